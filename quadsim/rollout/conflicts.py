"""Explains why a problem has no answer: which constraints conflict, by how much, and what would help.

An elastic problem has a slack e >= 0 for each bound at each step, and is a linear program:

    minimise  sum e / s    subject to    the dynamics,  lower - e <= C x + D u + E du <= upper + e,

where s is half of the gap between a row's bounds, so that rows of any unit count alike. It always has an answer, and
its optimum is zero if and only if the QP is feasible. Bounds on inputs alone come first: they describe what the
actuators can do, and bounds on states are relaxed to fit. Of the bounds on states, those with slack are *violated*.
Those that are *blocking* have no slack, and dropping any one of them reduces the violation. Multipliers give the
candidates, then deletion one by one confirms them (Chinneck and Dravnieks, 1991, "Locating minimal infeasible
constraint sets in linear programs").

It uses the constraints' rows, of any kind. Soft constraints never make a problem infeasible.
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
from quadsim.mpc.problem.qp import Solution
from quadsim.mpc.solvers import QPSolver
from quadsim.mpc.solvers.piqp import Piqp
from quadsim.state import Array

DIAGNOSIS_SOLVER: Final = "piqp-multistage"
"""Solves the suggested problems; the flight may use another solver."""
FEASIBLE: Final = 1e-6
"""Violation, as a share of half the gap between a row's bounds, attributed to rounding."""
PRICED: Final = 1e-9
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
    """Return which constraints conflict; None if the elastic problem cannot be solved either."""
    problem = infeasible_period.problem
    query = infeasible_period.query
    parts = infeasible_period.problem.every_constraint
    sides = _sides(problem)
    scales = _scales(problem)
    of_inputs = {side for side in sides if (C := parts[side.place].C) is None or not C.any()}
    total = 0.0
    violated = dict[Side, Violation]()
    held = set[Side]()
    for elastic in filter(None, (of_inputs, sides.keys() - of_inputs)):
        present = {side: one for side, one in sides.items() if side in of_inputs or side in elastic}
        relaxed = _relaxed(problem, query, present, elastic)
        if relaxed is None:
            return None
        total += relaxed.total
        if relaxed.total <= FEASIBLE:
            continue
        giving = {side: slack for side, slack in relaxed.slacks.items() if (slack > FEASIBLE).any()}
        for side, slack in giving.items():
            steps = np.flatnonzero(slack > FEASIBLE)
            share = float(slack.max())
            of_inputs_too = (parts[side.place].D, parts[side.place].E)
            later = int(not any(matrix is not None and matrix[side.row].any() for matrix in of_inputs_too))
            violated[side] = Violation(
                amount=share * float(scales[side.place][side.row]),
                share=share,
                first=int(steps[0]) + later,
                last=int(steps[-1]) + later,
            )
            # widened for the next pass by the violation
            one = sides[side]
            wider = share + FEASIBLE
            sides[side] = replace(one, lower=one.lower - wider, upper=one.upper + wider)
        held |= _needed(problem, query, present, elastic, relaxed, giving)
    return Conflict(total=total, violated=violated, blocking=tuple(sorted(held - violated.keys())))


def smallest_widening(infeasible_period: InfeasiblePeriod, sides: Collection[Side]) -> float | None:
    """Return the smallest amount by which all `sides` must move outwards, at all steps, to make the problem feasible.

    None if no amount does.
    """
    problem = infeasible_period.problem
    query = infeasible_period.query
    scales = {side: _scales(problem)[side.place][side.row] for side in sides}
    relaxed = _relaxed(problem, query, _sides(problem), sides, together=scales)
    if relaxed is None:
        return None
    return relaxed.total


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


class _Relaxed(NamedTuple):
    """An elastic problem's optimum, each elastic bound's slack (N,), and the bounds with a multiplier."""

    total: float
    slacks: dict[Side, Array]
    priced: set[Side]


def _scales(problem: Problem) -> list[Array]:
    """Return the scale of each row (m,): half the gap between its bounds; the size of a single bound, or 1."""
    scales = []
    for part in problem.every_constraint:
        lower = np.atleast_2d(part.lower)
        upper = np.atleast_2d(part.upper)
        half = 0.5 * (upper - lower).max(axis=0)
        size = np.where(np.isfinite(lower), np.abs(lower), np.where(np.isfinite(upper), np.abs(upper), 0.0)).max(axis=0)
        scales.append(np.where(np.isfinite(half), half, np.where(size > 0.0, size, 1.0)))
    return scales


