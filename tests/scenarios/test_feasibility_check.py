"""A scenario's course against its vehicle and its controller, before it is flown."""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support import scenario_table

import quadsim
from quadsim.flight.feasibility import Feasibility
from quadsim.scenarios.assembly import Assembly
from quadsim.scenarios.catalogue import scenario_names
from quadsim.scenarios.feasibility_check import fitting, report
from quadsim.scenarios.loading import load_scenario, parse_scenario
from quadsim.scenarios.schema.scenario import Scenario
from quadsim.state import Array
from quadsim.vehicle import Vehicle


def scenario(reference: dict[str, Any], *, duration: float = 20.0, **fields: Any) -> Scenario:
    return parse_scenario(scenario_table() | {"duration": duration, "reference": reference, "constraints": []} | fields)


def found(reference: dict[str, Any], vehicle: Vehicle, **fields: Any) -> Feasibility:
    return report(Assembly(scenario(reference, **fields), vehicle))


def bounded_by(result: Feasibility) -> list[str]:
    """The quantities whose limits are exceeded, one for each side."""
    return [problem.split(" of ", 1)[1].split(" (")[0] for problem in result.problems]


def test_the_papers_course_steps_and_what_its_filter_leaves_is_beyond_the_bound() -> None:
    """After a step of d m the filter leaves d (3 / tau_r)^2 exp(-3 t / tau_r): 20 deg for 10 m in one axis."""
    made = load_scenario("paper-constrained")
    finding = report(Assembly(made))
    assert finding.jumps == (0.0, 10.0, 20.0, 40.0)
    assert finding.tilt == pytest.approx(20.0, abs=0.1)
    assert bounded_by(finding) == ["roll", "roll", "pitch", "pitch"]
    assert finding.sentence == "The course needs 19.1 deg of roll (limit 5 deg); three other limits are exceeded, too."
    assert "10.2 s" in finding.advice
    assert "25 %" in finding.advice
    assert finding.advice == fitting(Assembly(made))


@pytest.mark.slow("library")
def test_a_shipped_course_beyond_a_bound_has_advice_or_is_called_not_flyable() -> None:
    for name in scenario_names():
        result = report(Assembly(load_scenario(name)))
        assert bool(result.advice or "not flyable" in result.sentence) == bool(result.problems)


def test_a_course_that_the_flight_cuts_is_reported(vehicle: Vehicle, tmp_path: Path) -> None:
    eight = scenario({"type": "figure_eight", "length": 6.0, "period": 12.0, "turns": 1.5, "ramp": 4.0})
    table = rounded(tmp_path / "eight.csv", poses_of(eight), 4)
    cut = " It lasts until 20.95 s, but the flight follows it for 10 s."
    assert found(table, vehicle, duration=10.0).sentence.endswith(cut)
    assert "lasts" not in found(table, vehicle, duration=21.0).sentence
    sampled = quadsim.fly(scenario(table, duration=1.0), reference=lambda t: [0.0, 0.0, 0.0, 0.0], progress=False)
    assert "lasts" not in sampled.summary["course"]["sentence"]


def test_a_circle_requires_the_tilt_of_the_closed_form(vehicle: Vehicle) -> None:
    circle = {"type": "circle", "radius": 3.0, "speed": 1.0, "turns": 2.0, "ramp": 10.0}
    finding = found(circle, vehicle)
    assert finding.tilt == pytest.approx(math.degrees(math.atan(1.0 / (3.0 * vehicle.gravity))), rel=1e-3)
    assert finding.velocity == pytest.approx(1.0, rel=1e-3)
    assert finding.problems == ()
    assert (
        found(circle | {"speed": 3.0, "turns": 9.0}, vehicle).problems[0].partition(" deg of ")[2].startswith("roll ")
    )


def test_a_filter_lowers_what_is_required(vehicle: Vehicle) -> None:
    legs = {"type": "waypoints", "speed": 0.5, "points": [{"position": [3.0, 0.0, 0.0]}]}
    corners = found(legs, vehicle)
    assert corners.tilt == pytest.approx(math.degrees(math.atan(0.5 / 0.05 / vehicle.gravity)), rel=1e-9)
    assert corners.rotor_max < 250.0  # no torque is taken of a corner
    smoothed = math.degrees(math.atan(0.5 * 3.0 / 3.0 / vehicle.gravity))  # v (3 / tau_r), just after the corner
    assert found(legs | {"response_time": 3.0}, vehicle).tilt == pytest.approx(smoothed, rel=0.06)


