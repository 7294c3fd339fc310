"""An exported law against the same law in flight: the same failures, the same statuses, commands and plans.

One contract in C guards both; what surrounds it is C there, and `quadsim.mpc.guard.contract` here.
"""

from __future__ import annotations

import math
import shutil
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
from exported_c import PHASES, Host, Reply

from quadsim.controller import ACCEPTED, CORE, Command, Phase, StepInputs
from quadsim.core.mirror import constant, core_library
from quadsim.mpc.export import source
from quadsim.mpc.guard.answer import ActuatorBounds
from quadsim.mpc.guard.contract import PHASES as GUARD_PHASES
from quadsim.mpc.guard.numbers import fallback_numbers
from quadsim.mpc.guard.settings import USUAL_FALLBACK
from quadsim.mpc.guard.structs import STATUSES
from quadsim.mpc.laws.nonlinear import Nonlinear
from quadsim.mpc.laws.parts.linear import LinearMPC
from quadsim.mpc.laws.parts.nonlinear_mpc import NonlinearMPC
from quadsim.mpc.problem.equilibrium import Trim
from quadsim.mpc.problem.heading import advance
from quadsim.mpc.problem.model import LinearModel
from quadsim.scenarios.assembly import Assembly
from quadsim.scenarios.loading import load_scenario
from quadsim.scenarios.schema.scenario import Scenario
from quadsim.state import EULER, EULER_RATE, INDEX, POSITION, VELOCITY, Array

pytestmark = pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler")

TOLD = ("max_iterations", "no_room")
"""Failures for lack of what the exported law alone is given little of."""
SHORT = {"controller.fallback": {"unseen": 0.4, "hover": 0.5, "plan_age": 0.5}}
CEILING = {"name": "ceiling", "of": ["vz"], "rows": [[1.0]], "upper": [0.4]}
HARD = SHORT | {"controller.soft.linear": 1e8, "controller.polytopes": [CEILING]}
HARD_NONLINEAR = {"controller.polytopes": [CEILING], "controller.offset_free": {}}
NONLINEAR: dict[str, Any] = {
    "controller": {"type": "nonlinear", "horizon": 20, "fallback": {"unseen": 0.4, "hover": 0.5, "plan_age": 0.5}}
}
RATES = {
    "controller": NONLINEAR["controller"] | {"commands": "rates", "inner_lag": [0.02, 0.03, 0.03, 0.06]},
}
PERIODS = 240


@dataclass
class Told:
    """A law that fails as it is told to."""

    law: LinearMPC | NonlinearMPC
    failure: str | None = None

    def __post_init__(self) -> None:
        self.name = self.law.name
        self.solver = self.law.solver
        self.horizon = self.law.horizon

    def reset(self, speeds: Array) -> None:
        self.law.reset(speeds)

    def step(self, now: StepInputs, state: Array, reference: Array) -> Command:
        answer = self.law.step(now, state, reference)
        return answer if self.failure is None else replace(answer, status=self.failure)

    @property
    def trim(self) -> Trim | None:
        return self.law.trim

    def predict(self, states: Array, plans: Array) -> Array:
        return self.law.predict(states, plans)


class Vehicle:
    """A vehicle that moves as the hover model does under a constant force, measured with noise and with faults."""

    def __init__(self, model: LinearModel, seed: int) -> None:
        self.rng = np.random.default_rng(seed)
        self.state = np.zeros(12)
        self.measured = np.zeros(12)
        self.model = model
        self.speeds = model.u_bar
        self.state[INDEX["yaw"]] = 0.4
        more = np.array([0.3, 0.0, 0.0, 0.0] if model.targets else [3.0, 4.0, 3.0, 2.0])
        self.trim = Trim(speeds=self.speeds + more, lift=np.array([-0.2, 0.1, 9.81]))

    def move(self) -> None:
        self.state = advance(self.model, self.state, self.speeds, self.trim)

    def measure(self, k: int, frozen: Mapping[int, tuple[int, ...]], missing: Mapping[int, tuple[int, ...]]) -> Array:
        """The state in period k; `frozen` and `missing` channels by period, the latter by turns in three ways."""
        before = self.measured
        self.measured = self.state + 1e-3 * self.rng.normal(size=12)
        self.measured[[*frozen.get(k, ())]] = before[[*frozen.get(k, ())]]
        seen = self.measured.copy()
        seen[[*missing.get(k, ())]] = (math.nan, math.inf, -1e7)[k % 3]
        return seen


