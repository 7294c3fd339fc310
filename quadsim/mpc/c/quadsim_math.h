/* Arithmetic that the core and the controllers share. */
#ifndef QUADSIM_MATH_H
#define QUADSIM_MATH_H

#include "quadsim_core.h"

#if defined __FINITE_MATH_ONLY__ && __FINITE_MATH_ONLY__
#error "compile without -ffast-math, which takes away the check that numbers are finite"
#endif

#ifdef QUADSIM_FLOAT
#define R(number) number##F
#else
#define R(number) number
#endif

typedef quadsim_real real;

#include "quadsim_rigid.h"

enum { NU = QUADSIM_INPUTS };

#define TURN R(6.283185307179586) /* 2 pi */

/* A function whose sizes are constants wherever it is called: the compiler makes one of each size, and with
 * QUADSIM_ANY_SIZE one for all, smaller and slower. */
#if defined QUADSIM_ANY_SIZE
#define INLINED static
#elif defined __GNUC__
#define INLINED static inline __attribute__((always_inline))
#else
#define INLINED static inline
#endif

/* ---- numbers ---------------------------------------------------------------------------------------------------- */

static inline int is_finite(const real *numbers, int count)
{
    real even = R(0.0), odd = R(0.0); /* sums of zeros, and of NaN where a number is none, or infinite */
    int i;
    for (i = 0; i + 1 < count; i += 2) {
        even += numbers[i] * R(0.0);
        odd += numbers[i + 1] * R(0.0);
    }
    if (count % 2 == 1) {
        even += numbers[count - 1] * R(0.0);
    }
    return even + odd >= R(0.0);
}

static inline real magnitude(real number)
{
    return number < R(0.0) ? -number : number;
}

/* Whether magnitudes are at most so large, as none that is not finite is. */
static inline int is_within(const real *numbers, real most, int count)
{
    int i;
    for (i = 0; i < count; i++) {
        if (!(numbers[i] >= -most && numbers[i] <= most)) {
            return 0;
        }
    }
    return 1;
}

static inline int is_equal(real left, real right)
{
    return left >= right && left <= right;
}

static inline real clipped(real number, real lower, real upper)
{
    const real least = number > lower ? number : lower;
    return least < upper ? least : upper;
}

/* Whole turns n for which angle - n turn is in (-1/2, 1/2] turn, up to rounding; 0 of an angle that is absurd. */
static inline real whole_turns(real angle)
{
    const real turns = angle / TURN - R(0.500001);
    int n;
    if (!(magnitude(turns) < R(1e9))) {
        return R(0.0);
    }
    n = (int)turns;
    return (real)((real)n < turns ? n + 1 : n);
}

static inline real dot(const real *left, const real *right, int count)
{
    real sum[4] = {R(0.0), R(0.0), R(0.0), R(0.0)};
    const int whole = count - (count & 3);
    int i;
    for (i = 0; i < whole; i += 4) { /* four sums at a time, so that none waits for the one before */
        sum[0] += left[i] * right[i];
        sum[1] += left[i + 1] * right[i + 1];
        sum[2] += left[i + 2] * right[i + 2];
        sum[3] += left[i + 3] * right[i + 3];
    }
    for (; i < count; i++) {
        sum[0] += left[i] * right[i];
    }
    return (sum[0] + sum[1]) + (sum[2] + sum[3]);
}

/* The sum of four numbers, one of each input. */
static inline real sum_of_inputs(const real *numbers)
{
    static const real ONES[NU] = {R(1.0), R(1.0), R(1.0), R(1.0)};
    return dot(numbers, ONES, NU);
}

/* ---- elementary functions, by arithmetic alone: the same bits wherever it is IEEE 754 and not contracted -------- */

/* After FreeBSD's msun, by Sun Microsystems, 1993: permission to use, copy, modify, and distribute this software is
 * freely granted, provided that this notice is preserved. */

static const real HALF_PI = R(1.5707963267948966);

/* sin and cos of a number of up to 1e5 [rad], as 1e-15 near; 1e-6 in single precision.  Beyond, 0 and 1; not a number
 * where the angle is not finite. */
