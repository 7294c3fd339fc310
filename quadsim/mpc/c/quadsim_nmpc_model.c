/* The rigid body from node to node: the Runge-Kutta map and its exact derivatives.
 *
 *     dp/dt = v,   dq/dt = q (0, omega) / 2,   dv/dt = T R(q) e_z - R(q) D R(q)' v - g e_z + a,
 *     d(omega)/dt = I^-1 (tau - omega x I omega + air) + alpha,   actuator = input + left (actuator - input).
 *
 * Columns of derivatives pass through the stages with the value.  Two kinds of them are apart: those that turn the
 * attitude ("turning": of the quaternion, body rates, and what acts on these), and those of velocity and of targets of
 * thrust, which only push ("pushing").  Where the air turns the body, so does velocity.  Actuators follow their inputs
 * exactly. */
#include "quadsim_nmpc_math.h"

enum { PUSHING = 6, TURNING = 18 };

/* Share of thrust below which a parabola stands for the root, which is steep at 0. */
static const real PARABOLA_BELOW = R(0.01);

/* What acts at an instant. */
struct drive {
    real thrust, angular[3]; /* T, I^-1 tau + alpha */
    real speed;              /* sum of the rotors' speeds, as shares */
    real rates[3];           /* of targets */
    const real *left;
};

/* The slope of a state, and what its derivatives need. */
struct slope {
    real q[4], v[3], w[3];
    real axis[3], by_q[3][4], by_v[3][3];
    real v_by_speed;                                /* along the axis, where the air turns the body */
    real w_by_q[3][4], w_by_v[3][3], w_by_speed[3]; /* where the air turns the body */
};

/* A rotor's speed, as a share, of a share of thrust, and its slope. */
static real speed_share(real share, real *slope)
{
    if (share < PARABOLA_BELOW) {
        const real edge = square_root(PARABOLA_BELOW), part = share / PARABOLA_BELOW;
        *slope = (R(1.5) - part) / edge;
        return edge * (R(1.5) - R(0.5) * part) * part;
    } else {
        const real speed = square_root(share);
        *slope = R(0.5) / speed;
        return speed;
    }
}

static struct drive drive_at(const quadsim_nmpc_problem *p, const quadsim_nmpc_world *world, const real *x,
                             const real *u, int instant, real by_share[5][NU])
{
    struct drive drive;
    int i, j;
    drive.left = p->left + instant * LEFT;
    drive.speed = R(0.0);
    if (p->targets) {
        const real thrust = p->effect[0] * world->thrust_scale;
        drive.thrust = thrust * (u[0] + drive.left[0] * (x[BODY] - u[0]));
        for (i = 0; i < 3; i++) {
            const real target = p->effect[5 * (i + 1)] * u[i + 1];
            drive.rates[i] = target + drive.left[i + 1] * (x[W + i] - target) - drive.left[NU + i + 1] * target;
            drive.angular[i] = R(0.0);
        }
        return drive;
    }
    drive.thrust = R(0.0);
    for (i = 0; i < 3; i++) {
        drive.angular[i] = world->angular[i];
    }
    for (j = 0; j < NU; j++) {
        const real now = p->actuators ? u[j] + drive.left[j] * (x[BODY + j] - u[j]) : u[j];
        const real share = world->thrust_scale * (p->speeds ? now * now : now);
        const real by = world->thrust_scale * (p->speeds ? R(2.0) * now : R(1.0));
        drive.thrust += p->effect[j] * share;
        for (i = 0; i < 3; i++) {
            drive.angular[i] += p->effect[NU * (i + 1) + j] * share;
        }
        for (i = 0; i < 4; i++) {
            by_share[i][j] = p->effect[NU * i + j] * by;
        }
        if (p->moments) {
            by_share[4][j] = R(1.0);
            drive.speed += p->speeds ? now : speed_share(now, &by_share[4][j]);
        }
    }
    return drive;
}

/* Whether air acts on the body. */
static int meets_air(const quadsim_nmpc_problem *p, const quadsim_nmpc_world *world)
{
    int i, any = p->moments;
    for (i = 0; i < 3; i++) {
        any |= world->drag[i] != R(0.0) || world->square_drag[i] != R(0.0);
    }
    return any;
}

