/* The error-state Kalman filter over the samples of a control period; derivation: `quadsim.sim.estimator`.
 *
 * With the error e = [dp dv dtheta domega db], de/dt = D e at the middle of a step h, and A = h D,
 *
 *     prediction   mean by the midpoint rule;   F = 1 + A (1 + A / 2 (1 + A / 3)),   P <- F P F' + Q
 *     update       r = z - h(x),   S = H P H' + R,   K = P H' S^-1,   x <- x + K r,   P <- P - K H P
 *
 * Samples come in the order in which they were taken; one with r' S^-1 r beyond the gate changes nothing. */
#include "quadsim_plant.h"

#include <string.h>

#include "quadsim_rotation.h"

enum { P_ = 0, V_ = 3, THETA = 6, OMEGA = 9, BIAS = 12 }; /* blocks of the error */
enum { QUATERNION = 6, MEAN_RATES = 10, MEAN_BIAS = 13 }; /* of the mean, whose first six are p and v */

static const double LARGEST_STATE = 1e6, LARGEST_VARIANCE = 1e15;
static const double STILL_VELOCITY = 0.1, STILL_RATE = 0.5 * 0.017453292519943295, STILL_TIME = 0.01;

typedef double square[ERRORS][ERRORS];

/* ---- prediction -------------------------------------------------------------------------------------------------- */

static void reset_covariance(const quadsim_filter *f, quadsim_track *t)
{
    memset(t->P, 0, sizeof t->P);
    for (int i = 0; i < ERRORS; i++) {
        t->P[i][i] = f->initial[i] * f->initial[i];
    }
}

/* P <- F P F' for an F that is block upper triangular: what lies below its diagonal blocks is zero. */
static void propagate_covariance(square F, square P)
{
    square FP;
    for (int i = 0; i < ERRORS; i++) {
        double *row = FP[i];
        memset(row, 0, sizeof FP[i]);
        for (int k = i / 3 * 3; k < ERRORS; k++) {
            const double factor = F[i][k];
            for (int j = 0; factor != 0.0 && j < ERRORS; j++) {
                row[j] += factor * P[k][j];
            }
        }
    }
    for (int i = 0; i < ERRORS; i++) {
        for (int j = 0; j <= i; j++) {
            double sum = 0.0;
            for (int k = j / 3 * 3; k < ERRORS; k++) {
                sum += FP[i][k] * F[j][k];
            }
            P[i][j] = P[j][i] = sum;
        }
    }
}

/* B <- 1 + A B / divisor, for A of the same structure. */
static void horner_step(square A, square B, double divisor)
{
    square product;
    for (int i = 0; i < ERRORS; i++) {
        memset(product[i], 0, sizeof product[i]);
        for (int k = i / 3 * 3; k < ERRORS; k++) {
            const double factor = A[i][k] / divisor;
            for (int j = k / 3 * 3; factor != 0.0 && j < ERRORS; j++) {
                product[i][j] += factor * B[k][j];
            }
        }
        product[i][i] += 1.0;
    }
    memcpy(B, product, sizeof product);
}

static int is_diagonal(const quadsim_filter *f)
{
    return f->products[0] == 0.0 && f->products[1] == 0.0 && f->products[2] == 0.0;
}

static void times_inverse_inertia(const quadsim_filter *f, const double *torque, double *result)
{
    for (int i = 0; i < 3; i++) {
        result[i] = f->inverse[i][0] * torque[0] + f->inverse[i][1] * torque[1] + f->inverse[i][2] * torque[2];
    }
}

/* Angular acceleration at body rates under a torque, damped. */
static void angular_acceleration(const quadsim_filter *f, const double *torque, const double *rates, double *result)
{
    const double *J = f->inertia, coupling[3] = {(J[1] - J[2]) / J[0], (J[2] - J[0]) / J[1], (J[0] - J[1]) / J[2]};
    double momentum[3], gyroscopic[3], net[3];
    for (int i = 0; i < 3; i++) {
        net[i] = torque[i] - f->rate_damping[i] * rates[i];
    }
    if (is_diagonal(f)) {
        for (int i = 0; i < 3; i++) {
            result[i] = net[i] / J[i];
        }
        add_gyroscopic(coupling, rates, result);
        return;
    }
    times_inertia(J, f->products, rates, momentum);
    cross_product(rates, momentum, gyroscopic);
    for (int i = 0; i < 3; i++) {
        net[i] -= gyroscopic[i];
    }
    times_inverse_inertia(f, net, result);
}