static inline void sin_cos(real angle, real *sine, real *cosine)
{
    /* pi / 2 in three parts, the first two with so few bits that their products with quarters are exact. */
#ifdef QUADSIM_FLOAT
    static const real HALF_PI_PARTS[3] = {1.5703125F, 4.837512969970703125e-4F, 7.54978995489188216e-8F};
#else
    static const real HALF_PI_PARTS[3] = {1.57079632673412561417e+00, 6.07710050630396597660e-11,
                                          2.02226624879595063154e-21};
#endif
    static const real SINE[6] = {R(-1.66666666666666324348e-01), R(8.33333333332248946124e-03),
                                 R(-1.98412698298579493134e-04), R(2.75573137070700676789e-06),
                                 R(-2.50507602534068634195e-08), R(1.58969099521155010221e-10)};
    static const real COSINE[6] = {R(4.16666666666666019037e-02), R(-1.38888888888741095749e-03),
                                   R(2.48015872894767294178e-05), R(-2.75573143513906633035e-07),
                                   R(2.08757232129817482790e-09), R(-1.13596475577881948265e-11)};
    const real turns = angle / HALF_PI, most = R(65536.0);
    const int far = !(turns <= most && turns >= -most);
    const int quarters = far ? 0 : (int)(turns < R(0.0) ? turns - R(0.5) : turns + R(0.5));
    const real count = (real)quarters;
    const real x = ((angle - count * HALF_PI_PARTS[0]) - count * HALF_PI_PARTS[1]) - count * HALF_PI_PARTS[2],
               square = x * x;
    real s = SINE[5], c = COSINE[5];
    int i;
    if (far) {
        *sine = angle * R(0.0);
        *cosine = R(1.0) + *sine;
        return;
    }
    for (i = 4; i >= 0; i--) {
        s = s * square + SINE[i];
        c = c * square + COSINE[i];
    }
    s = x + x * square * s;
    c = (R(1.0) - R(0.5) * square) + square * square * c;
    *sine = quarters % 2 == 0 ? s : c;
    *cosine = quarters % 2 == 0 ? c : s;
    if (quarters % 4 == 2 || quarters % 4 == -2 || quarters % 4 == 3 || quarters % 4 == -1) {
        *sine = -*sine;
    }
    if (quarters % 4 == 1 || quarters % 4 == -3 || quarters % 4 == 2 || quarters % 4 == -2) {
        *cosine = -*cosine;
    }
}

/* atan of a number that is not negative [rad]. */
static inline real arc_tangent(real tangent)
{
    static const real SERIES[11] = {
        R(3.33333333333329318027e-01),  R(-1.99999999998764832476e-01), R(1.42857142725034663711e-01),
        R(-1.11111104054623557880e-01), R(9.09088713343650656196e-02),  R(-7.69187620504482999495e-02),
        R(6.66107313738753120669e-02),  R(-5.83357013379057348645e-02), R(4.97687799461593236017e-02),
        R(-3.65315727442169155270e-02), R(1.62858201153657823623e-02)};
    real base = R(0.0), x = tangent, square, sum = SERIES[10];
    int i;
    if (tangent > R(2.4375)) {
        base = HALF_PI;
        x = R(-1.0) / tangent;
    } else if (tangent > R(0.4375)) { /* atan(1/2), or atan(1), or atan(3/2), and the rest */
        const real middle = tangent < R(0.6875) ? R(0.5) : (tangent < R(1.1875) ? R(1.0) : R(1.5));
        base = tangent < R(0.6875) ? R(0.4636476090008061)
                                   : (tangent < R(1.1875) ? R(0.7853981633974483) : R(0.982793723247329));
        x = (tangent - middle) / (R(1.0) + middle * tangent);
    }
    square = x * x;
    for (i = 9; i >= 0; i--) {
        sum = SERIES[i] + square * sum;
    }
    return base + (x - x * square * sum);
}

/* atan2 of y and a positive x [rad]. */
static inline real angle_of(real y, real x)
{
    return y < R(0.0) ? -arc_tangent(-y / x) : arc_tangent(y / x);
}

