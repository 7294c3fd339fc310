
/* ---- the vehicle's model --------------------------------------------------------------------------------------------- */

enum { X = 0, VX = 1, Y = 2, VY = 3, Z = 4, VZ = 5, ROLL = 6, PITCH = 8, YAW = 10 };

static void sines_of(const real *state, real sine[3], real cosine[3])
{
    sin_cos(state[ROLL], &sine[0], &cosine[0]);
    sin_cos(state[PITCH], &sine[1], &cosine[1]);
    sin_cos(state[YAW], &sine[2], &cosine[2]);
}

/* The unit vector along which rotors push, world axes. */
static void thrust_axis(const real *state, real axis[3])
{
    real s[3], c[3];
    sines_of(state, s, c);
    axis[0] = c[2] * (c[0] * s[1]) + s[2] * s[0];
    axis[1] = s[2] * (c[0] * s[1]) - c[2] * s[0];
    axis[2] = c[0] * c[1];
}

/* Body rates (p, q, r) of Euler angles and their rates. */
static void body_rates(const real *state, real rates[3])
{
    const real a = state[ROLL + 1], b = state[PITCH + 1], c = state[YAW + 1];
    real s[3], k[3];
    sines_of(state, s, k);
    rates[0] = a - c * s[1];
    rates[1] = b * k[0] + c * k[1] * s[0];
    rates[2] = c * k[1] * k[0] - b * s[0];
}

/* Rates of change of a state, of U/m and I^-1 tau (4,) and a constant acceleration (3,).  Sec. 2.2. */
static void slopes(const real *state, const real *drive, const real *disturbance, real *rates)
{
    const real a = state[ROLL + 1], b = state[PITCH + 1], c = state[YAW + 1];
    real s[3], k[3], p, q, r, dp, dq, dr, yaw, turn, level, side;
    int i;
    sines_of(state, s, k);
    for (i = 0; i < 12; i += 2) {
        rates[i] = state[i + 1];
    }
    turn = c * k[1];
    p = a - c * s[1];
    q = b * k[0] + turn * s[0];
    r = turn * k[0] - b * s[0];
    dp = drive[1] + GYRATION[0] * q * r;
    dq = drive[2] + GYRATION[1] * r * p;
    dr = drive[3] + GYRATION[2] * p * q;
    yaw = (dq * s[0] + dr * k[0] + b * (a + c * s[1])) / k[1];
    level = drive[0] * s[1] * k[0];
    side = drive[0] * s[0];
    rates[VX] = k[2] * level + s[2] * side + disturbance[0];
    rates[VY] = s[2] * level - k[2] * side + disturbance[1];
    rates[VZ] = drive[0] * k[1] * k[0] + (disturbance[2] - GRAVITY);
    rates[ROLL + 1] = dp + b * turn + s[1] * yaw;
    rates[PITCH + 1] = dq * k[0] - dr * s[0] - a * turn;
    rates[YAW + 1] = yaw;
}

/* result = state + time rates */
static void moved(const real *state, real time, const real *rates, real *result)
{
    int i;
    for (i = 0; i < 12; i++) {
        result[i] = state[i] + time * rates[i];
    }
}

