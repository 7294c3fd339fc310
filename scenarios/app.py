"""The functions of quadsim: the API of `import quadsim` and the commands of the command line.

A function under `@app.command` is both.  `scenarios.cli` alone prints, and shows the results (`scenarios.results`).
No heavy import precedes the call of a function.
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
    from quadsim.controller import Controller
    from quadsim.flight.feasibility import Feasibility
    from quadsim.vehicle import Vehicle
    from scenarios.assembly import Assembly
    from scenarios.campaign.campaign import CampaignResult, Replay
    from scenarios.campaign.paired import PairedComparison
    from scenarios.campaign.sweep import Sweep
    from scenarios.catalogue import Catalogue
    from scenarios.design.vehicle_report import VehicleReport
    from scenarios.flight import Flight
    from scenarios.flight_comparison import FlightComparison
    from scenarios.papers.reproduction import Reproductions
    from scenarios.progress import Progress
    from scenarios.reaudit import Reaudit
    from scenarios.results import Document, Listing, ScenarioFile
    from scenarios.rollout import Rollout
    from scenarios.schema.scenario import Scenario
    from scenarios.tuning.tuning import TuningResult

    File: TypeAlias = str | Path
    PaperName: TypeAlias = File
    TuningName: TypeAlias = File
    VehicleName: TypeAlias = File
    ScenarioName: TypeAlias = Scenario | File
    CampaignName: TypeAlias = ScenarioName
    Target: TypeAlias = Flight | ScenarioName
    Changes: TypeAlias = Mapping[Any, Any] | Sequence[str]
    Whole = int
    Flag = bool
    UserCode = object
    UserForces = Sequence[object]
    UserReference: TypeAlias = Callable[[float], ArrayLike] | None
    Fields: TypeAlias = Mapping[str, Any]
    Draws: TypeAlias = Sequence[Mapping[str, Any]]
    Watched: TypeAlias = Progress | bool
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
    Replay = Reproductions = ScenarioFile = TuningResult = VehicleReport = Any
    File = Path
    VehicleName = _one_of(vehicle_names)
    Target = ScenarioName = _one_of(scenario_names)
    CampaignName, PaperName = _one_of(campaign_names), _one_of(paper_names)
    TuningName = _one_of(tuning_names)
    Changes = Annotated[Sequence[str], Parameter(name="--set")]
    Whole = Annotated[int, Parameter(converter=_whole)]
    Flag = Annotated[bool, Parameter(negative="")]
    UserCode = UserForces = UserReference = Fields = Draws = Watched = Annotated[Any, Parameter(parse=False)]

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
    """What the help of a command ends with."""
    return "\n  ".join(["examples:", *lines])


# --- scenarios -----------------------------------------------------------------------------------------------------


def load(name: str | Path, changes: Changes = ()) -> Scenario:
    """A scenario of the library, or of a file, checked together with the vehicle and the course that it names.

    Args:
        name: a library name, or a path ending in `.toml`.
        changes: fields to replace: values by dotted path as `Scenario.replace` takes them, or texts as of `--set`.

    Raises:
        InputError: it is missing or malformed, or cannot be flown so.

    Examples:
        >>> import quadsim
        >>> scenario = quadsim.load("paper-constrained", {"controller.horizon": 30})
        >>> scenario.controller.horizon, scenario.duration
        (30, 60.0)
    """
    from scenarios.loading import load_scenario

    return load_scenario(name, changes)


def feasibility(scenario: ScenarioName) -> Feasibility:
    """Compare a course with the vehicle's limits and the controller's bounds, tightened ones too, without a flight.

    Args:
        scenario: it, or its name or file.

    Returns:
        Peaks of the course, as `tilt` [deg], `problems` where a limit or a bound is passed, and a `sentence`.

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


