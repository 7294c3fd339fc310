/* Sequential quadratic programming: the reference, the start, steps and what is kept of them.
 *
 * Each iteration linearises s_{i+1} = f(s_i, u_i) at the plan, A_i, B_i and c_i, solves the quadratic program of
 * quadsim_nmpc_qp.h, and takes a share of the step to its optimum,  plan <- plan + share (optimum - plan):  all of it,
 * unless there are several iterations, of which Aitken's relaxation finds the share. */
#include "quadsim_nmpc_qp.h"

static const real SHORTEST_STEP = R(0.1); /* share of a step that Aitken's relaxation takes */
enum { ROW_INTS = sizeof(quadsim_nmpc_row) / sizeof(int) };
enum { PATIENCE = 8 }; /* steps without a new shortest one after which the largest share of a step is halved */

/* Memory that is handed out from its start; without reals it is only counted. */
typedef struct memory {
    real *reals;
    long count;
} memory;

static void take_reals(memory *from, real **array, long size)
{
    if (from->reals != NULL) {
        *array = from->reals + from->count;
    }
    from->count += size;
}

static long larger_of(long a, long b)
{
    return a > b ? a : b;
}

/* Reals of the memory of responses, which is reused: the responses of all rows, the costs that a recursion keeps, or
 * the numbers of an interior point method. */
static long responses_size(const quadsim_nmpc_problem *p)
{
    const long N = p->horizon, n = states_of(p), kept = (N - 1) * n * (n + 1);
    return larger_of(p->capacity * entries_size(p), larger_of(kept, quadsim_nmpc_interior_size(p)));
}

/* Set a work's arrays of reals. */
static void take_arrays(const quadsim_nmpc_problem *p, quadsim_nmpc_work *work, memory *from)
{
    const long N = p->horizon, n = states_of(p), capacity = p->capacity, w = entries_of(p), width = columns_of((int)n);
    const int iterates = p->iterations > 1 || p->targets;
    take_reals(from, &work->x, (N + 1) * n);
    take_reals(from, &work->u, N * NU);
    take_reals(from, &work->frame, (N + 1) * 4);
    take_reals(from, &work->goal, (N + 1) * n);
    take_reals(from, &work->aim, N * NU);
    take_reals(from, &work->face, N * p->faces * 3);
    take_reals(from, &work->beyond, N * p->faces);
    take_reals(from, &work->map, N * BODY * width);
    take_reals(from, &work->offset, N * n);
    take_reals(from, &work->end, N * n);
    take_reals(from, &work->axis, p->tilts ? N * 8 : 0);
    take_reals(from, &work->known, p->tilts ? N * 2 : 0);
    take_reals(from, &work->gain, N * NU * n);
    take_reals(from, &work->inverse, N * NU * NU);
    take_reals(from, &work->feed, N * NU);
    take_reals(from, &work->more, N * NU);
    take_reals(from, &work->s, (N + 1) * n);
    take_reals(from, &work->v, N * NU);
    take_reals(from, &work->value, (N + 1) * w);
    take_reals(from, &work->own, (N + 1) * w);
    take_reals(from, &work->response, responses_size(p));
    take_reals(from, &work->factor, capacity * (capacity + 1) / 2);
    take_reals(from, &work->multiplier, capacity);
    take_reals(from, &work->r, capacity);
    take_reals(from, &work->d, capacity);
    take_reals(from, &work->price, N * p->slacks);
    take_reals(from, &work->rate, N * p->slacks);
    take_reals(from, &work->origin, N * p->slacks);
    take_reals(from, &work->x_before, iterates ? (N + 1) * n : 0);
    take_reals(from, &work->u_before, iterates ? N * NU : 0);
    take_reals(from, &work->last, iterates ? N * NU : 0);
}

long quadsim_nmpc_reals(const quadsim_nmpc_problem *problem)
{
    memory counted = {NULL, 0};
    quadsim_nmpc_work unused;
    take_arrays(problem, &unused, &counted);
    return counted.count;
}

