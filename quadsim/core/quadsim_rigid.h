/* The rigid body that plant, filter and controllers share.  `real`, a type, and R(), which makes a constant of it, are
 * those of the file that includes this.  Quaternions q are wxyz, body to world; body rates w; rotations turn[3][3],
 * body to world. */
#ifndef QUADSIM_RIGID_H
#define QUADSIM_RIGID_H

/* q' = 1/2 q (0, w). */
static inline void quaternion_rate(const real *q, const real *w, real *rate)
{
    rate[0] = R(-0.5) * (q[1] * w[0] + q[2] * w[1] + q[3] * w[2]);
    rate[1] = R(0.5) * (q[0] * w[0] + q[2] * w[2] - q[3] * w[1]);
    rate[2] = R(0.5) * (q[0] * w[1] + q[3] * w[0] - q[1] * w[2]);
    rate[3] = R(0.5) * (q[0] * w[2] + q[1] * w[1] - q[2] * w[0]);
}

/* left x right; the product may take the place of either. */
static inline void cross_product(const real *left, const real *right, real *product)
{
    const real x = left[1] * right[2] - left[2] * right[1];
    const real y = left[2] * right[0] - left[0] * right[2];
    const real z = left[0] * right[1] - left[1] * right[0];
    product[0] = x;
    product[1] = y;
    product[2] = z;
}

/* Add what body rates do to each other, -w x J w, where J is diagonal: coupling is (Jyy - Jzz), (Jzz - Jxx), (Jxx -
 * Jyy), or these over Jxx, Jyy, Jzz. */
static inline void add_gyroscopic(const real *coupling, const real *w, real *turned)
{
    turned[0] += coupling[0] * w[1] * w[2];
    turned[1] += coupling[1] * w[2] * w[0];
    turned[2] += coupling[2] * w[0] * w[1];
}

/* The rotation of a quaternion, with twice = 2 / |q|^2; with 2 it is polynomial, and right for unit length alone. */
static inline void rotation_of(const real *q, real twice, real turn[3][3])
{
    const real w = q[0], x = q[1], y = q[2], z = q[3];
    turn[0][0] = R(1.0) - twice * (y * y + z * z);
    turn[0][1] = twice * (x * y - w * z);
    turn[0][2] = twice * (x * z + w * y);
    turn[1][0] = twice * (x * y + w * z);
    turn[1][1] = R(1.0) - twice * (x * x + z * z);
    turn[1][2] = twice * (y * z - w * x);
    turn[2][0] = twice * (x * z - w * y);
    turn[2][1] = twice * (y * z + w * x);
    turn[2][2] = R(1.0) - twice * (x * x + y * y);
}

/* Its last column alone, along which rotors push; the polynomial. */
static inline void thrust_axis(const real *q, real *axis)
{
    axis[0] = R(2.0) * (q[1] * q[3] + q[0] * q[2]);
    axis[1] = R(2.0) * (q[2] * q[3] - q[0] * q[1]);
    axis[2] = R(1.0) - R(2.0) * (q[1] * q[1] + q[2] * q[2]);
}

/* A component along a body axis of a vector, world. */
static inline real along_axis(real turn[3][3], int axis, const real *vector)
{
    return turn[0][axis] * vector[0] + turn[1][axis] * vector[1] + turn[2][axis] * vector[2];
}

/* Add drag -(linear + square |v|) v along body axes to a push, world, with the velocity through the air, world; `along`
 * and `pull` are both along body axes. */
static inline void add_air_drag(const real *linear, const real *square, real turn[3][3], const real *air, real *along,
                                real *pull, real *push)
{
    int a, i;
    for (a = 0; a < 3; a++) {
        const real v = along_axis(turn, a, air), size = v < R(0.0) ? -v : v;
        along[a] = v;
        pull[a] = -(linear[a] + square[a] * size) * v;
        for (i = 0; i < 3; i++) {
            push[i] += pull[a] * turn[i][a];
        }
    }
}

#endif
