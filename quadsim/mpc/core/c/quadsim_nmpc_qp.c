/* The quadratic program of an iteration, solved exactly.
 *
 *     min  1/2 sum |s_i - goal_i|^2_Q + |u_i - aim_i|^2_R    s.t.  s_{i+1} = A_i s_i + B_i u_i + c_i  and bounds.
 *
 * A Riccati recursion finds the optimum of all inputs that are not held at a bound.  Where inputs alone are bounded, or
 * no other row is near its bound, three ways to the set of held inputs follow one another:
 *
 *  1. that of the last optimum, a node further on, changed by the primal-dual active-set method: a few recursions;
 *  2. that of an interior point method, then 1. again: at most MOST_INNER recursions, whatever the number of bounds,
 *     and once more with a smaller tolerance where that does not settle;
 *  3. the dual active-set method of Goldfarb and Idnani (1983), which adds violated rows one by one, and which takes soft
 *     rows, too.  What a row's multiplier does to all others, its response, is one pass backwards and forwards.
 *
 * A search that exchanges more than LONG_SEARCH rows per node starts again from what an interior point method of all rows
 * finds active: far from the reference it would exchange thousands.
 *
 * A slack that several soft rows of a node share is a variable of its own, zero and out of the way until the rows'
 * multipliers reach its linear price.
 *
 * Rows of a node, all as a z <= b: inputs above, below [4 each], sides of the tilt polygon [12], body rates above, below
 * [3 each], those that the caller states, half-spaces, and slacks, at least zero.  Multipliers of a work are theirs. */
#include "quadsim_nmpc_math.h"

enum { SIDES = QUADSIM_NMPC_SIDES, TILT = 2 * NU, SPIN = TILT + SIDES, STATED = SPIN + 6 };

#ifdef QUADSIM_FLOAT
static const real FEASIBLE = 2e-5F;  /* violation of a bound */
static const real DEPENDENT = 3e-6F; /* share of a row's response to itself that others leave of it */
static const real NOTHING = 1e-6F;   /* change of a multiplier by that of a row */
static const real COMPLEMENTARY_ROWS = 1e-4F; /* see below; of all rows */
#else
static const real FEASIBLE = 1e-10;
static const real DEPENDENT = 1e-11;
static const real NOTHING = 1e-13;
static const real COMPLEMENTARY_ROWS = 1e-6;
#endif
static const real COMPLEMENTARY = R(1e-3); /* mean product of multipliers and distances, where bounds tell */
static const real AGAIN = R(1e-5); /* the same, where what is active at first does not settle */
static const real LEAST_START = R(3.0); /* multiplier that it starts from */
static const real HARD = R(1e29), NEVER = R(1e30);
static const real CURVATURE = R(1e-5); /* of a linear price, in its proportion */
enum { WARM_ROUNDS = 30, MOST_ROUNDS = 4, MOST_INNER = 30, MOST_INNER_ROWS = 60, MOST_AGAIN = 20 };
enum { LONG_SEARCH = 5 }; /* changes per node that a search has before the interior point method of all rows */
enum { OF_TILT, OF_RATES, OF_FACES, OF_STATED }; /* slacks of a node */

static const int FREE_INPUTS[NU] = {0, 0, 0, 0};

static const real SIDE[SIDES][2] = {
    {R(1.0), R(0.0)},  {R(0.86602540378443864676), R(0.5)},  {R(0.5), R(0.86602540378443864676)},
    {R(0.0), R(1.0)},  {R(-0.5), R(0.86602540378443864676)}, {R(-0.86602540378443864676), R(0.5)},
    {R(-1.0), R(0.0)}, {R(-0.86602540378443864676), R(-0.5)}, {R(-0.5), R(-0.86602540378443864676)},
    {R(0.0), R(-1.0)}, {R(0.5), R(-0.86602540378443864676)}, {R(0.86602540378443864676), R(-0.5)}};

/* ---- the optimum without bounds ---------------------------------------------------------------------------------- */

/* Actuators and inputs before follow the inputs: this is the input of the a-th of them, and what a step leaves of the
 * distance from it. */
INLINED int followed(const int actuators, int a)
{
    return a < actuators ? a : a - actuators;
}

INLINED real left_of(const quadsim_nmpc_problem *p, const int actuators, int a)
{
    return a < actuators ? p->left[2 * p->substeps * NU + a] : R(0.0);
}

enum { WIDE = MOST + 1 };

/* Rows from..to of [A B]' P [A B], but for what is right of the block on the diagonal; sizes are constants, so that a
 * row stays in registers. */
INLINED void lower_rows(const quadsim_nmpc_work *work, const real *map, real both[MOST][WIDE + 1],
                        real H[WIDE + 1][WIDE + 1], const int actuators, const int moves, const int from, const int to)
{
    const quadsim_nmpc_problem *p = work->p;
    const int followers = actuators + (moves ? NU : 0), n = BODY + followers, width = (n + 2) & ~1, first = n - 3;
    const int past = to < width ? to : width, end = to < n + 1 ? to : n + 1;
    int j, k, r, a;
    for (j = from; j < end; j++) {
        real row[WIDE + 1] = {R(0.0)};
        for (k = 0; k < W; k++) {
            const real by = map[k * width + j];
            for (r = 0; r < past; r++) {
                row[r] += by * both[k][r];
            }
        }
        for (k = W; (j >= 7 || p->moments) && k < BODY; k++) {
            const real by = map[k * width + j];
            for (r = 0; r < past; r++) {
                row[r] += by * both[k][r];
            }
        }
        for (a = 0; a < followers; a++) {
            const real left = left_of(p, actuators, a);
            const real by = j == 10 + a ? left : j == first + followed(actuators, a) ? R(1.0) - left : R(0.0);
            for (r = 0; by != R(0.0) && r < past; r++) {
                row[r] += by * both[BODY + a][r];
            }
        }
        for (r = 0; r < past; r++) {
            H[j][r] = row[r];
        }
    }
}

/* One node backwards: from P of the next state to that of this one, without its own weight, and the gains.  Inputs that
 * are held at a bound do not answer; what they do, by g, is known. */
