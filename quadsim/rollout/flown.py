"""A flown scenario in memory: named arrays, numbers, pictures, and its run directory.

A `Flight` joins scenario, log and findings of the audit.  Text, JSON, tables, figures and films are made of this
object, never of files.  Tables and summary are written first, then recording, figures and film.
"""

from __future__ import annotations

import contextlib
import logging
import shlex
import time as clock
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from quadsim.console.junit import Cases, flight_verdicts
from quadsim.console.progress import Progress, reporting, silent
from quadsim.console.results import EXIT_DONE, EXIT_FAILED, Result, Shown, plot_html, require_pandas
from quadsim.controller import NOT_CONVERGED
from quadsim.errors import OutputError, UnknownNameError, failure_line
from quadsim.flight import metrics, rundir
from quadsim.flight.audit import (
    VERDICT_TEXT,
    Finding,
    Limit,
    flight_verdict,
    margins_at,
    margins_sampled,
    worst_finding,
)
from quadsim.flight.departure import DEPARTURE, Departure, departure_numbers, departure_of
from quadsim.flight.log import FlightLog, PlantLog, columns_of
from quadsim.flight.model_error import model_report
from quadsim.flight.parquet import FORMAT, log_tables, write_log
from quadsim.flight.rundir import limit_to_json
from quadsim.interrupts import current_hold
from quadsim.outputs import absolute, adding, amend, file_hashes, to_json, writing
from quadsim.plausibility import implausible
from quadsim.rollout.flight_events import story
from quadsim.rollout.machine import machine, versions
from quadsim.scenarios.courses.csv_course import Csv
from quadsim.scenarios.feasibility_check import report
from quadsim.scenarios.mismatch import model_notes
from quadsim.scenarios.plugin import is_plugin
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
    from quadsim.mpc.problem.ocp import InfeasiblePeriod
    from quadsim.report.figure import Figure
    from quadsim.rollout.flight_plot import Overlay
    from quadsim.scenarios.assembly import Assembly

_log: Final = logging.getLogger("quadsim")
_PRODUCTS: Final = {rundir.RECORDING_FILE: "recording", rundir.FIGURES_DIR: "figures", rundir.VIDEO_FILE: "video"}
"""Options of `Flight.save`, by the names of the products in a run directory."""
INTERRUPTED: Final = "interrupted (Ctrl-C)"
MADE: Final = "made"
"""State of a product in a summary; that of a product that is not there says why."""


@dataclass(frozen=True, kw_only=True)
class Check:
    """What `quadsim check` adds to a flight."""

    notes: tuple[str, ...] = ()  # remarks for the user that are not errors
    again: tuple[Finding, ...] | None = None
    """The audit from a run's tables, at the control samples and at the log rate; None if the flight was not read from a
    run, but flown for the check."""


