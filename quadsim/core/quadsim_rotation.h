/* What plant, filter, inner loops and margins compute with: bounds, quaternions wxyz, body to world, rotation vectors
 * and Z-Y-X Euler angles, as `quadsim.rotation` has them. */
#ifndef QUADSIM_ROTATION_H
#define QUADSIM_ROTATION_H

#include <math.h>

typedef double real;

#define R(number) number

#include "quadsim_rigid.h"

static const double TURN = 6.283185307179586; /* 2 pi */

/* A number within bounds; NaN stays so. */
static inline double clip(double number, double low, double high)
{
    return number < low ? low : number > high ? high : number;
}

/* Angular momentum of body rates: J x, J of moments (3) and products xy, xz, yz of inertia (3). */
static inline void times_inertia(const double *moments, const double *products, const double *x, double *result)
{
    const double *o = products, a = x[0], b = x[1], c = x[2];
    result[0] = moments[0] * a;
    result[1] = moments[1] * b;
    result[2] = moments[2] * c;
    if (o[0] != 0.0 || o[1] != 0.0 || o[2] != 0.0) {
        result[0] += o[0] * b + o[1] * c;
        result[1] += o[0] * a + o[2] * c;
        result[2] += o[1] * a + o[2] * b;
    }
}

static inline void multiply(const double *a, const double *b, double *product)
{
    const double w = a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3];
    const double x = a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2];
    const double y = a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1];
    const double z = a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0];
    product[0] = w;
    product[1] = x;
    product[2] = y;
    product[3] = z;
}

static inline void conjugate(const double *q, double *result)
{
    result[0] = q[0];
    result[1] = -q[1];
    result[2] = -q[2];
    result[3] = -q[3];
}

static inline void normalise(double *q)
{
    const double scale = 1.0 / sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]);
    for (int i = 0; i < 4; i++) {
        q[i] *= scale;
    }
}

static inline void exponential(const double *vector, double *q)
{
    const double angle = sqrt(vector[0] * vector[0] + vector[1] * vector[1] + vector[2] * vector[2]);
    const double scale = angle < 1e-4 ? 0.5 - angle * angle / 48.0 : sin(0.5 * angle) / angle;
    q[0] = cos(0.5 * angle);
    q[1] = scale * vector[0];
    q[2] = scale * vector[1];
    q[3] = scale * vector[2];
}

static inline void logarithm(const double *q, double *vector)
{
    const double sign = q[0] >= 0.0 ? 1.0 : -1.0;
    const double sine = sqrt(q[1] * q[1] + q[2] * q[2] + q[3] * q[3]);
    const double scale = sine < 1e-8 ? 2.0 : 2.0 * atan2(sine, sign * q[0]) / sine;
    for (int i = 0; i < 3; i++) {
        vector[i] = scale * (sign * q[1 + i]);
    }
}

static inline void to_euler(const double *q, double *euler)
{
    const double w = q[0], x = q[1], y = q[2], z = q[3];
    const double sine = 2.0 * (w * y - z * x);
    euler[0] = atan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y));
    euler[1] = asin(sine < -1.0 ? -1.0 : sine > 1.0 ? 1.0 : sine);
    euler[2] = atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z));
}

static inline void of_euler(const double *euler, double *q)
{
    const double cr = cos(0.5 * euler[0]), cp = cos(0.5 * euler[1]), cy = cos(0.5 * euler[2]);
    const double sr = sin(0.5 * euler[0]), sp = sin(0.5 * euler[1]), sy = sin(0.5 * euler[2]);
    q[0] = cr * cp * cy + sr * sp * sy;
    q[1] = sr * cp * cy - cr * sp * sy;
    q[2] = cr * sp * cy + sr * cp * sy;
    q[3] = cr * cp * sy - sr * sp * cy;
}

/* Body to world, of a quaternion that need not be of unit length. */
static inline void to_matrix(const double *q, double R[3][3])
{
    rotation_of(q, 2.0 / (q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]), R);
}

#endif
