/* DAQP's own files on the QP's least-distance form around the optimum without rows, from its last working set. */
#include <stddef.h>
#include <string.h>

#include "daqp.h"
#include "auxiliary.h"
#include "peer.h"
#include "daqp_data.h" /* ROOT_INVERSE, ROWS, SCALING, LOWER, UPPER of sizes SIZE, COUNT, BOXED */

static c_float upper[COUNT], lower[COUNT], product[COUNT - BOXED], multipliers[SIZE + 1], stationary[SIZE + 1];
static c_float diagonal[SIZE + 1], x_l[SIZE + 1], z_l[SIZE + 1], u[SIZE], factor[(SIZE + 1) * (SIZE + 2) / 2];
static int sense[COUNT], working[SIZE + 1];

static DAQPSettings settings = {
#ifdef PEER_FLOAT
    .primal_tol = 1e-6, .dual_tol = 1e-7, .zero_tol = 1e-6, .pivot_tol = 1e-4, .progress_tol = 1e-6, .sing_tol = 1e-6,
    .refactor_tol = 1e-6,
#else
    .primal_tol = 1e-9, .dual_tol = DAQP_DEFAULT_DUAL_TOL, .zero_tol = DAQP_DEFAULT_ZERO_TOL,
    .pivot_tol = DAQP_DEFAULT_PIVOT_TOL, .progress_tol = DAQP_DEFAULT_PROG_TOL, .sing_tol = DAQP_DEFAULT_SING_TOL,
    .refactor_tol = DAQP_DEFAULT_REFACTOR_TOL,
#endif
    .cycle_tol = DAQP_DEFAULT_CYCLE_TOL, .iter_limit = 2000, .fval_bound = DAQP_INF,
    .rho_soft = DAQP_DEFAULT_RHO_SOFT, .eps_prox = 0, .time_limit = 0,
};

static DAQPWorkspace work = {
    .n = SIZE, .m = COUNT, .ms = BOXED, .M = (c_float *)ROWS, .dupper = upper, .dlower = lower,
    .Rinv = (c_float *)ROOT_INVERSE, .sense = sense, .scaling = (c_float *)SCALING, .x = u, .lam = multipliers,
    .lam_star = stationary, .u = u, .L = factor, .D = diagonal, .xldl = x_l, .zldl = z_l, .WS = working,
    .sing_ind = DAQP_EMPTY_IND, .settings = &settings, .Mu = product,
};

int peer_solve(const real *vectors, real command[4])
{
    const real *free = vectors, *shift = vectors + SIZE; /* the optimum without rows, and G free + shift */
    int i, j, found;
    for (i = 0; i < COUNT; i++) {
        const real value = i < BOXED ? free[i] : shift[i - BOXED];
        upper[i] = (UPPER[i] - value) * SCALING[i];
        lower[i] = (LOWER[i] - value) * SCALING[i];
    }
    work.reuse_ind = 0;
    found = daqp_ldp(&work);
    if (found != DAQP_EXIT_OPTIMAL) {
        memset(sense, 0, sizeof sense);
        reset_daqp_workspace(&work);
    }
    for (i = 0; i < 4; i++) {
        real sum = R(0.0);
        for (j = i; j < SIZE; j++) {
            sum += ROOT_INVERSE[DAQP_R_OFFSET(i, SIZE) + j] * u[j];
        }
        command[i] = free[i] + sum / SCALING[i];
    }
    return found == DAQP_EXIT_OPTIMAL ? work.iterations : -1;
}