def make_controller(scenario: ScenarioName) -> Controller:
    """The controller of a scenario, ready for `reset` and `step`, without a simulator.

    Raises:
        InputError: it cannot be made from these numbers.

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
    """The optimal control problem of a scenario's controller: matrices, weights and constraints as numpy arrays.

    `model` has A (n, n), B (n, 4), u_bar (4,) [rad/s]; `objective` C_r, Q_y, Q_u; `rows` the constraints, lower <=
    C x + D u + E (u - u_before) <= upper.  `condensed()` and `qp(state, reference, u_before)` give the QP.

    The problem of `robust` has its soft and tightened rows, weights of moves and rotor lag.  It starts where its delay
    ends, in axes turned by the yaw with `heading`; an estimated disturbance moves its `equilibrium`.  Half-spaces of
    `controller.avoidance` differ from period to period and are left out.

    Raises:
        InputError: the controller solves none: `nonlinear`, `lqr`, `pid`, `geometric`, or yours.

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
    progress: Watched = True,
) -> Flight:
    """Fly a scenario and audit it, in memory; `run` and `Flight.save` write its run directory.

    Ctrl-C, or a controller or force that raises, ends the flight in order: it is returned as far as it came, with the
    reason, and its outcome is `aborted`.

    Args:
        scenario: the scenario, or its name or file.
        controller: flies it, instead of the scenario's: a class, called as MyLaw(vehicle, period=..., horizon=...)
            and with a method `step(now, state, reference)`; a function `law(now, state, reference)` that gives four
            rotor speeds [rad/s]; an object with such a `step`; or a text `package.module:Class`.  Further arguments of
            a class through `functools.partial`.
        forces: user-defined forces on the vehicle, besides the scenario's effects: functions
            `force(time, state)`, called once per physics step, that give force x, y, z in the world frame [N] and
            torque in the body frame [N m]; or classes called as MyForce(vehicle, rng=...) whose objects are called so.
        reference: replaces the course and its filter; the scenario's constraints stay.  A function `f(t)` of the time
            [s] that gives x, y, z [m], yaw [rad] (unwrapped), called before the flight for all control instants to the
            end of the last preview.  A run directory keeps these samples in `reference.csv`, and its `scenario.toml`
            flies to the same bits.
        progress: called with (what, done, total); True for bars on a terminal and elsewhere a line every ten seconds,
            False for none.

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
        return start(scenario, controller=controller, forces=forces, reference=reference).fly(report)


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
) -> Flight:
    """Fly one scenario and write its run directory.

    A flight that was flown is kept: tables and summary first, then what is made from them.

    Args:
        scenario: library name, or path to a TOML file.
        out: run directory (default: runs/SCENARIO, or the next free name).
        overwrite: replace an earlier output there, if its summary.json lists all that the directory holds.
        changes: replace a field of the scenario, e.g. --set controller.horizon=30; may be repeated.
        seed: replace the seed, of everything random in it.
        video: film it (default: where that can be done).
        recording: write flight.rrd for the rerun viewer (default: where that can be done).
        figures: draw it (default: where that can be done).
        controller: as of `fly`.
        forces: as of `fly`.
        reference: as of `fly`.
        progress: as of `fly`.

    Raises:
        InputError: the scenario cannot be flown, or the controller or the reference cannot be set up.
        RenderingUnavailableError: a video is asked for and cannot be made; nothing was flown.
        OutputError: the directory cannot be written; or what was asked for by name: its `result` is the flight then.

    Examples:
        >>> import tempfile, quadsim
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     flown = quadsim.run("hover", out=folder + "/run", changes={"duration": 0.5}, video=False)
        ...     flown.outcome, flown.directory.name
        ('satisfied', 'run')
    """
    from scenarios import loading, user_code
    from scenarios.flight import require_rendering
    from scenarios.progress import reporting
    from scenarios.rollout import Rollout

    if video:
        require_rendering()
    parts = user_code.set_up(loading.assemble(scenario, changes, seed), controller, forces, reference)
    _announce(parts[0], progress)
    products: dict[str, Any] = {"video": video, "recording": recording, "figures": figures}
    with run_directory(parts[0].scenario.name, out, overwrite=overwrite) as directory, reporting(progress) as report:
        flight = replace(Rollout(*parts).fly(report), directory=directory)
        try:
            flight.save(directory, overwrite=overwrite, progress=report, **products)
        except OutputError as error:
            if error.path.parent == directory:  # a product that was asked for by name
                error.result = flight
            raise
    return flight


def run_directory(name: str, out: str | Path | None, *, overwrite: bool) -> AbstractContextManager[Path]:
    """The directory of a run, reserved: `out`, or `runs/NAME`, or the next free name where that is not replaced."""
    from quadsim.outputs import reserving

    if out is not None:
        return reserving(out, overwrite=overwrite)
    return reserving(Path("runs") / name, overwrite=overwrite, free=not overwrite)


def _announce(assembly: Assembly, progress: Watched) -> None:
    """On a terminal, report what the course requires before it is flown; the summary repeats it."""
    from scenarios import console, feasibility_check

    if progress is True and (terminal := console.stderr()).is_terminal:
        required = feasibility_check.report(assembly)
        fits = feasibility_check.fitting(assembly) if required.problems else ""
        console.show([f"{required.sentence} {fits}".rstrip()], terminal)


def start(
    scenario: ScenarioName,
    *,
    controller: object = None,
    forces: Sequence[object] = (),
    reference: UserReference = None,
    live: bool = False,
    recorded: bool = True,
) -> Rollout:
    """Build everything that a flight needs, for a script that flies it period by period.

    Args:
        scenario: the scenario, or its name or file.
        controller: as of `fly`.
        forces: as of `fly`.
        reference: as of `fly`; beyond the scenario's end and its preview it stays at the last sample.
        live: whether anything may be applied to it that can happen to its vehicle; else what its scenario's events are
            of, and set-points, stalls, rotor losses and lags, and other controllers.
        recorded: whether all periods are recorded, some 10 kB each; without them there is no `Rollout.flight`.

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

    parts = user_code.set_up(loading.assemble(scenario), controller, forces, reference)
    return Rollout(*parts, live=live, recorded=recorded)


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
    from quadsim.flight import rundir
    from quadsim.flight.rundir import finding_from_json
    from quadsim.vehicle import Vehicle
    from scenarios.assembly import Assembly
    from scenarios.flight import Flight
    from scenarios.reaudit import stored_scenario

    directory = Path(directory)
    run = rundir.load_run(directory)
    law = run.summary["controller"]
    return Flight(
        assembly=Assembly(stored_scenario(directory), Vehicle(**run.summary["vehicle"])),
        log=run.log,
        findings=tuple(finding_from_json(entry) for entry in run.summary["constraints"]),
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
    """Audit a scenario (flown first) or a finished run; exit 1 if it fails.

    A finished run is audited again from its tables, and compared with its summary and its files' hashes.  This
    finds damage and mistakes: integrity, not authenticity.  Rewriting every file can make them agree.

    Args:
        target: library name, TOML file, or run directory.
        changes: replace a field of the scenario, e.g. --set controller.horizon=30; may be repeated.
        seed: replace the seed, of everything random in it.
        junit: also write the verdicts as JUnit XML.
        progress: as of `fly`.

    Raises:
        InputError: the scenario cannot be flown.
        FileError: a file is missing, changed or damaged, or the summary contradicts the tables.

    Examples:
        >>> import tempfile, quadsim
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     flown = quadsim.fly(quadsim.load("hover").replace({"duration": 1.0}))
        ...     audited = quadsim.check(flown.save(folder + "/run", video=False))
        >>> audited.satisfied, audited.notes
        (True, ())
    """
    from scenarios import loading, reaudit
    from scenarios.campaign.store import is_campaign
    from scenarios.junit import junit_file, write_junit
    from scenarios.progress import reporting
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
        _announce(assembly, progress)
        with reporting(progress) as report:
            flight = Rollout(assembly).fly(report)
        audited = reaudit.Reaudit(summary=dict(flight.summary), findings=flight.findings, satisfied=flight.satisfied)
    if file is not None:
        write_junit(audited, file)
    return audited


@app.command(
    help_epilogue=_examples(
        "quadsim compare paper-unconstrained paper-constrained --out runs/comparison",
        "quadsim compare runs/mine runs/other --markdown",
    )
)
def compare(
    *targets: Target,
    out: File | None = None,
    overwrite: Flag = False,
    markdown: Flag = False,
    progress: Watched = True,
) -> FlightComparison | PairedComparison | Document:
    """Flights, or two campaigns flight by flight, side by side: table, figures, HTML page.

    Args:
        targets: run directories, scenarios to fly, or the directories of two campaigns.
        out: directory of the page, its figures and its table.
        overwrite: replace an earlier output there, if its summary.json lists all that the directory holds.
        markdown: print the table as Markdown.
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
    from quadsim.outputs import absolute
    from scenarios.flight_comparison import compare_campaigns, compare_flights, is_campaign
    from scenarios.progress import reporting
    from scenarios.results import Document

    if not targets:
        raise InputError("compare needs runs, scenarios, or two campaigns")
    page = None if out is None else absolute(out)
    compared: FlightComparison | PairedComparison
    if any(isinstance(target, str | Path) and is_campaign(Path(target)) for target in targets):
        compared = compare_campaigns([Path(str(target)) for target in targets], page, overwrite=overwrite)
    else:
        with reporting(progress) as report:
            compared = compare_flights(targets, page, report, overwrite=overwrite)
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
        out: MP4 or GIF file (default: flight.mp4 in the run's directory, replacing an earlier one).
        overwrite: replace a file that is there.
        workers: rendering processes (default: one per core).
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

    It returns when the viewer is closed or Ctrl-C is pressed.

    Args:
        run: run directory or .rrd file.
        web: serve the viewer to a browser instead, to this machine alone.

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
        raise FileError(path, "is no recording; give a run directory or a file ending in .rrd")
    open_viewer(recording, web=web)


@app.command(
    help_epilogue=_examples("quadsim live paper-constrained", "quadsim live robust --against paper-unconstrained")
)
def live(
    scenario: ScenarioName,
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
    """Fly in the browser: push, turn every knob, keep it as a scenario.

    Args:
        scenario: library name, or path to a TOML file; or the directory of a run to fly on from.
        against: a second vehicle, flown by the controller of this scenario.
        out: run directory (default: runs/SCENARIO-live, or the next free name).
        overwrite: replace an earlier output there, if its summary.json lists all that the directory holds.
        script: TOML file of inputs and times: no browser, as fast as it goes.
        port: to listen on (default: any free one).
        host: other than this machine: for a network that you trust.
        browser: open the browser.
        video: film what was flown.
        changes: replace a field of the scenario, e.g. --set controller.horizon=30; may be repeated.
        seed: replace the seed, of everything random in it.

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
            raise ParameterError("", "--set" if changes else "--seed", "given", "absent where a run is flown on")
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
    """Fly a scenario once for every combination of some fields' values, all with the scenario's own seed.

    Args:
        scenario: the scenario, or its name or file.
        values: what to try, by dotted path; a tuple of paths varies together, with one value for all of them or a tuple
            of one for each.
        controller: as of `fly`; a class or a function of a module that other processes can import.
        forces: what acts on it, as of `fly`; the same.
        workers: processes that fly; one per usable core where absent.
        progress: as of `fly`.

    Returns:
        A table with a row per flight, in the order of the combinations, the last field varying fastest.

    Raises:
        InputError: a value is not allowed, or the controller cannot be sent to other processes.

    Examples:
        >>> import quadsim
        >>> scenario = quadsim.load("hover").replace({"duration": 1.0})
        >>> found = quadsim.sweep(scenario, {"controller.horizon": [20, 40]}, workers=1)
        >>> found["controller.horizon"].tolist(), found["verdict"].tolist()
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
    fields: Fields | None = None,
    controller: UserCode = None,
    forces: UserForces = (),
    progress: Watched = True,
) -> CampaignResult:
    """Fly a scenario many times with parameters drawn at random.

    Args:
        campaign: a campaign's name, or path to a TOML file; in Python also a scenario, with `vary` and `fields`.
        out: campaign's directory (default: runs/campaigns/NAME).
        overwrite: replace an earlier output there, if its summary.json lists all that the directory holds.
        workers: processes (default: one per core).
        cluster: fly on a Dask cluster: its scheduler's address, tcp://HOST:PORT.
        resume: continue what is there.
        flights: number of flights, instead of the file's.
        until_width: stop once the 95 % interval of the failure probability is as narrow as this, e.g. 0.05.
        require: exit 1 unless the flights support it, e.g. "P(violation) < 0.01 @ 95%"; may be repeated.
        report: write the report, an HTML page.
        junit: also write the requirements' verdicts as JUnit XML.
        changes: replace a field of the scenario, e.g. --set controller.horizon=30; may be repeated.
        seed: replace the seed, of all draws.
        vary: of a scenario: what varies, entries as `[[vary]]` of a campaign file.
        fields: of a scenario: other fields of a campaign file, as `name`, `failure` or `sampling`.
        controller: of a scenario, as of `sweep`.
        forces: of a scenario, as of `sweep`.
        progress: whether to show a bar on a terminal, and elsewhere a line every ten seconds.

    Returns:
        The results: `table` (a row per flight), `summary` (estimates with their intervals), `judgements` (of what was
        required), and the `directory`.

    Raises:
        InputError: something cannot be flown so.
        OutputError: a campaign is there already, or the directory cannot be written.
        KeyboardInterrupt: the user stopped it; the flights so far are kept, and `resume` continues it.

    Examples:
        >>> import tempfile, quadsim
        >>> scenario = quadsim.load("hover").replace({"duration": 1.0})
        >>> mass = {"name": "mass", "fields": ["vehicle.mass"], "distribution": "uniform", "low": 4.0, "high": 4.4}
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     found = quadsim.campaign(scenario, vary=[mass], flights=3, workers=1, out=folder + "/mass")
        >>> found.table["verdict"].to_pylist()
        ['satisfied', 'satisfied', 'satisfied']
    """
    from scenarios.campaign.campaign import fly_campaign
    from scenarios.campaign.events import parse_event
    from scenarios.campaign.plan import load_plan, make_plan
    from scenarios.campaign.statistics import judge, parse_requirement
    from scenarios.junit import junit_file, write_junit
    from scenarios.schema.scenario import Scenario
    from scenarios.user_code import importable

    if junit is not None and not require:
        raise ParameterError("", "--junit", junit, "given with --require, whose verdicts it is to hold")
    file = None if junit is None else junit_file(junit)
    requirements = [parse_requirement(text) for text in require]
    if isinstance(campaign, Scenario):
        if changes:
            raise InputError("changes go with a campaign file; a scenario is changed by its replace")
        given = {"vary": [dict(entry) for entry in vary], "flights": flights, "seed": seed, **(fields or {})}
        given = {name: value for name, value in given.items() if value is not None}
        plan = make_plan(importable(campaign, controller, forces), given)
    elif vary or fields or controller is not None or forces:
        raise InputError("vary, controller and other fields go with a scenario; a campaign file has its own")
    else:
        plan = load_plan(str(campaign), list(changes), flights=flights, seed=seed)
    for requirement in requirements:
        parse_event(requirement.event.text, plan.columns)
    target = Path("runs") / "campaigns" / plan.spec.name if out is None else Path(out)
    with _growing(target, progress, resume=resume, overwrite=overwrite) as options:
        result = fly_campaign(plan, workers=workers, cluster=cluster, report=report, until_width=until_width, **options)
    result = replace(result, judgements=tuple(judge(result.table, requirement) for requirement in requirements))
    if file is not None:
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
) -> Replay:
    """Fly one flight of a finished campaign again, with all outputs.

    Args:
        campaign: a campaign's directory.
        worst: the worst flight (the default).
        flight: that flight.
        out: run directory (default: runs/CAMPAIGN-N, or the next free name).
        overwrite: replace an earlier output there, if its summary.json lists all that the directory holds.
        video: film it (default: where that can be done).
        recording: write flight.rrd for the rerun viewer (default: where that can be done).
        figures: draw it (default: where that can be done).
        progress: as of `fly`.

    Returns:
        The flight, and the columns of the campaign's table that it does not agree with, bit for bit.

    Raises:
        InputError: there is no such campaign or flight.
        OutputError: the directory cannot be written.

    Examples:
        >>> import quadsim
        >>> quadsim.replay("runs/campaigns/not-flown")
        Traceback (most recent call last):
        quadsim.errors.FileError: runs/campaigns/not-flown: is not a campaign: it has no manifest.json
    """
    from scenarios.campaign.campaign import held_against, recorded_flight
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
    products: dict[str, Any] = {"video": video, "recording": recording, "figures": figures}
    with reporting(progress) as report, run_directory(recorded.scenario.name, out, overwrite=overwrite) as directory:
        flown = replace(Rollout(recorded.scenario).fly(report), directory=directory)
        flown.save(directory, overwrite=overwrite, progress=report, **products)
    return held_against(flown, recorded)


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
    """Search fields of a scenario; the answer is compared with the start on fresh draws.

    Args:
        tuning: name of a tuning that ships, or path to a TOML file.
        out: tuning's directory (default: runs/tunings/NAME).
        overwrite: replace an earlier output there, if its summary.json lists all that the directory holds.
        trials: number of candidates, instead of the file's.
        seed: replace the seed, of the search and of its draws.
        workers: processes (default: one per core).
        cluster: fly on a Dask cluster, as quadsim campaign does.
        resume: continue what is there.
        report: write the report, HTML pages.
        progress: as of `campaign`.

    Returns:
        `best` (the scenario that was found), `summary` (the search and the fresh flights),
        `comparison` (flight by flight), `holds`, and the `directory`.

    Raises:
        InputError: something cannot be flown so.
        MissingPackageError: the extra `tune` is not installed.
        OutputError: a tuning is there already, or the directory cannot be written.
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
    """What grows in a directory: the options of where, and of its progress; Ctrl-C says what is there."""
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
    """Fly what papers publish: published, ours, difference; exit 1 if one is off.

    Args:
        paper: name, or path to a TOML file (default: every paper that ships).
        junit: also write each number's verdict as JUnit XML.
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
    from scenarios.junit import junit_file, write_junit
    from scenarios.papers.reproduction import Reproductions, load_paper, reproduce_paper
    from scenarios.progress import reporting

    file = None if junit is None else junit_file(junit)
    papers = [load_paper(name) for name in ([str(paper)] if paper is not None else paper_names())]
    with reporting(progress) as report:
        found = Reproductions(reproduce_paper(each, report) for each in papers)
    if file is not None:
        write_junit(found, file)
    return found


# --- files, code, and what there is --------------------------------------------------------------------------------


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
) -> Document | Flight:
    """Write a scenario's controller as self-contained C99, with its recorded periods.

    Args:
        scenario: library name, or path to a TOML file.
        out: directory.
        overwrite: replace an earlier output there, if its summary.json lists all that the directory holds.
        precision: of all numbers: double or float (default: double).
        target: what its programs are for: posix, cortex-m7 or cortex-m4f (default: posix).
        rows: room for so many active rows; memory grows with the square (default: 2.56 per step, at least 64).
        fly: then fly the scenario with the exported controller on its target, emulated, into runs/SCENARIO-TARGET.
        changes: replace a field of the scenario, e.g. --set controller.horizon=30; may be repeated.
        seed: replace the seed, of everything random in it.
    """
    import json
    import shlex

    from scenarios import loading, results
    from scenarios.export import exporter, in_the_loop

    flown, options = loading.load_scenario(scenario, changes, seed), {"precision": precision, "target": target}
    directory = exporter.export(flown, out, overwrite=overwrite, rows=rows, **options)  # type: ignore[arg-type]
    room = exporter.room_sentence(json.loads((directory / exporter.FACTS).read_text()))
    make = f"make -C {shlex.quote(str(directory))} check"
    text = f"{precision}: {room}\nWrote {directory}: {make} compiles it and runs its recorded periods"
    if not fly:
        return results.Document(f"{text}\n", {"directory": str(directory)})
    _log.info(text.replace("\n", "; "))
    with run_directory(f"{flown.name}-{target}", None, overwrite=False) as place:
        return in_the_loop.fly_exported(flown, place, **options)  # type: ignore[arg-type]


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
    schema: Flag = False,
) -> ScenarioFile:
    """Print a scenario with all defaults and comments: a start for yours.

    Args:
        name: library name, or path to a TOML file.
        changes: replace a field of the scenario, e.g. --set controller.horizon=30; may be repeated.
        seed: replace the seed, of everything random in it.
        vehicle: print one made for this vehicle instead.
        course: of it: hover, step (of 1 m) or figure-eight, at 60 % of what the vehicle can do (default: hover).
        controller: of it: robust, lqr, pid or geometric (default: robust).
        schema: print the JSON Schema of scenario files instead.

    Returns:
        Its `content`, where every number has its unit or source, and the `scenario` that it is.

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
    choice = {option: value for option, value in {"course": course, "law": controller}.items() if value is not None}
    if vehicle is not None:
        for option, value in {"a scenario": name, "--set": changes, "--seed": seed}.items():
            if value:
                raise ParameterError("", "--for", vehicle, f"given without {option}")
        return results.ScenarioFile(first_scenario(load_vehicle(vehicle), str(vehicle), **choice).to_toml())
    for option, value in choice.items():
        raise ParameterError("", "--course" if option == "course" else "--controller", value, "given with --for alone")
    if name is None:
        names = ", ".join(scenario_names())
        raise InputError(f"scenario needs a name or a TOML file, or --schema (there are: {names})")
    whole = loading.assemble(name, changes, seed).resolved.scenario
    if isinstance(whole.reference, Csv):  # another table may take the place of its own
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
    """A vehicle's derived figures, its parameters' sources, its picture.

    Args:
        name: a shipped vehicle's name, or path to a TOML file.
        template: print a commented vehicle file to fill in instead.
        scenario: report which of its bounds the vehicle cannot meet.
        out: PNG file to draw it to, on a floor of 10 cm squares.
        overwrite: replace a file that is there.

    Returns:
        Its numbers with their sources, `figures` that follow from them, `shortfalls` where a scenario is given; or the
        template.

    Raises:
        InputError: there is no such vehicle or scenario, it cannot fly, or the file has another ending.
        RenderingUnavailableError: nothing can render here.

    Examples:
        >>> import quadsim
        >>> can = quadsim.vehicle_report("hummingbird", scenario="paper-constrained")
        >>> can.figures.designed.limited_by, round(can.figures.designed.time_constants["x, y"], 2)  # [s]
        ('torque', 0.18)
        >>> can.shortfalls[0]
        'controller.input_bounds.speed: hover is 453.2 rad/s, the scenario allows 250'
    """
    from quadsim.assets import vehicle_path
    from quadsim.report.film.video import render_portrait
    from quadsim.vehicle import vehicle_sources
    from scenarios import loading, results
    from scenarios.design import shortfalls, vehicle_report

    if template:
        return results.Document((Path(__file__).parent / "design/vehicle_template.toml").read_text(encoding="utf-8"))
    if name is None:
        names = ", ".join(vehicle_names())
        raise InputError(f"vehicle needs a name or a TOML file, or --template (there are: {names})")
    loaded = load_vehicle(name)
    against = None if scenario is None else loading.load_scenario(scenario)
    if out is not None:
        if Path(out).suffix != ".png":
            raise ParameterError("", "--out", str(out), "a file ending in .png")
        render_portrait(loaded, Path(out), overwrite=overwrite)
    return vehicle_report.VehicleReport(
        vehicle=loaded,
        sources=vehicle_sources(vehicle_path(str(name))),
        figures=vehicle_report.make_sheet(loaded),
        scenario=None if against is None else against.name,
        shortfalls=None if against is None else shortfalls.shortfalls(against, loaded),
        picture=None if out is None else Path(out),
    )


def load_vehicle(name: VehicleName) -> Vehicle:
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
    from quadsim.assets import vehicle_path
    from quadsim.vehicle import load_vehicle as read_vehicle

    return read_vehicle(vehicle_path(str(name)))


@app.command(name="list", help_epilogue=_examples("quadsim list", "quadsim list --json"))
def catalogue() -> Catalogue:
    """Scenarios, campaigns, tunings, vehicles, controllers, papers and solvers, one line each.

    Returns:
        Each by its name: `scenarios`, with their `description`, `group` and the verdict that they `expect`, and
        `campaigns`, `tunings`, `vehicles`, `controllers`, `papers` and `solvers`, with a sentence.

    Examples:
        >>> import quadsim
        >>> found = quadsim.catalogue()
        >>> [name for name, each in found.scenarios.items() if each.group == "ground"]
        ['ground-effect', 'hard-landing', 'take-off-and-landing']
        >>> found.controllers["lqr"]
        "infinite-horizon LQR on the hover model, following the reference's velocity"
    """
    from scenarios.catalogue import read_catalogue

    return read_catalogue()


@app.command(help_epilogue=_examples("quadsim doctor", "quadsim doctor --json"))
def doctor() -> Listing:
    """What this machine can do: cores, packages, rendering, viewer, and every QP solver tried on a step.

    Returns:
        Checks by section (machine, packages, rendering, viewer, solvers), each a line that a person can act on.

    Examples:
        >>> import quadsim
        >>> found = quadsim.doctor()
        >>> found["solvers"]["piqp-multistage"].startswith("works")
        True
        >>> sorted(found)
        ['machine', 'packages', 'rendering', 'solvers', 'viewer']
    """
    from scenarios.machine import capabilities
    from scenarios.results import Listing

    return Listing(capabilities())
