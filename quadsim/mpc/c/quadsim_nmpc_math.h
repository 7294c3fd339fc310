/* Arithmetic of the rigid body that the files of the nonlinear controller share. */
#ifndef QUADSIM_NMPC_MATH_H
#define QUADSIM_NMPC_MATH_H

#include "quadsim_math.h"
#include "quadsim_nmpc.h"

#include <string.h>

enum { SETTLED_PERIODS = 64 }; /* periods after which actuators have reached their command */

enum { BODY = QUADSIM_NMPC_BODY, MOST = QUADSIM_NMPC_MOST, LEFT = QUADSIM_NMPC_LEFT, P = 0, Q = 3, V = 7, W = 10 };

static inline int states_of(const quadsim_nmpc_problem *p)
{
    return BODY + p->actuators + (p->moves ? NU : 0);
}

/* Entries of a node; see quadsim_nmpc_problem. */
static inline int entries_of(const quadsim_nmpc_problem *p)
{
    return NU + (p->tilts ? 2 : 0) + (p->turns ? 3 : 0) + (p->places ? 6 : 0);
}

/* Columns of a map: all states but the position, then the inputs; padded to an even number. */
static inline int columns_of(int n)
{
    return (n + 2) & ~1;
}

/* F q, or F' q, of the frame of a reference quaternion: the product with its conjugate, or with itself. */
static inline void into_frame(const real *frame, const real *q, real *out)
{
    const real w = frame[0], x = frame[1], y = frame[2], z = frame[3];
    const real a = q[0], b = q[1], c = q[2], d = q[3];
    out[0] = w * a + x * b + y * c + z * d;
    out[1] = -x * a + w * b + z * c - y * d;
    out[2] = -y * a - z * b + w * c + x * d;
    out[3] = -z * a + y * b - x * c + w * d;
}

static inline void from_frame(const real *frame, const real *q, real *out)
{
    const real w = frame[0], x = frame[1], y = frame[2], z = frame[3];
    const real a = q[0], b = q[1], c = q[2], d = q[3];
    out[0] = w * a - x * b - y * c - z * d;
    out[1] = x * a + w * b - z * c + y * d;
    out[2] = y * a + z * b + w * c - x * d;
    out[3] = z * a - y * b + x * c + w * d;
}

/* The attitude that Euler angles stand for. */
static inline void quaternion_of_angles(const real *state, real q[4])
{
    real s[3], c[3];
    int i;
    for (i = 0; i < 3; i++) {
        sin_cos(R(0.5) * state[ROLL + 2 * i], &s[i], &c[i]);
    }
    q[0] = c[0] * c[1] * c[2] + s[0] * s[1] * s[2];
    q[1] = s[0] * c[1] * c[2] - c[0] * s[1] * s[2];
    q[2] = c[0] * s[1] * c[2] + s[0] * c[1] * s[2];
    q[3] = c[0] * c[1] * s[2] - s[0] * s[1] * c[2];
}

/* A body (13,) of a state, and of attitude and body rates where these are known. */
static inline void put_body(const real *state, const real *attitude, const real *rates, real *body)
{
    int i;
    for (i = 0; i < 3; i++) {
        body[P + i] = state[2 * i];
        body[V + i] = state[2 * i + 1];
    }
    if (attitude != NULL && is_finite(attitude, 4)) {
        memcpy(body + Q, attitude, 4 * sizeof(real));
    } else {
        quaternion_of_angles(state, body + Q);
    }
    if (rates != NULL && is_finite(rates, 3)) {
        memcpy(body + W, rates, 3 * sizeof(real));
    } else {
        body_rates(state, body + W);
    }
}

/* Shares of the largest inputs for commands (4,): rotor speeds [rad/s], of rotors with a mean coefficient [N s^2], or
 * targets, of which `scale` is a share of 1. */
static inline void commands_to_shares(const quadsim_nmpc_problem *p, real coefficient, const real *scale,
                                      const real *commands, real *shares)
{
    int j;
    for (j = 0; j < NU; j++) {
        const real thrust = coefficient * commands[j] * commands[j] / p->largest;
        const real rotor = p->speeds ? square_root(thrust) : thrust;
        shares[j] = p->targets ? commands[j] / scale[j] : rotor;
    }
}

/* quadsim_nmpc_model.c: by how much the plan misses the dynamics. */
quadsim_real quadsim_nmpc_defect(const quadsim_nmpc_work *work, const quadsim_nmpc_world *world);

#endif
