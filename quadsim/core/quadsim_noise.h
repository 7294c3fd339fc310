/* Coloured noise: white noise behind a first-order filter, as turbulence is made of (`quadsim.sim.effects.turbulence`).
 */
#ifndef QUADSIM_NOISE_H
#define QUADSIM_NOISE_H

#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

/* y(k) = pole y(k-1) + drive(k), from y = `before` on: samples [count], which come in as the drive. */
void quadsim_first_order(double pole, double before, int64_t count, double *samples);

#ifdef __cplusplus
}
#endif

#endif
