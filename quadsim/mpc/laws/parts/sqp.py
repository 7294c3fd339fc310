"""Sequential quadratic programming of the nonlinear law, in C: one program after another, each solved exactly."""

from __future__ import annotations

import ctypes
import math
import time
from collections.abc import Callable, Sequence
from enum import IntEnum
from typing import Any, Final, NamedTuple, NoReturn

import numpy as np

from quadsim.core.mirror import Struct, constant, core_library, set_members, struct
from quadsim.errors import ParameterError
from quadsim.mpc.laws.parts.body import STATES_ROOM, ProblemStruct, World, body_numbers, unpacked, width_of
from quadsim.mpc.problem.constraints import Constraint
from quadsim.mpc.problem.ocp import Problem
from quadsim.mpc.problem.rigidbody import N_BODY, P, RigidBody, V
from quadsim.state import Array, Indices
from quadsim.vehicle import N_ROTORS

_MOST_CHANGES: Final = 3000
"""Limit of active-set changes in a search."""
_HARD: Final = 1e30
_CURVATURE: Final = 1e-5
"""Curvature of a price without one, about the optimum that the core iterates for, per l1."""
_OWN_SLACKS: Final = {"tilt": 0, "body_rates": 1, "space": 2}
"""Slacks of a node by the constraints that have them; those of all others follow."""
_NAMES: Final = {
    constant("QUADSIM_NMPC_INPUT"): "inputs",
    constant("QUADSIM_NMPC_TILT"): "tilt",
    constant("QUADSIM_NMPC_RATE"): "body_rates",
}
"""The constraint of a row by its kind in the core."""
_STATED: Final = constant("QUADSIM_NMPC_STATED")
_FACE: Final = constant("QUADSIM_NMPC_FACE")
_ROW_MEMBERS: Final = 5
"""Integers of a row in the core: node, kind, index, sign and slack."""
OWN_NAMES: Final = ("inputs", "tilt", "body_rates")
"""Constraints whose rows the core has by themselves."""


class SQPStatus(IntEnum):
    """The status of a program or plan, by the codes of `enum quadsim_nmpc_status`."""

    FREE = 0
    BOUNDED = 1
    UNCONVERGED = 2
    INFEASIBLE = 3
    GIVEN_UP = 4
    NO_ROOM = 5
    NOT_FINITE = 6


_TermStruct: Final = struct("quadsim_nmpc_term")
_WorkStruct: Final = struct("quadsim_nmpc_work")


class _StatedRow(NamedTuple):
    """A row that the caller states, as the upper bound of a sum of terms."""

    terms: list[tuple[float, int, int]]  # coefficient, entry, lag
    bounds: Array  # (N,) of each node
    slack: int
    of: tuple[int, int]  # index among the problem's rows, and side: 1 upper, -1 lower


