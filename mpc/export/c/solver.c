#include "quadsim_mpc.h"

#include <string.h>

#if defined __FINITE_MATH_ONLY__ && __FINITE_MATH_ONLY__
#error "compile without -ffast-math, which takes away the check that numbers are finite"
#endif

#ifdef QUADSIM_FLOAT
#define R(number) number##F
#else
#define R(number) number
#endif

typedef quadsim_real real;

enum { N = QUADSIM_HORIZON, M = QUADSIM_STEP_ROWS, ROOM = QUADSIM_ROOM, NU = 4, NX = QUADSIM_STATES };
enum { AXIS_STATES = QUADSIM_AXIS_STATES, AXIS_INPUTS = QUADSIM_AXIS_INPUTS };

/* One axis: a part of the problem with states x and inputs w of its own, u = u_s + T w.  Matrices are stored row by
 * row. */
struct axis {
    int states, inputs, first, outputs, targets; /* n, m, where w is among all axes' inputs, o, r */
    int shape;                                   /* n and m, as a number */
    int before;                                  /* whether the last m states are the inputs before */
    const unsigned char *state;                  /* which of the problem's states the first n are */
    const unsigned char *target;                 /* [r] which of x, y, z, yaw of the reference it follows */
    const unsigned char *row;                    /* [o] which rows have its states */
    const real *B;                               /* [n][m] */
    const real *closed;                          /* [N][n][n] A - B K_i */
    const real *K;                               /* [N][m][n] */
    const real *inverse;                         /* [N][m][m] (R + B' P_{i+1} B)^-1 */
    const real *W, *W_end;                       /* [n][r] pull of the reference, on the last state */
    const real *V, *V_end;                       /* [n][n] pull of the state at rest */
    const real *C;                               /* [o][n] */
    const real *responses;                       /* symmetric, lower part: of inputs and outputs of each step */
};

/* A row of each step: C x + sum of coefficient u_input(step - lag), within [lower, upper]. */
struct row {
    int axis;        /* whose states it has; -1: no axis's */
    int output;      /* which of that axis's outputs */
    int later;       /* whether C x is that at the end of the step */
    int first, past; /* its terms */
    int soft;        /* leaving the bounds by e costs l1 e + l2 e^2 */
    real l1, compliance; /* l1, 1 / (2 l2) */
};

struct term {
    real coefficient;
    int input, lag;
};

#include "quadsim_mpc_data.h"

/* Tolerances.  Those of rows are shares of the root of a row's response to itself, as if it had unit length. */
#ifdef QUADSIM_FLOAT
static const real FEASIBLE = 2e-5F;   /* violation of a bound */
static const real DEPENDENT = 3e-6F;  /* what other rows leave over of a row that is their combination */
static const real ROUNDED = 4e-7F;    /* of the largest multiplier, what rounding makes of a row's value */
static const real WRONG = 1e-6F;      /* multiplier of the wrong sign */
static const real NOTHING_OF = 1e-5F; /* share of a row in a combination */
#else
static const real FEASIBLE = 1e-11;
static const real DEPENDENT = 1e-9;
static const real ROUNDED = 1e-15;
static const real WRONG = 1e-12;
static const real NOTHING_OF = 1e-10;
#endif
static const real NO_BOUND = R(1e29);
static const real MOST_SLACK = R(8.0); /* by which tolerances are relaxed where rows come and go */
enum { MOST_CHANGES = QUADSIM_CHANGES }; /* of the active set in a search */

enum verdict { SOLVED, INFEASIBLE, GAVE_UP };

/* ---- numbers ---------------------------------------------------------------------------------------------------- */

static int is_finite(const real *numbers, int count)
{
    real even = R(0.0), odd = R(0.0); /* sums of zeros, and of NaN where a number is none, or infinite */
    int i;
    for (i = 0; i + 1 < count; i += 2) {
        even += numbers[i] * R(0.0);
        odd += numbers[i + 1] * R(0.0);
    }
    if (count % 2 == 1) {
        even += numbers[count - 1] * R(0.0);
    }
    return even + odd >= R(0.0);
}

static real magnitude(real number)
{
    return number < R(0.0) ? -number : number;
}

static real clipped(real number, real lower, real upper)
{
    const real least = number > lower ? number : lower;
    return least < upper ? least : upper;
}

static real dot(const real *left, const real *right, int count)
{
    real sum[4] = {R(0.0), R(0.0), R(0.0), R(0.0)};
    int i;
    for (i = 0; i + 3 < count; i += 4) { /* four sums at a time, so that none waits for the one before */
        sum[0] += left[i] * right[i];
        sum[1] += left[i + 1] * right[i + 1];
        sum[2] += left[i + 2] * right[i + 2];
        sum[3] += left[i + 3] * right[i + 3];
    }
    for (; i < count; i++) {
        sum[0] += left[i] * right[i];
    }
    return (sum[0] + sum[1]) + (sum[2] + sum[3]);
}
@AXES@
/* ---- rows --------------------------------------------------------------------------------------------------------- */

