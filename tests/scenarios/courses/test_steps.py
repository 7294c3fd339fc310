"""Eqs. (30)-(31): the steps, their filter, and where each starts."""

from __future__ import annotations

import math

import numpy as np

from quadsim.scenarios.assembly import Assembly
from quadsim.scenarios.courses.smoothing import smooth
from quadsim.scenarios.courses.steps import Window, steps, switches
from quadsim.scenarios.loading import load_scenario

PERIOD = 0.05


def test_a_window_holds_strictly_between_its_instants() -> None:
    """Eq. (30) prints strict inequalities on both sides: the switching instants themselves are outside."""
    t = np.array([9.95, 10.0, 10.05, 39.95, 40.0, 40.05])
    held = steps(t, [Window(start=10.0, stop=40.0, value=10.0)], 2.0)
    np.testing.assert_array_equal(held, [2.0, 2.0, 10.0, 10.0, 2.0, 2.0])


def test_the_switching_instant_is_outside_whatever_rounding_makes_of_it() -> None:
    t = np.arange(2000) * PERIOD
    for k in range(1, 1990):
        held = steps(t, [Window(start=round(k * PERIOD, 9), stop=round((k + 2) * PERIOD, 9), value=1.0)], 0.0)
        assert np.flatnonzero(held).tolist() == [k + 1]


def test_later_windows_win_where_they_overlap() -> None:
    windows = [Window(start=0.0, stop=4.0, value=1.0), Window(start=1.0, stop=3.0, value=2.0)]
    np.testing.assert_array_equal(steps(np.arange(5.0), windows, 0.0), [0.0, 1.0, 2.0, 1.0, 0.0])


def test_a_course_switches_where_its_value_does() -> None:
    windows = [Window(start=0.0, stop=4.0, value=1.0), Window(start=1.0, stop=3.0, value=2.0)]
    result = switches(windows, 0.0, initial=0.0)
    assert result == [(0.0, 0.0, 1.0), (1.0, 1.0, 2.0), (3.0, 2.0, 1.0), (4.0, 1.0, 0.0)]
    touching = [Window(start=-1.0, stop=2.0, value=5.0), Window(start=2.0, stop=3.0, value=5.0)]
    assert switches(touching, 0.0, initial=5.0) == [(3.0, 5.0, 0.0)]
    assert switches([], 0.0, initial=0.5) == [(0.0, 0.5, 0.0)]


def test_the_steps_of_the_papers_course() -> None:
    """A step is watched until the next is within the preview of 50 periods, 2.5 s; yaw starts 30 deg off its course."""
    result = Assembly(load_scenario("paper-constrained")).course_steps
    rows = [(step.channel, step.time, step.before, step.after, step.until) for step in result]
    assert rows == [
        *(("x", 10.0, 0.0, 10.0, 37.5), ("x", 40.0, 10.0, 0.0, 60.0)),
        *(("y", 20.0, 0.0, 10.0, 37.5), ("y", 40.0, 10.0, 0.0, 60.0)),
        *(("z", 0.0, 0.0, 10.0, 37.5), ("z", 40.0, 10.0, 0.0, 60.0)),
        ("yaw", 0.0, math.radians(30.0), 0.0, 60.0),
    ]
    short = Assembly(load_scenario("paper-constrained", ["duration=15"])).course_steps
    assert [(step.channel, step.until) for step in short] == [("x", 15.0), ("z", 15.0), ("yaw", 15.0)]


def test_the_filter_is_the_first_order_lag_in_closed_form() -> None:
    """A step from a to b: F(k) = b + (a - b) exp(-3 (k + 1) tau_s / tau_r)."""
    response_time = 5.0
    k = np.arange(300)
    filtered = smooth(np.full(300, 10.0), initial=2.0, response_time=response_time, period=PERIOD)
    expected = 10.0 + (2.0 - 10.0) * np.exp(-3.0 * (k + 1) * PERIOD / response_time)
    np.testing.assert_allclose(filtered, expected, rtol=1e-12)


def test_the_paper_course_is_eq_30() -> None:
    reference = Assembly(load_scenario("paper-constrained", ["reference.response_time=0.0"])).reference(1200)
    t = np.round(np.arange(1200) * PERIOD, 9)
    for column, start in ((0, 10.0), (1, 20.0), (2, 0.0)):
        np.testing.assert_array_equal(reference[:, column], np.where((t > start) & (t < 40.0), 10.0, 0.0))
    assert not reference[:, 3].any()


def test_yaw_windows_are_in_degrees() -> None:
    settings = ["reference.yaw=[{start=0.0, stop=1.0, value=90.0}]", "reference.response_time=0.0"]
    reference = Assembly(load_scenario("paper-constrained", settings)).reference(3)
    np.testing.assert_allclose(reference[:, 3], [0.0, math.pi / 2, math.pi / 2])
