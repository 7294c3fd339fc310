"""Periods of a flight as test vectors: the controller's inputs and its exact answers."""

from __future__ import annotations

import contextlib
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from mpc.bounded import Bounded
from mpc.core.solver import Core
from mpc.core.tables import with_constraints
from mpc.linear import LinearMPC
from mpc.ocp import Query
from mpc.solvers import Method
from mpc.unconstrained import UnconstrainedMPC
from quadsim.controller import ACCEPTED, CORE, GAIN, Command, Phase, StepInputs
from quadsim.errors import ExportError, PlanExhaustedError
from quadsim.state import Array
from scenarios.assembly import Assembly
from scenarios.rollout import Rollout
from scenarios.schema.scenario import Scenario

MPC = LinearMPC | UnconstrainedMPC
REFUSED: Final = len(Method)  # least status of a period without an optimum


@dataclass(frozen=True, kw_only=True)
class Recording:
    """K consecutive periods of one flight."""

    speeds: Array  # (4,) the command before the first [rad/s]
    state: Array  # (K, 12) as the controller was given it
    acting: Array  # (K, 4) command in force before each [rad/s]
    path: Array  # (K + N - 1, 4) references; period k is given N rows from row k on
    status: NDArray[np.int64]  # (K,) as of `enum quadsim_status`: `REFUSED` for all that are no optimum
    command: Array  # (K, 4) the optimum's first command; the one before where there is none [rad/s]


class Recorder:
    """An MPC whose questions are noted: from where the flight begins to where it ends, or where a measurement lacks."""

    def __init__(self, inner: MPC) -> None:
        self.inner, self.name, self.solver, self.horizon = inner, inner.name, inner.solver, inner.horizon
        self.queries: list[tuple[Array, Array, Array]] = []
        """State (12,), command in force (4,) and reference (N, 4) of each period."""
        self._before, self._ended = np.zeros(4), False

    def reset(self, speeds: Array) -> None:
        """See `quadsim.controller.Controller.reset`."""
        self.queries, self._before, self._ended = [], np.array(speeds, float), False
        self.inner.reset(speeds)

    def step(self, now: StepInputs, state: Array, reference: Array) -> Command:
        """See `quadsim.controller.Controller.step`."""
        flying = now.phase is Phase.FLYING and (now.unseen is None or not now.unseen.any())
        self._ended |= bool(self.queries) and not flying
        if flying and not self._ended:
            acting = self._before if now.acting is None else now.acting
            self.queries.append((state.copy(), np.array(acting, float), np.array(reference, float)))
        command = self.inner.step(now, state, reference)
        self._before = command.speeds.copy()
        return command

    def predict(self, states: Array, plans: Array) -> Array:
        """See `quadsim.controller.Controller.predict`."""
        return self.inner.predict(states, plans)


def record(scenario: Scenario) -> Recording:
    """Fly a scenario, record each period, and compute the answers of a controller that starts with the first."""
    scenario = scenario.replace({"controller.compiled": False})
    if isinstance(scenario.controller, Bounded):
        scenario = scenario.replace({"controller.solver": CORE})
    pilot = Assembly(scenario).controller()
    law = pilot.law
    assert isinstance(law, MPC)
    pilot.law = recorder = Recorder(law)
    Rollout(scenario, pilot).fly()
    queries = recorder.queries
    if not queries:
        raise ExportError("its flight has no period in the air, with everything measured, to record")
    states, acting, windows = (np.array(column) for column in zip(*queries, strict=True))
    status, commands = _answers(law, scenario.control_period, acting[0], queries)
    known = len(status)
    return Recording(
        speeds=acting[0],
        state=states[:known],
        acting=acting[:known],
        path=np.concatenate([windows[: known - 1, 0], windows[known - 1]]),
        status=status,
        command=commands,
    )


def _answers(
    law: MPC, period: float, speeds: Array, queries: list[tuple[Array, Array, Array]]
) -> tuple[NDArray[np.int64], Array]:
    """Status (K,) and command (K, 4) of a controller for these queries after its reset.

    They end before the first period whose optimum is known as a solver's approximation alone.
    """
    if isinstance(law, UnconstrainedMPC):
        return np.zeros(len(queries), np.int64), _free_commands(law, queries)
    law.reset(speeds)
    answers: list[tuple[int, Array]] = []
    for k, (state, acting, reference) in enumerate(queries):
        answer = REFUSED, acting
        with contextlib.suppress(PlanExhaustedError):
            command = law.step(StepInputs(time=k * period, acting=acting), state, reference)
            if command.status in ACCEPTED:
                assert law.answer is not None
                answer = law.answer.method, command.speeds
                if command.answered_by not in (GAIN, CORE):
                    break
        answers.append(answer)
    status, commands = zip(*answers, strict=True)
    return np.array(status), np.array(commands)


def _free_commands(law: UnconstrainedMPC, queries: list[tuple[Array, Array, Array]]) -> Array:
    """(K, 4) from the core: the one gain of Eq. (24) has lost half its digits at N = 100."""
    core, desired = Core(with_constraints(law.problem)), law.problem.objective.desired
    return np.array([core.solve(Query(state, desired(path), before)).plan[0] for state, before, path in queries])
