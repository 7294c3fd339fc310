/* Commands under way, and the state when the next one takes over; see quadsim_delay.h.
 *
 * Over m periods under a command of shares u, actuators follow  a <- u + left^m (a - u), and the body by
 * quadsim_nmpc_model.c; first over the part `late` of a period, then over n whole ones. */
#include "quadsim_delay.h"

#include "quadsim_nmpc_math.h"

/* What a step leaves of actuators' distance from their inputs [4]. */
static const real *left_after(const quadsim_nmpc_problem *body)
{
    return body->left + 2 * body->substeps * LEFT;
}

/* Shares some steps after, under a command. */
static void move_actuators(const quadsim_delay_numbers *n, const quadsim_nmpc_problem *body, int steps,
                           const real *command, real *rotors)
{
    const real *left = left_after(body);
    real shares[NU];
    int i, j;
    commands_to_shares(body, n->coefficient, n->scale, command, shares);
    for (j = 0; j < NU; j++) {
        real away = rotors[j] - shares[j];
        for (i = 0; i < steps && i < SETTLED_PERIODS; i++) {
            away *= left[j];
        }
        rotors[j] = shares[j] + away;
    }
}

/* A state's next one after a step of a body under a command. */
static void move_state(const quadsim_delay_numbers *n, const quadsim_nmpc_problem *body,
                       const quadsim_nmpc_world *world, const real *command, real *state)
{
    real shares[NU], next[MOST];
    commands_to_shares(body, n->coefficient, n->scale, command, shares);
    quadsim_nmpc_advance(body, world, 1, state, shares, next);
    memcpy(state, next, (size_t)states_of(body) * sizeof(real));
}

void quadsim_delay_reset(quadsim_delay *delay, const quadsim_delay_numbers *n, const quadsim_real command[4])
{
    int i;
    memcpy(delay->before, command, sizeof(delay->before));
    for (i = 0; i <= n->under_way; i++) {
        memcpy(delay->sent[i], command, sizeof(delay->sent[i]));
    }
    commands_to_shares(n->late, n->coefficient, n->scale, command, delay->rotors);
    memcpy(delay->rotors_before, delay->rotors, sizeof(delay->rotors));
}

void quadsim_delay_send(quadsim_delay *delay, const quadsim_delay_numbers *n, int periods,
                        const quadsim_real command[4])
{
    memcpy(delay->before, delay->sent[0], sizeof(delay->before));
    memmove(delay->sent[0], delay->sent[1], (size_t)n->under_way * sizeof(delay->sent[0]));
    memcpy(delay->sent[n->under_way], command, sizeof(delay->sent[0]));
    memcpy(delay->rotors_before, delay->rotors, sizeof(delay->rotors));
    if (periods < 1) {
        return;
    }
    move_actuators(n, n->late, 1, delay->before, delay->rotors);
    if (n->rest != NULL) {
        move_actuators(n, n->rest, 1, delay->sent[0], delay->rotors);
    }
    move_actuators(n, n->whole, periods - 1, delay->sent[0], delay->rotors);
}

void quadsim_delay_expect(const quadsim_delay *delay, const quadsim_delay_numbers *n, const quadsim_nmpc_world *world,
                          const quadsim_real *last, quadsim_real *expected)
{
    memcpy(expected, last, BODY * sizeof(real));
    memcpy(expected + BODY, delay->rotors_before, (size_t)n->late->actuators * sizeof(real));
    move_state(n, n->late, world, delay->before, expected);
    if (n->rest != NULL) {
        move_state(n, n->rest, world, delay->sent[0], expected);
    }
}

void quadsim_delay_predict(const quadsim_delay *delay, const quadsim_delay_numbers *n, const quadsim_nmpc_world *world,
                           const quadsim_real *measured, quadsim_real *ahead)
{
    real state[MOST];
    int i;
    memcpy(state, measured, BODY * sizeof(real));
    memcpy(state + BODY, delay->rotors, (size_t)n->late->actuators * sizeof(real));
    move_state(n, n->late, world, delay->sent[0], state);
    for (i = 1; i <= n->under_way; i++) {
        move_state(n, n->whole, world, delay->sent[i], state);
    }
    memcpy(ahead, state, (size_t)states_of(n->late) * sizeof(real));
}

/* Between two samples: positions by the cubic that has their velocities, too, quaternions turned evenly, all else
 * straight. */
void quadsim_delay_sample(const quadsim_delay_numbers *n, quadsim_real period, const quadsim_real *motion, int row,
                          quadsim_real sample[QUADSIM_MOTION])
{
    const real *now = motion + (row + n->under_way) * QUADSIM_MOTION, *next = now + QUADSIM_MOTION;
    const real s = n->share, square = s * s, end = square * (R(3.0) - R(2.0) * s);
    const real side = dot(now + Q, next + Q, 4) < R(0.0) ? R(-1.0) : R(1.0);
    real length;
    int i;
    for (i = 0; i < QUADSIM_MOTION; i++) {
        sample[i] = now[i] + s * (next[i] - now[i]);
    }
    for (i = 0; i < 3; i++) {
        const real leaving = (s - R(2.0) * square + square * s) * now[V + i],
                   arriving = (square * s - square) * next[V + i];
        sample[P + i] = now[P + i] + end * (next[P + i] - now[P + i]) + period * (leaving + arriving);
    }
    for (i = 0; i < 4; i++) {
        sample[Q + i] = now[Q + i] + s * (side * next[Q + i] - now[Q + i]);
    }
    length = square_root(dot(sample + Q, sample + Q, 4));
    for (i = 0; i < 4; i++) {
        sample[Q + i] /= length;
    }
}