@dataclass(frozen=True, kw_only=True, repr=False)
class Flight(Result):
    """A flown scenario: the one record from which text, JSON, tables, figures and films are made.

    Arrays with one row per control period k, taken at t_k, are `time`, `state`, `measured`, `reference`, `command` and
    `margins`; `plant` has the vehicle in between, at the physics rate (when read from a directory: at the scenario's
    `log_rate`). Angles are in rad; `docs/conventions.md` defines states, frames and margins.

    Attributes:
        scenario: the scenario flown, with every number of its vehicle.
        assembly: the parts that were built of it.
        log: the flight as stacked arrays.
        findings: the audit, one per constraint of the scenario.
        controller: name of the control law.
        solver: name of its QP solver; empty for a closed form.
        simulate_s: wall time of the closed loop alone [s].
        tallies: counts of each sensor's samples in the estimator; empty without one.
        directory: where it was read from or written to; None if it is only in memory.
        label: its name in comparisons and legends; None for the scenario's name, and what tells it from other flights
            of the scenario.
        recorded: `summary.json` as it was read or written; None for a flight that is only in memory.
        thinned: whether `plant` has the rows at the scenario's `log_rate` alone, as files have them.
        checked: what `quadsim check` adds; None for a flight that was not checked.
        infeasible_period: the first period whose QP had no answer; None if there is none, or the flight was read.
        own_code: whether a controller, force or autopilot was passed in, so that the scenario cannot repeat the flight.
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

    scenario: Scenario
    assembly: Assembly = field(repr=False)
    log: FlightLog = field(repr=False)
    findings: tuple[Finding, ...] = field(repr=False)
    controller: str
    solver: str
    simulate_s: float
    tallies: Mapping[SensorName, Tally] = field(repr=False)
    directory: Path | None = None
    label: str | None = None
    recorded: Mapping[str, Any] | None = field(default=None, repr=False)
    thinned: bool = field(default=False, repr=False)
    checked: Check | None = field(default=None, repr=False)
    infeasible_period: InfeasiblePeriod | None = field(default=None, repr=False)
    own_code: bool = field(default=False, repr=False)
    try_remedies: Callable[[Mapping[str, Any], Flight], dict[str, Any]] | None = field(default=None, repr=False)

    def __getstate__(self) -> dict[str, Any]:
        """Pickle an assembly that does not need its vehicle's file."""
        return {**vars(self), "assembly": self.assembly.of(self.scenario)}

    @property
    def name(self) -> str:
        """The scenario's name."""
        return self.scenario.name

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
        if self.recorded is None:
            course_end = self.assembly.course_cut
        else:
            course_end = self.recorded.get("course", {}).get("cut_before")
        if course_end is not None:
            flown += f" of a course that ends at {course_end:g} s"
        line = f"<Flight {self.scenario.name}: {self.outcome}, {flown} by {self.controller}"
        if self.reason:
            line += f", {self.reason}"
        return f"{line}{worst_margin(self.findings)}>"

    @property
    def outcome(self) -> FlightVerdict:
        """The verdict in one word, see `quadsim.flight.audit.flight_verdict`."""
        return self.verdict_of(self.findings)

    def verdict_of(self, findings: Sequence[Finding]) -> FlightVerdict:
        """Return the verdict that another audit of this flight gives, see `quadsim.flight.audit.flight_verdict`."""
        return flight_verdict(
            findings,
            aborted=self.log.aborted,
            lost=self.reason is not None,
            failed=metrics.failure(self.log.control) is not None,
        )

    @cached_property
    def departure(self) -> Departure | None:
        """How far from its course the flight ended; None where it ended on the ground, or too early to tell.

        It is also None for a run of a version that did not compute it: such a run keeps its verdict.
        """
        if self.recorded is None:
            numbers = departure_numbers(self.log.control)
        else:
            numbers = self.recorded["tracking"].get("departure")
        return departure_of(numbers, self.scenario.lost.departure or None)

    @property
    def reason(self) -> str | None:
        """Why the flight ended early, or is lost though it was flown to its end; None if it is neither."""
        if self.log.reason is None and self.departure is not None and self.departure.lost:
            return self.departure.sentence
        return self.log.reason

    @cached_property
    def diagnosis(self) -> Mapping[str, Any] | None:
        """Why the flight failed, and what helps; None if there is nothing to explain.

        It explains the first QP that had no answer.  If all QPs had one, it explains the first SQP that did not
        converge, where a constraint does not hold, or else what the model lacks, where the flight was lost.

        The changes that it advises are flown first, in `quadsim.rollout.remedies.MOST_FLOWN` flights at most: the first
        access takes seconds.

        `sentence` and `advice` are for users; `docs/audit.md` explains the other entries.
        """
        explanation = self._explanation
        if explanation is None or self.recorded is not None or self.try_remedies is None:
            return explanation
        return self.try_remedies(explanation, self)

    @cached_property
    def _explanation(self) -> Mapping[str, Any] | None:
        """`diagnosis` before anything is flown."""
        if self.recorded is not None:
            return self.recorded.get("diagnosis")
        from quadsim.rollout.infeasibility import diagnose, lacking_report

        period = self.infeasible_period
        if period is None:
            kept_controller = self.scenario.controller_at(self.end) == self.scenario.controller
            if self.outcome == "lost" and kept_controller and not self.own_code:
                return lacking_report(self.assembly, self.end)
            return None
        if period.status == NOT_CONVERGED and self.satisfied:
            return None
        controller = self.scenario.controller_at(period.time)
        scenario = self.scenario.altered(controller=controller, events=())
        return diagnose(period, scenario, self.vehicle, self.log.control.status)

    @property
    def limits(self) -> tuple[Limit, ...]:
        """The constraints that it was audited against."""
        return tuple(finding.limit for finding in self.findings)

    @property
    def notes(self) -> tuple[str, ...]:
        """Remarks of `quadsim check` that are not errors."""
        if self.checked is None:
            return ()
        return self.checked.notes

    @property
    def end(self) -> float:
        """Last time of the flight [s]."""
        return float(self.log.plant.t[-1])

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
        states = dict(zip(STATE_NAMES, log.state.T, strict=True))
        speed_names = columns_of(PlantLog)["speeds"].units
        speeds = dict(zip(speed_names, log.speeds.T, strict=True))
        return {"t": log.t, **states, **speeds}

    @cached_property
    def margins(self) -> dict[str, Array]:
        """(K,) of each constraint, by name: its smallest signed margin within the period; negative = violated.

        At the rate of `plant`, in the constraint's unit; NaN outside its time window.  The smallest of all is the
        audit's `worst_margin`. See `docs/conventions.md`.
        """
        plant = self.log.plant
        t = self.time
        last_row = max(plant.t.size - 1, 0)
        first_rows = np.searchsorted(plant.t, t - 1e-9)  # of each period; the two times may differ by rounding
        first_rows = np.minimum(first_rows, last_row)
        margins: dict[str, Array] = {}
        for limit in self.limits:
            signal = limit.source
            if signal.plant is None or not t.size:
                margins[limit.name] = margins_sampled(limit, self.log)
            else:
                at_rows = margins_at(limit, plant.t, signal.plant(plant))
                margins[limit.name] = np.fmin.reduceat(at_rows, first_rows)
        return margins

    @cached_property
    def summary(self) -> Mapping[str, Any]:
        """All numbers: the content of `summary.json`."""
        return {**self.numbers, "diagnosis": self.diagnosis}

    @cached_property
    def numbers(self) -> Mapping[str, Any]:
        """`summary`; of a flight that is not saved, with the diagnosis before the changes that it advises are flown."""
        if self.recorded is None:
            return summarise(self)
        return self.recorded

    @cached_property
    def metrics(self) -> dict[str, float]:
        """The flight's numbers by name, e.g. `rmse.x`, `speed_max`, `step_ms.p99`; units as in `summary`."""
        values = {}
        for group in ("tracking", "control", "controller"):
            for name, value in leaves(self.numbers[group]):
                if isinstance(value, int | float) and not isinstance(value, bool):
                    values[name] = value
        return values

    def to_toml(self) -> str:
        """Return the file of its scenario, as `save` writes it."""
        return self.assembly.to_toml(self.scenario)

    def labelled(self, label: str) -> Flight:
        """Return the flight under another name in comparisons and legends."""
        return replace(self, label=label)

    def as_stored(self) -> Flight:
        """Return the flight with the plant's rows that its files have; numbers and audit remain those of all rows."""
        if self.thinned:
            return self
        plant = self.log.plant.every(self.scenario.plant_stride)
        return replace(self, log=replace(self.log, plant=plant), recorded=self.summary, thinned=True)

    def to_arrow(self, table: str = "flight") -> pa.Table:
        """A table of the flight, units in its columns' metadata.

        Args:
            table: `flight` (a row per control period), `plant` (between the commands), `timing` (what a clock
                measured), or `horizon` (the positions that were predicted).

        Raises:
            UnknownNameError: the flight has no such table.

        Examples:
            >>> import quadsim
            >>> table = quadsim.fly(quadsim.load("hover", {"duration": 1.0})).to_arrow()
            >>> table.num_rows, table.column_names[:3], table.schema.field("vx").metadata[b"unit"]
            (20, ['t', 'x', 'vx'], b'm/s')
        """
        tables = log_tables(self.log, metadata=self.metadata)
        if table not in tables:
            raise UnknownNameError("table", table, tables)
        return tables[table]

    def to_pandas(self, table: str = "flight") -> Any:
        """A table of the flight as a pandas DataFrame; the table's name as in `to_arrow`.

        Raises:
            MissingPackageError: pandas is not installed.

        Examples:
            >>> import quadsim
            >>> frame = quadsim.fly(quadsim.load("hover", {"duration": 1.0})).to_pandas()
            >>> frame.shape[0], round(float(frame["z"].mean()), 6)
            (20, 1.0)
        """
        return to_pandas(self.to_arrow(table))

    def plot(self, *signals: str, **options: Any) -> Overlay:
        """Draw signals over time with their references and bounds: `quadsim.plot` of this flight.

        Args:
            signals: as in `quadsim.plot`.
            options: its `labels`, `width`, `style`, `out` and `overwrite`.

        Returns:
            The matplotlib axes, top to bottom.

        Raises:
            InputError: as in `quadsim.plot`.

        Examples:
            >>> import quadsim
            >>> axes = quadsim.fly(quadsim.load("hover", {"duration": 1.0})).plot("z", "roll")
            >>> [panel.get_ylabel() for panel in axes]
            ['z [m]', 'roll [deg]']
        """
        from quadsim.rollout.flight_plot import plot_runs

        return plot_runs([self], signals, **options)

    def save(
        self,
        directory: str | Path,
        *,
        overwrite: bool = False,
        video: bool | None = None,
        recording: bool | None = None,
        figures: bool | None = None,
        fps: int | None = None,
        progress: Progress | bool = True,
    ) -> Path:
        """Write the run directory, as `quadsim run` does: tables and summary first, then figures, recording and video.

        All but the video takes seconds.  The video takes one to several seconds for each second of flight where no
        graphics card renders it; `video=False` does without.

        Args:
            directory: run directory.
            overwrite: whether to replace an earlier output.
            video: whether to film the flight; None: if possible; True: raise if it fails.
            recording: whether to write `flight.rrd` for the rerun viewer, as for `video`.
            figures: whether to plot the flight, as for `video`.
            fps: frames per second of the video; None: 30, or 20 for flights of half a minute or more.
            progress: as of `quadsim.fly`.

        Returns:
            The directory.

        Raises:
            ParameterError: `fps` is out of range.
            RenderingUnavailableError: a video is requested but cannot be rendered.
            OutputError: the directory cannot be written or contains other files, the flight was read from a directory,
                or a requested product failed; in that case the tables and the summary are written.

        Examples:
            >>> import quadsim
            >>> flight = quadsim.fly(quadsim.load("hover", {"duration": 1.0}))
            >>> directory = flight.save("saved", video=False, recording=False, figures=False)
            >>> quadsim.read(directory).outcome
            'satisfied'
        """
        if self.thinned:
            raise OutputError(directory, f"this flight is on disk already, in {self.directory}; copy that directory")
        require_film(video, fps)
        flight, whole = self.write_tables(directory, overwrite=overwrite)
        if whole:
            products = {"video": video, "recording": recording, "figures": figures}
            with reporting(progress, "the figures") as report:
                _require_products(add_products(flight, products, fps=fps, progress=report), products)
        return Path(directory)

    def write_tables(self, directory: str | Path, *, overwrite: bool = False) -> tuple[Flight, bool]:
        """Write the run directory without figures, recording and video; errors as `save`.

        Returns:
            The flight as it was written, and whether products may follow: not after Ctrl-C, which loses no flight, as
            tables that it interrupts are written again.
        """
        started = clock.perf_counter() - self.simulate_s  # the total includes the closed loop
        target = absolute(directory)
        try:
            written = self._write_files(target, started, overwrite=overwrite)
        except KeyboardInterrupt:
            return self._write_files(target, started, overwrite=True), False
        try:
            current_hold().release()
            if self._explanation is None:
                return written, True
            diagnosis = self.diagnosis  # it flies the changes that it advises
            amend(target, {"diagnosis": diagnosis})
            return written._with_entries(diagnosis=diagnosis), True
        except KeyboardInterrupt:
            return written, False

    def _write_files(self, target: Path, started: float, *, overwrite: bool) -> Flight:
        """Write scenario, course, tables and summary; return the flight as it was written.

        Args:
            target: run directory.
            started: reading of the clock at the start of the flight [s].
            overwrite: whether to replace an earlier output.
        """
        with writing(target, overwrite=overwrite) as partial:
            (partial / rundir.SCENARIO_FILE).write_text(self.to_toml(), encoding="utf-8")
            course = self.scenario.reference
            if isinstance(course, Csv) and course.content is not None:
                (partial / course.file).write_bytes(course.content)
            write_log(partial, self.log, plant_stride=self.scenario.plant_stride, metadata=self.metadata)
            wall_s = {"simulate": self.simulate_s, "total": clock.perf_counter() - started}
            summary = {**self.numbers, "wall_s": wall_s, "products": {}, "files": file_hashes(partial)}
            (partial / rundir.SUMMARY_FILE).write_text(to_json(summary), encoding="utf-8")
        return replace(self, directory=target, recorded=summary)

    def _with_entries(self, **entries: Any) -> Flight:
        """Return the flight with these entries in its summary, in place of earlier ones."""
        return replace(self, recorded={**self.numbers, **entries})

    @property
    def exit_status(self) -> int:
        """See `Result.exit_status`; 1 of a check that does not show that every constraint of the scenario holds."""
        if self.checked is None:
            done = self.outcome in ("satisfied", "incomplete", "unaudited")
        elif self.checked.again is None:
            done = self.satisfied
        else:
            done = self.satisfied and self.verdict_of(self.checked.again) == "satisfied"
        if done:
            return EXIT_DONE
        return EXIT_FAILED

    def shown(self) -> Shown:
        """See `Result.shown`."""
        from quadsim.console.summary_tables import summary_tables

        yield from summary_tables(self)
        if self.checked is not None and self.checked.again is not None:
            satisfied_again = self.verdict_of(self.checked.again) == "satisfied"
            phrase = "a different verdict than recorded"
            if satisfied_again == self.satisfied:
                phrase = "as recorded"
            yield f"audited again from the tables, {self.scenario.log_rate:g} rows per second: {phrase}"

    def verdicts(self) -> tuple[str, Cases]:
        """See `quadsim.console.junit.Judged`."""
        return flight_verdicts(self)

    def outputs(self) -> Shown:
        """See `Result.outputs`."""
        from quadsim.console import console

        if self.directory is None or self.checked is not None:
            return
        yield console.written_to(self.directory)
        products = self.numbers.get("products", {})
        for name in (rundir.VIDEO_FILE, rundir.FIGURES_DIR):
            if products.get(name) == MADE:
                yield console.to_open(self.directory / name)
        if products.get(rundir.RECORDING_FILE) == MADE:
            yield console.to_open(self.directory, "quadsim view")
        if self.time.size:
            words = ("quadsim", "plot", console.short_path(self.directory), "--out", f"{self.directory.name}.pdf")
            yield console.command(shlex.join(words))

    def to_json(self) -> dict[str, Any]:
        """Return `summary.json`, with the new audit of a run that was checked under `reaudit`."""
        summary = dict(self.summary)
        if self.checked is not None and self.checked.again is not None:
            summary["reaudit"] = {
                "rate": self.scenario.log_rate,
                "satisfied": self.verdict_of(self.checked.again) == "satisfied",
                "constraints": [limit_to_json(finding) for finding in self.checked.again],
                "notes": [*self.notes],
            }
        return summary

    def small_plot(self) -> Figure | None:
        """See `Result.small_plot`: position over time."""
        from quadsim.report.flight_figures import signals

        if self.time.size:
            return signals([self], ("x", "y", "z"))
        return None

    def _repr_html_(self) -> str:
        """Numbers and a small plot, for notebooks."""
        from quadsim.report.comparison_rows import tolerance_text

        rows = ""
        for finding in self.findings:
            name = escape(finding.limit.name)
            margin = f"{finding.margin:.4g} {escape(finding.limit.unit)}"
            tolerance = escape(tolerance_text(finding.limit))
            verdict = VERDICT_TEXT[finding.verdict]
            rows += f"<tr><td>{name}</td><td>{margin}</td><td>{tolerance}</td><td>{verdict}</td></tr>"
        errors = "none"
        if self.time.size:
            errors = ", ".join(f"{name} {self.metrics[f'rmse.{name}']:.3g}" for name in "xyz")
        return (
            f"<p><b>{escape(self.scenario.name)}</b>: {self.outcome}, {self.numbers['duration']:g} s flown, "
            f"RMS error [m]: {errors}</p>"
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
    require_pandas()
    return table.to_pandas()


def worst_margin(findings: Iterable[Finding]) -> str:
    """The worst margin, see `worst_finding`, as a further line of a repr; empty if no finding counts."""
    from quadsim.report.comparison_rows import tolerance_text

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
) -> Flight:
    """Write the tables, call `flown`, and add the products; return the flight as it was written."""
    flight, whole = flight.write_tables(directory, overwrite=overwrite)
    if flown is not None:
        flown(flight)
    if not whole:
        return flight
    with reporting(progress, "the figures") as report:
        try:
            flight = add_products(flight, products, fps=fps, progress=report)
            _require_products(flight, products)
        except OutputError as error:
            is_requested_product = error.path.parent == flight.directory
            if is_requested_product:  # the flight is complete without it, and is shown before the error
                error.result = flight
            raise
    return flight


