/* Linear model predictive controllers of quadrotors.
 *
 * Once every period, call quadsim_mpc_step with what is measured now; hold the command until the next call.
 *
 * state [12]        x vx y vy z vz roll roll_rate pitch pitch_rate yaw yaw_rate
 *                   [m, m/s, rad, rad/s]: world axes with z up; Z-Y-X Euler angles, body to world, and their rates
 * reference [N][4]  x y z yaw [m, rad], where to be one period from now, two, ... N periods from now; whole turns of
 *                   yaw make no difference
 * acting [4]        the command before, u(k-1), in force up to now unless it is still under way [rad/s]
 * command [4]       rotor speeds to hold for the period [rad/s], rotors in the vehicle file's order; or targets of an
 *                   inner loop: thrust [N] and body rates [rad/s]
 *
 * A controller's numbers are a quadsim_controller, which is read only and may be shared.  All that a controller
 * remembers is in a quadsim_mpc and its memory of quadsim_mpc_reals(controller) numbers, both of the caller's.  Nothing
 * is allocated, nothing is shared: two structs are two controllers. */
#ifndef QUADSIM_MPC_H
#define QUADSIM_MPC_H

#include "quadsim_guard.h"

#ifdef __cplusplus
extern "C" {
#endif

/* Runge-Kutta steps of a prediction.  Over 50 ms from 30 deg of tilt, turning at 2 rad/s, with commands 50 rad/s apart,
 * two have errors of 1e-5 rad, or 3e-4 rad with a rotor lag of 20 ms; one has ten times as much. */
enum { QUADSIM_SUBSTEPS = 2 };
enum { QUADSIM_ANSWER = 4 * 6 };  /* numbers of an inner loop's answer in such a step */
enum { QUADSIM_LAW_STATES = 16 }; /* of a problem: 12, and 4 that stand for rotor speeds where these lag */

/* The robust controller's numbers besides those of its problem.  Matrices are row by row.
 *
 * A delay is under_way whole periods and the rest `delay`, which is less than a period or equal to one: in each period,
 * one more command takes over `delay` after its start, and is in force for rest_of_period until the next start.  Of
 * each of these spans, and of a whole period, there are:
 * left_after_...   the share that is left after it of the rotors' distance from their command;
 * decay_... [SUBSTEPS][4]      the same at the instants of Runge-Kutta's stages;
 * answer_... [SUBSTEPS][4][6]  of an inner loop at these instants, about body x, y, z: the share that is left of the
 *                              body rates at the start [3], and what the turn since then takes from their targets [3]
 */
typedef struct quadsim_robust {
    int observes;                /* whether disturbances are estimated */
    int heading;                 /* whether the model is turned by the yaw */
    int targets;                 /* whether commands are an inner loop's targets: T, p, q, r */
    int under_way;               /* whole periods that a command takes to act, before delay */
    quadsim_real gravity;        /* [m/s^2] */
    quadsim_real least_lift;     /* least share of the weight that thrust is taken to balance */
    quadsim_real upright;        /* least cosine of the tilt that the observer divides by */
    quadsim_real period, delay;  /* [s] */
    quadsim_real delayed_share;  /* delay as a share of the period */
    quadsim_real rest_of_period; /* [s] */
    quadsim_real left_after_period, left_after_delay, left_after_rest;
    quadsim_real largest_turn;      /* of the reference's yaw in a period [rad] */
    quadsim_real effectiveness[16]; /* from squared speeds to U/m and I^-1 tau */
    quadsim_real allocation[16];    /* its inverse */
    quadsim_real gyration[3];       /* (I_y - I_z) / I_x and so on */
    int moment;                     /* whether the one-step prediction has what the air does, by the next four: */
    quadsim_real across[6];         /* I^-1 torque [3][2] per sum of the rotors' speeds and velocity along body x, y */
    quadsim_real inflow[6];         /* I^-1 torque [3][2] per velocity along body z and velocity along body x, y */
    quadsim_real damping[9];        /* I^-1 torque [3][3] per body rate */
    quadsim_real loss;              /* U/m lost per sum of the rotors' speeds and velocity along body z */
    quadsim_real slope_inverse[16]; /* from changes of U/m and I^-1 tau to those of speeds at hover */
    quadsim_real gain[6];           /* of the observer */
    quadsim_real largest[6];        /* magnitudes of its estimate */
    quadsim_real decay_before[QUADSIM_SUBSTEPS * 4]; /* of rest_of_period */
    quadsim_real decay_delay[QUADSIM_SUBSTEPS * 4];
    quadsim_real decay_period[QUADSIM_SUBSTEPS * 4];
    quadsim_real mass;                                             /* where commands are targets [kg] */
    quadsim_real answer_before[QUADSIM_SUBSTEPS * QUADSIM_ANSWER]; /* of rest_of_period */
    quadsim_real answer_delay[QUADSIM_SUBSTEPS * QUADSIM_ANSWER];
    quadsim_real answer_period[QUADSIM_SUBSTEPS * QUADSIM_ANSWER];
    quadsim_real plausible_state[12], plausible_reference[4]; /* largest magnitudes of a measurement and a reference */
} quadsim_robust;

/* A controller's numbers.  Where another solver optimises, the problem has no axes, and neither quadsim_mpc_optimise
 * nor quadsim_mpc_step may be called; where quadsim guards, the fallback is NULL, and quadsim_mpc_step may not be
 * called. */
typedef struct quadsim_controller {
    const quadsim_problem *problem;
    const quadsim_robust *robust; /* NULL: the paper's controllers */
    const quadsim_fallback *fallback;
    quadsim_real hover[4]; /* [rad/s] */
    int follows_rates;     /* whether a desired output is a velocity or the yaw rate of the reference */
    quadsim_real period;   /* [s] */
} quadsim_controller;

/* A controller.  Read guard.level, work.changes and work.plan, the last optimum [N][4] in rad/s, and the query; the
 * rest is its own. */
typedef struct quadsim_mpc {
    const quadsim_controller *controller;
    quadsim_work work;
    quadsim_real *desired;    /* the query: y_d [N][n_r] */
    quadsim_real *guard_plan; /* [N][4] memory of the guard */
    quadsim_real *sent;       /* robust: [under_way][4] the commands before the last, oldest first [rad/s] */
    quadsim_real state[QUADSIM_LAW_STATES]; /* the query: x(k), in axes that may be turned by the yaw */
    quadsim_real rest[QUADSIM_LAW_STATES];  /* the query: x_s, where the model rests */
    quadsim_real rest_command[4];           /* the query: u_s, the speeds or targets there [rad/s], [N] */
    quadsim_real acting[4];                 /* the query: u(k-1), the last command sent [rad/s] */
    quadsim_real yaw;                       /* by which the query's axes are turned about world z [rad] */
    quadsim_real before[4];                 /* the command of the last period, should acting not be finite [rad/s] */
    int headed;                             /* whether a heading has been followed */
    quadsim_real heading;           /* the reference's one period from now, on the turn that is followed [rad] */
    int ahead_known;                /* robust: whether `ahead` is known */
    quadsim_real rotors[4];         /* robust: speeds when the next command takes over in this period [rad/s] */
    quadsim_real ahead[12];         /* robust: the state at that instant */
    quadsim_real rotors_ahead[4];   /* robust: speeds at the instant from which this period's command acts [rad/s] */
    quadsim_real estimate[6];       /* disturbance: world x, y, along thrust [m/s^2], body [rad/s^2] */
    quadsim_trim trim;              /* equilibrium under it; the paper's controllers: level hover */
    quadsim_real effectiveness[16]; /* from squared speeds to U/m and I^-1 tau under it, in which thrust twists */
    quadsim_guard guard;
} quadsim_mpc;

/* Numbers of memory that a controller needs. */
long quadsim_mpc_reals(const quadsim_controller *controller);

/* A controller in memory of the caller's, after the command of hover. */
void quadsim_mpc_start(quadsim_mpc *mpc, const quadsim_controller *controller, quadsim_real *memory);

/* Restart after the command u(-1) [rad/s]. */
void quadsim_mpc_reset(quadsim_mpc *mpc, const quadsim_real speeds[4]);

/* Start from an estimate of the disturbance, as of `estimate`; without an observer nothing changes. */
void quadsim_mpc_learn(quadsim_mpc *mpc, const quadsim_real estimate[6]);

/* Pass a period on the ground, where no disturbance shows and no plan is flown, with the command in force [rad/s]. */
void quadsim_mpc_stand(quadsim_mpc *mpc, const quadsim_real acting[4]);

/* The query of the period that starts now; QUADSIM_INVALID_DATA without one, otherwise QUADSIM_FREE.  `flying`: in the
 * air; the ground holds the vehicle, so its motion shows no disturbance.  `learns`: the state is measured, one period
 * after the last call, and so may be compared with the one expected. */
enum quadsim_status quadsim_mpc_prepare(quadsim_mpc *mpc, int flying, int learns, const quadsim_real state[12],
                                        const quadsim_real *reference, const quadsim_real acting[4]);

/* The optimum of the query, as work.plan; without one a status from QUADSIM_PRIMAL_INFEASIBLE on. */
enum quadsim_status quadsim_mpc_optimise(quadsim_mpc *mpc);

/* The command of the period that starts now, always finite and within the bounds on rotor speeds: the optimum, or
 * without one what the fallback contract flies instead (quadsim_guard.c).  Channels of the state that are not measured
 * are not finite. */
enum quadsim_status quadsim_mpc_step(quadsim_mpc *mpc, enum quadsim_phase phase, const quadsim_real state[12],
                                     const quadsim_real *reference, const quadsim_real acting[4],
                                     quadsim_real command[4]);

#ifdef __cplusplus
}
#endif

#endif
