"""A flown scenario in memory: named arrays, numbers, pictures, and its run directory."""

from __future__ import annotations

import contextlib
import logging
import shlex
import time as clock
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import cached_property
from html import escape
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from quadsim.console.progress import Progress, reporting, silent
from quadsim.console.results import EXIT_DONE, EXIT_FAILED, Result, Shown, plot_html
from quadsim.controller import NOT_CONVERGED
from quadsim.errors import MissingPackageError, OutputError, UnknownNameError, failure_line
from quadsim.flight import metrics, rundir
from quadsim.flight.audit import (
    VERDICT_TEXT,
    Finding,
    flight_verdict,
    margins_at,
    margins_sampled,
    worst_finding,
)
from quadsim.flight.log import FlightLog, PlantLog, columns_of
from quadsim.flight.parquet import FORMAT, log_tables, write_log
from quadsim.flight.rundir import limit_to_json
from quadsim.interrupts import current_hold
from quadsim.outputs import absolute, adding, amend, to_json, writing
from quadsim.plausibility import implausible
from quadsim.rollout.flight_events import story
from quadsim.rollout.machine import machine, versions
from quadsim.scenarios.courses.csv_course import Csv
from quadsim.scenarios.feasibility_check import report
from quadsim.scenarios.mismatch import model_notes
from quadsim.scenarios.schema.scenario import Scenario
from quadsim.scenarios.schema.settings import leaves
from quadsim.sim.airframe import outline
from quadsim.sim.estimator import Tally
from quadsim.sim.sensing import SensorName
from quadsim.state import REFERENCE_NAMES, STATE_NAMES, Array
from quadsim.vehicle import Vehicle

if TYPE_CHECKING:
    import pyarrow as pa

    from quadsim.flight.audit import FlightVerdict  # only here: Jedi completes no object with a property of a Literal
    from quadsim.mpc.ocp import InfeasiblePeriod
    from quadsim.report.figure import Figure
    from quadsim.rollout.flight_plot import Overlay
    from quadsim.scenarios.assembly import Assembly

_log: Final = logging.getLogger("quadsim")
_PRODUCTS: Final = {rundir.RECORDING_FILE: "recording", rundir.FIGURES_DIR: "figures", rundir.VIDEO_FILE: "video"}
INTERRUPTED: Final = "interrupted (Ctrl-C)"