def require_film(video: bool | None, fps: int | None = None) -> None:
    """Raise if a requested video cannot be made here, before the flight.

    Raises:
        ParameterError: `fps` is out of range.
        RenderingUnavailableError: this machine cannot render.
    """
    if not video and fps is None:
        return
    from quadsim.report.film.video import frame_rate, rendering_backend

    frame_rate(0.0, fps)  # raises if `fps` is out of range
    if video:
        rendering_backend()  # raises if there is none


def summarise(flight: Flight) -> dict[str, Any]:
    """Return `summary.json` of a flight, without the hashes of its files and the total wall time."""
    scenario = flight.scenario
    log = flight.log
    deadline_ms = 1e3 * scenario.control_period
    numbers = metrics.flight_numbers(log, deadline_ms=deadline_ms, course=flight.assembly.course_steps)
    summary = _outcome_entries(flight)
    summary["course"] = _course_entry(flight)
    events = story(scenario, log.control.t.size * scenario.control_period)
    if events:
        summary["events"] = events
    summary["tracking"] = numbers["tracking"]
    summary["constraints"] = [limit_to_json(finding) for finding in flight.findings]
    summary["audit_notes"] = flight.assembly.audit_notes
    summary |= _model_entries(flight)
    summary["control"] = numbers["control"]
    summary["diagnosis"] = flight._explanation
    summary["controller"] = _controller_entry(flight, numbers["controller"])
    summary |= _entries_of_parts(flight)
    summary["vehicle"] = asdict(flight.vehicle)
    if flight.actual != flight.vehicle:
        summary["actual"] = asdict(flight.actual)
    summary["wall_s"] = {"simulate": flight.simulate_s, "total": flight.simulate_s}
    summary["versions"] = versions()
    summary["machine"] = machine()
    summary["products"] = {}
    summary["files"] = {}
    return summary


