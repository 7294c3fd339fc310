"""Rotor speeds, or thrust and body rates: the same laws through both interfaces, in wind, on an estimate.

Vehicles, courses, air, sensors and every controller's settings are in benchmarks/interfaces.toml.  All rows of a
vehicle fly the same seeds, in the same wind.  Errors are distances from the course as it is stated, unfiltered.
"""

from __future__ import annotations

import copy
import math
import time
from collections.abc import Mapping, Sequence
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np
from scipy.special import stdtrit
from timing import Record, Stopwatch, options, run, step_quantiles

from quadsim.assets import read_toml
from quadsim.console.progress import Progress
from quadsim.controller import ACCEPTED, NOT_CONVERGED
from quadsim.errors import QuadsimError
from quadsim.features.campaign.statistics import proportion
from quadsim.rollout.many import fly_many
from quadsim.rollout.rollout import Rollout
from quadsim.scenarios.loading import parse_scenario
from quadsim.scenarios.schema.scenario import Scenario
from quadsim.state import POSITION

Table = dict[str, Any]
Row = tuple[str, str]  # vehicle and controller
CONDITIONS: Final = read_toml(Path(__file__).with_suffix(".toml"))
COURSES: Final = ("circle", "steps")
SEEDS: Final = 16
LEAST_MARGIN: Final = -10.0  # worse margins are drawn there [deg]
QUICK: Final = ("hummingbird", ("rotors 20 Hz", "rates 20 Hz", "geometric, rates"), 1)  # vehicle, controllers, seeds


def rows() -> list[Row]:
    """Vehicle and controller of every row."""
    return [(vehicle, name) for vehicle in CONDITIONS["vehicles"] for name in CONDITIONS["controllers"]]


def merged(base: Mapping[str, Any], *others: Mapping[str, Any]) -> Table:
    """Tables merged field by field; the last one holds."""
    result = copy.deepcopy(dict(base))
    for other in others:
        for name, value in other.items():
            both = isinstance(value, Mapping) and isinstance(result.get(name), Mapping)
            result[name] = merged(result[name], value) if both else copy.deepcopy(value)
    return result


def scenario(row: Row, course: str, seed: int) -> Scenario:
    """A row's flight along a course."""
    vehicle, name = row
    entry = CONDITIONS["controllers"][name]
    table = merged(
        CONDITIONS["laws"][entry["law"]],
        CONDITIONS["interfaces"].get(entry["law"], {}).get(entry["commands"], {}),
        {"commands": entry["commands"]},
        entry.get("controller", {}),
        CONDITIONS.get("settings", {}).get(vehicle, {}).get(name, {}),
    )
    shared = merged(CONDITIONS["scenario"], CONDITIONS["vehicles"][vehicle], CONDITIONS["courses"][vehicle][course])
    filtered = {"reference": entry.get(course, {})}
    own = {"control_period": entry["control_period"], "controller": table, "seed": seed}
    return parse_scenario(merged(shared, filtered, own))


def fly(flight: tuple[Row, str, int]) -> Record:
    """One flight: its error [m], whether it was lost, its margin of tilt [deg], and its steps' processor times [ms]."""
    rollout, watch = Rollout(scenario(*flight)), Stopwatch(time.thread_time)
    watch.watch(rollout.loop.controller, "step", "step")
    flown = rollout.fly()
    control = flown.log.control
    away = control.truth[:, list(POSITION)] - flown.assembly.course.sample(control.t)[:, :3]
    tilt = next(finding for finding in flown.findings if finding.limit.signal == "tilt")
    return {
        "lost": flown.log.reason is not None,
        "error": math.sqrt(float(np.square(away).sum(axis=1).mean())),
        "violated": not tilt.satisfied,
        "margin": tilt.worst_margin,
        "unsolved": float(np.mean([status not in ACCEPTED - {NOT_CONVERGED} for status in control.status])),
        "step_ms": 1e3 * np.array(watch.laps["step"]),
    }


def summary(flights: Mapping[str, Sequence[Record]]) -> Record:
    """A row's flights by course: RMS errors with half their mean's 95 % interval [m], shares with their intervals."""
    every = [flight for flown in flights.values() for flight in flown]
    record: Record = {}
    for course, flown in flights.items():
        errors = np.array([flight["error"] for flight in flown if not flight["lost"]])
        n = len(errors)
        record[course] = float(errors.mean()) if n else None
        record[f"{course}_half"] = float(stdtrit(n - 1, 0.975) * errors.std(ddof=1)) / math.sqrt(n) if n > 1 else None
    lost = proportion(sum(flight["lost"] for flight in every), len(every))
    record |= {"flights": len(every), "lost": lost["count"], "lost_from": lost["lower"], "lost_to": lost["upper"]}
    record["violated"] = float(np.mean([flight["violated"] for flight in every]))
    record["worst_margin"] = min(flight["margin"] for flight in every)
    record["unsolved"] = float(np.mean([flight["unsolved"] for flight in every]))
    return record | step_quantiles(np.concatenate([flight["step_ms"] for flight in every]))


