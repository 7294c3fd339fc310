/* The query of a linear controller, and its optimum.
 *
 * The robust controller predicts the vehicle from t_k to the instant t_k + d from which its command acts, through the
 * commands u(k-1-n) .. u(k-1) that act before.  With Z-Y-X Euler angles eta, body rates omega = E(eta) d(eta)/dt and
 * rotor speeds that follow commands as tau_r dw/dt = u - w,
 *
 *     d2(p)/dt2 = U / m R(eta) e_z - g e_z + a,
 *     d(omega)/dt = I^-1 (tau - omega x I omega) + (U / m) twist,
 *
 * with what the air does at R(eta)' d(p)/dt and omega, where the controller knows it (`Vehicle.air_moment`,
 * `lost_to_inflow`). Here a has two components along world x and y and one along the thrust: a wrong mass scales the
 * thrust in any direction.  The observer of (a, twist) is quadsim_math.h's update_disturbance, of the velocities and
 * body rates that were expected a period before (quadsim/mpc/estimate/observer.py).
 *
 * The model is linearised where the vehicle rests under that disturbance, with thrust along g e_z - a,
 *
 *     x(k+1) = x_s + A (x(k) - x_s) + B (u(k) - u_s),
 *
 * and u_s is the target of the inputs: a loop that settles with no bound active has no steady error, whatever the
 * errors of A and B.  With the air's moment, u_s balances what it does at x(k) beyond A.
 *
 * Where an inner loop turns the vehicle, U is commanded, and omega is known at every instant from its targets
 * (quadsim/mpc/problem/rigidbody.py): omega = a omega(0) + (1 - a - b) omega_c.  There is no twist then. */
#include "quadsim_mpc.h"

#include <stddef.h>
#include <string.h>

#include "quadsim_math.h"

/* ---- desired outputs --------------------------------------------------------------------------------------------- */

/* y_d [n_r] of a row of the reference. */
static void put_places(const quadsim_problem *p, const real row[4], real *desired)
{
    int r;
    for (r = 0; r < p->regulated; r++) {
        const real *C = p->C_r + r * p->states;
        desired[r] = C[X] * row[0] + C[Y] * row[1] + C[Z] * row[2] + C[YAW] * row[3];
    }
}

/* Add that of the velocities and the yaw rate of a row; roll, pitch and their rates are desired at 0. */
static void add_rates(const quadsim_problem *p, const real rates[4], real *desired)
{
    int r;
    for (r = 0; r < p->regulated; r++) {
        const real *C = p->C_r + r * p->states;
        desired[r] += C[VX] * rates[0] + C[VY] * rates[1] + C[VZ] * rates[2] + C[YAW + 1] * rates[3];
    }
}

/* The reference's step from row i to the next, in yaw the shorter way round. */
static void step_from(const real *reference, int i, real step[4])
{
    int j;
    for (j = 0; j < 4; j++) {
        step[j] = reference[(i + 1) * 4 + j] - reference[i * 4 + j];
    }
    step[3] -= TURN * whole_turns(step[3]);
}

/* Velocities and yaw rate of the reference at row i: the mean of the steps before and after it, and at both ends those
 * of the parabola through three rows.  There are at least two rows. */
static void reference_rates(const quadsim_controller *c, const real *reference, int i, real rates[4])
{
    const int last = c->problem->horizon - 2; /* the last step */
    const int second = last > 0 ? 1 : 0;
    int near = i, other = i - 1, j;
    real share = R(0.5), near_step[4], other_step[4];
    if (i == 0) {
        share = R(1.5);
        other = second;
    } else if (i > last) {
        share = R(1.5);
        near = last;
        other = last - second;
    }
    step_from(reference, near, near_step);
    step_from(reference, other, other_step);
    for (j = 0; j < 4; j++) {
        rates[j] = (share * near_step[j] + (R(1.0) - share) * other_step[j]) / c->period;
    }
}

/* Level rest at a state's place and yaw. */
static void rest_at(const real *state, real *rest)
{
    memset(rest, 0, QUADSIM_LAW_STATES * sizeof(real));
    rest[X] = state[X];
    rest[Y] = state[Y];
    rest[Z] = state[Z];
    rest[YAW] = state[YAW];
}

