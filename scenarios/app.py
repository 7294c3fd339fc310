"""The functions of quadsim: the API of `import quadsim` and the commands of the command line.

A function under `@app.command` is both.  Only `scenarios.cli` prints; it shows the results (`scenarios.results`).
Heavy imports are inside the functions, so that importing this module is fast.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import replace
from functools import partial
from glob import escape, glob
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, TypeAlias

from cyclopts import App, Parameter

from quadsim import __version__
from quadsim.assets import vehicle_names
from quadsim.errors import FileError, InputError, OutputError, ParameterError
from scenarios.catalogue import campaign_names, paper_names, scenario_names, tuning_names

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from mpc.ocp import Problem
    from mpc.pilot import Pilot
    from quadsim.controller import AutopilotLoop
    from quadsim.flight.feasibility import Feasibility
    from quadsim.vehicle import Vehicle
    from scenarios.campaign.campaign import CampaignResult, Replay
    from scenarios.campaign.paired import PairedComparison
    from scenarios.campaign.sweep import Sweep
    from scenarios.catalogue import Catalogue
    from scenarios.design.vehicle_report import VehicleReport
    from scenarios.flight import Flight
    from scenarios.flight_comparison import FlightComparison
    from scenarios.identify.report import IdentifiedVehicle
    from scenarios.papers.reproduction import Reproductions
    from scenarios.progress import Progress
    from scenarios.reaudit import Reaudit
    from scenarios.results import Document, Listing, ScenarioFile
    from scenarios.rollout import Rollout
    from scenarios.schema.scenario import Scenario
    from scenarios.tuning.tuning import TuningResult

    File: TypeAlias = str | Path
    Files: TypeAlias = Sequence[File]
    PaperName: TypeAlias = File
    TuningName: TypeAlias = File
    VehicleName: TypeAlias = File
    ScenarioName: TypeAlias = Scenario | File
    CampaignName: TypeAlias = ScenarioName
    Target: TypeAlias = Flight | ScenarioName
    Changes: TypeAlias = Mapping[Any, Any] | Sequence[str]
    Names: TypeAlias = Sequence[str]
    Whole = int
    Flag = bool
    UserCode = object
    UserForces = Sequence[object]
    UserReference: TypeAlias = Callable[[float], ArrayLike] | None
    Fields: TypeAlias = Mapping[str, Any] | None
    Draws: TypeAlias = Sequence[Mapping[str, Any]]
    Watched: TypeAlias = Progress | bool
    Flown: TypeAlias = Callable[[Flight], object] | None
else:  # as cyclopts reads them: it resolves all annotations where a command is declared

    def _one_of(names: Any) -> Any:
        def completions(context: Any) -> list[str]:
            return [*names(), *glob(f"{escape(context.incomplete or '.')}*")]  # noqa: PTH207  # as it was typed

        return Annotated[str, Parameter(completer=completions)]

    def _whole(_: type, tokens: Sequence[Any]) -> int:
        text = tokens[0].value
        if not text.lstrip("+-").isdecimal():  # by itself cyclopts rounds 3.7
            raise ValueError(f"must be a whole number; got {text!r:.100}")
        return int(text)

    PairedComparison = CampaignResult = Catalogue = FlightComparison = Document = Flight = Listing = Reaudit = Any
    Replay = Reproductions = ScenarioFile = TuningResult = VehicleReport = IdentifiedVehicle = Any
    File, Files = Path, Sequence[Path]
    VehicleName = _one_of(vehicle_names)
    Target = ScenarioName = _one_of(scenario_names)
    CampaignName, PaperName = _one_of(campaign_names), _one_of(paper_names)
    TuningName = _one_of(tuning_names)
    Changes = Annotated[Sequence[str], Parameter(name="--set")]
    Names = Annotated[Sequence[str], Parameter(name="--name")]
    Whole = Annotated[int, Parameter(converter=_whole)]
    Flag = Annotated[bool, Parameter(negative="")]
    UserCode = UserForces = UserReference = Fields = Draws = Watched = Flown = Annotated[Any, Parameter(parse=False)]

app: Final = App(
    name="quadsim",
    help="Fly model predictive controllers of quadrotors in MuJoCo; record, film and audit every flight.",
    help_epilogue="exit status: 0 done; 1 a required constraint does not hold, or the flight was aborted or "
    "interrupted; 2 wrong input",
    help_format="plaintext",
    default_parameter=Parameter(show_default=False, negative_iterable=(), allow_repeating=True),
    version=f"quadsim {__version__}",
)
_log: Final = logging.getLogger("quadsim")


def _examples(*lines: str) -> str:
    """Return the examples at the end of a command's help."""
    return "\n  ".join(["examples:", *lines])


# --- scenarios -----------------------------------------------------------------------------------------------------


def load(name: str | Path, changes: Changes = ()) -> Scenario:
    """Load a scenario from the library or a file, and check it together with its vehicle and course.

    Args:
        name: a library name, or a path ending in `.toml`.
        changes: fields to replace: values by dotted path, as in `Scenario.replace`, or texts, as after `--set`.

    Raises:
        InputError: the scenario is missing, malformed, or cannot be flown with these changes.

    Examples:
        >>> import quadsim
        >>> scenario = quadsim.load("paper-constrained", {"controller.horizon": 30})
        >>> scenario.controller.horizon, scenario.duration
        (30, 60.0)
    """
    from scenarios.loading import load_scenario

    return load_scenario(name, changes)


