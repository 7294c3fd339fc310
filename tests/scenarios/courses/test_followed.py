"""The reference as it is followed, against the filter of the whole course and of the set-points that leave it."""

from __future__ import annotations

import math

import numpy as np
import pytest

from quadsim.scenarios.assembly import Assembly
from quadsim.scenarios.courses.followed import FollowedCourse
from quadsim.scenarios.feasibility_check import report
from quadsim.scenarios.loading import load_scenario
from quadsim.scenarios.schema.scenario import Scenario
from quadsim.state import Array

SAMPLES = 700


def rows(followed: FollowedCourse, count: int = SAMPLES) -> Array:
    return np.array([followed.row(k) for k in range(count)])


@pytest.mark.parametrize("name", ["paper-constrained", "figure-eight", "csv-trefoil", "minimum-snap", "nonlinear"])
def test_without_set_points_it_is_the_filtered_course(name: str) -> None:
    scenario = load_scenario(name)
    followed = Assembly(scenario).followed()
    np.testing.assert_array_equal(rows(followed), Assembly(scenario).reference(SAMPLES))
    np.testing.assert_array_equal(followed.preview(10, 50), Assembly(scenario).reference(SAMPLES)[11:61])


def test_a_set_point_runs_the_filter_on_from_its_row() -> None:
    scenario = load_scenario("paper-constrained")
    course = Assembly(scenario).course
    tau_r = scenario.reference.response_time
    tau_s = scenario.control_period
    keep = math.exp(-3.0 * tau_s / tau_r)
    followed = Assembly(scenario).followed()
    before = Assembly(scenario).reference(SAMPLES)
    preview = followed.preview(100, 50)
    followed.set(100, {"x": 2.0})
    followed.set(300, {"yaw": -1.0, "x": 0.5})
    result = rows(followed)
    expected = course.sample(tau_s * np.arange(SAMPLES))
    expected[101:, 0] = 2.0
    expected[301:, 0] = 0.5
    expected[301:, 3] = -1.0
    last = course.initial
    for k, sample in enumerate(expected):
        expected[k] = last = sample + keep * (last - sample)
    np.testing.assert_array_equal(result, expected)
    np.testing.assert_array_equal(result[:101], before[:101])  # what was in force stays
    np.testing.assert_array_equal(result[:, 1:3], before[:, 1:3])  # the other axes stay on the course
    np.testing.assert_array_equal(preview, before[101:151])  # what was known then
    assert (followed.preview(300, 3)[:, 0] == result[301:304, 0]).all()
    setpoints = [(100, {"x": 2.0}), (300, {"yaw": -1.0, "x": 0.5})]
    _, flown = Assembly(scenario).followed().flown(SAMPLES, setpoints)  # with all of them known
    np.testing.assert_array_equal(flown, result)


def test_without_a_response_time_a_set_point_is_reached_at_once() -> None:
    followed = Assembly(load_scenario("hover", ["reference.response_time=0.0"])).followed()
    before = followed.row(0)[2]
    followed.set(5, {"z": 3.0})
    assert rows(followed, 10)[:, 2].tolist() == [before] * 6 + [3.0] * 4


def with_setpoint(at: float, axes: str = "x=0.1") -> Scenario:
    return load_scenario("paper-constrained", [f"events=[{{type='setpoint', at={at}, {axes}}}]"])


def test_what_is_reported_of_a_course_is_what_was_followed_of_it() -> None:
    plain = load_scenario("paper-constrained")
    assert {step.channel for step in Assembly(plain).course_steps} == {"x", "y", "z", "yaw"}
    assert {step.channel for step in Assembly(with_setpoint(5.0)).course_steps} == {"y", "z", "yaw"}
    whole = report(Assembly(plain))
    nearly = report(Assembly(with_setpoint(59.9)))
    assert nearly.tilt == whole.tilt
    assert report(Assembly(with_setpoint(0.05))).tilt > 0.9 * whole.tilt  # y steps by 10 m as before
    assert report(Assembly(with_setpoint(0.05, "x=0.1, y=0.1"))).tilt < 0.1 * whole.tilt