/* ---- the vehicle's model ----------------------------------------------------------------------------------------- */

/* The unit vector along which rotors push, world axes. */
static void thrust_axis_at(const real *state, real axis[3])
{
    real s[3], c[3];
    sines_of(state, s, c);
    push_of(R(1.0), s, c, axis);
}

/* What the air takes from U/m and adds to the angular acceleration (3,), with a sum of the rotors' speeds. */
static real air_effect(const quadsim_robust *robust, const real *state, real speed, const real *sine,
                       const real *cosine, const real *rates, real turned[3])
{
    real velocity[3], along[3];
    velocity[0] = state[VX];
    velocity[1] = state[VY];
    velocity[2] = state[VZ];
    into_body_axes(velocity, sine, cosine, along);
    turn_by_air(robust->across, robust->inflow, robust->damping, speed, along, rates, turned);
    return robust->loss * speed * along[2];
}

/* Rates of change of a state, of U/m, I^-1 tau and the sum of the rotors' speeds (5,) and a constant acceleration (3,).
 * Sec. 2.2. */
static void state_slopes(const quadsim_robust *robust, const real *state, const real *drive, const real *disturbance,
                         real *rates)
{
    const real a = state[ROLL + 1], b = state[PITCH + 1], c = state[YAW + 1];
    real s[3], k[3], w[3], push[3], turned[3], thrust = drive[0], yaw;
    int i;
    sines_of(state, s, k);
    for (i = 0; i < 12; i += 2) {
        rates[i] = state[i + 1];
    }
    rates_of(state, s, k, w);
    memcpy(turned, drive + 1, sizeof(turned));
    add_gyroscopic(robust->gyration, w, turned);
    if (robust->moment) {
        real by_air[3];
        thrust -= air_effect(robust, state, drive[NU], s, k, w, by_air);
        for (i = 0; i < 3; i++) {
            turned[i] += by_air[i];
        }
    }
    push_of(thrust, s, k, push);
    yaw = (turned[1] * s[0] + turned[2] * k[0] + b * (a + c * s[1])) / k[1];
    rates[VX] = push[0] + disturbance[0];
    rates[VY] = push[1] + disturbance[1];
    rates[VZ] = push[2] + (disturbance[2] - robust->gravity);
    rates[ROLL + 1] = turned[0] + b * (c * k[1]) + s[1] * yaw;
    rates[PITCH + 1] = turned[1] * k[0] - turned[2] * s[0] - a * (c * k[1]);
    rates[YAW + 1] = yaw;
}

/* result = state + time rates */
static void state_after(const real *state, real time, const real *rates, real *result)
{
    int i;
    for (i = 0; i < 12; i++) {
        result[i] = state[i] + time * rates[i];
    }
}

/* U/m, I^-1 tau and the sum of the speeds (5,) of rotors that have gone from rotors to command but for a share that
 * decays. */
static void find_drive(const quadsim_mpc *mpc, const real *rotors, const real *command, real decay, real *drive)
{
    int i, j;
    memset(drive, 0, (NU + 1) * sizeof(real));
    for (j = 0; j < NU; j++) {
        const real speed = command[j] + decay * (rotors[j] - command[j]);
        drive[NU] += speed;
        for (i = 0; i < NU; i++) {
            drive[i] += mpc->effectiveness[i * NU + j] * (speed * speed);
        }
    }
}

/* The acceleration (3,) that the estimated disturbance is, world axes, with thrust along an axis. */
static void find_disturbance(const quadsim_mpc *mpc, const real axis[3], real acceleration[3])
{
    acceleration[0] = mpc->estimate[2] * axis[0] + mpc->estimate[0];
    acceleration[1] = mpc->estimate[2] * axis[1] + mpc->estimate[1];
    acceleration[2] = mpc->estimate[2] * axis[2];
}

/* Give a state the rates of Euler angles that body rates are. */
static void put_body_rates(const real w[3], real *state)
{
    real s[3], k[3], yaw;
    sines_of(state, s, k);
    yaw = (w[1] * s[0] + w[2] * k[0]) / k[1];
    state[ROLL + 1] = w[0] + yaw * s[1];
    state[PITCH + 1] = w[1] * k[0] - w[2] * s[0];
    state[YAW + 1] = yaw;
}

