"""What each controller survives: the paper's course with one thing at a time that its model leaves out.

Conditions are in benchmarks/mismatch.toml.  Flights do not depend on the number of processes.
"""

from __future__ import annotations

from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np
from timing import Record, options, run

from quadsim.assets import read_toml
from quadsim.commands.app import load
from quadsim.console.progress import Progress
from quadsim.errors import QuadsimError
from quadsim.flight import metrics
from quadsim.rollout.many import fly_many
from quadsim.rollout.rollout import Rollout
from quadsim.scenarios.schema.bases import read_scenario
from quadsim.scenarios.schema.scenario import Scenario
from quadsim.state import INDEX, POSITION

SCENARIO: Final = "paper-constrained"
TILT: Final = 5.0
"""The paper's bound on roll and pitch [deg]."""
BASELINE_TILT: Final = 20.0
"""Largest tilt that LQR, PID and geometric controller command [deg], who have no bounds on states: at the paper's 5 deg
the geometric controller circles its goal, 8 m off after 60 s."""
DIVERGED: Final = 10.0
"""Distance from the reference at the end [m] beyond which a flight counts as lost."""
OVERTURNED: Final = 90.0
"""Roll or pitch [deg] beyond which a flight counts as lost, whatever comes after."""
NO_STEPS: Final = 1e6
"""A bound on steps [rad/s] that bounds nothing: held to the paper's, which it knows nothing of, the LQR overturns."""
QUICK: Final = (("paper", "PID"), ("nominal", "mass +30 %"), 3.0)  # controllers, conditions, duration [s]

Table = dict[str, Any]


def controllers(paper: Table, lag: float, delay: float, period: float) -> dict[str, Table]:
    """The `[controller]` tables by name, each `+` being an addition.

    Args:
        paper: that of the paper's constrained MPC.
        lag: of rotors, as models of it assume [s]; 0 for none.
        delay: from measurement to command, likewise [s].
        period: of control [s].
    """
    soft = {name: paper[name] for name in ("horizon", "output_weights", "output_bounds", "input_bounds")}
    # Ten times the paper's input weight: with its 0.01, rotor lag that the model misjudges is amplified.
    soft |= {"type": "robust", "input_weights": {"speed": 0.1}, "soft": {}, "move_weight": 20.0}
    model = soft | {"rotor_lag": lag, "delay": delay, "heading": True}
    offset_free = model | {"offset_free": {"torque_walk": 0.2, "force_walk": 0.1}}
    speeds = {"speed": paper["input_bounds"]["speed"], "slew": [-NO_STEPS, NO_STEPS]}
    baseline: Table = {"tilt": BASELINE_TILT, "input_bounds": speeds}
    gains = {"lag": max(0.5 * period, lag) + delay} if lag or delay else {}
    return {
        "paper": paper,
        "soft": soft,
        "+ model": model,
        "+ offset-free": offset_free,
        "+ tightening": offset_free | {"tightening": {}},
        "LQR": baseline | {"type": "lqr"},
        "PID": baseline | gains | {"type": "pid"},
        "geometric": baseline | gains | {"type": "geometric", "integral": True},
    }


def cells(quick: bool) -> list[tuple[str, str, Scenario]]:
    """Controller, condition and scenario of every flight."""
    conditions = read_toml(Path(__file__).with_suffix(".toml"))["conditions"]
    start = load(SCENARIO)
    if quick:
        start = start.replace({"duration": QUICK[2], "constraints": []})
    paper = read_scenario(SCENARIO)["controller"]
    cells_flown = []
    for condition, entry in conditions.items():
        if quick and condition not in QUICK[1]:
            continue
        changed = start.replace(entry.get("changes", {}))
        known = (entry.get("rotor_lag", 0.0), entry.get("delay", 0.0))
        for name, table in controllers(paper, *known, start.control_period).items():
            if not quick or name in QUICK[0]:
                cells_flown.append((name, condition, changed.replace({"controller": table})))
    return cells_flown


def fly(scenario: Scenario) -> Record:
    """One flight's numbers; those of nothing flown are None."""
    log = Rollout(scenario).fly().log
    control, period = log.control, scenario.control_period
    if not control.t.size:
        return {"fate": "lost, 0 s", "end_error": None, "peak_tilt": None, "violated_s": 0.0, "fallbacks": 0}
    end = float(np.linalg.norm(control.truth[-1, list(POSITION)] - control.reference[-1, :3]))
    tilt = metrics.peak_tilt(log.plant.state)
    fate = "overturned" if tilt > OVERTURNED else "diverged" if end > DIVERGED else ""
    if log.reason is not None:
        fate = f"lost, {control.t.size * period:.0f} s"
    # A row of the plant covers the step that follows it; the last has none.
    tilts = np.degrees(np.abs(log.plant.state[:-1, [INDEX["roll"], INDEX["pitch"]]]).max(axis=1))
    return {
        "fate": fate,
        "end_error": end,
        "peak_tilt": tilt,
        "violated_s": float(np.count_nonzero(tilts > TILT) * scenario.plant.timestep),
        "fallbacks": int(np.count_nonzero(control.fallback)),
    }


def measure(quick: bool, workers: int | None, report: Progress) -> list[Record]:
    """A record of each flight, in order."""
    flights = cells(quick)
    rows: dict[int, Record] = {}
    with closing(fly_many([scenario for *_, scenario in flights], fly, workers=workers)) as answers:
        for flown, (place, row) in enumerate(answers, 1):
            report("flights", flown, len(flights))
            if "fate" not in row:
                raise QuadsimError(f"{', '.join(flights[place][:2])}: {row['verdict']} ({row['reason']})")
            rows[place] = row
    return [
        {"controller": controller, "condition": condition, **rows[i]}
        for i, (controller, condition, _) in enumerate(flights)
    ]


def main() -> None:
    """Fly, print and write."""
    chosen = options(__doc__, workers={"type": int, "metavar": "N", "help": "processes (default: one per core)"})
    run(partial(measure, chosen.quick, chosen.workers), "What each controller survives", chosen.json)


if __name__ == "__main__":
    from mismatch import main as start  # worker processes import `fly` by its module's name

    start()
