"""The firmware's example, as far as it goes without the firmware; `make betaflight` flies it."""

from __future__ import annotations

import socket
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from runpy import run_path
from types import ModuleType

import numpy as np
import pytest

import quadsim
from quadsim.sim.autopilot import AutopilotSettings

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
    mixers = {  # roll, pitch, yaw of motors 1 to 4: flight/mixer_init.c
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
        with pytest.raises(ValueError, match="hummingbird"):
            example.motor_layout(replace(vehicle, **change))


def test_channels_are_degrees_per_second_and_the_root_of_the_thrust(example: ModuleType) -> None:
    """A microsecond is 1 deg/s, roll and yaw to the right, nose down; thrust is the square of the motors' share."""
    rates = np.radians([100.0, -20.0, 30.0])
    rest = np.zeros(3)
    assert example.channels(np.array([20.0, *rates]), 20.0) == [1600, 1480, 2000, 1470, 2000]
    assert example.channels(np.array([5.0, *rest]), 20.0) == [1500, 1500, 1506, 1500, 2000]
    assert example.channels(np.array([-1.0, 90.0, -90.0, 90.0]), 20.0) == [2000, 1000, 1011, 1000, 2000]
    idling = example.channels(np.array([5.0, *rest]), 20.0, 0.2)[2]
    assert 0.2 + 0.8 * (idling - 1010) / 990 == pytest.approx(0.5, abs=2e-3)
    with pytest.raises(ValueError, match='commands = "rates"'):
        example.channels(np.array([5.0, *rest, 1.0, *rest]), 20.0)


def test_the_firmwares_gains_turn_the_vehicle_as_the_built_in_autopilots_do(example: ModuleType) -> None:
    """A rate error of 1 rad/s accelerates roll at hover by p [1/s], to the firmware's whole numbers."""
    vehicle = quadsim.load_vehicle("hummingbird")
    lines = dict(line.split(" = ") for line in example.gains(vehicle, AutopilotSettings(p=(60.0, 50.0, 10.0))))
    mixer = {"roll": (0, 1, 0, -1), "pitch": (-1, 0, 1, 0), "yaw": (1, -1, 1, -1)}  # of the vehicle's rotors
    for axis, (name, motors) in enumerate(mixer.items()):
        share = 0.032029 * int(lines[f"set p_{name}"]) * np.degrees(1.0) / 1000.0 * np.array(motors)
        h = 1e-6
        speeds = vehicle.hover_speed + h * share * vehicle.speed_max
        acceleration = (vehicle.allocation @ speeds**2)[1:] / np.array(vehicle.inertia) / h
        assert acceleration[axis] == pytest.approx((60.0, 50.0, 10.0)[axis], rel=0.01)
    assert max(int(value) for value in lines.values()) <= 250


def test_every_firmware_has_an_address_of_its_own_or_is_told_that_there_is_none(
    example: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(example, "MOTORS", 0)  # any port, so that a firmware on this machine does not matter
    monkeypatch.setattr(example, "CLI", 0)
    motors, address = example.own_address()
    with motors:
        assert address == "127.0.0.1"
        for name, kind in (("MOTORS", socket.SOCK_DGRAM), ("CLI", socket.SOCK_STREAM)):
            with socket.socket(socket.AF_INET, kind) as taken:
                taken.bind(("127.0.0.1", 0))
                if name == "CLI":
                    taken.listen()
                with monkeypatch.context() as patch:
                    patch.setattr(example, name, taken.getsockname()[1])
                    beside, address = example.own_address()
                    beside.close()
                    assert address == "127.0.0.2"
    with socket.create_server(("", 0)) as everywhere:
        monkeypatch.setattr(example, "CLI", everywhere.getsockname()[1])
        with pytest.raises(RuntimeError, match="loopback"):
            example.own_address()


def test_without_the_firmware_it_says_how_to_build_it(
    example: ModuleType, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(example, "BINARY", tmp_path / "SITL")
    with pytest.raises(FileNotFoundError, match="make betaflight"):
        example.Betaflight(quadsim.load_vehicle("hummingbird"))


def test_the_whole_chain_names_what_it_lacks(
    example: ModuleType, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(example, "BINARY", tmp_path / "SITL")
    monkeypatch.setattr(sys, "argv", ["flight_chain.py", str(tmp_path / "chain")])
    monkeypatch.setenv("PATH", "")
    with pytest.raises(SystemExit, match=r"^2$"):
        run_path(str(EXAMPLES / "flight_chain.py"), run_name="__main__")
    printed = capsys.readouterr().err
    assert printed.startswith("flight_chain.py lacks Betaflight's firmware (make betaflight), make (make firmware)")
    assert "qemu-system-arm (make firmware)" in printed
    assert not (tmp_path / "chain").exists()
