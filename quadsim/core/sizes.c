/* sizeof the structs that Python mirrors; see check_sizes in quadsim/core/library.py. */
#include <stddef.h>

#include "quadsim_plant.h"

#define SIZE(type) extern const size_t type##_size; const size_t type##_size = sizeof(type)

SIZE(quadsim_vehicle);
SIZE(quadsim_inner);
SIZE(quadsim_sensor);
SIZE(quadsim_steps);
SIZE(quadsim_sensing);
SIZE(quadsim_filter);
SIZE(quadsim_track);
SIZE(quadsim_sample);
