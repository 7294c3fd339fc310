"""Real Betaflight firmware as the autopilot, on a simulated clock; `make betaflight` builds it and flies the proof.

    python examples/betaflight.py SCENARIO [--out DIR]   # whose controller has `commands = "rates"`
    python examples/betaflight.py                        # the proof, benchmarks/autopilots.py

The firmware is a program of its own (GPL-3), which is spoken to over the loopback interface; lockstep.c is its clock.
"""

import argparse
import contextlib
import os
import select
import shutil
import socket
import struct
import subprocess
import sys
import tempfile
import weakref
from collections.abc import Callable
from pathlib import Path
from typing import NoReturn

import numpy as np

import quadsim
from quadsim.scenarios.loading import assemble
from quadsim.sim.autopilot import AutopilotSettings
from quadsim.state import Array

HERE = Path(__file__).resolve().parent
BINARY = HERE.parent / ".venv/betaflight/betaflight/firmware/obj/betaflight_4.6.0_SITL"
COMPILE = ("gcc", "-std=gnu11", "-O2", "-shared", "-fPIC", HERE / "lockstep.c", "-ldl", "-o")
MOTORS = 9001  # UDP port, from the firmware
STATE = 9003  # UDP port, to the firmware
RC = 9004  # UDP port, to the firmware
CLI = 5761  # TCP port of its command line
LAYOUTS = {  # azimuth [deg] and spin of the firmware's motors 1 to 4: flight/mixer_init.c
    "QUADP": ((180.0, 1), (270.0, -1), (90.0, -1), (0.0, 1)),
    "QUADX": ((225.0, 1), (315.0, -1), (135.0, -1), (45.0, 1)),
}
SCALES = {"p": 3.2029e-5, "i": 2.44381e-4, "d": 5.29e-7}  # motors' share per unit, deg/s, deg and deg/s^2: flight/pid.h
AXES = ("roll", "pitch", "yaw")
LARGEST_GAIN = 250  # that its command line takes
STOCK_IDLE = 0.055  # of the motors' range
PATIENCE = 20.0  # s, of the wall clock


def motor_layout(vehicle: quadsim.Vehicle) -> tuple[str, list[int]]:
    """Return the firmware's mixer for a vehicle and its motor, 0 to 3, of each rotor; a ValueError if it has none."""
    azimuths = np.mod(np.degrees(vehicle.azimuths).round(9), 360.0).tolist()
    rotors = list(zip(azimuths, vehicle.rotor_spins, strict=True))
    for mixer, motors in LAYOUTS.items():
        if set(motors) == set(rotors):
            return mixer, [motors.index(rotor) for rotor in rotors]
    raise ValueError(f"Betaflight has no mixer for {vehicle.name}: azimuths and spins {rotors} are none of {LAYOUTS}")


def gains(vehicle: quadsim.Vehicle, settings: AutopilotSettings | None = None) -> list[str]:
    """Return the lines that set the gains of the built-in autopilot [1/s, 1/s^2, -] in the firmware's units, up to 250.

    A motor's share of its range, du, accelerates axis k by 2 w_hover w_max sum |allocation_k| / J_k du at hover.
    """
    torques = np.abs(vehicle.allocation[1:]).sum(axis=1)
    effect = 2.0 * vehicle.hover_speed * vehicle.speed_max * torques / vehicle.inertia
    resolved = (settings or AutopilotSettings()).resolved(vehicle)
    lines = []
    for name, scale in SCALES.items():
        numbers = getattr(resolved, name) / (np.degrees(scale) * effect)
        if numbers.max() > LARGEST_GAIN:
            cut = f"{name} of {vehicle.name} is cut from {numbers.max():.0f} to {LARGEST_GAIN}, the firmware's largest"
            print(cut, file=sys.stderr)
        for axis, number in zip(AXES, numbers, strict=True):
            lines.append(f"set {name}_{axis} = {min(round(number), LARGEST_GAIN)}")
    return lines


def channels(target: Array, largest_thrust: float, idle: float = 0.0) -> list[int]:
    """Return the RC channels roll, pitch, throttle, yaw, arm [us] for a target: thrust [N], body rates [rad/s].

    A microsecond is 1 deg/s; thrust is the square of the rotors' speed, of which `idle` is there without throttle.
    """
    if target.shape != (4,):
        raise ValueError('this set-up flies thrust and body rates: commands = "rates"')
    p, q, r = np.degrees(target[1:])
    throttle = (np.sqrt(max(target[0], 0.0) / largest_thrust) - idle) / (1.0 - idle)
    sticks = [1500.0 + p, 1500.0 + q, 1011.0 + 990.0 * throttle, 1500.0 - r]  # 1010 .. 2000, which it truncates twice
    rounded = np.clip(np.rint(sticks), 1000, 2000)
    return [*(int(stick) for stick in rounded), 2000]


