"""`[reference]` of every type: what it becomes, and the messages for one that is wrong."""

from __future__ import annotations

import math
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support import scenario_table

from quadsim.errors import FileError
from quadsim.scenarios.assembly import Assembly
from quadsim.scenarios.courses.smoothing import smooth
from quadsim.scenarios.loading import load_scenario, parse_scenario
from quadsim.scenarios.schema.scenario import Scenario
from quadsim.state import Array

INITIAL = (1.0, -2.0, 3.0)
POINTS = [{"position": [4.0, 2.0, 3.0], "yaw": 90.0}, {"position": [4.0, 2.0, 5.0]}]
TABLE = "t,x,y,z,yaw\n1,1,-2,3,0.5\n3,5,-2,3,0.5\n"

REFERENCES: dict[str, dict[str, Any]] = {
    "steps": {"x": [{"start": 1.0, "stop": 3.0, "value": 2.0}]},
    "waypoints": {"points": POINTS, "speed": 2.0},
    "minimum_snap": {"points": POINTS, "speed": 1.0},
    "circle": {"radius": 2.0, "speed": 1.0},
    "helix": {"radius": 2.0, "period": 8.0, "climb": 1.5, "turns": -2.0},
    "figure_eight": {"length": 4.0, "period": 12.0},
    "yaw_turns": {"turns": [{"start": 1.0, "yaw": 180.0, "rate": 45.0}]},
}


def scenario(kind: str, euler: tuple[float, float, float] = (0.0, 0.0, 30.0), **fields: Any) -> Scenario:
    """A short scenario with a course of one type, its fields those of `REFERENCES` but for what is given."""
    reference = {"type": kind, **REFERENCES.get(kind, {}), **fields}
    reference = {name: value for name, value in reference.items() if value is not None}
    initial = {"position": list(INITIAL), "euler": list(euler)}
    return parse_scenario(scenario_table() | {"initial": initial, "reference": reference})


def sampled(kind: str, *times: float, **fields: Any) -> Array:
    return Assembly(scenario(kind, **fields)).course.sample(np.array(times))


# --- what is right -------------------------------------------------------------------------------------------------


def test_a_course_that_repeats_starts_again_where_it_is_closed_and_else_turns_back() -> None:
    t = np.linspace(0.0, 4.95, 100)
    out = sampled("waypoints", *t, repeat=5.0)
    np.testing.assert_allclose(out, sampled("waypoints", *t), atol=1e-12, err_msg="its first round")
    np.testing.assert_allclose(sampled("waypoints", *(10.0 - t), repeat=5.0), out, atol=1e-9)
    np.testing.assert_allclose(sampled("waypoints", *(20.0 + t), repeat=5.0), out, atol=1e-9)
    there = [*POINTS, {"position": list(INITIAL), "yaw": 390.0}]
    closed = sampled("waypoints", *t, points=there, repeat=10.0)
    np.testing.assert_allclose(sampled("waypoints", *(10.0 + t), points=there, repeat=10.0), closed, atol=1e-9)
    np.testing.assert_allclose(sampled("waypoints", 10.0 - 1e-6, points=there, repeat=10.0)[0, :3], INITIAL, atol=1e-4)
    steps = Assembly(scenario("steps", repeat=2.0)).course
    assert steps.sample(np.array([0.5, 1.5, 2.5, 3.5, 4.5, 5.5]))[:, 0].tolist() == [1.0, 2.0, 2.0, 1.0, 1.0, 2.0]
    assert math.isinf(steps.end)


def test_jumps_and_kinks_of_a_course_that_repeats_are_those_of_every_round() -> None:
    flown = scenario("steps", repeat=2.0).replace({"duration": 6.0})
    assert Assembly(flown).course.jumps == (1.0, 3.0, 5.0)
    legs = scenario("waypoints", repeat=5.0, start=1.0).replace({"duration": 12.0})
    kinks = Assembly(legs).course.kinks
    t = np.array(kinks)
    assert {0.0, 1.0, 5.0, 9.0, 10.0, 11.0} <= set(kinks)
    first = t[t <= 5.0]
    np.testing.assert_allclose(np.sort(10.0 - first), t[(t >= 5.0) & (t <= 10.0)])


@pytest.mark.parametrize("kind", [kind for kind in REFERENCES if kind != "steps"])
def test_every_course_begins_at_the_initial_position_and_stays_at_its_end(kind: str) -> None:
    course = Assembly(scenario(kind)).course
    np.testing.assert_allclose(course.sample(np.zeros(1))[0, :3], INITIAL, atol=1e-12)
    np.testing.assert_allclose(course.initial, [*INITIAL, math.radians(30.0)])
    last = course.kinks[-1]
    ends = course.sample(np.array([last, last + 0.05, 1e5]))
    np.testing.assert_allclose(ends, ends[[0, 0, 0]], rtol=0.0, atol=1e-12)


@pytest.mark.parametrize("kind", ["waypoints", "minimum_snap", "circle", "helix", "figure_eight"])
def test_every_course_waits_for_its_start(kind: str) -> None:
    t = np.arange(0.0, 20.0, 0.05)
    at_once = Assembly(scenario(kind)).course
    later = Assembly(scenario(kind, start=2.5)).course
    np.testing.assert_allclose(later.sample(t + 2.5), at_once.sample(t), atol=1e-12)
    np.testing.assert_array_equal(later.sample(np.array([0.0, 1.0, 2.45])), np.tile(later.initial, (3, 1)))


