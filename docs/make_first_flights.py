"""Remake docs/first-flights.md, first scenarios of shipped and drawn vehicles, flown once: `make first-flights`.

No clock decides anything here.  The vehicles are drawn by tests/plausible_vehicles.py; the flights are made and flown
by tests/first_flights.py, as the tests do with some of them.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Iterator
from pathlib import Path

from first_flights import DRAWN, LARGEST_RMS, SEED, FirstFlight, fly_first, vehicles
from make_numbers import markdown
from plausible_vehicles import HEAVIEST, LIGHTEST, QUICKEST, SLOWEST, STRONGEST, WEAKEST

from quadsim.vehicle import Vehicle
from scenarios.design.first_scenario import COURSES, LAWS, SHARE, largest_eight
from scenarios.design.tuning import STEEPEST, THRUST_SHARE, tune

PAGE = Path(__file__).resolve().parent / "first-flights.md"
Flights = dict[tuple[str, str, str], FirstFlight]
"""By vehicle, course and law."""
STEEPER = math.radians(55.0)
"""A tilt bound to try beside the rule's [rad]."""


def page(flown: list[Vehicle], flights: Flights, steeper: dict[str, FirstFlight]) -> str:
    """The whole page."""
    robust = [flight for (_, _, law), flight in flights.items() if law == LAWS[0]]
    met = sum(flight.meets_the_bar for flight in robust)
    missed = [name for name, flight in steeper.items() if not flight.meets_the_bar]
    held = sum(flight.outcome == "satisfied" for flight in flights.values())
    fast = [vehicle.name for vehicle in flown if largest_eight(vehicle, tune(vehicle))[1] == "speed"]
    parts = [
        "# First flights\n\nMade by `make first-flights`; nothing here is typed by hand.\n\n"
        "`quadsim scenario --for VEHICLE --course COURSE [--controller NAME]` makes a scenario from a vehicle's\n"
        "numbers ([own-vehicle.md](own-vehicle.md)). Here it is made and flown once, untouched, for the vehicles that\n"
        f"ship and for {DRAWN} drawn at random (seed {SEED}): {1e3 * LIGHTEST:g} g to {HEAVIEST:g} kg, "
        f"thrust to weight {WEAKEST:g} to {STRONGEST:g},\nrotor lag {1e3 * QUICKEST:g} to {1e3 * SLOWEST:g} ms, "
        "X and plus, with lag, inertia and drag in the plant.\n",
        f"The bar for `robust`: hover, 1 m steps and a figure eight at {100 * SHARE:g} % of what the vehicle can do, "
        "every\nconstraint held at every instant, RMS error below "
        f"{100 * LARGEST_RMS:g} % of the course's size.\nIt is met in **{met} of {len(robust)}** flights. "
        f"All controllers together hold every constraint in **{held} of {len(flights)}**.\n",
        "What a vehicle can do on a figure eight is the largest level acceleration within the tilt bound, or the\n"
        "fastest level speed where that is reached first"
        + (f", as of {', '.join(fast)}" if fast else "")
        + ". The speed ends where the moment of the air on\na body that flies aslant "
        "([Munk's](effects.md#limits)) tilts it further as quickly as its controller answers;\n"
        "[own-vehicle.md](own-vehicle.md#the-rules) has the rule.\n",
        f"The tilt bound is {math.degrees(STEEPEST):g} deg, or what {100 * THRUST_SHARE:g} % of the thrust holds where "
        "that is less. Most of these vehicles could\nhold more; the model linearised at hover is what ends. With a "
        f"bound of {math.degrees(STEEPER):g} deg the figure eight at {100 * SHARE:g} % of\nwhat that allows meets the "
        f"bar with {sum(flight.meets_the_bar for flight in steeper.values())} of {len(steeper)} vehicles"
        + (f", but not with {', '.join(missed)}" if missed else "")
        + ".\n",
        "The baselines fly the same courses with their own defaults, which plan nothing ahead; no error is required "
        "of\nthem, only the bounds.\n",
        "Each cell: RMS error in percent of the course's size, then the room left to the tilt bound in percent of it;\n"
        "**lost** or **violated** where it was. Lag is the longer of rise and fall, w the bandwidth of x and y.\n",
    ]
    for law in LAWS:
        rows = [row(vehicle, flights, law) for vehicle in flown]
        parts.append(f"## {law}\n\n{_summary(flights, law)}\n\n{markdown([_head(), *rows])}")
    parts.append(_failures(flights))
    return "\n".join(parts)


def _head() -> tuple[str, ...]:
    return ("vehicle", "kg", "layout", "thrust to weight", "lag [ms]", "w [rad/s]", *COURSES, "length of the eight [m]")


def row(vehicle: Vehicle, flights: Flights, law: str) -> tuple[str, ...]:
    """A vehicle's row in the table of a law."""
    tuning = tune(vehicle)
    cells = (_cell(flights[vehicle.name, course, law]) for course in COURSES)
    return (
        vehicle.name,
        f"{vehicle.mass:.3g}",
        "plus" if vehicle.rotor_azimuths[0] == 0.0 else "X",
        f"{tuning.authority.thrust_to_weight:.2f}",
        f"{1e3 * tuning.authority.lag:.0f}",
        f"{tuning.bandwidth:.1f}",
        *cells,
        f"{flights[vehicle.name, 'figure-eight', law].size:.3g}",
    )


def _cell(flight: FirstFlight) -> str:
    if flight.outcome == "lost":
        return "**lost**"
    numbers = f"{100.0 * flight.rms:.1f}, {100.0 * flight.nearest:.0f}"
    return numbers if flight.outcome == "satisfied" else f"**violated** {numbers}"


def _summary(flights: Flights, law: str) -> str:
    held = [flight for (_, _, name), flight in flights.items() if name == law]
    texts = [
        f"{sum(flight.outcome == 'satisfied' for flight in held)} of {len(held)} flights with every constraint held"
    ]
    for course in COURSES:
        rms = [
            100.0 * flight.rms
            for (_, where, name), flight in flights.items()
            if (where, name) == (course, law) and flight.outcome != "lost"
        ]
        texts.append(f"{course}: RMS error median {statistics.median(rms):.1f} %, largest {max(rms):.1f} %")
    return "; ".join(texts) + "."


def _failures(flights: Flights) -> str:
    lines = [
        f"- {name}, {course}, {law}: {flight.outcome}, tilt up to {flight.tilt:.0f} deg"
        for (name, course, law), flight in flights.items()
        if flight.outcome != "satisfied"
    ]
    return "## What was not flown\n\n" + ("\n".join(lines) if lines else "Nothing.") + "\n"


def _flown(found: list[Vehicle]) -> Iterator[tuple[tuple[str, str, str], FirstFlight]]:
    for law in LAWS:
        for vehicle in found:
            for course in COURSES:
                yield (vehicle.name, course, law), fly_first(vehicle, course, law)


def main() -> None:
    """Fly everything and write the page."""
    found = vehicles()
    flights = dict(_flown(found))
    steeper = {vehicle.name: fly_first(vehicle, "figure-eight", LAWS[0], steepest=STEEPER) for vehicle in found}
    PAGE.write_text(page(found, flights, steeper), encoding="utf-8")


if __name__ == "__main__":
    main()
