"""Exact ways around the whole QP: an optimum of fewer constraints that satisfies all of them is the optimum."""

from __future__ import annotations

import time as clock
from functools import partial
from typing import Final, NamedTuple

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from mpc.constraints import Rows
from mpc.core.axes import Axis, axes
from mpc.exact.activeset import FEASIBLE, Active, ActiveSet, Side
from mpc.exact.free import FreeOptimum
from mpc.ocp import Problem, Query
from mpc.paper.condensed import Condensed, row_maps
from mpc.qp import QP, Solution
from mpc.solvers import Answer, Method, Solver
from quadsim.controller import ACTIVE_SET, GAIN, SOLVED, UNCONSTRAINED
from quadsim.state import Array, Indices, all_true, read_only

Flags = NDArray[np.bool_]

LARGEST_MAP: Final = 2**20
"""Entries beyond which there is no shortcut: 8 MiB, as much as a core's caches hold.  50 steps of the paper's problem
have 16 k entries, 400 steps 970 k."""


class Shortcut:
    """Solves no more of the QP than it has to.

    The cost is strictly convex: the minimiser over fewer constraints, if it satisfies the others too, is the one and
    only solution of Eq. (27).  In turn,

    1. no constraint at all: Eq. (22), a product for each axis of `mpc.core.axes`; the status is then `unconstrained`;
    2. rows of states alone, axis by axis, by their multipliers (`mpc.exact.activeset`), from the last period's;
    3. all rows, likewise;
    4. the whole QP by its solver, whose active set then leads to the exact optimum.

    Along the plan active rows alternate, so that the last period's set, moved one step earlier, is nearly this one's;
    where margins grow along the horizon, it is nearly so unmoved.  Both are tried as a start.

    Args:
        problem: with constraints.
        whole: solves the whole QP.
        parts: the problem's axes, where they are at hand.

    Raises:
        numpy.linalg.LinAlgError: the Hessian is so ill-conditioned that the gains of Eq. (22) are not exact.

    Attributes:
        formulation: the condensed QP.
    """

    def __init__(self, problem: Problem, whole: Solver, parts: list[Axis] | None = None) -> None:
        rows, N, nu = problem.rows, problem.horizon, problem.model.nu
        parts = axes(problem) if parts is None else parts
        self._rows, self._whole, self._rest = rows, whole, problem.rest
        self._free, self.formulation = FreeOptimum(problem, parts), Condensed(problem)
        self._C_r, self._C = problem.objective.C_r, rows.C
        found, channels = self._free.outputs, np.concatenate([axis.outputs for axis in parts])
        later = rows.of_states[channels]
        self._now = channels[~later], found[~later]
        # What the free optimum finds, as inputs (nu,) and as rows' values (m,); these are of inputs and steps as well.
        self._T = np.zeros((nu + channels.size, nu))
        self._T[self._free.inputs] = np.hstack([axis.T for axis in parts]).T
        of_found = np.zeros((nu + channels.size, len(rows.C)))
        of_found[found[later], channels[later]] = 1.0
        self._to_values = np.concatenate([rows.D.T, rows.E.T, of_found])
        terms = np.empty((N, len(self._to_values)))
        self._terms, self._inputs, self._steps, self._found = terms, *np.split(terms, [nu, 2 * nu], axis=1)
        self._lower, self._upper = rows.lower.ravel(), rows.upper.ravel()
        endless = np.isinf(rows.lower) + 2 * np.isinf(rows.upper)
        self._uneven = bool((endless != endless[0]).any())  # some steps have bounds that others lack
        self._values = np.empty(rows.lower.shape)
        self._none_active: Side = np.zeros(rows.lower.size, np.int8)
        self._none_active.setflags(write=False)
        self._side = self._none_active
        self._no_slacks = read_only(np.zeros((N, rows.soft.size)))
        self._no_multipliers = read_only(np.zeros(rows.lower.shape))
        grid = np.arange(rows.lower.size).reshape(rows.lower.shape)
        self._of_inputs_alone = ~np.broadcast_to(rows.C.any(axis=1), grid.shape)
        self._groups = []
        if rows.of_states[rows.C.any(axis=1)].all():
            groups = ((axis, axis.outputs) for axis in parts if axis.outputs.size)
            self._groups = [
                _Group(axis, rows.part(own, axis.states, axis.T.shape[1]), grid[:, own].ravel(), axis.T)
                for axis, own in groups
                if (N * max(own.size, axis.T.shape[1])) ** 2 <= LARGEST_MAP
            ]
        self._all = _Group(self.formulation, rows, grid.ravel(), np.eye(nu)) if grid.size**2 <= LARGEST_MAP else None

    @property
    def name(self) -> str:
        """Name of the QP solver."""
        return self._whole.name

    def reset(self) -> None:
        """See `mpc.solvers.Solver.reset`."""
        self._side = self._none_active
        self._whole.reset()

    def solve(self, query: Query) -> Answer:
        """See `mpc.solvers.Solver.solve`."""
        started, (state, desired, u_before, rest, _) = clock.perf_counter(), query
        x_s, u_s = self._rest if rest is None else rest
        dx, dy = (state, desired) if rest is None else (state - x_s, desired - self._C_r @ x_s)
        found = self._free.at(dx, dy, u_before - u_s).T
        plan = np.dot(found, self._T)
        plan += u_s
        self._found[:] = found
        values = self._values_of(plan, u_before)
        rows, channels = self._now
        if rows.size:
            values[0, rows] += self._C[rows] @ dx
            values[1:, rows] += found[:-1, channels]
        if rest is not None:
            values += self._C @ x_s
        free = values.ravel()
        within = (self._lower <= free) & (free <= self._upper)
        if all_true(within):
            self._side = self._none_active
            return Answer(
                plan,
                self._no_slacks,
                UNCONSTRAINED,
                GAIN,
                method=Method.FREE,
                exact=True,
                certificate=partial(self._certificate, query, plan, self._no_slacks, self._no_multipliers),
                solve_s=clock.perf_counter() - started,
            )
        free = free.copy()  # the values' room is used again
        if all_true(np.isfinite(free)):
            starts = self._starts()
            optimum, settled = self._by_axes(plan, free, within, u_before, starts)
            method = Method.WHOLE if optimum is None else Method.AXES
            if optimum is None and settled and self._all is not None:
                optimum = self._all.solve(plan, free, starts)
            if optimum is not None:
                self._side = optimum.active.side
                return self._answer(optimum, method, query, started)
        return self._by_solver(plan, free, query, started)

    def _certificate(self, query: Query, plan: Array, slacks: Array, multipliers: Array) -> tuple[QP, Solution]:
        """The condensed QP of a query, and its solution of a plan (N, nu)."""
        return self.formulation.pose(query).qp, self.formulation.solution(plan, slacks, multipliers)

    def _values_of(self, plan: Array, u_before: Array) -> Array:
        """(N, m) values of the rows, of those of states at the free optimum; the next call's too."""
        self._inputs[:] = plan
        np.subtract(plan[0], u_before, out=self._steps[0])
        np.subtract(plan[1:], plan[:-1], out=self._steps[1:])
        return np.dot(self._terms, self._to_values, out=self._values)

    def _starts(self) -> list[Side]:
        """The last active set moved one step earlier, its last step's held, and as it was."""
        if not np.count_nonzero(self._side):
            return [self._none_active]
        m = self._rows.l1.size
        moved = np.concatenate((self._side[m:], self._side[-m:]))
        if self._uneven:
            moved[np.isinf(np.where(moved > 0, self._upper, self._lower))] = 0
        return [moved, self._side]

    def _by_axes(
        self, plan: Array, free: Array, within: Flags, u_before: Array, starts: list[Side]
    ) -> tuple[_Found | None, bool]:
        """The optimum with active rows of states alone, if it satisfies all others; and whether it was found at all."""
        z, side, values, steps = np.zeros(free.size), np.zeros(free.size, np.int8), free.copy(), 0
        for group in self._groups:
            own = group.rows
            if all_true(within[own]):
                continue
            found = group.solve(plan, values, starts)
            if found is None:
                return None, False
            plan, steps = found.plan, steps + found.active.steps
            z[own], side[own], values[own] = found.active.z, found.active.side, found.active.values
        inputs = self._values_of(plan, u_before)
        np.copyto(values.reshape(inputs.shape), inputs, where=self._of_inputs_alone)
        beyond = np.maximum(values - self._upper, self._lower - values)
        if self._no_slacks.size:
            beyond[np.abs(side) == 2] = 0.0
        if not beyond[beyond.argmax()] <= FEASIBLE:
            return None, True
        return _Found(plan, Active(z=z, values=values, side=side, steps=steps)), True

    def _answer(self, found: _Found, method: Method, query: Query, started: float) -> Answer:
        slacks, active = self._no_slacks, found.active
        if slacks.size and np.count_nonzero(violated := np.abs(active.side) == 2):
            values, shape = active.values, self._rows.lower.shape
            beyond = np.maximum(np.maximum(values - self._upper, self._lower - values), 0.0)
            slacks = (violated * beyond).reshape(shape)[:, self._rows.soft]
        multipliers = active.z.reshape(self._rows.lower.shape)
        return Answer(
            found.plan,
            slacks,
            SOLVED,
            ACTIVE_SET,
            iterations=active.steps,
            active=int(np.count_nonzero(active.side)),
            method=method,
            exact=True,
            certificate=partial(self._certificate, query, found.plan, slacks, multipliers),
            solve_s=clock.perf_counter() - started,
        )

    def _by_solver(self, plan: Array, free: Array, query: Query, started: float) -> Answer:
        """The solver's answer to the whole QP, made exact where its active set leads to the optimum."""
        whole, spent_s = self._whole, clock.perf_counter() - started
        answer = given = whole.solve(query)
        started, self._side = clock.perf_counter(), self._none_active
        if given.status == SOLVED:
            assert given.certificate is not None
            multipliers, found = whole.formulation.multipliers(given.certificate()[1]), None
            if self._all is not None:
                self._side = self._all.near(multipliers.ravel(), free)
                found = self._all.solve(plan, free, [self._side])
            if found is not None:
                self._side = found.active.side
                answer = self._answer(found, Method.WHOLE, query, started)
            else:
                certificate = partial(self._certificate, query, given.plan, given.slacks, multipliers)
                answer = given._replace(certificate=certificate)
        return answer._replace(
            answered_by=whole.name,
            iterations=given.iterations,
            solve_s=spent_s + given.solve_s + clock.perf_counter() - started,
            reported_primal=given.reported_primal,
            reported_dual=given.reported_dual,
        )


