"""From a flight log to firmware, once: `make chain`, or `python examples/flight_chain.py [DIRECTORY]`.

A Hummingbird is flown by a guess of its numbers and identified from the log.  Its first scenario with thrust and body
rates is exported as C in float, which an emulated Cortex-M7 runs behind its UART.  The targets go to Betaflight's
firmware in lockstep, whose motors drive the true vehicle; every bound is audited at 1 kHz.  It fails where one does not
hold, or where the flight is not that of the same controller in Python through the same firmware.
"""

import argparse
import json
import shutil
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from betaflight import BINARY, Betaflight

import quadsim
from quadsim.scenarios.loading import assemble
from quadsim.vehicle import VEHICLE_UNITS

TARGET = "cortex-m7"
PROGRAMS = ("make", "arm-none-eabi-gcc", "qemu-system-arm")
TRUE = quadsim.load_vehicle("hummingbird")
NUMBERS = {name: value for name in VEHICLE_UNITS if (value := getattr(TRUE, name)) is not None}
WRONG = {  # the guess over the truth; mass, arm, layout and range of speeds can be measured, and are right
    "thrust_coefficient": 0.8,
    "inertia": 1.4,
    "drag_to_thrust": 0.7,
    "rotor_rise": 2.0,
    "rotor_fall": 1.2,
    "rotor_inertia": 0.6,
    "rotor_drag": 0.5,
    "body_drag": 2.0,
}
NOISE = {"position": 0.003, "velocity": 0.03, "attitude": 0.3, "rates": 1.5}  # m, m/s, deg, deg/s, at 100 Hz
YAW = [{"type": "setpoint", "at": 1.5 * i, "yaw": 25.0 * (-1) ** i} for i in range(1, 8)]  # s, deg
SENSORS = {f"sensors.{name}": {"rate": 100.0, "noise": noise} for name, noise in NOISE.items()}
EXCITATION = {
    "control_period": 0.01,
    "reference.turns": 2.0,
    "events": YAW,
    "constraints": [],
    "actual": NUMBERS,
    **SENSORS,
}
APART = 1e-3  # m, of the RMS errors of C and Python
SIGNALS = ("xy", "error", "margin.tilt")


class Steps:
    """Prints what a step took and found."""

    def __init__(self) -> None:
        self._start = time.perf_counter()
        self._last = self._start

    def __call__(self, step: str, found: str) -> None:
        """End a step."""
        now = time.perf_counter()
        print(f"{now - self._last:5.1f} s  {step:9}  {found}", flush=True)
        self._last = now

    def end(self) -> None:
        """Print the sum."""
        print(f"{self._last - self._start:5.1f} s  in all")


def require() -> None:
    """Exit with status 2, and what installs it, where the firmware, the compiler or the emulator is missing."""
    missing = []
    if not BINARY.exists():
        missing.append("Betaflight's firmware (make betaflight)")
    for name in PROGRAMS:
        if shutil.which(name) is None:
            missing.append(f"{name} (make firmware)")
    if missing:
        print(f"flight_chain.py lacks {', '.join(missing)}", file=sys.stderr)
        sys.exit(2)


def write_guess(file: Path) -> Path:
    """Write the start file: the vehicle with wrong numbers."""
    lines = ['name = "mine"', 'description = "a Hummingbird by a guess"']
    for name, value in NUMBERS.items():
        guess = value
        if name in WRONG:
            guess = (WRONG[name] * np.array(value)).tolist()
        lines.append(f"[{name}]")
        lines.append(f"value = {json.dumps(guess)}")
        lines.append(f'unit = "{VEHICLE_UNITS[name]}"')
        lines.append('source = "a guess"')
    file.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return file


def error(flight: quadsim.Flight) -> float:
    """RMS distance from the reference [m]."""
    return float(flight.metrics["position_error.rms"])


def fly(directory: Path) -> tuple[quadsim.Flight, quadsim.Flight]:
    """Return the flight through the whole chain, and that of the same controller in Python."""
    step = Steps()
    guess = write_guess(directory / "start.toml")
    start = quadsim.scenario(vehicle=guess, course="figure-eight", controller="geometric").scenario
    excited = start.replace(EXCITATION)
    log = quadsim.fly(excited, progress=False)
    log.write_tables(directory / "log")
    step("log", f"{log.time.size} samples, {log.time[-1]:.1f} s")

    identified = directory / "identified.toml"
    found = quadsim.identify(directory / "log", vehicle=guess, out=identified)
    step("identify", f"{found.counted}\n{'':20}{found.prediction.verdict}")

    made = quadsim.scenario(vehicle=identified, course="figure-eight", controller="rates").scenario
    parts = assemble(made.replace({"actual": NUMBERS}))
    firmware = Betaflight(parts.vehicle, parts.autopilot)
    parts.user_autopilot = firmware
    lags = parts.inner_lag
    first = parts.scenario.replace({"controller.inner_lag": lags})
    (directory / "first.toml").write_text(first.to_toml(), encoding="utf-8")
    shown = ", ".join(f"{1e3 * lag:.0f}" for lag in lags)
    step("scenario", f"{first.name}; thrust and rates lag by {shown} ms through the firmware")

    code = quadsim.export(first, directory / "c", precision="float", target=TARGET)
    facts = json.loads((code / "export.json").read_text(encoding="utf-8"))
    step("export", f"C99 in float with {facts['memory_bytes'] / 1e3:.0f} kB of memory")

    flight = quadsim.fly_exported(first, precision="float", target=TARGET, autopilot=firmware, progress=False)
    flight.write_tables(directory / "flight")
    margins = []
    for finding in flight.findings:
        margins.append(f"{finding.limit.name} {finding.margin:.3g} {finding.limit.unit}")
    step("flight", f"{flight.solver}: {flight.outcome}, RMS error {100.0 * error(flight):.2f} cm")
    print(f"{'':20}margins: {', '.join(margins)}")

    python = quadsim.fly(first, autopilot=firmware, progress=False)
    step("Python", f"{python.outcome}, RMS error {100.0 * error(python):.2f} cm")
    quadsim.plot(flight, *SIGNALS, out=directory / "chain.svg")
    step.end()
    return flight, python


def main() -> None:
    """Fly, and exit with status 1 if something does not hold."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "directory", nargs="?", type=Path, help="new directory for all that is made; absent: none stays"
    )
    directory = parser.parse_args().directory
    require()
    if directory is not None and directory.exists():
        parser.error(f"{directory} exists; name a directory that does not")
    with tempfile.TemporaryDirectory() as scratch:
        folder = directory or Path(scratch)
        folder.mkdir(parents=True, exist_ok=True)
        flight, python = fly(folder)
    if flight.outcome != "satisfied" or not abs(error(flight) - error(python)) <= APART:
        sys.exit(f"not as required: {flight.outcome}, RMS errors {error(flight):.4f} and {error(python):.4f} m")


if __name__ == "__main__":
    main()
