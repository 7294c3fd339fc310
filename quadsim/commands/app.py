"""The functions of quadsim: the API of `import quadsim` and the commands of the command line.

A function under `@app.command` is both.  Only `quadsim.commands.cli` prints; it shows the results
(`quadsim.console.results`).  Heavy imports are inside the functions, so that importing this module is fast.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from cyclopts import App, Parameter

from quadsim.errors import FileError, InputError, ParameterError
from quadsim.features.arguments import (
    Changes,
    ComparedName,
    File,
    Flag,
    Flown,
    Inches,
    Labels,
    Names,
    Plotted,
    ScenarioName,
    SignalName,
    StyleName,
    UserCode,
    UserForces,
    UserReference,
    VehicleName,
    Watched,
    Whole,
)
from quadsim.features.entries import FEATURES, owner_of

if TYPE_CHECKING:
    from quadsim.console.results import Listing, Result
    from quadsim.controller import AutopilotLoop
    from quadsim.flight.feasibility import Feasibility
    from quadsim.mpc.pilot.pilot import Pilot
    from quadsim.mpc.problem.ocp import Problem
    from quadsim.rollout.flight_plot import Overlay
    from quadsim.rollout.flown import Flight
    from quadsim.rollout.rollout import Rollout
    from quadsim.scenarios.catalogue import Catalogue
    from quadsim.scenarios.schema.scenario import Scenario
    from quadsim.vehicle import Vehicle
else:  # cyclopts looks up the annotations of a command; the classes of results are too heavy to import for that
    Catalogue = Flight = Listing = Overlay = Result = Any


def _examples(*lines: str) -> str:
    """Return the examples at the end of a command's help."""
    return "\n  ".join(["examples:", *lines])


def _version() -> str:
    """Return the line of `quadsim --version`."""
    from importlib.metadata import version

    return f"quadsim {version('quadsim')}"


app: Final = App(
    name="quadsim",
    help="Fly model predictive controllers of quadrotors in MuJoCo; record, film and audit every flight.",
    help_epilogue="exit status: 0 done; 1 a required constraint is violated, or the flight was aborted; 2 wrong input; "
    "130 interrupted by Ctrl-C, 143 by SIGTERM",
    help_format="plaintext",
    default_parameter=Parameter(show_default=False, negative_iterable=(), allow_repeating=True),
    version=_version,
)
for _name, _feature in FEATURES.items():
    for _word, _command in _feature.commands.items():
        app.command(
            f"quadsim.features.{_name}.commands:{_command.function}",  # imported when it is called
            name=_word,
            help=_command.help,
            help_epilogue=_examples(*_command.examples),
        )
_log: Final = logging.getLogger("quadsim")


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
    from quadsim.scenarios.loading import load_scenario

    return load_scenario(name, changes)


def feasibility(scenario: ScenarioName) -> Feasibility:
    """Compare a course with the vehicle's limits and the controller's bounds (also the tightened ones), without flying.

    Args:
        scenario: the scenario, or its name or file.

    Returns:
        The peaks of the course, such as `tilt` [deg]; `problems`, what it needs beyond limits and bounds; a `sentence`.

    Raises:
        InputError: the course cannot be built.

    Examples:
        >>> import quadsim
        >>> quadsim.feasibility("hover").problems
        ()
        >>> fast = quadsim.load("figure-eight").replace({"reference.period": 6.0, "reference.ramp": 3.0})
        >>> quadsim.feasibility(fast).problems[0]
        '40.4 deg of roll (limit 5 deg)'
    """
    from quadsim.rollout.stability import instability_notes
    from quadsim.scenarios import feasibility_check, loading

    assembly = loading.assemble(scenario)
    report = feasibility_check.report(assembly)
    return replace(report, notes=(*report.notes, *instability_notes(assembly)))


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
    from quadsim.scenarios.loading import assemble

    return assemble(scenario).controller()