long quadsim_nmpc_ints(const quadsim_nmpc_problem *problem)
{
    return ROW_INTS * problem->capacity + (problem->slacks + NU) * problem->horizon;
}

void quadsim_nmpc_start(quadsim_nmpc_work *work, const quadsim_nmpc_problem *problem, quadsim_real *reals, int *ints)
{
    memory from = {reals, 0};
    int i;
    memset(work, 0, sizeof *work);
    work->p = problem;
    take_arrays(problem, work, &from);
    for (i = 0; i < problem->horizon * problem->faces; i++) {
        work->face[3 * i] = work->face[3 * i + 1] = work->face[3 * i + 2] = work->beyond[i] = R(0.0);
    }
    work->row = (quadsim_nmpc_row *)ints;
    work->free = ints + ROW_INTS * problem->capacity;
    work->held = work->free + problem->slacks * problem->horizon;
    quadsim_nmpc_reset(work);
}

void quadsim_nmpc_reset(quadsim_nmpc_work *work)
{
    work->planned = work->shifted = work->doubtful = work->count = 0;
    memset(work->free, 0, sizeof(int) * (size_t)((work->p->slacks + NU) * work->p->horizon)); /* and held */
}

/* Frames, goals of states and inputs; the reference's actuators are in goals. */
static void set_goals(quadsim_nmpc_work *work, const quadsim_nmpc_world *world, const real *states, const real *thrusts)
{
    const quadsim_nmpc_problem *p = work->p;
    const int N = p->horizon, n = states_of(p);
    const real by = p->largest * world->thrust_scale;
    int i, j;
    for (i = 0; i <= N; i++) {
        const real *at = states + i * BODY, *thrust = thrusts + (i < N ? i : N - 1) * NU;
        real *goal = work->goal + i * n;
        memcpy(goal, at, sizeof(real) * BODY);
        memset(goal + BODY, 0, sizeof(real) * (size_t)(n - BODY));
        memcpy(work->frame + 4 * i, at + Q, sizeof(real) * 4);
        goal[Q] = p->difference ? R(1.0) : R(0.0);
        goal[Q + 1] = goal[Q + 2] = goal[Q + 3] = R(0.0);
        if (p->targets) {
            goal[BODY] = (thrust[0] + thrust[1] + thrust[2] + thrust[3]) / by;
            continue;
        }
        for (j = 0; j < NU; j++) {
            const real share = p->speeds ? square_root(thrust[j] / by) : thrust[j] / by;
            if (i < N) {
                work->aim[i * NU + j] = share;
            }
            if (p->actuators) {
                goal[BODY + j] = share;
            }
        }
    }
    for (i = 0; p->targets && i < N; i++) { /* targets lead their lags, at a node's middle */
        for (j = 0; j < NU; j++) {
            const real scale = j > 0 ? p->effect[5 * j] : R(1.0);
            const real now = work->goal[i * n + (j > 0 ? W + j - 1 : BODY)] / scale;
            const real next = work->goal[(i + 1) * n + (j > 0 ? W + j - 1 : BODY)] / scale;
            const real target = p->hold[j] * (R(0.5) * (now + next)) + p->lead[j] * (next - now);
            work->aim[i * NU + j] = clipped(target, p->lower[j], p->upper[j]);
        }
    }
}

