/* A model predictive controller of a quadrotor, exported from quadsim.
 *
 *     @TITLE@
 *
 * Once every @PERIOD@ s, call quadsim_mpc_step with what is measured now; hold the command until the next call.
 *
 * state [12]       x vx y vy z vz roll roll_rate pitch pitch_rate yaw yaw_rate
 *                  [m, m/s, rad, rad/s]: world axes with z up; Z-Y-X Euler angles, body to world, and their rates
 * reference [N*4]  x y z yaw [m, rad], where to be one period from now, two, ... N periods from now
 * acting [4]       command in force up to now, u(k-1) [rad/s]
 * command [4]      rotor speeds to hold for the period [rad/s], rotors in the vehicle file's order
 *
 * Nothing is allocated and nothing is shared: all that a controller remembers is in its struct, which the caller owns
 * and resets before the first step.  Two structs are two controllers.
 */
#ifndef QUADSIM_MPC_H
#define QUADSIM_MPC_H

#ifdef __cplusplus
extern "C" {
#endif

typedef @REAL@ quadsim_real;

@SIZES@

/* How a command was found.  The first three are the optimum; the others are fallbacks where there is none, or none
 * was found, in this order. */
enum quadsim_status {
    QUADSIM_FREE = 0,    /* the optimum without constraints keeps them all */
    QUADSIM_AXES = 1,    /* the optimum with rows of states alone, axis by axis, keeps all others */
    QUADSIM_WHOLE = 2,   /* the optimum of the whole problem */
    QUADSIM_CLIPPED = 3, /* the axes' optimum, clipped to what the bounds on rotor speeds and their steps leave */
    QUADSIM_SHIFTED = 4, /* what the last optimum planned for now, clipped likewise */
    QUADSIM_BEFORE = 5   /* the command before */
};

/* A controller.  Read changes and plan; the rest is its own. */
typedef struct quadsim_mpc {
    int changes;                                                 /* of the active set in the last step */
    quadsim_real plan[QUADSIM_HORIZON * 4];                      /* the last optimum [rad/s] */
    int age;                                                     /* periods since then; negative: there is none yet */
    quadsim_real before[4];                                      /* the last command [rad/s] */
    signed char last[QUADSIM_STEP_ROWS * QUADSIM_HORIZON];       /* active set of the last step */
    signed char side[QUADSIM_STEP_ROWS * QUADSIM_HORIZON];       /* and of this one: see quadsim_mpc.c */
    quadsim_real value[QUADSIM_STEP_ROWS * QUADSIM_HORIZON];     /* of each row at the free optimum */
    quadsim_real shift[QUADSIM_STEP_ROWS * QUADSIM_HORIZON];     /* by which the multipliers change it */
    quadsim_real w[QUADSIM_HORIZON * 4];                         /* the free optimum in the axes' inputs */
    quadsim_real dw[QUADSIM_HORIZON * 4];                        /* by which the multipliers change it */
    quadsim_real u[QUADSIM_HORIZON * 4];                         /* rotor speeds, or changes of them [rad/s] */
    quadsim_real pull[QUADSIM_HORIZON * QUADSIM_AXIS_STATES];    /* linear terms of an axis's states */
    quadsim_real push[QUADSIM_HORIZON * QUADSIM_AXIS_INPUTS];    /* and inputs */
    int count;                                                   /* active rows */
    int spent;                                                   /* changes of the active set in this search */
    int solved;                                                  /* of them, those whose forward is up to date */
    int passed_over;                                             /* a row that comes and goes within rounding, or -1 */
    quadsim_real slack;                                          /* by which tolerances are relaxed */
    quadsim_real largest;                                        /* multiplier, as of rows of unit length */
    short row[QUADSIM_ROOM];                                     /* which they are */
    quadsim_real z[QUADSIM_ROOM];                                /* their multipliers */
    quadsim_real goal[QUADSIM_ROOM];                             /* the multipliers that their bounds require */
    quadsim_real forward[QUADSIM_ROOM];                          /* L^-1 of the right side */
    quadsim_real pivot[QUADSIM_ROOM];                            /* D of L D L' */
    quadsim_real factor[QUADSIM_ROOM * (QUADSIM_ROOM + 1) / 2]; /* L, row by row, below its diagonal of ones */
@STATE@} quadsim_mpc;

/* Restart after the command u(-1) [rad/s]. */
void quadsim_mpc_reset(quadsim_mpc *mpc, const quadsim_real speeds[4]);

/* The command of the period that starts now, always finite and within the bounds on rotor speeds. */
enum quadsim_status quadsim_mpc_step(quadsim_mpc *mpc, const quadsim_real state[12], const quadsim_real *reference,
                                     const quadsim_real acting[4], quadsim_real command[4]);

#ifdef __cplusplus
}
#endif

#endif
