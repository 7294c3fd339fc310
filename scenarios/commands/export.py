"""`quadsim export`."""

from __future__ import annotations

import shlex
from argparse import Namespace
from pathlib import Path

from quadsim.flight import rundir
from quadsim.outputs import reserving
from scenarios.commands import EXIT_DONE, EXIT_FAILED, console
from scenarios.commands.common import load, shown
from scenarios.export.exporter import export as write_export


def export(options: Namespace) -> int:
    """`quadsim export`."""
    scenario = load(options.scenario, options)
    machine = {"precision": options.precision, "target": options.target}
    directory = write_export(scenario, Path(options.out), overwrite=options.overwrite, **machine)
    print(f"Wrote {directory}: make -C {shlex.quote(str(directory))} check compiles it and runs its recorded periods")
    if not options.fly:
        return EXIT_DONE
    from scenarios.export.in_the_loop import fly_exported

    with reserving(Path("runs") / f"{scenario.name}-{options.target}", free=True) as run:
        flight = fly_exported(scenario, run, **machine)
    console.print_summary(rundir.read_summary(run), shown(run))
    return EXIT_DONE if flight.satisfied else EXIT_FAILED
