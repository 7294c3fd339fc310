"""Periods of a flight as test vectors: the controller's inputs and its exact answers."""

from __future__ import annotations

import contextlib
from dataclasses import dataclass, replace
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from quadsim.controller import ACCEPTED, CORE, GAIN, ROTORS, SOLVED, Command, Phase, StepInputs
from quadsim.errors import ExportError, PlanExhaustedError
from quadsim.mpc.guard.structs import STATUSES
from quadsim.mpc.laws.geometric import GeometricController
from quadsim.mpc.laws.parts.linear import LinearMPC
from quadsim.mpc.laws.parts.nonlinear_law import measured_state, reference_rows
from quadsim.mpc.laws.parts.nonlinear_mpc import NonlinearMPC
from quadsim.mpc.laws.unconstrained import UnconstrainedMPC
from quadsim.mpc.problem.ocp import Query
from quadsim.mpc.solvers import Method
from quadsim.mpc.solvers.core import Core
from quadsim.mpc.solvers.core_tables import with_constraints
from quadsim.mpc.tables.bounded import Bounded
from quadsim.rollout.rollout import Rollout
from quadsim.scenarios.assembly import Assembly
from quadsim.scenarios.schema.scenario import Scenario
from quadsim.state import Array

RecordedLaw = LinearMPC | UnconstrainedMPC | NonlinearMPC | GeometricController
QUATERNIONS: Final = (NonlinearMPC, GeometricController)
"""Laws that take quaternion and body rates, as exported too."""
REFUSED: Final = len(Method)  # least status of a period without an optimum


@dataclass(frozen=True, kw_only=True)
class Recording:
    """K consecutive periods of one flight; M rows of W numbers are a reference."""

    before: Array  # (4,) the command before the first
    state: Array  # (K, 12) as the controller was given it; a nonlinear one's (K, 19), with quaternion and body rates
    acting: Array  # (K, 4) command in force before each
    path: Array  # (K + M - 1, W) references; period k is given M rows from row k on
    status: NDArray[np.int64]  # (K,) as of `enum quadsim_status`: `REFUSED` for all that are no optimum
    command: Array  # (K, 4) the optimum's first command; the one before where there is none


class _Asked(NamedTuple):
    """A period's inputs: state, command in force, reference and motion."""

    state: Array
    acting: Array
    reference: Array
    now: StepInputs


class Recorder:
    """A law whose questions are noted: from where the flight begins to where it ends, or where a measurement lacks."""

    def __init__(self, inner: RecordedLaw) -> None:
        self.inner = inner
        self.name = inner.name
        self.solver = inner.solver
        self.horizon = inner.horizon
        if isinstance(inner, QUATERNIONS):
            self.commands = inner.commands
        else:
            self.commands = ROTORS
        self.asked: list[_Asked] = []
        self._before = np.zeros(4)
        self._ended = False

    def reset(self, speeds: Array) -> None:
        """See `quadsim.controller.Controller.reset`."""
        self.asked = []
        self._before = np.array(speeds, float)
        self._ended = False
        self.inner.reset(speeds)

    def step(self, now: StepInputs, state: Array, reference: Array) -> Command:
        """See `quadsim.controller.Controller.step`."""
        flying = now.phase is Phase.FLYING and (now.unseen is None or not now.unseen.any())
        self._ended |= bool(self.asked) and not flying
        if flying and not self._ended:
            if now.acting is None:
                acting = self._before
            else:
                acting = now.acting
            parts = (state.copy(), np.array(acting, float), np.array(reference, float))
            self.asked.append(_Asked(*parts, replace(now, signals=None)))
        command = self.inner.step(now, state, reference)
        self._before = command.speeds.copy()
        return command

    def predict(self, states: Array, plans: Array) -> Array:
        """See `quadsim.controller.Controller.predict`."""
        return self.inner.predict(states, plans)


def record(scenario: Scenario) -> Recording:
    """Fly a scenario, record each period, and compute the answers of a controller that starts with the first."""
    if isinstance(scenario.controller, Bounded):
        scenario = scenario.replace({"controller.solver": CORE})
    pilot = Assembly(scenario).controller()
    law = pilot.law
    assert isinstance(law, RecordedLaw)
    pilot.law = recorder = Recorder(law)
    Rollout(scenario, pilot).fly()
    asked = recorder.asked
    if not asked:
        raise ExportError("its flight has no period in the air, with everything measured, to record")
    status, commands = _answers(law, scenario.control_period, asked)
    known = len(status)
    if isinstance(law, QUATERNIONS):
        rows = law.motion_rows
    else:
        rows = 0
    windows = [reference_rows(query.now, query.reference, rows) for query in asked[:known]]
    return Recording(
        before=asked[0].acting,
        state=np.array([_measured(law, query) for query in asked[:known]]),
        acting=np.array([query.acting for query in asked[:known]]),
        path=np.concatenate([[rows[0] for rows in windows[:-1]], windows[-1]]) if known > 1 else windows[0],
        status=status,
        command=commands,
    )


def _measured(law: RecordedLaw, query: _Asked) -> Array:
    """Return a state as an exported controller takes it."""
    if isinstance(law, QUATERNIONS):
        return measured_state(query.now, query.state)
    return query.state


def _answers(law: RecordedLaw, period: float, asked: list[_Asked]) -> tuple[NDArray[np.int64], Array]:
    """Status (K,) and command (K, 4) of a controller for these queries after its reset.

    They end before the first period whose optimum is known as a solver's approximation alone.
    """
    if isinstance(law, UnconstrainedMPC):
        return np.zeros(len(asked), np.int64), _free_commands(law, asked)
    law.reset(asked[0].acting)
    answers: list[tuple[int, Array]] = []
    for k, query in enumerate(asked):
        answer = REFUSED, query.acting
        with contextlib.suppress(PlanExhaustedError):
            now = replace(query.now, time=k * period, acting=query.acting)
            command = law.step(now, query.state, query.reference)
            if command.status in ACCEPTED:
                if isinstance(law, LinearMPC) and command.answered_by not in (GAIN, CORE):
                    break
                answer = _found(law, command), command.speeds
        answers.append(answer)
    status, commands = zip(*answers, strict=True)
    return np.array(status), np.array(commands)


def _found(law: LinearMPC | NonlinearMPC | GeometricController, command: Command) -> int:
    """Return the status of an optimum, as of `enum quadsim_status`."""
    if isinstance(law, QUATERNIONS):
        if command.status != SOLVED:
            return STATUSES.index(command.status)
        return Method.WHOLE
    assert law.answer is not None
    return law.answer.method


def _free_commands(law: UnconstrainedMPC, asked: list[_Asked]) -> Array:
    """(K, 4) from the core: the one gain of Eq. (24) has lost half its digits at N = 100."""
    core = Core(with_constraints(law.problem))
    desired = law.problem.desired
    queries = (Query(state, desired(path), acting) for state, acting, path, _ in asked)
    return np.array([core.solve(query).plan[0] for query in queries])
