/* TinyMPC's generated code, its first state and its targets updated, from its last point. */
extern "C" {
#include "peer.h"
#include "target.h"
#include "tinympc_data.h" /* TARGETS: states that have one; STEP: the unit of inputs [rad/s]; NX, NODES */
}
#undef R
#include "tinympc/admm.hpp"
#include "tinympc/tiny_data.hpp"

extern "C" {
extern void (*const constructors[])(), (*const constructors_end[])();
extern char bss_end[]; /* mps2.ld: the heap grows from here */
void *__dso_handle;     /* named where destructors are registered, which are never called */

void *_sbrk(ptrdiff_t more) /* tells the heap's size */
{
    static char *end = bss_end;
    char *const start = end, line[] = "heap 00000000\n";
    end += more;
    for (size_t i = 0, used = end - bss_end; i < 8; i++, used >>= 4) {
        line[12 - i] = "0123456789abcdef"[used & 15U];
    }
    target_print(line);
    return start;
}

int peer_solve(const double *vectors, double command[4])
{
    const double *const targets = vectors + NX, *const acting = targets + 4 * (NODES - 1);
    static bool constructed;
    for (auto each = constructors; !constructed && each != constructors_end; each++) {
        (*each)();
    }
    constructed = true;
    TinyWorkspace *const work = tiny_solver.work;
    work->x.col(0) = Map<const tinyVector>(vectors, NX);
    for (int i = 0; i < 4 * (NODES - 1); i++) {
        work->Xref(TARGETS[i % 4], i / 4 + 1) = targets[i];
    }
    const int left = solve(&tiny_solver);
    for (int i = 0; i < 4; i++) {
        command[i] = acting[i] + STEP[0] * tiny_solver.solution->u(i, 0);
    }
    return left == 0 ? tiny_solver.solution->iter : -1;
}
}
