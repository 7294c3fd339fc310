/* Recorded periods of the scenario's flight: the controller's inputs, and the exact answers. */
#ifndef QUADSIM_VECTORS_H
#define QUADSIM_VECTORS_H

#include "quadsim_mpc.h"

#ifdef __cplusplus
extern "C" {
#endif

#define QUADSIM_VECTORS @COUNT@
#define QUADSIM_VECTORS_ROWS @ROWS@
#ifdef QUADSIM_FLOAT
#define QUADSIM_VECTORS_TOLERANCE 6e-2F /* [rad/s] of a command from the exact optimum */
#define QUADSIM_VECTORS_ANY_OPTIMUM 1   /* whether the first three statuses count as one */
#else
#define QUADSIM_VECTORS_TOLERANCE 1e-8
#define QUADSIM_VECTORS_ANY_OPTIMUM 0
#endif

struct quadsim_vector {
    quadsim_real state[12];  /* measured */
    quadsim_real acting[4];  /* command in force [rad/s] */
    quadsim_real command[4]; /* first command of the exact optimum; the command in force where there is none [rad/s] */
    int status;              /* enum quadsim_status; QUADSIM_PRIMAL_INFEASIBLE for all that are no optimum */
};

extern const int quadsim_vectors_count;
extern const quadsim_real quadsim_vectors_speeds[4];                    /* command before the first [rad/s] */
extern const quadsim_real quadsim_vectors_path[QUADSIM_VECTORS_ROWS][4]; /* period k's reference begins at row k */
extern const struct quadsim_vector quadsim_vectors[QUADSIM_VECTORS];

#ifdef __cplusplus
}
#endif

#endif