def test_where_it_begins_elsewhere_the_course_jumps(vehicle: Vehicle) -> None:
    circle = {"type": "circle", "radius": 3.0, "speed": 1.0, "start": 2.0, "centre": [5.0, 5.0]}
    finding = found(circle, vehicle)
    assert finding.jumps == (2.0,)
    assert finding.tilt < 5.0
    assert found(circle, vehicle, duration=1.0).jumps == ()  # a start after the flight's end


def rounded(path: Path, poses: Array, decimals: int) -> dict[str, str]:
    """The reference of a table with a row per control period."""
    lines = (",".join(f"{value:.{decimals}f}" for value in (0.05 * k, *row)) for k, row in enumerate(poses))
    path.write_text("t,x,y,z,yaw\n" + "\n".join(lines) + "\n")
    return {"type": "csv", "file": str(path)}


@pytest.mark.parametrize("decimals", [3, 4, 6])
def test_a_rounded_table_of_a_smooth_course_requires_what_the_course_does(
    tmp_path: Path, vehicle: Vehicle, decimals: int
) -> None:
    """Fourth differences of 0.1 mm of rounding are steps of tens of rad/s: no controller has to follow those."""
    eight = scenario({"type": "figure_eight", "length": 6.0, "period": 12.0, "turns": 1.5, "ramp": 4.0})
    smooth = report(Assembly(eight, vehicle))
    result = report(Assembly(scenario(rounded(tmp_path / "eight.csv", poses_of(eight), decimals)), vehicle))
    assert not any("rotor speed change" in problem for problem in result.problems)
    assert result.tilt == pytest.approx(smooth.tilt, abs=0.05)
    assert (result.rotor_min, result.rotor_max) == pytest.approx((smooth.rotor_min, smooth.rotor_max), abs=0.2)


def poses_of(made: Scenario) -> Array:
    """(420, 4) samples of a course, one per control period."""
    return Assembly(made).course.sample(0.05 * np.arange(420))


def test_bounds_are_those_of_the_controller(vehicle: Vehicle) -> None:
    circle = {"type": "circle", "radius": 3.0, "speed": 1.0, "turns": 2.0}
    table = scenario_table()["controller"]
    narrow = table | {"output_bounds": {"vx": [-0.5, 2.0], "yaw_rate": [-1.0, 1.0], "pitch": [-1.5, 1.5]}}
    result = found(circle, vehicle, controller=narrow)
    assert bounded_by(result) == ["vx", "pitch", "pitch"]
    assert result.problems[0] == "-1 m/s of vx (limit -0.5 m/s)"
    free = {"type": "unconstrained", **{k: table[k] for k in ("horizon", "output_weights", "input_weights")}}
    assert found(circle | {"speed": 3.0, "turns": 9.0}, vehicle, controller=free).problems == ()
    slow = table | {"input_bounds": {"speed": [0.0, 192.0], "slew": [-10.0, 5.0]}}
    assert any("193 rad/s" in problem for problem in found(circle, vehicle, controller=slow).problems)


TIGHT = {
    "type": "robust",
    "horizon": 50,
    "output_weights": {"x": 10.0, "y": 10.0, "z": 100.0, "yaw": 100.0},
    "input_weights": {"speed": 0.1},
    "output_bounds": {"roll": [-5.0, 5.0], "pitch": [-5.0, 5.0]},
    "input_bounds": {"speed": [0.0, 250.0], "slew": [-10.0, 5.0]},
    "tightening": {},
}


def test_a_course_within_the_bounds_but_not_within_the_tightened_ones_is_reported(vehicle: Vehicle) -> None:
    """A circle of 4.9 deg: within 5 deg, but tightening leaves 4.84 deg."""
    speed = math.sqrt(3.0 * vehicle.gravity * math.tan(math.radians(4.9)))
    circle = {"type": "circle", "radius": 3.0, "speed": speed, "turns": 3.0, "ramp": 10.0}
    loose = found(circle, vehicle, controller={name: value for name, value in TIGHT.items() if name != "tightening"})
    assert loose.problems == ()
    problems = found(circle, vehicle, controller=TIGHT).problems
    assert len(problems) == 4
    assert "4.9 deg" in problems[0]
    assert "limit 5 deg, tightened to 4.83" in problems[0]
    assert "limit -5 deg, tightened to -4.83" in problems[1]
    tight = scenario(circle, controller=TIGHT)
    assert re.findall(r"\d+ %", fitting(Assembly(tight, vehicle))) == ["99 %", "98 %"]