INLINED void riccati_node(quadsim_nmpc_work *work, int i, const int actuators, const int moves, const real *effort, const int *held,
                          real *cost, real *g)
{
    const quadsim_nmpc_problem *p = work->p;
    const int followers = actuators + (moves ? NU : 0), n = BODY + followers, width = (n + 2) & ~1, first = n - 3;
    const real *map = work->map + i * BODY * width;
    real *gain = work->gain + i * NU * n, *inverse = work->inverse + i * NU * NU;
    real both[MOST][WIDE + 1], H[WIDE + 1][WIDE + 1], pivot[NU] = {R(0.0)}, low[NU][NU], K[NU][MOST];
    int r, k, j, a, b;
    const int any = held[0] || held[1] || held[2] || held[3];
    for (r = 0; r < n; r++) { /* P [A B], but for A's first three columns, which are P's */
        real row[WIDE + 1] = {R(0.0)};
        for (k = 0; k < W; k++) {
            const real by = cost[r * n + k];
            for (j = 0; j < width; j++) {
                row[j] += by * map[k * width + j];
            }
        }
        for (k = W; p->moments && k < BODY; k++) { /* body rates depend on these by the air alone */
            const real by = cost[r * n + k];
            for (j = 0; j < 6; j++) {
                row[j] += by * map[k * width + j];
            }
        }
        for (k = W; k < BODY; k++) {
            const real by = cost[r * n + k];
            for (j = 6; j < width; j++) {
                row[j] += by * map[k * width + j];
            }
        }
        for (a = 0; a < followers; a++) {
            const real left = left_of(p, actuators, a);
            row[10 + a] += left * cost[r * n + BODY + a];
            row[first + followed(actuators, a)] += (R(1.0) - left) * cost[r * n + BODY + a];
        }
        for (j = 0; j < width; j++) {
            both[r][j] = row[j];
        }
    }
    lower_rows(work, map, both, H, actuators, moves, 0, 6);
    lower_rows(work, map, both, H, actuators, moves, 6, 10);
    lower_rows(work, map, both, H, actuators, moves, 10, 14);
    lower_rows(work, map, both, H, actuators, moves, 14, 18);
    lower_rows(work, map, both, H, actuators, moves, 18, 22);
    for (a = 0; a < NU; a++) { /* L D L' of R + B' P B, and its inverse */
        for (b = 0; b <= a; b++) {
            real sum = H[first + a][first + b] + (a == b ? effort[a] + (moves ? p->move : R(0.0)) : R(0.0));
            if (any && (held[a] || held[b])) {
                sum = a == b ? R(1.0) : R(0.0);
            }
            for (k = 0; k < b; k++) {
                sum -= low[a][k] * pivot[k] * low[b][k];
            }
            if (a == b) {
                pivot[a] = sum;
            } else {
                low[a][b] = sum / pivot[b];
            }
        }
    }
    for (b = 0; b < NU; b++) {
        real column[NU];
        for (a = 0; a < NU; a++) {
            column[a] = a == b ? R(1.0) : R(0.0);
            for (k = 0; k < a; k++) {
                column[a] -= low[a][k] * column[k];
            }
        }
        for (a = 0; a < NU; a++) {
            column[a] /= pivot[a];
        }
        for (a = NU - 1; a >= 0; a--) {
            for (k = a + 1; k < NU; k++) {
                column[a] -= low[k][a] * column[k];
            }
        }
        for (a = 0; a < NU; a++) {
            inverse[a * NU + b] = any && (held[a] || held[b]) ? R(0.0) : column[a];
        }
    }
    for (a = 0; any && a < NU; a++) {
        for (r = 0; held[a] && r < n; r++) {
            g[r] += both[r][first + a] * (held[a] > 0 ? p->upper[a] : p->lower[a]);
        }
    }
    for (a = 0; a < NU; a++) { /* B' P A, and from it the gain */
        for (j = 0; j < 3; j++) {
            K[a][j] = both[j][first + a];
        }
        for (j = 0; j < first; j++) {
            K[a][3 + j] = H[first + a][j];
        }
        if (moves) {
            K[a][n - NU + a] -= p->move;
        }
    }
    for (a = 0; a < NU; a++) {
        for (j = 0; j < n; j++) {
            gain[a * n + j] = inverse[a * NU] * K[0][j] + inverse[a * NU + 1] * K[1][j] + inverse[a * NU + 2] * K[2][j] +
                              inverse[a * NU + 3] * K[3][j];
        }
    }
    for (r = 0; r < n; r++) { /* A' P A - K' gain, the lower part, then the upper */
        real less[MOST];
        for (j = 0; j < n; j++) {
            less[j] = K[0][r] * gain[j] + K[1][r] * gain[n + j] + K[2][r] * gain[2 * n + j] + K[3][r] * gain[3 * n + j];
        }
        for (j = 0; j <= r; j++) {
            const real square = r < 3 ? cost[r * n + j] : j < 3 ? both[j][r - 3] : H[r - 3][j - 3];
            cost[r * n + j] = square - less[j];
        }
    }
    for (r = 0; r < n; r++) {
        for (j = 0; j < r; j++) {
            cost[j * n + r] = cost[r * n + j];
        }
    }
}

/* Add [A B]' g to a sum: the gradient of a node's state, but for the position's, and of its inputs. */
INLINED void carry_back(const quadsim_nmpc_work *work, int i, const int actuators, const int moves, const real *g,
                        real *sum)
{
    const int followers = actuators + (moves ? NU : 0), n = BODY + followers, width = (n + 2) & ~1;
    const real *map = work->map + i * BODY * width;
    int k, j, a;
    for (k = 0; k < BODY; k++) {
        const real by = g[k];
        for (j = 0; j < width; j++) {
            sum[j] += by * map[k * width + j];
        }
    }
    for (a = 0; a < followers; a++) {
        const real left = left_of(work->p, actuators, a);
        sum[10 + a] += left * g[BODY + a];
        sum[n - 3 + followed(actuators, a)] += (R(1.0) - left) * g[BODY + a];
    }
}

/* The feed of a node from the gradient g of the next state and push of the inputs; then that of this state. */
INLINED void backward_node(const quadsim_nmpc_work *work, int i, const int actuators, const int moves, const real *push, real *g,
                           real *feed)
{
    const int n = BODY + actuators + (moves ? NU : 0);
    const real *gain = work->gain + i * NU * n, *inverse = work->inverse + i * NU * NU;
    real sum[MOST + 2] = {R(0.0)}, v[NU];
    int j, a;
    carry_back(work, i, actuators, moves, g, sum);
    for (a = 0; a < NU; a++) {
        v[a] = sum[n - 3 + a] + (push != NULL ? push[a] : R(0.0));
    }
    for (j = 0; j < n - 3; j++) {
        g[3 + j] = sum[j];
    }
    for (a = 0; a < NU; a++) {
        feed[a] = -(inverse[a * NU] * v[0] + inverse[a * NU + 1] * v[1] + inverse[a * NU + 2] * v[2] +
                    inverse[a * NU + 3] * v[3]);
        for (j = 0; j < n; j++) {
            g[j] -= gain[a * n + j] * v[a];
        }
    }
}

/* The input of a state, and the next state; without feed none is added, without offset the map is linear. */
INLINED void forward_node(const quadsim_nmpc_work *work, int i, const int actuators, const int moves, const real *feed,
                          const real *offset, const real *s, real *u, real *next)
{
    const quadsim_nmpc_problem *p = work->p;
    const int followers = actuators + (moves ? NU : 0), n = BODY + followers, width = (n + 2) & ~1;
    const real *map = work->map + i * BODY * width, *gain = work->gain + i * NU * n;
    real at[MOST + 2] = {R(0.0)};
    int k, j, a;
    for (a = 0; a < NU; a++) {
        real even = feed != NULL ? feed[a] : R(0.0), odd = R(0.0);
        for (j = 0; j + 1 < n; j += 2) {
            even -= gain[a * n + j] * s[j];
            odd -= gain[a * n + j + 1] * s[j + 1];
        }
        u[a] = even + odd - (n % 2 ? gain[a * n + n - 1] * s[n - 1] : R(0.0));
    }
    for (j = 0; j < n - 3; j++) {
        at[j] = s[3 + j];
    }
    for (a = 0; a < NU; a++) {
        at[n - 3 + a] = u[a];
    }
    for (k = 0; k < BODY; k++) {
        real even = k < 3 ? s[k] : R(0.0), odd = offset != NULL ? offset[k] : R(0.0);
        for (j = 0; j < width; j += 2) {
            even += map[k * width + j] * at[j];
            odd += map[k * width + j + 1] * at[j + 1];
        }
        next[k] = even + odd;
    }
    for (a = 0; a < followers; a++) {
        const real input = u[followed(actuators, a)];
        next[BODY + a] = input + left_of(p, actuators, a) * (s[BODY + a] - input);
    }
}

/* ---- rows -------------------------------------------------------------------------------------------------------- */

/* Kinds of rows of a node; see above. */
static int faces_from(const quadsim_nmpc_problem *p)
{
    return STATED + p->rows;
}

static int slacks_from(const quadsim_nmpc_problem *p)
{
    return STATED + p->rows + p->faces;
}

static int kinds_of(const quadsim_nmpc_problem *p)
{
    return STATED + p->rows + p->faces + p->slacks;
}

/* Where a node's body rates, and positions and velocities, are among its entries. */
static int rates_at(const quadsim_nmpc_problem *p)
{
    return NU + (p->tilts ? 2 : 0);
}

static int places_at(const quadsim_nmpc_problem *p)
{
    return NU + (p->tilts ? 2 : 0) + (p->turns ? 3 : 0);
}

/* Entries [w] of a node among those of all, which begin with those before the first node. */
static long entries_size(const quadsim_nmpc_problem *p)
{
    return (long)(p->horizon + 1) * entries_of(p);
}

/* The inputs and bounded outputs of a node, from its input and the state at its end; of node -1 the known ones. */
static void entries_at(const quadsim_nmpc_work *work, int i, int whole, const real *u, const real *next, real *value)
{
    const quadsim_nmpc_problem *p = work->p;
    real *at = value + (long)(i + 1) * entries_of(p);
    int a;
    memcpy(at, u, sizeof(real) * NU);
    at += NU;
    for (a = 0; p->tilts && a < 2; a++) {
        const real *rows = work->axis + 8 * (i < 0 ? 0 : i) + 4 * a;
        *at++ = i < 0 ? R(0.0)
                      : rows[0] * next[Q] + rows[1] * next[Q + 1] + rows[2] * next[Q + 2] + rows[3] * next[Q + 3] +
                            (whole ? work->known[2 * i + a] : R(0.0));
    }
    if (p->turns) {
        memcpy(at, next + W, sizeof(real) * 3);
        at += 3;
    }
    if (p->places) {
        memcpy(at, next + P, sizeof(real) * 3);
        memcpy(at + 3, next + V, sizeof(real) * 3);
    }
}

