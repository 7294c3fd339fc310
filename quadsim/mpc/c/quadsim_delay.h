/* The instant from which a command acts, a known delay after the measurement that it answers.
 *
 * Of the command u(k) of a measurement at t_k, the delay is n whole periods and a part of one, `late`, which is not 0.
 * At t_k the command u(k-1-n) is in force, for that part; u(k-n) .. u(k-1) are under way, and then act for a period
 * each. The state at which u(k) takes over is predicted through all of them, by the rigid body of quadsim_nmpc_model.c.
 *
 * The numbers are read only, and may be shared; what is remembered is in a quadsim_delay of the caller's. */
#ifndef QUADSIM_DELAY_H
#define QUADSIM_DELAY_H

#include "quadsim_nmpc.h"

#ifdef __cplusplus
extern "C" {
#endif

enum {
    QUADSIM_MOST_LATE = 16, /* periods of a delay, at most */
    QUADSIM_MEASURED = 19,  /* numbers of a measured state: 12, quaternion, body rates */
    QUADSIM_MOTION = 17     /* numbers of a sample of a motion: position, quaternion, velocity, body rates, thrusts */
};

typedef struct quadsim_delay_numbers {
    const quadsim_nmpc_problem *late; /* the body over the part of a period for which the command before is in force, */
    const quadsim_nmpc_problem *rest; /* over the rest of the period, NULL for none, */
    const quadsim_nmpc_problem *whole; /* and over a period; sizes, step, substeps and lags count */
    int under_way;                     /* n */
    quadsim_real share;                /* late, as a share of the period */
    quadsim_real delay;                /* [s] */
    quadsim_real coefficient;          /* mean thrust of a rotor over its squared speed [N s^2] */
    quadsim_real scale[4];             /* targets that are shares of 1 */
} quadsim_delay_numbers;

typedef struct quadsim_delay {
    quadsim_real before[4];                   /* the command in force up to `late` after the last measurement */
    quadsim_real sent[QUADSIM_MOST_LATE][4];  /* [n + 1] commands in force and under way, oldest first */
    quadsim_real rotors[4], rotors_before[4]; /* shares that actuators have reached at this measurement, and the last */
} quadsim_delay;

/* Restart after a command, which acts, with actuators there. */
void quadsim_delay_reset(quadsim_delay *delay, const quadsim_delay_numbers *numbers, const quadsim_real command[4]);

/* Take note of the command that was sent last, so many periods after the measurement before; none: actuators stay. */
void quadsim_delay_send(quadsim_delay *delay, const quadsim_delay_numbers *numbers, int periods,
                        const quadsim_real command[4]);

/* The state [13 and actuators] at the present measurement that the last one leads to. */
void quadsim_delay_expect(const quadsim_delay *delay, const quadsim_delay_numbers *numbers,
                          const quadsim_nmpc_world *world, const quadsim_real *last, quadsim_real *expected);

/* The state [13 and actuators] when this period's command takes over, of the one that is measured. */
void quadsim_delay_predict(const quadsim_delay *delay, const quadsim_delay_numbers *numbers,
                           const quadsim_nmpc_world *world, const quadsim_real *measured, quadsim_real *ahead);

/* Row `row` of a motion [][17] as it is the delay later. */
void quadsim_delay_sample(const quadsim_delay_numbers *numbers, quadsim_real period, const quadsim_real *motion,
                          int row, quadsim_real sample[QUADSIM_MOTION]);

#ifdef __cplusplus
}
#endif

#endif
