/* Rows: what is bounded in a quadratic program.
 *
 * A row bounds a sum of entries z of a node, perhaps of the node before, too:
 *
 *     a z <= b,  where it has a slack  a z - e <= b,  e >= 0,  and e costs  l e + q e^2 / 2.
 *
 * Several soft rows of a node share a slack, a variable of its own.  With y the sum of these rows' multipliers, its
 * price, the slack is zero until y reaches l, and e = (y - l) / q from then on: it is free.  Linear prices, l e, get a
 * small curvature q about an origin o that quadsim_nmpc_solve.c moves to the optimum: l e + q (e - o)^2 / 2. */
#include "quadsim_nmpc_qp.h"

enum { SIDES = QUADSIM_NMPC_SIDES, AXES = 3 };
enum { OF_TILT, OF_RATES, OF_FACES }; /* slacks of a node; those of stated rows follow */

static const real SIDE[SIDES][2] = {
    {R(1.0), R(0.0)},  {R(0.86602540378443864676), R(0.5)},   {R(0.5), R(0.86602540378443864676)},
    {R(0.0), R(1.0)},  {R(-0.5), R(0.86602540378443864676)},  {R(-0.86602540378443864676), R(0.5)},
    {R(-1.0), R(0.0)}, {R(-0.86602540378443864676), R(-0.5)}, {R(-0.5), R(-0.86602540378443864676)},
    {R(0.0), R(-1.0)}, {R(0.5), R(-0.86602540378443864676)},  {R(0.86602540378443864676), R(-0.5)}};

/* ---- which there are --------------------------------------------------------------------------------------------- */

/* A row of states; `of` is which slack of its node it has, where that has a price. */
static quadsim_nmpc_row row_of(const quadsim_nmpc_problem *p, int node, int kind, int index, int sign, int of)
{
    const int soft = of >= 0 && p->linear[of] < NO_LIMIT;
    const quadsim_nmpc_row row = {node, kind, index, sign, soft ? p->slacks * node + of : -1};
    return row;
}

static quadsim_nmpc_row row_of_side(const quadsim_nmpc_problem *p, int node, int side)
{
    return row_of(p, node, QUADSIM_NMPC_TILT, side, 1, OF_TILT);
}

static quadsim_nmpc_row row_of_rate(const quadsim_nmpc_problem *p, int node, int axis, int sign)
{
    return row_of(p, node, QUADSIM_NMPC_RATE, axis, sign, OF_RATES);
}

static quadsim_nmpc_row stated_row(const quadsim_nmpc_problem *p, int node, int index)
{
    return row_of(p, node, QUADSIM_NMPC_STATED, index, 1, p->slack[index]);
}

static quadsim_nmpc_row row_of_face(const quadsim_nmpc_problem *p, int node, int face)
{
    return row_of(p, node, QUADSIM_NMPC_FACE, face, 1, OF_FACES);
}

/* That a slack of a node is not negative. */
static quadsim_nmpc_row row_of_slack(const quadsim_nmpc_problem *p, int node, int slack)
{
    const quadsim_nmpc_row row = {node, QUADSIM_NMPC_SLACK, slack, -1, p->slacks * node + slack};
    return row;
}

int quadsim_nmpc_state_rows(const quadsim_nmpc_problem *p)
{
    return (p->tilts ? SIDES : 0) + (p->turns ? 2 * AXES : 0) + p->rows + p->faces;
}

void quadsim_nmpc_state_row(const quadsim_nmpc_problem *p, int node, int k, quadsim_nmpc_row *row)
{
    const int rates = p->tilts ? SIDES : 0, stated = rates + (p->turns ? 2 * AXES : 0), faces = stated + p->rows;
    if (k < rates) {
        *row = row_of_side(p, node, k);
    } else if (k < stated) {
        *row = row_of_rate(p, node, (k - rates) % AXES, k < rates + AXES ? 1 : -1);
    } else if (k < faces) {
        *row = stated_row(p, node, k - stated);
    } else {
        *row = row_of_face(p, node, k - faces);
    }
}