real quadsim_nmpc_turned(const quadsim_nmpc_problem *p, const real *state, const real *thrusts, real *turned)
{
    real turn[3][3], along[3], slope, speed = R(0.0);
    int i;
    rotation_of(state + Q, R(2.0), turn);
    for (i = 0; i < 3; i++) {
        along[i] = along_axis(turn, i, state + V);
    }
    for (i = 0; p->moments && i < NU; i++) {
        speed += speed_share(thrusts[i] / p->largest, &slope);
    }
    turn_by_air(p->moment, p->inflow, p->damping, speed, along, state + W, turned);
    return p->loss * speed * along[2];
}

/* Add to a slope what the air does, drag and torque, and, where wanted, its derivatives. */
static void add_air_slopes(const quadsim_nmpc_problem *p, const quadsim_nmpc_world *world, const struct drive *drive,
                           const real *q, const real *v, const real *w_b, int derive, struct slope *k)
{
    const real w = q[0], x = q[1], y = q[2], z = q[3];
    const real slopes[4][3][3] = {{{R(0.0), -z, y}, {z, R(0.0), -x}, {-y, x, R(0.0)}},
                                  {{R(0.0), y, z}, {y, R(-2.0) * x, -w}, {z, w, R(-2.0) * x}},
                                  {{R(-2.0) * y, x, w}, {x, R(0.0), z}, {-w, z, R(-2.0) * y}},
                                  {{R(-2.0) * z, -w, x}, {w, R(-2.0) * z, y}, {x, y, R(0.0)}}}; /* halves */
    real turn[3][3], pull[3], damped[3][3], along[3], turned[3], by_along[3][3];
    int i, j, a;
    rotation_of(q, R(2.0), turn);
    add_air_drag(world->drag, world->square_drag, turn, v, along, pull, k->v);
    if (p->moments) {
        const real lost = p->loss * drive->speed * along[2];
        k->v_by_speed = -p->loss * along[2];
        pull[2] -= lost;
        for (i = 0; i < 3; i++) {
            k->v[i] -= turn[i][2] * lost;
        }
    }
    for (a = 0; a < 3; a++) {
        const real climbing = p->moments && a == 2 ? p->loss * drive->speed : R(0.0);
        const real rate = -(world->drag[a] + R(2.0) * world->square_drag[a] * magnitude(along[a])) - climbing;
        for (i = 0; i < 3; i++) {
            damped[i][a] = turn[i][a] * rate;
        }
    }
    if (p->moments) {
        turn_by_air(p->moment, p->inflow, p->damping, drive->speed, along, w_b, turned);
    }
    for (i = 0; p->moments && i < 3; i++) {
        const real *const m = p->moment + 2 * i, *const inflow = p->inflow + 2 * i;
        k->w_by_speed[i] = m[0] * along[0] + m[1] * along[1];
        k->w[i] += turned[i];
        by_along[i][0] = drive->speed * m[0] + along[2] * inflow[0];
        by_along[i][1] = drive->speed * m[1] + along[2] * inflow[1];
        by_along[i][2] = inflow[0] * along[0] + inflow[1] * along[1];
        for (j = 0; j < 3; j++) {
            k->w_by_v[i][j] = dot(by_along[i], turn[j], 3);
        }
    }
    for (i = 0; derive && i < 3; i++) {
        for (j = 0; j < 3; j++) {
            k->by_v[i][j] = damped[i][0] * turn[j][0] + damped[i][1] * turn[j][1] + damped[i][2] * turn[j][2];
        }
    }
    for (j = 0; derive && j < 4; j++) {
        real air[3];
        for (a = 0; a < 3; a++) {
            air[a] = slopes[j][0][a] * v[0] + slopes[j][1][a] * v[1] + slopes[j][2][a] * v[2];
        }
        for (i = 0; i < 3; i++) {
            real sum = R(0.0);
            for (a = 0; a < 3; a++) {
                sum += slopes[j][i][a] * pull[a] + damped[i][a] * air[a];
            }
            k->by_q[i][j] += R(2.0) * sum;
            if (p->moments) {
                k->w_by_q[i][j] = R(2.0) * dot(by_along[i], air, 3);
            }
        }
    }
}

