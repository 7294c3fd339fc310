/* sizeof the structs that Python mirrors; see check_sizes in quadsim/core/library.py. */
#include <stddef.h>

#include "quadsim_mpc.h"

#define SIZE(type) extern const size_t type##_size; const size_t type##_size = sizeof(type)

SIZE(quadsim_axis);
SIZE(quadsim_row);
SIZE(quadsim_term);
SIZE(quadsim_problem);
SIZE(quadsim_work);
SIZE(quadsim_robust);
SIZE(quadsim_controller);
SIZE(quadsim_guard);
SIZE(quadsim_mpc);