def feasibility(scenario: ScenarioName) -> Feasibility:
    """Compare a course with the vehicle's limits and the controller's bounds (also the tightened ones), without flying.

    Args:
        scenario: the scenario, or its name or file.

    Returns:
        The peaks of the course, such as `tilt` [deg]; `problems`, the limits and bounds that it exceeds; a `sentence`.

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
    from scenarios import feasibility_check, loading

    return feasibility_check.report(loading.assemble(scenario))


def make_controller(scenario: ScenarioName) -> Pilot:
    """Return the controller of a scenario, ready for `reset` and `step`, without a simulator.

    Its `law` is the control law itself, around which there may be a fallback contract and an autopilot.

    Raises:
        InputError: the controller cannot be built from these numbers.

    Examples:
        >>> import numpy as np
        >>> import quadsim
        >>> law = quadsim.make_controller("paper-constrained")
        >>> law.reset(np.full(4, 200.0))
        >>> command = law.step(quadsim.StepInputs(), np.zeros(12), np.zeros((law.horizon, 4)))
        >>> command.speeds.shape, command.plan.shape
        ((4,), (50, 4))
    """
    from scenarios.loading import assemble

    return assemble(scenario).controller()


def problem(scenario: ScenarioName) -> Problem:
    """Return the optimal control problem of a scenario's controller: matrices, weights and constraints as numpy arrays.

    `model` has A (n, n), B (n, 4), u_bar (4,) [rad/s]; `objective` C_r, Q_y, Q_u; `rows` the constraints, lower <=
    C x + D u + E (u - u_before) <= upper.  `condensed()` and `qp(state, reference, u_before)` give the QP.

    The problem of `robust` has its soft and tightened rows, weights of moves and rotor lag.  It starts where its delay
    ends, in axes turned by the yaw with `heading`; an estimated disturbance moves its `equilibrium`.  Half-spaces of
    `controller.avoidance` differ from period to period and are left out.

    Raises:
        InputError: the controller solves no linear MPC problem: `nonlinear`, `lqr`, `pid`, `geometric`, or yours.

    Examples:
        >>> import quadsim
        >>> problem = quadsim.problem("paper-constrained")
        >>> problem.model.A.shape, problem.model.B.shape, problem.horizon
        ((12, 12), (12, 4), 50)
        >>> problem.rows.names[0], problem.rows.upper.shape
        ('outputs', (50, 10))
    """
    from scenarios.loading import assemble

    return assemble(scenario).problem()


# --- flights -------------------------------------------------------------------------------------------------------


def fly(
    scenario: ScenarioName,
    *,
    controller: object = None,
    forces: Sequence[object] = (),
    reference: UserReference = None,
    autopilot: AutopilotLoop | None = None,
    progress: Watched = True,
) -> Flight:
    """Fly a scenario and audit it, in memory; `run` and `Flight.save` write its run directory.

    If you press Ctrl-C, or a controller or force raises, the flight ends early: `fly` returns it up to that time, with
    the outcome `aborted` and the reason.

    Args:
        scenario: the scenario, or its name or file.
        controller: replaces the scenario's controller: a class, called as MyLaw(vehicle, period=..., horizon=...)
            and with a method `step(now, state, reference)`; a function `law(now, state, reference)` that returns four
            rotor speeds [rad/s]; an object with such a `step`; or a text `package.module:Class`.  Further arguments of
            a class through `functools.partial`.
        forces: user-defined forces on the vehicle, in addition to the scenario's effects: functions
            `force(time, state)`, called once per physics step, that return the force x, y, z in the world frame [N]
            and the torque in the body frame [N m]; or classes, called as MyForce(vehicle, rng=...), whose objects
            are such functions.
        reference: replaces the course and its filter; the scenario's constraints stay.  A function `f(t)` of time
            [s] that returns x, y, z [m] and yaw [rad].  It is called before the flight, for all control
            instants up to the end of the last preview.  A run directory keeps these samples in `reference.csv`; its
            `scenario.toml` reproduces the flight bit for bit.
        autopilot: flies in place of the built-in autopilot, for a controller that commands thrust and body rates: an
            inner loop (`quadsim.controller.AutopilotLoop`) that takes targets, such as a firmware's.  The file does not
            name it.
        progress: True shows a bar on a terminal, or a line every ten seconds elsewhere; False shows nothing; a function
            is called with (activity, done, total).

    Raises:
        InputError: the scenario cannot be flown, or the controller or the reference cannot be set up.

    Examples:
        >>> import quadsim
        >>> scenario = quadsim.load("hover").replace({"duration": 1.0})
        >>> quadsim.fly(scenario).satisfied
        True
        >>> quadsim.fly(scenario, reference=lambda t: [0.0, 0.0, 2.0 * t, 0.0]).reference["z"][-1].round(3)
        np.float64(1.9)
        >>> def full_throttle(now, state, reference):
        ...     return [300.0] * 4
        >>> quadsim.fly(scenario, controller=full_throttle).state["vz"][-1].round()
        np.float64(13.0)
    """
    from scenarios.progress import reporting

    with reporting(progress) as report:
        begun = start(scenario, controller=controller, forces=forces, reference=reference, autopilot=autopilot)
        return begun.fly(report)


@app.command(
    help_epilogue=_examples(
        "quadsim run paper-constrained", "quadsim run hover --set controller.horizon=30 --out runs/short --no-video"
    )
)
def run(
    scenario: ScenarioName,
    /,
    *,
    out: File | None = None,
    overwrite: Flag = False,
    changes: Changes = (),
    seed: Whole | None = None,
    video: bool | None = None,
    recording: bool | None = None,
    figures: bool | None = None,
    controller: UserCode = None,
    forces: UserForces = (),
    reference: UserReference = None,
    progress: Watched = True,
    flown: Flown = None,
) -> Flight:
    """Fly one scenario and write its run directory.

    The tables and the summary are written first, so a failure in the figures or the video does not lose the flight.

    Args:
        scenario: library name, or path to a TOML file.
        out: run directory (default: runs/SCENARIO, or the next free name).
        overwrite: replace an earlier output, if its summary.json lists every file in the directory.
        changes: replace a field of the scenario, e.g. --set controller.horizon=30; may be repeated.
        seed: replace the seed of everything random in the scenario.
        video: film the flight (default: if possible).
        recording: write flight.rrd for the rerun viewer (default: if possible).
        figures: plot the flight (default: if possible).
        controller: as in `fly`.
        forces: as in `fly`.
        reference: as in `fly`.
        progress: as in `fly`.
        flown: called with the flight as soon as its tables are written, before figures, recording and video.

    Raises:
        InputError: the scenario cannot be flown, or the controller or the reference cannot be set up.
        RenderingUnavailableError: a video is requested but cannot be rendered; nothing was flown.
        OutputError: the directory, or a requested product, cannot be written; in the second case its `result` is the
            flight.

    Examples:
        >>> import tempfile, quadsim
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     flight = quadsim.run("hover", out=folder + "/run", changes={"duration": 0.5}, video=False)
        ...     flight.outcome, flight.directory.name
        ('satisfied', 'run')
    """
    from scenarios import loading, user_code
    from scenarios.feasibility_check import hover_notes
    from scenarios.flight import require_rendering
    from scenarios.progress import reporting
    from scenarios.rollout import Rollout

    if video:
        require_rendering()
    parts = user_code.set_up(loading.assemble(scenario, changes, seed), controller, forces, reference)
    products = {"video": video, "recording": recording, "figures": figures}
    for note in hover_notes(parts[0]):
        _log.info(note)
    with run_directory(parts[0].scenario.name, out, overwrite=overwrite) as directory:
        with reporting(progress) as report:
            flight = replace(Rollout(*parts).fly(report), directory=directory)
        _write(flight, directory, products, overwrite=overwrite, progress=progress, flown=flown)
    return flight


def _write(
    flight: Flight,
    directory: Path,
    products: Mapping[str, bool | None],
    *,
    overwrite: bool,
    progress: Watched,
    flown: Flown,
) -> None:
    """Write the tables, call `flown`, and add the products."""
    from scenarios.progress import reporting

    more = flight.write_tables(directory, overwrite=overwrite)
    if flown is not None:
        flown(flight)
    if more:
        with reporting(progress) as report:
            try:
                flight.add_products(directory, progress=report, **products)
            except OutputError as error:
                if error.path.parent == directory:  # a product that was requested explicitly
                    error.result = flight
                raise


def run_directory(name: str, out: str | Path | None, *, overwrite: bool) -> AbstractContextManager[Path]:
    """Reserve a run directory: `out`, or `runs/NAME`, or the next free name unless `overwrite`."""
    from quadsim.outputs import reserving

    if out is not None:
        return reserving(out, overwrite=overwrite)
    return reserving(Path("runs") / name, overwrite=overwrite, free=not overwrite)


def start(
    scenario: ScenarioName,
    *,
    controller: object = None,
    forces: Sequence[object] = (),
    reference: UserReference = None,
    autopilot: AutopilotLoop | None = None,
    live: bool = False,
    recorded: bool = True,
) -> Rollout:
    """Build a flight for a script that flies it period by period.

    Args:
        scenario: the scenario, or its name or file.
        controller: as in `fly`.
        forces: as in `fly`.
        reference: as in `fly`; after the scenario's end and its preview it keeps its last sample.
        autopilot: as in `fly`.
        live: whether events of every kind may be applied; otherwise only the kinds among the scenario's events, and
            set-points, stalls, rotor losses, rotor lags and controller changes.
        recorded: whether every period is recorded, at about 10 kB; required by `Rollout.flight`.

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
    from scenarios import loading, user_code
    from scenarios.rollout import Rollout

    parts = user_code.set_up(loading.assemble(scenario), controller, forces, reference, autopilot)
    return Rollout(*parts, live=live, recorded=recorded)


