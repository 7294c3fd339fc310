"""A quadratic program and its solution as values, and the KKT residuals that relate them.

    min 1/2 x' P x + c' x    subject to    A x = b,  h_l <= G x <= h_u,  x_l <= x <= x_u    Eq. (27)

`quadsim.mpc.forms` makes a QP of a problem and a query; a `Backend` of `quadsim.mpc.solvers` solves it; the residuals
of its solution (stationarity, complementarity, signs, feasibility) are logged in flight.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, NamedTuple, Protocol, TypeAlias

import numpy as np
from scipy.sparse import csc_matrix

from quadsim.controller import NO_STATISTICS, SOLVED, Statistics
from quadsim.mpc.problem.ocp import Problem
from quadsim.state import Array

Matrix: TypeAlias = Array | csc_matrix

KKT_EVERY: Final = 20
"""Default interval, in periods, at which KKT residuals are computed in flight."""


@dataclass(frozen=True, kw_only=True)
class QP:
    """min 1/2 x' P x + c' x  subject to  A x = b,  h_l <= G x <= h_u,  x_l <= x <= x_u.

    Matrices are dense or sparse (csc); bounds may be infinite.  Eq. (27), with rows bounded from both sides.
    """

    P: Matrix
    c: Array
    A: Matrix
    b: Array
    G: Matrix
    h_l: Array
    h_u: Array
    x_l: Array
    x_u: Array


class QPRows:
    """A problem's rows in a QP: bounds on single inputs go to the box; a soft row becomes one or two rows with a slack.

    Attributes:
        C, D, E: (K, n), or (N, K, n) if rows differ from step to step, (K, nu), (K, nu).
        origin: (K,) index of each row among the problem's.
        slack: (K, m_s) slack coefficients.
        lower, upper: (N, K).
        of_states: (K,) see `quadsim.mpc.problem.constraints.Rows`.
        u_min, u_max: (N, nu) the box.
    """

    def __init__(self, problem: Problem) -> None:
        self._whole = rows = problem.rows
        self._boxed = np.flatnonzero(rows.input >= 0)
        hard = np.flatnonzero((rows.input < 0) & np.isinf(rows.l1))
        above = rows.soft[np.isfinite(rows.upper[:, rows.soft]).any(axis=0)]
        below = rows.soft[np.isfinite(rows.lower[:, rows.soft]).any(axis=0)]
        self.origin = origin = np.concatenate([hard, above, below])
        of_rows = (rows.slack[:, None] == np.arange(rows.slacks.size)).astype(float)
        self.slack = np.concatenate([np.zeros((hard.size, rows.slacks.size)), 0.0 - of_rows[above], of_rows[below]])
        self.C = rows.C[..., origin, :]
        self.D = rows.D[origin]
        self.E = rows.E[origin]
        self.of_states = rows.of_states[origin]
        self.lower = rows.lower[:, origin].copy()
        self.upper = rows.upper[:, origin].copy()
        self.lower[:, hard.size : hard.size + above.size] = -np.inf
        self.upper[:, hard.size + above.size :] = np.inf
        self.u_min = np.full((problem.horizon, problem.model.nu), -np.inf)
        self.u_max = np.full((problem.horizon, problem.model.nu), np.inf)
        for row, j in zip(self._boxed, rows.input[self._boxed], strict=True):
            self.u_min[:, j] = np.maximum(self.u_min[:, j], rows.lower[:, row])
            self.u_max[:, j] = np.minimum(self.u_max[:, j], rows.upper[:, row])
        # (N, K) limits of multipliers, for one-sided rows, and (m, nu) which input a row bounds
        self._least = np.where(np.isneginf(self.lower), 0.0, -np.inf)
        self._most = np.where(np.isposinf(self.upper), 0.0, np.inf)
        self._of_box = np.zeros((len(rows.D), problem.model.nu))
        self._of_box[self._boxed, rows.input[self._boxed]] = 1.0

    def multipliers(self, z: Array, z_inputs: Array) -> Array:
        """(N, m) multipliers of the constraints' rows, from those of the QP's rows (N K,) and inputs (N nu,)."""
        N = len(self.lower)
        multipliers = np.zeros((N, len(self._whole.D)))
        for column, row in zip(z.reshape(N, -1).T, self.origin, strict=True):
            multipliers[:, row] += column
        left = z_inputs.reshape(N, -1).copy()
        for row in self._boxed:  # the first of several rows at the same bound takes the whole multiplier
            j = self._whole.input[row]
            upper = self._whole.upper[:, row] == self.u_max[:, j]
            lower = self._whole.lower[:, row] == self.u_min[:, j]
            active_side = np.where(left[:, j] > 0.0, upper, lower)
            multipliers[active_side, row] = left[active_side, j]
            left[active_side, j] = 0.0
        return multipliers * self._whole.scale

    def split(self, multipliers: Array) -> tuple[Array, Array]:
        """The inverse: multipliers of the QP's rows (N K,) and of inputs (N nu,)."""
        multipliers = multipliers / self._whole.scale
        z = np.minimum(np.maximum(multipliers[:, self.origin], self._least), self._most)
        return z.ravel(), np.dot(multipliers, self._of_box).ravel()


