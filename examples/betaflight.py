"""Real Betaflight firmware as the autopilot of a flight, on a simulated clock; `make betaflight` builds it first.

    python examples/betaflight.py                             # the proof: a table of flights, and what must hold of them
    python examples/betaflight.py SCENARIO.toml [--out DIR]   # a scenario whose controller has `commands = "rates"`

The firmware is a process of its own (GPL-3; nothing of it is part of quadsim), spoken to over the loopback interface.
"""

from __future__ import annotations

import contextlib
import math
import os
import select
import shutil
import socket
import struct
import subprocess
import tempfile
import weakref
from collections.abc import Callable
from pathlib import Path
from typing import Final

import numpy as np

from quadsim.state import Array
from quadsim.vehicle import Vehicle

HERE: Final = Path(__file__).resolve().parent
PACKAGE: Final = HERE.parent / ".venv" / "betaflight"
BINARY: Final = "betaflight/firmware/obj/betaflight_4.6.0_SITL"
MOTORS, STATE, RC, CLI = 9001, 9003, 9004, 5761
"""Ports of the firmware: UDP out, in, in, and TCP."""
LAYOUTS: Final = {
    "QUADP": ((180.0, 1), (-90.0, -1), (90.0, -1), (0.0, 1)),
    "QUADX": ((-135.0, 1), (-45.0, -1), (135.0, -1), (45.0, 1)),
}
"""Azimuth [deg] and spin of the firmware's motors 1 to 4, as of `Vehicle`: flight/mixer_init.c."""
FULL_RATE, LOW, HIGH = 500.0, 1010, 2000  # deg/s at full stick; throttle's channel from no thrust to all of it
COMPILE: Final = (os.environ.get("CC", "gcc"), "-std=gnu11", "-O2", "-Wall", "-Wextra", "-shared", "-fPIC")
PATIENCE: Final = 20.0  # s, of the wall clock


def motor_layout(vehicle: Vehicle) -> tuple[str, list[int]]:
    """Return the firmware's mixer, and its motor (0 to 3) for each of the vehicle's rotors.

    Raises:
        ValueError: it has no mixer for this layout.
    """
    rotors = [(azimuth % 360.0, spin) for azimuth, spin in zip(vehicle.rotor_azimuths, vehicle.rotor_spins, strict=True)]
    for mixer, layout in LAYOUTS.items():
        motors = [(azimuth % 360.0, spin) for azimuth, spin in layout]
        if sorted(motors) == sorted(rotors):
            return mixer, [motors.index(rotor) for rotor in rotors]
    raise ValueError(f"{vehicle.name} is no QUADP or QUADX of Betaflight: azimuths and spins {rotors}, not {LAYOUTS}")


def channels(target: Array, largest_thrust: float, idle: float) -> list[int]:
    """Return the RC channels [us] roll, pitch, throttle, yaw, arm for a target (4,) in N and rad/s.

    A motor at the share s of its range beyond idle turns at (idle + (1 - idle) s) w_max; thrust goes with the square.
    """
    sticks = np.clip(np.degrees(target[1:]) / FULL_RATE, -1.0, 1.0)
    share = (math.sqrt(max(target[0], 0.0) / largest_thrust) - idle) / (1.0 - idle)
    roll, pitch, throttle, yaw = np.rint(
        [
            1500.0 + 500.0 * sticks[0],
            1500.0 + 500.0 * sticks[1],
            LOW + (HIGH - LOW) * min(max(share, 0.0), 1.0),
            1500.0 - 500.0 * sticks[2],
        ]
    ).astype(int)
    return [roll, pitch, throttle, yaw, 2000]


class Firmware:
    """A process of the firmware, in a folder with its eeprom.bin; its clock stands still but for `run`."""

    def __init__(self, folder: Path, lockstep: Path) -> None:
        self.folder, self.time_ns = folder, 1_000_000_000
        self._socket, self.address = _receiver()
        limits, self._limits = os.pipe()
        self._reports, reports = os.pipe()
        with (folder / "sitl.log").open("w") as log:
            self.process = subprocess.Popen(
                [PACKAGE / BINARY, self.address],
                cwd=folder,
                env={**os.environ, "LD_PRELOAD": str(lockstep), "LOCKSTEP": f"{limits},{reports},{self.address}"},
                pass_fds=(limits, reports),
                stdout=log,
                stderr=log,
            )
        os.close(limits)
        os.close(reports)
        self._await("d")  # its first look at the clock
        self.run(1.0)  # its sockets are bound

    def run(self, seconds: float) -> None:
        """Let it run for so long by its clock."""
        self.time_ns += round(1e9 * seconds)
        os.write(self._limits, struct.pack("<Q", self.time_ns))
        self._await("d")

    def step(self, seconds: float, sticks: list[int], rates: Array, attitude: Array) -> None:
        """Give it channels, gyro (3,) [rad/s] and attitude (4,) of now; let it run for so long."""
        time, (p, q, r), (w, x, y, z) = 1e-9 * self.time_ns, rates, attitude
        self._send(RC, struct.pack("<d16H", time, *sticks, *[1500] * (16 - len(sticks))))
        gravity, nowhere = (0.0, 0.0, -9.80665), [0.0] * 6
        self._send(STATE, struct.pack("<18d", time, p, -q, -r, *gravity, w, x, -y, -z, *nowhere, 101325.0))
        self.run(seconds)

    def motors(self) -> Array | None:
        """Return the last command to motors 1 to 4, as a share of their range; None if none came since."""
        motors = None
        while select.select([self._socket], [], [], 0.0)[0]:
            motors = np.array(struct.unpack("<H2x16f", self._socket.recv(256))[1:5]) / 1000.0 - 1.0
        return motors

    def configure(self, lines: list[str]) -> None:
        """Type lines into its command line and save them to eeprom.bin, which ends the process.

        Raises:
            RuntimeError: it refuses one.
        """
        with socket.create_connection((self.address, CLI), PATIENCE) as cli:
            for line in ("#", *(line + "\n" for line in lines)):  # `#` alone opens it
                cli.sendall(line.encode())
                answer = ""
                while not answer.endswith("\n# "):
                    self.run(0.001)
                    if select.select([cli], [], [], 0.001)[0]:
                        answer += cli.recv(65536).decode(errors="replace")
                if "###" in answer:
                    raise RuntimeError(f"Betaflight refuses {line!r}: {answer}")
            cli.sendall(b"save\n")
            with contextlib.suppress(RuntimeError):
                while True:
                    self.run(0.001)
        self.process.wait(PATIENCE)

    def close(self) -> None:
        """End the process."""
        self.process.kill()
        self.process.wait()
        self._socket.close()
        os.close(self._limits)
        os.close(self._reports)

    def _send(self, port: int, packet: bytes) -> None:
        self._socket.sendto(packet, (self.address, port))
        self._await("p")

    def _await(self, report: str) -> None:
        ready = select.select([self._reports], [], [], PATIENCE)[0]
        if not ready or not (got := os.read(self._reports, 1)):
            raise RuntimeError(f"Betaflight {'has ended' if ready else 'hangs'}: see {self.folder / 'sitl.log'}")
        assert got == report.encode(), got


