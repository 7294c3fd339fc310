"""Tables from which a problem's optimum is computed without a linear algebra library.

Axis by axis (`quadsim.mpc.solvers.core_axes`), the inputs u - u_s = T w separate into parts w without a common
cost.  For each axis:

- without rows, the optimum of a linear-quadratic problem with any linear terms is one backward pass of dynamic
programming, with gains K_i that do not depend on these terms, and one forward pass: O(N) numbers instead of the O(N^2)
of Eq.  (22). With a weight on input changes, the previous input is a further state;

- a table holds the responses G H^-1 G' of its inputs and of its rows' outputs to one another, from which the system of
an active set is assembled.

Inputs that affect neither cost nor rows are one further axis, without states.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
import scipy.linalg

from quadsim.core.mirror import constant
from quadsim.errors import ParameterError
from quadsim.mpc.forms.condensing import condensed_cost, states_rows
from quadsim.mpc.problem.constraints import Constraint, Rows
from quadsim.mpc.problem.ocp import Problem
from quadsim.mpc.problem.paper import prediction
from quadsim.mpc.solvers.core_axes import Axis, axes, axis_of, symmetric
from quadsim.state import N_STATES, Array
from quadsim.vehicle import N_ROTORS

ROW_ROUNDING: Final = 1e-13
"""Share of the largest number of a row of C_r, D, E, or T below which a number counts as rounding."""
LARGEST_RESPONSES: Final = 2**20
"""Largest total of entries of all responses that the core takes: 8 MiB."""
LEAST_QUADRATIC: Final = 1e-9
"""Share of l1 that replaces a zero quadratic penalty, for which a step length is undefined."""
MOST_STATES: Final = constant("QUADSIM_MOST_STATES")
"""Most states of an axis, including previous inputs where changes have a weight."""
MOST_STEP_ROWS: Final = 256
"""Most rows of a step, numbered in bytes."""
NO_BOUND: Final = 1e30
"""Stands for infinity."""
TINY: Final = 1e-18
"""Share of the largest response below which a response is set to zero: denormal arithmetic is slow."""


@dataclass(frozen=True, kw_only=True)
class AxisTables:
    """One axis: n states, the last m of them the previous inputs if changes have a weight, and m inputs."""

    states: list[int]  # indices of the first n states in the problem
    has_inputs_before: bool  # whether the previous inputs are states
    inputs: int  # m
    first_input: int  # index of w among the inputs of all axes
    rows: list[int]  # indices of the o rows on its states
    regulated: list[int]  # indices of its r rows of C_r
    B: Array  # (n, m)
    closed_loop: Array  # (N, n, n) A - B K_i
    K: Array  # (N, m, n) w_i = k_i - K_i x_i
    inverse: Array  # (N, m, m) (R + B' P_{i+1} B)^-1
    W: Array  # (n, r) linear term of a state's cost in y_d - C_r x_s
    W_end: Array  # (n, r) the same for the last state
    C: Array  # (o, n) its rows
    responses: Array  # (N (m + o), N (m + o)) responses of the inputs and outputs of each step to one another


@dataclass(frozen=True, kw_only=True)
class RowTables:
    """A row of each step: C x, at the end or start of the step, and terms in the inputs of the step and the one before.

    Its value is C x + sum of coefficient u_input(step - lag).
    """

    axis: int  # -1 for a row without states
    at_end: bool  # whether C x is taken at the end of the step
    terms: list[tuple[float, int, int]]  # coefficient, input, lag
    l1: float  # linear penalty; infinite for a hard row
    compliance: float  # 1 / (2 l2)


@dataclass(frozen=True, kw_only=True)
class Tables:
    """A problem as numbers."""

    problem: Problem
    axes: list[AxisTables]
    rows: list[RowTables]
    lower: Array  # (N, m); (1, m) if all steps share it
    upper: Array
    scale: Array  # (N, m) 1 / sqrt of a row's response to itself
    tolerance: Array  # (m,) the largest of these square roots
    T: Array  # (nu, nu) u - u_s = T w
    T_inverse: Array
    modes: Array  # (nu, nu) maps rotor speeds that are states to modes, one per axis


def tables(problem: Problem) -> Tables:
    """Return the tables of a problem.

    Raises:
        ParameterError: the core cannot take it: too large, rows that differ from step to step, or shared slacks.
    """
    problem = with_constraints(problem)
    N = problem.horizon
    modes = np.eye(problem.model.nu)
    if rotor_states(problem):
        modes = _modes(problem)
        problem = _in_modes(problem, modes)
    rows = problem.rows
    if rows.C.ndim == 3:
        raise ParameterError("controller", "constraints", "rows that differ from step to step", "the same at all steps")
    if rows.slacks.size < rows.soft.size:
        raise ParameterError("controller", "constraints", "soft rows that share a slack", "each with its own")
    if problem.model.nu != N_ROTORS:
        raise ParameterError("controller", "problem", f"{problem.model.nu} inputs", f"of {N_ROTORS} inputs")
    parts, T = _all_axes(problem)
    entries = 0
    for part in parts:
        channels = N * (part.T.shape[1] + part.outputs.size)
        entries += channels**2 // 2
    if entries > LARGEST_RESPONSES:
        rule = f"so short that its responses have at most {LARGEST_RESPONSES} numbers; they have {entries}"
        raise ParameterError("controller", "horizon", N, rule)
    T_inverse = np.array(np.linalg.inv(T), float)
    T_inverse[np.abs(T_inverse) < ROW_ROUNDING * np.abs(T_inverse).max()] = 0.0
    axis_tables = []
    first = 0
    for part in parts:
        axis_tables.append(_axis_tables(rows, part, first, N))
        first += part.T.shape[1]
    row_tables = [_row_tables(rows, i, axis_tables) for i in range(rows.l1.size)]
    most_states = max(len(part.B) for part in axis_tables)
    _require_at_most(MOST_STATES, most_states, "states of an axis")
    _require_at_most(MOST_STEP_ROWS, len(row_tables), "rows of a step")
    steps = slice(None)
    if (rows.lower == rows.lower[0]).all() and (rows.upper == rows.upper[0]).all():
        steps = slice(0, 1)
    scale = _row_scales(axis_tables, row_tables, T, N)
    return Tables(
        problem=problem,
        axes=axis_tables,
        rows=row_tables,
        lower=rows.lower[steps],
        upper=rows.upper[steps],
        scale=scale,
        tolerance=1.0 / scale.min(axis=0, initial=math.inf),
        T=T,
        T_inverse=T_inverse,
        modes=modes,
    )


def members(tables: Tables, *, capacity: int, changes: int) -> dict[str, Any]:
    """Return the members of a `quadsim_problem`: integers, arrays of numbers or bytes, and lists of structs' members.

    At most `capacity` rows are active at a time; a search stops after `changes` changes of the active set.
    """
    problem = tables.problem
    rows = tables.rows
    row_members = []
    terms: list[dict[str, Any]] = []
    for r, row in enumerate(rows):
        first = len(terms)
        for coefficient, j, lag in row.terms:
            terms.append({"coefficient": coefficient, "input": j, "lag": lag})
        row_members.append(_row_members(row, output=_output(tables, r), first_term=first, end_term=len(terms)))
    return {
        "horizon": problem.horizon,
        "states": problem.model.n,
        "step_rows": len(rows),
        "axis_count": len(tables.axes),
        "regulated": len(problem.objective.C_r),
        "rotor_states": rotor_states(problem),
        "capacity": capacity,
        "changes": changes,
        "bounds_differ": int(len(tables.lower) > 1),
        "mixed": int(any(row.axis >= 0 and row.terms for row in rows)),
        "modes": _reals(tables.modes),
        "T": _reals(tables.T),
        "T_inverse": _reals(tables.T_inverse),
        "scale": _reals(tables.scale),
        "tolerance": _reals(tables.tolerance),
        "C_r": _reals(problem.objective.C_r),
        "lower": _reals(np.clip(tables.lower, -NO_BOUND, NO_BOUND)),
        "upper": _reals(np.clip(tables.upper, -NO_BOUND, NO_BOUND)),
        "axes": [_axis_members(part, bounded=bool(rows)) for part in tables.axes],
        "rows": row_members,
        "terms": terms,
    }


def _output(tables: Tables, r: int) -> int:
    """Return which of its axis's rows a row is; 0 of a row without states."""
    axis = tables.rows[r].axis
    if axis < 0:
        return 0
    return tables.axes[axis].rows.index(r)


