"""How often the 95 % interval of an identified parameter holds the truth, on logs of drawn vehicles.

Each vehicle has the numbers of the Hummingbird times factors, in X layout, flies 20 s under geometric control at 100 Hz
in a wind of 0.9 m/s with turbulence, and is identified from what its sensors say, given a start file that is wrong by
up to a factor of two.  Of the logs that pass a parameter's gates, `inside` are those whose interval holds the truth.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Mapping, Sequence
from contextlib import closing, suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np
from interfaces import merged
from timing import Record, options, run

import quadsim
from quadsim.console.progress import Progress
from quadsim.errors import QuadsimError
from quadsim.features.design.first_scenario import first_scenario
from quadsim.features.identify.estimate import VECTORS
from quadsim.features.identify.fit import identify_records
from quadsim.features.identify.record import Record as Log
from quadsim.rollout.flown import Flight
from quadsim.rollout.many import fly_many
from quadsim.rotation import euler_to_body_rates, euler_to_quaternion
from quadsim.scenarios.loading import parse_scenario
from quadsim.sim.airframe import munk_moment
from quadsim.sim.effects.wind import SEA_LEVEL_DENSITY
from quadsim.state import ANGLE_RATES, ANGLES, POSITIONS, VELOCITIES
from quadsim.vehicle import VEHICLE_UNITS, Vehicle

Table = dict[str, Any]
DrawnLog = tuple[str, int]  # condition and seed of a log
VEHICLES: Final = 20
FIRST_SEED: Final = 422_400_000
DURATION: Final = 20.0  # [s]
TRACKED: Final = {
    "position": {"rate": 100.0, "noise": 0.003},
    "velocity": {"rate": 100.0, "noise": 0.03},
    "attitude": {"rate": 100.0, "noise": 0.3},
    "rates": {"rate": 100.0, "noise": 1.5},
}
RAW: Final = {
    "position": {"rate": 100.0, "noise": 0.003},
    "attitude": {"rate": 100.0, "noise": 0.3},
    "rates": {"rate": 500.0, "noise": 0.6, "bias": 0.5, "bias_walk": 0.0022},
}
SHARED: Final[Table] = {
    "duration": DURATION,
    "control_period": 0.01,
    "sensors": TRACKED,
    "effects": {
        "air": {"wind": [0.8, -0.5, 0.0], "turbulence": {"altitude": 10.0, "wind_speed_20ft": 7.7}},
    },
}
CONDITIONS: Final[dict[str, Table]] = {
    "eight, yaw steps": {"yaw_steps": True},
    "eight": {},
    "hover": {"hover": True},
    "body drag": {"yaw_steps": True, "body_drag": True},
    "moments, damping": {"yaw_steps": True, "moments": True},
    "moments, still air": {"yaw_steps": True, "moments": True, "still": True},
    "torque 0.003, yaw steps": {"yaw_steps": True, "torque": 0.003},
    "torque 0.01, yaw steps": {"yaw_steps": True, "torque": 0.01},
    "torque 0.003, eight": {"torque": 0.003},
    "torque 0.01, eight": {"torque": 0.01},
    "torque 0.003, hover": {"hover": True, "torque": 0.003},
    "raw sensors, estimator": {"yaw_steps": True, "estimator": True},
    "commands 10 ms late": {"yaw_steps": True, "late": 1},
    "commands 10 ms early": {"yaw_steps": True, "late": -1},
    "torque and force that last": {"yaw_steps": True, "still": True, "lasting": True},
}
"""Of each row: the flight, torque noise [N m s^0.5], and by how many periods the log's commands are late."""


def drawn(rng: np.random.Generator, *, body_drag: bool, moments: bool = False) -> Vehicle:
    """A vehicle, with a moment of its rotors and damping where `moments`."""
    base = quadsim.load_vehicle("hummingbird")
    inertia = rng.uniform(0.75, 1.4) * base.inertia[0] * np.array([1.0, rng.uniform(0.85, 1.15), 0.0])
    inertia[2] = rng.uniform(0.7, 0.97) * inertia.sum()
    lag, ratio = rng.uniform(0.02, 0.05), rng.choice([1.0, rng.uniform(1.0, 1.6)])
    vehicle = replace(
        base,
        rotor_azimuths=(-45.0, -135.0, 135.0, 45.0),
        rotor_spins=(-1, 1, -1, 1),
        thrust_coefficient=base.mean_coefficient * rng.uniform(0.8, 1.25),
        inertia=tuple(inertia.tolist()),
        drag_to_thrust=base.drag_to_thrust * rng.uniform(0.7, 1.4),
        rotor_rise=float(lag / math.sqrt(ratio)),
        rotor_fall=float(lag * math.sqrt(ratio)),
        rotor_inertia=(base.rotor_inertia or 0.0) * rng.uniform(0.6, 1.5),
        rotor_drag=(base.rotor_drag or 0.0) * rng.uniform(1.2, 3.2),
        body_drag=base.body_drag if body_drag else None,
        rotor_moment=tuple((rng.uniform(0.4, 3.0, 2) * 1e-5).tolist()) if moments else None,
        rate_damping=tuple((rng.uniform(0.2, 2.0, 3) * inertia).tolist()) if moments else None,
    )
    if not moments:
        return vehicle
    turning = float(vehicle.hover_speeds.sum())
    gone = rng.uniform(0.1, 0.5, 2)  # share of the moment that a climb of 1 m/s takes
    return replace(vehicle, inflow_moment=tuple((gone * turning * np.array(vehicle.rotor_moment)).tolist()))


