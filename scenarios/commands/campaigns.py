"""`quadsim campaign` and `replay`."""

from __future__ import annotations

import json
from argparse import Namespace
from pathlib import Path
from typing import TYPE_CHECKING

from quadsim.errors import ParameterError
from quadsim.flight import rundir
from quadsim.outputs import real_path, require_file
from scenarios.commands import EXIT_DONE, EXIT_FAILED, console
from scenarios.commands.common import print_summary
from scenarios.commands.junit import write_cases
from scenarios.run import Outputs

if TYPE_CHECKING:
    from scenarios.campaign.engine.protocol import Engine


def campaign(options: Namespace) -> int:
    """`quadsim campaign`."""
    from scenarios.campaign.plan import load_plan
    from scenarios.campaign.results.events import parse_event
    from scenarios.campaign.run import fly_campaign
    from scenarios.campaign.statistics.requirement import judge, parse_requirement
    from scenarios.commands.campaign_console import print_campaign, progress

    requirements = [parse_requirement(text) for text in options.requirements]
    if options.junit is not None and not requirements:
        raise ParameterError("", "--junit", options.junit, "given with --require, whose verdicts it is to hold")
    if options.junit is not None:
        require_file(options.junit, ".xml")
    plan = load_plan(options.file, options.settings, flights=options.flights, seed=options.seed)
    for requirement in requirements:
        parse_event(requirement.event.text, plan.columns)
    target = real_path(Path("runs") / "campaigns" / plan.spec.name if options.out is None else options.out)
    engine = _engine(options)
    try:
        with progress(enabled=not options.json) as watch:
            result = fly_campaign(
                plan,
                target,
                engine,
                resume=options.resume,
                until_width=options.until_width,
                report=options.report,
                watch=watch,
            )
    except KeyboardInterrupt:
        console.say(f"interrupted (Ctrl-C); {target} has what was flown, --resume goes on with it")
        return EXIT_FAILED
    judgements = [judge(result.table, requirement) for requirement in requirements]
    if options.junit is not None:
        cases = [(judgement.requirement.text, judgement.holds, judgement.sentence) for judgement in judgements]
        write_cases(plan.spec.name, cases, Path(options.junit))
    if options.json:
        gate = [judgement.to_json() for judgement in judgements]
        print(json.dumps({**result.summary, "requirements": gate}, indent=2))
    else:
        print_campaign(result.summary, plan.spec.failure, judgements, str(target))
    return EXIT_DONE if all(judgement.holds for judgement in judgements) else EXIT_FAILED


def _engine(options: Namespace) -> Engine:
    """Who flies the campaign."""
    from scenarios.campaign.engine.local import LocalEngine

    if options.cluster is None:
        return LocalEngine(options.workers)
    from scenarios.campaign.engine.cluster import DaskEngine

    if options.workers is not None:
        raise ParameterError("", "--workers", options.workers, "absent where --cluster says who flies")
    return DaskEngine(options.cluster)


def replay(options: Namespace) -> int:
    """`quadsim replay`."""
    from scenarios.campaign.replay import recorded_flight
    from scenarios.campaign.replay import replay as fly_again
    from scenarios.campaign.results.verdicts import MEMORY, TIMEOUT
    from scenarios.commands.campaign_console import print_replay

    directory = Path(options.campaign)
    flight = recorded_flight(directory, options.flight)
    target = real_path(Path("runs") / flight.scenario.name if options.out is None else options.out)
    outputs = Outputs(video=options.video, recording=options.recording, figures=options.figures)
    if flight.otherwise:
        console.say(f"other {', '.join(flight.otherwise)} flew that campaign, so numbers may differ")
    if flight.row["verdict"] in (TIMEOUT, MEMORY):
        ended = f"flight {flight.number} was ended in the campaign ({flight.row['reason']})"
        console.say(f"{ended}; here nothing ends it but Ctrl-C")
    with console.progress_bars(enabled=not options.json) as progress:
        _, differing = fly_again(flight, target, outputs, progress)
    print_summary(rundir.read_summary(target), options, where=str(target))
    if not options.json:
        print_replay(flight.number, flight.row, differing)
    return EXIT_FAILED if differing else EXIT_DONE
