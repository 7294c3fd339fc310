"""Exact ways around the whole QP: an optimum of fewer constraints that satisfies all of them is the optimum."""

from __future__ import annotations

import time as clock
from collections.abc import Sequence
from dataclasses import replace
from typing import Final, NamedTuple

import numpy as np

from mpc.axes import Axis, axes
from mpc.condensed import condensed, require_bounds
from mpc.free import FreeOptimum
from mpc.polish import DensePolish, RowPolish
from mpc.problem import Problem
from mpc.qp import Solution
from mpc.solvers import Answer, QPSolver, Solver, Way
from quadsim.controller import SOLVED, UNCONSTRAINED
from quadsim.state import Array, Indices, read_only

LARGEST_MAP: Final = 2**20
"""Entries beyond which there is no shortcut: 8 MiB, as much as a core's caches hold.  50 steps of the paper's problem
have 16 k entries, 400 steps 970 k."""
NEAR: Final = 0.1
"""How far outside its bounds an input may be [rad/s] before its axis's answer is polished: by far more than answers are
off, since what is not worth polishing is left to the whole QP."""


class Shortcut:
    """Solves no more of the QP than it has to.

    The cost is strictly convex: the minimiser over fewer constraints, if it satisfies the others too, is the one and
    only solution of Eq. (27).  In turn,

    1. no constraint at all: Eq. (22), a product for each axis of `mpc.axes`; the status is then `unconstrained`;
    2. output bounds alone: a small QP for each axis whose outputs leave theirs, its answer polished, so that it is
       exact whatever the solver's tolerances; where there is one axis only, the whole, this is left out;
    3. the whole QP, its answer polished as well where the matrices for that are no larger than `LARGEST_MAP`.

    Args:
        problem: with bounds.
        whole: solves the whole QP; those of the axes are solved by a solver of the same name.

    Raises:
        numpy.linalg.LinAlgError: the Hessian is so ill-conditioned that the gains of Eq. (22) are not exact.

    Attributes:
        formulation: the condensed QP.
    """

    def __init__(self, problem: Problem, whole: Solver) -> None:
        bounds, N, nu = require_bounds(problem), problem.horizon, problem.model.nu
        parts = axes(problem)
        self._free = FreeOptimum(problem, parts)
        places = zip(parts, self._free.inputs, self._free.outputs, strict=True)
        self._axes = [
            _BoundedAxis(axis, whole.name, inputs=inputs, outputs=outputs)
            for axis, inputs, outputs in places
            if len(parts) > 1 and axis.outputs.size
        ]
        self._whole, self.formulation = whole, condensed(problem)
        qp = self.formulation.qp
        self._polish = DensePolish(qp) if (qp.c.size + qp.h_l.size) ** 2 <= LARGEST_MAP else None
        lower = np.stack([bounds.u_min, bounds.delta_min])[:, None]
        upper = np.stack([bounds.u_max, bounds.delta_max])[:, None]
        self._bounds, self._nearly = (lower, upper), (lower - NEAR, upper + NEAR)
        self._inputs = np.empty((2, N, nu))
        self._outputs = bounds.y_min.size
        self._T, self._u_bar = np.ascontiguousarray(np.hstack([axis.T for axis in parts]).T), problem.model.u_bar
        rows = np.concatenate([axis.outputs for axis in parts])
        self._y_min, self._y_max = bounds.y_min[rows, None], bounds.y_max[rows, None]
        self._y, self._z_box = read_only(np.zeros(0)), read_only(np.zeros(N * nu))
        self._z = read_only(np.zeros(N * (bounds.y_min.size + bounds.slewing.size)))

    @property
    def name(self) -> str:
        """Name of the QP solver."""
        return self._whole.name

    def solve(self, state: Array, desired: Array, u_before: Array) -> Answer:
        """See `mpc.solvers.Solver.solve`."""
        started = clock.perf_counter()
        w, y = self._free.at(state, desired)
        within = (self._y_min <= y) & (y <= self._y_max)
        parts: list[Answer] = []
        if within.all():
            plan = self._plan(w)
            if self._inputs_within(self._bounds, plan, u_before):
                return Answer(plan=plan, solution=self._joined(plan, [], parts, started), way=Way.FREE)
        else:
            leaving = [axis for axis in self._axes if not within[axis.outputs].all()]
            parts = [axis.solve(state, desired) for axis in leaving]
            if self._near(w, leaving, parts, u_before):
                held = [axis.polished(part, w, y) for axis, part in zip(leaving, parts, strict=True)]
                plan = self._plan(w, held)
                if self._inputs_within(self._bounds, plan, u_before):
                    return Answer(plan=plan, solution=self._joined(plan, held, parts, started), way=Way.AXES)
        tried_s, tried = clock.perf_counter() - started, sum(part.solution.iterations for part in parts)
        answer = self._whole.solve(state, desired, u_before)
        started = clock.perf_counter()
        solution = self._whole.formulation.condensed(answer.solution)
        if self._polish is not None and solution.status == SOLVED:
            vectors = self.formulation.vectors(state, desired, u_before)
            solution = self._polish.optimum(self.formulation.qp.with_vectors(vectors), solution)
        solve_s = solution.solve_s + tried_s + clock.perf_counter() - started
        solution = replace(solution, iterations=solution.iterations + tried, solve_s=solve_s)
        return Answer(plan=self.formulation.inputs(solution.x), solution=solution)

    def _near(self, w: Array, leaving: list[_BoundedAxis], parts: list[Answer], u_before: Array) -> bool:
        """Whether the axes that leave their bounds have an answer, and together one that the inputs may well allow."""
        if not parts or any(part.solution.status != SOLVED for part in parts):
            return False
        held = [axis.held(part) for axis, part in zip(leaving, parts, strict=True)]
        return self._inputs_within(self._nearly, self._plan(w, held), u_before)

    def _plan(self, w: Array, held: Sequence[_Held] = ()) -> Array:
        """(N, nu) of the inputs of all axes (m, N), of some as their outputs' bounds would have it."""
        if held:
            w = w.copy()
            for axis in held:
                w[axis.inputs] = axis.w
        return np.asarray(w.T @ self._T + self._u_bar)

    def _inputs_within(self, bounds: tuple[Array, Array], plan: Array, u_before: Array) -> bool:
        """Whether all inputs and their steps are within bounds; NaN is not."""
        lower, upper = bounds
        inputs, steps = self._inputs
        inputs[:] = plan
        np.subtract(plan[0], u_before, out=steps[0])
        np.subtract(plan[1:], plan[:-1], out=steps[1:])
        return bool(((lower <= self._inputs) & (self._inputs <= upper)).all())

    def _joined(self, plan: Array, held: list[_Held], parts: list[Answer], started: float) -> Solution:
        """The solution of the condensed QP whose axes' are these parts."""
        z, iterations, active, primal, dual = self._z, 0, 0, 0.0, 0.0
        if held:
            z = np.zeros_like(z)
            rows = z[: len(plan) * self._outputs].reshape(len(plan), -1)
            for axis in held:
                rows[:, axis.rows] = axis.z
                active += axis.active
            for part in parts:
                iterations += part.solution.iterations
                primal, dual = max(primal, part.solution.primal_residual), max(dual, part.solution.dual_residual)
        return Solution(
            x=plan.ravel(),
            y=self._y,
            z=z,
            z_box=self._z_box,
            status=SOLVED if held else UNCONSTRAINED,
            iterations=iterations,
            active=active,
            primal_residual=primal,
            dual_residual=dual,
            solve_s=clock.perf_counter() - started,
        )