/* Add the terms of inputs u [N][4] to the rows' values [N][M]; u(k-1) is before. */
static void add_terms(const real *u, const real *before, real *values)
{
    int i, r, t;
    for (r = 0; r < M; r++) {
        for (i = 0; ROWS[r].axis < 0 && i < N; i++) {
            values[i * M + r] = R(0.0);
        }
        for (t = ROWS[r].first; t < ROWS[r].past; t++) {
            const struct term term = TERMS[t];
            const real *at = u + term.input;
            if (term.lag > 0) {
                values[r] += term.coefficient * before[term.input];
            }
            for (i = term.lag; i < N; i++, at += NU) {
                values[i * M + r] += term.coefficient * *at;
            }
        }
    }
}

/* u [N][4] = T w, of the axes' inputs w, axis after axis. */
static void inputs_of_axes(const real *w, real *u)
{
    int g, i, j, a;
    for (g = 0; g < QUADSIM_PARTS; g++) {
        const int m = AXES[g].inputs, first = AXES[g].first;
        for (a = 0; a < m; a++) {
            for (i = 0; i < N; i++) {
                const real own = w[first * N + i * m + a];
                for (j = 0; j < NU; j++) {
                    const real part = T[j * NU + first + a] * own;
                    u[i * NU + j] = first + a == 0 ? part : u[i * NU + j] + part;
                }
            }
        }
    }
}

static real lower_bound(int row)
{
    return LOWER[QUADSIM_BOUNDS_DIFFER ? row : row % M];
}

static real upper_bound(int row)
{
    return UPPER[QUADSIM_BOUNDS_DIFFER ? row : row % M];
}

/* How far a row is beyond the bound on a side of it, by the free optimum. */
static real excess(const quadsim_mpc *mpc, int row, int side)
{
    const struct row *kind = &ROWS[row % M];
    switch (side) {
    case 1:
        return mpc->value[row] - upper_bound(row);
    case -1:
        return mpc->value[row] - lower_bound(row);
    case 2:
        return mpc->value[row] - upper_bound(row) + kind->l1 * kind->compliance;
    default:
        return mpc->value[row] - lower_bound(row) - kind->l1 * kind->compliance;
    }
}

/* The number of the response of two entries to one another among an axis's. */
static int entry(int a, int b)
{
    return a >= b ? a * (a + 1) / 2 + b : b * (b + 1) / 2 + a;
}

/* A row in an axis's inputs and outputs of each step: entries and their coefficients; returns how many. */
static int expand(int row, int g, int entries[QUADSIM_ENTRIES], real coefficients[QUADSIM_ENTRIES])
{
    const struct row *kind = &ROWS[row % M];
    const struct axis *axis = &AXES[g];
    const int width = axis->inputs + axis->outputs, step = row / M;
    int count = 0, t, a;
    if (kind->axis == g) {
        entries[count] = step * width + axis->inputs + kind->output;
        coefficients[count++] = R(1.0);
    }
    for (t = kind->first; t < kind->past; t++) {
        const struct term term = TERMS[t];
        for (a = 0; step >= term.lag && a < axis->inputs; a++) {
            entries[count] = (step - term.lag) * width + a;
            coefficients[count++] = term.coefficient * T[term.input * NU + axis->first + a];
        }
    }
    return count;
}

/* sums[j] = G_row H^-1 G_j' of the active rows j and, the last, of the row itself. */
static void find_responses(const quadsim_mpc *mpc, int row, real *sums)
{
    int mine[QUADSIM_ENTRIES], theirs[QUADSIM_ENTRIES], g, j, a, b;
    real own[QUADSIM_ENTRIES], other[QUADSIM_ENTRIES];
    memset(sums, 0, (size_t)(mpc->count + 1) * sizeof(real));
    for (g = 0; g < QUADSIM_PARTS; g++) {
        const int count = expand(row, g, mine, own);
        for (j = 0; count > 0 && j <= mpc->count; j++) {
            const int others = expand(j < mpc->count ? mpc->row[j] : row, g, theirs, other);
            for (a = 0; a < count; a++) {
                for (b = 0; b < others; b++) {
                    sums[j] += own[a] * other[b] * AXES[g].responses[entry(mine[a], theirs[b])];
                }
            }
        }
    }
}

/* ---- the active set's system, S z = excess with S = L D L' ---------------------------------------------------------- */