def read(directory: str | Path) -> Flight:
    """Read a finished run: its log at the scenario's `log_rate`, and its recorded audit.

    Args:
        directory: run directory, written by `quadsim run` or `Flight.save`.

    Raises:
        FileError: the directory is not a run directory, or a file is missing or damaged.

    Examples:
        >>> import tempfile, quadsim
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     flight = quadsim.fly(quadsim.load("hover").replace({"duration": 1.0}))
        ...     read = quadsim.read(flight.save(folder + "/run", video=False))
        >>> bool((read.command == flight.command).all()), read.outcome
        (True, 'satisfied')
    """
    from quadsim.flight.rundir import findings_of
    from quadsim.vehicle import Vehicle
    from scenarios.assembly import Assembly
    from scenarios.flight import Flight
    from scenarios.reaudit import stored_run, stored_scenario

    directory = Path(directory)
    run = stored_run(directory)
    law = run.summary["controller"]
    return Flight(
        assembly=Assembly(stored_scenario(directory), Vehicle(**run.summary["vehicle"])),
        log=run.log,
        findings=findings_of(run.summary),
        controller=law["name"],
        solver=law["solver"],
        simulate_s=run.summary["wall_s"]["simulate"],
        tallies={},
        directory=directory,
        recorded=run.summary,
    )


@app.command(
    help_epilogue=_examples(
        "quadsim check paper-constrained", "quadsim check runs/paper-constrained --junit verdicts.xml"
    )
)
def check(
    target: ScenarioName,
    /,
    *,
    changes: Changes = (),
    seed: Whole | None = None,
    junit: File | None = None,
    progress: Watched = True,
) -> Reaudit:
    """Audit a scenario (flown first) or a finished run; exit 1 if a constraint fails.

    A finished run is audited again from its tables; the result is compared with its summary, and its files with
    their hashes.  This finds damage and mistakes, not forgery: someone who rewrites every file can make them agree.

    Args:
        target: library name, TOML file, or run directory.
        changes: replace a field of the scenario, e.g. --set controller.horizon=30; may be repeated.
        seed: replace the seed of everything random in the scenario.
        junit: also write the verdicts as JUnit XML.
        progress: as in `fly`.

    Raises:
        InputError: the scenario cannot be flown.
        FileError: a file is missing, changed or damaged, or the summary contradicts the tables.

    Examples:
        >>> import tempfile, quadsim
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     flight = quadsim.fly(quadsim.load("hover").replace({"duration": 1.0}))
        ...     audited = quadsim.check(flight.save(folder + "/run", video=False))
        >>> audited.satisfied, audited.notes
        (True, ())
    """
    from scenarios import loading, reaudit
    from scenarios.campaign.store import is_campaign
    from scenarios.junit import junit_file, write_junit
    from scenarios.progress import reporting
    from scenarios.results import after
    from scenarios.rollout import Rollout

    file = None if junit is None else junit_file(junit)
    if isinstance(target, str | Path) and Path(target).is_dir():
        if changes or seed is not None:
            option, value = ("--set", changes) if changes else ("--seed", seed)
            raise ParameterError("", option, value, "absent when a finished run is checked")
        if is_campaign(Path(target)):
            raise InputError(
                f"{target} is a campaign, not a run: quadsim replay {target} --worst makes a run of its worst flight; "
                "quadsim campaign --require judges them all"
            )
        audited = reaudit.reaudit(Path(target))
        for note in audited.notes:
            _log.info("%s: %s", target, note)
    else:
        assembly = loading.assemble(target, changes, seed)
        with reporting(progress) as report:
            flight = Rollout(assembly).fly(report)
        audited = reaudit.Reaudit(summary=dict(flight.summary), findings=flight.findings, satisfied=flight.satisfied)
    if file is not None:
        with after(audited, file):
            write_junit(audited, file)
    return audited


