/* A vehicle over a control period, physics step by physics step: inner loop, rotors, forces, motion, sensors.
 *
 * A rotor follows its target u by dw/dt = (u - w) / tau, at most at the given acceleration, and gives the thrust
 * (b w^2 + l w) times the battery's factor.  The motion follows from MuJoCo's step, or from Runge-Kutta's classical
 * method on
 *
 *     dp/dt = v,   dv/dt = (R(q) e_z sum T + F) / m - g e_z,   dq/dt = q (0, omega) / 2,
 *     d(omega)/dt = J^-1 (M T + tau - omega x J omega),
 *
 * with force F and torque tau of `forces_at`; their equations: `quadsim.sim.effects`. */
#include "quadsim_plant.h"

#include <setjmp.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "quadsim_rotation.h"

#ifdef _MSC_VER
#define THREAD_LOCAL __declspec(thread)
#else
#define THREAD_LOCAL __thread
#endif

/* Lowest height of a rotor, in radii, at which the ground effect grows. */
static const double LOWEST_HEIGHT_RATIO = 0.5;

/* Where the parts of a motion start, which kinds of sensors measure. */
static const int START[SENSORS] = {[POSITION] = 0, [ATTITUDE] = 3, [VELOCITY] = 7, [RATES] = 10};

/* What the rotors of a step give, whatever the motion; sums over the rotors that have a propeller. */
typedef struct {
    double thrust[ROTORS];
    double speed[ROTORS];                 /* 0 without a propeller */
    double drag;                          /* sum of k w, with k the coefficient of drag */
    double drag_x, drag_y;                /* sums of k w x and k w y, with x and y the places of the rotors */
    double drag_xy;                       /* sum of k w (x^2 + y^2) */
    double turning, turning_x, turning_y; /* sums of w, w x and w y */
    double momentum;                      /* angular momentum along z */
    double spin_up;                       /* torque on the body about z, of rotors that change their speed */
} rotor_state;

/* ---- rotors ------------------------------------------------------------------------------------------------------ */

/* The speed of a rotor and its slope a time `t` after a command: a straight line at the largest acceleration, then an
 * exponential. */
static double follow_target(const quadsim_vehicle *v, double speed, double target, double t, double *slope)
{
    const double gap = target - speed;
    const double distance = fabs(gap);
    const double lag = gap >= 0.0 ? v->rise : v->fall;
    const double steepest = v->acceleration;
    double sign = 0.0;
    double eased = distance; /* the part of the distance that is left to the exponential */
    double ramp_end = 0.0;   /* when it begins */
    if (gap > 0.0) {
        sign = 1.0;
    } else if (gap < 0.0) {
        sign = -1.0;
    }
    if (steepest > 0.0) {
        eased = fmin(distance, steepest * lag);
        ramp_end = (distance - eased) / steepest;
    }
    if (t < ramp_end) {
        *slope = sign * steepest;
        return speed + sign * steepest * t;
    }
    if (lag <= 0.0) {
        *slope = 0.0;
        return target;
    }
    const double rate = 1.0 / lag;
    const double decay = exp(-rate * (t - ramp_end));
    *slope = sign * eased * rate * decay;
    return target - sign * eased * decay;
}

/* Turn the rotors for a step towards their targets; give their speeds at its start and midway, and the slopes there. */
static void turn_rotors(quadsim_vehicle *v, double *at_start, double *midway, double *slope)
{
    double unused;
    for (int i = 0; i < ROTORS; i++) {
        const double speed = v->speeds[i], target = v->target[i];
        if (v->at_once) {
            at_start[i] = target;
            midway[i] = target;
            slope[i] = 0.0;
            v->speeds[i] = target;
            continue;
        }
        at_start[i] = follow_target(v, speed, target, 0.0, &unused);
        midway[i] = follow_target(v, speed, target, 0.5 * v->timestep, &slope[i]);
        v->speeds[i] = follow_target(v, speed, target, v->timestep, &unused);
    }
}

/* The battery's voltage at rest, from the curve of a cell: linear between its points. */
static double open_circuit_voltage(const quadsim_vehicle *v)
{
    int64_t k = 1; /* the point that ends the piece with the charge */
    while (k < v->points - 1 && v->curve[2 * k] <= v->charge) {
        k++;
    }
    const double *low = v->curve + 2 * (k - 1);
    const double *high = v->curve + 2 * k;
    const double share = (v->charge - low[0]) / (high[0] - low[0]);
    return v->cells * (low[1] + share * (high[1] - low[1]));
}

