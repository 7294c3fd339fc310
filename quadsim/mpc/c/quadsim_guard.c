/* The fallback contract around a controller: what is flown when it has no usable answer, and the state it is given.
 *
 * Each period flies the first of these that there is: the controller's optimum; the last one's plan, shifted, with a
 * correction towards the states that it foresaw; level hover; descent.
 *
 * Completion.  A channel is missing if it is not finite, implausibly large, or frozen, and is replaced by its
 * conditional mean.  The hover model, about the equilibrium (x_s, u_s) and in axes turned by the yaw, predicts the
 * state under the command in force; a Kalman filter corrects it, channel by channel, with those that are measured
 * (Simon, "Optimal State Estimation", 2006, Secs. 5.1 and 6.1):
 *
 *     x = x_s + A (x - x_s) + B (u - u_s)    P = A P A' + Q
 *     x = x + P_i (y_i - x_i) / (P_ii + r_i)    P = P - P_i P_i' / (P_ii + r_i)    for each measured channel i
 *
 * Measured channels pass unchanged.  A group of three is frozen if it repeats the last period's numbers bit by bit
 * though the prediction has moved away from them: a sensor slower than the controller repeats its numbers between
 * samples.
 *
 * Level hover is the LQR of the hover model in axes turned by the yaw, from errors e to accelerations along z and about
 * x, y, z, which S maps from changes of commands:
 *
 *     u = u_s - S^-1 K e    roll and pitch demanded by horizontal errors: -(k_p e_p + k_v e_v) / k_tilt
 *
 * The demanded tilt, that at rest included, is bounded: the controller is exactly the LQR within the bound, and demands
 * no more tilt beyond.  Numbers: quadsim/mpc/guard/numbers.py of quadsim. */
#include "quadsim_guard.h"

#include <string.h>

#include "quadsim_math.h"

enum { MOST_PERIODS = 1 << 30 }; /* at which counts of periods stop: so long ago is never */

#ifdef QUADSIM_FLOAT
static const real BOUND_TOLERANCE = 6e-2F, RATE_ROUNDING = 1e-6F; /* [rad/s] of an optimum; relative, of a body rate */
#else
static const real BOUND_TOLERANCE = 1e-6, RATE_ROUNDING = 1e-9;
#endif

static void count_up(int *periods)
{
    *periods += *periods < MOST_PERIODS;
}

/* ---- the model of level hover ------------------------------------------------------------------------------------ */

/* Sine and cosine of a yaw. */
static void find_heading(real yaw, real heading[2])
{
    sin_cos(yaw, &heading[0], &heading[1]);
}

/* Turn positions and velocities about world z by the angle of a sine and a cosine. */
static void turn_horizontally(real *state, real sine, real cosine)
{
    int i;
    for (i = X; i <= VX; i++) {
        const real x = state[i], y = state[i + Y];
        state[i] = cosine * x - sine * y;
        state[i + Y] = sine * x + cosine * y;
    }
}

/* A deviation from rest a period later, by the model in axes turned by the yaw, of changed speeds (4,). */
static void predict_deviation(const quadsim_fallback *f, const real heading[2], const real *changes, real *deviation)
{
    real before[12];
    int i;
    for (i = 0; i < 12; i++) {
        before[i] = deviation[i];
    }
    turn_horizontally(before, -heading[0], heading[1]);
    for (i = 0; i < 12; i++) {
        deviation[i] = dot(f->A + i * 12, before, 12) + dot(f->B + i * NU, changes, NU);
    }
    turn_horizontally(deviation, heading[0], heading[1]);
}

/* A state a period later, of which roll and pitch at rest are level. */
static void predict_about(const quadsim_fallback *f, const real heading[2], const real level[2], const real *changes,
                          real *state)
{
    state[ROLL] -= level[0];
    state[PITCH] -= level[1];
    predict_deviation(f, heading, changes, state);
    state[ROLL] += level[0];
    state[PITCH] += level[1];
}

