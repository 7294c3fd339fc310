/* Thrust along the body axis, and a moment or body rates, from errors on SE(3); see quadsim_geometric.h.
 *
 *     A = m (-k_x e_x - k_v e_v - integral + g e_3 + a_d - d),   f = A . R e_3,   b_3 along A and drag,
 *     e_R = (R_d' R - R' R_d)^vee / 2,   e_Omega = Omega - R' R_d Omega_d,
 *     M = -J (k_R e_R + k_Omega e_Omega + integral + Omega x R' R_d Omega_d - R' R_d Omega_d' + d_R) + Omega x J Omega.
 *
 * Omega_d and its rate of change follow from A, A' and A'' and the heading (Lee, Leok and McClamroch 2010). */
#include "quadsim_geometric.h"

#include <string.h>

#include "quadsim_nmpc_math.h"

typedef quadsim_geometric_numbers numbers_of_law;
typedef quadsim_geometric_motion motion_now;
typedef quadsim_geometric_target target_now;
typedef quadsim_geometric_disturbance disturbance_now;

/* A vector and its first two derivatives. */
typedef real jet[3][3];

enum { POSITION, VELOCITY, ACCELERATION, JERK, SNAP };

static real length_of(const real *vector)
{
    return square_root(dot(vector, vector, 3));
}

/* ---- what is measured, and what is wanted ------------------------------------------------------------------------ */

/* The attitude of Euler angles, body to world. */
static void attitude_of_angles(const real *state, real attitude[9])
{
    real s[3], c[3];
    sines_of(state, s, c);
    attitude[0] = c[2] * c[1];
    attitude[1] = c[2] * s[1] * s[0] - s[2] * c[0];
    attitude[2] = c[2] * s[1] * c[0] + s[2] * s[0];
    attitude[3] = s[2] * c[1];
    attitude[4] = s[2] * s[1] * s[0] + c[2] * c[0];
    attitude[5] = s[2] * s[1] * c[0] - c[2] * s[0];
    attitude[6] = -s[1];
    attitude[7] = c[1] * s[0];
    attitude[8] = c[1] * c[0];
}

void quadsim_geometric_measure(const quadsim_real state[12], const quadsim_real *quaternion, const quadsim_real *rates,
                               quadsim_geometric_motion *motion)
{
    int i;
    for (i = 0; i < 3; i++) {
        motion->position[i] = state[X + 2 * i];
        motion->velocity[i] = state[VX + 2 * i];
    }
    motion->yaw = state[YAW];
    if (quaternion != NULL) {
        attitude_of(quaternion, motion->attitude);
    } else {
        attitude_of_angles(state, motion->attitude);
    }
    if (rates != NULL) {
        memcpy(motion->rates, rates, sizeof(motion->rates));
    } else {
        body_rates(state, motion->rates);
    }
}

void quadsim_geometric_preview(const numbers_of_law *n, const quadsim_real *reference, quadsim_geometric_target *target)
{
    real turns = R(0.0);
    int order, i, k;
    memset(target, 0, sizeof(*target));
    for (k = 0; k < n->horizon; k++) {
        const real *row = reference + 4 * k;
        turns = next_turns(reference, k, turns);
        for (order = 0; order < n->orders; order++) {
            const real share = n->preview[order * n->horizon + k];
            for (i = 0; i < 3; i++) { /* from the first sample on, near which floats are fine */
                target->path[order][i] += share * (row[i] - reference[i]);
            }
            if (order < 3) {
                target->yaw[order] += share * (row[3] - TURN * turns - reference[3]);
            }
        }
    }
    for (i = 0; i < 3; i++) {
        target->path[POSITION][i] += reference[i];
    }
    target->yaw[0] += reference[3];
}

