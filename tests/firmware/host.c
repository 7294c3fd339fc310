/* What tests call by ctypes: one controller of an export, its questions and answers in arrays of doubles. */
#include "quadsim_data.h"

#include <stddef.h>

typedef struct host {
    quadsim_law law;
    quadsim_memory memory;
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
    *right = quadsim_law_fits();
    return sizeof(host);
}

void host_reset(host *at, const double *before)
{
    quadsim_real start[4];
    convert(start, before, 4);
    quadsim_law_start(&at->law, &at->memory);
    quadsim_law_reset(&at->law, start);
}

/* Inputs: state, acting [4], phase, reference.  Answered: status, fallback, changes, command [4], the law's plan
 * [N][4], the guard's plan [N][4]. */
void host_step(host *at, const double *inputs, double *answers)
{
    quadsim_real state[QUADSIM_STATE], acting[4], reference[QUADSIM_ROWS * QUADSIM_ROW], command[4];
    quadsim_real plan[QUADSIM_HORIZON * 4];
    const double *rest = inputs + QUADSIM_STATE;
    int i;
    convert(state, inputs, QUADSIM_STATE);
    convert(acting, rest, 4);
    convert(reference, rest + 5, QUADSIM_ROWS * QUADSIM_ROW);
    answers[0] = (double)quadsim_law_step(&at->law, (enum quadsim_phase)rest[4], state, reference, acting, command);
    answers[1] = (double)at->law.guard.level;
    answers[2] = (double)quadsim_law_changes(&at->law);
    for (i = 0; i < 4; i++) {
        answers[3 + i] = (double)command[i];
    }
    quadsim_guard_plan(&at->law.guard, plan);
    for (i = 0; i < QUADSIM_HORIZON * 4; i++) {
        answers[7 + i] = (double)quadsim_law_plan(&at->law)[i];
        answers[7 + QUADSIM_HORIZON * 4 + i] = (double)plan[i];
    }
}
