/* Mehrotra's (1992) primal-dual interior point method: which rows are active, where an active-set method would exchange
 * many of them.
 *
 * A row  a z + t = b, t > 0,  has a multiplier y > 0, and a soft one  a z + t - e = b, with a slack of its own, e > 0,
 * whose own multiplier is  l + q e - y > 0.  A step towards  t y = m - p  and  e (l + q e - y) = m - r  follows from
 * the optimum with the row's weight w and slope c,
 *
 *     w = y / t,   c = (m - p) / t + y - w b;             and with f = q + (l + q e - y) / e  of its slack
 *     w <- w / (1 + w / f),   c <- (c - w ((m - r) / e - l + (l + q e - y)) / f) / (1 + w / f),
 *
 * after which its multiplier is  w a z + c:  one Riccati recursion.  The first of two steps in each iteration has
 * m = p = r = 0; its length gives m, its products of dt dy and of de and d(l + q e - y) are p and r of the second one,
 * which has the same w and so only passes backwards and forwards.  Distances and multipliers have lengths of their own.
 *
 * One method serves inputs alone and all rows: the first 2 N 4 rows are those of inputs, in loops without a branch, so
 * that they cost a tenth of the recursion. */
#include "quadsim_nmpc_qp.h"

static const real STEP_SHARE_TO_BOUND = R(0.995); /* share of a step that ends at a bound */
static const real LEAST_MULTIPLIER = R(3.0);      /* of inputs at the start */
static const real START_MARGIN = R(0.3);          /* share of an input's range from its bounds, at the start */

/* Numbers of each row; those of inputs are first, upper ones [N][4], then lower ones [N][4], those of states
 * [N][quadsim_nmpc_state_rows] follow.  A row of states that is not bounded has t = 0. */
typedef struct inner {
    int inputs, rows, count; /* N 4; rows of states; rows of both */
    int pairs;               /* of distances, or slacks, and their multipliers */
    real *t, *by;            /* [count] distance, and multiplier */
    real *inverse;           /* [count] 1 / t */
    real *aim;               /* [count] m - p */
    real *dt, *dby;          /* [count] steps */
    real *e, *nu;            /* [rows] slack, and its multiplier; 0 of a hard row */
    real *aim_slack;         /* [rows] m - r */
    real *de, *dnu;          /* [rows] steps */
    quadsim_nmpc_weights weights;
} inner;

static real *take_part(real **memory, long size)
{
    real *start = *memory;
    *memory += size;
    return start;
}

int quadsim_nmpc_takes_rows(const quadsim_nmpc_problem *p)
{
    int j;
    for (j = 0; p->rows > 0 && j < p->first[p->rows]; j++) {
        if (p->terms[j].lag != 0 || p->terms[j].entry < NU) {
            return 0;
        }
    }
    return 1;
}

long quadsim_nmpc_interior_size(const quadsim_nmpc_problem *p)
{
    const long N = p->horizon, rows = quadsim_nmpc_takes_rows(p) ? N * quadsim_nmpc_state_rows(p) : 0;
    const long entries = rows > 0 ? entries_size(p) : 0;
    return 6 * (2 * N * NU + rows) + 7 * rows + entries + N * (3 * NU + states_of(p));
}