class SQP:
    """A program of the nonlinear law, with the plan and the active set that it remembers.

    Args:
        model: the rigid body; `set_world` changes its disturbance and drag.
        problem: the program: bounds named `inputs`, `tilt` and `body_rates`, and any others on positions, velocities
            and inputs.
        inputs: (2, 4) lower and upper bounds of the inputs.
        difference: whether the attitude error is q - q_r.
        shift: whether the plan moves on by a node from period to period.
        iterations: most steps in a period.
        corrections: further steps, if the plan misses the dynamics by too much.
        tolerance: change of a state or an input at which further steps end.
        time_limit: time since `begin` after which no further step is taken [s]; None for none.
        faces: half-spaces of positions per node.
        price: l1 and l2 of leaving the largest of a node's half-spaces; None if they are hard.

    Attributes:
        most_rows: active rows at most.
        struct: the program's numbers in the core's layout.
        pointed: the arrays that the struct's members point to, by their names; besides these, `terms`.
        clock: returns the time [s].
    """

    def __init__(
        self,
        model: RigidBody,
        problem: Problem,
        *,
        inputs: Array,
        difference: bool,
        shift: bool,
        iterations: int,
        corrections: int,
        tolerance: float,
        time_limit: float | None = None,
        faces: int = 0,
        price: tuple[float, float] | None = None,
    ) -> None:
        self._library, self._n, self.horizon = core_library(), model.n, problem.horizon
        self.clock: Callable[[], float] = time.perf_counter
        self._time_limit, self._deadline = time_limit, math.inf
        self.pointed: dict[str, Array] = {}
        moves = problem.objective.Q_d is not None
        parts = {part.name: part for part in problem.every_constraint}
        tilt, rates = parts.get("tilt"), parts.get("body_rates")
        prices = [_price(tilt), _price(rates), (_HARD, 1.0) if price is None else _halved(*price)]
        places = N_ROTORS + 2 * (tilt is not None) + 3 * (rates is not None)
        rows, groups = _stated(problem, places, prices)
        self._rows, self._numbers, self._scale = rows, _numbers(problem), problem.rows.scale
        self._slack_scale = np.ones(len(prices))
        for slack, group in groups.items():
            self._slack_scale[group] = problem.rows.slack_scale[slack]
        bounds = _bounds(rows, self.horizon)
        self.most_rows = self.horizon * (
            N_ROTORS + 3 * (tilt is not None) + 3 * (rates is not None) + len(rows) // 2 + faces
        )
        p = ProblemStruct(
            horizon=self.horizon,
            difference=difference,
            shifts=shift,
            moves=moves,
            tilts=tilt is not None,
            turns=rates is not None,
            places=bool(faces) or any(entry >= places for row in rows for _, entry, _ in row.terms),
            rows=len(rows),
            bound_nodes=len(bounds),
            faces=faces,
            slacks=len(prices),
            room=min(self.most_rows, 6 * self.horizon) + 1,
            changes=_MOST_CHANGES,
            iterations=iterations,
            corrections=corrections,
            tolerance=tolerance,
            move=problem.objective.move_weight[0, 0],
        )
        size = model.n + N_ROTORS * moves
        weights, terminal = np.zeros(STATES_ROOM), np.zeros((size, size))
        Q, end = problem.objective.weights[0], problem.objective.terminal_weights[0]
        weights[: model.n] = np.diag(Q)[: model.n]
        terminal[: model.n, : model.n] = end[: model.n, : model.n]
        if moves:
            weights[model.n : size] = p.move
        set_members(p, weight=weights, effort=np.diag(problem.objective.Q_u), lower=inputs[0], upper=inputs[1])
        if tilt is not None:
            p.tilt = float(tilt.upper[0])
        if rates is not None:
            set_members(p, turn=np.minimum(rates.upper, _HARD))
        terms = [term for row in rows for term in row.terms]
        first = np.cumsum([0, *(len(row.terms) for row in rows)])
        linear, quadratic = np.array(prices).T
        self._prices = linear, np.where(quadratic > 0.0, quadratic, _CURVATURE * linear)
        self.pointed["left"], p.terminal = body_numbers(model, p), self._array("terminal", terminal)
        self.terms = (_TermStruct * max(len(terms), 1))(*(_TermStruct(*term) for term in terms))
        p.terms, p.bounds = ctypes.addressof(self.terms), self._array("bounds", bounds)
        p.first = self._array("first", first, np.intc)
        p.slack = self._array("slack", [row.slack for row in rows], np.intc)
        p.linear, p.quadratic = self._array("linear", linear), self._array("quadratic", quadratic)
        self.struct, self._world = p, World.of(model)
        self._make_work()

    def resize(self, room: int, changes: int) -> None:
        """Make room for so many active rows, and allow so many changes of the active set, in memory of its own."""
        self.struct.room, self.struct.changes = room, changes
        self._make_work()

    def _make_work(self) -> None:
        p, library, N, work = self.struct, self._library, self.horizon, _WorkStruct()
        self._memory = np.zeros(library.quadsim_nmpc_reals(p)), np.zeros(library.quadsim_nmpc_ints(p), np.intc)
        library.quadsim_nmpc_start(work, p, *(part.ctypes.data for part in self._memory))
        arrays = (np.zeros(self._n), np.zeros(N_ROTORS), np.zeros((N + 1, N_BODY)), np.zeros((N, N_ROTORS)))
        self.bind(work, self._world, arrays)

    def bind(self, work: Struct, world: World, arrays: tuple[Array, Array, Array, Array]) -> None:
        """Use another work of the same problem, another world and other arrays for the arguments of `step`."""
        p, N = self.struct, self.horizon
        self._work, self._world, self._asked, self._status = work, world, arrays, ctypes.c_int()
        self._size = self._n + N_ROTORS * bool(p.moves)
        self._x, self._u = self._view("x", N + 1, self._size), self._view("u", N, N_ROTORS)
        self._s, self._v = self._view("s", N + 1, self._size), self._view("v", N, N_ROTORS)
        self.goal, self.aim = self._view("goal", N + 1, self._size)[:, : self._n], self._view("aim", N, N_ROTORS)
        self._face, self._beyond = self._view("face", N, p.faces, 3), self._view("beyond", N, p.faces)
        self._origin = self._view("origin", N, p.slacks)
        self._price, self._own = self._view("price", N, p.slacks), self._view("own", N, N_ROTORS)
        self._multiplier = self._view("multiplier", p.room)
        self._row = self._view("row", p.room, _ROW_MEMBERS, kind=ctypes.c_int)
        self._free = self._view("free", N, p.slacks, kind=ctypes.c_int)
        self._held = self._view("held", N, N_ROTORS, kind=ctypes.c_int)
        self._measured, self._before = arrays[:2]
        self._arguments = work, world.struct, *(array.ctypes.data for array in arrays)

    def __reduce__(self) -> NoReturn:
        """Refuse: addresses are useless in a copy or another process."""
        raise TypeError("an SQP cannot be copied or pickled: make another from its problem")

    def _array(self, name: str, values: Array | Sequence[object], kind: type = np.double) -> int:
        array = self.pointed[name] = np.ascontiguousarray(values, kind)
        return array.ctypes.data

    def _view(self, name: str, *shape: int, kind: Any = ctypes.c_double) -> Array:
        count = math.prod(shape)
        if not count:
            return np.zeros(shape)
        return np.ctypeslib.as_array((kind * count).from_address(getattr(self._work, name))).reshape(shape)

    def set_world(self, model: RigidBody) -> None:
        """Predict with the disturbance, drag and thrust scale of a model from now on."""
        self._world.set(model)

    def reset(self) -> None:
        """Forget the plan and the active set."""
        self._library.quadsim_nmpc_reset(self._work)

    @property
    def plan(self) -> tuple[Array, Array] | None:
        """States (N + 1, n) and inputs (N, 4) of the plan; None without one."""
        if not self._work.planned:
            return None
        return self._x[:, : self._n].copy(), self._u.copy()

    @plan.setter
    def plan(self, plan: tuple[Array, Array] | None) -> None:
        self._work.planned = int(plan is not None)
        if plan is None:
            self.reset()
            return
        self._x[:, : self._n], self._u[:] = plan
        if self._size > self._n:
            self._x[0, self._n :], self._x[1:, self._n :] = self._before, self._u

    def step(self, *asked: Array) -> SQPStatus:
        """Plan from a measured state (n,) after the inputs `before` (4,), along a reference; see `begin`."""
        if self._time_limit is None:
            self._ask(asked)
            return SQPStatus(self._library.quadsim_nmpc_step(*self._arguments))
        on, status = self.begin(*asked), SQPStatus.NOT_FINITE
        while on:
            self.linearise()
            status, on = self.keep(self.solve())
        return status

    def begin(self, *asked: Array) -> bool:
        """Take a measured state (n,), the inputs `before` (4,) and a reference; False if numbers are not finite.

        Args:
            asked: position, quaternion, velocity, body rates and actuators (n,) as measured; inputs in force (4,);
                reference states (N + 1, 13), and thrusts of the rotors that hold them (N, 4) [N]; none: what the
                arrays that it is bound to contain.
        """
        self._ask(asked)
        if self._time_limit is not None:
            self._deadline = self.clock() + self._time_limit
        return bool(self._library.quadsim_nmpc_begin(*self._arguments))

    def _ask(self, asked: tuple[Array, ...]) -> None:
        for array, value in zip(self._asked, asked, strict=False):
            array[:] = value

    def linearise(self) -> None:
        """Make the program of the stored plan."""
        self._library.quadsim_nmpc_linearise(self._work, self._world.struct)

    def solve(self) -> SQPStatus:
        """Return the status of the program's optimum."""
        return SQPStatus(self._library.quadsim_nmpc_solve(self._work))

    def keep(self, status: SQPStatus) -> tuple[SQPStatus, bool]:
        """Keep the optimum as the plan; return the plan's status, and whether another step should follow."""
        self._status.value = status
        self._work.ends = self._time_limit is not None and self.clock() >= self._deadline
        on = self._library.quadsim_nmpc_keep(self._work, self._world.struct, ctypes.byref(self._status))
        return SQPStatus(self._status.value), bool(on)

    @property
    def half_spaces(self) -> tuple[Array, Array]:
        """Normals (S, N, 3) and bounds (S, N) of normal . p >= bound, for positions, from the next `solve` on."""
        return np.asarray(-self._face.transpose(1, 0, 2)), np.asarray(-self._beyond.T)

    @half_spaces.setter
    def half_spaces(self, half_spaces: tuple[Array, Array]) -> None:
        normals, bounds = half_spaces
        self._face[:], self._beyond[:] = -normals.transpose(1, 0, 2), -bounds.T

    @property
    def planned_positions(self) -> Array:
        """(N, 3) positions of the stored plan at the ends of its nodes [m]."""
        return np.array(self._x[1:, P])

    @property
    def positions(self) -> Array:
        """(N, 3) positions of the last optimum [m]."""
        return np.array(self._s[1:, P])

    @property
    def inputs(self) -> Array:
        """(N, 4) inputs of the last optimum."""
        return np.array(self._v)

    @property
    def optimum(self) -> Array:
        """(N, n) states of the last optimum, quaternions in the nodes' frames."""
        return np.array(self._s[1:, : self._n])

    @property
    def start(self) -> Array:
        """(n,) the measured state, its quaternion in the first frame."""
        return np.array(self._work.start[: self._n])

    @property
    def measured(self) -> Array:
        """(n,) the measured state."""
        return self._measured.copy()

    @property
    def before(self) -> Array:
        """(4,) the inputs in force."""
        return self._before.copy()

    @property
    def active(self) -> int:
        """Number of active rows at the last optimum."""
        return int(self._work.count + np.count_nonzero(self._held))

    @property
    def iterations(self) -> int:
        """Changes of the active set and recursions of the last program."""
        return int(self._work.changes + self._work.rounds + self._work.inner)

    @property
    def defect(self) -> float:
        """By how much the plan misses the dynamics."""
        return float(self._work.defect)

    @property
    def moved(self) -> float:
        """Largest change of a state or an input in the last step."""
        return float(self._work.moved)

    def slacks(self, groups: Indices) -> Array:
        """(N, m) slacks of the last optimum, of chosen groups, in the constraints' units."""
        linear, quadratic = self._prices
        normalised = self._free * (self._origin + (self._price - linear) / quadratic)
        return np.array((normalised / self._slack_scale)[:, groups])

    def multipliers(self, rows: int, faces_from: int | None = None) -> Array:
        """(N, rows) multipliers of the problem's rows at the last optimum, as `qp.Solution` has their signs.

        Those of half-spaces begin at column `faces_from`.
        """
        found = np.zeros((self.horizon, rows))
        starts = self._numbers
        for row, by in zip(self._row[: self._work.count].tolist(), self._multiplier.tolist(), strict=False):
            node, kind, index, sign, _ = row
            if kind in _NAMES:
                found[node, starts[_NAMES[kind]] + index] += sign * by
            elif kind == _STATED:
                number, side = self._rows[index].of
                found[node, number] += side * by * self._scale[number]
            elif kind == _FACE and faces_from is not None:
                found[node, faces_from + index] -= by
        at = starts["inputs"]
        found[:, at : at + N_ROTORS] -= np.where(self._held != 0, self._own, 0.0)
        return 2.0 * found  # of the cost, of which the core minimises half

    def steps(self) -> tuple[Array, Array, Array]:
        """A (N, n, n), B (N, n, 4), c (N, n) of the program; under `tilt`, the thrust axis is two further states."""
        p, N, n = self.struct, self.horizon, self._n
        maps, offset = self._view("map", N, N_BODY, width_of(self._size)), self._view("offset", N, self._size)
        A, B = unpacked(maps, n, self._size - n, self.pointed["left"][-1])
        c = np.array(offset[:, :n])
        if p.tilts:
            axis, known = self._view("axis", N, 2, 4), self._view("known", N, 2)
            A = np.pad(np.concatenate([A, axis @ A[:, 3:7]], axis=1), ((0, 0), (0, 0), (0, 2)))
            B = np.concatenate([B, axis @ B[:, 3:7]], axis=1)
            c = np.concatenate([c, (axis @ c[:, 3:7, None])[:, :, 0] + known], axis=1)
        return A, B, c


