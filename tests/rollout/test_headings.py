"""Headings are on the circle: a whole turn, added to a reference or to the initial yaw, changes nothing."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from typing import Any, Final

import numpy as np
import pytest

import quadsim
from quadsim.controller import StepInputs
from quadsim.rollout.flown import Flight
from quadsim.scenarios.assembly import Assembly
from quadsim.scenarios.courses.csv_course import tabulated
from quadsim.scenarios.feasibility_check import report
from quadsim.state import INDEX, REFERENCE_NAMES, TURN, Array, make_state

YAW: Final = REFERENCE_NAMES.index("yaw")
CONTROLLERS: Final[dict[str, tuple[str, dict[str, Any]]]] = {
    "unconstrained": ("paper-unconstrained", {}),
    "constrained": ("hover", {"controller.solver": "piqp"}),
    "constrained by the core": ("hover", {"controller.solver": "core"}),
    "robust": ("robust", {}),
    "robust in world axes": ("robust", {"controller.heading": False}),
    "robust by DAQP": ("robust", {"controller.solver": "daqp"}),
    "nonlinear": ("hover", {"controller": "nonlinear"}),
    "nonlinear, rates": ("hover", {"controller": {"type": "nonlinear", "commands": "rates"}}),
    "lqr": ("hover", {"controller": "lqr"}),
    "pid": ("hover", {"controller": "pid"}),
    "geometric": ("hover", {"controller": "geometric"}),
}
SMALL: Final = 1e-7
"""Difference of commands [rad/s], [N]: an angle and a whole turn are rounded to 1e-15, which solvers amplify."""
LIMITS: Final = [
    {"name": "error", "signal": "yaw_error", "lower": -30.0, "upper": 30.0},
    {"name": "yaw", "signal": "yaw", "lower": 100.0, "upper": 300.0},
    {"name": "impossible", "signal": "yaw_error", "lower": 1.0, "upper": 2.0},
]


def scenario(name: str, start: float) -> quadsim.Scenario:
    """A flight of half a second from an initial yaw [deg]."""
    library, changes = CONTROLLERS[name]
    flight = {"duration": 0.5, "initial.euler": [0.0, 0.0, start], "constraints": LIMITS, "group": None, "expect": None}
    base = quadsim.load(library)
    return base.replace({key: value for key, value in (flight | changes).items() if value is not None})


def turning(turns: float) -> Any:
    """A heading that turns on through 180 deg, some whole turns away."""
    return lambda t: [0.05 * t, 0.0, 1.0, math.radians(178.0) + 0.4 * t + TURN * turns]


def verdicts(flight: Flight) -> list[tuple[str, str]]:
    return [("flight", flight.outcome), *((each.limit.name, each.verdict) for each in flight.findings)]


@pytest.mark.slow("headings")
@pytest.mark.parametrize("name", CONTROLLERS)
def test_whole_turns_of_reference_or_initial_yaw_change_no_command_and_no_verdict(name: str) -> None:
    """Whole turns of the initial yaw, in whole degrees, change not a bit."""
    flown = quadsim.fly(scenario(name, 175.0), reference=turning(0), progress=False)
    assert dict(verdicts(flown))["error"] == "satisfied"
    assert dict(verdicts(flown))["impossible"] == "violated"
    assert np.ptp(flown.command) > 0.1  # it is not at rest
    turned = quadsim.fly(scenario(name, 175.0 - 720.0), reference=turning(0), progress=False)
    np.testing.assert_array_equal(turned.command, flown.command)
    np.testing.assert_array_equal(turned.log.plant.state, flown.log.plant.state)
    assert verdicts(turned) == verdicts(flown)
    for turns in (1, -3):
        shifted = quadsim.fly(scenario(name, 175.0), reference=turning(turns), progress=False)
        np.testing.assert_allclose(shifted.command, flown.command, rtol=0.0, atol=SMALL)
        np.testing.assert_allclose(shifted.log.control.reference, flown.log.control.reference, rtol=0.0, atol=1e-12)
        assert verdicts(shifted) == verdicts(flown)


@pytest.mark.representative("headings")
@pytest.mark.parametrize("name", CONTROLLERS)
def test_a_law_called_by_itself_takes_headings_that_jump_by_whole_turns(name: str) -> None:
    """Each period's preview is on another turn, and jumps from its third sample on."""
    assembly = Assembly(scenario(name, 0.0))

    def commands(jumping: bool, lap: int = 0) -> Array:
        law = assembly.controller()
        acting = assembly.vehicle.hover_speed * np.ones(4)
        law.reset(assembly.initial_speeds)
        given = []
        for k in range(4):
            yaw = math.radians(150.0) + 0.02 * (k + np.arange(1, law.horizon + 1))
            reference = np.column_stack([np.zeros((law.horizon, 2)), np.ones(law.horizon), yaw])
            if jumping:
                reference[:, YAW] += TURN * (k - 1)
                reference[2:, YAW] -= TURN
            state = make_state(position=(0.0, 0.0, 1.0), euler=(0.01, 0.02, math.radians(170.0) + TURN * lap))
            now = StepInputs(time=0.05 * k, acting=None if name.endswith("rates") else acting)
            given.append(law.step(now, state, reference).speeds)
        return np.array(given)

    flat = commands(jumping=False)
    assert np.ptp(flat) > 0.1
    np.testing.assert_allclose(commands(jumping=True), flat, rtol=0.0, atol=SMALL)
    # From another number, PIQP stops elsewhere within its tolerance, which with active bounds is 1e-3 of an input.
    np.testing.assert_allclose(
        commands(jumping=True, lap=2), flat, rtol=0.0, atol=1e-3 if name == "constrained" else SMALL
    )


