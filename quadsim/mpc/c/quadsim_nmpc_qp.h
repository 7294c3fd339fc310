/* What the files of an iteration's quadratic program share.
 *
 *     min  1/2 sum |s_i - goal_i|^2_Q + |u_i - aim_i|^2_R
 *     s.t. s_{i+1} = A_i s_i + B_i u_i + c_i  and rows a z <= b.
 *
 *   quadsim_nmpc_rows.c        what rows are: their products, bounds, gradients and slacks
 *   quadsim_nmpc_riccati.c     the recursion: the optimum without rows, and what a row's multiplier does to it
 *   quadsim_nmpc_active_set.c  the dual active-set method, which adds violated rows one by one
 *   quadsim_nmpc_interior.c    the interior point method, which finds which rows are active where they are many
 *   quadsim_nmpc_solve.c       which of these is asked, in which order */
#ifndef QUADSIM_NMPC_QP_H
#define QUADSIM_NMPC_QP_H

#include "quadsim_nmpc_math.h"

#ifdef QUADSIM_FLOAT
static const real FEASIBILITY_TOLERANCE = 2e-5F; /* violation of a row */
#else
static const real FEASIBILITY_TOLERANCE = 1e-10;
#endif
static const real NO_LIMIT = R(1e29); /* a price, or a bound, that is none */
static const real NO_STEP_LIMIT = R(1e30);
static const real LINEAR_PRICE_CURVATURE = R(1e-5); /* of a linear price, in its proportion */

/* ---- quadsim_nmpc_rows.c ----------------------------------------------------------------------------------------- */

/* Entries [w] of all nodes; those before the first node come first. */
static inline long entries_size(const quadsim_nmpc_problem *p)
{
    return (long)(p->horizon + 1) * entries_of(p);
}

/* Entries of node i from its inputs [4] and the state [n] at its end, into those of all; of node -1 the known ones.
 * Unless they are `whole`, what is known of the thrust axis is left out: they are linear in the state. */
void quadsim_nmpc_entries_at(const quadsim_nmpc_work *work, int i, int whole, const quadsim_real *inputs,
                             const quadsim_real *state, quadsim_real *entries);

/* The row of a node that bounds an input above, sign 1, or below, -1. */
static inline quadsim_nmpc_row row_of_input(int node, int input, int sign)
{
    const quadsim_nmpc_row row = {node, QUADSIM_NMPC_INPUT, input, sign, -1};
    return row;
}

/* How many rows of states a node has, whether or not they are bounded, and the k-th of them. */
int quadsim_nmpc_state_rows(const quadsim_nmpc_problem *p);
void quadsim_nmpc_state_row(const quadsim_nmpc_problem *p, int node, int k, quadsim_nmpc_row *row);

/* A row's product with entries of all nodes, what is known of it, and its bound. */
quadsim_real quadsim_nmpc_product(const quadsim_nmpc_work *work, const quadsim_nmpc_row *row,
                                  const quadsim_real *entries);
quadsim_real quadsim_nmpc_known_part(const quadsim_nmpc_work *work, const quadsim_nmpc_row *row);
quadsim_real quadsim_nmpc_bound(const quadsim_nmpc_work *work, const quadsim_nmpc_row *row);

/* Add a row's terms in a node, its own or the one before, times a factor to the gradients of that node's inputs [4] and
 * of the state [n] at its end. */
void quadsim_nmpc_add_row_gradient(const quadsim_nmpc_work *work, const quadsim_nmpc_row *row, int node,
                                   quadsim_real factor, quadsim_real *inputs, quadsim_real *state);

/* The same of all active rows with their multipliers. */
void quadsim_nmpc_add_active_gradients(const quadsim_nmpc_work *work, int node, quadsim_real *inputs,
                                       quadsim_real *state);

/* The prices of a slack e of all nodes' [N][slacks]: l e + q e^2 / 2. */
quadsim_real quadsim_nmpc_linear_price(const quadsim_nmpc_work *work, int slack);
quadsim_real quadsim_nmpc_quadratic_price(const quadsim_nmpc_problem *p, int slack);

