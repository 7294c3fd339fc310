"""The curves of a flight's effects, the least span of an axis, and gaps where angles wrap."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support import small_log

from quadsim.flight.log import FlightLog
from quadsim.report.figure import LEAST_SPANS, break_at_wraps, commanded_speeds, effect_curves, least_range
from quadsim.state import Array


def log_with(*, speeds: Array | float = 0.0, wrench: Array | None = None, wind: Array | None = None) -> FlightLog:
    """Four periods of 0.1 s with five plant rows each, and one at the end; ideal but for what is given."""
    log = small_log(4, steps=5)
    held = np.concatenate([np.repeat(log.control.speeds, 5, axis=0), log.control.speeds[-1:]])
    return replace(log, plant=replace(log.plant, speeds=held + speeds, wrench=wrench, wind=wind))


def test_forces_torques_and_wind_have_curves_unless_they_are_zero_throughout() -> None:
    assert effect_curves(log_with()) == []
    wrench = np.zeros((21, 6))
    assert effect_curves(log_with(wrench=wrench, wind=np.zeros((21, 3)))) == []
    wrench[7, 4] = 0.5
    (torque,) = effect_curves(log_with(wrench=wrench))
    np.testing.assert_array_equal(torque.values, wrench[:, 3:])
    curves = effect_curves(log_with(wrench=np.ones((21, 6)), wind=np.ones((21, 3))))
    assert [(entry.key, entry.unit) for entry in curves] == [("force", "N"), ("torque", "N m"), ("wind", "m/s")]
    empty = replace(small_log(0), plant=replace(small_log(0).plant, wrench=None, wind=None))
    assert (commanded_speeds(empty), effect_curves(empty)) == (None, [])


def test_commands_hold_for_their_period_where_they_differ_from_the_speeds() -> None:
    assert commanded_speeds(log_with(speeds=1e-9)) is None, "rounding"
    log = log_with(speeds=-3.0 * (np.arange(84) == 22).reshape(21, 4))
    commanded = commanded_speeds(log)
    assert commanded is not None
    np.testing.assert_array_equal(commanded, log_with().plant.speeds)


@pytest.mark.parametrize(("unit", "span"), LEAST_SPANS.items())
def test_rounding_is_shown_as_a_line_at_the_middle_of_the_least_span(unit: str, span: float) -> None:
    rounding = 1e-12 * np.sin(np.arange(50.0))
    assert least_range([rounding, rounding[:3]], unit) == (-0.5 * span, 0.5 * span)
    assert least_range([1.5 + rounding], unit) == pytest.approx((1.5 - 0.5 * span, 1.5 + 0.5 * span))


def test_curves_that_move_apart_from_one_another_or_have_no_unit_fit_their_axis_to_them() -> None:
    assert least_range([np.zeros(5), np.ones(5)], "m") is None
    assert least_range([np.zeros(5), np.array([np.nan, np.inf, 1e-9])], "m") is not None
    assert least_range([np.zeros(5), np.array([0.02])], "m") is None
    assert least_range([np.zeros(5)], "N") is None
    assert least_range([], "m") is least_range([np.full(4, np.nan)], "deg") is None


def test_an_angle_has_a_gap_at_each_wrap_and_only_there() -> None:
    t = np.linspace(0.0, 2.0, 201)
    wrapped = (360.0 * t + 180.0) % 360.0 - 180.0  # two turns in two seconds
    times, values = break_at_wraps(t, wrapped, "deg")
    gaps = np.isnan(values)
    np.testing.assert_allclose(times[gaps], [0.495, 1.495])
    np.testing.assert_array_equal(values[~gaps], wrapped)
    np.testing.assert_array_equal(times[~gaps], t)
    assert break_at_wraps(t, wrapped, "rad/s")[1].size == t.size
