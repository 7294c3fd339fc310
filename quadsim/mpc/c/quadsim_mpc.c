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

/* y_d [n_r] = C_r times a row of the reference, at the entries of position and yaw. */
static void put_desired_pose(const quadsim_problem *p, const real row[4], real *desired)
{
    int r;
    for (r = 0; r < p->regulated; r++) {
        const real *C = p->C_r + r * p->states;
        desired[r] = C[X] * row[0] + C[Y] * row[1] + C[Z] * row[2] + C[YAW] * row[3];
    }
}

/* Add C_r times the velocities and the yaw rate of a row to y_d; roll, pitch and their rates are desired to be 0. */
static void add_desired_rates(const quadsim_problem *p, const real rates[4], real *desired)
{
    int r;
    for (r = 0; r < p->regulated; r++) {
        const real *C = p->C_r + r * p->states;
        desired[r] += C[VX] * rates[0] + C[VY] * rates[1] + C[VZ] * rates[2] + C[YAW + 1] * rates[3];
    }
}

/* The reference's step from row i to the next, in yaw the shorter way round. */
static void reference_step(const real *reference, int i, real step[4])
{
    int j;
    for (j = 0; j < 4; j++) {
        step[j] = reference[(i + 1) * 4 + j] - reference[i * 4 + j];
    }
    step[3] -= TURN * whole_turns(step[3]);
}

/* Velocities and yaw rate of the reference at row i: inside, the mean of the steps before and after it; at both ends,
 * those of the parabola through three rows, 3/2 of the near step less 1/2 of the next one.  There are at least two
 * rows, and of two, both steps are the same one. */
static void reference_rates(const quadsim_controller *c, const real *reference, int i, real rates[4])
{
    const int last_step = c->problem->horizon - 2;
    const int neighbour = last_step > 0 ? 1 : 0;
    int near = i, other = i - 1, j;
    real share = R(0.5), near_step[4], other_step[4];
    if (i == 0) {
        share = R(1.5);
        other = neighbour;
    } else if (i > last_step) {
        share = R(1.5);
        near = last_step;
        other = last_step - neighbour;
    }
    reference_step(reference, near, near_step);
    reference_step(reference, other, other_step);
    for (j = 0; j < 4; j++) {
        rates[j] = (share * near_step[j] + (R(1.0) - share) * other_step[j]) / c->period;
    }
}

/* x_s: level and at rest at a state's position and yaw. */
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

/* What the air does at a state, where the speeds of all rotors add up to `speed`: it adds `angular` (3,) to the angular
 * acceleration; returns what it takes from U/m. */
static real air_effect(const quadsim_robust *robust, const real *state, real speed, const real *sine,
                       const real *cosine, const real *rates, real angular[3])
{
    real velocity[3], along[3];
    velocity[0] = state[VX];
    velocity[1] = state[VY];
    velocity[2] = state[VZ];
    into_body_axes(velocity, sine, cosine, along);
    turn_by_air(robust->across, robust->inflow, robust->damping, speed, along, rates, angular);
    return robust->loss * speed * along[2];
}

/* The rates of change of a state, Sec. 2.2, under `drive` (5,) = U/m, I^-1 tau and the sum of the rotors' speeds, and a
 * constant acceleration `disturbance` (3,). */