/* Let all slacks be zero. */
void quadsim_nmpc_close_slacks(quadsim_nmpc_work *work);

/* Sum the multipliers of the rows that share a slack, into work->price. */
void quadsim_nmpc_sum_prices(quadsim_nmpc_work *work);

/* The value of a slack at these sums. */
quadsim_real quadsim_nmpc_slack_value(const quadsim_nmpc_work *work, int slack);

/* By how much a row is violated, where `pending`, its own multiplier that is not yet active, adds to its slack. */
quadsim_real quadsim_nmpc_violation(const quadsim_nmpc_work *work, const quadsim_nmpc_row *row, quadsim_real pending);

/* Whether a row is violated by more than *most: then the most violated one, and *most its violation. */
int quadsim_nmpc_worst_row(const quadsim_nmpc_work *work, quadsim_nmpc_row *worst, quadsim_real *most);

/* ---- quadsim_nmpc_riccati.c -------------------------------------------------------------------------------------- */

/* Weights of one step of an interior point method.  Rows of inputs are part of their effort; for each row of states
 * it has w z^2 / 2 + c z. */
typedef struct quadsim_nmpc_weights {
    quadsim_real *effort, *push;  /* [N][4] of the inputs: w u^2 / 2 + c u */
    quadsim_real *weight, *slope; /* [N][quadsim_nmpc_state_rows] w, 0 where there is no row, and c; NULL: no rows */
    quadsim_real *known;          /* [N][n] products that a second step with the same w takes from the first one */
    quadsim_real *inputs;         /* [N][4] the inputs that follow */
    quadsim_real *entries;        /* [N+1][w] the entries that follow, where there are rows */
} quadsim_nmpc_weights;

/* Gains, and the optimum with the held inputs at their bounds and no other rows.  The recursion starts from node
 * `last`, the last node whose held inputs have changed since the recursion before: nothing else may have used the
 * responses' memory since.  N - 1: from the end. */
void quadsim_nmpc_optimum(quadsim_nmpc_work *work, int last);

/* Add the active rows' multipliers to that optimum. */
void quadsim_nmpc_add_multipliers(quadsim_nmpc_work *work);

/* The response [N+1][w] of all entries to a row, H^-1 a: by which they fall with each unit of its multiplier. */
void quadsim_nmpc_response(quadsim_nmpc_work *work, const quadsim_nmpc_row *row, quadsim_real *response);

/* The gradient [N][4] in the inputs of the Lagrangian at the optimum, with the active rows' multipliers. */
void quadsim_nmpc_gradient(quadsim_nmpc_work *work, quadsim_real *gradient);

/* That of the active rows alone, with their multipliers. */
void quadsim_nmpc_rows_gradient(const quadsim_nmpc_work *work, quadsim_real *gradient);

/* One step of an interior point method, all inputs free; with `factorise` it has new w, else only new c. */
void quadsim_nmpc_weighted_optimum(quadsim_nmpc_work *work, const quadsim_nmpc_weights *weights, int factorise);

/* ---- quadsim_nmpc_active_set.c ----------------------------------------------------------------------------------- */

/* The optimum from the active set that is there, beside what quadsim_nmpc_optimum has found.  Where it says that there
 * is none, that is proven for all inputs within their bounds, held or not. */
enum quadsim_nmpc_status quadsim_nmpc_search(quadsim_nmpc_work *work);

/* ---- quadsim_nmpc_interior.c ------------------------------------------------------------------------------------- */

/* Hold the inputs and activate the rows that an interior point method finds at their bounds once the mean product of
 * distances and multipliers is below a tolerance, after at most so many iterations, whose number is returned; without
 * `of_states` there are rows of inputs alone.  It begins with the held inputs and the gradient in work->own, and the
 * entries in work->value. */
int quadsim_nmpc_interior(quadsim_nmpc_work *work, int of_states, quadsim_real tolerance, int most);

/* Whether it takes rows of states: those that the caller states have to be of states alone. */
int quadsim_nmpc_takes_rows(const quadsim_nmpc_problem *p);

/* Reals of its memory, which is that of the responses. */
long quadsim_nmpc_interior_size(const quadsim_nmpc_problem *p);

#endif
