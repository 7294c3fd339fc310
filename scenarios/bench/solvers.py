"""`quadsim bench solvers`: every QP solver there is, on the queries of one flight."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np

from mpc.ocp import Problem
from mpc.solvers import SOLVERS, Method
from mpc.unconstrained import UnconstrainedMPC
from quadsim.controller import ACCEPTED
from quadsim.errors import InputError, ParameterError, UnknownNameError
from quadsim.outputs import to_json
from quadsim.report.figures.canvas import write_drawings
from quadsim.report.table import section
from quadsim.state import Array
from scenarios.bench.bench_results import CandidateResult, Growth, SolverBench
from scenarios.bench.bench_tables import solver_tables
from scenarios.bench.candidates import Entry, StepCandidate, entries, judge, reference_optima, time_stages
from scenarios.bench.queries import QueriedController, flight_between, recorded
from scenarios.bench.timing import Candidate, StepTimes, segments, time_in_turns
from scenarios.build import build_problem
from scenarios.flight import Flight
from scenarios.machine import machine, versions
from scenarios.progress import Progress, silent
from scenarios.run import fly_scenario
from scenarios.schema.base import LARGEST_HORIZON
from scenarios.schema.controller import ConstrainedSpec
from scenarios.schema.scenario import Scenario

RESULTS_FILE: Final = "bench.json"
TABLES_FILE: Final = "solvers.md"
FORMAT: Final = "quadsim bench solvers"  # the `format` of `bench.json`

REPEATS: Final = 3
HORIZONS: Final = (10, 20, 50, 100, 200)
GROWTH_STRIDE: Final = 6  # one segment in this number is timed at each horizon and for each form of the QP
LONGEST_PASS: Final = 20.0  # a candidate whose first pass takes longer [s] is timed once
GAIN: Final = "unconstrained gain"  # what the controller would be without its constraints
PATIENCE: Final = 60.0  # a candidate that takes longer for the questions at one horizon [s] is dropped


Race = Callable[..., dict[str, StepTimes]]  # `time_in_turns` with what all races of a bench have in common


class _Timed(NamedTuple):
    """A candidate's steps (K,) [ms], the ways (K,) they were answered in, and the periods without their optimum."""

    step_ms: Array
    ways: np.ndarray[tuple[int], np.dtype[np.object_]]
    failures: int


def _timed(candidate: StepCandidate, periods: Sequence[int], laps: StepTimes) -> _Timed:
    failures = sum(status not in ACCEPTED for status in candidate.statuses(periods))
    return _Timed(laps.median, candidate.ways(periods), failures)


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
        stride: one segment of 20 periods in this number is timed; for growth and forms, one in six of those.
        progress: called with how much is done, of how much.

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
    few = segments(flight.log.control.t.size, stride * GROWTH_STRIDE)
    with flight_between(scenario, flight.vehicle) as between:
        race = partial(time_in_turns, between=between, repeats=repeats, rng=rng)
        candidates, own, gain, queried, reference_kkt = _time_candidates(
            flight, problem, taking_part, race, stride, progress
        )
        growth = _growth(flight, problem, taking_part, race, horizons, few, own, progress)
        queries = recorded(scenario, flight.log.control, problem.horizon)
        stages = time_stages(problem, queries, few, race, progress)
    return SolverBench(
        scenario=scenario.name,
        horizon=problem.horizon,
        deadline_ms=1e3 * scenario.control_period,
        asked=queried,
        flown=flight.log.control.t.size,
        candidates=candidates,
        gain_ms=gain,
        left_out={name: SOLVERS[name].line for name in solvers if not SOLVERS[name].installed},
        growth=growth,
        growth_asked=sum(map(len, few)),
        stages=stages,
        reference_kkt=reference_kkt,
        versions=versions(),
        machine=machine(),
    )


def write_bench(bench: SolverBench, directory: Path) -> None:
    """Write `bench.json`, `solvers.md`, `solvers.png` and `solvers.svg` into a directory.

    Raises:
        OutputError: it cannot be written.
    """
    from scenarios.bench.solver_figure import draw_solvers

    results = to_json({"format": FORMAT, **bench.to_json()})
    (directory / RESULTS_FILE).write_text(results, encoding="utf-8")
    (directory / TABLES_FILE).write_text(bench_markdown(bench), encoding="utf-8")
    write_drawings({"solvers": lambda: draw_solvers(bench)}, directory)


def bench_markdown(bench: SolverBench) -> str:
    """All tables of a bench with their notes."""
    return f"# The solvers on {bench.scenario}\n\n" + "\n".join(map(section, solver_tables(bench)))


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