/* The state some time [s] later under an inner loop's targets: place, velocity and attitude by Runge-Kutta's classical
 * method, body rates as `answer` [SUBSTEPS][4][6] has them at its instants. */
static void predict_under_targets(const quadsim_mpc *mpc, real time, const real *answer, const real *command,
                                  real *state)
{
    static const real STAGE_TIME[4] = {R(0.0), R(0.5), R(0.5), R(1.0)},
                      STAGE_WEIGHT[4] = {R(1.0), R(2.0), R(2.0), R(1.0)};
    const quadsim_robust *robust = mpc->controller->robust;
    const real step = time / (real)QUADSIM_SUBSTEPS;
    real start[3], w[3], axis[3], disturbance[3], rates[12];
    int k, stage, i;
    thrust_axis_at(state, axis);
    find_disturbance(mpc, axis, disturbance);
    body_rates(state, start);
    for (k = 0; k < QUADSIM_SUBSTEPS; k++) {
        real sum[12] = {R(0.0)};
        memset(rates, 0, sizeof(rates));
        for (stage = 0; stage < 4; stage++, answer += 6) {
            real at[12], s[3], c[3], push[3];
            state_after(state, STAGE_TIME[stage] * step, rates, at);
            for (i = 0; i < 3; i++) {
                const real target = command[1 + i];
                w[i] = target + answer[i] * (start[i] - target) - answer[3 + i] * target;
            }
            put_body_rates(w, at);
            sines_of(at, s, c);
            push_of(command[0] / robust->mass, s, c, push);
            for (i = 0; i < 3; i++) {
                rates[2 * i] = at[2 * i + 1];
                rates[2 * i + 1] = push[i] + disturbance[i];
                rates[ROLL + 2 * i] = at[ROLL + 2 * i + 1];
            }
            rates[VZ] -= robust->gravity;
            for (i = 0; i < 12; i++) {
                sum[i] += STAGE_WEIGHT[stage] * rates[i];
            }
        }
        state_after(state, step / R(6.0), sum, state);
        put_body_rates(w, state);
    }
}

/* The state some time [s] later under a command, by Runge-Kutta's classical method; decay [SUBSTEPS][4] of the rotors'
 * speeds at its instants. */
static void predict_vehicle(const quadsim_mpc *mpc, real time, const real *decay, const real *answer,
                            const real *rotors, const real *command, real *state)
{
    const quadsim_robust *robust = mpc->controller->robust;
    const real step = time / (real)QUADSIM_SUBSTEPS;
    real axis[3], disturbance[3], drive[NU + 1], rates[4][12], at[12];
    int k, i;
    if (!(time > R(1e-9))) {
        return;
    }
    if (robust->targets) {
        predict_under_targets(mpc, time, answer, command, state);
        return;
    }
    thrust_axis_at(state, axis);
    find_disturbance(mpc, axis, disturbance);
    for (k = 0; k < QUADSIM_SUBSTEPS; k++, decay += 4) {
        find_drive(mpc, rotors, command, decay[0], drive);
        state_slopes(robust, state, drive, disturbance, rates[0]);
        find_drive(mpc, rotors, command, decay[1], drive);
        state_after(state, R(0.5) * step, rates[0], at);
        state_slopes(robust, at, drive, disturbance, rates[1]);
        state_after(state, R(0.5) * step, rates[1], at);
        state_slopes(robust, at, drive, disturbance, rates[2]);
        find_drive(mpc, rotors, command, decay[3], drive);
        state_after(state, step, rates[2], at);
        state_slopes(robust, at, drive, disturbance, rates[3]);
        for (i = 0; i < 12; i++) {
            state[i] += step / R(6.0) * (rates[0][i] + R(2.0) * (rates[1][i] + rates[2][i]) + rates[3][i]);
        }
    }
}

/* ---- the disturbance, and rest under it -------------------------------------------------------------------------- */

/* Where the vehicle rests against the estimated disturbance: lift (3,), trim (4,), twist (3,) and effectiveness.
 * U / m R(eta) e_z = g e_z - a,    I^-1 tau = -alpha. */