def over(channels: tuple[int, ...], *spans: range) -> dict[int, tuple[int, ...]]:
    return dict.fromkeys((k for span in spans for k in span), channels)


def flown(scenario: Scenario, host: Host, seed: int = 0) -> tuple[list[Command], list[Reply]]:
    """Commands in flight and of the exported law to the same measurements, while the vehicle flies the former."""
    table = scenario.controller
    period = scenario.control_period
    linear = not isinstance(table, Nonlinear)
    pilot = Assembly(scenario.replace({"controller.solver": CORE} if linear else {})).controller()
    guard = table.guard(Assembly(scenario).vehicle, period)
    assert guard is not None
    assert isinstance(pilot.law, LinearMPC | NonlinearMPC)
    vehicle = Vehicle(guard.model, seed)
    law = Told(pilot.law)
    everything = tuple(range(12))
    law.reset(guard.reset(vehicle.speeds))
    host.reset(vehicle.speeds)
    frozen = over(VELOCITY, range(28, 34)) | over(EULER_RATE, range(36, 40)) | over(POSITION + EULER, range(44, 48))
    missing = over(POSITION, range(52, 56), range(150, 160)) | over(everything, range(60, 63), range(80, 96))
    missing |= over((INDEX["vx"], INDEX["roll"], INDEX["yaw_rate"]), range(100, 106))
    path = np.zeros((PERIODS + law.horizon, 4))
    path[62:66, 0] = 3.0
    path[125:129, 1] = 2.0
    path[110:, 3] = 1.0
    path[190:, 2] = 0.3
    path += [0.0, 0.0, 0.0, 0.4]
    commands = list[Command]()
    replies = list[Reply]()
    for k in range(PERIODS):
        if k in (130, 170):
            vehicle.state[[INDEX["vz"], INDEX["vx"]]] += [2.0, 1.0]  # beyond a hard bound: infeasible
        seen = vehicle.measure(k, frozen, missing)
        reference = path[k : k + law.horizon].copy()
        acting = vehicle.speeds
        reference[0, 1] = math.nan if k in (66, 67) else 1e6 if k == 68 else reference[0, 1]
        acting = np.full(4, math.nan) if k == 24 else np.full(4, 2e6) if k == 25 else acting
        phase = PHASES[2 if k in (0, 225, 226, 227) else 1 if k in (1, 2, 228) else 0]
        reply = host.step(seen, reference, acting, phase)
        status = STATUSES[reply.status]
        law.failure = status if status in TOLD else None
        command = guard.step(law, StepInputs(time=k * period, phase=phase, acting=acting), seen, reference)
        commands.append(command)
        replies.append(reply)
        vehicle.speeds = command.speeds
        vehicle.move()
    return commands, replies


CASES = {
    "infeasible": ("robust", HARD, {}, {"primal_infeasible"}),
    "gave up": ("robust", SHORT, {"changes": 6}, {"max_iterations"}),
    "no room": ("robust", SHORT, {"rows": 12}, {"no_room"}),
    "delayed": ("robust-lag50", SHORT, {"rows": 12}, {"no_room"}),
    "without heading": ("paper-constrained", SHORT, {"rows": 12}, {"no_room"}),
    "nonlinear": ("hover", NONLINEAR | HARD_NONLINEAR, {}, {"primal_infeasible"}),
    "rates": ("hover", RATES | HARD_NONLINEAR, {}, {"primal_infeasible"}),
}
"""Scenario, its changes, limits of the C, and failures that occur beside those of every case."""
ALWAYS = {"solved", "unconstrained", "state_unknown", "invalid_reference", "landed"}