@dataclass(frozen=True, kw_only=True, repr=False)
class Flight(Result):
    """A flown scenario.

    Arrays with one row per control period k, taken at t_k, are `time`, `state`, `measured`, `reference`, `command` and
    `margins`; `plant` has the vehicle in between, at the physics rate (when read from a directory: at the scenario's
    `log_rate`). Angles are in rad; `docs/conventions.md` defines states, frames and margins.

    Attributes:
        assembly: the parts of its scenario, which is resolved: it contains every number of its vehicle.
        log: the flight as stacked arrays.
        findings: the audit, one per constraint of the scenario.
        controller: name of the control law.
        solver: name of its QP solver; empty for a closed form.
        simulate_s: wall time of the closed loop alone [s].
        tallies: counts of each sensor's samples in the estimator; empty without one.
        directory: where it was read from or written to; None if it is only in memory.
        recorded: `summary.json` of a flight that was read; None for a new flight.
        infeasible_period: the first period whose QP had no answer; None if there is none, or the flight was read.
        own_code: whether a controller, force or autopilot flew that was passed in, which the scenario cannot repeat.
        try_remedies: flies what the explanation of a failure suggests, see `quadsim.rollout.remedies.tried`; None for a
            flight that was read.

    Examples:
        >>> import quadsim
        >>> flight = quadsim.fly(quadsim.load("hover").replace({"duration": 1.0}))
        >>> flight.outcome, flight.time.shape, flight.command.shape
        ('satisfied', (20,), (20, 4))
        >>> bool(flight.margins["roll"].min() > 0.0)
        True
    """

    assembly: Assembly
    log: FlightLog = field(repr=False)
    findings: tuple[Finding, ...] = field(repr=False)
    controller: str
    solver: str
    simulate_s: float
    tallies: Mapping[SensorName, Tally] = field(repr=False)
    directory: Path | None = None
    recorded: Mapping[str, Any] | None = field(default=None, repr=False)
    infeasible_period: InfeasiblePeriod | None = field(default=None, repr=False)
    own_code: bool = field(default=False, repr=False)
    try_remedies: Callable[[Mapping[str, Any], Flight], dict[str, Any]] | None = field(default=None, repr=False)

    @property
    def scenario(self) -> Scenario:
        """The scenario flown, with every number of its vehicle."""
        return self.assembly.scenario

    @property
    def vehicle(self) -> Vehicle:
        """The modelled vehicle, as the controller knows it."""
        return self.assembly.vehicle

    @property
    def actual(self) -> Vehicle:
        """The actual vehicle: the modelled one with the values of the scenario's `[actual]`."""
        return self.assembly.actual

    @property
    def satisfied(self) -> bool:
        """Whether the verdict is `satisfied`."""
        return self.outcome == "satisfied"

    def __repr__(self) -> str:
        flown = f"{self.log.control.t.size * self.scenario.control_period:.2f} s"
        end = self.assembly.course_cut if self.recorded is None else self.recorded.get("course", {}).get("cut_before")
        if end is not None:
            flown += f" of a course that ends at {end:g} s"
        line = f"<Flight {self.scenario.name}: {self.outcome}, {flown} by {self.controller}"
        return f"{line}{f', {self.log.reason}' if self.log.reason else ''}{worst_margin(self.findings)}>"

    @property
    def outcome(self) -> FlightVerdict:
        """The verdict in one word, see `quadsim.flight.audit.flight_verdict`."""
        return flight_verdict(
            self.findings,
            aborted=self.log.aborted,
            lost=self.log.reason is not None,
            failed=metrics.failure(self.log.control) is not None,
        )

    @cached_property
    def diagnosis(self) -> Mapping[str, Any] | None:
        """Why the first QP without an answer had none, and what helps; None if all QPs had one.

        If all had one and a constraint does not hold, it explains the first SQP that did not converge, if any.  What is
        advised has been flown, in `quadsim.rollout.remedies.MOST_FLOWN` flights at most; this takes seconds, once.

        `sentence` and `advice` are for users; `docs/audit.md` explains the other entries.
        """
        explanation = self._explanation
        if explanation is None or self.try_remedies is None:
            return explanation
        return self.try_remedies(explanation, self)

    @cached_property
    def _explanation(self) -> Mapping[str, Any] | None:
        """`diagnosis` before anything is flown."""
        if self.recorded is not None:
            return self.recorded.get("diagnosis")
        if self.infeasible_period is None or (self.infeasible_period.status == NOT_CONVERGED and self.satisfied):
            return None
        from quadsim.rollout.infeasibility import diagnose

        spec = self.scenario.controller_at(self.infeasible_period.time)
        scenario = self.scenario.altered(controller=spec, events=())
        return diagnose(self.infeasible_period, scenario, self.vehicle, self.log.control.status)

    @property
    def audit(self) -> tuple[Finding, ...]:
        """The audit at the physics rate, one finding per constraint of the scenario."""
        return self.findings

    @property
    def time(self) -> Array:
        """(K,) t_k of each control period [s]."""
        return self.log.control.t

    @cached_property
    def state(self) -> dict[str, Array]:
        """(K,) of each true state, by name [m, m/s, rad, rad/s]; names as in `quadsim.state.STATE_NAMES`."""
        return dict(zip(STATE_NAMES, self.log.control.truth.T, strict=True))

    @cached_property
    def measured(self) -> dict[str, Array]:
        """(K,) of each state as the controller received it; equal to `state` if measurement is perfect."""
        return dict(zip(STATE_NAMES, self.log.control.state.T, strict=True))

    @cached_property
    def reference(self) -> dict[str, Array]:
        """(K,) of the filtered reference x, y, z [m], yaw [rad]."""
        return dict(zip(REFERENCE_NAMES, self.log.control.reference.T, strict=True))

    @cached_property
    def logged(self) -> dict[str, Array]:
        """(K,) of each signal that the controller logged (`StepInputs.log`), NaN in periods without a value."""
        return {name: values for name, (_, values) in self.log.control.logged.items()}

    @property
    def command(self) -> Array:
        """(K, 4) commanded rotor speeds [rad/s]."""
        return self.log.control.speeds

    @cached_property
    def plant(self) -> dict[str, Array]:
        """(M,) of the time `t` [s], each true state, and rotor speeds `w1` .. `w4` [rad/s], between commands."""
        log = self.log.plant
        speeds = dict(zip(columns_of(PlantLog)["speeds"].units, log.speeds.T, strict=True))
        return {"t": log.t, **dict(zip(STATE_NAMES, log.state.T, strict=True)), **speeds}

    @cached_property
    def margins(self) -> dict[str, Array]:
        """(K,) of each constraint, by name: its smallest signed margin within the period; negative = violated.

        At the rate of `plant`, in the constraint's unit; NaN outside its time window.  The smallest of all is the
        audit's `worst_margin`. See `docs/conventions.md`.
        """
        plant, t = self.log.plant, self.time
        starts = np.minimum(np.searchsorted(plant.t, t - 1e-9), max(plant.t.size - 1, 0))
        margins: dict[str, Array] = {}
        for finding in self.findings:
            limit, signal = finding.limit, finding.limit.source
            if signal.plant is None or not t.size:
                margins[limit.name] = margins_sampled(limit, self.log)
            else:
                between = margins_at(limit, plant.t, signal.plant(plant))
                margins[limit.name] = np.fmin.reduceat(between, starts)
        return margins

    @cached_property
    def summary(self) -> Mapping[str, Any]:
        """All numbers: the content of `summary.json`."""
        return self._numbers if self.recorded is not None else {**self._numbers, "diagnosis": self.diagnosis}

    @cached_property
    def _numbers(self) -> Mapping[str, Any]:
        """`summary` before a change that its diagnosis advises is flown."""
        return self.recorded if self.recorded is not None else summarise(self)

    @cached_property
    def metrics(self) -> dict[str, float]:
        """The flight's numbers by name, e.g. `rmse.x`, `speed_max`, `step_ms.p99`; units as in `summary`."""
        numbers = (leaf for name in ("tracking", "control", "controller") for leaf in leaves(self._numbers[name]))
        return {
            name: value for name, value in numbers if isinstance(value, int | float) and not isinstance(value, bool)
        }

    @property
    def run(self) -> rundir.Run:
        """The flight in the form that figures and pages use."""
        return self._run(self.summary)

    @property
    def undiagnosed_run(self) -> rundir.Run:
        """`run` for figures, before a change that its diagnosis advises is flown."""
        return self._run(self._numbers)

    def _run(self, summary: Mapping[str, Any]) -> rundir.Run:
        limits = tuple(finding.limit for finding in self.findings)
        directory = self.directory or Path(self.scenario.name)
        return rundir.Run(directory=directory, summary=dict(summary), log=self.log, vehicle=self.actual, limits=limits)

    def to_arrow(self, table: str = "flight") -> pa.Table:
        """A table of the flight, units in its columns' metadata.

        Args:
            table: `flight` (a row per control period), `plant` (between the commands), `timing` (what a clock
                measured), or `horizon` (the positions that were predicted).

        Raises:
            UnknownNameError: the flight has no such table.
        """
        tables = log_tables(self.log, metadata=self.metadata)
        if table not in tables:
            raise UnknownNameError("table", table, tables)
        return tables[table]

    def to_pandas(self, table: str = "flight") -> Any:
        """The same as a pandas DataFrame.

        Raises:
            MissingPackageError: pandas is not installed.
        """
        return to_pandas(self.to_arrow(table))

    def plot(self, *signals: str, **options: Any) -> Overlay:
        """Draw signals over time with their references and bounds: `quadsim.plot` of this flight.

        Args:
            signals: as in `quadsim.plot`.
            options: its `labels`, `width`, `out` and `overwrite`.

        Returns:
            The matplotlib axes, top to bottom.

        Raises:
            InputError: as in `quadsim.plot`.
        """
        from quadsim.rollout.flight_plot import plot_runs

        return plot_runs([self.undiagnosed_run], signals, **options)

    def save(
        self,
        directory: str | Path,
        *,
        overwrite: bool = False,
        video: bool | None = None,
        recording: bool | None = None,
        figures: bool | None = None,
        fps: int | None = None,
        progress: Progress = silent,
    ) -> Path:
        """Write the run directory, as `quadsim run` does: tables and summary first, then figures, recording and video.

        Args:
            directory: run directory.
            overwrite: whether to replace an earlier output.
            video: whether to film the flight; None: if possible; True: raise if it fails.
            recording: whether to write `flight.rrd` for the rerun viewer, as for `video`.
            figures: whether to plot the flight, as for `video`.
            fps: frames per second of the video; None: 30, or 20 from half a minute on.
            progress: called with (activity, done, total).

        Returns:
            The directory.

        Raises:
            ParameterError: `fps` is out of range.
            RenderingUnavailableError: a video is requested but cannot be rendered.
            OutputError: the directory cannot be written or contains other files, the flight was read from a directory,
                or a requested product failed; in that case the tables and the summary are written.
        """
        if self.recorded is not None:
            raise OutputError(directory, f"this flight is on disk already, in {self.directory}; copy that directory")
        require_film(video, fps)
        if self.write_tables(directory, overwrite=overwrite):
            products = {"video": video, "recording": recording, "figures": figures}
            self.add_products(directory, **products, fps=fps, progress=progress)
        return Path(directory)

    def write_tables(self, directory: str | Path, *, overwrite: bool = False) -> bool:
        """Write the run directory without figures, recording and video; errors as `save`.

        Returns:
            Whether products may follow: Ctrl-C here is heeded, but loses no flight.
        """
        started = clock.perf_counter() - self.simulate_s

        def write(*, overwrite: bool) -> None:
            with writing(directory, overwrite=overwrite) as partial:
                (partial / rundir.SCENARIO_FILE).write_text(self.assembly.to_toml(), encoding="utf-8")
                course = self.scenario.reference
                if isinstance(course, Csv) and course.content is not None:
                    (partial / course.file).write_bytes(course.content)
                write_log(partial, self.log, plant_stride=self.scenario.plant_stride, metadata=self.metadata)
                wall_s = {"simulate": self.simulate_s, "total": clock.perf_counter() - started}
                summary = to_json({**self._numbers, "wall_s": wall_s})
                (partial / rundir.SUMMARY_FILE).write_text(summary, encoding="utf-8")

        try:
            write(overwrite=overwrite)
        except KeyboardInterrupt:
            write(overwrite=True)
            return False
        try:
            current_hold().release()
            if self._explanation is not None:
                diagnosis = self.diagnosis  # which flies the changes that it advises
                amend(absolute(directory), {"diagnosis": diagnosis})
        except KeyboardInterrupt:
            return False
        return True

    def add_products(
        self,
        directory: str | Path,
        *,
        video: bool | None = None,
        recording: bool | None = None,
        figures: bool | None = None,
        fps: int | None = None,
        progress: Progress = silent,
    ) -> None:
        """Add figures, recording and video to the run directory; arguments and errors as `save`."""
        target, started = absolute(directory), clock.perf_counter()
        before = rundir.read_summary(target)["wall_s"]["total"]
        requested = {"recording": recording, "figures": figures, "video": video}
        failed = _add_products(self, target, requested, progress, fps)
        amend(target, {"wall_s": {"total": before + clock.perf_counter() - started}})
        for path, problem in failed.items():
            raise OutputError(path, f"{problem}; all else is there")

    @property
    def exit_status(self) -> int:
        """See `Result.exit_status`."""
        return EXIT_DONE if self.outcome in ("satisfied", "incomplete", "unaudited") else EXIT_FAILED

    def shown(self) -> Shown:
        """See `Result.shown`."""
        from quadsim.console.summary_tables import summary_tables

        return summary_tables(self.to_json())

    def outputs(self) -> Shown:
        """See `Result.outputs`."""
        from quadsim.console import console

        if self.directory is None:
            return
        yield console.written_to(self.directory)
        for name in (rundir.VIDEO_FILE, rundir.FIGURES_DIR):
            if (self.directory / name).exists():
                yield console.to_open(self.directory / name)
        if (self.directory / rundir.RECORDING_FILE).exists():
            yield console.to_open(self.directory, "quadsim view")
        if self.time.size:
            words = ("quadsim", "plot", console.short_path(self.directory), "--out", f"{self.directory.name}.pdf")
            yield console.command(shlex.join(words))

    def to_json(self) -> dict[str, Any]:
        """Return `summary.json`, the recorded one if the flight is on disk."""
        return dict(self.summary) if self.directory is None else rundir.read_summary(self.directory)

    def small_plot(self) -> Figure | None:
        """See `Result.small_plot`: position over time."""
        from quadsim.report.flight_figures import signals

        return signals([self.undiagnosed_run], ("x", "y", "z")) if self.time.size else None

    def _repr_html_(self) -> str:
        """Numbers and a small plot, for notebooks."""
        from quadsim.report.comparison import tolerance_text

        rows = "".join(
            f"<tr><td>{escape(entry.limit.name)}</td><td>{entry.margin:.4g} {escape(entry.limit.unit)}</td>"
            f"<td>{escape(tolerance_text(entry.limit))}</td><td>{VERDICT_TEXT[entry.verdict]}</td></tr>"
            for entry in self.findings
        )
        errors = ", ".join(f"{name} {self.metrics[f'rmse.{name}']:.3g}" for name in "xyz" if self.time.size)
        return (
            f"<p><b>{escape(self.scenario.name)}</b>: {self.outcome}, {self._numbers['duration']:g} s flown, "
            f"RMS error [m]: {errors or 'none'}</p>"
            "<table><tr><th>constraint</th><th>margin</th><th>tolerance</th><th>verdict</th></tr>"
            f"{rows}</table>{plot_html(self.small_plot())}"
        )

    @property
    def metadata(self) -> dict[str, str]:
        """The metadata of its tables' schemas."""
        return {"scenario": self.scenario.name, "seed": str(self.scenario.seed)}