/* The slack that a row has, of its node; -1 none. */
static int slack_of(const quadsim_nmpc_problem *p, int kind)
{
    int slack;
    if (kind >= slacks_from(p)) {
        return kind - slacks_from(p);
    }
    slack = kind < TILT     ? -1
            : kind < SPIN   ? OF_TILT
            : kind < STATED ? OF_RATES
            : kind < faces_from(p) ? p->slack[kind - STATED] : OF_FACES;
    return slack >= 0 && p->linear[slack] < HARD ? slack : -1;
}

/* A row's product with entries of all nodes. */
static real product(const quadsim_nmpc_work *work, int row, const real *value)
{
    const quadsim_nmpc_problem *p = work->p;
    const int node = row / kinds_of(p), kind = row % kinds_of(p), w = entries_of(p);
    const real *at = value + (long)(node + 1) * w;
    real sum = R(0.0);
    int t;
    if (kind < TILT) {
        return kind < NU ? at[kind] : -at[kind - NU];
    }
    if (kind < SPIN) {
        return SIDE[kind - TILT][0] * at[NU] + SIDE[kind - TILT][1] * at[NU + 1];
    }
    if (kind < STATED) {
        const real *rates = at + rates_at(p);
        return kind < SPIN + 3 ? rates[kind - SPIN] : -rates[kind - SPIN - 3];
    }
    if (kind < faces_from(p)) {
        for (t = p->first[kind - STATED]; t < p->first[kind - STATED + 1]; t++) {
            sum += p->terms[t].coefficient * at[p->terms[t].entry - p->terms[t].lag * w];
        }
    } else if (kind < slacks_from(p)) {
        const real *normal = work->face + 3 * (node * p->faces + kind - faces_from(p)), *place = at + places_at(p);
        sum = normal[0] * place[0] + normal[1] * place[1] + normal[2] * place[2];
    }
    return sum;
}

static real bound(const quadsim_nmpc_work *work, int row)
{
    const quadsim_nmpc_problem *p = work->p;
    const int node = row / kinds_of(p), kind = row % kinds_of(p);
    const int stated = node < p->bound_nodes ? node : p->bound_nodes - 1;
    return kind < NU              ? p->upper[kind]
           : kind < TILT          ? -p->lower[kind - NU]
           : kind < SPIN          ? p->tilt
           : kind < STATED        ? p->turn[(kind - SPIN) % 3]
           : kind < faces_from(p) ? p->bounds[stated * p->rows + kind - STATED]
           : kind < slacks_from(p) ? work->beyond[node * p->faces + kind - faces_from(p)]
                                   : R(0.0);
}

/* Add an entry with a factor to the gradients of its node's inputs [4] and of the state at the node's end [n]. */
static void pull_entry(const quadsim_nmpc_work *work, int node, int entry, real by, real *inputs, real *state)
{
    const quadsim_nmpc_problem *p = work->p;
    int j;
    if (entry < NU) {
        inputs[entry] += by;
    } else if (entry < rates_at(p)) {
        const real *rows = work->axis + 8 * node + 4 * (entry - NU);
        for (j = 0; j < 4; j++) {
            state[Q + j] += by * rows[j];
        }
    } else if (entry < places_at(p)) {
        state[W + entry - rates_at(p)] += by;
    } else {
        const int of = entry - places_at(p);
        state[of < 3 ? P + of : V + of - 3] += by;
    }
}

/* Add a row's terms in its own node, lag 0, or in the one before, lag 1, with a multiplier to that node's gradients. */
static void pull(const quadsim_nmpc_work *work, int row, int lag, real by, real *inputs, real *state)
{
    const quadsim_nmpc_problem *p = work->p;
    const int node = row / kinds_of(p), kind = row % kinds_of(p);
    int j;
    if (kind >= STATED && kind < faces_from(p)) {
        for (j = p->first[kind - STATED]; j < p->first[kind - STATED + 1]; j++) {
            if (p->terms[j].lag == lag) {
                pull_entry(work, node - lag, p->terms[j].entry, by * p->terms[j].coefficient, inputs, state);
            }
        }
        return;
    }
    if (lag > 0 || kind >= slacks_from(p)) {
        return;
    }
    if (kind < TILT) {
        pull_entry(work, node, kind % NU, kind < NU ? by : -by, inputs, state);
    } else if (kind < SPIN) {
        pull_entry(work, node, NU, by * SIDE[kind - TILT][0], inputs, state);
        pull_entry(work, node, NU + 1, by * SIDE[kind - TILT][1], inputs, state);
    } else if (kind < STATED) {
        pull_entry(work, node, rates_at(p) + (kind - SPIN) % 3, kind < SPIN + 3 ? by : -by, inputs, state);
    } else {
        const real *normal = work->face + 3 * (node * p->faces + kind - faces_from(p));
        for (j = 0; j < 3; j++) {
            state[P + j] += by * normal[j];
        }
    }
}

/* Add the active rows with their multipliers to the gradients of a node. */
static void pull_active(const quadsim_nmpc_work *work, int node, real *inputs, real *state)
{
    const int kinds = kinds_of(work->p);
    int j;
    for (j = 0; j < work->count; j++) {
        const int lag = work->row[j] / kinds - node;
        if (lag == 0 || lag == 1) {
            pull(work, work->row[j], lag, work->multiplier[j], inputs, state);
        }
    }
}

/* ---- passes, made for each number of states ------------------------------------------------------------------------ */

/* The quadratic and linear cost of the last state. */
INLINED void cost_at_end(const quadsim_nmpc_work *work, const int n, real *cost, real *g)
{
    const quadsim_nmpc_problem *p = work->p;
    int j, k;
    memcpy(cost, p->terminal, sizeof(real) * (size_t)(n * n));
    for (j = 0; j < n; j++) {
        g[j] = R(0.0);
        for (k = 0; k < n; k++) {
            g[j] -= cost[j * n + k] * work->goal[p->horizon * n + k];
        }
    }
}

/* Gains, and the optimum with the held inputs at their bounds and no other bounds.  Costs of all nodes' ends but the last
 * are kept in the responses' memory, [N - 1][n][n + 1], so that the next recursion may start from node `last`: that is
 * the last node whose held inputs have changed since. */
INLINED void optimum_sized(quadsim_nmpc_work *work, int last, const int actuators, const int moves)
{
    const quadsim_nmpc_problem *p = work->p;
    const int N = p->horizon, n = BODY + actuators + (moves ? NU : 0), size = n * (n + 1);
    real *kept = work->response, cost[MOST * MOST], g[MOST];
    int i, j, k;
    if (last < N - 1) {
        memcpy(cost, kept + last * size, sizeof(real) * (size_t)(n * n));
        memcpy(g, kept + last * size + n * n, sizeof(real) * (size_t)n);
    } else {
        cost_at_end(work, n, cost, g);
    }
    for (i = last; i >= 0; i--) {
        real push[NU];
        if (i < last) {
            memcpy(kept + i * size, cost, sizeof(real) * (size_t)(n * n));
            memcpy(kept + i * size + n * n, g, sizeof(real) * (size_t)n);
        }
        for (k = 0; k < BODY; k++) { /* actuators have no offset */
            for (j = 0; j < n; j++) {
                g[j] += cost[k * n + j] * work->offset[i * n + k];
            }
        }
        for (j = 0; j < NU; j++) {
            push[j] = -p->effort[j] * work->aim[i * NU + j];
        }
        riccati_node(work, i, actuators, moves, p->effort, work->held + i * NU, cost, g);
        backward_node(work, i, actuators, moves, push, g, work->feed + i * NU);
        for (j = 0; j < NU; j++) {
            const int side = work->held[i * NU + j];
            if (side != 0) {
                work->feed[i * NU + j] = side > 0 ? p->upper[j] : p->lower[j];
                if (moves) {
                    g[n - NU + j] -= p->move * work->feed[i * NU + j];
                }
            }
        }
        for (j = 0; j < n; j++) {
            cost[j * n + j] += p->weight[j];
            g[j] -= p->weight[j] * work->goal[i * n + j];
        }
    }
    memcpy(work->s, work->start, sizeof(real) * (size_t)n);
    for (i = 0; i < N; i++) {
        real *next = work->s + (i + 1) * n;
        forward_node(work, i, actuators, moves, work->feed + i * NU, work->offset + i * n, work->s + i * n,
                     work->v + i * NU, next);
        entries_at(work, i, 1, work->v + i * NU, next, work->value);
    }
}