/* A plan to start from: the reference, or the last plan, a node further on. */
static void set_first_plan(quadsim_nmpc_work *work)
{
    const quadsim_nmpc_problem *p = work->p;
    const int N = p->horizon, n = states_of(p), befores = p->moves ? NU : 0;
    int i, j;
    work->shifted = work->planned && p->shifts;
    if (work->shifted) {
        memmove(work->x, work->x + n, sizeof(real) * (size_t)(N * n));
        memmove(work->u, work->u + NU, sizeof(real) * (size_t)((N - 1) * NU));
    }
    if (work->planned) {
        return;
    }
    for (i = 0; i < N * NU; i++) {
        work->u[i] = clipped(work->aim[i], p->lower[i % NU], p->upper[i % NU]);
    }
    memcpy(work->x, work->goal, sizeof(real) * (size_t)((N + 1) * n));
    for (i = 0; i <= N; i++) {
        memcpy(work->x + i * n + Q, work->frame + 4 * i, sizeof(real) * 4);
        for (j = 0; j < befores; j++) {
            work->x[i * n + n - NU + j] = i > 0 ? work->u[(i - 1) * NU + j] : work->before[j];
        }
    }
}

/* ---- where targets lead far from the reference ------------------------------------------------------------------- */

/* The states that follow from inputs [N][4], into the plan, with the inputs. */
static void roll_out(quadsim_nmpc_work *work, const quadsim_nmpc_world *world, const real *inputs)
{
    const quadsim_nmpc_problem *p = work->p;
    const int n = states_of(p);
    int i;
    memmove(work->u, inputs, sizeof(real) * (size_t)(p->horizon * NU));
    memcpy(work->x, work->measured, sizeof(real) * (size_t)n);
    for (i = 0; i < p->horizon; i++) {
        quadsim_nmpc_advance(p, world, 1, work->x + i * n, work->u + i * NU, work->x + (i + 1) * n);
    }
}

static real weighted_square(const real *weight, const real *left, const real *right, int count)
{
    real sum = R(0.0);
    int j;
    for (j = 0; j < count; j++) {
        sum += weight[j] * (left[j] - right[j]) * (left[j] - right[j]);
    }
    return sum;
}

/* What the plan costs beside rows: twice the objective, but for a constant. */
static real plan_cost(const quadsim_nmpc_work *work)
{
    const quadsim_nmpc_problem *p = work->p;
    const int N = p->horizon, n = states_of(p);
    real sum = R(0.0), s[MOST] = {R(0.0)}, away[MOST];
    int i, j, k;
    for (i = 0; i < N; i++) {
        sum += weighted_square(p->effort, work->u + i * NU, work->aim + i * NU, NU);
        memcpy(s, work->x + (i + 1) * n, sizeof(real) * (size_t)n);
        into_frame(work->frame + 4 * (i + 1), work->x + (i + 1) * n + Q, s + Q);
        if (i + 1 < N) {
            sum += weighted_square(p->weight, s, work->goal + (i + 1) * n, n);
        }
    }
    for (j = 0; j < n; j++) {
        away[j] = s[j] - work->goal[N * n + j];
    }
    for (j = 0; j < n; j++) {
        for (k = 0; k < n; k++) {
            sum += away[j] * p->terminal[j * n + k] * away[k];
        }
    }
    return sum;
}

/* Inputs by which a geometric controller follows the reference, and the states to which they lead: the thrust axis
 * turns to the acceleration that a damped oscillator about the reference asks for. */
static void steer_geometrically(quadsim_nmpc_work *work, const quadsim_nmpc_world *world)
{
    const quadsim_nmpc_problem *p = work->p;
    const int N = p->horizon, n = states_of(p);
    const real speed = R(4.0) / ((real)N * p->step), turn = R(0.5) / p->step < R(10.0) ? R(0.5) / p->step : R(10.0);
    int i, j;
    memcpy(work->x, work->measured, sizeof(real) * (size_t)n);
    for (i = 0; i < N; i++) {
        const real *x = work->x + i * n, *goal = work->goal + i * n, *next = goal + n, *q = x + Q;
        real *u = work->u + i * NU, axis[3], pull[3], size, along, turned[4], body[4], wanted[4];
        for (j = 0; j < 3; j++) {
            pull[j] = (next[V + j] - goal[V + j]) / p->step + R(2.0) * speed * (goal[V + j] - x[V + j]) +
                      speed * speed * (goal[P + j] - x[P + j]) - world->acceleration[j];
        }
        pull[2] += p->gravity;
        thrust_axis(q, axis);
        along = dot(pull, axis, 3);
        size = square_root(pull[0] * pull[0] + pull[1] * pull[1] + pull[2] * pull[2]) + R(1e-6);
        wanted[0] = R(0.0); /* R(q)' pull is the vector part of q* (0, pull) q */
        memcpy(wanted + 1, pull, sizeof pull);
        into_frame(q, wanted, turned);
        from_frame(turned, q, body);
        u[0] = along / (p->effect[0] * world->thrust_scale);
        u[1] = -turn * body[2] / size / p->effect[5];
        u[2] = turn * body[1] / size / p->effect[10];
        u[3] = goal[W + 2] / p->effect[15];
        for (j = 0; j < NU; j++) {
            u[j] = clipped(u[j], p->lower[j], p->upper[j]);
        }
        quadsim_nmpc_advance(p, world, 1, x, u, work->x + (i + 1) * n);
    }
}

