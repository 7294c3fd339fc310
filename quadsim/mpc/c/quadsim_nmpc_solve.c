/* The solution of a quadratic program: which method is asked, in which order.
 *
 * Where inputs alone are at bounds, as in most programs, three ways to the set of held inputs follow one another:
 *
 *  1. that of the last optimum, a node further on, changed by the primal-dual active-set method: a few recursions, as
 *     long as the changes get fewer;
 *  2. that of the interior point method with a loose tolerance, then 1. again: at most MOST_INNER recursions, whatever
 *     the number of bounds, and once more with a smaller tolerance where that does not settle;
 *  3. the dual active-set method, which takes all other rows, too, with the held inputs in the recursion.
 *
 * A search that exchanges more than LONG_SEARCH rows per node starts again from what the interior point method of all
 * rows finds active: far from the reference it would exchange thousands. */
#include "quadsim_nmpc_qp.h"

#ifdef QUADSIM_FLOAT
static const real COMPLEMENTARITY_OF_ROWS = 1e-4F; /* mean product of multipliers and distances, where all rows tell */
#else
static const real COMPLEMENTARITY_OF_ROWS = 1e-6;
#endif
static const real COMPLEMENTARITY_OF_INPUTS = R(1e-3); /* the same, where bounds of inputs tell */
static const real COMPLEMENTARITY_AGAIN = R(1e-5);     /* and where what is active at first does not settle */
enum { MOST_ROUNDS = 4, MOST_INNER = 30, MOST_INNER_ROWS = 60, MOST_PROXIMAL_STEPS = 20 };
enum { LONG_SEARCH = 5 }; /* changes per node that a search has before the interior point method of all rows */

/* Hold inputs that leave their bounds, release those whose multipliers have the wrong sign, until there are none: the
 * primal-dual active-set method (Hintermueller, Ito and Kunisch 2002), a Riccati recursion each, from the last node
 * that changes.  Where it is `hasty`, it ends as soon as the changes do not get fewer, or are many at first.  Whether
 * it settled. */
static int settle_held_inputs(quadsim_nmpc_work *work, int rounds, int hasty)
{
    const quadsim_nmpc_problem *p = work->p;
    const int size = p->horizon * NU;
    int i, round, last = p->horizon - 1, before = p->horizon + 1;
    for (round = 0; round < rounds; round++) {
        int changed = 0, any = 0, at = 0;
        quadsim_nmpc_optimum(work, last);
        work->rounds++;
        for (i = 0; i < size; i++) {
            any |= work->held[i];
        }
        if (any) {
            quadsim_nmpc_gradient(work, work->own);
        }
        for (i = 0; i < size; i++) {
            const real input = work->v[i];
            const int side = work->held[i];
            if (side != 0) {
                if (side > 0 ? work->own[i] > R(0.0) : work->own[i] < R(0.0)) {
                    work->held[i] = 0;
                    changed++;
                    at = i;
                }
            } else if (input > p->upper[i % NU] + FEASIBILITY_TOLERANCE ||
                       input < p->lower[i % NU] - FEASIBILITY_TOLERANCE) {
                work->held[i] = input > p->upper[i % NU] ? 1 : -1;
                changed++;
                at = i;
            }
        }
        if (!changed) {
            return 1;
        }
        if (hasty && changed >= before) {
            return 0;
        }
        before = changed;
        last = at / NU;
    }
    return 0;
}

/* Move the active set on by a node. */
static void shift_active(quadsim_nmpc_work *work)
{
    const quadsim_nmpc_problem *p = work->p;
    const int inputs = p->horizon * NU, slacks = p->horizon * p->slacks;
    int i, kept = 0;
    for (i = 0; i < inputs; i++) {
        work->held[i] = i + NU < inputs ? work->held[i + NU] : 0;
    }
    for (i = 0; i < slacks; i++) {
        work->free[i] = i + p->slacks < slacks ? work->free[i + p->slacks] : 0;
    }
    for (i = 0; i < work->count; i++) {
        quadsim_nmpc_row row = work->row[i];
        if (row.node > 0) {
            row.node--;
            row.slack -= row.slack >= 0 ? p->slacks : 0;
            work->row[kept++] = row;
        }
    }
    work->count = kept;
}

/* Rows of held inputs among the active ones; none is held then. */
static void rows_of_held(quadsim_nmpc_work *work)
{
    const int size = work->p->horizon * NU;
    int i;
    for (i = 0; i < size; i++) {
        if (work->held[i] != 0 && work->count < work->p->capacity) {
            work->row[work->count++] = row_of_input(i / NU, i % NU, work->held[i]);
        }
        work->held[i] = 0;
    }
}

/* Hold the inputs whose rows are active, in place of these rows. */
static void hold_rows(quadsim_nmpc_work *work)
{
    int j, kept = 0;
    for (j = 0; j < work->count; j++) {
        const quadsim_nmpc_row row = work->row[j];
        if (row.kind == QUADSIM_NMPC_INPUT) {
            work->held[row.node * NU + row.index] = row.sign;
        } else {
            work->row[kept++] = row;
        }
    }
    work->count = kept;
}

/* Release the held inputs whose multipliers have the wrong sign; whether there were any. */
static int release_inputs(quadsim_nmpc_work *work)
{
    const int size = work->p->horizon * NU;
    int i, any = 0;
    quadsim_nmpc_gradient(work, work->own);
    for (i = 0; i < size; i++) {
        const int side = work->held[i];
        if (side != 0 && (side > 0 ? work->own[i] > R(0.0) : work->own[i] < R(0.0))) {
            work->held[i] = 0;
            any = 1;
        }
    }
    return any;
}