/* A state a period later under a command, by the model about where the vehicle rests. */
static void predict_by_hover_model(const quadsim_fallback *f, const quadsim_trim *trim, const real heading[2],
                                   const real *command, real *state)
{
    real effect[NU], level[2], lift = R(0.0);
    int j;
    lean_of(trim->lift, heading[0], heading[1], &level[0], &level[1]);
    for (j = 0; j < NU; j++) { /* thrust of rotors has another slope there, and turns the vehicle */
        effect[j] = (f->targets ? R(1.0) : trim->commands[j] / f->hover[j]) * (command[j] - trim->commands[j]);
        lift += f->slope[j] * effect[j];
    }
    for (j = 0; j < NU && !f->targets; j++) {
        effect[j] += lift * dot(f->inverse + j * NU + 1, trim->twist, 3);
    }
    predict_about(f, heading, level, effect, state);
}

/* ---- the state, completed by a Kalman filter --------------------------------------------------------------------- */

static int is_moved(real predicted, real measured, real unmoved)
{
    return magnitude(predicted - measured) > unmoved;
}

/* Which channels repeat the last period's numbers; returns whether any does. */
static int find_repeated(quadsim_guard *g, const real *measured, const int *seen, int *repeated)
{
    real rates[3] = {R(1e30), R(1e30), R(1e30)}; /* of no vehicle */
    int i, any = 0, turning = 1, same = 1;
    for (i = 0; i < 12; i++) {
        repeated[i] = is_equal(measured[i], g->last[i]);
        turning &= i < ROLL || seen[i];
    }
    if (turning) { /* a gyro's numbers, which Euler rates are made of */
        body_rates(measured, rates);
        for (i = 0; i < 3; i++) {
            same &= magnitude(rates[i] - g->last_rates[i]) <= R(1e-12) + RATE_ROUNDING * magnitude(rates[i]);
        }
    }
    for (i = 0; i < 12; i++) {
        repeated[i] |= turning && same && i > ROLL && i % 2 == 1;
        any |= repeated[i];
    }
    memcpy(g->last, measured, sizeof(g->last));
    memcpy(g->last_rates, rates, sizeof(rates));
    return any;
}

/* No longer take a group of three channels for measured that repeats its numbers though the vehicle moves. */
static void drop_frozen(const quadsim_fallback *f, const real *predicted, const real *measured, const int *repeated,
                        int *seen)
{
    int group, i;
    for (group = 0; group < 4; group++) {
        const int first = group / 2 * ROLL + group % 2;
        int same = 1, moved = 0;
        for (i = first; i <= first + 4; i += 2) {
            same &= repeated[i];
            moved |= is_moved(predicted[i], measured[i], f->unmoved[i]);
        }
        for (i = first; i <= first + 4 && same && moved; i += 2) {
            seen[i] = 0;
        }
    }
}

/* The covariance of the state a period later: F P F' + Q. */
static void predict_covariance(const quadsim_fallback *f, const real heading[2], real *covariance)
{
    static const real still[NU] = {R(0.0)};
    real line[12] = {R(0.0)};
    int i, j;
    for (j = 0; j < 12; j++) {
        for (i = 0; i < 12; i++) {
            line[i] = covariance[i * 12 + j];
        }
        predict_deviation(f, heading, still, line);
        for (i = 0; i < 12; i++) {
            covariance[i * 12 + j] = line[i];
        }
    }
    for (i = 0; i < 12; i++) {
        predict_deviation(f, heading, still, covariance + i * 12);
    }
    for (i = 0; i < 12; i += 2) {
        const real *process = f->process + (i < ROLL ? 0 : 3);
        real *pair = covariance + i * 12 + i;
        pair[0] += process[0];
        pair[1] += process[1];
        pair[12] += process[1];
        pair[13] += process[2];
    }
}

/* Correct a predicted state, and its covariance, by one measured channel. */
static void update_by_channel(const quadsim_fallback *f, int channel, real measured, real *state, real *covariance)
{
    real column[12], innovation = measured - state[channel], sum, share;
    int i, j;
    for (i = 0; i < 12; i++) {
        column[i] = covariance[i * 12 + channel];
    }
    sum = (column[channel] > R(0.0) ? column[channel] : R(0.0)) + f->noise[channel];
    share = f->noise[channel] / sum;
    for (i = 0; i < 12; i++) {
        state[i] += column[i] / sum * innovation;
        for (j = 0; j < 12; j++) {
            covariance[i * 12 + j] -= column[i] * column[j] / sum;
        }
    }
    for (i = 0; i < 12; i++) { /* a difference of nearly equal numbers above */
        covariance[i * 12 + channel] = covariance[channel * 12 + i] = share * column[i];
    }
}