/* The angle whose tangent is y / x, of any quadrant [rad]. */
static inline real direction_of(real y, real x)
{
    if (x > R(0.0)) {
        return angle_of(y, x);
    }
    if (x < R(0.0)) {
        return angle_of(y, -x) * R(-1.0) + (y < R(0.0) ? -R(2.0) * HALF_PI : R(2.0) * HALF_PI);
    }
    return y < R(0.0) ? -HALF_PI : (y > R(0.0) ? HALF_PI : R(0.0));
}

/* The root of a number that is not negative, by Newton's method. */
static inline real square_root(real number)
{
    real scaled = number, factor = R(1.0), root;
    int i;
    if (!(number > R(0.0)) || !is_finite(&number, 1)) {
        return number > R(0.0) ? number : R(0.0);
    }
    while (scaled > R(4.0)) {
        scaled *= R(0.25);
        factor *= R(2.0);
    }
    while (scaled < R(1.0)) {
        scaled *= R(4.0);
        factor *= R(0.5);
    }
    root = R(0.5) + R(0.5) * scaled;
    for (i = 0; i < 5; i++) {
        root = R(0.5) * (root + scaled / root);
    }
    return factor * root;
}

/* ---- vectors (3,) and matrices [3][3], row by row; results lie apart from what they are of ------------------------
 */

/* Matrix times vector: of an attitude, from body to world. */
static inline void turn_by(const real *matrix, const real *vector, real *result)
{
    result[0] = dot(matrix, vector, 3);
    result[1] = dot(matrix + 3, vector, 3);
    result[2] = dot(matrix + 6, vector, 3);
}

/* The transposed matrix times vector: of an attitude, from world to body. */
static inline void turn_back_by(const real *matrix, const real *vector, real *result)
{
    int i;
    for (i = 0; i < 3; i++) {
        result[i] = matrix[i] * vector[0] + matrix[3 + i] * vector[1] + matrix[6 + i] * vector[2];
    }
}

/* Body z in world axes, and its rate of change, R hat(Omega) e_3, of an attitude and body rates. */
static inline void thrust_axis_of(const real *attitude, const real *rates, real axis[3], real change[3])
{
    int i;
    for (i = 0; i < 3; i++) {
        axis[i] = attitude[3 * i + 2];
        change[i] = attitude[3 * i] * rates[1] - attitude[3 * i + 1] * rates[0];
    }
}

/* Body to world of a unit quaternion wxyz, row by row. */
static inline void attitude_of(const real *q, real attitude[9])
{
    real rows[3][3];
    int i, j;
    rotation_of(q, R(2.0), rows);
    for (i = 0; i < 3; i++) {
        for (j = 0; j < 3; j++) {
            attitude[3 * i + j] = rows[i][j];
        }
    }
}

/* The torque of the air on rotors whose speeds add up to `turning`: ((m_x W - k_x v_z) v_y, -(m_y W - k_y v_z) v_x, 0)
 * - D omega; velocity through the air, and rates, along the body's axes. */
static inline void air_moment(const real *across, const real *inflow, const real *damping, real turning,
                              const real *velocity, const real *rates, real torque[3])
{
    torque[0] = (turning * across[0] - inflow[0] * velocity[2]) * velocity[1] - damping[0] * rates[0];
    torque[1] = -(turning * across[1] - inflow[1] * velocity[2]) * velocity[0] - damping[1] * rates[1];
    torque[2] = -damping[2] * rates[2];
}

/* What the air does with so much speed of the rotors in all, at a velocity and rates along the body's axes, as angular
 * acceleration: by maps [3][2] of the velocity across the rotors, per speed and per velocity along z, and [3][3] of the
 * rates. */
static inline void turn_by_air(const real *moment, const real *inflow, const real *damping, real speed,
                               const real *along, const real *rates, real turned[3])
{
    int i;
    for (i = 0; i < 3; i++) {
        const real *m = moment + 2 * i, *k = inflow + 2 * i, *c = damping + 3 * i;
        turned[i] = (speed * m[0] + along[2] * k[0]) * along[0] + (speed * m[1] + along[2] * k[1]) * along[1] -
                    (c[0] * rates[0] + c[1] * rates[1] + c[2] * rates[2]);
    }
}

/* ---- states: world axes, Z-Y-X Euler angles and their rates ---------------------------------------------------- */