def own_address() -> tuple[socket.socket, str]:
    """Return a socket for the motors, and its loopback address, where no other firmware is."""
    for host in range(1, 255):
        address = f"127.0.0.{host}"
        motors = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        with contextlib.suppress(OSError):
            motors.bind((address, MOTORS))
            socket.create_server((address, CLI)).close()
            return motors, address
        motors.close()
    raise RuntimeError(f"UDP port {MOTORS} or TCP port {CLI} is in use on every loopback address: end the other SITL")


def readable(source: socket.socket | int, seconds: float) -> bool:
    """Return whether a socket or a pipe has something to read, within some time [s]."""
    ready, _, _ = select.select([source], [], [], seconds)
    return bool(ready)


class Firmware:
    """A process of the firmware, in a folder with its eeprom.bin; its clock stands still except in `run`."""

    def __init__(self, folder: Path, lockstep: Path) -> None:
        self.time_ns = 10**9
        self.motors = np.zeros(4)
        self._log = folder / "sitl.log"
        self._socket, self.address = own_address()
        limits, self._limits = os.pipe()
        self._reports, reports = os.pipe()
        preload = {"LD_PRELOAD": str(lockstep), "LOCKSTEP": f"{limits},{reports},{self.address}"}
        command = [str(BINARY), self.address]
        with self._log.open("w") as log:
            self.process = subprocess.Popen(
                command,
                cwd=folder,
                env=os.environ | preload,
                pass_fds=(limits, reports),
                stdout=log,
                stderr=log,
            )
        os.close(limits)
        os.close(reports)
        try:
            self._await(b"d")
            self.run(1.0)  # by then its sockets are bound
        except RuntimeError:
            self.close()
            raise

    def run(self, seconds: float) -> None:
        """Let its clock advance."""
        self.time_ns += round(1e9 * seconds)
        os.write(self._limits, struct.pack("<Q", self.time_ns))
        self._await(b"d")

    def step(self, seconds: float, sticks: list[int], rates: Array, attitude: Array) -> None:
        """Give it RC channels, gyro (3,) [rad/s] and attitude (4,), let it run, and take `motors` (4,), 0 to 1."""
        time = 1e-9 * self.time_ns
        p, q, r = rates
        w, x, y, z = attitude
        unused = [1500] * (16 - len(sticks))
        self._send(RC, struct.pack("<d16H", time, *sticks, *unused))
        self._send(STATE, struct.pack("<18d", time, p, -q, -r, 0.0, 0.0, -9.81, w, x, -y, -z, *[0.0] * 6, 101325.0))
        self.run(seconds)
        while readable(self._socket, 0.0):
            packet = struct.unpack("<H2x16f", self._socket.recv(256))
            self.motors = np.array(packet[1:5]) / 1000.0 - 1.0

    def configure(self, lines: list[str]) -> None:
        """Type lines into its command line, and save what they set in eeprom.bin: that ends the process."""
        with socket.create_connection((self.address, CLI), PATIENCE) as cli:
            self._type(cli, "#")  # which opens it
            for line in lines:
                self._type(cli, f"{line}\n")
            cli.sendall(b"save\n")
            with contextlib.suppress(RuntimeError):  # until it has ended
                for _ in range(round(1e3 * PATIENCE)):
                    self.run(0.001)

    def close(self) -> None:
        """End the process."""
        self.process.kill()
        self.process.wait()
        self._socket.close()
        os.close(self._limits)
        os.close(self._reports)

    def _type(self, cli: socket.socket, line: str) -> None:
        """Type a line, and wait for the prompt that follows the answer."""
        cli.sendall(line.encode())
        answer = ""
        while not answer.endswith("\n# "):
            self.run(0.001)
            if readable(cli, 0.001):
                answer += cli.recv(65536).decode()
        if "###" in answer:
            raise RuntimeError(f"Betaflight refuses {line.strip()!r}: {answer}")

    def _send(self, port: int, packet: bytes) -> None:
        self._socket.sendto(packet, (self.address, port))
        self._await(b"p")

    def _await(self, report: bytes) -> None:
        """Wait until lockstep.c reports that a packet has arrived (p) or that the time has passed (d)."""
        if not readable(self._reports, PATIENCE):
            self._fail("hangs")
        if os.read(self._reports, 1) != report:
            self._fail("has ended")

    def _fail(self, what: str) -> NoReturn:
        log = self._log.read_text(errors="replace")[-300:]
        raise RuntimeError(f"Betaflight {what}; its last words are {log!r}")


