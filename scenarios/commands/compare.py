"""`quadsim compare`: of runs and of campaigns."""

from __future__ import annotations

from argparse import Namespace
from pathlib import Path

from quadsim.errors import InputError, ParameterError
from quadsim.flight import rundir
from quadsim.outputs import real_path, require_directory
from scenarios.campaign.manifest import is_campaign, stored_plan
from scenarios.commands import EXIT_DONE, console
from scenarios.loading import load_scenario
from scenarios.reaudit import reaudit
from scenarios.run import Outputs, run_scenario


def compare(options: Namespace) -> int:
    """`quadsim compare`."""
    from quadsim.report.comparison import comparison_rows, run_names
    from quadsim.report.pages.comparison_page import KIND, write_comparison
    from quadsim.report.table import to_markdown
    from scenarios.cost.measure import find_study, study_cost
    from scenarios.cost.section import cost_section

    if any(is_campaign(Path(name)) for name in options.targets):
        return compare_campaigns(options)
    target = real_path(options.out)
    require_directory(target, KIND)
    for name in options.targets:  # what is wrong with any of them is reported before the first is flown
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
    page = write_comparison(runs, target, None if study is None else cost_section(study))
    rows, names = comparison_rows(runs), run_names(runs)
    if options.markdown:
        print(to_markdown(rows, names))
    else:
        console.print_comparison(rows, names, str(page))
    return EXIT_DONE


def _fly_for_comparison(name: str, target: Path) -> Path:
    scenario = load_scenario(name)
    directory = target.parent / f"{target.name}-runs" / scenario.name
    with console.progress_bars(enabled=True) as progress:
        run_scenario(scenario, directory, Outputs(), progress)
    return directory


def compare_campaigns(options: Namespace) -> int:
    """`quadsim compare` of two campaigns, flight by flight."""
    from scenarios.campaign.report.campaign_page import KIND, write_comparison_report
    from scenarios.campaign.report.comparison_tables import comparison_markdown
    from scenarios.campaign.results.store import FLIGHTS_FILE, read_flights
    from scenarios.campaign.statistics.comparison import compare
    from scenarios.commands.campaign_console import print_comparison

    if len(options.targets) != 2:
        raise InputError(f"compare takes two campaigns, each by itself, not {len(options.targets)}")
    if options.cost:
        raise ParameterError("", "--cost", True, "absent when campaigns are compared")
    target = real_path(options.out)
    require_directory(target, KIND)
    first, second = (Path(name) for name in options.targets)
    plans = (stored_plan(first), stored_plan(second))
    names = (plans[0].spec.name, plans[1].spec.name)
    failures = (plans[0].spec.failure, plans[1].spec.failure)
    a, b = (read_flights(path / FLIGHTS_FILE, plan.schema) for path, plan in zip((first, second), plans, strict=True))
    comparison = compare(a, b, names, failures)
    page = write_comparison_report(comparison, target)
    if options.markdown:
        print(comparison_markdown(comparison))
    else:
        print_comparison(comparison, str(page))
    return EXIT_DONE