/* Discharge the battery for a step, and write its voltage and charge; return the share of thrust that it leaves.
 *
 * Rotors take the current g V^2, so the voltage is the positive root of V = E - R (g V^2 + i_idle). */
static double discharge(quadsim_vehicle *v, const double *speeds, double *row)
{
    double demand = 0.0;
    for (int i = 0; i < ROTORS; i++) {
        const double ratio = speeds[i] / v->hover;
        demand += v->efficiency[i] * v->demand[i] * ratio * (ratio * ratio);
        demand += v->efficiency[i] * v->linear_demand * (ratio * ratio);
    }
    const double conductance = v->hover_current * (demand / ROTORS) / (v->reference_voltage * v->reference_voltage);
    const double idle_voltage = fmax(open_circuit_voltage(v) - v->resistance * v->idle_current, 0.0);
    const double root = sqrt(1.0 + 4.0 * v->resistance * conductance * idle_voltage);
    const double voltage = 2.0 * idle_voltage / (1.0 + root);
    const double current = conductance * (voltage * voltage) + v->idle_current;
    row[0] = voltage;
    row[1] = v->charge;
    v->charge = fmax(v->charge - v->timestep / (3600.0 * v->capacity) * current, 0.0);
    return pow(voltage / v->reference_voltage, v->exponent);
}

/* A thrust less a random loss, which is a share of the largest thrust; `draw` is a standard normal number. */
static double noisy_thrust(const quadsim_vehicle *v, double thrust, double largest, double draw)
{
    const double share = thrust / largest;
    const double lost = v->loss * (share * share) + v->deviation * sqrt(share) * draw;
    return largest * clip(share - lost, 0.0, 1.0);
}

/* The thrust of a rotor at a speed; `factor` is the battery's. */
static double rotor_thrust(const quadsim_vehicle *v, int i, double speed, double factor)
{
    double thrust = v->efficiency[i] * v->coefficient[i] * (speed * speed);
    thrust = (thrust + v->efficiency[i] * v->linear * speed) * factor;
    return thrust < 0.0 ? 0.0 : thrust; /* NaN stays so */
}

/* Add a propeller's part to the sums. */
static void add_propeller(const quadsim_vehicle *v, int i, double speed, double slope, rotor_state *state)
{
    const double x = v->place[i][0], y = v->place[i][1];
    const double k = v->rotor_drag;
    const double inertia = v->rotor_inertia;
    state->speed[i] = speed;
    state->drag += speed * k;
    state->drag_x += speed * (k * x);
    state->drag_y += speed * (k * y);
    state->drag_xy += speed * (k * (x * x + y * y));
    state->turning += speed;
    state->turning_x += speed * x;
    state->turning_y += speed * y;
    state->momentum += speed * (-inertia * v->spin[i]);
    state->spin_up += slope * (inertia * v->spin[i]);
}

/* Turn the rotors for a step; it writes speeds, thrust and battery. */
static rotor_state drive_rotors(quadsim_vehicle *v, const quadsim_steps *rows, int64_t row)
{
    const int64_t at = rows->width * row;
    double midway[ROTORS], slope[ROTORS];
    double factor = 1.0;
    double total = 0.0;
    rotor_state state;
    memset(&state, 0, sizeof state);
    turn_rotors(v, rows->speeds + at, midway, slope);
    if (v->cells > 0.0) {
        factor = discharge(v, midway, rows->battery + at);
    }
    for (int i = 0; i < ROTORS; i++) {
        double thrust = rotor_thrust(v, i, midway[i], factor);
        if (v->largest[i] > 0.0) {
            thrust = noisy_thrust(v, thrust, v->largest[i], rows->noise[ROTORS * row + i]);
        }
        state.thrust[i] = thrust;
        total += thrust;
        if (v->efficiency[i] > 0.0) { /* a lost propeller has neither drag nor momentum */
            add_propeller(v, i, midway[i], slope[i], &state);
        }
    }
    rows->thrust[at] = total;
    return state;
}

/* ---- forces ------------------------------------------------------------------------------------------------------ */

/* Thrust at a height above the ground over that far from it, 1 / (1 - (radius / (4 height))^2). */
static double thrust_ratio(double height, double radius)
{
    const double image = 0.25 * radius / fmax(height, LOWEST_HEIGHT_RATIO * radius);
    return 1.0 / (1.0 - image * image);
}

