/* What tests call by ctypes: one controller of an export, its questions and answers in arrays of doubles. */
#include "quadsim_data.h"

#include <stddef.h>

typedef struct host {
    quadsim_mpc mpc;
    quadsim_real memory[QUADSIM_MEMORY];
} host;

static void convert(quadsim_real *to, const double *from, int count)
{
    int i;
    for (i = 0; i < count; i++) {
        to[i] = (quadsim_real)from[i];
    }
}

/* Bytes of a controller, and whether its memory is as much as it needs. */
size_t host_size(int *right)
{
    *right = quadsim_mpc_reals(&QUADSIM_CONTROLLER) == QUADSIM_MEMORY;
    return sizeof(host);
}

void host_reset(host *at, const double *speeds)
{
    quadsim_real start[4];
    convert(start, speeds, 4);
    quadsim_mpc_start(&at->mpc, &QUADSIM_CONTROLLER, at->memory);
    quadsim_mpc_reset(&at->mpc, start);
}

/* Inputs: state [12], acting [4], phase, reference [N][4].  Answered: status, fallback, changes, command [4],
 * plan [N][4]. */
void host_step(host *at, const double *inputs, double *answers)
{
    quadsim_real state[12], acting[4], reference[QUADSIM_HORIZON * 4], command[4];
    int i;
    convert(state, inputs, 12);
    convert(acting, inputs + 12, 4);
    convert(reference, inputs + 17, QUADSIM_HORIZON * 4);
    answers[0] = (double)quadsim_mpc_step(&at->mpc, (enum quadsim_phase)inputs[16], state, reference, acting, command);
    answers[1] = (double)at->mpc.guard.level;
    answers[2] = (double)at->mpc.work.changes;
    for (i = 0; i < 4; i++) {
        answers[3 + i] = (double)command[i];
    }
    for (i = 0; i < QUADSIM_HORIZON * 4; i++) {
        answers[7 + i] = (double)at->mpc.work.plan[i];
    }
}
