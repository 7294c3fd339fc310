"""The exact optimum of a problem whose matrices are fixed, by the compiled core."""

from __future__ import annotations

import ctypes
import math
import time as clock
from dataclasses import dataclass, field, fields, is_dataclass
from functools import cache, cached_property, lru_cache, partial
from typing import Final, Generic, NoReturn, TypeVar

import numpy as np

from mpc.condensing import Condensed
from mpc.core.library import check_mirrors, load
from mpc.core.tables import Tables, tables
from mpc.ocp import Problem, Query
from mpc.qp import QP, Solution
from mpc.solvers import Answer, Method, QPSolver
from quadsim.controller import CORE, GAIN, SOLVED, UNCONSTRAINED
from quadsim.errors import ParameterError
from quadsim.state import N_STATES, Array, read_only
from quadsim.vehicle import N_ROTORS

MOST_STATES: Final = 20
"""Of an axis, with the inputs before where changes cost something; as in quadsim_core.h."""
MOST_ROWS: Final = 256
"""Rows of a step, which are numbered in bytes."""
MOST_CHANGES: Final = 3000
"""Of the active set in a search, before it is given up; the most seen is 2507, of a state drawn far off."""
PROBLEMS: Final = 16
"""Whose tables are kept, those used last, for the controllers to come."""
WAYS: Final = (Method.FREE, Method.AXES, Method.WHOLE)
"""By `enum quadsim_found`; beyond these there is no optimum."""

NO_BOUND: Final = 1e30
"""In place of infinity."""
TINY: Final = 1e-18
"""Share of the largest response below which one is taken for zero: arithmetic on the least numbers is slow."""

_INT, _REAL, _AT = ctypes.c_int, ctypes.c_double, ctypes.c_void_p


def _members(kind: type, names: str) -> list[tuple[str, type]]:
    return [(name, kind) for name in names.split()]


class _Axis(ctypes.Structure):
    _fields_ = [
        *_members(_INT, "states inputs first outputs targets before"),
        *_members(_AT, "state target row B closed K inverse W W_end C responses"),
    ]


class _Row(ctypes.Structure):
    _fields_ = [*_members(_INT, "axis output later first past soft"), *_members(_REAL, "l1 compliance")]


class _Term(ctypes.Structure):
    _fields_ = [*_members(_REAL, "coefficient"), *_members(_INT, "input lag")]


class _Problem(ctypes.Structure):
    _fields_ = [
        *_members(_INT, "horizon states step_rows parts regulated room changes bounds_differ mixed"),
        *_members(_AT, "axes rows terms T T_inverse lower upper scale tolerance"),
    ]


class Work(ctypes.Structure):
    """A `quadsim_work`."""

    _fields_ = [
        *(*_members(_AT, "p"), *_members(_INT, "changes refused")),
        *_members(_AT, "plan multiplier value shift last side start"),
        ("axes", _REAL * N_ROTORS),
        *(*_members(_AT, "w dw u pull push"), *_members(_INT, "count spent solved passed_over")),
        *(*_members(_REAL, "slack largest"), *_members(_AT, "row z goal forward pivot column sums factor")),
    ]


@cache
def core_library() -> ctypes.CDLL:
    """The library, its functions declared.

    Raises:
        MissingCoreError: there is none here.
    """
    library = load()
    check_mirrors(quadsim_axis=_Axis, quadsim_row=_Row, quadsim_term=_Term, quadsim_problem=_Problem, quadsim_work=Work)
    library.quadsim_work_reals.restype, library.quadsim_work_reals.argtypes = ctypes.c_long, [_AT]
    library.quadsim_work_start.argtypes = [_AT, _AT, _AT]
    library.quadsim_work_reset.argtypes = [_AT]
    library.quadsim_optimise.argtypes = [_AT] * 6
    return library


