"""What `import quadsim` hands out of many flights: sweeps, campaigns, one flight again, tuning, and papers."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from quadsim.errors import InputError, ParameterError
from quadsim.outputs import absolute, reserving
from scenarios.api import as_scenario, named_by
from scenarios.flight import Outputs
from scenarios.parts.plugin import require_importable
from scenarios.progress import Progress, reporting
from scenarios.schema.scenario import Scenario
from scenarios.shipped import paper_names

if TYPE_CHECKING:
    from scenarios.campaign.replay import Replay
    from scenarios.campaign.run import Result
    from scenarios.campaign.sweep import Sweep
    from scenarios.papers.reproduction import Reproduction
    from scenarios.tuning.run import TuningResult


def sweep(
    scenario: Scenario | str | Path,
    values: Mapping[str, Sequence[Any]],
    *,
    controller: object = None,
    forces: Sequence[object] = (),
    workers: int | None = None,
    progress: bool = True,
) -> Sweep:
    """Fly a scenario once for every combination of some fields' values, all with the scenario's own seed.

    Args:
        scenario: what is flown, or its name or file.
        values: what to try, by dotted path.
        controller: as of `fly`; a class or a function of a module that other processes can import.
        forces: what acts on it, as of `fly`; the same.
        workers: processes that fly; one per usable core where absent.
        progress: whether to show a bar on a terminal.

    Returns:
        A row per flight, in the order of the combinations, the last field varying fastest.

    Raises:
        InputError: a value is not allowed, or the controller cannot be sent to other processes.

    Examples:
        >>> import quadsim
        >>> scenario = quadsim.load("hover").replace({"duration": 1.0})
        >>> found = quadsim.sweep(scenario, {"controller.horizon": [20, 40]}, workers=1)
        >>> found["controller.horizon"].tolist(), found["verdict"].tolist()
        ([20.0, 40.0], ['satisfied', 'satisfied'])
    """
    from scenarios.campaign.sweep import fly_sweep

    scenario = as_scenario(scenario)
    with reporting(progress) as report:
        return fly_sweep(flown_by(scenario, controller, forces), values, workers, report)


def campaign(
    campaign: str | Path | Scenario,
    *,
    out: str | Path | None = None,
    vary: Sequence[Mapping[str, Any]] = (),
    flights: int | None = None,
    seed: int | None = None,
    changes: Sequence[str] = (),
    controller: object = None,
    forces: Sequence[object] = (),
    require: Sequence[str] = (),
    workers: int | None = None,
    cluster: str | None = None,
    resume: bool = False,
    overwrite: bool = False,
    until_width: float | None = None,
    report: bool = True,
    progress: bool | Literal["lines"] = True,
    **fields: Any,
) -> Result:
    """Fly a scenario many times, what may vary drawn at random.

    Args:
        campaign: one that ships or a campaign file; or a scenario, with the following in place of the file.
        out: its directory, `runs/campaigns/NAME` where absent.
        vary: of a scenario: what varies, entries as `[[vary]]` of a campaign file.
        flights: how many, instead of the file's.
        seed: of all draws, instead of the file's.
        changes: of a file: texts `dotted.path=value` that change fields of its scenario.
        controller: of a scenario, as of `sweep`.
        forces: of a scenario, as of `sweep`.
        require: requirements as texts, e.g. `P(failure) < 0.02`, that `judgements` judges.
        workers: processes that fly; one per usable core where absent.
        cluster: the address of a Dask scheduler whose workers fly instead, as of `--cluster`.
        resume: whether to continue what the directory holds.
        overwrite: whether to replace an earlier output there.
        until_width: width of the 95 % interval of the failure probability, from 0 to 1, at which to stop.
        report: whether to write the page and its figure.
        progress: whether to show a bar on a terminal; "lines" for a line now and then where stderr is none.
        **fields: of a scenario: other fields of a campaign file, as `name`, `failure` or `sampling`.

    Returns:
        The results: `table` (a row per flight), `summary` (estimates with their intervals), and the `directory`.

    Raises:
        InputError: something cannot be flown so.
        OutputError: a campaign is there already, or the directory cannot be written.
        KeyboardInterrupt: a person stopped it; what was flown is there, and `resume` continues it.

    Examples:
        >>> import tempfile, quadsim
        >>> scenario = quadsim.load("hover").replace({"duration": 1.0})
        >>> mass = {"name": "mass", "fields": ["vehicle.mass"], "distribution": "uniform", "low": 4.0, "high": 4.4}
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     found = quadsim.campaign(scenario, vary=[mass], flights=3, workers=1, out=folder + "/mass")
        >>> found.table["verdict"].to_pylist()
        ['satisfied', 'satisfied', 'satisfied']
    """
    from scenarios.campaign.plan import load_plan, make_plan
    from scenarios.campaign.results.events import parse_event
    from scenarios.campaign.run import fly_campaign
    from scenarios.campaign.statistics.requirement import judge, parse_requirement

    requirements = [parse_requirement(text) for text in require]
    if isinstance(campaign, Scenario):
        requested = {"vary": [dict(entry) for entry in vary], "flights": flights, "seed": seed, **fields}
        given = {name: value for name, value in requested.items() if value is not None}
        plan = make_plan(flown_by(campaign, controller, forces), given)
    elif vary or fields or controller is not None or forces:
        raise InputError("vary, controller and other fields go with a scenario; a campaign file has its own")
    else:
        plan = load_plan(str(campaign), changes, flights=flights, seed=seed)
    for requirement in requirements:
        parse_event(requirement.event.text, plan.columns)
    target = absolute(Path("runs") / "campaigns" / plan.spec.name if out is None else out)
    options: dict[str, Any] = {"workers": workers, "cluster": cluster, "report": report, "until_width": until_width}
    with _watching(target, progress, resume=resume, overwrite=overwrite) as shared:
        result = fly_campaign(plan, target, **options, **shared)
    return replace(result, judgements=tuple(judge(result.table, requirement) for requirement in requirements))


def tune(
    tuning: str | Path,
    *,
    out: str | Path | None = None,
    trials: int | None = None,
    seed: int | None = None,
    workers: int | None = None,
    cluster: str | None = None,
    resume: bool = False,
    overwrite: bool = False,
    report: bool = True,
    progress: bool | Literal["lines"] = True,
) -> TuningResult:
    """Search fields of a scenario, and hold the answer against the start on fresh draws.

    The tuning is one that ships, or a file; `trials` (candidates) and `seed` (of the search and its draws) replace the
    file's.  Its directory is `runs/tunings/NAME` where `out` is absent.  All other options are those of `campaign`.

    Returns:
        `best` (the scenario that was found), `summary` (the search and the fresh flights),
        `comparison` (flight by flight), `holds`, and the `directory`.

    Raises:
        InputError: something cannot be flown so.
        MissingPackageError: the extra `tune` is not installed.
        OutputError: a tuning is there already, or the directory cannot be written.
        KeyboardInterrupt: a person stopped it; what was flown is there, and `resume` continues it.

    Examples:
        >>> import tempfile, pathlib, quadsim
        >>> text = '''
        ... name = "little"
        ... trials = 2
        ... batch = 2
        ... flights = [1]
        ... require = "P(lost) < 0.9 @ 50%"
        ... fresh = { flights = 2 }
        ... objectives = [{ name = "error", expression = "rmse.z" }]
        ... campaign = { scenario = "hover", set = { duration = 0.5, constraints = [] } }
        ... [[search]]
        ... name = "horizon"
        ... fields = ["controller.horizon"]
        ... distribution = "integer"
        ... low = 10
        ... high = 20
        ... '''
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     file = pathlib.Path(folder) / "little.toml"
        ...     _ = file.write_text(text)
        ...     found = quadsim.tune(file, out=folder + "/little", workers=1, report=False)
        >>> len(found.summary["candidates"]), found.holds
        (3, True)
    """
    from scenarios.tuning.plan import load_tuning
    from scenarios.tuning.run import tune as carry_out
    from scenarios.tuning.search import require_optuna

    require_optuna()
    plan = load_tuning(str(tuning), trials=trials, seed=seed)
    target = absolute(Path("runs") / "tunings" / plan.spec.name if out is None else out)
    with _watching(target, progress, resume=resume, overwrite=overwrite) as shared:
        return carry_out(plan, target, workers=workers, cluster=cluster, report=report, **shared)


@contextmanager
def _watching(
    target: Path, progress: bool | Literal["lines"], *, resume: bool, overwrite: bool
) -> Iterator[dict[str, Any]]:
    """The options that say whether to go on in a directory, and that show a bar; Ctrl-C says what is there."""
    from scenarios.commands.campaign_console import progress as bar

    if resume and overwrite:
        raise ParameterError("", "--overwrite", overwrite, "absent with --resume")
    try:
        with bar(enabled=bool(progress), lines=progress == "lines") as watch:
            yield {"resume": resume, "overwrite": overwrite, "watch": watch}
    except KeyboardInterrupt:
        raise KeyboardInterrupt(f"{target} has what was flown") from None


def replay(
    campaign: str | Path,
    flight: int | None = None,
    *,
    out: str | Path | None = None,
    overwrite: bool = False,
    video: bool | None = None,
    recording: bool | None = None,
    figures: bool | None = None,
    progress: Progress | bool = True,
) -> Replay:
    """Fly one flight of a finished campaign again, with everything that a run directory has.

    `campaign` is its directory, and `flight` the worst where absent.  The run directory is `runs/CAMPAIGN-N`, or the
    next free name, where `out` is absent.  All other options are those of `fly`.

    Returns:
        The flight, and the columns of the campaign's table that it does not agree with, bit for bit.

    Raises:
        InputError: there is no such campaign or flight.
        OutputError: the directory cannot be written.

    Examples:
        >>> import tempfile, quadsim
        >>> scenario = quadsim.load("hover").replace({"duration": 0.5})
        >>> mass = {"name": "mass", "fields": ["vehicle.mass"], "distribution": "uniform", "low": 4.0, "high": 4.4}
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     found = quadsim.campaign(scenario, vary=[mass], flights=2, workers=1, out=folder + "/mass")
        ...     again = quadsim.replay(found.directory, 1, out=folder + "/again", video=False)
        >>> len(again.differing)  # columns that are not the same bit for bit
        0
    """
    from scenarios.campaign.replay import recorded_flight, replay_flight

    recorded = recorded_flight(Path(campaign), flight)
    for note in recorded.notes:
        logging.getLogger("quadsim").info(note)
    target, free = (Path("runs") / recorded.scenario.name, not overwrite) if out is None else (Path(out), False)
    outputs = Outputs(video=video, recording=recording, figures=figures)
    with reporting(progress) as report, reserving(target, overwrite=overwrite, free=free) as directory:
        return replay_flight(recorded, directory, outputs, report, overwrite=overwrite)


def flown_by(scenario: Scenario, controller: object, forces: Sequence[object] = ()) -> Scenario:
    """The same, of code that other processes import by its place.

    Raises:
        ParameterError: they cannot.
    """
    if controller is not None and not isinstance(controller, str):
        require_importable(controller)
    for force in forces:
        require_importable(force, "forces")
    return named_by(scenario, controller, forces)


def reproduce(paper: str | Path | None = None, *, progress: Progress | bool = True) -> tuple[Reproduction, ...]:
    """Fly what papers publish, and hold it against their numbers.

    Args:
        paper: a name, or a path ending in `.toml`; every paper that ships where absent.
        progress: as of `fly`.

    Returns:
        A reproduction for each paper: `numbers`, each with `ours`, `difference` and `within`, and a table, `grid`.

    Raises:
        InputError: there is no such paper, or a number of it cannot be flown.

    Examples:
        >>> import quadsim
        >>> (found,) = quadsim.reproduce("quadrotor-uav", progress=False)
        >>> found.within, found.numbers[2].spec.published, round(found.numbers[2].ours, 3)
        (True, 250.0, 250.0)
    """
    from scenarios.papers.paper import load_paper
    from scenarios.papers.reproduction import reproduce_paper

    papers = [load_paper(name) for name in ([str(paper)] if paper is not None else paper_names())]
    with reporting(progress) as report:
        return tuple(reproduce_paper(each, report) for each in papers)
