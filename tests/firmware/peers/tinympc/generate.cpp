/* TinyMPC's own set-up and code generation, on this machine: writes into argv[1] and prints its terminal weight. */
#include <cstdio>

#include "peer.h"
#include "tinympc_problem.h" /* A, B, the weights' diagonals, bounds by columns; SETTINGS: rho, tolerance, iterations */
#undef R
#include "codegen.hpp"
#include "tiny_api.hpp"

static tinyMatrix matrix(const double *entries, int rows, int columns)
{
    return Map<const tinyMatrix>(entries, rows, columns);
}

int main(int, char **argv)
{
    TinySolver *solver;
    if (tiny_setup(&solver, matrix(A, NX, NX), matrix(B, NX, NU), matrix(STATE_WEIGHTS, NX, 1).asDiagonal(),
                   matrix(INPUT_WEIGHTS, NU, 1).asDiagonal(), SETTINGS[0], NX, NU, NODES, matrix(X_MIN, NX, NODES),
                   matrix(X_MAX, NX, NODES), matrix(U_MIN, NU, NODES - 1), matrix(U_MAX, NU, NODES - 1), 0) != 0) {
        return 1;
    }
    solver->settings->abs_pri_tol = solver->settings->abs_dua_tol = SETTINGS[1];
    solver->settings->max_iter = (int)SETTINGS[2];
    solver->cache->C1 = tinyMatrix::Zero(NX, NX); /* unused; as it is, the generator reads beyond its end */
    for (int i = 0; i < NX * NX; i++) {
        std::printf("%.17g\n", solver->cache->Pinf(i));
    }
    return tiny_codegen(solver, argv[1], 0);
}