def _outcome_entries(flight: Flight) -> dict[str, Any]:
    """Return the first entries of a summary: what was flown, and what came of it."""
    scenario = flight.scenario
    log = flight.log
    entries: dict[str, Any] = {
        "format": FORMAT,
        "scenario": scenario.name,
        "description": scenario.description,
        "status": log.status,
        "reason": log.reason,
    }
    if log.traceback:
        entries["traceback"] = [*log.traceback]
    lost = log.lost
    flown_to_its_end = log.reason is None
    if flown_to_its_end and flight.reason is not None:
        lost = DEPARTURE
    return entries | {
        "lost": lost,
        "satisfied": flight.satisfied,
        "verdict": flight.outcome,
        "group": scenario.group,
        "expected": scenario.expect,
        "as_expected": flight.outcome == scenario.expect,
        "duration": round(log.control.t.size * scenario.control_period, 9),
        "seed": scenario.seed,
    }


def _course_entry(flight: Flight) -> dict[str, Any]:
    """Return the entry on the course: its demands, and where it ends early, if it does."""
    entry = asdict(report(flight.assembly))
    if flight.assembly.course_cut is not None:
        entry["cut_before"] = flight.assembly.course_cut
    return entry


def _controller_entry(flight: Flight, numbers: Mapping[str, Any]) -> dict[str, Any]:
    """Return the entry on the controller: what it is, its numbers over the flight, and the autopilot below it."""
    entry = {
        "name": flight.controller,
        "solver": flight.solver,
        "horizon": flight.scenario.controller.horizon,
        **numbers,
    }
    if flight.log.control.target is not None:
        entry["autopilot"] = flight.assembly.autopilot_flown
    return entry


