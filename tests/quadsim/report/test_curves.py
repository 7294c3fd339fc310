"""The least span of an axis, and gaps where angles wrap."""

import numpy as np
import pytest

from quadsim.report.curves import LEAST_SPANS, break_at_wraps, least_range


@pytest.mark.parametrize(("unit", "span"), LEAST_SPANS.items())
def test_rounding_is_shown_as_a_line_at_the_middle_of_the_least_span(unit: str, span: float) -> None:
    rounding = 1e-12 * np.sin(np.arange(50.0))
    assert least_range([rounding, rounding[:3]], unit) == (-0.5 * span, 0.5 * span)
    low, high = least_range([1.5 + rounding], unit) or (0.0, 0.0)
    assert (low, high) == pytest.approx((1.5 - 0.5 * span, 1.5 + 0.5 * span))


def test_curves_that_move_apart_from_one_another_or_have_no_unit_fit_their_axis_to_them() -> None:
    assert least_range([np.zeros(5), np.ones(5)], "m") is None
    assert least_range([np.zeros(5), np.array([np.nan, np.inf, 1e-9])], "m") is not None
    assert least_range([np.zeros(5), np.array([0.02])], "m") is None
    assert least_range([np.zeros(5)], "N") is None
    assert least_range([], "m") is None
    assert least_range([np.full(4, np.nan)], "deg") is None


def test_an_angle_has_a_gap_at_each_wrap_and_only_there() -> None:
    t = np.linspace(0.0, 2.0, 201)
    wrapped = (360.0 * t + 180.0) % 360.0 - 180.0  # two turns in two seconds
    times, values = break_at_wraps(t, wrapped, "deg")
    gaps = np.isnan(values)
    assert np.count_nonzero(gaps) == 2
    np.testing.assert_allclose(times[gaps], [0.495, 1.495])
    assert np.all(np.diff(times) > 0.0)
    np.testing.assert_array_equal(values[~gaps], wrapped)
    np.testing.assert_array_equal(times[~gaps], t)
    assert np.nanmax(np.abs(np.diff(values))) < 4.0, "no line across the panel is left"


def test_what_is_no_angle_does_not_wrap() -> None:
    t, jump = np.arange(4.0), np.array([0.0, 0.0, 900.0, 900.0])
    for curve in break_at_wraps(t, jump, "rad/s"):
        assert curve.size == 4
    assert break_at_wraps(t, jump, "deg")[1].size == 5