static void find_slope(const quadsim_nmpc_problem *p, const quadsim_nmpc_world *world, const struct drive *drive,
                       int air, int derive, const real *q, const real *v, const real *w, struct slope *k)
{
    const real T = drive->thrust, twice = R(2.0) * T;
    quaternion_rate(q, w, k->q);
    thrust_axis(q, k->axis);
    k->v[0] = T * k->axis[0] + world->acceleration[0];
    k->v[1] = T * k->axis[1] + world->acceleration[1];
    k->v[2] = T * k->axis[2] + world->acceleration[2] - p->gravity;
    memcpy(k->w, drive->angular, sizeof k->w);
    add_gyroscopic(p->gyration, w, k->w);
    if (derive) {
        const real by_q[3][4] = {{twice * q[2], twice * q[3], twice * q[0], twice * q[1]},
                                 {-twice * q[1], -twice * q[0], twice * q[3], twice * q[2]},
                                 {R(0.0), R(-2.0) * twice * q[1], R(-2.0) * twice * q[2], R(0.0)}};
        memcpy(k->by_q, by_q, sizeof by_q);
    }
    if (air) {
        add_air_slopes(p, world, drive, q, v, w, derive, k);
    }
}

/* Slopes of the turning columns D: m of them, the first four of the quaternion, which leave body rates alone unless the
 * air turns the body. */
INLINED void turning_slopes(const quadsim_nmpc_problem *p, const struct slope *k, const real *q, const real *w, int air,
                            real by_share[5][NU], const int m, const int targets, const int actuators,
                            const int moments, const struct drive *drive, real D[10][TURNING], real K[10][TURNING])
{
    const int still = moments ? 0 : 4;
    int c, i;
    for (c = 0; c < still; c++) {
        K[0][c] = R(0.5) * (-w[0] * D[1][c] - w[1] * D[2][c] - w[2] * D[3][c]);
        K[1][c] = R(0.5) * (w[0] * D[0][c] + w[2] * D[2][c] - w[1] * D[3][c]);
        K[2][c] = R(0.5) * (w[1] * D[0][c] - w[2] * D[1][c] + w[0] * D[3][c]);
        K[3][c] = R(0.5) * (w[2] * D[0][c] + w[1] * D[1][c] - w[0] * D[2][c]);
    }
    for (c = still; c < m; c++) {
        const real *const a = &D[7][c], *const b = &D[8][c], *const d = &D[9][c];
        K[0][c] = R(0.5) * (-w[0] * D[1][c] - w[1] * D[2][c] - w[2] * D[3][c] - q[1] * *a - q[2] * *b - q[3] * *d);
        K[1][c] = R(0.5) * (w[0] * D[0][c] + w[2] * D[2][c] - w[1] * D[3][c] + q[0] * *a + q[2] * *d - q[3] * *b);
        K[2][c] = R(0.5) * (w[1] * D[0][c] - w[2] * D[1][c] + w[0] * D[3][c] + q[0] * *b - q[1] * *d + q[3] * *a);
        K[3][c] = R(0.5) * (w[2] * D[0][c] + w[1] * D[1][c] - w[0] * D[2][c] + q[0] * *d + q[1] * *b - q[2] * *a);
    }
    for (i = 0; i < 3; i++) {
        const real *by = k->by_q[i];
        for (c = 0; c < m; c++) {
            K[4 + i][c] = by[0] * D[0][c] + by[1] * D[1][c] + by[2] * D[2][c] + by[3] * D[3][c];
        }
        if (air) {
            const real *pull = k->by_v[i];
            for (c = 0; c < m; c++) {
                K[4 + i][c] += pull[0] * D[4][c] + pull[1] * D[5][c] + pull[2] * D[6][c];
            }
        }
    }
    if (targets) {
        return;
    }
    for (c = still; c < m; c++) {
        K[7][c] = p->gyration[0] * (w[1] * D[9][c] + w[2] * D[8][c]);
        K[8][c] = p->gyration[1] * (w[2] * D[7][c] + w[0] * D[9][c]);
        K[9][c] = p->gyration[2] * (w[0] * D[8][c] + w[1] * D[7][c]);
    }
    for (i = 0; moments && i < 3; i++) {
        const real *by = k->w_by_q[i], *pull = k->w_by_v[i], *damping = p->damping + 3 * i;
        for (c = 0; c < m; c++) {
            K[7 + i][c] += by[0] * D[0][c] + by[1] * D[1][c] + by[2] * D[2][c] + by[3] * D[3][c] + pull[0] * D[4][c] +
                           pull[1] * D[5][c] + pull[2] * D[6][c] -
                           (damping[0] * D[7][c] + damping[1] * D[8][c] + damping[2] * D[9][c]);
        }
    }
    for (c = 0; c < NU; c++) {
        const real left = actuators ? drive->left[c] : R(0.0);
        for (i = 0; i < 3; i++) {
            const real turned = by_share[i + 1][c] + (moments ? k->w_by_speed[i] * by_share[4][c] : R(0.0));
            const real pushed = by_share[0][c] + (moments ? k->v_by_speed * by_share[4][c] : R(0.0));
            if (actuators) {
                K[4 + i][7 + c] += k->axis[i] * pushed * left;
                K[7 + i][7 + c] += turned * left;
            }
            K[4 + i][7 + actuators + c] += k->axis[i] * pushed * (R(1.0) - left);
            K[7 + i][7 + actuators + c] += turned * (R(1.0) - left);
        }
    }
}

