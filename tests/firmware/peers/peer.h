/* What peer.c and the solvers beside it share: min 1/2 x'Hx + c'x, LOWER <= [x; G x + shift] <= UPPER. */
#ifndef PEER_H
#define PEER_H

#ifdef PEER_FLOAT
typedef float real;
#define R(number) number##F
#else
typedef double real;
#define R(number) number
#endif

/* The command of one period, the first four of x, from what changes; the iterations taken, negative without an optimum.
 * vectors: c (or the optimum without rows, see VECTORS in the problem's header) and then the shift. */
int peer_solve(const real *vectors, real command[4]);

#endif
