"""`quadsim run` and `check`."""

from __future__ import annotations

from argparse import Namespace
from pathlib import Path

from quadsim.errors import ParameterError
from quadsim.flight import rundir
from quadsim.outputs import real_path, require_file
from scenarios.api import fly
from scenarios.commands import EXIT_DONE, EXIT_FAILED, console
from scenarios.commands.common import load, print_summary
from scenarios.commands.junit import write_junit
from scenarios.courses.feasibility_check import fitting, report
from scenarios.parts.vehicle import build_vehicle
from scenarios.reaudit import reaudit
from scenarios.schema.scenario import Scenario


def run(options: Namespace) -> int:
    """`quadsim run`."""
    scenario = load(options.scenario, options)
    target = real_path(Path("runs") / scenario.name if options.out is None else options.out)
    _announce(scenario, options)
    flight = fly(
        scenario,
        out=target,
        video=options.video,
        recording=options.recording,
        figures=options.figures,
        progress=not options.json,
    )
    print_summary(rundir.read_summary(target), options, where=str(target))
    return EXIT_DONE if flight.satisfied else EXIT_FAILED


def check(options: Namespace) -> int:
    """`quadsim check`."""
    if options.junit is not None:
        require_file(options.junit, ".xml")
    again = None
    if Path(options.target).is_dir():
        if options.settings or options.seed is not None:
            option, value = ("--set", options.settings) if options.settings else ("--seed", options.seed)
            raise ParameterError("", option, value, "absent when a finished run is checked")
        again = reaudit(Path(options.target))
        summary = {**again.summary, "reaudit": again.to_json()}
        for note in again.notes:
            console.say(f"{options.target}: {note}")
    else:
        scenario = load(options.target, options)
        _announce(scenario, options)
        summary = dict(fly(scenario, progress=not options.json).summary)
    if options.junit is not None:
        write_junit(summary, Path(options.junit))
    print_summary(summary, options)
    return EXIT_DONE if summary["satisfied"] and (again is None or again.satisfied) else EXIT_FAILED


def _announce(scenario: Scenario, options: Namespace) -> None:
    """Say what the course asks for, before it is flown; the summary says it again."""
    if not options.json:
        vehicle = build_vehicle(scenario)
        asked = report(scenario, vehicle)
        fits = fitting(scenario, vehicle) if asked.problems and console.is_watched() else ""
        console.print_notice(f"{asked.sentence} {fits}".rstrip())
