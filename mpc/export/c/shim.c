/* What Python calls: one controller, its questions and answers in two arrays. */
#include "quadsim_mpc.c"

#include <stddef.h>

size_t quadsim_shim_size(void)
{
    return sizeof(quadsim_mpc);
}

/* Active rows of the last optimum, and the most by which it leaves a soft bound. */
static void put_active(const quadsim_mpc *mpc, double *answers)
{
    int row;
    answers[2] = answers[3] = 0.0;
    for (row = 0; row < N * M; row++) {
        const int side = mpc->last[row];
        if (side != 0) {
            answers[2] += 1.0;
        }
        if (side == 2 || side == -2) {
            const real value = mpc->value[row] + mpc->shift[row];
            const double over = (double)(side > 0 ? value - upper_bound(row) : lower_bound(row) - value);
            answers[3] = over > answers[3] ? over : answers[3];
        }
    }
}

/* Inputs: state [12], acting [4], reference [N][4]; whether the last period's end may update the observer, and this one's.
 * Answered: status, changes, active rows, slack, command [4], plan [N][4]; then trim, lift and twist. */
void quadsim_shim_step(quadsim_mpc *mpc, const double *inputs, double *answers)
{
    real state[12], acting[NU], reference[N * 4], command[NU];
    int i;
    for (i = 0; i < 12; i++) {
        state[i] = (real)inputs[i];
    }
    for (i = 0; i < NU; i++) {
        acting[i] = (real)inputs[12 + i];
    }
    for (i = 0; i < N * 4; i++) {
        reference[i] = (real)inputs[16 + i];
    }
#ifdef QUADSIM_OBSERVES
    mpc->known = mpc->known && inputs[16 + N * 4] > 0.0;
#endif
    answers[0] = (double)quadsim_mpc_step(mpc, state, reference, acting, command);
    answers[1] = (double)mpc->changes;
    put_active(mpc, answers);
    for (i = 0; i < NU; i++) {
        answers[4 + i] = (double)command[i];
    }
    for (i = 0; i < N * NU; i++) {
        answers[8 + i] = (double)mpc->plan[i];
    }
#ifdef QUADSIM_OBSERVES
    mpc->known = mpc->known && inputs[17 + N * 4] > 0.0;
    for (i = 0; i < NU; i++) {
        answers[8 + N * NU + i] = (double)mpc->trim[i];
    }
    for (i = 0; i < 3; i++) {
        answers[12 + N * NU + i] = (double)mpc->lift[i];
        answers[15 + N * NU + i] = (double)mpc->twist[i];
    }
#endif
}

void quadsim_shim_reset(quadsim_mpc *mpc, const double *speeds)
{
    real start[NU];
    int i;
    for (i = 0; i < NU; i++) {
        start[i] = (real)speeds[i];
    }
    quadsim_mpc_reset(mpc, start);
}