static inner lay_out_rows(const quadsim_nmpc_work *work, int of_states)
{
    const quadsim_nmpc_problem *p = work->p;
    const int N = p->horizon;
    real *memory = work->response;
    inner at;
    at.pairs = 0;
    at.inputs = N * NU;
    at.rows = of_states ? N * quadsim_nmpc_state_rows(p) : 0;
    at.count = 2 * at.inputs + at.rows;
    at.t = take_part(&memory, at.count);
    at.by = take_part(&memory, at.count);
    at.inverse = take_part(&memory, at.count);
    at.aim = take_part(&memory, at.count);
    at.dt = take_part(&memory, at.count);
    at.dby = take_part(&memory, at.count);
    at.e = take_part(&memory, at.rows);
    at.nu = take_part(&memory, at.rows);
    at.aim_slack = take_part(&memory, at.rows);
    at.de = take_part(&memory, at.rows);
    at.dnu = take_part(&memory, at.rows);
    at.weights.weight = take_part(&memory, at.rows);
    at.weights.slope = take_part(&memory, at.rows);
    at.weights.entries = at.rows > 0 ? take_part(&memory, entries_size(p)) : NULL;
    at.weights.effort = take_part(&memory, at.inputs);
    at.weights.push = take_part(&memory, at.inputs);
    at.weights.inputs = take_part(&memory, at.inputs);
    at.weights.known = take_part(&memory, N * states_of(p));
    if (at.rows == 0) {
        at.weights.weight = at.weights.slope = NULL;
    }
    return at;
}

/* Inputs start inside their range, near the plan.  Their multipliers start at half the largest one of the held inputs,
 * which did not settle: much smaller ones cost twice the iterations. */
static void start_inputs(const quadsim_nmpc_work *work, inner *at)
{
    const quadsim_nmpc_problem *p = work->p;
    const int size = at->inputs;
    real start = LEAST_MULTIPLIER;
    int i;
    for (i = 0; i < size; i++) {
        const real half = work->held[i] != 0 ? R(0.5) * magnitude(work->own[i]) : R(0.0);
        start = half > start ? half : start;
    }
    for (i = 0; i < size; i++) {
        const real lower = p->lower[i % NU], upper = p->upper[i % NU], margin = START_MARGIN * (upper - lower);
        const real input = clipped(work->u[i], lower + margin, upper - margin);
        at->t[i] = upper - input;
        at->t[size + i] = input - lower;
        at->by[i] = at->by[size + i] = start;
    }
    memset(at->dt, 0, sizeof(real) * (size_t)(2 * size));
    memset(at->dby, 0, sizeof(real) * (size_t)(2 * size));
    at->pairs = 2 * size;
}

/* Rows of states start from the present entries. */
static void start_states(const quadsim_nmpc_work *work, inner *at)
{
    const quadsim_nmpc_problem *p = work->p;
    const int kinds = quadsim_nmpc_state_rows(p), first = 2 * at->inputs;
    int node, k, i = 0;
    for (node = 0; at->rows > 0 && node < p->horizon; node++) {
        for (k = 0; k < kinds; k++, i++) {
            real *t = at->t + first + i, *by = at->by + first + i, most, least, beyond;
            quadsim_nmpc_row row;
            quadsim_nmpc_state_row(p, node, k, &row);
            most = quadsim_nmpc_bound(work, &row);
            least = R(0.1) * magnitude(most) + R(0.01);
            *t = *by = at->e[i] = at->nu[i] = R(0.0);
            at->de[i] = at->dnu[i] = at->dt[first + i] = at->dby[first + i] = R(0.0);
            at->weights.weight[i] = at->weights.slope[i] = R(0.0);
            if (most >= NO_LIMIT) {
                continue;
            }
            beyond = quadsim_nmpc_product(work, &row, work->value) - most;
            *by = R(1.0);
            at->pairs++;
            if (row.slack >= 0) {
                const real l = quadsim_nmpc_linear_price(work, row.slack);
                *by = l < R(2.0) ? R(0.5) * l : R(1.0);
                at->e[i] = beyond > R(0.0) ? beyond + least : least;
                at->nu[i] = l + quadsim_nmpc_quadratic_price(p, row.slack) * at->e[i] - *by;
                beyond -= at->e[i];
                at->pairs++;
            }
            *t = beyond < -least ? -beyond : least;
        }
    }
}

