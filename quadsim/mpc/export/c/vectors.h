/* Recorded periods of the scenario's flight: the controller's inputs, and the exact answers. */
#ifndef QUADSIM_VECTORS_H
#define QUADSIM_VECTORS_H

#include "@LAW@.h"

#ifdef __cplusplus
extern "C" {
#endif

#define QUADSIM_VECTORS @COUNT@
#define QUADSIM_VECTORS_ROWS @PATH@
#ifdef QUADSIM_FLOAT
#define QUADSIM_VECTORS_TOLERANCE @FLOAT_TOLERANCE@F /* of a command from the exact optimum */
#define QUADSIM_VECTORS_ANY_OPTIMUM 1   /* whether all statuses of an optimum count as one */
#else
#define QUADSIM_VECTORS_TOLERANCE @DOUBLE_TOLERANCE@
#define QUADSIM_VECTORS_ANY_OPTIMUM 0
#endif

struct quadsim_vector {
    quadsim_real state[@STATE@];  /* measured */
    quadsim_real acting[4];  /* command in force */
    quadsim_real command[4]; /* first command of the exact optimum; the command in force where there is none */
    int status;              /* enum quadsim_status; QUADSIM_PRIMAL_INFEASIBLE for all that are no optimum */
};

extern const int quadsim_vectors_count;
extern const quadsim_real quadsim_vectors_before[4]; /* command before the first */
extern const quadsim_real quadsim_vectors_path[QUADSIM_VECTORS_ROWS][@ROW@]; /* period k's reference begins at row k */
extern const struct quadsim_vector quadsim_vectors[QUADSIM_VECTORS];

#ifdef __cplusplus
}
#endif

#endif
