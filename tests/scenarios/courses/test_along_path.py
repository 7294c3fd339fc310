"""`yaw = "along_path"`: the heading is the direction of travel, without jumps, on every course that moves."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from quadsim.errors import InputError
from quadsim.rollout.stability import instability_notes
from quadsim.scenarios.assembly import Assembly
from quadsim.scenarios.courses.along_path import directions, limited, turned
from quadsim.scenarios.loading import load_scenario
from quadsim.scenarios.schema.scenario import Scenario
from quadsim.state import Array

ALONG = {"reference.yaw": "along_path"}
COURSES: dict[str, dict[str, Any]] = {
    "crazyflie-steps": {},
    "waypoints": {},
    "minimum-snap": {"reference.points.1.yaw": None, "reference.points.3.yaw": None},
    "circle": {},
    "helix": {},
    "figure-eight": {},
    "csv-trefoil": {},
    "torrente-loop4-ideal": {},
    "torrente-lemniscate8-ideal": {},
}


def looking(name: str, **changes: Any) -> Scenario:
    return load_scenario(name).replace({**COURSES[name], **ALONG, **changes})


def flown(scenario: Scenario) -> tuple[Array, Array, Array]:
    """Return the filtered headings, the directions of travel and the speeds of a scenario's reference."""
    rows = Assembly(scenario).reference(scenario.periods + 1)
    velocity = np.gradient(rows[:, :2], scenario.control_period, axis=0)
    return rows[:, 3], np.arctan2(velocity[:, 1], velocity[:, 0]), np.hypot(velocity[:, 0], velocity[:, 1])


@pytest.mark.parametrize("name", [name for name in COURSES if name not in {"crazyflie-steps", "waypoints"}])
def test_bends_are_followed_exactly(name: str) -> None:
    heading, direction, speed = flown(looking(name, **{"reference.yaw_rate": 720.0}))
    error = np.abs(np.remainder(heading - direction + math.pi, math.tau) - math.pi)
    assert np.degrees(error[speed > 0.5 * speed.max()]).max() < 6.0


@pytest.mark.parametrize("name", COURSES)
def test_it_starts_at_the_initial_yaw_and_never_turns_faster_than_allowed(name: str) -> None:
    scenario = looking(name)
    assembly = Assembly(scenario)
    heading, _, _ = flown(scenario)
    assert heading[0] == pytest.approx(assembly.initial_yaw, abs=1e-9)
    fastest = np.degrees(np.abs(np.diff(heading))).max() / scenario.control_period
    assert fastest < 1.05 * 180.0


@pytest.mark.parametrize("name", ["waypoints", "crazyflie-steps"])
def test_corners_and_stops_turn_half_before_and_half_after(name: str) -> None:
    """On the straight parts in between the heading is along them; at a stop it is held once the turn is over."""
    heading, direction, speed = flown(looking(name, **{"reference.yaw_rate": 400.0}))
    error = np.abs(np.remainder(heading - direction + math.pi, math.tau) - math.pi)
    fast = speed > 0.5 * speed.max()
    assert np.median(np.degrees(error[fast])) < 6.0


def test_a_reversal_turns_to_the_left_without_a_jump() -> None:
    there_and_back = {
        "type": "waypoints",
        "start": 1.0,
        "response_time": 0.9,
        "points": [{"position": [3.0, 0.0, 1.0], "hold": 2.0}, {"position": [0.0, 0.0, 1.0]}],
        "yaw": "along_path",
    }
    scenario = load_scenario("hover").replace({"reference": there_and_back, "duration": 14.0})
    heading, _, _ = flown(scenario)
    assert heading.min() > -1e-6
    assert heading[-1] == pytest.approx(math.pi, abs=1e-6)
    assert np.degrees(np.abs(np.diff(heading))).max() / 0.05 < 100.0, "at half the rate"
    assert heading[round(2.0 / 0.05)] == pytest.approx(0.0, abs=1e-6), "not before it is due"


def test_without_speed_the_heading_is_held() -> None:
    climb = {"type": "waypoints", "points": [{"position": [0.0, 0.0, 5.0]}], "yaw": "along_path"}
    scenario = load_scenario("hover").replace({"reference": climb, "initial.euler": [0.0, 0.0, 50.0], "duration": 6.0})
    heading, _, _ = flown(scenario)
    np.testing.assert_allclose(np.degrees(heading), 50.0)


