/* Model predictive controllers of quadrotors.
 *
 * Once every period, call quadsim_mpc_step with what is measured now; hold the command until the next call.
 *
 * state [12]        x vx y vy z vz roll roll_rate pitch pitch_rate yaw yaw_rate
 *                   [m, m/s, rad, rad/s]: world axes with z up; Z-Y-X Euler angles, body to world, and their rates
 * reference [N][4]  x y z yaw [m, rad], where to be one period from now, two, ... N periods from now; whole turns of
 *                   yaw make no difference
 * acting [4]        the command before, u(k-1), in force up to now unless it is still under way [rad/s]
 * command [4]       rotor speeds to hold for the period [rad/s], rotors in the vehicle file's order
 *
 * A controller's numbers are a quadsim_controller, which is read only and may be shared.  All that a controller
 * remembers is in a quadsim_mpc and its memory of quadsim_mpc_reals(controller) numbers, both of the caller's.  Nothing
 * is allocated, nothing is shared: two structs are two controllers. */
#ifndef QUADSIM_MPC_H
#define QUADSIM_MPC_H

#include "quadsim_core.h"

#ifdef __cplusplus
extern "C" {
#endif

enum { QUADSIM_SUBSTEPS = 2 };     /* Runge-Kutta steps of a prediction */
enum { QUADSIM_LAW_STATES = 16 }; /* of a problem: 12, and 4 that stand for rotor speeds where these lag */

/* The robust controller's numbers besides those of its problem.  Matrices are row by row. */
typedef struct quadsim_robust {
    int observes;                                      /* whether disturbances are estimated */
    int heading;                                       /* whether the model is turned by the yaw */
    int under_way;                                     /* whole periods that a command takes to act, before delay */
    quadsim_real gravity;                              /* [m/s^2] */
    quadsim_real least_lift, upright;                  /* least shares of weight, and of thrust along z */
    quadsim_real period, delay, delayed_share, rest_of_period; /* [s], [s], share of the period, [s] */
    quadsim_real spun_period, spun_delay, spun_before; /* shares of rotor speeds left after these and rest_of_period */
    quadsim_real largest_turn;                         /* of the reference's yaw in a period [rad] */
    quadsim_real effectiveness[16];                    /* from squared speeds to U/m and I^-1 tau */
    quadsim_real allocation[16];                       /* its inverse */
    quadsim_real gyration[3];
    quadsim_real slope_inverse[16]; /* from changes of U/m and I^-1 tau to those of speeds at hover */
    quadsim_real modes[16];         /* from rotor speeds to the states that stand for them where they lag */
    quadsim_real gain[6], largest[6];                                  /* of the observer; of its estimate */
    quadsim_real decay_before[QUADSIM_SUBSTEPS * 4];                   /* shares left at instants of rest_of_period */
    quadsim_real decay_delay[QUADSIM_SUBSTEPS * 4];                    /* of delay */
    quadsim_real decay_period[QUADSIM_SUBSTEPS * 4];                   /* and of a period */
    quadsim_real plausible_state[12], plausible_reference[4];          /* most that is taken for a measurement */
} quadsim_robust;

/* The numbers of the fallback contract.  Ages are in periods; the model is that of level hover. */
typedef struct quadsim_fallback {
    int plan_age, hover;           /* how long a plan is flown, and level hover after it, at most */
    int unseen, compared;          /* how old a channel may be that is predicted; the last state that is learnt from */
    quadsim_real sink, sunk;       /* of the descent [m/s], and in a period [m] */
    quadsim_real settled;          /* horizontal speed above which no place is held [m/s] */
    quadsim_real tilt, climb, turn; /* most that hover demands [rad], [m/s^2], [rad/s^2] */
    quadsim_real largest_speed;    /* most that is taken for a command [rad/s] */
    quadsim_real largest_reference; /* and for a reference [m], [rad] */
    quadsim_real distance[12];     /* from a plan's states at most */
    quadsim_real plausible[12], unmoved[12]; /* most that is taken for a measurement; least motion of what moves */
    quadsim_real noise[12], unknown[12]; /* variances of what is measured, and before the first measurement */
    quadsim_real process[6];       /* of the prediction: position, with velocity, velocity; the same of angles */
    quadsim_real A[144], B[48];
    quadsim_real gain[48], lean[8]; /* of hover: from errors to accelerations, from horizontal ones to tilts */
    quadsim_real slope[4];         /* from changes of speeds to acceleration along z */
    quadsim_real inverse[16];      /* from accelerations along z and about x, y, z to changes of speeds */
} quadsim_fallback;

/* A controller's numbers. */
typedef struct quadsim_controller {
    const quadsim_problem *problem;
    const quadsim_robust *robust;                            /* NULL: the paper's controllers */
    const quadsim_fallback *fallback; /* NULL where quadsim guards the law: quadsim_mpc_step is not for it */
    const quadsim_real *C_r;                                 /* [n_r][n] regulated outputs, C_r x */
    quadsim_real hover[4];                                   /* [rad/s] */
    quadsim_real speed_min[4], speed_max[4];                 /* [rad/s]; no bound: +-1e30 */
    quadsim_real step_min[4], step_max[4];                   /* of speeds from one period to the next [rad/s] */
} quadsim_controller;

/* How a period was answered.  The first three are the optimum, flown as it is; the others are why there is none. */
enum quadsim_status {
    QUADSIM_FREE = QUADSIM_FOUND_FREE,   /* the optimum without constraints keeps them all */
    QUADSIM_AXES = QUADSIM_FOUND_AXES,   /* the optimum with rows of states alone, axis by axis, keeps all others */
    QUADSIM_WHOLE = QUADSIM_FOUND_WHOLE, /* the optimum of the whole problem */
    QUADSIM_PRIMAL_INFEASIBLE = QUADSIM_FOUND_INFEASIBLE,
    QUADSIM_MAX_ITERATIONS = QUADSIM_FOUND_GAVE_UP, /* the search took as many changes as it may */
    QUADSIM_NO_ROOM = QUADSIM_FOUND_NO_ROOM,        /* for as many active rows */
    QUADSIM_INVALID_DATA = QUADSIM_FOUND_INVALID,   /* numbers that are not finite, or implausible */
    QUADSIM_NOT_FINITE,        /* the plan */
    QUADSIM_OUT_OF_BOUNDS,     /* the plan's first command */
    QUADSIM_STATE_UNKNOWN,     /* a channel has not been measured for too long */
    QUADSIM_INVALID_REFERENCE,
    QUADSIM_LANDED,            /* rotors are stopped */
    QUADSIM_MISSED             /* no question came in time: of serial.c */
};

/* Where a period passes: in the air, on the ground with rotors that turn, or at rest there. */
enum quadsim_phase { QUADSIM_PHASE_FLYING, QUADSIM_PHASE_ARMED, QUADSIM_PHASE_LANDED };

/* What the fallback contract remembers. */
typedef struct quadsim_guard {
    int planned, foreseeing;   /* whether a plan is kept; whether `foreseen` moves along it */
    int age, hovered, targeted; /* periods in fallback, and in hover or descent; whether these have a target */
    int since;                 /* periods since the law was given a state that is measured */
    int unseen[12];            /* periods since each channel was */
    quadsim_real state[12];    /* complete */
    quadsim_real covariance[144];
    quadsim_real last[12], last_rates[3]; /* as measured the period before; body rates */
    quadsim_real foreseen[12]; /* the state of the last optimum, then where its plan leads */
    quadsim_real heading[2], level[2], resting[4]; /* sine and cosine of its yaw, roll and pitch at rest, speeds there */
    quadsim_real target[12];
} quadsim_guard;

/* A controller.  Read fallback, work.changes and work.plan, the last optimum [N][4] in rad/s; the rest is its own. */
typedef struct quadsim_mpc {
    const quadsim_controller *controller;
    quadsim_work work;
    quadsim_real *wanted;           /* [N][n_r] y_d - C_r x_s */
    quadsim_real *kept;             /* [N][4] the last optimum that was flown [rad/s] */
    quadsim_real *sent;             /* robust: [under_way][4] the commands before the last, oldest first [rad/s] */
    quadsim_real state[QUADSIM_LAW_STATES]; /* the query: x(k), seen from axes that may be turned by the yaw */
    quadsim_real rest[QUADSIM_LAW_STATES];  /* where the model rests, x_s */
    quadsim_real resting[4];                 /* and at which speeds, u_s [rad/s] */
    quadsim_real before[4];         /* the last command [rad/s] */
    int fallback;                   /* of the last step: 0 its optimum, 1 the plan kept, 2 hover, 3 descent */
    int headed;                     /* whether a heading has been followed */
    quadsim_real heading;           /* the reference's one period from now, on the turn that is followed [rad] */
    int known;                      /* robust: whether the state ahead is known */
    quadsim_real rotors[4];         /* robust: speeds when the next command takes over in this period [rad/s] */
    quadsim_real ahead[12];         /* the state there */
    quadsim_real turning[4];        /* speeds at the instant from which the command acts [rad/s] */
    quadsim_real estimate[6];       /* disturbance: world x, y, along thrust [m/s^2], body [rad/s^2] */
    quadsim_real trim[4];           /* rotor speeds at rest against it [rad/s]; the paper's: of level hover */
    quadsim_real lift[3];           /* along which thrust points there, world axes */
    quadsim_real twist[3];          /* angular acceleration over that by thrust [1/m] */
    quadsim_real effectiveness[16]; /* from squared speeds to U/m and I^-1 tau, so twisted */
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

/* The optimum of the period that starts now, as work.plan; without one a status from QUADSIM_PRIMAL_INFEASIBLE on. */
enum quadsim_status quadsim_mpc_solve(quadsim_mpc *mpc, const quadsim_real state[12], const quadsim_real *reference,
                                      const quadsim_real acting[4]);

/* The command of the period that starts now, always finite and within the bounds on rotor speeds: the optimum, or
 * without one what the fallback contract flies instead (quadsim_guard.c).  Channels of the state that are not measured
 * are not finite. */
enum quadsim_status quadsim_mpc_step(quadsim_mpc *mpc, enum quadsim_phase phase, const quadsim_real state[12],
                                     const quadsim_real *reference, const quadsim_real acting[4],
                                     quadsim_real command[4]);

/* Forget measurements, plan and level: of quadsim_mpc_reset. */
void quadsim_guard_reset(quadsim_mpc *mpc);

#ifdef __cplusplus
}
#endif

#endif
