"""The result of `quadsim identify`: the vehicle, how well it predicts, and what to fly for the rest.

`identify_logs` goes all the way: logs, records, checks, fit, prediction of what was held out, vehicle file and page.
"""

from __future__ import annotations

import itertools
import math
import shlex
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from quadsim.console.results import Shown, Tabular, after
from quadsim.errors import InputError, MissingPackageError, ParameterError
from quadsim.features.identify.checks import airborne_spans, check_log
from quadsim.features.identify.estimate import DisturbanceEstimate, Identification, ParameterEstimate
from quadsim.features.identify.fit import identify_records
from quadsim.features.identify.identification_figures import (
    horizon_figure,
    interval_figure,
    residual_figure,
    trace_figure,
)
from quadsim.features.identify.log_errors import fitting_errors
from quadsim.features.identify.prediction import (
    BASELINES,
    HORIZONS,
    JUDGED,
    QUANTITIES,
    PredictionErrors,
    hold_out,
    predict,
)
from quadsim.features.identify.quantities import NamedQuantity
from quadsim.features.identify.record import Record, read_record
from quadsim.features.identify.vehicle_file import factor_text, interval_text, rounded, vehicle_text, verdict
from quadsim.outputs import require_file, writing_file
from quadsim.report.page import Section, render_page
from quadsim.report.table import ABSENT, Cell, Grid, Mark, format_number, line
from quadsim.report.to_plotly import to_plot
from quadsim.state import shown_unit
from quadsim.vehicle import Vehicle, load_vehicle

NEEDED_PARAMETERS: Final = "mass, gravity, arm_length, rotor_azimuths, rotor_spins, speed_min and speed_max"