class Solution(NamedTuple):
    """A primal point of a QP with its multipliers and statistics; the arrays are copies."""

    x: Array
    y: Array  # multipliers of A x = b
    z: Array  # multipliers of h_l <= G x <= h_u, positive at the upper side, negative at the lower
    z_box: Array  # multipliers of x_l <= x <= x_u, with the same signs
    status: str = SOLVED  # `solved`, or the solver's name for the failure
    stats: Statistics = NO_STATISTICS
    """Of the solver; `active` counts inequality rows and box entries, `solve_s` includes updates."""


class Backend(Protocol):
    """A QP solver."""

    def setup(self, qp: QP) -> None:
        """Prepare for QPs with these matrices, or at least with their pattern."""

    def solve(self, qp: QP) -> Solution:
        """Solve this QP, whatever differs from the one before; failures are reported in the solution's status.

        A matrix or vector that has changed is another object: what is changed in place may not be seen.
        """


@dataclass(frozen=True, kw_only=True)
class KKTResiduals:
    """Distance of a point from optimality, each as the largest absolute entry; all zero at the optimum."""

    stationarity: float  # P x + c + A' y + G' z + z_box
    primal: float  # violation of A x = b, h_l <= G x <= h_u, x_l <= x <= x_u
    complementarity: float  # multiplier times distance to its bound
    dual: float  # multipliers at infinite bounds

    @property
    def worst(self) -> float:
        """The largest of the four."""
        return float(np.max([self.stationarity, self.primal, self.complementarity, self.dual]))


def kkt_residuals(qp: QP, solution: Solution) -> KKTResiduals:
    """Compute the KKT residuals of a solution from the QP alone, independent of the solver."""
    x, y, z, z_box = solution[:4]
    gradient = qp.P @ x + qp.c + qp.A.T @ y + qp.G.T @ z + z_box
    values = np.concatenate([qp.G @ x, x])
    multipliers = np.concatenate([z, z_box])
    lower = np.concatenate([qp.h_l, qp.x_l])
    upper = np.concatenate([qp.h_u, qp.x_u])
    bound = np.where(multipliers >= 0.0, upper, lower)
    bounded = np.isfinite(bound)
    distance = np.where(bounded, np.abs(np.where(bounded, bound, 0.0) - values), 0.0)
    violation = np.concatenate([lower - values, values - upper, np.abs(qp.A @ x - qp.b)])
    return KKTResiduals(
        stationarity=_largest_size(gradient),
        primal=float(np.max(violation, initial=0.0)),  # NaN stays NaN
        complementarity=_largest_size(multipliers * distance),
        dual=_largest_size(np.where(bounded, 0.0, multipliers)),
    )


def _largest_size(values: Array) -> float:
    return float(np.max(np.abs(values), initial=0.0))