/* Samples of a course that count: what repeats the last one may lie past its end. */
static int samples_of(int samples, int width, const real *rows)
{
    int count = samples < QUADSIM_GEOMETRIC_SAMPLES ? samples : QUADSIM_GEOMETRIC_SAMPLES;
    for (; count > 1; count--) {
        const real *last = rows + (count - 1) * width;
        int i, same = 1;
        for (i = 0; i < 7; i++) {
            same &= is_equal(last[i], last[i - width]);
        }
        if (!same) {
            break;
        }
    }
    return count;
}

void quadsim_geometric_course(const numbers_of_law *n, int samples, int width, const quadsim_real *rows,
                              quadsim_geometric_target *target)
{
    const int count = samples_of(samples, width, rows);
    const int orders = count > QUADSIM_GEOMETRIC_DEGREE ? QUADSIM_GEOMETRIC_DEGREE + 1 : count;
    const real *from_samples = n->course;
    real attitude[9];
    int order, i, k;
    for (k = 1; k < count; k++) {
        from_samples += k * k;
    }
    memset(target, 0, sizeof(*target));
    target->headed = 1;
    for (k = 0; k < count; k++) {
        const real *row = rows + k * width;
        attitude_of(row + 3, attitude);
        for (order = 0; order < orders && order < QUADSIM_GEOMETRIC_ORDERS; order++) {
            const real share = from_samples[order * count + k];
            for (i = 0; i < 3; i++) {
                target->path[order][i] += share * (row[i] - rows[i]);
                if (order < 3) {
                    target->heading[3 * order + i] += share * attitude[3 * i];
                }
            }
        }
    }
    for (i = 0; i < 3; i++) {
        target->path[POSITION][i] += rows[i];
    }
}

/* The desired horizontal direction of body x.
 *
 * e_R vanishes at half a turn, where it should be largest.  If the heading error exceeds a quarter turn, the desired
 * heading is a quarter turn away, at rest. */
static void find_desired_heading(real yaw, const target_now *target, jet heading)
{
    const real error = target->yaw[0] - yaw, turn = error - TURN * whole_turns(error);
    const int near = magnitude(turn) <= HALF_PI;
    const real rate = near ? target->yaw[1] : R(0.0), acceleration = near ? target->yaw[2] : R(0.0);
    real sine, cosine;
    if (target->headed) {
        memcpy(heading, target->heading, sizeof(target->heading));
        return;
    }
    sin_cos(yaw + (near ? turn : (turn < R(0.0) ? -HALF_PI : HALF_PI)), &sine, &cosine);
    memset(heading, 0, sizeof(jet));
    heading[0][0] = cosine;
    heading[0][1] = sine;
    heading[1][0] = -rate * sine;
    heading[1][1] = rate * cosine;
    heading[2][0] = -acceleration * sine - rate * rate * cosine;
    heading[2][1] = acceleration * cosine - rate * rate * sine;
}

/* ---- the attitude of a force and a heading ----------------------------------------------------------------------- */

void quadsim_geometric_limit(const quadsim_real force[3], quadsim_real least, quadsim_real slope,
                             quadsim_real limited[3])
{
    const real upward = force[2] > least ? force[2] : least, allowed = upward * slope;
    const real horizontal = square_root(force[0] * force[0] + force[1] * force[1]);
    const real share = horizontal <= allowed ? R(1.0) : allowed / horizontal;
    limited[0] = share * force[0];
    limited[1] = share * force[1];
    limited[2] = upward;
}

/* The direction of a vector that is not 0. */
static void find_direction(jet v, jet u)
{
    const real length = length_of(v[0]);
    real along, across;
    int i;
    for (i = 0; i < 3; i++) {
        u[0][i] = v[0][i] / length;
    }
    along = dot(u[0], v[1], 3);
    for (i = 0; i < 3; i++) {
        u[1][i] = (v[1][i] - along * u[0][i]) / length;
    }
    across = dot(u[1], v[1], 3) + dot(u[0], v[2], 3);
    for (i = 0; i < 3; i++) {
        u[2][i] = (v[2][i] - across * u[0][i] - R(2.0) * along * u[1][i]) / length;
    }
}

