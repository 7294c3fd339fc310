"""What `import quadsim` hands out of scenarios and flights; the command line calls it and prints what it returns.

Beside it: `scenarios.many_flights`, `vehicles`, `catalogue`, `benchmarks`, `self_check`, `junit`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from quadsim.controller import Controller
from quadsim.errors import FileError, InputError, ParameterError
from quadsim.flight import rundir
from quadsim.flight.summary import finding_from_json, require_inside
from quadsim.outputs import absolute, adding
from quadsim.sim.effects import Force
from quadsim.vehicle import Vehicle
from scenarios.build import build_controller
from scenarios.build import resolve as write_out
from scenarios.courses.csv_course import Csv
from scenarios.flight import Flight, Outputs
from scenarios.loading import check_parts, load_scenario
from scenarios.parts.plugin import import_plugin, make_force, make_law, refer_to
from scenarios.parts.randomness import generator
from scenarios.parts.vehicle import build_actual, build_vehicle
from scenarios.progress import Progress, reporting
from scenarios.reaudit import Reaudit, reaudit, stored_scenario
from scenarios.run import StartedFlight, fly_scenario, run_scenario
from scenarios.run import start as start_flight
from scenarios.schema.scenario import Scenario

if TYPE_CHECKING:
    from quadsim.flight.feasibility import Feasibility
    from scenarios.campaign.statistics.comparison import Comparison as CampaignComparison
    from scenarios.comparison import Comparison

Setting = Mapping[str, Any] | Sequence[str]
"""Changes of a scenario: values by dotted path, or texts `dotted.path=value` as of `--set`."""


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


def as_scenario(given: Scenario | str | Path) -> Scenario:
    """A scenario that is given itself, or by its name or file, as `load` takes it."""
    return given if isinstance(given, Scenario) else load(given)


def resolve(scenario: Scenario | str | Path) -> Scenario:
    """A scenario with every number that it leaves to its vehicle written out: a start for a file of one's own.

    A course's table is no longer held to a hash, so that another may take its place.

    Args:
        scenario: it, or its name or file.

    Raises:
        InputError: it is missing or malformed.

    Examples:
        >>> import quadsim
        >>> scenario = quadsim.resolve("hover")
        >>> scenario.vehicle.mass  # [kg]
        4.0
        >>> 'name = "hover"' in scenario.to_toml()
        True
    """
    scenario = as_scenario(scenario)
    found = write_out(scenario, build_vehicle(scenario))
    if isinstance(found.reference, Csv):
        return found.model_copy(update={"reference": replace(found.reference, sha256=None)})
    return found


def feasibility(scenario: Scenario | str | Path) -> Feasibility:
    """What a course requires of the vehicle and of the controller's bounds, tightened ones too; nothing is flown.

    Args:
        scenario: it, or its name or file.

    Returns:
        Peaks of the course (`tilt` [deg], `velocity` [m/s], `rotor_max` [rad/s] and others), the `problems` where a
        limit or a bound is passed, and all that as a `sentence`.

    Raises:
        InputError: the course cannot be built.

    Examples:
        >>> import quadsim
        >>> quadsim.feasibility("hover").problems
        ()
        >>> fast = quadsim.load("figure-eight").replace({"reference.period": 6.0, "reference.ramp": 3.0})
        >>> quadsim.feasibility(fast).problems[0]
        'roll up to 40.43 deg (bound 5)'
    """
    from scenarios.feasibility_check import report

    scenario = as_scenario(scenario)
    return report(scenario, build_vehicle(scenario))


def fitting(scenario: Scenario | str | Path) -> str:
    """At which speed, size or response time a course with `problems` would have none.

    Args:
        scenario: it, or its name or file.

    Returns:
        A sentence; empty where the course fits as it is, or at none of them down to a tenth.

    Raises:
        InputError: the course cannot be built.

    Examples:
        >>> import quadsim
        >>> fast = quadsim.load("figure-eight").replace({"reference.period": 6.0, "reference.ramp": 3.0})
        >>> quadsim.fitting(fast)
        'It would fit at 31 % of its speed.'
    """
    from scenarios.feasibility_check import fitting as find_fitting

    scenario = as_scenario(scenario)
    return find_fitting(scenario, build_vehicle(scenario))


def fly(
    scenario: Scenario | str | Path,
    *,
    controller: object = None,
    forces: Sequence[object] = (),
    out: str | Path | None = None,
    overwrite: bool = False,
    video: bool | None = None,
    recording: bool | None = None,
    figures: bool | None = None,
    progress: Progress | bool = True,
) -> Flight:
    """Fly a scenario and audit it.

    Ctrl-C, or a controller or force that raises, ends the flight in order: it is returned as far as it came, with the
    reason, and its outcome is `aborted`.

    Args:
        scenario: what is flown, or its name or file.
        controller: flies it, instead of the scenario's: a class, called as MyLaw(vehicle, period=..., horizon=...)
            and with a method `step(now, state, reference)`; a function `law(now, state, reference)` that gives four
            rotor speeds [rad/s]; an object with such a `step`; or a text `package.module:Class`.  Further arguments of
            a class through `functools.partial`.
        forces: forces of one's own that act on the vehicle, besides the scenario's effects: functions
            `force(time, state)`, called once per physics step, that give force x, y, z in the world frame [N] and
            torque in the body frame [N m]; or classes called as MyForce(vehicle, rng=...) whose objects are called so.
        out: the run directory to write; nothing is written where absent (`Flight.save` can).
        overwrite: whether to replace an earlier output there.
        video: whether to film it, where it is written; None for where that can be done, True to raise where it fails.
        recording: whether to write `flight.rrd`, where it is written; likewise.
        figures: whether to draw it, where it is written; likewise.
        progress: called with (what, done, total); True for bars on a terminal, False for none.

    Raises:
        InputError: the scenario cannot be flown, or the controller cannot be set up.
        RenderingUnavailableError: a video is asked for and cannot be made; nothing was flown.
        OutputError: the directory cannot be written, and nothing was flown; or what was asked for failed: the tables
            and the summary are there then.

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
    referring, law, own = _set_up(scenario, controller, forces)
    with reporting(progress) as report:
        if out is None:
            return fly_scenario(referring, report, law, own)
        outputs = Outputs(video=video, recording=recording, figures=figures)
        return run_scenario(referring, absolute(out), outputs, report, law, own, overwrite=overwrite)


