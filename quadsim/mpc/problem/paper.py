"""The paper's prediction and cost, condensed to the inputs alone, as printed.  Eqs. (2)-(10).

    xi = Phi xi(k) + Psi (u - u_bar),    J(u) = 1/2 u' H u + F(k)' u

`quadsim.mpc.forms.condensing` extends them to any weights and constraints.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from quadsim.mpc.problem.model import LinearModel
from quadsim.mpc.problem.ocp import Objective
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
    n = model.n
    nu = model.nu
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


@dataclass(frozen=True, kw_only=True)
class Cost:
    """J(u) = 1/2 u' H u + [F1 xi(k) + F2 y_d + (F3 + F4) u_bar]' u + const, u = [u(k); ...; u(k+N-1)]."""

    H: Array  # (N nu, N nu) symmetric positive definite. Eq. (7)
    F1: Array  # (N nu, n). Eq. (8)
    F2: Array  # (N nu, N n_r), for the stacked desired outputs. Eq. (9)
    F3: Array  # (N nu, nu) = -2 sum Pi_i' Q_u. Eq. (10) prints it with a plus, which would regulate u to -u_bar
    # (N nu, nu), absent from the paper: the offset of the linearisation, -2 sum Psi_i' C_r' Q_y C_r Psi_i applied to u
    # = u_bar throughout. H [I; ...; I] = -(F3 + F4), so that at hover on the reference the optimum is u_bar
    F4: Array

    def gradient(self, state: Array, desired: Array, u_bar: Array) -> Array:
        """F(k) (N nu,) of Eq. (28), for xi(k) (n,), y_d (N, n_r) and u_bar (nu,)."""
        return self.F1 @ state + self.F2 @ desired.ravel() + (self.F3 + self.F4) @ u_bar


def cost(maps: Prediction, objective: Objective) -> Cost:
    """Build H and F1 to F4 from the prediction map and the weights."""
    nu = objective.Q_u.shape[0]
    horizon = maps.Psi.shape[1] // nu
    outputs_of_inputs = _apply_blockwise(objective.C_r, maps.Psi, horizon)  # C_r Psi_i, stacked
    outputs_of_state = _apply_blockwise(objective.C_r, maps.Phi, horizon)  # C_r Phi_i, stacked
    weighted = _apply_blockwise(objective.Q_y, outputs_of_inputs, horizon)
    tracking = 2.0 * outputs_of_inputs.T @ weighted
    every_step = np.tile(np.eye(nu), (horizon, 1))  # u_bar held over the horizon
    H = tracking + 2.0 * np.kron(np.eye(horizon), objective.Q_u)
    return Cost(
        H=0.5 * (H + H.T),
        F1=2.0 * weighted.T @ outputs_of_state,
        F2=-2.0 * weighted.T,
        F3=-2.0 * np.tile(objective.Q_u, (horizon, 1)),
        F4=-tracking @ every_step,
    )


def _apply_blockwise(matrix: Array, stacked: Array, blocks: int) -> Array:
    """diag(matrix, ..., matrix) @ stacked, without forming the block-diagonal."""
    rows = stacked.reshape(blocks, matrix.shape[1], stacked.shape[1])
    return (matrix @ rows).reshape(blocks * matrix.shape[0], stacked.shape[1])


def slew_matrix(horizon: int, nu: int) -> Array:
    """(N nu, N nu) matrix taking inputs to their steps u(k+i) - u(k+i-1), the upper half of Eq. (16)."""
    return np.kron(np.eye(horizon) - np.eye(horizon, k=-1), np.eye(nu)).astype(np.float64)