/* Take the cheaper one of two plans for the plan: the rollout of inputs [N][4], and the geometric one. */
static real choose_cheaper_plan(quadsim_nmpc_work *work, const quadsim_nmpc_world *world, const real *inputs)
{
    real cost, other;
    memcpy(work->u_before, inputs, sizeof(real) * (size_t)(work->p->horizon * NU));
    steer_geometrically(work, world);
    other = plan_cost(work);
    memcpy(work->last, work->u, sizeof(real) * (size_t)(work->p->horizon * NU));
    roll_out(work, world, work->u_before);
    cost = plan_cost(work);
    if (cost <= other) {
        return cost;
    }
    roll_out(work, world, work->last);
    return other;
}

int quadsim_nmpc_begin(quadsim_nmpc_work *work, const quadsim_nmpc_world *world, const quadsim_real *measured,
                       const quadsim_real *before, const quadsim_real *states, const quadsim_real *thrusts)
{
    const quadsim_nmpc_problem *p = work->p;
    const int N = p->horizon, n = states_of(p), known = BODY + p->actuators;
    if (!is_finite(measured, known) || !is_finite(before, NU) || !is_finite(states, (N + 1) * BODY) ||
        !is_finite(thrusts, N * NU)) {
        return 0;
    }
    memcpy(work->before, before, sizeof work->before);
    set_goals(work, world, states, thrusts);
    set_first_plan(work);
    memcpy(work->measured, measured, sizeof(real) * (size_t)known);
    if (p->moves) {
        memcpy(work->measured + known, before, sizeof(real) * NU);
    }
    memcpy(work->start, work->measured, sizeof(real) * (size_t)n);
    into_frame(work->frame, measured + Q, work->start + Q);
    if (work->doubtful) {
        (void)choose_cheaper_plan(work, world, work->u);
    }
    work->share = work->largest = R(1.0);
    work->least = R(1e30);
    work->patience = PATIENCE;
    work->iterations = work->ends = 0;
    work->defect = work->moved = R(0.0);
    return 1;
}

static real larger_change(real largest, real a, real b)
{
    const real change = magnitude(a - b);
    return change > largest ? change : largest;
}

/* Take a share of the step from the plan before.  Full Gauss-Newton steps may oscillate: Aitken's relaxation (Irons and
 * Tuck 1969) finds the share from how much of the previous step a step undoes; the largest share falls for good where
 * steps do not get shorter. */