def start(
    scenario: Scenario | str | Path,
    *,
    controller: object = None,
    forces: Sequence[object] = (),
    live: bool = False,
    recorded: bool = True,
) -> StartedFlight:
    """Build everything that a flight needs, for a script of one's own to fly it period by period.

    Args:
        scenario: what is flown, or its name or file.
        controller: as of `fly`.
        forces: as of `fly`.
        live: whether anything may be applied to it that can happen to its vehicle; else what its scenario's events are
            of, and set-points, stalls, rotor losses and lags, and other controllers.
        recorded: whether all periods are recorded, some 10 kB each; without them there is no `StartedFlight.flight`.

    Raises:
        InputError: the scenario cannot be flown, or the controller cannot be set up.

    Examples:
        >>> import quadsim
        >>> with quadsim.start("hover") as started:
        ...     while started.k < 20:
        ...         sample = started.step()
        ...     started.flight().outcome
        'satisfied'
    """
    return start_flight(*_set_up(scenario, controller, forces), live=live, recorded=recorded)


def _set_up(
    scenario: Scenario | str | Path, controller: object, forces: Sequence[object]
) -> tuple[Scenario, Controller | None, list[Force] | None]:
    """A scenario that refers to what was passed in, checked, and these parts as the closed loop takes them."""
    scenario = as_scenario(scenario)
    referring, law, own = named_by(scenario, controller, forces), None, None
    if controller is not None and not isinstance(controller, str):
        spec = refer_to(controller, scenario.controller.horizon)
        law = make_law(controller, spec, build_vehicle(scenario), scenario.control_period)
    if forces:
        vehicle = build_actual(scenario, build_vehicle(scenario))
        rng = generator(scenario.seed, "forces")
        named = [(import_plugin(spec), spec) for spec in scenario.forces]
        named += zip(forces, referring.forces[len(named) :], strict=True)
        own = [make_force(force, spec, vehicle, rng) for force, spec in named]
    check_parts(referring)
    return referring, law, own


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
        vehicle=Vehicle(**run.summary["vehicle"]),
        log=run.log,
        findings=tuple(finding_from_json(entry) for entry in run.summary["constraints"]),
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
    scenario = as_scenario(scenario)
    return build_controller(scenario, build_vehicle(scenario))