class Betaflight:
    """The firmware as an inner loop that takes thrust and body rates: `quadsim.controller.AutopilotLoop`.

    The rotor speeds that answer a gyro sample are applied from the next one on.
    """

    takes_targets = True

    def __init__(
        self, vehicle: quadsim.Vehicle, settings: AutopilotSettings | None = None, *, stock: bool = False
    ) -> None:
        """Configure it for a vehicle: with the gains of the built-in autopilot, or with its stock gains and filters."""
        if not BINARY.exists():
            raise FileNotFoundError(f"{BINARY} is not there: make betaflight builds it")
        mixer, self._motor_of_rotor = motor_layout(vehicle)
        self.rate = 1000.0
        self._fastest = vehicle.speed_max
        self._idle = 0.0
        if stock:
            self._idle = STOCK_IDLE
        self._hover = np.array([vehicle.mass * vehicle.gravity, 0.0, 0.0, 0.0])
        self._largest_thrust = vehicle.level_thrust(vehicle.speed_max)
        self._folder = Path(tempfile.mkdtemp(prefix="betaflight-"))
        weakref.finalize(self, shutil.rmtree, self._folder)
        subprocess.run([*COMPILE, self._folder / "lockstep.so"], check=True)
        arming, _, tuning = (HERE / "betaflight.txt").read_text(encoding="utf-8").partition("# Tuning")
        lines = arming.splitlines()[1:]  # below a comment, as is the tuning
        if not stock:
            lines += tuning.splitlines()[1:] + gains(vehicle, settings)
        self._start(self._folder).configure([f"mixer {mixer}", *lines])

    def reset(self) -> None:
        """Start it anew with its configuration, arm it and let it hover."""
        self._close()
        flight = self._folder / "flight"
        flight.mkdir(exist_ok=True)
        shutil.copy(self._folder / "eeprom.bin", flight)
        self._firmware = self._start(flight)
        disarmed = [1500, 1500, 1000, 1500, 1000]
        armed = [1500, 1500, 1000, 1500, 2000]
        hover = channels(self._hover, self._largest_thrust, self._idle)
        level = np.array([1.0, 0.0, 0.0, 0.0])
        for sticks, seconds in ((disarmed, 6), (armed, 1), (hover, 1)):  # it does not arm in its first 5 s
            for _ in range(100 * seconds):
                self._firmware.step(0.01, sticks, np.zeros(3), level)
        if self._firmware.motors.min() < 0.1:
            raise RuntimeError("Betaflight does not arm: betaflight.txt sets the switch that arms it")

    def speeds(self, time: float, commanded: Array, rates: Array, rotors: Array, attitude: Array) -> Array:
        """Return rotor speeds (4,) [rad/s] for a target (4,); see `quadsim.controller.InnerLoop`."""
        motors = self._firmware.motors
        sticks = channels(commanded, self._largest_thrust, self._idle)
        self._firmware.step(1.0 / self.rate, sticks, rates, attitude)
        return np.clip(motors[self._motor_of_rotor], 0.0, 1.0) * self._fastest

    def _start(self, folder: Path) -> Firmware:
        firmware = Firmware(folder, self._folder / "lockstep.so")
        self._close: Callable[[], object] = weakref.finalize(self, firmware.close)
        return firmware


def main() -> None:
    """Fly a scenario, or the proof."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenario", nargs="?", help="library name or file; absent: the proof")
    parser.add_argument("--out", help="run directory to write")
    arguments = parser.parse_args()
    if arguments.scenario is None:
        sys.exit(subprocess.call([sys.executable, HERE.parent / "benchmarks/autopilots.py"]))
    scenario = quadsim.load(arguments.scenario)
    parts = assemble(scenario)
    flight = quadsim.fly(scenario, autopilot=Betaflight(parts.vehicle, parts.autopilot))
    print(flight)
    if arguments.out is not None:
        print("written to", flight.save(arguments.out))


if __name__ == "__main__":
    main()
