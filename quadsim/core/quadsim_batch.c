/* Vehicles flown together, and the margins of their bounds.
 *
 * The margin of a bound on a signal s is  min(s - lower, upper - s), negative where it is violated; that of a control
 * period is the smallest one of its physics steps (`quadsim.sim.margins`). */
#include "quadsim_batch.h"

#include <stdio.h>
#include <string.h>

#include "quadsim_rotation.h"

/* What the signals of some bounds take of a physics step. */
enum { NEEDS_ANGLES = 1, NEEDS_ANGLE_RATES = 2, NEEDS_YAW = 4, NEEDS_TILT = 8 };

/* ---- margins ----------------------------------------------------------------------------------------------------- */

/* A physics step as signals see it. */
typedef struct {
    double state[STATE + ROTORS]; /* with the rotor speeds behind it */
    double tilt, rates[3], thrust;
} step_values;

static int needs_of(const quadsim_bound *bounds, int64_t count)
{
    int needs = 0;
    for (int64_t k = 0; k < count; k++) {
        const quadsim_bound *b = bounds + k;
        if (b->signal == SIGNAL_TILT) {
            needs |= NEEDS_ANGLES | NEEDS_TILT;
        }
        for (int64_t j = 0; b->signal == SIGNAL_SUM && j < b->terms; j++) {
            if (b->index[j] < 6 || b->index[j] >= STATE) {
                continue;
            }
            needs |= NEEDS_ANGLES;
            needs |= b->index[j] % 2 ? NEEDS_ANGLE_RATES : 0;
            needs |= b->index[j] == 10 ? NEEDS_YAW : 0;
        }
    }
    return needs;
}

static void evaluate_step(const double *physics, const double *speeds, int needs, double *last, double *upright,
                          step_values *at)
{
    double euler[3], rates[3];
    for (int i = 0; i < 3; i++) {
        at->state[2 * i] = physics[1 + i];
        at->state[2 * i + 1] = physics[8 + i];
        at->rates[i] = physics[11 + i];
    }
    memcpy(at->state + STATE, speeds, ROTORS * sizeof *speeds);
    if (!(needs & NEEDS_ANGLES)) {
        return;
    }
    to_euler(physics + 4, euler);
    if (needs & NEEDS_ANGLE_RATES) {
        quadsim_euler_rates(euler, physics + 11, rates);
        for (int i = 0; i < 3; i++) {
            at->state[7 + 2 * i] = rates[i];
        }
    }
    if (needs & NEEDS_TILT) {
        const double cosine = cos(euler[0]) * cos(euler[1]);
        at->tilt = acos(cosine < -1.0 ? -1.0 : cosine > 1.0 ? 1.0 : cosine);
    }
    if (needs & NEEDS_YAW) {
        quadsim_turn(euler, last, upright);
        euler[2] = *last;
    }
    for (int i = 0; i < 3; i++) {
        at->state[6 + 2 * i] = euler[i];
    }
}

static double smaller(double a, double b) /* NaN if either is */
{
    return a < b || a != a ? a : b;
}

static double margin_of(const quadsim_bound *b, double value)
{
    return smaller(value - b->lower, b->upper - value);
}

/* The smallest margin of values of the rotors. */
static double margin_of_rotors(const quadsim_bound *b, const double *values)
{
    double least = margin_of(b, values[0]);
    for (int i = 1; i < ROTORS; i++) {
        least = smaller(least, margin_of(b, values[i]));
    }
    return least;
}

static double margin_at(const quadsim_bound *b, const step_values *at)
{
    double sum = 0.0;
    switch (b->signal) {
    case SIGNAL_TILT:
        return margin_of(b, b->factor[0] * at->tilt);
    case SIGNAL_BODY_RATE:
        return margin_of(b, b->factor[0] * at->rates[b->axis]);
    case SIGNAL_THRUST:
        return margin_of(b, at->thrust);
    case SIGNAL_SPEED:
        return margin_of_rotors(b, at->state + STATE);
    default:
        for (int64_t j = 0; j < b->terms; j++) {
            sum += b->factor[j] * at->state[b->index[j]];
        }
        return margin_of(b, sum);
    }
}

/* A difference of angles in (-pi, pi], as `quadsim.state.wrapped`. */
static double wrapped(double angle)
{
    static const double PI = 3.141592653589793;
    const double left = fmod(PI - angle, TURN);
    return PI - (left < 0.0 ? fmod(left + TURN, TURN) : left);
}

