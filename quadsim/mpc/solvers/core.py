"""The exact optimum of a problem with constant matrices, by the compiled core."""

from __future__ import annotations

import ctypes
import math
import time as clock
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, is_dataclass
from functools import cached_property, lru_cache, partial
from typing import Any, Final, Generic, NoReturn, TypeVar

import numpy as np

from quadsim.controller import CORE, GAIN, SOLVED, UNCONSTRAINED, Statistics
from quadsim.core.mirror import Struct, core_library, struct
from quadsim.mpc.forms.condensing import Condensed
from quadsim.mpc.problem.ocp import Problem, Query
from quadsim.mpc.problem.qp import QP, Solution
from quadsim.mpc.solvers import CORES_SECOND, Answer, Method, QPSolver
from quadsim.mpc.solvers.core_tables import members, tables
from quadsim.state import Array, read_only
from quadsim.vehicle import N_ROTORS

MOST_CHANGES: Final = 3000
"""Limit of active-set changes in a search; the most observed is 2507, for a state drawn far off."""
PROBLEMS: Final = 16
"""Number of problems whose tables are cached, most recently used first."""

Made = TypeVar("Made")
Filled = TypeVar("Filled", bound=Struct)

WorkStruct: Final = struct("quadsim_work")
ENTRIES: Final = {"axes": struct("quadsim_axis"), "rows": struct("quadsim_row"), "terms": struct("quadsim_term")}
"""Structs of the lists among the members of a problem, by their names."""


class CoreProblem:
    """A problem's `tables` in the core's memory layout; any number of controllers may share them.

    `struct` is the `quadsim_problem`, which points to memory that this object owns.
    """

    def __init__(self, problem: Problem) -> None:
        self._problem = problem
        self.tables = tables(problem)
        self._kept: list[object] = []
        # Independent hard rows are at most as many as inputs; violated soft rows may add their number.
        N = problem.horizon
        rows = self.tables.rows
        soft_rows = sum(math.isfinite(row.l1) for row in rows)
        at_most = N * (N_ROTORS + soft_rows)
        capacity = min(N * len(rows), at_most) + 1
        self.struct = self._filled(
            struct("quadsim_problem"), members(self.tables, capacity=capacity, changes=MOST_CHANGES)
        )

    def _filled(self, kind: type[Filled], values: Mapping[str, Any]) -> Filled:
        """Return a struct, and keep the memory that it points to."""
        members = {name: self._member(name, value) for name, value in values.items()}
        return kind(**members)

    def _member(self, name: str, value: Any) -> int | float:
        if isinstance(value, list):
            kind = ENTRIES[name]
            entries = [self._filled(kind, entry) for entry in value]
            value = (kind * len(value))(*entries)
        elif not isinstance(value, np.ndarray):
            return value
        self._kept.append(value)
        if isinstance(value, np.ndarray):
            return value.ctypes.data
        return ctypes.addressof(value)

    @cached_property
    def condensed(self) -> Condensed:
        """The QP to which the KKT residuals of the optimum refer."""
        return Condensed(self._problem)


@dataclass(frozen=True)
class Key(Generic[Made]):
    """A cache key of something built from dataclasses, by its contents."""

    content: object
    of: Made = field(compare=False)

    @classmethod
    def to(cls, value: Made) -> Key[Made]:
        """Return the key of a value."""
        return cls(_content(value), value)


def _content(value: object) -> object:
    if isinstance(value, np.ndarray):
        return value.shape, value.tobytes()
    if is_dataclass(value):
        return tuple(_content(getattr(value, item.name)) for item in fields(value))
    if isinstance(value, dict):
        return tuple(value.items())
    if isinstance(value, tuple):
        return tuple(map(_content, value))
    return value


def core_problem(problem: Problem) -> CoreProblem:
    """Return a problem's tables, shared by equal problems of this process."""
    return _core_problem(Key.to(problem))


@lru_cache(PROBLEMS)
def _core_problem(key: Key[Problem]) -> CoreProblem:
    return CoreProblem(key.of)