def wrong(vehicle: Vehicle, rng: np.random.Generator) -> Vehicle:
    """A start file: some of the vehicle's numbers wrong by up to a factor of two, lag and rotor drag guessed."""
    inertia = np.array(vehicle.inertia) * np.exp(rng.uniform(-0.6, 0.6, 3))
    inertia[2] = 0.87 * inertia[:2].sum() * rng.uniform(0.9, 1.1)
    return replace(
        vehicle,
        thrust_coefficient=vehicle.mean_coefficient * rng.uniform(0.7, 1.4),
        inertia=tuple(inertia.tolist()),
        drag_to_thrust=vehicle.drag_to_thrust * rng.uniform(0.5, 2.0),
        speed_max=1.4 * vehicle.speed_max,
        rotor_rise=0.03,
        rotor_fall=0.03,
        rotor_inertia=5e-6,
        rotor_drag=1e-4,
        body_drag=None,
        rotor_moment=None,
        inflow_moment=None,
        rate_damping=None,
    )


def lasting(vehicle: Vehicle, rng: np.random.Generator) -> Table:
    """A random torque and force that last: `[effects.disturbance]`."""
    return {
        "torque_deviation": (rng.uniform(2.0, 8.0, 3) * vehicle.inertia).tolist(),
        "torque_time": rng.uniform(0.08, 0.5, 3).tolist(),
        "force_deviation": (rng.uniform(0.2, 0.8, 3) * vehicle.mass).tolist(),
        "force_time": rng.uniform(0.1, 0.6, 3).tolist(),
    }


def fly(vehicle: Vehicle, condition: Mapping[str, Any], rng: np.random.Generator) -> Flight:
    """Fly what is logged."""
    course = "hover" if condition.get("hover") else "figure-eight"
    data = first_scenario(vehicle, "drawn", course=course, law="geometric").to_data()
    numbers = {name: value for name in VEHICLE_UNITS if (value := getattr(vehicle, name)) is not None}
    changes: Table = {"vehicle": {"file": "drawn", **numbers}, "seed": int(rng.integers(2**31)), "constraints": []}
    if course == "figure-eight":
        turn = data["reference"]["period"]
        changes["reference"] = {"turns": max(1.0, round((DURATION - data["reference"]["ramp"] - 1.0) / turn))}
    if condition.get("yaw_steps"):
        angles = rng.uniform(15.0, 35.0, 21) * (-1.0) ** np.arange(21)
        changes["events"] = [
            {"type": "setpoint", "at": round(1.6 + 0.8 * i, 2), "yaw": float(angle)} for i, angle in enumerate(angles)
        ]
    if torque := condition.get("torque"):
        changes["effects"] = {"disturbance": {"torque_noise": torque}}
    if condition.get("still"):
        changes["effects"] = {"air": {"wind": [0.0, 0.0, 0.0], "turbulence": None}}
        if disturbance := condition.get("disturbance"):
            changes["effects"]["disturbance"] = disturbance
    table = merged(data, SHARED, changes)
    if condition.get("estimator"):
        table |= {"sensors": RAW, "estimator": {"type": "error_state"}}
    return quadsim.fly(parse_scenario(table), progress=False)


def logged(flight: Flight, late: int) -> Log:
    """The flight's log, its commands late by some periods."""
    log = flight.log.control
    angles = log.state[:, ANGLES]
    return Log(
        name="drawn",
        t=log.t,
        position=log.state[:, POSITIONS],
        velocity=log.state[:, VELOCITIES],
        attitude=euler_to_quaternion(angles),
        rates=euler_to_body_rates(angles, log.state[:, ANGLE_RATES]),
        commands=log.speeds[np.clip(np.arange(len(log.t)) - late, 0, len(log.t) - 1)],
    )


def truth_of(vehicle: Vehicle, late: int) -> dict[str, float]:
    """What the estimates are to hold, by name."""
    true = {name: getattr(vehicle, name) or 0.0 for name in VEHICLE_UNITS}
    for name, axes in VECTORS.items():
        numbers = getattr(vehicle, name) or [0.0] * len(axes)
        true |= {f"{name}_{axis}": value for axis, value in zip(axes, numbers, strict=True)}
    if vehicle.body_drag is not None:
        munk = munk_moment(vehicle.body_drag, SEA_LEVEL_DENSITY)
        true |= dict(zip(("inflow_moment_x", "inflow_moment_y"), munk, strict=True))
    return true | {
        "body_drag": (vehicle.body_drag or [0.0])[0],
        "lateness": 0.0,
        "delay": -0.01 * late,
        "offset_x": 0.0,
        "offset_y": 0.0,
    }


