"""The unconstrained optimum where it is the constrained one: an exact way around the QP."""

from __future__ import annotations

from typing import Final

import numpy as np

from mpc.condensed import require_bounds
from mpc.prediction import prediction
from mpc.problem import Problem
from mpc.unconstrained import sequence_gains
from quadsim.state import Array

LARGEST_MAP: Final = 2**20
"""Entries beyond which there is no shortcut: 8 MiB, as much as a core's caches hold.  50 steps of the paper's problem
have 64 k entries, 200 steps 970 k."""
ROUNDING: Final = 1e-2
"""Error of L_N u_bar [rad/s], whose value is known, beyond which rounding is taken to have spoilt the gains.  That of
K_N xi(k), on deviations and not on the whole speed, is a hundredth of it."""


class Shortcut:
    """Evaluates Eq. (22), the optimal sequence without constraints, and keeps it when it satisfies all of them.

    The cost is strictly convex, so its minimiser, if feasible, is the one and only solution of Eq. (27).  Sequence
    and predicted outputs are affine in xi(k) and y_d,

        [u_opt; y_c] = W [xi(k); y_d] + [u_bar; 0],

    so that matrix-vector products and a few comparisons decide.  All that is computed is written into buffers.
    """

    def __init__(self, problem: Problem) -> None:
        bounds, model, N = require_bounds(problem), problem.model, problem.horizon
        gains, maps = sequence_gains(problem), prediction(model, N)
        K, G, hover = gains.K, gains.G, np.tile(model.u_bar, N)
        if not np.abs(gains.L @ model.u_bar - hover).max() < ROUNDING:
            raise np.linalg.LinAlgError("the Hessian is too ill-conditioned")

        def outputs(states: Array) -> Array:
            """C_c applied to every predicted state in the columns of (N n, m)."""
            return (bounds.C_c @ states.reshape(N, model.n, -1)).reshape(N * bounds.y_min.size, states.shape[1])

        self._inputs = _Affine(np.hstack([K, G]), hover, np.tile(bounds.u_min, N), np.tile(bounds.u_max, N))
        self._outputs = _Affine(
            np.hstack([outputs(maps.Phi + maps.Psi @ K), outputs(maps.Psi @ G)]),
            np.zeros(N * bounds.y_min.size),
            np.tile(bounds.y_min, N),
            np.tile(bounds.y_max, N),
        )
        self._bounds = bounds
        self._query = np.empty(K.shape[1] + G.shape[1])
        self._slews = np.empty((N, model.nu))

    def plan(self, state: Array, desired: Array, u_before: Array) -> Array | None:
        """The optimal inputs (N, nu) [rad/s] where no constraint stands in their way, else None.

        Args:
            state: xi(k) (n,).
            desired: y_d (N, n_r).
            u_before: u(k-1) (nu,).
        """
        self._query[: state.size] = state
        self._query[state.size :] = desired.ravel()
        if self._outputs.within_bounds(self._query) is None:  # first, as they bar the way most often
            return None
        sequence = self._inputs.within_bounds(self._query)
        if sequence is None:
            return None
        plan = sequence.reshape(self._slews.shape)
        np.subtract(plan[0], u_before, out=self._slews[0])
        np.subtract(plan[1:], plan[:-1], out=self._slews[1:])
        if not _within(self._bounds.delta_min, self._slews, self._bounds.delta_max):
            return None
        return plan.copy()


class _Affine:
    """Values M q + m of a query q, between bounds."""

    def __init__(self, matrix: Array, offset: Array, lower: Array, upper: Array) -> None:
        self._matrix, self._offset, self._lower, self._upper = matrix, offset, lower, upper
        self._values = np.empty(offset.size)

    def within_bounds(self, query: Array) -> Array | None:
        """The values, in a buffer that the next call overwrites, or None where one is out of its bounds."""
        np.dot(self._matrix, query, out=self._values)
        self._values += self._offset
        return self._values if _within(self._lower, self._values, self._upper) else None


def make_shortcut(problem: Problem) -> Shortcut | None:
    """The problem's shortcut, or None where there is no good one.

    The map grows with the square of the horizon, the QP in proportion to it: beyond `LARGEST_MAP` entries there is
    none.  Nor is there where the Hessian is so ill-conditioned, by a long horizon or weights far apart, that the gains
    are not exact.
    """
    bounds, nu = require_bounds(problem), problem.model.nu
    rows = problem.horizon * (nu + bounds.y_min.size)
    columns = problem.model.n + problem.horizon * problem.objective.Q_y.shape[0]
    if rows * columns > LARGEST_MAP:
        return None
    try:
        return Shortcut(problem)
    except np.linalg.LinAlgError:
        return None


def _within(lower: Array, values: Array, upper: Array) -> bool:
    """Whether all values are within their bounds; NaN is not."""
    return bool(((lower <= values) & (values <= upper)).all())