class _Held(NamedTuple):
    """An axis held within its output bounds.

    Attributes:
        inputs: its rows of w.
        w: (m, N) its inputs.
        rows: of C_c.
        z: (N, n_c) their multipliers.
        active: bounds active.
    """

    inputs: slice
    w: Array
    rows: Indices
    z: Array
    active: int


class _BoundedAxis:
    """The QP of one axis, set up once.

    Attributes:
        rows: of C_c.
        inputs, outputs: its places among those of all axes.
    """

    def __init__(self, axis: Axis, solver: str, *, inputs: slice, outputs: slice) -> None:
        self._axis, self._solver = axis, QPSolver(solver, axis.problem)
        self._before = axis.problem.model.u_bar
        self.rows, self.inputs, self.outputs = axis.outputs, inputs, outputs
        qp = condensed(axis.problem).qp
        self._polish, self._bounds = RowPolish(np.asarray(qp.P), np.asarray(qp.G)), (qp.h_l, qp.h_u)

    def solve(self, state: Array, desired: Array) -> Answer:
        """The optimal w (N, m) for the whole's xi(k) (n,) and y_d (N, n_r), as good as the solver's tolerances."""
        axis = self._axis
        return self._solver.solve(state[axis.states], desired[:, axis.regulated], self._before)

    def held(self, answer: Answer) -> _Held:
        """What its solver answered."""
        solution = answer.solution
        z = solution.z[: len(answer.plan) * self.rows.size].reshape(len(answer.plan), -1)
        return _Held(inputs=self.inputs, w=answer.plan.T, rows=self.rows, z=z, active=solution.active)

    def polished(self, answer: Answer, w: Array, y: Array) -> _Held:
        """The exact optimum, from an answer near it and the free optimum of all axes; where that fails, the answer."""
        near = self.held(answer)
        z = self._polish.multipliers(y[self.outputs].T.ravel(), near.z.ravel(), *self._bounds)
        if z is None:
            return near
        plan = w[self.inputs].T - (self._polish.R @ z).reshape(answer.plan.shape)
        active = int(np.count_nonzero(z))
        return _Held(inputs=self.inputs, w=plan.T, rows=self.rows, z=z.reshape(near.z.shape), active=active)


def with_shortcut(problem: Problem, whole: Solver) -> Solver:
    """A solver that tries less than the whole QP first; the solver itself where that is no good.

    The map to the free optimum grows with the square of the horizon, the QP in proportion to it: beyond `LARGEST_MAP`
    entries nothing is tried.  Nor is it where the Hessian is so ill-conditioned, by a long horizon or weights far
    apart, that the gains are not exact.
    """
    N = problem.horizon
    entries = sum(
        N * (axis.T.shape[1] + axis.outputs.size) * (axis.states.size + N * axis.regulated.size)
        for axis in axes(problem)
    )
    if entries > LARGEST_MAP:
        return whole
    try:
        return Shortcut(problem, whole)
    except np.linalg.LinAlgError:
        return whole