def _row_members(row: RowTables, *, output: int, first_term: int, end_term: int) -> dict[str, Any]:
    """Return the members of a `quadsim_row`, whose terms are those from `first_term` on, before `end_term`."""
    soft = math.isfinite(row.l1)
    return {
        "axis": row.axis,
        "output": output,
        "at_end": int(row.at_end),
        "first_term": first_term,
        "end_term": end_term,
        "soft": int(soft),
        "l1": row.l1 if soft else 0.0,
        "compliance": row.compliance,
    }


def _reals(values: Array) -> Array:
    """Return a copy as doubles, row by row."""
    return np.array(values, float, order="C")


def _axis_members(part: AxisTables, *, bounded: bool) -> dict[str, Any]:
    """Return the members of a `quadsim_axis`; its responses only if there are rows."""
    n, m = part.B.shape
    responses = np.zeros(0)
    if bounded:
        responses = part.responses[np.tril_indices(len(part.responses))]
        responses[np.abs(responses) < TINY * np.abs(responses).max(initial=0.0)] = 0.0
    return {
        "states": n,
        "inputs": m,
        "first_input": part.first_input,
        "outputs": len(part.rows),
        "regulated": len(part.regulated),
        "has_inputs_before": int(part.has_inputs_before),
        "state_index": np.array(part.states, np.uint8),
        "regulated_index": np.array(part.regulated, np.uint8),
        "row_index": np.array(part.rows, np.uint8),
        "B": _reals(part.B),
        "closed_loop": _reals(part.closed_loop),
        "K": _reals(part.K),
        "inverse": _reals(part.inverse),
        "W": _reals(part.W),
        "W_end": _reals(part.W_end),
        "C": _reals(part.C),
        "responses": responses,
    }