static void add_pushes(const quadsim_vehicle *v, double R[3][3], double *wrench)
{
    for (int64_t k = 0; k < v->pushing; k++) {
        const quadsim_push *push = v->pushes + k;
        double force_body[3], torque[3];
        for (int i = 0; i < 3; i++) {
            wrench[i] += push->force[i];
            force_body[i] = along_axis(R, i, push->force);
        }
        cross_product(push->point, force_body, torque);
        for (int i = 0; i < 3; i++) {
            wrench[3 + i] += torque[i];
        }
    }
}

/* Add the thrust that rotors gain from the ground, with its torques; `height` is the body's. */
static void add_ground_effect(const quadsim_vehicle *v, double R[3][3], double height, const double *thrust,
                              double *wrench)
{
    double lift = 0.0;
    for (int i = 0; i < ROTORS; i++) {
        const double x = v->place[i][0], y = v->place[i][1];
        const double along_z = height - v->floor + R[2][2] * (v->disc + v->place[i][2]);
        const double rotor_height = along_z + R[2][0] * x + R[2][1] * y;
        const double gain = thrust[i] * (thrust_ratio(rotor_height, v->radius) - 1.0);
        lift += gain;
        wrench[3] += y * gain;
        wrench[4] -= x * gain;
    }
    for (int i = 0; i < 3; i++) {
        wrench[i] += R[i][2] * lift;
    }
}

/* Add what the hubs' height z adds to drag and moment of the rotors: where the body turns, the hubs move by rate x z.
 * `along` is the velocity through the air, body frame. */
static void add_hub_height(const quadsim_vehicle *v, double R[3][3], const double *along, const double *rate,
                           const double *speed, double *wrench)
{
    for (int i = 0; i < ROTORS; i++) {
        const double x = v->place[i][0], y = v->place[i][1], z = v->place[i][2];
        const double drag = v->rotor_drag * speed[i];
        if (z == 0.0) {
            continue;
        }
        const double hub_x = rate[1] * z, hub_y = -rate[0] * z;
        wrench[3] += z * drag * (along[1] + rate[2] * x + hub_y) + v->rotor_moment[0] * speed[i] * hub_y;
        wrench[4] -= z * drag * (along[0] - rate[2] * y + hub_x) + v->rotor_moment[1] * speed[i] * hub_x;
        wrench[5] += drag * (y * hub_x - x * hub_y);
        for (int j = 0; j < 3; j++) {
            wrench[j] -= drag * (R[j][0] * hub_x + R[j][1] * hub_y);
        }
    }
}

/* Subtract the thrust that rotors lose to the air along their axes, with its torques; `climbing` is the velocity
 * through the air along z. */
static void add_inflow(const quadsim_vehicle *v, double R[3][3], double climbing, const double *rate,
                       const double *speed, double *wrench)
{
    double lost = 0.0;
    for (int i = 0; i < ROTORS; i++) {
        const double axial = climbing + rate[0] * v->place[i][1] - rate[1] * v->place[i][0];
        const double loss = v->inflow * speed[i] * axial;
        lost += loss;
        for (int j = 0; j < 3; j++) {
            wrench[3 + j] -= v->torque_of_thrust[j][i] * loss;
        }
    }
    for (int j = 0; j < 3; j++) {
        wrench[j] -= R[j][2] * lost;
    }
}

/* Add the drag of the rotors in the plane of their discs; `along` is the velocity through the air, body frame. */
static void add_rotor_drag(const rotor_state *rotors, double R[3][3], const double *along, const double *rate,
                           double *wrench)
{
    const double x = rotors->drag_y * rate[2] - rotors->drag * along[0];
    const double y = -rotors->drag_x * rate[2] - rotors->drag * along[1];
    wrench[5] += rotors->drag_y * along[0] - rotors->drag_x * along[1] - rotors->drag_xy * rate[2];
    for (int i = 0; i < 3; i++) {
        wrench[i] += R[i][0] * x + R[i][1] * y;
    }
}