static void set_diagonal(real *covariance, const real *variances)
{
    int i;
    memset(covariance, 0, 144 * sizeof(real));
    for (i = 0; i < 12; i++) {
        covariance[i * 13] = variances[i];
    }
}

/* The whole state now, of what is measured of it, the others predicted under the command in force. */
static void complete_state(quadsim_guard *g, const quadsim_trim *trim, const real *measured, int flying)
{
    const quadsim_fallback *f = g->numbers;
    real predicted[12], heading[2];
    int seen[12], repeated[12], i, all = 1, any;
    for (i = 0; i < 12; i++) {
        seen[i] = is_within(measured + i, f->plausible[i], 1);
        all &= seen[i];
    }
    any = find_repeated(g, measured, seen, repeated);
    if (!all || (flying && any)) {
        memcpy(predicted, g->state, sizeof(predicted));
        find_heading(g->state[YAW], heading);
        predict_by_hover_model(f, trim, heading, g->in_force, predicted);
        if (flying) {
            drop_frozen(f, predicted, measured, repeated, seen);
        }
        for (i = 0, all = 1; i < 12; i++) {
            all &= seen[i];
        }
    }
    if (all) {
        memcpy(g->state, measured, sizeof(g->state));
        set_diagonal(g->covariance, f->noise);
        memset(g->unseen, 0, sizeof(g->unseen));
        return;
    }
    predict_covariance(f, heading, g->covariance);
    for (i = 0; i < 12; i++) {
        if (seen[i]) {
            update_by_channel(f, i, measured[i], predicted, g->covariance);
        }
    }
    if (!is_finite(g->covariance, 144)) { /* after days without a measurement */
        set_diagonal(g->covariance, f->unknown);
    }
    for (i = 0; i < 12; i++) {
        g->state[i] = seen[i] ? measured[i] : clipped(predicted[i], -f->plausible[i], f->plausible[i]);
        count_up(&g->unseen[i]);
        if (seen[i]) {
            g->unseen[i] = 0;
        }
    }
}

/* ---- level hover by LQR ------------------------------------------------------------------------------------------ */

/* Changes of speeds (4,) that an error in axes turned by the yaw demands, roll and pitch at rest being none. */
static void lqr_feedback(const quadsim_fallback *f, const real *error, const real level[2], real *change)
{
    real lean[2], levelled[12], acceleration[NU], length;
    int i;
    for (i = 0; i < 2; i++) {
        lean[i] = level[i] - dot(f->lean + i * 4, error, 4); /* of x, vx, y, vy */
    }
    length = square_root(lean[0] * lean[0] + lean[1] * lean[1]);
    memcpy(levelled, error, sizeof(levelled));
    memset(levelled, 0, 4 * sizeof(real));
    for (i = 0; i < 2; i++) {
        levelled[ROLL + 2 * i] -= length > f->tilt ? lean[i] * (f->tilt / length) : lean[i];
    }
    for (i = 0; i < NU; i++) {
        acceleration[i] = -dot(f->gain + i * 12, levelled, 12);
    }
    acceleration[0] = clipped(acceleration[0], -f->climb, f->climb);
    acceleration[3] = clipped(acceleration[3], -f->turn, f->turn);
    for (i = 0; i < NU; i++) {
        change[i] = dot(f->inverse + i * NU, acceleration, NU);
    }
}

/* ---- what is flown ----------------------------------------------------------------------------------------------- */

void quadsim_guard_clip(const quadsim_fallback *f, const quadsim_real *wanted, const quadsim_real *before,
                        quadsim_real *command)
{
    int j;
    for (j = 0; j < NU; j++) {
        const real lower = clipped(before[j] + f->step_least[j], f->least[j], f->most[j]);
        const real upper = clipped(before[j] + f->step_most[j], f->least[j], f->most[j]);
        command[j] = clipped(wanted[j], lower, upper);
    }
}