def compare(
    *targets: Flight | Scenario | str | Path,
    out: str | Path | None = None,
    overwrite: bool = False,
    progress: Progress | bool = True,
) -> Comparison | CampaignComparison:
    """Flights side by side, or two campaigns flight by flight.

    Args:
        targets: flights, run directories, or scenarios to fly, by themselves or by name; or the directories of two
            campaigns.
        out: where to write the page, its figures and its table; nothing is written where absent.
        overwrite: whether to replace an earlier output there.
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

    target = None if out is None else absolute(out)
    if any(isinstance(each, str | Path) and is_campaign(Path(each)) for each in targets):
        return compare_campaigns([Path(str(each)) for each in targets], target, overwrite=overwrite)
    with reporting(progress) as report:
        return compare_flights(targets, target, report, overwrite=overwrite)


def check(directory: str | Path) -> Reaudit:
    """Audit a finished run again from its tables, and hold its summary and its files' hashes against that.

    It finds damage and mistakes: integrity, not authenticity.  Who writes every file anew can make them agree.

    Raises:
        FileError: a file is missing, changed or damaged, or the summary contradicts the tables.

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
    overwrite: bool = False,
    workers: int | None = None,
    progress: Progress | bool = True,
) -> Path:
    """Film a finished run.

    Args:
        directory: of the run.
        out: an MP4 or GIF file; `flight.mp4` in the run's directory where absent, replacing an earlier one.
        overwrite: whether to replace another file that is there.
        workers: rendering processes; one per usable core where absent.
        progress: as of `fly`.

    Returns:
        The file.

    Raises:
        InputError: it is no run directory, or the file has another ending.
        RenderingUnavailableError: nothing can render here.
        OutputError: the file cannot be written.

    Examples:
        >>> import tempfile, quadsim
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     flown = quadsim.fly(quadsim.load("hover").replace({"duration": 0.2}))
        ...     file = quadsim.film(flown.save(folder + "/run", video=False), workers=1)
        ...     file.name, file.stat().st_size > 1000
        ('flight.mp4', True)
    """
    from quadsim.report.film.video import render_gif, render_video

    reaudit(Path(directory), products=False)
    directory = absolute(directory)
    path = absolute(directory / rundir.VIDEO_FILE if out is None else out)
    if workers is not None and workers < 1:
        raise ParameterError("", "--workers", workers, "at least 1")
    if path.suffix not in (".mp4", ".gif"):
        raise ParameterError("", "--out", out, "a file ending in .mp4 or .gif")

    def render(file: Path, *, overwrite: bool) -> None:
        if path.suffix == ".gif":
            render_gif(directory, file, workers=workers, overwrite=overwrite)
            return
        watch = lambda done, total: report("video", done, total)  # noqa: E731
        render_video(directory, file, workers=workers, progress=watch, overwrite=overwrite)

    with reporting(progress) as report:
        if path.parent != directory:
            render(path, overwrite=overwrite)
        else:  # a product of the run, which its summary lists
            with adding(directory, products={path.name: "made"}) as folder:
                render(folder / path.name, overwrite=False)
    return path


def view(run: str | Path, *, web: bool = False) -> None:
    """Open a run's recording in the rerun viewer; returns when the viewer is closed or Ctrl-C is pressed.

    Args:
        run: directory of a run, or a file ending in `.rrd`.
        web: whether to serve it to a browser, to this machine alone, instead.

    Raises:
        FileError: there is no such recording.
        ViewerUnavailableError: there is no display, or the viewer failed.

    Examples:
        >>> import quadsim
        >>> try:
        ...     quadsim.view("runs/not-flown-yet")
        ... except quadsim.QuadsimError as error:
        ...     print(error)
        runs/not-flown-yet: no such run or recording
    """
    from quadsim.report.recording import open_viewer

    path = Path(run)
    recording = path / rundir.RECORDING_FILE if path.is_dir() else path
    if not path.exists():
        raise FileError(path, "no such run or recording")
    if path.is_dir():
        require_inside(path)
    if not recording.is_file():
        raise FileError(path, f"has no {rundir.RECORDING_FILE}; run the scenario again without --no-recording")
    if recording.suffix != ".rrd":
        raise FileError(path, "is no recording; give a run directory or a file ending in .rrd")
    open_viewer(recording, web=web)


def named_by(scenario: Scenario, controller: object, forces: Sequence[object] = ()) -> Scenario:
    """A scenario whose file names the controller and the forces that were passed in, by the place of their code."""
    changes: dict[str, Any] = {}
    horizon = scenario.controller.horizon
    if isinstance(controller, str):
        changes["controller"] = {"type": controller, "horizon": horizon}
    elif controller is not None:
        changes["controller"] = refer_to(controller, horizon).model_dump(exclude_none=True)
    if forces:
        specs = [*scenario.forces, *(refer_to(force) for force in forces)]
        changes["forces"] = [spec.model_dump(exclude_none=True, exclude={"horizon"}) for spec in specs]
    return scenario.replace(changes) if changes else scenario
