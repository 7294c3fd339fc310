"""The exported C, compiled, in place of the Python that it was exported from."""

from __future__ import annotations

import ctypes
import math
import time as clock
from pathlib import Path
from typing import Final

import numpy as np

from mpc.answer import ActuatorBounds
from mpc.equilibrium import Trim
from mpc.export.source import Exportable
from mpc.fallback.completion import CompletedMoment
from mpc.heading import predict_in_heading_frame
from mpc.model import hover_model
from mpc.paper.prediction import rollout
from mpc.robust.settings import LONGEST_SPAN
from quadsim.controller import (
    CORE,
    FALLBACK,
    GAIN,
    GROUNDED,
    SOLVED,
    UNCONSTRAINED,
    Command,
    Moment,
    Phase,
    stopped,
)
from quadsim.state import EULER, EULER_RATE, VELOCITY, Array

STATUSES: Final = (UNCONSTRAINED, SOLVED, SOLVED, "clipped", "shifted", "before")
"""What `enum quadsim_status` is in a flight's log."""
ANSWERERS: Final = (GAIN, CORE, CORE, FALLBACK, FALLBACK, FALLBACK)
"""Who answered."""
LEVELS: Final = (0, 0, 0, 1, 2, 3)
"""And its fallback level."""
SOLVER: Final = "compiled"
"""In place of a solver's name."""
_MOVING: Final = [*VELOCITY, *EULER, *EULER_RATE]
_SAME_TIME: Final = 1e-6  # [s]


class CompiledMPC:
    """A law that was exported and compiled with `c/shim.c`; it answers as the C does, whatever there is no optimum for.

    Args:
        library: the compiled file.
        law: what it was exported from.
    """

    solver: Final = SOLVER

    def __init__(self, library: Path, law: Exportable) -> None:
        self.name, self.problem, self.horizon = law.name, law.problem, law.problem.horizon
        self._robust = law.settings is not None
        self._nominal = hover_model(law.vehicle, law.problem.model.period)
        self._unbounded = not law.problem.every_constraint  # whose law is the gain: no status reports a free optimum
        self._bounds = None if self._unbounded else ActuatorBounds.of_problem(law.problem)
        self._library = ctypes.CDLL(str(library))
        self._library.quadsim_shim_size.restype = ctypes.c_size_t
        self._inputs, self._answers = np.zeros(18 + 4 * self.horizon), np.zeros(18 + 4 * self.horizon)
        self._state, self._acting = self._inputs[:12], self._inputs[12:16]
        self._path = self._inputs[16:-2].reshape(self.horizon, 4)
        self._memory = ctypes.create_string_buffer(self._library.quadsim_shim_size() + 64)
        start = -(-ctypes.addressof(self._memory) // 64) * 64
        self._arguments = tuple(
            map(ctypes.c_void_p, (start, self._inputs.ctypes.data, self._answers.ctypes.data))
        )  # the same each time
        self._step = self._library.quadsim_shim_step
        self._step.restype = None
        self.reset(self._nominal.u_bar)

    def reset(self, speeds: Array) -> None:
        """See `quadsim.controller.Controller.reset`."""
        self._before = np.array(speeds, float)
        self._inputs[:4] = self._before
        self._library.quadsim_shim_reset(self._arguments[0], self._arguments[1])
        self._called_at = self._measured = -math.inf
        self.trim = Trim(speeds=self._nominal.u_bar, lift=np.array([0.0, 0.0, 1.0]))
        """What holds the vehicle at rest against the disturbance that is estimated."""

    def step(self, now: Moment, state: Array, reference: Array) -> Command:
        """See `quadsim.controller.Controller.step`."""
        acting = self._before if now.acting is None else now.acting
        if now.phase in GROUNDED:
            return self._stop(acting, now.phase)
        self._state[:], self._acting[:], self._path[:] = state, acting, reference
        if self._robust:
            self._inputs[-2], self._inputs[-1] = self._may_learn(now), now.phase is Phase.FLYING
        started = clock.perf_counter()
        self._step(*self._arguments)
        spent_s = clock.perf_counter() - started
        found = self._answers.copy()
        status, changes, active, slack = found[:4].tolist()
        method, N = int(status), self.horizon
        self._before = found[4:8]
        if self._robust:
            at = 8 + 4 * N
            self.trim = Trim(speeds=found[at : at + 4], lift=found[at + 4 : at + 7], twist=found[at + 7 : at + 10])
        plan = found[8 : 8 + 4 * N].reshape(N, 4)
        plan[0] = self._before
        accepted = LEVELS[method] == 0
        return Command(
            speeds=self._before.copy(),
            plan=plan if accepted else np.tile(self._before, (N, 1)),
            status=UNCONSTRAINED if self._unbounded else STATUSES[method],
            answered_by=GAIN if self._unbounded else ANSWERERS[method],
            iterations=int(changes),
            active=int(active) if accepted else 0,
            fallback=LEVELS[method],
            slack=slack if accepted else 0.0,
            solve_s=spent_s,
        )

    def predict(self, states: Array, plans: Array) -> Array:
        """See `quadsim.controller.Controller.predict`."""
        if self._robust:
            return predict_in_heading_frame(self._nominal, states, plans, self.trim)
        return rollout(self.problem.model, states, plans)

    def _stop(self, acting: Array, phase: Phase) -> Command:
        speeds = np.zeros(4) if self._bounds is None else self._bounds.reach(acting)[0]
        self.reset(speeds)
        return stopped(speeds.copy(), self.horizon, phase)

    def _may_learn(self, now: Moment) -> bool:
        """Whether what was expected for now may be held against the state; see `RobustMPC.step`."""
        if abs(now.time - self._called_at - self._nominal.period) > _SAME_TIME:
            self._measured = -math.inf
        self._called_at = now.time
        if isinstance(now, CompletedMoment) and now.unseen[_MOVING].any():
            return False
        span, self._measured = now.time - self._measured, now.time
        return span - _SAME_TIME <= LONGEST_SPAN and now.phase is Phase.FLYING