/* The response [N+1][w] of all entries to a row: H^-1 a. */
INLINED void response_sized(quadsim_nmpc_work *work, int row, real *response, const int actuators, const int moves)
{
    const quadsim_nmpc_problem *p = work->p;
    const int N = p->horizon, n = BODY + actuators + (moves ? NU : 0), node = row / kinds_of(p);
    real g[MOST] = {R(0.0)}, push[NU] = {R(0.0)}, s[MOST] = {R(0.0)}, next[MOST], u[NU];
    int i;
    for (i = node; i >= 0; i--) {
        if (i >= node - 1) {
            memset(push, 0, sizeof push);
            pull(work, row, node - i, R(1.0), push, g);
        }
        backward_node(work, i, actuators, moves, i >= node - 1 ? push : NULL, g, work->more + i * NU);
    }
    memset(response, 0, sizeof(real) * (size_t)entries_of(p));
    for (i = 0; i < N; i++) {
        forward_node(work, i, actuators, moves, i <= node ? work->more + i * NU : NULL, NULL, s, u, next);
        entries_at(work, i, 0, u, next, response);
        memcpy(s, next, sizeof(real) * (size_t)n);
    }
}

/* The Lagrangian's gradient [N][4] in the inputs at (s, v), with the active rows' multipliers. */
INLINED void gradient_sized(quadsim_nmpc_work *work, real *gradient, const int actuators, const int moves)
{
    const quadsim_nmpc_problem *p = work->p;
    const int n = BODY + actuators + (moves ? NU : 0), N = p->horizon;
    real g[MOST];
    int i, j, k;
    for (j = 0; j < n; j++) {
        g[j] = R(0.0);
        for (k = 0; k < n; k++) {
            g[j] += p->terminal[j * n + k] * (work->s[N * n + k] - work->goal[N * n + k]);
        }
    }
    for (i = N - 1; i >= 0; i--) {
        const real *s = work->s + i * n, *v = work->v + i * NU;
        real sum[MOST + 2] = {R(0.0)}, push[NU] = {R(0.0)};
        pull_active(work, i, push, g);
        carry_back(work, i, actuators, moves, g, sum);
        for (j = 0; j < NU; j++) {
            const real step = moves ? p->move * (v[j] - s[n - NU + j]) : R(0.0);
            gradient[i * NU + j] = sum[n - 3 + j] + push[j] + p->effort[j] * (v[j] - work->aim[i * NU + j]) + step;
        }
        for (j = 0; j < n - 3; j++) {
            g[3 + j] = sum[j];
        }
        for (j = 0; j < n; j++) {
            g[j] += p->weight[j] * (s[j] - work->goal[i * n + j]);
        }
        for (j = 0; moves && j < NU; j++) {
            g[n - NU + j] -= p->move * v[j];
        }
    }
}

/* The optimum with the active rows' multipliers. */
INLINED void finish_sized(quadsim_nmpc_work *work, const int actuators, const int moves)
{
    const quadsim_nmpc_problem *p = work->p;
    const int n = BODY + actuators + (moves ? NU : 0);
    real g[MOST] = {R(0.0)};
    int i, j;
    for (i = p->horizon - 1; i >= 0; i--) {
        real push[NU] = {R(0.0)};
        pull_active(work, i, push, g);
        backward_node(work, i, actuators, moves, push, g, work->more + i * NU);
        for (j = 0; j < NU; j++) {
            work->more[i * NU + j] += work->feed[i * NU + j];
        }
    }
    for (i = 0; i < p->horizon; i++) {
        forward_node(work, i, actuators, moves, work->more + i * NU, work->offset + i * n, work->s + i * n,
                     work->v + i * NU, work->s + (i + 1) * n);
        entries_at(work, i, 1, work->v + i * NU, work->s + (i + 1) * n, work->value);
    }
}

/* Call a function that is made for each number of actuators, with moves and without; with QUADSIM_SIZES, as 4,0, for
 * these alone. */
#if defined QUADSIM_ANY_SIZE
#define SIZED(function, ...) function(__VA_ARGS__, work->p->actuators, work->p->moves ? 1 : 0);
#elif defined QUADSIM_SIZES
#define SIZED(function, ...) function(__VA_ARGS__, QUADSIM_SIZES);
#else
#define SIZED(function, ...)                                              \
    switch (2 * work->p->actuators + (work->p->moves ? 1 : 0)) {          \
    case 0:                                                               \
        function(__VA_ARGS__, 0, 0);                                      \
        break;                                                            \
    case 1:                                                               \
        function(__VA_ARGS__, 0, 1);                                      \
        break;                                                            \
    case 2:                                                               \
        function(__VA_ARGS__, 1, 0);                                      \
        break;                                                            \
    case 3:                                                               \
        function(__VA_ARGS__, 1, 1);                                      \
        break;                                                            \
    case 8:                                                               \
        function(__VA_ARGS__, 4, 0);                                      \
        break;                                                            \
    default:                                                              \
        function(__VA_ARGS__, 4, 1);                                      \
    }
#endif

static void optimum(quadsim_nmpc_work *work, int last)
{
    SIZED(optimum_sized, work, last)
}

static void gradient(quadsim_nmpc_work *work, real *all)
{
    SIZED(gradient_sized, work, all)
}

static void respond(quadsim_nmpc_work *work, int row, real *response)
{
    const long size = entries_size(work->p);
    long i;
    if (row % kinds_of(work->p) >= slacks_from(work->p)) {
        memset(response, 0, sizeof(real) * (size_t)size);
        return;
    }
    SIZED(response_sized, work, row, response)
    for (i = 0; i < size; i++) {
        response[i] = -response[i];
    }
}

static void finish(quadsim_nmpc_work *work)
{
    SIZED(finish_sized, work)
}

/* ---- the active set ---------------------------------------------------------------------------------------------- */

static real *response_of(const quadsim_nmpc_work *work, int j)
{
    return work->response + (long)j * entries_size(work->p);
}

static real *factor_of(const quadsim_nmpc_work *work, int j)
{
    return work->factor + (long)j * (j + 1) / 2;
}

/* The slack of a row among those of all nodes; -1 if it has none. */
static int slot_of(const quadsim_nmpc_problem *p, int row)
{
    const int slack = slack_of(p, row % kinds_of(p));
    return slack < 0 ? -1 : p->slacks * (row / kinds_of(p)) + slack;
}

/* The prices of a slack e: linear ones, l e, get a curvature about the origin o that solve_again moves to the optimum,
 * l e + q (e - o)^2 / 2. */
static real quadratic_of(const quadsim_nmpc_problem *p, int slot)
{
    const real quadratic = p->quadratic[slot % p->slacks];
    return quadratic > R(0.0) ? quadratic : CURVATURE * p->linear[slot % p->slacks];
}

static real linear_of(const quadsim_nmpc_work *work, int slot)
{
    const quadsim_nmpc_problem *p = work->p;
    return p->linear[slot % p->slacks] - quadratic_of(p, slot) * work->origin[slot];
}

/* A row's response to another, whose response and slack are given. */
static real mutual(const quadsim_nmpc_work *work, int row, int slot, int other, const real *response)
{
    real sum = product(work, row, response);
    if (slot >= 0 && slot == other && work->free[slot]) {
        sum += R(1.0) / quadratic_of(work->p, slot); /* a z - e <= b, and -e <= 0: the product of -1 and -1 */
    }
    return sum;
}

