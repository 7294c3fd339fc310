"""Programs of the nonlinear MPC: their numbers for the core, which solves each exactly, and what its answers mean."""

from __future__ import annotations

import ctypes
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Any, Final, NamedTuple

import numpy as np

from quadsim.core.mirror import Struct, constant, set_members, struct
from quadsim.errors import ParameterError
from quadsim.mpc.laws.parts.body import MOST_BODY_STATES, ProblemStruct, body_numbers
from quadsim.mpc.problem.constraints import Constraint
from quadsim.mpc.problem.ocp import Problem
from quadsim.mpc.problem.rigidbody import P, RigidBody, V
from quadsim.mpc.solvers.core import MOST_CHANGES
from quadsim.state import Array, Indices
from quadsim.vehicle import N_ROTORS

_HARD: Final = 1e30
_CURVATURE: Final = 1e-5
"""Curvature of a price without one, about the optimum that the core iterates for, per l1."""
_OWN_SLACKS: Final = {"tilt": 0, "body_rates": 1, "space": 2}
"""Slacks of a node by the constraints that have them; those of all others follow."""
TILT_SIDES: Final = constant("QUADSIM_NMPC_SIDES")
"""Sides of the polygon within which the thrust axis stays."""
_NAMES: Final = {
    constant("QUADSIM_NMPC_INPUT"): "inputs",
    constant("QUADSIM_NMPC_TILT"): "tilt",
    constant("QUADSIM_NMPC_RATE"): "body_rates",
}
"""The constraint of a row by its kind in the core."""
_STATED: Final = constant("QUADSIM_NMPC_STATED")
_FACE: Final = constant("QUADSIM_NMPC_FACE")
_ROW_MEMBERS: Final = ctypes.sizeof(struct("quadsim_nmpc_row")) // ctypes.sizeof(ctypes.c_int)
"""Integers of a row in the core: node, kind, index, sign and slack."""
OWN_NAMES: Final = ("inputs", "tilt", "body_rates")
"""Constraints whose rows the core has by themselves."""


class SQPStatus(IntEnum):
    """The status of a program or plan, by the codes of `enum quadsim_nmpc_status`."""

    FREE = constant("QUADSIM_NMPC_FREE")
    BOUNDED = constant("QUADSIM_NMPC_BOUNDED")
    UNCONVERGED = constant("QUADSIM_NMPC_UNCONVERGED")
    INFEASIBLE = constant("QUADSIM_NMPC_INFEASIBLE")
    GIVEN_UP = constant("QUADSIM_NMPC_GIVEN_UP")
    OVER_CAPACITY = constant("QUADSIM_NMPC_OVER_CAPACITY")
    NOT_FINITE = constant("QUADSIM_NMPC_NOT_FINITE")


_TermStruct: Final = struct("quadsim_nmpc_term")


class _StatedRow(NamedTuple):
    """A row that the caller states, as the upper bound of a sum of terms."""

    terms: list[tuple[float, int, int]]  # coefficient, entry, lag
    bounds: Array  # (N,) of each node
    slack: int
    of: tuple[int, int]  # index among the problem's rows, and side: 1 upper, -1 lower


@dataclass(frozen=True, kw_only=True)
class SQPProgram:
    """The numbers of the nonlinear controller's program in the core's layout, and which of the problem's rows they are.

    Attributes:
        struct: the numbers.
        pointed: the arrays that the struct's members point to, by their names; besides these, `terms`.
        terms: of all stated rows.
        stated: rows that the core does not have by itself.
        most_rows: active rows at most.
        first: the first row of each constraint among the problem's.
        scale: (m,) of the problem's rows.
        slack_scale: what a slack variable is per unit of the constraint's, of each slack of a node.
        linear: price of each slack of a node.
        quadratic: curvature of that price.
    """

    struct: Struct
    pointed: Mapping[str, Any]
    terms: Any
    stated: Sequence[_StatedRow]
    most_rows: int
    first: Mapping[str, int]
    scale: Array
    slack_scale: Array
    linear: Array
    quadratic: Array