/* Move rows [count][4] of a plan within what the bounds leave after the row before, unless they are up to rounding. */
static void clip_rows(const quadsim_fallback *f, const real *before, int count, real *rows)
{
    int i, j, beyond = 0;
    for (i = 0; i < count; i++) {
        const real *last = i == 0 ? before : rows + (i - 1) * NU;
        for (j = 0; j < NU; j++) {
            const real step = rows[i * NU + j] - last[j];
            beyond |= f->step_least[j] - step > BOUND_TOLERANCE || step - f->step_most[j] > BOUND_TOLERANCE;
        }
    }
    for (i = 0; i < count; i++) {
        real *row = rows + i * NU;
        for (j = 0; j < NU && !beyond; j++) {
            row[j] = clipped(row[j], f->least[j], f->most[j]);
        }
        if (beyond) {
            quadsim_guard_clip(f, row, i == 0 ? before : row - NU, row);
        }
    }
}

/* Row i of the last plan, whose last row holds on. */
static const real *kept_row(const quadsim_guard *g, int i)
{
    return g->kept + (i < g->horizon ? i : g->horizon - 1) * NU;
}

/* Leave all fallback levels. */
static void leave_fallback(quadsim_guard *g)
{
    g->planned = g->foreseeing = g->age = g->hovered = g->targeted = 0;
}

/* The command of the last plan, corrected; 0 from when it is no longer usable. */
static int follow_plan(quadsim_guard *g, int lost, real *command)
{
    static const real level[2] = {R(0.0), R(0.0)};
    const quadsim_fallback *f = g->numbers;
    real error[12] = {R(0.0)}, heading[2];
    int i, near = 1;
    if (!g->planned) {
        return 0;
    }
    for (i = 0; i < 12; i++) {
        error[i] = g->state[i] - g->foreseen[i];
        near &= is_within(error + i, f->distance[i], 1);
    }
    g->planned = near && !lost && g->age <= f->plan_age && g->age < g->horizon;
    if (!g->planned) {
        return 0;
    }
    find_heading(g->state[YAW], heading);
    turn_horizontally(error, -heading[0], heading[1]);
    lqr_feedback(f, error, level, command);
    for (i = 0; i < NU; i++) {
        command[i] += g->kept[g->age * NU + i];
    }
    quadsim_guard_clip(f, command, g->in_force, command);
    return 1;
}

/* The command of level hover towards a target, in axes turned by a heading. */
static void hover_command(const quadsim_fallback *f, const quadsim_trim *trim, const real heading[2], const real *state,
                          const real *target, const real *before, real *command)
{
    real error[12] = {R(0.0)}, level[2];
    int i;
    for (i = 0; i < 12; i++) {
        error[i] = state[i] - target[i];
    }
    turn_horizontally(error, -heading[0], heading[1]);
    lean_of(trim->lift, heading[0], heading[1], &level[0], &level[1]);
    lqr_feedback(f, error, level, command);
    for (i = 0; i < NU; i++) {
        command[i] += trim->commands[i];
    }
    quadsim_guard_clip(f, command, before, command);
}

/* The command of level hover, or of the descent after it, whose target moves; returns its level. */
static int fly_hover(quadsim_guard *g, const quadsim_trim *trim, real *command)
{
    const quadsim_fallback *f = g->numbers;
    const real *state = g->state;
    const int sinking = g->hovered >= f->hover_periods;
    real heading[2];
    if (!g->targeted) {
        g->targeted = 1;
        memset(g->target, 0, sizeof(g->target));
        g->target[X] = state[X];
        g->target[Y] = state[Y];
        g->target[Z] = state[Z];
        g->target[YAW] = state[YAW];
    }
    if (square_root(state[VX] * state[VX] + state[VY] * state[VY]) > f->settled) {
        g->target[X] = state[X];
        g->target[Y] = state[Y];
    }
    if (sinking) {
        g->target[VZ] = -f->sink;
        g->target[Z] -= f->sunk;
    }
    count_up(&g->hovered);
    find_heading(state[YAW], heading);
    hover_command(f, trim, heading, state, g->target, g->in_force, command);
    return sinking ? 3 : 2;
}

/* The closed loop of level hover, or of the descent, by the model turned by the yaw now, from the period's command on.
 */
static void plan_hover(const quadsim_guard *g, real *plan)
{
    const quadsim_fallback *f = g->numbers;
    real state[12], target[12], heading[2];
    int i;
    memcpy(state, g->state, sizeof(state));
    memcpy(target, g->target, sizeof(target));
    find_heading(state[YAW], heading);
    for (i = 1; i < g->horizon; i++) {
        const real *before = plan + (i - 1) * NU;
        predict_by_hover_model(f, &g->trim, heading, before, state);
        target[Z] -= g->level == 3 ? f->sunk : R(0.0);
        hover_command(f, &g->trim, heading, state, target, before, plan + i * NU);
    }
}

