"""What each command of `quadsim` does."""

from __future__ import annotations

import json
from argparse import Namespace
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Final, get_args

from mpc.solvers import SOLVERS
from quadsim import rundir
from quadsim.assets import vehicle_names, vehicle_path
from quadsim.errors import FileError, InputError, ParameterError
from quadsim.table import Grid
from quadsim.vehicle import load_vehicle, vehicle_sources
from scenarios import console, runner
from scenarios.build import CONTROLLERS, build_vehicle, resolve
from scenarios.cli import EXIT_DONE, EXIT_FAILED
from scenarios.courses import report
from scenarios.junit import write_junit
from scenarios.loading import load_scenario, scenario_names
from scenarios.runner import Outputs
from scenarios.spec import Group, Scenario


def list_everything(options: Namespace) -> int:
    """`quadsim list`."""
    scenarios = [load_scenario(name) for name in scenario_names()]
    sections = {
        "vehicles": {name: load_vehicle(vehicle_path(name)).description for name in vehicle_names()},
        "controllers": dict(CONTROLLERS),
        "solvers": {name: entry.line for name, entry in SOLVERS.items()},
    }
    if options.json:
        about = {
            "scenarios": {each.name: each.description for each in scenarios},
            "groups": {each.name: each.group for each in scenarios},
            "expected": {each.name: each.expect for each in scenarios},
        }
        print(json.dumps({**about, **sections}, indent=2))
    else:
        console.print_listing({**_by_group(scenarios), **sections})
    return EXIT_DONE


def run(options: Namespace) -> int:
    """`quadsim run`."""
    scenario = _load(options.scenario, options)
    target = Path(options.out) if options.out else Path("runs") / scenario.name
    outputs = Outputs(video=options.video, recording=options.recording, figures=options.figures)
    _announce(scenario, options)
    with console.progress_bars(enabled=not options.json) as progress:
        flight = runner.run(scenario, target, outputs, progress)
    _print_summary(rundir.read_summary(target), options, where=str(target))
    return EXIT_DONE if flight.satisfied else EXIT_FAILED


def check(options: Namespace) -> int:
    """`quadsim check`."""
    if Path(options.target).is_dir():
        if options.settings or options.seed is not None:
            option, value = ("--set", options.settings) if options.settings else ("--seed", options.seed)
            raise ParameterError("", option, value, "absent when a finished run is checked")
        summary = _read_intact_summary(Path(options.target))
    else:
        scenario = _load(options.target, options)
        _announce(scenario, options)
        with console.progress_bars(enabled=not options.json) as progress:
            summary = runner.summarise(runner.fly_scenario(scenario, progress))
    if options.junit:
        write_junit(summary, Path(options.junit))
    _print_summary(summary, options)
    return EXIT_DONE if summary["satisfied"] else EXIT_FAILED


def compare(options: Namespace) -> int:
    """`quadsim compare`."""
    from quadsim.comparison import comparison_rows, run_names
    from quadsim.report import write_comparison
    from quadsim.table import to_markdown
    from scenarios.cost import find_study, study_cost

    target = Path(options.out)
    for name in options.targets:  # what is wrong with any of them is said before the first is flown
        if Path(name).is_dir():
            rundir.read_summary(Path(name))
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


def video(options: Namespace) -> int:
    """`quadsim video`."""
    from quadsim.video import render_gif, render_video

    directory = Path(options.run)
    rundir.read_summary(directory)
    path = Path(options.out) if options.out else directory / rundir.VIDEO_FILE
    if options.workers is not None and options.workers < 1:
        raise ParameterError("", "--workers", options.workers, "at least 1")
    if path.suffix not in (".mp4", ".gif"):
        raise ParameterError("", "--out", options.out, "a file ending in .mp4 or .gif")
    with console.progress_bars(enabled=True) as progress:
        if path.suffix == ".gif":
            render_gif(directory, path)
        else:
            render_video(
                directory,
                path,
                workers=options.workers,
                progress=lambda done, total: progress("video", done, total),
            )
    if path.parent.resolve() == directory.resolve():
        rundir.refresh_hashes(directory)
    print(f"written to {path}")
    return EXIT_DONE


def view(options: Namespace) -> int:
    """`quadsim view`."""
    from quadsim.recording import open_viewer

    path = Path(options.run)
    recording = path / rundir.RECORDING_FILE if path.is_dir() else path
    if not path.exists():
        raise FileError(path, "no such run or recording")
    if not recording.is_file():
        raise FileError(path, f"has no {rundir.RECORDING_FILE}; run the scenario again without --no-recording")
    if recording.suffix != ".rrd":
        raise FileError(path, "is no recording; give a run directory or a file ending in .rrd")
    open_viewer(recording, web=options.web)
    return EXIT_DONE


def scenario(options: Namespace) -> int:
    """`quadsim scenario`."""
    if options.schema:
        from scenarios.schema import scenario_schema

        print(json.dumps(scenario_schema(), indent=2))
        return EXIT_DONE
    if options.scenario is None:
        raise InputError(
            f"scenario needs a name or a TOML file, or --schema (there are: {', '.join(scenario_names())})"
        )
    loaded = _load(options.scenario, options)
    print(resolve(loaded, build_vehicle(loaded)).to_toml(), end="")
    return EXIT_DONE