class _Found(NamedTuple):
    """A plan (N, nu) and the multipliers that lead to it."""

    plan: Array
    active: Active


class _Group:
    """Rows whose multipliers are found together.

    Args:
        of: the part of the whole that they are on.
        part: these rows of the part.
        rows: where they are among all (N m,).
        T: (nu, m) what the part's inputs are among all.
    """

    def __init__(self, of: Axis | Condensed, part: Rows, rows: Indices, T: Array) -> None:
        G = row_maps(part, of.maps).of_inputs
        factor = np.linalg.cholesky(of.cost.H)
        half = scipy.linalg.solve_triangular(factor, G.reshape(rows.size, -1).T, lower=True)
        self.rows, self._T = rows, T.T
        self._R = np.ascontiguousarray(scipy.linalg.solve_triangular(factor, half, lower=True, trans="T").T)
        l1, l2 = (np.tile(penalty, len(G)) for penalty in (part.l1, part.l2))
        self._lower, self._upper = part.lower.ravel(), part.upper.ravel()
        self._set = ActiveSet(half.T @ half, l1, l2, part.l1.size)

    def solve(self, plan: Array, free: Array, starts: list[Side]) -> _Found | None:
        """The optimum over these rows alone, from one without them; of values and sides of all rows."""
        own = self.rows
        found = self._set.solve(free[own], self._lower, self._upper, [side[own] for side in starts])
        if found is None:
            return None
        active = found.z.nonzero()[0]
        change = np.dot(found.z[active], self._R.take(active, 0)).reshape(len(plan), -1)
        return _Found(plan - np.dot(change, self._T), found)

    def near(self, z: Array, free: Array) -> Side:
        """The active set that approximate multipliers of all rows indicate; see `ActiveSet.near`."""
        return self._set.near(z, free, self._lower, self._upper)


def with_shortcut(problem: Problem, whole: Solver) -> Solver:
    """A solver that tries less than the whole QP first; the solver itself where that is no good.

    The map to the free optimum grows with the square of the horizon, the QP in proportion to it: beyond `LARGEST_MAP`
    entries nothing is tried.  Nor is it where the Hessian is so ill-conditioned, by a long horizon or weights far
    apart, that the gains are not exact, nor where rows share a slack, or differ from step to step: `mpc.space.clearing`
    has those.
    """
    if problem.rows.C.ndim == 3 or problem.rows.slacks.size < problem.rows.soft.size:
        return whole
    N, parts = problem.horizon, axes(problem)
    entries = sum(
        N * (axis.T.shape[1] + axis.outputs.size) * (axis.states.size + N * axis.regulated.size) for axis in parts
    )
    if entries > LARGEST_MAP:
        return whole
    try:
        return Shortcut(problem, whole, parts)
    except np.linalg.LinAlgError:
        return whole
