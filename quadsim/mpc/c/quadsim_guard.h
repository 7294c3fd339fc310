/* The fallback contract around a controller: what is flown when it has no usable answer, and the state it is given.
 *
 * Each period passes quadsim_guard_begin, where it returns QUADSIM_FREE the controller, and quadsim_guard_end.  The
 * controller has the whole state and the command in force from the guard, and states where the vehicle rests.
 *
 * state [12]        x vx y vy z vz roll roll_rate pitch pitch_rate yaw yaw_rate
 *                   [m, m/s, rad, rad/s]: world axes with z up; Z-Y-X Euler angles, body to world, and their rates
 * commands [4]      rotor speeds [rad/s], or targets of an inner loop: thrust [N] and body rates [rad/s] */
#ifndef QUADSIM_GUARD_H
#define QUADSIM_GUARD_H

#include "quadsim_core.h"

#ifdef __cplusplus
extern "C" {
#endif

/* How a period was answered.  The first three are the optimum, flown as it is; the last two are flown as well; the
 * others are why there is none. */
enum quadsim_status {
    QUADSIM_FREE = QUADSIM_FOUND_FREE,   /* the optimum without constraints keeps them all */
    QUADSIM_AXES = QUADSIM_FOUND_AXES,   /* the optimum with rows of states alone, axis by axis, keeps all others */
    QUADSIM_WHOLE = QUADSIM_FOUND_WHOLE, /* the optimum of the whole problem */
    QUADSIM_PRIMAL_INFEASIBLE = QUADSIM_FOUND_INFEASIBLE,
    QUADSIM_MAX_ITERATIONS = QUADSIM_FOUND_GAVE_UP, /* the search took as many changes as it may */
    QUADSIM_NO_ROOM = QUADSIM_FOUND_OVER_CAPACITY,  /* the search needed more active rows than the capacity */
    QUADSIM_INVALID_DATA = QUADSIM_FOUND_INVALID,   /* numbers that are not finite, or implausible */
    QUADSIM_NOT_FINITE,                             /* the plan */
    QUADSIM_OUT_OF_BOUNDS,                          /* the plan's first command */
    QUADSIM_STATE_UNKNOWN,                          /* a channel has not been measured for too long */
    QUADSIM_INVALID_REFERENCE,
    QUADSIM_LANDED,            /* rotors are stopped */
    QUADSIM_MISSED,            /* no question came in time: of serial.c */
    QUADSIM_INFEASIBLE_ANSWER, /* the plan violates a row by more than rounding */
    QUADSIM_NOT_CONVERGED,     /* the optimum, whose plan misses the nonlinear dynamics by more than it should */
    QUADSIM_COMMANDED          /* the command of a controller that solves no problem */
};

/* Whether a status is that of a command which is flown as it is. */
int quadsim_is_flown(enum quadsim_status status);

/* Where a period passes: in the air, on the ground with rotors that turn, or at rest there. */
enum quadsim_phase { QUADSIM_PHASE_FLYING, QUADSIM_PHASE_ARMED, QUADSIM_PHASE_LANDED };

/* The numbers of the fallback contract.  Ages are in periods; the model is that of level hover. */
typedef struct quadsim_fallback {
    int targets;                    /* whether commands are targets of an inner loop */
    int plan_age, hover_periods;    /* how long a plan is flown, and level hover after it, at most */
    int unseen, compared;           /* how old a channel may be that is predicted; the last state that is learnt from */
    quadsim_real sink, sunk;        /* of the descent [m/s], and in a period [m] */
    quadsim_real settled;           /* horizontal speed above which no place is held [m/s] */
    quadsim_real tilt, climb, turn; /* most that hover demands [rad], [m/s^2], [rad/s^2] */
    quadsim_real largest_command;   /* most that is taken for a command */
    quadsim_real largest_reference; /* and for a reference [m], [rad] */
    quadsim_real distance[12];      /* from a plan's states at most */
    quadsim_real upright;           /* pitch below which implausible Euler rates are a fault of the measurement [rad] */
    quadsim_real plausible[12], unmoved[12]; /* most that is taken for a measurement; least motion of what moves */
    quadsim_real noise[12], unknown[12];     /* variances of what is measured, and before the first measurement */
    quadsim_real process[6]; /* of the prediction: position, with velocity, velocity; the same of angles */
    quadsim_real hover[4];   /* the command of level hover */
    quadsim_real least[4], most[4], step_least[4], step_most[4]; /* of commands, and of their steps from period to
                                                                  * period; no bound: +-1e30 */
    quadsim_real A[144], B[48];
    quadsim_real gain[48], lean[8]; /* of hover: from errors to accelerations, from horizontal ones to tilts */
    quadsim_real slope[4];          /* from changes of speeds to acceleration along z */
    quadsim_real inverse[16];       /* from accelerations along z and about x, y, z to changes of speeds */
} quadsim_fallback;

/* Where a controller says that the vehicle rests under what disturbs it. */
typedef struct quadsim_trim {
    quadsim_real commands[4];
    quadsim_real lift[3];  /* along which thrust points, world axes, upwards */
    quadsim_real twist[3]; /* angular acceleration over that by thrust [1/m] */
} quadsim_trim;

/* What the contract remembers.  Read state, in_force, learns, asked and level; the rest is its own. */
typedef struct quadsim_guard {
    const quadsim_fallback *numbers;
    quadsim_real *kept; /* [horizon][4] the last plan that was flown */
    int horizon;
    int level;                  /* of the last step: 0 the controller's command, 1 the plan kept, 2 hover, 3 descent */
    int learns;                 /* whether the controller may compare this state with the one it expected */
    int asked, waiting;         /* periods from the controller's call before to this one; since the last */
    int planned, foreseeing;    /* whether a plan is kept; whether `foreseen` moves along it */
    int age, hovered, targeted; /* periods in fallback, and in hover or descent; whether these have a target */
    int since;                  /* periods since the controller was given a state that is measured */
    int unseen[12];             /* periods since each channel was */
    quadsim_real in_force[4], before[4]; /* commands in force now, and after the last step */
    quadsim_real state[12];              /* complete */
    quadsim_real covariance[144];
    quadsim_real last[12], last_rates[3]; /* as measured the period before; body rates */
    quadsim_real foreseen[12];            /* the state of the last plan, then where it leads */
    quadsim_real heading[2], level_there[2],
        resting[4]; /* sine and cosine of its yaw, roll and pitch at rest, commands */
    quadsim_real target[12];
    quadsim_trim trim; /* of the last step */
} quadsim_guard;

/* A contract whose plans have room [horizon][4], the caller's; reset it before its first period. */
void quadsim_guard_start(quadsim_guard *guard, const quadsim_fallback *numbers, int horizon, quadsim_real *kept);

/* Restart after a command, or after that of hover where it is unusable: guard->before. */
void quadsim_guard_reset(quadsim_guard *guard, const quadsim_real command[4]);

/* Take over what another contract remembers, its plan where it commands the same; after a reset. */
void quadsim_guard_adopt(quadsim_guard *guard, const quadsim_guard *previous);

/* Complete the state, of which channels that are not measured are not finite.  QUADSIM_FREE: ask the controller;
 * otherwise why it cannot be asked.  The reference is of so many numbers. */
enum quadsim_status quadsim_guard_begin(quadsim_guard *guard, enum quadsim_phase phase, const quadsim_trim *trim,
                                        const quadsim_real state[12], const quadsim_real *reference, int count,
                                        const quadsim_real acting[4]);

/* The controller's status, unless its plan [horizon][4] may not be flown. */
enum quadsim_status quadsim_guard_check(const quadsim_guard *guard, enum quadsim_status status,
                                        const quadsim_real *plan);

/* Whether the attitude was measured; and whether the body rates may be taken: near a pitch of 90 deg, Euler rates are
 * implausibly large, but body rates are not. */
int quadsim_guard_turned(const quadsim_guard *guard);
int quadsim_guard_has_rates(const quadsim_guard *guard);

/* Whether `foreseen` is to be moved on by a period under quadsim_guard_row, as the controller's answer is not flown but
 * its plan may be: by quadsim_guard_foresee, or by a model of the controller's. */
int quadsim_guard_foresees(const quadsim_guard *guard, enum quadsim_phase phase, enum quadsim_status status);
const quadsim_real *quadsim_guard_row(const quadsim_guard *guard);

/* Move it on by the model of level hover, turned to the plan's yaw where `heading`, about rest at these commands. */
void quadsim_guard_foresee(quadsim_guard *guard, int heading, const quadsim_trim *trim, const quadsim_real resting[4]);

/* The command of the period, always finite and within its bounds: the controller's where its status is one that is
 * flown, with its plan [horizon][4], or what is flown instead.  Returns the status of the period. */
enum quadsim_status quadsim_guard_end(quadsim_guard *guard, enum quadsim_phase phase, const quadsim_trim *trim,
                                      enum quadsim_status status, const quadsim_real *plan, quadsim_real command[4]);

/* The plan [horizon][4] of the period that quadsim_guard_end answered last, its command first: the controller's plan,
 * what is left of the last one, that of hover or descent by the model, or on the ground the command, held. */
void quadsim_guard_plan(const quadsim_guard *guard, quadsim_real *plan);

/* Commands within what the bounds on them and on their steps leave after a command; where these leave nothing, within
 * those on the commands. */
void quadsim_guard_clip(const quadsim_fallback *numbers, const quadsim_real *wanted, const quadsim_real *before,
                        quadsim_real *command);

#ifdef __cplusplus
}
#endif

#endif
