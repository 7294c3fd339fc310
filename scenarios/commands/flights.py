"""`quadsim run` and `check`."""

from __future__ import annotations

from argparse import Namespace
from pathlib import Path

from quadsim.errors import InputError, OutputError, ParameterError
from quadsim.flight import rundir
from quadsim.outputs import reserving
from scenarios import api
from scenarios.api import feasibility, fitting, fly
from scenarios.campaign.manifest import is_campaign
from scenarios.commands import EXIT_DONE, EXIT_FAILED, console
from scenarios.commands.common import load, print_summary, shown
from scenarios.flight import Flight
from scenarios.junit import junit_file, write_junit
from scenarios.reaudit import Reaudit
from scenarios.schema.scenario import Scenario


def run(options: Namespace) -> int:
    """`quadsim run`."""
    scenario = load(options.scenario, options)
    _announce(scenario, options)
    out = Path("runs") / scenario.name if options.out is None else options.out
    with reserving(out, overwrite=options.overwrite, free=options.out is None and not options.overwrite) as target:
        try:
            outcome = fly(
                scenario,
                out=target,
                overwrite=options.overwrite,
                video=options.video,
                recording=options.recording,
                figures=options.figures,
                progress=not options.json,
            ).outcome
        except OutputError as error:
            if error.path.parent == target:  # a product that was asked for by name; the flight is there
                print_summary(rundir.read_summary(target), options, where=shown(target))
            raise
    print_summary(rundir.read_summary(target), options, where=shown(target))
    return EXIT_DONE if outcome in ("satisfied", "incomplete") else EXIT_FAILED


def check(options: Namespace) -> int:
    """`quadsim check`; `incomplete` is a failure here: not every constraint was shown to hold."""
    if options.junit is not None:
        options.junit = junit_file(options.junit)
    found: Flight | Reaudit
    directory = Path(options.target)
    if directory.is_dir():
        if options.settings or options.seed is not None:
            option, value = ("--set", options.settings) if options.settings else ("--seed", options.seed)
            raise ParameterError("", option, value, "absent when a finished run is checked")
        if is_campaign(directory):
            name = options.target
            raise InputError(
                f"{name} is a campaign, not a run: quadsim replay {name} --worst makes a run of its worst flight; "
                "quadsim campaign --require judges them all"
            )
        found = api.check(directory)
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