def test_the_speed_at_which_a_course_fits_is_that_of_the_closed_form(vehicle: Vehicle) -> None:
    """tan(tilt) goes with the speed squared, and with the size at the same time for a turn."""
    circle = {"type": "circle", "radius": 3.0, "speed": 3.0, "turns": 9.0, "ramp": 10.0}
    made = scenario(circle)
    share = math.tan(math.radians(5.0)) * 3.0 * vehicle.gravity / 3.0**2
    expected = [f"{math.floor(100 * math.sqrt(share))} %", f"{math.floor(100 * share)} %"]
    assert re.findall(r"\d+ %", fitting(Assembly(made, vehicle))) == expected
    assert fitting(Assembly(scenario(circle | {"speed": 1.0, "turns": 2.0}), vehicle)) == ""


def test_filtered_steps_would_fit_with_a_slower_filter_or_smaller(vehicle: Vehicle) -> None:
    """What the filter leaves is d (3 / tau_r)^2: at 5 deg and with 2 m in one axis tau_r = 4.58 s."""
    steps = {"response_time": 3.0, "y": [{"start": 1.0, "stop": 15.0, "value": 2.0}]}
    advice = fitting(Assembly(scenario(steps), vehicle))
    time = 3.0 * math.sqrt(2.0 / (vehicle.gravity * math.tan(math.radians(5.0))))
    assert float(advice.partition(" s,")[0].rpartition(" ")[2]) == pytest.approx(time, rel=0.06)


def test_what_a_set_point_leaves_of_the_course_is_counted(vehicle: Vehicle) -> None:
    """A circle of 2.5 deg that turns its yaw by 10 deg at 2 s, when it has hardly begun."""
    circle = {"type": "circle", "radius": 3.0, "speed": 1.136, "turns": 2.0, "ramp": 10.0}
    turn = {"type": "setpoint", "at": 2.0, "yaw": 10.0}
    alone = found(circle, vehicle, duration=44.0)
    turned = found(circle, vehicle, duration=44.0, events=[turn])
    assert turned.tilt == pytest.approx(alone.tilt, rel=1e-3)
    assert turned.tilt == pytest.approx(math.degrees(math.atan(1.136**2 / 3.0 / vehicle.gravity)), rel=2e-2)
    assert (turned.jumps, turned.yaw) == ((2.0,), pytest.approx(10.0))
    assert "lasts" not in turned.sentence
    fast = found(circle | {"speed": 3.0, "turns": 9.0}, vehicle, duration=44.0, events=[turn])
    assert bounded_by(fast)[0] == "roll"
    assert fast.advice


def test_a_course_is_followed_until_each_axis_that_moves_has_a_set_point(vehicle: Vehicle) -> None:
    circle = {"type": "circle", "radius": 3.0, "speed": 1.0, "turns": 1.0, "ramp": 4.0}
    events = [{"type": "setpoint", "at": 2.0, "x": 0.0}, {"type": "setpoint", "at": 6.0, "y": 1.0, "z": 0.5}]
    sentence = found(circle, vehicle, duration=20.0, events=events).sentence
    assert sentence.endswith(" 6 s.")
    assert "lasts" not in found(circle, vehicle, duration=23.0, events=events[:1]).sentence


def test_a_filtered_set_point_requires_what_the_filter_leaves_of_it(vehicle: Vehicle) -> None:
    """At most d (3 / tau_r)^2, of a step of 1 m."""
    still = {"response_time": 3.0}
    step = [{"type": "setpoint", "at": 1.0, "y": 1.0}]
    required = math.degrees(math.atan(1.0 / vehicle.gravity))
    assert found(still, vehicle, events=step).tilt == pytest.approx(required, rel=0.1)
    assert found({"response_time": 1.0}, vehicle, events=step).problems[0].startswith("34.3 deg of roll ")