def _sides(problem: Problem) -> dict[Side, Constraint]:
    """Return every finite bound of a hard constraint as its own constraint, scaled by its row."""
    sides = {}
    for place, (part, scales) in enumerate(zip(problem.every_constraint, _scales(problem), strict=True)):
        for row in range(scales.size if part.penalty is None else 0):
            matrices: dict[str, Any] = {}
            for name, matrix in (("C", part.C), ("D", part.D), ("E", part.E)):
                matrices[name] = None if matrix is None else matrix[..., [row], :] / scales[row]
            for upper in (False, True):
                bound = (part.upper if upper else part.lower)[..., [row]] / scales[row]
                if np.isfinite(bound).any():
                    none = np.full_like(bound, -math.inf if upper else math.inf)
                    lower, higher = (none, bound) if upper else (bound, none)
                    sides[Side(place, row, upper)] = Constraint(name=part.name, lower=lower, upper=higher, **matrices)
    return sides


def _needed(
    problem: Problem,
    query: Query,
    sides: Mapping[Side, Constraint],
    elastic: Collection[Side],
    relaxed: _Relaxed,
    giving: Collection[Side],
) -> set[Side]:
    """Return the smallest set of bounds without slack each of which increases the violation."""

    def is_enough(held: Mapping[Side, Constraint]) -> bool:
        less = _relaxed(problem, query, held, elastic)
        return less is not None and less.total >= relaxed.total * (1.0 - 1e-6) - FEASIBLE

    # Multipliers may fall by powers of ten along a chain of bounds over successive steps, below the resolution.
    priced = {side: one for side, one in sides.items() if side in relaxed.priced or side in giving}
    present = priced if is_enough(priced) else dict(sides)
    for side in sorted(present.keys() - set(giving)):
        fewer = {other: one for other, one in present.items() if other != side}
        if is_enough(fewer):
            present = fewer
    return present.keys() - set(giving)


def _relaxed(
    problem: Problem,
    query: Query,
    sides: Mapping[Side, Constraint],
    elastic: Collection[Side],
    together: Mapping[Side, float] | None = None,
) -> _Relaxed | None:
    """Solve the elastic problem of scaled bounds; None if the solver fails.

    `together` gives the scales of elastic bounds that share one slack over all steps, in their own unit; the problem
    then minimises that slack.
    """
    from scipy.optimize import linprog  # takes a tenth of a second, which flights without failures do not need

    slack = Penalty(l1=np.ones(1), l2=np.zeros(1))
    rows = tuple(replace(one, penalty=slack if side in elastic else None) for side, one in sides.items())
    form = Staged(replace(problem, bounds=None, constraints=rows))
    qp = form.assemble(query)
    named = [side for side in sides if side in elastic]
    columns = form.slack_columns
    scale = form.slack_scale
    basis = sparse.identity(qp.c.size, format="csc")
    cost = np.zeros(qp.c.size)
    box = np.stack([qp.x_l, qp.x_u], 1)
    cost[columns] = 1.0 / scale
    if together is not None:
        weights = np.zeros(qp.c.size)
        weights[columns] = scale / np.array([together[side] for side in named])
        others = np.setdiff1d(np.arange(qp.c.size), columns)
        basis = sparse.hstack([basis[:, others], sparse.csc_matrix(weights[:, None])], format="csc")
        cost = np.append(np.zeros(others.size), 1.0)
        box = np.vstack([box[others], [0.0, math.inf]])
    above = np.isfinite(qp.h_u)
    below = np.isfinite(qp.h_l)
    for method in ("highs-ds", "highs-ipm"):  # the simplex fails now and then where the optimum is degenerate
        optimum = linprog(
            cost,
            A_ub=sparse.vstack([qp.G[above], -qp.G[below]]) @ basis,
            b_ub=np.concatenate([qp.h_u[above], -qp.h_l[below]]),
            A_eq=qp.A @ basis,
            b_eq=qp.b,
            bounds=box,
            method=method,
        )
        if not optimum.status:
            break
    else:
        return None
    slacks = dict(zip(named, form.slacks(basis @ optimum.x).T, strict=True))
    if together is not None:
        return _Relaxed(total=float(optimum.fun), slacks=slacks, priced=set())
    z = np.zeros(qp.h_u.size)
    z[above] -= optimum.ineqlin.marginals[: np.count_nonzero(above)]
    z[below] += optimum.ineqlin.marginals[np.count_nonzero(above) :]
    z_box = -optimum.upper.marginals - optimum.lower.marginals
    multipliers = form.multipliers(Solution(x=optimum.x, y=np.zeros(0), z=z, z_box=z_box))
    return _Relaxed(
        total=float(optimum.fun),
        slacks=slacks,
        priced={side for side, priced in zip(sides, multipliers.T, strict=True) if (np.abs(priced) > PRICED).any()},
    )
