/* The controller around quadsim_nmpc.h: the reference's nodes, the disturbance, commands for shares, and the guard.
 *
 * A constant disturbance follows d <- d + L (v - v expected), with the state expected by quadsim_nmpc_model.c; one that
 * changes is quadsim_ramp.h's.  The reference is balanced against it: of thrust T b per mass and drag D, each node gets
 * the thrust axis along  T b - d - D, by the least rotation, and the thrusts that give its length and torque -d_R. */
#include "quadsim_nonlinear.h"

#include <string.h>

#include "quadsim_nmpc_math.h"

static const real SIDE_KEPT_ABOVE = R(-0.08715574274765817); /* cosine of 95 deg, half of what a heading may be off */
#ifdef QUADSIM_FLOAT
static const real INPUT_TOLERANCE = 1e-3F; /* tolerance of bounds on inputs, as a share of the largest */
#else
static const real INPUT_TOLERANCE = 1e-6;
#endif

/* Periods of the reference and of the plan. */
static int rows_of(const quadsim_nonlinear_numbers *numbers)
{
    return numbers->problem->horizon * numbers->stride;
}

/* Whole periods for which commands are under way. */
static int under_way_of(const quadsim_nonlinear_numbers *numbers)
{
    return numbers->delay == NULL ? 0 : numbers->delay->under_way;
}

/* Numbers of a reference; a motion goes on until the last node, by the delay later, and to the sample after it. */
static int count_of(const quadsim_nonlinear_numbers *numbers, int motion)
{
    const int later = numbers->delay == NULL ? 0 : numbers->delay->under_way + 1;
    return motion ? (rows_of(numbers) + 1 + later) * QUADSIM_MOTION : rows_of(numbers) * QUADSIM_PREVIEW;
}

static int actuators_of(const quadsim_nonlinear_numbers *numbers)
{
    return numbers->problem->actuators;
}

/* ---- inputs and commands ----------------------------------------------------------------------------------------- */

/* Shares of the largest inputs for commands (4,). */
static void put_shares(const quadsim_nonlinear_numbers *numbers, const real *commands, real *shares)
{
    commands_to_shares(numbers->problem, numbers->coefficient, numbers->scale, commands, shares);
}

/* Commands (4,) for shares, moved onto their bounds. */
static void put_commands(const quadsim_nonlinear_numbers *numbers, const real *shares, real *commands)
{
    const quadsim_nmpc_problem *p = numbers->problem;
    int j;
    for (j = 0; j < NU; j++) {
        const real share = clipped(shares[j], p->lower[j], p->upper[j]);
        const real rotor = p->speeds ? share * share : share;
        commands[j] = p->targets ? share * numbers->scale[j] : square_root(rotor * p->largest / numbers->coefficient);
    }
}

/* ---- the reference ----------------------------------------------------------------------------------------------- */

/* Nodes of a motion. */
static void take_motion(quadsim_nonlinear *law, const real *reference)
{
    const quadsim_nonlinear_numbers *numbers = law->numbers;
    const int N = numbers->problem->horizon;
    int i;
    for (i = 0; i <= N; i++) {
        const real *row = reference + i * numbers->stride * QUADSIM_MOTION;
        real later[QUADSIM_MOTION];
        if (numbers->delay != NULL) {
            quadsim_delay_sample(numbers->delay, numbers->control_period, reference, i * numbers->stride, later);
            row = later;
        }
        memcpy(law->states + i * BODY, row, BODY * sizeof(real));
        if (i < N) {
            memcpy(law->thrusts + i * NU, row + BODY, NU * sizeof(real));
        }
    }
}

/* A level node at x y z yaw (4,), of which these are the rates. */
static void put_node(quadsim_nonlinear *law, int node, const real *place, const real *rates)
{
    real *state = law->states + node * BODY;
    memset(state, 0, BODY * sizeof(real));
    memcpy(state + P, place, 3 * sizeof(real));
    sin_cos(R(0.5) * place[3], &state[Q + 3], &state[Q]);
    memcpy(state + V, rates, 3 * sizeof(real));
    state[W + 2] = rates[3];
    if (node < law->numbers->problem->horizon) {
        memcpy(law->thrusts + node * NU, law->numbers->lifts, NU * sizeof(real));
    }
}

/* Row k of a preview as it is the delay later, its yaw without turns: `turns` are those of the row read before, and
 * become those of this one.  Past the end the last row is held. */