static void state_slopes(const quadsim_robust *robust, const real *state, const real *drive, const real *disturbance,
                         real *slopes)
{
    const real roll_rate = state[ROLL + 1], pitch_rate = state[PITCH + 1], yaw_rate = state[YAW + 1];
    real s[3], k[3], rates[3], push[3], angular[3], thrust = drive[0], yaw_slope; /* s, k: sines and cosines */
    int i;
    sines_of(state, s, k);
    for (i = 0; i < 12; i += 2) {
        slopes[i] = state[i + 1];
    }
    rates_of(state, s, k, rates);
    memcpy(angular, drive + 1, sizeof(angular));
    add_gyroscopic(robust->gyration, rates, angular);
    if (robust->moment) {
        real by_air[3];
        thrust -= air_effect(robust, state, drive[NU], s, k, rates, by_air);
        for (i = 0; i < 3; i++) {
            angular[i] += by_air[i];
        }
    }
    push_of(thrust, s, k, push);
    yaw_slope = (angular[1] * s[0] + angular[2] * k[0] + pitch_rate * (roll_rate + yaw_rate * s[1])) / k[1];
    slopes[VX] = push[0] + disturbance[0];
    slopes[VY] = push[1] + disturbance[1];
    slopes[VZ] = push[2] + (disturbance[2] - robust->gravity);
    slopes[ROLL + 1] = angular[0] + pitch_rate * (yaw_rate * k[1]) + s[1] * yaw_slope;
    slopes[PITCH + 1] = angular[1] * k[0] - angular[2] * s[0] - roll_rate * (yaw_rate * k[1]);
    slopes[YAW + 1] = yaw_slope;
}

/* result = state + time slopes */
static void state_after(const real *state, real time, const real *slopes, real *result)
{
    int i;
    for (i = 0; i < 12; i++) {
        result[i] = state[i] + time * slopes[i];
    }
}

/* drive (5,) = U/m, I^-1 tau and the sum of the rotors' speeds, which follow a command: of their first distance from it
 * the share `decay` is left. */
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

/* The estimated disturbance as an acceleration (3,) in world axes: its third component is along the thrust. */
static void find_disturbance(const quadsim_mpc *mpc, const real axis[3], real acceleration[3])
{
    acceleration[0] = mpc->estimate[2] * axis[0] + mpc->estimate[0];
    acceleration[1] = mpc->estimate[2] * axis[1] + mpc->estimate[1];
    acceleration[2] = mpc->estimate[2] * axis[2];
}

/* Set the rates of the Euler angles of a state to those of body rates w. */
static void put_body_rates(const real w[3], real *state)
{
    real s[3], k[3], yaw;
    sines_of(state, s, k);
    yaw = (w[1] * s[0] + w[2] * k[0]) / k[1];
    state[ROLL + 1] = w[0] + yaw * s[1];
    state[PITCH + 1] = w[1] * k[0] - w[2] * s[0];
    state[YAW + 1] = yaw;
}

/* The rates of change of a state under targets of an inner loop, in the stage of a step at which the inner loop's
 * response is `answer` [6]; `at` gets the body rates w there, a w(0) + (1 - a - b) w_c.  The entries of the rates of
 * Euler angles stay as they are: they are known, not integrated. */
static void slopes_under_targets(const quadsim_robust *robust, const real *answer, const real *start,
                                 const real *command, const real *disturbance, real *at, real w[3], real *slopes)
{
    real s[3], c[3], push[3];
    int i;
    for (i = 0; i < 3; i++) {
        const real target = command[1 + i];
        w[i] = target + answer[i] * (start[i] - target) - answer[3 + i] * target;
    }
    put_body_rates(w, at);
    sines_of(at, s, c);
    push_of(command[0] / robust->mass, s, c, push);
    for (i = 0; i < 3; i++) {
        slopes[2 * i] = at[2 * i + 1];
        slopes[2 * i + 1] = push[i] + disturbance[i];
        slopes[ROLL + 2 * i] = at[ROLL + 2 * i + 1];
    }
    slopes[VZ] -= robust->gravity;
}

/* The state some time [s] later under an inner loop's targets: place, velocity and attitude by Runge-Kutta's classical
 * method, body rates as `answer` [SUBSTEPS][4][6] has them at its instants. */