@pytest.mark.parametrize(("start", "table", "other"), [(180.0, -180.0, 180.0), (-180.0, 540.0, -180.0)])
def test_a_table_that_names_the_vehicles_heading_otherwise_asks_for_no_turn(
    start: float, table: float, other: float, tmp_path: Path
) -> None:
    rows = ["t,x,y,z,yaw", *(f"{t},0,0,0,{math.radians(table)!r}" for t in (0.0, 1.0))]
    (tmp_path / "still.csv").write_text("\n".join(rows))
    changes = {
        "initial.euler": [0.0, 0.0, start],
        "initial.position": [0.0, 0.0, 0.0],
        "controller": "geometric",
        "duration": 0.5,
        "constraints": LIMITS[:1],
    }
    course = {"reference": {"type": "csv", "file": str(tmp_path / "still.csv")}}
    still = quadsim.load("hover").replace(changes | course)
    flight = quadsim.fly(still, progress=False)
    assert (flight.outcome, flight.metrics["rmse.yaw"] < 1e-6) == ("satisfied", True)
    feasible = report(Assembly(still))
    assert (feasible.jumps, feasible.problems) == ((), ())
    assert "180 deg" in feasible.sentence
    assert feasible.yaw == pytest.approx(abs(other))


def test_a_column_that_jumps_by_a_whole_turn_is_a_smooth_turn(tmp_path: Path) -> None:
    t = np.linspace(0.0, 1.0, 41)
    yaw = np.radians(170.0) + 0.5 * t
    flights = []
    for column in (yaw, np.angle(np.exp(1j * yaw))):
        course = tabulated("turn.csv", t, np.column_stack([np.zeros((41, 3)), column]))
        still = quadsim.load("hover").replace({"initial.euler": [0.0, 0.0, 170.0], "constraints": LIMITS[:1]})
        still = still.altered(duration=1.0, reference=course)
        assert report(Assembly(still)).yaw_rate == pytest.approx(math.degrees(0.5), rel=1e-3)
        flights.append(quadsim.fly(still, progress=False))
    np.testing.assert_allclose(flights[1].command, flights[0].command, rtol=0.0, atol=SMALL)
    assert verdicts(flights[0]) == verdicts(flights[1])


def test_set_points_and_windows_are_reached_the_shorter_way_round() -> None:
    base = quadsim.load("hover").replace({"initial.euler": [0.0, 0.0, 0.0], "duration": 1.0, "controller": "geometric"})
    for reference, events in (
        ({}, [{"type": "setpoint", "at": 0.2, "yaw": 350.0}]),
        ({"yaw": [{"start": 0.2, "stop": 9.0, "value": 710.0}]}, []),
    ):
        for response_time in (0.0, 0.5):
            course = {"type": "steps", "response_time": response_time, **reference}
            flight = quadsim.fly(base.replace({"reference": course, "events": events}), progress=False)
            followed = np.degrees(flight.log.control.reference[:, YAW])
            assert followed.min() >= -10.0 - 1e-9
            assert followed.max() <= 1e-9
            assert followed[-1] == pytest.approx(-10.0, abs=1.0)


def test_a_vehicle_spun_by_a_whole_turn_is_not_turned_back() -> None:
    """A law that spins the vehicle sees its reference come along, and the error stays within half a turn."""

    class Spinning:
        def __init__(self) -> None:
            self.given: list[float] = []

        def step(self, now: StepInputs, state: Array, reference: Array) -> Array:
            self.given.append(reference[0, YAW] - state[INDEX["yaw"]])
            return np.array([205.0, 180.0, 205.0, 180.0])

    law = Spinning()
    limits = [{"name": "error", "signal": "yaw_error", "lower": -180.0, "upper": 180.0}]
    calm = quadsim.load("hover").replace({"duration": 6.0, "constraints": limits})
    flight = quadsim.fly(calm, controller=law, progress=False)
    assert abs(flight.state["yaw"][-1]) > 1.5 * TURN
    assert np.abs(law.given).max() <= math.radians(190.0) + 0.3  # the preview's first sample is a period ahead
    assert dict(verdicts(flight))["error"] == "satisfied"
    assert flight.metrics["max_error.yaw"] <= math.pi


def test_a_records_errors_are_on_the_circle_though_its_headings_count_turns() -> None:
    log = quadsim.fly(scenario("geometric", 175.0), reference=turning(0), progress=False).log.control
    apart = dataclasses.replace(log, reference=log.reference + TURN * np.array([0.0, 0.0, 0.0, 3.0]))
    np.testing.assert_allclose(apart.tracking_error, log.tracking_error, rtol=0.0, atol=1e-12)
    assert np.abs(log.tracking_error[:, YAW]).max() < 0.2
