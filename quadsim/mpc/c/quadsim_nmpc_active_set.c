/* The dual active-set method of Goldfarb and Idnani (1983): violated rows are added one by one, and rows whose
 * multipliers fall to zero are dropped.
 *
 * With the active rows' products A z = b, their multipliers y and H of the whole program (see quadsim_nmpc_riccati.c),
 * a row a whose multiplier grows by t moves
 *
 *     z <- z - t (H^-1 a - H^-1 A' r),   y <- y - t r,   A H^-1 A' r = A H^-1 a,
 *
 * its own violation falls by t (a H^-1 a - a H^-1 A' r), and t ends at the first of these: the violation is zero, and
 * the row is active; a multiplier is zero, and its row is dropped; the price of a slack reaches its linear one, and the
 * slack is free.  A free slack adds 1 / q to the products of the rows that share it.  A H^-1 A' is kept as a factor L D
 * L', row by row, of which each change of the set costs O(count^2).
 *
 * Where the violation does not fall and no multiplier does, the rows exclude each other, in exact arithmetic.  By
 * rounding that may only seem so: bounds of inputs alone, for instance, never do.  It is said only with a proof: with
 * the hard rows of states that take part, and their multipliers y >= 0,
 *
 *     sum y (a z - b) > 0  for all inputs within their bounds:  at the present ones, with the gradient in the inputs,
 *
 * which holds however y was found. */
#include "quadsim_nmpc_qp.h"

#ifdef QUADSIM_FLOAT
static const real DEPENDENCE_TOLERANCE = 3e-6F; /* share of a row's response to itself that others leave of it */
static const real LEAST_CHANGE = 1e-6F;         /* change of a multiplier by that of a row */
#else
static const real DEPENDENCE_TOLERANCE = 1e-11;
static const real LEAST_CHANGE = 1e-13;
#endif
enum { WARM_START_ROUNDS = 30 };

static real *response_of(const quadsim_nmpc_work *work, int j)
{
    return work->response + (long)j * entries_size(work->p);
}

static real *factor_of(const quadsim_nmpc_work *work, int j)
{
    return work->factor + (long)j * (j + 1) / 2;
}

/* A row's response to another, whose response and slack are given. */
static real mutual_response(const quadsim_nmpc_work *work, const quadsim_nmpc_row *row, int other, const real *response)
{
    const int slack = row->slack;
    real sum = quadsim_nmpc_product(work, row, response);
    if (slack >= 0 && slack == other && work->free[slack]) {
        /* a z - e <= b, and -e <= 0: the product of -1 and -1 */
        sum += R(1.0) / quadsim_nmpc_quadratic_price(work->p, slack);
    }
    return sum;
}

/* Row j of the factor L D L', from the responses; whether the row is not a combination of those before. */
static int factorise_row(quadsim_nmpc_work *work, int j)
{
    const real *response = response_of(work, j);
    const int slack = work->row[j].slack;
    real *mine = factor_of(work, j), whole;
    int k;
    for (k = 0; k < j; k++) { /* L D first */
        mine[k] = mutual_response(work, &work->row[k], slack, response) - dot(mine, factor_of(work, k), k);
    }
    mine[j] = whole = mutual_response(work, &work->row[j], slack, response);
    for (k = 0; k < j; k++) {
        const real scaled = mine[k] / factor_of(work, k)[k];
        mine[j] -= scaled * mine[k];
        mine[k] = scaled;
    }
    return mine[j] > DEPENDENCE_TOLERANCE * whole;
}

/* Add weight z z' to the product of the factor, from row j on (Gill, Golub, Murray and Saunders 1974); z is
 * overwritten. */
static void update_factor(quadsim_nmpc_work *work, int j, real weight, real *z)
{
    int r;
    for (; j < work->count; j++) {
        real *pivot = factor_of(work, j) + j;
        const real p = z[j], whole = *pivot + weight * p * p, by = weight * p / whole;
        weight *= *pivot / whole;
        *pivot = whole;
        for (r = j + 1; p != R(0.0) && r < work->count; r++) {
            real *entry = factor_of(work, r) + j;
            z[r] -= p * *entry;
            *entry += by * z[r];
        }
    }
}

/* r = (L D L')^-1 d. */
static void solve_active(const quadsim_nmpc_work *work, const real *d, real *r)
{
    int j, k;
    for (j = 0; j < work->count; j++) {
        r[j] = d[j] - dot(factor_of(work, j), r, j);
    }
    for (j = 0; j < work->count; j++) {
        r[j] /= factor_of(work, j)[j];
    }
    for (j = work->count - 1; j >= 0; j--) {
        const real *mine = factor_of(work, j), by = r[j];
        for (k = 0; k < j; k++) {
            r[k] -= mine[k] * by;
        }
    }
}