def problem(scenario: ScenarioName) -> Problem:
    """Return the optimal control problem of a scenario's controller: matrices, weights and constraints as numpy arrays.

    `model` has A (n, n), B (n, 4), u_bar (4,) [rad/s]; `objective` C_r, Q_y, Q_u; `rows` the constraints, lower <=
    C x + D u + E (u - u_before) <= upper.  `condensed()` and `qp(state, reference, u_before)` give the QP.

    The problem of `robust` has its soft and tightened rows, weights of moves and rotor lag.  Its first state is that at
    the end of the delay; with `heading`, its axes are turned by the yaw.  An estimated disturbance moves its
    `equilibrium`.  Half-spaces of `controller.avoidance` differ from period to period and are left out.

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
    from quadsim.scenarios.loading import assemble

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
    from quadsim.console.progress import reporting

    with reporting(progress, "the flight") as report:
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
    fps: Whole | None = None,
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
        fps: frames per second of the video (default: 30, or 20 for flights of half a minute or more).
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
    from quadsim.console.progress import reporting
    from quadsim.interrupts import SignalHold
    from quadsim.outputs import run_directory
    from quadsim.rollout.flown import require_film, write_run
    from quadsim.rollout.rollout import Rollout
    from quadsim.rollout.stability import instability_notes
    from quadsim.scenarios import loading, user_code
    from quadsim.scenarios.feasibility_check import notes

    require_film(video, fps)
    assembly = loading.assemble(scenario, changes, seed)
    assembly, law, acting_forces = user_code.set_up(assembly, controller, forces, reference)
    products = {"video": video, "recording": recording, "figures": figures}
    for note in (*notes(assembly), *instability_notes(assembly)):
        _log.info(note)
    with run_directory(assembly.scenario.name, out, overwrite=overwrite) as directory, SignalHold():
        with reporting(progress, "the flight") as report:
            flight = Rollout(assembly, law, acting_forces).fly(report)
        return write_run(flight, directory, products, overwrite=overwrite, fps=fps, progress=progress, flown=flown)


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
    from quadsim.rollout.rollout import Rollout
    from quadsim.scenarios import loading, user_code

    assembly = loading.assemble(scenario)
    assembly, law, acting_forces = user_code.set_up(assembly, controller, forces, reference, autopilot)
    return Rollout(assembly, law, acting_forces, live=live, recorded=recorded)


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
    from quadsim.rollout.stored import read_flight

    return read_flight(Path(directory))


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
) -> Flight:
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
    from quadsim.console.junit import junit_file, write_junit
    from quadsim.console.results import after
    from quadsim.scenarios.catalogue import names_directory

    file = None
    if junit is not None:
        file = junit_file(junit)  # refused, if at all, before anything is flown
    if isinstance(target, str | Path) and names_directory(target):
        if changes:
            raise ParameterError("", "--set", changes, "absent when a finished run is checked")
        if seed is not None:
            raise ParameterError("", "--seed", seed, "absent when a finished run is checked")
        audited = _check_run(target)
    else:
        audited = _check_scenario(target, changes, seed, progress)
    if file is not None:
        with after(audited, file):
            write_junit(audited, file)
    return audited


def _check_run(directory: str | Path) -> Flight:
    """Return a finished run, audited again from its tables."""
    from quadsim.rollout.reaudit import reaudit

    owner = owner_of(Path(directory))
    if owner is not None:
        raise InputError(owner.check_advice(directory))
    flight = reaudit(Path(directory))
    for note in flight.notes:
        _log.info("%s: %s", directory, note)
    return flight


def _check_scenario(scenario: ScenarioName, changes: Changes, seed: Whole | None, progress: Watched) -> Flight:
    """Return the audited flight of a scenario."""
    from quadsim.console.progress import reporting
    from quadsim.rollout.flown import Check
    from quadsim.rollout.rollout import Rollout
    from quadsim.rollout.stability import instability_notes
    from quadsim.scenarios import loading
    from quadsim.scenarios.feasibility_check import leftover_notes

    assembly = loading.assemble(scenario, changes, seed)
    for note in (*leftover_notes(assembly), *instability_notes(assembly)):
        _log.info(note)
    with reporting(progress, "the flight") as report:
        flight = Rollout(assembly).fly(report)
    return replace(flight, checked=Check())


@app.command(
    help_epilogue=_examples(
        "quadsim compare paper-unconstrained paper-constrained --out runs/comparison",
        "quadsim compare runs/mine runs/other --name mine --name theirs --markdown",
    )
)
def compare(
    *targets: ComparedName,
    out: File | None = None,
    overwrite: Flag = False,
    names: Names = (),
    markdown: Flag = False,
    constraints: ComparedName | None = None,
    video: bool | None = None,
    recording: bool | None = None,
    figures: bool | None = None,
    fps: Whole | None = None,
    progress: Watched = True,
    flown: Flown = None,
) -> Result:
    """Compare flights, or two campaigns flight by flight: table, figures, HTML page.

    With `out`, scenarios are flown into run directories below OUT-runs, beside the page.  The page is there before the
    films, which are added to it.

    Args:
        targets: run directories, scenarios to fly, or the directories of two campaigns.
        out: directory for the page, its figures and its table.
        overwrite: replace an earlier output, if its summary.json lists every file in the directory.
        names: name of a column, once for each target and in their order (default: scenario, and what tells its flights
            apart).
        markdown: print the table as Markdown.
        constraints: one of the targets, whose constraints and tolerances all are audited against, from their tables.
        video: film every flight that has no film (default: those that it flies, if possible).
        recording: write flight.rrd for the rerun viewer, of the scenarios that it flies (default: if possible).
        figures: plot them (default: if possible).
        fps: frames per second of the films (default: 30, or 20 for flights of half a minute or more).
        progress: as in `fly`.
        flown: called with the comparison of flights as soon as its page is written, before the films.

    Raises:
        InputError: a target is neither a run, a scenario nor a campaign, or the names are wrong; nothing was flown.
        OutputError: the page, or a requested film, cannot be written; in the second case its `result` is the
            comparison.
        RenderingUnavailableError: a video is requested but cannot be rendered; nothing was flown.

    Examples:
        >>> import quadsim
        >>> hover = quadsim.load("hover").replace({"duration": 1.0})
        >>> pid = hover.replace({"controller": {"type": "pid"}})
        >>> quadsim.compare(quadsim.fly(hover), quadsim.fly(pid)).to_markdown().count("|") > 10
        True
    """
    from quadsim.console.progress import reporting
    from quadsim.console.results import Document
    from quadsim.outputs import absolute
    from quadsim.rollout.flight_comparison import compare_flights

    if not targets:
        raise InputError("compare needs runs, scenarios, or two campaigns")
    page = None
    if out is not None:
        page = absolute(out)
    owner = _owner_of_any(targets)
    products = {"video": video, "recording": recording, "figures": figures}
    for name, is_wanted in products.items():
        if is_wanted:
            _check_product(name, of_campaigns=owner is not None, is_written=page is not None)
    compared: Any
    if owner is not None:
        directories = [Path(str(target)) for target in targets]
        compared = owner.compare_directories(
            directories, page, overwrite=overwrite, names=names, constraints=constraints
        )
    else:
        options: dict[str, Any] = {"names": names, "products": products, "constraints": constraints, "fps": fps}
        if not markdown:  # Markdown is printed once, at the end
            options["flown"] = flown
        with reporting(progress, "the comparison") as report:
            compared = compare_flights(targets, page, report, overwrite=overwrite, **options)
    if markdown:
        return Document(compared.to_markdown() + "\n", compared.to_json())
    return compared


def _check_product(name: str, *, of_campaigns: bool, is_written: bool) -> None:
    """Refuse a product that is asked of a comparison that cannot have it."""
    if of_campaigns:
        raise ParameterError("", f"--{name}", True, "absent where campaigns are compared")
    if not is_written:
        raise ParameterError("", f"--{name}", True, "absent without --out: nothing is written")


def _owner_of_any(targets: Sequence[ComparedName]) -> Any:
    """Return the commands of the feature that made one of the targets; None if none did, as with `owner_of`."""
    for target in targets:
        if isinstance(target, str | Path):
            owner = owner_of(Path(target))
            if owner is not None:
                return owner
    return None


@app.command(
    help_epilogue=_examples(
        "quadsim plot runs/paper-constrained --signals x pitch margin.pitch step_ms",
        "quadsim plot runs/mine runs/other --signals error speed --labels mine theirs --out fig.pdf",
    )
)
def plot(
    flights: Plotted,
    /,
    *signals: SignalName,
    labels: Labels = (),
    width: Inches = 7.16,
    style: StyleName | None = None,
    out: File | None = None,
    overwrite: Flag = False,
) -> Overlay:
    """Draw signals of one or several flights over one another, with references and bounds.

    Args:
        flights: run directories; in Python also flights, one or several.
        signals: one panel each: names that constraints can have (x, pitch, tilt, x_error, speed, slew, ...), speed_1 to
            speed_4 (one rotor), command (commanded rotor speeds), margin.NAME (of a constraint), error (distance from
            the filtered reference), step_ms and solve_ms (computing time), xy (path from above), or what a controller
            logged (default: position and attitude).
        labels: names in the legend, one for each flight (default: scenario, and what tells its flights apart).
        width: of the figure [in]; 3.5 is one column of a journal, the default two.
        style: a style sheet of matplotlib, by its name or file; in Python also rcParams: {"font.family": "serif"}.
        out: PDF, SVG or PNG file, with texts of 8 pt; without it a window opens.
        overwrite: replace an existing file.

    Returns:
        The matplotlib axes, top to bottom; `axes[0].figure` is the figure, which is pyplot's unless `out` is given.

    Raises:
        InputError: a directory is not a run, no flight has such a signal, or the labels are wrong.
        OutputError: the file exists, or cannot be written.

    Examples:
        >>> import quadsim
        >>> hover = quadsim.load("hover").replace({"duration": 1.0})
        >>> pid = hover.replace({"controller": {"type": "pid"}})
        >>> axes = quadsim.plot([quadsim.fly(hover), quadsim.fly(pid)], "z", "margin.roll", labels=["MPC", "PID"])
        >>> axes[0].get_ylabel(), len(axes)
        ('z [m]', 2)
    """
    from quadsim.rollout.flight_plot import plot_runs
    from quadsim.rollout.flown import Flight
    from quadsim.rollout.stored import read_plotted

    if isinstance(flights, Flight | str | Path):
        flights = [flights]
    runs = []
    for flight in flights:
        if isinstance(flight, Flight):
            runs.append(flight)
        else:
            runs.append(read_plotted(Path(flight), runs))
    return plot_runs(runs, signals, labels=labels, width=width, style=style, out=out, overwrite=overwrite)


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
    fps: Whole | None = None,
    progress: Watched = True,
) -> Path:
    """Film a finished run.

    Args:
        directory: run directory.
        out: MP4 or GIF file (default: flight.mp4 in the run directory, replacing an earlier one).
        overwrite: replace an existing file.
        workers: rendering processes (default: one per core).
        fps: frames per second (default: 30, or 20 for flights of half a minute or more; 8 of a GIF).
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
    from quadsim.console.progress import reporting
    from quadsim.flight import rundir
    from quadsim.outputs import absolute, adding
    from quadsim.report.film.video import Estimate, render_gif, render_video
    from quadsim.rollout.reaudit import reaudit

    flight = reaudit(Path(directory), products=False)
    directory = absolute(directory)
    if out is None:
        path = absolute(directory / rundir.VIDEO_FILE)
    else:
        path = absolute(out)
    if workers is not None and workers < 1:
        raise ParameterError("", "--workers", workers, "at least 1")
    if path.suffix not in (".mp4", ".gif"):
        raise ParameterError("", "--out", out, "a file ending in .mp4 or .gif")
    with reporting(progress, "the film") as report:
        estimate = Estimate()

        def report_frames(done: int, total: int) -> None:
            estimate(done, total)
            report("video", done, total)

        render: Any = render_video
        if path.suffix == ".gif":
            render = render_gif
        render = partial(render, flight, workers=workers, fps=fps, progress=report_frames)
        is_product_of_run = path.parent == directory
        if is_product_of_run:
            with adding(directory, products={path.name: "made"}) as folder:  # its summary then lists the film
                render(folder / path.name, overwrite=False)
        else:
            render(path, overwrite=overwrite)
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
    if not path.exists():
        raise FileError(path, "no such run or recording")
    recording = path
    if path.is_dir():
        recording = path / rundir.RECORDING_FILE
    if not recording.is_file():
        raise FileError(path, f"has no {rundir.RECORDING_FILE}; run the scenario again without --no-recording")
    if path.is_dir():
        require_inside(path)
    if recording.suffix != ".rrd":
        raise FileError(path, "is not a recording; give a run directory or a file ending in .rrd")
    open_viewer(recording, web=web)


# --- files, code, and the catalogue --------------------------------------------------------------------------------


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
    """List scenarios, campaigns, vehicles, controllers, papers and solvers, one per line.

    Returns:
        Mappings by name: `scenarios`, with `description`, `group`, the expected verdict, `expect`, and `variant`, the
        `base` that it changes and what it has `set`, or None; and `campaigns`, `vehicles`, `controllers`, `papers` and
        `solvers`, with a sentence.

    Examples:
        >>> import quadsim
        >>> catalogue = quadsim.catalogue()
        >>> [name for name, entry in catalogue.scenarios.items() if entry.group == "ground"]
        ['ground-effect', 'hard-landing', 'take-off-and-landing']
        >>> catalogue.controllers["lqr"]
        "infinite-horizon LQR on the hover model, following the reference's velocity"
    """
    from quadsim.scenarios.catalogue import read_catalogue

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
        ['machine', 'many vehicles', 'packages', 'rendering', 'solvers', 'viewer']
    """
    from quadsim.commands.doctor import capabilities
    from quadsim.console.results import Listing

    return Listing(capabilities())