/* The derivative of `angular_acceleration` in the rates. */
static void angular_acceleration_slope(const quadsim_filter *f, const double *rates, double slope[3][3])
{
    const double *J = f->inertia, p = rates[0], q = rates[1], r = rates[2];
    const double k[3] = {(J[2] - J[1]) / J[0], (J[0] - J[2]) / J[1], (J[1] - J[0]) / J[2]};
    const double plain[3][3] = {{0.0, -k[0] * r, -k[0] * q}, {-k[1] * r, 0.0, -k[1] * p}, {-k[2] * q, -k[2] * p, 0.0}};
    double momentum[3];
    memcpy(slope, plain, sizeof plain);
    times_inertia(J, f->products, rates, momentum);
    for (int j = 0; j < 3; j++) {
        if (is_diagonal(f)) {
            slope[j][j] -= f->rate_damping[j] / J[j];
            continue;
        }
        double unit[3] = {0.0}, column[3], one[3], other[3];
        unit[j] = 1.0;
        times_inertia(J, f->products, unit, column);
        cross_product(rates, column, one);
        cross_product(unit, momentum, other);
        for (int i = 0; i < 3; i++) {
            one[i] = -one[i] - other[i] - (i == j ? f->rate_damping[j] : 0.0);
        }
        times_inverse_inertia(f, one, column);
        for (int i = 0; i < 3; i++) {
            slope[i][j] = column[i];
        }
    }
}

static void predict_flight(const quadsim_filter *f, quadsim_track *t, double acceleration, const double *torque,
                           double h)
{
    const double *rate = t->mean + MEAN_RATES, a = acceleration;
    const double p = rate[0], q = rate[1], r = rate[2], half = 0.5 * h, quarter = 0.25 * h;
    double turn[3];
    angular_acceleration(f, torque, rate, turn);
    const double p1 = p + half * turn[0], q1 = q + half * turn[1], r1 = r + half * turn[2];
    const double halfway[3] = {p1, q1, r1};
    const double to_middle[3] = {quarter * (p + p1), quarter * (q + q1), quarter * (r + r1)};
    const double to_end[3] = {h * p1, h * q1, h * r1};
    double middle[4], turned[4], after[MEAN], R[3][3];
    exponential(to_middle, turned);
    multiply(t->mean + QUATERNION, turned, middle);
    rotation_of(middle, 2.0, R);
    const double push[3] = {a * R[0][2], a * R[1][2], a * R[2][2] - f->gravity};
    for (int i = 0; i < 3; i++) {
        after[i] = t->mean[i] + h * (t->mean[V_ + i] + half * push[i]);
        after[V_ + i] = t->mean[V_ + i] + h * push[i];
        after[MEAN_BIAS + i] = t->mean[MEAN_BIAS + i];
    }
    exponential(to_end, turned);
    multiply(t->mean + QUATERNION, turned, after + QUATERNION);
    normalise(after + QUATERNION);
    angular_acceleration(f, torque, halfway, turn);
    after[MEAN_RATES] = p + h * turn[0];
    after[MEAN_RATES + 1] = q + h * turn[1];
    after[MEAN_RATES + 2] = r + h * turn[2];
    memcpy(t->mean, after, sizeof after);

    const double turning[3][3] = {{0.0, r1, -q1}, {-r1, 0.0, p1}, {q1, -p1, 0.0}};
    double spinning[3][3];
    angular_acceleration_slope(f, halfway, spinning);
    square A = {{0.0}}, F = {{0.0}};
    for (int i = 0; i < 3; i++) {
        A[P_ + i][V_ + i] = A[THETA + i][OMEGA + i] = h;
        A[V_ + i][THETA] = h * (-a * R[i][1]);
        A[V_ + i][THETA + 1] = h * (a * R[i][0]);
        for (int j = 0; j < 3; j++) {
            A[THETA + i][THETA + j] = h * turning[i][j];
            A[OMEGA + i][OMEGA + j] = h * spinning[i][j];
        }
    }
    for (int i = 0; i < ERRORS; i++) {
        F[i][i] = 1.0;
    }
    /* 1 + A (1 + A / 2 (1 + A / 3)), from the inside out */
    horner_step(A, F, 3.0);
    horner_step(A, F, 2.0);
    horner_step(A, F, 1.0);
    propagate_covariance(F, t->P);
    for (int i = 0; i < ERRORS; i++) { /* white noise, through the two double integrators */
        t->P[i][i] += h * f->density[i / 3];
    }
    for (int i = 0; i < 3; i++) {
        for (int block = P_; block <= THETA; block += THETA - P_) {
            const double noise = f->density[block / 3 + 1];
            t->P[block + i][block + i] += h * h * h * noise / 3.0;
            t->P[block + i][block + 3 + i] += 0.5 * h * h * noise;
            t->P[block + 3 + i][block + i] += 0.5 * h * h * noise;
        }
    }
}

