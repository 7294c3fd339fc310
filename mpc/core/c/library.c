/* What Python loads: the core and the controllers as one unit, of which sources they are, and how large the structs are
 * that Python mirrors. */
#include "quadsim_core.c"
#include "quadsim_mpc.c"

#ifndef QUADSIM_SOURCE
#define QUADSIM_SOURCE ""
#endif

const char *quadsim_library_source(void)
{
    return QUADSIM_SOURCE;
}

/* sizeof the structs, in the order of MIRRORS in mpc/core/library.py. */
void quadsim_library_sizes(size_t *sizes)
{
    sizes[0] = sizeof(quadsim_axis);
    sizes[1] = sizeof(quadsim_row);
    sizes[2] = sizeof(quadsim_term);
    sizes[3] = sizeof(quadsim_problem);
    sizes[4] = sizeof(quadsim_work);
    sizes[5] = sizeof(quadsim_robust);
    sizes[6] = sizeof(quadsim_controller);
    sizes[7] = sizeof(quadsim_mpc);
}