static void cross_jets(jet a, jet b, jet product)
{
    real first[3], second[3], third[3];
    int i;
    cross_product(a[0], b[0], product[0]);
    cross_product(a[1], b[0], first);
    cross_product(a[0], b[1], second);
    for (i = 0; i < 3; i++) {
        product[1][i] = first[i] + second[i];
    }
    cross_product(a[2], b[0], first);
    cross_product(a[1], b[1], second);
    cross_product(a[0], b[2], third);
    for (i = 0; i < 3; i++) {
        product[2][i] = first[i] + R(2.0) * second[i] + third[i];
    }
}

/* The direction of a force and drag times momentum. */
static void find_direction_with_drag(jet force, jet momentum, real drag, jet u)
{
    jet v;
    int i, j;
    for (i = 0; i < 3; i++) {
        for (j = 0; j < 3; j++) {
            v[i][j] = force[i][j] + drag * momentum[i][j];
        }
    }
    find_direction(v, u);
}

/* R_c = [b_1, b_2, b_3], with b_1 as close to the heading as the force allows.
 *
 * Rotors and drag together give the force A, f b_3 - R_c diag(d) R_c' p = A.  Perpendicular to b_3,
 * b_1 . (A + d_x p) = 0 and b_2 . (A + d_y p) = 0.  Faessler et al. (2018), Eqs. (12) to (16), with body x rather than
 * body y close to a given direction. */
static void find_desired_attitude(jet force, jet momentum, const real drag[3], jet heading,
                                  quadsim_geometric_attitude *desired)
{
    jet beta, across, b[3];
    int order, i, j;
    find_direction_with_drag(force, momentum, drag[1], beta);
    cross_jets(beta, heading, across);
    find_direction(across, b[1]);
    if (is_equal(drag[0], drag[1])) {
        memcpy(b[2], beta, sizeof(jet));
        cross_jets(b[1], beta, b[0]);
    } else {
        jet alpha, along;
        find_direction_with_drag(force, momentum, drag[0], alpha);
        cross_jets(b[1], alpha, along);
        find_direction(along, b[0]);
        cross_jets(b[0], b[1], b[2]);
    }
    for (order = 1; order < 3; order++) { /* of hat(Omega)^2 + hat(Omega'), the skew part */
        real *turning = order == 1 ? desired->rates : desired->acceleration;
        for (i = 0; i < 3; i++) {
            const int next = (i + 1) % 3, last = (i + 2) % 3;
            turning[i] = R(0.5) * (dot(b[last][0], b[next][order], 3) - dot(b[next][0], b[last][order], 3));
        }
    }
    for (i = 0; i < 3; i++) {
        for (j = 0; j < 3; j++) {
            desired->attitude[3 * i + j] = b[j][0][i];
        }
    }
}

/* e_R = (R_d' R - R' R_d)^vee / 2.  Lee, Leok, McClamroch (2010). */
static void attitude_error(const real *attitude, const real *desired, real error[3])
{
    real relative[9];
    int i, j, k;
    for (i = 0; i < 3; i++) {
        for (j = 0; j < 3; j++) {
            relative[3 * i + j] = R(0.0);
            for (k = 0; k < 3; k++) {
                relative[3 * i + j] += desired[3 * k + i] * attitude[3 * k + j];
            }
        }
    }
    for (i = 0; i < 3; i++) {
        const int next = (i + 1) % 3, last = (i + 2) % 3;
        error[i] = R(0.5) * (relative[3 * last + next] - relative[3 * next + last]);
    }
}

/* R' R_c v: a vector from the axes of the commanded attitude to those of the body. */
static void desired_into_body(const motion_now *motion, const quadsim_geometric_attitude *desired, const real *vector,
                              real result[3])
{
    real world[3];
    turn_by(desired->attitude, vector, world);
    turn_back_by(motion->attitude, world, result);
}

/* ---- thrust ------------------------------------------------------------------------------------------------------ */

