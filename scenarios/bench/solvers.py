"""`quadsim bench solvers`: every QP solver there is, on the queries of one flight."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np

from mpc.problem import Problem
from mpc.solvers import SOLVERS, Way
from quadsim import outputs
from quadsim.bench import Contender, Growth, SolverBench, solver_tables
from quadsim.errors import InputError, ParameterError, UnknownNameError
from quadsim.table import Grid, grid_to_markdown
from scenarios.bench.contenders import Entry, StepEntrant, entries, judge, reference_optima
from scenarios.bench.race import race, stretches
from scenarios.bench.stages import time_stages
from scenarios.build import build_problem
from scenarios.queries import recorded
from scenarios.runner import Flight, Progress, fly_scenario, machine, silent, versions
from scenarios.spec import LARGEST_HORIZON, ConstrainedSpec, Scenario

RESULTS_FILE: Final = "bench.json"
TABLES_FILE: Final = "solvers.md"
FORMAT: Final = "quadsim bench solvers"
"""What `bench.json` says it is."""
KIND: Final = "bench of solvers"
"""What `quadsim.outputs` calls its directory."""

REPEATS: Final = 3
HORIZONS: Final = (10, 20, 50, 100, 200)
GROWTH_STRIDE: Final = 6
"""One stretch of so many is asked at each horizon and of each form of the QP."""
LONGEST_PASS: Final = 20.0
"""A contender whose first pass takes longer [s] is timed once."""
PATIENCE: Final = 60.0
"""A contender that takes longer for the questions at one horizon [s] is dropped."""


def bench_solvers(
    scenario: Scenario,
    *,
    repeats: int = REPEATS,
    horizons: Sequence[int] = HORIZONS,
    solvers: Sequence[str] = tuple(SOLVERS),
    stride: int = 1,
    progress: Progress = silent,
) -> SolverBench:
    """Fly a scenario, and put its queries to the controller as it is flown and to every solver without shortcuts.

    Args:
        scenario: by a constrained controller.
        repeats: how often each question is put, at most.
        horizons: N for the growth; empty for none.
        solvers: names in `SOLVERS`; those that are not installed are left out.
        stride: one stretch of 20 periods of so many is asked; of the growth and the forms, one of six of those.
        progress: told how far it is.

    Raises:
        InputError: an argument is wrong, or the flight is not one by a constrained controller.
    """
    spec = _check(scenario, repeats, horizons, solvers, stride)
    flight = fly_scenario(scenario, progress)
    if not flight.log.control.t.size:
        raise InputError(
            f"{scenario.name}: there is nothing to time, since not one period was flown: {flight.log.reason}"
        )
    problem = build_problem(scenario, flight.vehicle)
    rng = np.random.default_rng(scenario.seed)
    taking_part = entries(Entry(solver=spec.solver, shortcut=spec.shortcut), solvers)
    contenders, asked, reference_kkt = _time_contenders(
        flight, problem, taking_part, repeats=repeats, stride=stride, rng=rng, progress=progress
    )
    few = stretches(flight.log.control.t.size, stride * GROWTH_STRIDE)
    growth = _growth(flight, problem, taking_part, horizons, few, repeats=repeats, rng=rng, progress=progress)
    return SolverBench(
        scenario=scenario.name,
        horizon=problem.horizon,
        deadline_ms=1e3 * scenario.control_period,
        asked=asked,
        flown=flight.log.control.t.size,
        contenders=contenders,
        left_out={name: SOLVERS[name].line for name in solvers if not SOLVERS[name].installed},
        growth=growth,
        growth_asked=sum(map(len, few)),
        stages=time_stages(
            problem,
            recorded(scenario, flight.log.control, problem.horizon),
            few,
            repeats=repeats,
            rng=rng,
            progress=progress,
        ),
        reference_kkt=reference_kkt,
        versions=versions(),
        machine=machine(),
    )


def write_bench(bench: SolverBench, directory: Path) -> None:
    """Write `bench.json`, `solvers.md`, `solvers.png` and `solvers.svg` into a directory.

    Raises:
        OutputError: it cannot be written.
    """
    from quadsim.figures import write_solver_figure

    outputs.write_json(directory / RESULTS_FILE, {"format": FORMAT, **bench.to_json()})
    outputs.write_text(directory / TABLES_FILE, bench_markdown(bench))
    write_solver_figure(bench, directory)


def bench_markdown(bench: SolverBench) -> str:
    """All tables of a bench with their notes."""
    return f"# The solvers on {bench.scenario}\n\n" + "\n".join(map(section, solver_tables(bench)))


def section(grid: Grid) -> str:
    """A table under its title, with its note, as Markdown."""
    return f"## {grid.title}\n\n{grid_to_markdown(grid)}\n{grid.note}".rstrip() + "\n"


def _check(
    scenario: Scenario, repeats: int, horizons: Sequence[int], solvers: Sequence[str], stride: int
) -> ConstrainedSpec:
    for name in solvers:
        if name not in SOLVERS:
            raise UnknownNameError("solver", name, SOLVERS)
    for option, value in (("--repeats", repeats), ("--stride", stride)):
        if value < 1:
            raise ParameterError("", option, value, "at least 1")
    if any(not 1 <= N <= LARGEST_HORIZON for N in horizons):
        raise ParameterError("", "--horizons", list(horizons), f"between 1 and {LARGEST_HORIZON} each")
    if not isinstance(scenario.controller, ConstrainedSpec):
        raise InputError(f"{scenario.name} is flown without a QP; choose a scenario with a constrained controller")
    return scenario.controller


def _time_contenders(
    flight: Flight,
    problem: Problem,
    taking_part: Sequence[Entry],
    *,
    repeats: int,
    stride: int,
    rng: np.random.Generator,
    progress: Progress,
) -> tuple[tuple[Contender, ...], int, float]:
    """Every contender, the number of periods asked, and the worst KKT residual of the reference."""
    queries = recorded(flight.scenario, flight.log.control, problem.horizon)
    asked = stretches(queries.t.size, stride)
    periods = [period for stretch in asked for period in stretch]
    reference = reference_optima(problem, queries, periods)
    entrants = {entry.name: StepEntrant(entry, problem, queries) for entry in taking_part}
    laps = race(
        entrants,
        asked,
        repeats=repeats,
        rng=rng,
        longest_pass=LONGEST_PASS,
        progress=lambda done, total: progress("contenders", done, total),
    )
    contenders = tuple(
        Contender(
            name=name,
            solver=entrant.entry.solver,
            package=_package(entrant.entry.solver),
            shortcut=entrant.entry.shortcut,
            repeats=laps[name].ms.shape[0],
            step_ms=laps[name].best,
            raw_max_ms=float(laps[name].ms.max()),
            **vars(judge(entrant, queries, periods, reference)),
        )
        for name, entrant in entrants.items()
    )
    return contenders, len(periods), reference.kkt


def _package(solver: str) -> str:
    entry = SOLVERS[solver]
    return f"{entry.package} {entry.version}"


def _growth(
    flight: Flight,
    problem: Problem,
    taking_part: Sequence[Entry],
    horizons: Sequence[int],
    asked: Sequence[range],
    *,
    repeats: int,
    rng: np.random.Generator,
    progress: Progress,
) -> tuple[Growth, ...]:
    """Every contender at each N, until one would hardly keep up with the flight at the next.

    Steps by the whole QP and by either shortcut are told apart: their shares change with N.
    """
    grown: dict[tuple[Entry, Way], list[tuple[int, float, float]]] = {}
    failures: dict[str, dict[int, int]] = {}
    dropped: dict[str, str] = {}
    periods = [period for stretch in asked for period in stretch]
    deadline_ms = 1e3 * flight.scenario.control_period
    for N in sorted(set(horizons)):
        queries = recorded(flight.scenario, flight.log.control, N)
        longer = replace(problem, horizon=N)
        racing = [entry for entry in taking_part if entry.name not in dropped]
        entrants = {entry.name: StepEntrant(entry, longer, queries) for entry in racing}
        laps = race(
            entrants,
            asked,
            repeats=repeats,
            rng=rng,
            longest_pass=LONGEST_PASS,
            patience=PATIENCE,
            progress=lambda done, total, N=N: progress(f"N = {N}", done, total),  # type: ignore[misc]
        )
        for entry in racing:
            if entry.name not in laps:
                dropped[entry.name] = f"more than {PATIENCE:g} s for them at N = {N}"
                continue
            best = laps[entry.name].best
            if failed := entrants[entry.name].failures(periods):
                failures.setdefault(entry.name, {})[N] = failed
            ways = entrants[entry.name].ways(periods)
            for way in Way:
                if (ways == way).any():
                    p50, p99 = np.percentile(best[ways == way], [50, 99])
                    grown.setdefault((entry, way), []).append((N, float(p50), float(p99)))
            if (p95 := np.percentile(best, 95)) > 0.5 * deadline_ms:
                dropped[entry.name] = f"p95 of {p95:.0f} ms at N = {N}, beyond half the control period"
    return tuple(
        Growth(
            name=entry.name,
            kind=str(way) if entry.shortcut else "",
            whole=way is Way.WHOLE,
            horizons=tuple(N for N, _, _ in times),
            p50=tuple(p50 for _, p50, _ in times),
            p99=tuple(p99 for _, _, p99 in times),
            failures=failures.get(entry.name, {}),
            dropped=dropped.get(entry.name, "") if times[-1][0] < max(horizons) else "",
        )
        for (entry, way), times in grown.items()
    )
