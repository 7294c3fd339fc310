
/* ---- the controller -------------------------------------------------------------------------------------------------- */

void quadsim_mpc_reset(quadsim_mpc *mpc, const quadsim_real speeds[4])
{
    const real *usable = is_finite(speeds, NU) ? speeds : HOVER;
    memset(mpc, 0, sizeof(*mpc));
    memcpy(mpc->before, usable, sizeof(mpc->before));
    mpc->age = -1;
}

enum quadsim_status quadsim_mpc_step(quadsim_mpc *mpc, const quadsim_real state[12], const quadsim_real *reference,
                                     const quadsim_real acting[4], quadsim_real command[4])
{
    real rest[NX], axes[NU], in_force[NU];
    enum quadsim_status found = QUADSIM_BEFORE;
    memcpy(in_force, is_finite(acting, NU) ? acting : mpc->before, sizeof(in_force));
    if (is_finite(state, 12) && is_finite(reference, N * 4) && is_finite(acting, NU)) {
        /* Hover is an equilibrium anywhere and at any yaw: here there is least to round. */
        memset(rest, 0, sizeof(rest));
        rest[0] = state[0];
        rest[2] = state[2];
        rest[4] = state[4];
        rest[10] = state[10];
        found = optimise(mpc, state, reference, rest, HOVER, in_force, axes);
    }
    return answer(mpc, found, axes, in_force, command);
}