/* The weights with which the next step leads towards the aims. */
static void set_weights(const quadsim_nmpc_work *work, const inner *at)
{
    const quadsim_nmpc_problem *p = work->p;
    const int size = at->inputs, kinds = quadsim_nmpc_state_rows(p);
    const quadsim_nmpc_weights *weights = &at->weights;
    int node, k, i;
    for (i = 0; i < size; i++) {
        const int low = size + i;
        const real above = at->by[i] * at->inverse[i], below = at->by[low] * at->inverse[low];
        const real slope = at->aim[i] * at->inverse[i] + at->by[i] - above * p->upper[i % NU];
        const real slope_low = at->aim[low] * at->inverse[low] + at->by[low] + below * p->lower[i % NU];
        weights->effort[i] = p->effort[i % NU] + above + below;
        weights->push[i] = slope - slope_low - p->effort[i % NU] * work->aim[i];
    }
    for (node = 0, i = 0; at->rows > 0 && node < p->horizon; node++) {
        for (k = 0; k < kinds; k++, i++) {
            const int j = 2 * size + i;
            real weight, slope;
            quadsim_nmpc_row row;
            if (!(at->t[j] > R(0.0))) {
                continue;
            }
            quadsim_nmpc_state_row(p, node, k, &row);
            weight = at->by[j] * at->inverse[j];
            slope = at->aim[j] * at->inverse[j] + at->by[j] - weight * quadsim_nmpc_bound(work, &row);
            if (row.slack >= 0) {
                const real curvature = quadsim_nmpc_quadratic_price(p, row.slack) + at->nu[i] / at->e[i];
                const real l = quadsim_nmpc_linear_price(work, row.slack);
                const real from = at->aim_slack[i] / at->e[i] + at->nu[i] - l;
                const real share = R(1.0) / (R(1.0) + weight / curvature);
                slope = (slope - weight * from / curvature) * share;
                weight *= share;
            }
            weights->weight[i] = weight;
            weights->slope[i] = slope;
        }
    }
}

/* The steps that follow from the optimum with these weights. */
static void find_row_steps(const quadsim_nmpc_work *work, const inner *at)
{
    const quadsim_nmpc_problem *p = work->p;
    const int size = at->inputs, kinds = quadsim_nmpc_state_rows(p);
    const quadsim_nmpc_weights *weights = &at->weights;
    int node, k, i;
    for (i = 0; i < size; i++) {
        const int low = size + i;
        at->dt[i] = p->upper[i % NU] - weights->inputs[i] - at->t[i];
        at->dt[low] = weights->inputs[i] - p->lower[i % NU] - at->t[low];
    }
    for (i = 0; i < 2 * size; i++) {
        at->dby[i] = (at->aim[i] - at->by[i] * at->dt[i]) * at->inverse[i] - at->by[i];
    }
    for (node = 0, i = 0; at->rows > 0 && node < p->horizon; node++) {
        for (k = 0; k < kinds; k++, i++) {
            const int j = 2 * size + i;
            real z, by, e = R(0.0);
            quadsim_nmpc_row row;
            if (!(at->t[j] > R(0.0))) {
                continue;
            }
            quadsim_nmpc_state_row(p, node, k, &row);
            z = quadsim_nmpc_product(work, &row, weights->entries);
            by = weights->weight[i] * z + weights->slope[i];
            if (row.slack >= 0) {
                const real l = quadsim_nmpc_linear_price(work, row.slack);
                const real q = quadsim_nmpc_quadratic_price(p, row.slack);
                const real from = at->aim_slack[i] / at->e[i] + at->nu[i] - l;
                e = (from + by) / (q + at->nu[i] / at->e[i]);
                at->de[i] = e - at->e[i];
                at->dnu[i] = l + q * e - by - at->nu[i];
            }
            at->dt[j] = quadsim_nmpc_bound(work, &row) + e - z - at->t[j];
            at->dby[j] = by - at->by[j];
        }
    }
}

/* The largest share of a step, at most 1, that leaves none of the numbers negative. */
static real longest_step(real share, const real *numbers, const real *steps, int count)
{
    int i;
    for (i = 0; i < count; i++) {
        if (steps[i] < R(0.0) && numbers[i] < -share * steps[i]) {
            share = -numbers[i] / steps[i];
        }
    }
    return share;
}