static void update_trim(quadsim_mpc *mpc)
{
    const quadsim_robust *r = mpc->controller->robust;
    const real x = mpc->estimate[0], y = mpc->estimate[1];
    const real length = square_root(x * x + y * y + r->gravity * r->gravity);
    real axis[3], acceleration[3], drive[NU], up, thrust;
    int i, j;
    axis[0] = -x / length;
    axis[1] = -y / length;
    axis[2] = r->gravity / length;
    find_disturbance(mpc, axis, acceleration);
    up = r->gravity - acceleration[2];
    if (up < r->least_lift * r->gravity) {
        up = r->least_lift * r->gravity;
    }
    thrust = square_root(acceleration[0] * acceleration[0] + acceleration[1] * acceleration[1] + up * up);
    mpc->trim.lift[0] = -acceleration[0];
    mpc->trim.lift[1] = -acceleration[1];
    mpc->trim.lift[2] = up;
    if (r->targets) {
        memset(mpc->trim.commands, 0, sizeof(mpc->trim.commands));
        mpc->trim.commands[0] = r->mass * thrust;
        return;
    }
    memcpy(mpc->effectiveness, r->effectiveness, sizeof(mpc->effectiveness));
    drive[0] = thrust;
    for (i = 0; i < 3; i++) {
        mpc->trim.twist[i] = mpc->estimate[3 + i] / r->gravity;
        drive[1 + i] = -thrust * mpc->trim.twist[i];
        for (j = 0; j < NU; j++) {
            mpc->effectiveness[(1 + i) * NU + j] += mpc->trim.twist[i] * r->effectiveness[j];
        }
    }
    for (j = 0; j < NU; j++) {
        mpc->trim.commands[j] = square_root(dot(r->allocation + j * NU, drive, NU));
    }
}

/* What the air does at a state and the rotors' speeds there beyond what the hover matrices have of it: U/m, I^-1 tau.
 * They have it at hover speeds, of level velocities in their axes and of rates of Euler angles. */
static void air_beyond_hover(const quadsim_mpc *mpc, const real *state, real beyond[NU])
{
    const quadsim_robust *r = mpc->controller->robust;
    const real hovering = sum_of_inputs(mpc->controller->hover), speed = sum_of_inputs(mpc->turning);
    real s[3], k[3], rates[3], along[3], known[3];
    int i;
    sines_of(state, s, k);
    rates_of(state, s, k, rates);
    beyond[0] = r->loss * hovering * state[VZ] - air_effect(r, state, speed, s, k, rates, beyond + 1);
    along[0] = r->heading ? k[2] * state[VX] + s[2] * state[VY] : state[VX];
    along[1] = r->heading ? k[2] * state[VY] - s[2] * state[VX] : state[VY];
    along[2] = R(0.0); /* of two velocities' product they know nothing */
    for (i = 0; i < 3; i++) {
        rates[i] = state[ROLL + 1 + 2 * i];
    }
    turn_by_air(r->across, r->inflow, r->damping, hovering, along, rates, known);
    for (i = 0; i < 3; i++) {
        beyond[1 + i] -= known[i];
    }
}

/* u_s: speeds at rest that also balance what is so now and the hover matrices omit: the torque caused by thrust as it
 * is, and what the air does at a state `ahead`, unless it is NULL. */
static void update_resting(quadsim_mpc *mpc, const real *ahead)
{
    const quadsim_robust *r = mpc->controller->robust;
    const real *rest = mpc->trim.commands;
    real excess_thrust = R(0.0), beyond[NU];
    int j;
    if (r->targets) {
        memcpy(mpc->resting, rest, sizeof(mpc->resting));
        return;
    }
    for (j = 0; j < NU; j++) {
        excess_thrust += r->effectiveness[j] * (mpc->turning[j] * mpc->turning[j] - rest[j] * rest[j]);
    }
    for (j = 0; j < NU; j++) {
        mpc->resting[j] = rest[j] - excess_thrust * dot(r->slope_inverse + j * NU + 1, mpc->trim.twist, 3);
    }
    if (r->moment && ahead != NULL) {
        air_beyond_hover(mpc, ahead, beyond);
        for (j = 0; j < NU; j++) {
            mpc->resting[j] -= dot(r->slope_inverse + j * NU, beyond, NU);
        }
    }
}