/* A' and A'' by the equations of motion under the controller's own thrust, drag and disturbance.
 *
 * The disturbance is assumed to change at a constant rate; drag turns with the body. */
static void foresee_force(const numbers_of_law *n, const motion_now *motion, const target_now *target,
                          const disturbance_now *d, jet A)
{
    const real m = n->mass, *drag = n->drag, *R_now = motion->attitude, *Omega = motion->rates;
    const real *acceleration = target->path[ACCELERATION], *jerk = target->path[JERK];
    real up[3], up1[3], v_b[3], v_d[3], pull[3], force[3], e_v[3], e_a[3], e_j[3], turned[3], f, f1, along;
    int i;
    thrust_axis_of(R_now, Omega, up, up1);
    turn_back_by(R_now, motion->velocity, v_b);
    turn_back_by(R_now, target->path[VELOCITY], v_d);
    f = dot(A[0], up, 3) + m * drag[2] * v_d[2];
    f = f > R(0.0) ? f : R(0.0);
    for (i = 0; i < 3; i++) {
        pull[i] = drag[i] * v_b[i];
        e_v[i] = motion->velocity[i] - target->path[VELOCITY][i];
    }
    turn_by(R_now, pull, force);
    for (i = 0; i < 3; i++) {
        e_a[i] = f / m * up[i] - (i == 2 ? n->gravity : R(0.0)) - acceleration[i] + (d->force[i] - force[i]);
        A[1][i] = -m * (n->k_x * e_v[i] + n->k_v * e_a[i]) + m * (jerk[i] - d->change[i]);
        turned[i] = e_a[i] + acceleration[i];
    }
    f1 = dot(A[1], up, 3) + dot(A[0], up1, 3);
    along = drag[2] * (dot(acceleration, up, 3) + dot(target->path[VELOCITY], up1, 3));
    turn_back_by(R_now, turned, v_d);
    cross_product(Omega, v_b, force); /* v_b' = R' v' - Omega x v_b */
    for (i = 0; i < 3; i++) {
        v_d[i] = drag[i] * (v_d[i] - force[i]);
    }
    cross_product(Omega, pull, turned);
    for (i = 0; i < 3; i++) {
        turned[i] += v_d[i];
    }
    turn_by(R_now, turned, force);
    for (i = 0; i < 3; i++) {
        e_j[i] = f1 / m * up[i] + f / m * up1[i] - jerk[i] + d->change[i] + (along * up[i] - force[i]);
        A[2][i] = -m * (n->k_x * e_a[i] + n->k_v * e_j[i]) + m * target->path[SNAP][i];
    }
}

/* The thrust along body z [N], and the desired attitude.  Where the limits of tilt or lift change the force, that
 * attitude counts as constant. */
static real find_thrust(quadsim_geometric *law, const motion_now *motion, const target_now *target,
                        const disturbance_now *d)
{
    const numbers_of_law *n = law->numbers;
    const real m = n->mass;
    real demanded[3], up[3], up1[3], thrust = R(0.0);
    jet A, momentum, heading;
    int i, free = 1;
    for (i = 0; i < 3; i++) {
        const real e_x = motion->position[i] - target->path[POSITION][i];
        const real e_v = motion->velocity[i] - target->path[VELOCITY][i];
        demanded[i] = m * (-n->k_x * e_x - n->k_v * e_v - law->translation[i] + (i == 2 ? n->gravity : R(0.0)) +
                           target->path[ACCELERATION][i]) -
                      m * d->force[i];
    }
    memset(A, 0, sizeof(A));
    memset(momentum, 0, sizeof(momentum));
    quadsim_geometric_limit(demanded, n->least_lift, n->slope, A[0]);
    for (i = 0; i < 3; i++) {
        free &= is_equal(A[0][i], demanded[i]);
        momentum[0][i] = m * target->path[VELOCITY][i];
    }
    if (free) {
        foresee_force(n, motion, target, d, A);
        for (i = 0; i < 3; i++) {
            momentum[1][i] = m * target->path[ACCELERATION][i];
            momentum[2][i] = m * target->path[JERK][i];
        }
    }
    find_desired_heading(motion->yaw, target, heading);
    find_desired_attitude(A, momentum, n->drag, heading, &law->desired);
    thrust_axis_of(motion->attitude, motion->rates, up, up1);
    if (!n->feedforward) {
        return dot(A[0], up, 3);
    }
    for (i = 0; i < 3; i++) {
        const real along = A[0][i] + n->drag[2] * momentum[0][i], along1 = A[1][i] + n->drag[2] * momentum[1][i];
        thrust += (along + n->ahead * along1) * (up[i] + n->ahead * up1[i]);
    }
    return thrust;
}

