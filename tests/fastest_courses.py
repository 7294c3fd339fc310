"""The fastest safe speed of five vehicles on three courses: the table of docs/own-vehicle.md.

`python tests/fastest_courses.py` finds them, as `quadsim scenario --for VEHICLE --course COURSE --fastest` does, and
prints JSON.
"""

from __future__ import annotations

import json
from concurrent.futures import ProcessPoolExecutor
from itertools import product
from pathlib import Path
from typing import Any, Final

from quadsim.assets import vehicle_path
from quadsim.features.design.any_course import course_for
from quadsim.features.design.fastest import fly_fastest
from quadsim.features.design.first_scenario import first_scenario
from quadsim.vehicle import load_vehicle

SHIPPED: Final = ("crazyflie2", "hummingbird", "torrente2021", "lopes2011")
IRIS: Final = Path(__file__).with_name("vehicles") / "iris.toml"
VEHICLES: Final = (*SHIPPED, str(IRIS))
COURSES: Final = ("figure-eight", "minimum-snap", "waypoints")


def fastest(vehicle: str, course: str) -> dict[str, Any]:
    """Find the fastest speed of a vehicle on a course, with the default margin."""
    loaded = load_vehicle(vehicle_path(vehicle))
    made = course_for(course, loaded, vehicle, law="robust")
    found = fly_fastest(first_scenario(loaded, vehicle, course=made).scenario)
    stopped = found.stopped.worst
    return {
        "vehicle": loaded.name,
        "course": course,
        "size": made.size,
        "margin": found.margin,
        "by_rule": found.fastest.speed / found.fastest.pace,
        "speed": found.fastest.speed,
        "stopped_at": found.stopped.speed,
        "stopped_by": None if stopped is None else stopped.limit.name,
        "flights": len(found.flights),
    }


def main() -> None:
    """Find all of them and print them."""
    cells = list(product(VEHICLES, COURSES))
    with ProcessPoolExecutor(max_workers=2) as pool:
        rows = list(pool.map(fastest, *zip(*cells, strict=True)))
    print(json.dumps(rows, indent=1))


if __name__ == "__main__":
    main()