class Optimum:
    """Reads the answers in a `quadsim_work`; PIQP gives those that the core gives up or finds infeasible.

    The work and its views point into memory that the caller keeps.

    Attributes:
        plan: (N, 4) the optimum that was found last, which the next one overwrites [rad/s].
    """

    def __init__(self, problem: Problem, shared: CoreProblem, work: Struct) -> None:
        self._problem = problem
        self._shared = shared
        self._work = work
        self._piqp: QPSolver | None = None
        rows = problem.rows
        self._upper = rows.upper
        self._lower = rows.lower
        self._soft = rows.soft
        self._scale = rows.scale
        self._slack_scale = rows.slack_scale
        self._no_slacks = read_only(np.zeros((problem.horizon, rows.soft.size)))
        self._no_multipliers = read_only(np.zeros((problem.horizon, len(rows.D))))
        step_rows = shared.struct.step_rows
        self.plan = self._view(work.plan, ctypes.c_double, N_ROTORS)
        self._multiplier = self._view(work.multiplier, ctypes.c_double, step_rows)
        self._value = self._view(work.value, ctypes.c_double, step_rows)
        self._shift = self._view(work.shift, ctypes.c_double, step_rows)
        self._side = self._view(work.last, ctypes.c_int8, step_rows)

    def _view(self, address: int, kind: type[ctypes.c_double | ctypes.c_int8], columns: int) -> Array:
        shape = self._problem.horizon, columns
        return np.ctypeslib.as_array((kind * math.prod(shape)).from_address(address)).reshape(shape)

    def reset(self) -> None:
        """Clear the last answer of PIQP."""
        if self._piqp is not None:
            self._piqp.reset()

    def answer(self, found: int, query: Query, started: float) -> Answer:
        """Return the answer to a query that the core `found` so, or PIQP's; `started` on the performance counter."""
        if found >= len(Method):
            return self._by_piqp(query, started)
        method = Method(found)
        plan = self.plan.copy()
        slacks = self.slacks(method)
        if method is Method.FREE:
            multipliers = self._no_multipliers
            active = 0
            status = UNCONSTRAINED
            answered_by = GAIN
        else:
            multipliers = self._multiplier * self._scale
            active = self.active
            status = SOLVED
            answered_by = CORE
        return Answer(
            plan,
            slacks,
            status,
            answered_by,
            method=method,
            certificate=partial(self._certificate, query, plan, slacks, multipliers),
            stats=Statistics(iterations=self._work.changes, active=active, solve_s=clock.perf_counter() - started),
        )

    @property
    def active(self) -> int:
        """Active rows of the optimum that was found last, if any row was."""
        return int(np.count_nonzero(self._side))

    def slacks(self, method: Method) -> Array:
        """Return (N, m_s) the violations of soft rows at the optimum that was found last."""
        if method is Method.FREE or not self._no_slacks.size:
            return self._no_slacks
        violated = np.abs(self._side) == 2
        if not np.count_nonzero(violated):
            return self._no_slacks
        values = self._value + self._shift
        beyond = np.maximum(np.maximum(values - self._upper, self._lower - values), 0.0)
        return np.asarray((violated * beyond)[:, self._soft] / self._slack_scale)

    def _certificate(self, query: Query, plan: Array, slacks: Array, multipliers: Array) -> tuple[QP, Solution]:
        """Return the condensed QP of a query, and a plan as its solution."""
        form = self._shared.condensed
        return form.assemble(query), form.solution(plan, slacks, multipliers)

    def _by_piqp(self, query: Query, started: float) -> Answer:
        if self._piqp is None:
            self._piqp = QPSolver(CORES_SECOND, self._problem)
        spent_s = clock.perf_counter() - started
        answer = self._piqp.solve(query)
        return answer._replace(stats=answer.stats._replace(solve_s=spent_s + answer.stats.solve_s))


class Core:
    """Computes a problem's optimum with the compiled core; see `quadsim.mpc.solvers.Solver`.

    The search starts from the last optimum's active set, shifted by one step.  PIQP answers the problems that the core
    gives up or finds infeasible, and `answered_by` names it.

    Attributes:
        shared: the problem's tables.

    Raises:
        FileError: the library cannot be compiled or loaded.
        ParameterError: the core cannot take the problem.
    """

    name: Final = CORE
    iterates: Final = frozenset({CORE, CORES_SECOND})

    def __init__(self, problem: Problem) -> None:
        self._library = core_library()
        self.shared = core_problem(problem)
        self._equilibrium = problem.equilibrium
        p = self.shared.struct
        # The work struct and its views point into this memory.
        self._memory = np.zeros(self._library.quadsim_work_reals(p))
        self._work = WorkStruct()
        self._library.quadsim_work_start(self._work, p, self._memory.ctypes.data)
        self._optimum = Optimum(problem, self.shared, self._work)
        sizes = p.states, p.horizon * p.regulated, p.states, N_ROTORS, N_ROTORS
        self._query = np.zeros(sum(sizes))
        parts = np.split(self._query, np.cumsum(sizes[:-1]))
        self._state, desired, self._x_s, self._u_s, self._before = parts
        self._desired = desired.reshape(p.horizon, -1)
        addresses = [part.ctypes.data for part in parts]
        self._arguments = self._work, *addresses

    def __reduce__(self) -> NoReturn:
        """Refuse: addresses are useless in a copy or another process."""
        raise TypeError("a Core cannot be copied or pickled: make another from its problem")

    @property
    def formulation(self) -> Condensed:
        """See `quadsim.mpc.solvers.Solver`."""
        return self.shared.condensed

    def reset(self) -> None:
        """See `quadsim.mpc.solvers.Solver.reset`."""
        self._library.quadsim_work_reset(self._work)
        self._optimum.reset()

    def solve(self, query: Query) -> Answer:
        """See `quadsim.mpc.solvers.Solver.solve`."""
        started = clock.perf_counter()
        state, desired, u_before, rest, _ = query
        x_s, u_s = rest or self._equilibrium
        self._state[:] = state
        self._desired[:] = desired
        self._x_s[:] = x_s
        self._u_s[:] = u_s
        self._before[:] = u_before
        if math.isfinite(self._query.sum()):
            found = self._library.quadsim_optimise(*self._arguments)
        else:
            found = len(Method)
        return self._optimum.answer(found, query, started)