/* Update the disturbance from a measured state and the one that was expected. */
static void observe_state(quadsim_mpc *mpc, const real *measured, const real *expected)
{
    const quadsim_robust *r = mpc->controller->robust;
    real axis[3], rates[3], expected_rates[3], surprise[6], upright;
    int i;
    thrust_axis_at(measured, axis);
    body_rates(measured, rates);
    body_rates(expected, expected_rates);
    upright = axis[2] > r->upright ? axis[2] : r->upright;
    surprise[2] = (measured[VZ] - expected[VZ]) / upright;
    surprise[0] = (measured[VX] - expected[VX]) - surprise[2] * axis[0];
    surprise[1] = (measured[VY] - expected[VY]) - surprise[2] * axis[1];
    for (i = 0; i < 3; i++) {
        surprise[3 + i] = rates[i] - expected_rates[i];
    }
    update_disturbance(r->gain, r->largest, surprise, mpc->estimate);
    update_trim(mpc);
}

/* ---- the robust controller --------------------------------------------------------------------------------------- */

/* Rotor speeds after a time, of which the share that is still what it was is decay. */
static void spin_rotors(real *rotors, const real *command, real decay)
{
    int j;
    for (j = 0; j < NU; j++) {
        rotors[j] = command[j] + decay * (rotors[j] - command[j]);
    }
}

/* The reference's row at the instant that its prediction is for, the delay after it; turns are those of row i. */
static void later_row(const quadsim_controller *c, const real *reference, int i, real turns, real row[4])
{
    const int last = i == c->problem->horizon - 1;
    const real *now = reference + i * 4, *next = last ? now : now + 4;
    const real heading = now[3] - TURN * turns;
    const real ahead = last ? heading : next[3] - TURN * next_turns(reference, i + 1, turns);
    int j;
    for (j = 0; j < 3; j++) {
        row[j] = now[j] + c->robust->delayed_share * (next[j] - now[j]);
    }
    row[3] = heading + c->robust->delayed_share * (ahead - heading);
}

/* The reference's rates at the instant that the prediction of row i is for, likewise. */
static void later_rates(const quadsim_controller *c, const real *reference, int i, real rates[4])
{
    const int next = i == c->problem->horizon - 1 ? i : i + 1;
    real ahead[4];
    int j;
    reference_rates(c, reference, i, rates);
    reference_rates(c, reference, next, ahead);
    for (j = 0; j < 4; j++) {
        rates[j] += c->robust->delayed_share * (ahead[j] - rates[j]);
    }
}

/* The first two numbers, along world x and y, in axes turned by an angle. */
static void turn_axes(real row[4], real sine, real cosine)
{
    const real x = row[0], y = row[1];
    row[0] = cosine * x + sine * y;
    row[1] = cosine * y - sine * x;
}

/* y_d of the reference [N][4] as the prediction is given it: later by the delay, and where the model is turned by the
 * heading, yaw without jumps, seen from axes turned by it. */
static void put_desired(quadsim_mpc *mpc, const real *reference, real turns, real yaw, real sine, real cosine)
{
    const quadsim_controller *c = mpc->controller;
    const int end = c->problem->horizon - 1, under_way = c->robust->under_way;
    real row[4], rates[4], last = yaw, turned = yaw;
    int i;
    for (i = 0; i < under_way && i <= end; i++) { /* rows that are past when the command acts */
        turns = next_turns(reference, i, turns);
    }
    for (i = 0; i <= end; i++) {
        const int at = i + under_way < end ? i + under_way : end;
        real *desired = mpc->desired + i * c->problem->regulated;
        if (i + under_way <= end) {
            turns = next_turns(reference, at, turns);
        }
        later_row(c, reference, at, turns, row);
        if (c->robust->heading) {
            const real step = row[3] - last;
            last = row[3];
            turned += clipped(step, -c->robust->largest_turn, c->robust->largest_turn);
            turn_axes(row, sine, cosine);
            row[3] = turned - yaw;
        }
        put_places(c->problem, row, desired);
        if (c->follows_rates) {
            later_rates(c, reference, at, rates);
            if (c->robust->heading) {
                turn_axes(rates, sine, cosine);
            }
            add_rates(c->problem, rates, desired);
        }
    }
}

