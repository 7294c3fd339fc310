"""`quadsim bench`."""

from __future__ import annotations

import json
from argparse import Namespace
from typing import Any

from quadsim.outputs import absolute
from quadsim.report.table import Grid
from scenarios import benchmarks
from scenarios.commands import EXIT_DONE, console
from scenarios.commands.common import load


def bench(options: Namespace) -> int:
    """`quadsim bench`."""
    measured, tables = _measure(options)
    if options.json:
        print(json.dumps(measured.to_json(), indent=2))
    else:
        console.print_grids(tables, str(absolute(options.out)) if "out" in options else None)
    return EXIT_DONE


def _measure(options: Namespace) -> tuple[Any, list[Grid]]:
    """What was measured, and its tables."""
    from scenarios.bench import bench_tables

    if options.kind == "speed":
        from scenarios.bench.speed import speed_tables

        speeds = benchmarks.bench_speed(quick=options.quick, workers=options.workers, progress=not options.json)
        return speeds, speed_tables(speeds)
    scenario, progress = load(options.scenario, options), not options.json
    match options.kind:
        case "solvers":
            solvers = benchmarks.bench_solvers(
                scenario,
                out=options.out,
                solvers=options.solvers or (),
                repeats=options.repeats,
                horizons=options.horizons,
                stride=options.stride,
                progress=progress,
            )
            return solvers, bench_tables.solver_tables(solvers)
        case "flight":
            flight = benchmarks.bench_flight(scenario, repeats=options.repeats, progress=progress)
            return flight, bench_tables.flight_tables(flight)
        case "render":
            film = benchmarks.bench_render(
                scenario, seconds=options.seconds, workers=options.workers, progress=progress
            )
            return film, bench_tables.render_tables(film)
        case "ladder":
            from scenarios.bench.mismatch.survival import mismatch_tables

            mismatch = benchmarks.bench_ladder(
                options.scenario,
                [*options.settings, f"seed={scenario.seed}"],
                out=options.out,
                quick=options.quick,
                workers=options.workers,
                progress=progress,
            )
            return mismatch, mismatch_tables(mismatch)
        case _:
            from scenarios.bench.campaigns import campaign_tables

            sizes = {"flights": options.flights, "rounds": options.rounds, "sizes": options.sizes}
            campaign = benchmarks.bench_campaign(scenario, **sizes, progress=progress)
            return campaign, campaign_tables(campaign)
