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

/* What a step's rotors give whatever the motion: sums of their speeds, and of speed by place; drag about z, angular
 * momentum, spin-up torque. */
typedef struct {
    double thrust[ROTORS], speed[ROTORS], drag, drag_x, drag_y, drag_xy, turning, turning_x, turning_y, momentum,
        spin_up;
} rotor_state;

/* ---- rotors ------------------------------------------------------------------------------------------------------ */

/* A speed and its slope a time `t` after a command: a straight line, then an exponential. */
static double follow_target(const quadsim_vehicle *v, double speed, double target, double t, double *slope)
{
    const double gap = target - speed, distance = fabs(gap), sign = gap > 0.0 ? 1.0 : gap < 0.0 ? -1.0 : 0.0;
    const double lag = gap >= 0.0 ? v->rise : v->fall, steepest = v->acceleration;
    const double eased = steepest > 0.0 ? fmin(distance, steepest * lag) : distance;
    const double ramp_end = steepest > 0.0 ? (distance - eased) / steepest : 0.0;
    if (t < ramp_end) {
        *slope = sign * steepest;
        return speed + sign * steepest * t;
    }
    if (lag <= 0.0) {
        *slope = 0.0;
        return target;
    }
    const double rate = 1.0 / lag, decay = exp(-rate * (t - ramp_end));
    *slope = sign * eased * rate * decay;
    return target - sign * eased * decay;
}

static void turn_rotors(quadsim_vehicle *v, double *at_start, double *midway, double *slope)
{
    double unused;
    for (int i = 0; i < ROTORS; i++) {
        if (v->at_once) {
            at_start[i] = midway[i] = v->speeds[i] = v->target[i];
            slope[i] = 0.0;
            continue;
        }
        const double speed = v->speeds[i], target = v->target[i];
        at_start[i] = follow_target(v, speed, target, 0.0, &unused);
        midway[i] = follow_target(v, speed, target, 0.5 * v->timestep, &slope[i]);
        v->speeds[i] = follow_target(v, speed, target, v->timestep, &unused);
    }
}

static double open_circuit_voltage(const quadsim_vehicle *v)
{
    int64_t k = 1;
    while (k < v->points - 1 && v->curve[2 * k] <= v->charge) {
        k++;
    }
    const double *low = v->curve + 2 * (k - 1), *high = low + 2;
    return v->cells * (low[1] + (v->charge - low[0]) / (high[0] - low[0]) * (high[1] - low[1]));
}

/* The share of thrust that the battery's voltage leaves; it discharges for a step. */
static double discharge(quadsim_vehicle *v, const double *speeds, double *row)
{
    double demand = 0.0;
    for (int i = 0; i < ROTORS; i++) {
        const double ratio = speeds[i] / v->hover;
        demand += v->efficiency[i] * v->demand[i] * ratio * (ratio * ratio);
        demand += v->efficiency[i] * v->linear_demand * (ratio * ratio);
    }
    const double conductance = v->hover_current * (demand / ROTORS) / (v->reference_voltage * v->reference_voltage);
    const double rest = fmax(open_circuit_voltage(v) - v->resistance * v->idle_current, 0.0);
    const double voltage = 2.0 * rest / (1.0 + sqrt(1.0 + 4.0 * v->resistance * conductance * rest));
    const double current = conductance * (voltage * voltage) + v->idle_current;
    row[0] = voltage;
    row[1] = v->charge;
    v->charge = fmax(v->charge - v->timestep / (3600.0 * v->capacity) * current, 0.0);
    return pow(voltage / v->reference_voltage, v->exponent);
}

static double noisy_thrust(const quadsim_vehicle *v, double thrust, double largest, double draw)
{
    const double share = thrust / largest;
    const double left = share - (v->loss * (share * share) + v->deviation * sqrt(share) * draw);
    return largest * clip(left, 0.0, 1.0);
}