/* The last states of a state, which are rotor speeds where these lag. */
static void put_speeds(const quadsim_problem *p, const real *speeds, real *state)
{
    int j;
    for (j = 0; j < p->rotor_states; j++) {
        state[12 + j] = speeds[j];
    }
}

/* Where the model rests: x_s at the present place, u_s as it is. */
static void put_rest(quadsim_mpc *mpc, real sine, real cosine)
{
    rest_at(mpc->state, mpc->rest);
    lean_of(mpc->trim.lift, sine, cosine, &mpc->rest[ROLL], &mpc->rest[PITCH]);
    put_speeds(mpc->controller->problem, mpc->resting, mpc->rest);
}

/* The query from a state at the instant from which the command acts. */
static void put_query(quadsim_mpc *mpc, const real *ahead, const real *reference, real turns)
{
    const quadsim_controller *c = mpc->controller;
    real *state = mpc->state, sine = R(0.0), cosine = R(1.0);
    memcpy(state, ahead, 12 * sizeof(real));
    mpc->yaw = R(0.0);
    if (c->robust->heading) {
        mpc->yaw = ahead[YAW];
        sin_cos(ahead[YAW], &sine, &cosine);
        state[X] = cosine * ahead[X] + sine * ahead[Y];
        state[Y] = cosine * ahead[Y] - sine * ahead[X];
        state[VX] = cosine * ahead[VX] + sine * ahead[VY];
        state[VY] = cosine * ahead[VY] - sine * ahead[VX];
        state[YAW] = R(0.0);
    }
    put_speeds(c->problem, mpc->turning, state);
    put_rest(mpc, sine, cosine);
    put_desired(mpc, reference, turns, ahead[YAW], sine, cosine);
}

/* The i-th of the commands that act one after the other until this period's does: in force, under way. */
static const real *sent_command(const quadsim_mpc *mpc, int i, const real *acting)
{
    return i < mpc->controller->robust->under_way ? mpc->sent + i * NU : acting;
}

/* Take note of the last command sent. */
static void note_sent(quadsim_mpc *mpc, const real *acting)
{
    const int n = mpc->controller->robust->under_way;
    int i;
    for (i = 0; i < n; i++) {
        memcpy(mpc->sent + i * NU, sent_command(mpc, i + 1, acting), NU * sizeof(real));
    }
}

/* Let the rotors follow their commands up to the instant from which this period's acts.  From a state (12,), NULL where
 * none is usable, predict the one there, `ahead`, and let the observer compare it with the one expected; returns
 * whether there is one. */
static int predict_ahead(quadsim_mpc *mpc, const real *state, int learns, real ahead[12])
{
    const quadsim_robust *r = mpc->controller->robust;
    const real *acting = mpc->acting, *in_force = sent_command(mpc, 0, acting);
    real before[NU], expected[12];
    int i;
    memcpy(before, mpc->rotors, sizeof(before));
    spin_rotors(mpc->rotors, in_force, r->spun_before);
    if (state != NULL && r->observes && mpc->known && learns) {
        memcpy(expected, mpc->ahead, sizeof(expected));
        predict_vehicle(mpc, r->rest_of_period, r->decay_before, r->answer_before, before, in_force, expected);
        if (is_finite(expected, 12)) {
            observe_state(mpc, state, expected);
        }
    }
    if (state != NULL) {
        memcpy(mpc->ahead, state, sizeof(mpc->ahead));
        predict_vehicle(mpc, r->delay, r->decay_delay, r->answer_delay, mpc->rotors, in_force, mpc->ahead);
    }
    spin_rotors(mpc->rotors, in_force, r->spun_delay);
    memcpy(ahead, mpc->ahead, sizeof(mpc->ahead));
    memcpy(mpc->turning, mpc->rotors, sizeof(mpc->turning));
    for (i = 1; i <= r->under_way; i++) {
        const real *next = sent_command(mpc, i, acting);
        if (state != NULL) {
            predict_vehicle(mpc, r->period, r->decay_period, r->answer_period, mpc->turning, next, ahead);
        }
        spin_rotors(mpc->turning, next, r->spun_period);
    }
    note_sent(mpc, acting);
    mpc->known = state != NULL && is_finite(ahead, 12);
    update_resting(mpc, mpc->known ? ahead : NULL);
    return mpc->known;
}