static void predict_under_targets(const quadsim_mpc *mpc, real time, const real *answer, const real *command,
                                  real *state)
{
    static const real STAGE_TIME[4] = {R(0.0), R(0.5), R(0.5), R(1.0)};
    static const real STAGE_WEIGHT[4] = {R(1.0), R(2.0), R(2.0), R(1.0)};
    const quadsim_robust *robust = mpc->controller->robust;
    const real step = time / (real)QUADSIM_SUBSTEPS;
    real start[3], w[3], axis[3], disturbance[3], slopes[12], at[12];
    int k, stage, i;
    thrust_axis_at(state, axis);
    find_disturbance(mpc, axis, disturbance);
    body_rates(state, start);
    for (k = 0; k < QUADSIM_SUBSTEPS; k++) {
        real sum[12] = {R(0.0)};
        memset(slopes, 0, sizeof(slopes));
        for (stage = 0; stage < 4; stage++, answer += 6) {
            state_after(state, STAGE_TIME[stage] * step, slopes, at);
            slopes_under_targets(robust, answer, start, command, disturbance, at, w, slopes);
            for (i = 0; i < 12; i++) {
                sum[i] += STAGE_WEIGHT[stage] * slopes[i];
            }
        }
        state_after(state, step / R(6.0), sum, state);
        put_body_rates(w, state);
    }
}

/* The state some time [s] later under a command, by Runge-Kutta's classical method.  `decay` [SUBSTEPS][4] has the
 * share that is left of the rotors' distance from the command at the instants of its stages; `answer` is what
 * predict_under_targets takes where the command is of targets. */
static void predict_vehicle(const quadsim_mpc *mpc, real time, const real *decay, const real *answer,
                            const real *rotors, const real *command, real *state)
{
    const quadsim_robust *robust = mpc->controller->robust;
    const real step = time / (real)QUADSIM_SUBSTEPS;
    real axis[3], disturbance[3], drive[NU + 1], slopes[4][12], at[12];
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
        state_slopes(robust, state, drive, disturbance, slopes[0]);
        find_drive(mpc, rotors, command, decay[1], drive);
        state_after(state, R(0.5) * step, slopes[0], at);
        state_slopes(robust, at, drive, disturbance, slopes[1]);
        state_after(state, R(0.5) * step, slopes[1], at);
        state_slopes(robust, at, drive, disturbance, slopes[2]);
        find_drive(mpc, rotors, command, decay[3], drive);
        state_after(state, step, slopes[2], at);
        state_slopes(robust, at, drive, disturbance, slopes[3]);
        for (i = 0; i < 12; i++) {
            state[i] += step / R(6.0) * (slopes[0][i] + R(2.0) * (slopes[1][i] + slopes[2][i]) + slopes[3][i]);
        }
    }
}

/* ---- the disturbance, and rest under it -------------------------------------------------------------------------- */

/* Where thrust along g e_z - a balances gravity and the estimated disturbance: puts g e_z - a into the trim's lift (3,)
 * and returns U/m.  Its vertical part is at least a share of gravity. */
static real find_lift(quadsim_mpc *mpc)
{
    const quadsim_robust *r = mpc->controller->robust;
    const real x = mpc->estimate[0], y = mpc->estimate[1];
    const real length = square_root(x * x + y * y + r->gravity * r->gravity);
    real axis[3], acceleration[3], up;
    axis[0] = -x / length;
    axis[1] = -y / length;
    axis[2] = r->gravity / length;
    find_disturbance(mpc, axis, acceleration);
    up = r->gravity - acceleration[2];
    if (up < r->least_lift * r->gravity) {
        up = r->least_lift * r->gravity;
    }
    mpc->trim.lift[0] = -acceleration[0];
    mpc->trim.lift[1] = -acceleration[1];
    mpc->trim.lift[2] = up;
    return square_root(acceleration[0] * acceleration[0] + acceleration[1] * acceleration[1] + up * up);
}

/* Where the vehicle rests against the estimated disturbance: lift (3,), trim (4,), twist (3,) and effectiveness.
 * U / m R(eta) e_z = g e_z - a,    I^-1 tau = -(U / m) twist. */