/* The mean product of distances and slacks and their multipliers, after these shares of their steps. */
static real mean_product(const inner *at, real primal, real dual)
{
    real sum = R(0.0), of_slacks = R(0.0);
    int i;
    for (i = 0; i < at->count; i++) {
        sum += (at->t[i] + primal * at->dt[i]) * (at->by[i] + dual * at->dby[i]);
    }
    for (i = 0; i < at->rows; i++) {
        of_slacks += (at->e[i] + primal * at->de[i]) * (at->nu[i] + dual * at->dnu[i]);
    }
    return (sum + of_slacks) / (real)at->pairs;
}

static void move_by(real *numbers, real share, const real *steps, int count)
{
    int i;
    for (i = 0; i < count; i++) {
        numbers[i] += share * steps[i];
    }
}

/* Hold the inputs at bounds, make the active rows of states active, and free their slacks that are positive. */
static void keep_active(quadsim_nmpc_work *work, const inner *at)
{
    const quadsim_nmpc_problem *p = work->p;
    const int size = at->inputs, kinds = quadsim_nmpc_state_rows(p);
    int node, k, i;
    for (i = 0; i < size; i++) {
        const int above = at->by[i] > at->t[i], below = at->by[size + i] > at->t[size + i];
        work->held[i] = below ? -1 : above ? 1 : 0;
    }
    work->count = 0;
    for (node = 0, i = 0; at->rows > 0 && node < p->horizon; node++) {
        for (k = 0; k < kinds; k++, i++) {
            const int j = 2 * size + i;
            if (at->by[j] > at->t[j] && work->count < p->capacity) {
                quadsim_nmpc_row row;
                quadsim_nmpc_state_row(p, node, k, &row);
                work->row[work->count++] = row;
                if (row.slack >= 0 && at->e[i] > at->nu[i]) {
                    work->free[row.slack] = 1;
                }
            }
        }
    }
}

int quadsim_nmpc_interior(quadsim_nmpc_work *work, int of_states, quadsim_real tolerance, int most)
{
    inner at = lay_out_rows(work, of_states);
    const int count = at.count, rows = at.rows;
    int i, k, pass;
    real mu;
    start_inputs(work, &at);
    start_states(work, &at);
    mu = mean_product(&at, R(0.0), R(0.0));
    for (k = 0; k < most && mu > tolerance; k++) {
        real primal = R(1.0), dual = R(1.0), after, centre;
        for (i = 0; i < count; i++) {
            at.inverse[i] = R(1.0) / at.t[i];
            at.aim[i] = R(0.0);
        }
        for (i = 0; i < rows; i++) {
            at.aim_slack[i] = R(0.0);
        }
        for (pass = 0; pass < 2; pass++) {
            set_weights(work, &at);
            quadsim_nmpc_weighted_optimum(work, &at.weights, pass == 0);
            find_row_steps(work, &at);
            primal = longest_step(longest_step(R(1.0), at.t, at.dt, count), at.e, at.de, rows);
            dual = longest_step(longest_step(R(1.0), at.by, at.dby, count), at.nu, at.dnu, rows);
            if (pass > 0) {
                break;
            }
            after = mean_product(&at, primal, dual);
            centre = (after / mu) * (after / mu) * after;
            for (i = 0; i < count; i++) {
                at.aim[i] = centre - at.dt[i] * at.dby[i];
            }
            for (i = 0; i < rows; i++) {
                at.aim_slack[i] = centre - at.de[i] * at.dnu[i];
            }
        }
        primal *= STEP_SHARE_TO_BOUND;
        dual *= STEP_SHARE_TO_BOUND;
        move_by(at.t, primal, at.dt, count);
        move_by(at.by, dual, at.dby, count);
        move_by(at.e, primal, at.de, rows);
        move_by(at.nu, dual, at.dnu, rows);
        mu = mean_product(&at, R(0.0), R(0.0));
    }
    keep_active(work, &at);
    return k;
}