/* Row j of the factor L D L', from the responses; whether the row is not a combination of those before. */
static int factorise_row(quadsim_nmpc_work *work, int j)
{
    const real *response = response_of(work, j);
    const int slot = work->slot[j];
    real *mine = factor_of(work, j), whole;
    int k;
    for (k = 0; k < j; k++) { /* L D first */
        mine[k] = mutual(work, work->row[k], work->slot[k], slot, response) - dot(mine, factor_of(work, k), k);
    }
    mine[j] = whole = mutual(work, work->row[j], slot, slot, response);
    for (k = 0; k < j; k++) {
        const real scaled = mine[k] / factor_of(work, k)[k];
        mine[j] -= scaled * mine[k];
        mine[k] = scaled;
    }
    return mine[j] > DEPENDENT * whole;
}

/* Add weight z z' to the product of the factor, from row j on (Gill, Golub, Murray and Saunders 1974); z is overwritten. */
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

static void drop(quadsim_nmpc_work *work, int j)
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
        work->slot[k] = work->slot[k + 1];
        work->multiplier[k] = work->multiplier[k + 1];
        memcpy(response_of(work, k), response_of(work, k + 1), size);
    }
    update_factor(work, j, weight, work->d);
}

/* Let a slack be positive, or zero. */
static void set_slack(quadsim_nmpc_work *work, int slot, int free)
{
    const real weight = R(1.0) / quadratic_of(work->p, slot);
    int j;
    work->free[slot] = free;
    for (j = 0; j < work->count; j++) {
        work->d[j] = work->slot[j] == slot ? R(1.0) : R(0.0);
    }
    update_factor(work, 0, free ? weight : -weight, work->d);
}

/* Sums of the multipliers of the rows that share a slack. */
static void add_prices(quadsim_nmpc_work *work)
{
    int j;
    memset(work->price, 0, sizeof(real) * (size_t)(work->p->slacks * work->p->horizon));
    for (j = 0; j < work->count; j++) {
        if (work->slot[j] >= 0) {
            work->price[work->slot[j]] += work->multiplier[j];
        }
    }
}

static real slack_value(const quadsim_nmpc_work *work, int slot)
{
    return work->free[slot] ? (work->price[slot] - linear_of(work, slot)) / quadratic_of(work->p, slot) : R(0.0);
}

/* By how much a row is violated, where its own multiplier that is not yet active adds to its slack. */
static real violation(const quadsim_nmpc_work *work, int row, real pending)
{
    const quadsim_nmpc_problem *p = work->p;
    const int slot = slot_of(p, row);
    real sum = product(work, row, work->value) - bound(work, row);
    if (slot >= 0 && work->free[slot]) {
        sum -= slack_value(work, slot) + pending / quadratic_of(p, slot);
    }
    return sum;
}

/* The most violated row, by more than *most, which becomes its violation; -1 if none is. */
static int worst_row(const quadsim_nmpc_work *work, real *most)
{
    const quadsim_nmpc_problem *p = work->p;
    const int w = entries_of(p), kinds = kinds_of(p), last = slacks_from(p);
    int i, kind, worst = -1;
    for (i = 0; i < p->horizon; i++) {
        const real *at = work->value + (long)(i + 1) * w, *rates = at + rates_at(p);
        for (kind = 0; kind < NU; kind++) {
            const real above = at[kind] - p->upper[kind], below = p->lower[kind] - at[kind];
            if (above > *most || below > *most) {
                *most = above > below ? above : below;
                worst = i * kinds + (above > below ? kind : NU + kind);
            }
        }
        if (p->tilts && at[NU] * at[NU] + at[NU + 1] * at[NU + 1] > p->tilt * p->tilt) {
            const real allowed = p->tilt + slack_value(work, p->slacks * i + OF_TILT);
            for (kind = 0; kind < SIDES; kind++) {
                const real beyond = SIDE[kind][0] * at[NU] + SIDE[kind][1] * at[NU + 1] - allowed;
                if (beyond > *most) {
                    *most = beyond;
                    worst = i * kinds + TILT + kind;
                }
            }
        }
        for (kind = 0; p->turns && kind < 3; kind++) {
            const real beyond = magnitude(rates[kind]) - p->turn[kind] - slack_value(work, p->slacks * i + OF_RATES);
            if (beyond > *most) {
                *most = beyond;
                worst = i * kinds + SPIN + kind + (rates[kind] > R(0.0) ? 0 : 3);
            }
        }
        for (kind = STATED; kind < last; kind++) {
            const real beyond = violation(work, i * kinds + kind, R(0.0));
            if (beyond > *most) {
                *most = beyond;
                worst = i * kinds + kind;
            }
        }
        for (kind = 0; kind < p->slacks; kind++) {
            const real below = -slack_value(work, p->slacks * i + kind);
            if (below > *most) {
                *most = below;
                worst = i * kinds + last + kind;
            }
        }
    }
    return worst;
}

/* Move all entries by a step along a row's response, and the active rows' answer r. */
static void move(quadsim_nmpc_work *work, real step, const real *response)
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
    add_prices(work);
}

/* The slack at zero that opens first as a row's multiplier, now `multiplier`, grows by less than *longest; -1 if none. */
static int first_to_open(quadsim_nmpc_work *work, int slot, real multiplier, real *longest)
{
    const quadsim_nmpc_problem *p = work->p;
    int j, opens = -1;
    memset(work->rate, 0, sizeof(real) * (size_t)(p->slacks * p->horizon));
    for (j = 0; j < work->count; j++) {
        if (work->slot[j] >= 0) {
            work->rate[work->slot[j]] -= work->r[j];
        }
    }
    if (slot >= 0) {
        work->rate[slot] += R(1.0);
    }
    for (j = 0; j < p->slacks * p->horizon; j++) {
        const real rate = work->rate[j];
        const real room = linear_of(work, j) - work->price[j] - (j == slot ? multiplier : R(0.0));
        if (rate > NOTHING && !work->free[j] && room < *longest * rate) {
            *longest = room > R(0.0) ? room / rate : R(0.0);
            opens = j;
        }
    }
    return opens;
}

/* Make a violated row active, and drop what must go. */
static enum quadsim_nmpc_status add_row(quadsim_nmpc_work *work, int row)
{
    const quadsim_nmpc_problem *p = work->p;
    const int slot = slot_of(p, row), of_slack = row % kinds_of(p) >= slacks_from(p);
    real multiplier = R(0.0);
    if (work->count == p->room) {
        return QUADSIM_NMPC_NO_ROOM;
    }
    respond(work, row, work->own);
    for (;;) {
        const real whole = mutual(work, row, slot, slot, work->own);
        real left = whole, longest = NEVER, full;
        int j, blocks = -1, opens;
        if (++work->changes > work->allowed) {
            return QUADSIM_NMPC_GIVEN_UP;
        }
        for (j = 0; j < work->count; j++) {
            work->d[j] = mutual(work, work->row[j], work->slot[j], slot, work->own);
        }
        solve_active(work, work->d, work->r);
        left -= dot(work->d, work->r, work->count);
        for (j = 0; j < work->count; j++) {
            if (work->r[j] > NOTHING && work->multiplier[j] < longest * work->r[j]) {
                longest = work->multiplier[j] / work->r[j];
                blocks = j;
            }
        }
        opens = first_to_open(work, slot, multiplier, &longest);
        full = left > DEPENDENT * whole ? violation(work, row, multiplier) / left : NEVER;
        if (full < longest) {
            longest = full;
        }
        if (longest >= NEVER) {
            return QUADSIM_NMPC_INFEASIBLE;
        }
        multiplier += longest;
        move(work, longest, work->own);
        if (longest == full) {
            if (of_slack) {
                set_slack(work, slot, 0);
                return QUADSIM_NMPC_BOUNDED;
            }
            work->row[work->count] = row;
            work->slot[work->count] = slot;
            work->multiplier[work->count] = multiplier;
            memcpy(response_of(work, work->count), work->own, sizeof(real) * (size_t)entries_size(p));
            (void)factorise_row(work, work->count);
            work->count++;
            add_prices(work);
            return QUADSIM_NMPC_BOUNDED;
        }
        if (opens >= 0) {
            set_slack(work, opens, 1);
        } else {
            drop(work, blocks);
        }
    }
}

static void close_slacks(quadsim_nmpc_work *work)
{
    memset(work->free, 0, sizeof(int) * (size_t)(work->p->slacks * work->p->horizon));
}

