"""The optimum of an optimal control problem from its definition alone: rolled out, probed, and solved as a dense QP.

Nothing of `quadsim.mpc.problem.qp`, `quadsim.mpc.forms.staged` or `quadsim.mpc.problem.paper` that builds
matrices is used: states by recursion, and every matrix by what unit inputs do.  A plan may have axes in front of its
own two: many plans are then rolled out at once.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection
from dataclasses import dataclass

import numpy as np
import scipy.linalg
from polish import polish
from scipy.optimize import linprog

from quadsim.mpc.problem.constraints import Constraint
from quadsim.mpc.problem.ocp import Equilibrium, Problem, Query
from quadsim.mpc.problem.qp import QP, Solution, kkt_residuals
from quadsim.mpc.solvers.daqp import DaqpDense
from quadsim.state import Array


@dataclass(frozen=True, kw_only=True)
class Period:
    """One period's data: x(k+i+1) = A_i x(k+i) + B_i u(k+i) + c_i from a state, after an input, towards outputs.

    Attributes:
        A: (N, n, n).
        B: (N, n, nu).
        c: (N, n).
        state: (n,) x(k).
        desired: (N, n_r) y_d.
        u_before: (nu,) u(k-1).
        rest: what the cost is about.
    """

    A: Array
    B: Array
    c: Array
    state: Array
    desired: Array
    u_before: Array
    equilibrium: Equilibrium

    @property
    def query(self) -> Query:
        """The same for a solver whose model changes."""
        return Query(self.state, self.desired, self.u_before, self.equilibrium, (self.A, self.B, self.c))


def period(problem: Problem, state: Array, desired: Array, u_before: Array, rest: Equilibrium | None = None) -> Period:
    """Of the problem's own model, anchored at its rest state or another."""
    model, N, (x_s, u_s) = problem.model, problem.horizon, problem.equilibrium if rest is None else rest
    c = x_s - model.A @ x_s - model.B @ u_s
    return Period(
        A=np.tile(model.A, (N, 1, 1)),
        B=np.tile(model.B, (N, 1, 1)),
        c=np.tile(c, (N, 1)),
        state=state,
        desired=desired,
        u_before=u_before,
        equilibrium=Equilibrium(x_s, u_s),
    )


def trajectory(given: Period, plan: Array) -> Array:
    """(N + 1, n) x(k) .. x(k+N) under a plan (N, nu)."""
    states = [np.broadcast_to(given.state, (*plan.shape[:-2], given.state.size))]
    for A, B, c, u in zip(given.A, given.B, given.c, np.moveaxis(plan, -2, 0), strict=True):
        states.append(states[-1] @ A.T + u @ B.T + c)
    return np.stack(states, axis=-2)


def moves(given: Period, plan: Array) -> Array:
    """(N, nu) the steps of the inputs of a plan (N, nu)."""
    before = np.broadcast_to(given.u_before, (*plan.shape[:-2], 1, plan.shape[-1]))
    return np.diff(plan, axis=-2, prepend=before)


def constraints(problem: Problem) -> tuple[Constraint, ...]:
    """All of them, the paper's among them."""
    return (*(problem.bounds.constraints if problem.bounds else ()), *problem.constraints)


def values(constraint: Constraint, given: Period, plan: Array) -> Array:
    """(N, m) the values of a constraint's rows along the rolled out plan."""
    states = trajectory(given, plan)
    steps = moves(given, plan)
    result = np.zeros((*plan.shape[:-1], constraint.lower.shape[-1]))
    for row in range(result.shape[-1]):
        of_inputs = [
            part @ matrix[row]
            for matrix, part in ((constraint.D, plan), (constraint.E, steps))
            if matrix is not None and matrix[row].any()
        ]
        result[..., row] = sum(of_inputs, np.zeros(plan.shape[:-1]))
        if constraint.C is not None:
            result[..., row] += (states[..., :-1, :] if of_inputs else states[..., 1:, :]) @ constraint.C[row]
    return result


def violation(constraint: Constraint, given: Period, plan: Array) -> Array:
    """(N, m) by how much a rolled out plan violates a constraint; 0 where it does not."""
    result = values(constraint, given, plan)
    return np.maximum(np.maximum(constraint.lower - result, result - constraint.upper), 0.0)