def nonlinear_program(
    model: RigidBody,
    problem: Problem,
    *,
    inputs: Array,
    difference: bool,
    shift: bool,
    iterations: int,
    corrections: int,
    tolerance: float,
    converged: float,
    faces: int = 0,
    price: tuple[float, float] | None = None,
) -> SQPProgram:
    """Return a problem of the nonlinear controller as the core's numbers.

    Args:
        model: the rigid body.
        problem: bounds named `inputs`, `tilt` and `body_rates`, and any others on positions, velocities and inputs.
        inputs: (2, 4) lower and upper bounds of the inputs.
        difference: whether the attitude error is q - q_r.
        shift: whether the plan moves on by a node from period to period.
        iterations: most steps in a period.
        corrections: further steps, if the plan misses the dynamics by too much.
        tolerance: change of a state or an input at which further steps end.
        converged: largest defect of a plan that has converged.
        faces: half-spaces of positions per node.
        price: l1 and l2 of leaving the largest of a node's half-spaces; None if they are hard.

    Raises:
        ParameterError: bounds that the core has once differ from step to step.
    """
    horizon = problem.horizon
    moves = problem.objective.Q_d is not None
    parts = {part.name: part for part in problem.every_constraint}
    tilt = parts.get("tilt")
    rates = parts.get("body_rates")
    prices = [_price(tilt), _price(rates), (_HARD, 1.0)]
    if price is not None:
        prices[2] = _halved(*price)
    places = N_ROTORS + 2 * (tilt is not None) + 3 * (rates is not None)
    stated, groups = _stated_rows(problem, places, prices)
    slack_scale = np.ones(len(prices))
    for slack, group in groups.items():
        slack_scale[group] = problem.rows.slack_scale[slack]
    bounds = _upper_bounds(stated, horizon)
    most_rows = horizon * (N_ROTORS + 3 * (tilt is not None) + 3 * (rates is not None) + len(stated) // 2 + faces)
    terms: list[Any] = []
    first_terms = [0]  # of each row, and the end
    has_places = faces > 0
    for row in stated:
        for coefficient, entry, lag in row.terms:
            terms.append(_TermStruct(coefficient, entry, lag))
            has_places = has_places or entry >= places
        first_terms.append(len(terms))
    struct = ProblemStruct(
        horizon=horizon,
        difference=difference,
        shifts=shift,
        moves=moves,
        tilts=tilt is not None,
        turns=rates is not None,
        places=has_places,
        rows=len(stated),
        bound_nodes=len(bounds),
        faces=faces,
        slacks=len(prices),
        capacity=min(most_rows, 6 * horizon) + 1,
        changes=MOST_CHANGES,
        iterations=iterations,
        corrections=corrections,
        tolerance=tolerance,
        converged=converged,
        move=problem.objective.move_weight[0, 0],
    )
    size = model.n + N_ROTORS * moves
    weights = np.zeros(MOST_BODY_STATES)
    terminal = np.zeros((size, size))
    weights[: model.n] = np.diag(problem.objective.weights[0])[: model.n]
    terminal[: model.n, : model.n] = problem.objective.terminal_weights[0][: model.n, : model.n]
    if moves:
        weights[model.n : size] = struct.move
    set_members(struct, weight=weights, effort=np.diag(problem.objective.Q_u), lower=inputs[0], upper=inputs[1])
    if tilt is not None:
        struct.tilt = float(tilt.upper[0])
    if rates is not None:
        set_members(struct, turn=np.minimum(rates.upper, _HARD))
    linear, quadratic = np.array(prices).T
    pointed: dict[str, Any] = {
        "left": body_numbers(model, struct),
        "terminal": terminal,
        "bounds": np.ascontiguousarray(bounds),
        "first": np.array(first_terms, np.intc),
        "slack": np.array([row.slack for row in stated], np.intc),
        "linear": np.ascontiguousarray(linear),
        "quadratic": np.ascontiguousarray(quadratic),
    }
    for name, array in pointed.items():
        setattr(struct, name, array.ctypes.data)
    all_terms = (_TermStruct * max(len(terms), 1))(*terms)
    struct.terms = ctypes.addressof(all_terms)
    return SQPProgram(
        struct=struct,
        pointed=pointed,
        terms=all_terms,
        stated=stated,
        most_rows=most_rows,
        first=_first_rows(problem),
        scale=problem.rows.scale,
        slack_scale=slack_scale,
        linear=linear,
        quadratic=np.where(quadratic > 0.0, quadratic, _CURVATURE * linear),
    )


def core_view(address: int, *shape: int, kind: Any = ctypes.c_double) -> Array:
    """Return an array of the core's at an address, which its owner keeps."""
    count = math.prod(shape)
    if not count:
        return np.zeros(shape)
    return np.ctypeslib.as_array((kind * count).from_address(address)).reshape(shape)


def multipliers(program: SQPProgram, work: Struct, rows: int, faces_from: int | None = None) -> Array:
    """(N, rows) multipliers of the problem's rows at a work's last optimum, as `qp.Solution` has their signs.

    Those of half-spaces begin at column `faces_from`.
    """
    p = program.struct
    multiplier = np.zeros((p.horizon, rows))
    of_row = core_view(work.row, p.capacity, _ROW_MEMBERS, kind=ctypes.c_int)[: work.count].tolist()
    for row, by in zip(of_row, core_view(work.multiplier, p.capacity).tolist(), strict=False):
        node, kind, index, sign, _ = row
        if kind in _NAMES:
            multiplier[node, program.first[_NAMES[kind]] + index] += sign * by
        elif kind == _STATED:
            number, side = program.stated[index].of
            multiplier[node, number] += side * by * program.scale[number]
        elif kind == _FACE and faces_from is not None:
            multiplier[node, faces_from + index] -= by
    at = program.first["inputs"]
    held = core_view(work.held, p.horizon, N_ROTORS, kind=ctypes.c_int)
    multiplier[:, at : at + N_ROTORS] -= np.where(held != 0, core_view(work.own, p.horizon, N_ROTORS), 0.0)
    return 2.0 * multiplier  # of the cost, of which the core minimises half


def _halved(l1: float, l2: float) -> tuple[float, float]:
    """Prices of half the cost: the linear one, and the curvature."""
    return 0.5 * l1, l2


def _price(part: Constraint | None) -> tuple[float, float]:
    if part is None or part.penalty is None:
        return _HARD, 1.0
    return _halved(float(part.penalty.l1[0]), float(part.penalty.l2[0]))


def _first_rows(problem: Problem) -> dict[str, int]:
    """Return the first row of each constraint among the problem's rows."""
    first: dict[str, int] = {}
    for i, name in enumerate(problem.rows.names):
        first.setdefault(name, i)
    return first


def _stated_rows(
    problem: Problem, places: int, prices: list[tuple[float, float]]
) -> tuple[list[_StatedRow], dict[int, int]]:
    """Return all rows but the bounds of inputs, tilt and body rates, and append their prices.

    Returns:
        the rows, and the place in `prices` of each of the problem's slacks that they have.

    Raises:
        ParameterError: bounds that the core has once differ from step to step.
    """
    stated: list[_StatedRow] = []
    rows = problem.rows
    entry_of_state: dict[int, int] = {}
    for state in (*range(P.start, P.stop), *range(V.start, V.stop)):
        entry_of_state[state] = places + len(entry_of_state)
    groups: dict[int, int] = {}
    for i, name in enumerate(rows.names):
        if name in OWN_NAMES:
            _require_alike(name, rows.lower[:, i], rows.upper[:, i])
            continue
        lag = 1
        if rows.of_states[i]:
            lag = 0
        terms = []
        for k in np.flatnonzero(rows.C[i]).tolist():
            terms.append((float(rows.C[i, k]), entry_of_state[k], lag))
        now = rows.D[i] + rows.E[i]
        for j in np.flatnonzero(now).tolist():
            terms.append((float(now[j]), j, 0))
        for j in np.flatnonzero(rows.E[i]).tolist():
            terms.append((-float(rows.E[i, j]), j, 1))
        slack = int(rows.slack[i])
        if slack >= 0 and slack not in groups:
            groups[slack] = len(prices)
            prices.append(_halved(float(rows.l1[i]), float(rows.l2[i])))
        for side, bounds in ((1, rows.upper[:, i]), (-1, rows.lower[:, i])):
            if np.isfinite(bounds).any():
                signed = [(side * by, entry, lag) for by, entry, lag in terms]
                of = (i, side)
                stated.append(_StatedRow(signed, side * bounds, groups.get(slack, -1), of))
    return stated, groups


def _require_alike(name: str, lower: Array, upper: Array) -> None:
    """Reject bounds (N,) that differ from step to step, where the core has one number for all."""
    for side in (lower, upper):
        if (side != side[0]).any():
            raise ParameterError("controller", name, side.tolist(), "the same at all steps of the nonlinear MPC")


def _upper_bounds(rows: list[_StatedRow], horizon: int) -> Array:
    """Return the upper bounds of rows in the first nodes (nodes, rows), of which the last holds in all that follow."""
    bounds = np.full((horizon, len(rows)), _HARD)
    for k, row in enumerate(rows):
        bounds[:, k] = np.minimum(row.bounds, _HARD)
    differing = np.flatnonzero((bounds != bounds[-1]).any(axis=1))
    last = 0
    if differing.size:
        last = differing[-1] + 1
    return bounds[: last + 1]


def slack_groups(problem: Problem, *, faces: bool = False) -> Indices:
    """Return which slack of a node each of the problem's slacks is, and last that of `faces`, which have one."""
    rows = problem.rows
    groups = dict[int, int]()
    count = len(_OWN_SLACKS)
    for i, name in enumerate(rows.names):
        slack = int(rows.slack[i])
        if slack < 0 or slack in groups:
            continue
        if name in _OWN_SLACKS:
            groups[slack] = _OWN_SLACKS[name]
        else:
            groups[slack] = count
            count = count + 1
    ordered = [groups[slack] for slack in range(len(groups))]
    if faces:
        ordered.append(_OWN_SLACKS["space"])
    return np.array(ordered, int)