/* ---- entries ----------------------------------------------------------------------------------------------------- */

/* Where a node's body rates, and positions and velocities, are among its entries. */
static int rate_entries(const quadsim_nmpc_problem *p)
{
    return NU + (p->tilts ? 2 : 0);
}

static int place_entries(const quadsim_nmpc_problem *p)
{
    return rate_entries(p) + (p->turns ? AXES : 0);
}

void quadsim_nmpc_entries_at(const quadsim_nmpc_work *work, int i, int whole, const quadsim_real *inputs,
                             const quadsim_real *state, quadsim_real *entries)
{
    const quadsim_nmpc_problem *p = work->p;
    real *at = entries + (long)(i + 1) * entries_of(p);
    int a;
    memcpy(at, inputs, sizeof(real) * NU);
    at += NU;
    for (a = 0; p->tilts && a < 2; a++) {
        const real *axis = work->axis + 8 * (i < 0 ? 0 : i) + 4 * a;
        *at++ = i < 0 ? R(0.0)
                      : axis[0] * state[Q] + axis[1] * state[Q + 1] + axis[2] * state[Q + 2] + axis[3] * state[Q + 3] +
                            (whole ? work->known[2 * i + a] : R(0.0));
    }
    if (p->turns) {
        memcpy(at, state + W, sizeof(real) * AXES);
        at += AXES;
    }
    if (p->places) {
        memcpy(at, state + P, sizeof(real) * 3);
        memcpy(at + 3, state + V, sizeof(real) * 3);
    }
}

quadsim_real quadsim_nmpc_product(const quadsim_nmpc_work *work, const quadsim_nmpc_row *row,
                                  const quadsim_real *entries)
{
    const quadsim_nmpc_problem *p = work->p;
    const int w = entries_of(p), index = row->index;
    const real *at = entries + (long)(row->node + 1) * w, *place = at + place_entries(p), *normal;
    real sum = R(0.0);
    int j;
    switch (row->kind) {
    case QUADSIM_NMPC_INPUT:
        return row->sign > 0 ? at[index] : -at[index];
    case QUADSIM_NMPC_TILT:
        return SIDE[index][0] * at[NU] + SIDE[index][1] * at[NU + 1];
    case QUADSIM_NMPC_RATE:
        at += rate_entries(p);
        return row->sign > 0 ? at[index] : -at[index];
    case QUADSIM_NMPC_STATED:
        for (j = p->first[index]; j < p->first[index + 1]; j++) {
            sum += p->terms[j].coefficient * at[p->terms[j].entry - p->terms[j].lag * w];
        }
        return sum;
    case QUADSIM_NMPC_FACE:
        normal = work->face + 3 * (row->node * p->faces + index);
        return normal[0] * place[0] + normal[1] * place[1] + normal[2] * place[2];
    default:
        return R(0.0); /* a slack is no entry */
    }
}

quadsim_real quadsim_nmpc_known_part(const quadsim_nmpc_work *work, const quadsim_nmpc_row *row)
{
    const real *known = work->known + 2 * row->node;
    if (row->kind != QUADSIM_NMPC_TILT) {
        return R(0.0);
    }
    return SIDE[row->index][0] * known[0] + SIDE[row->index][1] * known[1];
}

quadsim_real quadsim_nmpc_bound(const quadsim_nmpc_work *work, const quadsim_nmpc_row *row)
{
    const quadsim_nmpc_problem *p = work->p;
    const int stated = row->node < p->bound_nodes ? row->node : p->bound_nodes - 1;
    switch (row->kind) {
    case QUADSIM_NMPC_INPUT:
        return row->sign > 0 ? p->upper[row->index] : -p->lower[row->index];
    case QUADSIM_NMPC_TILT:
        return p->tilt;
    case QUADSIM_NMPC_RATE:
        return p->turn[row->index];
    case QUADSIM_NMPC_STATED:
        return p->bounds[stated * p->rows + row->index];
    case QUADSIM_NMPC_FACE:
        return work->beyond[row->node * p->faces + row->index];
    default:
        return R(0.0);
    }
}