/* U/m and I^-1 tau of rotors whose speeds have gone from rotors to command but for a share that decays. */
static void find_drive(const quadsim_mpc *mpc, const real *rotors, const real *command, real decay, real *drive)
{
    int i, j;
    memset(drive, 0, NU * sizeof(real));
    for (j = 0; j < NU; j++) {
        const real speed = command[j] + decay * (rotors[j] - command[j]);
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

/* The state some time [s] later under a command, by Runge-Kutta's classical method; decay [SUBSTEPS][4] of the rotors'
 * speeds at its instants. */
static void advance(const quadsim_mpc *mpc, real time, const real *decay, const real *rotors, const real *command,
                    real *state)
{
    const real step = time / (real)QUADSIM_SUBSTEPS;
    real axis[3], disturbance[3], drive[NU], rates[4][12], at[12];
    int k, i;
    if (!(time > R(1e-9))) {
        return;
    }
    thrust_axis(state, axis);
    find_disturbance(mpc, axis, disturbance);
    for (k = 0; k < QUADSIM_SUBSTEPS; k++, decay += 4) {
        find_drive(mpc, rotors, command, decay[0], drive);
        slopes(state, drive, disturbance, rates[0]);
        find_drive(mpc, rotors, command, decay[1], drive);
        moved(state, R(0.5) * step, rates[0], at);
        slopes(at, drive, disturbance, rates[1]);
        moved(state, R(0.5) * step, rates[1], at);
        slopes(at, drive, disturbance, rates[2]);
        find_drive(mpc, rotors, command, decay[3], drive);
        moved(state, step, rates[2], at);
        slopes(at, drive, disturbance, rates[3]);
        for (i = 0; i < 12; i++) {
            state[i] += step / R(6.0) * (rates[0][i] + R(2.0) * (rates[1][i] + rates[2][i]) + rates[3][i]);
        }
    }
}

/* ---- what the model does not explain: steady-state Kalman filters of a force and a torque ------------------------------- */

/* Where the vehicle rests against the estimated disturbance: lift (3,), trim (4,), twist (3,) and effectiveness.
 * U / m R(eta) e_z = g e_z - a,    I^-1 tau = -alpha. */
static void believe(quadsim_mpc *mpc)
{
    const real x = mpc->estimate[0], y = mpc->estimate[1];
    const real length = square_root(x * x + y * y + GRAVITY * GRAVITY);
    real axis[3], acceleration[3], drive[NU], up, thrust;
    int i, j;
    axis[0] = -x / length;
    axis[1] = -y / length;
    axis[2] = GRAVITY / length;
    find_disturbance(mpc, axis, acceleration);
    up = GRAVITY - acceleration[2];
    if (up < LEAST_LIFT * GRAVITY) {
        up = LEAST_LIFT * GRAVITY;
    }
    thrust = square_root(acceleration[0] * acceleration[0] + acceleration[1] * acceleration[1] + up * up);
    mpc->lift[0] = -acceleration[0];
    mpc->lift[1] = -acceleration[1];
    mpc->lift[2] = up;
    memcpy(mpc->effectiveness, EFFECTIVENESS, sizeof(mpc->effectiveness));
    drive[0] = thrust;
    for (i = 0; i < 3; i++) {
        mpc->twist[i] = mpc->estimate[3 + i] / GRAVITY;
        drive[1 + i] = -thrust * mpc->twist[i];
        for (j = 0; j < NU; j++) {
            mpc->effectiveness[(1 + i) * NU + j] += mpc->twist[i] * EFFECTIVENESS[j];
        }
    }
    for (j = 0; j < NU; j++) {
        mpc->trim[j] = square_root(dot(ALLOCATION + j * NU, drive, NU));
    }
}

/* Take note of a measured state and of the one that was expected. */
static void observe(quadsim_mpc *mpc, const real *measured, const real *expected)
{
    real axis[3], rates[3], expected_rates[3], surprise[6], upright;
    int i;
    thrust_axis(measured, axis);
    body_rates(measured, rates);
    body_rates(expected, expected_rates);
    upright = axis[2] > UPRIGHT ? axis[2] : UPRIGHT;
    surprise[2] = (measured[VZ] - expected[VZ]) / upright;
    surprise[0] = (measured[VX] - expected[VX]) - surprise[2] * axis[0];
    surprise[1] = (measured[VY] - expected[VY]) - surprise[2] * axis[1];
    for (i = 0; i < 3; i++) {
        surprise[3 + i] = rates[i] - expected_rates[i];
    }
    for (i = 0; i < 6; i++) {
        mpc->estimate[i] = clipped(mpc->estimate[i] + GAIN[i] * surprise[i], -LARGEST[i], LARGEST[i]);
    }
    believe(mpc);
}

/* ---- the controller -------------------------------------------------------------------------------------------------- */

/* Rotor speeds after a time, of which the share that is still what it was is decay. */
static void spin(real *rotors, const real *command, real decay)
{
    int j;
    for (j = 0; j < NU; j++) {
        rotors[j] = command[j] + decay * (rotors[j] - command[j]);
    }
}

/* The reference's row at the instant that its prediction is for, the delay after it. */
static void later_row(const real *reference, int i, real row[4])
{
    const real *now = reference + i * 4, *next = i < N - 1 ? now + 4 : now;
    int j;
    for (j = 0; j < 4; j++) {
        row[j] = now[j] + DELAYED_SHARE * (next[j] - now[j]);
    }
}

/* The reference [N][4] as the prediction is given it: later by the delay, and where the model is turned by the heading,
 * yaw without jumps, seen from axes turned by it. */
static void see_reference(const real *reference, real yaw, real sine, real cosine, real *seen)
{
    real last = R(0.0), turned = yaw;
    int i;
    for (i = 0; i < N; i++) {
        real *row = seen + i * 4;
        later_row(reference, i, row);
        if (QUADSIM_HEADING) {
            const real x = row[0], y = row[1], step = i == 0 ? row[3] - yaw : row[3] - last;
            last = row[3];
            turned += clipped(step, -LARGEST_TURN, LARGEST_TURN);
            row[0] = cosine * x + sine * y;
            row[1] = cosine * y - sine * x;
            row[3] = turned - yaw;
        }
    }
}

/* The last states [NX], which stand for the rotors' speeds where these lag. */
static void put_modes(const real *speeds, real *state)
{
    int j;
    for (j = 0; j < NX - 12; j++) {
        state[12 + j] = dot(MODES + j * NU, speeds, NU);
    }
}

/* Where the model rests: x_s at the present place, u_s with what balances the torque that thrust twists now. */
static void find_rest(const quadsim_mpc *mpc, const real *state, real sine, real cosine, real *rest, real *speeds)
{
    const real forward = cosine * mpc->lift[0] + sine * mpc->lift[1], left = cosine * mpc->lift[1] - sine * mpc->lift[0];
    real excess_thrust = R(0.0);
    int j;
    memset(rest, 0, NX * sizeof(real));
    rest[X] = state[X];
    rest[Y] = state[Y];
    rest[Z] = state[Z];
    rest[YAW] = state[YAW];
    rest[ROLL] = -angle_of(left, square_root(forward * forward + mpc->lift[2] * mpc->lift[2]));
    rest[PITCH] = angle_of(forward, mpc->lift[2]);
    for (j = 0; j < NU; j++) {
        const real turning = mpc->rotors[j], resting = mpc->trim[j];
        excess_thrust += EFFECTIVENESS[j] * (turning * turning - resting * resting);
    }
    for (j = 0; j < NU; j++) {
        speeds[j] = mpc->trim[j] - excess_thrust * dot(SLOPE_INVERSE + j * NU + 1, mpc->twist, 3);
    }
    put_modes(speeds, rest);
}

/* The optimum from a state at the instant from which the command acts. */
static enum quadsim_status solve_ahead(quadsim_mpc *mpc, const real *ahead, const real *reference, const real *acting,
                                       real axes[NU])
{
    real state[NX], rest[NX], speeds[NU], sine = R(0.0), cosine = R(1.0);
    memcpy(state, ahead, 12 * sizeof(real));
    if (QUADSIM_HEADING) {
        sin_cos(ahead[YAW], &sine, &cosine);
        state[X] = cosine * ahead[X] + sine * ahead[Y];
        state[Y] = cosine * ahead[Y] - sine * ahead[X];
        state[VX] = cosine * ahead[VX] + sine * ahead[VY];
        state[VY] = cosine * ahead[VY] - sine * ahead[VX];
        state[YAW] = R(0.0);
    }
    put_modes(mpc->rotors, state);
    see_reference(reference, ahead[YAW], sine, cosine, mpc->reference);
    find_rest(mpc, state, sine, cosine, rest, speeds);
    return optimise(mpc, state, mpc->reference, rest, speeds, acting, axes);
}

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

/* The same of the reference. */
static int is_plausible_path(const real *reference)
{
    int i;
    for (i = 0; i < N; i++) {
        if (!is_plausible(reference + i * 4, PLAUSIBLE_REFERENCE, 4)) {
            return 0;
        }
    }
    return 1;
}

void quadsim_mpc_reset(quadsim_mpc *mpc, const quadsim_real speeds[4])
{
    const real *usable = is_finite(speeds, NU) ? speeds : HOVER;
    memset(mpc, 0, sizeof(*mpc));
    memcpy(mpc->before, usable, sizeof(mpc->before));
    memcpy(mpc->rotors, usable, sizeof(mpc->rotors));
    mpc->age = -1;
    believe(mpc);
}

enum quadsim_status quadsim_mpc_step(quadsim_mpc *mpc, const quadsim_real state[12], const quadsim_real *reference,
                                     const quadsim_real acting[4], quadsim_real command[4])
{
    real axes[NU], in_force[NU], before[NU], expected[12];
    enum quadsim_status found = QUADSIM_BEFORE;
    const int known = mpc->known;
    memcpy(in_force, is_finite(acting, NU) ? acting : mpc->before, sizeof(in_force));
    memcpy(before, mpc->rotors, sizeof(before));
    spin(mpc->rotors, in_force, SPUN_BEFORE);
    mpc->known = 0;
    if (is_plausible(state, PLAUSIBLE, 12) && is_plausible_path(reference) && is_finite(acting, NU)) {
        if (QUADSIM_OBSERVES && known) {
            memcpy(expected, mpc->ahead, sizeof(expected));
            advance(mpc, REST_OF_PERIOD, DECAY_BEFORE, before, in_force, expected);
            if (is_finite(expected, 12)) {
                observe(mpc, state, expected);
            }
        }
        memcpy(mpc->ahead, state, sizeof(mpc->ahead));
        advance(mpc, DELAY, DECAY_DELAY, mpc->rotors, in_force, mpc->ahead);
        spin(mpc->rotors, in_force, SPUN_DELAY);
        if (is_finite(mpc->ahead, 12)) {
            mpc->known = 1;
            found = solve_ahead(mpc, mpc->ahead, reference, in_force, axes);
        }
    } else {
        spin(mpc->rotors, in_force, SPUN_DELAY);
    }
    return answer(mpc, found, axes, in_force, command);
}