/* ---- periods ----------------------------------------------------------------------------------------------------- */

int quadsim_is_flown(enum quadsim_status status)
{
    return status <= QUADSIM_WHOLE || status >= QUADSIM_NOT_CONVERGED;
}

void quadsim_guard_start(quadsim_guard *guard, const quadsim_fallback *numbers, int horizon, quadsim_real *kept)
{
    memset(guard, 0, sizeof(*guard));
    guard->numbers = numbers;
    guard->horizon = horizon;
    guard->kept = kept;
}

void quadsim_guard_reset(quadsim_guard *guard, const quadsim_real command[4])
{
    const quadsim_fallback *f = guard->numbers;
    int i;
    memcpy(guard->before, is_within(command, f->largest_command, NU) ? command : f->hover, sizeof(guard->before));
    leave_fallback(guard);
    guard->level = guard->learns = 0;
    memset(guard->state, 0, sizeof(guard->state));
    set_diagonal(guard->covariance, f->unknown);
    for (i = 0; i < 12; i++) {
        guard->unseen[i] = MOST_PERIODS;
        guard->last[i] = guard->last_rates[i % 3] = R(-1e30); /* what no channel repeats */
    }
    guard->since = guard->asked = guard->waiting = MOST_PERIODS;
}

void quadsim_guard_adopt(quadsim_guard *guard, const quadsim_guard *previous)
{
    int i;
    memcpy(guard->state, previous->state, sizeof(guard->state));
    memcpy(guard->covariance, previous->covariance, sizeof(guard->covariance));
    memcpy(guard->unseen, previous->unseen, sizeof(guard->unseen));
    memcpy(guard->last, previous->last, sizeof(guard->last));
    memcpy(guard->last_rates, previous->last_rates, sizeof(guard->last_rates));
    guard->age = previous->age;
    guard->hovered = previous->hovered;
    guard->targeted = previous->targeted;
    memcpy(guard->target, previous->target, sizeof(guard->target));
    if (!previous->planned || previous->numbers->targets != guard->numbers->targets) {
        return;
    }
    guard->planned = 1;
    memcpy(guard->foreseen, previous->foreseen, sizeof(guard->foreseen));
    for (i = 0; i < guard->horizon; i++) {
        memcpy(guard->kept + i * NU, kept_row(previous, i), NU * sizeof(real));
    }
}

enum quadsim_status quadsim_guard_begin(quadsim_guard *guard, enum quadsim_phase phase, const quadsim_trim *trim,
                                        const quadsim_real state[12], const quadsim_real *reference, int count,
                                        const quadsim_real acting[4])
{
    const quadsim_fallback *f = guard->numbers;
    int i, oldest = 0, moving = 1;
    memcpy(guard->in_force, is_within(acting, f->largest_command, NU) ? acting : guard->before,
           sizeof(guard->in_force));
    complete_state(guard, trim, state, phase == QUADSIM_PHASE_FLYING);
    count_up(&guard->waiting);
    for (i = 0; i < 12; i++) {
        oldest = guard->unseen[i] > oldest ? guard->unseen[i] : oldest;
        moving &= guard->unseen[i] == 0 || i == X || i == Y || i == Z; /* how it turns, and how fast it flies */
    }
    guard->learns = 0;
    if (oldest > f->unseen) {
        guard->since = MOST_PERIODS;
        return QUADSIM_STATE_UNKNOWN;
    }
    if (!is_within(reference, f->largest_reference, count)) {
        guard->since = MOST_PERIODS;
        return QUADSIM_INVALID_REFERENCE;
    }
    guard->asked = guard->waiting;
    guard->waiting = 0;
    count_up(&guard->since);
    if (phase != QUADSIM_PHASE_LANDED) {
        guard->learns = moving && guard->since <= f->compared && phase == QUADSIM_PHASE_FLYING;
        guard->since = moving ? 0 : guard->since;
    }
    return QUADSIM_FREE;
}

