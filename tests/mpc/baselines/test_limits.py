"""Bounds on speeds and slews, and what is refused."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mpc.baselines.limits import InputBounds
from quadsim.errors import ParameterError

SPEEDS = st.lists(st.floats(0.0, 400.0), min_size=4, max_size=4).map(np.array)


@pytest.mark.parametrize(
    ("pair", "message"),
    [
        ({"speed": (250.0, 0.0)}, "controller.speed must be two finite numbers, the lower one first"),
        ({"speed": (0.0, math.inf)}, "controller.speed must be two finite numbers"),
        ({"slew": (math.nan, 5.0)}, "controller.slew must be two finite numbers"),
        ({"speed": (-1.0, 250.0)}, "controller.speed must be at least 0 rad/s"),
        ({"slew": (1.0, 5.0)}, "controller.slew must be one that a held speed, 0, is within"),
    ],
)
def test_wrong_bounds_are_named(pair: dict[str, Any], message: str) -> None:
    with pytest.raises(ParameterError, match=message):
        InputBounds(**pair)


@given(before=SPEEDS)
def test_speeds_within_reach_keep_the_speed_bounds_and_the_slews_where_both_can_hold(before: np.ndarray) -> None:
    lower, upper = InputBounds(speed=(50.0, 250.0), slew=(-10.0, 5.0)).reach(before)
    assert (lower >= 50.0).all()
    assert (upper <= 250.0).all()
    assert (lower <= upper).all()
    inside = (before >= 50.0) & (before <= 250.0)
    assert (lower[inside] - before[inside] >= -10.0 - 1e-9).all()
    assert (upper[inside] - before[inside] <= 5.0 + 1e-9).all()


def test_without_bounds_rotors_turn_at_any_speed_one_way() -> None:
    lower, upper = InputBounds().reach(np.full(4, 100.0))
    np.testing.assert_array_equal(lower, 0.0)
    np.testing.assert_array_equal(upper, math.inf)