@dataclass(frozen=True, kw_only=True, repr=False)
class IdentifiedVehicle(Tabular):
    """A vehicle that was identified from flight logs."""

    identification: Identification
    prediction: PredictionErrors
    notes: tuple[str, ...]  # of the checks
    logs: tuple[str, ...]  # fitted
    test: tuple[str, ...]  # predicted; empty where the last fifth of each log is
    content: str  # of the vehicle file
    file: Path | None = None  # where it was written
    page: Path | None = None  # where the page was written

    @property
    def vehicle(self) -> Vehicle:
        """The vehicle of the file, before its numbers are rounded."""
        return self.identification.vehicle

    @property
    def verdict(self) -> Cell:
        """Whether the vehicle predicts flight that was not fitted better than the start and than thrust and drag."""
        return Cell(text=self.prediction.verdict, mark=Mark.BAD if self.prediction.lost else Mark.GOOD)

    @property
    def counted(self) -> str:
        """How many parameters are identified, and which are not."""
        estimates = self.identification.estimates
        refused = [estimate.name for estimate in estimates if estimate.refused]
        identified = len(estimates) - len(refused)
        text = f"{identified} of {len(estimates)} parameters identified from {', '.join(self.logs)}"
        if refused:
            text += f"; not identified: {', '.join(refused)}"
        return text

    @property
    def advice(self) -> dict[str, str]:
        """What to fly, and what that identifies."""
        names: dict[str, list[str]] = {}
        for estimate in self.identification.estimates:
            if estimate.refused and estimate.advice:
                names.setdefault(estimate.advice, []).append(estimate.name)
        return {advice: ", ".join(identified) for advice, identified in names.items()}

    @property
    def settings(self) -> dict[str, str]:
        """Values by field of a scenario: numbers that a vehicle file has no field for and whose interval excludes 0."""
        nonzero = {}
        for estimate in self.identification.estimates:
            may_be_zero = estimate.low <= 0.0 <= estimate.high
            if not (estimate.in_file or estimate.refused or may_be_zero):
                nonzero[estimate.name] = rounded(estimate.value, estimate)
        settings = {}
        delay = nonzero.get("delay", 0.0)
        if delay > 0.0:
            settings["computation.delay"] = f"{delay:g}"
        x = nonzero.get("offset_x", 0.0)
        y = nonzero.get("offset_y", 0.0)
        if x or y:
            settings["effects.load.centre_of_mass"] = f"[{x:g}, {y:g}, 0]"
        return settings

    def tables(self) -> tuple[Grid, Grid, Grid]:
        """Return the parameters, the disturbance, and the errors of the prediction."""
        known = self.identification
        parameter_lines = tuple(_parameter_line(estimate, known) for estimate in known.estimates)
        disturbance_lines = tuple(_disturbance_line(estimate) for estimate in known.disturbance)
        note = ""
        if known.whiteness:
            white = ", ".join(f"{axis} {value:.2f}" for axis, value in known.whiteness.items())
            note = f"Largest autocorrelation of what is not predicted, 0 for noise: {white}."
        parameters = Grid(
            key="parameters",
            title="Parameters",
            head=("parameter", "unit", "start", "estimate", "95 % interval", "verdict"),
            lines=parameter_lines,
            note=note,
        )
        disturbance = Grid(
            key="disturbance",
            title="Disturbance",
            head=("not modelled", "unit", "deviation", "95 % interval", "lasts [s]", "95 % interval", "verdict"),
            lines=disturbance_lines,
            note="Random torque about body axes and force along world axes, wind's included. It decays with the time "
            "constant in seconds.",
        )
        return parameters, disturbance, self._error_table()

    def _error_table(self) -> Grid:
        """Return the mean errors of each model by quantity and horizon, the least of them marked."""
        lines = []
        for j, (quantity, si) in enumerate(QUANTITIES.items()):
            unit, scale = shown_unit(si)
            for horizon in JUDGED:
                row = HORIZONS.index(horizon)
                errors = [scale * float(of_model[row, j]) for of_model in self.prediction.errors.values()]
                if all(map(math.isfinite, errors)):
                    lines.append(line(f"{quantity} [{unit}]", f"{horizon:g} s", *_error_cells(errors)))
        held_out = ", ".join(self.test) or "the last fifth of each log, which is not fitted"
        rates_last = self.identification.rates_last
        return Grid(
            key="errors",
            title="Errors of prediction",
            head=("mean error", "horizon", *self.prediction.errors),
            lines=tuple(lines),
            note=f"{self.prediction.windows} windows of {held_out}. identified: starts with the torque and force that "
            "a filter estimates at that instant; undisturbed: without. start: the start file with the same filter. "
            f"rates held, rates decay: identified thrust and drag alone; decay with {rates_last:.2g} s, as in what was "
            "fitted. floor: the error that the identified disturbance causes to any prediction.",
        )

    def records(self) -> list[dict[str, Any]]:
        """Return a row per parameter: `start`, `estimate` with its 95 % interval, and whether that was refused."""
        rows = []
        for estimate in self.identification.estimates:
            row = {
                "parameter": estimate.name,
                "unit": estimate.unit,
                "start": estimate.start,
                "estimate": estimate.value,
                "low": estimate.low,
                "high": estimate.high,
                "refused": bool(estimate.refused),
            }
            rows.append(row)
        return rows

    def shown(self) -> Shown:
        """See `Result.shown`."""
        from quadsim.console import console

        yield console.styled((self.verdict.text, "bold"))
        yield self.counted
        yield from console.grids(self.tables(), left=("unit", "verdict", "horizon"))
        yield from self.sentences()

    def sentences(self) -> tuple[str, ...]:
        """Return what the checks noted, what to fly, and the settings that only a scenario has a field for."""
        sentences = [f"check: {note}" for note in self.notes]
        for quantity in self.prediction.at_floor:
            sentences.append(
                f"check: the error of {quantity} is at the floor, what the disturbance leaves open: the true vehicle "
                "may lose, too; fly more briskly to see what the file is worth"
            )
        for estimate in self.identification.estimates:
            if estimate.name == "delay" and estimate.high < 0.0:
                late = -1e3 * estimate.value
                sentences.append(f"check: the commands are logged {late:.0f} ms late, as a delay cannot be negative")
        for advice, names in self.advice.items():
            sentences.append(f"to identify {names}, fly: {advice}")
        for field, value in self.settings.items():
            sentences.append(f"a vehicle file has no field for it, a scenario has: {field} = {value}")
        return tuple(sentences)

    @property
    def _written(self) -> list[Path]:
        return [path for path in (self.file, self.page) if path is not None]

    def outputs(self) -> Shown:
        """See `Result.outputs`."""
        from quadsim.console import console

        for path in self._written:
            yield console.written_to(path)
        if self.page is not None:
            yield console.to_open(self.page)
        if self.file is None:
            options = "--out mine.toml"
            if self.prediction.lost:
                options += " --anyway"
            yield f"no vehicle file was written: {options} writes it"
        elif not self.prediction.lost:
            yield console.command(f"{console.to_open(self.file, 'quadsim scenario --for')} > first.toml")
            settings = [f" --set {shlex.quote(f'{field}={value}')}" for field, value in self.settings.items()]
            yield console.command(f"quadsim run first.toml{''.join(settings)}")

    def to_json(self) -> dict[str, Any]:
        """All of it as plain values; a number that is not finite is None."""
        errors = {}
        for model, of_model in self.prediction.errors.items():
            errors[model] = {quantity: of_model[:, j] for j, quantity in enumerate(QUANTITIES)}
        verdict: dict[str, Any] = {"better": not self.prediction.lost, "text": self.prediction.verdict}
        for baseline in BASELINES:
            verdict[baseline] = self.prediction.ratios(baseline)
        data = {
            "logs": self.logs,
            "test": self.test,
            **asdict(self.identification),
            "notes": self.notes,
            "advice": self.advice,
            "settings": self.settings,
            "verdict": verdict,
            "prediction": {"windows": self.prediction.windows, "horizons": HORIZONS, "errors": errors},
            "vehicle_file": self.content,
            "written": [str(path) for path in self._written],
        }
        return {name: _plain(value) for name, value in data.items()}