enum quadsim_status quadsim_guard_check(const quadsim_guard *guard, enum quadsim_status status,
                                        const quadsim_real *plan)
{
    real flown[NU];
    int i;
    if (!quadsim_is_flown(status)) {
        return status;
    }
    if (!is_finite(plan, guard->horizon * NU)) {
        return QUADSIM_NOT_FINITE;
    }
    quadsim_guard_clip(guard->numbers, plan, guard->in_force, flown);
    for (i = 0; i < NU; i++) {
        if (magnitude(plan[i] - flown[i]) > BOUND_TOLERANCE) {
            return QUADSIM_OUT_OF_BOUNDS;
        }
    }
    return status;
}

int quadsim_guard_turned(const quadsim_guard *guard)
{
    return guard->unseen[ROLL] == 0 && guard->unseen[PITCH] == 0 && guard->unseen[YAW] == 0;
}

int quadsim_guard_has_rates(const quadsim_guard *guard)
{
    const int turning = guard->unseen[ROLL + 1] == 0 && guard->unseen[PITCH + 1] == 0 && guard->unseen[YAW + 1] == 0;
    return turning || magnitude(guard->state[PITCH]) >= guard->numbers->upright;
}

int quadsim_guard_foresees(const quadsim_guard *guard, enum quadsim_phase phase, enum quadsim_status status)
{
    return guard->planned && phase != QUADSIM_PHASE_LANDED && !quadsim_is_flown(status);
}

const quadsim_real *quadsim_guard_row(const quadsim_guard *guard)
{
    return kept_row(guard, guard->age);
}

void quadsim_guard_foresee(quadsim_guard *guard, int heading, const quadsim_trim *trim, const quadsim_real resting[4])
{
    const real *row = quadsim_guard_row(guard);
    real changes[NU];
    int i;
    if (!guard->foreseeing) {
        guard->foreseeing = 1;
        find_heading(heading ? guard->foreseen[YAW] : R(0.0), guard->heading);
        lean_of(trim->lift, guard->heading[0], guard->heading[1], &guard->level_there[0], &guard->level_there[1]);
        memcpy(guard->resting, resting, sizeof(guard->resting));
    }
    for (i = 0; i < NU; i++) {
        changes[i] = row[i] - guard->resting[i];
    }
    predict_about(guard->numbers, guard->heading, guard->level_there, changes, guard->foreseen);
}

enum quadsim_status quadsim_guard_end(quadsim_guard *guard, enum quadsim_phase phase, const quadsim_trim *trim,
                                      enum quadsim_status status, const quadsim_real *plan, quadsim_real command[4])
{
    const quadsim_fallback *f = guard->numbers;
    if (phase == QUADSIM_PHASE_LANDED) {
        static const real slowest[NU] = {R(0.0)};
        leave_fallback(guard);
        guard->level = 0;
        status = QUADSIM_LANDED;
        quadsim_guard_clip(f, slowest, guard->in_force, command);
    } else if (quadsim_is_flown(status)) {
        leave_fallback(guard);
        guard->level = 0;
        quadsim_guard_clip(f, plan, guard->in_force, command);
        memcpy(guard->kept, plan, (size_t)(guard->horizon * NU) * sizeof(real));
        memcpy(guard->kept, command, NU * sizeof(real));
        clip_rows(f, command, guard->horizon - 1, guard->kept + NU);
        memcpy(guard->foreseen, guard->state, sizeof(guard->foreseen));
        guard->planned = 1;
    } else {
        count_up(&guard->age);
        guard->level = 1;
        if (!follow_plan(guard, status == QUADSIM_STATE_UNKNOWN, command)) {
            guard->level = fly_hover(guard, trim, command);
        }
    }
    memcpy(guard->before, command, sizeof(guard->before));
    guard->trim = *trim;
    return status;
}

void quadsim_guard_plan(const quadsim_guard *guard, quadsim_real *plan)
{
    int i;
    memcpy(plan, guard->before, sizeof(guard->before));
    if (guard->level >= 2) {
        plan_hover(guard, plan);
        return;
    }
    for (i = 1; i < guard->horizon; i++) {
        memcpy(plan + i * NU, guard->planned ? kept_row(guard, guard->age + i) : guard->before, sizeof(guard->before));
    }
    if (guard->level == 1) {
        clip_rows(guard->numbers, plan, guard->horizon - 1, plan + NU);
    }
}