/* Slopes of the pushing columns E: velocity, and with targets thrust and its target. */
INLINED void pushing_slopes(const quadsim_nmpc_problem *p, const quadsim_nmpc_world *world, const struct slope *k,
                            const struct drive *drive, int air, const int targets, real E[3][PUSHING],
                            real K[3][PUSHING])
{
    const real thrust = p->effect[0] * world->thrust_scale;
    int c, i;
    for (i = 0; i < 3; i++) {
        for (c = 0; c < PUSHING; c++) {
            K[i][c] = air ? k->by_v[i][0] * E[0][c] + k->by_v[i][1] * E[1][c] + k->by_v[i][2] * E[2][c] : R(0.0);
        }
        if (targets) {
            K[i][3] += k->axis[i] * thrust * drive->left[0];
            K[i][4] += k->axis[i] * thrust * (R(1.0) - drive->left[0]);
        }
    }
}

/* Derivatives of what a step leads to: columns that turn the attitude, of quaternion, velocity and body rates, and of
 * the position; and columns that only push, of velocity and of the position. */
struct columns {
    real turning[10][TURNING], moved[3][TURNING];
    real pushing[3][PUSHING], pushed[3][PUSHING];
};

/* Body rates at an instant, where targets make them known, and their columns. */
INLINED void set_rates(const quadsim_nmpc_problem *p, const struct drive *drive, const int derive, real *y,
                       real D[10][TURNING])
{
    int i;
    for (i = 0; i < 3; i++) {
        y[7 + i] = drive->rates[i];
        if (derive) {
            D[7 + i][4 + i] = drive->left[i + 1];
            D[7 + i][7 + i] = p->effect[5 * (i + 1)] * (R(1.0) - drive->left[i + 1] - drive->left[NU + i + 1]);
        }
    }
}

/* Actuators at the end of a step, and the inputs before. */
static void actuators_after(const quadsim_nmpc_problem *p, const real *x, const real *u, real *end)
{
    int i;
    for (i = 0; i < p->actuators; i++) {
        end[BODY + i] = u[i] + p->left[2 * p->substeps * LEFT + i] * (x[BODY + i] - u[i]);
    }
    if (p->moves) {
        memcpy(end + BODY + p->actuators, u, sizeof(real) * NU);
    }
}

