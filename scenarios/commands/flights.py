"""`quadsim run` and `check`."""

from __future__ import annotations

from argparse import Namespace
from pathlib import Path

from quadsim.errors import ParameterError
from quadsim.flight import rundir
from quadsim.outputs import real_path, require_file
from scenarios.api import check as check_run
from scenarios.api import feasibility, fitting, fly
from scenarios.commands import EXIT_DONE, EXIT_FAILED, console
from scenarios.commands.common import load, print_summary
from scenarios.flight import Flight
from scenarios.junit import write_junit
from scenarios.reaudit import Reaudit
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
    return EXIT_DONE if flight.outcome in ("satisfied", "incomplete") else EXIT_FAILED


def check(options: Namespace) -> int:
    """`quadsim check`; `incomplete` is a failure here: not every constraint was shown to hold."""
    if options.junit is not None:
        require_file(options.junit, ".xml")
    found: Flight | Reaudit
    if Path(options.target).is_dir():
        if options.settings or options.seed is not None:
            option, value = ("--set", options.settings) if options.settings else ("--seed", options.seed)
            raise ParameterError("", option, value, "absent when a finished run is checked")
        found = check_run(options.target)
        summary = {**found.summary, "reaudit": found.to_json()}
        for note in found.notes:
            console.say(f"{options.target}: {note}")
    else:
        scenario = load(options.target, options)
        _announce(scenario, options)
        found = fly(scenario, progress=not options.json)
        summary = dict(found.summary)
    if options.junit is not None:
        write_junit(found, options.junit)
    print_summary(summary, options)
    return EXIT_DONE if summary["satisfied"] and found.satisfied else EXIT_FAILED


def _announce(scenario: Scenario, options: Namespace) -> None:
    """Report what the course requires, before it is flown; the summary repeats it."""
    if not options.json:
        required = feasibility(scenario)
        fits = fitting(scenario) if required.problems and console.is_watched() else ""
        console.print_notice(f"{required.sentence} {fits}".rstrip())