static void drop_row(quadsim_nmpc_work *work, int j)
{
    const size_t size = sizeof(real) * (size_t)entries_size(work->p);
    const real weight = factor_of(work, j)[j];
    int k;
    work->count--;
    for (k = j; k < work->count; k++) {
        real *to = factor_of(work, k);
        const real *from = factor_of(work, k + 1);
        work->d[k] = from[j];
        memmove(to, from, sizeof(real) * (size_t)j);
        memmove(to + j, from + j + 1, sizeof(real) * (size_t)(k - j + 1));
        work->row[k] = work->row[k + 1];
        work->multiplier[k] = work->multiplier[k + 1];
        memcpy(response_of(work, k), response_of(work, k + 1), size);
    }
    update_factor(work, j, weight, work->d);
}

/* Let a slack be positive, or zero. */
static void set_slack(quadsim_nmpc_work *work, int slack, int free)
{
    const real weight = R(1.0) / quadsim_nmpc_quadratic_price(work->p, slack);
    int j;
    work->free[slack] = free;
    for (j = 0; j < work->count; j++) {
        work->d[j] = work->row[j].slack == slack ? R(1.0) : R(0.0);
    }
    update_factor(work, 0, free ? weight : -weight, work->d);
}

/* Move all entries by a step along a row's response, and the active rows' answer r. */
static void move_along_response(quadsim_nmpc_work *work, real step, const real *response)
{
    const long size = entries_size(work->p);
    long i;
    int j;
    for (i = 0; i < size; i++) {
        work->value[i] -= step * response[i];
    }
    for (j = 0; j < work->count; j++) {
        const real by = step * work->r[j], *other = response_of(work, j);
        work->multiplier[j] -= by;
        for (i = 0; by != R(0.0) && i < size; i++) {
            work->value[i] += by * other[i];
        }
    }
    quadsim_nmpc_sum_prices(work);
}

/* The slack at zero that opens first as the multiplier of a row with `slack`, now `multiplier`, grows by less than
 * *longest; -1 if none. */
static int first_slack_to_open(quadsim_nmpc_work *work, int slack, real multiplier, real *longest)
{
    const quadsim_nmpc_problem *p = work->p;
    int j, opens = -1;
    memset(work->rate, 0, sizeof(real) * (size_t)(p->slacks * p->horizon));
    for (j = 0; j < work->count; j++) {
        if (work->row[j].slack >= 0) {
            work->rate[work->row[j].slack] -= work->r[j];
        }
    }
    if (slack >= 0) {
        work->rate[slack] += R(1.0);
    }
    for (j = 0; j < p->slacks * p->horizon; j++) {
        const real rate = work->rate[j];
        const real left = quadsim_nmpc_linear_price(work, j) - work->price[j] - (j == slack ? multiplier : R(0.0));
        if (rate > LEAST_CHANGE && !work->free[j] && left < *longest * rate) {
            *longest = left > R(0.0) ? left / rate : R(0.0);
            opens = j;
        }
    }
    return opens;
}

/* Whether the active rows and a violated one, whose multipliers change by -r and 1, exclude each other for all inputs
 * within their bounds.  The active set is lost. */
static int is_proven_infeasible(quadsim_nmpc_work *work, const quadsim_nmpc_row *violated)
{
    const quadsim_nmpc_problem *p = work->p;
    const int size = p->horizon * NU, w = entries_of(p);
    real least = R(0.0), whole = R(0.0);
    int i, j;
    work->row[work->count] = *violated;
    work->r[work->count] = R(-1.0);
    work->count++;
    for (j = 0; j < work->count; j++) {
        const quadsim_nmpc_row *row = &work->row[j];
        const int counts = row->kind != QUADSIM_NMPC_INPUT && row->slack < 0 && work->r[j] < R(0.0);
        work->multiplier[j] = counts ? -work->r[j] : R(0.0);
        if (counts) {
            least -= work->r[j] * quadsim_nmpc_violation(work, row, R(0.0));
            whole -= work->r[j];
        }
    }
    quadsim_nmpc_rows_gradient(work, work->own);
    for (i = 0; i < size; i++) {
        const real input = work->value[(long)(i / NU + 1) * w + i % NU], slope = work->own[i];
        least += slope * ((slope > R(0.0) ? p->lower[i % NU] : p->upper[i % NU]) - input);
    }
    return least > FEASIBILITY_TOLERANCE * whole;
}

