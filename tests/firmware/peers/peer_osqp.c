/* OSQP's generated code, its vectors updated. */
#include "osqp.h"
#include "peer.h"
#include "osqp_data.h" /* LOWER, UPPER of sizes SIZE, COUNT */
#include "workspace.h"

int peer_solve(const real *vectors, real command[4])
{
    static real lower[COUNT], upper[COUNT];
    int i;
    for (i = 0; i < COUNT; i++) {
        const real value = i < SIZE ? R(0.0) : vectors[i];
        lower[i] = LOWER[i] - value;
        upper[i] = UPPER[i] - value;
    }
    (void)osqp_update_data_vec(&solver, vectors, lower, upper);
    (void)osqp_solve(&solver);
    for (i = 0; i < 4; i++) {
        command[i] = solver.solution->x[i];
    }
    return solver.info->status_val == OSQP_SOLVED ? (int)solver.info->iter : -1;
}
