"""The condensed constraints.  Eqs. (12)-(20)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mpc.constraints import Bounds
from mpc.paper.prediction import Prediction
from quadsim.state import Array


@dataclass(frozen=True, kw_only=True)
class Inequalities:
    """A_ineq u <= G1 xi(k) + G2 u(k-1) + G3 + G4 u_bar, and u_min <= u <= u_max.

    Rows in the paper's order: output upper, output lower (N n_c each), slew upper, slew lower (N nu each).
    """

    A_ineq: Array  # (2 N n_c + 2 N nu, N nu). Eqs. (14), (16), (18)
    G1: Array  # (rows, n). Eqs. (14), (18)
    G2: Array  # (rows, nu). Eqs. (16), (19)
    G3: Array  # (rows,). Eqs. (14), (16), (19)
    G4: Array  # (rows, nu), absent from the paper: +-C_c Psi_i applied to u = u_bar, the offset of the linearisation
    u_min: Array  # (N nu,) input bounds [rad/s]. Eq. (20)
    u_max: Array  # likewise
    n_outputs: int  # N n_c, the length of the first two groups of rows

    def right_side(self, state: Array, u_before: Array, u_bar: Array) -> Array:
        """B_ineq(k) (rows,) of Eq. (29)."""
        return self.G1 @ state + self.G2 @ u_before + self.G3 + self.G4 @ u_bar


def slew_matrix(horizon: int, nu: int) -> Array:
    """(N nu, N nu) matrix taking inputs to their steps u(k+i) - u(k+i-1), the upper half of Eq. (16)."""
    return np.kron(np.eye(horizon) - np.eye(horizon, k=-1), np.eye(nu)).astype(np.float64)


def inequalities(maps: Prediction, bounds: Bounds) -> Inequalities:
    """Build A_ineq and G1 to G4 from the prediction map and the bounds."""
    n_c, n = bounds.C_c.shape
    nu = bounds.u_min.size
    horizon = maps.Phi.shape[0] // n
    outputs_of_inputs = (bounds.C_c @ maps.Psi.reshape(horizon, n, -1)).reshape(horizon * n_c, horizon * nu)
    outputs_of_state = (bounds.C_c @ maps.Phi.reshape(horizon, n, -1)).reshape(horizon * n_c, n)
    offset = outputs_of_inputs @ np.tile(np.eye(nu), (horizon, 1))
    slew = slew_matrix(horizon, nu)
    first = np.zeros((horizon * nu, nu))
    first[:nu] = np.eye(nu)
    n_outputs, n_slews = horizon * n_c, horizon * nu
    return Inequalities(
        A_ineq=np.vstack([outputs_of_inputs, -outputs_of_inputs, slew, -slew]),
        G1=np.vstack([-outputs_of_state, outputs_of_state, np.zeros((2 * n_slews, n))]),
        G2=np.vstack([np.zeros((2 * n_outputs, nu)), first, -first]),
        G3=np.concatenate(
            [
                np.tile(bounds.y_max, horizon),
                np.tile(-bounds.y_min, horizon),
                np.tile(bounds.delta_max, horizon),
                np.tile(-bounds.delta_min, horizon),
            ]
        ),
        G4=np.vstack([offset, -offset, np.zeros((2 * n_slews, nu))]),
        u_min=np.tile(bounds.u_min, horizon),
        u_max=np.tile(bounds.u_max, horizon),
        n_outputs=n_outputs,
    )