@app.command(
    help_epilogue=_examples(
        "quadsim compare paper-unconstrained paper-constrained --out runs/comparison",
        "quadsim compare runs/mine runs/other --name mine --name theirs --markdown",
    )
)
def compare(
    *targets: Target,
    out: File | None = None,
    overwrite: Flag = False,
    names: Names = (),
    markdown: Flag = False,
    constraints: Target | None = None,
    video: bool | None = None,
    recording: bool | None = None,
    figures: bool | None = None,
    progress: Watched = True,
) -> FlightComparison | PairedComparison | Document:
    """Compare flights, or two campaigns flight by flight: table, figures, HTML page.

    With `out`, scenarios are flown into run directories below OUT-runs, beside the page.

    Args:
        targets: run directories, scenarios to fly, or the directories of two campaigns.
        out: directory for the page, its figures and its table.
        overwrite: replace an earlier output, if its summary.json lists every file in the directory.
        names: name of a column, once for each target and in their order (default: scenario, and what tells its flights
            apart).
        markdown: print the table as Markdown.
        constraints: one of the targets, whose constraints and tolerances all are audited against, from their tables.
        video: film the scenarios that it flies (default: if possible).
        recording: write their flight.rrd for the rerun viewer (default: if possible).
        figures: plot them (default: if possible).
        progress: as in `fly`.

    Raises:
        InputError: a target is neither a run, a scenario nor a campaign, or the names are wrong; nothing was flown.
        OutputError: the page cannot be written.
        RenderingUnavailableError: a video is requested but cannot be rendered; nothing was flown.

    Examples:
        >>> import quadsim
        >>> hover = quadsim.load("hover").replace({"duration": 1.0})
        >>> pid = hover.replace({"controller": {"type": "pid"}})
        >>> quadsim.compare(quadsim.fly(hover), quadsim.fly(pid)).to_markdown().count("|") > 10
        True
    """
    from quadsim.outputs import absolute
    from scenarios.flight_comparison import compare_campaigns, compare_flights, is_campaign
    from scenarios.progress import reporting
    from scenarios.results import Document

    if not targets:
        raise InputError("compare needs runs, scenarios, or two campaigns")
    page = None if out is None else absolute(out)
    of_campaigns = any(isinstance(target, str | Path) and is_campaign(Path(target)) for target in targets)
    products = {"video": video, "recording": recording, "figures": figures}
    if (page is None or of_campaigns) and (asked := [name for name, wanted in products.items() if wanted]):
        rule = "absent where campaigns are compared" if of_campaigns else "absent without --out: nothing is written"
        raise ParameterError("", f"--{asked[0]}", True, rule)
    compared: FlightComparison | PairedComparison
    if of_campaigns:
        campaigns = [Path(str(target)) for target in targets]
        compared = compare_campaigns(campaigns, page, overwrite=overwrite, names=names, constraints=constraints)
    else:
        options: dict[str, Any] = {"names": names, "products": products, "constraints": constraints}
        with reporting(progress) as report:
            compared = compare_flights(targets, page, report, overwrite=overwrite, **options)
    return Document(compared.to_markdown() + "\n", compared.to_json()) if markdown else compared


@app.command(
    name="video",
    help_epilogue=_examples(
        "quadsim video runs/paper-constrained", "quadsim video runs/paper-constrained --out flight.gif"
    ),
)
def film(
    directory: File,
    /,
    *,
    out: File | None = None,
    overwrite: Flag = False,
    workers: Whole | None = None,
    progress: Watched = True,
) -> Path:
    """Film a finished run.

    Args:
        directory: run directory.
        out: MP4 or GIF file (default: flight.mp4 in the run directory, replacing an earlier one).
        overwrite: replace an existing file.
        workers: rendering processes (default: one per core).
        progress: as in `fly`.

    Returns:
        Path of the file.

    Raises:
        InputError: the directory is not a run directory, or the file ends in neither .mp4 nor .gif.
        RenderingUnavailableError: this machine cannot render.
        OutputError: the file cannot be written.

    Examples:
        >>> import tempfile, quadsim
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     flight = quadsim.fly(quadsim.load("hover").replace({"duration": 0.2}))
        ...     file = quadsim.film(flight.save(folder + "/run", video=False), workers=1)
        ...     file.name, file.stat().st_size > 1000
        ('flight.mp4', True)
    """
    from quadsim.flight import rundir
    from quadsim.outputs import absolute, adding
    from quadsim.report.film.video import render_gif, render_video
    from scenarios.progress import reporting
    from scenarios.reaudit import reaudit

    reaudit(Path(directory), products=False)
    directory = absolute(directory)
    path = absolute(directory / rundir.VIDEO_FILE if out is None else out)
    if workers is not None and workers < 1:
        raise ParameterError("", "--workers", workers, "at least 1")
    if path.suffix not in (".mp4", ".gif"):
        raise ParameterError("", "--out", out, "a file ending in .mp4 or .gif")
    with reporting(progress) as report:
        make = render_video if path.suffix == ".mp4" else render_gif
        render = partial(make, directory, workers=workers, progress=partial(report, "video"))
        if path.parent != directory:
            render(path, overwrite=overwrite)
        else:  # a product of the run, which its summary lists
            with adding(directory, products={path.name: "made"}) as folder:
                render(folder / path.name, overwrite=False)
    return path


@app.command(
    help_epilogue=_examples("quadsim view runs/paper-constrained", "quadsim view runs/paper-constrained --web")
)
def view(run: File, /, *, web: Flag = False) -> None:
    """Open a run's recording in the rerun viewer.

    It returns when you close the viewer or press Ctrl-C.

    Args:
        run: run directory or .rrd file.
        web: serve the viewer to a browser on this machine instead.

    Raises:
        FileError: the recording does not exist.
        ViewerUnavailableError: there is no display, or the viewer failed.

    Examples:
        >>> import quadsim
        >>> try:
        ...     quadsim.view("runs/not-flown-yet")
        ... except quadsim.QuadsimError as error:
        ...     print(error)
        runs/not-flown-yet: no such run or recording
    """
    from quadsim.flight import rundir
    from quadsim.flight.rundir import require_inside
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
        raise FileError(path, "is not a recording; give a run directory or a file ending in .rrd")
    open_viewer(recording, web=web)


@app.command(help_epilogue=_examples("quadsim live", "quadsim live robust --against paper-constrained"))
def live(
    scenario: ScenarioName = "playground",
    /,
    *,
    against: ScenarioName | None = None,
    out: File | None = None,
    overwrite: Flag = False,
    script: File | None = None,
    port: Whole = 0,
    host: str = "127.0.0.1",
    browser: bool = True,
    video: Flag = False,
    changes: Changes = (),
    seed: Whole | None = None,
) -> Document:
    """Fly interactively in the browser: push, change every setting, save the flight as a scenario.

    Args:
        scenario: library name, or path to a TOML file; or directory of a run to continue (default: playground, which
            is made for sessions).
        against: scenario whose controller flies a second vehicle beside the first.
        out: run directory (default: runs/SCENARIO-live, or the next free name).
        overwrite: replace an earlier output, if its summary.json lists every file in the directory.
        script: TOML file of timed inputs, flown without a browser and as fast as possible.
        port: port to listen on (default: any free port).
        host: address to listen on (default: 127.0.0.1, this machine only); others only on a network that you trust.
        browser: open the browser.
        video: film the session.
        changes: replace a field of the scenario, e.g. --set controller.horizon=30; may be repeated.
        seed: replace the seed of everything random in the scenario.

    Examples:
        >>> import quadsim
        >>> quadsim.live("hover", port=70_000)
        Traceback (most recent call last):
        quadsim.errors.ParameterError: --port must be from 1 to 65535, or 0 for any that is free; got 70000
    """
    from scenarios.live.serving import fly_live
    from scenarios.loading import load_scenario
    from scenarios.reaudit import reaudit, stored_scenario

    onward = isinstance(scenario, str | Path) and Path(scenario).is_dir()
    if onward:
        if changes or seed is not None:
            raise ParameterError("", "--set" if changes else "--seed", "given", "absent when a run is continued")
        reaudit(Path(str(scenario)), products=False)
        scenario = stored_scenario(Path(str(scenario)))
    flown = load_scenario(scenario, changes, seed)
    other = None if against is None else load_scenario(against).controller
    place = {"port": port, "host": host, "browser": browser}
    return fly_live(flown, other, script, onward=onward, out=out, overwrite=overwrite, video=video, **place)


