"""What identification is worth: controllers made from a guessed file, from the identified one, and from the true one.

Vehicles are drawn, and a start file is guessed for each.  The controller made from that flies the true vehicle once;
from the log of this flight the vehicle is identified.  All three controllers then fly the true vehicle along the same
course, under the same constraints, in the same wind and with the same sensor noise.
"""

from __future__ import annotations

import json
import math
import tempfile
from collections.abc import Sequence
from contextlib import closing, suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np
from timing import Record, options, run

import quadsim
from quadsim.console.progress import Progress
from quadsim.errors import InputError, QuadsimError
from quadsim.features.campaign.statistics import proportion
from quadsim.features.design.plausible_vehicles import plausible_vehicles
from quadsim.features.identify.report import IdentifiedVehicle
from quadsim.flight.metrics import tracking
from quadsim.rollout.flown import Flight
from quadsim.rollout.many import fly_many
from quadsim.rollout.rollout import Rollout
from quadsim.scenarios.loading import parse_scenario
from quadsim.vehicle import VEHICLE_UNITS, Vehicle

Table = dict[str, Any]
MODELS: Final = ("start", "identified", "true")
VEHICLES: Final = 20
SEEDS: Final = 8  # flights of each controller on each vehicle
DRAW: Final = 2026  # seed of the vehicles
QUICK: Final = ((0, 2), 1)  # vehicles, flights of each controller
EXCITATION: Final = 20.0  # [s] of the flight that is identified from
YAW: Final = 25.0  # [deg] of its yaw steps, there and back
YAW_EVERY: Final = 2.0  # [s]
LAG: Final = 0.03  # [s] a lag that one guesses without knowing better
PLATE: Final = 0.87  # Izz over Ixx + Iyy, likewise
TILT_TOLERANCE: Final = 2.0  # [deg] for wind and noise, which the tilt bound of a first scenario does not know
WIND: Final = {"wind": [1.0, 0.0, 0.0], "turbulence": {"altitude": 10.0, "wind_speed_20ft": 3.85}}  # m/s, light
SENSORS: Final = {
    name: {"rate": 100.0, "noise": noise}  # Hz; m, m/s, deg, deg/s
    for name, noise in {"position": 0.003, "velocity": 0.03, "attitude": 0.3, "rates": 1.5}.items()
}


def guessed(vehicle: Vehicle, rng: np.random.Generator) -> Vehicle:
    """A start file: what is weighed and measured with a ruler is true, everything else is wrong by up to a factor."""

    def factor() -> float:
        return float(np.exp(rng.uniform(-math.log(2.0), math.log(2.0))))

    x, y = (factor() * moment for moment in vehicle.inertia[:2])
    known = numbers(vehicle)
    lag, air = factor(), factor()
    guess: Table = {"rotor_rise": LAG, "rotor_fall": LAG, "rotor_drag": None, "body_drag": None}
    if rng.random() < 0.5:
        guess |= {name: lag * known[name] for name in ("rotor_rise", "rotor_fall")}
    if rng.random() < 0.5:
        guess |= {
            "rotor_drag": air * known["rotor_drag"],
            "body_drag": tuple(air * area for area in known["body_drag"]),
        }
    return replace(
        vehicle,
        inertia=(x, y, PLATE * (x + y)),
        thrust_coefficient=rng.uniform(0.7, 1.4) * vehicle.mean_coefficient,
        drag_to_thrust=factor() * vehicle.drag_to_thrust,
        rotor_inertia=factor() * known["rotor_inertia"],
        **guess,
    )


def numbers(vehicle: Vehicle) -> Table:
    """The parameters that a vehicle has."""
    return {name: value for name in VEHICLE_UNITS if (value := getattr(vehicle, name)) is not None}


def write(vehicle: Vehicle, path: Path) -> Path:
    """Write a vehicle file."""
    lines = [f"{name} = {json.dumps(getattr(vehicle, name))}" for name in ("name", "description")]
    for name, value in numbers(vehicle).items():
        lines += [f"[{name}]", f"value = {json.dumps(value)}", f'unit = "{VEHICLE_UNITS[name]}"', 'source = "drawn"']
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def first(file: Path, true: Vehicle, controller: str = "robust") -> Table:
    """A first figure eight made from a vehicle file, but flown by the true vehicle, in wind and with sensor noise."""
    table: Table = quadsim.scenario(vehicle=file, course="figure-eight", controller=controller).to_json()
    table["lost"] = {"distance": table["reference"]["length"], "depth": table["initial"]["position"][2]}
    # A bound on steps is per control period, and so each controller's own.
    table["constraints"] = [limit for limit in table["constraints"] if limit["name"] != "slew"]
    for limit in table["constraints"]:
        if limit["name"] in ("roll", "pitch"):
            limit |= {"tolerance": TILT_TOLERANCE, "tolerance_sampled": TILT_TOLERANCE}
    table["effects"]["air"] = table["effects"]["air"] | WIND
    return table | {"actual": numbers(true), "sensors": SENSORS}


