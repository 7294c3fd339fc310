/* The numbers of a controller of quadsim_mpc.h, exported from quadsim.
 *
 *     @TITLE@
 *
 * Include it in one source file: each has numbers of its own.  Its period is @PERIOD@ s.
 *
 *     static quadsim_mpc mpc;
 *     static quadsim_real memory[QUADSIM_MEMORY];
 *     quadsim_mpc_start(&mpc, &QUADSIM_CONTROLLER, memory);
 */
#ifndef QUADSIM_DATA_H
#define QUADSIM_DATA_H

#include <stddef.h>

#include "quadsim_mpc.h"

#@IFN@ QUADSIM_FLOAT
#error "this export is of @PRECISION@s: compile all of its files with QUADSIM_FLOAT defined for floats alone"
#endif

#define QUADSIM_HORIZON @HORIZON@ /* N, periods of the reference and of the plan */
#define QUADSIM_MEMORY @MEMORY@ /* numbers of memory, quadsim_mpc_reals(&QUADSIM_CONTROLLER) */

@NUMBERS@

#endif
