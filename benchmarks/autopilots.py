"""Betaflight's firmware and the built-in autopilot under one MPC of thrust and body rates: `make betaflight`.

It fails where a flight violates a constraint, two runs of a flight through the firmware differ by a byte of
plant.parquet, or the RMS errors of firmware and built-in autopilot differ by more than `AGREEMENT`.
"""

from __future__ import annotations

import hashlib
import sys
import tempfile
from functools import cache, partial
from pathlib import Path
from runpy import run_path
from typing import Any, Final

import numpy as np
from timing import Record, options, run

import quadsim
from quadsim.console.progress import Progress
from quadsim.flight.audit import worst_finding

EXAMPLE: Final = Path(__file__).resolve().parent.parent / "examples" / "betaflight.py"
AGREEMENT: Final = 0.3  # cm
SETTLED: Final = 1.0  # s, when errors start to count
CIRCLE: Final = {"type": "ramped_circle", "radius": 3.0, "speed": 4.0, "acceleration": 2.0, "ramp": 1.0, "start": 1.0}
STEPS: Final = {"x": (1.0, 1.0), "y": (3.0, 1.0), "z": (5.0, 3.0), "yaw": (7.0, 45.0)}  # at [s], to [m, deg]
BASE: Final[dict[str, Any]] = {
    "vehicle.file": "hummingbird",
    "initial.position": [0.0, 0.0, 2.0],
    "control_period": 0.02,
    "controller": {
        "type": "nonlinear",
        "commands": "rates",
        "horizon": 40,
        "node": 0.04,
        "terminal": "lqr",
        "tilt": 60.0,
    },
    "constraints": [],
    "plant.limit_speeds": True,
    "effects": {"rotors": {}, "air": {}},
}
"""Rotor lag, rotor inertia and drag as in the vehicle file; tilt, thrust and body rates are bounded, and audited."""
FLIGHTS: Final[dict[str, dict[str, Any]]] = {
    "hover": {"duration": 5.0},
    "steps": {
        "duration": 9.0,
        "reference": {
            "type": "steps",
            "response_time": 0.0,
            **{axis: [{"start": at, "stop": 9.0, "value": to}] for axis, (at, to) in STEPS.items()},
        },
    },
    "circle": {"reference": CIRCLE},
    "lemniscate": {"reference": {**CIRCLE, "type": "ramped_lemniscate", "radius": 4.0}},
    "circle, rotors at 80 %": {"reference": CIRCLE, "effects": {"rotors": {"efficiency": [0.8] * 4}, "air": {}}},
    "circle, gyro noise 6 deg/s": {"reference": CIRCLE, "sensors": {"rates": {"rate": 1000.0, "noise": 6.0}}},
    "circle, stock gains": {"reference": CIRCLE},
    "circle, Crazyflie": {
        "reference": {**CIRCLE, "radius": 1.0, "speed": 1.5, "ramp": 0.5},
        "vehicle.file": "crazyflie2",
    },
}


def scenario(name: str) -> quadsim.Scenario:
    """The scenario of a flight."""
    return quadsim.load("hover", {"duration": None, **BASE, **FLIGHTS[name]})


def error(flight: quadsim.Flight) -> float:
    """RMS error of the position [cm]."""
    errors = np.array([flight.state[axis] - flight.reference[axis] for axis in "xyz"])[:, flight.time > SETTLED]
    return 100.0 * float(np.sqrt(np.mean(np.sum(errors**2, axis=0))))


def digest(flight: quadsim.Flight) -> str:
    """SHA-256 of its plant.parquet."""
    with tempfile.TemporaryDirectory() as scratch:
        flight.write_tables(directory := Path(scratch) / "run")
        return hashlib.sha256((directory / "plant.parquet").read_bytes()).hexdigest()


def measure(quick: bool, report: Progress) -> list[Record]:
    """Each flight through the firmware, twice, and through the built-in autopilot."""
    make = cache(run_path(str(EXAMPLE))["Betaflight"])
    records: list[Record] = []
    scenarios = {name: scenario(name) for name in (["hover"] if quick else FLIGHTS)}
    for i, (name, flown) in enumerate(scenarios.items()):
        report("flights", i, len(scenarios))
        firmware = make(quadsim.load_vehicle(flown.vehicle.file), stock="stock" in name)
        flight, again, builtin = (
            quadsim.fly(flown, autopilot=autopilot, progress=False) for autopilot in (firmware, firmware, None)
        )
        worst = worst_finding(flight.findings)
        assert worst is not None
        errors = error(flight), error(builtin)
        records.append(
            {
                "flight": name,
                "Betaflight_cm": round(errors[0], 3),
                "built-in_cm": round(errors[1], 3),
                "difference_cm": round(errors[0] - errors[1], 3),
                "nearest_margin": f"{worst.limit.name}: {worst.margin:.2f} {worst.limit.unit}",
                "verdict": flight.outcome,
                "second_run": "same bytes" if digest(flight) == digest(again) else "differs",
            }
        )
    return records


def main() -> None:
    """Fly, print, write, and exit with status 1 if something does not hold."""
    chosen = options(__doc__)
    records = run(partial(measure, chosen.quick), "Betaflight 4.6.0 and the built-in autopilot", chosen.json)
    failed = [
        record["flight"]
        for record in records
        if (record["verdict"], record["second_run"]) != ("satisfied", "same bytes")
        or not abs(record["difference_cm"]) <= AGREEMENT
    ]
    if failed:
        sys.exit(f"not as required: {', '.join(failed)}")


if __name__ == "__main__":
    main()