/* The optimum of all rows, with inputs held in the recursion: a search among the other rows for each set of them. */
static enum quadsim_nmpc_status search_held(quadsim_nmpc_work *work)
{
    const int size = work->p->horizon * NU;
    int round;
    for (round = 0; round < MOST_ROUNDS; round++) {
        enum quadsim_nmpc_status status;
        int i, any = 0;
        hold_rows(work);
        for (i = 0; i < size; i++) {
            any |= work->held[i];
        }
        quadsim_nmpc_optimum(work, work->p->horizon - 1);
        work->rounds++;
        status = quadsim_nmpc_search(work);
        if (status > QUADSIM_NMPC_BOUNDED) {
            if (!any || status == QUADSIM_NMPC_INFEASIBLE) {
                return status;
            }
            break; /* perhaps of the held inputs */
        }
        quadsim_nmpc_add_multipliers(work);
        if (!release_inputs(work)) {
            return QUADSIM_NMPC_BOUNDED;
        }
    }
    rows_of_held(work);
    quadsim_nmpc_optimum(work, work->p->horizon - 1);
    {
        const enum quadsim_nmpc_status status = quadsim_nmpc_search(work);
        if (status == QUADSIM_NMPC_BOUNDED) {
            quadsim_nmpc_add_multipliers(work);
        }
        return status;
    }
}

/* The optimum where inputs alone may be at bounds; whether there is one that satisfies all rows. */
static int solve_input_bounds(quadsim_nmpc_work *work)
{
    quadsim_nmpc_row worst;
    real most = FEASIBILITY_TOLERANCE;
    int settled, again;
    quadsim_nmpc_close_slacks(work);
    quadsim_nmpc_sum_prices(work);
    settled = settle_held_inputs(work, MOST_ROUNDS, 1);
    for (again = 0; !settled && again < 2; again++) {
        work->inner +=
            quadsim_nmpc_interior(work, 0, again ? COMPLEMENTARITY_AGAIN : COMPLEMENTARITY_OF_INPUTS, MOST_INNER);
        settled = settle_held_inputs(work, 2 * MOST_ROUNDS, 0);
    }
    return settled && !quadsim_nmpc_worst_row(work, &worst, &most);
}

/* The optimum with slacks of linear prices alone, by the proximal point method, each from the active set before. */
static enum quadsim_nmpc_status solve_linear_slacks(quadsim_nmpc_work *work)
{
    const quadsim_nmpc_problem *p = work->p;
    enum quadsim_nmpc_status status = QUADSIM_NMPC_BOUNDED;
    int i, again;
    for (again = 0; again < MOST_PROXIMAL_STEPS && status == QUADSIM_NMPC_BOUNDED; again++) {
        real changed = R(0.0);
        for (i = 0; i < p->horizon * p->slacks; i++) {
            if (!(p->quadratic[i % p->slacks] > R(0.0))) {
                const real slack = quadsim_nmpc_slack_value(work, i);
                const real change = LINEAR_PRICE_CURVATURE * magnitude(slack - work->origin[i]);
                work->origin[i] = slack;
                changed = change > changed ? change : changed;
            }
        }
        if (changed <= FEASIBILITY_TOLERANCE) {
            break;
        }
        status = search_held(work);
    }
    return status;
}

enum quadsim_nmpc_status quadsim_nmpc_solve(quadsim_nmpc_work *work)
{
    const int size = work->p->horizon * NU;
    enum quadsim_nmpc_status status = QUADSIM_NMPC_FREE;
    quadsim_nmpc_row worst;
    int i;
    work->changes = work->rounds = work->inner = 0;
    work->allowed = work->p->changes;
    if (quadsim_nmpc_takes_rows(work->p) && work->allowed > LONG_SEARCH * work->p->horizon) {
        work->allowed = LONG_SEARCH * work->p->horizon;
    }
    memset(work->origin, 0, sizeof(real) * (size_t)(work->p->slacks * work->p->horizon));
    quadsim_nmpc_entries_at(work, -1, 1, work->before, work->start, work->value);
    hold_rows(work);
    if (work->shifted) {
        shift_active(work);
        work->shifted = 0;
    }
    if (work->count == 0 && solve_input_bounds(work)) { /* no other rows were active, so perhaps none is */
        for (i = 0; i < size; i++) {
            status = work->held[i] != 0 ? QUADSIM_NMPC_BOUNDED : status;
        }
    } else {
        status = search_held(work);
        if (status == QUADSIM_NMPC_GIVEN_UP && work->allowed < work->p->changes) {
            memset(work->held, 0, sizeof(int) * (size_t)size);
            quadsim_nmpc_optimum(work, work->p->horizon - 1);
            work->inner += quadsim_nmpc_interior(work, 1, COMPLEMENTARITY_OF_ROWS, MOST_INNER_ROWS);
            work->allowed = work->p->changes;
            status = search_held(work);
        }
        work->allowed = work->p->changes;
        if (status == QUADSIM_NMPC_BOUNDED) {
            status = solve_linear_slacks(work);
        }
    }
    work->violation = R(0.0);
    if (status <= QUADSIM_NMPC_BOUNDED) {
        (void)quadsim_nmpc_worst_row(work, &worst, &work->violation);
    }
    return status;
}