# --- many flights --------------------------------------------------------------------------------------------------


def sweep(
    scenario: ScenarioName,
    values: Mapping[Any, Sequence[Any]],
    *,
    controller: object = None,
    forces: Sequence[object] = (),
    workers: int | None = None,
    progress: bool = True,
) -> Sweep:
    """Fly a scenario for every combination of the values of some fields, always with the scenario's seed.

    Args:
        scenario: the scenario, or its name or file.
        values: values to try, by dotted path; the fields of a tuple of paths vary together, with one common value or a
            tuple of one value per field.
        controller: as in `fly`; a class or a function of a module that other processes can import.
        forces: as in `fly`; importable, like the controller.
        workers: number of processes (default: one per usable core).
        progress: as in `fly`.

    Returns:
        A table with a row per flight, in the order of the combinations, the last field varying fastest.

    Raises:
        InputError: a value is not allowed, or the controller cannot be sent to other processes.

    Examples:
        >>> import quadsim
        >>> scenario = quadsim.load("hover").replace({"duration": 1.0})
        >>> table = quadsim.sweep(scenario, {"controller.horizon": [20, 40]}, workers=1)
        >>> table["controller.horizon"].tolist(), table["verdict"].tolist()
        ([20.0, 40.0], ['satisfied', 'satisfied'])
        >>> both = ("controller.output_bounds.roll", "controller.output_bounds.pitch")
        >>> tilt = quadsim.sweep(scenario, {both: [[-2.0, 2.0], [-5.0, 5.0]]}, workers=1)
        >>> tilt["controller.output_bounds.pitch.1"].tolist(), tilt["margin.roll"].round(3).tolist()
        ([2.0, 5.0], [2.0, 5.0])
    """
    from scenarios.campaign.sweep import fly_sweep
    from scenarios.loading import load_scenario
    from scenarios.progress import reporting
    from scenarios.user_code import importable

    with reporting(progress) as report:
        return fly_sweep(importable(load_scenario(scenario), controller, forces), values, workers, report)


@app.command(
    help_epilogue=_examples(
        "quadsim campaign paper-robustness --flights 100",
        "quadsim campaign mine.toml --resume --require 'P(violation) < 0.01 @ 95%'",
    )
)
def campaign(
    campaign: CampaignName,
    /,
    *,
    out: File | None = None,
    overwrite: Flag = False,
    workers: Whole | None = None,
    cluster: str | None = None,
    resume: Flag = False,
    flights: Whole | None = None,
    until_width: float | None = None,
    require: Sequence[str] = (),
    report: bool = True,
    junit: File | None = None,
    changes: Changes = (),
    seed: Whole | None = None,
    vary: Draws = (),
    fields: Fields = None,
    controller: UserCode = None,
    forces: UserForces = (),
    progress: Watched = True,
) -> CampaignResult:
    """Fly a scenario many times with randomly drawn parameters.

    Args:
        campaign: campaign's name, or path to a TOML file; in Python also a scenario, with `vary` and `fields`.
        out: campaign directory (default: runs/campaigns/NAME).
        overwrite: replace an earlier output, if its summary.json lists every file in the directory.
        workers: processes (default: one per core).
        cluster: fly on a Dask cluster: its scheduler's address, tcp://HOST:PORT.
        resume: continue the flights in this directory.
        flights: number of flights, in place of the file's.
        until_width: stop once the 95 % interval of the failure probability is this narrow, e.g. 0.05.
        require: exit 1 unless the flights support this statement, e.g. "P(violation) < 0.01 @ 95%"; may be repeated.
        report: write the report, an HTML page.
        junit: also write the requirements' verdicts as JUnit XML.
        changes: replace a field of the scenario, e.g. --set controller.horizon=30; may be repeated.
        seed: replace the seed of all draws.
        vary: with a scenario: the quantities to draw, entries as `[[vary]]` of a campaign file.
        fields: with a scenario: other fields of a campaign file, such as `name`, `failure` or `sampling`.
        controller: with a scenario: as in `sweep`.
        forces: with a scenario: as in `sweep`.
        progress: whether to show a bar on a terminal, and elsewhere a line every ten seconds.

    Returns:
        The results: `table` (a row per flight), `summary` (estimates with their intervals), `judgements` (of the
        requirements), and the `directory`.

    Raises:
        InputError: the campaign, or one of its flights, cannot be set up.
        OutputError: the directory already has a campaign, or cannot be written.
        KeyboardInterrupt: the user stopped it; the flights so far are kept, and `resume` continues it.

    Examples:
        >>> import tempfile, quadsim
        >>> scenario = quadsim.load("hover").replace({"duration": 1.0})
        >>> mass = {"name": "mass", "fields": ["vehicle.mass"], "distribution": "uniform", "low": 4.0, "high": 4.4}
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     result = quadsim.campaign(scenario, vary=[mass], flights=3, workers=1, out=folder + "/mass")
        >>> result.table["verdict"].to_pylist()
        ['satisfied', 'satisfied', 'satisfied']
    """
    from scenarios.campaign.campaign import fly_campaign
    from scenarios.campaign.events import parse_event
    from scenarios.campaign.plan import load_plan, make_plan
    from scenarios.campaign.statistics import judge, parse_requirement
    from scenarios.junit import junit_file, write_junit
    from scenarios.results import after
    from scenarios.schema.scenario import Scenario
    from scenarios.user_code import importable

    if junit is not None and not require:
        raise ParameterError("", "--junit", junit, "given with --require, whose verdicts it writes")
    file = None if junit is None else junit_file(junit)
    requirements = [parse_requirement(text) for text in require]
    if isinstance(campaign, Scenario):
        if changes:
            raise InputError("changes apply to a campaign file; change a scenario by its replace")
        settings = {"vary": [dict(entry) for entry in vary], "flights": flights, "seed": seed, **(fields or {})}
        settings = {name: value for name, value in settings.items() if value is not None}
        plan = make_plan(importable(campaign, controller, forces), settings)
    elif vary or fields or controller is not None or forces:
        raise InputError("vary, controller, forces and fields apply to a scenario; a campaign file sets them itself")
    else:
        plan = load_plan(str(campaign), list(changes), flights=flights, seed=seed)
    for requirement in requirements:
        parse_event(requirement.event.text, plan.columns)
    target = Path("runs") / "campaigns" / plan.spec.name if out is None else Path(out)
    with _growing(target, progress, resume=resume, overwrite=overwrite) as options:
        result = fly_campaign(plan, workers=workers, cluster=cluster, report=report, until_width=until_width, **options)
    result = replace(result, judgements=tuple(judge(result.table, requirement) for requirement in requirements))
    if file is not None:
        with after(result, file):
            write_junit(result, file)
    return result