static void read_preview_row(const quadsim_nonlinear_numbers *numbers, const real *reference, int k, real *turns,
                             real row[4])
{
    const int last = rows_of(numbers) - 1, at = k + under_way_of(numbers), now = at < last ? at : last;
    int i;
    for (i = k == 0 ? 1 : at; i <= now; i++) {
        *turns = next_turns(reference, i, *turns);
    }
    memcpy(row, reference + now * 4, 4 * sizeof(real));
    row[3] -= TURN * *turns;
    if (numbers->delay != NULL && now < last) {
        const real *next = reference + (now + 1) * 4, share = numbers->delay->share;
        const real heading = next[3] - TURN * next_turns(reference, now + 1, *turns);
        for (i = 0; i < 3; i++) {
            row[i] += share * (next[i] - row[i]);
        }
        row[3] += share * (heading - row[3]);
    }
}

/* Nodes of a preview: velocities by differences, level, thrusts of hover.  The first node, which has no cost, is
 * extrapolated from the first two rows. */
static void take_preview(quadsim_nonlinear *law, const real *reference, real yaw)
{
    const quadsim_nonlinear_numbers *numbers = law->numbers;
    const int rows = rows_of(numbers);
    real turns = first_turns(&law->headed, &law->heading, reference, yaw);
    real place[4], next[4], step[4] = {R(0.0)}, rates[4];
    int k, j;
    read_preview_row(numbers, reference, 0, &turns, place);
    for (k = 1; k <= rows; k++) { /* the k-th row, k periods from now */
        memcpy(next, place, sizeof(next));
        if (k < rows) {
            read_preview_row(numbers, reference, k, &turns, next);
        }
        for (j = 0; j < 4; j++) {
            const real ahead = k < rows ? next[j] - place[j] : step[j];
            rates[j] = R(0.5) * ((k == 1 ? ahead : step[j]) + ahead) / numbers->control_period;
            step[j] = ahead;
        }
        if (k == 1) {
            real first[4];
            for (j = 0; j < 4; j++) {
                first[j] = place[j] - step[j];
            }
            put_node(law, 0, first, rates);
        }
        if (k % numbers->stride == 0) {
            put_node(law, k / numbers->stride, place, rates);
        }
        memcpy(place, next, sizeof(place));
    }
}

/* ---- what disturbs ------------------------------------------------------------------------------------------------
 */

static int is_any(const real *numbers, int count)
{
    int i;
    for (i = 0; i < count; i++) {
        if (magnitude(numbers[i]) > R(0.0)) {
            return 1;
        }
    }
    return 0;
}

/* Where the vehicle rests under the world's disturbance; of rotors level hover. */
static void find_trim(quadsim_nonlinear *law)
{
    const quadsim_nonlinear_numbers *numbers = law->numbers;
    const quadsim_nmpc_problem *p = numbers->problem;
    quadsim_trim *trim = &law->trim;
    memset(trim, 0, sizeof(*trim));
    memcpy(trim->commands, numbers->level, sizeof(trim->commands));
    trim->lift[2] = R(1.0);
    if (p->targets) {
        const real least = numbers->least_lift * p->gravity, up = p->gravity - law->world.acceleration[2];
        trim->lift[0] = -law->world.acceleration[0];
        trim->lift[1] = -law->world.acceleration[1];
        trim->lift[2] = up > least ? up : least;
        trim->commands[0] = numbers->mass * square_root(dot(trim->lift, trim->lift, 3)) / law->world.thrust_scale;
    }
}

/* Predict with the observer's estimate from now on. */
static void apply_estimate(quadsim_nonlinear *law)
{
    memcpy(law->world.acceleration, law->estimate, sizeof(law->world.acceleration));
    memset(law->world.angular, 0, sizeof(law->world.angular));
    if (!law->numbers->problem->targets) { /* an inner loop balances torques */
        memcpy(law->world.angular, law->estimate + 3, sizeof(law->world.angular));
    }
    find_trim(law);
}

/* Take note of how the measured state differs from the one that the last and the command in force lead to. */
static void update_estimate(quadsim_nonlinear *law)
{
    const quadsim_nonlinear_numbers *numbers = law->numbers;
    real expected[QUADSIM_NMPC_MOST], innovation[6];
    int i;
    memcpy(law->last + BODY, law->rotors_before, (size_t)actuators_of(numbers) * sizeof(real));
    if (numbers->delay != NULL) {
        quadsim_delay_expect(&law->delay, numbers->delay, &law->world, law->last, expected);
    } else {
        quadsim_nmpc_advance(numbers->period, &law->world, 1, law->last, law->before, expected);
    }
    for (i = 0; i < 6; i++) {
        const int at = i < 3 ? V + i : W + i - 3;
        innovation[i] = i >= 3 && numbers->problem->targets ? R(0.0) : law->measured[at] - expected[at];
    }
    update_disturbance(numbers->gain, numbers->largest, innovation, law->estimate);
    apply_estimate(law);
}

