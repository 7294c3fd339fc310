"""Where the default gains are from."""

from __future__ import annotations

import math

import numpy as np
import pytest

from quadsim.errors import ParameterError
from quadsim.mpc.laws.parts.bandwidths import SEPARATION, Bandwidths, bandwidths, lag_to_allow_for
from quadsim.vehicle import Vehicle


def test_at_20_hz_they_are_as_documented() -> None:
    k = bandwidths(period=0.05, lag=0.025)
    assert (k.rate, k.attitude, k.velocity, k.position) == pytest.approx((10.0, 5.0, 2.5, 1.25))
    assert (k.yaw_rate, k.yaw) == pytest.approx((4.0, 2.0))


def test_the_separation_is_every_characteristic_ratio() -> None:
    """Of the polynomial that the nested loops have, from position to rate."""
    k = bandwidths(period=0.05, lag=0.01)
    a = np.cumprod([1.0, k.rate, k.attitude, k.velocity, k.position])
    np.testing.assert_allclose(a[1:-1] ** 2 / (a[:-2] * a[2:]), SEPARATION)


def test_the_innermost_loop_has_the_damping_that_its_rule_promises() -> None:
    """An integrator with dead time theta under the gain 1 / (2 theta): 61 deg of phase margin, any theta."""
    for lag in (0.0, 0.025, 0.072):
        crossover = bandwidths(period=0.05, lag=lag).rate
        margin = 90.0 - math.degrees(crossover * (0.025 + lag))
        assert margin == pytest.approx(90.0 - math.degrees(0.5))


def test_slow_rotors_make_slow_loops(craft: Vehicle) -> None:
    lag = lag_to_allow_for(craft, 0.05)
    assert lag == max(0.025, craft.rotor_rise or 0.0, craft.rotor_fall or 0.0)


def test_a_bandwidth_is_positive() -> None:
    good = bandwidths(period=0.05, lag=0.025)
    with pytest.raises(ParameterError, match=r"controller\.attitude"):
        Bandwidths(**{**vars(good), "attitude": 0.0})