def to_pandas(table: pa.Table) -> Any:
    """An Arrow table as a DataFrame.

    Raises:
        MissingPackageError: pandas is not installed.
    """
    if find_spec("pandas") is None:
        raise MissingPackageError("a DataFrame", "pandas", extra="pandas")
    return table.to_pandas()


def worst_margin(findings: Iterable[Finding]) -> str:
    """The worst margin, see `worst_finding`, as the second line of a repr."""
    from quadsim.report.comparison import tolerance_text

    worst = worst_finding(findings)
    if worst is None:
        return ""
    limit = worst.limit
    return f"\n worst margin: {limit.name} {worst.margin:.4g} {limit.unit}, tolerance {tolerance_text(limit)}"


def write_run(
    flight: Flight,
    directory: Path,
    products: Mapping[str, bool | None],
    *,
    overwrite: bool,
    fps: int | None = None,
    progress: Progress | bool,
    flown: Callable[[Flight], object] | None,
) -> None:
    """Write the tables, call `flown`, and add the products."""
    more = flight.write_tables(directory, overwrite=overwrite)
    if flown is not None:
        flown(flight)
    if more:
        with reporting(progress) as report:
            try:
                flight.add_products(directory, fps=fps, progress=report, **products)
            except OutputError as error:
                if error.path.parent == directory:  # a product that was requested explicitly
                    error.result = flight
                raise