static real *factor_row(quadsim_mpc *mpc, int j)
{
    return mpc->factor + j * (j - 1) / 2;
}

/* The next row of L, in place, and its pivot. */
static real next_pivot(quadsim_mpc *mpc, int row, int side)
{
    real sums[ROOM + 1], *next = factor_row(mpc, mpc->count), rest;
    int j;
    find_responses(mpc, row, sums);
    rest = sums[mpc->count];
    if (side == 2 || side == -2) {
        rest += ROWS[row % M].compliance;
    }
    for (j = 0; j < mpc->count; j++) {
        sums[j] -= dot(factor_row(mpc, j), sums, j);
    }
    for (j = 0; j < mpc->count; j++) {
        next[j] = sums[j] / mpc->pivot[j];
        rest -= next[j] * sums[j];
    }
    return rest;
}

/* L^-1 of the right side up to a row. */
static void solve_forward(quadsim_mpc *mpc)
{
    int j;
    for (j = mpc->solved; j < mpc->count; j++) {
        const int row = mpc->row[j];
        mpc->forward[j] = excess(mpc, row, mpc->side[row]) - dot(factor_row(mpc, j), mpc->forward, j);
    }
    mpc->solved = mpc->count;
}

/* L'^-1, in place. */
static void solve_backward(quadsim_mpc *mpc, real *right)
{
    int i, j;
    for (j = mpc->count - 1; j > 0; j--) {
        const real *row = factor_row(mpc, j);
        for (i = 0; i < j; i++) {
            right[i] -= row[i] * right[j];
        }
    }
}

/* The multipliers that put every active row on its bound. */
static void find_goal(quadsim_mpc *mpc)
{
    int j;
    solve_forward(mpc);
    for (j = 0; j < mpc->count; j++) {
        mpc->goal[j] = mpc->forward[j] / mpc->pivot[j];
    }
    solve_backward(mpc, mpc->goal);
}

/* A row joins, if it is no combination of those that are there; returns whether. */
static int append(quadsim_mpc *mpc, int row, int side, real z)
{
    const real rest = next_pivot(mpc, row, side), scale = SCALE[row];
    if (!(rest * scale * scale > DEPENDENT * mpc->slack)) {
        return 0;
    }
    mpc->pivot[mpc->count] = rest;
    mpc->row[mpc->count] = (short)row;
    mpc->z[mpc->count] = z;
    mpc->side[row] = (signed char)side;
    mpc->count++;
    return 1;
}

/* Move what follows a row that leaves forward by one; its column of L goes to removed. */
static void close_gap(quadsim_mpc *mpc, int gap, real *removed)
{
    int i, j;
    for (j = gap + 1; j < mpc->count; j++) {
        const real *from = factor_row(mpc, j);
        real *to = factor_row(mpc, j - 1);
        removed[j - 1] = from[gap];
        for (i = 0; i < gap; i++) {
            to[i] = from[i];
        }
        for (i = gap; i < j - 1; i++) {
            to[i] = from[i + 1];
        }
        mpc->row[j - 1] = mpc->row[j];
        mpc->z[j - 1] = mpc->z[j];
        mpc->pivot[j - 1] = mpc->pivot[j];
    }
}

/* A row leaves.  L D L' of what follows it gains pivot column column' (Gill, Golub, Murray and Saunders, 1974). */
static void leave(quadsim_mpc *mpc, int gap)
{
    real column[ROOM], share = mpc->pivot[gap];
    int i, j;
    mpc->side[mpc->row[gap]] = 0;
    close_gap(mpc, gap, column);
    mpc->count--;
    for (j = gap; j < mpc->count; j++) {
        const real p = column[j], before = mpc->pivot[j], after = before + share * p * p;
        const real weight = p * share / after;
        mpc->pivot[j] = after;
        share *= before / after;
        for (i = j + 1; i < mpc->count; i++) {
            real *l = factor_row(mpc, i) + j;
            column[i] -= p * *l;
            *l += weight * column[i];
        }
    }
    if (mpc->solved > gap) {
        mpc->solved = gap;
    }
}

/* ---- the dual active set method (Goldfarb and Idnani, 1983) ---------------------------------------------------------
 *
 * A row's side is 0 where it is inactive, 1 or -1 at its upper or lower bound, and 2 or -2 beyond it, for soft rows.
 * Its multiplier z is positive at upper bounds and negative at lower ones: of size 0 to l1 at the bound, l1 and more
 * beyond it.  Every change raises the dual function, so that no active set comes twice. */

static real least_size(int row, int side)
{
    return side == 2 || side == -2 ? ROWS[row % M].l1 : R(0.0);
}