/* A vehicle that stands on the ground: velocity and rates are white noise. */
static void predict_standing(const quadsim_filter *f, quadsim_track *t, double h)
{
    static const double VARIANCE[2] = {STILL_VELOCITY * STILL_VELOCITY, STILL_RATE * STILL_RATE};
    for (int i = 0; i < 3; i++) {
        t->mean[V_ + i] = t->mean[MEAN_RATES + i] = 0.0;
        for (int block = V_; block <= OMEGA; block += OMEGA - V_) {
            const double variance = VARIANCE[block == OMEGA];
            for (int j = 0; j < ERRORS; j++) {
                t->P[block + i][j] = t->P[j][block + i] = 0.0;
            }
            t->P[block + i][block + i] = variance;
            t->P[block - 3 + i][block - 3 + i] += h * STILL_TIME * variance;
        }
        t->P[BIAS + i][BIAS + i] += h * f->density[4];
    }
}

static int has_diverged(const quadsim_track *t)
{
    double size = 0.0, spread = 0.0;
    for (int i = 0; i < MEAN; i++) {
        size += t->mean[i] * t->mean[i];
    }
    for (int i = 0; i < ERRORS; i++) {
        spread += t->P[i][i];
    }
    return !(size < LARGEST_STATE * LARGEST_STATE && spread < LARGEST_VARIANCE);
}

/* Whether the same rotor speeds act in two steps, in the same contact with the ground. */
static int same_drive(const double *commands, const uint8_t *grounded, int64_t one, int64_t other)
{
    return grounded[one] == grounded[other] &&
           !memcmp(commands + ROTORS * one, commands + ROTORS * other, ROTORS * sizeof *commands);
}

/* The moment of the air at the mean's velocity, for the rotors' speeds and their sum, and the thrust lost to inflow;
 * the covariance knows nothing of them. */
static void add_air_wrench(const quadsim_filter *f, const quadsim_track *t, const double *speeds, double turning,
                           double *wrench)
{
    const double *rate = t->mean + MEAN_RATES;
    double R[3][3], along[3], *torque = wrench + 1;
    to_matrix(t->mean + QUATERNION, R);
    for (int i = 0; i < 3; i++) {
        along[i] = along_axis(R, i, t->mean + V_);
    }
    torque[0] += (f->rotor_moment[0] * turning - f->inflow_moment[0] * along[2]) * along[1];
    torque[1] -= (f->rotor_moment[1] * turning - f->inflow_moment[1] * along[2]) * along[0];
    for (int j = 0; f->inflow > 0.0 && j < ROTORS; j++) { /* thrust j has the arms y and -x about x and y */
        double arm[4];
        for (int i = 0; i < 4; i++) {
            arm[i] = f->allocation[i][j] / f->allocation[0][j];
        }
        const double lost = f->inflow * speeds[j] * (along[2] + rate[0] * arm[1] + rate[1] * arm[2]);
        for (int i = 0; i < 4; i++) {
            wrench[i] -= arm[i] * lost;
        }
    }
}