/* Turn the rotors for a step; it writes speeds, thrust and battery. */
static rotor_state drive_rotors(quadsim_vehicle *v, const quadsim_steps *rows, int64_t row)
{
    rotor_state state = {{0.0}, {0.0}, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0};
    double midway[ROTORS], slope[ROTORS], factor = 1.0, total = 0.0;
    turn_rotors(v, rows->speeds + rows->width * row, midway, slope);
    if (v->cells > 0.0) {
        factor = discharge(v, midway, rows->battery + rows->width * row);
    }
    for (int i = 0; i < ROTORS; i++) {
        double thrust = v->efficiency[i] * v->coefficient[i] * (midway[i] * midway[i]);
        thrust = (thrust + v->efficiency[i] * v->linear * midway[i]) * factor;
        thrust = thrust < 0.0 ? 0.0 : thrust; /* NaN stays so */
        if (v->largest[i] > 0.0) {
            thrust = noisy_thrust(v, thrust, v->largest[i], rows->noise[ROTORS * row + i]);
        }
        state.thrust[i] = thrust;
        total += thrust;
        if (v->efficiency[i] > 0.0) { /* a lost propeller has neither drag nor momentum */
            const double x = v->place[i][0], y = v->place[i][1], k = v->rotor_drag, inertia = v->rotor_inertia;
            state.speed[i] = midway[i];
            state.drag += midway[i] * k;
            state.drag_x += midway[i] * (k * x);
            state.drag_y += midway[i] * (k * y);
            state.drag_xy += midway[i] * (k * (x * x + y * y));
            state.turning += midway[i];
            state.turning_x += midway[i] * x;
            state.turning_y += midway[i] * y;
            state.momentum += midway[i] * (-inertia * v->spin[i]);
            state.spin_up += slope[i] * (inertia * v->spin[i]);
        }
    }
    rows->thrust[rows->width * row] = total;
    return state;
}

/* ---- forces ------------------------------------------------------------------------------------------------------ */

static double thrust_ratio(double height, double radius)
{
    const double image = 0.25 * radius / fmax(height, LOWEST_HEIGHT_RATIO * radius);
    return 1.0 / (1.0 - image * image);
}

static void add_pushes(const quadsim_vehicle *v, double R[3][3], double *wrench)
{
    for (int64_t k = 0; k < v->pushing; k++) {
        const double *f = v->pushes[k].force;
        double body[3], torque[3];
        for (int i = 0; i < 3; i++) {
            wrench[i] += f[i];
            body[i] = along_axis(R, i, f);
        }
        cross_product(v->pushes[k].point, body, torque);
        for (int i = 0; i < 3; i++) {
            wrench[3 + i] += torque[i];
        }
    }
}

static void add_ground_effect(const quadsim_vehicle *v, double R[3][3], double height, const double *thrust,
                              double *wrench)
{
    double lift = 0.0;
    for (int i = 0; i < ROTORS; i++) {
        const double x = v->place[i][0], y = v->place[i][1];
        const double above = height - v->floor + R[2][2] * (v->disc + v->place[i][2]);
        const double gain = thrust[i] * (thrust_ratio(above + R[2][0] * x + R[2][1] * y, v->radius) - 1.0);
        lift += gain;
        wrench[3] += y * gain;
        wrench[4] -= x * gain;
    }
    for (int i = 0; i < 3; i++) {
        wrench[i] += R[i][2] * lift;
    }
}

/* What the height of the hubs adds to drag and moment of the rotors, with `along` the velocity of the air along x and
 * y. */
static void add_height(const quadsim_vehicle *v, double R[3][3], const double *along, const double *rate,
                       const double *speed, double *wrench)
{
    for (int i = 0; i < ROTORS; i++) {
        const double x = v->place[i][0], y = v->place[i][1], z = v->place[i][2], drag = v->rotor_drag * speed[i];
        if (z == 0.0) {
            continue;
        }
        const double back = rate[1] * z, left = -rate[0] * z; /* of the hub's velocity */
        wrench[3] += z * drag * (along[1] + rate[2] * x + left) + v->rotor_moment[0] * speed[i] * left;
        wrench[4] -= z * drag * (along[0] - rate[2] * y + back) + v->rotor_moment[1] * speed[i] * back;
        wrench[5] += drag * (y * back - x * left);
        for (int j = 0; j < 3; j++) {
            wrench[j] -= drag * (R[j][0] * back + R[j][1] * left);
        }
    }
}