class _Usable(NamedTuple):
    """A log that can be used."""

    record: Record
    spans: list[slice]  # of its samples, in the air
    notes: tuple[str, ...]  # of the checks


def identify_logs(
    logs: Sequence[Path],
    start: Path,
    *,
    test: Sequence[Path] = (),
    poles: int | None = None,
    columns: Sequence[NamedQuantity] = (),
    out: Path | None = None,
    page: Path | None = None,
    overwrite: bool = False,
    wind: bool = False,
    anyway: bool = False,
) -> IdentifiedVehicle:
    """Identify a vehicle from logs, given a start file; see `quadsim.identify`.

    A log that cannot be used is left out, and `notes` says so; the error is raised where none is left.
    """
    file = None if out is None else require_file(out, overwrite=overwrite)
    page = None if page is None else require_file(page, overwrite=overwrite)
    vehicle = load_vehicle(start)
    fitted, notes = _usable(logs, vehicle, poles, columns)
    tested, test_notes = _usable(test, vehicle, poles, columns)
    notes += test_notes
    for log in (*fitted, *tested):
        notes += log.notes
    _refuse_same_flights([*fitted, *tested])
    names = tuple(log.record.name for log in fitted)
    tested_names = tuple(log.record.name for log in tested)
    with fitting_errors(", ".join(names)):
        identification, prediction = _fit_and_predict(fitted, tested, start, vehicle, wind=wind)
    if prediction.lost and not anyway:
        file = None
    result = IdentifiedVehicle(
        identification=identification,
        prediction=prediction,
        notes=tuple(notes),
        logs=names,
        test=tested_names,
        content=vehicle_text(identification, start, names),
        file=file,
        page=page,
    )
    _write(result, overwrite=overwrite)
    return result


def _write(result: IdentifiedVehicle, *, overwrite: bool) -> None:
    """Write the vehicle file and the page, where they were asked for."""
    if result.file is not None:
        with writing_file(result.file, overwrite=overwrite) as new:
            new.write_text(result.content, encoding="utf-8")
            load_vehicle(new)  # raises where the numbers, as they are rounded, make no vehicle
    if result.page is not None:
        without_page = replace(result, page=None)
        with after(without_page, result.page), writing_file(result.page, overwrite=overwrite) as new:
            new.write_text(_render(result), encoding="utf-8")


def _fit_and_predict(
    fitted: Sequence[_Usable], tested: Sequence[_Usable], start: Path, vehicle: Vehicle, *, wind: bool
) -> tuple[Identification, PredictionErrors]:
    """Fit some logs, and predict others; without others, what is held out of those that are fitted."""
    records = [log.record for log in fitted]
    predicted = records
    fitted_spans = []
    held_spans = []
    if tested:
        predicted = [log.record for log in tested]
        fitted_spans = [log.spans for log in fitted]
        held_spans = [log.spans for log in tested]
    else:
        for log in fitted:
            first, last = hold_out(log.record, log.spans)
            fitted_spans.append(first)
            held_spans.append(last)
    try:
        identification = identify_records(records, fitted_spans, vehicle, wind=wind)
    except ParameterError as error:
        if error.owner != "vehicle":
            raise
        raise InputError(
            f"the logs and {start} give a vehicle that cannot be: {error}; correct mass, arm_length or speed "
            "range, or what was kept and does not suit what was identified"
        ) from None
    return identification, predict(predicted, held_spans, identification, vehicle, fitted=not tested)