def excite(table: Table, seed: int) -> Flight:
    """Fly figure eights, with yaw steps."""
    turns = math.ceil(EXCITATION / table["reference"]["period"])
    times = np.arange(YAW_EVERY, EXCITATION, YAW_EVERY).tolist()
    steps = [{"type": "setpoint", "at": at, "yaw": YAW * (-1) ** i} for i, at in enumerate(times)]
    own = {"reference": table["reference"] | {"turns": turns}, "duration": EXCITATION, "events": steps, "seed": seed}
    return Rollout(parse_scenario(table | own | {"constraints": []})).fly()


def identify(start: Path, true: Vehicle, seed: int) -> tuple[IdentifiedVehicle | None, Table]:
    """Fly the true vehicle by the start's controller and identify it; also returns how that flight went.

    Where that controller loses the vehicle so soon that the log cannot be used, the pilot takes the geometric baseline.
    """
    fate = {"cut": False, "baseline": False}
    for controller in ("robust", "geometric"):
        fate["baseline"] = controller == "geometric"
        flight = excite(first(start, true, controller), seed)
        fate["cut"] |= flight.log.reason is not None
        log = start.with_name(controller)
        flight.write_tables(log)
        with suppress(InputError):
            found = quadsim.identify(log, vehicle=start, out=start.with_name("identified.toml"), wind=True)
            return found, fate
    return None, fate


def fly(table: Table, seed: int) -> Record:
    """One flight: its RMS error over the course's length, inf if it was lost, and whether a constraint was violated."""
    flown = Rollout(parse_scenario(table | {"seed": seed})).fly()
    lost = flown.log.reason is not None
    error = math.inf if lost else tracking(flown.log.control)["position_error"]["rms"] / table["reference"]["length"]
    return {"error": error, "lost": lost, "violated": flown.outcome != "satisfied"}


def worth(place: int, seeds: int) -> Record:
    """The round trip of one drawn vehicle: what was identified, and the flights (seeds) by each model's controller."""
    true = plausible_vehicles(VEHICLES, DRAW)[place]
    with tempfile.TemporaryDirectory() as folder:
        files = {model: Path(folder) / f"{model}.toml" for model in MODELS}
        write(true, files["true"])
        write(guessed(true, np.random.default_rng([DRAW, place])), files["start"])
        result, fate = identify(files["start"], true, seeds + place)
        if result is None or result.file is None:  # no log, or one whose vehicle predicts worse than the start
            files["identified"] = files["start"]
        course = first(files["true"], true)
        shared = {name: course[name] for name in ("initial", "reference", "lost", "constraints")}
        flights = {
            model: [fly(first(file, true) | shared, seed) for seed in range(seeds)] for model, file in files.items()
        }
    estimates = () if result is None else result.identification.estimates
    passed = sum(not estimate.refused for estimate in estimates)
    return {"flights": flights, "failed": result is None, "passed": passed, "sought": len(estimates), **fate}


def summary(model: str, trips: Sequence[Record]) -> Record:
    """A row: errors over the vehicles, each by the median of its flights, and shares of all flights that failed."""
    flights = [flight for trip in trips for flight in trip["flights"][model]]
    errors = median_errors(model, trips)
    record: Record = {"file": model, "vehicles": len(trips), "flights": len(flights)}
    for name, share in (("median", 0.5), ("p90", 0.9)):
        record[f"{name}_%"] = finite(float(np.quantile(errors, share, method="inverted_cdf")))
    record["better_than_start"] = int(np.count_nonzero(errors < median_errors("start", trips)))
    for event in ("violated", "lost"):
        found = proportion(sum(flight[event] for flight in flights), len(flights))
        record |= {event: found["count"], f"{event}_from": found["lower"], f"{event}_to": found["upper"]}
    record["vehicles_lost"] = sum(any(flight["lost"] for flight in trip["flights"][model]) for trip in trips)
    if model == "identified":
        record |= {
            name: sum(trip[name] for trip in trips) for name in ("passed", "sought", "cut", "baseline", "failed")
        }
    record["errors_%"] = [finite(error) for error in errors.tolist()]
    record["losses"] = [sum(flight["lost"] for flight in trip["flights"][model]) for trip in trips]
    return record