/* How far a multiplier may move in a direction [+1 or -1] before its side ends; negative: never. */
static real room_of(int row, int side, real z, real direction)
{
    const real sign = side > 0 ? R(1.0) : R(-1.0), size = sign * z;
    if (sign * direction < R(0.0)) {
        const real left = size - least_size(row, side);
        return left > R(0.0) ? left : R(0.0);
    }
    if (ROWS[row % M].soft && (side == 1 || side == -1)) {
        const real left = ROWS[row % M].l1 - size;
        return left > R(0.0) ? left : R(0.0);
    }
    return R(-1.0);
}

/* By how much a multiplier is off its side, as of a row of unit length. */
static real wrong_by(const quadsim_mpc *mpc, int row, real z)
{
    const int side = mpc->side[row];
    const real size = side > 0 ? z : -z, least = least_size(row, side);
    real off = least - size;
    if (ROWS[row % M].soft && (side == 1 || side == -1) && size - ROWS[row % M].l1 > off) {
        off = size - ROWS[row % M].l1;
    }
    return off / SCALE[row] - WRONG * mpc->slack * (R(1.0) + least / SCALE[row]);
}

/* Take the multipliers towards their goal, as far as all stay on their sides; returns which one stops them, or -1. */
static int move_to_goal(quadsim_mpc *mpc)
{
    real share = R(2.0), worst = R(0.0);
    int stop = -1, j;
    for (j = 0; j < mpc->count; j++) {
        const int row = mpc->row[j];
        const real off = wrong_by(mpc, row, mpc->goal[j]), step = mpc->goal[j] - mpc->z[j];
        if (off > R(0.0)) {
            const real room = room_of(row, mpc->side[row], mpc->z[j], step);
            const real part = step > R(0.0) || step < R(0.0) ? room / magnitude(step) : R(0.0);
            if (stop < 0 || part < share || (part <= share && off > worst)) {
                share = part;
                worst = off;
                stop = j;
            }
        }
    }
    for (j = 0; j < mpc->count; j++) {
        mpc->z[j] = stop < 0 ? mpc->goal[j] : mpc->z[j] + share * (mpc->goal[j] - mpc->z[j]);
    }
    return stop;
}

/* The side on which a multiplier goes on from where its own ends. */
static int next_side(const quadsim_mpc *mpc, int j, real direction)
{
    const int side = mpc->side[mpc->row[j]];
    const int sign = side > 0 ? 1 : -1;
    if (side == 2 || side == -2) {
        return sign;
    }
    return (direction > R(0.0)) == (sign > 0) ? 2 * sign : 0;
}

/* A row goes on, on another side; returns whether it could. */
static int change_side(quadsim_mpc *mpc, int j, real direction)
{
    const int row = mpc->row[j], side = next_side(mpc, j, direction);
    const real z = side > 0 ? ROWS[row % M].l1 : -ROWS[row % M].l1;
    leave(mpc, j);
    mpc->changes++;
    mpc->spent++;
    return side == 0 || append(mpc, row, side, z);
}

/* Where a row that depends on active ones joins: the multipliers of these move by direction times combination for each
 * unit of its own, which changes no active row's value.  Returns which stops that, count for the row itself, or -1. */
static int first_stop(const quadsim_mpc *mpc, int row, int side, real z, real direction, const real *combination,
                      real *length)
{
    const real own = room_of(row, side, z, direction);
    int stop = own < R(0.0) ? -1 : mpc->count, j;
    *length = own;
    for (j = 0; j < mpc->count; j++) {
        const int active = mpc->row[j];
        const real rate = direction * combination[j];
        if (magnitude(rate) * SCALE[row] > NOTHING_OF * SCALE[active]) {
            const real room = room_of(active, mpc->side[active], mpc->z[j], rate);
            if (room >= R(0.0) && (stop < 0 || room < *length * magnitude(rate))) {
                *length = room / magnitude(rate);
                stop = j;
            }
        }
    }
    return stop;
}

/* A violated row joins; active ones that it depends on leave. */
static enum verdict enter(quadsim_mpc *mpc, int row, int side)
{
    real combination[ROOM], z = R(0.0), length, direction;
    int stop, j;
    mpc->changes++;
    mpc->spent++;
    while (mpc->count < ROOM && mpc->spent < MOST_CHANGES) {
        if (append(mpc, row, side, z)) {
            return SOLVED;
        }
        for (j = 0; j < mpc->count; j++) {
            combination[j] = -factor_row(mpc, mpc->count)[j];
        }
        solve_backward(mpc, combination);
        direction = side > 0 ? R(1.0) : R(-1.0);
        stop = first_stop(mpc, row, side, z, direction, combination, &length);
        if (stop < 0) {
            return INFEASIBLE;
        }
        for (j = 0; j < mpc->count; j++) {
            mpc->z[j] += length * direction * combination[j];
        }
        z += length * direction;
        if (stop == mpc->count) {
            side *= 2;
            z = side > 0 ? ROWS[row % M].l1 : -ROWS[row % M].l1;
        } else if (!change_side(mpc, stop, direction * combination[stop])) {
            return GAVE_UP;
        }
    }
    return GAVE_UP;
}

