"""Remake docs/papers.md, published numbers and ours: `make reproduce`, some three minutes.

No clock decides any of it; tests/scenarios/papers holds the short flights.
"""

from __future__ import annotations

import numpy as np
from make_numbers import Table, fly, markdown, write_page

from quadsim.report.table import section
from scenarios.flight import Flight
from scenarios.many_flights import reproduce

COURSES = ("loop4", "loop8", "lemniscate8")
SEEDS = 16
HOW = """## How to add a paper

1. Make its vehicle (`quadsim vehicle --template`) and its scenarios: files of your own, or in `scenarios/library`.
2. Write one TOML file of its numbers; in `scenarios/papers` it ships, elsewhere `quadsim reproduce mine.toml` takes it:

        title = "Its title"
        authors = "Who wrote it"
        publication = "Where and when"
        about = "What is reproduced, and what it is written from"

        [[numbers]]
        name = "circle at 2 m/s"
        scenario = "my-circle.toml"          # a library name, or a path beside this file
        set = { reference.speed = 2.0 }      # merged over the scenario
        measure = "tracking.position_error.mean"   # a dotted path into summary.json
        unit = "m"
        published = 0.12                     # or the lowest and the highest of several
        relation = "equal"                   # or "at most", "at least"
        relative = 0.01                      # or absolute = 0.001
        source = "Table 2"

`quadsim reproduce` flies all that ship; exits with 1 where a number is beyond its tolerance (`--json`, `--junit FILE`).
"""


def mean_error(flight: Flight) -> float:
    """Of the position [m]."""
    return float(flight.metrics["position_error.mean"])


def integrations() -> Table:
    """The flights with drag by both integrators."""
    rows: Table = [("flight", "mean error [m], rk4", "mean error [m], MuJoCo", "largest distance between them [m]")]
    for course in COURSES:
        name = f"torrente-{course}-drag"
        ours, mujocos = (fly(name, f"plant.integrator={each}") for each in ("rk4", "mujoco"))
        apart = np.linalg.norm((ours.log.plant.state - mujocos.log.plant.state)[:, 0:6:2], axis=1).max()
        rows.append((f"`{name}`", *(f"{mean_error(each):.6f}" for each in (ours, mujocos)), f"{apart:.0e}"))
    return rows


def seeds() -> Table:
    """The flights with noise, over seeds."""
    rows: Table = [("flight", "mean [m]", "standard deviation [m]", "lowest [m]", "highest [m]")]
    for course in COURSES:
        name = f"torrente-{course}-all"
        errors = np.array([mean_error(fly(name, f"seed={seed}")) for seed in range(SEEDS)])
        numbers = (errors.mean(), errors.std(ddof=1), errors.min(), errors.max())
        rows.append((f"`{name}`", *(f"{number:.5f}" for number in numbers)))
    return rows


def main() -> None:
    """Fly everything and write the page."""
    parts = [
        "# Papers that anyone can rerun\n\nMade by `make reproduce`; nothing here is typed by hand.\n\n"
        "```sh\nquadsim reproduce quadrotor-uav\n```\n\n"
        "flies one paper again and prints what it publishes, ours, and the difference; without a name, all.\n",
        *(section(found.grid) for found in reproduce()),
        "A line with a colon changes one detail of the flight, and says what it is worth; its number is from a "
        "separate implementation.\nThe mean of the position error, which that paper calls RMSE, is "
        "`tracking.position_error.mean` of `summary.json`; the true root\nmean square is "
        "`tracking.position_error.rms`.\n",
        "## Noise over seeds\n\n" + markdown(seeds()),
        "## MuJoCo's integration and theirs\n\nTheir plant is integrated with the drag evaluated at all four stages of "
        'a Runge-Kutta step, `plant.integrator = "rk4"`;\nMuJoCo\'s Runge-Kutta step holds the drag of its middle. '
        "With steps of 0.5 ms they differ by this:\n\n" + markdown(integrations()),
        HOW,
    ]
    write_page("papers.md", *parts)


if __name__ == "__main__":
    main()