static void update_trim(quadsim_mpc *mpc)
{
    const quadsim_robust *r = mpc->controller->robust;
    const real thrust = find_lift(mpc);
    real drive[NU];
    int i, j;
    if (r->targets) {
        memset(mpc->trim.commands, 0, sizeof(mpc->trim.commands));
        mpc->trim.commands[0] = r->mass * thrust;
        return;
    }
    memcpy(mpc->effectiveness, r->effectiveness, sizeof(mpc->effectiveness));
    drive[0] = thrust;
    for (i = 0; i < 3; i++) {
        const real twist = mpc->estimate[3 + i] / r->gravity;
        mpc->trim.twist[i] = twist;
        drive[1 + i] = -thrust * twist;
        for (j = 0; j < NU; j++) {
            mpc->effectiveness[(1 + i) * NU + j] += twist * r->effectiveness[j];
        }
    }
    for (j = 0; j < NU; j++) {
        mpc->trim.commands[j] = square_root(dot(r->allocation + j * NU, drive, NU));
    }
}

/* The components of a horizontal vector along axes that are turned about world z by an angle with this sine and
 * cosine. */
static void into_turned_axes(real x, real y, real sine, real cosine, real *along_x, real *along_y)
{
    *along_x = cosine * x + sine * y;
    *along_y = cosine * y - sine * x;
}

/* beyond (4,) = what the air does to U/m and I^-1 tau at a state and the rotors' speeds there, less what the hover
 * matrices have of it.  They have it of hover speeds, of horizontal velocities along their axes and of the rates of
 * Euler angles; not of inflow, a product of two velocities. */
static void air_beyond_hover(const quadsim_mpc *mpc, const real *state, real beyond[NU])
{
    const quadsim_robust *r = mpc->controller->robust;
    const real hovering = sum_of_inputs(mpc->controller->hover), speed = sum_of_inputs(mpc->rotors_ahead);
    real s[3], k[3], rates[3], euler_rates[3], along[3], in_matrices[3];
    int i;
    sines_of(state, s, k);
    rates_of(state, s, k, rates);
    beyond[0] = r->loss * hovering * state[VZ] - air_effect(r, state, speed, s, k, rates, beyond + 1);
    along[0] = state[VX];
    along[1] = state[VY];
    along[2] = R(0.0);
    if (r->heading) {
        into_turned_axes(state[VX], state[VY], s[2], k[2], &along[0], &along[1]);
    }
    for (i = 0; i < 3; i++) {
        euler_rates[i] = state[ROLL + 1 + 2 * i];
    }
    turn_by_air(r->across, r->inflow, r->damping, hovering, along, euler_rates, in_matrices);
    for (i = 0; i < 3; i++) {
        beyond[1 + i] -= in_matrices[i];
    }
}

/* u_s: the trim's speeds, changed so that they also balance two effects of the present that the hover matrices omit:
 * the torque that the disturbance causes at the present thrust, and what the air does at a state `ahead`, unless NULL.
 */
static void update_rest_command(quadsim_mpc *mpc, const real *ahead)
{
    const quadsim_robust *r = mpc->controller->robust;
    const real *rest = mpc->trim.commands;
    real excess_thrust = R(0.0), beyond[NU];
    int j;
    if (r->targets) {
        memcpy(mpc->rest_command, rest, sizeof(mpc->rest_command));
        return;
    }
    for (j = 0; j < NU; j++) {
        excess_thrust += r->effectiveness[j] * (mpc->rotors_ahead[j] * mpc->rotors_ahead[j] - rest[j] * rest[j]);
    }
    for (j = 0; j < NU; j++) {
        mpc->rest_command[j] = rest[j] - excess_thrust * dot(r->slope_inverse + j * NU + 1, mpc->trim.twist, 3);
    }
    if (r->moment && ahead != NULL) {
        air_beyond_hover(mpc, ahead, beyond);
        for (j = 0; j < NU; j++) {
            mpc->rest_command[j] -= dot(r->slope_inverse + j * NU, beyond, NU);
        }
    }
}

/* Update the disturbance from the innovation, the difference of a measured state and the one that was expected.  Of
 * velocities, the vertical difference is taken to be that along the thrust axis, over the cosine of the tilt; what that
 * leaves of the horizontal differences is along world x and y. */