/* Turn a quaternion by the least rotation that takes a unit vector to the direction of another, (1 + a . b, a x b) up
 * to its length; not at all where they are opposite. */
static void turn_least(const real *unit, const real *to, real size, real *q)
{
    real turn[4], turned[4], length;
    int i;
    turn[0] = R(1.0) + dot(unit, to, 3) / size;
    turn[1] = (unit[1] * to[2] - unit[2] * to[1]) / size;
    turn[2] = (unit[2] * to[0] - unit[0] * to[2]) / size;
    turn[3] = (unit[0] * to[1] - unit[1] * to[0]) / size;
    length = square_root(dot(turn, turn, 4));
    if (length < R(1e-6)) {
        return;
    }
    from_frame(turn, q, turned);
    for (i = 0; i < 4; i++) {
        q[i] = turned[i] / length;
    }
}

/* Add to the reference what balances air and disturbance: thrust turned by the least rotation, and torque. */
static void balance_reference(quadsim_nonlinear *law)
{
    const quadsim_nonlinear_numbers *numbers = law->numbers;
    const quadsim_nmpc_world *world = &law->world;
    const int N = numbers->problem->horizon;
    int i, j;
    if (!numbers->problem->moments && !is_any(world->acceleration, 3) && !is_any(world->angular, 3) &&
        !is_any(world->drag, 3) && !is_any(world->square_drag, 3)) {
        return;
    }
    for (i = N; i >= 0; i--) { /* the last node has the thrusts of the one before, as they were */
        real *state = law->states + i * BODY, *thrusts = law->thrusts + (i < N ? i : N - 1) * NU;
        const real total = ((thrusts[0] + thrusts[1]) + (thrusts[2] + thrusts[3])) / numbers->mass;
        real turn[3][3], along[3], pull[3], drag[3] = {R(0.0)}, turned[3], axis[3], wanted[3], effort[NU], size, lost;
        thrust_axis(state + Q, axis);
        rotation_of(state + Q, R(2.0), turn);
        add_air_drag(world->drag, world->square_drag, turn, state + V, along, pull, drag);
        lost = quadsim_nmpc_turned(numbers->problem, state, thrusts, turned);
        for (j = 0; j < 3; j++) {
            wanted[j] = (total + lost) * axis[j] - world->acceleration[j] - drag[j];
        }
        size = square_root(dot(wanted, wanted, 3));
        size = size > R(1e-9) ? size : R(1e-9);
        turn_least(axis, wanted, size, state + Q);
        effort[0] = size - total;
        for (j = 0; j < 3; j++) {
            effort[1 + j] = -world->angular[j] - turned[j];
        }
        for (j = 0; j < NU && i < N; j++) {
            thrusts[j] += dot(numbers->inverse + j * NU, effort, NU);
        }
    }
}

/* Split the observed force into drag, as far as it follows the velocity, and a constant remainder. */
static void update_drag_and_force(quadsim_nonlinear *law, int follows, const real *acting)
{
    const quadsim_nonlinear_numbers *numbers = law->numbers;
    quadsim_nmpc_world *world = &law->world;
    const real *velocity = law->measured + V, length = square_root(dot(law->measured + Q, law->measured + Q, 4));
    real q[4], turn[3][3], attitude[9], change[3], drag[3], along[3];
    int i;
    for (i = 0; i < 4; i++) {
        q[i] = law->measured[Q + i] / length;
    }
    rotation_of(q, R(2.0), turn);
    memcpy(attitude, turn, sizeof(attitude));
    quadsim_ramp_update(&law->ramp, numbers->ramp, follows, velocity, attitude, law->measured + W, acting);
    quadsim_ramp_foreseen(&law->ramp, numbers->ramp, R(0.5) * numbers->control_period, world->acceleration, change,
                          world->angular);
    quadsim_ramp_drag(&law->ramp, numbers->ramp, drag);
    for (i = 0; i < 3; i++) {
        along[i] = drag[i] * along_axis(turn, i, velocity);
        world->drag[i] = numbers->drag[i] + drag[i];
    }
    for (i = 0; i < 3; i++) {
        world->acceleration[i] += dot(turn[i], along, 3);
    }
    world->thrust_scale = quadsim_ramp_scale(&law->ramp, numbers->ramp);
    find_trim(law);
}