def vehicle(options: Namespace) -> int:
    """`quadsim vehicle`."""
    from scenarios.vehicle_sheet import make_sheet, sheet_tables, sheet_to_json

    path = vehicle_path(options.vehicle)
    loaded, sources = load_vehicle(path), vehicle_sources(path)
    if options.out is not None:
        from quadsim.video import render_portrait

        if Path(options.out).suffix != ".png":
            raise ParameterError("", "--out", options.out, "a file ending in .png")
        render_portrait(loaded, Path(options.out))
    sheet = make_sheet(loaded)
    if options.json:
        print(json.dumps(sheet_to_json(loaded, sheet, sources), indent=2))
    else:
        console.print_grids(sheet_tables(loaded, sheet, sources), options.out, prose=("unit", "source"))
    return EXIT_DONE


def doctor(options: Namespace) -> int:
    """`quadsim doctor`."""
    from scenarios.doctor import examine

    findings = examine()
    if options.json:
        print(json.dumps(findings, indent=2))
    else:
        console.print_listing(findings)
    return EXIT_DONE


def bench(options: Namespace) -> int:
    """`quadsim bench`."""
    scenario = _load(options.scenario, options)
    with console.progress_bars(enabled=not options.json) as progress:
        measured, tables, where = _BENCHES[options.kind](scenario, options, progress)
    if options.json:
        print(json.dumps(measured, indent=2))
    else:
        console.print_grids(tables, where)
    return EXIT_DONE


_Benched = tuple[dict[str, Any], list[Grid], str | None]
"""What was measured, as plain values and as tables, and where it was written."""


def _bench_solvers(scenario: Scenario, options: Namespace, progress: runner.Progress) -> _Benched:
    from quadsim.bench import solver_tables
    from scenarios.bench.solvers import bench_solvers, is_bench, write_bench

    target = Path(options.out)
    with rundir.writing(target, replaces=is_bench) as directory:
        measured = bench_solvers(
            scenario,
            repeats=options.repeats,
            horizons=options.horizons,
            solvers=tuple(options.solvers or SOLVERS),
            stride=options.stride,
            progress=progress,
        )
        write_bench(measured, directory)
    return measured.to_json(), solver_tables(measured), str(target)


def _bench_flight(scenario: Scenario, options: Namespace, progress: runner.Progress) -> _Benched:
    from quadsim.bench import flight_tables
    from scenarios.bench.flight import bench_flight

    profile = bench_flight(scenario, repeats=options.repeats, progress=progress)
    return profile.to_json(), flight_tables(profile), None


def _bench_render(scenario: Scenario, options: Namespace, progress: runner.Progress) -> _Benched:
    from quadsim.bench import render_tables
    from scenarios.bench.render import bench_render

    profile = bench_render(scenario, seconds=options.seconds, workers=options.workers, progress=progress)
    return profile.to_json(), render_tables(profile), None


_BENCHES: Final = {"solvers": _bench_solvers, "flight": _bench_flight, "render": _bench_render}


_MEANT: Final = {"violated": "  (meant to violate a constraint)", "lost": "  (meant to be lost)"}
"""What `quadsim list` says of a scenario that is to defeat its controller."""

COMMANDS: Final[dict[str, Callable[[Namespace], int]]] = {
    "list": list_everything,
    "run": run,
    "check": check,
    "compare": compare,
    "video": video,
    "view": view,
    "scenario": scenario,
    "vehicle": vehicle,
    "bench": bench,
    "doctor": doctor,
}


def _by_group(scenarios: Sequence[Scenario]) -> dict[str, dict[str, str]]:
    """One line per scenario, by group; those that are to defeat their controller say so."""
    found: dict[str, dict[str, str]] = {}
    for group in get_args(Group):
        lines = {each.name: each.description + _MEANT.get(each.expect, "") for each in scenarios if each.group == group}
        found |= {f"scenarios: {group}": lines} if lines else {}
    return found


def _announce(scenario: Scenario, options: Namespace) -> None:
    """Say what the course asks for, before it is flown; the summary says it again."""
    if not options.json:
        console.print_notice(report(scenario, build_vehicle(scenario)).sentence)


def _load(name: str, options: Namespace) -> Scenario:
    settings = [*options.settings] if options.seed is None else [*options.settings, f"seed={options.seed}"]
    if Path(name).is_dir():
        raise InputError(f"{name} is a directory; give a scenario's name or its TOML file")
    return load_scenario(name, settings)


def _read_intact_summary(directory: Path) -> dict[str, Any]:
    summary = rundir.read_summary(directory)
    damaged = rundir.damaged_files(directory, summary)
    if damaged:
        raise FileError(directory, f"{', '.join(damaged)} missing or not the files that the summary was made from")
    return rundir.load_run(directory).summary


def _fly_for_comparison(name: str, target: Path) -> Path:
    scenario = load_scenario(name)
    directory = target.parent / f"{target.name}-runs" / scenario.name
    with console.progress_bars(enabled=True) as progress:
        runner.run(scenario, directory, Outputs(), progress)
    return directory


def _print_summary(summary: dict[str, Any], options: Namespace, where: str | None = None) -> None:
    if options.json:
        print(json.dumps(summary, indent=2))
    else:
        console.print_summary(summary, where)
