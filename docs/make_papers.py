"""Remake docs/papers.md, published numbers and ours: `make reproduce`, some five minutes.

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
FAST = "{velocity_noise=0.001,velocity_walk=0.001,force_walk=1.0,largest_force=20.0}"
TORQUE = "effects.disturbance.torque=[0.2,-0.1,0.03]"
GEOMETRIC = "controller={type = 'geometric', tilt = 80.0, feedforward = %s}"
QUICK = "true, lag = 0.006, disturbance = {force = 40.0}, indi = {}"
DETAILS = """
Three details without a field are compared by `tests/scenarios/papers/test_details.py` with the numbers of that separate
implementation: the reference window one sample late (circle at 4 m/s, ideal, 0.04073 m; at 8 m/s with drag, 0.1852
m), drag by component in the world frame (circle at 8 m/s, 0.2492 m), and the first command from a guess of zero
(0.122371 and 0.122879), from which ours, begun along the reference, differs by the guess alone.
"""
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
        measure = "tracking.position_error.mean"   # a dotted path into summary.json, checked before the first flight
        unit = "m"
        published = 0.12                     # or the lowest and the highest of several
        relation = "equal"                   # or "at most", "at least"
        relative = 0.01                      # or absolute = 0.001
        source = "Table 2"

Leave out `duration` of a course of turns or ramps, as `torrente-loop4-ideal.toml` does: the flight then ends with its
course at any speed. A mean over a longer flight counts the rest at the end as well.

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
    """The flights with noise, and two that do better, over seeds."""
    rows: Table = [("flight", "mean [m]", "standard deviation [m]", "lowest [m]", "highest [m]")]
    flights = [(f"torrente-{course}-all",) for course in COURSES]
    for name, *changes in [*flights, ("torrente-loop8-all", "controller.disturbance={}"), ("torrente-loop8-flatness",)]:
        errors = np.array([mean_error(fly(name, f"seed={seed}", *changes)) for seed in range(SEEDS)])
        numbers = (errors.mean(), errors.std(ddof=1), errors.min(), errors.max())
        title = ", ".join(f"`{each}`" for each in (name, *changes))
        rows.append((title, *(f"{number:.5f}" for number in numbers)))
    return rows


LAWS = (
    ("nonlinear MPC", ()),
    ("nonlinear MPC, drag law known", ("controller.drag=[0.3,0.3,0]", "controller.quadratic_drag=[0.08,0.08,0.08]")),
    ("nonlinear MPC, constant force observed: `offset_free`", (f"controller.offset_free={FAST}",)),
    ("nonlinear MPC, drag fitted in flight: `disturbance`", ("controller.disturbance={}",)),
    ("the same, and INDI", ("controller.disturbance={}", "controller.indi={}")),
    ("geometric control", (GEOMETRIC % "false",)),
    ("the same with feed-forward", (GEOMETRIC % "true",)),
    ("the same, drag of 0.6/s known", (GEOMETRIC % "true, drag = [0.6, 0.6, 0.3]",)),
    ("feed-forward and force observed", (GEOMETRIC % "true, disturbance = {}",)),
    ("the same, and INDI", (GEOMETRIC % "true, disturbance = {}, indi = {}",)),
    ("the same, gains for a lag of 6 ms, bandwidth 40 rad/s", (GEOMETRIC % QUICK,)),
)


def improved() -> Table:
    """Mean position errors of all laws under drag and noise; on the circle at 8 m/s with a constant torque too."""
    rows: Table = [("law", "circle, 4 m/s", "circle, 8 m/s", "lemniscate, 8 m/s", "circle, 8 m/s, torque")]
    for law, changes in LAWS:
        flights = [fly(f"torrente-{course}-all", *changes) for course in COURSES]
        flights.append(fly("torrente-loop8-all", TORQUE, *changes))
        rows.append((law, *(f"{mean_error(flight):.4f}" for flight in flights)))
    return rows


def main() -> None:
    """Fly everything and write the page."""
    parts = [
        "# Papers that anyone can rerun\n\nMade by `make reproduce`; nothing here is typed by hand.\n\n"
        "```sh\nquadsim reproduce quadrotor-uav\n```\n\n"
        "flies one paper again and prints what it publishes, ours, and the difference; without a name, all.\n",
        *(section(found.grid) for found in reproduce()),
        "A line with a colon changes one detail of the flight, and shows its effect; its number is from a "
        "separate implementation.\nThe mean of the position error, which that paper calls RMSE, is "
        "`tracking.position_error.mean` of `summary.json`; the true root\nmean square is "
        "`tracking.position_error.rms`.\n" + DETAILS,
        "## Noise over seeds\n\n" + markdown(seeds()),
        "## Better than published\n\nPublished of learned models on the circle at 8 m/s with noise: "
        "0.0273 and 0.020 m.\nMean errors [m] without learning; the last column with a constant torque of 0.2, -0.1 "
        "and 0.03 N m:\n\n" + markdown(improved()),
        "## MuJoCo's integration and theirs\n\nTheir plant is integrated with the drag evaluated at all four stages of "
        'a Runge-Kutta step, `plant.integrator = "rk4"`;\nMuJoCo\'s Runge-Kutta step holds the drag of its middle. '
        "With steps of 0.5 ms they differ by this:\n\n" + markdown(integrations()),
        HOW,
    ]
    write_page("papers.md", *parts)


if __name__ == "__main__":
    main()
