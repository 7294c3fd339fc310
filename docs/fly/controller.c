/* An exported controller as a WebAssembly module: the page exchanges numbers with it and never sees its structs. */
#include "quadsim_data.h"

static quadsim_mpc mpc;
static quadsim_problem problem;
static quadsim_controller controller;
static quadsim_real memory[QUADSIM_MEMORY], lower[BOUNDS + 1], upper[BOUNDS + 1];
static struct {
    double state[12], acting[4], command[4], reference[QUADSIM_HORIZON * 4];
} exchange;

/* Move the bounds on roll and pitch, the only rows with states, outwards from the exported ones by an angle [rad]. */
void widen(double angle)
{
    const quadsim_problem *exported = QUADSIM_CONTROLLER.problem;
    int i;
    for (i = 0; i < BOUNDS; i++) {
        const double change = exported->rows[i % exported->step_rows].axis >= 0 ? angle : 0.0;
        lower[i] = exported->lower[i] - change;
        upper[i] = exported->upper[i] + change;
    }
}

double *start(void)
{
    problem = *QUADSIM_CONTROLLER.problem;
    problem.lower = lower;
    problem.upper = upper;
    controller = QUADSIM_CONTROLLER;
    controller.problem = &problem;
    widen(0.0);
    quadsim_mpc_start(&mpc, &controller, memory);
    return exchange.state;
}

int horizon(void)
{
    return QUADSIM_HORIZON;
}
int changes(void)
{
    return mpc.work.changes;
}
void reset(void)
{
    quadsim_mpc_reset(&mpc, exchange.acting);
}
int step(void)
{
    return (int)quadsim_mpc_step(&mpc, QUADSIM_PHASE_FLYING, exchange.state, exchange.reference, exchange.acting,
                                 exchange.command);
}

/* All that the exported code needs from a C library. */
void *memcpy(void *restrict to, const void *restrict from, size_t bytes)
{
    char *target = to;
    const char *source = from;
    while (bytes-- > 0) {
        *target++ = *source++;
    }
    return to;
}

void *memset(void *to, int value, size_t bytes)
{
    char *target = to;
    while (bytes-- > 0) {
        *target++ = (char)value;
    }
    return to;
}