/* ---- what multipliers do ------------------------------------------------------------------------------------------- */

/* pull and push of the active rows on an axis: minus half of z' G; returns whether there is any. */
static int collect(quadsim_mpc *mpc, int g)
{
    const struct axis *axis = &AXES[g];
    const int n = axis->states, m = axis->inputs;
    int touched = 0, j, t, a;
    memset(mpc->pull, 0, (size_t)(N * n) * sizeof(real));
    memset(mpc->push, 0, (size_t)(N * m) * sizeof(real));
    for (j = 0; j < mpc->count; j++) {
        const int row = mpc->row[j], step = row / M;
        const struct row *kind = &ROWS[row % M];
        const real half = R(-0.5) * mpc->z[j];
        if (kind->axis == g) {
            const int at = kind->later ? step : step - 1;
            for (a = 0; at >= 0 && a < n; a++) {
                mpc->pull[at * n + a] += half * axis->C[kind->output * n + a];
            }
            touched = 1;
        }
        for (t = kind->first; t < kind->past; t++) {
            const struct term term = TERMS[t];
            for (a = 0; step >= term.lag && a < m; a++) {
                mpc->push[(step - term.lag) * m + a] += half * term.coefficient * T[term.input * NU + axis->first + a];
                touched = 1;
            }
        }
    }
    return touched;
}

/* dw of an axis, and shift of its rows' C x, by the multipliers. */
static void respond_axis(quadsim_mpc *mpc, int g)
{
    static const real at_rest[AXIS_STATES] = {R(0.0)};
    const struct axis *axis = &AXES[g];
    real *dw = mpc->dw + axis->first * N;
    int i, c;
    if (collect(mpc, g)) {
        plan(axis, mpc->pull, mpc->push, at_rest, dw, mpc->shift);
        return;
    }
    memset(dw, 0, (size_t)(N * axis->inputs) * sizeof(real));
    for (i = 0; i < N; i++) {
        for (c = 0; c < axis->outputs; c++) {
            mpc->shift[i * M + axis->row[c]] = R(0.0);
        }
    }
}

/* The size of the largest multiplier, as of rows of unit length. */
static real largest_multiplier(const quadsim_mpc *mpc)
{
    real largest = R(0.0);
    int j;
    for (j = 0; j < mpc->count; j++) {
        const real size = magnitude(mpc->z[j]) / SCALE[mpc->row[j]];
        largest = size > largest ? size : largest;
    }
    return largest;
}

/* The same of one axis alone, or of all and of all rows. */
static void respond(quadsim_mpc *mpc, int only)
{
    static const real before[NU] = {R(0.0)};
    int g;
    mpc->largest = largest_multiplier(mpc);
    if (only >= 0) {
        respond_axis(mpc, only);
        return;
    }
    memset(mpc->shift, 0, sizeof(mpc->shift));
    for (g = 0; g < QUADSIM_PARTS; g++) {
        respond_axis(mpc, g);
    }
    inputs_of_axes(mpc->dw, mpc->u);
    add_terms(mpc->u, before, mpc->shift);
}

enum { ALL = -1, OTHERS = -2 }; /* rows, instead of those of an axis */

/* Whether a row is one of those that only states of an axis are in, of all, or of all others. */
static int belongs(int row, int only)
{
    const struct row *kind = &ROWS[row % M];
    const int others = kind->axis < 0 || kind->first < kind->past;
    return only == ALL || (only == OTHERS ? others : kind->axis == only && !others);
}

/* Violation of a row of unit length that is taken for rounding. */
static real tolerance(const quadsim_mpc *mpc)
{
    const real rounded = ROUNDED * mpc->largest, most = R(15.0) * FEASIBLE; /* without end where there is no optimum */
    return FEASIBLE * mpc->slack + (rounded < most ? rounded : most);
}

