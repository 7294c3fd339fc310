"""`quadsim bench`."""

from __future__ import annotations

import json
from argparse import Namespace
from typing import Any

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
        measured, tables = _measure(scenario, options, progress)
    if options.json:
        print(json.dumps(measured.to_json(), indent=2))
    else:
        console.print_grids(tables, str(real_path(options.out)) if "out" in options else None)
    return EXIT_DONE


def _measure(scenario: Scenario, options: Namespace, progress: Progress) -> tuple[Any, list[Grid]]:
    """What was measured, and its tables; it is written where there is an `--out`."""
    match options.kind:
        case "solvers":
            from scenarios.bench.bench_tables import solver_tables
            from scenarios.bench.solvers import KIND, bench_solvers, write_bench

            with writing(real_path(options.out), KIND) as directory:
                solvers = bench_solvers(
                    scenario,
                    repeats=options.repeats,
                    horizons=options.horizons,
                    solvers=tuple(options.solvers or SOLVERS),
                    stride=options.stride,
                    progress=progress,
                )
                write_bench(solvers, directory)
            return solvers, solver_tables(solvers)
        case "flight":
            from scenarios.bench.bench_tables import flight_tables
            from scenarios.bench.flight import bench_flight

            flight = bench_flight(scenario, repeats=options.repeats, progress=progress)
            return flight, flight_tables(flight)
        case "render":
            from scenarios.bench.bench_tables import render_tables
            from scenarios.bench.film import bench_render

            film = bench_render(scenario, seconds=options.seconds, workers=options.workers, progress=progress)
            return film, render_tables(film)
        case "ladder":
            from scenarios.bench.mismatch import benchmark
            from scenarios.bench.mismatch.survival import mismatch_tables

            settings = [*options.settings, f"seed={scenario.seed}"]
            with writing(real_path(options.out), benchmark.KIND) as directory:
                mismatch = benchmark.run_mismatch(
                    options.scenario, settings, quick=options.quick, workers=options.workers, progress=progress
                )
                benchmark.write_mismatch(mismatch, directory)
            return mismatch, mismatch_tables(mismatch)
        case _:
            from scenarios.bench.campaigns import bench_campaign, campaign_tables

            sizes = {"flights": options.flights, "rounds": options.rounds, "sizes": options.sizes}
            campaign = bench_campaign(scenario, **sizes, progress=progress)
            return campaign, campaign_tables(campaign)
