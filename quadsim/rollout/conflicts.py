"""Explains why a problem has no answer: which constraints conflict, by how much, and what would help.

The elastic problem has a slack e >= 0 for each bound at each step; s is half of the gap between a row's bounds:
    minimise  sum e / s    subject to    the dynamics,  lower - e <= C x + D u + E du <= upper + e.
It is a linear program that always has an answer.  `quadsim.rollout.infeasibility` puts the conflict into the terms of a
scenario file.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, replace
from typing import Any, Final, NamedTuple

import numpy as np
from scipy import sparse

from quadsim.controller import SOLVED
from quadsim.mpc.forms.staged import Staged, steps_of
from quadsim.mpc.problem.constraints import Constraint, Penalty
from quadsim.mpc.problem.ocp import InfeasiblePeriod, Problem, Query
from quadsim.mpc.problem.qp import QP, Solution
from quadsim.mpc.solvers import QPSolver
from quadsim.mpc.solvers.piqp import Piqp
from quadsim.state import Array

DIAGNOSIS_SOLVER: Final = "piqp-multistage"
"""Solves the suggested problems; the flight may use another solver."""
FEASIBLE: Final = 1e-6
"""Largest violation, as a share of half the gap between a row's bounds, that is attributed to rounding."""
LEAST_MULTIPLIER: Final = 1e-9
"""Multiplier of a bound, in shares per share, above which it may be blocking."""


class Side(NamedTuple):
    """One of the two bounds of a row."""

    place: int  # index of its constraint (`quadsim.mpc.problem.ocp.Problem.every_constraint`)
    row: int  # row within the constraint
    upper: bool  # whether it is the upper bound


@dataclass(frozen=True, kw_only=True)
class Violation:
    """A bound that has to be relaxed."""

    amount: float  # largest violation, in the row's unit
    share: float  # the same as a share of half the gap between the row's bounds
    first: int  # first violation, in whole periods after the instant of x(k)
    last: int  # last violation


@dataclass(frozen=True, kw_only=True)
class Conflict:
    """Conflicting constraints; empty if the problem is feasible and its solver failed."""

    total: float  # sum of all violations, as shares
    violated: Mapping[Side, Violation]  # the bounds that have to be relaxed
    blocking: tuple[Side, ...]  # the bounds that hold, each of which increases the violation

    @property
    def feasible(self) -> bool:
        """Whether all constraints can hold."""
        return not self.violated


def find_conflict(infeasible_period: InfeasiblePeriod) -> Conflict | None:
    """Return which constraints conflict; None if the elastic problem cannot be solved either.

    The elastic problem's optimum is zero if and only if the QP is feasible.  Bounds on inputs alone come first: they
    describe what the actuators can do, and bounds on states are relaxed to fit.  Bounds with slack are *violated*.
    Those that are *blocking* have no slack, and dropping any one of them reduces the violation.

    It uses the constraints' rows, of any kind.  Soft constraints never make a problem infeasible.
    """
    problem = infeasible_period.problem
    query = infeasible_period.query
    bounds = _scaled_bounds(problem)
    scales = _scales(problem)
    of_inputs = _on_inputs_alone(problem, bounds)
    total = 0.0
    violated = dict[Side, Violation]()
    blocking = set[Side]()
    for elastic in (of_inputs, bounds.keys() - of_inputs):
        if not elastic:
            continue
        present = {side: bound for side, bound in bounds.items() if side in of_inputs or side in elastic}
        optimum = _elastic_optimum(problem, query, present, elastic)
        if optimum is None:
            return None
        total += optimum.total
        if optimum.total <= FEASIBLE:
            continue
        with_slack = {side: slack for side, slack in optimum.slacks.items() if (slack > FEASIBLE).any()}
        for side, slack in with_slack.items():
            constraint = problem.every_constraint[side.place]
            violated[side] = _violation(constraint, side, slack, float(scales[side.place][side.row]))
            # the bounds on states are relaxed to fit these
            bounds[side] = _widened(bounds[side], violated[side].share + FEASIBLE)
        blocking |= _needed_for(optimum, problem, query, present, elastic, with_slack)
    return Conflict(total=total, violated=violated, blocking=tuple(sorted(blocking - violated.keys())))


def smallest_widening(infeasible_period: InfeasiblePeriod, sides: Collection[Side]) -> float | None:
    """Return the smallest amount by which all `sides` must move outwards, at all steps, to make the problem feasible.

    None if no amount does.
    """
    problem = infeasible_period.problem
    scales = _scales(problem)
    together = {side: float(scales[side.place][side.row]) for side in sides}
    optimum = _elastic_optimum(problem, infeasible_period.query, _scaled_bounds(problem), sides, together)
    if optimum is None:
        return None
    return optimum.total


def has_answer(problem: Problem, query: Query) -> bool:
    """Return whether PIQP solves the problem, called as the controllers call it."""
    return _set_up(problem, query)(query)