/* The inactive row that is violated most, as of unit length, and its side; -1 for none. */
static int most_violated(const quadsim_mpc *mpc, int only, int *side)
{
    real most = R(0.0);
    int found = -1, i, r;
    for (r = 0; r < M; r++) {
        const real tolerated = tolerance(mpc) * TOLERANCE[r];
        const int steps = belongs(r, only) ? N : 0;
        for (i = 0; i < steps; i++) {
            const int row = i * M + r, bound = QUADSIM_BOUNDS_DIFFER ? row : r;
            const real value = mpc->value[row] + mpc->shift[row];
            const real above = value - UPPER[bound], below = LOWER[bound] - value;
            if (!(above > tolerated || below > tolerated) || mpc->side[row] != 0 || row == mpc->passed_over) {
                continue;
            }
            if ((above > below ? above : below) * SCALE[row] > most) {
                most = (above > below ? above : below) * SCALE[row];
                *side = above > below ? 1 : -1;
                found = row;
            }
        }
    }
    return found;
}

/* Whether a row is violated by so little that it may be rounding. */
static int is_slight(const quadsim_mpc *mpc, int row)
{
    const real value = mpc->value[row] + mpc->shift[row], much = R(100.0) * tolerance(mpc) * TOLERANCE[row % M];
    return value < upper_bound(row) + much && value > lower_bound(row) - much;
}

/* What an active row is off its bound by. */
static real residual(const quadsim_mpc *mpc, int j)
{
    const int row = mpc->row[j], side = mpc->side[row];
    real left = excess(mpc, row, side) + mpc->shift[row];
    if (side == 2 || side == -2) {
        left -= ROWS[row % M].compliance * mpc->z[j];
    }
    return left;
}

/* One step of refinement of the multipliers. */
static void refine(quadsim_mpc *mpc)
{
    real *correction = mpc->goal;
    int j;
    for (j = 0; j < mpc->count; j++) {
        correction[j] = residual(mpc, j) - dot(factor_row(mpc, j), correction, j);
    }
    for (j = 0; j < mpc->count; j++) {
        correction[j] /= mpc->pivot[j];
    }
    solve_backward(mpc, correction);
    for (j = 0; j < mpc->count; j++) {
        mpc->z[j] += correction[j];
    }
}

/* Whether all active rows are on their bounds. */
static int is_exact(const quadsim_mpc *mpc)
{
    int j;
    for (j = 0; j < mpc->count; j++) {
        if (!(magnitude(residual(mpc, j)) <= R(10.0) * tolerance(mpc) * TOLERANCE[mpc->row[j] % M])) {
            return 0;
        }
    }
    return 1;
}

/* The optimum from an active set on. */
static enum verdict improve(quadsim_mpc *mpc, int only)
{
    int refined = 0, side = 0, left = -1, row, stop;
    while (mpc->spent < MOST_CHANGES) {
        if (!refined) {
            find_goal(mpc);
            stop = move_to_goal(mpc);
            if (stop >= 0) {
                left = mpc->row[stop];
                if (!change_side(mpc, stop, mpc->goal[stop] - mpc->z[stop])) {
                    return GAVE_UP;
                }
                continue;
            }
        }
        respond(mpc, only);
        row = most_violated(mpc, only, &side);
        if (row >= 0 && (refined || mpc->count == 0 || !is_slight(mpc, row))) {
            const enum verdict verdict = enter(mpc, row, side);
            if ((row == left || mpc->spent >= MOST_CHANGES / 2) && mpc->slack < MOST_SLACK) {
                mpc->slack *= R(2.0); /* in circles, within rounding */
            } else if (row == left && is_slight(mpc, row)) {
                mpc->passed_over = row;
            }
            if (verdict != SOLVED) {
                return verdict;
            }
            refined = 0;
        } else if (row < 0 && (refined || mpc->count == 0)) {
            return is_exact(mpc) ? SOLVED : GAVE_UP;
        } else {
            refine(mpc);
            refined = 1;
        }
    }
    return GAVE_UP;
}

/* ---- starts ---------------------------------------------------------------------------------------------------------- */

/* No active row. */
static void start_cold(quadsim_mpc *mpc, int only)
{
    int row;
    mpc->count = mpc->solved = mpc->spent = 0;
    mpc->passed_over = -1;
    mpc->slack = R(1.0);
    for (row = 0; row < N * M; row++) {
        if (belongs(row, only)) {
            mpc->side[row] = 0;
        }
    }
}

/* Whether a row has a bound on a side. */
static int has_bound(int row, int side)
{
    return side > 0 ? upper_bound(row) < NO_BOUND : lower_bound(row) > -NO_BOUND;
}

/* The active rows of a set, at most as many as there is room for, and their multipliers as near to what their bounds
 * require as far as their sides allow. */