/* ---- the controller ---------------------------------------------------------------------------------------------- */

void quadsim_geometric_wrench(quadsim_geometric *law, const motion_now *motion, const target_now *target,
                              const quadsim_geometric_disturbance *disturbance, quadsim_real wrench[4])
{
    const numbers_of_law *n = law->numbers;
    const real *Omega = motion->rates;
    real e_R[3], Omega_d[3], change[3], turning[3], demanded[3], momentum[3], gyroscopic[3];
    int i;
    wrench[0] = find_thrust(law, motion, target, disturbance);
    attitude_error(motion->attitude, law->desired.attitude, e_R);
    desired_into_body(motion, &law->desired, law->desired.rates, Omega_d);
    desired_into_body(motion, &law->desired, law->desired.acceleration, change);
    cross_product(Omega, Omega_d, turning);
    for (i = 0; i < 3; i++) {
        demanded[i] = n->k_R[i] * e_R[i] + n->k_Omega[i] * (Omega[i] - Omega_d[i]) + law->rotation[i] +
                      (turning[i] - change[i] + disturbance->torque[i]);
    }
    turn_by(n->inertia, Omega, momentum);
    cross_product(Omega, momentum, gyroscopic);
    turn_by(n->inertia, demanded, momentum);
    for (i = 0; i < 3; i++) {
        wrench[1 + i] = gyroscopic[i] - momentum[i];
    }
    if (n->moment) {
        const real share = wrench[0] / (n->mass * n->gravity); /* speeds as the root of the thrust */
        const real speed = n->turning * square_root(share);
        real velocity[3], air[3];
        turn_back_by(motion->attitude, target->path[VELOCITY], velocity);
        air_moment(n->across, n->inflow, n->damping, speed, velocity, Omega_d, air);
        wrench[0] += n->loss * speed * velocity[2];
        for (i = 0; i < 3; i++) {
            wrench[1 + i] -= air[i];
        }
    }
}

/* A unit quaternion wxyz of an attitude: the longest column of 4 q q'. */
static void quaternion_of(const real *a, real q[4])
{
    const real columns[4][4] = {{R(1.0) + a[0] + a[4] + a[8], a[7] - a[5], a[2] - a[6], a[3] - a[1]},
                                {a[7] - a[5], R(1.0) + a[0] - a[4] - a[8], a[1] + a[3], a[2] + a[6]},
                                {a[2] - a[6], a[1] + a[3], R(1.0) - a[0] + a[4] - a[8], a[5] + a[7]},
                                {a[3] - a[1], a[2] + a[6], a[5] + a[7], R(1.0) - a[0] - a[4] + a[8]}};
    int i, longest = 0;
    real length;
    for (i = 1; i < 4; i++) {
        longest = columns[i][i] > columns[longest][longest] ? i : longest;
    }
    length = square_root(dot(columns[longest], columns[longest], 4));
    for (i = 0; i < 4; i++) {
        q[i] = columns[longest][i] / length;
    }
}

