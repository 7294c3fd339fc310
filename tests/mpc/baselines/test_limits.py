"""The bounds on speeds and slews that baselines are held to, and what is refused."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from mpc.answer import ActuatorBounds
from quadsim.vehicle import Vehicle

SPEEDS = st.lists(st.floats(0.0, 400.0), min_size=4, max_size=4).map(np.array)


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