def require_film(video: bool | None, fps: int | None = None) -> None:
    """Raise if a requested video cannot be made here, before the flight.

    Raises:
        ParameterError: `fps` is out of range.
        RenderingUnavailableError: this machine cannot render.
    """
    if not video and fps is None:
        return
    from quadsim.report.film.video import frame_rate, rendering_backend

    frame_rate(0.0, fps)
    if video:
        rendering_backend()


def summarise(flight: Flight) -> dict[str, Any]:
    """Return `summary.json` of a flight, without the hashes of its files and the total wall time."""
    scenario, log = flight.scenario, flight.log
    ground = scenario.effects.ground
    flown = log.control.t.size > 0
    samples = {str(name): asdict(tally) for name, tally in flight.tallies.items()}
    estimation = {} if log.control.measured_perfectly else {**metrics.estimation(log.control), "samples": samples}
    steps = flight.assembly.course_steps
    course_cut = flight.assembly.course_cut
    numbers = metrics.flight_numbers(log, deadline_ms=1e3 * scenario.control_period, course=steps)
    notes = implausible(flight.actual)
    notes += model_notes(flight.assembly) if flight.controller == scenario.controller.type else []
    return {
        "format": FORMAT,
        "scenario": scenario.name,
        "description": scenario.description,
        "status": log.status,
        "reason": log.reason,
        **({"traceback": [*log.traceback]} if log.traceback else {}),
        "lost": log.lost,
        "satisfied": flight.satisfied,
        "verdict": flight.outcome,
        "group": scenario.group,
        "expected": scenario.expect,
        "as_expected": flight.outcome == scenario.expect,
        "duration": round(log.control.t.size * scenario.control_period, 9),
        "seed": scenario.seed,
        "course": asdict(report(flight.assembly)) | ({} if course_cut is None else {"cut_before": course_cut}),
        **({"events": events} if (events := story(scenario, log.control.t.size * scenario.control_period)) else {}),
        "tracking": numbers["tracking"],
        "constraints": [limit_to_json(finding) for finding in flight.findings],
        "audit_notes": flight.assembly.audit_notes,
        **({"model_notes": notes} if notes else {}),
        "control": numbers["control"],
        "diagnosis": flight._explanation,
        "controller": {
            "name": flight.controller,
            "solver": flight.solver,
            "horizon": scenario.controller.horizon,
            **numbers["controller"],
            **({} if log.control.target is None else {"autopilot": flight.assembly.autopilot_flown}),
        },
        **({"computation": metrics.computation(log.control)} if flown and flight.assembly.computation() else {}),
        **({"estimation": estimation} if estimation else {}),
        **({"ground": metrics.ground(log, outline(flight.actual))} if flown and ground and ground.contact else {}),
        "vehicle": asdict(flight.vehicle),
        **({"actual": asdict(flight.actual)} if flight.actual != flight.vehicle else {}),
        "wall_s": {"simulate": flight.simulate_s, "total": flight.simulate_s},
        "versions": versions(),
        "machine": machine(),
        "products": {},
        "files": {},
    }