static void predict_to(const quadsim_filter *f, quadsim_track *t, const double *commands, const uint8_t *grounded,
                       int64_t base, int64_t step)
{
    while (t->step < step) {
        const int64_t first = t->step - base;
        int64_t length = 1;
        while (length < f->stride && t->step + length < step && same_drive(commands, grounded, first, first + length)) {
            length++;
        }
        double wrench[4] = {0.0}, mean[MEAN], speeds[ROTORS], turning = 0.0;
        for (int i = 0; i < 4; i++) {
            for (int j = 0; j < ROTORS; j++) {
                const double speed = fmax(commands[ROTORS * first + j], 0.0);
                wrench[i] += f->allocation[i][j] * (speed * speed);
                turning += i == 0 ? speed : 0.0;
                speeds[j] = speed;
            }
        }
        add_air_wrench(f, t, speeds, turning, wrench);
        memcpy(mean, t->mean, sizeof mean);
        const double acceleration = wrench[0] / f->mass, h = (double)length * f->timestep;
        if (grounded[first] && !(acceleration > f->gravity)) {
            predict_standing(f, t, h);
        } else {
            predict_flight(f, t, acceleration, wrench + 1, h);
        }
        if (has_diverged(t)) { /* keep the mean, restore the initial covariance, and let the sensors correct it */
            memcpy(t->mean, mean, sizeof mean);
            reset_covariance(f, t);
        }
        t->step += length;
    }
}

/* ---- samples ----------------------------------------------------------------------------------------------------- */

static const int BLOCK[SENSORS] = {P_, V_, THETA, OMEGA};

static void find_innovation(const quadsim_track *t, const quadsim_sample *s, double *residual)
{
    double back[4], measured[4];
    switch (s->kind) {
    case ATTITUDE:
        conjugate(t->mean + QUATERNION, back);
        of_euler(s->value, measured);
        multiply(back, measured, back);
        logarithm(back, residual);
        return;
    case RATES:
        for (int i = 0; i < 3; i++) {
            residual[i] = s->value[i] - t->mean[MEAN_RATES + i] - t->mean[MEAN_BIAS + i];
        }
        return;
    default:
        for (int i = 0; i < 3; i++) {
            residual[i] = s->value[i] - t->mean[BLOCK[s->kind] + i];
        }
    }
}

static void invert_symmetric(double S[3][3], double W[3][3])
{
    const double a = S[0][0], b = S[0][1], c = S[0][2], d = S[1][1], e = S[1][2], f = S[2][2];
    const double A = d * f - e * e, B = c * e - b * f, C = b * e - c * d, scale = 1.0 / (a * A + b * B + c * C);
    W[0][0] = scale * A;
    W[1][1] = scale * (a * f - c * c);
    W[2][2] = scale * (a * d - b * b);
    W[0][1] = W[1][0] = scale * B;
    W[0][2] = W[2][0] = scale * C;
    W[1][2] = W[2][1] = scale * (b * c - a * e);
}

static void apply_error(double *mean, const double *error)
{
    double turned[4];
    exponential(error + THETA, turned);
    multiply(mean + QUATERNION, turned, mean + QUATERNION);
    normalise(mean + QUATERNION);
    for (int i = 0; i < 6; i++) {
        mean[i] += error[i];
        mean[MEAN_RATES + i] += error[OMEGA + i];
    }
}