class CoreProblem:
    """A problem's tables where the core reads them; any number of controllers may share them.

    Raises:
        ParameterError: the problem is not one for the core.

    Attributes:
        tables: the numbers.
        struct: the `quadsim_problem`, which points to memory that this object holds.
    """

    def __init__(self, problem: Problem) -> None:
        _refuse_shared_slacks(problem)
        self._problem, self.tables = problem, tables(problem)
        self._kept: list[object] = []
        found, N = self.tables, problem.horizon
        _refuse_large(found)
        axes = (_Axis * len(found.axes))()
        for axis, part in zip(axes, found.axes, strict=True):
            axis.states, axis.inputs, axis.first, axis.outputs = *part.B.shape, part.first, len(part.rows)
            axis.targets, axis.before = len(part.regulated), part.before
            axis.state, axis.target, axis.row = map(self._bytes, (part.states, part.regulated, part.rows))
            axis.B, axis.closed, axis.K, axis.inverse = map(self._reals, (part.B, part.closed, part.K, part.inverse))
            axis.W, axis.W_end, axis.C = map(self._reals, (part.W, part.W_end, part.C))
            responses = part.responses[np.tril_indices(len(part.responses))]
            tiny = np.abs(responses) < TINY * np.abs(responses).max(initial=0.0)
            axis.responses = self._reals(np.where(tiny, 0.0, responses))
        rows, terms = (_Row * len(found.rows))(), list[_Term]()
        for i, (row, kind) in enumerate(zip(rows, found.rows, strict=True)):
            row.axis, row.later, row.first, row.past = kind.axis, kind.later, len(terms), len(terms) + len(kind.terms)
            row.output = found.axes[kind.axis].rows.index(i) if kind.axis >= 0 else 0
            row.soft = math.isfinite(kind.l1)
            row.l1, row.compliance = kind.l1 if row.soft else 0.0, kind.compliance
            terms += [_Term(*term) for term in kind.terms]
        all_terms = (_Term * len(terms))(*terms)
        self._kept += [axes, rows, all_terms]
        # Hard rows that are independent are no more than inputs; soft ones beyond their bounds may add their number.
        at_most = N * (N_ROTORS + sum(row.soft for row in rows))
        self.struct = _Problem(
            horizon=N,
            states=problem.model.n,
            step_rows=len(rows),
            parts=len(axes),
            regulated=len(problem.objective.C_r),
            room=min(N * len(rows), at_most) + 1,
            changes=MOST_CHANGES,
            bounds_differ=len(found.lower) > 1,
            mixed=any(row.axis >= 0 and row.terms for row in found.rows),
            axes=ctypes.addressof(axes),
            rows=ctypes.addressof(rows),
            terms=ctypes.addressof(all_terms),
            T=self._reals(found.T),
            T_inverse=self._reals(found.T_inverse),
            lower=self._reals(np.clip(found.lower, -NO_BOUND, NO_BOUND)),
            upper=self._reals(np.clip(found.upper, -NO_BOUND, NO_BOUND)),
            scale=self._reals(found.scale),
            tolerance=self._reals(found.tolerance),
        )

    @cached_property
    def condensed(self) -> Condensed:
        """The QP that the optimum's KKT residuals are of."""
        return Condensed(self._problem)

    def _reals(self, values: Array) -> int:
        kept = np.array(values if np.size(values) else [0.0], np.float64, order="C")
        self._kept.append(kept)
        return kept.ctypes.data

    def _bytes(self, values: list[int]) -> int:
        kept = np.array(values or [0], np.uint8)
        self._kept.append(kept)
        return kept.ctypes.data


def _refuse_shared_slacks(problem: Problem) -> None:
    if problem.every_constraint and problem.rows.slacks.size < problem.rows.soft.size:
        raise ParameterError("controller", "constraints", "soft rows that share a slack", "each with its own")


def _refuse_large(found: Tables) -> None:
    """Refuse what has no place in the core's arrays."""
    if found.problem.model.nu != N_ROTORS:
        raise ParameterError("controller", "problem", f"{found.problem.model.nu} inputs", f"of {N_ROTORS} inputs")
    for name, count, most in (
        ("states of an axis", max(len(part.B) for part in found.axes), MOST_STATES),
        ("rows of a step", len(found.rows), MOST_ROWS),
    ):
        if count > most:
            raise ParameterError("controller", "problem", f"{count} {name}", f"such that there are at most {most}")


Made = TypeVar("Made")


@dataclass(frozen=True)
class Key(Generic[Made]):
    """Something made of dataclasses, by what it consists of."""

    content: object
    of: Made = field(compare=False)

    @classmethod
    def to(cls, value: Made) -> Key[Made]:
        """The key of a value."""
        return cls(_content(value), value)


def _content(value: object) -> object:
    if isinstance(value, np.ndarray):
        return value.shape, value.tobytes()
    if is_dataclass(value):
        return tuple(_content(getattr(value, each.name)) for each in fields(value))
    return tuple(map(_content, value)) if isinstance(value, tuple) else value


def core_problem(problem: Problem) -> CoreProblem:
    """A problem's tables, which equal problems of this process share.

    Raises:
        ParameterError: the problem is not one for the core.
    """
    return _core_problem(Key.to(problem))


@lru_cache(PROBLEMS)
def _core_problem(key: Key[Problem]) -> CoreProblem:
    return CoreProblem(key.of)