def test_the_filter_does_not_delay_it() -> None:
    fast = flown(looking("figure-eight"))[0]
    filtered, direction, speed = flown(looking("figure-eight", **{"reference.response_time": 1.5}))
    error = np.abs(np.remainder(filtered - direction + math.pi, math.tau) - math.pi)
    assert np.degrees(error[speed > 0.5 * speed.max()]).max() < 2.0
    assert np.abs(filtered - fast).max() > 0.1, "the filtered path is another one"


def test_a_course_that_turns_back_looks_back() -> None:
    scenario = looking("waypoints", **{"reference.repeat": 9.0, "duration": 40.0, "constraints": []})
    heading, direction, speed = flown(scenario)
    error = np.abs(np.remainder(heading - direction + math.pi, math.tau) - math.pi)
    assert np.degrees(np.median(error[speed > 0.9 * speed.max()])) < 1.0


def test_the_reference_motion_has_the_heading_too() -> None:
    scenario = looking("torrente-loop4-ideal")
    assembly = Assembly(scenario)
    motion = assembly.motion
    assert motion is not None
    w, x, y, z = motion.attitude.T
    nose = np.arctan2(2.0 * (x * y + w * z), 1.0 - 2.0 * (y * y + z * z))
    turning = np.remainder(
        nose - assembly.course.sample(scenario.control_period * np.arange(len(nose)))[:, 3], math.tau
    )
    assert np.degrees(np.abs(np.remainder(turning + math.pi, math.tau) - math.pi)).max() < 15.0


def test_the_old_field_of_loops_means_the_same() -> None:
    old = load_scenario("figure-eight").replace({"reference.yaw_along_path": True})
    np.testing.assert_array_equal(flown(old)[0], flown(looking("figure-eight"))[0])


def test_a_law_that_flies_one_heading_is_told(tmp_path: Path) -> None:
    circle = load_scenario("hummingbird-real-rotors").replace(
        {"reference": {"type": "circle", "radius": 1.0, "period": 6.0, "ramp": 3.0, "yaw": "along_path"}}
    )
    (note,) = instability_notes(Assembly(circle))
    assert "a heading of" in note
    assert 'controller.type = "robust", controller.heading = true' in note


@pytest.mark.parametrize(
    ("name", "changes", "message"),
    [
        (
            "waypoints",
            {"reference.points.0.yaw": 10.0},
            'points.0.yaw must be absent where yaw = "along_path"; got 10.0',
        ),
        ("minimum-snap", {"reference.points.1.yaw": 20.0}, 'points.1.yaw must be absent where yaw = "along_path"'),
        ("waypoints", {"reference.yaw": "along"}, "reference.yaw"),
        ("waypoints", {"reference.yaw_rate": 0.0}, "reference.yaw_rate"),
    ],
)
def test_what_contradicts_it_is_refused(name: str, changes: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message.replace(".", r"\.")):
        looking(name, **changes)


def test_a_vertical_circle_has_no_direction_of_travel() -> None:
    with pytest.raises(InputError, match="yaw must be absent where plane is vertical"):
        load_scenario("power-loop").replace(ALONG)


def test_the_steps_of_the_rule() -> None:
    """A jump of one is turned evenly within its size over half the rate, half before and half after."""
    direction = np.where(np.arange(41) < 20, 0.0, 1.0)
    heading = turned(direction, 0.1, 0.0)
    assert heading[10:12].tolist() == pytest.approx([0.0, 0.05])
    assert heading[19] + heading[20] == pytest.approx(1.0, abs=0.06)
    assert np.diff(heading)[11:19].tolist() == pytest.approx([0.05] * 8)
    slope = 0.08 * np.arange(41)
    np.testing.assert_allclose(turned(slope, 0.1, 0.0), slope, atol=1e-12)
    assert limited(np.array([5.0, 5.0, -5.0]), 1.0, 0.0).tolist() == [0.0, 1.0, 0.0]
    still = directions(np.zeros((5, 3)), 0.02, 0.7)
    assert still.tolist() == [0.7] * 5