/* Runge-Kutta's classical method over a step with held inputs: it moves y, the quaternion, velocity and body rates
 * [10], and adds to `place` how far the position went; and, where `derive`, moves the columns: m that turn, padded,
 * with targets or not, so many actuators, and with the air's torque or not. */
INLINED void integrate_node(const quadsim_nmpc_problem *p, const quadsim_nmpc_world *world, const real *x,
                            const real *u, const int derive, const int m, const int targets, const int actuators,
                            const int moments, real *y, real *place, struct columns *columns)
{
    const real h = p->step / (real)p->substeps, part[4] = {R(0.0), R(0.5) * h, R(0.5) * h, h};
    const int air = meets_air(p, world);
    real K[10][TURNING], L[3][PUSHING], by_share[5][NU];
    struct drive drive;
    struct slope k;
    int s, stage, i, c;
    if (derive) {
        memset(K, 0, sizeof K);
    }
    for (s = 0; s < p->substeps; s++) {
        real Ds[10][TURNING], Es[3][PUSHING], ys[10], sum[10][TURNING], push[3][PUSHING], value[10] = {R(0.0)};
        for (stage = 0; stage < 4; stage++) {
            const real twice = stage == 1 || stage == 2 ? R(2.0) : R(1.0), by = part[stage];
            if (stage == 0) {
                memcpy(ys, y, sizeof ys);
            } else {
                for (i = 0; i < 3; i++) {
                    ys[i] = y[i] + by * k.q[i];
                    ys[4 + i] = y[4 + i] + by * k.v[i];
                    ys[7 + i] = y[7 + i] + by * k.w[i];
                }
                ys[3] = y[3] + by * k.q[3];
            }
            for (i = 0; derive && i < 10; i++) {
                for (c = 0; c < m; c++) {
                    Ds[i][c] = stage == 0 ? columns->turning[i][c] : columns->turning[i][c] + by * K[i][c];
                }
            }
            for (i = 0; derive && i < 3; i++) {
                for (c = 0; c < PUSHING; c++) {
                    Es[i][c] = stage == 0 ? columns->pushing[i][c] : columns->pushing[i][c] + by * L[i][c];
                }
            }
            drive = drive_at(p, world, x, u, 2 * s + (stage + 1) / 2, by_share);
            if (targets) {
                set_rates(p, &drive, derive, ys, Ds);
            }
            find_slope(p, world, &drive, air, derive, ys, ys + 4, ys + 7, &k);
            for (i = 0; i < 3; i++) { /* the position's slope is the velocity */
                place[i] += stage < 3 ? h * h / R(6.0) * k.v[i] : h * y[4 + i];
            }
            for (i = 0; i < 10; i++) {
                value[i] += twice * (i < 4 ? k.q[i] : i < 7 ? k.v[i - 4] : k.w[i - 7]);
            }
            if (!derive) {
                continue;
            }
            turning_slopes(p, &k, ys, ys + 7, air, by_share, m, targets, actuators, moments, &drive, Ds, K);
            pushing_slopes(p, world, &k, &drive, air, targets, Es, L);
            for (i = 0; i < 3; i++) {
                const real share = h * h / R(6.0);
                for (c = 0; c < m; c++) {
                    columns->moved[i][c] += stage < 3 ? share * K[4 + i][c] : h * columns->turning[4 + i][c];
                }
                for (c = 0; c < PUSHING; c++) {
                    columns->pushed[i][c] += stage < 3 ? share * L[i][c] : h * columns->pushing[i][c];
                    push[i][c] = stage == 0 ? L[i][c] : push[i][c] + twice * L[i][c];
                }
            }
            for (i = 0; i < 10; i++) {
                for (c = 0; c < m; c++) {
                    sum[i][c] = stage == 0 ? K[i][c] : sum[i][c] + twice * K[i][c];
                }
            }
        }
        for (i = 0; i < 10; i++) {
            for (c = 0; derive && c < m; c++) {
                columns->turning[i][c] += h / R(6.0) * sum[i][c];
            }
            y[i] += h / R(6.0) * value[i];
        }
        for (i = 0; derive && i < 3; i++) {
            for (c = 0; c < PUSHING; c++) {
                columns->pushing[i][c] += h / R(6.0) * push[i][c];
            }
        }
    }
    if (targets) {
        drive = drive_at(p, world, x, u, 2 * p->substeps, by_share);
        set_rates(p, &drive, derive, y, derive ? columns->turning : NULL);
    }
}