/* ---- periods ------------------------------------------------------------------------------------------------------
 */

/* Let actuators follow the commands in force, since the call before; `acting` is the last one that was sent. */
static void update_actuators(quadsim_nonlinear *law, int periods, const real *acting)
{
    const real left = law->numbers->left;
    int i, j;
    if (law->numbers->delay != NULL) {
        quadsim_delay_send(&law->delay, law->numbers->delay, law->called ? periods : 0, acting);
        memcpy(law->rotors, law->delay.rotors, sizeof(law->rotors));
        memcpy(law->rotors_before, law->delay.rotors_before, sizeof(law->rotors_before));
        law->called = 1;
        return;
    }
    memcpy(law->rotors_before, law->rotors, sizeof(law->rotors));
    if (law->called && left > R(0.0)) {
        for (j = 0; j < NU; j++) {
            real away = law->rotors[j] - law->before[j];
            for (i = 0; i < periods && i < SETTLED_PERIODS; i++) {
                away *= left;
            }
            law->rotors[j] = law->before[j] + away;
        }
    }
    law->called = 1;
}

/* Drop the plan, and assume no disturbance. */
static void reset_estimates(quadsim_nonlinear *law, const real *acting)
{
    const quadsim_nonlinear_numbers *numbers = law->numbers;
    quadsim_nmpc_reset(&law->work);
    law->called = law->turned = law->headed = law->learns = 0;
    law->side = R(1.0);
    law->world.thrust_scale = R(1.0);
    if (numbers->ramp != NULL) {
        quadsim_ramp_reset(&law->ramp, numbers->ramp, acting);
        law->world.thrust_scale = quadsim_ramp_scale(&law->ramp, numbers->ramp);
    }
    memcpy(law->world.drag, numbers->drag, sizeof(law->world.drag));
    memcpy(law->world.square_drag, numbers->square_drag, sizeof(law->world.square_drag));
    memset(law->estimate, 0, sizeof(law->estimate));
    apply_estimate(law);
}

/* q and -q are one attitude: the one near the last measured, and of the reference's, whose turns count, the nearer one
 * until it is more than 190 deg away. */
static void choose_sides(quadsim_nonlinear *law)
{
    real *q = law->measured + Q;
    const int N = law->numbers->problem->horizon;
    int i, j;
    if (!law->turned) {
        memcpy(law->quaternion, law->states + Q, sizeof(law->quaternion));
    }
    law->turned = 1;
    if (dot(q, law->quaternion, 4) < R(0.0)) {
        for (j = 0; j < 4; j++) {
            q[j] = -q[j];
        }
    }
    memcpy(law->quaternion, q, sizeof(law->quaternion));
    if (law->side * dot(q, law->states + Q, 4) < SIDE_KEPT_ABOVE) {
        law->side = -law->side;
    }
    for (i = 0; i <= N && law->side < R(0.0); i++) {
        for (j = 0; j < 4; j++) {
            law->states[i * BODY + Q + j] *= R(-1.0);
        }
    }
}

long quadsim_nonlinear_reals(const quadsim_nonlinear_numbers *numbers)
{
    const int N = numbers->problem->horizon;
    return quadsim_nmpc_reals(numbers->problem) + (N + 1) * BODY + N * NU + 2 * rows_of(numbers) * NU;
}

long quadsim_nonlinear_ints(const quadsim_nonlinear_numbers *numbers)
{
    return quadsim_nmpc_ints(numbers->problem);
}

void quadsim_nonlinear_start(quadsim_nonlinear *law, const quadsim_nonlinear_numbers *numbers, quadsim_real *reals,
                             int *ints)
{
    const int N = numbers->problem->horizon, rows = rows_of(numbers);
    memset(law, 0, sizeof(*law));
    law->numbers = numbers;
    law->states = reals;
    law->thrusts = law->states + (N + 1) * BODY;
    law->plan = law->thrusts + N * NU;
    law->kept = law->plan + rows * NU;
    quadsim_nmpc_start(&law->work, numbers->problem, law->kept + rows * NU, ints);
    quadsim_guard_start(&law->guard, numbers->fallback, rows, law->kept);
    quadsim_nonlinear_reset(law, numbers->level);
}