/* The desired attitude as a quaternion, with feed-forward that of half a period later. */
static void put_quaternion(const quadsim_geometric *law, real q[4])
{
    const numbers_of_law *n = law->numbers;
    const real quarter = n->feedforward ? R(0.25) * n->period : R(0.0), *Omega = law->desired.rates;
    const real x = quarter * Omega[0], y = quarter * Omega[1], z = quarter * Omega[2];
    real a[4], length;
    int i;
    quaternion_of(law->desired.attitude, a);
    q[0] = a[0] - a[1] * x - a[2] * y - a[3] * z;
    q[1] = a[0] * x + a[1] + a[2] * z - a[3] * y;
    q[2] = a[0] * y - a[1] * z + a[2] + a[3] * x;
    q[3] = a[0] * z + a[1] * y - a[2] * x + a[3];
    length = square_root(dot(q, q, 4));
    for (i = 0; i < 4; i++) {
        q[i] /= length;
    }
}

void quadsim_geometric_targets(quadsim_geometric *law, const motion_now *motion, const target_now *target,
                               const quadsim_geometric_disturbance *disturbance, quadsim_real *targets)
{
    const numbers_of_law *n = law->numbers;
    real e_R[3], Omega_d[3], change[3], turning[3];
    int i;
    targets[0] = find_thrust(law, motion, target, disturbance);
    desired_into_body(motion, &law->desired, law->desired.rates, Omega_d);
    desired_into_body(motion, &law->desired, law->desired.acceleration, change);
    cross_product(motion->rates, Omega_d, turning);
    attitude_error(motion->attitude, law->desired.attitude, e_R);
    for (i = 0; i < 3; i++) {
        targets[1 + i] = Omega_d[i] + n->lead[i] * (change[i] - turning[i]);
        if (n->commands == QUADSIM_GEOMETRIC_RATES) {
            targets[1 + i] -= n->k_attitude[i] * e_R[i];
        }
    }
    if (n->commands == QUADSIM_GEOMETRIC_ATTITUDE) { /* the autopilot has a gain of its own */
        put_quaternion(law, targets + 4);
    }
}

void quadsim_geometric_integrate(quadsim_geometric *law, const motion_now *motion, const target_now *target)
{
    const numbers_of_law *n = law->numbers;
    real e_R[3], Omega_d[3];
    int i;
    attitude_error(motion->attitude, law->desired.attitude, e_R);
    desired_into_body(motion, &law->desired, law->desired.rates, Omega_d);
    for (i = 0; i < 3; i++) {
        const real e_x = motion->position[i] - target->path[POSITION][i];
        const real e_v = motion->velocity[i] - target->path[VELOCITY][i];
        const real turned = motion->rates[i] - Omega_d[i] + n->c_2 * e_R[i];
        law->translation[i] =
            clipped(law->translation[i] + n->period * n->k_i * (e_v + n->c_1 * e_x), -n->sigma, n->sigma);
        law->rotation[i] = clipped(law->rotation[i] + n->period * n->k_I * turned, -n->sigma_R, n->sigma_R);
    }
}

/* The disturbance in the middle of the period for which this command acts, and the thrust scale; none until the vehicle
 * flies. */
static void estimate_disturbance(quadsim_geometric *law, int flying, int follows, const motion_now *motion,
                                 const real *acting, disturbance_now *d)
{
    const numbers_of_law *n = law->numbers;
    memset(d, 0, sizeof(*d));
    law->thrust_scale = R(1.0);
    if (n->ramp == NULL) {
        return;
    }
    if (!flying) {
        quadsim_ramp_reset(&law->ramp, n->ramp, acting);
        return;
    }
    quadsim_ramp_update(&law->ramp, n->ramp, follows, motion->velocity, motion->attitude, motion->rates, acting);
    quadsim_ramp_foreseen(&law->ramp, n->ramp, R(0.5) * n->period + (n->delay == NULL ? R(0.0) : n->delay->delay),
                          d->force, d->change, d->torque);
    law->thrust_scale = quadsim_ramp_scale(&law->ramp, n->ramp);
}