/* One node: m turning columns, padded, with targets or not, so many actuators, and with the air's torque or not. */
INLINED void linearise_node(const quadsim_nmpc_problem *p, const quadsim_nmpc_world *world, const real *x,
                            const real *u, const real *frame, const real *next, const int m, const int targets,
                            const int actuators, const int moments, int n, real *map, real *end)
{
    static const real UNITS[4][4] = {
        {R(1.0)}, {R(0.0), R(1.0)}, {R(0.0), R(0.0), R(1.0)}, {R(0.0), R(0.0), R(0.0), R(1.0)}};
    const int width = columns_of(n), turning = targets ? 10 : 11 + actuators, befores = n - BODY - actuators;
    struct columns d;
    real y[10], travelled[3] = {R(0.0)};
    int i, c;
    memset(&d, 0, sizeof d);
    memcpy(y, x + Q, sizeof y);
    for (i = 0; i < 4; i++) { /* the quaternion starts at F' of the frame's units */
        real column[4];
        from_frame(frame, UNITS[i], column);
        for (c = 0; c < 4; c++) {
            d.turning[c][i] = column[c];
        }
    }
    for (i = 0; i < 3; i++) {
        d.turning[7 + i][4 + i] = d.pushing[i][i] = R(1.0);
        if (moments) {
            d.turning[4 + i][turning + i] = R(1.0);
        }
    }
    integrate_node(p, world, x, u, 1, m, targets, actuators, moments, y, travelled, &d);
    /* The map's columns: quaternion, velocity, body rates, actuators, inputs. */
    memset(map, 0, sizeof(real) * (size_t)(BODY * width));
    for (c = 0; c < turning + (moments ? 3 : 0); c++) {
        const int of_input = c >= 7 + (targets ? 0 : actuators);
        const int of_turning = c < 4 ? c : targets && of_input ? c + 5 : c + 3;
        const int at = c < turning ? of_turning + (of_input ? befores : 0) : 4 + c - turning;
        real q[4], turned[4];
        for (i = 0; i < 4; i++) {
            q[i] = d.turning[i][c];
        }
        into_frame(next, q, turned);
        for (i = 0; i < 3; i++) {
            map[i * width + at] = d.moved[i][c];
            map[(V + i) * width + at] = d.turning[4 + i][c];
            map[(W + i) * width + at] = d.turning[7 + i][c];
        }
        for (i = 0; i < 4; i++) {
            map[(Q + i) * width + at] = turned[i];
        }
    }
    for (c = moments ? 3 : 0; c < (targets ? 5 : 3); c++) {
        const int at = c < 3 ? 4 + c : 7 + c + (c == 4 ? befores : 0);
        for (i = 0; i < 3; i++) {
            map[i * width + at] = d.pushed[i][c];
            map[(V + i) * width + at] = d.pushing[i][c];
        }
    }
    for (i = 0; i < 3; i++) {
        end[i] = x[i] + travelled[i];
    }
    memcpy(end + Q, y, sizeof y);
    actuators_after(p, x, u, end);
}

/* The part of the next state that is neither of the state nor of the inputs. */
static void find_offset(int n, const real *map, const real *x, const real *u, const real *frame, const real *next,
                        const real *end, real *offset)
{
    const int width = columns_of(n);
    real at[MOST + 2] = {R(0.0)};
    int i, j;
    into_frame(frame, x + Q, at);
    memcpy(at + 4, x + V, sizeof(real) * (size_t)(n - V));
    memcpy(at + n - 3, u, sizeof(real) * NU);
    memcpy(offset, end, sizeof(real) * (size_t)n);
    into_frame(next, end + Q, offset + Q);
    for (i = 0; i < BODY; i++) {
        real sum = i < 3 ? x[i] : R(0.0);
        for (j = 0; j < n + 1; j++) {
            sum += map[i * width + j] * at[j];
        }
        offset[i] -= sum;
    }
    for (i = BODY; i < n; i++) {
        offset[i] = R(0.0);
    }
}