void quadsim_nonlinear_reset(quadsim_nonlinear *law, const quadsim_real command[4])
{
    const real *usable = is_finite(command, NU) ? command : law->numbers->level;
    if (law->numbers->fallback != NULL) {
        quadsim_guard_reset(&law->guard, command);
        usable = law->guard.before;
    }
    put_shares(law->numbers, usable, law->rotors);
    memcpy(law->rotors_before, law->rotors, sizeof(law->rotors));
    memcpy(law->before, law->rotors, sizeof(law->before));
    if (law->numbers->delay != NULL) {
        quadsim_delay_reset(&law->delay, law->numbers->delay, usable);
    }
    reset_estimates(law, usable);
}

void quadsim_nonlinear_learn(quadsim_nonlinear *law, const quadsim_real estimate[6])
{
    const quadsim_nonlinear_numbers *numbers = law->numbers;
    if (!numbers->observes || !is_finite(estimate, 6)) {
        return;
    }
    put_disturbance(numbers->largest, estimate, law->estimate);
    apply_estimate(law);
}

void quadsim_nonlinear_stand(quadsim_nonlinear *law, int periods, const quadsim_real acting[4])
{
    put_shares(law->numbers, acting, law->before);
    update_actuators(law, periods, acting);
    reset_estimates(law, acting);
}

int quadsim_nonlinear_begin(quadsim_nonlinear *law, int periods, int flying, int motion, const quadsim_real state[12],
                            const quadsim_real *attitude, const quadsim_real *rates, const quadsim_real *reference,
                            const quadsim_real acting[4])
{
    const quadsim_nonlinear_numbers *numbers = law->numbers;
    const int actuators = actuators_of(numbers), learns = law->learns && periods == 1;
    law->learns = 0;
    put_shares(numbers, acting, law->before);
    update_actuators(law, periods, acting);
    if (!is_within(state, numbers->plausible, 12) ||
        !is_within(reference, numbers->plausible, count_of(numbers, motion)) || !is_finite(law->before, NU)) {
        return 0;
    }
    put_body(state, attitude, rates, law->measured);
    memcpy(law->measured + BODY, law->rotors, (size_t)actuators * sizeof(real));
    if (!is_within(law->measured, numbers->plausible, BODY + actuators)) {
        return 0;
    }
    if (motion) {
        take_motion(law, reference);
    } else {
        take_preview(law, reference, state[YAW]);
    }
    choose_sides(law);
    if (flying) {
        if (numbers->observes && learns) {
            update_estimate(law);
        }
        if (numbers->ramp != NULL) {
            update_drag_and_force(law, learns, numbers->delay == NULL ? acting : law->delay.sent[0]);
        }
        law->learns = 1;
        memcpy(law->last, law->measured, sizeof(law->last));
    }
    balance_reference(law);
    if (numbers->delay != NULL) {
        quadsim_delay_predict(&law->delay, numbers->delay, &law->world, law->measured, law->measured);
        return is_within(law->measured, numbers->plausible, BODY + actuators);
    }
    return 1;
}

enum quadsim_status quadsim_nonlinear_end(quadsim_nonlinear *law, enum quadsim_nmpc_status answer)
{
    static const enum quadsim_status STATUS[] = {
        QUADSIM_FREE,           QUADSIM_WHOLE,   QUADSIM_WHOLE,       QUADSIM_PRIMAL_INFEASIBLE,
        QUADSIM_MAX_ITERATIONS, QUADSIM_NO_ROOM, QUADSIM_INVALID_DATA};
    const quadsim_nonlinear_numbers *numbers = law->numbers;
    const quadsim_nmpc_problem *p = numbers->problem;
    const quadsim_nmpc_work *work = &law->work;
    enum quadsim_status status = STATUS[answer];
    const real *inputs = answer == QUADSIM_NMPC_UNCONVERGED ? work->u : work->v;
    int i, j;
    for (i = 0; status <= QUADSIM_WHOLE && i < p->horizon * NU; i++) {
        if (!is_finite(inputs + i, 1)) {
            status = QUADSIM_NOT_FINITE;
        } else if (!(inputs[i] <= p->upper[i % NU] + INPUT_TOLERANCE &&
                     inputs[i] >= p->lower[i % NU] - INPUT_TOLERANCE)) {
            status = QUADSIM_OUT_OF_BOUNDS;
        }
    }
    if (status <= QUADSIM_WHOLE && !(work->violation <= law->numbers->infeasible)) {
        status = QUADSIM_INFEASIBLE_ANSWER;
    }
    if (status > QUADSIM_WHOLE) {
        quadsim_nmpc_reset(&law->work);
        return status;
    }
    for (i = 0; i < p->horizon; i++) {
        for (j = 0; j < numbers->stride; j++) {
            put_commands(numbers, inputs + i * NU, law->plan + (i * numbers->stride + j) * NU);
        }
    }
    return work->defect > numbers->problem->converged ? QUADSIM_NOT_CONVERGED : status;
}

