/* Coloured noise, in place of white samples w:  x_k = pole x_{k-1} + w_k. */
#include "quadsim_noise.h"

void quadsim_first_order(double pole, double before, int64_t count, double *samples)
{
    for (int64_t k = 0; k < count; k++) {
        samples[k] = before = pole * before + samples[k];
    }
}