/* ---- gradients --------------------------------------------------------------------------------------------------- */

static void add_entry_gradient(const quadsim_nmpc_work *work, int node, int entry, real factor, real *inputs,
                               real *state)
{
    const quadsim_nmpc_problem *p = work->p;
    int j;
    if (entry < NU) {
        inputs[entry] += factor;
    } else if (entry < rate_entries(p)) {
        const real *axis = work->axis + 8 * node + 4 * (entry - NU);
        for (j = 0; j < 4; j++) {
            state[Q + j] += factor * axis[j];
        }
    } else if (entry < place_entries(p)) {
        state[W + entry - rate_entries(p)] += factor;
    } else {
        const int of = entry - place_entries(p);
        state[of < 3 ? P + of : V + of - 3] += factor;
    }
}

void quadsim_nmpc_add_row_gradient(const quadsim_nmpc_work *work, const quadsim_nmpc_row *row, int node,
                                   quadsim_real factor, quadsim_real *inputs, quadsim_real *state)
{
    const quadsim_nmpc_problem *p = work->p;
    const int lag = row->node - node, index = row->index;
    const real *normal;
    int j;
    if (row->kind == QUADSIM_NMPC_STATED) {
        for (j = p->first[index]; j < p->first[index + 1]; j++) {
            if (p->terms[j].lag == lag) {
                add_entry_gradient(work, node, p->terms[j].entry, factor * p->terms[j].coefficient, inputs, state);
            }
        }
        return;
    }
    if (lag > 0) {
        return;
    }
    switch (row->kind) {
    case QUADSIM_NMPC_INPUT:
        add_entry_gradient(work, node, index, row->sign > 0 ? factor : -factor, inputs, state);
        break;
    case QUADSIM_NMPC_TILT:
        add_entry_gradient(work, node, NU, factor * SIDE[index][0], inputs, state);
        add_entry_gradient(work, node, NU + 1, factor * SIDE[index][1], inputs, state);
        break;
    case QUADSIM_NMPC_RATE:
        add_entry_gradient(work, node, rate_entries(p) + index, row->sign > 0 ? factor : -factor, inputs, state);
        break;
    case QUADSIM_NMPC_FACE:
        normal = work->face + 3 * (node * p->faces + index);
        for (j = 0; j < 3; j++) {
            state[P + j] += factor * normal[j];
        }
        break;
    default:
        break;
    }
}

void quadsim_nmpc_add_active_gradients(const quadsim_nmpc_work *work, int node, quadsim_real *inputs,
                                       quadsim_real *state)
{
    int j;
    for (j = 0; j < work->count; j++) {
        const int lag = work->row[j].node - node;
        if (lag == 0 || lag == 1) {
            quadsim_nmpc_add_row_gradient(work, &work->row[j], node, work->multiplier[j], inputs, state);
        }
    }
}

/* ---- slacks ------------------------------------------------------------------------------------------------------ */

quadsim_real quadsim_nmpc_quadratic_price(const quadsim_nmpc_problem *p, int slack)
{
    const real quadratic = p->quadratic[slack % p->slacks];
    return quadratic > R(0.0) ? quadratic : LINEAR_PRICE_CURVATURE * p->linear[slack % p->slacks];
}

quadsim_real quadsim_nmpc_linear_price(const quadsim_nmpc_work *work, int slack)
{
    const quadsim_nmpc_problem *p = work->p;
    return p->linear[slack % p->slacks] - quadsim_nmpc_quadratic_price(p, slack) * work->origin[slack];
}