@app.command(
    help_epilogue=_examples(
        "quadsim replay runs/campaigns/paper-robustness --worst",
        "quadsim replay runs/campaigns/paper-robustness --flight 12 --no-video",
    )
)
def replay(
    campaign: File,
    /,
    *,
    worst: Flag = False,
    flight: Whole | None = None,
    out: File | None = None,
    overwrite: Flag = False,
    video: bool | None = None,
    recording: bool | None = None,
    figures: bool | None = None,
    progress: Watched = True,
    flown: Flown = None,
) -> Replay:
    """Fly one flight of a finished campaign again, with all outputs.

    Args:
        campaign: campaign directory.
        worst: replay the worst flight (the default).
        flight: replay the flight of this number.
        out: run directory (default: runs/CAMPAIGN-N, or the next free name).
        overwrite: replace an earlier output, if its summary.json lists every file in the directory.
        video: film the flight (default: if possible).
        recording: write flight.rrd for the rerun viewer (default: if possible).
        figures: plot the flight (default: if possible).
        progress: as in `fly`.
        flown: as in `run`.

    Returns:
        The flight, and the columns of the campaign's table in which it differs by any bit.

    Raises:
        InputError: the campaign or the flight does not exist.
        OutputError: the directory cannot be written.

    Examples:
        >>> import quadsim
        >>> quadsim.replay("runs/campaigns/not-flown")
        Traceback (most recent call last):
        quadsim.errors.FileError: runs/campaigns/not-flown: is not a campaign: it has no manifest.json
    """
    from scenarios.campaign.campaign import compare_replay, recorded_flight
    from scenarios.flight import require_rendering
    from scenarios.progress import reporting
    from scenarios.rollout import Rollout

    if video:
        require_rendering()

    if worst and flight is not None:
        raise ParameterError("", "--flight", flight, "absent with --worst")
    recorded = recorded_flight(Path(campaign), flight)
    for note in recorded.notes:
        _log.info(note)
    products = {"video": video, "recording": recording, "figures": figures}
    with run_directory(recorded.scenario.name, out, overwrite=overwrite) as directory:
        with reporting(progress) as report:
            again = replace(Rollout(recorded.scenario).fly(report), directory=directory)
        _write(again, directory, products, overwrite=overwrite, progress=progress, flown=flown)
    return compare_replay(again, recorded)


@app.command(help_epilogue=_examples("quadsim tune paper-robust", "quadsim tune mine.toml --trials 50 --resume"))
def tune(
    tuning: TuningName,
    /,
    *,
    out: File | None = None,
    overwrite: Flag = False,
    trials: Whole | None = None,
    seed: Whole | None = None,
    workers: Whole | None = None,
    cluster: str | None = None,
    resume: Flag = False,
    report: bool = True,
    progress: Watched = True,
) -> TuningResult:
    """Tune fields of a scenario, and compare the result with the start on fresh draws.

    Args:
        tuning: name of a shipped tuning, or path to a TOML file.
        out: tuning directory (default: runs/tunings/NAME).
        overwrite: replace an earlier output, if its summary.json lists every file in the directory.
        trials: number of candidates, in place of the file's.
        seed: replace the seed of the search and of its draws.
        workers: processes (default: one per core).
        cluster: fly on a Dask cluster, as quadsim campaign does.
        resume: continue the flights in this directory.
        report: write the report, a set of HTML pages.
        progress: as in `campaign`.

    Returns:
        `best` (the tuned scenario), `summary` (the search and the fresh flights), `comparison` (flight by flight),
        `holds`, and the `directory`.

    Raises:
        InputError: the tuning, or one of its flights, cannot be set up.
        MissingPackageError: the extra `tune` is not installed.
        OutputError: the directory already has a tuning, or cannot be written.
        KeyboardInterrupt: the user stopped it; the flights so far are kept, and `resume` continues it.

    Examples:
        >>> import quadsim
        >>> quadsim.tune("paper-robust", workers=0)
        Traceback (most recent call last):
        quadsim.errors.ParameterError: --workers must be 1 or more; got 0
    """
    from scenarios.tuning.search import require_optuna
    from scenarios.tuning.tuning import fly_tuning
    from scenarios.tuning.tuning_plan import load_tuning

    require_optuna()
    plan = load_tuning(str(tuning), trials=trials, seed=seed)
    target = Path("runs") / "tunings" / plan.spec.name if out is None else Path(out)
    with _growing(target, progress, resume=resume, overwrite=overwrite) as options:
        return fly_tuning(plan, workers=workers, cluster=cluster, report=report, **options)


@contextmanager
def _growing(target: Path, progress: Watched, *, resume: bool, overwrite: bool) -> Iterator[dict[str, Any]]:
    """Yield the options of a command that adds flights to a directory; Ctrl-C says how to continue."""
    from quadsim.outputs import absolute
    from scenarios.progress import watching

    if resume and overwrite:
        raise ParameterError("", "--overwrite", overwrite, "absent with --resume")
    directory = absolute(target)
    try:
        with watching(bool(progress)) as watch:
            yield {"directory": directory, "resume": resume, "overwrite": overwrite, "watch": watch}
    except KeyboardInterrupt:
        raise KeyboardInterrupt(f"{directory} has the flights so far, --resume continues it") from None


@app.command(help_epilogue=_examples("quadsim reproduce", "quadsim reproduce torrente2021 --junit numbers.xml"))
def reproduce(
    paper: PaperName | None = None, /, *, junit: File | None = None, progress: Watched = True
) -> Reproductions:
    """Reproduce published numbers: published, ours, difference; exit 1 if one is off.

    Args:
        paper: name, or path to a TOML file (default: every shipped paper).
        junit: also write each number's verdict as JUnit XML.
        progress: as in `fly`.

    Returns:
        One reproduction per paper: its `numbers` with `ours`, `difference` and `within`, and a table, `grid`.

    Raises:
        InputError: the paper does not exist, or one of its numbers cannot be flown.

    Examples:
        >>> import quadsim
        >>> (paper,) = quadsim.reproduce("quadrotor-uav", progress=False)
        >>> paper.within, paper.numbers[2].spec.published, round(paper.numbers[2].ours, 3)
        (True, 250.0, 250.0)
    """
    from scenarios.junit import junit_file, write_junit
    from scenarios.papers.reproduction import Reproductions, load_paper, reproduce_paper
    from scenarios.progress import reporting
    from scenarios.results import after

    file = None if junit is None else junit_file(junit)
    papers = [load_paper(name) for name in ([str(paper)] if paper is not None else paper_names())]
    with reporting(progress) as report:
        reproductions = Reproductions(reproduce_paper(spec, report) for spec in papers)
    if file is not None:
        with after(reproductions, file):
            write_junit(reproductions, file)
    return reproductions


