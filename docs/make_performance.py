"""Remake every time that docs/performance.md and docs/constraints-cost.md report: `make numbers`.

Everything is measured by `quadsim bench`; here it becomes pages.  Steps of controllers are timed once, as a flight sees
them (`scenarios.bench.timing`), and all tables and figures take them from there.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

from make_cost import timed, write_cost
from make_numbers import ROOT, Table, copy_figure, markdown, write_page

from quadsim.report.table import section
from scenarios.bench.bench_results import FlightProfile, RenderProfile, SolverBench
from scenarios.bench.bench_tables import flight_tables, render_tables, solver_tables
from scenarios.bench.campaigns import bench_campaign, campaign_tables
from scenarios.bench.film import bench_render
from scenarios.bench.flight import bench_flight
from scenarios.bench.solvers import bench_solvers, write_bench
from scenarios.bench.timing import in_turns, time_python
from scenarios.cost.measure import study_cost
from scenarios.loading import load_scenario
from scenarios.run import fly_scenario

SCENARIO = "paper-constrained"
REST = "## Where the time of a flight goes"
"""What begins with it stays as it is where steps alone are measured."""
NONLINEAR = "## Nonlinear MPC"
"""What begins with it is made by other commands: `make nonlinear`, and those that compare two checkouts."""

REPEATS = 5

AIR = ["effects.air.rotor_drag=3e-4", "effects.air.wind=[3.0, 0.0, 0.0]"]
LAG = ["effects.rotors.rise=0.02", "effects.rotors.fall=0.02"]
GPS = ["sensors.position={rate=20, noise=0.5, delay=0.11}", "sensors.attitude={rate=100, noise=1.0}"]
EFFECTS = {
    "none": [],
    "rotor lag": LAG,
    "rotor lag and inertia": [*LAG, "effects.rotors.inertia=1e-4"],
    "rotor drag, steady wind": AIR,
    "the same, body drag, turbulence": [
        *AIR,
        "effects.air.body_drag=[0.02, 0.02, 0.05]",
        "effects.air.turbulence={wind_speed_20ft=7.7}",
    ],
    "ground": ["effects.ground={contact=true}"],
    "ground, ground effect": ["effects.ground={contact=true, effect=true}"],
    "four sensors, no estimator": [
        *(f"sensors.{name}={{rate=100, noise=0.01}}" for name in ("position", "velocity", "attitude", "rates"))
    ],
    "position and attitude sensor, estimator": [*GPS, "estimator={type='error_state'}"],
    "the same with a gyro of 200 Hz": [*GPS, "sensors.rates={rate=200, noise=0.3}", "estimator={type='error_state'}"],
}
"""Effects whose cost is measured, as settings of the scenario; the first is what the others are compared with."""


EFFECTS_NOTE = (
    "The paper's unconstrained controller in hover, so that little but the plant is left; best of five, in turns, "
    "scaled to 60 s.\nWithout effects a control period is one call of MuJoCo; what depends on the vehicle's motion "
    "takes each physics step by itself,\nfrom Python."
)


TOGETHER_NOTE = (
    "Was measured, and is not done: several flights' physics steps as one batch of MuJoCo's, the forces between its "
    "steps evaluated for all\nvehicles at once. The numbers are the same to the bit. Of 8 to 64 flights together, one "
    "took 0.97 to 1.01 of its time alone without\nwind, and 0.82 to 1.08 in wind; the gain in wind begins where the "
    "logs of the flights in the air fill a worker's memory. A QP, sensors and\nthe log belong to one flight either way."
)


def effect_costs() -> Table:
    """What effects cost a flight of 20 s in hover; best of `REPEATS`, in turns."""
    hover = ["duration=20.0", "reference.x=[]", "reference.y=[]", "reference.z=[]", "initial.position=[0.0, 0.0, 2.0]"]
    scenarios = {name: load_scenario("paper-unconstrained", [*hover, *extra]) for name, extra in EFFECTS.items()}
    runs = {name: lambda flown=scenario: fly_scenario(flown).simulate_s for name, scenario in scenarios.items()}
    best = {name: min(seconds) for name, seconds in in_turns(runs, REPEATS).items()}
    rows: Table = [("effects", "60 s of flight [s]", "ratio")]
    for name, seconds in best.items():
        rows.append((name, f"{3.0 * seconds:.2f}", f"{seconds / best['none']:.2f}"))
    return rows


def whole_commands(flight: FlightProfile, film: RenderProfile) -> Table:
    """What a person waits for: the best of a few times, but for the film, whose time is long enough."""
    rows: Table = [
        ("what a person waits for, at best", "target", "measured [s]"),
        ("60 s of constrained flight simulated, one core", "<= 1.2 s", f"{flight.best:.2f}"),
    ]
    with tempfile.TemporaryDirectory() as scratch:
        run = f"{scratch}/run"
        filmed = f"`quadsim video`: the same 60 s, 1280x720 at 30 fps, {film.workers} cores"
        for label, target, repeats, *arguments in (
            ("`quadsim --help`", "<= 0.3 s", REPEATS, "--help"),
            (f"`quadsim run {SCENARIO} --no-video`", "<= 3.5 s", REPEATS, "run", SCENARIO, "--no-video", "--out", run),
            (filmed, "<= 50 s", 1, "video", run),
        ):
            times = [time_python("-m", "scenarios.cli", *arguments, tree=ROOT).wall_s for _ in range(repeats)]
            rows.append((label, target, f"{min(times):.2f}"))
    return rows


def campaigns() -> str:
    """What many flights cost, and what stepping them as one batch was found to save."""
    profile = bench_campaign(load_scenario(SCENARIO), rounds=5)
    by_daqp = bench_campaign(load_scenario(SCENARIO, ["controller.solver=daqp"]), rounds=1, sizes=())
    return "\n".join(
        [
            *(section(grid) for grid in campaign_tables(profile)),
            f"With `--set controller.solver=daqp`, which starts from its last active set, it is "
            f"{by_daqp.per_core_hour:.0f} flights per core-hour, in one round.\n",
            f"## Flights stepped as one batch\n\n{TOGETHER_NOTE}\n",
        ]
    )


def steps(bench: SolverBench) -> str:
    """The page's beginning: the tables of a controller's steps."""
    candidates, *others = solver_tables(bench)
    machine = bench.machine
    return "\n".join(
        [
            "# Performance\n\nMade by `make numbers` on one machine "
            f"({machine['processor']}, {machine['cores']} cores, no GPU); each table in one run: read the ratios.\n"
            f"`quadsim bench solvers`, `flight`, `render` and `campaign` measure the same on yours.\n\n"
            "A controller's step is timed in one way, as a flight sees it: between two steps the plant flies a period, "
            "each step is\ntaken three times in turns with all others', and the median counts. "
            "[constraints-cost.md](constraints-cost.md) has the\nsame numbers.\n",
            section(candidates),
            "![Time of a whole controller step of every candidate, and its growth with the horizon](solvers.png)\n",
            *(section(grid) for grid in others),
        ]
    )


def rest(flight: FlightProfile, film: RenderProfile, commands: str, effects: str, campaigns: str) -> str:
    """What else takes time."""
    return "\n".join(
        [
            *(section(grid) for grid in flight_tables(flight)),
            f"## What effects cost\n\n{EFFECTS_NOTE}\n\n{effects}",
            campaigns,
            *(section(grid) for grid in render_tables(film)),
            f"## Whole commands\n\n{commands}",
        ]
    )


def main() -> None:
    """Measure everything and write it; with --steps a controller's steps alone, and the rest stays as it is."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("--steps", action="store_true")
    options = parser.parse_args()
    scenario, path = load_scenario(SCENARIO), ROOT / "docs" / "performance.md"
    if options.steps:
        end = "".join(path.read_text(encoding="utf-8").partition(REST)[1:])
    else:
        flight, film = bench_flight(scenario), bench_render(scenario)
        commands, effects = markdown(whole_commands(flight, film)), markdown(effect_costs())
        section = "".join(path.read_text(encoding="utf-8").partition(NONLINEAR)[1:])
        end = "\n".join([rest(flight, film, commands, effects, campaigns()), section])
    bench = bench_solvers(scenario)
    with tempfile.TemporaryDirectory() as scratch:
        write_bench(bench, Path(scratch))
        copy_figure(Path(scratch) / "solvers.png", "solvers.png", 64)
    write_page(path.name, steps(bench), end)
    write_cost(study_cost(scenario, [load_scenario("paper-unconstrained")], timed=timed(bench)))


if __name__ == "__main__":
    main()