void quadsim_nmpc_close_slacks(quadsim_nmpc_work *work)
{
    memset(work->free, 0, sizeof(int) * (size_t)(work->p->slacks * work->p->horizon));
}

void quadsim_nmpc_sum_prices(quadsim_nmpc_work *work)
{
    int j;
    memset(work->price, 0, sizeof(real) * (size_t)(work->p->slacks * work->p->horizon));
    for (j = 0; j < work->count; j++) {
        if (work->row[j].slack >= 0) {
            work->price[work->row[j].slack] += work->multiplier[j];
        }
    }
}

quadsim_real quadsim_nmpc_slack_value(const quadsim_nmpc_work *work, int slack)
{
    if (!work->free[slack]) {
        return R(0.0);
    }
    return (work->price[slack] - quadsim_nmpc_linear_price(work, slack)) / quadsim_nmpc_quadratic_price(work->p, slack);
}

/* ---- violations -------------------------------------------------------------------------------------------------- */

quadsim_real quadsim_nmpc_violation(const quadsim_nmpc_work *work, const quadsim_nmpc_row *row, quadsim_real pending)
{
    const int slack = row->slack;
    real sum = quadsim_nmpc_product(work, row, work->value) - quadsim_nmpc_bound(work, row);
    if (slack >= 0 && work->free[slack]) {
        sum -= quadsim_nmpc_slack_value(work, slack) + pending / quadsim_nmpc_quadratic_price(work->p, slack);
    }
    return sum;
}

/* Whether a violation is the largest so far: it is then. */
static int is_worse(real violation, real *most)
{
    if (violation > *most) {
        *most = violation;
        return 1;
    }
    return 0;
}

int quadsim_nmpc_worst_row(const quadsim_nmpc_work *work, quadsim_nmpc_row *worst, quadsim_real *most)
{
    const quadsim_nmpc_problem *p = work->p;
    const int w = entries_of(p);
    int i, j, any = 0;
    for (i = 0; i < p->horizon; i++) {
        const real *at = work->value + (long)(i + 1) * w, *rates = at + rate_entries(p);
        for (j = 0; j < NU; j++) {
            const real above = at[j] - p->upper[j], below = p->lower[j] - at[j];
            if (is_worse(above > below ? above : below, most)) {
                *worst = row_of_input(i, j, above > below ? 1 : -1);
                any = 1;
            }
        }
        if (p->tilts && at[NU] * at[NU] + at[NU + 1] * at[NU + 1] > p->tilt * p->tilt) {
            const real allowed = p->tilt + quadsim_nmpc_slack_value(work, p->slacks * i + OF_TILT);
            for (j = 0; j < SIDES; j++) {
                if (is_worse(SIDE[j][0] * at[NU] + SIDE[j][1] * at[NU + 1] - allowed, most)) {
                    *worst = row_of_side(p, i, j);
                    any = 1;
                }
            }
        }
        for (j = 0; p->turns && j < AXES; j++) {
            const real slack = quadsim_nmpc_slack_value(work, p->slacks * i + OF_RATES);
            if (is_worse(magnitude(rates[j]) - p->turn[j] - slack, most)) {
                *worst = row_of_rate(p, i, j, rates[j] > R(0.0) ? 1 : -1);
                any = 1;
            }
        }
        for (j = 0; j < p->rows + p->faces; j++) {
            const quadsim_nmpc_row row = j < p->rows ? stated_row(p, i, j) : row_of_face(p, i, j - p->rows);
            if (is_worse(quadsim_nmpc_violation(work, &row, R(0.0)), most)) {
                *worst = row;
                any = 1;
            }
        }
        for (j = 0; j < p->slacks; j++) {
            if (is_worse(-quadsim_nmpc_slack_value(work, p->slacks * i + j), most)) {
                *worst = row_of_slack(p, i, j);
                any = 1;
            }
        }
    }
    return any;
}
