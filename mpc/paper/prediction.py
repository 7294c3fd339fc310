"""The prediction map.  Eqs. (2)-(3)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mpc.model import LinearModel
from quadsim.state import Array


@dataclass(frozen=True, kw_only=True)
class Prediction:
    """Stacked future states [xi(k+1); ...; xi(k+N)] = Phi xi(k) + Psi (u - u_bar).

    The paper's Phi_i and Psi_i are the i-th block rows; its selections Pi_i are the block columns themselves.
    """

    Phi: Array  # (N n, n)
    Psi: Array  # (N n, N nu), block lower triangular


def prediction(model: LinearModel, horizon: int) -> Prediction:
    """Build Phi and Psi for a horizon of N steps, from A^i and A^i B."""
    n, nu = model.n, model.nu
    Phi = np.empty((horizon, n, n))
    responses = np.empty((horizon, n, nu))  # A^i B
    power = np.eye(n)
    for i in range(horizon):
        responses[i] = power @ model.B
        power = model.A @ power
        Phi[i] = power
    Psi = np.zeros((horizon, n, horizon, nu))
    for i in range(horizon):
        Psi[i, :, : i + 1] = responses[i::-1].transpose(1, 0, 2)
    return Prediction(Phi=Phi.reshape(horizon * n, n), Psi=Psi.reshape(horizon * n, horizon * nu))


def rollout(model: LinearModel, states: Array, plans: Array) -> Array:
    """States (K, N, n) xi(k+1) .. xi(k+N) from states (K, n) under plans (K, N, nu), by recursion."""
    predicted = np.empty((*plans.shape[:2], model.n))
    state = states
    for i in range(plans.shape[1]):
        state = state @ model.A.T + (plans[:, i] - model.u_bar) @ model.B.T
        predicted[:, i] = state
    return predicted


def condense_stages(start: Array, A: Array, B: Array, c: Array) -> Array:
    """(J, L + 1, n, m + 1) states of J stages of L steps, as functions of the variables, the inputs the last, and of 1.

    From the first of them (J, n, m + 1) by A (J, L, n, n), B (J, L, n, nu) and c (J, L, n).
    """
    (count, steps, n, nu), columns = B.shape, start.shape[2]
    states = np.empty((count, steps + 1, n, columns))
    states[:, 0] = start
    for t in range(steps):
        np.matmul(A[:, t], states[:, t], out=states[:, t + 1])
        at = columns - 1 - (steps - t) * nu
        states[:, t + 1, :, at : at + nu] = B[:, t]
        states[:, t + 1, :, -1] += c[:, t]
    return states