def _receiver() -> tuple[socket.socket, str]:
    """Return a socket for the motors on a loopback address of its own, where the firmware's other ports are free too."""
    for host in range(1, 255):
        address = f"127.0.0.{host}"
        receiver = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            receiver.bind((address, MOTORS))  # whoever has this one has the address
            for kind, port in ((socket.SOCK_DGRAM, STATE), (socket.SOCK_DGRAM, RC), (socket.SOCK_STREAM, CLI)):
                with socket.socket(socket.AF_INET, kind) as trial:
                    trial.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, kind is socket.SOCK_STREAM)
                    trial.bind((address, port))
        except OSError:
            receiver.close()
            continue
        return receiver, address
    raise RuntimeError("ports of Betaflight's SITL are in use on every address: UDP 9001, 9003, 9004 or TCP 5761")


class Betaflight:
    """The firmware as an inner loop (`quadsim.controller.InnerLoop`) of targets (4,): thrust [N] and body rates [rad/s].

    Its motors act one period after the gyro that they answer, as on hardware at this rate.
    """

    takes_targets = True

    def __init__(self, vehicle: Vehicle, *, tuned: bool = True, rate: float = 1000.0) -> None:
        """Configure it for a vehicle, once; not `tuned`: with the firmware's own gains, filters and idle."""
        mixer, self._motor_of_rotor = motor_layout(vehicle)
        self.vehicle, self.rate, self.idle = vehicle, rate, 0.0 if tuned else 0.055
        self._largest_thrust = 4.0 * vehicle.thrust_coefficient * vehicle.speed_max**2
        self._close: Callable[[], object] = lambda: None
        self._folder = Path(tempfile.mkdtemp(prefix="betaflight-"))
        weakref.finalize(self, shutil.rmtree, self._folder)
        self._lockstep = self._folder / "lockstep.so"
        subprocess.run([*COMPILE, "-o", self._lockstep, HERE / "lockstep.c", "-ldl"], check=True)
        arming, _, tuning = (HERE / "betaflight.txt").read_text(encoding="utf-8").partition("# Tuning")
        lines = [line for line in (arming + f"#{tuning}" * tuned).splitlines() if not line.startswith("#")]
        firmware = Firmware(self._folder, self._lockstep)
        firmware.configure([lines[0], f"mixer {mixer}", *lines[1:]])
        firmware.close()

    def reset(self) -> None:
        """Start it anew from its configuration, and arm it.

        Raises:
            RuntimeError: it does not arm.
        """
        self._close()
        folder = self._folder / "flight"
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir()
        shutil.copy(self._folder / "eeprom.bin", folder)
        self._firmware = Firmware(folder, self._lockstep)
        self._close = weakref.finalize(self, self._firmware.close)
        hover = self._channels(np.array([self.vehicle.mass * self.vehicle.gravity, 0.0, 0.0, 0.0]))
        low = [1500, 1500, 1000, 1500]
        for sticks, steps in (([*low, 1000], 600), ([*low, 2000], 50), (hover, 2)):  # it refuses for its first 5 s
            for _ in range(steps):
                self._firmware.step(0.01, sticks, np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]))
                motors = self._firmware.motors()
        if motors is None or motors.min() < 0.1:
            raise RuntimeError(f"Betaflight does not arm: motors {motors}; see {folder / 'sitl.log'}")
        self._motors = motors

    def speeds(self, time: float, commanded: Array, rates: Array, rotors: Array, attitude: Array) -> Array:
        """Return rotor speeds (4,) [rad/s]; see `quadsim.controller.InnerLoop`."""
        motors = self._motors
        self._firmware.step(1.0 / self.rate, self._channels(commanded), rates, attitude)
        self._motors = self._firmware.motors()
        return np.clip(motors[self._motor_of_rotor], 0.0, 1.0) * self.vehicle.speed_max

    def _channels(self, target: Array) -> list[int]:
        return channels(target, self._largest_thrust, self.idle)