class Core:
    """Finds a problem's optimum by the compiled core; see `mpc.solvers.Solver`.

    The search starts from the last optimum's active set, moved one step earlier.  What the core gives up, or finds
    infeasible, PIQP answers, and is named for it.

    Raises:
        MissingCoreError: there is no library.
        ParameterError: the problem is not one for the core.
    """

    name: Final = CORE

    def __init__(self, problem: Problem) -> None:
        self._library, self._shared = core_library(), core_problem(problem)
        self.formulation = self._shared.condensed
        self._problem, self._equilibrium, self._C_r = problem, problem.equilibrium, problem.objective.C_r
        self._modes = self._shared.tables.modes if problem.model.n > N_STATES else None
        self._piqp: QPSolver | None = None
        p, rows = self._shared.struct, problem.rows
        self._upper, self._lower, self._soft = rows.upper, rows.lower, rows.soft
        self._no_slacks, self._no_multipliers = (
            read_only(np.zeros((problem.horizon, count))) for count in (rows.soft.size, len(rows.D))
        )
        # The work points into this memory, and so do the views of it.
        self._memory = np.zeros(self._library.quadsim_work_reals(ctypes.addressof(p)))
        self._work = Work()
        self._at = ctypes.addressof(self._work)
        self._library.quadsim_work_start(self._at, ctypes.addressof(p), self._memory.ctypes.data)
        self._plan = self._view(self._work.plan, _REAL, N_ROTORS)
        self._multiplier, self._value, self._shift = (
            self._view(at, _REAL, p.step_rows) for at in (self._work.multiplier, self._work.value, self._work.shift)
        )
        self._side = self._view(self._work.last, ctypes.c_int8, p.step_rows)
        sizes = p.states, p.horizon * p.regulated, p.states, N_ROTORS, N_ROTORS
        self._given = np.zeros(sum(sizes))
        parts = np.split(self._given, np.cumsum(sizes[:-1]))
        self._state, wanted, self._x_s, self._u_s, self._before = parts
        self._wanted = wanted.reshape(p.horizon, -1)
        self._arguments = self._at, *(part.ctypes.data for part in parts)

    def _view(self, address: int, kind: type[ctypes.c_double | ctypes.c_int8], columns: int) -> Array:
        shape = self._problem.horizon, columns
        return np.ctypeslib.as_array((kind * math.prod(shape)).from_address(address)).reshape(shape)

    def __reduce__(self) -> NoReturn:
        """Addresses are of no use to a copy, or in another process."""
        raise TypeError("a Core cannot be copied or pickled: make another from its problem")

    def reset(self) -> None:
        """See `mpc.solvers.Solver.reset`."""
        self._library.quadsim_work_reset(self._at)
        if self._piqp is not None:
            self._piqp.reset()

    def solve(self, query: Query) -> Answer:
        """See `mpc.solvers.Solver.solve`."""
        started, (state, desired, u_before, rest, _) = clock.perf_counter(), query
        x_s, u_s = self._equilibrium if rest is None else rest
        self._state[:], self._x_s[:], self._u_s[:], self._before[:] = state, x_s, u_s, u_before
        np.subtract(desired, 0.0 if rest is None else self._C_r @ x_s, out=self._wanted)
        if self._modes is not None:
            for speeds in (self._state[N_STATES:], self._x_s[N_STATES:]):
                speeds[:] = self._modes @ speeds
        way = self._library.quadsim_optimise(*self._arguments) if math.isfinite(self._given.sum()) else len(WAYS)
        if way >= len(WAYS):
            return self._by_piqp(query, started)
        plan, slacks, multipliers, active = self._plan.copy(), self._no_slacks, self._no_multipliers, 0
        if way:
            multipliers, active = self._multiplier.copy(), int(np.count_nonzero(self._side))
            if slacks.size and np.count_nonzero(violated := np.abs(self._side) == 2):
                values = self._value + self._shift
                beyond = np.maximum(np.maximum(values - self._upper, self._lower - values), 0.0)
                slacks = (violated * beyond)[:, self._soft]
        return Answer(
            plan,
            slacks,
            SOLVED if way else UNCONSTRAINED,
            CORE if way else GAIN,
            iterations=self._work.changes,
            active=active,
            method=WAYS[way],
            certificate=partial(self._certificate, query, plan, slacks, multipliers),
            solve_s=clock.perf_counter() - started,
        )

    def _certificate(self, query: Query, plan: Array, slacks: Array, multipliers: Array) -> tuple[QP, Solution]:
        """The condensed QP of a query, and the solution that a plan is of it."""
        return self.formulation.pose(query).qp, self.formulation.solution(plan, slacks, multipliers)

    def _by_piqp(self, query: Query, started: float) -> Answer:
        if self._piqp is None:
            self._piqp = QPSolver("piqp-multistage", self._problem)
        spent_s = clock.perf_counter() - started
        answer = self._piqp.solve(query)
        return answer._replace(solve_s=spent_s + answer.solve_s)
