
/* ---- what is answered ------------------------------------------------------------------------------------------------ */

/* Speeds within what the bounds on them and on their steps leave after acting [rad/s]; where these leave nothing, within
 * those on the speeds. */
static void put_command(quadsim_mpc *mpc, const real *speeds, const real *acting, real *command)
{
    int j;
    for (j = 0; j < NU; j++) {
        const real lower = clipped(acting[j] + STEP_MIN[j], SPEED_MIN[j], SPEED_MAX[j]);
        const real upper = clipped(acting[j] + STEP_MAX[j], SPEED_MIN[j], SPEED_MAX[j]);
        command[j] = mpc->before[j] = clipped(speeds[j], lower, upper);
    }
}

/* The command of an optimum, or the fallback without one. */
static enum quadsim_status answer(quadsim_mpc *mpc, enum quadsim_status found, const real *axes, const real *acting,
                                  real *command)
{
    enum quadsim_status status = found;
    if (status <= QUADSIM_WHOLE && is_finite(mpc->plan, N * NU)) {
        mpc->age = 0;
        put_command(mpc, mpc->plan, acting, command);
        return status;
    }
    if (mpc->age >= 0 && mpc->age < N) {
        mpc->age++;
    }
    if (status == QUADSIM_CLIPPED && is_finite(axes, NU)) {
        put_command(mpc, axes, acting, command);
        return status;
    }
    if (status <= QUADSIM_SHIFTED && mpc->age >= 0 && mpc->age < N && is_finite(mpc->plan, N * NU)) {
        put_command(mpc, mpc->plan + mpc->age * NU, acting, command);
        return QUADSIM_SHIFTED;
    }
    put_command(mpc, acting, acting, command);
    return QUADSIM_BEFORE;
}