/* Thrust that rotors lose to the air along their axes, with its torques; `climbing`: the velocity of the air along z.
 */
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

/* Force, world, and torque, body, of a pose (7) and a velocity (6). */
static void forces_at(const quadsim_vehicle *v, const double *pose, const double *velocity, const rotor_state *rotors,
                      const double *wind, double *wrench)
{
    const double *rate = velocity + 3;
    double R[3][3], air[3], along[3], pull[3];
    to_matrix(pose + 3, R);
    for (int i = 0; i < 3; i++) {
        air[i] = velocity[i] - wind[i];
        wrench[i] = 0.0;
        wrench[3 + i] = -v->rate_damping[i] * rate[i];
    }
    for (int i = 0; i < 3; i++) {
        along[i] = along_axis(R, i, air);
    }
    wrench[3] -= rate[1] * rotors->momentum;
    wrench[4] += rate[0] * rotors->momentum;
    wrench[5] += rotors->spin_up;
    if (v->rotor_drag > 0.0) {
        const double x = rotors->drag_y * rate[2] - rotors->drag * along[0];
        const double y = -rotors->drag_x * rate[2] - rotors->drag * along[1];
        wrench[5] += rotors->drag_y * along[0] - rotors->drag_x * along[1] - rotors->drag_xy * rate[2];
        for (int i = 0; i < 3; i++) {
            wrench[i] += R[i][0] * x + R[i][1] * y;
        }
    }
    add_air_drag(v->linear_drag, v->quadratic_drag, R, air, along, pull, wrench);
    wrench[3] += v->rotor_moment[0] * (along[1] * rotors->turning + rate[2] * rotors->turning_x);
    wrench[4] -= v->rotor_moment[1] * (along[0] * rotors->turning - rate[2] * rotors->turning_y);
    wrench[3] -= v->inflow_moment[0] * along[1] * along[2];
    wrench[4] += v->inflow_moment[1] * along[0] * along[2];
    add_height(v, R, along, rate, rotors->speed, wrench);
    if (v->inflow > 0.0) {
        add_inflow(v, R, along[2], rate, rotors->speed, wrench);
    }
    add_pushes(v, R, wrench);
    if (v->radius > 0.0) {
        add_ground_effect(v, R, pose[2], rotors->thrust, wrench);
    }
}

/* The same half a step ahead, by this step's motion and the last one's. */
static void forces_midway(quadsim_vehicle *v, const rotor_state *rotors, const double *wind, double *wrench)
{
    const double half = 0.5 * v->timestep, *pose = v->motion, *q = pose + 3;
    double velocity[6], ahead[7], rate[4];
    for (int i = 0; i < 6; i++) {
        velocity[i] = v->velocity[i] + 0.5 * (v->velocity[i] - v->before[i]);
        v->before[i] = v->velocity[i];
    }
    quaternion_rate(q, velocity + 3, rate);
    for (int i = 0; i < 7; i++) {
        ahead[i] = pose[i] + half * (i < 3 ? velocity[i] : rate[i - 3]);
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
        for (int i = 0; disturbance && i < WRENCH; i++) {
            wrench[i] += disturbance[i];
        }
        memcpy(v->applied, wrench, WRENCH * sizeof *wrench);
    }
    v->step(v->model, v->data);
    for (int i = 0; v->fluid && i < WRENCH; i++) {
        wrench[i] += v->fluid[i];
    }
}