/* Use a sample within the gate; false: it is outside, and changes nothing. */
static int update_with_sample(const quadsim_filter *f, quadsim_track *t, const quadsim_sample *s, double *distance)
{
    double residual[3], rows[3][ERRORS], S[3][3], W[3][3], gain[ERRORS][3], error[ERRORS];
    const int block = BLOCK[s->kind], biased = s->kind == RATES;
    find_innovation(t, s, residual);
    for (int i = 0; i < 3; i++) {
        for (int j = 0; j < ERRORS; j++) {
            rows[i][j] = t->P[block + i][j] + (biased ? t->P[BIAS + i][j] : 0.0);
        }
        for (int j = 0; j < 3; j++) {
            S[i][j] =
                rows[i][block + j] + (biased ? rows[i][BIAS + j] : 0.0) + (i == j ? f->variance[s->kind][i] : 0.0);
        }
    }
    invert_symmetric(S, W);
    *distance = 0.0;
    for (int i = 0; i < 3; i++) {
        *distance += residual[i] * (W[i][0] * residual[0] + W[i][1] * residual[1] + W[i][2] * residual[2]);
    }
    if (!(*distance <= f->gate)) {
        return 0;
    }
    for (int i = 0; i < ERRORS; i++) {
        for (int j = 0; j < 3; j++) {
            gain[i][j] = rows[0][i] * W[0][j] + rows[1][i] * W[1][j] + rows[2][i] * W[2][j];
        }
        error[i] = gain[i][0] * residual[0] + gain[i][1] * residual[1] + gain[i][2] * residual[2];
    }
    for (int i = 0; i < ERRORS; i++) {
        for (int j = 0; j <= i; j++) {
            const double one = gain[i][0] * rows[0][j] + gain[i][1] * rows[1][j] + gain[i][2] * rows[2][j];
            const double other = gain[j][0] * rows[0][i] + gain[j][1] * rows[1][i] + gain[j][2] * rows[2][i];
            t->P[i][j] = t->P[j][i] = 0.5 * ((t->P[i][j] - one) + (t->P[j][i] - other));
        }
    }
    apply_error(t->mean, error);
    return 1;
}

/* Let a sensor that has been refused for so long back in, by the variance that its sample asks for. */
static void inflate_covariance(quadsim_track *t, const quadsim_sample *s, double refused)
{
    double residual[3];
    find_innovation(t, s, residual);
    for (int i = 0; i < 3; i++) {
        const double squared = residual[i] * residual[i], fast = squared / (refused * refused);
        const int block = BLOCK[s->kind];
        t->P[block + i][block + i] += squared;
        t->P[BIAS + i][BIAS + i] += s->kind == RATES ? squared : s->kind == ATTITUDE ? fast : 0.0;
        if (s->kind == POSITION || s->kind == ATTITUDE) {
            t->P[block + 3 + i][block + 3 + i] += fast;
        }
    }
}

static void filter_sample(const quadsim_filter *f, quadsim_track *t, const quadsim_sample *s)
{
    int64_t *since = t->refused + s->kind;
    const double refused = *since < 0 ? 0.0 : (double)(s->taken - *since);
    double distance;
    if (f->patience > 0.0 && refused >= f->patience) {
        inflate_covariance(t, s, refused * f->timestep);
    }
    if (update_with_sample(f, t, s, &distance)) {
        *since = -1;
        t->accepted[s->kind]++;
        t->nis[s->kind] += distance;
    } else {
        *since = *since < 0 ? s->taken : *since;
        t->rejected[s->kind]++;
    }
}

void quadsim_filter_run(const quadsim_filter *f, quadsim_track *t, const quadsim_sample *samples, int64_t count,
                        const double *commands, const uint8_t *grounded, int64_t base, int64_t until)
{
    for (int64_t k = 0; k < count; k++) {
        const quadsim_sample *s = samples + k;
        const double size = fmax(fmax(fabs(s->value[0]), fabs(s->value[1])), fabs(s->value[2]));
        const int number = s->value[0] == s->value[0] && s->value[1] == s->value[1] && s->value[2] == s->value[2];
        if (!number || !(size < LARGEST_STATE)) {
            t->rejected[s->kind]++;
            continue;
        }
        predict_to(f, t, commands, grounded, base, s->taken);
        filter_sample(f, t, s);
    }
    predict_to(f, t, commands, grounded, base, until);
}
