/* Geometric tracking control on SE(3); equations and sources: quadsim/mpc/laws/geometric.py of quadsim.
 *
 * Once every period, call quadsim_geometric_step with what is measured now; hold the command until the next call.
 *
 * state [19]        position, velocity, Euler angles and their rates in the order of quadsim_guard.h [12]; the
 *                   attitude as a quaternion w x y z, body to world [4], and body rates [3] [rad/s], each derived
 *                   from the angles and their rates where it is not finite, or where `exact` is not set
 * reference         previews [N][4]: x y z yaw [m, rad], where to be one period from now, two, ... N periods from now;
 *                   whole turns of yaw make no difference.  Or where `motion` is set samples of a course [7][17], now,
 *                   one period on, ...: position, quaternion, and ten numbers that are not needed here; past the end
 *                   of the course its last one
 * acting [4]        the command before, in force up to now
 * command [4]       targets of an autopilot, to hold for the period: thrust [N] and body rates [rad/s]
 *
 * A controller's numbers are read only, and may be shared.  All that a controller remembers is in a quadsim_geometric
 * and its memory of quadsim_geometric_reals(numbers) reals, all of the caller's.  Nothing is allocated, nothing is
 * shared. */
#ifndef QUADSIM_GEOMETRIC_H
#define QUADSIM_GEOMETRIC_H

#include "quadsim_delay.h"
#include "quadsim_guard.h"
#include "quadsim_ramp.h"

