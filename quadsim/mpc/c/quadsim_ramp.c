/* Filters of unmodelled force and torque; see quadsim_ramp.h.
 *
 * The mean acceleration of a period tau_s that the model misses, m = (v(k) - v(k-1)) / tau_s - model, enters the filter
 * of a disturbance d and its rate of change c, within limits; the angular acceleration likewise:
 *
 *     r = m - (d + tau_s c),   d <- d + tau_s c + gain r,   c <- c + gain_of_change r. */
#include "quadsim_ramp.h"

#include <string.h>

#include "quadsim_math.h"

typedef quadsim_ramp_numbers ramp_numbers;

void quadsim_ramp_reset(quadsim_ramp *ramp, const ramp_numbers *n, const quadsim_real acting[4])
{
    memset(ramp, 0, sizeof(*ramp));
    memcpy(ramp->acting, acting, (n->targets ? 1 : NU) * sizeof(real));
    memcpy(ramp->command, ramp->acting, sizeof(ramp->command));
}

/* Add what a command gives over a share of the period: its part of the means of squared speeds, or of the thrust [N],
 * and of the change of the rotors' momentum; the actuators follow it. */
static void add_command(quadsim_ramp *ramp, const ramp_numbers *n, const real *command, real share, real left,
                        real means[NU], real *spun)
{
    const real lost = R(1.0) - left;
    int i;
    if (n->targets) {
        const real away = ramp->acting[0] - command[0];
        means[0] += share * command[0] + n->lag * lost * away;
        ramp->acting[0] = command[0] + left * away;
        return;
    }
    for (i = 0; i < NU; i++) { /* speeds tend to the command exponentially */
        const real away = ramp->acting[i] - command[i];
        means[i] += share * command[i] * command[i] + R(2.0) * n->lag * lost * command[i] * away +
                    R(0.5) * n->lag * (R(1.0) - left * left) * away * away;
        ramp->acting[i] = command[i] + left * away;
        *spun -= n->momentum[i] * lost * away;
    }
}

/* The mean thrust [N], before its scale, and torque [N m] of a period with this command, or with the one before and it.
 */
static void mean_wrench(quadsim_ramp *ramp, const ramp_numbers *n, const real *command, real *thrust, real torque[3])
{
    const real scale = quadsim_ramp_scale(ramp, n);
    real means[NU] = {R(0.0)}, spun = R(0.0);
    int i;
    memset(torque, 0, 3 * sizeof(real));
    if (n->share > R(0.0)) {
        add_command(ramp, n, ramp->command, n->share, n->left_before, means, &spun);
    }
    add_command(ramp, n, command, R(1.0) - n->share, n->left, means, &spun);
    memcpy(ramp->command, command, (n->targets ? 1 : NU) * sizeof(real));
    if (n->targets) {
        *thrust = means[0];
        return;
    }
    *thrust = dot(n->allocation, means, NU);
    for (i = 0; i < 3; i++) {
        torque[i] = scale * dot(n->allocation + NU * (i + 1), means, NU);
    }
    torque[2] -= spun / n->period;
}

/* Sum of the rotors' speeds [rad/s]. */
static real rotors_speed(const quadsim_ramp *ramp)
{
    return sum_of_inputs(ramp->acting);
}

/* Drag, and loss of thrust to inflow, that the model knows, world axes [m/s^2]. */
static void known_drag(const quadsim_ramp *ramp, const ramp_numbers *n, const real *attitude, const real v_b[3],
                       real pull[3])
{
    real along[3];
    int i;
    for (i = 0; i < 3; i++) {
        along[i] = -(n->drag[i] + n->square_drag[i] * magnitude(v_b[i])) * v_b[i];
    }
    if (n->moment) {
        along[2] -= n->loss * rotors_speed(ramp) * v_b[2];
    }
    turn_by(attitude, along, pull);
}

/* The torque that turns the momentum of body and rotors, less the air's moment where the model knows it [N m]. */
static void resisting_torque(const quadsim_ramp *ramp, const ramp_numbers *n, const real v_b[3], const real *rates,
                             real torque[3])
{
    real momentum[3];
    int i;
    turn_by(n->inertia, rates, momentum);
    momentum[2] += dot(n->momentum, ramp->acting, NU);
    cross_product(rates, momentum, torque);
    if (n->moment) {
        real air[3];
        air_moment(n->across, n->inflow, n->damping, rotors_speed(ramp), v_b, rates, air);
        for (i = 0; i < 3; i++) {
            torque[i] -= air[i];
        }
    }
}

/* Take a mean of the period that the model misses into the filters; whether the thrust scale, if there is one, moved.
 */