def check_the_same(commands: list[Command], replies: list[Reply], tolerance: float) -> None:
    """Statuses, levels, and plans, whose first row is the command, within a tolerance [rad/s], or [N] and [rad/s]."""
    assert [command.status for command in commands] == [STATUSES[reply.status] for reply in replies]
    assert [command.fallback for command in commands] == [reply.fallback for reply in replies]
    for command, reply in zip(commands, replies, strict=True):
        np.testing.assert_array_equal(command.speeds, command.plan[0])
        np.testing.assert_array_equal(reply.command, reply.flown_plan[0])
        np.testing.assert_allclose(command.plan, reply.flown_plan, rtol=0.0, atol=tolerance)


@pytest.mark.parametrize("case", CASES)
def test_an_exported_law_flies_what_flies_here(case: str, monkeypatch: pytest.MonkeyPatch) -> None:
    name, changes, limits, failures = CASES[case]
    monkeypatch.setattr(source, "CHANGES", limits.get("changes", source.CHANGES))
    scenario = load_scenario(name).replace(changes)
    commands, replies = flown(scenario, Host(scenario, rows=limits.get("rows", 128)))
    check_the_same(commands, replies, 1e-4 if "controller" in changes else 1e-11)  # far off, a nonlinear law amplifies
    assert {command.status for command in commands} >= ALWAYS | failures
    assert {command.fallback for command in commands} == {0, 1, 2, 3}


def test_statuses_and_phases_are_those_of_the_header() -> None:
    """`solved` is two in C: with rows of states alone active, or with any."""
    in_c = ("free", "axes", "whole", *STATUSES[3:])
    assert [constant(f"QUADSIM_{status.upper()}") for status in in_c] == [*range(len(STATUSES))]
    for phase, code in GUARD_PHASES.items():
        name = Phase.LANDED if phase is Phase.CRASHED else phase
        assert code == constant(f"QUADSIM_PHASE_{name.upper()}")
    assert [GUARD_PHASES[phase] for phase in PHASES] == [0, 1, 2]
    accepted = [status in ACCEPTED for status in STATUSES]
    assert [bool(core_library().quadsim_is_flown(code)) for code in range(len(STATUSES))] == accepted


@pytest.mark.parametrize("name", ["paper-constrained", "robust", "robust-lag50", "crazyflie-steps"])
def test_bounds_of_the_table_are_those_of_the_problem(name: str) -> None:
    """A contract in flight has those of the table, an exported one those of the problem."""
    scenario = load_scenario(name).replace({"controller.fallback": {}})
    assembly = Assembly(scenario)
    guard = scenario.controller.guard(assembly.vehicle, scenario.control_period)
    assert guard is not None
    bounds = ActuatorBounds.of_problem(assembly.problem())
    exported = fallback_numbers(guard.model, bounds, USUAL_FALLBACK.within({}))
    for side in ("least", "most", "step_least", "step_most"):
        np.testing.assert_array_equal(getattr(guard.numbers, side), exported[side])


def test_a_law_without_a_contract_in_flight_has_one_on_a_computer() -> None:
    """`unconstrained` hovers level where its state is unknown, and sinks after 5 s."""
    host = Host(load_scenario("paper-unconstrained"))
    period = load_scenario("paper-unconstrained").control_period
    reference = np.zeros((host.horizon, 4))
    hover = np.full(4, 192.8)
    host.reset(hover)
    assert host.step(np.zeros(12), reference, hover).fallback == 0
    levels = [host.step(np.full(12, math.nan), reference, hover).fallback for _ in range(round(8.0 / period))]
    assert levels == [0] * round(1.5 / period) + [2] * round(5.0 / period) + [3] * round(1.5 / period)


@pytest.mark.parametrize("case", ["infeasible", "delayed"])
def test_floats_fly_nearly_the_same(case: str) -> None:
    name, changes, limits, _ = CASES[case]
    scenario = load_scenario(name).replace(changes)
    commands, replies = flown(scenario, Host(scenario, "float", rows=limits.get("rows", 128)))
    assert [command.status for command in commands] == [STATUSES[reply.status] for reply in replies]
    assert [command.fallback for command in commands] == [reply.fallback for reply in replies]
    for command, reply in zip(commands, replies, strict=True):
        np.testing.assert_allclose(command.speeds, reply.command, rtol=0.0, atol=0.02)
