"""Where linear control ends: how well each controller follows agile courses, flown ever faster.

A flight is judged by its mean position error, and by how long roll or pitch is beyond a bound within which the course
can be flown.  Weights of the MPCs that are linearised at hover come from `quadsim.features.design.first_scenario`;
those of all other controllers are their defaults.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np
from scipy.special import stdtrit
from timing import Record, options, run

from quadsim.assets import vehicle_path
from quadsim.console.progress import Progress
from quadsim.errors import QuadsimError
from quadsim.features.design.first_scenario import first_scenario
from quadsim.flight import metrics
from quadsim.rollout.many import fly_many
from quadsim.rollout.rollout import Rollout
from quadsim.scenarios.assembly import Assembly
from quadsim.scenarios.feasibility_check import report
from quadsim.scenarios.loading import parse_scenario
from quadsim.state import INDEX, tilt
from quadsim.vehicle import Vehicle, load_vehicle

Table = dict[str, Any]

ROOM: Final = 10.0
"""By how much the bound on tilt is above what the course takes without drag [deg]."""
STEEPEST: Final = 80.0
"""Largest bound: the most that the baselines may be given [deg]."""
TOLERANCE: Final = 0.5
"""Beyond the bound by no more than this is no violation [deg]."""
SEEDS: Final = 5
"""Flights of each controller at each speed where the world is random."""
NODE: Final = 0.1
"""From node to node of the nonlinear MPC at most, as Torrente et al. (2021) have it [s]."""
QUICK: Final = ("loop, drag", 6.0, ("LQR", "nonlinear"))


@dataclass(frozen=True, kw_only=True)
class World:
    """A vehicle on a course, at several speeds."""

    vehicle: str  # its name
    size: float  # of the course [m]; a vehicle farther off is lost
    speeds: tuple[float, ...]  # to fly at [m/s]
    course: Callable[[float, float], tuple[Table, float]]  # `[reference]` and duration [s] at a speed, for a period [s]
    changes: Table  # of the vehicle's first scenario, whose plant has lag, inertia and drag of the vehicle's file
    seeds: int = 1  # flights at each speed; 1 where nothing is random


def _loop(speed: float, period: float) -> tuple[Table, float]:
    reference = {"type": "ramped_circle", "radius": 5.0, "acceleration": 2.0, "ramp": 1.0, "heading": "held"}
    return {**reference, "speed": speed, "sampling": period}, speed + 2.0


def _eight(speed: float, period: float) -> tuple[Table, float]:
    length = 4.0
    turn = math.tau * math.sqrt(0.5) * length / speed
    reference = {"type": "figure_eight", "length": length, "speed": speed, "turns": 2.0, "ramp": turn, "start": 0.5}
    return reference, period * math.ceil((0.5 + 3.0 * turn) / period)


PLANT: Final = {"timestep": 0.0005, "integrator": "rk4", "limit_speeds": True}
DRAG: Final = {"air": {"linear_drag": [0.3, 0.3, 0.0], "quadratic_drag": [0.08, 0.08, 0.08]}}  # of Torrente et al.
SENSED: Final = {  # those of the library's `motion-capture`
    "sensors": {
        "position": {"rate": 100.0, "noise": 0.01},
        "attitude": {"rate": 100.0, "noise": 0.26},
        "rates": {"rate": 500.0, "noise": 0.43, "bias_walk": 0.0022},
    },
    "estimator": {"type": "error_state"},
}
LOOP: Final[Table] = {
    "vehicle": "torrente2021",
    "size": 10.0,
    "speeds": (4.0, 6.0, 8.0, 10.0, 12.0, 14.0),
    "course": _loop,
}
EIGHT: Final[Table] = {"size": 4.0, "course": _eight}
WORLDS: Final = {
    "loop": World(**LOOP, changes={"plant": PLANT, "effects": {}}),
    "loop, drag": World(**LOOP, changes={"plant": PLANT, "effects": DRAG}),
    "crazyflie2": World(**EIGHT, vehicle="crazyflie2", speeds=(2.0, 3.0, 4.0, 5.0), changes={}),
    "hummingbird": World(**EIGHT, vehicle="hummingbird", speeds=(3.0, 4.0, 5.0, 6.0, 7.0), changes={}),
    "hummingbird, sensors": World(**EIGHT, vehicle="hummingbird", speeds=(4.0, 6.0), changes=SENSED, seeds=SEEDS),
}


def controllers(vehicle: Vehicle, tuned: Table, period: float, bound: float) -> dict[str, Table]:
    """The `[controller]` tables by name.

    Args:
        vehicle: that they fly.
        tuned: the table of its first scenario, a robust MPC.
        period: of control [s].
        bound: on roll and pitch [deg].
    """
    lag = vehicle.rotor_rise or 0.0
    robust = {
        **tuned,
        "output_bounds": {name: [-bound, bound] for name in ("roll", "pitch")},
        "input_bounds": {
            "speed": [vehicle.speed_min, vehicle.speed_max],
            "slew": [-vehicle.speed_max, vehicle.speed_max],
        },
    }
    shared = ("horizon", "output_weights", "input_weights", "output_bounds", "input_bounds")
    periods_per_node = max(1, math.floor(NODE / period + 1e-9))  # periods from node to node
    nonlinear = {
        "type": "nonlinear",
        "horizon": periods_per_node * math.ceil(tuned["horizon"] / periods_per_node),
        "node": periods_per_node * period,
        "substeps": math.ceil(periods_per_node * period / lag) if lag else 1,
        "rotor_lag": tuned["rotor_lag"],
        "terminal": "lqr",
        "tilt": bound,
        "soft": {},
    }
    observed = {"feedforward": True, "indi": {}, "disturbance": {"rotor_lag": lag}}
    return {
        "LQR": {"type": "lqr", "tilt": bound},
        "PID": {"type": "pid", "tilt": bound},
        "constrained": {"type": "constrained", **{name: value for name, value in robust.items() if name in shared}},
        "robust": robust,
        "geometric": {"type": "geometric", "tilt": bound},
        "geometric +": {"type": "geometric", "tilt": bound, **observed},
        "nonlinear": nonlinear,
        "nonlinear +": {**nonlinear, "disturbance": {}},
    }


LINEAR: Final = ("LQR", "PID", "constrained", "robust")
LAWS: Final = (*LINEAR, "geometric", "geometric +", "nonlinear", "nonlinear +")


def fly(cell: tuple[str, float, str, int]) -> Record:
    """Fly one controller in one world at one speed [m/s] with one seed."""
    world, speed, law, seed = WORLDS[cell[0]], *cell[1:]
    vehicle = load_vehicle(vehicle_path(world.vehicle))
    data = first_scenario(vehicle, world.vehicle, course="figure-eight").to_data()
    tuned, period = data["controller"], data["control_period"]
    data["reference"], data["duration"] = world.course(speed, period)
    data |= {"seed": seed, "constraints": [], "lost": {"distance": world.size}, **copy.deepcopy(world.changes)}
    bound = min(STEEPEST, round(report(Assembly(parse_scenario(data))).tilt + ROOM))
    data["controller"] = controllers(vehicle, tuned, period, bound)[law]
    log = Rollout(parse_scenario(data)).fly().log
    # A row of the plant covers the step that follows it; the last has none.
    states, speeds = log.plant.state[:-1], log.control.speeds
    beyond = np.degrees(np.abs(states[:, [INDEX["roll"], INDEX["pitch"]]]).max(axis=1)) > bound + TOLERANCE
    at_end = (speeds <= vehicle.speed_min) | (speeds >= vehicle.speed_max)
    return {
        "bound": float(bound),
        "error": None if log.reason else float(metrics.tracking(log.control)["position_error"]["mean"]),
        "tilt": float(np.degrees(tilt(states)).max()),
        "violated": float(beyond.mean()),
        "saturated": float(at_end.any(axis=1).mean()),
        "fallback": float((log.control.fallback > 0).mean()),
    }


def merged(flights: Sequence[Record]) -> Record:
    """Seeds of one flight as one: means but for the tilt, with half the 95 % interval of the mean error [m]."""
    errors = np.array([flight["error"] for flight in flights if flight["error"] is not None])
    n, half = len(flights), None
    if 1 < n == len(errors):
        half = float(stdtrit(n - 1, 0.975) * errors.std(ddof=1)) / math.sqrt(n)
    shares = {key: float(np.mean([f[key] for f in flights])) for key in ("violated", "saturated", "fallback")}
    return {
        "bound": flights[0]["bound"],
        "error": float(errors.mean()) if len(errors) == n else None,
        "half": half,
        "lost": n - len(errors),
        "tilt": max(flight["tilt"] for flight in flights),
        **shares,
    }


def measure(quick: bool, workers: int | None, report: Progress) -> list[Record]:
    """A record of each course, speed and controller."""
    cells = [(world, speed, law) for world, entry in WORLDS.items() for speed in entry.speeds for law in LAWS]
    if quick:
        cells = [cell for cell in cells if cell[:2] == QUICK[:2] and cell[2] in QUICK[2]]
    flights = [(*cell, seed) for cell in cells for seed in range(WORLDS[cell[0]].seeds)]
    rows: dict[tuple[str, float, str], list[tuple[int, Record]]] = {cell: [] for cell in cells}
    with closing(fly_many(flights, fly, workers=workers)) as answers:
        for flown, (place, row) in enumerate(answers, 1):
            report("flights", flown, len(flights))
            if "bound" not in row:
                raise QuadsimError(f"{flights[place]}: {row['verdict']} ({row['reason']})")
            rows[flights[place][:3]].append((place, row))
    return [
        {
            "course": cell[0],
            "speed": cell[1],
            "controller": cell[2],
            **merged([row for _, row in sorted(rows[cell], key=lambda entry: entry[0])]),
        }
        for cell in cells
    ]


def draw(records: Sequence[Record], path: Path) -> None:
    """Draw error and share of violation over speed, a column of panels for each course; linear laws dashed."""
    import matplotlib.pyplot as plt

    courses = list(dict.fromkeys(record["course"] for record in records))
    size = (3.1 * len(courses) + 1.0, 6.4)
    figure, panels = plt.subplots(2, len(courses), sharex="col", sharey="row", squeeze=False, figsize=size)
    for column, course in enumerate(courses):
        errors, violations = panels[:, column]
        for i, law in enumerate(LAWS):
            selected = [record for record in records if (record["course"], record["controller"]) == (course, law)]
            look: Table = {
                "color": f"C{i}",
                "linestyle": "--" if law in LINEAR else "-",
                "marker": "o",
                "markersize": 3,
            }
            speeds = [record["speed"] for record in selected]
            errors.plot(speeds, [math.nan if f["error"] is None else f["error"] for f in selected], label=law, **look)
            violations.plot(speeds, [100.0 * record["violated"] for record in selected], **look)
        errors.set_title(course, loc="left", fontsize=10)
        errors.set_yscale("log")
        violations.set_xlabel("speed [m/s]")
    panels[0, 0].set_ylabel("mean position error [m]; none: lost")
    panels[1, 0].set_ylabel("time beyond the tilt bound [%]")
    figure.legend(*panels[0, 0].get_legend_handles_labels(), loc="lower center", ncols=len(LAWS))
    figure.tight_layout(rect=(0.0, 0.06, 1.0, 1.0))
    figure.savefig(path, dpi=150)
    plt.close(figure)


def main() -> None:
    """Fly, print and write."""
    chosen = options(__doc__, workers={"type": int, "metavar": "N", "help": "processes (default: one per core)"})
    records = run(partial(measure, chosen.quick, chosen.workers), "Where linear control ends", chosen.json)
    if chosen.json is not None:
        draw(records, chosen.json.with_suffix(".png"))


if __name__ == "__main__":
    from speed import main as start  # worker processes import `fly` by its module's name

    start()
