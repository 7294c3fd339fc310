"""First scenarios of a small vehicle that the air turns, with the moment in the law's model and without.

The vehicle is the shipped Crazyflie with rotors that lag by 38 ms, as brushless ones do, or by 72 ms as its own, and
numbers of the size that flights of small quadrotors show: at hover it is turned by 43 rad/s^2 per m/s.

"With": its file states them, and `quadsim scenario --for` makes the scenario of that file.  "Without": the controller
is made for a file that lacks them; vehicle, course and constraints are the same.
"""

from __future__ import annotations

from contextlib import closing
from functools import partial
from typing import Any, Final

from timing import Record, options, run

from quadsim.assets import vehicle_path
from quadsim.console.progress import Progress
from quadsim.errors import QuadsimError
from quadsim.features.design.first_scenario import DESIGNED_LAWS, first_scenario
from quadsim.flight.metrics import tracking
from quadsim.rollout.many import fly_many
from quadsim.rollout.rollout import Rollout
from quadsim.scenarios.loading import parse_scenario
from quadsim.scenarios.schema.scenario import Scenario
from quadsim.vehicle import Vehicle, altered, load_vehicle

BASE: Final = "crazyflie2"
AIR: Final[dict[str, Any]] = {
    **{"rotor_moment": (8.2e-8, 10.5e-8), "inflow_moment": (2e-4, 3e-4), "rate_damping": (2e-5, 2e-5, 2e-5)},
    "inflow": 2.4e-6,
}
"""What the air does to the vehicle; by `inflow` its rotors lose 6 % of their thrust per m/s."""
LAGS: Final = (0.038, 0.072)
"""Time constants of its rotors [s]."""
MOVING: Final = ("step", "figure-eight")


def turned_vehicle(lag: float) -> Vehicle:
    """The vehicle with rotors that lag so long [s], as it is."""
    return load_vehicle(vehicle_path(BASE), {"rotor_rise": lag, "rotor_fall": lag, **AIR})


def scenario_of(lag: float, law: str, course: str, *, known: bool) -> tuple[Scenario, float]:
    """The first scenario of a law, its controller made for a file with the moment or without; the course's size [m].

    The vehicle that flies has the moment either way, and its course is the same.
    """
    vehicle = turned_vehicle(lag)
    made = first_scenario(vehicle, BASE, course=course, law=law)
    numbers = {"rotor_rise": lag, "rotor_fall": lag}
    air = {name: [*value] if isinstance(value, tuple) else value for name, value in AIR.items()}
    data = made.to_data()
    data["vehicle"] = {"file": BASE, **numbers, **(air if known else {})}
    if not known:
        ignorant = first_scenario(altered(vehicle, dict.fromkeys(AIR)), BASE, course=course, law=law)
        data |= {"actual": air, "controller": ignorant.to_data()["controller"]}
    return parse_scenario(data), made.size


def fly(scenario: Scenario) -> Record:
    """The verdict of a flight, and its largest error along x, y or z [m]."""
    flight = Rollout(scenario).fly()
    errors = tracking(flight.log.control)["max_error"]
    violated = [finding.limit.name for finding in flight.findings if not finding.satisfied]
    return {
        "outcome": flight.outcome,
        "largest": max(errors[axis] for axis in "xyz"),
        "violated": ", ".join(violated),
    }


def measure(quick: bool, workers: int | None, report: Progress) -> list[Record]:
    """A record of each flight, in order."""
    laws = ("pid",) if quick else DESIGNED_LAWS
    lags = LAGS[:1] if quick else LAGS
    cells = [(lag, law, course, known) for lag in lags for law in laws for course in MOVING for known in (False, True)]
    made = [scenario_of(lag, law, course, known=known) for lag, law, course, known in cells]
    rows: dict[int, Record] = {}
    with closing(fly_many([scenario for scenario, _ in made], fly, workers=workers)) as answers:
        for flown, (place, row) in enumerate(answers, 1):
            report("flights", flown, len(made))
            if "largest" not in row:
                raise QuadsimError(f"{cells[place]}: {row['verdict']} ({row['reason']})")
            rows[place] = row
    records = []
    for i, (lag, law, course, known) in enumerate(cells):
        share = rows[i]["largest"] / made[i][1]
        record = {"law": law, "course": course, "lag": lag, "moment": "with" if known else "without"}
        records.append(record | rows[i] | {"share": share})
    return records


def main() -> None:
    """Fly, print and write."""
    chosen = options(__doc__, workers={"type": int, "metavar": "N", "help": "processes (default: one per core)"})
    run(partial(measure, chosen.quick, chosen.workers), "With the moment in the model, and without", chosen.json)


if __name__ == "__main__":
    from moment import main as start  # worker processes import `fly` by its module's name

    start()
