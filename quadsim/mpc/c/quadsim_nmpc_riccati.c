/* The Riccati recursion: the optimum of all inputs without rows, and how it answers to multipliers of rows.
 *
 * What follows node i costs  1/2 s' P s + g' s  in the state s at its end.  Backwards, with the input's effort R, the
 * offset c of the dynamics and a push d of the inputs, -R aim and what rows add to it,
 *
 *     H = R + B' P B,      K = H^-1 B' P A,      feed = -H^-1 (B' (P c + g) + d),
 *     P <- Q + A' P A - A' P B K,                g <- A' (P c + g) - K' (B' (P c + g) + d) - Q goal,
 *
 * then forwards  u = feed - K s,  s <- A s + B u + c.  Where moves have a weight m, the last states are the input
 * before: m is added to H, and -m to B' P A in their columns.  An input that is held at a bound has unit rows and
 * columns in H, none in H^-1, and its bound for a feed.  A row's multiplier adds its gradient a to d and g: with the
 * same K and H^-1, one pass backwards and forwards gives the response of all entries, H^-1 a with the whole program's
 * H.
 *
 * Maps have no columns for the position, whose derivative is the unit matrix: the first three columns of P A are P's.
 * Functions are made for each number of states: loops of constant length are a third faster. */
#include "quadsim_nmpc_qp.h"

enum { WIDE = MOST + 1 };

static const int FREE_INPUTS[NU] = {0, 0, 0, 0};

/* ---- a node ------------------------------------------------------------------------------------------------------ */

/* Actuators and inputs before follow the inputs: this is the input of the a-th of them, and what a step leaves of the
 * distance from it. */
INLINED int followed(const int actuators, int a)
{
    return a < actuators ? a : a - actuators;
}

INLINED real left_of(const quadsim_nmpc_problem *p, const int actuators, int a)
{
    return a < actuators ? p->left[2 * p->substeps * LEFT + a] : R(0.0);
}

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
            for (r = 0; r < past; r++) {   /* rows of `both` are set, whichever columns are */
                row[r] += by * both[k][r]; /* NOLINT(clang-analyzer-core.UndefinedBinaryOperatorResult) */
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
INLINED void riccati_node(quadsim_nmpc_work *work, int i, const int actuators, const int moves, const real *effort,
                          const int *held, real *cost, real *g)
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
            gain[a * n + j] = inverse[a * NU] * K[0][j] + inverse[a * NU + 1] * K[1][j] +
                              inverse[a * NU + 2] * K[2][j] + inverse[a * NU + 3] * K[3][j];
        }
    }
    for (r = 0; r < n; r++) { /* A' P A - K' gain, the lower part, then the upper */
        real less[MOST] = {R(0.0)};
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
INLINED void backward_node(const quadsim_nmpc_work *work, int i, const int actuators, const int moves, const real *push,
                           real *g, real *feed)
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

/* ---- passes -------------------------------------------------------------------------------------------------------
 */

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

/* Gains, and the optimum with the held inputs at their bounds and no other bounds.  Costs of all nodes' ends but the
 * last are kept in the responses' memory, [N - 1][n][n + 1], so that the next recursion may start from node `last`:
 * that is the last node whose held inputs have changed since. */
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
        quadsim_nmpc_entries_at(work, i, 1, work->v + i * NU, next, work->value);
    }
}