/* Move what is measured on to when this period's command takes over. */
static void predict_motion(const quadsim_geometric *law, const disturbance_now *d, motion_now *motion)
{
    const numbers_of_law *n = law->numbers;
    quadsim_nmpc_world world;
    real state[MOST], length;
    int i;
    memset(&world, 0, sizeof(world));
    for (i = 0; i < 3; i++) {
        world.acceleration[i] = d->force[i] - n->delay->delay * d->change[i]; /* in the period that starts now */
        world.angular[i] = d->torque[i];
        world.drag[i] = n->drag[i];
    }
    world.thrust_scale = law->thrust_scale;
    memcpy(state + P, motion->position, sizeof(motion->position));
    memcpy(state + V, motion->velocity, sizeof(motion->velocity));
    memcpy(state + W, motion->rates, sizeof(motion->rates));
    quaternion_of(motion->attitude, state + Q);
    quadsim_delay_predict(&law->delay, n->delay, &world, state, state);
    length = square_root(dot(state + Q, state + Q, 4));
    for (i = 0; i < 4; i++) {
        state[Q + i] /= length;
    }
    memcpy(motion->position, state + P, sizeof(motion->position));
    memcpy(motion->velocity, state + V, sizeof(motion->velocity));
    memcpy(motion->rates, state + W, sizeof(motion->rates));
    attitude_of(state + Q, motion->attitude);
    motion->yaw = direction_of(motion->attitude[3], motion->attitude[0]);
}

/* Drop the integrals and all that is estimated. */
static void reset_integrals(quadsim_geometric *law, const real *acting)
{
    memset(law->translation, 0, sizeof(law->translation));
    memset(law->rotation, 0, sizeof(law->rotation));
    law->learns = 0;
    if (law->numbers->ramp != NULL) {
        quadsim_ramp_reset(&law->ramp, law->numbers->ramp, acting);
    }
    if (law->numbers->delay != NULL) {
        quadsim_delay_reset(&law->delay, law->numbers->delay, acting);
    }
}

long quadsim_geometric_reals(const numbers_of_law *n)
{
    return 2L * n->horizon * NU;
}

/* The command after which a controller starts: the thrust of the weight or, of rotors, rotors at rest. */
static void find_first_command(const numbers_of_law *n, real command[NU])
{
    memset(command, 0, NU * sizeof(real));
    if (n->commands != QUADSIM_GEOMETRIC_ROTORS) {
        command[0] = n->mass * n->gravity;
    }
}

void quadsim_geometric_start(quadsim_geometric *law, const numbers_of_law *n, quadsim_real *memory)
{
    real first[NU];
    memset(law, 0, sizeof(*law));
    law->numbers = n;
    law->plan = memory;
    find_first_command(n, first);
    if (n->fallback != NULL) {
        quadsim_guard_start(&law->guard, n->fallback, n->horizon, memory + n->horizon * NU);
    }
    quadsim_geometric_reset(law, first);
}

void quadsim_geometric_reset(quadsim_geometric *law, const quadsim_real acting[4])
{
    real first[NU];
    const real *usable = is_finite(acting, NU) ? acting : first;
    find_first_command(law->numbers, first);
    if (law->numbers->fallback != NULL) {
        quadsim_guard_reset(&law->guard, acting);
        usable = law->guard.before;
    }
    reset_integrals(law, usable);
}

