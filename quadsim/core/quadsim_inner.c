/* The inner loops that fly a command between control instants, and the allocation of a wrench to rotor speeds.
 *
 * The autopilot (`quadsim.sim.autopilot`), with filtered body rates y,
 *
 *     omega_c = omega_ff + k 2 vec(q* q_c),   alpha = p (omega_c - y) + I - d dy/dt,   dI/dt = i (omega_c - y),
 *     tau = J alpha + y x J y,
 *
 * and incremental nonlinear dynamic inversion (`quadsim.mpc.pilot.indi`), which adds to the torque of the commanded
 * speeds what the low-pass filter of  tau(w) - J alpha - omega x J omega  says is missed.  The allocation keeps thrust,
 * roll and pitch torque and gives up yaw torque first, then solves weighted least squares within the bounds. */
#include "quadsim_plant.h"

#include <string.h>

#include "quadsim_rotation.h"

/* Damping of INDI's filter: Butterworth. */
static const double INDI_DAMPING = 0.70710678118654752440;
/* Weights of thrust, roll, pitch and yaw torque in `nearest_wrench`. */
static const double WRENCH_WEIGHT[4] = {30.0, 1000.0, 1000.0, 1.0};

/* ---- thrust over its coefficient --------------------------------------------------------------------------------- */

static double scaled_thrust(const quadsim_inner *a, int i, double speed)
{
    return a->linear[i] * speed + a->quadratic[i] * (speed * speed);
}

static double speed_of_thrust(const quadsim_inner *a, int i, double square)
{
    const double linear = a->linear[i], quadratic = a->quadratic[i], under = linear * linear + 4.0 * quadratic * square;
    const double root = sqrt(under < 0.0 ? 0.0 : under); /* beyond the map's top, its top; NaN stays so */
    if (linear == 0.0) {
        return sqrt(square);
    }
    return linear > 0.0 ? 2.0 * square / (linear + root) : (root - linear) / (2.0 * quadratic);
}

/* ---- autopilot --------------------------------------------------------------------------------------------------- */

/* The thrust that parts of a torque take: with airmode the difference of each pair, else the size of each part. */
static double torque_part(const quadsim_inner *a, const double *parts, int i, int j)
{
    return a->airmode ? parts[i] - parts[j] : j ? -parts[i] : parts[i];
}

static double thrust_margin(const quadsim_inner *a, double base, int i, int j)
{
    return a->airmode ? a->high[i] - a->low[j] : fmin(base - a->low[i], a->high[i] - base);
}

/* Thrusts for a collective thrust and a torque; `cut` says which torques are smaller than demanded. */
static void mix_thrusts(const quadsim_inner *a, double thrust, const double *torque, double *thrusts, int *cut)
{
    double level[ROTORS], yaw[ROTORS], share = 1.0, turning = 1.0, largest = 0.0;
    double slowest = -INFINITY, fastest = INFINITY; /* of all rotors alike */
    for (int i = 0; i < ROTORS; i++) {
        slowest = fmax(slowest, a->low[i]);
        fastest = fmin(fastest, a->high[i]);
    }
    double base = clip(0.25 * thrust, slowest, fastest);
    for (int i = 0; i < ROTORS; i++) {
        level[i] = a->to_thrusts[i][1] * torque[0] + a->to_thrusts[i][2] * torque[1];
        yaw[i] = a->to_thrusts[i][3] * torque[2];
        largest = fmax(largest, fabs(yaw[i]));
    }
    for (int i = 0; i < ROTORS; i++) {
        for (int j = 0; j < ROTORS; j++) {
            const double extent = torque_part(a, level, i, j);
            share = extent > 0.0 ? fmin(share, thrust_margin(a, base, i, j) / extent) : share;
        }
    }
    for (int i = 0; i < ROTORS; i++) {
        level[i] *= share;
    }
    for (int i = 0; i < ROTORS; i++) {
        for (int j = 0; j < ROTORS; j++) {
            const double change = torque_part(a, yaw, i, j);
            if (change > 1e-9 * largest) { /* rotors that turn alike differ by rounding */
                turning = fmin(turning, (thrust_margin(a, base, i, j) - torque_part(a, level, i, j)) / change);
            }
        }
    }
    turning = fmax(turning, 0.0);
    slowest = -INFINITY;
    fastest = INFINITY;
    for (int i = 0; i < ROTORS; i++) {
        level[i] += turning * yaw[i];
        slowest = fmax(slowest, a->low[i] - level[i]);
        fastest = fmin(fastest, a->high[i] - level[i]);
    }
    base = a->airmode ? clip(base, slowest, fastest) : base;
    for (int i = 0; i < ROTORS; i++) {
        thrusts[i] = clip(base + level[i], a->low[i], a->high[i]);
    }
    cut[0] = cut[1] = share < 1.0;
    cut[2] = turning < 1.0;
}

