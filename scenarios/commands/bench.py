"""`quadsim bench`."""

from __future__ import annotations

import json
from argparse import Namespace
from typing import Any, Final

from mpc.solvers import SOLVERS
from quadsim.outputs import real_path, writing
from quadsim.report.table import Grid
from scenarios.commands import EXIT_DONE, console
from scenarios.commands.common import load
from scenarios.progress import Progress
from scenarios.schema.scenario import Scenario


def bench(options: Namespace) -> int:
    """`quadsim bench`."""
    scenario = load(options.scenario, options)
    with console.progress_bars(enabled=not options.json) as progress:
        measured, tables, where = _BENCHES[options.kind](scenario, options, progress)
    if options.json:
        print(json.dumps(measured, indent=2))
    else:
        console.print_grids(tables, where)
    return EXIT_DONE


_Benched = tuple[dict[str, Any], list[Grid], str | None]
"""What was measured, as plain values and as tables, and where it was written."""


def _bench_solvers(scenario: Scenario, options: Namespace, progress: Progress) -> _Benched:
    from scenarios.bench.bench_tables import solver_tables
    from scenarios.bench.solvers import KIND, bench_solvers, write_bench

    target = real_path(options.out)
    with writing(target, KIND) as directory:
        measured = bench_solvers(
            scenario,
            repeats=options.repeats,
            horizons=options.horizons,
            solvers=tuple(options.solvers or SOLVERS),
            stride=options.stride,
            progress=progress,
        )
        write_bench(measured, directory)
    return measured.to_json(), solver_tables(measured), str(target)


def _bench_flight(scenario: Scenario, options: Namespace, progress: Progress) -> _Benched:
    from scenarios.bench.bench_tables import flight_tables
    from scenarios.bench.flight import bench_flight

    profile = bench_flight(scenario, repeats=options.repeats, progress=progress)
    return profile.to_json(), flight_tables(profile), None


def _bench_render(scenario: Scenario, options: Namespace, progress: Progress) -> _Benched:
    from scenarios.bench.bench_tables import render_tables
    from scenarios.bench.film import bench_render

    profile = bench_render(scenario, seconds=options.seconds, workers=options.workers, progress=progress)
    return profile.to_json(), render_tables(profile), None


def _bench_mismatch(scenario: Scenario, options: Namespace, progress: Progress) -> _Benched:
    from scenarios.bench.mismatch.benchmark import KIND, run_mismatch, write_mismatch
    from scenarios.bench.mismatch.survival import mismatch_tables

    target = real_path(options.out)
    with writing(target, KIND) as directory:
        measured = run_mismatch(
            options.scenario,
            [*options.settings, f"seed={scenario.seed}"],
            quick=options.quick,
            workers=options.workers,
            progress=progress,
        )
        write_mismatch(measured, directory)
    return measured.to_json(), mismatch_tables(measured), str(target)


def _bench_campaign(scenario: Scenario, options: Namespace, progress: Progress) -> _Benched:
    from scenarios.bench.campaigns import bench_campaign, campaign_tables

    profile = bench_campaign(
        scenario, flights=options.flights, rounds=options.rounds, sizes=options.sizes, progress=progress
    )
    return profile.to_json(), campaign_tables(profile), None


_BENCHES: Final = {
    "solvers": _bench_solvers,
    "flight": _bench_flight,
    "render": _bench_render,
    "ladder": _bench_mismatch,
    "campaign": _bench_campaign,
}
