/* The numbers of a controller of @LAW@.h, exported from quadsim.
 *
 *     @TITLE@
 *
 * Include it in one source file: each has numbers of its own.  Its period is @PERIOD@ s.
 *
 *     static quadsim_law law;
 *     static quadsim_memory memory;
 *     quadsim_law_start(&law, &memory);
 */
#ifndef QUADSIM_DATA_H
#define QUADSIM_DATA_H

#include <stddef.h>

#include "@LAW@.h"

#@IFN@ QUADSIM_FLOAT
#error "this export is of @PRECISION@s: compile all of its files with QUADSIM_FLOAT defined for floats alone"
#endif

#define QUADSIM_HORIZON @HORIZON@ /* N, periods of the plan */
#define QUADSIM_STATE @STATE@ /* numbers of a measured state */
#define QUADSIM_ROWS @ROWS@ /* rows of a reference, */
#define QUADSIM_ROW @ROW@ /* of so many numbers each: @REFERENCE@ */
#define QUADSIM_MEMORY @MEMORY@ /* numbers of memory, @LAW@_reals(&QUADSIM_CONTROLLER) */

@NUMBERS@

/* ---- the controller, by names that all exports share -------------------------------------------------------------- */

typedef @LAW@ quadsim_law;

typedef struct quadsim_memory {
    quadsim_real reals[QUADSIM_MEMORY];
@INTS@} quadsim_memory;

/* Whether the memory is as much as the controller needs. */
static inline int quadsim_law_fits(void)
{
    return @FITS@;
}

static inline void quadsim_law_start(quadsim_law *law, quadsim_memory *memory)
{
    @LAW@_start(law, &QUADSIM_CONTROLLER, memory->reals@MORE@);
}

static inline void quadsim_law_reset(quadsim_law *law, const quadsim_real command[4])
{
    @LAW@_reset(law, command);
}

static inline enum quadsim_status quadsim_law_step(quadsim_law *law, enum quadsim_phase phase,
                                                   const quadsim_real state[QUADSIM_STATE],
                                                   const quadsim_real *reference, const quadsim_real acting[4],
                                                   quadsim_real command[4])
{
    return @LAW@_step(law, phase, state, reference, acting, command);
}

/* The last optimum [N][4], as commands. */
static inline const quadsim_real *quadsim_law_plan(const quadsim_law *law)
{
    return @PLAN@;
}

/* Changes of the active set in the last step. */
static inline int quadsim_law_changes(const quadsim_law *law)
{
    return @CHANGES@;
}

#endif