static void start_warm(quadsim_mpc *mpc, int only, const signed char *set)
{
    int row, j;
    start_cold(mpc, only);
    for (row = 0; row < N * M; row++) {
        const int side = set[row];
        if (side != 0 && belongs(row, only) && has_bound(row, side) && mpc->count < ROOM - 1) {
            (void)append(mpc, row, side, R(0.0));
        }
    }
    find_goal(mpc);
    for (j = 0; j < mpc->count; j++) {
        const int active = mpc->row[j], side = mpc->side[active];
        const struct row *kind = &ROWS[active % M];
        const real size = side > 0 ? mpc->goal[j] : -mpc->goal[j], least = least_size(active, side);
        real inside = size > least ? size : least;
        if (kind->soft && (side == 1 || side == -1) && inside > kind->l1) {
            inside = kind->l1;
        }
        mpc->z[j] = side > 0 ? inside : -inside;
    }
}

/* The optimum over the rows of one axis, or over all, from a set, and again without one if that fails. */
static enum verdict optimum(quadsim_mpc *mpc, int only, const signed char *set)
{
    enum verdict verdict;
    start_warm(mpc, only, set);
    verdict = improve(mpc, only);
    if (verdict != SOLVED) {
        start_cold(mpc, only);
        verdict = improve(mpc, only);
    }
    return verdict;
}

/* ---- the optimum ----------------------------------------------------------------------------------------------------- */

/* Deviations from rest at which an axis starts: of its states, and of the inputs before, away (4,), where it has them.
 * still (n,) is its state at rest. */
static void find_start(const struct axis *axis, const real *state, const real *rest, const real *away, real *start,
                       real *still)
{
    const int n = axis->states, own = axis->before ? n - axis->inputs : n;
    int j;
    for (j = 0; j < own; j++) {
        still[j] = rest[axis->state[j]];
        start[j] = state[axis->state[j]] - still[j];
    }
    for (j = own; j < n; j++) {
        still[j] = R(0.0);
        start[j] = dot(T_INVERSE + (axis->first + j - own) * NU, away, NU);
    }
}

/* pull [N][n] of the reference [N][4] and of the state at rest. */
static void find_pull(const struct axis *axis, const real *reference, const real *rest, const real *still, real *pull)
{
    static const unsigned char STATE_OF[4] = {0, 2, 4, 10}; /* which state x, y, z, yaw of the reference are */
    const int n = axis->states, r = axis->targets;
    int i, j, t;
    for (j = 0; j < n; j++) {
        const real rests = QUADSIM_RESTS ? -dot(axis->V + j * n, still, n) : R(0.0);
        for (i = 0; i < N - 1; i++) {
            pull[i * n + j] = rests;
        }
        pull[(N - 1) * n + j] = QUADSIM_RESTS ? -dot(axis->V_end + j * n, still, n) : R(0.0);
        for (t = 0; t < r; t++) {
            const real weight = axis->W[j * r + t], origin = rest[STATE_OF[axis->target[t]]];
            const real *wanted = reference + axis->target[t];
            for (i = 0; magnitude(weight) > R(0.0) && i < N - 1; i++) {
                pull[i * n + j] += weight * (wanted[i * 4] - origin);
            }
            pull[(N - 1) * n + j] += axis->W_end[j * r + t] * (wanted[(N - 1) * 4] - origin);
        }
    }
}

/* w of the free optimum, u in rotor speeds, and the rows' values.
 * state is x(k), rest and trim where the model rests, (x_s, u_s). */
static void find_free(quadsim_mpc *mpc, const real *state, const real *reference, const real *rest, const real *trim,
                      const real *acting)
{
    real start[AXIS_STATES], still[AXIS_STATES], away[NU];
    int g, i, j;
    for (j = 0; j < NU; j++) {
        away[j] = acting[j] - trim[j];
    }
    for (g = 0; g < QUADSIM_PARTS; g++) {
        const struct axis *axis = &AXES[g];
        find_start(axis, state, rest, away, start, still);
        find_pull(axis, reference, rest, still, mpc->pull);
        plan(axis, mpc->pull, NULL, start, mpc->w + axis->first * N, mpc->value);
        for (j = 0; j < axis->outputs; j++) {
            const real there = dot(axis->C + j * axis->states, still, axis->states);
            for (i = 0; i < N; i++) {
                mpc->value[i * M + axis->row[j]] += there;
            }
        }
    }
    inputs_of_axes(mpc->w, mpc->u);
    for (i = 0; i < N; i++) {
        for (j = 0; j < NU; j++) {
            mpc->u[i * NU + j] += trim[j];
        }
    }
    add_terms(mpc->u, acting, mpc->value);
}

/* Whether the free optimum keeps all bounds, to rounding. */
static int keeps_bounds(const quadsim_mpc *mpc)
{
    int i, r;
    for (i = 0; i < N; i++) {
        for (r = 0; r < M; r++) {
            const int row = i * M + r, bound = QUADSIM_BOUNDS_DIFFER ? row : r;
            const real value = mpc->value[row], tolerated = FEASIBLE * TOLERANCE[r];
            if (!(value <= UPPER[bound] + tolerated && value >= LOWER[bound] - tolerated)) {
                return 0;
            }
        }
    }
    return 1;
}

