"""Waypoints and turns: straight, at the speed given, and for as long as it takes."""

from __future__ import annotations

import math

import numpy as np
import pytest

from scenarios.courses.course import begin
from scenarios.courses.legs import Turn, Waypoint, polyline, waypoints, yaw_turns

START = np.array([1.0, 0.0, 2.0, 0.0])


def point(x: float, y: float, z: float, yaw: float = 0.0, *, speed: float = 1.0, hold: float = 0.0) -> Waypoint:
    return Waypoint(pose=np.array([x, y, z, yaw]), speed=speed, hold=hold)


def test_legs_take_the_time_of_their_length_and_speed_and_holds_last() -> None:
    path = waypoints(START, [point(4.0, 4.0, 2.0, 1.0, speed=2.0, hold=3.0), point(4.0, 4.0, 0.0, -1.0, speed=0.5)])
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
    path = waypoints(START, [point(1.0, 0.0, 2.0, hold=1.0), point(2.0, 0.0, 2.0)])
    assert path.kinks == (0.0, 1.0, 2.0)
    turned = waypoints(START, [point(1.0, 0.0, 2.0, 0.5), point(2.0, 0.0, 2.0, 0.5)])
    assert begin(turned, start=3.0, initial=START).jumps == (3.0,)
    assert waypoints(START, [point(1.0, 0.0, 2.0)]).duration == 0.0


def test_turns_begin_when_they_should_and_turn_at_their_rate() -> None:
    path = yaw_turns(START, [Turn(start=1.0, yaw=2.0, rate=0.5), Turn(start=8.0, yaw=-1.0, rate=1.0)])
    poses = path.pose(np.array([0.0, 1.0, 3.0, 5.0, 8.0, 9.5, 11.0]))
    np.testing.assert_allclose(poses[:, 3], [0.0, 0.0, 1.0, 2.0, 2.0, 0.5, -1.0])
    np.testing.assert_array_equal(poses[:, :3], np.tile(START[:3], (7, 1)))


def test_a_turn_cuts_off_one_that_is_not_over() -> None:
    path = yaw_turns(START, [Turn(start=0.0, yaw=2.0 * math.pi, rate=1.0), Turn(start=2.0, yaw=0.0, rate=0.5)])
    np.testing.assert_allclose(path.pose(np.array([1.0, 2.0, 4.0, 6.0]))[:, 3], [1.0, 2.0, 1.0, 0.0])
    assert path.kinks == (0.0, 2.0, 6.0)


def test_a_course_is_the_initial_pose_then_the_path_then_its_end() -> None:
    path = polyline(np.array([0.0, 2.0]), np.array([[5.0, 0.0, 0.0, 0.0], [7.0, 0.0, 0.0, 0.0]]))
    course = begin(path, start=0.35, initial=START)
    t = np.array([0.0, 0.3, 7 * 0.05, 1.35, 2.35, 100.0])
    np.testing.assert_allclose(course.sample(t)[:, 0], [1.0, 1.0, 5.0, 6.0, 7.0, 7.0])
    assert course.jumps == (0.35,)
    assert course.kinks == pytest.approx((0.35, 2.35))
    assert begin(path, start=0.35, initial=np.array([5.0, 0.0, 0.0, 0.0])).jumps == ()
