"""Waypoints and turns: straight, at the speed given, and for as long as it takes."""

from __future__ import annotations

import math

import numpy as np
import pytest

from quadsim.errors import ParameterError
from quadsim.scenarios.courses.course import Path, begin
from quadsim.scenarios.courses.legs import Turn, Waypoint, Waypoints, YawTurns, polyline

START = np.array([1.0, 0.0, 2.0, 0.0])


def point(x: float, y: float, z: float, yaw: float = 0.0, *, speed: float = 1.0, hold: float = 0.0) -> Waypoint:
    return Waypoint(position=(x, y, z), yaw=math.degrees(yaw), speed=speed, hold=hold)


def waypoints(*points: Waypoint) -> Path:
    return Waypoints(type="waypoints", points=points).path(START, 9.81)


def test_legs_take_the_time_of_their_length_and_speed_and_holds_last() -> None:
    path = waypoints(point(4.0, 4.0, 2.0, 1.0, speed=2.0, hold=3.0), point(4.0, 4.0, 0.0, -1.0, speed=0.5))
    assert path.kinks == (0.0, 2.5, 5.5, 9.5)
    assert path.duration == 9.5
    t = np.array([0.0, 1.25, 2.5, 4.0, 5.5, 7.5, 9.5])
    expected = [
        START,
        [2.5, 2.0, 2.0, 0.5],
        [4.0, 4.0, 2.0, 1.0],
        [4.0, 4.0, 2.0, 1.0],
        [4.0, 4.0, 2.0, 1.0],
        [4.0, 4.0, 1.0, 0.0],
        [4.0, 4.0, 0.0, -1.0],
    ]
    np.testing.assert_allclose(path.pose(t), expected, atol=1e-12)


def test_a_first_point_at_the_start_takes_no_time() -> None:
    path = waypoints(point(1.0, 0.0, 2.0, hold=1.0), point(2.0, 0.0, 2.0))
    assert path.kinks == (0.0, 1.0, 2.0)
    turned = waypoints(point(1.0, 0.0, 2.0, 0.5), point(2.0, 0.0, 2.0, 0.5))
    assert begin(turned, start=3.0, initial=START).jumps == (3.0,)
    assert waypoints(point(1.0, 0.0, 2.0)).duration == 0.0


def test_turns_begin_when_they_should_and_turn_at_their_rate() -> None:
    turns = (Turn(start=1.0, yaw=200.0, rate=50.0), Turn(start=8.0, yaw=-100.0, rate=100.0))
    poses = YawTurns(type="yaw_turns", turns=turns).build(START, 9.81).sample(np.array([0, 1, 3, 5, 8, 9.5, 11]))
    np.testing.assert_allclose(np.degrees(poses[:, 3]), [0, 0, 100, 200, 200, 50, -100], atol=1e-12)
    np.testing.assert_array_equal(poses[:, :3], np.tile(START[:3], (7, 1)))


def test_a_turn_cuts_off_one_that_is_not_over() -> None:
    turns = (Turn(start=0.0, yaw=360.0, rate=50.0), Turn(start=2.0, yaw=0.0, rate=25.0))
    course = YawTurns(type="yaw_turns", turns=turns).build(START, 9.81)
    np.testing.assert_allclose(np.degrees(course.sample(np.array([1, 2, 4, 6.0]))[:, 3]), [50, 100, 50, 0], atol=1e-12)
    assert course.kinks == pytest.approx((0.0, 2.0, 6.0))


def test_a_course_is_the_initial_pose_then_the_path_then_its_end() -> None:
    path = polyline(np.array([0.0, 2.0]), np.array([[5.0, 0.0, 0.0, 0.0], [7.0, 0.0, 0.0, 0.0]]))
    course = begin(path, start=0.35, initial=START)
    t = np.array([0.0, 0.3, 7 * 0.05, 1.35, 2.35, 100.0])
    np.testing.assert_allclose(course.sample(t)[:, 0], [1.0, 1.0, 5.0, 6.0, 7.0, 7.0])
    assert course.jumps == (0.35,)
    assert course.kinks == pytest.approx((0.35, 2.35))
    assert begin(path, start=0.35, initial=np.array([5.0, 0.0, 0.0, 0.0])).jumps == ()


def test_times_take_the_place_of_every_speed() -> None:
    points = (Waypoint(position=(4.0, 4.0, 2.0), hold=1.0), Waypoint(position=(4.0, 4.0, 0.0)))
    path = Waypoints(type="waypoints", points=points, times=(2.0, 5.0)).path(START, 9.81)
    assert path.kinks == (0.0, 2.0, 3.0, 5.0)
    np.testing.assert_allclose(path.pose(np.array([1.0, 2.5, 4.0]))[:, :3], [[2.5, 2.0, 2.0], [4, 4, 2], [4, 4, 1]])


@pytest.mark.parametrize(
    ("times", "fields", "message"),
    [
        ((2.0,), {}, "times must be a list of 2 times, one for each point"),
        ((2.0, 2.5), {}, r"times\.1 must be 3\.001 s or later"),
        ((2.0, 5.0), {"speed": 3.0}, r"points\.0\.speed must be absent where times are given; got 3\.0"),
    ],
)
def test_times_that_do_not_fit_the_points_are_refused(
    times: tuple[float, ...], fields: dict[str, float], message: str
) -> None:
    points = (Waypoint(position=(4.0, 4.0, 2.0), hold=1.0, **fields), Waypoint(position=(4.0, 4.0, 0.0)))
    with pytest.raises(ParameterError, match=message):
        Waypoints(type="waypoints", points=points, times=times)