/* The response [N+1][w] of all entries to a row: H^-1 a. */
INLINED void response_sized(quadsim_nmpc_work *work, const quadsim_nmpc_row *row, real *response, const int actuators,
                            const int moves)
{
    const quadsim_nmpc_problem *p = work->p;
    const int N = p->horizon, n = BODY + actuators + (moves ? NU : 0), node = row->node;
    real g[MOST] = {R(0.0)}, push[NU] = {R(0.0)}, s[MOST] = {R(0.0)}, next[MOST], u[NU];
    int i;
    for (i = node; i >= 0; i--) {
        if (i >= node - 1) {
            memset(push, 0, sizeof push);
            quadsim_nmpc_add_row_gradient(work, row, i, R(1.0), push, g);
        }
        backward_node(work, i, actuators, moves, i >= node - 1 ? push : NULL, g, work->more + i * NU);
    }
    memset(response, 0, sizeof(real) * (size_t)entries_of(p));
    for (i = 0; i < N; i++) {
        forward_node(work, i, actuators, moves, i <= node ? work->more + i * NU : NULL, NULL, s, u, next);
        quadsim_nmpc_entries_at(work, i, 0, u, next, response);
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
        quadsim_nmpc_add_active_gradients(work, i, push, g);
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

/* The gradient [N][4] in the inputs of the active rows alone, with their multipliers. */
INLINED void rows_gradient_sized(const quadsim_nmpc_work *work, real *gradient, const int actuators, const int moves)
{
    const int n = BODY + actuators + (moves ? NU : 0);
    real g[MOST] = {R(0.0)};
    int i, j;
    for (i = work->p->horizon - 1; i >= 0; i--) {
        real sum[MOST + 2] = {R(0.0)}, push[NU] = {R(0.0)};
        quadsim_nmpc_add_active_gradients(work, i, push, g);
        carry_back(work, i, actuators, moves, g, sum);
        for (j = 0; j < NU; j++) {
            gradient[i * NU + j] = sum[n - 3 + j] + push[j];
        }
        for (j = 0; j < n - 3; j++) {
            g[3 + j] = sum[j];
        }
    }
}

/* The optimum with the active rows' multipliers. */
INLINED void add_multipliers_sized(quadsim_nmpc_work *work, const int actuators, const int moves)
{
    const quadsim_nmpc_problem *p = work->p;
    const int n = BODY + actuators + (moves ? NU : 0);
    real g[MOST] = {R(0.0)};
    int i, j;
    for (i = p->horizon - 1; i >= 0; i--) {
        real push[NU] = {R(0.0)};
        quadsim_nmpc_add_active_gradients(work, i, push, g);
        backward_node(work, i, actuators, moves, push, g, work->more + i * NU);
        for (j = 0; j < NU; j++) {
            work->more[i * NU + j] += work->feed[i * NU + j];
        }
    }
    for (i = 0; i < p->horizon; i++) {
        forward_node(work, i, actuators, moves, work->more + i * NU, work->offset + i * n, work->s + i * n,
                     work->v + i * NU, work->s + (i + 1) * n);
        quadsim_nmpc_entries_at(work, i, 1, work->v + i * NU, work->s + (i + 1) * n, work->value);
    }
}

/* Add the weights of the rows of states to the cost of the state at a node's end. */
INLINED void weigh_rows(const quadsim_nmpc_work *work, int i, const int n, const quadsim_nmpc_weights *weights,
                        int factorise, real *cost, real *g)
{
    const quadsim_nmpc_problem *p = work->p;
    const int rows = quadsim_nmpc_state_rows(p);
    int r, j, k;
    for (r = 0; r < rows; r++) {
        const real weight = weights->weight[i * rows + r];
        real inputs[NU] = {R(0.0)}, z[MOST] = {R(0.0)}, slope;
        quadsim_nmpc_row row;
        if (weight == R(0.0)) {
            continue;
        }
        quadsim_nmpc_state_row(p, i, r, &row);
        slope = weights->slope[i * rows + r] + weight * quadsim_nmpc_known_part(work, &row);
        quadsim_nmpc_add_row_gradient(work, &row, i, R(1.0), inputs, z);
        for (j = 0; j < BODY; j++) {
            for (k = 0; factorise && z[j] != R(0.0) && k < BODY; k++) {
                cost[j * n + k] += weight * z[j] * z[k];
            }
            g[j] += slope * z[j];
        }
    }
}

INLINED void weighted_optimum_sized(quadsim_nmpc_work *work, const quadsim_nmpc_weights *weights, int factorise,
                                    const int actuators, const int moves)
{
    const quadsim_nmpc_problem *p = work->p;
    const int N = p->horizon, n = BODY + actuators + (moves ? NU : 0);
    real *known = weights->known, *inputs = weights->inputs, cost[MOST * MOST], g[MOST], s[MOST], next[MOST];
    int i, j, k;
    cost_at_end(work, n, cost, g);
    for (i = N - 1; i >= 0; i--) {
        if (weights->weight != NULL) {
            weigh_rows(work, i, n, weights, factorise, cost, g);
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
            riccati_node(work, i, actuators, moves, weights->effort + i * NU, FREE_INPUTS, cost, g);
        }
        backward_node(work, i, actuators, moves, weights->push + i * NU, g, work->more + i * NU);
        for (j = 0; j < n; j++) {
            cost[j * n + j] += p->weight[j];
            g[j] -= p->weight[j] * work->goal[i * n + j];
        }
    }
    memcpy(s, work->start, sizeof(real) * (size_t)n);
    for (i = 0; i < N; i++) {
        forward_node(work, i, actuators, moves, work->more + i * NU, work->offset + i * n, s, inputs + i * NU, next);
        if (weights->weight != NULL) {
            quadsim_nmpc_entries_at(work, i, 1, inputs + i * NU, next, weights->entries);
        }
        memcpy(s, next, sizeof(real) * (size_t)n);
    }
}

/* ---- for each number of states ----------------------------------------------------------------------------------- */

/* Call a function that is made for each number of actuators, with moves and without; with QUADSIM_SIZES, as 4,0, for
 * these alone. */
#if defined QUADSIM_ANY_SIZE
#define SIZED(function, ...) function(__VA_ARGS__, work->p->actuators, work->p->moves ? 1 : 0);
#elif defined QUADSIM_SIZES
#define SIZED(function, ...) function(__VA_ARGS__, QUADSIM_SIZES);
#else
#define SIZED(function, ...)                                                                                           \
    switch (2 * work->p->actuators + (work->p->moves ? 1 : 0)) {                                                       \
    case 0:                                                                                                            \
        function(__VA_ARGS__, 0, 0);                                                                                   \
        break;                                                                                                         \
    case 1:                                                                                                            \
        function(__VA_ARGS__, 0, 1);                                                                                   \
        break;                                                                                                         \
    case 2:                                                                                                            \
        function(__VA_ARGS__, 1, 0);                                                                                   \
        break;                                                                                                         \
    case 3:                                                                                                            \
        function(__VA_ARGS__, 1, 1);                                                                                   \
        break;                                                                                                         \
    case 8:                                                                                                            \
        function(__VA_ARGS__, 4, 0);                                                                                   \
        break;                                                                                                         \
    default:                                                                                                           \
        function(__VA_ARGS__, 4, 1);                                                                                   \
    }
#endif

void quadsim_nmpc_optimum(quadsim_nmpc_work *work, int last)
{
    SIZED(optimum_sized, work, last)
}

void quadsim_nmpc_add_multipliers(quadsim_nmpc_work *work)
{
    SIZED(add_multipliers_sized, work)
}

void quadsim_nmpc_response(quadsim_nmpc_work *work, const quadsim_nmpc_row *row, quadsim_real *response)
{
    const long size = entries_size(work->p);
    long i;
    if (row->kind == QUADSIM_NMPC_SLACK) {
        memset(response, 0, sizeof(real) * (size_t)size);
        return;
    }
    SIZED(response_sized, work, row, response)
    for (i = 0; i < size; i++) {
        response[i] = -response[i];
    }
}

void quadsim_nmpc_gradient(quadsim_nmpc_work *work, quadsim_real *gradient)
{
    SIZED(gradient_sized, work, gradient)
}

void quadsim_nmpc_rows_gradient(const quadsim_nmpc_work *work, quadsim_real *gradient)
{
    SIZED(rows_gradient_sized, work, gradient)
}

void quadsim_nmpc_weighted_optimum(quadsim_nmpc_work *work, const quadsim_nmpc_weights *weights, int factorise)
{
    SIZED(weighted_optimum_sized, work, weights, factorise)
}