static void start_cold(quadsim_nmpc_work *work)
{
    work->count = 0;
    close_slacks(work);
    add_prices(work);
}

/* Start from the active set that is there: the rows that have positive multipliers with the present values. */
static void start_warm(quadsim_nmpc_work *work)
{
    const quadsim_nmpc_problem *p = work->p;
    const int slots = p->slacks * p->horizon, count = work->count;
    const long size = entries_size(p);
    int j, i, round, kept = 0;
    work->count = 0;
    for (j = 0; j < count; j++) {
        const int row = work->row[j];
        work->row[kept] = row;
        work->slot[kept] = slot_of(p, row);
        respond(work, row, response_of(work, kept));
        if (factorise_row(work, kept)) {
            kept++;
            work->count = kept;
        }
    }
    for (round = 0; round < WARM_ROUNDS; round++) {
        int wrong = 0, opened = 0;
        for (j = 0; j < work->count; j++) {
            const int slot = work->slot[j];
            work->d[j] = product(work, work->row[j], work->value) - bound(work, work->row[j]);
            if (slot >= 0 && work->free[slot]) {
                work->d[j] += linear_of(work, slot) / quadratic_of(p, slot);
            }
        }
        solve_active(work, work->d, work->multiplier);
        for (j = work->count - 1; j >= 0; j--) {
            if (work->multiplier[j] < R(0.0)) {
                drop(work, j);
                wrong = 1;
            }
        }
        add_prices(work);
        for (i = 0; !wrong && i < slots; i++) { /* prices beyond what slacks at zero allow */
            if (!work->free[i] && work->price[i] > linear_of(work, i)) {
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
    start_cold(work);
}

/* The optimum from the active set that is there, by the method of Goldfarb and Idnani. */
static enum quadsim_nmpc_status search(quadsim_nmpc_work *work)
{
    start_warm(work);
    for (;;) {
        real most = FEASIBLE;
        const int row = worst_row(work, &most);
        enum quadsim_nmpc_status status;
        if (row < 0) {
            return work->count > 0 ? QUADSIM_NMPC_BOUNDED : QUADSIM_NMPC_FREE;
        }
        status = add_row(work, row);
        if (status != QUADSIM_NMPC_BOUNDED) {
            start_cold(work);
            return status;
        }
    }
}

/* ---- inputs alone ------------------------------------------------------------------------------------------------ */

/* Hold inputs that leave their bounds, release those whose multipliers have the wrong sign, until there are none: the
 * primal-dual active-set method (Hintermueller, Ito and Kunisch 2002), a Riccati recursion each, from the last node that
 * changes.  Where it is `hasty`, it ends as soon as the changes do not get fewer, or are many at first.  Whether it
 * settled. */
static int settle(quadsim_nmpc_work *work, int rounds, int hasty)
{
    const quadsim_nmpc_problem *p = work->p;
    const int size = p->horizon * NU;
    int i, round, last = p->horizon - 1, before = p->horizon + 1;
    for (round = 0; round < rounds; round++) {
        int changed = 0, any = 0, at = 0;
        optimum(work, last);
        work->rounds++;
        for (i = 0; i < size; i++) {
            any |= work->held[i];
        }
        if (any) {
            gradient(work, work->own);
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
            } else if (input > p->upper[i % NU] + FEASIBLE || input < p->lower[i % NU] - FEASIBLE) {
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

/* Rows that an interior point method weighs: w z^2 / 2 + c z each, [N][kinds without slacks]; those of inputs are part of
 * their effort. */
typedef struct weighed {
    const real *weight, *slope;
    real *value; /* [N+1][w] the entries that follow */
} weighed;

/* Add the weighed rows of a node's end to the cost of that state. */
INLINED void weigh_rows(const quadsim_nmpc_work *work, int i, const int n, const weighed *rows, int factorise, real *cost,
                        real *g)
{
    const quadsim_nmpc_problem *p = work->p;
    const int kinds = slacks_from(p);
    int kind, j, k;
    for (kind = TILT; kind < kinds; kind++) {
        const real weight = rows->weight[i * kinds + kind], slope = rows->slope[i * kinds + kind];
        real inputs[NU] = {R(0.0)}, z[MOST] = {R(0.0)};
        if (weight == R(0.0)) {
            continue;
        }
        pull(work, i * kinds_of(p) + kind, 0, R(1.0), inputs, z);
        for (j = 0; j < BODY; j++) {
            for (k = 0; factorise && z[j] != R(0.0) && k < BODY; k++) {
                cost[j * n + k] += weight * z[j] * z[k];
            }
            g[j] += slope * z[j];
        }
    }
}

/* One Newton step of an interior point method: with these weights and pushes of inputs, and rows, all inputs v [N][4]. */
INLINED void barrier_sized(quadsim_nmpc_work *work, const real *effort, const real *push, int factorise, real *known,
                           real *v, const weighed *rows, const int actuators, const int moves)
{
    const quadsim_nmpc_problem *p = work->p;
    const int N = p->horizon, n = BODY + actuators + (moves ? NU : 0);
    real cost[MOST * MOST], g[MOST], s[MOST], next[MOST];
    int i, j, k;
    cost_at_end(work, n, cost, g);
    for (i = N - 1; i >= 0; i--) {
        if (rows != NULL) {
            weigh_rows(work, i, n, rows, factorise, cost, g);
        }
        for (j = 0; j < n; j++) {
            if (factorise) { /* P c */
                known[i * n + j] = R(0.0);
                for (k = 0; k < BODY; k++) {
                    known[i * n + j] += cost[j * n + k] * work->offset[i * n + k];
                }
            }
            g[j] += known[i * n + j];
        }
        if (factorise) {
            riccati_node(work, i, actuators, moves, effort + i * NU, FREE_INPUTS, cost, g);
        }
        backward_node(work, i, actuators, moves, push + i * NU, g, work->more + i * NU);
        for (j = 0; j < n; j++) {
            cost[j * n + j] += p->weight[j];
            g[j] -= p->weight[j] * work->goal[i * n + j];
        }
    }
    memcpy(s, work->start, sizeof(real) * (size_t)n);
    for (i = 0; i < N; i++) {
        forward_node(work, i, actuators, moves, work->more + i * NU, work->offset + i * n, s, v + i * NU, next);
        if (rows != NULL) {
            entries_at(work, i, 1, v + i * NU, next, rows->value);
        }
        memcpy(s, next, sizeof(real) * (size_t)n);
    }
}

static void barrier(quadsim_nmpc_work *work, const real *effort, const real *push, int factorise, real *known, real *v,
                    const weighed *rows)
{
    SIZED(barrier_sized, work, effort, push, factorise, known, v, rows)
}

static real shortened(real share, real now, real step)
{
    return step < R(0.0) && now < -share * step ? -now / step : share;
}

/* Mehrotra's (1992) primal-dual interior point method for the inputs' bounds, with a Riccati recursion in every
 * iteration, until the complementarity is below `tolerance`.  Multipliers start at half the largest of the set that did
 * not settle: much smaller ones cost twice the iterations.  What it holds at bounds is then in work->held, the inputs
 * are at the start of work->response.  Returns the iterations. */
static int interior(quadsim_nmpc_work *work, real tolerance, int most)
{
    const quadsim_nmpc_problem *p = work->p;
    const int size = p->horizon * NU;
    real *u = work->response, *low = u + size, *high = low + size, *effort = high + size, *push = effort + size;
    real *v = push + size, *known = v + size, mu = NEVER;
    real *below = known + p->horizon * states_of(p), *above = below + size; /* one over distances */
    real *one = above + size, *two = one + size, *dl = two + size, *dh = dl + size;
    real start = LEAST_START;
    int i, k, pass;
    for (i = 0; i < size; i++) {
        const real half = work->held[i] != 0 ? R(0.5) * magnitude(work->own[i]) : R(0.0);
        start = half > start ? half : start;
    }
    for (i = 0; i < size; i++) {
        const real lower = p->lower[i % NU], upper = p->upper[i % NU], gap = upper - lower;
        u[i] = clipped(work->u[i], lower + R(0.3) * gap, upper - R(0.3) * gap);
        low[i] = high[i] = start;
    }
    for (k = 0; k < most && mu > tolerance; k++) {
        real centre = R(0.0), primal = R(1.0), dual = R(1.0), after = R(0.0);
        mu = R(0.0);
        for (i = 0; i < size; i++) {
            const real to_lower = u[i] - p->lower[i % NU], to_upper = p->upper[i % NU] - u[i];
            mu += to_lower * low[i] + to_upper * high[i];
            below[i] = R(1.0) / to_lower;
            above[i] = R(1.0) / to_upper;
            effort[i] = p->effort[i % NU] + low[i] * below[i] + high[i] * above[i];
            one[i] = two[i] = R(0.0);
        }
        mu /= (real)(2 * size);
        for (pass = 0; pass < 2; pass++) { /* the affine step, then that to the centre, of second order */
            for (i = 0; i < size; i++) {
                push[i] = -p->effort[i % NU] * work->aim[i] - (effort[i] - p->effort[i % NU]) * u[i] - one[i] * below[i] +
                          two[i] * above[i];
            }
            barrier(work, effort, push, pass == 0, known, v, NULL);
            primal = dual = R(1.0);
            for (i = 0; i < size; i++) {
                const real du = v[i] - u[i];
                dl[i] = (one[i] - low[i] * du) * below[i] - low[i];
                dh[i] = (two[i] + high[i] * du) * above[i] - high[i];
                /* what steps take of distances and multipliers */
                primal = -du * below[i] > primal ? -du * below[i] : du * above[i] > primal ? du * above[i] : primal;
                if (dl[i] < R(0.0) && -dl[i] > dual * low[i]) {
                    dual = -dl[i] / low[i];
                }
                if (dh[i] < R(0.0) && -dh[i] > dual * high[i]) {
                    dual = -dh[i] / high[i];
                }
            }
            primal = R(1.0) / primal;
            dual = R(1.0) / dual;
            if (pass == 0) {
                for (i = 0; i < size; i++) {
                    const real du = v[i] - u[i];
                    after += (u[i] - p->lower[i % NU] + primal * du) * (low[i] + dual * dl[i]) +
                             (p->upper[i % NU] - u[i] - primal * du) * (high[i] + dual * dh[i]);
                }
                after /= (real)(2 * size);
                centre = (after / mu) * (after / mu) * after;
                for (i = 0; i < size; i++) {
                    const real du = v[i] - u[i];
                    one[i] = centre - du * dl[i];
                    two[i] = centre + du * dh[i];
                }
            }
        }
        mu = R(0.0);
        for (i = 0; i < size; i++) {
            u[i] += R(0.995) * primal * (v[i] - u[i]);
            low[i] += R(0.995) * dual * dl[i];
            high[i] += R(0.995) * dual * dh[i];
            mu += (u[i] - p->lower[i % NU]) * low[i] + (p->upper[i % NU] - u[i]) * high[i];
        }
        mu /= (real)(2 * size);
    }
    for (i = 0; i < size; i++) {
        work->held[i] = low[i] > u[i] - p->lower[i % NU] ? -1 : high[i] > p->upper[i % NU] - u[i] ? 1 : 0;
    }
    return k;
}

/* An interior point method's numbers of each row [N][kinds without slacks]: its distance t > 0, multiplier, slack e and
 * the slack's multiplier; t = 0: there is no such row.  Each soft row has a slack of its own here. */
typedef struct inner {
    real *t, *by, *e, *nu;
    real *one, *two;             /* products of affine steps */
    real *dt, *dby, *de, *dnu;   /* steps */
} inner;

typedef struct inner_step {
    real t, by, e, nu;
    real weight, slope; /* the multiplier that follows is weight z + slope */
} inner_step;

/* What follows of a row from the value z that follows, towards the complementarity `centre`. */
static inner_step step_of_row(const quadsim_nmpc_work *work, const inner *at, int index, int row, real z, real centre)
{
    const int slot = slot_of(work->p, row);
    const real t = at->t[index], by = at->by[index], w = by / t, most = bound(work, row);
    inner_step to = {R(0.0), R(0.0), R(0.0), R(0.0), w, (centre - at->one[index]) / t + by - w * most};
    if (slot < 0) {
        to.by = w * z + to.slope;
        to.t = most - z;
    } else {
        const real e = at->e[index], nu = at->nu[index], l = linear_of(work, slot), q = quadratic_of(work->p, slot);
        const real slope = q + nu / e, from = (centre - at->two[index]) / e + nu - l, share = R(1.0) / (R(1.0) + w / slope);
        to.weight *= share;
        to.slope = (to.slope - w * from / slope) * share;
        to.by = to.weight * z + to.slope;
        to.e = (from + to.by) / slope;
        to.t = most + to.e - z;
        to.nu = l + q * to.e - to.by;
    }
    to.t -= t;
    to.by -= by;
    to.e -= at->e[index];
    to.nu -= at->nu[index];
    return to;
}

/* Whether the interior point method takes all rows: those that the caller states are of states alone; and whether the
 * responses' memory holds its numbers. */
static int takes_rows(const quadsim_nmpc_problem *p)
{
    const long N = p->horizon, kinds = slacks_from(p);
    int j;
    for (j = 0; p->rows > 0 && j < p->first[p->rows]; j++) {
        if (p->terms[j].lag != 0 || p->terms[j].entry < NU) {
            return 0;
        }
    }
    return p->room * entries_size(p) >= 12 * N * kinds + entries_size(p) + N * (3 * NU + states_of(p));
}

/* The same method for all rows: where the search finds too many that it has to exchange.  What it finds active is then
 * held, among the active rows, or a free slack. */
static void interior_rows(quadsim_nmpc_work *work)
{
    const quadsim_nmpc_problem *p = work->p;
    const int N = p->horizon, kinds = slacks_from(p), size = N * kinds;
    const long entries = entries_size(p);
    real *weight = work->response, *slope = weight + size, *next = slope + size;
    real *effort = next + entries, *push = effort + N * NU, *v = push + N * NU, *known = v + N * NU;
    real *own = known + N * states_of(p);
    const inner at = {own,            own + size,     own + 2 * size, own + 3 * size, own + 4 * size,
                      own + 5 * size, own + 6 * size, own + 7 * size, own + 8 * size, own + 9 * size};
    const weighed rows = {weight, slope, next};
    real mu = NEVER;
    int i, index, kind, pass, pairs = 0;
    memset(work->held, 0, sizeof(int) * (size_t)(N * NU));
    optimum(work, work->p->horizon - 1);
    memcpy(next, work->value, sizeof(real) * (size_t)entries);
    memset(weight, 0, sizeof(real) * (size_t)(2 * size));
    memset(own, 0, sizeof(real) * (size_t)(10 * size));
    for (index = 0; index < size; index++) {
        const int row = index / kinds * kinds_of(p) + index % kinds, slot = slot_of(p, row);
        const real most = bound(work, row), least = R(0.1) * magnitude(most) + R(0.01);
        real beyond;
        kind = index % kinds;
        if (most >= HARD || (kind >= TILT && kind < SPIN && !p->tilts) || (kind >= SPIN && kind < STATED && !p->turns)) {
            continue;
        }
        beyond = product(work, row, next) - most;
        at.by[index] = R(1.0);
        pairs++;
        if (slot >= 0) {
            const real l = linear_of(work, slot);
            at.by[index] = l < R(2.0) ? R(0.5) * l : R(1.0);
            at.e[index] = beyond > R(0.0) ? beyond + least : least;
            at.nu[index] = l + quadratic_of(p, slot) * at.e[index] - at.by[index];
            beyond -= at.e[index];
            pairs++;
        }
        at.t[index] = beyond < -least ? -beyond : least;
    }
    for (; work->inner < MOST_INNER_ROWS && mu > COMPLEMENTARY_ROWS; work->inner++) {
        real centre = R(0.0), length = R(1.0), after = R(0.0);
        for (pass = 0; pass < 2; pass++) {
            for (i = 0; i < N * NU; i++) {
                effort[i] = p->effort[i % NU];
                push[i] = -p->effort[i % NU] * work->aim[i];
            }
            for (index = 0; index < size; index++) {
                const int node = index / kinds, row = node * kinds_of(p) + index % kinds;
                inner_step to;
                kind = index % kinds;
                if (at.t[index] == R(0.0)) {
                    continue;
                }
                if (pass == 0) {
                    at.one[index] = at.two[index] = R(0.0);
                }
                to = step_of_row(work, &at, index, row, R(0.0), centre);
                weight[index] = to.weight;
                slope[index] = to.slope;
                if (kind < TILT) {
                    effort[node * NU + kind % NU] += to.weight;
                    push[node * NU + kind % NU] += kind < NU ? to.slope : -to.slope;
                } else if (kind < SPIN) {
                    slope[index] += to.weight * (SIDE[kind - TILT][0] * work->known[2 * node] +
                                                 SIDE[kind - TILT][1] * work->known[2 * node + 1]);
                }
            }
            barrier(work, effort, push, pass == 0, known, v, &rows);
            length = R(1.0);
            for (index = 0; index < size; index++) {
                const int row = index / kinds * kinds_of(p) + index % kinds;
                inner_step to;
                if (at.t[index] == R(0.0)) {
                    continue;
                }
                to = step_of_row(work, &at, index, row, product(work, row, next), centre);
                length = shortened(shortened(length, at.t[index], to.t), at.by[index], to.by);
                length = shortened(shortened(length, at.e[index], to.e), at.nu[index], to.nu);
                at.dt[index] = to.t;
                at.dby[index] = to.by;
                at.de[index] = to.e;
                at.dnu[index] = to.nu;
            }
            length *= pass == 0 ? R(1.0) : R(0.995);
            mu = after = R(0.0);
            for (index = 0; index < size; index++) { /* zeros where there is no row */
                const real dt = length * at.dt[index], dby = length * at.dby[index];
                const real de = length * at.de[index], dnu = length * at.dnu[index];
                mu += at.t[index] * at.by[index] + at.e[index] * at.nu[index];
                after += (at.t[index] + dt) * (at.by[index] + dby) + (at.e[index] + de) * (at.nu[index] + dnu);
                if (pass == 0) {
                    at.one[index] = at.dt[index] * at.dby[index];
                    at.two[index] = at.de[index] * at.dnu[index];
                } else {
                    at.t[index] += dt;
                    at.by[index] += dby;
                    at.e[index] += de;
                    at.nu[index] += dnu;
                }
            }
            mu /= (real)pairs;
            after /= (real)pairs;
            centre = (after / mu) * (after / mu) * after;
        }
        mu = after;
    }
    work->count = 0;
    for (index = 0; index < size; index++) {
        const int row = index / kinds * kinds_of(p) + index % kinds, slot = slot_of(p, row);
        kind = index % kinds;
        if (at.t[index] == R(0.0) || at.by[index] <= at.t[index]) {
            continue;
        }
        if (kind < TILT) {
            work->held[index / kinds * NU + kind % NU] = kind < NU ? 1 : -1;
        } else if (work->count < p->room) {
            work->row[work->count++] = row;
            if (slot >= 0 && at.e[index] > at.nu[index]) {
                work->free[slot] = 1;
            }
        }
    }
}

/* Move the active set on by a node. */
static void shift_active(quadsim_nmpc_work *work)
{
    const quadsim_nmpc_problem *p = work->p;
    const int inputs = p->horizon * NU, slots = p->horizon * p->slacks, kinds = kinds_of(p);
    int i, kept = 0;
    for (i = 0; i < inputs; i++) {
        work->held[i] = i + NU < inputs ? work->held[i + NU] : 0;
    }
    for (i = 0; i < slots; i++) {
        work->free[i] = i + p->slacks < slots ? work->free[i + p->slacks] : 0;
    }
    for (i = 0; i < work->count; i++) {
        if (work->row[i] >= kinds) {
            work->row[kept++] = work->row[i] - kinds;
        }
    }
    work->count = kept;
}

/* Rows of held inputs among the active ones; none is held then. */
static void rows_of_held(quadsim_nmpc_work *work)
{
    const int size = work->p->horizon * NU, kinds = kinds_of(work->p);
    int i;
    for (i = 0; i < size; i++) {
        if (work->held[i] != 0 && work->count < work->p->room) {
            work->row[work->count++] = (i / NU) * kinds + i % NU + (work->held[i] > 0 ? 0 : NU);
        }
        work->held[i] = 0;
    }
}

/* Hold the inputs whose rows are active, in place of these rows. */
static void hold_rows(quadsim_nmpc_work *work)
{
    const int kinds = kinds_of(work->p);
    int j, kept = 0;
    for (j = 0; j < work->count; j++) {
        const int kind = work->row[j] % kinds;
        if (kind < TILT) {
            work->held[work->row[j] / kinds * NU + kind % NU] = kind < NU ? 1 : -1;
        } else {
            work->row[kept++] = work->row[j];
        }
    }
    work->count = kept;
}

/* Release the held inputs whose multipliers have the wrong sign; whether there were any. */
static int release(quadsim_nmpc_work *work)
{
    const int size = work->p->horizon * NU;
    int i, any = 0;
    gradient(work, work->own);
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
        optimum(work, work->p->horizon - 1);
        work->rounds++;
        status = search(work);
        if (status > QUADSIM_NMPC_BOUNDED) {
            if (!any) {
                return status;
            }
            break; /* perhaps of the held inputs */
        }
        finish(work);
        if (!release(work)) {
            return QUADSIM_NMPC_BOUNDED;
        }
    }
    rows_of_held(work);
    optimum(work, work->p->horizon - 1);
    {
        const enum quadsim_nmpc_status status = search(work);
        if (status == QUADSIM_NMPC_BOUNDED) {
            finish(work);
        }
        return status;
    }
}

/* The optimum where inputs alone may be at bounds; whether there is one that satisfies all rows. */
static int solve_inputs(quadsim_nmpc_work *work)
{
    real most = FEASIBLE;
    int settled, again;
    close_slacks(work);
    add_prices(work);
    settled = settle(work, MOST_ROUNDS, 1);
    for (again = 0; !settled && again < 2; again++) {
        work->inner += interior(work, again ? AGAIN : COMPLEMENTARY, MOST_INNER);
        settled = settle(work, 2 * MOST_ROUNDS, 0);
    }
    return settled && worst_row(work, &most) < 0;
}

/* The optimum with slacks of linear prices alone, by the proximal point method, each from the active set before. */
static enum quadsim_nmpc_status solve_again(quadsim_nmpc_work *work)
{
    const quadsim_nmpc_problem *p = work->p;
    enum quadsim_nmpc_status status = QUADSIM_NMPC_BOUNDED;
    int i, again;
    for (again = 0; again < MOST_AGAIN && status == QUADSIM_NMPC_BOUNDED; again++) {
        real changed = R(0.0);
        for (i = 0; i < p->horizon * p->slacks; i++) {
            if (!(p->quadratic[i % p->slacks] > R(0.0))) {
                const real slack = slack_value(work, i), change = CURVATURE * magnitude(slack - work->origin[i]);
                work->origin[i] = slack;
                changed = change > changed ? change : changed;
            }
        }
        if (changed <= FEASIBLE) {
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
    int i;
    work->changes = work->rounds = work->inner = 0;
    work->allowed = work->p->changes;
    if (takes_rows(work->p) && work->allowed > LONG_SEARCH * work->p->horizon) {
        work->allowed = LONG_SEARCH * work->p->horizon;
    }
    memset(work->origin, 0, sizeof(real) * (size_t)(work->p->slacks * work->p->horizon));
    entries_at(work, -1, 1, work->before, work->start, work->value);
    hold_rows(work);
    if (work->shifted) {
        shift_active(work);
        work->shifted = 0;
    }
    if (work->count == 0 && solve_inputs(work)) { /* no other rows were active, so perhaps none is */
        for (i = 0; i < size; i++) {
            status = work->held[i] != 0 ? QUADSIM_NMPC_BOUNDED : status;
        }
    } else {
        status = search_held(work);
        if (status == QUADSIM_NMPC_GIVEN_UP && work->allowed < work->p->changes) {
            interior_rows(work);
            work->allowed = work->p->changes;
            status = search_held(work);
        }
        work->allowed = work->p->changes;
        if (status == QUADSIM_NMPC_BOUNDED) {
            status = solve_again(work);
        }
    }
    work->violation = R(0.0);
    if (status <= QUADSIM_NMPC_BOUNDED) {
        (void)worst_row(work, &work->violation);
    }
    return status;
}
