/* sizeof the structs that Python mirrors; see check_sizes in quadsim/core/library.py. */
#include <stddef.h>

#include "quadsim_geometric.h"
#include "quadsim_mpc.h"
#include "quadsim_nonlinear.h"
#include "quadsim_ramp.h"

#define SIZE(type) extern const size_t type##_size; const size_t type##_size = sizeof(type)

SIZE(quadsim_axis);
SIZE(quadsim_row);
SIZE(quadsim_term);
SIZE(quadsim_problem);
SIZE(quadsim_work);
SIZE(quadsim_robust);
SIZE(quadsim_controller);
SIZE(quadsim_trim);
SIZE(quadsim_guard);
SIZE(quadsim_mpc);
SIZE(quadsim_nmpc_term);
SIZE(quadsim_nmpc_problem);
SIZE(quadsim_nmpc_world);
SIZE(quadsim_nmpc_work);
SIZE(quadsim_nonlinear_numbers);
SIZE(quadsim_nonlinear);
SIZE(quadsim_ramp_numbers);
SIZE(quadsim_ramp);
SIZE(quadsim_geometric_numbers);
SIZE(quadsim_geometric_motion);
SIZE(quadsim_geometric_target);
SIZE(quadsim_geometric_disturbance);
SIZE(quadsim_geometric_attitude);
SIZE(quadsim_geometric);
