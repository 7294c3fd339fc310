/* Coloured noise. */
#include "quadsim_noise.h"

void quadsim_first_order(double pole, double before, int64_t count, double *samples)
{
    for (int64_t k = 0; k < count; k++) {
        samples[k] = before = pole * before + samples[k];
    }
}