/* ---- with the fallback contract ------------------------------------------------------------------------------------
 */

/* The state (12,) of a body, its yaw on the turn nearest to that of the state before. */
static void put_state(const real *body, real *state)
{
    const real w = body[Q], x = body[Q + 1], y = body[Q + 2], z = body[Q + 3];
    const real sine = clipped(R(2.0) * (w * y - z * x), R(-1.0), R(1.0)), before = state[YAW];
    real s[3], c[3], along;
    int i;
    for (i = 0; i < 3; i++) {
        state[2 * i] = body[P + i];
        state[2 * i + 1] = body[V + i];
    }
    state[ROLL] = direction_of(R(2.0) * (w * x + y * z), R(1.0) - R(2.0) * (x * x + y * y));
    state[PITCH] = direction_of(sine, square_root(R(1.0) - sine * sine));
    state[YAW] = direction_of(R(2.0) * (w * z + x * y), R(1.0) - R(2.0) * (y * y + z * z));
    state[YAW] -= TURN * whole_turns(state[YAW] - before);
    sines_of(state, s, c);
    along = body[W + 1] * s[0] + body[W + 2] * c[0];
    c[1] = magnitude(c[1]) > R(1e-9) ? c[1] : R(1e-9); /* Euler rates grow without bound there */
    state[ROLL + 1] = body[W] + along * s[1] / c[1];
    state[PITCH + 1] = body[W + 1] * c[0] - body[W + 2] * s[0];
    state[YAW + 1] = along / c[1];
}

/* Move the state that the guard foresees on by a period, under its plan. */
static void predict_fallback(quadsim_nonlinear *law)
{
    const quadsim_nonlinear_numbers *numbers = law->numbers;
    quadsim_guard *guard = &law->guard;
    real shares[NU], next[BODY + 1], length;
    int i;
    if (!guard->foreseeing) {
        guard->foreseeing = 1;
        law->then = law->world;
        put_body(guard->foreseen, NULL, NULL, law->ahead);
    }
    put_shares(numbers, quadsim_guard_row(guard), shares);
    law->ahead[BODY] = R(0.0);
    quadsim_nmpc_advance(numbers->unlagged, &law->then, 1, law->ahead, shares, next);
    length = square_root(dot(next + Q, next + Q, 4));
    for (i = 0; i < 4; i++) {
        next[Q + i] /= length;
    }
    memcpy(law->ahead, next, sizeof(law->ahead));
    put_state(law->ahead, guard->foreseen);
}

enum quadsim_status quadsim_nonlinear_step(quadsim_nonlinear *law, enum quadsim_phase phase,
                                           const quadsim_real state[QUADSIM_MEASURED], const quadsim_real *reference,
                                           const quadsim_real acting[4], quadsim_real command[4])
{
    const quadsim_nonlinear_numbers *numbers = law->numbers;
    const int count = count_of(numbers, numbers->motion);
    quadsim_guard *guard = &law->guard;
    enum quadsim_status status = quadsim_guard_begin(guard, phase, &law->trim, state, reference, count, acting);
    law->work.changes = 0;
    if (status == QUADSIM_FREE && phase == QUADSIM_PHASE_LANDED) {
        quadsim_nonlinear_stand(law, guard->asked, guard->in_force);
    } else if (status == QUADSIM_FREE) {
        const real *attitude = quadsim_guard_turned(guard) ? state + 12 : NULL;
        const real *rates = quadsim_guard_has_rates(guard) ? state + 16 : NULL;
        status = QUADSIM_INVALID_DATA;
        if (quadsim_nonlinear_begin(law, guard->asked, phase == QUADSIM_PHASE_FLYING, numbers->motion, guard->state,
                                    attitude, rates, reference, guard->in_force)) {
            status = quadsim_nonlinear_end(
                law, quadsim_nmpc_step(&law->work, &law->world, law->measured, law->before, law->states, law->thrusts));
        }
        status = quadsim_guard_check(guard, status, law->plan);
    }
    if (quadsim_guard_foresees(guard, phase, status)) {
        predict_fallback(law);
    }
    return quadsim_guard_end(guard, phase, &law->trim, status, law->plan, command);
}
