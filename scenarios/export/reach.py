"""How far from the reference an export's room for active rows suffices, by drawn states."""

from __future__ import annotations

import ctypes
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from mpc.core.library import MIRRORS
from mpc.core.solver import WAYS, CoreProblem, core_library
from mpc.ocp import Problem
from quadsim.state import N_STATES, POSITION, VELOCITY, Array

DISTANCES: Final = (0.25, 0.5, 1.0, 1.5, 2.0, 3.0, 4.0, 6.0, 8.0)
"""Per axis [m], and speeds per axis [m/s]."""
DRAWS: Final = 500
"""States of each distance."""


@dataclass(frozen=True, kw_only=True)
class Reach:
    """What was found by states up to the first distance at which one ran out of room.

    Attributes:
        distance: the largest one [m, m/s] up to which none did; 0 where some did at the first.
        drawn: states up to there.
        feasible: those of them that have an optimum.
        beyond: the next distance; None where none was left to try.
        lost: of its states with an optimum, those that ran out of room.
    """

    distance: float
    drawn: int
    feasible: int
    beyond: float | None = None
    lost: int = 0

    def __str__(self) -> str:
        found = f"up to {self.distance:g} m and m/s per axis it sufficed for all {self.feasible} feasible states"
        if self.beyond is None:
            return f"{found} of {self.drawn} drawn"
        return f"{found} of {self.drawn} drawn, at {self.beyond:g} it lacked for {self.lost} of {DRAWS}"


class _Search:
    """Cold searches for the optimum with a room, and a number of changes, of its own."""

    def __init__(self, shared: CoreProblem, room: int, changes: int) -> None:
        self._library, self._shared = core_library(), shared
        self._problem = type(shared.struct).from_buffer_copy(shared.struct)
        self._problem.room, self._problem.changes = room, changes
        at, sizes = ctypes.addressof(self._problem), (ctypes.c_size_t * len(MIRRORS))()
        self._library.quadsim_library_sizes(sizes)
        self._memory = np.zeros(self._library.quadsim_work_reals(at))
        self._work = np.zeros(sizes[MIRRORS.index("quadsim_work")], np.uint8)
        self._at = self._work.ctypes.data
        self._library.quadsim_work_start(self._at, at, self._memory.ctypes.data)

    def solves(self, *arguments: Array) -> bool:
        self._library.quadsim_work_reset(self._at)
        return self._library.quadsim_optimise(self._at, *(part.ctypes.data for part in arguments)) < len(WAYS)


def reach(problem: Problem, room: int, changes: int) -> Reach:
    """Draw states around a reference at rest, and search with this room and with all that can be needed.

    Position and velocity are uniform within a distance per axis, attitude and yaw are level, rotors hover; each search
    begins without an active set.

    Raises:
        MissingCoreError: the core was not compiled here.
    """
    shared, rng = CoreProblem(problem), np.random.default_rng(0)
    whole, own = _Search(shared, shared.struct.room, shared.struct.changes), _Search(shared, room, changes)
    rest, speeds = np.zeros(problem.model.n), np.array(problem.model.u_bar)
    rest[N_STATES:] = (shared.tables.modes @ speeds)[: rest.size - N_STATES]
    wanted, moving = np.zeros((problem.horizon, len(problem.objective.C_r))), [*POSITION, *VELOCITY]
    found = Reach(distance=0.0, drawn=0, feasible=0)
    for distance in DISTANCES:
        feasible = lost = 0
        for offset in rng.uniform(-distance, distance, (DRAWS, len(moving))):
            state = rest.copy()
            state[moving] += offset
            if whole.solves(state, wanted, rest, speeds, speeds):
                feasible += 1
                lost += not own.solves(state, wanted, rest, speeds, speeds)
        if lost:
            return replace(found, beyond=distance, lost=lost)
        found = Reach(distance=distance, drawn=found.drawn + DRAWS, feasible=found.feasible + feasible)
    return found
