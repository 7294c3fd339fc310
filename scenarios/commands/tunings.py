"""`quadsim tune`."""

from __future__ import annotations

import json
from argparse import Namespace

from scenarios.commands import EXIT_DONE, EXIT_FAILED, console
from scenarios.commands.console import shown
from scenarios.many_flights import tune as carry_out


def tune(options: Namespace) -> int:
    """`quadsim tune`."""
    from scenarios.tuning.page import sentences, tables, verdict

    try:
        result = carry_out(
            options.file,
            out=options.out,
            trials=options.trials,
            seed=options.seed,
            workers=options.workers,
            cluster=options.cluster,
            resume=options.resume,
            overwrite=options.overwrite,
            report=options.report,
            progress=False if options.json else "lines",
        )
    except KeyboardInterrupt as stop:
        if not stop.args:  # before the first flight
            raise
        console.say(f"interrupted (Ctrl-C); {stop}, --resume continues it")
        return EXIT_FAILED
    if options.json:
        print(json.dumps(result.summary, indent=2))
    else:
        out = console.stdout()
        out.print(console.styled((result.summary["tuning"], "bold"), f": {verdict(result.summary)}"))
        for sentence in sentences(result.summary):
            out.print(sentence, soft_wrap=True)
        console.print_grids(tables(result.summary), shown(result.directory), prose=("fields",))
    return EXIT_DONE if result.holds else EXIT_FAILED