/* Force, world, and torque, body frame, at a pose (7) and a velocity (6), beside thrust and its torques. */
static void forces_at(const quadsim_vehicle *v, const double *pose, const double *velocity, const rotor_state *rotors,
                      const double *wind, double *wrench)
{
    const double *rate = velocity + 3;
    double R[3][3];
    double air[3];   /* velocity through the air, world */
    double along[3]; /* the same, body frame */
    double drag[3];
    to_matrix(pose + 3, R);
    for (int i = 0; i < 3; i++) {
        air[i] = velocity[i] - wind[i];
        wrench[i] = 0.0;
        wrench[3 + i] = -v->rate_damping[i] * rate[i];
    }
    for (int i = 0; i < 3; i++) {
        along[i] = along_axis(R, i, air);
    }
    /* the rotors' angular momentum */
    wrench[3] -= rate[1] * rotors->momentum;
    wrench[4] += rate[0] * rotors->momentum;
    wrench[5] += rotors->spin_up;
    if (v->rotor_drag > 0.0) {
        add_rotor_drag(rotors, R, along, rate, wrench);
    }
    add_air_drag(v->linear_drag, v->quadratic_drag, R, air, along, drag, wrench);
    /* moments of the air across the rotors, and of inflow across the body */
    wrench[3] += v->rotor_moment[0] * (along[1] * rotors->turning + rate[2] * rotors->turning_x);
    wrench[4] -= v->rotor_moment[1] * (along[0] * rotors->turning - rate[2] * rotors->turning_y);
    wrench[3] -= v->inflow_moment[0] * along[1] * along[2];
    wrench[4] += v->inflow_moment[1] * along[0] * along[2];
    add_hub_height(v, R, along, rate, rotors->speed, wrench);
    if (v->inflow > 0.0) {
        add_inflow(v, R, along[2], rate, rotors->speed, wrench);
    }
    add_pushes(v, R, wrench);
    if (v->radius > 0.0) {
        add_ground_effect(v, R, pose[2], rotors->thrust, wrench);
    }
}

/* The same half a step ahead: at the velocity extrapolated from the last step's and this one's, and the pose that it
 * leads to. */
static void forces_midway(quadsim_vehicle *v, const rotor_state *rotors, const double *wind, double *wrench)
{
    const double half = 0.5 * v->timestep;
    const double *pose = v->motion;
    const double *q = pose + 3;
    double velocity[6], ahead[7], rate[4];
    for (int i = 0; i < 6; i++) {
        velocity[i] = v->velocity[i] + 0.5 * (v->velocity[i] - v->before[i]);
        v->before[i] = v->velocity[i];
    }
    quaternion_rate(q, velocity + 3, rate);
    for (int i = 0; i < 3; i++) {
        ahead[i] = pose[i] + half * velocity[i];
    }
    for (int i = 0; i < 4; i++) {
        ahead[3 + i] = q[i] + half * rate[i];
    }
    forces_at(v, ahead, velocity, rotors, wind, wrench);
}

/* ---- the step ---------------------------------------------------------------------------------------------------- */

static void step_mujoco(quadsim_vehicle *v, const rotor_state *rotors, const double *wind, const double *disturbance,
                        double *wrench)
{
    memcpy(v->control, rotors->thrust, sizeof rotors->thrust);
    if (v->follows_motion) {
        forces_midway(v, rotors, wind, wrench);
        if (disturbance) {
            for (int i = 0; i < WRENCH; i++) {
                wrench[i] += disturbance[i];
            }
        }
        memcpy(v->applied, wrench, WRENCH * sizeof *wrench);
    }
    v->step(v->model, v->data);
    if (v->fluid) { /* the drag that MuJoCo has computed itself */
        for (int i = 0; i < WRENCH; i++) {
            wrench[i] += v->fluid[i];
        }
    }
}

/* J^-1 (torque - w x J w). */
static void angular_acceleration(const quadsim_vehicle *v, const double *w, const double *torque, double *acceleration)
{
    const double *J = v->inertia;
    if (v->products[0] != 0.0 || v->products[1] != 0.0 || v->products[2] != 0.0) {
        double momentum[3], gyroscopic[3];
        times_inertia(J, v->products, w, momentum);
        cross_product(w, momentum, gyroscopic);
        for (int i = 0; i < 3; i++) {
            acceleration[i] = 0.0;
            for (int j = 0; j < 3; j++) {
                acceleration[i] += v->inverse[i][j] * (torque[j] - gyroscopic[j]);
            }
        }
        return;
    }
    const double coupling[3] = {J[1] - J[2], J[2] - J[0], J[0] - J[1]};
    double total[3] = {torque[0], torque[1], torque[2]};
    add_gyroscopic(coupling, w, total);
    for (int i = 0; i < 3; i++) {
        acceleration[i] = total[i] / J[i];
    }
}