def _model_entries(flight: Flight) -> dict[str, Any]:
    """Return the entries on the controller's model, if any: what it lacks of the flight, and what it gets wrong."""
    stated_type = flight.scenario.controller.type
    entries: dict[str, Any] = {}
    notes = implausible(flight.actual)
    if flight.controller == stated_type:
        notes += model_notes(flight.assembly)
    if notes:
        entries["model_notes"] = notes
    if flight.own_code or is_plugin(stated_type):
        owner = "your model"
    else:
        owner = f"the model of {flight.controller}"
    model_error = model_report(flight.log.control, flight.log.foreseen, owner)
    if model_error is not None:
        entries["model_error"] = model_error
    return entries


def _entries_of_parts(flight: Flight) -> dict[str, Any]:
    """Return the entries of the parts that a scenario may have: computation, estimation, ground."""
    log = flight.log
    flown = log.control.t.size > 0
    entries: dict[str, Any] = {}
    if flown and flight.assembly.computation():
        entries["computation"] = metrics.computation(log.control)
    if not log.control.measured_perfectly:
        samples = {str(name): asdict(tally) for name, tally in flight.tallies.items()}
        entries["estimation"] = {**metrics.estimation(log.control), "samples": samples}
    ground = flight.scenario.effects.ground
    if flown and ground and ground.contact:
        entries["ground"] = metrics.ground(log, outline(flight.actual))
    return entries


