"""First flights, made and flown in memory: what the tests and docs/own-vehicle.md judge `quadsim.features.design` by.

`python tests/first_flights.py` flies every vehicle on every course by every law, and prints JSON.
"""

from __future__ import annotations

import json
import math
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from itertools import product
from typing import Final

from quadsim.assets import vehicle_names, vehicle_path
from quadsim.features.design.courses_by_rule import COURSES
from quadsim.features.design.first_scenario import DESIGNED_LAWS, first_scenario
from quadsim.features.design.plausible_vehicles import plausible_vehicles
from quadsim.flight.metrics import peak_tilt, tracking
from quadsim.rollout.rollout import Rollout
from quadsim.scenarios.loading import parse_scenario
from quadsim.vehicle import VEHICLE_UNITS, Vehicle, load_vehicle

REQUIREMENTS: Final = {
    "tracking": ("hold_x", "hold_y", "hold_z"),
    "floor": ("floor",),
    "tilt": ("roll", "pitch", "tilt"),
    "rotors": ("speed", "slew"),
}
"""What a first scenario requires, and the constraints that state it."""
LARGEST_RMS: Final = 0.05
"""Of the robust controller's position error, over the course's size."""


@dataclass(frozen=True, kw_only=True)
class FirstFlight:
    """How a first flight went.

    Attributes:
        outcome: the verdict in one word.
        rms: of the distance from the reference, over the course's size; NaN where hardly anything was flown.
        largest: error along x, y or z, likewise.
        failed: of `REQUIREMENTS`, those that did not hold.
        tilt: largest roll or pitch [deg].
    """

    outcome: str
    rms: float
    largest: float
    failed: tuple[str, ...]
    tilt: float

    @property
    def meets_the_bar(self) -> bool:
        """Whether it was flown to its end, every constraint held, with an RMS error within the bar."""
        return self.outcome == "satisfied" and self.rms < LARGEST_RMS


def vehicles() -> list[Vehicle]:
    """Those that ship, and the drawn ones."""
    return [*(load_vehicle(vehicle_path(name)) for name in vehicle_names()), *plausible_vehicles(20, seed=2026)]


def fly_first(vehicle: Vehicle, course: str, law: str) -> FirstFlight:
    """Make a first scenario and fly it once."""
    made = first_scenario(vehicle, vehicle.name, course=course, law=law)
    numbers = {name: value for name in VEHICLE_UNITS if (value := getattr(vehicle, name)) is not None}
    given = {name: list(value) if isinstance(value, tuple) else value for name, value in numbers.items()}
    flight = Rollout(parse_scenario(made.to_data() | {"vehicle": {"file": vehicle.name, **given}})).fly()
    failed = {finding.limit.name for finding in flight.findings if not finding.satisfied}
    requirements = tuple(name for name, constraints in REQUIREMENTS.items() if not failed.isdisjoint(constraints))
    if not flight.log.control.t.size:
        return FirstFlight(outcome=flight.outcome, rms=math.nan, largest=math.nan, failed=requirements, tilt=math.nan)
    errors = tracking(flight.log.control)
    return FirstFlight(
        outcome=flight.outcome,
        rms=math.hypot(*(errors["rmse"][axis] for axis in "xyz")) / made.size,
        largest=max(errors["max_error"][axis] for axis in "xyz") / made.size,
        failed=requirements,
        tilt=peak_tilt(flight.log.plant.state),
    )


def main() -> None:
    """Fly everything and print it."""
    cells = list(product(vehicles(), COURSES, DESIGNED_LAWS))
    with ProcessPoolExecutor() as pool:
        flown = pool.map(fly_first, *zip(*cells, strict=True))
        names = [{"vehicle": vehicle.name, "course": course, "law": law} for vehicle, course, law in cells]
        print(json.dumps([name | asdict(flight) for name, flight in zip(names, flown, strict=True)], indent=1))


if __name__ == "__main__":
    main()