def residuals(problem: Problem, given: Period, plan: Array) -> Array:
    """What the cost is the sum of the squares of, but for slacks."""
    objective = problem.objective
    states = trajectory(given, plan)
    errors = states[..., 1:, :] @ objective.C_r.T - given.desired
    summed = errors[..., : plan.shape[-2] - (objective.P is not None), :]
    parts = [(summed, objective.Q_y), (plan - given.equilibrium.u, objective.Q_u)]
    if objective.Q_d is not None:
        parts.append((moves(given, plan), objective.Q_d))
    if objective.P is not None:
        x_s = given.equilibrium.x
        inverse = np.linalg.pinv(objective.C_r)
        desired = x_s + inverse @ (given.desired[-1] - objective.C_r @ x_s)
        parts.append((states[..., -1:, :] - desired, objective.P))
    return np.concatenate([_flat(part @ _root(weight)) for part, weight in parts], axis=-1)


def cost(problem: Problem, given: Period, plan: Array) -> float:
    """What a plan costs, its violations of soft constraints included."""
    total = float(np.square(residuals(problem, given, plan)).sum())
    for constraint in constraints(problem):
        if constraint.penalty is not None:
            e = violation(constraint, given, plan)
            penalty = constraint.penalty
            l1 = penalty.l1
            l2 = penalty.l2
            if penalty.largest:
                e = e.max(axis=1, keepdims=True)
                l1 = l1[:1]
                l2 = l2[:1]
            total += float((e @ l1 + np.square(e) @ l2).sum())
    return total


def dense_qp(problem: Problem, given: Period) -> QP:
    """In [u(k); ..; u(k+N-1); e], the slacks e time by time."""
    N = given.B.shape[0]
    nu = given.B.shape[2]
    M, r0 = _probed(lambda plan: residuals(problem, given, plan), N, nu)
    hard: list[tuple[Array, Array, Array]] = []
    soft: list[tuple[Array, Array, Array]] = []
    l1 = np.zeros((N, 0))
    l2 = np.zeros((N, 0))
    shares = []
    for part in constraints(problem):
        slopes, known = _probed(lambda plan, part=part: _flat(values(part, given, plan)), N, nu)  # type: ignore[misc]
        m = part.lower.shape[-1]
        lower, upper = (np.broadcast_to(side, (N, m)) for side in (part.lower, part.upper))
        bounded = (np.isfinite(lower) | np.isfinite(upper)).any(axis=0)
        lower = lower[:, bounded]
        upper = upper[:, bounded]
        known = known.reshape(N, m)[:, bounded]
        rows = slopes.reshape(N, m, N * nu)[:, bounded], lower - known, upper - known
        (hard if part.penalty is None else soft).append(rows)
        if part.penalty is not None:
            own = bounded if not part.penalty.largest else np.arange(m) == 0
            shares.append(np.ones((bounded.sum(), 1)) if part.penalty.largest else np.eye(bounded.sum()))
            l1 = np.hstack([l1, np.tile(part.penalty.l1[own], (N, 1))])
            l2 = np.hstack([l2, np.tile(part.penalty.l2[own], (N, 1))])
    n_s = l1.size
    G, low, high = _stacked(hard, N * nu)
    S, soft_low, soft_high = _stacked(soft, N * nu)
    none, E = (
        np.zeros((len(G), n_s)),
        np.kron(np.eye(N), scipy.linalg.block_diag(*shares)) if shares else np.zeros((0, 0)),
    )
    return QP(
        P=scipy.linalg.block_diag(2.0 * M.T @ M, np.diag(2.0 * l2.ravel())),
        c=np.concatenate([2.0 * M.T @ r0, l1.ravel()]),
        A=np.zeros((0, N * nu + n_s)),
        b=np.zeros(0),
        G=np.vstack([np.hstack([G, none]), np.hstack([S, E]), np.hstack([S, -E])]),
        h_l=np.concatenate([low, soft_low, np.full(len(S), -math.inf)]),
        h_u=np.concatenate([high, np.full(len(S), math.inf), soft_high]),
        x_l=np.concatenate([np.full(N * nu, -math.inf), np.zeros(n_s)]),
        x_u=np.full(N * nu + n_s, math.inf),
    )