def add_products(
    flight: Flight, requested: Mapping[str, bool | None], *, progress: Progress = silent, fps: int | None = None
) -> Flight:
    """Add recording, figures and video to the directory of a flight that was written; return it with them.

    Ctrl-C stops the current one and skips the rest.  What fails is recorded, with the reason.  Products that are
    `requested` as False are left out.
    """
    from quadsim.console.console import short_path

    started = clock.perf_counter()
    shown = flight.as_stored()
    products = _Products(flight)
    if requested["recording"] is not False:
        _add_recording(products, shown, progress)
    has_periods = bool(flight.time.size)
    figures = requested["figures"] is not False and has_periods
    if figures and not products.interrupted:
        _add_figures(products, shown, progress)
    flight = products.recorded()
    video = requested["video"] is not False and has_periods and not flight.log.interrupted
    if video and not products.interrupted:
        note = f"all else is in {short_path(products.directory)}"
        (flight,) = add_films([flight], note=note, progress=progress, fps=fps)
    before = flight.numbers["wall_s"]
    wall_s = {**before, "total": before["total"] + clock.perf_counter() - started}
    amend(products.directory, {"wall_s": wall_s})
    return flight._with_entries(wall_s=wall_s)


def _add_recording(products: _Products, flight: Flight, progress: Progress) -> None:
    with products.making(rundir.RECORDING_FILE) as folder:
        from quadsim.report.recording import write_recording

        progress("recording", 0, 1)
        write_recording(flight, folder / rundir.RECORDING_FILE)
    progress("recording", 1, 1)