def _add_products(
    flight: Flight, directory: Path, requested: Mapping[str, bool | None], progress: Progress, fps: int | None
) -> dict[Path, str]:
    """Add recording, figures and video, made from the files; return which requested ones failed, and why.

    Ctrl-C stops the current one and skips the rest.
    """
    run, failed = rundir.load_run(directory), dict[Path, str]()
    has_periods = bool(run.log.control.t.size)
    if requested["recording"] is not False:
        with _product(directory, rundir.RECORDING_FILE, failed) as folder:
            from quadsim.report.recording import write_recording

            progress("recording", 0, 1)
            write_recording(run, folder / rundir.RECORDING_FILE)
        progress("recording", 1, 1)
    if requested["figures"] is not False and has_periods and INTERRUPTED not in failed.values():
        with _product(directory, rundir.FIGURES_DIR, failed) as folder:
            from quadsim.report.flight_figures import write_figures

            progress("figures", 0, 1)
            write_figures(run, folder / rundir.FIGURES_DIR)
            progress("figures", 1, 1)
    interrupted = flight.log.interrupted or INTERRUPTED in failed.values()
    if requested["video"] is not False and has_periods and not interrupted:
        from quadsim.console.console import short_path

        failed |= add_films([run], note=f"all else is in {short_path(directory)}", progress=progress, fps=fps)
    demanded = {name: requested[product] for name, product in _PRODUCTS.items()}
    return {path: problem for path, problem in failed.items() if demanded[path.name] and problem != INTERRUPTED}