/* The time derivative of a motion x (13), and the wrench (6) of the forces that follow from it; `held` (6) is a wrench
 * that is constant over the step. */
static void motion_slope(const quadsim_vehicle *v, const double *x, const rotor_state *rotors, const double *wind,
                         const double *held, double *wrench, double *slope)
{
    const double *q = x + START[ATTITUDE], *velocity = x + START[VELOCITY], *w = x + START[RATES];
    const double *T = rotors->thrust;
    const double lift = T[0] + T[1] + T[2] + T[3];
    double *acceleration = slope + START[VELOCITY];
    double torque[3], axis[3];
    memset(wrench, 0, WRENCH * sizeof *wrench);
    if (v->follows_motion) {
        forces_at(v, x, velocity, rotors, wind, wrench);
    }
    quaternion_rate(q, w, slope + START[ATTITUDE]);
    thrust_axis(q, axis);
    for (int i = 0; i < 3; i++) {
        const double *row = v->torque_of_thrust[i];
        const double of_thrust = row[0] * T[0] + row[1] * T[1] + row[2] * T[2] + row[3] * T[3];
        const double force = wrench[i] + held[i];
        torque[i] = of_thrust + (wrench[3 + i] + held[3 + i]);
        slope[i] = velocity[i];
        acceleration[i] = (axis[i] * lift + force) / v->mass;
    }
    acceleration[2] -= v->gravity;
    angular_acceleration(v, w, torque, slope + START[RATES]);
}

static void step_runge_kutta(quadsim_vehicle *v, const rotor_state *rotors, const double *wind,
                             const double *disturbance, double *wrench)
{
    static const double STAGE_TIME[4] = {0.0, 0.5, 0.5, 1.0}, ZERO[WRENCH] = {0.0};
    const double h = v->timestep;
    const double *held = disturbance ? disturbance : ZERO;
    double k[4][MOTION], acted[4][WRENCH], x[MOTION];
    memcpy(x, v->motion, sizeof x);
    for (int stage = 0; stage < 4; stage++) {
        if (stage > 0) {
            for (int i = 0; i < MOTION; i++) {
                x[i] = v->motion[i] + STAGE_TIME[stage] * h * k[stage - 1][i];
            }
        }
        motion_slope(v, x, rotors, wind, held, acted[stage], k[stage]);
    }
    for (int i = 0; i < MOTION; i++) {
        v->motion[i] += h / 6.0 * (k[0][i] + 2.0 * k[1][i] + 2.0 * k[2][i] + k[3][i]);
    }
    double *q = v->motion + START[ATTITUDE];
    const double norm = sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]);
    for (int i = 0; i < 4; i++) {
        q[i] /= norm;
    }
    for (int i = 0; i < WRENCH; i++) {
        wrench[i] = held[i] + (acted[0][i] + 2.0 * acted[1][i] + 2.0 * acted[2][i] + acted[3][i]) / 6.0;
    }
}

/* ---- sensors ----------------------------------------------------------------------------------------------------- */

/* Copy the motion (13), which MuJoCo keeps in two arrays. */
static void motion_of(const quadsim_vehicle *v, double *motion)
{
    memcpy(motion, v->motion, 7 * sizeof *motion);
    memcpy(motion + START[VELOCITY], v->velocity, 6 * sizeof *motion);
}

/* Take sample j: what stands in its place is its error, which the sample replaces. */
static void take_sample(quadsim_sensor *s, int64_t j, const double *motion)
{
    double *value = s->values + 3 * (j - s->first);
    const double *truth = motion + START[s->kind];
    const int faults = s->faults[j - s->first];
    if (s->kind == ATTITUDE) { /* the error is a rotation vector, the sample Euler angles */
        double q[4];
        exponential(value, q);
        multiply(truth, q, q);
        to_euler(q, value);
    } else {
        for (int i = 0; i < 3; i++) {
            value[i] += truth[i];
        }
    }
    if ((faults & FROZEN) && s->passed) {
        memcpy(value, s->through, sizeof s->through);
    } else if (!(faults & LOST)) {
        memcpy(s->through, value, sizeof s->through);
        s->passed = 1;
    }
    for (int i = 0; i < 3; i++) {
        if (faults & (NO_NUMBER << i)) {
            value[i] = NAN;
        }
    }
}