static int update_filters(quadsim_ramp *ramp, const ramp_numbers *n, const real lift[3], real missed[6])
{
    const int holds = n->scaled && lift[2] < n->least_lift;
    int i;
    if (holds) {
        ramp->change[2] = R(0.0);
    }
    if (n->scaled) {
        const real scale = holds ? ramp->value[2] / n->gravity : missed[2] / lift[2];
        missed[0] -= scale * lift[0];
        missed[1] -= scale * lift[1];
        missed[2] = n->gravity * scale;
    }
    for (i = 0; i < 6; i++) {
        const real predicted = ramp->value[i] + n->period * ramp->change[i], innovation = missed[i] - predicted;
        const real value = predicted + n->gain[i] * innovation;
        ramp->value[i] = clipped(value, -n->largest[i], n->largest[i]);
        ramp->change[i] =
            is_equal(value, ramp->value[i]) ? ramp->change[i] + n->gain_of_change[i] * innovation : R(0.0);
    }
    return !holds;
}

/* Fit linear drag to the force, older samples weighing less. */
static void fit_drag(quadsim_ramp *ramp, const ramp_numbers *n, const real *attitude, const real v_b[3])
{
    real force[3], change[3], torque[3], d_b[3];
    int i;
    quadsim_ramp_foreseen(ramp, n, R(0.0), force, change, torque);
    turn_back_by(attitude, force, d_b);
    if (n->scaled) {
        d_b[2] = R(0.0);
    }
    for (i = 0; i < 3; i++) {
        ramp->products[i] = n->decay * ramp->products[i] + d_b[i] * v_b[i];
        ramp->squares[i] = n->decay * ramp->squares[i] + v_b[i] * v_b[i];
    }
}

void quadsim_ramp_update(quadsim_ramp *ramp, const ramp_numbers *n, int follows, const quadsim_real velocity[3],
                         const quadsim_real attitude[9], const quadsim_real rates[3], const quadsim_real command[4])
{
    const real period = n->period;
    const quadsim_ramp last = *ramp;
    real thrust, torque[3], v_b[3], lift[3], missed[6], turned[3];
    int i;
    mean_wrench(ramp, n, command, &thrust, torque);
    turn_back_by(attitude, velocity, v_b);
    known_drag(ramp, n, attitude, v_b, ramp->pull);
    resisting_torque(ramp, n, v_b, rates, ramp->resisting);
    thrust_axis_of(attitude, rates, ramp->axis, ramp->turning);
    memcpy(ramp->velocity, velocity, sizeof(ramp->velocity));
    memcpy(ramp->rates, rates, sizeof(ramp->rates));
    ramp->measured = 1;
    if (!last.measured || !follows) {
        return;
    }
    /* Means over the period from its two ends; for the thrust axis also from its derivative (Euler-Maclaurin). */
    for (i = 0; i < 3; i++) {
        const real axis =
            R(0.5) * (last.axis[i] + ramp->axis[i]) + period / R(12.0) * (last.turning[i] - ramp->turning[i]);
        lift[i] = thrust / n->mass * axis;
        missed[i] = (velocity[i] - last.velocity[i]) / period - lift[i] - R(0.5) * (last.pull[i] + ramp->pull[i]);
        torque[i] -= R(0.5) * (last.resisting[i] + ramp->resisting[i]);
    }
    missed[2] += n->gravity;
    turn_by(n->inverse, torque, turned);
    for (i = 0; i < 3; i++) {
        missed[3 + i] = (rates[i] - last.rates[i]) / period - turned[i];
    }
    if (update_filters(ramp, n, lift, missed)) {
        fit_drag(ramp, n, attitude, v_b);
    }
}

void quadsim_ramp_foreseen(const quadsim_ramp *ramp, const ramp_numbers *n, quadsim_real ahead, quadsim_real force[3],
                           quadsim_real change[3], quadsim_real torque[3])
{
    const real later = R(0.5) * n->period + ahead; /* the estimate is for mid-period */
    int i;
    for (i = 0; i < 3; i++) {
        force[i] = ramp->value[i] + later * ramp->change[i];
        change[i] = ramp->change[i];
        torque[i] = ramp->value[3 + i] + later * ramp->change[3 + i];
    }
    if (n->scaled) {
        force[2] = change[2] = R(0.0);
    }
}

quadsim_real quadsim_ramp_scale(const quadsim_ramp *ramp, const ramp_numbers *n)
{
    if (!n->scaled) {
        return R(1.0);
    }
    return R(1.0) + clipped(ramp->value[2] + n->period * ramp->change[2], -n->largest[2], n->largest[2]) / n->gravity;
}

void quadsim_ramp_drag(const quadsim_ramp *ramp, const ramp_numbers *n, quadsim_real drag[3])
{
    int i;
    for (i = 0; i < 3; i++) {
        const real fitted = -ramp->products[i] / (ramp->squares[i] + n->ballast);
        drag[i] = fitted > R(0.0) ? fitted : R(0.0);
    }
}