def add_films(
    runs: Sequence[rundir.Run], *, note: str, progress: Progress = silent, fps: int | None = None
) -> dict[Path, str]:
    """Film flights into their run directories; return which films failed, and why.

    Ctrl-C stops the current one and skips the rest.  `note` says, beside the estimated time, what can be opened
    meanwhile.
    """
    from quadsim.report.film.video import Estimate, frame_count, frame_rate, render_video

    failed: dict[Path, str] = {}
    estimate = Estimate([frame_count(run.end, frame_rate(run.end, fps)) for run in runs], note)

    def follow(done: int, total: int) -> None:
        estimate(done, total)
        progress("video", done, total)

    for run in runs:
        if INTERRUPTED not in failed.values():
            with _product(run.directory, rundir.VIDEO_FILE, failed) as folder:
                progress("video", 0, 1)  # until the renderer has started
                render_video(run.directory, folder / rundir.VIDEO_FILE, progress=follow, fps=fps)
    return failed


@contextlib.contextmanager
def _product(directory: Path, name: str, failed: dict[Path, str]) -> Iterator[Path]:
    """A folder for a product of a run directory; if it cannot be made, the summary and `failed` say why."""
    try:
        with adding(directory, products={name: "made"}) as folder:
            yield folder
        return
    except KeyboardInterrupt:
        problem = INTERRUPTED
    except Exception as error:
        problem = failure_line(error)
    failed[directory / name] = problem
    amend(directory, {"products": {name: problem}})
    _log.warning("%s %s", name, problem)