def identify(log: DrawnLog) -> Record:
    """Of one log: by parameter, whether it passes, and whether its interval holds the truth."""
    name, seed = log
    rng, condition = np.random.default_rng(seed), CONDITIONS[name]
    late, own = condition.get("late", 0), {name: name in condition for name in ("body_drag", "moments")}
    vehicle = drawn(rng, **own)
    disturbance = lasting(vehicle, rng) if "lasting" in condition else {}
    condition = {**condition, "disturbance": disturbance}
    flown = logged(fly(vehicle, condition, rng), late)
    found = identify_records([flown], [[slice(0, len(flown.t))]], wrong(vehicle, rng), wind="still" not in condition)
    true = truth_of(vehicle, late)
    judged = {
        estimate.name: {
            "passed": not estimate.refused,
            "inside": bool(estimate.low <= true[estimate.name] <= estimate.high),
            "error": float(estimate.value / true[estimate.name] - 1.0 if true[estimate.name] else estimate.value),
        }
        for estimate in found.estimates
    }
    for estimate in found.disturbance if disturbance else ():
        place = "xyz".index(estimate.axis)
        for number in ("deviation", "time"):
            truth = disturbance[f"{estimate.kind}_{number}"][place]
            low, high = getattr(estimate, f"{number}_interval")
            judged[f"{estimate.kind}_{number}_{estimate.axis}"] = {
                "passed": not estimate.refused,
                "inside": low <= truth <= high,
                "error": getattr(estimate, number) / truth - 1.0,
            }
    return judged


def summaries(condition: str, answers: Sequence[Mapping[str, Any]]) -> list[Record]:
    """Of one condition: by parameter, how many passed, how many of these are inside, and the median error of all.

    A log that raised has no estimates; it counts as `failed`.
    """
    found = [answer for answer in answers if "verdict" not in answer]
    records = []
    for name in found[0] if found else ():
        each = [log[name] for log in found]
        records.append(
            {
                "condition": condition,
                "parameter": name,
                "logs": len(answers),
                "failed": len(answers) - len(found),
                "passed": sum(one["passed"] for one in each),
                "inside": sum(one["passed"] and one["inside"] for one in each),
                "median_error": float(np.median([abs(one["error"]) for one in each])),
            }
        )
    return records


def remembered(file: Path | None) -> dict[DrawnLog, Record]:
    """What an earlier call left in a file of answers, one line of JSON per log; a line that was cut off is none."""
    known: dict[DrawnLog, Record] = {}
    for line in file.read_text(encoding="utf-8").splitlines() if file is not None and file.is_file() else ():
        with suppress(json.JSONDecodeError):
            entry = json.loads(line)
            known[entry["condition"], entry["seed"]] = entry["answer"]
    return known


def measure(chosen: argparse.Namespace, report: Progress) -> list[Record]:
    """A record of each condition and parameter, vehicle after vehicle, so that a part of it is a part of each."""
    conditions, vehicles = (["hover"], 1) if chosen.quick else ([*CONDITIONS], chosen.vehicles)
    logs = [(name, chosen.seed + 100 * i + k) for k in range(vehicles) for i, name in enumerate(conditions)]
    known = remembered(chosen.answers)
    left = [log for log in logs if log not in known]
    with closing(fly_many(left, identify, workers=chosen.workers)) as answers:
        for done, (place, answer) in enumerate(answers, 1):
            report("logs", done, len(left))
            log = left[place]
            known[log] = answer
            if "verdict" in answer:
                print(f"{log}: {answer['verdict']} ({answer['reason']})", file=sys.stderr)
            if chosen.answers is not None:
                entry = {"condition": log[0], "seed": log[1], "answer": answer}
                with chosen.answers.open("a", encoding="utf-8") as file:
                    file.write(json.dumps(entry) + "\n")
    records = []
    for name in conditions:
        records += summaries(name, [known[log] for log in logs if log[0] == name])
    if not records:
        raise QuadsimError("no log could be identified")
    return records


def main() -> None:
    """Fly, identify, print and write."""
    chosen = options(
        __doc__,
        workers={"type": int, "metavar": "N", "help": "processes (default: one per core)"},
        vehicles={"type": int, "metavar": "N", "default": VEHICLES, "help": "of each condition (default: %(default)s)"},
        seed={"type": int, "metavar": "N", "default": FIRST_SEED, "help": "the first (default: %(default)s)"},
        answers={"type": Path, "metavar": "FILE", "help": "keep each log's answer there, and what is there already"},
    )
    run(partial(measure, chosen), "Truth inside the interval, of the logs that pass", chosen.json)


if __name__ == "__main__":
    from intervals import main as start  # worker processes import `identify` by its module's name

    start()