static void relax_step(quadsim_nmpc_work *work)
{
    const quadsim_nmpc_problem *p = work->p;
    const int N = p->horizon, states = (N + 1) * states_of(p), inputs = N * NU;
    real undone = R(1.0), step;
    int i;
    if (work->iterations > 1) {
        real product = R(0.0), square = R(0.0);
        for (i = 0; i < inputs; i++) {
            product += (work->u[i] - work->u_before[i]) * work->last[i];
            square += work->last[i] * work->last[i];
        }
        undone = square > R(0.0) ? R(1.0) - product / square : R(1.0);
    }
    work->patience = work->moved < R(0.9) * work->least ? PATIENCE : work->patience - 1;
    work->least = work->moved < work->least ? work->moved : work->least;
    if (work->patience == 0) {
        work->largest *= R(0.5);
        work->patience = PATIENCE;
    }
    step = work->share / (undone > SHORTEST_STEP ? undone : SHORTEST_STEP);
    step = step > SHORTEST_STEP ? step : SHORTEST_STEP;
    work->share = step < work->largest ? step : work->largest;
    for (i = 0; i < inputs; i++) {
        work->last[i] = work->u[i] - work->u_before[i];
        work->u[i] = work->u_before[i] + work->share * work->last[i];
    }
    for (i = 0; i < states; i++) {
        work->x[i] = work->x_before[i] + work->share * (work->x[i] - work->x_before[i]);
    }
}

int quadsim_nmpc_keep(quadsim_nmpc_work *work, const quadsim_nmpc_world *world, enum quadsim_nmpc_status *status)
{
    const quadsim_nmpc_problem *p = work->p;
    const int N = p->horizon, n = states_of(p);
    int i, j, on;
    if (*status <= QUADSIM_NMPC_BOUNDED && !is_finite(work->v, N * NU)) {
        *status = QUADSIM_NMPC_NOT_FINITE;
    }
    if (*status > QUADSIM_NMPC_BOUNDED) {
        quadsim_nmpc_reset(work);
        return 0;
    }
    work->iterations++;
    work->moved = R(0.0);
    if (p->iterations > 1) {
        memcpy(work->x_before, work->x, sizeof(real) * (size_t)((N + 1) * n));
        memcpy(work->u_before, work->u, sizeof(real) * (size_t)(N * NU));
    }
    for (i = 0; i <= N; i++) {
        real *x = work->x + i * n, s[MOST];
        memcpy(s, i > 0 ? work->s + i * n : work->measured, sizeof(real) * (size_t)n);
        if (i > 0) {
            from_frame(work->frame + 4 * i, work->s + i * n + Q, s + Q);
        }
        for (j = 0; j < n; j++) {
            work->moved = larger_change(work->moved, s[j], x[j]);
            x[j] = s[j];
        }
    }
    for (i = 0; i < N * NU; i++) {
        const real input = clipped(work->v[i], p->lower[i % NU], p->upper[i % NU]); /* beyond by rounding at most */
        work->moved = larger_change(work->moved, input, work->u[i]);
        work->u[i] = input;
    }
    work->planned = 1;
    work->defect = quadsim_nmpc_defect(work, world);
    on = !work->ends && work->iterations < p->iterations + p->corrections &&
         !(p->iterations > 1 && work->moved <= p->tolerance) &&
         !(p->corrections > 0 && work->iterations >= p->iterations && work->defect <= p->converged);
    if (on && p->iterations > 1) {
        relax_step(work);
    }
    if (!on && work->defect > p->converged) {
        if (p->targets) {
            (void)choose_cheaper_plan(work, world, work->u);
        }
        *status = QUADSIM_NMPC_UNCONVERGED;
    }
    work->doubtful = !on && p->targets && *status == QUADSIM_NMPC_UNCONVERGED;
    return on;
}

enum quadsim_nmpc_status quadsim_nmpc_step(quadsim_nmpc_work *work, const quadsim_nmpc_world *world,
                                           const quadsim_real *measured, const quadsim_real *before,
                                           const quadsim_real *states, const quadsim_real *thrusts)
{
    enum quadsim_nmpc_status status;
    if (!quadsim_nmpc_begin(work, world, measured, before, states, thrusts)) {
        return QUADSIM_NMPC_NOT_FINITE;
    }
    do {
        quadsim_nmpc_linearise(work, world);
        status = quadsim_nmpc_solve(work);
    } while (quadsim_nmpc_keep(work, world, &status));
    return status;
}