/* The last active set moved one step earlier, its last step's held. */
static void shift_set(quadsim_mpc *mpc)
{
    /* Through side, which is reset: compilers turn a loop into memmove. */
    memcpy(mpc->side, mpc->last + M, sizeof(mpc->side) - M);
    memcpy(mpc->last, mpc->side, sizeof(mpc->side) - M);
}

/* Whether an active set has a row that is not of one axis's states alone. */
static int has_inputs(const signed char *set)
{
    int row;
    for (row = 0; row < N * M; row++) {
        if (set[row] != 0 && ROWS[row % M].first < ROWS[row % M].past) {
            return 1;
        }
    }
    return 0;
}

/* u = u_s + T (w + dw) */
static void put_plan(quadsim_mpc *mpc, const real *trim)
{
    int i;
    inputs_of_axes(mpc->dw, mpc->u);
    inputs_of_axes(mpc->w, mpc->plan);
    for (i = 0; i < N * NU; i++) {
        mpc->plan[i] = trim[i % NU] + (mpc->plan[i] + mpc->u[i]);
    }
}

/* The optimum axis by axis with rows of states alone, its first command in axes; SOLVED if it keeps all others too,
 * INFEASIBLE if it does not, GAVE_UP if there is none. */
static enum verdict solve_axes(quadsim_mpc *mpc, const real *trim, real axes[NU])
{
    static const real before[NU] = {R(0.0)};
    int g, j, side = 0;
    memset(mpc->side, 0, sizeof(mpc->side));
    memset(mpc->shift, 0, sizeof(mpc->shift));
    memset(mpc->dw, 0, sizeof(mpc->dw));
    mpc->slack = R(1.0);
    mpc->largest = R(0.0);
    for (g = 0; g < QUADSIM_PARTS; g++) {
        if (most_violated(mpc, g, &side) >= 0 && optimum(mpc, g, mpc->last) != SOLVED) {
            return GAVE_UP;
        }
    }
    inputs_of_axes(mpc->dw, mpc->u);
    add_terms(mpc->u, before, mpc->shift);
    for (j = 0; j < NU; j++) {
        axes[j] = trim[j];
        for (g = 0; g < QUADSIM_PARTS; g++) {
            const int m = AXES[g].inputs, at = AXES[g].first * N;
            axes[j] += dot(T + j * NU + AXES[g].first, mpc->w + at, m);
        }
        axes[j] += mpc->u[j];
    }
    mpc->slack = R(1.0);
    return most_violated(mpc, OTHERS, &side) < 0 ? SOLVED : INFEASIBLE;
}

/* The optimum of the period, as mpc->plan, and how it was found.  Where there is none, QUADSIM_CLIPPED with the first
 * command of the axes' optimum in axes, or QUADSIM_SHIFTED without one. */
static enum quadsim_status optimise(quadsim_mpc *mpc, const real *state, const real *reference, const real *rest,
                                    const real *trim, const real *acting, real axes[NU])
{
    enum verdict found;
    signed char start[N * M];
    mpc->changes = 0;
    mpc->count = 0;
    mpc->slack = R(1.0);
    mpc->largest = R(0.0);
    mpc->passed_over = -1;
    find_free(mpc, state, reference, rest, trim, acting);
    if (!is_finite(mpc->u, N * NU)) {
        return QUADSIM_BEFORE;
    }
    if (keeps_bounds(mpc)) {
        memcpy(mpc->plan, mpc->u, sizeof(mpc->plan));
        memset(mpc->last, 0, sizeof(mpc->last));
        return QUADSIM_FREE;
    }
    shift_set(mpc);
    memset(mpc->side, 0, sizeof(mpc->side));
    found = QUADSIM_MIXED ? INFEASIBLE : solve_axes(mpc, trim, axes);
    if (found == SOLVED) {
        put_plan(mpc, trim);
        memcpy(mpc->last, mpc->side, sizeof(mpc->last));
        return QUADSIM_AXES;
    }
    if (found == INFEASIBLE) {
        memcpy(start, has_inputs(mpc->last) ? mpc->last : mpc->side, sizeof(start));
        if (optimum(mpc, ALL, start) == SOLVED) {
            put_plan(mpc, trim);
            memcpy(mpc->last, mpc->side, sizeof(mpc->last));
            return QUADSIM_WHOLE;
        }
    }
    memset(mpc->last, 0, sizeof(mpc->last));
    return found == GAVE_UP || QUADSIM_MIXED ? QUADSIM_SHIFTED : QUADSIM_CLIPPED;
}
