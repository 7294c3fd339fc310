/* Nonlinear model predictive control of quadrotors at any attitude: the controller around quadsim_nmpc.h.
 *
 * Once every period, call quadsim_nonlinear_step with what is measured now; hold the command until the next call.
 *
 * state [19]        position, velocity, Euler angles and their rates in the order of quadsim_guard.h [12]; the
 *                   attitude as a quaternion w x y z, body to world [4], and body rates [3] [rad/s], each derived
 *                   from the angles and their rates where it is not finite
 * reference         previews [rows][4]: x y z yaw [m, rad], where to be one period from now, two, ... N periods from
 *                   now; whole turns of yaw make no difference.  Motions [rows + 1][17], now and then the same:
 *                   position, quaternion, velocity, body rates, and thrusts of the rotors [N]; with a delay of n
 *                   periods and a part of one, n + 1 rows more
 * acting [4]        the command before, in force up to now
 * command [4]       rotor speeds [rad/s], or targets of an inner loop: thrust [N] and body rates [rad/s]
 *
 * A controller's numbers are a quadsim_nonlinear_numbers, which is read only and may be shared.  All that a controller
 * remembers is in a quadsim_nonlinear and its memory of quadsim_nonlinear_reals(numbers) reals and
 * quadsim_nonlinear_ints(numbers) ints, all of the caller's. */
#ifndef QUADSIM_NONLINEAR_H
#define QUADSIM_NONLINEAR_H

#include "quadsim_delay.h"
#include "quadsim_guard.h"
#include "quadsim_nmpc.h"
#include "quadsim_ramp.h"

#ifdef __cplusplus
extern "C" {
#endif

enum { QUADSIM_PREVIEW = 4 };

typedef struct quadsim_nonlinear_numbers {
    const quadsim_nmpc_problem *problem;  /* the program */
    const quadsim_nmpc_problem *period;   /* its body over a control period: sizes, step, substeps and lags count */
    const quadsim_nmpc_problem *unlagged; /* the same without lag of thrusts, for plans */
    const quadsim_fallback *fallback;     /* NULL where quadsim guards: quadsim_nonlinear_step is not for it */
    const quadsim_delay_numbers *delay;   /* NULL where commands act at once */
    const quadsim_ramp_numbers *ramp;     /* NULL where no changing force is followed */
    int stride;                           /* control periods from node to node */
    int motion;                           /* whether references are motions */
    int observes;                         /* whether disturbances are estimated as constant */
    quadsim_real control_period;          /* [s] */
    quadsim_real mass;                    /* [kg] */
    quadsim_real coefficient;             /* mean thrust of a rotor over its squared speed [N s^2] */
    quadsim_real left;                    /* of actuators' distance from the command after a control period */
    quadsim_real scale[4];                /* targets that are shares of 1 */
    quadsim_real level[4], lifts[4];      /* the command of level hover, and rotors' thrusts there [N] */
    quadsim_real inverse[16];             /* from T [m/s^2] and I^-1 tau to rotors' thrusts [N] */
    quadsim_real drag[3], square_drag[3]; /* over the mass, body axes [1/s], [1/m] */
    quadsim_real gain[6], largest[6];     /* of the observer; of its estimate */
    quadsim_real least_lift;              /* least thrust at rest as a share of the weight */
    quadsim_real plausible;               /* largest magnitude of a number that is taken for a measurement */
    quadsim_real infeasible;              /* violation of a row that a plan may have */
} quadsim_nonlinear_numbers;

/* A controller.  Read guard.level, work.changes and plan [rows][4], the last optimum as commands; the rest is its own.
 */
typedef struct quadsim_nonlinear {
    const quadsim_nonlinear_numbers *numbers;
    quadsim_nmpc_work work;
    quadsim_nmpc_world world;
    quadsim_guard guard;
    quadsim_trim trim;
    quadsim_real *states, *thrusts; /* [nodes + 1][13], [nodes][4] of the reference */
    quadsim_real *plan, *kept;      /* [rows][4], the second of the guard */
    quadsim_real measured[QUADSIM_NMPC_MOST];
    quadsim_real before[4];                   /* shares of the command in force */
    quadsim_real rotors[4], rotors_before[4]; /* shares that actuators have reached now, and a period ago */
    int called;                               /* whether they were followed in the call before */
    int turned;                               /* whether `quaternion` is known, the last one measured */
    quadsim_real quaternion[4], side;         /* side of the reference's quaternions: 1 or -1 */
    int headed;                               /* whether a heading has been followed */
    quadsim_real heading; /* the reference's one period from now, on the turn that is followed [rad] */
    int learns;           /* whether `last` is known, the state of the last period */
    quadsim_real last[QUADSIM_NMPC_MOST];
    quadsim_real estimate[6]; /* disturbance: world [m/s^2], body [rad/s^2] */
    quadsim_ramp ramp;        /* one that changes */
    quadsim_delay delay;      /* commands under way; then `measured` is the state when the next one takes over */
    quadsim_real ahead[QUADSIM_NMPC_BODY + 1]; /* where the guard's plan leads, */
    quadsim_nmpc_world then;                   /* in the world as it was known when the plan was first needed */
} quadsim_nonlinear;

long quadsim_nonlinear_reals(const quadsim_nonlinear_numbers *numbers);
long quadsim_nonlinear_ints(const quadsim_nonlinear_numbers *numbers);

/* A controller in memory of the caller's, after the command of hover. */
void quadsim_nonlinear_start(quadsim_nonlinear *law, const quadsim_nonlinear_numbers *numbers, quadsim_real *reals,
                             int *ints);

/* Restart after a command, which acts. */
void quadsim_nonlinear_reset(quadsim_nonlinear *law, const quadsim_real command[4]);

/* Start from an estimate of the disturbance; without an observer nothing changes. */
void quadsim_nonlinear_learn(quadsim_nonlinear *law, const quadsim_real estimate[6]);

/* Pass a period on the ground, where no disturbance shows and no plan is flown; `periods` as of _begin. */
void quadsim_nonlinear_stand(quadsim_nonlinear *law, int periods, const quadsim_real acting[4]);

/* Take a measurement, `periods` after the call before, and a reference: law->measured, before, states, thrusts and
 * world are the query then, which quadsim_nmpc_step answers.  0 where numbers are not plausible.
 *
 * Attitude and body rates may be NULL; `flying`: the ground does not hold the vehicle, so that its motion shows a
 * disturbance; `motion`: the reference is one, no preview. */
int quadsim_nonlinear_begin(quadsim_nonlinear *law, int periods, int flying, int motion, const quadsim_real state[12],
                            const quadsim_real *attitude, const quadsim_real *rates, const quadsim_real *reference,
                            const quadsim_real acting[4]);

/* law->plan of the program's answer, and the period's status. */
enum quadsim_status quadsim_nonlinear_end(quadsim_nonlinear *law, enum quadsim_nmpc_status answer);

/* The command of the period that starts now, always finite and within its bounds: the controller's, or without one what
 * the fallback contract flies instead (quadsim_guard.h).  Channels that are not measured are not finite. */
enum quadsim_status quadsim_nonlinear_step(quadsim_nonlinear *law, enum quadsim_phase phase,
                                           const quadsim_real state[QUADSIM_MEASURED], const quadsim_real *reference,
                                           const quadsim_real acting[4], quadsim_real command[4]);

#ifdef __cplusplus
}
#endif

#endif