/* The query of the robust controller; returns whether there is one. */
static int prepare_robust(quadsim_mpc *mpc, int flying, int learns, const real *state, const real *reference)
{
    real ahead[12];
    const int known = predict_ahead(mpc, state, learns, ahead);
    mpc->known = known && flying;
    if (known && state != NULL) {
        put_query(mpc, ahead, reference, first_turns(&mpc->headed, &mpc->heading, reference, state[YAW]));
    }
    return known;
}

/* ---- the controllers --------------------------------------------------------------------------------------------- */

/* Whether numbers are within magnitudes [count] that are taken for a measurement, as none that is not finite is. */
static int is_plausible(const real *numbers, const real *most, int count)
{
    int i;
    for (i = 0; i < count; i++) {
        if (!(numbers[i] >= -most[i] && numbers[i] <= most[i])) {
            return 0;
        }
    }
    return 1;
}

/* Whether a period's inputs can be answered. */
static int is_usable(const quadsim_controller *c, const real *state, const real *reference, const real *acting)
{
    const int N = c->problem->horizon;
    int i;
    if (!is_finite(acting, NU)) {
        return 0;
    }
    if (c->robust == NULL) {
        return is_finite(state, 12) && is_finite(reference, N * 4);
    }
    for (i = 0; i < N; i++) {
        if (!is_plausible(reference + i * 4, c->robust->plausible_reference, 4)) {
            return 0;
        }
    }
    return is_plausible(state, c->robust->plausible_state, 12);
}

/* The query of the paper's controllers. */
static void prepare_paper(quadsim_mpc *mpc, const real *state, const real *reference)
{
    const quadsim_controller *c = mpc->controller;
    real row[4], rates[4], turns = first_turns(&mpc->headed, &mpc->heading, reference, state[YAW]);
    int i;
    memcpy(mpc->state, state, 12 * sizeof(real));
    memcpy(mpc->resting, c->hover, sizeof(mpc->resting));
    rest_at(state, mpc->rest); /* hover is an equilibrium anywhere and at any yaw: here there is least to round */
    for (i = 0; i < c->problem->horizon; i++) {
        real *desired = mpc->desired + i * c->problem->regulated;
        turns = next_turns(reference, i, turns);
        memcpy(row, reference + i * 4, sizeof(row));
        row[3] -= TURN * turns;
        put_places(c->problem, row, desired);
        if (c->follows_rates) {
            reference_rates(c, reference, i, rates);
            add_rates(c->problem, rates, desired);
        }
    }
}

/* Numbers of the commands that are remembered. */
static int sent_reals(const quadsim_controller *controller)
{
    return controller->robust == NULL ? 0 : controller->robust->under_way * NU;
}

long quadsim_mpc_reals(const quadsim_controller *controller)
{
    const quadsim_problem *p = controller->problem;
    return quadsim_work_reals(p) + p->horizon * (p->regulated + NU) + sent_reals(controller);
}

void quadsim_mpc_start(quadsim_mpc *mpc, const quadsim_controller *controller, real *memory)
{
    const quadsim_problem *p = controller->problem;
    memset(mpc, 0, sizeof(*mpc));
    mpc->controller = controller;
    mpc->desired = memory;
    mpc->kept = memory + p->horizon * p->regulated;
    mpc->sent = mpc->kept + p->horizon * NU;
    quadsim_work_start(&mpc->work, p, mpc->sent + sent_reals(controller));
    quadsim_guard_start(&mpc->guard, controller->fallback, p->horizon, mpc->kept);
    quadsim_mpc_reset(mpc, controller->hover);
}

