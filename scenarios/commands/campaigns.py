"""`quadsim campaign` and `replay`."""

from __future__ import annotations

import json
from argparse import Namespace
from pathlib import Path

from quadsim.errors import ParameterError
from quadsim.flight import rundir
from quadsim.outputs import real_path, require_file
from scenarios.api import campaign as fly_campaign
from scenarios.commands import EXIT_DONE, EXIT_FAILED, console
from scenarios.commands.common import print_summary
from scenarios.commands.junit import write_cases
from scenarios.flight import Outputs


def campaign(options: Namespace) -> int:
    """`quadsim campaign`."""
    from scenarios.commands.campaign_console import print_campaign

    if options.junit is not None and not options.requirements:
        raise ParameterError("", "--junit", options.junit, "given with --require, whose verdicts it is to hold")
    if options.junit is not None:
        require_file(options.junit, ".xml")
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
            until_width=options.until_width,
            report=options.report,
            progress=False if options.json else "lines",
        )
    except KeyboardInterrupt as stop:
        if not stop.args:  # before the first flight
            raise
        console.say(f"interrupted (Ctrl-C); {stop}, --resume goes on with it")
        return EXIT_FAILED
    judgements = result.judgements
    if options.junit is not None:
        cases = [(judgement.requirement.text, judgement.holds, judgement.sentence) for judgement in judgements]
        write_cases(result.summary["campaign"], cases, Path(options.junit))
    if options.json:
        gate = [judgement.to_json() for judgement in judgements]
        print(json.dumps({**result.summary, "requirements": gate}, indent=2))
    else:
        print_campaign(result.summary, result.failure, judgements, str(result.directory))
    return EXIT_DONE if all(judgement.holds for judgement in judgements) else EXIT_FAILED


def replay(options: Namespace) -> int:
    """`quadsim replay`."""
    from scenarios.campaign.replay import recorded_flight, replay_flight
    from scenarios.commands.campaign_console import print_replay

    recorded = recorded_flight(Path(options.campaign), options.flight)
    target = real_path(Path("runs") / recorded.scenario.name if options.out is None else options.out)
    outputs = Outputs(video=options.video, recording=options.recording, figures=options.figures)
    for note in recorded.notes:
        console.say(note)
    with console.progress_bars(enabled=not options.json) as progress:
        found = replay_flight(recorded, target, outputs, progress)
    print_summary(rundir.read_summary(target), options, where=str(target))
    if not options.json:
        print_replay(recorded.number, recorded.row, found.differing)
    return EXIT_FAILED if found.differing else EXIT_DONE