# --- files, code, and the catalogue --------------------------------------------------------------------------------


@app.command(
    help_epilogue=_examples(
        "quadsim export paper-constrained --out exported",
        "quadsim export paper-constrained --out small --precision float --target cortex-m7",
    )
)
def export(
    scenario: ScenarioName,
    /,
    *,
    out: File,
    overwrite: Flag = False,
    precision: str = "double",
    target: str = "posix",
    rows: Whole | None = None,
    fly: Flag = False,
    changes: Changes = (),
    seed: Whole | None = None,
    progress: Watched = True,
) -> Document | Flight:
    """Export a scenario's controller as self-contained C99, with recorded periods to test it.

    Args:
        scenario: library name, or path to a TOML file.
        out: output directory.
        overwrite: replace an earlier output, if its summary.json lists every file in the directory.
        precision: number type, double or float (default: double).
        target: platform of the test programs: posix, cortex-m7 or cortex-m4f (default: posix).
        rows: largest number of active constraints; memory grows with its square (default: 2.56 per step, at least 64).
        fly: then fly the scenario with the exported controller on the emulated target, into runs/SCENARIO-TARGET.
        changes: replace a field of the scenario, e.g. --set controller.horizon=30; may be repeated.
        seed: replace the seed of everything random in the scenario.
        progress: as in `fly`.
    """
    import json
    import shlex

    from scenarios import loading, results
    from scenarios.export import exporter, in_the_loop
    from scenarios.progress import reporting

    flown, options = loading.load_scenario(scenario, changes, seed), {"precision": precision, "target": target}
    with reporting(progress) as report:
        report("export", 0, 1)
        directory = exporter.export(flown, out, overwrite=overwrite, rows=rows, **options)  # type: ignore[arg-type]
    room = exporter.room_sentence(json.loads((directory / exporter.FACTS).read_text()))
    make = f"make -C {shlex.quote(str(directory))} check"
    text = f"{precision}: {room}\nWrote {directory}: {make} compiles it and checks its recorded periods"
    if not fly:
        return results.Document(f"{text}\n", {"directory": str(directory)})
    _log.info(text.replace("\n", "; "))
    with run_directory(f"{flown.name}-{target}", None, overwrite=False) as place:
        return in_the_loop.fly_exported(flown, place, progress=progress, **options)  # type: ignore[arg-type]


@app.command(
    help_epilogue=_examples(
        "quadsim identify eight.csv --vehicle start.toml --out mine.toml --page mine.html",
        "quadsim identify eight.csv climb.csv --vehicle start.toml --test square.csv --poles 14",
    )
)
def identify(
    *logs: File,
    vehicle: VehicleName | None = None,
    test: Files = (),
    out: File | None = None,
    page: File | None = None,
    overwrite: Flag = False,
    poles: Whole | None = None,
) -> IdentifiedVehicle:
    """Identify a vehicle from flight logs: its file, with an interval for every number.

    Args:
        logs: flights of one vehicle: CSV, Parquet, ULog, or run directories.
        vehicle: start: a vehicle's name, or path to a TOML file with its mass, arm length and rotor layout.
        test: log to predict and not to fit; may be repeated (default: the last fifth of each log, which is not fitted).
        out: TOML file for the identified vehicle (default: none is written).
        page: HTML file for the page: intervals, and measured against predicted.
        overwrite: replace existing files.
        poles: magnets of a motor, where a log has its electrical speed.

    Returns:
        The `vehicle`; its `identification` (estimates with intervals and verdicts); the `prediction` of flight that was
        not fitted; what to fly to learn the rest, `advice`.

    Raises:
        InputError: a log cannot be used, or the vehicle that it gives cannot fly.
        OutputError: a file exists, or cannot be written.

    Examples:
        >>> import quadsim
        >>> quadsim.identify("not-logged-yet.csv", vehicle="hummingbird")
        Traceback (most recent call last):
        quadsim.errors.FileError: not-logged-yet.csv: is missing, or not a file
    """
    from quadsim.assets import vehicle_path
    from scenarios.identify.report import NEEDED, identify_logs

    if not logs:
        raise InputError("identify needs a flight log: CSV, Parquet, ULog, or a run directory")
    if vehicle is None:
        raise InputError(
            "identify needs --vehicle, a start: mass and arm are in no log; quadsim vehicle --template > start.toml"
            f" writes one; give your {NEEDED}, and estimates of the rest"
        )
    for name, path, ending in (("--out", out, ".toml"), ("--page", page, ".html")):
        if path is not None and Path(path).suffix != ending:
            raise ParameterError("", name, str(path), f"a file ending in {ending}")
    fitted, tested = ([Path(log) for log in paths] for paths in (logs, test))
    if both := [log for log in tested if log.resolve() in {log.resolve() for log in fitted}]:
        raise ParameterError("", "--test", str(both[0]), "a log that is not fitted too")
    files = {name: None if path is None else Path(path) for name, path in (("out", out), ("page", page))}
    start = vehicle_path(str(vehicle))
    return identify_logs(fitted, start, test=tested, poles=poles, overwrite=overwrite, **files)


@app.command(
    help_epilogue=_examples(
        "quadsim scenario hover > mine.toml", "quadsim scenario --for hummingbird --course figure-eight > mine.toml"
    )
)
def scenario(
    name: ScenarioName | None = None,
    /,
    *,
    changes: Changes = (),
    seed: Whole | None = None,
    vehicle: Annotated[VehicleName | None, Parameter(name="--for")] = None,
    course: str | None = None,
    controller: str | None = None,
    tilt: float | None = None,
    schema: Flag = False,
) -> ScenarioFile:
    """Print a scenario with all defaults and comments, as a start for your own.

    Args:
        name: library name, or path to a TOML file.
        changes: replace a field of the scenario, e.g. --set controller.horizon=30; may be repeated.
        seed: replace the seed of everything random in the scenario.
        vehicle: print a first scenario for this vehicle instead.
        course: its course: hover, step (of 1 m) or figure-eight, at 60 % of the vehicle's limits (default: hover).
        controller: its controller: robust, lqr, pid or geometric, or rates for nonlinear MPC of thrust and body rates
            through its autopilot (default: robust).
        tilt: its tilt bound [deg] (default: by rule, at most 40).
        schema: print the JSON Schema of scenario files instead.

    Returns:
        The `content` of the file, where every number has its unit or source, and the `scenario` itself.

    Examples:
        >>> import quadsim
        >>> quadsim.scenario("hover").scenario.vehicle.mass  # [kg]
        4.0
        >>> first = quadsim.scenario(vehicle="hummingbird", course="figure-eight").scenario
        >>> first.control_period, first.reference.length  # [s], [m]
        (0.025, 1.69)
        >>> quadsim.fly(first).outcome
        'satisfied'
    """
    import json
    from dataclasses import replace

    from scenarios import loading, results
    from scenarios.courses.csv_course import Csv
    from scenarios.design.first_scenario import first_scenario
    from scenarios.schema.json_schema import scenario_schema

    if schema:
        return results.ScenarioFile(json.dumps(scenario_schema(), indent=2) + "\n", scenario_schema())
    options = {"course": course, "law": controller, "tilt": tilt}
    choice: dict[str, Any] = {option: value for option, value in options.items() if value is not None}
    if vehicle is not None:
        for option, value in {"a scenario": name, "--set": changes, "--seed": seed}.items():
            if value:
                raise ParameterError("", "--for", vehicle, f"given without {option}")
        return results.ScenarioFile(first_scenario(load_vehicle(vehicle), str(vehicle), **choice).to_toml())
    for option, value in choice.items():
        raise ParameterError("", f"--{'controller' if option == 'law' else option}", value, "given with --for alone")
    if name is None:
        names = ", ".join(scenario_names())
        raise InputError(f"scenario needs a name or a TOML file, or --schema (there are: {names})")
    whole = loading.assemble(name, changes, seed).resolved.scenario
    if isinstance(whole.reference, Csv):  # so that you may replace the table
        whole = whole.altered(reference=replace(whole.reference, sha256=None))
    return results.ScenarioFile(whole.to_toml())


