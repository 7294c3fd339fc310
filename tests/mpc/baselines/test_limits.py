"""The bounds on speeds and slews that baselines are held to, and what is refused."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mpc.answer import ActuatorBounds
from mpc.baselines.limits import require_positive, require_within
from quadsim.errors import ParameterError
from quadsim.vehicle import Vehicle

SPEEDS = st.lists(st.floats(0.0, 400.0), min_size=4, max_size=4).map(np.array)


@pytest.mark.parametrize(
    ("pairs", "message"),
    [
        (((250.0, 0.0),), r"controller\.u_min must be finite and below a finite u_max"),
        (((0.0, math.inf),), r"controller\.u_min must be finite and below a finite u_max"),
        (((-1.0, 250.0),), r"controller\.u_min must be at least 0 rad/s: rotors turn one way"),
        (((0.0, 250.0), (math.nan, 5.0)), r"controller\.delta_min must be 4 numbers"),
        (((0.0, 250.0), (1.0, 5.0)), r"controller\.delta_min must be <= 0 and .* so that a speed can be held"),
    ],
)
def test_wrong_bounds_are_named(pairs: tuple[tuple[float, float], ...], message: str) -> None:
    with pytest.raises(ParameterError, match=message):
        ActuatorBounds.alike(*pairs)


@given(before=SPEEDS)
def test_speeds_within_reach_keep_the_speed_bounds_and_the_slews_where_both_can_hold(before: np.ndarray) -> None:
    lower, upper = ActuatorBounds.alike((50.0, 250.0), (-10.0, 5.0)).reach(before)
    assert (lower >= 50.0).all()
    assert (upper <= 250.0).all()
    assert (lower <= upper).all()
    inside = (before >= 50.0) & (before <= 250.0)
    assert (lower[inside] - before[inside] >= -10.0 - 1e-9).all()
    assert (upper[inside] - before[inside] <= 5.0 + 1e-9).all()


def test_a_vehicle_s_own_bounds_are_the_speeds_that_its_rotors_hold(craft: Vehicle) -> None:
    lower, upper = ActuatorBounds.of_vehicle(craft).reach(np.full(4, craft.hover_speed))
    np.testing.assert_array_equal(lower, craft.speed_min)
    np.testing.assert_array_equal(upper, craft.speed_max)


@pytest.mark.parametrize("value", [0.0, -1.0, math.inf, math.nan])
def test_a_setting_that_is_not_positive_is_named(value: float) -> None:
    with pytest.raises(ParameterError, match=r"controller\.gain must be positive and finite"):
        require_positive("gain", value)
    with pytest.raises(ParameterError, match=r"controller\.share must be between 0\.1 and 0\.9"):
        require_within("share", value, 0.1, 0.9)