void quadsim_mpc_reset(quadsim_mpc *mpc, const quadsim_real speeds[4])
{
    const quadsim_fallback *fallback = mpc->controller->fallback;
    const real *usable = is_finite(speeds, NU) ? speeds : mpc->controller->hover;
    int i;
    if (fallback != NULL) {
        quadsim_guard_reset(&mpc->guard, speeds);
        usable = mpc->guard.before;
    }
    memcpy(mpc->before, usable, sizeof(mpc->before));
    memcpy(mpc->rotors, usable, sizeof(mpc->rotors));
    memcpy(mpc->turning, usable, sizeof(mpc->turning));
    for (i = 0; i < sent_reals(mpc->controller); i++) {
        mpc->sent[i] = usable[i % NU];
    }
    memset(mpc->estimate, 0, sizeof(mpc->estimate));
    quadsim_work_reset(&mpc->work);
    mpc->known = mpc->headed = 0;
    memcpy(mpc->resting, mpc->controller->hover, sizeof(mpc->resting));
    memcpy(mpc->trim.commands, mpc->controller->hover, sizeof(mpc->trim.commands));
    mpc->trim.lift[2] = R(1.0);
    if (mpc->controller->robust != NULL) {
        update_trim(mpc);
        update_resting(mpc, NULL);
    }
}

/* Take note of the command in force: the last one where what is given is not finite. */
static void put_acting(quadsim_mpc *mpc, const real *acting)
{
    memcpy(mpc->acting, is_finite(acting, NU) ? acting : mpc->before, sizeof(mpc->acting));
}

void quadsim_mpc_stand(quadsim_mpc *mpc, const quadsim_real acting[4])
{
    real ahead[12];
    put_acting(mpc, acting);
    if (mpc->controller->robust != NULL) {
        (void)predict_ahead(mpc, NULL, 0, ahead);
        memset(mpc->estimate, 0, sizeof(mpc->estimate));
        update_trim(mpc);
        update_resting(mpc, NULL);
    }
    memcpy(mpc->before, mpc->acting, sizeof(mpc->before));
}

void quadsim_mpc_learn(quadsim_mpc *mpc, const quadsim_real estimate[6])
{
    const quadsim_robust *r = mpc->controller->robust;
    if (r == NULL || !r->observes || !is_finite(estimate, 6)) {
        return;
    }
    put_disturbance(r->largest, estimate, mpc->estimate);
    update_trim(mpc);
    update_resting(mpc, NULL);
}

enum quadsim_status quadsim_mpc_prepare(quadsim_mpc *mpc, int flying, int learns, const quadsim_real state[12],
                                        const quadsim_real *reference, const quadsim_real acting[4])
{
    const quadsim_controller *c = mpc->controller;
    int usable = is_usable(c, state, reference, acting);
    mpc->work.changes = 0;
    put_acting(mpc, acting);
    if (c->robust != NULL) {
        usable = prepare_robust(mpc, flying, learns, usable ? state : NULL, reference);
    } else if (usable) {
        prepare_paper(mpc, state, reference);
    }
    return usable ? QUADSIM_FREE : QUADSIM_INVALID_DATA;
}

enum quadsim_status quadsim_mpc_optimise(quadsim_mpc *mpc)
{
    return (enum quadsim_status)quadsim_optimise(&mpc->work, mpc->state, mpc->desired, mpc->rest, mpc->resting,
                                                 mpc->acting);
}

enum quadsim_status quadsim_mpc_step(quadsim_mpc *mpc, enum quadsim_phase phase, const quadsim_real state[12],
                                     const quadsim_real *reference, const quadsim_real acting[4],
                                     quadsim_real command[4])
{
    const quadsim_controller *c = mpc->controller;
    quadsim_guard *guard = &mpc->guard;
    const real *plan = mpc->work.plan;
    enum quadsim_status status =
        quadsim_guard_begin(guard, phase, &mpc->trim, state, reference, c->problem->horizon * 4, acting);
    if (status == QUADSIM_FREE && phase == QUADSIM_PHASE_LANDED) {
        quadsim_mpc_stand(mpc, guard->in_force);
    } else if (status == QUADSIM_FREE) {
        status = quadsim_mpc_prepare(mpc, phase == QUADSIM_PHASE_FLYING, guard->learns, guard->state, reference,
                                     guard->in_force);
        if (status == QUADSIM_FREE) {
            status = quadsim_mpc_optimise(mpc);
        }
        status = quadsim_guard_check(guard, status, plan);
    }
    if (quadsim_guard_foresees(guard, phase, status)) { /* the paper's model is not turned */
        quadsim_guard_foresee(guard, c->robust != NULL, &mpc->trim, mpc->resting);
    }
    status = quadsim_guard_end(guard, phase, &mpc->trim, status, plan, command);
    memcpy(mpc->before, command, sizeof(mpc->before));
    return status;
}