def _require_at_most(most: int, count: int, name: str) -> None:
    """Reject a problem with more of something than the core can take."""
    if count > most:
        raise ParameterError("controller", "problem", f"{count} {name}", f"such that there are at most {most}")


def with_constraints(problem: Problem) -> Problem:
    """Return a problem with at least one constraint: one that bounds nothing is added if there is none."""
    if problem.every_constraint:
        return problem
    nothing = np.full(problem.model.nu, -math.inf)
    none = Constraint(name="none", lower=nothing, upper=-nothing, D=np.eye(problem.model.nu))
    return replace(problem, constraints=(none,))


def rotor_states(problem: Problem) -> int:
    """Return how many states at the end of a problem's are rotor speeds: one per rotor where these lag, otherwise 0."""
    nu = problem.model.nu
    if problem.model.n == N_STATES + nu:
        return nu
    return 0


def _modes(problem: Problem) -> Array:
    """T^-1 of the problem without rotor lag, which separates rotor speeds that follow their inputs alike into axes."""
    model = problem.model
    objective = problem.objective
    n = N_STATES
    P = None
    if objective.P is not None:
        P = objective.P[:n, :n]
    constraints = []
    for part in problem.every_constraint:
        if part.C is None:
            constraints.append(part)
        else:
            constraints.append(replace(part, C=part.C[:, :n]))
    without_rotors = Problem(
        model=replace(model, A=model.A[:n, :n], B=model.B[:n]),
        horizon=problem.horizon,
        objective=replace(objective, C_r=objective.C_r[:, :n], P=P),
        constraints=tuple(constraints),
    )
    _, T = _all_axes(without_rotors)
    return np.array(np.linalg.inv(T), float)


def _in_modes(problem: Problem, modes: Array) -> Problem:
    """Return the problem with `modes` times the rotor speeds as its last states."""
    model = problem.model
    objective = problem.objective
    to = scipy.linalg.block_diag(np.eye(N_STATES), modes)
    back = np.linalg.inv(to)
    A = to @ model.A @ back
    B = to @ model.B
    for matrix in (A, B):
        matrix[np.abs(matrix) < ROW_ROUNDING * np.abs(matrix).max()] = 0.0
    if objective.P is None:
        P = None
    else:
        P = symmetric(back.T @ objective.P @ back)
    return Problem(
        model=replace(model, A=A, B=B),
        horizon=problem.horizon,
        objective=replace(objective, P=P),
        constraints=problem.every_constraint,
    )


def _all_axes(problem: Problem) -> tuple[list[Axis], Array]:
    """Return the axes, the last perhaps without effect, and T (nu, nu) of all of them."""
    parts = axes(problem)
    nu = problem.model.nu
    T = np.hstack([part.T for part in parts])
    T[np.abs(T) < ROW_ROUNDING] = 0.0
    missing = nu - T.shape[1]
    if missing:
        _, _, rest = np.linalg.svd((problem.objective.Q_u @ T).T)
        nothing = np.zeros(0, np.int64)
        parts.append(axis_of(problem, rest[-missing:].T, nothing, nothing, nothing))
        T = np.array(np.hstack([T, rest[-missing:].T]), float)
    return parts, T