def _halved(l1: float, l2: float) -> tuple[float, float]:
    """Prices of half the cost: the linear one, and the curvature."""
    return 0.5 * l1, l2


def _price(part: Constraint | None) -> tuple[float, float]:
    if part is None or part.penalty is None:
        return _HARD, 1.0
    return _halved(float(part.penalty.l1[0]), float(part.penalty.l2[0]))


def _numbers(problem: Problem) -> dict[str, int]:
    """Return the first row of each constraint among the problem's rows."""
    names = problem.rows.names
    return {name: names.index(name) for name in dict.fromkeys(names)}


def _stated(
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
    states = {at: places + k for k, at in enumerate([*range(P.start, P.stop), *range(V.start, V.stop)])}
    groups: dict[int, int] = {}
    for i, name in enumerate(rows.names):
        if name in OWN_NAMES:
            _require_alike(name, rows.lower[:, i], rows.upper[:, i])
            continue
        lag = 0 if rows.of_states[i] else 1
        terms = [(float(rows.C[i, k]), states[int(k)], lag) for k in np.flatnonzero(rows.C[i])]
        terms += [(float(rows.D[i, j] + rows.E[i, j]), int(j), 0) for j in np.flatnonzero(rows.D[i] + rows.E[i])]
        terms += [(-float(rows.E[i, j]), int(j), 1) for j in np.flatnonzero(rows.E[i])]
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
            raise ParameterError("controller", name, side.tolist(), "the same at all steps of the nonlinear law")


def _bounds(rows: list[_StatedRow], horizon: int) -> Array:
    """Return the upper bounds of rows in the first nodes (nodes, rows), of which the last holds in all that follow."""
    bounds = np.full((horizon, len(rows)), _HARD)
    for k, row in enumerate(rows):
        bounds[:, k] = np.minimum(row.bounds, _HARD)
    differing = np.flatnonzero((bounds != bounds[-1]).any(axis=1))
    last = differing[-1] + 1 if differing.size else 0
    return bounds[: last + 1]


def slack_groups(problem: Problem, *, faces: bool = False) -> Indices:
    """Return which slack of a node each of the problem's slacks is, and last that of `faces`, which have one."""
    rows, groups, count = problem.rows, dict[int, int](), len(_OWN_SLACKS)
    for i, name in enumerate(rows.names):
        slack = int(rows.slack[i])
        if slack < 0 or slack in groups:
            continue
        if name in _OWN_SLACKS:
            groups[slack] = _OWN_SLACKS[name]
        else:
            groups[slack], count = count, count + 1
    return np.array([groups[slack] for slack in range(len(groups))] + [_OWN_SLACKS["space"]] * faces, int)