#ifdef __cplusplus
extern "C" {
#endif

#ifdef QUADSIM_FLOAT
#define quadsim_geometric_start quadsim_geometric_start_float
#endif

/* What a controller commands: a wrench for its rotors [N, N m]; thrust and body rates; or these, then a quaternion
 * wxyz. */
enum { QUADSIM_GEOMETRIC_ROTORS, QUADSIM_GEOMETRIC_RATES, QUADSIM_GEOMETRIC_ATTITUDE };

enum {
    QUADSIM_GEOMETRIC_ORDERS = 5,  /* derivatives of a position from 0 to snap */
    QUADSIM_GEOMETRIC_SAMPLES = 7, /* of a course, at most */
    QUADSIM_GEOMETRIC_DEGREE = 5   /* of the polynomial through them */
};

/* Matrices are row by row.  Axes of vectors: world of forces, body of rates and torques. */
typedef struct quadsim_geometric_numbers {
    int commands;               /* see above */
    int feedforward, moment;    /* whether jerk, snap and drag are fed forward, and the air's moment */
    int exact;                  /* whether attitude and body rates count as they are measured */
    int motion;                 /* whether references are samples of a course, in quadsim_geometric_step */
    int horizon, orders;        /* N samples of a preview; values and derivatives that are taken from it */
    quadsim_real period;        /* [s] */
    quadsim_real mass, gravity; /* [kg], [m/s^2] */
    quadsim_real k_x, k_v;      /* gains of position and velocity errors [1/s^2], [1/s] */
    quadsim_real k_R[3], k_Omega[3], k_attitude[3]; /* of attitude and rate errors [1/s^2], [1/s]; to rates [1/s] */
    quadsim_real k_i, k_I, c_1, c_2;                /* of the integrals [1/s^2]; weights in them [1/s] */
    quadsim_real sigma, sigma_R;                    /* their limits [m/s^2], [rad/s^2] */
    quadsim_real least_lift, slope; /* limits of the force: upwards [N], and of its horizontal part over that */
    quadsim_real ahead, lead[3];    /* of the thrust that is fed forward, and of rates [s] */
    quadsim_real drag[3];           /* that is fed forward, body axes [1/s] */
    quadsim_real inertia[9];        /* J [kg m^2] */
    quadsim_real across[2], inflow[2], damping[3],
        turning;                    /* the air's moment, see quadsim_ramp.h; speeds of all rotors [rad/s] */
    quadsim_real loss;              /* of thrust, per speed of a rotor and velocity along body z [N s^2/(m rad)] */
    quadsim_real least[4], most[4]; /* of targets */
    const quadsim_real *preview; /* [orders][N] from samples one period on, two, ... to value and derivatives when the
                                  * command takes over, */
    const quadsim_real *course;  /* [min(K, 6)][K] from samples now, one period on, ..., for K = 1, then 2, ... 7 */
    const quadsim_delay_numbers *delay; /* which is so much later; NULL where commands act at once */
    const quadsim_ramp_numbers *ramp;   /* NULL where no disturbance is observed */
    const quadsim_fallback *fallback;   /* NULL where quadsim guards: quadsim_geometric_step is not for it */
} quadsim_geometric_numbers;

/* What is measured. */
typedef struct quadsim_geometric_motion {
    quadsim_real position[3], velocity[3]; /* world [m], [m/s] */
    quadsim_real attitude[9];              /* R, body to world */
    quadsim_real rates[3];                 /* Omega, body [rad/s] */
    quadsim_real yaw;                      /* [rad] */
} quadsim_geometric_motion;

/* Where to be now. */
typedef struct quadsim_geometric_target {
    quadsim_real path[QUADSIM_GEOMETRIC_ORDERS][3]; /* position to snap, world */
    quadsim_real yaw[3];                            /* and its first two derivatives [rad], ... */
    int headed;                                     /* whether, in place of yaw, there is a */
    quadsim_real heading[9]; /* direction of body x, of any length but zero, and its first two derivatives */
} quadsim_geometric_target;

typedef struct quadsim_geometric_disturbance {
    quadsim_real force[3], change[3], torque[3]; /* [m/s^2], [m/s^3], [rad/s^2] */
} quadsim_geometric_disturbance;

/* The attitude that is commanded, its rates, and their derivative in its own axes. */
typedef struct quadsim_geometric_attitude {
    quadsim_real attitude[9], rates[3], acceleration[3];
} quadsim_geometric_attitude;

/* Read command, thrust_scale and guard.level; the rest is its own. */
typedef struct quadsim_geometric {
    const quadsim_geometric_numbers *numbers;
    quadsim_real translation[3], rotation[3]; /* the integrals [m/s^2], [rad/s^2] */
    quadsim_real command[8], thrust_scale;
    quadsim_geometric_attitude desired;
    quadsim_ramp ramp;   /* of disturbances */
    quadsim_delay delay; /* commands under way */
    quadsim_real *plan;  /* [N][4] the command, then hover */
    int learns;          /* whether the state of the last period was measured */
    quadsim_guard guard;
} quadsim_geometric;

long quadsim_geometric_reals(const quadsim_geometric_numbers *numbers);

/* A controller in memory of the caller's, after the thrust of the weight or, of rotors, with rotors at rest. */
void quadsim_geometric_start(quadsim_geometric *law, const quadsim_geometric_numbers *numbers, quadsim_real *memory);

/* Restart after a command, targets or rotor speeds [rad/s]; after that of the start where it is not finite. */
void quadsim_geometric_reset(quadsim_geometric *law, const quadsim_real acting[4]);

/* The motion of a state, with the quaternion wxyz and the body rates that are measured; NULL: those of the state. */
void quadsim_geometric_measure(const quadsim_real state[12], const quadsim_real *quaternion, const quadsim_real *rates,
                               quadsim_geometric_motion *motion);

/* The target of a preview [N][4] of x, y, z, yaw. */
void quadsim_geometric_preview(const quadsim_geometric_numbers *numbers, const quadsim_real *reference,
                               quadsim_geometric_target *target);

/* The target of the next samples of a course, from now on: rows of `width` numbers that begin with position and
 * quaternion; those that repeat the last one do not count. */
void quadsim_geometric_course(const quadsim_geometric_numbers *numbers, int samples, int width,
                              const quadsim_real *rows, quadsim_geometric_target *target);

/* The force [3] [N] limited to at least `least` upwards, and sideways to `slope` times that. */
void quadsim_geometric_limit(const quadsim_real force[3], quadsim_real least, quadsim_real slope,
                             quadsim_real limited[3]);

/* Thrust and torques [N, N m], and law->desired. */
void quadsim_geometric_wrench(quadsim_geometric *law, const quadsim_geometric_motion *motion,
                              const quadsim_geometric_target *target, const quadsim_geometric_disturbance *disturbance,
                              quadsim_real wrench[4]);

/* Thrust and body rates [N, rad/s], of QUADSIM_GEOMETRIC_ATTITUDE a quaternion after them, and law->desired. */
void quadsim_geometric_targets(quadsim_geometric *law, const quadsim_geometric_motion *motion,
                               const quadsim_geometric_target *target, const quadsim_geometric_disturbance *disturbance,
                               quadsim_real *targets);

/* Move the integrals on by a period, towards law->desired. */
void quadsim_geometric_integrate(quadsim_geometric *law, const quadsim_geometric_motion *motion,
                                 const quadsim_geometric_target *target);

/* law->command for the period that starts now: targets within their bounds, or a wrench.  The motion is moved on to
 * when it takes over, and the target is for then; `acting` is the command that was sent last.  The integrals hold
 * unless the vehicle is flying and the targets that matter to it are within; of a wrench that rotors can give, the
 * caller calls quadsim_geometric_integrate.  `follows`: whether the last call was one period ago. */
void quadsim_geometric_solve(quadsim_geometric *law, int flying, int follows, quadsim_geometric_motion *motion,
                             const quadsim_geometric_target *target, const quadsim_real acting[4]);

/* The command of the period that starts now, always finite and within its bounds: the controller's, or what the
 * fallback contract flies instead (quadsim_guard.h).  Not for a controller of rotors.  Channels of the state that are
 * not measured are not finite. */
enum quadsim_status quadsim_geometric_step(quadsim_geometric *law, enum quadsim_phase phase,
                                           const quadsim_real state[QUADSIM_MEASURED], const quadsim_real *reference,
                                           const quadsim_real acting[4], quadsim_real command[4]);

#ifdef __cplusplus
}
#endif

#endif