static void observe_state(quadsim_mpc *mpc, const real *measured, const real *expected)
{
    const quadsim_robust *r = mpc->controller->robust;
    real axis[3], rates[3], expected_rates[3], innovation[6], upright;
    int i;
    thrust_axis_at(measured, axis);
    body_rates(measured, rates);
    body_rates(expected, expected_rates);
    upright = axis[2] > r->upright ? axis[2] : r->upright;
    innovation[2] = (measured[VZ] - expected[VZ]) / upright;
    innovation[0] = (measured[VX] - expected[VX]) - innovation[2] * axis[0];
    innovation[1] = (measured[VY] - expected[VY]) - innovation[2] * axis[1];
    for (i = 0; i < 3; i++) {
        innovation[3 + i] = rates[i] - expected_rates[i];
    }
    update_disturbance(r->gain, r->largest, innovation, mpc->estimate);
    update_trim(mpc);
}

/* ---- the robust controller --------------------------------------------------------------------------------------- */

/* Rotor speeds after some time under a command: of their distance from it the share `decay` is left. */
static void follow_command(real *rotors, const real *command, real decay)
{
    int j;
    for (j = 0; j < NU; j++) {
        rotors[j] = command[j] + decay * (rotors[j] - command[j]);
    }
}

/* Row i of the reference at the instant that its prediction is for, which is the delay later: interpolated, and held
 * after the last row.  From the yaw of row i so many turns are taken off. */
static void later_row(const quadsim_controller *c, const real *reference, int i, real turns, real row[4])
{
    const real share = c->robust->delayed_share;
    const real *now = reference + i * 4, *next = now;
    const real yaw = now[3] - TURN * turns;
    real next_yaw = yaw;
    int j;
    if (i < c->problem->horizon - 1) {
        next = now + 4;
        next_yaw = next[3] - TURN * next_turns(reference, i + 1, turns);
    }
    for (j = 0; j < 3; j++) {
        row[j] = now[j] + share * (next[j] - now[j]);
    }
    row[3] = yaw + share * (next_yaw - yaw);
}

/* The reference's rates at that instant, likewise. */
static void later_rates(const quadsim_controller *c, const real *reference, int i, real rates[4])
{
    const int next = i == c->problem->horizon - 1 ? i : i + 1;
    real next_rates[4];
    int j;
    reference_rates(c, reference, i, rates);
    reference_rates(c, reference, next, next_rates);
    for (j = 0; j < 4; j++) {
        rates[j] += c->robust->delayed_share * (next_rates[j] - rates[j]);
    }
}

/* y_d of the reference [N][4]: later by the delay, and where the model is turned by the heading, in axes turned by it,
 * with yaw as distance from the present one, in steps of at most the largest turn.  Rows that are past when the command
 * acts are passed over, and the last row is held. */
static void put_desired(quadsim_mpc *mpc, const real *reference, real turns, real yaw, real sine, real cosine)
{
    const quadsim_controller *c = mpc->controller;
    const quadsim_robust *robust = c->robust;
    const int last_row = c->problem->horizon - 1, under_way = robust->under_way;
    real row[4], rates[4], yaw_before = yaw, limited_yaw = yaw;
    int i;
    for (i = 0; i < under_way && i <= last_row; i++) {
        turns = next_turns(reference, i, turns);
    }
    for (i = 0; i <= last_row; i++) {
        const int at = i + under_way < last_row ? i + under_way : last_row;
        real *desired = mpc->desired + i * c->problem->regulated;
        if (i + under_way <= last_row) {
            turns = next_turns(reference, at, turns);
        }
        later_row(c, reference, at, turns, row);
        if (robust->heading) {
            const real step = row[3] - yaw_before;
            yaw_before = row[3];
            limited_yaw += clipped(step, -robust->largest_turn, robust->largest_turn);
            into_turned_axes(row[0], row[1], sine, cosine, &row[0], &row[1]);
            row[3] = limited_yaw - yaw;
        }
        put_desired_pose(c->problem, row, desired);
        if (c->follows_rates) {
            later_rates(c, reference, at, rates);
            if (robust->heading) {
                into_turned_axes(rates[0], rates[1], sine, cosine, &rates[0], &rates[1]);
            }
            add_desired_rates(c->problem, rates, desired);
        }
    }
}

