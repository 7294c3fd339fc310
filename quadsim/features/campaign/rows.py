"""The rows of a campaign, one per flight, and their Parquet table.

A column's unit stands in its metadata.  A value that does not exist, such as the tracking error of a flight that raised
before its first period, is null.  `plan` fills rows, `store` writes them; the readers of columns at the end are for
`statistics`, `paired` and the report.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow as pa

from quadsim.controller import ACCEPTED, NO_SOLVER, Phase
from quadsim.errors import FileError
from quadsim.features.campaign.events import ALL_SATISFIED, INCOMPLETE, UNAUDITED, VERDICTS, CountedEvent, FlightFlags
from quadsim.flight import metrics
from quadsim.flight.audit import Finding, Limit, worst_finding, worst_share
from quadsim.flight.log import FlightLog
from quadsim.flight.parquet import FORMAT, read_parquet
from quadsim.rollout.many import Row
from quadsim.state import REFERENCE_NAMES, REFERENCE_UNITS, Array

DRAW: Final = "draw."  # how the columns of drawn values begin
VIOLATION: Final = "violation"  # the event
MARGIN: Final = "margin."
SAMPLED: Final = "margin_sampled."
TIME_VIOLATED: Final = "time_violated."
SATISFIED: Final = "satisfied."
"""Prefixes of the columns of a constraint."""
_MEASURES: Final = ("rmse", "max_error", "final_error", "overshoot")
_FLOAT = pa.float64()
_WHOLE = pa.int64()


def _fields(kind: pa.DataType, unit: str, *names: str) -> list[pa.Field]:
    """Return columns of one type and unit."""
    return [pa.field(name, kind, metadata={"unit": unit}) for name in names]


_HEAD: Final = [
    *_fields(pa.string(), "-", "status", "verdict", "reason"),
    *_fields(pa.bool_(), "-", "failed", "violated", "crashed"),
    *_fields(pa.string(), "-", "failed_by"),
    *_fields(_FLOAT, "s", "duration"),
]
_COMMANDS: Final = [
    *_fields(_FLOAT, "deg", "peak_tilt"),
    *_fields(_FLOAT, "rad/s", "speed_min", "speed_max", "slew_min", "slew_max", "total_variation"),
    *_fields(_WHOLE, "-", "fallback_periods", "fallback_max", "unsolved_periods"),
    *_fields(_FLOAT, "rad", "slack_max"),
    *_fields(_WHOLE, "-", "solver_periods"),
    *_fields(_FLOAT, "-", "iterations.mean"),
    *_fields(_WHOLE, "-", "iterations.max"),
]
_WORST: Final = [*_fields(_FLOAT, "-", "worst_margin"), *_fields(pa.string(), "-", "worst_constraint")]
_TIMING: Final = [
    *_fields(pa.string(), "-", "machine"),
    *_fields(_FLOAT, "s", "wall_s"),
    *_fields(_FLOAT, "ms", "step_p50_ms", "step_p99_ms"),
]
TIMES: Final = tuple(field.name for field in _TIMING)
"""Clock times of a flight and its machine, in a separate table."""
CampaignSummary = Mapping[str, Any]
Texts = np.ndarray[Any, np.dtype[np.object_]]
_NO_METRIC: Final = ("flight", "seed", DRAW, MARGIN, SAMPLED, TIME_VIOLATED, SATISFIED)
RowIndices = np.ndarray[Any, np.dtype[np.intp]]


def make_schema(
    draws: Mapping[str, tuple[pa.DataType, str]], limits: Sequence[Limit], failure: Sequence[str] = (VIOLATION,)
) -> pa.Schema:
    """Return the columns of a campaign, clock times last.

    Args:
        draws: type and unit of each varied parameter.
        limits: the limits of its audit.
        failure: the events that count as failure, in their standard form.
    """
    fields = _fields(_WHOLE, "-", "flight", "seed")
    for name, (kind, unit) in draws.items():
        fields += _fields(kind, unit, DRAW + name)
    fields += _HEAD
    for measure in _MEASURES:
        for channel, unit in zip(REFERENCE_NAMES, REFERENCE_UNITS, strict=True):
            fields += _fields(_FLOAT, unit, f"{measure}.{channel}")
    fields += _COMMANDS
    for limit in limits:
        fields += _fields(_FLOAT, limit.unit, MARGIN + limit.name, SAMPLED + limit.name)
        fields += _fields(_FLOAT, "s", TIME_VIOLATED + limit.name)
        fields += _fields(pa.bool_(), "-", SATISFIED + limit.name)
    fields += _WORST
    fields += _TIMING
    return pa.schema(fields, metadata={"format": str(FORMAT), "failure": "; ".join(failure)})


def flown_row(
    log: FlightLog,
    findings: Sequence[Finding],
    *,
    verdict: str,
    reason: str | None = None,
    wall_s: float,
    machine: str,
) -> Row:
    """Return the row of a flight, with plant rows at the physics rate, its audit, and the reason of its verdict."""
    row: Row = {
        "status": log.status,
        "verdict": verdict,
        "reason": reason or log.reason,
        "violated": verdict not in (ALL_SATISFIED, INCOMPLETE, UNAUDITED),
        "failed_by": metrics.failure(log.control),
        "crashed": log.control.crashed,
        "duration": round(float(log.plant.t[-1]), 9),
        "wall_s": wall_s,
        "machine": machine,
    }
    for finding in findings:
        row |= _constraint_cells(finding, verdict)
    worst = worst_finding(findings)
    if worst is not None:
        row["worst_margin"] = worst_share(findings)
        row["worst_constraint"] = worst.limit.name
    if log.control.t.size:
        row |= _metric_cells(log)
    return row


def _constraint_cells(finding: Finding, verdict: str) -> Row:
    """Return the columns of one constraint, in a flight with this verdict."""
    name = finding.limit.name
    cells: Row = {MARGIN + name: None, SAMPLED + name: None}
    if math.isfinite(finding.worst_margin):
        cells[MARGIN + name] = finding.worst_margin
    if math.isfinite(finding.worst_margin_sampled):
        cells[SAMPLED + name] = finding.worst_margin_sampled
    cells[TIME_VIOLATED + name] = finding.time_violated
    unknown = finding.verdict == "incomplete" and verdict != "lost"  # a lost flight had to get there
    cells[SATISFIED + name] = None if unknown else finding.satisfied
    return cells


def make_table(rows: Iterable[Row], schema: pa.Schema) -> pa.Table:
    """Rows as a table, sorted by flight; what a row lacks is null, and text that is no Unicode has backslashes."""
    ordered = sorted(rows, key=lambda row: row["flight"])
    columns = []
    for field in schema:
        values = [_storable(row.get(field.name)) for row in ordered]
        columns.append(pa.array(values, field.type))
    return pa.Table.from_arrays(columns, schema=schema)


def _storable(value: object) -> object:
    if isinstance(value, str):
        return value.encode("utf-8", "backslashreplace").decode()
    return value


def split_times(table: pa.Table) -> tuple[pa.Table, pa.Table]:
    """Return the columns that a seed determines and those of clock times, by flight."""
    return table.drop_columns([*TIMES]), table.select(["flight", *TIMES])


def read_table(path: Path) -> pa.Table:
    """A table of flights.

    Raises:
        FileError: the file is missing, damaged, or none of ours.
    """
    table = read_parquet(path)
    if "flight" not in table.column_names:
        raise FileError(path, "is not a campaign's table: it has no column 'flight'")
    return table


def unit_of(table: pa.Table, column: str) -> str:
    """The unit of a column; `-` for none."""
    metadata = table.schema.field(column).metadata or {}
    unit: bytes = metadata.get(b"unit", b"-")
    return unit.decode()


def _metric_cells(log: FlightLog) -> Row:
    """Return the columns that measure a flight of at least one control period."""
    control = log.control
    cells: Row = {}
    tracked = metrics.tracking(control)
    for measure in _MEASURES:
        for name in REFERENCE_NAMES:
            cells[f"{measure}.{name}"] = tracked[measure][name]
    cells |= metrics.control(control)
    cells["peak_tilt"] = metrics.peak_tilt(log.plant.state)

    accepted = sum(status in ACCEPTED for status in control.status)
    grounded = sum(status in (Phase.LANDED, Phase.CRASHED) for status in control.status)
    cells["fallback_periods"] = int(np.count_nonzero(control.fallback))
    cells["fallback_max"] = int(control.fallback.max())
    cells["unsolved_periods"] = control.t.size - accepted - grounded
    cells["slack_max"] = float(control.slack.max())

    by_solver = np.array([by not in NO_SOLVER for by in control.answered_by])
    cells["solver_periods"] = int(by_solver.sum())
    cells["iterations.mean"] = None
    cells["iterations.max"] = None
    if by_solver.any():
        iterations = control.iterations[by_solver]
        cells["iterations.mean"] = float(iterations.mean())
        cells["iterations.max"] = int(iterations.max())
    cells["step_p50_ms"] = float(np.percentile(log.timing.step_ms, 50))
    cells["step_p99_ms"] = float(np.percentile(log.timing.step_ms, 99))
    return cells


def numbers(table: pa.Table, name: str) -> Array:
    """(K,) a column of numbers or of truth values; NaN where a flight has none, or where there is no such column."""
    if name not in table.column_names:
        return np.full(table.num_rows, np.nan)
    return np.array(table[name].cast(pa.float64()).to_numpy(), float)


def flags(table: pa.Table, name: str, *, absent: bool) -> FlightFlags:
    """(K,) a column of truth values, with `absent` where a flight has none."""
    return np.array(table[name].fill_null(absent).to_pylist(), bool)


def null(table: pa.Table, name: str) -> FlightFlags:
    """(K,) which flights have no value in a column."""
    return np.array(table[name].is_null().to_pylist(), bool)


def reached(table: pa.Table, name: str) -> FlightFlags:
    """(K,) which flights count for a constraint: all but those that ended well before its time window.

    Lost flights and those that raised an error or met a limit had to get there, so they count: they did not hold it.
    """
    had_to = ~np.isin(texts(table, "verdict").astype(str), (ALL_SATISFIED, INCOMPLETE, UNAUDITED, "violated"))
    return np.asarray(~null(table, SATISFIED + name) | had_to, bool)


def not_held(table: pa.Table, name: str) -> FlightFlags:
    """(K,) which flights did not hold a constraint, of those that count for it; see `reached`."""
    return reached(table, name) & ~flags(table, SATISFIED + name, absent=False)


def texts(table: pa.Table, name: str) -> Texts:
    """(K,) a column as text, `-` where a flight has none; truth values as `true` and `false`."""
    if pa.types.is_boolean(table[name].type):
        words = table[name].cast(pa.string())
    else:
        words = table[name]
    values = []
    for value in words.to_pylist():
        if value is None:
            values.append("-")
        else:
            values.append(str(value))
    return np.array(values, object)


def verdicts(table: pa.Table) -> dict[str, FlightFlags]:
    """(K,) which flights have each verdict."""
    flown = texts(table, "verdict")
    return {verdict: np.asarray(flown == verdict, bool) for verdict in VERDICTS}


def failure_of(table: pa.Table) -> list[str]:
    """The events that count as failure of a flight, in their standard form."""
    stated: bytes = (table.schema.metadata or {}).get(b"failure", VIOLATION.encode())
    return stated.decode().split("; ")


def unaudited(table: pa.Table) -> FlightFlags:
    """(K,) which flights had no constraint; none of a table without verdicts."""
    if "verdict" in table.column_names:
        return np.asarray(texts(table, "verdict") == UNAUDITED)
    return np.zeros(table.num_rows, bool)


def is_counted(table: pa.Table, event: CountedEvent) -> FlightFlags:
    """(K,) which flights count for an event's share: of failure and violation, those that show whether it happened.

    A flight without it that is incomplete or unaudited shows neither: it is left out, as it is no success.  Unaudited
    flights count for failure where violations do not.
    """
    if event.text not in ("failure", VIOLATION) or "verdict" not in table.column_names:
        return np.ones(table.num_rows, bool)
    shows_nothing = [INCOMPLETE]
    if event.text == VIOLATION or VIOLATION in failure_of(table):
        shows_nothing.append(UNAUDITED)
    unknown = np.isin(texts(table, "verdict").astype(str), shows_nothing)
    return np.asarray(~unknown | event.column(table), bool)


def draw_names(table: pa.Table) -> list[str]:
    """The varied parameters, in order."""
    return _names_after(DRAW, table)


def constraint_names(table: pa.Table) -> list[str]:
    """The constraints of the scenario, in order."""
    return _names_after(SATISFIED, table)


def _names_after(prefix: str, table: pa.Table) -> list[str]:
    """The rest of the columns' names that begin so, in order."""
    names = []
    for name in table.column_names:
        if name.startswith(prefix):
            names.append(name.removeprefix(prefix))
    return names


def metric_names(table: pa.Table) -> list[str]:
    """The columns that measure a flight by a number, `worst_margin` included."""
    names = []
    for name in table.column_names:
        if is_number(table, name) and not name.startswith(_NO_METRIC):
            names.append(name)
    return names


def is_number(table: pa.Table, name: str) -> bool:
    """Whether a column holds numbers, rather than texts or truth values."""
    kind = table.schema.field(name).type
    return bool(pa.types.is_integer(kind) or pa.types.is_floating(kind))