static void fly_autopilot(quadsim_inner *a, const double *rates, const double *attitude)
{
    double error[4], target[3], acceleration[3], torque[3], momentum[3], gyroscopic[3], thrusts[ROTORS], answer[ROTORS];
    int cut[3];
    memcpy(target, a->command + 1, sizeof target);
    if (a->holds_attitude) {
        conjugate(attitude, error);
        multiply(error, a->command + 4, error);
        for (int i = 0; i < 3; i++) {
            target[i] += a->attitude[i] * (copysign(2.0, error[0]) * error[1 + i]);
            target[i] = clip(target[i], -a->largest[i], a->largest[i]);
        }
    }
    for (int i = 0; i < 3; i++) {
        const double before = a->filtered[i];
        a->filtered[i] += a->gyro_share * (rates[i] - before);
        a->slope[i] += a->d_share * ((a->filtered[i] - before) / a->step - a->slope[i]);
    }
    times_inertia(a->inertia, a->products, a->filtered, momentum);
    cross_product(a->filtered, momentum, gyroscopic);
    for (int i = 0; i < 3; i++) {
        target[i] -= a->filtered[i]; /* the error from here on */
        acceleration[i] = a->p[i] * target[i] + a->integral[i] - a->d[i] * a->slope[i];
    }
    times_inertia(a->inertia, a->products, acceleration, torque);
    for (int i = 0; i < 3; i++) {
        torque[i] += gyroscopic[i];
    }
    mix_thrusts(a, a->command[0], torque, thrusts, cut);
    for (int i = 0; i < 3; i++) {
        if (!cut[i]) {
            a->integral[i] = clip(a->integral[i] + a->step * a->i[i] * target[i], -a->i_max[i], a->i_max[i]);
        }
    }
    for (int i = 0; i < ROTORS; i++) {
        answer[i] = speed_of_thrust(a, i, thrusts[i] / a->coefficient[i]);
    }
    if (a->delay > 0) {
        double *oldest = a->queue + ROTORS * a->oldest;
        memcpy(a->answer, oldest, sizeof answer);
        memcpy(oldest, answer, sizeof answer);
        a->oldest = (a->oldest + 1) % a->delay;
    } else {
        memcpy(a->answer, answer, sizeof answer);
    }
}

/* ---- allocation -------------------------------------------------------------------------------------------------- */

/* Along the line on which thrust, roll and pitch torque are exact, as close as the bounds allow; false: nowhere. */
static int reduce_yaw_torque(const quadsim_inner *a, const double *low, const double *high, double *squares)
{
    double slack = 1.0, first = -INFINITY, last = INFINITY;
    for (int i = 0; i < ROTORS; i++) {
        slack = fmax(slack, high[i]);
    }
    slack *= 1e-9; /* rounding must not exclude a corner of the bounds */
    for (int i = 0; i < ROTORS; i++) {
        const double yaw = a->inverse[i][3];
        const double one = (low[i] - slack - squares[i]) / yaw, other = (high[i] + slack - squares[i]) / yaw;
        first = fmax(first, fmin(one, other));
        last = fmin(last, fmax(one, other));
    }
    for (int i = 0; first <= last && i < ROTORS; i++) {
        squares[i] += clip(0.0, first, last) * a->inverse[i][3];
    }
    return first <= last;
}

/* Least squares of the columns in `free` by Gram-Schmidt; the residual takes the place of `rest`. */
static void solve_free_rotors(double A[ROTORS][4], const int *free, double *rest, double *x)
{
    double Q[ROTORS][4], upper[ROTORS][ROTORS], along[ROTORS];
    for (int j = 0; j < ROTORS; j++) {
        if (!free[j]) {
            continue;
        }
        memcpy(Q[j], A[j], sizeof Q[j]);
        for (int k = 0; k <= j; k++) {
            double product = 0.0;
            for (int i = 0; free[k] && i < 4; i++) {
                product += Q[k][i] * Q[j][i];
            }
            upper[k][j] = k == j ? sqrt(product) : product;
            for (int i = 0; free[k] && i < 4; i++) {
                Q[j][i] = k == j ? Q[j][i] / upper[j][j] : Q[j][i] - product * Q[k][i];
            }
        }
        along[j] = 0.0;
        for (int i = 0; i < 4; i++) {
            along[j] += Q[j][i] * rest[i];
        }
        for (int i = 0; i < 4; i++) {
            rest[i] -= along[j] * Q[j][i];
        }
    }
    for (int j = ROTORS - 1; j >= 0; j--) {
        for (int k = j + 1; free[j] && k < ROTORS; k++) {
            along[j] -= free[k] ? upper[j][k] * x[k] : 0.0;
        }
        x[j] = free[j] ? along[j] / upper[j][j] : x[j];
    }
}