def least_violation(
    problem: Problem, given: Period, sides: Collection[tuple[int, int, bool]] | None = None
) -> float | None:
    """The smallest sum of violations of hard constraints on states, each over half of what lies between its bounds.

    None where bounds on inputs cannot hold by themselves.  Of the bounds, by constraint, row and whether upper, those
    given alone are there, or all.
    """
    N = given.B.shape[0]
    nu = given.B.shape[2]
    rows: list[Array] = []
    bounds: list[Array] = []
    weights: list[Array] = []
    for place, part in enumerate(constraints(problem)):
        if part.penalty is not None:
            continue
        slopes, known = _probed(lambda plan, part=part: _flat(values(part, given, plan)), N, nu)  # type: ignore[misc]
        m = part.lower.shape[-1]
        lower, upper = (np.broadcast_to(side, (N, m)) for side in (part.lower, part.upper))
        free = part.C is not None and bool(part.C.any())
        for i, j in np.ndindex(N, m):
            half = 0.5 * max(upper[:, j] - lower[:, j])
            size = max((abs(b) for b in (lower[0, j], upper[0, j]) if math.isfinite(b)), default=1.0) or 1.0
            for sign, bound in ((1.0, upper[i, j]), (-1.0, -lower[i, j])):
                if math.isfinite(bound) and (sides is None or (place, j, sign > 0.0) in sides):
                    rows.append(sign * slopes[i * m + j])
                    bounds.append(bound - sign * known[i * m + j])
                    weights.append((half if math.isfinite(half) else size) if free else 0.0)
    slack = np.diag(weights)[:, np.flatnonzero(weights)]
    for method in ("highs-ipm", "highs-ds"):  # the first finds some that do have an answer infeasible
        result = linprog(
            np.concatenate([np.zeros(N * nu), np.ones(slack.shape[1])]),
            A_ub=np.hstack([rows, -slack]),
            b_ub=bounds,
            bounds=[(None, None)] * (N * nu) + [(0.0, None)] * slack.shape[1],
            method=method,
        )
        if result.status == 0:
            return float(result.fun)
    return None


@dataclass(frozen=True, kw_only=True)
class Optimum:
    """What the peer finds."""

    plan: Array  # (N, nu)
    slacks: Array  # (N, m_s)
    solution: Solution  # of `dense_qp`
    residual: float  # its largest KKT residual


def optimum(problem: Problem, given: Period) -> Optimum:
    """The exact optimum, by an active-set solver and dense matrices, or how they failed: see its solution's status."""
    qp = dense_qp(problem, given)
    backend = DaqpDense()
    backend.setup(qp)
    solution = backend.solve(qp)
    exact = polish(qp, solution) if np.isfinite(solution.x).all() else solution
    if kkt_residuals(qp, exact).worst < kkt_residuals(qp, solution).worst:
        solution = exact
    N = given.B.shape[0]
    nu = given.B.shape[2]
    return Optimum(
        plan=solution.x[: N * nu].reshape(N, nu),
        slacks=solution.x[N * nu :].reshape(N, -1),
        solution=solution,
        residual=kkt_residuals(qp, solution).worst,
    )


def _probed(function: Callable[[Array], Array], N: int, nu: int) -> tuple[Array, Array]:
    """Slopes and offset of a function that is affine in the plan."""
    offset = function(np.zeros((N, nu)))
    return (function(np.eye(N * nu).reshape(-1, N, nu)) - offset).T, offset


def _flat(numbers: Array) -> Array:
    """The last two axes as one."""
    return numbers.reshape(*numbers.shape[:-2], -1)


def _stacked(parts: list[tuple[Array, Array, Array]], inputs: int) -> tuple[Array, Array, Array]:
    """Rows and bounds of some constraints, time by time."""
    if not parts:
        return np.zeros((0, inputs)), np.zeros(0), np.zeros(0)
    slopes, lower, upper = (np.concatenate(part, axis=1) for part in zip(*parts, strict=True))
    return slopes.reshape(-1, inputs), lower.ravel(), upper.ravel()


def _root(weight: Array) -> Array:
    """R with R R' = weight."""
    sizes, directions = np.linalg.eigh(weight)
    return np.asarray(directions * np.sqrt(np.maximum(sizes, 0.0)))
