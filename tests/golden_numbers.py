"""Golden numbers of tests/golden: what flights of the library gave when somebody last looked at them.

A test that finds another number is a reason to look at the flight.  `python tests/golden_numbers.py NAME...` writes the
entries of a new scenario, or of one that was changed on purpose.
"""

from __future__ import annotations

import json
import math
import sys
from pathlib import Path
from typing import Any, Final

import numpy as np

from quadsim.controller import ACCEPTED, SOLVED
from quadsim.flight.audit import worst_finding
from quadsim.flight.metrics import peak_tilt, tracking
from quadsim.rollout.flown import Flight, summarise
from quadsim.rollout.rollout import Rollout
from quadsim.scenarios.catalogue import scenario_names
from quadsim.scenarios.loading import load_scenario

GOLDEN: Final = Path(__file__).resolve().parent / "golden"
PAPER: Final = ("paper-unconstrained", "paper-unconstrained-clipped", "paper-constrained")
"""Flights of the README's table."""
NO_STEPS: Final = {"speed": [0.0, 250.0], "slew": [-400.0, 400.0]}
NO_SPEEDS: Final = {"speed": [0.0, 400.0], "slew": [-10.0, 5.0]}
NOTHING: Final = {"speed": [0.0, 400.0], "slew": [-400.0, 400.0]}
ABLATION: Final[dict[str, dict[str, Any]]] = {
    "none": {"controller.output_bounds": {}, "controller.input_bounds": NOTHING},
    "tilt": {"controller.input_bounds": NOTHING},
    "speeds": {"controller.output_bounds": {}, "controller.input_bounds": NO_STEPS},
    "steps": {"controller.output_bounds": {}, "controller.input_bounds": NO_SPEEDS},
    "all": {},
}
"""Constraints of the paper's constrained controller, with its weights and horizon; 400 rad/s is no bound."""


DIVERGING: Final = ("yaw-180",)
"""Flights that multiply the rounding of the processor that flies them (docs/commands.md): only their verdict counts."""


def read(name: str) -> dict[str, Any]:
    """The golden numbers of one file."""
    numbers: dict[str, Any] = json.loads((GOLDEN / f"{name}.json").read_text(encoding="utf-8"))
    return numbers


def write(name: str, numbers: dict[str, Any]) -> None:
    """One entry per line, in alphabetical order."""
    lines = (f"{json.dumps(key)}: {json.dumps(entry)}" for key, entry in sorted(numbers.items()))
    (GOLDEN / f"{name}.json").write_text("{\n" + ",\n".join(lines) + "\n}\n", encoding="utf-8")


def library_entry(flight: Flight) -> dict[str, Any]:
    """Verdict and seconds flown; unless the vehicle was lost, also errors [m], tilt [deg] and the nearest bound.

    The verdict alone of `DIVERGING` flights.
    """
    if flight.scenario.name in DIVERGING:
        return {"verdict": flight.outcome}
    log = flight.log
    entry: dict[str, Any] = {
        "verdict": flight.outcome,
        "flown": round(log.control.t.size * flight.scenario.control_period, 6),
    }
    if flight.outcome != "lost":
        rmse = tracking(log.control)["rmse"]
        result = worst_finding(flight.findings)
        entry["rmse"] = [round(rmse[axis], 4) for axis in "xyz"]
        entry["tilt"] = round(peak_tilt(log.plant.state), 2)
        entry["qps"] = round(100.0 * log.control.status.count(SOLVED) / log.control.t.size, 1) if flight.solver else 0
        if result is not None:
            entry["nearest"] = result.limit.name
            entry["margin"] = round(result.margin, 3)
            entry["unit"] = result.limit.unit
    return entry


def paper_entry(flight: Flight) -> dict[str, Any]:
    """Tracking [m, deg], the margins that decide, and the commands of one of the paper's flights [rad/s]."""
    summary = summarise(flight)
    control = flight.log.control
    rmse = summary["tracking"]["rmse"]
    return {
        "rmse": [round(rmse[axis], 5) for axis in "xyz"] + [round(math.degrees(rmse["yaw"]), 4)],
        "final_error": float(f"{max(abs(value) for value in summary['tracking']['final_error'].values()):.1e}"),
        "bounds": {
            finding.limit.name: {
                "satisfied": finding.satisfied,
                "margin": round(finding.margin, 4) + 0.0,
                "time_violated": round(finding.time_violated, 3),
            }
            for finding in flight.findings
            if finding.limit.name in ("roll", "pitch", "speed", "slew")
        },
        "highest_speed": round(float(flight.log.plant.speeds.max()), 3),
        "largest_step": round(float(np.abs(control.slews).max()), 3),
        "total_variation": round(summary["control"]["total_variation"], 1),
        "optima": sum(status in ACCEPTED for status in control.status),
        "periods": control.t.size,
    }


def ablation_entry(constraints: str) -> dict[str, Any]:
    """Outcome and errors [m, deg] of the paper's constrained controller with some of its constraints."""
    flight = Rollout(load_scenario("paper-constrained").replace(ABLATION[constraints])).fly()
    rmse = summarise(flight)["tracking"]["rmse"]
    lost = flight.outcome == "lost"
    errors = [] if lost else [round(rmse[axis], 5) for axis in "xyz"] + [round(math.degrees(rmse["yaw"]), 4)]
    return {"lost": lost, "rmse": errors}


def main(names: list[str]) -> None:
    """Fly these scenarios and write their entries; drop those of scenarios that are no more.

    The name `ablation` stands for the flights of `ABLATION`.
    """
    if "ablation" in names:
        write("ablation", {constraints: ablation_entry(constraints) for constraints in ABLATION})
        names = [name for name in names if name != "ablation"]
    flights = {name: Rollout(load_scenario(name)).fly() for name in names}
    library = read("library") | {name: library_entry(flight) for name, flight in flights.items()}
    write("library", {name: entry for name, entry in library.items() if name in scenario_names()})
    paper = {name: paper_entry(flight) for name, flight in flights.items() if name in PAPER}
    write("paper", read("paper") | paper)


if __name__ == "__main__":
    main(sys.argv[1:])
