"""`quadsim export`."""

from __future__ import annotations

import shlex
from argparse import Namespace
from pathlib import Path

from quadsim.flight import rundir
from quadsim.outputs import real_path
from scenarios.commands import EXIT_DONE, EXIT_FAILED, console
from scenarios.commands.common import load
from scenarios.export.exporter import export as write_export


def export(options: Namespace) -> int:
    """`quadsim export`."""
    scenario = load(options.scenario, options)
    directory = write_export(scenario, Path(options.out), precision=options.precision, target=options.target)
    print(f"Wrote {directory}: make -C {shlex.quote(str(directory))} check compiles it and runs its recorded periods")
    if not options.fly:
        return EXIT_DONE
    from scenarios.export.in_the_loop import fly_exported

    run = real_path(Path("runs") / f"{scenario.name}-{options.target}")
    flight = fly_exported(scenario, run, precision=options.precision, target=options.target)
    console.print_summary(rundir.read_summary(run), str(run))
    return EXIT_DONE if flight.satisfied else EXIT_FAILED