enum { X = 0, VX = 1, Y = 2, VY = 3, Z = 4, VZ = 5, ROLL = 6, PITCH = 8, YAW = 10 };

static inline void sines_of(const real *state, real sine[3], real cosine[3])
{
    sin_cos(state[ROLL], &sine[0], &cosine[0]);
    sin_cos(state[PITCH], &sine[1], &cosine[1]);
    sin_cos(state[YAW], &sine[2], &cosine[2]);
}

/* Body rates (p, q, r) of the rates of Euler angles with these sines and cosines. */
static inline void rates_of(const real *state, const real s[3], const real k[3], real rates[3])
{
    const real a = state[ROLL + 1], b = state[PITCH + 1], c = state[YAW + 1];
    rates[0] = a - c * s[1];
    rates[1] = b * k[0] + c * k[1] * s[0];
    rates[2] = c * k[1] * k[0] - b * s[0];
}

static inline void body_rates(const real *state, real rates[3])
{
    real s[3], k[3];
    sines_of(state, s, k);
    rates_of(state, s, k, rates);
}

/* What a thrust pushes along world axes, at Euler angles with these sines and cosines. */
static inline void push_of(real thrust, const real s[3], const real k[3], real push[3])
{
    const real level = thrust * s[1] * k[0], side = thrust * s[0];
    push[0] = k[2] * level + s[2] * side;
    push[1] = s[2] * level - k[2] * side;
    push[2] = thrust * k[1] * k[0];
}

/* A vector of world axes along the body's, at Euler angles with these sines and cosines: R(eta)' v. */
static inline void into_body_axes(const real v[3], const real s[3], const real k[3], real along[3])
{
    const real ahead = k[2] * v[0] + s[2] * v[1], aside = k[2] * v[1] - s[2] * v[0];
    const real below = s[1] * ahead + k[1] * v[2];
    along[0] = k[1] * ahead - s[1] * v[2];
    along[1] = s[0] * below + k[0] * aside;
    along[2] = k[0] * below - s[0] * aside;
}

/* Roll and pitch of a vehicle whose thrust points along lift (3,), upwards, at a yaw. */
static inline void lean_of(const real lift[3], real sine, real cosine, real *roll, real *pitch)
{
    const real forward = cosine * lift[0] + sine * lift[1], left = cosine * lift[1] - sine * lift[0];
    *roll = -angle_of(left, square_root(forward * forward + lift[2] * lift[2]));
    *pitch = angle_of(forward, lift[2]);
}

/* ---- a constant disturbance: force along three axes, torque about three ---------------------------------------------
 */

/* Steady-state Kalman filters of six scalar disturbances, d += L (v - v expected), each within its limit. */
static inline void update_disturbance(const real gain[6], const real largest[6], const real innovation[6],
                                      real estimate[6])
{
    int i;
    for (i = 0; i < 6; i++) {
        estimate[i] = clipped(estimate[i] + gain[i] * innovation[i], -largest[i], largest[i]);
    }
}

/* Start from an estimate, within the limits. */
static inline void put_disturbance(const real largest[6], const real given[6], real estimate[6])
{
    int i;
    for (i = 0; i < 6; i++) {
        estimate[i] = clipped(given[i], -largest[i], largest[i]);
    }
}

/* ---- references: rows x y z yaw -----------------------------------------------------------------------------------
 */

/* Turns to be taken off the reference's heading in the next period, so that it starts near a yaw: as it went on
 * before, and from the yaw anew only where that is more than 190 deg away. */
static inline real first_turns(int *headed, real *heading, const real *reference, real yaw)
{
    real turns = *headed ? whole_turns(reference[3] - *heading) : R(0.0);
    *heading = reference[3] - TURN * turns;
    if (!*headed || magnitude(yaw - *heading) > R(3.3161255787892263)) {
        turns -= whole_turns(yaw - *heading);
        *heading = reference[3] - TURN * turns;
    }
    *headed = 1;
    return turns;
}

/* The same of row i, of which row i - 1 had these turns. */
static inline real next_turns(const real *reference, int i, real turns)
{
    return i == 0 ? turns : turns + whole_turns(reference[i * 4 + 3] - reference[i * 4 - 1]);
}

#endif