def median_errors(model: str, trips: Sequence[Record]) -> np.ndarray[Any, np.dtype[np.float64]]:
    """(V,) median error of each vehicle's flights [% of the course's length]; inf where half of them were lost."""
    every = [[flight["error"] for flight in trip["flights"][model]] for trip in trips]
    return 100.0 * np.quantile(every, 0.5, axis=1, method="higher")


def finite(number: float) -> float | None:
    """A number, or None for infinity, which JSON lacks."""
    return number if math.isfinite(number) else None


def measure(quick: bool, workers: int | None, report: Progress) -> list[Record]:
    """A record of each file that controllers are made from."""
    places, seeds = QUICK if quick else (range(VEHICLES), SEEDS)
    trips: dict[int, Record] = {}
    with closing(fly_many(places, partial(worth, seeds=seeds), workers=workers)) as answers:
        for done, (i, answer) in enumerate(answers, 1):
            report("vehicles", done, len(places))
            if "verdict" in answer:
                raise QuadsimError(f"vehicle {places[i]}: {answer['verdict']} ({answer['reason']})")
            trips[i] = answer
    return [summary(model, [trips[i] for i in range(len(places))]) for model in MODELS]


def draw(records: Sequence[Record], path: Path) -> None:
    """Draw each vehicle's errors from file to file, and how often flights failed."""
    import matplotlib.pyplot as plt
    from matplotlib.ticker import NullLocator

    figure, (left, right) = plt.subplots(1, 2, figsize=(11.0, 4.6), layout="constrained")
    columns = np.arange(len(records))
    errors = np.array([record["errors_%"] for record in records], float)  # (3, V); NaN: half of the flights lost
    losses = np.array([record["losses"] for record in records])
    top = 2.0 * np.nanmax(errors)
    drawn = np.where(np.isnan(errors), top, errors)
    for y, lost in zip(drawn.T, losses.T, strict=True):
        left.plot(columns, y, "-o", color="C3" if lost.any() else "C0", alpha=0.6, markersize=4, linewidth=1.0)
        left.plot(columns[lost > 0], y[lost > 0], "x", color="C3", markersize=9)
    left.plot([], [], "-o", color="C0", markersize=4, label="a vehicle: median of its flights")
    left.plot([], [], "-o", color="C3", markersize=4, label="one with lost flights, where marked x")
    left.axhline(top, color="C3", linewidth=0.8, linestyle=":")
    left.set_yscale("log")
    marks = [mark for mark in (1.0, 2.0, 5.0, 10.0, 20.0, 50.0) if mark < 0.8 * top]
    left.set_yticks([*marks, top], [*(f"{mark:g}" for mark in marks), "lost in\nhalf or\nmore"])
    left.yaxis.set_minor_locator(NullLocator())
    left.set_ylim(0.4 * drawn.min(), 1.3 * top)
    left.set_title("RMS distance from the course [% of its length]", loc="left", fontsize=10)
    left.legend(fontsize=8, loc="lower right")
    for i, event in enumerate(("violated", "lost")):
        share = np.array([100.0 * record[event] / record["flights"] for record in records])
        ends = 100.0 * np.array([[record[f"{event}_from"], record[f"{event}_to"]] for record in records]).T
        place = columns + 0.36 * (i - 0.5)
        right.bar(place, share, 0.34, color=f"C{1 + 2 * i}", label=("a constraint violated, or lost", "lost")[i])
        right.errorbar(place, share, yerr=np.abs(ends - share), fmt="none", color="black", capsize=3, linewidth=1.0)
    right.set_title("flights that failed [%], with 95 % intervals", loc="left", fontsize=10)
    right.set_ylim(bottom=0.0)
    right.legend(fontsize=8)
    for axes in (left, right):
        axes.set_xticks(columns, [f"{record['file']} file" for record in records])
        axes.set_xlim(-0.5, len(records) - 0.5)
        axes.grid(axis="y", alpha=0.3)
    figure.savefig(path, dpi=150)
    plt.close(figure)


def main() -> None:
    """Fly, print and write."""
    chosen = options(__doc__, workers={"type": int, "metavar": "N", "help": "processes (default: one per core)"})
    records = run(partial(measure, chosen.quick, chosen.workers), "What identification is worth", chosen.json)
    if chosen.json is not None:
        draw(records, chosen.json.with_suffix(".png"))


if __name__ == "__main__":
    from identification import main as start  # worker processes import `worth` by its module's name

    start()
