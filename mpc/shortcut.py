"""Exact ways around the whole QP: an optimum of fewer constraints that satisfies all of them is the optimum."""

from __future__ import annotations

import time as clock
from dataclasses import replace
from typing import Any, Final

import numpy as np

from mpc.axes import Axis, bounded_axes
from mpc.condensed import require_bounds
from mpc.prediction import prediction
from mpc.problem import Problem
from mpc.qp import Solution
from mpc.solvers import Answer, QPSolver, Solver, Way
from mpc.unconstrained import sequence_gains
from quadsim.controller import SOLVED, UNCONSTRAINED
from quadsim.state import Array, read_only

LARGEST_MAP: Final = 2**20
"""Entries beyond which there is no shortcut: 8 MiB, as much as a core's caches hold.  50 steps of the paper's problem
have 64 k entries, 200 steps 970 k."""
ROUNDING: Final = 1e-2
"""Error of L_N u_bar [rad/s], whose value is known, beyond which rounding is taken to have spoilt the gains.  That of
K_N xi(k), on deviations and not on the whole speed, is a hundredth of it."""


class Shortcut:
    """Solves no more of the QP than it has to.

    The cost is strictly convex: the minimiser over fewer constraints, if it satisfies the others too, is the one and
    only solution of Eq. (27).  In turn,

    1. no constraint at all: Eq. (22), a product; the status is then `unconstrained`;
    2. output bounds alone: a small QP for each axis whose outputs leave theirs; see `mpc.axes`;
    3. the whole QP.

    Args:
        problem: with bounds.
        whole: solves the whole QP; those of the axes are solved by a solver of the same name.

    Raises:
        numpy.linalg.LinAlgError: the Hessian is so ill-conditioned that the gains of Eq. (22) are not exact.
    """

    def __init__(self, problem: Problem, whole: Solver) -> None:
        bounds, N, nu = require_bounds(problem), problem.horizon, problem.model.nu
        self._free = _FreeOptimum(problem)
        self._axes = [_AxisSolver(axis, whole.name) for axis in bounded_axes(problem)]
        self._whole = whole
        self._bounds, self._u_bar = bounds, problem.model.u_bar
        self._slews = np.empty((N, nu))
        self._y, self._z_box = read_only(np.zeros(0)), read_only(np.zeros(N * nu))
        self._z = read_only(np.zeros(N * (bounds.y_min.size + bounds.slewing.size)))

    @property
    def name(self) -> str:
        """Name of the QP solver."""
        return self._whole.name

    def solve(self, state: Array, desired: Array, u_before: Array) -> Answer:
        """See `mpc.solvers.Solver.solve`."""
        started = clock.perf_counter()
        plan, outputs = self._free.at(state, desired)
        staying = (self._bounds.y_min <= outputs) & (outputs <= self._bounds.y_max)
        way, found, z = Way.FREE, True, self._z
        parts: list[Solution] = []
        if not staying.all():
            way = Way.AXES
            plan, parts, z = self._by_axes(plan, np.all(staying, axis=0), state, desired)
            found = bool(parts) and all(part.status == SOLVED for part in parts)
        if found and self._inputs_within_bounds(plan, u_before):
            return Answer(plan=plan, solution=self._joined(plan, parts, z, started), way=way)
        tried_s, tried = clock.perf_counter() - started, sum(part.iterations for part in parts)
        answer = self._whole.solve(state, desired, u_before)
        iterations, solve_s = answer.solution.iterations + tried, answer.solution.solve_s + tried_s
        return replace(answer, solution=replace(answer.solution, iterations=iterations, solve_s=solve_s))

    def _by_axes(self, free: Array, staying: Any, state: Array, desired: Array) -> tuple[Array, list[Solution], Array]:
        """The free plan with the axes replaced whose outputs do not stay in bounds, their answers, the multipliers."""
        plan, parts, z = free, [], np.zeros_like(self._z)
        multipliers = z[: len(plan) * staying.size].reshape(-1, staying.size)
        for solver in self._axes:
            axis = solver.axis
            if not staying[axis.outputs].all():
                answer = solver.solve(state, desired)
                plan = plan + (answer.plan - (plan - self._u_bar) @ axis.S.T) @ axis.T.T
                multipliers[:, axis.outputs] = answer.solution.z[: len(plan) * axis.outputs.size].reshape(len(plan), -1)
                parts.append(answer.solution)
        return plan, parts, z

    def _joined(self, plan: Array, parts: list[Solution], z: Array, started: float) -> Solution:
        """The solution of the condensed QP whose axes' are these parts."""
        return Solution(
            x=plan.ravel(),
            y=self._y,
            z=z,
            z_box=self._z_box,
            status=SOLVED if parts else UNCONSTRAINED,
            iterations=sum(part.iterations for part in parts),
            active=sum(part.active for part in parts),
            primal_residual=max((part.primal_residual for part in parts), default=0.0),
            dual_residual=max((part.dual_residual for part in parts), default=0.0),
            solve_s=clock.perf_counter() - started,
        )

    def _inputs_within_bounds(self, plan: Array, u_before: Array) -> bool:
        bounds = self._bounds
        np.subtract(plan[0], u_before, out=self._slews[0])
        np.subtract(plan[1:], plan[:-1], out=self._slews[1:])
        return _within(bounds.u_min, plan, bounds.u_max) and _within(bounds.delta_min, self._slews, bounds.delta_max)


