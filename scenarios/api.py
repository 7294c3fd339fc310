"""The public Python interface, as `import quadsim` hands it out: scenarios, flights, sweeps, campaigns, comparisons.

The command line calls these functions and prints what they return.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from quadsim.assets import vehicle_path
from quadsim.controller import Controller
from quadsim.errors import InputError, ParameterError
from quadsim.flight import rundir
from quadsim.outputs import real_path
from quadsim.vehicle import Vehicle
from quadsim.vehicle import load_vehicle as read_vehicle
from scenarios.build import build_controller
from scenarios.flight import Flight, Outputs
from scenarios.loading import check_parts, load_scenario
from scenarios.parts.own_code import refer_to, refer_to_force, require_importable, set_up, set_up_force
from scenarios.parts.plugin import build_force
from scenarios.parts.randomness import generator
from scenarios.parts.vehicle import build_vehicle
from scenarios.progress import Progress, silent
from scenarios.reaudit import Reaudit, reaudit, stored_scenario
from scenarios.run import fly_scenario, run_scenario
from scenarios.schema.scenario import Scenario
from scenarios.shipped import paper_names, scenario_names

if TYPE_CHECKING:
    from scenarios.campaign.engine.protocol import Engine
    from scenarios.campaign.replay import Replay
    from scenarios.campaign.run import Result
    from scenarios.campaign.statistics.comparison import Comparison as CampaignComparison
    from scenarios.campaign.sweep import Sweep
    from scenarios.comparison import Comparison
    from scenarios.papers.reproduction import Reproduction

Setting = Mapping[str, Any] | Sequence[str]
"""Changes of a scenario: values by dotted path, or texts `dotted.path=value` as of `--set`."""


def scenarios() -> list[str]:
    """Names of the scenarios that ship, sorted.

    Examples:
        >>> import quadsim
        >>> "paper-constrained" in quadsim.scenarios()
        True
    """
    return scenario_names()


def load(name: str | Path, changes: Setting = ()) -> Scenario:
    """A scenario of the library, or of a file, checked together with the vehicle and the course that it names.

    Args:
        name: a library name, or a path ending in `.toml`.
        changes: fields to replace, as `Scenario.replace` takes them.

    Raises:
        InputError: it is missing or malformed, or cannot be flown so.

    Examples:
        >>> import quadsim
        >>> scenario = quadsim.load("paper-constrained", {"controller.horizon": 30})
        >>> scenario.controller.horizon, scenario.duration
        (30, 60.0)
    """
    if Path(name).is_dir():
        raise InputError(f"{name} is a directory; give a scenario's name or its TOML file")
    if not isinstance(changes, Mapping):
        return load_scenario(str(name), changes)
    scenario = load_scenario(str(name))
    return scenario.replace(changes) if changes else scenario


def load_vehicle(name: str | Path) -> Vehicle:
    """The numbers of a vehicle.

    Args:
        name: of one that ships, or a path ending in `.toml`.

    Raises:
        InputError: there is none, or it cannot fly.

    Examples:
        >>> import quadsim
        >>> vehicle = quadsim.load_vehicle("hummingbird")
        >>> vehicle.mass, round(vehicle.hover_speed)
        (0.716, 453)
    """
    return read_vehicle(vehicle_path(str(name)))


def fly(
    scenario: Scenario | str | Path,
    *,
    controller: object = None,
    forces: Sequence[object] = (),
    out: str | Path | None = None,
    video: bool = True,
    recording: bool = True,
    figures: bool = True,
    progress: Progress | bool = True,
) -> Flight:
    """Fly a scenario and audit it.

    Ctrl-C ends the flight in order: it is returned as far as it came, with the reason.

    Args:
        scenario: what is flown, or its name or file.
        controller: who flies it, instead of the scenario's: a class, called as MyLaw(vehicle, period=..., horizon=...)
            and with a method `step(now, state, reference)`; a function `law(now, state, reference)` that gives four
            rotor speeds [rad/s]; an object with such a `step`; or a text `package.module:Class`.  Further arguments of
            a class through `functools.partial`.
        forces: forces of one's own that act on the vehicle, besides the scenario's effects: functions
            `force(time, state)`, called once per physics step, that give force x, y, z in the world frame [N] and
            torque in the body frame [N m]; or classes called as MyForce(vehicle, rng=...) whose objects are called so.
        out: the run directory to write, complete or not at all; nothing is written where absent (`Flight.save` can).
        video: whether to film it, where it is written.
        recording: whether to write `flight.rrd`, where it is written.
        figures: whether to draw it, where it is written.
        progress: called with (what, done, total); True for bars on a terminal, False for none.

    Raises:
        InputError: the scenario cannot be flown, or the controller cannot be set up.
        RenderingUnavailableError: a video is wanted and cannot be made; nothing was flown.
        OutputError: the directory cannot be written; nothing is left there.

    Examples:
        >>> import numpy as np
        >>> import quadsim
        >>> scenario = quadsim.load("hover").replace({"duration": 1.0})
        >>> quadsim.fly(scenario).satisfied
        True
        >>> def full_throttle(now, state, reference):
        ...     return np.full(4, 300.0)
        >>> bool(quadsim.fly(scenario, controller=full_throttle).state["vz"][-1] > 1.0)
        True
        >>> def side_wind(time, state):
        ...     return np.array([0.5, 0.0, 0.0, 0.0, 0.0, 0.0])
        >>> bool(quadsim.fly(scenario, forces=[side_wind]).state["x"][-1] > 0.01)
        True
    """
    if not isinstance(scenario, Scenario):
        scenario = load(scenario)
    referring, law, own = named_by(scenario, controller, forces), None, None
    if controller is not None and not isinstance(controller, str):
        spec = refer_to(controller, scenario.controller.horizon)
        law = set_up(controller, spec, build_vehicle(scenario), scenario.control_period)
    if forces:
        vehicle, rng = build_vehicle(scenario), generator(scenario.seed, "forces")
        own = [build_force(spec, vehicle, rng) for spec in scenario.forces]
        own += [set_up_force(force, vehicle, rng) for force in forces]
    check_parts(referring)
    with reporting(progress) as report:
        if out is None:
            return fly_scenario(referring, report, law, own)
        outputs = Outputs(video=video, recording=recording, figures=figures)
        return run_scenario(referring, real_path(out), outputs, report, law, own)


def read(directory: str | Path) -> Flight:
    """A finished run: its log at the scenario's `log_rate`, its audit as it was recorded.

    Args:
        directory: as `quadsim run` or `Flight.save` wrote it.

    Raises:
        FileError: it is no run directory, or a file is missing or damaged.

    Examples:
        >>> import tempfile, quadsim
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     flown = quadsim.fly(quadsim.load("hover").replace({"duration": 1.0}))
        ...     read = quadsim.read(flown.save(folder + "/run", video=False))
        >>> bool((read.command == flown.command).all()), read.outcome
        (True, 'satisfied')
    """
    directory = Path(directory)
    run = rundir.load_run(directory)
    law = run.summary["controller"]
    return Flight(
        scenario=stored_scenario(directory),
        vehicle=run.vehicle,
        log=run.log,
        findings=tuple(rundir.finding_from_json(entry) for entry in run.summary["constraints"]),
        controller=law["name"],
        solver=law["solver"],
        simulate_s=run.summary["wall_s"]["simulate"],
        tallies={},
        directory=directory,
        recorded=run.summary,
    )


def make_controller(scenario: Scenario | str | Path) -> Controller:
    """The controller of a scenario, ready for `reset` and `step`, without a simulator.

    Raises:
        InputError: it cannot be made from these numbers.

    Examples:
        >>> import numpy as np
        >>> import quadsim
        >>> law = quadsim.make_controller("paper-constrained")
        >>> law.reset(np.full(4, 200.0))
        >>> command = law.step(quadsim.Moment(), np.zeros(12), np.zeros((law.horizon, 4)))
        >>> command.speeds.shape, command.plan.shape
        ((4,), (50, 4))
    """
    if not isinstance(scenario, Scenario):
        scenario = load(scenario)
    return build_controller(scenario, build_vehicle(scenario))


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
        controller: who flies it, as of `fly`; a class or a function of a module that other processes can import.
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

    if not isinstance(scenario, Scenario):
        scenario = load(scenario)
    with reporting(progress) as report:
        return fly_sweep(flown_by(scenario, controller, forces), values, make_engine(workers, None), report)


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
        controller: of a scenario: who flies, as of `sweep`.
        forces: of a scenario: what acts on it, as of `sweep`.
        require: requirements as texts, e.g. `P(failure) < 0.02`, that `judgements` judges.
        workers: processes that fly; one per usable core where absent.
        cluster: a dask cluster that flies instead, as of `--cluster`.
        resume: whether to go on with what the directory holds.
        until_width: width of the 95 % interval of the failure probability, from 0 to 1, at which to stop.
        report: whether to write the page and its figure.
        progress: whether to show a bar on a terminal; "lines" for a line now and then where stderr is none.
        **fields: of a scenario: other fields of a campaign file, as `name`, `failure` or `sampling`.

    Returns:
        The results: `table` (a row per flight), `summary` (estimates with their intervals), and the `directory`.

    Raises:
        InputError: something cannot be flown so.
        OutputError: a campaign is there already, or the directory cannot be written.
        KeyboardInterrupt: a person stopped it; what was flown is there, and `resume` goes on with it.

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
    from scenarios.commands.campaign_console import progress as bar

    if cluster is not None and workers is not None:
        raise ParameterError("", "--workers", workers, "absent where --cluster says who flies")
    requirements = [parse_requirement(text) for text in require]
    if isinstance(campaign, Scenario):
        asked = {"vary": [dict(entry) for entry in vary], "flights": flights, "seed": seed, **fields}
        given = {name: value for name, value in asked.items() if value is not None}
        plan = make_plan(flown_by(campaign, controller, forces), given)
    elif vary or fields or controller is not None or forces:
        raise InputError("vary, controller and other fields go with a scenario; a campaign file has its own")
    else:
        plan = load_plan(str(campaign), changes, flights=flights, seed=seed)
    for requirement in requirements:
        parse_event(requirement.event.text, plan.columns)
    target = real_path(Path("runs") / "campaigns" / plan.spec.name if out is None else out)
    engine = make_engine(workers, cluster)
    try:
        with bar(enabled=bool(progress), lines=progress == "lines") as watch:
            result = fly_campaign(
                plan, target, engine, resume=resume, until_width=until_width, report=report, watch=watch
            )
    except KeyboardInterrupt:
        raise KeyboardInterrupt(f"{target} has what was flown") from None
    return replace(result, judgements=tuple(judge(result.table, requirement) for requirement in requirements))


def compare(
    *targets: Flight | Scenario | str | Path,
    out: str | Path | None = None,
    cost: bool | None = None,
    progress: Progress | bool = True,
) -> Comparison | CampaignComparison:
    """Flights side by side, or two campaigns flight by flight.

    Args:
        targets: flights, run directories, or scenarios to fly, by themselves or by name; or the directories of two
            campaigns.
        out: where to write the page, its figures and its table; nothing is written where absent.
        cost: whether to study what constraints cost; None: on a page, where a constrained and an unconstrained
            controller fly the same course of at most 120 s.
        progress: as of `fly`.

    Raises:
        InputError: something is neither; nothing was flown.
        OutputError: the page cannot be written.

    Examples:
        >>> import quadsim
        >>> hover = quadsim.load("hover").replace({"duration": 1.0})
        >>> pid = hover.replace({"controller": {"type": "pid"}})
        >>> quadsim.compare(quadsim.fly(hover), quadsim.fly(pid)).to_markdown().count("|") > 10
        True
    """
    from scenarios.comparison import compare_campaigns, compare_flights, is_campaign

    target = None if out is None else real_path(out)
    if any(isinstance(each, str | Path) and is_campaign(Path(each)) for each in targets):
        if cost:
            raise ParameterError("", "--cost", True, "absent when campaigns are compared")
        return compare_campaigns([Path(str(each)) for each in targets], target)
    with reporting(progress) as report:
        return compare_flights(targets, target, cost, report)


def check(directory: str | Path) -> Reaudit:
    """Audit a finished run again from its tables, and hold its summary and its files' hashes against that.

    Raises:
        FileError: a file is missing, changed or damaged, or the summary is not what the tables say.

    Examples:
        >>> import tempfile, quadsim
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     flown = quadsim.fly(quadsim.load("hover").replace({"duration": 1.0}))
        ...     found = quadsim.check(flown.save(folder + "/run", video=False))
        >>> found.satisfied, found.notes
        (True, ())
    """
    return reaudit(Path(directory))


def film(
    directory: str | Path,
    out: str | Path | None = None,
    *,
    workers: int | None = None,
    progress: Progress | bool = True,
) -> Path:
    """Film a finished run.

    Args:
        directory: of the run.
        out: an MP4 or GIF file; `flight.mp4` in the run's directory where absent, with its hash in the summary.
        workers: rendering processes; one per usable core where absent.
        progress: as of `fly`.

    Returns:
        The file.

    Raises:
        InputError: it is no run directory, or the file has another ending.
        RenderingUnavailableError: nothing can render here.
        OutputError: the file cannot be written.
    """
    from quadsim.report.film.video import render_gif, render_video

    directory = Path(directory)
    reaudit(directory, products=False)
    path = real_path(directory / rundir.VIDEO_FILE if out is None else out)
    if workers is not None and workers < 1:
        raise ParameterError("", "--workers", workers, "at least 1")
    if path.suffix not in (".mp4", ".gif"):
        raise ParameterError("", "--out", out, "a file ending in .mp4 or .gif")
    own = path.resolve().parent == directory.resolve()
    with (
        reporting(progress) as report,
        rundir.adding(directory, path.name) if own else contextlib.nullcontext(path) as file,
    ):
        if path.suffix == ".gif":
            render_gif(directory, file, workers=workers)
        else:
            render_video(directory, file, workers=workers, progress=lambda done, total: report("video", done, total))
    return path


def replay(
    campaign: str | Path,
    flight: int | None = None,
    *,
    out: str | Path | None = None,
    video: bool = True,
    recording: bool = True,
    figures: bool = True,
    progress: Progress | bool = True,
) -> Replay:
    """Fly one flight of a finished campaign again, with everything that a run directory has.

    Args:
        campaign: its directory.
        flight: which; the worst where absent.
        out: the run directory, `runs/CAMPAIGN-N` where absent.
        video: whether to film it.
        recording: whether to write `flight.rrd`.
        figures: whether to draw it.
        progress: as of `fly`.

    Returns:
        The flight, and the columns of the campaign's table that it does not agree with, bit for bit.

    Raises:
        InputError: there is no such campaign or flight.
        OutputError: the directory cannot be written.
    """
    from scenarios.campaign.replay import recorded_flight, replay_flight

    recorded = recorded_flight(Path(campaign), flight)
    target = real_path(Path("runs") / recorded.scenario.name if out is None else out)
    outputs = Outputs(video=video, recording=recording, figures=figures)
    with reporting(progress) as report:
        return replay_flight(recorded, target, outputs, report)


def reproduce(paper: str | Path | None = None, *, progress: Progress | bool = True) -> tuple[Reproduction, ...]:
    """Fly what papers publish, and hold it against their numbers.

    Args:
        paper: a name, or a path ending in `.toml`; every paper that ships where absent.
        progress: as of `fly`.

    Returns:
        A reproduction for each paper: its `numbers`, each with `published`, `ours`, `difference` and `within`.

    Raises:
        InputError: there is no such paper, or a number of it cannot be flown.

    Examples:
        >>> import quadsim
        >>> (found,) = quadsim.reproduce("quadrotor-uav")  # doctest: +SKIP
        >>> found.within  # doctest: +SKIP
        True
    """
    from scenarios.papers.paper import load_paper
    from scenarios.papers.reproduction import reproduce_paper

    papers = [load_paper(name) for name in ([str(paper)] if paper is not None else paper_names())]
    with reporting(progress) as report:
        return tuple(reproduce_paper(each, report) for each in papers)


@contextlib.contextmanager
def reporting(progress: Progress | bool) -> Iterator[Progress]:
    """Who is called with the progress: bars on a terminal, nobody, or what the caller gave."""
    if callable(progress):
        yield progress
    elif not progress:
        yield silent
    else:
        from scenarios.commands.console import progress_bars

        with progress_bars(enabled=True) as bars:
            yield bars


def named_by(scenario: Scenario, controller: object, forces: Sequence[object] = ()) -> Scenario:
    """A scenario whose file names the controller and the forces that were passed in, by the place of their code."""
    changes: dict[str, Any] = {}
    horizon = scenario.controller.horizon
    if isinstance(controller, str):
        changes["controller"] = {"type": controller, "horizon": horizon}
    elif controller is not None:
        changes["controller"] = refer_to(controller, horizon).model_dump(exclude_none=True)
    if forces:
        specs = [*scenario.forces, *map(refer_to_force, forces)]
        changes["forces"] = [spec.model_dump(exclude_none=True) for spec in specs]
    return scenario.replace(changes) if changes else scenario


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


def make_engine(workers: int | None, cluster: str | None) -> Engine:
    """Who flies a campaign: processes of this machine, or a dask cluster."""
    if cluster is None:
        from scenarios.campaign.engine.local import LocalEngine

        return LocalEngine(workers)
    from scenarios.campaign.engine.cluster import DaskEngine

    return DaskEngine(cluster)
