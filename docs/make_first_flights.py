"""Remake docs/first-flights.md, first scenarios of shipped and drawn vehicles, flown once: `make first-flights`.

No clock decides anything here.  The vehicles are drawn by tests/plausible_vehicles.py; the flights are made and flown
by tests/first_flights.py, as the tests do with some of them.
"""

from __future__ import annotations

import math
import statistics
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from itertools import product
from pathlib import Path

from first_flights import DRAWN, LARGEST_RMS, REQUIREMENTS, SEED, FirstFlight, fly_first, vehicles
from make_numbers import markdown
from plausible_vehicles import HEAVIEST, LIGHTEST, QUICKEST, SLOWEST, STRONGEST, WEAKEST

from quadsim.vehicle import Vehicle
from scenarios.design.first_scenario import COURSES, LAG_SHARE, LAWS, PREVIEW, ROOM, SHARE, largest_eight
from scenarios.design.tuning import STEEPEST, THRUST_SHARE, tune

PAGE = Path(__file__).resolve().parent / "first-flights.md"
Flights = dict[tuple[str, str, str], FirstFlight]
"""By vehicle, course and law."""
FLOWN = ("satisfied", "violated")
"""Outcomes of flights that reached their end."""
STEEPER = math.radians(55.0)
"""A tilt bound to try beside the rule's [rad]."""


def page(flown: list[Vehicle], flights: Flights, steeper: dict[str, FirstFlight]) -> str:
    """The whole page."""
    robust = [flight for (_, _, law), flight in flights.items() if law == LAWS[0]]
    met = sum(flight.meets_the_bar for flight in robust)
    missed = [name for name, flight in steeper.items() if not flight.meets_the_bar]
    fast = [vehicle.name for vehicle in flown if largest_eight(vehicle, tune(vehicle))[1] == "speed"]
    parts = [
        "# First flights\n\nMade by `make first-flights`; nothing here is typed by hand.\n\n"
        "`quadsim scenario --for VEHICLE --course COURSE [--controller NAME]` makes a scenario from a vehicle's\n"
        "numbers ([own-vehicle.md](own-vehicle.md)). Here it is made and flown once, untouched, for the vehicles that\n"
        f"ship and for {DRAWN} drawn at random (seed {SEED}): {1e3 * LIGHTEST:g} g to {HEAVIEST:g} kg, "
        f"thrust to weight {WEAKEST:g} to {STRONGEST:g},\nrotor lag {1e3 * QUICKEST:g} to {1e3 * SLOWEST:g} ms, "
        "X and plus, with lag, inertia and drag in the plant.\n",
        "Every controller has to meet the same requirements: at the control samples errors along x, y and z of at "
        f"most\n{100 * ROOM:g} % of the course's size (tracking); at every instant the whole vehicle above the ground "
        "(floor), and the bounds on\nroll and pitch (tilt), on rotor speeds and on their steps (rotors). The courses: "
        f"hover, 1 m steps, and a figure eight at\n{100 * SHARE:g} % of what the vehicle can do. How many flights "
        "satisfied all of them, and how many failed which:\n",
        markdown(
            [
                ("controller", *COURSES, "satisfied", *REQUIREMENTS, "ended early"),
                *(_totals(flights, law) for law in LAWS),
            ]
        ),
        "The bar for `robust` is higher: an RMS error below "
        f"{100 * LARGEST_RMS:g} % of the course's size, too. It is met in **{met} of {len(robust)}** flights.\n",
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
        "The baselines plan nothing ahead. The gains of PID and geometric control allow for "
        f"{100 * LAG_SHARE:g} % of the rotors' lag, which\nleaves a quarter to three quarters of the delay margin of "
        "the robust controller's loop. All take the reference's velocity\n"
        f"from the next {PREVIEW:g} / w; the rules: [own-vehicle.md](own-vehicle.md#baselines). The LQR tracks the "
        "reference's pose and velocity, not\nits acceleration, so it lags on every moving course.\n",
        "Each cell: RMS error and largest error along an axis in percent of the course's size, then the room left to "
        "the tilt bound\nin percent of it, after the requirements that **failed**. Lag is the longer of rise and fall, "
        "w the bandwidth of x and y.\n",
    ]
    for law in LAWS:
        rows = [row(vehicle, flights, law) for vehicle in flown]
        parts.append(f"## {law}\n\n{_summary(flights, law)}\n\n{markdown([_head(), *rows])}")
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
    if flight.outcome not in FLOWN:
        return f"**{flight.outcome}**"
    numbers = f"{100.0 * flight.rms:.1f}, {100.0 * flight.largest:.1f}, {100.0 * flight.nearest:.0f}"
    return f"**{', '.join(flight.failed)}** {numbers}" if flight.failed else numbers


def _totals(flights: Flights, law: str) -> tuple[str, ...]:
    flown: dict[str, list[FirstFlight]] = {course: [] for course in COURSES}
    for (_, course, by), flight in flights.items():
        if by == law:
            flown[course].append(flight)
    every = [flight for some in flown.values() for flight in some]
    held = [sum(flight.outcome == "satisfied" for flight in flown[course]) for course in COURSES]
    return (
        law,
        *(f"{count} of {len(flown[course])}" for count, course in zip(held, COURSES, strict=True)),
        f"{sum(held)} of {len(every)}",
        *(str(sum(name in flight.failed for flight in every)) for name in REQUIREMENTS),
        str(sum(flight.outcome not in FLOWN for flight in every)),
    )


def _summary(flights: Flights, law: str) -> str:
    texts = []
    for course in COURSES:
        flown = [
            flight
            for (_, where, by), flight in flights.items()
            if (where, by) == (course, law) and flight.outcome in FLOWN
        ]
        rms, largest = ([100.0 * getattr(flight, name) for flight in flown] for name in ("rms", "largest"))
        texts.append(
            f"{course}: RMS error median {statistics.median(rms):.1f} %, most {max(rms):.1f} %; "
            f"largest error median {statistics.median(largest):.1f} %, most {max(largest):.1f} %"
        )
    return ".\n".join(texts) + "."


def main() -> None:
    """Fly everything and write the page."""
    found = vehicles()
    with ProcessPoolExecutor() as pool:
        cells = list(product(found, COURSES, LAWS))
        flown = pool.map(fly_first, *zip(*cells, strict=True))
        steep = pool.map(partial(fly_first, course="figure-eight", law=LAWS[0], steepest=STEEPER), found)
        flights = {
            (vehicle.name, course, law): flight for (vehicle, course, law), flight in zip(cells, flown, strict=True)
        }
        steeper = {vehicle.name: flight for vehicle, flight in zip(found, steep, strict=True)}
    PAGE.write_text(page(found, flights, steeper), encoding="utf-8")


if __name__ == "__main__":
    main()