static void motion_slope(const quadsim_vehicle *v, const double *x, const rotor_state *rotors, const double *wind,
                         const double *held, double *wrench, double *rate)
{
    const double *q = x + 3, *w = x + 10, *T = rotors->thrust, *J = v->inertia, m = v->mass;
    double torque[3], load[WRENCH], momentum[3], gyroscopic[3], axis[3];
    const double lift = T[0] + T[1] + T[2] + T[3];
    memset(wrench, 0, WRENCH * sizeof *wrench);
    if (v->follows_motion) {
        forces_at(v, x, x + 7, rotors, wind, wrench);
    }
    for (int i = 0; i < 3; i++) {
        const double *row = v->torque_of_thrust[i];
        torque[i] = row[0] * T[0] + row[1] * T[1] + row[2] * T[2] + row[3] * T[3];
        load[i] = wrench[i] + held[i];
        load[3 + i] = wrench[3 + i] + held[3 + i];
        rate[i] = x[7 + i];
    }
    quaternion_rate(q, w, rate + 3);
    thrust_axis(q, axis);
    for (int i = 0; i < 3; i++) {
        rate[7 + i] = (axis[i] * lift + load[i]) / m;
    }
    rate[9] -= v->gravity;
    if (v->products[0] != 0.0 || v->products[1] != 0.0 || v->products[2] != 0.0) {
        times_inertia(J, v->products, w, momentum);
        cross_product(w, momentum, gyroscopic);
        for (int i = 0; i < 3; i++) {
            rate[10 + i] = 0.0;
            for (int j = 0; j < 3; j++) {
                rate[10 + i] += v->inverse[i][j] * (torque[j] + load[3 + j] - gyroscopic[j]);
            }
        }
        return;
    }
    const double coupling[3] = {J[1] - J[2], J[2] - J[0], J[0] - J[1]};
    for (int i = 0; i < 3; i++) {
        torque[i] += load[3 + i];
    }
    add_gyroscopic(coupling, w, torque);
    for (int i = 0; i < 3; i++) {
        rate[10 + i] = torque[i] / J[i];
    }
}

static void step_runge_kutta(quadsim_vehicle *v, const rotor_state *rotors, const double *wind,
                             const double *disturbance, double *wrench)
{
    static const double STAGE_TIME[4] = {0.0, 0.5, 0.5, 1.0}, ZERO[WRENCH] = {0.0};
    const double h = v->timestep, *held = disturbance ? disturbance : ZERO;
    double k[4][MOTION], acted[4][WRENCH], x[MOTION];
    for (int stage = 0; stage < 4; stage++) {
        for (int i = 0; i < MOTION; i++) {
            x[i] = stage ? v->motion[i] + STAGE_TIME[stage] * h * k[stage - 1][i] : v->motion[i];
        }
        motion_slope(v, x, rotors, wind, held, acted[stage], k[stage]);
    }
    for (int i = 0; i < MOTION; i++) {
        v->motion[i] += h / 6.0 * (k[0][i] + 2.0 * k[1][i] + 2.0 * k[2][i] + k[3][i]);
    }
    const double *q = v->motion + 3, norm = sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]);
    for (int i = 3; i < 7; i++) {
        v->motion[i] /= norm;
    }
    for (int i = 0; i < WRENCH; i++) {
        wrench[i] = held[i] + (acted[0][i] + 2.0 * acted[1][i] + 2.0 * acted[2][i] + acted[3][i]) / 6.0;
    }
}

/* ---- sensors ----------------------------------------------------------------------------------------------------- */

static const int COLUMN[SENSORS] = {0, 7, 3, 10}; /* of a sensor's quantity in the motion */

static void motion_of(const quadsim_vehicle *v, double *motion)
{
    memcpy(motion, v->motion, 7 * sizeof *motion);
    memcpy(motion + 7, v->velocity, 6 * sizeof *motion);
}