def measure(quick: bool, workers: int | None, report: Progress) -> list[Record]:
    """A record of each vehicle and controller."""
    chosen, seeds = rows(), SEEDS
    if quick:
        chosen, seeds = [(QUICK[0], name) for name in QUICK[1]], QUICK[2]
    flights = [(row, course, seed) for row in chosen for course in COURSES for seed in range(seeds)]
    flown: dict[int, Record] = {}
    with closing(fly_many(flights, fly, workers=workers)) as answers:
        for done, (place, answer) in enumerate(answers, 1):
            report("flights", done, len(flights))
            if "verdict" in answer:
                raise QuadsimError(f"{flights[place]}: {answer['verdict']} ({answer['reason']})")
            flown[place] = answer
    places = {flight: place for place, flight in enumerate(flights)}
    return [
        {
            "vehicle": row[0],
            "controller": row[1],
            **summary({course: [flown[places[row, course, seed]] for seed in range(seeds)] for course in COURSES}),
        }
        for row in chosen
    ]


def draw(records: Sequence[Record], path: Path) -> None:
    """Draw errors, worst margins and step times, a line for each controller, a row of panels for each vehicle."""
    import matplotlib.pyplot as plt

    vehicles = list(dict.fromkeys(record["vehicle"] for record in records))
    titles = (
        *("circle: RMS error [cm]", "steps of 1 m: RMS error [cm]"),
        *("worst margin of tilt [deg]; violated", "step: median to p99 [ms]"),
    )
    size = (12.5, 0.6 + 2.9 * len(vehicles))
    figure, panels = plt.subplots(len(vehicles), 4, sharex="col", squeeze=False, figsize=size)
    for axes, vehicle in zip(panels, vehicles, strict=True):
        selected = [record for record in records if record["vehicle"] == vehicle]
        for y, record in enumerate(selected):
            name, n = record["controller"], record["flights"]
            look: Table = {"color": "C2" if name.startswith("geometric") else "C0" if "rotors" in name else "C1"}
            for panel, course in zip(axes[:2], COURSES, strict=True):
                if record[course] is not None:
                    half = 100.0 * (record[f"{course}_half"] or 0.0)
                    panel.errorbar(100.0 * record[course], y, xerr=half, fmt="o", capsize=3, markersize=5, **look)
            axes[2].plot(max(record["worst_margin"], LEAST_MARGIN), y, "o", markersize=5, **look)
            lost = f", lost {record['lost']}" if record["lost"] else ""
            note = f"{round(n * record['violated'])} of {n}{lost}"
            axes[2].annotate(note, (0.98, y), xycoords=("axes fraction", "data"), va="center", ha="right", fontsize=8)
            axes[3].plot([record["p50_ms"], record["p99_ms"]], [y, y], "-", **look)
            axes[3].plot(record["p50_ms"], y, "o", markersize=5, **look)
        for panel in axes:
            panel.set_yticks(range(len(selected)), [""] * len(selected))
            panel.set_ylim(len(selected) - 0.5, -0.5)
            panel.grid(axis="x", alpha=0.3)
        axes[0].set_yticklabels([record["controller"] for record in selected])
        axes[0].set_ylabel(vehicle, fontsize=11)
        axes[2].axvline(0.0, color="black", linewidth=0.8)
        axes[2].set_xlim(LEAST_MARGIN - 1.0, 40.0)
        axes[3].set_xscale("log")
        axes[3].xaxis.set_major_formatter("{x:g}")
    for panel, title in zip(panels[0], titles, strict=True):
        panel.set_title(title, loc="left", fontsize=10)
    for panel in panels[-1, :2]:
        panel.set_xlim(left=0.0)
    figure.tight_layout()
    figure.savefig(path, dpi=150)
    plt.close(figure)


def main() -> None:
    """Fly, print and write."""
    chosen = options(__doc__, workers={"type": int, "metavar": "N", "help": "processes (default: one per core)"})
    title = "Rotor speeds, or thrust and body rates"
    records = run(partial(measure, chosen.quick, chosen.workers), title, chosen.json)
    if chosen.json is not None:
        draw(records, chosen.json.with_suffix(".png"))


if __name__ == "__main__":
    from interfaces import main as start  # worker processes import `fly` by its module's name

    start()
