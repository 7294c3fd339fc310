"""The condensed cost.  Eqs. (5)-(10)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mpc.ocp import Objective
from mpc.paper.prediction import Prediction
from quadsim.state import Array


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
    n = objective.C_r.shape[1]
    nu = objective.Q_u.shape[0]
    horizon = maps.Phi.shape[0] // n
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
    rows = stacked.reshape(blocks, matrix.shape[1], -1)
    return (matrix @ rows).reshape(blocks * matrix.shape[0], -1)