void quadsim_geometric_solve(quadsim_geometric *law, int flying, int follows, quadsim_geometric_motion *motion,
                             const target_now *target, const quadsim_real acting[4])
{
    const numbers_of_law *n = law->numbers;
    const real *in_force = acting;
    disturbance_now d;
    int i, attained = 1;
    if (n->delay != NULL) {
        quadsim_delay_send(&law->delay, n->delay, 1, acting);
        in_force = law->delay.sent[0];
    }
    estimate_disturbance(law, flying, follows, motion, in_force, &d);
    if (n->delay != NULL) {
        predict_motion(law, &d, motion);
    }
    if (n->commands == QUADSIM_GEOMETRIC_ROTORS) { /* rotors give a share of torques too */
        quadsim_geometric_wrench(law, motion, target, &d, law->command);
        for (i = 0; i < NU; i++) {
            law->command[i] /= law->thrust_scale;
        }
        return;
    }
    quadsim_geometric_targets(law, motion, target, &d, law->command);
    law->command[0] /= law->thrust_scale;
    for (i = 0; i < NU; i++) {
        const real demanded = law->command[i];
        /* What is not a number stays so. */
        law->command[i] = demanded < n->least[i] ? n->least[i] : (demanded > n->most[i] ? n->most[i] : demanded);
        attained &= i == 3 || is_equal(demanded, law->command[i]); /* translation does not depend on yaw */
    }
    if (attained && flying) {
        quadsim_geometric_integrate(law, motion, target);
    }
}

/* ---- with the fallback contract ------------------------------------------------------------------------------------
 */

/* The controller's answer to the guard's state, as law->plan. */
static void plan_commands(quadsim_geometric *law, int flying, const real *measured, const real *reference)
{
    const numbers_of_law *n = law->numbers;
    const quadsim_guard *guard = &law->guard;
    const int *unseen = guard->unseen;
    const int turned = quadsim_guard_turned(guard);
    const int turning = unseen[ROLL + 1] == 0 && unseen[PITCH + 1] == 0 && unseen[YAW + 1] == 0;
    const real *attitude = n->exact && turned && is_finite(measured + 12, 4) ? measured + 12 : NULL;
    const real *rates =
        n->exact && quadsim_guard_has_rates(guard) && is_finite(measured + 16, 3) ? measured + 16 : NULL;
    motion_now motion;
    target_now target;
    const int moved = unseen[VX] == 0 && unseen[VY] == 0 && unseen[VZ] == 0;
    int i;
    quadsim_geometric_measure(guard->state, attitude, rates, &motion);
    if (n->motion) {
        quadsim_geometric_course(n, QUADSIM_GEOMETRIC_SAMPLES, QUADSIM_MOTION, reference, &target);
    } else {
        quadsim_geometric_preview(n, reference, &target);
    }
    quadsim_geometric_solve(law, flying, law->learns && guard->learns && guard->asked == 1, &motion, &target,
                            guard->in_force);
    law->learns = flying && turned && turning && moved;
    memcpy(law->plan, law->command, NU * sizeof(real));
    for (i = 1; i < n->horizon; i++) {
        memcpy(law->plan + i * NU, n->fallback->hover, NU * sizeof(real));
    }
}

enum quadsim_status quadsim_geometric_step(quadsim_geometric *law, enum quadsim_phase phase,
                                           const quadsim_real state[QUADSIM_MEASURED], const quadsim_real *reference,
                                           const quadsim_real acting[4], quadsim_real command[4])
{
    const numbers_of_law *n = law->numbers;
    const int count = n->motion ? QUADSIM_GEOMETRIC_SAMPLES * QUADSIM_MOTION : n->horizon * 4;
    quadsim_guard *guard = &law->guard;
    quadsim_trim trim = {{R(0.0)}, {R(0.0), R(0.0), R(1.0)}, {R(0.0)}};
    enum quadsim_status status;
    memcpy(trim.commands, n->fallback->hover, sizeof(trim.commands));
    status = quadsim_guard_begin(guard, phase, &trim, state, reference, count, acting);
    if (status == QUADSIM_FREE && phase == QUADSIM_PHASE_LANDED) {
        reset_integrals(law, guard->in_force);
    } else if (status == QUADSIM_FREE) {
        plan_commands(law, phase == QUADSIM_PHASE_FLYING, state, reference);
        status = quadsim_guard_check(guard, QUADSIM_COMMANDED, law->plan);
    }
    if (quadsim_guard_foresees(guard, phase, status)) {
        quadsim_guard_foresee(guard, 1, &trim, n->fallback->hover);
    }
    return quadsim_guard_end(guard, phase, &trim, status, law->plan, command);
}