def _time_candidates(
    flight: Flight, problem: Problem, taking_part: Sequence[Entry], race: Race, stride: int, progress: Progress
) -> tuple[tuple[CandidateResult, ...], dict[str, _Timed], Array | None, int, float]:
    """Candidates, their steps, the gain's, the number of periods timed, and the reference's worst KKT residual."""
    queries = recorded(flight.scenario, flight.log.control, problem.horizon)
    chosen = segments(queries.t.size, stride)
    periods = [period for segment in chosen for period in segment]
    reference = reference_optima(problem, queries, periods)
    candidates = {entry.name: StepCandidate(entry, problem, queries) for entry in taking_part}
    with_gain: dict[str, Candidate] = {**candidates}
    with contextlib.suppress(np.linalg.LinAlgError):  # of weights so far apart that it cannot be computed
        with_gain = {GAIN: QueriedController(UnconstrainedMPC(problem), queries), **candidates}
    laps = race(with_gain, chosen, longest_pass=LONGEST_PASS, progress=partial(progress, "candidates"))
    results = tuple(
        CandidateResult(
            name=name,
            solver=candidate.entry.solver,
            package=f"{SOLVERS[candidate.entry.solver].package} {SOLVERS[candidate.entry.solver].version}",
            shortcut=candidate.entry.shortcut,
            repeats=laps[name].ms.shape[0],
            step_ms=laps[name].median,
            answered=candidate.statuses(periods),
            raw_max_ms=float(laps[name].ms.max()),
            **judge(candidate, queries, periods, reference),
        )
        for name, candidate in candidates.items()
    )
    gain = laps[GAIN].median if GAIN in laps else None
    own = {name: _timed(candidate, periods, laps[name]) for name, candidate in candidates.items()}
    return results, own, gain, len(periods), reference.kkt


def _growth(
    flight: Flight,
    problem: Problem,
    taking_part: Sequence[Entry],
    race: Race,
    horizons: Sequence[int],
    chosen: Sequence[range],
    own: Mapping[str, _Timed],
    progress: Progress,
) -> tuple[Growth, ...]:
    """Every candidate at each N, until one would hardly keep up with the flight at the next.

    Steps by the whole QP and by either shortcut are counted apart: their shares change with N.  At the flight's own N
    they are those of the candidates, `own`, which are not timed again.
    """
    grown: dict[tuple[Entry, Method], list[tuple[int, float, float]]] = {}
    failures: dict[str, dict[int, int]] = {}
    dropped: dict[str, str] = {}
    periods = [period for segment in chosen for period in segment]
    deadline_ms = 1e3 * flight.scenario.control_period
    for N in sorted(set(horizons)):
        racing = [entry for entry in taking_part if entry.name not in dropped]
        if problem.horizon == N:
            timed = dict(own)
        else:
            queries, longer = recorded(flight.scenario, flight.log.control, N), replace(problem, horizon=N)
            candidates = {entry.name: StepCandidate(entry, longer, queries) for entry in racing}
            report = partial(progress, f"N = {N}")
            laps = race(candidates, chosen, longest_pass=LONGEST_PASS, patience=PATIENCE, progress=report)
            timed = {name: _timed(candidates[name], periods, lap) for name, lap in laps.items()}
        for entry in racing:
            if entry.name not in timed:
                dropped[entry.name] = f"more than {PATIENCE:g} s for them at N = {N}"
                continue
            found = timed[entry.name]
            if found.failures:
                failures.setdefault(entry.name, {})[N] = found.failures
            for way in Method:
                if (found.ways == way).any():
                    p50, p99 = np.percentile(found.step_ms[found.ways == way], [50, 99])
                    grown.setdefault((entry, way), []).append((N, float(p50), float(p99)))
            if (p95 := np.percentile(found.step_ms, 95)) > 0.5 * deadline_ms:
                dropped[entry.name] = f"p95 of {p95:.0f} ms at N = {N}, beyond half the control period"
    return tuple(
        Growth(
            name=entry.name,
            kind=str(way) if entry.shortcut else "",
            whole=way is Method.WHOLE,
            horizons=tuple(N for N, _, _ in times),
            p50=tuple(p50 for _, p50, _ in times),
            p99=tuple(p99 for _, _, p99 in times),
            failures=failures.get(entry.name, {}),
            dropped=dropped.get(entry.name, "") if times[-1][0] < max(horizons) else "",
        )
        for (entry, way), times in grown.items()
    )
