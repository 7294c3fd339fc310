/* Estimates of unmodelled force and torque, and of the force's rate of change; equations and sources:
 * quadsim/mpc/estimate/disturbance.py of quadsim.
 *
 * velocity [3]      world axes [m/s]
 * attitude [3][3]   body to world, row by row
 * rates [3]         body axes [rad/s]
 * command [4]       in force now, over the period that ends, or from `share` of it on, up to which the one before was:
 *                   rotor speeds [rad/s]; of targets only command[0], thrust [N]
 *
 * The numbers are read only, and may be shared; all that is remembered is in a quadsim_ramp of the caller's. */
#ifndef QUADSIM_RAMP_H
#define QUADSIM_RAMP_H

#include "quadsim_core.h"

#ifdef __cplusplus
extern "C" {
#endif

#ifdef QUADSIM_FLOAT
#define quadsim_ramp_reset quadsim_ramp_reset_float
#endif

typedef struct quadsim_ramp_numbers {
    int scaled;                              /* whether a vertical misfit scales the thrust */
    int targets;                             /* whether commands are thrusts, and no torque is estimated */
    int moment;                              /* whether the model knows the air's moment */
    quadsim_real period;                     /* [s] */
    quadsim_real mass, gravity;              /* [kg], [m/s^2] */
    quadsim_real least_lift;                 /* vertical specific thrust below which the scale holds [m/s^2] */
    quadsim_real gain[6], gain_of_change[6]; /* of the filters: force, then torque; [1], [1/s] */
    quadsim_real largest[6]; /* estimates: [m/s^2], with `scaled` the third one of scale times gravity; [rad/s^2] */
    quadsim_real inertia[9], inverse[9]; /* J [kg m^2] and its inverse */
    quadsim_real allocation[16];         /* from squared rotor speeds to thrust and torques */
    quadsim_real momentum[4];            /* of each rotor about body z, per speed [kg m^2]; 0 where rotors do not lag */
    quadsim_real share; /* of a period, after which the command of the one before takes over; 0 without delay */
    quadsim_real lag;   /* of rotors, or of the thrust, over the period */
    quadsim_real left, left_before;       /* what is left of a distance after a period's rest, and after that share */
    quadsim_real drag[3], square_drag[3]; /* that the model knows, body axes [1/s], [1/m] */
    quadsim_real across[2], inflow[2], damping[3]; /* the air's moment: of all rotors [N m s^2/(m rad)], of the whole
                                                    * [N m s^2/m^2] and [N m s/rad] */
    quadsim_real loss;           /* of specific thrust, per rotor speed and velocity along body z [s/(m rad) m/s^2] */
    quadsim_real decay, ballast; /* of the fitted drag: share that a period leaves; squared speed [m^2/s^2] */
} quadsim_ramp_numbers;

typedef struct quadsim_ramp {
    int measured;                         /* whether there is a last measurement */
    quadsim_real value[6], change[6];     /* estimates in the middle of the last period, and their rates of change */
    quadsim_real products[3], squares[3]; /* of the fitted drag */
    quadsim_real acting[4];               /* rotor speeds [rad/s], or of targets the thrust [N] */
    quadsim_real command[4];              /* in force at the last measurement */
    quadsim_real velocity[3], rates[3];   /* the last measurement, and at it: */
    quadsim_real axis[3], turning[3];     /* body z and its rate of change, world axes */
    quadsim_real pull[3], resisting[3]; /* known drag [m/s^2], world axes; torque that turns momentum, less the air's */
} quadsim_ramp;

/* Clear the estimates, at rotor speeds acting [4] [rad/s]; of targets only acting[0] counts, the thrust [N]. */
void quadsim_ramp_reset(quadsim_ramp *ramp, const quadsim_ramp_numbers *numbers, const quadsim_real acting[4]);

/* Update the estimates at the end of a period.  Unless the last update was one period ago, it only records the start of
 * the next period. */
void quadsim_ramp_update(quadsim_ramp *ramp, const quadsim_ramp_numbers *numbers, int follows,
                         const quadsim_real velocity[3], const quadsim_real attitude[9], const quadsim_real rates[3],
                         const quadsim_real command[4]);

/* The disturbance `ahead` [s] after the last measurement: acceleration [m/s^2] and its rate of change [m/s^3], world
 * axes; angular acceleration [rad/s^2], body axes. */
void quadsim_ramp_foreseen(const quadsim_ramp *ramp, const quadsim_ramp_numbers *numbers, quadsim_real ahead,
                           quadsim_real force[3], quadsim_real change[3], quadsim_real torque[3]);

/* The thrust that rotors give over the modelled one in the period that follows the last measurement. */
quadsim_real quadsim_ramp_scale(const quadsim_ramp *ramp, const quadsim_ramp_numbers *numbers);

/* Linear drag beyond the model's, body axes [1/s]: the part of the force that follows the velocity. */
void quadsim_ramp_drag(const quadsim_ramp *ramp, const quadsim_ramp_numbers *numbers, quadsim_real drag[3]);

#ifdef __cplusplus
}
#endif

#endif
