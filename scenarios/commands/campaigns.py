"""`quadsim campaign` and `replay`."""

from __future__ import annotations

import json
from argparse import Namespace

from quadsim.errors import ParameterError
from quadsim.flight import rundir
from scenarios.commands import EXIT_DONE, EXIT_FAILED, console
from scenarios.commands.console import print_result, shown
from scenarios.junit import junit_file, write_junit
from scenarios.many_flights import campaign as fly_campaign
from scenarios.many_flights import replay as fly_again


def campaign(options: Namespace) -> int:
    """`quadsim campaign`."""
    from scenarios.commands.campaign_console import print_campaign

    if options.junit is not None:
        if not options.requirements:
            raise ParameterError("", "--junit", options.junit, "given with --require, whose verdicts it is to hold")
        options.junit = junit_file(options.junit)
    try:
        result = fly_campaign(
            options.file,
            out=options.out,
            flights=options.flights,
            seed=options.seed,
            changes=options.settings,
            require=options.requirements,
            workers=options.workers,
            cluster=options.cluster,
            resume=options.resume,
            overwrite=options.overwrite,
            until_width=options.until_width,
            report=options.report,
            progress=False if options.json else "lines",
        )
    except KeyboardInterrupt as stop:
        if not stop.args:  # before the first flight
            raise
        console.say(f"interrupted (Ctrl-C); {stop}, --resume continues it")
        return EXIT_FAILED
    if options.junit is not None:
        write_junit(result, options.junit)
    if options.json:
        gate = [judgement.to_json() for judgement in result.judgements]
        print(json.dumps({**result.summary, "requirements": gate}, indent=2))
    else:
        print_campaign(result, shown(result.directory))
    return EXIT_DONE if all(judgement.holds for judgement in result.judgements) else EXIT_FAILED


def replay(options: Namespace) -> int:
    """`quadsim replay`."""
    from scenarios.commands.campaign_console import print_replay

    found = fly_again(
        options.campaign,
        options.flight,
        out=options.out,
        overwrite=options.overwrite,
        video=options.video,
        recording=options.recording,
        figures=options.figures,
        progress=not options.json,
    )
    print_result(rundir.read_summary(found.directory), options, where=shown(found.directory))
    if not options.json:
        print_replay(found.recorded.number, found.recorded.row, found.differing)
    return EXIT_FAILED if found.differing else EXIT_DONE