class _FreeOptimum:
    """Eq. (22), the optimal sequence without constraints, and the outputs that it leads to.

    Both are affine in xi(k) and y_d,

        [u_opt; y_c] = W [xi(k); y_d] + [u_bar; 0],

    so that one product gives them.
    """

    def __init__(self, problem: Problem) -> None:
        bounds, model, N = require_bounds(problem), problem.model, problem.horizon
        gains, maps = sequence_gains(problem), prediction(model, N)
        K, G, hover = gains.K, gains.G, np.tile(model.u_bar, N)
        if not np.abs(gains.L @ model.u_bar - hover).max() < ROUNDING:
            raise np.linalg.LinAlgError("the Hessian is too ill-conditioned")

        def outputs(states: Array) -> Array:
            return (bounds.C_c @ states.reshape(N, model.n, -1)).reshape(N * bounds.y_min.size, states.shape[1])

        self._map = np.block([[K, G], [outputs(maps.Phi + maps.Psi @ K), outputs(maps.Psi @ G)]])
        self._u_bar, self._shape = model.u_bar, (N, model.nu)
        self._query = np.empty(self._map.shape[1])

    def at(self, state: Array, desired: Array) -> tuple[Array, Array]:
        """Inputs (N, nu) [rad/s] and outputs (N, n_c) for xi(k) (n,) and y_d (N, n_r)."""
        self._query[: state.size] = state
        self._query[state.size :] = desired.ravel()
        values = self._map @ self._query
        N, nu = self._shape
        return values[: N * nu].reshape(N, nu) + self._u_bar, values[N * nu :].reshape(N, -1)


class _AxisSolver:
    """The QP of one axis, set up once."""

    def __init__(self, axis: Axis, solver: str) -> None:
        self.axis, self._solver = axis, QPSolver(solver, axis.problem)
        self._before = axis.problem.model.u_bar

    def solve(self, state: Array, desired: Array) -> Answer:
        """The optimal w (N, m) for the whole's xi(k) (n,) and y_d (N, n_r)."""
        axis = self.axis
        return self._solver.solve(state[axis.states], desired[:, axis.regulated], self._before)


def with_shortcut(problem: Problem, whole: Solver) -> Solver:
    """A solver that tries less than the whole QP first; the solver itself where that is no good.

    The map to the free optimum grows with the square of the horizon, the QP in proportion to it: beyond `LARGEST_MAP`
    entries nothing is tried.  Nor is it where the Hessian is so ill-conditioned, by a long horizon or weights far
    apart, that the gains are not exact.
    """
    bounds, nu = require_bounds(problem), problem.model.nu
    rows = problem.horizon * (nu + bounds.y_min.size)
    columns = problem.model.n + problem.horizon * problem.objective.Q_y.shape[0]
    if rows * columns > LARGEST_MAP:
        return whole
    try:
        return Shortcut(problem, whole)
    except np.linalg.LinAlgError:
        return whole


def _within(lower: Array, values: Array, upper: Array) -> bool:
    """Whether all values are within their bounds; NaN is not."""
    return bool(((lower <= values) & (values <= upper)).all())
