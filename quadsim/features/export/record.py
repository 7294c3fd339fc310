"""Periods of a flight as test vectors: the controller's inputs and its exact answers.

A scenario is flown once, and its controller's queries are noted; then the controller answers them from its reset on, as
the exported C will.  `exporter` writes them as `vectors.c`, which `make check` of an export runs and compares.
"""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
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
QUATERNION_LAWS: Final = (NonlinearMPC, GeometricController)
"""Controllers that take quaternion and body rates, as exported too."""
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


class _PeriodInputs(NamedTuple):
    """A period's inputs: state, command in force, reference and motion."""

    state: Array
    acting: Array
    reference: Array
    now: StepInputs


class Recorder:
    """A controller whose inputs are noted: from take-off until the flight ends, or until a measurement lacks."""

    def __init__(self, inner: RecordedLaw) -> None:
        self.inner = inner
        self.name = inner.name
        self.solver = inner.solver
        self.horizon = inner.horizon
        if isinstance(inner, QUATERNION_LAWS):
            self.commands = inner.commands
        else:
            self.commands = ROTORS
        self.inputs: list[_PeriodInputs] = []
        self._before = np.zeros(4)
        self._ended = False

    def reset(self, speeds: Array) -> None:
        """See `quadsim.controller.Controller.reset`."""
        self.inputs = []
        self._before = np.array(speeds, float)
        self._ended = False
        self.inner.reset(speeds)

    def step(self, now: StepInputs, state: Array, reference: Array) -> Command:
        """See `quadsim.controller.Controller.step`."""
        all_measured = now.unseen is None or not now.unseen.any()
        recordable = now.phase is Phase.FLYING and all_measured
        if self.inputs and not recordable:
            self._ended = True
        if recordable and not self._ended:
            acting = self._before if now.acting is None else now.acting
            self.inputs.append(
                _PeriodInputs(
                    state=state.copy(),
                    acting=np.array(acting, float),
                    reference=np.array(reference, float),
                    now=replace(now, signals=None),
                )
            )
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
    recorder = Recorder(law)
    pilot.law = recorder
    Rollout(scenario, pilot).fly()
    inputs = recorder.inputs
    if not inputs:
        raise ExportError("its flight has no period in the air, with everything measured, to record")
    status, commands = _answers(law, scenario.control_period, inputs)
    inputs = inputs[: len(status)]
    return Recording(
        before=inputs[0].acting,
        state=np.array([_exported_state(law, period) for period in inputs]),
        acting=np.array([period.acting for period in inputs]),
        path=_path(law, inputs),
        status=status,
        command=commands,
    )


def _path(law: RecordedLaw, inputs: Sequence[_PeriodInputs]) -> Array:
    """Return the references of consecutive periods as one: the first row of each, and all rows of the last."""
    motion_rows = 0
    if isinstance(law, QUATERNION_LAWS):
        motion_rows = law.motion_rows
    windows = [reference_rows(period.now, period.reference, motion_rows) for period in inputs]
    first_rows = [window[0] for window in windows[:-1]]
    return np.array([*first_rows, *windows[-1]])


def _exported_state(law: RecordedLaw, period: _PeriodInputs) -> Array:
    """Return a state as an exported controller takes it."""
    if isinstance(law, QUATERNION_LAWS):
        return measured_state(period.now, period.state)
    return period.state


def _answers(
    law: RecordedLaw, control_period: float, inputs: Sequence[_PeriodInputs]
) -> tuple[NDArray[np.int64], Array]:
    """Status (K,) and command (K, 4) of a controller for these inputs after its reset.

    They end before the first period whose optimum is known as a solver's approximation alone.
    """
    if isinstance(law, UnconstrainedMPC):
        return np.zeros(len(inputs), np.int64), _unconstrained_commands(law, inputs)
    law.reset(inputs[0].acting)
    statuses = []
    commands = []
    for k, period in enumerate(inputs):
        status = REFUSED
        speeds = period.acting
        with contextlib.suppress(PlanExhaustedError):
            now = replace(period.now, time=k * control_period, acting=period.acting)
            command = law.step(now, period.state, period.reference)
            if command.status in ACCEPTED:
                if isinstance(law, LinearMPC) and command.answered_by not in (GAIN, CORE):
                    break
                status = _exported_status(law, command)
                speeds = command.speeds
        statuses.append(status)
        commands.append(speeds)
    return np.array(statuses), np.array(commands)


def _exported_status(law: LinearMPC | NonlinearMPC | GeometricController, command: Command) -> int:
    """Return the status of an optimum, as of `enum quadsim_status`."""
    if isinstance(law, QUATERNION_LAWS):
        if command.status != SOLVED:
            return STATUSES.index(command.status)
        return Method.WHOLE
    assert law.answer is not None
    return law.answer.method


def _unconstrained_commands(law: UnconstrainedMPC, inputs: Sequence[_PeriodInputs]) -> Array:
    """(K, 4) from the core: the one gain of Eq. (24) has lost half its digits at N = 100."""
    core = Core(with_constraints(law.problem))
    commands = []
    for period in inputs:
        query = Query(period.state, law.problem.desired(period.reference), period.acting)
        commands.append(core.solve(query).plan[0])
    return np.array(commands)
