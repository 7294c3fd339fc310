"""The firmware's example, as far as it goes without the firmware; `make betaflight` flies it."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

import quadsim

EXAMPLES = Path(__file__).resolve().parent.parent / "examples"


@pytest.fixture
def example(monkeypatch: pytest.MonkeyPatch) -> Iterator[ModuleType]:
    monkeypatch.syspath_prepend(EXAMPLES)
    import betaflight

    yield betaflight
    sys.modules.pop("betaflight")


@pytest.mark.parametrize("vehicle", ["hummingbird", "lopes2011", "crazyflie2", "torrente2021"])
def test_the_firmwares_mixer_turns_the_vehicle_as_its_rotors_do(example: ModuleType, vehicle: str) -> None:
    """Roll, pitch and yaw that Betaflight's mixer gives a motor have the sign of the vehicle's allocation."""
    mixers = {  # flight/mixer_init.c, motors 1 to 4; roll is right down, pitch nose down, yaw nose left for a motor's spin
        "QUADP": [(0, 1, -1), (-1, 0, 1), (1, 0, 1), (0, -1, -1)],
        "QUADX": [(-1, 1, -1), (-1, -1, 1), (1, 1, 1), (1, -1, -1)],
    }
    built = quadsim.load_vehicle(vehicle)
    mixer, motors = example.motor_layout(built)
    roll, pitch, yaw = np.array(mixers[mixer])[motors].T
    torques = np.sign(np.round(built.allocation[1:] / np.abs(built.allocation[1:]).max(axis=1)[:, None], 9))
    np.testing.assert_array_equal(torques, [roll, pitch, -yaw])


def test_a_layout_without_a_mixer_is_refused(example: ModuleType) -> None:
    vehicle = quadsim.load_vehicle("hummingbird")
    for change in ({"rotor_azimuths": (10.0, 100.0, 190.0, -80.0)}, {"rotor_spins": (-1, 1, -1, 1)}):
        with pytest.raises(ValueError, match="hummingbird is neither QUADP nor QUADX of Betaflight"):
            example.motor_layout(replace(vehicle, **change))


def test_channels_are_degrees_per_second_and_the_root_of_the_thrust(example: ModuleType) -> None:
    """Sticks: 1 us is 1 deg/s, roll right, nose down and yaw right positive; thrust is the square of the motors' share."""
    rates = np.radians([100.0, -20.0, 30.0])
    assert example.channels(np.array([20.0, *rates]), 20.0, 0.0) == [1600, 1480, 2000, 1470, 2000]
    assert example.channels(np.array([5.0, 0.0, 0.0, 0.0]), 20.0, 0.0) == [1500, 1500, 1505, 1500, 2000]
    assert example.channels(np.array([-1.0, 90.0, -90.0, 90.0]), 20.0, 0.0) == [2000, 1000, 1010, 1000, 2000]
    idling = example.channels(np.array([5.0, 0.0, 0.0, 0.0]), 20.0, 0.2)[2]
    assert 0.2 + 0.8 * (idling - 1010) / 990 == pytest.approx(0.5, abs=1e-3)


def test_without_the_firmware_it_says_how_to_build_it(
    example: ModuleType, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(example, "PACKAGE", tmp_path)
    with pytest.raises(FileNotFoundError, match="make betaflight"):
        example.Betaflight(quadsim.load_vehicle("hummingbird"))