/* Put rotor speeds into the last entries of a state, where these lag. */
static void put_speeds(const quadsim_problem *p, const real *speeds, real *state)
{
    int j;
    for (j = 0; j < p->rotor_states; j++) {
        state[12 + j] = speeds[j];
    }
}

/* x_s: at the present position, with the lean that balances the disturbance, and with the rotor speeds u_s. */
static void put_rest(quadsim_mpc *mpc, real sine, real cosine)
{
    rest_at(mpc->state, mpc->rest);
    lean_of(mpc->trim.lift, sine, cosine, &mpc->rest[ROLL], &mpc->rest[PITCH]);
    put_speeds(mpc->controller->problem, mpc->rest_command, mpc->rest);
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
        into_turned_axes(ahead[X], ahead[Y], sine, cosine, &state[X], &state[Y]);
        into_turned_axes(ahead[VX], ahead[VY], sine, cosine, &state[VX], &state[VY]);
        state[YAW] = R(0.0);
    }
    put_speeds(c->problem, mpc->rotors_ahead, state);
    put_rest(mpc, sine, cosine);
    put_desired(mpc, reference, turns, ahead[YAW], sine, cosine);
}

/* The i-th of the commands that act one after the other until this period's does: 0 is in force, the last was sent a
 * period ago. */
static const real *sent_command(const quadsim_mpc *mpc, int i, const real *acting)
{
    return i < mpc->controller->robust->under_way ? mpc->sent + i * NU : acting;
}

/* Move the commands under way on by a period, with the last one sent as the newest. */
static void note_sent(quadsim_mpc *mpc, const real *acting)
{
    const int n = mpc->controller->robust->under_way;
    int i;
    for (i = 0; i < n; i++) {
        memcpy(mpc->sent + i * NU, sent_command(mpc, i + 1, acting), NU * sizeof(real));
    }
}

/* Let the observer compare a state with the one that was expected: that predicted for t_k from the last period's
 * `ahead`, with rotor speeds `before` there and the command in force. */
static void compare_with_expected(quadsim_mpc *mpc, const real *state, const real *before, const real *in_force)
{
    const quadsim_robust *r = mpc->controller->robust;
    real expected[12];
    memcpy(expected, mpc->ahead, sizeof(expected));
    predict_vehicle(mpc, r->rest_of_period, r->decay_before, r->answer_before, before, in_force, expected);
    if (is_finite(expected, 12)) {
        observe_state(mpc, state, expected);
    }
}

/* Predict through the commands under way, a period each, to the instant from which this period's command acts: the
 * rotors' speeds, and, where it is known, the state `ahead`. */
static void pass_commands_under_way(quadsim_mpc *mpc, int is_known, const real *acting, real ahead[12])
{
    const quadsim_robust *r = mpc->controller->robust;
    int i;
    memcpy(ahead, mpc->ahead, sizeof(mpc->ahead));
    memcpy(mpc->rotors_ahead, mpc->rotors, sizeof(mpc->rotors_ahead));
    for (i = 1; i <= r->under_way; i++) {
        const real *next = sent_command(mpc, i, acting);
        if (is_known) {
            predict_vehicle(mpc, r->period, r->decay_period, r->answer_period, mpc->rotors_ahead, next, ahead);
        }
        follow_command(mpc->rotors_ahead, next, r->left_after_period);
    }
}

/* Let the rotors follow their commands up to the instant from which this period's acts.  From a state (12,), NULL where
 * none is usable, predict the one there, `ahead`, and let the observer compare it with the one expected; returns
 * whether there is one. */
