"""A flight's periods as test vectors: what the controller was asked, and what the exact answer is."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from mpc.constrained import ConstrainedMPC
from mpc.fallback.contract import Guarded
from mpc.robust.controller import RobustMPC
from mpc.solvers import Way
from mpc.unconstrained import UnconstrainedMPC
from quadsim.controller import ACCEPTED, GROUNDED, Command, Controller, Moment
from quadsim.state import Array
from scenarios.build import build_controller
from scenarios.parts.vehicle import build_vehicle
from scenarios.run import fly_scenario
from scenarios.schema.scenario import Scenario

MPC = ConstrainedMPC | RobustMPC | UnconstrainedMPC
WAYS: Final = {Way.FREE: 0, Way.AXES: 1, Way.WHOLE: 2}
REFUSED: Final = 3
"""Least status of a period without an optimum."""


@dataclass(frozen=True, kw_only=True)
class Recording:
    """K periods of one flight, without a gap.

    Attributes:
        speeds: (4,) the command before the first [rad/s].
        state: (K, 12) as the controller was given it.
        acting: (K, 4) command in force before each [rad/s].
        path: (K + N - 1, 4) references; period k is given N rows from row k on.
        status: (K,) as of `enum quadsim_status`: `REFUSED` for all that are no optimum.
        command: (K, 4) the optimum's first command; the one before where there is none [rad/s].
    """

    speeds: Array
    state: Array
    acting: Array
    path: Array
    status: NDArray[np.int64]
    command: Array


class Recorder:
    """An MPC that notes what it is asked and what it answers."""

    def __init__(self, inner: MPC) -> None:
        self.inner, self.name, self.solver, self.horizon = inner, inner.name, inner.solver, inner.horizon
        self.reset(np.zeros(4))

    def reset(self, speeds: Array) -> None:
        """See `quadsim.controller.Controller.reset`."""
        self._speeds = np.array(speeds, float)
        self._states: list[Array] = []
        self._acting: list[Array] = []
        self._windows: list[Array] = []
        self._answers: list[tuple[int, Array]] = []
        self._ended = False
        self.inner.reset(speeds)

    def step(self, now: Moment, state: Array, reference: Array) -> Command:
        """See `quadsim.controller.Controller.step`."""
        command = self.inner.step(now, state, reference)
        self._ended = self._ended or (bool(self._states) and now.phase in GROUNDED)
        if now.phase in GROUNDED or self._ended:
            if not self._states:
                self._speeds = command.speeds.copy()
            return command
        acting = self._speeds if not self._states else self._answers[-1][1]
        self._acting.append(np.array(acting if now.acting is None else now.acting, float))
        self._states.append(np.array(state, float))
        self._windows.append(np.array(reference, float))
        answer = getattr(self.inner, "answer", None)
        way = Way.FREE if answer is None else answer.way
        self._answers.append((WAYS[way] if command.status in ACCEPTED else REFUSED, command.speeds.copy()))
        return command

    def predict(self, states: Array, plans: Array) -> Array:
        """See `quadsim.controller.Controller.predict`."""
        return self.inner.predict(states, plans)

    @property
    def recording(self) -> Recording:
        """What was noted up to the first landing."""
        path = np.concatenate([*(window[:1] for window in self._windows[:-1]), self._windows[-1]])
        return Recording(
            speeds=self._speeds,
            state=np.array(self._states),
            acting=np.array(self._acting),
            path=path,
            status=np.array([status for status, _ in self._answers]),
            command=np.array([command for _, command in self._answers]),
        )


def record(scenario: Scenario) -> Recording:
    """Fly a scenario and note each period."""
    law: Controller = build_controller(scenario, build_vehicle(scenario))
    if isinstance(law, Guarded):
        assert isinstance(law.inner, MPC)
        law.inner = recorder = Recorder(law.inner)
    else:
        assert isinstance(law, MPC)
        law = recorder = Recorder(law)
    fly_scenario(scenario, law=law)
    return recorder.recording