@app.command(
    name="vehicle",
    help_epilogue=_examples(
        "quadsim vehicle hummingbird --scenario paper-constrained", "quadsim vehicle --template > mine.toml"
    ),
)
def vehicle_report(
    name: VehicleName | None = None,
    /,
    *,
    template: Flag = False,
    scenario: ScenarioName | None = None,
    out: File | None = None,
    overwrite: Flag = False,
) -> VehicleReport | Document:
    """Report a vehicle's limits and designed gains, and the sources of its parameters; draw it.

    Args:
        name: shipped vehicle's name, or path to a TOML file.
        template: print a commented vehicle file to fill in instead.
        scenario: scenario whose bounds the vehicle may be unable to meet; they are listed.
        out: PNG file for a picture of the vehicle on a floor of 10 cm squares.
        overwrite: replace an existing file.

    Returns:
        The vehicle's parameters with their sources, the `figures` derived from them, and the `shortfalls` if a scenario
        is given; or the template.

    Raises:
        InputError: the vehicle or scenario does not exist, the vehicle cannot fly, or the file does not end in .png.
        RenderingUnavailableError: this machine cannot render.

    Examples:
        >>> import quadsim
        >>> report = quadsim.vehicle_report("hummingbird", scenario="paper-constrained")
        >>> report.figures.designed.limited_by, round(report.figures.designed.time_constants["x, y"], 2)  # [s]
        ('torque', 0.18)
        >>> report.shortfalls[0]
        'controller.input_bounds.speed: hover is 453.2 rad/s, the scenario allows 250'
    """
    from quadsim.assets import vehicle_path
    from quadsim.report.film.video import render_portrait
    from quadsim.sim.autopilot import AutopilotSettings
    from quadsim.vehicle import vehicle_sources
    from scenarios import loading, results
    from scenarios.assembly import stated_autopilot
    from scenarios.design import shortfalls, vehicle_report

    if template:
        return results.Document((Path(__file__).parent / "design/vehicle_template.toml").read_text(encoding="utf-8"))
    if name is None:
        names = ", ".join(vehicle_names())
        raise InputError(f"vehicle needs a name or a TOML file, or --template (there are: {names})")
    loaded = load_vehicle(name)
    against = None if scenario is None else loading.load_scenario(scenario)
    if out is not None and Path(out).suffix != ".png":
        raise ParameterError("", "--out", str(out), "a file ending in .png")
    path = vehicle_path(str(name))
    autopilot = (stated_autopilot(path) or AutopilotSettings()).resolved(loaded)
    report = vehicle_report.VehicleReport(
        vehicle=loaded,
        sources=vehicle_sources(path),
        autopilot=autopilot,
        inner_lag=vehicle_report.inner_lag_of(loaded, autopilot),
        figures=vehicle_report.make_sheet(loaded),
        scenario=None if against is None else against.name,
        shortfalls=None if against is None else shortfalls.shortfalls(against, loaded),
    )
    if out is None:
        return report
    with results.after(report, Path(out)):
        render_portrait(loaded, Path(out), overwrite=overwrite)
    return replace(report, picture=Path(out))


def load_vehicle(name: VehicleName) -> Vehicle:
    """Load the parameters of a vehicle.

    Args:
        name: shipped vehicle's name, or a path ending in `.toml`.

    Raises:
        InputError: the vehicle does not exist or cannot fly.

    Examples:
        >>> import quadsim
        >>> vehicle = quadsim.load_vehicle("hummingbird")
        >>> vehicle.mass, round(vehicle.hover_speed)
        (0.716, 453)
    """
    from quadsim.assets import vehicle_path
    from quadsim.vehicle import load_vehicle as read_vehicle

    return read_vehicle(vehicle_path(str(name)))


@app.command(name="list", help_epilogue=_examples("quadsim list", "quadsim list --json"))
def catalogue() -> Catalogue:
    """List scenarios, campaigns, tunings, vehicles, controllers, papers and solvers, one per line.

    Returns:
        Mappings by name: `scenarios`, with `description`, `group` and the expected verdict, `expect`; and `campaigns`,
        `tunings`, `vehicles`, `controllers`, `papers` and `solvers`, with a sentence.

    Examples:
        >>> import quadsim
        >>> catalogue = quadsim.catalogue()
        >>> [name for name, entry in catalogue.scenarios.items() if entry.group == "ground"]
        ['ground-effect', 'hard-landing', 'take-off-and-landing']
        >>> catalogue.controllers["lqr"]
        "infinite-horizon LQR on the hover model, following the reference's velocity"
    """
    from scenarios.catalogue import read_catalogue

    return read_catalogue()


@app.command(help_epilogue=_examples("quadsim doctor", "quadsim doctor --json"))
def doctor() -> Listing:
    """Check this machine: cores, packages, rendering, viewer, and every QP solver on a step.

    Returns:
        Checks by section (machine, packages, rendering, viewer, solvers), one line each, with a remedy where one fails.

    Examples:
        >>> import quadsim
        >>> checks = quadsim.doctor()
        >>> checks["solvers"]["piqp-multistage"].startswith("works")
        True
        >>> sorted(checks)
        ['machine', 'packages', 'rendering', 'solvers', 'viewer']
    """
    from scenarios.machine import capabilities
    from scenarios.results import Listing

    return Listing(capabilities())