static void take_sample(quadsim_sensor *s, int64_t j, const double *motion)
{
    double *value = s->values + 3 * (j - s->first), turned[4];
    const double *truth = motion + COLUMN[s->kind];
    const int faults = s->faults[j - s->first];
    if (s->kind == ATTITUDE) {
        exponential(value, turned);
        multiply(truth, turned, turned);
        to_euler(turned, value);
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
        value[i] = faults & (NO_NUMBER << i) ? NAN : value[i];
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

/* What an inner loop measures now: the newest finite sample of each sensor, else the true value. */
void quadsim_hear(quadsim_sensing *sensed, int64_t now, const double *motion)
{
    double attitude[4], rates[3];
    memcpy(attitude, motion + 3, sizeof attitude);
    memcpy(rates, motion + 10, sizeof rates);
    for (int64_t k = 0; k < sensed->count; k++) {
        quadsim_sensor *s = sensed->sensors + k;
        for (; s->heard * s->stride + s->latency <= now; s->heard++) {
            if (!(s->faults[s->heard - s->first] & LOST)) {
                memcpy(s->held, s->values + 3 * (s->heard - s->first), sizeof s->held);
            }
        }
        if (s->kind == ATTITUDE) {
            of_euler(s->held, attitude);
        }
        for (int i = 0; s->kind == RATES && i < 3; i++) {
            rates[i] = s->held[i] - sensed->bias[i];
        }
    }
    if (all_finite(attitude, 4)) {
        memcpy(sensed->attitude, attitude, sizeof attitude);
    }
    if (all_finite(rates, 3)) {
        memcpy(sensed->rates, rates, sizeof rates);
    }
}

/* Let the inner loop answer if it is due. */
static int64_t answer_if_due(quadsim_vehicle *v, quadsim_inner *loop, quadsim_sensing *sensed)
{
    if (loop->until == 0) {
        const double *attitude = v->motion + 3, *rates = v->velocity + 3;
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

/* Take a step with the target speeds; the rows are written from its row on. */
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
    (v->step ? step_mujoco : step_runge_kutta)(v, &rotors, wind, disturbance, wrench);
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
        const int64_t row = rows->row, why = loop ? answer_if_due(v, loop, sensed) : QUADSIM_DONE;
        const double *physics = rows->physics + rows->width * row;
        if (why != QUADSIM_DONE) {
            return why;
        }
        for (int i = 0; i < ROTORS; i++) {
            v->target[i] = clip(loop ? loop->answer[i] : command[i], v->slowest, v->fastest);
        }
        step_vehicle(v, rows, row);
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

static double nearest_turn(double angle, double to)
{
    static const double TIE = 1e-6; /* as `quadsim.state.whole_turns` */
    return angle + TURN * floor(0.5 + TIE - (angle - to) / TURN);
}

void quadsim_turn(const double *euler, double *last, double *upright)
{
    if (isfinite(euler[0] + euler[1] + euler[2])) {
        const int up = cos(euler[0]) * cos(euler[1]) >= 0.0;
        *last = nearest_turn(euler[2], up ? *upright : *last);
        *upright = up ? *last : *upright;
    }
}

void quadsim_euler_rates(const double *euler, const double *rate, double *rates)
{
    const double sin_roll = sin(euler[0]), cos_roll = cos(euler[0]);
    const double lateral = rate[1] * sin_roll + rate[2] * cos_roll;
    rates[0] = rate[0] + lateral * tan(euler[1]);
    rates[1] = rate[1] * cos_roll - rate[2] * sin_roll;
    rates[2] = lateral / cos(euler[1]);
}

void quadsim_observe(const double *physics, double *last, double *upright, double *state)
{
    double euler[3], rates[3];
    to_euler(physics + 4, euler);
    quadsim_euler_rates(euler, physics + 11, rates);
    if (isfinite(euler[0] + euler[1] + euler[2])) {
        quadsim_turn(euler, last, upright);
        euler[2] = *last;
    }
    for (int i = 0; i < 3; i++) {
        state[2 * i] = physics[1 + i];
        state[2 * i + 1] = physics[8 + i];
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
