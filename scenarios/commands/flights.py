"""`quadsim run`, `check`, `compare`, `video`, `view`, `export` and `reproduce`."""

from __future__ import annotations

import json
import shlex
from argparse import Namespace
from pathlib import Path

from quadsim.errors import InputError, OutputError, ParameterError, printable
from quadsim.flight import rundir
from quadsim.outputs import reserving
from scenarios import api
from scenarios.commands import EXIT_DONE, EXIT_FAILED, console
from scenarios.commands.console import print_result, shown
from scenarios.flight import Flight
from scenarios.junit import junit_file, write_junit
from scenarios.reaudit import Reaudit
from scenarios.schema.scenario import Scenario


def load(name: str, options: Namespace) -> Scenario:
    """The scenario of that name, with the settings and the seed of the command line.

    Raises:
        InputError: it cannot be flown.
    """
    settings = [*options.settings] if options.seed is None else [*options.settings, f"seed={options.seed}"]
    return api.load(name, settings)


def run(options: Namespace) -> int:
    """`quadsim run`."""
    scenario = load(options.scenario, options)
    _announce(scenario, options)
    out = Path("runs") / scenario.name if options.out is None else options.out
    with reserving(out, overwrite=options.overwrite, free=options.out is None and not options.overwrite) as target:
        try:
            outcome = api.fly(
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
                print_result(rundir.read_summary(target), options, where=shown(target))
            raise
    print_result(rundir.read_summary(target), options, where=shown(target))
    return EXIT_DONE if outcome in ("satisfied", "incomplete") else EXIT_FAILED


def check(options: Namespace) -> int:
    """`quadsim check`; `incomplete` is a failure here: not every constraint was shown to hold."""
    from scenarios.campaign.manifest import is_campaign

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
        found = api.fly(scenario, progress=not options.json)
        summary = dict(found.summary)
    if options.junit is not None:
        write_junit(found, options.junit)
    print_result(summary, options)
    return EXIT_DONE if summary["satisfied"] and found.satisfied else EXIT_FAILED


def _announce(scenario: Scenario, options: Namespace) -> None:
    """Report what the course requires on a terminal, before it is flown; the summary repeats it."""
    terminal = console.stderr()
    if not options.json and terminal.is_terminal:
        required = api.feasibility(scenario)
        fits = api.fitting(scenario) if required.problems else ""
        terminal.print(f"{required.sentence} {fits}".rstrip(), soft_wrap=True)


def compare(options: Namespace) -> int:
    """`quadsim compare`: of runs and of campaigns."""
    from scenarios.comparison import Comparison

    found = api.compare(*options.targets, out=options.out, overwrite=options.overwrite)
    if isinstance(found, Comparison):
        for note in found.notes:
            console.say(note)
        if options.markdown:
            print(found.to_markdown())
        else:
            console.print_comparison(found.rows, found.names, str(found.page))
        return EXIT_DONE
    from scenarios.campaign.report.comparison_tables import comparison_markdown
    from scenarios.commands.campaign_console import print_comparison

    if options.markdown:
        print(comparison_markdown(found))
    else:
        print_comparison(found, str(Path(options.out) / "index.html"))
    return EXIT_DONE


def video(options: Namespace) -> int:
    """`quadsim video`."""
    path = api.film(options.run, options.out, overwrite=options.overwrite, workers=options.workers)
    print(f"written to {printable(shown(path))}")
    return EXIT_DONE


def view(options: Namespace) -> int:
    """`quadsim view`."""
    api.view(options.run, web=options.web)
    return EXIT_DONE


def export(options: Namespace) -> int:
    """`quadsim export`."""
    from scenarios.export.exporter import FACTS, room_sentence
    from scenarios.export.exporter import export as write_export

    scenario = load(options.scenario, options)
    machine = {"precision": options.precision, "target": options.target}
    directory = write_export(scenario, Path(options.out), overwrite=options.overwrite, rows=options.rows, **machine)
    print(f"{options.precision}: {room_sentence(json.loads((directory / FACTS).read_text()))}")
    print(f"Wrote {directory}: make -C {shlex.quote(str(directory))} check compiles it and runs its recorded periods")
    if not options.fly:
        return EXIT_DONE
    from scenarios.export.in_the_loop import fly_exported

    with reserving(Path("runs") / f"{scenario.name}-{options.target}", free=True) as out:
        flight = fly_exported(scenario, out, **machine)
    console.print_summary(rundir.read_summary(out), shown(out))
    return EXIT_DONE if flight.satisfied else EXIT_FAILED


def reproduce(options: Namespace) -> int:
    """`quadsim reproduce`."""
    from scenarios.many_flights import reproduce as reproduce_papers

    if options.junit is not None:
        options.junit = junit_file(options.junit)
    found = reproduce_papers(options.paper, progress=not options.json)
    if options.junit is not None:
        write_junit(found, options.junit)
    within = all(each.within for each in found)
    if options.json:
        print(json.dumps({"reproduced": within, "papers": [each.to_json() for each in found]}, indent=2))
    else:
        console.print_grids([each.grid for each in found], None, prose=("number",))
    return EXIT_DONE if within else EXIT_FAILED
