"""Which curves a flight's effects give."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from support import small_log

from quadsim.flight.log import FlightLog
from quadsim.report.curves import commanded_speeds, effect_curves
from quadsim.state import Array


def log_with(*, speeds: Array | None = None, wrench: Array | None = None, wind: Array | None = None) -> FlightLog:
    """Four periods of 0.1 s with five plant rows each, and one at the end; ideal but for what is given."""
    log = small_log(4, steps=5)
    held = np.concatenate([np.repeat(log.control.speeds, 5, axis=0), log.control.speeds[-1:]])
    plant = replace(log.plant, speeds=held if speeds is None else held + speeds, wrench=wrench, wind=wind)
    return replace(log, plant=plant)


def test_an_ideal_flight_has_none() -> None:
    assert effect_curves(log_with()) == []
    assert commanded_speeds(log_with()) is None


def test_what_is_zero_throughout_is_left_out() -> None:
    wrench = np.zeros((21, 6))
    assert effect_curves(log_with(wrench=wrench, wind=np.zeros((21, 3)))) == []
    wrench[7, 4] = 0.5
    (torque,) = effect_curves(log_with(wrench=wrench))
    assert (torque.key, torque.unit) == ("torque", "N m")
    np.testing.assert_array_equal(torque.values, wrench[:, 3:])


def test_forces_torques_and_wind_in_this_order() -> None:
    curves = effect_curves(log_with(wrench=np.ones((21, 6)), wind=np.ones((21, 3))))
    assert [(entry.key, entry.unit) for entry in curves] == [("force", "N"), ("torque", "N m"), ("wind", "m/s")]


def test_commands_hold_for_their_period() -> None:
    late = np.zeros((21, 4))
    late[5, 2] = -3.0
    log = log_with(speeds=late)
    commanded = commanded_speeds(log)
    assert commanded is not None
    np.testing.assert_array_equal(commanded[:20], np.repeat(log.control.speeds, 5, axis=0))
    np.testing.assert_array_equal(commanded[20], log.control.speeds[3])


def test_rounding_makes_no_difference() -> None:
    assert commanded_speeds(log_with(speeds=np.full((21, 4), 1e-9))) is None


def test_a_flight_that_never_began_has_none() -> None:
    log = replace(small_log(0), plant=replace(small_log(0).plant, wrench=None, wind=None))
    assert commanded_speeds(log) is None
    assert effect_curves(log) == []
