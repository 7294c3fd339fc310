"""Remake docs/scenarios.md, the library's scenarios in one table per group: `make numbers`.

Flies every scenario that ships.  No clock decides anything here; tests/scenarios/test_library.py holds every row.
"""

from __future__ import annotations

import itertools
import math
from pathlib import Path
from typing import get_args

from make_numbers import fly, markdown

from quadsim.controller import SOLVED
from quadsim.flight.audit import Finding
from quadsim.flight.metrics import peak_tilt, tracking
from scenarios.flight import Flight
from scenarios.schema.scenario import Group, LostSpec
from scenarios.shipped import scenario_names

PAGE = Path(__file__).resolve().parent / "scenarios.md"
TITLES: dict[Group, str] = {
    "paper": "The paper's flights, and where its controller ends",
    "papers": "Other papers, reproduced",
    "courses": "Courses and vehicles",
    "air": "Wind, drag and rotors that lag",
    "faults": "Faults, loads and slow computers",
    "ground": "Take-off, landing and the ground",
    "space": "Obstacles, windows and corridors",
    "sensors": "Sensors and estimation",
}
HEAD = (
    *("scenario", "shows", "verdict", "s", "peak roll, pitch [deg]", "RMS error x, y, z [m]"),
    *("nearest to its bound", "QPs [%]"),
)


def row(flight: Flight) -> tuple[str, ...]:
    """One scenario's line: what it shows, its verdict, and its numbers where the vehicle was not lost."""
    scenario, log = flight.scenario, flight.log
    flown = log.control.t.size * scenario.control_period
    first = (f"`{scenario.name}`", scenario.description, flight.outcome, f"{flown:g}")
    if flight.outcome == "lost":
        return (*first, "-", "-", "-", "-")
    rmse = tracking(log.control)["rmse"]
    solved = f"{100.0 * log.control.status.count(SOLVED) / log.control.t.size:.0f}" if flight.solver else "-"
    errors = ", ".join(f"{rmse[axis]:.3f}" for axis in "xyz")
    return (*first, f"{peak_tilt(log.plant.state):.1f}", errors, nearest(flight), solved)


def nearest(flight: Flight) -> str:
    """The required constraint that is broken most, or else is held by least, as a share of its range.

    Bounds on speeds and steps are left out: the controller keeps them to the last digit, or is far from them.
    """
    required = (finding.limit.required and finding.limit.signal not in ("speed", "slew") for finding in flight.findings)
    found = min(itertools.compress(flight.findings, required), key=_share)
    left = min(found.worst_margin, found.worst_margin_sampled)
    return f"{found.limit.name} {round(left, 2) + 0.0:.2f} {found.limit.unit}"


def _share(finding: Finding) -> float:
    limit = finding.limit
    bounds = [abs(bound) for bound in (limit.lower, limit.upper) if math.isfinite(bound)]
    left = min(finding.worst_margin + limit.tolerance, finding.worst_margin_sampled + limit.tolerance_sampled)
    return round(left / (max(*bounds, limit.tolerance) or 1.0), 2)  # of equals the first: rounding decides nothing


def _criteria() -> str:
    fields = LostSpec.model_fields.items()
    return "".join(f"- `lost.{name} = {info.default:g}`: {info.description}\n" for name, info in fields)


def page(flights: dict[str, Flight]) -> str:
    """The whole page."""
    count = len(flights)
    parts = [
        "# The scenarios\n\nMade by `make numbers`; nothing here is typed by hand.\n\n"
        f"{count} scenarios ship. `quadsim run NAME` flies one; `quadsim scenario NAME` prints its whole file with "
        "comments, to start your\nown from; comments in the files, in `scenarios/library`, state "
        "what each shows and with what numbers.\n",
        "The verdict is *satisfied* (flown to its end, every required constraint holds), *violated* (one does not, the "
        "vehicle\ncrashes, or the controller ends in [permanent fallback](controllers.md#fallback)), *lost* (the "
        "flight ends early) or *incomplete* (it ends\nbefore the window of a required constraint begins, as with "
        "`--set duration=20`). Each file states it, and a test flies them all;\nthose that are not satisfied are meant "
        "not to be. What is audited: [constraints](controllers.md#what-is-audited).\n",
        "A flight is lost when its controller gives up or answers with no command, when the simulation diverges, or "
        "when the true\nstate is beyond a criterion of `[lost]` at a control sample: looked at once per period, until "
        "the vehicle has crashed, which is\n*violated*. Every scenario has these criteria, and `false` switches one "
        "off, as `--set lost.tilt=false` for loops and flips. The\nflight is recorded up to there; `summary.json` has "
        "the criterion under `lost`, and its value, limit and time in `reason`.\n",
        _criteria(),
        "`s`: seconds flown. `nearest to its bound`: the required constraint, but for those on speeds and steps, with "
        "the least left\nas a share of its range, and what is left at the physics rate; a little below 0 is within the "
        "constraint's tolerance where\nthe verdict is *satisfied*. `QPs`: periods in which the unconstrained optimum "
        "was not feasible, so that the\nactive-set method or a QP solver found the optimum.\n",
    ]
    for group in get_args(Group):
        members = [flight for flight in flights.values() if flight.scenario.group == group]
        if members:
            table = markdown([HEAD, *(row(flight) for flight in members)])
            parts.append(f"## {TITLES.get(group, group)}\n\n{table}")
    return "\n".join(parts)


def main() -> None:
    """Fly everything and write the page."""
    PAGE.write_text(page({name: fly(name) for name in scenario_names()}), encoding="utf-8")


if __name__ == "__main__":
    main()