/* Weighted least squares within the bounds: the best of all choices of rotors at their lower or upper bound. */
static void nearest_wrench(const quadsim_inner *a, const double *demanded, const double *low, const double *high,
                           double *squares)
{
    double unit = 1.0, A[ROTORS][4], b[4], least = INFINITY, thrust[2] = {0.0, 0.0};
    for (int j = 0; j < ROTORS; j++) {
        unit = fmax(unit, high[j]);
        thrust[0] += a->effect[0][j] * low[j];
        thrust[1] += a->effect[0][j] * high[j];
    }
    for (int i = 0; i < 4; i++) {
        const double weight = WRENCH_WEIGHT[i] / a->scale[i];
        b[i] = weight * (i ? demanded[i] : clip(demanded[0], thrust[0], thrust[1]));
        for (int j = 0; j < ROTORS; j++) {
            A[j][i] = weight * a->effect[i][j] * unit;
        }
    }
    for (int choice = 0; choice < 81; choice++) {
        int free[ROTORS], within = 1;
        double x[ROTORS], rest[4], cost = 0.0;
        memcpy(rest, b, sizeof rest);
        for (int j = 0, digits = choice; j < ROTORS; j++, digits /= 3) {
            free[j] = digits % 3 == 0;
            x[j] = (digits % 3 == 1 ? low[j] : high[j]) / unit;
            for (int i = 0; !free[j] && i < 4; i++) {
                rest[i] -= A[j][i] * x[j];
            }
        }
        solve_free_rotors(A, free, rest, x);
        for (int j = 0; j < ROTORS; j++) {
            within &= !free[j] || (low[j] / unit <= x[j] && x[j] <= high[j] / unit);
            cost += rest[j] * rest[j];
        }
        if (within && cost < least) {
            least = cost;
            for (int j = 0; j < ROTORS; j++) {
                squares[j] = x[j] * unit;
            }
        }
    }
}

void quadsim_allocate(const quadsim_inner *a, const double *wrench, double *speeds)
{
    double squares[ROTORS], low[ROTORS], high[ROTORS];
    int within = 1;
    for (int i = 0; i < ROTORS; i++) {
        low[i] = scaled_thrust(a, i, a->least[i]);
        high[i] = scaled_thrust(a, i, a->most[i]);
        squares[i] = 0.0;
        for (int j = 0; j < 4; j++) {
            squares[i] += a->inverse[i][j] * wrench[j];
        }
        within &= low[i] <= squares[i] && squares[i] <= high[i];
    }
    if (!within && !reduce_yaw_torque(a, low, high, squares)) {
        nearest_wrench(a, wrench, low, high, squares);
    }
    for (int i = 0; i < ROTORS; i++) {
        const double speed = speed_of_thrust(a, i, squares[i] < 0.0 ? 0.0 : squares[i]);
        speeds[i] = clip(speed, a->least[i], a->most[i]); /* NaN stays so */
    }
}

/* ---- incremental nonlinear dynamic inversion --------------------------------------------------------------------- */

static void invert_dynamics(quadsim_inner *a, double time, const double *rates, const double *rotors)
{
    double wrench[4] = {0.0}, middle[3], change[3], gained[3], momentum[3], gyroscopic[3];
    if (a->started && time > a->last_time) {
        const double step = time - a->last_time, w = a->omega;
        for (int i = 0; i < 3; i++) {
            middle[i] = 0.5 * (rates[i] + a->last_rates[i]);
            change[i] = rates[i] - a->last_rates[i];
        }
        times_inertia(a->inertia, a->products, middle, momentum);
        times_inertia(a->inertia, a->products, change, gained);
        cross_product(middle, momentum, gyroscopic);
        for (int i = 0; i < 3; i++) {
            double torque = 0.0;
            for (int j = 0; j < ROTORS; j++) {
                torque += a->effect[1 + i][j] * scaled_thrust(a, j, rotors[j]);
            }
            const double missed = torque - gained[i] / step - gyroscopic[i];
            a->slope[i] = (a->slope[i] + step * (w * w) * (missed - a->filtered[i])) /
                          (1.0 + 2.0 * INDI_DAMPING * w * step + (w * step) * (w * step));
            a->filtered[i] += step * a->slope[i];
        }
    }
    a->started = 1;
    a->last_time = time;
    memcpy(a->last_rates, rates, sizeof a->last_rates);
    for (int i = 0; i < 4; i++) {
        for (int j = 0; j < ROTORS; j++) {
            wrench[i] += a->effect[i][j] * scaled_thrust(a, j, a->command[j]);
        }
        wrench[i] += i ? a->filtered[i - 1] : 0.0;
    }
    quadsim_allocate(a, wrench, a->answer);
}

void quadsim_answer(quadsim_inner *loop, double time, const double *rates, const double *rotors, const double *attitude)
{
    if (loop->kind == AUTOPILOT) {
        fly_autopilot(loop, rates, attitude);
    } else {
        invert_dynamics(loop, time, rates, rotors);
    }
}