def _refuse_same_flights(logs: Sequence[_Usable]) -> None:
    """Refuse two logs with the same body rates, which would count twice."""
    for one, other in itertools.combinations(logs, 2):
        if np.array_equal(one.record.rates, other.record.rates):
            raise InputError(f"{one.record.name} and {other.record.name} are the same flight: name it once")


def _usable(
    paths: Sequence[Path], vehicle: Vehicle, poles: int | None, columns: Sequence[NamedQuantity]
) -> tuple[list[_Usable], list[str]]:
    """Return the logs that can be used, and a line for each that is left out.

    Raises:
        InputError: none can be used, or a file is missing.
    """
    usable: list[_Usable] = []
    errors: list[InputError] = []
    for path in paths:
        try:
            record = read_record(path, poles=poles, columns=columns)
            with fitting_errors(record.name):
                airborne = airborne_spans(record, vehicle)
                notes = check_log(record, vehicle, airborne)
        except InputError as error:
            if isinstance(error, MissingPackageError) or not path.exists():
                raise
            errors.append(error)
            continue
        usable.append(_Usable(record, airborne, notes))
    if errors and not usable:
        raise errors[0]
    return usable, [f"left out: {error}" for error in errors]


def _render(result: IdentifiedVehicle) -> str:
    """Return the page as HTML."""
    parameters, disturbance, errors = result.tables()
    trace = result.prediction.trace
    figures = (trace_figure(trace), residual_figure(result.prediction), horizon_figure(result.prediction))
    return render_page(
        "identification",
        f"Identified: {result.vehicle.name}",
        [
            Section(
                title="Parameters",
                plots=(to_plot(interval_figure(result.identification.estimates)),),
                tables=(parameters, disturbance),
            ),
            Section(title="Prediction of flight not fitted", plots=tuple(map(to_plot, figures)), tables=(errors,)),
        ],
        verdict=result.verdict,
        notes=(result.counted, *result.sentences()),
    )


def _parameter_line(estimate: ParameterEstimate, known: Identification) -> tuple[Cell, ...]:
    """Return a line of the table of parameters."""
    if estimate.start is None:
        start = ABSENT
    else:
        start = f"{estimate.start:.4g}"
    value = f"{rounded(estimate.value, estimate):.7g}"
    judged = Cell(text=verdict(estimate, known.vehicle), mark=Mark.TEXT)
    return line(estimate.name, estimate.unit, start, value, interval_text(estimate), judged)


def _disturbance_line(estimate: DisturbanceEstimate) -> tuple[Cell, ...]:
    """Return a line of the table of disturbances."""
    name = f"{estimate.kind} {estimate.axis}"
    if estimate.refused:
        why = Cell(text=f"left out: {estimate.refused}", mark=Mark.TEXT)
        return line(name, estimate.unit, *4 * [ABSENT], why)
    return line(
        name,
        estimate.unit,
        f"{estimate.deviation:.3g}",
        factor_text(estimate.deviation_interval),
        f"{estimate.time:.3g}",
        factor_text(estimate.time_interval),
        Cell(text="identified", mark=Mark.TEXT),
    )


def _error_cells(errors: Sequence[float]) -> list[Cell]:
    """Return the cells of a line: each model's error, the least marked, then the floor, which predicts nothing."""
    *predicted, floor = errors
    best = min(predicted)
    cells = []
    for error in predicted:
        cells.append(Cell(text=format_number(error), mark=Mark.BEST if error == best else Mark.NONE))
    cells.append(Cell(text=format_number(floor)))
    return cells


def _plain(values: Any) -> Any:
    """Return plain data in which numbers that are not finite are None."""
    if isinstance(values, dict):
        return {name: _plain(value) for name, value in values.items()}
    if isinstance(values, list | tuple | np.ndarray):
        return [_plain(value) for value in values]
    if isinstance(values, float) and not math.isfinite(values):
        return None
    return values