def _add_figures(products: _Products, flight: Flight, progress: Progress) -> None:
    with products.making(rundir.FIGURES_DIR) as folder:
        from quadsim.report.flight_figures import write_figures

        progress("figures", 0, 1)
        write_figures(flight, folder / rundir.FIGURES_DIR)
        progress("figures", 1, 1)


def _require_products(flight: Flight, requested: Mapping[str, bool | None]) -> None:
    """Raise if a product that was requested is not there.

    Raises:
        OutputError: naming the first such product, and why.
    """
    for name, product in _PRODUCTS.items():
        if requested[product]:
            require_product(flight, name)


def require_product(flight: Flight, name: str) -> None:
    """Raise if making a product of a run directory failed; not if Ctrl-C stopped it.

    Raises:
        OutputError: with the reason.
    """
    state = flight.numbers.get("products", {}).get(name, MADE)
    if state in (MADE, INTERRUPTED):
        return
    directory = flight.directory or Path()
    raise OutputError(directory / name, f"{state}; all else is there")


def add_films(
    flights: Sequence[Flight], *, note: str, progress: Progress = silent, fps: int | None = None
) -> list[Flight]:
    """Film flights into their run directories; return them with their films.

    Ctrl-C stops the current one and skips the rest.  `note` says, beside the estimated time, what can be opened
    meanwhile.
    """
    from quadsim.report.film.video import Estimate, frame_count, frame_rate, render_video

    frames = []
    for flight in flights:
        frames.append(frame_count(flight.end, frame_rate(flight.end, fps)))
    estimate = Estimate(frames, note)

    def follow(done: int, total: int) -> None:
        estimate(done, total)
        progress("video", done, total)

    filmed = list[Flight]()
    interrupted = False
    for flight in flights:
        products = _Products(flight)
        if not interrupted:
            with products.making(rundir.VIDEO_FILE) as folder:
                progress("video", 0, 1)  # until the renderer has started
                render_video(flight.as_stored(), folder / rundir.VIDEO_FILE, progress=follow, fps=fps)
        interrupted = interrupted or products.interrupted
        filmed.append(products.recorded())
    return filmed