/* The margin of a signal that exists only at samples. */
static double margin_sampled(const quadsim_bound *b, const quadsim_period *p)
{
    static const int TRACKED[4] = {0, 2, 4, 10}; /* states that the reference has */
    double error, steps[ROTORS];
    if (b->signal == SIGNAL_SLEW) {
        for (int i = 0; i < ROTORS; i++) {
            steps[i] = p->commanded[i] - p->earlier[i];
        }
        return margin_of_rotors(b, steps);
    }
    if (b->signal == SIGNAL_ERROR) {
        error = p->truth[TRACKED[b->axis]] - p->reference[b->axis];
        error = b->axis == 3 ? wrapped(error) : error;
    } else {
        error = p->measured[b->axis] - p->truth[b->axis];
        error = b->axis == 10 ? wrapped(error) : error;
    }
    return margin_of(b, b->factor[0] * error);
}

static int holds_at(const quadsim_bound *b, int64_t step)
{
    return b->first <= step && step <= b->last;
}

void quadsim_margins(const quadsim_bound *bounds, int64_t count, const quadsim_period *p, double *smallest,
                     double *at_end)
{
    const int needs = needs_of(bounds, count);
    const int64_t first = p->count > 0; /* the row at the start alone where no step was flown */
    double last = p->truth[10], upright = p->truth[10];
    step_values at = {{0.0}, 0.0, {0.0}, INFINITY};
    for (int64_t k = 0; k < count; k++) {
        const int sampled = bounds[k].signal >= SIGNAL_ERROR && p->count > 0 && holds_at(bounds + k, p->start);
        smallest[k] = at_end[k] = sampled ? margin_sampled(bounds + k, p) : INFINITY;
    }
    for (int64_t j = first; j <= p->count; j++) {
        const double *physics = j ? p->physics + p->width * (j - 1) : p->before;
        const double *speeds = j < p->count ? p->speeds + p->width * j : p->rotors;
        evaluate_step(physics, speeds, needs, &last, &upright, &at);
        if (p->count > 0) {
            at.thrust = p->thrust[p->width * (j < p->count ? j : p->count - 1)];
        }
        for (int64_t k = 0; k < count; k++) {
            const quadsim_bound *b = bounds + k;
            if (b->signal >= SIGNAL_ERROR || (b->signal == SIGNAL_THRUST && !(p->targeted && p->count > 0))) {
                continue;
            }
            at_end[k] = holds_at(b, p->start + j) ? margin_at(b, &at) : INFINITY;
            smallest[k] = smaller(smallest[k], at_end[k]);
        }
    }
}

/* ---- many flights ------------------------------------------------------------------------------------------------ */

static void begin_period(quadsim_flight *f)
{
    const quadsim_vehicle *v = f->vehicle;
    f->rows->row = 0;
    f->before[0] = v->time;
    memcpy(f->before + 1, v->motion, 7 * sizeof *f->before);
    memcpy(f->before + 8, v->velocity, 6 * sizeof *f->before);
    memcpy(f->earlier, f->acting, sizeof f->earlier);
    memcpy(f->last, f->state, sizeof f->last);
    if (f->loop) {
        memcpy(f->loop->command, f->command, (size_t)f->numbers * sizeof *f->command);
        f->loop->holds_attitude = f->numbers > ROTORS;
    }
}

static void end_period(quadsim_flight *f)
{
    const quadsim_steps *rows = f->rows;
    quadsim_period flown;
    memcpy(f->acting, f->loop ? f->vehicle->target : f->command, sizeof f->acting);
    quadsim_observe(rows->physics + rows->width * (rows->row - 1), &f->yaw, &f->upright, f->state);
    if (f->bounded == 0) {
        return;
    }
    flown.before = f->before;
    flown.physics = rows->physics;
    flown.speeds = rows->speeds;
    flown.thrust = rows->thrust;
    flown.width = rows->width;
    flown.count = rows->row;
    flown.start = f->vehicle->now - rows->row;
    flown.rotors = f->vehicle->speeds;
    flown.truth = f->last;
    flown.measured = f->measured;
    flown.reference = f->reference;
    flown.commanded = f->acting;
    flown.earlier = f->earlier;
    flown.targeted = f->loop != NULL;
    quadsim_margins(f->bounds, f->bounded, &flown, f->smallest, f->at_end);
}

static void fly_part(quadsim_flight *f)
{
    quadsim_vehicle *v = f->vehicle;
    if (f->rows->row == 0 || f->rows->row + f->steps > f->period) { /* also after one that ended within a period */
        begin_period(f);
    }
    f->why = quadsim_fly(v, f->loop, f->sensing, f->rows, f->command, v->now + f->steps);
    if (f->why == QUADSIM_FAILED) {
        snprintf(f->complaint, sizeof f->complaint, "%s", quadsim_complaint());
    }
    if (f->why == QUADSIM_DONE && f->rows->row == f->period) {
        end_period(f);
    }
}

void quadsim_fly_many(quadsim_flight *flights, int64_t first, int64_t end)
{
    for (int64_t k = first; k < end; k++) {
        if (flights[k].steps > 0) {
            fly_part(flights + k);
        }
    }
}
