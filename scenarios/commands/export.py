"""`quadsim export`."""

from __future__ import annotations

from argparse import Namespace
from pathlib import Path

from scenarios.commands import EXIT_DONE
from scenarios.commands.common import load
from scenarios.export.exporter import export as write_export


def export(options: Namespace) -> int:
    """`quadsim export`."""
    scenario = load(options.scenario, options)
    directory = write_export(scenario, Path(options.out), precision=options.precision, target=options.target)
    print(f"Wrote {directory}: make -C {directory} check compiles it and runs its recorded periods")
    return EXIT_DONE