/* The thrust axis along world x and y, at a quaternion in its frame near q: a row for each, and what is known. */
static void find_axis(const real *q, const real *frame, real *rows, real *known)
{
    const real slope[2][4] = {{R(2.0) * q[2], R(2.0) * q[3], R(2.0) * q[0], R(2.0) * q[1]},
                              {R(-2.0) * q[1], R(-2.0) * q[0], R(2.0) * q[3], R(2.0) * q[2]}};
    real axis[3];
    int i, j;
    thrust_axis(q, axis);
    for (i = 0; i < 2; i++) {
        known[i] = axis[i];
        for (j = 0; j < 4; j++) {
            known[i] -= slope[i][j] * q[j];
        }
        into_frame(frame, slope[i], rows + 4 * i);
    }
}

void quadsim_nmpc_slopes(const quadsim_nmpc_problem *p, const quadsim_nmpc_world *world, const real *x, const real *u,
                         const real *frames, real *map, real *end)
{
    const int n = states_of(p);
    if (p->targets) {
        linearise_node(p, world, x, u, frames, frames + 4, 10, 1, 1, 0, n, map, end);
    } else if (p->moments) {
        linearise_node(p, world, x, u, frames, frames + 4, 18, 0, p->actuators, 1, n, map, end);
    } else if (p->actuators) {
        linearise_node(p, world, x, u, frames, frames + 4, 16, 0, 4, 0, n, map, end);
    } else {
        linearise_node(p, world, x, u, frames, frames + 4, 12, 0, 0, 0, n, map, end);
    }
}

void quadsim_nmpc_linearise(quadsim_nmpc_work *work, const quadsim_nmpc_world *world)
{
    const quadsim_nmpc_problem *p = work->p;
    const int n = states_of(p), width = columns_of(n);
    int i;
    for (i = 0; i < p->horizon; i++) {
        const real *x = work->x + i * n, *u = work->u + i * NU, *frame = work->frame + 4 * i;
        real *map = work->map + i * BODY * width, *end = work->end + i * n;
        quadsim_nmpc_slopes(p, world, x, u, frame, map, end);
        find_offset(n, map, x, u, frame, frame + 4, end, work->offset + i * n);
        if (p->tilts) {
            find_axis(x + n + Q, frame + 4, work->axis + 8 * i, work->known + 2 * i);
        }
    }
}

/* The next state, without derivatives. */
static void predict_node(const quadsim_nmpc_problem *p, const quadsim_nmpc_world *world, const real *x, const real *u,
                         real *end)
{
    real y[10];
    memcpy(y, x + Q, sizeof y);
    memcpy(end, x, sizeof(real) * 3);
    integrate_node(p, world, x, u, 0, 0, p->targets, p->actuators, p->moments, y, end, NULL);
    memcpy(end + Q, y, sizeof y);
    actuators_after(p, x, u, end);
}

void quadsim_nmpc_advance(const quadsim_nmpc_problem *p, const quadsim_nmpc_world *world, int count, const real *states,
                          const real *inputs, real *ends)
{
    const int n = states_of(p);
    int i;
    for (i = 0; i < count; i++) {
        predict_node(p, world, states + i * n, inputs + i * NU, ends + i * n);
    }
}

/* By how much the plan misses the dynamics. */
real quadsim_nmpc_defect(const quadsim_nmpc_work *work, const quadsim_nmpc_world *world)
{
    const quadsim_nmpc_problem *p = work->p;
    const int n = states_of(p);
    real largest = R(0.0), end[MOST];
    int i, j;
    for (i = 0; i < p->horizon; i++) {
        predict_node(p, world, work->x + i * n, work->u + i * NU, end);
        for (j = 0; j < n; j++) {
            const real miss = magnitude(work->x[(i + 1) * n + j] - end[j]);
            largest = miss > largest ? miss : largest;
        }
    }
    return largest;
}