static int predict_ahead(quadsim_mpc *mpc, const real *state, int learns, real ahead[12])
{
    const quadsim_robust *r = mpc->controller->robust;
    const real *acting = mpc->acting, *in_force = sent_command(mpc, 0, acting);
    real before[NU];
    memcpy(before, mpc->rotors, sizeof(before));
    follow_command(mpc->rotors, in_force, r->left_after_rest);
    if (state != NULL && r->observes && mpc->ahead_known && learns) {
        compare_with_expected(mpc, state, before, in_force);
    }
    if (state != NULL) {
        memcpy(mpc->ahead, state, sizeof(mpc->ahead));
        predict_vehicle(mpc, r->delay, r->decay_delay, r->answer_delay, mpc->rotors, in_force, mpc->ahead);
    }
    follow_command(mpc->rotors, in_force, r->left_after_delay);
    pass_commands_under_way(mpc, state != NULL, acting, ahead);
    note_sent(mpc, acting);
    mpc->ahead_known = state != NULL && is_finite(ahead, 12);
    update_rest_command(mpc, mpc->ahead_known ? ahead : NULL);
    return mpc->ahead_known;
}

/* The query of the robust controller; returns whether there is one. */
static int prepare_robust(quadsim_mpc *mpc, int flying, int learns, const real *state, const real *reference)
{
    real ahead[12];
    const int is_known = predict_ahead(mpc, state, learns, ahead);
    mpc->ahead_known = is_known && flying;
    if (is_known && state != NULL) {
        const real turns = first_turns(&mpc->headed, &mpc->heading, reference, state[YAW]);
        put_query(mpc, ahead, reference, turns);
    }
    return is_known;
}

/* ---- the controllers --------------------------------------------------------------------------------------------- */

/* Whether the magnitudes of numbers are at most those of plausible measurements; not where one is not finite. */
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

/* Whether a period's inputs are such that there is a query: finite, and for the robust controller plausible. */
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
    memcpy(mpc->rest_command, c->hover, sizeof(mpc->rest_command));
    rest_at(state, mpc->rest); /* hover is an equilibrium anywhere and at any yaw: here there is least to round */
    for (i = 0; i < c->problem->horizon; i++) {
        real *desired = mpc->desired + i * c->problem->regulated;
        turns = next_turns(reference, i, turns);
        memcpy(row, reference + i * 4, sizeof(row));
        row[3] -= TURN * turns;
        put_desired_pose(c->problem, row, desired);
        if (c->follows_rates) {
            reference_rates(c, reference, i, rates);
            add_desired_rates(c->problem, rates, desired);
        }
    }
}

/* How many numbers the commands under way are. */
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
    mpc->guard_plan = memory + p->horizon * p->regulated;
    mpc->sent = mpc->guard_plan + p->horizon * NU;
    quadsim_work_start(&mpc->work, p, mpc->sent + sent_reals(controller));
    quadsim_guard_start(&mpc->guard, controller->fallback, p->horizon, mpc->guard_plan);
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
    memcpy(mpc->rotors_ahead, usable, sizeof(mpc->rotors_ahead));
    for (i = 0; i < sent_reals(mpc->controller); i++) {
        mpc->sent[i] = usable[i % NU];
    }
    memset(mpc->estimate, 0, sizeof(mpc->estimate));
    quadsim_work_reset(&mpc->work);
    mpc->ahead_known = 0;
    mpc->headed = 0;
    memcpy(mpc->rest_command, mpc->controller->hover, sizeof(mpc->rest_command));
    memcpy(mpc->trim.commands, mpc->controller->hover, sizeof(mpc->trim.commands));
    mpc->trim.lift[2] = R(1.0);
    if (mpc->controller->robust != NULL) {
        update_trim(mpc);
        update_rest_command(mpc, NULL);
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
        update_rest_command(mpc, NULL);
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
    update_rest_command(mpc, NULL);
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
    return (enum quadsim_status)quadsim_optimise(&mpc->work, mpc->state, mpc->desired, mpc->rest, mpc->rest_command,
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
        quadsim_guard_foresee(guard, c->robust != NULL, &mpc->trim, mpc->rest_command);
    }
    status = quadsim_guard_end(guard, phase, &mpc->trim, status, plan, command);
    memcpy(mpc->before, command, sizeof(mpc->before));
    return status;
}