class _Products:
    """The products of a run directory while they are made: which are there, and why others are not."""

    def __init__(self, flight: Flight) -> None:
        assert flight.directory is not None
        self.directory = flight.directory
        self._flight = flight
        self._states = dict[str, str]()
        self._hashes = dict[str, str]()

    @property
    def interrupted(self) -> bool:
        """Whether Ctrl-C stopped one."""
        return INTERRUPTED in self._states.values()

    @contextlib.contextmanager
    def making(self, name: str) -> Iterator[Path]:
        """A folder for a product; if the product cannot be made, the summary says why."""
        try:
            with adding(self.directory, products={name: MADE}) as folder:
                yield folder
                hashes = file_hashes(folder)
        except KeyboardInterrupt:
            self._fail(name, INTERRUPTED)
        except Exception as error:
            self._fail(name, failure_line(error))
        else:
            self._states[name] = MADE
            self._hashes |= hashes

    def _fail(self, name: str, problem: str) -> None:
        self._states[name] = problem
        amend(self.directory, {"products": {name: problem}})
        _log.warning("%s %s", name, problem)

    def recorded(self) -> Flight:
        """Return the flight with these products in its summary."""
        before = self._flight.numbers
        products = {**before.get("products", {}), **self._states}
        files = dict(sorted({**before["files"], **self._hashes}.items()))
        return self._flight._with_entries(products=products, files=files)