void quadsim_sense(quadsim_sensing *sensed, int64_t now, const double *motion)
{
    for (int64_t k = 0; k < sensed->count; k++) {
        quadsim_sensor *s = sensed->sensors + k;
        if (now % s->stride == 0) {
            take_sample(s, now / s->stride, motion);
        }
    }
}

static int all_finite(const double *numbers, int count)
{
    for (int i = 0; i < count; i++) {
        if (!isfinite(numbers[i])) {
            return 0;
        }
    }
    return 1;
}

/* Hold the newest sample that has arrived. */
static void hold_newest(quadsim_sensor *s, int64_t now)
{
    while (s->heard * s->stride + s->latency <= now) {
        const int64_t place = s->heard - s->first;
        if (!(s->faults[place] & LOST)) {
            memcpy(s->held, s->values + 3 * place, sizeof s->held);
        }
        s->heard++;
    }
}

/* What an inner loop measures now: attitude and rates by their sensors, or the true ones without a sensor.  While a
 * sensor gives no numbers, the last ones stay. */
void quadsim_hear(quadsim_sensing *sensed, int64_t now, const double *motion)
{
    double attitude[4], rates[3];
    memcpy(attitude, motion + START[ATTITUDE], sizeof attitude);
    memcpy(rates, motion + START[RATES], sizeof rates);
    for (int64_t k = 0; k < sensed->count; k++) {
        quadsim_sensor *s = sensed->sensors + k;
        hold_newest(s, now);
        if (s->kind == ATTITUDE) {
            of_euler(s->held, attitude);
        }
        if (s->kind == RATES) {
            for (int i = 0; i < 3; i++) {
                rates[i] = s->held[i] - sensed->bias[i];
            }
        }
    }
    if (all_finite(attitude, 4)) {
        memcpy(sensed->attitude, attitude, sizeof attitude);
    }
    if (all_finite(rates, 3)) {
        memcpy(sensed->rates, rates, sizeof rates);
    }
}

/* Let the inner loop answer if it is due; return QUADSIM_DONE if its answer, new or not, can be flown. */
static int64_t answer_if_due(quadsim_vehicle *v, quadsim_inner *loop, quadsim_sensing *sensed)
{
    if (loop->until == 0) {
        const double *attitude = v->motion + START[ATTITUDE];
        const double *rates = v->velocity + 3;
        if (loop->kind == OUTSIDE) {
            return QUADSIM_DUE;
        }
        if (loop->measures && sensed) {
            double motion[MOTION];
            motion_of(v, motion);
            quadsim_hear(sensed, v->now, motion);
            attitude = sensed->attitude;
            rates = sensed->rates;
        }
        quadsim_answer(loop, v->time, rates, v->speeds, attitude);
        loop->until = loop->stride;
    }
    for (int i = 0; i < ROTORS; i++) {
        if (!(fabs(loop->answer[i]) <= v->fastest_valid)) { /* also not a number */
            return QUADSIM_INVALID;
        }
    }
    loop->until--;
    return QUADSIM_DONE;
}

/* ---- a part of a control period ---------------------------------------------------------------------------------- */

static int state_is_plausible(const quadsim_vehicle *v, const double *row)
{
    for (int i = 0; i < PHYSICS; i++) {
        if (!(fabs(row[i]) < v->plausible)) { /* also not a number */
            return 0;
        }
    }
    return 1;
}

/* Take a step towards the target speeds, and write its row. */
static void step_vehicle(quadsim_vehicle *v, const quadsim_steps *rows, int64_t row)
{
    static const double STILL[3] = {0.0};
    const int64_t at = rows->width * row;
    const double *wind = rows->wind ? rows->wind + at : STILL;
    const double *disturbance = rows->disturbance ? rows->disturbance + WRENCH * row : NULL;
    const rotor_state rotors = drive_rotors(v, rows, row);
    double wrench[WRENCH] = {0.0};
    memcpy(rows->commands + at, v->target, sizeof v->target);
    if (v->wind) {
        memcpy(v->wind, wind, 3 * sizeof *wind);
    }
    if (v->obstacles) {
        memcpy(v->obstacles, rows->obstacles + 3 * v->mocaps * row, 3 * (size_t)v->mocaps * sizeof *v->obstacles);
    }
    if (v->step) {
        step_mujoco(v, &rotors, wind, disturbance, wrench);
    } else {
        step_runge_kutta(v, &rotors, wind, disturbance, wrench);
    }
    v->time += v->timestep;
    v->now++;
    rows->physics[at] = v->time;
    motion_of(v, rows->physics + at + 1);
    if (rows->wrench) {
        memcpy(rows->wrench + at, wrench, sizeof wrench);
    }
}

