"""Remake docs/performance.md on this machine: `make numbers`.

Contenders are timed in one process, in random order within each problem, and compared as ratios: the machine's speed
drifts, their ratio hardly does.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time as clock
from pathlib import Path

import numpy as np
from make_numbers import Table, fly, markdown, replace_in_readme
from threadpoolctl import threadpool_limits

from mpc.condensed import condensed
from mpc.multistage import STEPS_PER_STAGE, multistage
from mpc.qp import Backend, Formulation
from mpc.solvers.piqp_dense import PiqpDense
from mpc.solvers.piqp_sparse import PiqpMultistage
from quadsim.plant import Plant
from quadsim.state import Array
from scenarios import runner
from scenarios.build import build_initial_state, build_problem, build_reference
from scenarios.runner import Flight

ROOT = Path(__file__).resolve().parent.parent
REPEATS, STRIDE = 3, 4


def queries(flight: Flight) -> list[tuple[Array, Array, Array]]:
    """What the controller was asked in a flight, every `STRIDE`-th period: xi(k), y_d, u(k-1)."""
    problem, log = build_problem(flight.scenario, flight.vehicle), flight.log.control
    reference = build_reference(flight.scenario, log.t.size + problem.horizon)
    before = np.vstack([log.speeds_before, log.speeds[:-1]])
    return [
        (log.state[k], problem.objective.desired(reference[k + 1 : k + 1 + problem.horizon]), before[k])
        for k in range(0, log.t.size, STRIDE)
    ]


def stage_lengths(flight: Flight) -> Table:
    """Solver time for each number of steps per stage, and for the condensed QP."""
    problem = build_problem(flight.scenario, flight.vehicle)
    contenders: dict[str, tuple[Formulation, Backend]] = {"condensed, dense": (condensed(problem), PiqpDense())}
    for steps in (1, 2, 3, 4, 5, 6, 8, 10, 13, 17, 25):
        contenders[f"{steps}"] = (multistage(problem, steps_per_stage=steps), PiqpMultistage())
    for formulation, backend in contenders.values():
        backend.setup(formulation.qp)
    times: dict[str, list[float]] = {name: [] for name in contenders}
    names, rng = list(contenders), np.random.default_rng(0)
    with threadpool_limits(limits=1):
        for query in queries(flight) * REPEATS:
            for name in rng.permutation(names):
                formulation, backend = contenders[name]
                started = clock.perf_counter()
                backend.solve(formulation.vectors(*query))
                times[name].append(1e3 * (clock.perf_counter() - started))
    reference = np.median(times[str(STEPS_PER_STAGE)])
    rows: Table = [("steps per stage", "variables", "median [ms]", "p99 [ms]", "median, as a ratio to the default")]
    for name, values in times.items():
        median, high = np.percentile(values, [50, 99])
        size = str(contenders[name][0].qp.c.size)
        label = f"**{name}** (default)" if name == str(STEPS_PER_STAGE) else name
        rows.append((label, size, f"{median:.2f}", f"{high:.2f}", f"{median / reference:.2f}"))
    return rows


def where_the_time_goes(flight: Flight) -> Table:
    """The 60 s of constrained flight, piece by piece."""
    with Plant(flight.vehicle) as plant:
        plant.reset(build_initial_state(flight.scenario))
        started = clock.perf_counter()
        for speeds in flight.log.control.speeds:
            plant.advance(speeds, flight.scenario.steps_per_period)
        physics = clock.perf_counter() - started
        started = clock.perf_counter()
        for _ in flight.log.control.t:
            plant.state()
        measurement = clock.perf_counter() - started
    solver = flight.log.timing.solve_ms.sum() / 1e3
    controller = flight.log.timing.step_ms.sum() / 1e3
    rest = flight.simulate_s - physics - measurement - controller
    pieces = {
        "QP solver": solver,
        "rest of the controller": controller - solver,
        "physics, 60 000 steps": physics,
        "measurement": measurement,
        "log, conversion to the paper's state": rest,
        "all": flight.simulate_s,
    }
    rows: Table = [("60 s of paper-constrained", "time [s]", "share")]
    rows += [(name, f"{value:.2f}", f"{100 * value / flight.simulate_s:.0f} %") for name, value in pieces.items()]
    return rows


def whole_commands(flight: Flight) -> Table:
    """What a person waits for."""
    rows: Table = [
        ("what a person waits for", "asked", "measured [s]"),
        ("60 s of constrained flight simulated, one core", "< 3 s", f"{flight.simulate_s:.2f}"),
    ]
    with tempfile.TemporaryDirectory() as scratch:
        run = f"{scratch}/run"
        for label, asked, arguments in (
            ("`quadsim --help`", "< 0.5 s", ["--help"]),
            (
                "`quadsim run paper-constrained --no-video`",
                "< 8 s",
                ["run", "paper-constrained", "--no-video", "--out", run],
            ),
            ("`quadsim video`: the same 60 s, 1280x720 at 30 fps, two cores", "< 90 s", ["video", run]),
        ):
            started = clock.perf_counter()
            subprocess.run(
                [sys.executable, "-m", "scenarios.cli", *arguments], check=True, capture_output=True, cwd=ROOT
            )
            rows.append((label, asked, f"{clock.perf_counter() - started:.2f}"))
    return rows


def steps_of(flights: list[Flight]) -> Table:
    """Controller steps against their deadline."""
    rows: Table = [("controller step [ms]", "median", "p95", "p99", "max", "deadline", "missed")]
    for flight in flights:
        controller = runner.summarise(flight)["controller"]
        times = (f"{controller['step_ms'][measure]:.2f}" for measure in ("p50", "p95", "p99", "max"))
        missed = str(controller["deadline_misses"])
        rows.append((flight.scenario.name, *times, f"{controller['deadline_ms']:g}", missed))
    return rows


def main() -> None:
    """Measure everything and write it."""
    constrained, unconstrained = fly("paper-constrained"), fly("paper-unconstrained")
    machine, commands = runner.machine(), markdown(whole_commands(constrained))
    page = [
        "# Performance\n\nMade by `make numbers` on one machine "
        f"({machine['processor']}, {machine['cores']} cores, no GPU), in one run; read the ratios.\n",
        f"## Controller steps\n\n{markdown(steps_of([unconstrained, constrained]))}",
        f"## Where the time of a flight goes\n\n{markdown(where_the_time_goes(constrained))}",
        f"## How many steps make a stage\n\n{markdown(stage_lengths(constrained))}",
        "PIQP's multistage factorisation costs less the fewer stages there are, and more the larger each is. The\n"
        "paper's own formulation is the condensed one; one step per stage keeps every state as a variable.\n",
        f"## Whole commands\n\n{commands}",
    ]
    (ROOT / "docs" / "performance.md").write_text("\n".join(page), encoding="utf-8")
    replace_in_readme("times", commands)


if __name__ == "__main__":
    main()
