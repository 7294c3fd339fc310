"""When a vehicle is lost: each criterion by itself, and off."""

from __future__ import annotations

import math

import numpy as np
import pytest

from quadsim.errors import LostError
from quadsim.flight.phase import check_loss
from quadsim.state import INDEX, Array, make_state

LIMITS = {"tilt": 120.0, "distance": 100.0, "depth": 50.0, "speed": 30.0}


def state(**values: float) -> Array:
    """A state at the origin, level and at rest, but for what is given."""
    made = make_state()
    for name, value in values.items():
        made[INDEX[name]] = value
    return made


def loss(now: Array, *, limits: dict[str, float] = LIMITS, reference: Array | None = None, lowest: float = 0.0) -> str:
    """Which criterion is met; empty for none."""
    try:
        check_loss(limits, 1.5, now, np.zeros(4) if reference is None else reference, lowest)
    except LostError as error:
        return error.criterion
    return ""


@pytest.mark.parametrize(
    ("within", "beyond", "criterion"),
    [
        ({"roll": math.radians(119.9)}, {"roll": math.radians(-120.1)}, "tilt"),
        ({"roll": math.radians(180.0), "pitch": math.radians(119.0)}, {"pitch": math.radians(120.1)}, "tilt"),
        ({"x": 60.0, "y": -79.9}, {"x": -60.0, "y": 80.1}, "distance"),
        ({"z": 99.9}, {"z": 100.1}, "distance"),
        ({"z": -49.9}, {"z": -50.1}, "depth"),
        ({"vx": 10.0, "vy": -20.0, "vz": 19.9}, {"vx": 10.0, "vy": -20.0, "vz": -20.1}, "speed"),
    ],
)
def test_a_criterion_is_met_beyond_its_limit_and_never_where_it_is_off(
    within: dict[str, float], beyond: dict[str, float], criterion: str
) -> None:
    assert loss(state(**within)) == ""
    assert loss(state(**beyond)) == criterion
    assert loss(state(**beyond), limits={}) == ""
    limits = {name: limit for name, limit in LIMITS.items() if name != criterion}
    assert loss(state(**beyond), limits=limits) == ""


def test_distance_is_from_the_reference_and_depth_below_the_lowest_it_has_been() -> None:
    far = np.array([500.0, 0.0, 0.0, 0.0])
    assert loss(state(x=450.0), reference=far) == ""
    assert loss(state(x=0.0), reference=far) == "distance"
    assert loss(state(z=-90.0), lowest=-60.0) == ""


def test_the_reason_names_which_criterion_its_value_its_limit_and_the_time() -> None:
    with pytest.raises(LostError) as caught:
        check_loss(LIMITS, 1.5, state(roll=math.radians(131.0)), np.zeros(4), 0.0)
    reason = "at t = 1.500 s: lost: the thrust axis is tilted by 131 deg, beyond lost.tilt = 120 deg"
    assert str(caught.value) == reason
    assert (caught.value.criterion, caught.value.limit, caught.value.time) == ("tilt", 120.0, 1.5)
    assert caught.value.value == pytest.approx(131.0)