@pytest.mark.parametrize("kind", REFERENCES)
def test_every_course_passes_through_the_filter_from_its_initial_pose(kind: str) -> None:
    course = Assembly(scenario(kind)).course
    t = 0.05 * np.arange(100)
    reference = Assembly(scenario(kind, response_time=2.0)).reference(100)
    for column in range(4):
        expected = smooth(course.sample(t)[:, column], initial=course.initial[column], response_time=2.0, period=0.05)
        np.testing.assert_array_equal(reference[:, column], expected)


def test_waypoints_keep_a_yaw_that_is_not_given_and_take_their_own_speed() -> None:
    points = [{"position": [1.0, -2.0, 7.0]}, {"position": [1.0, 0.0, 7.0], "yaw": -90.0, "speed": 0.5, "hold": 1.0}]
    poses = sampled("waypoints", 2.0, 4.0, 6.0, 7.0, points=points)
    np.testing.assert_allclose(poses[:, :3], [[1, -2, 7], [1, -1, 7], [1, 0, 7], [1, 0, 7]], atol=1e-12)
    np.testing.assert_allclose(np.degrees(poses[:, 3]), [30.0, -30.0, -90.0, -90.0])


def test_minimum_snap_passes_its_points_when_its_speed_or_its_times_require() -> None:
    for fields in ({"speed": 0.5}, {"speed": None, "times": [10.0, 14.0]}):
        poses = sampled("minimum_snap", 10.0, 14.0, **fields)
        np.testing.assert_allclose(poses[:, :3], [[4, 2, 3], [4, 2, 5]], atol=1e-10)
        np.testing.assert_allclose(np.degrees(poses[:, 3]), 90.0)


def test_a_circle_is_about_its_centre_or_begins_where_the_vehicle_is() -> None:
    t = np.linspace(0.0, 17.0, 60)
    free = Assembly(scenario("circle", angle=90.0)).course.sample(t)
    np.testing.assert_allclose(np.linalg.norm(free[:, :2] - [1.0, -4.0], axis=1), 2.0)
    course = Assembly(scenario("circle", centre=[5.0, 5.0], height=1.0, angle=180.0, yaw=-45.0)).course
    np.testing.assert_allclose(course.sample(np.zeros(1)), [[3.0, 5.0, 1.0, math.radians(-45.0)]], atol=1e-12)
    assert course.jumps == (0.0,)
    assert Assembly(scenario("circle")).course.jumps == ()


def test_speed_is_that_at_full_speed_for_every_loop() -> None:
    for kind, fields in (
        ("circle", {}),
        ("helix", {"period": None, "speed": 1.0}),
        ("figure_eight", {"period": None, "speed": 1.0, "turns": 3.0}),
    ):
        t = np.arange(5.5, 12.0, 1e-3)
        poses = Assembly(scenario(kind, **fields)).course.sample(t)
        fastest = np.linalg.norm(np.diff(poses[:, :3], axis=0), axis=1).max() / 1e-3
        assert fastest == pytest.approx(1.0, rel=1e-4), kind


def test_yaw_turns_are_in_degrees_and_leave_the_position() -> None:
    poses = sampled("yaw_turns", 0.5, 2.0, 10.0)
    np.testing.assert_allclose(np.degrees(poses[:, 3]), [30.0, 75.0, 180.0])
    np.testing.assert_array_equal(poses[:, :3], np.tile(INITIAL, (3, 1)))


# --- tables --------------------------------------------------------------------------------------------------------


def beside(tmp_path: Path, table: str = TABLE, **fields: str) -> Path:
    """A scenario file in a folder with its table."""
    (tmp_path / "course.csv").write_text(table)
    lines = [f'{name} = "{value}"' for name, value in ({"type": "csv", "file": "course.csv"} | fields).items()]
    text = load_scenario("hover").to_toml()
    begun = text.index("[reference]")
    ended = text.index("[controller]")
    path = tmp_path / "mine.toml"
    path.write_text(text[:begun] + "\n".join(["[reference]", "start = 0.5", *lines, "", text[ended:]]))
    return path


def test_a_table_is_found_beside_its_scenario_and_stored_by_its_whole_path_and_hash(tmp_path: Path) -> None:
    made = load_scenario(str(beside(tmp_path)))
    assert made.reference.type == "csv"
    assert made.reference.file == str(tmp_path / "course.csv")
    again = parse_scenario(tomllib.loads(made.to_toml()))
    assert again == made
    poses = Assembly(again).course.sample(np.array([0.0, 1.45, 1.5, 2.5, 3.5, 9.0]))
    np.testing.assert_allclose(poses[:, 0], [0.0, 0.0, 1.0, 3.0, 5.0, 5.0])  # row 1 is at 1 s, and start at 0.5 s
    np.testing.assert_allclose(poses[-1], [5.0, -2.0, 3.0, 0.5])  # yaw in radians


def test_a_table_that_changed_after_the_scenario_was_resolved_is_refused(tmp_path: Path) -> None:
    made = load_scenario(str(beside(tmp_path)))
    (tmp_path / "course.csv").write_text(TABLE.replace("5,-2", "6,-2"))
    with pytest.raises(FileError, match=r"course\.csv"):
        _ = Assembly(made).course
