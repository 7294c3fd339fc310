"""Thrust near the ground, against Cheeseman and Bennett's formula."""

import pytest

from quadsim.sim.effects.forces import LOWEST_RATIO, thrust_ratio


@pytest.mark.parametrize(("ratio", "expected"), [(0.5, 4.0 / 3.0), (1.0, 16.0 / 15.0), (2.0, 64.0 / 63.0)])
@pytest.mark.parametrize("radius", [0.02, 0.125])
def test_the_ratio_depends_on_heights_in_radii(ratio: float, expected: float, radius: float) -> None:
    assert thrust_ratio(ratio * radius, radius) == pytest.approx(expected, rel=1e-12)


def test_far_from_the_ground_there_is_no_effect() -> None:
    """The excess falls with the square of the height."""
    assert thrust_ratio(100.0, 0.125) - 1.0 == pytest.approx((0.125 / 400.0) ** 2, rel=1e-5)
    assert thrust_ratio(10.0, 0.125) - 1.0 == pytest.approx(100.0 * (thrust_ratio(100.0, 0.125) - 1.0), rel=1e-3)


@pytest.mark.parametrize("height", [0.9 * LOWEST_RATIO, 0.25, 0.1, 0.0, -1.0])
def test_below_where_the_formula_holds_the_ratio_stays(height: float) -> None:
    """At a quarter of the radius the formula is singular, and negative below."""
    assert thrust_ratio(height, 1.0) == thrust_ratio(LOWEST_RATIO, 1.0)