def recovery(infeasible_period: InfeasiblePeriod, plan: Array) -> int | None:
    """Return after how many periods of a plan (N, nu) the model predicts an answer; None if not within the plan."""
    problem = infeasible_period.problem
    query = infeasible_period.query
    is_solved = _set_up(problem, query)
    state = query.state
    for i, (u, A, B, c) in enumerate(zip(plan, *steps_of(problem, query), strict=True)):
        state = A @ state + B @ u + c
        if is_solved(query._replace(state=state, u_before=u)):
            return i + 1
    return None


def _set_up(problem: Problem, query: Query) -> Callable[[Query], bool]:
    """Return a function that tells whether queries of this kind are solved."""
    if query.steps is None:
        solver = QPSolver(DIAGNOSIS_SOLVER, problem)
        return lambda query: solver.solve(query).status == SOLVED
    form = Staged(problem)
    backend = Piqp()
    backend.setup(form.assemble(query))
    return lambda query: backend.solve(form.assemble(query)).status == SOLVED


class _ElasticOptimum(NamedTuple):
    """An elastic problem's optimum, each elastic bound's slack (N,), and the bounds with a multiplier."""

    total: float
    slacks: dict[Side, Array]
    priced: set[Side]


def _scales(problem: Problem) -> list[Array]:
    """Return the scale of each row (m,): half the gap between its bounds; the size of a single bound, or 1."""
    scales = []
    for constraint in problem.every_constraint:
        lower = np.atleast_2d(constraint.lower)
        upper = np.atleast_2d(constraint.upper)
        half_gap = 0.5 * (upper - lower).max(axis=0)
        upper_size = np.where(np.isfinite(upper), np.abs(upper), 0.0)
        size = np.where(np.isfinite(lower), np.abs(lower), upper_size).max(axis=0)
        size = np.where(size > 0.0, size, 1.0)
        scales.append(np.where(np.isfinite(half_gap), half_gap, size))
    return scales


def _scaled_bounds(problem: Problem) -> dict[Side, Constraint]:
    """Return every finite bound of a hard constraint as its own constraint, scaled by its row."""
    bounds = {}
    for place, (constraint, scales) in enumerate(zip(problem.every_constraint, _scales(problem), strict=True)):
        if constraint.penalty is not None:
            continue
        for row, scale in enumerate(scales):
            for upper in (False, True):
                bound = _one_sided(constraint, row, scale, upper=upper)
                if bound is not None:
                    bounds[Side(place, row, upper)] = bound
    return bounds


def _one_sided(constraint: Constraint, row: int, scale: float, *, upper: bool) -> Constraint | None:
    """Return the lower or upper bound of a row as its own constraint, divided by its scale; None if it is infinite."""
    stated = constraint.lower
    if upper:
        stated = constraint.upper
    bound = stated[..., [row]] / scale
    if not np.isfinite(bound).any():
        return None
    matrices: dict[str, Any] = {}
    for name, matrix in (("C", constraint.C), ("D", constraint.D), ("E", constraint.E)):
        if matrix is not None:
            matrices[name] = matrix[..., [row], :] / scale
    if upper:
        return Constraint(name=constraint.name, lower=np.full_like(bound, -math.inf), upper=bound, **matrices)
    return Constraint(name=constraint.name, lower=bound, upper=np.full_like(bound, math.inf), **matrices)


def _widened(bound: Constraint, share: float) -> Constraint:
    """Return a scaled bound that is moved outwards."""
    return replace(bound, lower=bound.lower - share, upper=bound.upper + share)


def _on_inputs_alone(problem: Problem, sides: Collection[Side]) -> set[Side]:
    """Return the sides of constraints that bound no state."""
    of_inputs = set()
    for side in sides:
        C = problem.every_constraint[side.place].C
        if C is None or not C.any():
            of_inputs.add(side)
    return of_inputs


def _violation(constraint: Constraint, side: Side, slack: Array, scale: float) -> Violation:
    """Return the violation of a bound with slack (N,), in shares of its row's scale.

    Rows with inputs hold at the instant of x(k) and after, rows on states alone from one period later on.
    """
    later = 1
    for matrix in (constraint.D, constraint.E):
        if matrix is not None and matrix[side.row].any():
            later = 0
    steps = np.flatnonzero(slack > FEASIBLE)
    share = float(slack.max())
    return Violation(amount=share * scale, share=share, first=int(steps[0]) + later, last=int(steps[-1]) + later)


