"""`quadsim run`, `check` and `compare`."""

from __future__ import annotations

from argparse import Namespace
from pathlib import Path

from quadsim import rundir
from quadsim.errors import ParameterError
from quadsim.outputs import real_path, require_directory, require_file
from scenarios import console, runner
from scenarios.build import build_vehicle
from scenarios.cli import EXIT_DONE, EXIT_FAILED
from scenarios.commands.common import load, print_summary
from scenarios.courses import report
from scenarios.junit import write_junit
from scenarios.loading import load_scenario
from scenarios.reaudit import reaudit
from scenarios.runner import Outputs
from scenarios.spec import Scenario


def run(options: Namespace) -> int:
    """`quadsim run`."""
    scenario = load(options.scenario, options)
    target = real_path(Path("runs") / scenario.name if options.out is None else options.out)
    outputs = Outputs(video=options.video, recording=options.recording, figures=options.figures)
    _announce(scenario, options)
    with console.progress_bars(enabled=not options.json) as progress:
        flight = runner.run(scenario, target, outputs, progress)
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
        with console.progress_bars(enabled=not options.json) as progress:
            summary = runner.summarise(runner.fly_scenario(scenario, progress))
    if options.junit is not None:
        write_junit(summary, Path(options.junit))
    print_summary(summary, options)
    return EXIT_DONE if summary["satisfied"] and (again is None or again.satisfied) else EXIT_FAILED


def compare(options: Namespace) -> int:
    """`quadsim compare`."""
    from quadsim.comparison import comparison_rows, run_names
    from quadsim.report import KIND, write_comparison
    from quadsim.table import to_markdown
    from scenarios.campaign.manifest import is_campaign
    from scenarios.commands.campaigns import compare_campaigns
    from scenarios.cost import find_study, study_cost

    if any(is_campaign(Path(name)) for name in options.targets):
        return compare_campaigns(options)
    target = real_path(options.out)
    require_directory(target, KIND)
    for name in options.targets:  # what is wrong with any of them is said before the first is flown
        if Path(name).is_dir():
            for note in reaudit(Path(name), products=False).notes:
                console.say(f"{name}: {note}")
        else:
            load_scenario(name)
    studied = find_study(options.targets, asked=options.cost)
    directories = [Path(name) if Path(name).is_dir() else _fly_for_comparison(name, target) for name in options.targets]
    runs = [rundir.load_run(directory) for directory in directories]
    study = None
    if studied:
        constrained, *others = studied
        with console.progress_bars(enabled=True) as progress:
            study = study_cost(constrained, others, progress=progress)
    page = write_comparison(runs, target, study)
    rows, names = comparison_rows(runs), run_names(runs)
    if options.markdown:
        print(to_markdown(rows, names))
    else:
        console.print_comparison(rows, names, str(page))
    return EXIT_DONE


def _announce(scenario: Scenario, options: Namespace) -> None:
    """Say what the course asks for, before it is flown; the summary says it again."""
    if not options.json:
        console.print_notice(report(scenario, build_vehicle(scenario)).sentence)


def _fly_for_comparison(name: str, target: Path) -> Path:
    scenario = load_scenario(name)
    directory = target.parent / f"{target.name}-runs" / scenario.name
    with console.progress_bars(enabled=True) as progress:
        runner.run(scenario, directory, Outputs(), progress)
    return directory