def _axis_tables(rows: Rows, part: Axis, first: int, N: int) -> AxisTables:
    n = part.states.size
    m = part.T.shape[1]
    objective = part.problem.objective
    model = part.problem.model
    A = model.A
    B = model.B
    R = objective.Q_u
    S = np.zeros((m, n))
    C = rows.C[np.ix_(part.outputs, part.states)]
    Q, W = objective.weights
    Q_end, W_end = objective.terminal_weights
    if objective.Q_d is not None:
        A = scipy.linalg.block_diag(A, np.zeros((m, m)))
        B = np.vstack([B, np.eye(m)])
        Q = scipy.linalg.block_diag(Q, objective.Q_d)
        Q_end = scipy.linalg.block_diag(Q_end, np.zeros((m, m)))
        W = np.vstack([W, np.zeros((m, W.shape[1]))])
        W_end = np.vstack([W_end, np.zeros((m, W_end.shape[1]))])
        C = np.hstack([C, np.zeros((len(C), m))])
        R = R + objective.Q_d
        S = np.hstack([S, -objective.Q_d])
    K, inverse = _gains(A, B, Q, Q_end, R, S, N)
    maps = prediction(model, N)
    G = states_rows(rows.C[np.ix_(part.outputs, part.states)], rows.of_states[part.outputs], maps, N).of_inputs
    channels = np.concatenate([np.eye(N * m).reshape(N, m, N * m), G], axis=1).reshape(-1, N * m)
    H = condensed_cost(part.problem, maps).H
    half = scipy.linalg.solve_triangular(np.linalg.cholesky(H), channels.T, lower=True)
    return AxisTables(
        states=part.states.tolist(),
        has_inputs_before=objective.Q_d is not None,
        inputs=m,
        first_input=first,
        rows=part.outputs.tolist(),
        regulated=part.regulated.tolist(),
        B=B,
        closed_loop=A - B @ K,
        K=K,
        inverse=inverse,
        W=W,
        W_end=W_end,
        C=C,
        responses=half.T @ half,
    )


def _gains(A: Array, B: Array, Q: Array, Q_end: Array, R: Array, S: Array, N: int) -> tuple[Array, Array]:
    """K_i (N, m, n) and (R + B' P_{i+1} B)^-1 (N, m, m) of the Riccati recursion, costs x'Qx + 2 u'Sx + u'Ru."""
    K = np.zeros((N, *B.T.shape))
    inverse = np.zeros((N, *R.shape))
    P = Q_end
    for i in reversed(range(N)):
        inverse[i] = symmetric(np.array(np.linalg.inv(R + B.T @ P @ B), float))
        M = B.T @ P @ A + S
        K[i] = inverse[i] @ M
        P = symmetric(Q + A.T @ P @ A - M.T @ K[i])
    return K, inverse


def _row_tables(rows: Rows, i: int, axes: list[AxisTables]) -> RowTables:
    axis = -1
    for g, part in enumerate(axes):
        if i in part.rows:
            axis = g
            break
    terms = []
    for lag, coefficients in enumerate((rows.D[i] + rows.E[i], -rows.E[i])):
        for j in np.flatnonzero(coefficients).tolist():
            terms.append((float(coefficients[j]), j, lag))
    l1 = float(rows.l1[i])
    l2 = float(rows.l2[i])
    compliance = 0.0
    if math.isfinite(l1):
        compliance = 0.5 / max(l2, LEAST_QUADRATIC * max(l1, 1.0))
    return RowTables(axis=axis, at_end=bool(rows.of_states[i]), terms=terms, l1=l1, compliance=compliance)


def _row_scales(axes: list[AxisTables], rows: list[RowTables], T: Array, N: int) -> Array:
    """(N, m) 1 / sqrt of each row's response to itself."""
    scale = np.zeros((N, len(rows)))
    for r, row in enumerate(rows):
        total = np.zeros(N)
        for g, part in enumerate(axes):
            width = part.inputs + len(part.rows)
            entries = []
            if row.axis == g:
                entries.append((1.0, part.inputs + part.rows.index(r), 0))
            for coefficient, j, lag in row.terms:
                for a in range(part.inputs):
                    entries.append((coefficient * T[j, part.first_input + a], a, lag))
            for left, a, lag in entries:
                for right, b, other in entries:
                    first = max(lag, other)
                    at = np.arange(first, N)
                    total[first:] += left * right * part.responses[(at - lag) * width + a, (at - other) * width + b]
        scale[:, r] = np.where(total > 0.0, 1.0 / np.sqrt(np.where(total > 0.0, total, 1.0)), 0.0)
    return scale