def _needed_for(
    optimum: _ElasticOptimum,
    problem: Problem,
    query: Query,
    bounds: Mapping[Side, Constraint],
    elastic: Collection[Side],
    with_slack: Collection[Side],
) -> set[Side]:
    """Return a smallest set of bounds without slack each of which increases the violation.

    Multipliers give the candidates, then deletion one by one confirms them (Chinneck and Dravnieks, 1991, "Locating
    minimal infeasible constraint sets in linear programs").
    """

    def is_enough(kept: Mapping[Side, Constraint]) -> bool:
        less = _elastic_optimum(problem, query, kept, elastic)
        return less is not None and less.total >= optimum.total * (1.0 - 1e-6) - FEASIBLE

    present = {side: bound for side, bound in bounds.items() if side in optimum.priced or side in with_slack}
    if not is_enough(present):
        # multipliers may fall by powers of ten along a chain of bounds over successive steps, below the resolution
        present = dict(bounds)
    for side in sorted(present.keys() - set(with_slack)):
        fewer = {other: bound for other, bound in present.items() if other != side}
        if is_enough(fewer):
            present = fewer
    return present.keys() - set(with_slack)


def _elastic_optimum(
    problem: Problem,
    query: Query,
    bounds: Mapping[Side, Constraint],
    elastic: Collection[Side],
    together: Mapping[Side, float] | None = None,
) -> _ElasticOptimum | None:
    """Solve the elastic problem of scaled bounds; None if the solver fails.

    `together` gives the scales of elastic bounds that share one slack over all steps, in their own unit; the problem
    then minimises that slack.
    """
    soft = Penalty(l1=np.ones(1), l2=np.zeros(1))
    rows = []
    for side, bound in bounds.items():
        if side in elastic:
            rows.append(replace(bound, penalty=soft))
        else:
            rows.append(replace(bound, penalty=None))
    form = Staged(replace(problem, bounds=None, constraints=tuple(rows)))
    qp = form.assemble(query)
    elastic_sides = [side for side in bounds if side in elastic]
    if together is None:
        program = _with_own_slacks(form, qp)
    else:
        program = _with_one_slack(form, qp, np.array([together[side] for side in elastic_sides]))
    optimum = _solve(program, qp)
    if optimum is None:
        return None
    slacks = dict(zip(elastic_sides, form.slacks(program.basis @ optimum.x).T, strict=True))
    priced = set()
    if together is None:
        for side, multipliers in zip(bounds, _multipliers(optimum, form, qp).T, strict=True):
            if (np.abs(multipliers) > LEAST_MULTIPLIER).any():
                priced.add(side)
    return _ElasticOptimum(total=float(optimum.fun), slacks=slacks, priced=priced)


class _Program(NamedTuple):
    """The elastic problem as a linear program in v: minimise cost' v; the variables of the QP are x = basis v."""

    basis: Any  # sparse
    cost: Array
    box: Array  # lower and upper bounds of v, in two columns


def _with_own_slacks(form: Staged, qp: QP) -> _Program:
    """Return the program in which every bound has its own slack at each step."""
    cost = np.zeros(qp.c.size)
    cost[form.slack_columns] = 1.0 / form.slack_scale
    return _Program(basis=sparse.identity(qp.c.size, format="csc"), cost=cost, box=np.stack([qp.x_l, qp.x_u], 1))


def _with_one_slack(form: Staged, qp: QP, scales: Array) -> _Program:
    """Return the program in which bounds of these scales share one slack, the last variable."""
    columns = form.slack_columns
    weights = np.zeros(qp.c.size)
    weights[columns] = form.slack_scale / scales
    others = np.setdiff1d(np.arange(qp.c.size), columns)
    identity = sparse.identity(qp.c.size, format="csc")
    basis = sparse.hstack([identity[:, others], sparse.csc_matrix(weights[:, None])], format="csc")
    box = np.stack([qp.x_l, qp.x_u], 1)[others]
    return _Program(basis=basis, cost=np.append(np.zeros(others.size), 1.0), box=np.vstack([box, [0.0, math.inf]]))


def _solve(program: _Program, qp: QP) -> Any:
    """Return scipy's result of a program; None if it cannot be solved."""
    from scipy.optimize import linprog  # takes a tenth of a second, which flights without failures do not need

    above = np.isfinite(qp.h_u)
    below = np.isfinite(qp.h_l)
    for method in ("highs-ds", "highs-ipm"):  # the simplex fails now and then where the optimum is degenerate
        optimum = linprog(
            program.cost,
            A_ub=sparse.vstack([qp.G[above], -qp.G[below]]) @ program.basis,
            b_ub=np.concatenate([qp.h_u[above], -qp.h_l[below]]),
            A_eq=qp.A @ program.basis,
            b_eq=qp.b,
            bounds=program.box,
            method=method,
        )
        if not optimum.status:
            return optimum
    return None


def _multipliers(optimum: Any, form: Staged, qp: QP) -> Array:
    """Return (N, m) the multipliers of the rows at the optimum of the program with a slack of each bound."""
    above = np.isfinite(qp.h_u)
    below = np.isfinite(qp.h_l)
    of_rows = optimum.ineqlin.marginals
    z = np.zeros(qp.h_u.size)
    z[above] -= of_rows[: np.count_nonzero(above)]
    z[below] += of_rows[np.count_nonzero(above) :]
    z_box = -optimum.upper.marginals - optimum.lower.marginals
    return form.multipliers(Solution(x=optimum.x, y=np.zeros(0), z=z, z_box=z_box))