/* Make a violated row active, and drop what must go. */
static enum quadsim_nmpc_status add_row(quadsim_nmpc_work *work, const quadsim_nmpc_row *row)
{
    const quadsim_nmpc_problem *p = work->p;
    const int slack = row->slack;
    real multiplier = R(0.0);
    if (work->count == p->capacity) {
        return QUADSIM_NMPC_OVER_CAPACITY;
    }
    quadsim_nmpc_response(work, row, work->own);
    for (;;) {
        const real whole = mutual_response(work, row, slack, work->own);
        real left = whole, longest = NO_STEP_LIMIT, full;
        int j, blocks = -1, opens;
        if (++work->changes > work->allowed) {
            return QUADSIM_NMPC_GIVEN_UP;
        }
        for (j = 0; j < work->count; j++) {
            work->d[j] = mutual_response(work, &work->row[j], slack, work->own);
        }
        solve_active(work, work->d, work->r);
        left -= dot(work->d, work->r, work->count);
        for (j = 0; j < work->count; j++) {
            if (work->r[j] > LEAST_CHANGE && work->multiplier[j] < longest * work->r[j]) {
                longest = work->multiplier[j] / work->r[j];
                blocks = j;
            }
        }
        opens = first_slack_to_open(work, slack, multiplier, &longest);
        full =
            left > DEPENDENCE_TOLERANCE * whole ? quadsim_nmpc_violation(work, row, multiplier) / left : NO_STEP_LIMIT;
        if (full < longest) {
            longest = full;
        }
        if (longest >= NO_STEP_LIMIT) {
            return is_proven_infeasible(work, row) ? QUADSIM_NMPC_INFEASIBLE : QUADSIM_NMPC_GIVEN_UP;
        }
        multiplier += longest;
        move_along_response(work, longest, work->own);
        if (longest == full) {
            if (row->kind == QUADSIM_NMPC_SLACK) {
                set_slack(work, slack, 0);
                return QUADSIM_NMPC_BOUNDED;
            }
            work->row[work->count] = *row;
            work->multiplier[work->count] = multiplier;
            memcpy(response_of(work, work->count), work->own, sizeof(real) * (size_t)entries_size(p));
            (void)factorise_row(work, work->count);
            work->count++;
            quadsim_nmpc_sum_prices(work);
            return QUADSIM_NMPC_BOUNDED;
        }
        if (opens >= 0) {
            set_slack(work, opens, 1);
        } else {
            drop_row(work, blocks);
        }
    }
}

static void clear_active_rows(quadsim_nmpc_work *work)
{
    work->count = 0;
    quadsim_nmpc_close_slacks(work);
    quadsim_nmpc_sum_prices(work);
}

/* Start from the active set that is there: the rows that have positive multipliers with the present values. */
static void start_from_active_rows(quadsim_nmpc_work *work)
{
    const quadsim_nmpc_problem *p = work->p;
    const int slacks = p->slacks * p->horizon, count = work->count;
    const long size = entries_size(p);
    int j, i, round, kept = 0;
    work->count = 0;
    for (j = 0; j < count; j++) {
        work->row[kept] = work->row[j];
        quadsim_nmpc_response(work, &work->row[kept], response_of(work, kept));
        if (factorise_row(work, kept)) {
            kept++;
            work->count = kept;
        }
    }
    for (round = 0; round < WARM_START_ROUNDS; round++) {
        int wrong = 0, opened = 0;
        for (j = 0; j < work->count; j++) {
            const quadsim_nmpc_row *row = &work->row[j];
            work->d[j] = quadsim_nmpc_product(work, row, work->value) - quadsim_nmpc_bound(work, row);
            if (row->slack >= 0 && work->free[row->slack]) {
                work->d[j] += quadsim_nmpc_linear_price(work, row->slack) / quadsim_nmpc_quadratic_price(p, row->slack);
            }
        }
        solve_active(work, work->d, work->multiplier);
        for (j = work->count - 1; j >= 0; j--) {
            if (work->multiplier[j] < R(0.0)) {
                drop_row(work, j);
                wrong = 1;
            }
        }
        quadsim_nmpc_sum_prices(work);
        for (i = 0; !wrong && i < slacks; i++) { /* prices beyond what slacks at zero allow */
            if (!work->free[i] && work->price[i] > quadsim_nmpc_linear_price(work, i)) {
                set_slack(work, i, 1);
                opened = 1;
            }
        }
        if (!wrong && !opened) {
            for (j = 0; j < work->count; j++) {
                const real multiplier = work->multiplier[j], *response = response_of(work, j);
                long k;
                for (k = 0; k < size; k++) {
                    work->value[k] -= multiplier * response[k];
                }
            }
            return;
        }
    }
    clear_active_rows(work);
}

enum quadsim_nmpc_status quadsim_nmpc_search(quadsim_nmpc_work *work)
{
    start_from_active_rows(work);
    for (;;) {
        real most = FEASIBILITY_TOLERANCE;
        quadsim_nmpc_row row;
        enum quadsim_nmpc_status status;
        if (!quadsim_nmpc_worst_row(work, &row, &most)) {
            return work->count > 0 ? QUADSIM_NMPC_BOUNDED : QUADSIM_NMPC_FREE;
        }
        status = add_row(work, &row);
        if (status != QUADSIM_NMPC_BOUNDED) {
            clear_active_rows(work);
            return status;
        }
    }
}