static int64_t fly_steps(quadsim_vehicle *v, quadsim_inner *loop, quadsim_sensing *sensed, quadsim_steps *rows,
                         const double *command, int64_t end)
{
    while (v->now < end) {
        const double *physics = rows->physics + rows->width * rows->row;
        const double *speeds = command;
        if (loop) {
            const int64_t why = answer_if_due(v, loop, sensed);
            if (why != QUADSIM_DONE) {
                return why;
            }
            speeds = loop->answer;
        }
        for (int i = 0; i < ROTORS; i++) {
            v->target[i] = clip(speeds[i], v->slowest, v->fastest);
        }
        step_vehicle(v, rows, rows->row);
        rows->row++;
        if (!state_is_plausible(v, physics)) {
            return QUADSIM_DIVERGED;
        }
        if (sensed) {
            quadsim_sense(sensed, v->now, physics + 1);
        }
    }
    return QUADSIM_DONE;
}

/* ---- the paper's state ------------------------------------------------------------------------------------------- */

/* As `quadsim.state.nearest_turn`. */
static double nearest_turn(double angle, double to)
{
    static const double TIE = 1e-6;
    return angle + TURN * floor(0.5 + TIE - (angle - to) / TURN);
}

void quadsim_turn(const double *euler, double *last, double *upright)
{
    const double roll = euler[0], pitch = euler[1], yaw = euler[2];
    if (!isfinite(roll + pitch + yaw)) {
        return;
    }
    if (cos(roll) * cos(pitch) >= 0.0) {
        *last = nearest_turn(yaw, *upright);
        *upright = *last;
    } else {
        *last = nearest_turn(yaw, *last);
    }
}

void quadsim_euler_rates(const double *euler, const double *rate, double *rates)
{
    const double roll = euler[0], pitch = euler[1];
    const double p = rate[0], q = rate[1], r = rate[2];
    const double turning = q * sin(roll) + r * cos(roll); /* about z of the frame before the roll */
    rates[0] = p + turning * tan(pitch);
    rates[1] = q * cos(roll) - r * sin(roll);
    rates[2] = turning / cos(pitch);
}

void quadsim_observe(const double *physics, double *last, double *upright, double *state)
{
    const double *motion = physics + 1; /* after the time */
    const double *position = motion + START[POSITION], *velocity = motion + START[VELOCITY];
    double euler[3], rates[3];
    to_euler(motion + START[ATTITUDE], euler);
    quadsim_euler_rates(euler, motion + START[RATES], rates);
    if (isfinite(euler[0] + euler[1] + euler[2])) {
        quadsim_turn(euler, last, upright);
        euler[2] = *last;
    }
    for (int i = 0; i < 3; i++) {
        state[2 * i] = position[i];
        state[2 * i + 1] = velocity[i];
        state[6 + 2 * i] = euler[i];
        state[7 + 2 * i] = rates[i];
    }
}

void quadsim_states(const double *physics, int64_t count, int64_t width, double yaw, double *states)
{
    double last = yaw, upright = yaw;
    for (int64_t k = 0; k < count; k++) {
        quadsim_observe(physics + width * k, &last, &upright, states + 12 * k);
    }
}

/* ---- MuJoCo's fatal errors --------------------------------------------------------------------------------------- */

static THREAD_LOCAL jmp_buf *landing; /* where a fatal error lands; NULL outside quadsim_fly */
static THREAD_LOCAL char complaint[256];

void quadsim_trap(const char *message)
{
    if (!landing) {
        fprintf(stderr, "ERROR: %s\n", message);
        exit(EXIT_FAILURE);
    }
    snprintf(complaint, sizeof complaint, "%s", message);
    longjmp(*landing, 1);
}

const char *quadsim_complaint(void)
{
    return complaint;
}

int64_t quadsim_fly(quadsim_vehicle *v, quadsim_inner *loop, quadsim_sensing *sensed, quadsim_steps *rows,
                    const double *command, int64_t end)
{
    jmp_buf here;
    int64_t why;
    if (setjmp(here)) {
        landing = NULL;
        return QUADSIM_FAILED;
    }
    landing = &here;
    why = fly_steps(v, loop, sensed, rows, command, end);
    landing = NULL;
    return why;
}
