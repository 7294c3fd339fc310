"""The rows of a campaign, one per flight, and their Parquet table.

A column's unit stands in its metadata.  A value that does not exist, such as the tracking error of a flight that raised
before its first period, is null.
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
from quadsim.flight import metrics
from quadsim.flight.audit import Finding, Limit
from quadsim.flight.log import FlightLog
from quadsim.flight.parquet import read_parquet
from quadsim.state import REFERENCE_NAMES, REFERENCE_UNITS, Array
from scenarios.campaign.results.events import HARMLESS, INCOMPLETE, VERDICTS, Event, Flags
from scenarios.many import ERROR

Row = dict[str, Any]  # one flight's values by column: numbers, texts, or None
DRAW: Final = "draw."  # how the columns of drawn values begin
MARGIN, TIME_VIOLATED, SATISFIED = "margin.", "time_violated.", "satisfied."
"""How the columns of a constraint begin, before its name."""
_MEASURES: Final = ("rmse", "max_error", "final_error", "overshoot")
_HEAD: Final = (
    ("status", "-", pa.string()),
    ("verdict", "-", pa.string()),
    ("reason", "-", pa.string()),
    ("failed", "-", pa.bool_()),
    ("violated", "-", pa.bool_()),
    ("crashed", "-", pa.bool_()),
    ("duration", "s", pa.float64()),
)
_COMMANDS: Final = (
    ("peak_tilt", "deg", pa.float64()),
    ("speed_min", "rad/s", pa.float64()),
    ("speed_max", "rad/s", pa.float64()),
    ("slew_min", "rad/s", pa.float64()),
    ("slew_max", "rad/s", pa.float64()),
    ("total_variation", "rad/s", pa.float64()),
    ("fallback_periods", "-", pa.int64()),
    ("fallback_max", "-", pa.int64()),
    ("unsolved_periods", "-", pa.int64()),
    ("slack_max", "rad", pa.float64()),
    ("solver_periods", "-", pa.int64()),
    ("iterations.mean", "-", pa.float64()),
    ("iterations.max", "-", pa.int64()),
)
_WORST: Final = (("worst_margin", "-", pa.float64()), ("worst_constraint", "-", pa.string()))
_COMMANDED: Final = ("speed", "slew")  # signals that the controller sets itself
TIMING: Final = (
    ("machine", "-", pa.string()),
    ("wall_s", "s", pa.float64()),
    ("step_p50_ms", "ms", pa.float64()),
    ("step_p99_ms", "ms", pa.float64()),
)
"""What a clock measured of a flight, and where; it stands in a table of its own."""
Summary = Mapping[str, Any]
Texts = np.ndarray[Any, np.dtype[np.object_]]
_NO_METRIC: Final = ("flight", "seed", DRAW, MARGIN, TIME_VIOLATED, SATISFIED)
Rows = np.ndarray[Any, np.dtype[np.intp]]


def make_schema(draws: Mapping[str, tuple[pa.DataType, str]], limits: Sequence[Limit]) -> pa.Schema:
    """The columns of a campaign, clock times last.

    Args:
        draws: type and unit, `-` for none, of each varied parameter, by name.
        limits: what its flights are audited against.
    """
    tracked = [
        (f"{measure}.{channel}", unit, pa.float64())
        for measure in _MEASURES
        for channel, unit in zip(REFERENCE_NAMES, REFERENCE_UNITS, strict=True)
    ]
    audited = [
        column
        for limit in limits
        for column in (
            (MARGIN + limit.name, limit.unit, pa.float64()),
            (TIME_VIOLATED + limit.name, "s", pa.float64()),
            (SATISFIED + limit.name, "-", pa.bool_()),
        )
    ]
    columns = [
        ("flight", "-", pa.int64()),
        ("seed", "-", pa.int64()),
        *((DRAW + name, unit, kind) for name, (kind, unit) in draws.items()),
        *_HEAD,
        *tracked,
        *_COMMANDS,
        *audited,
        *_WORST,
        *TIMING,
    ]
    return pa.schema([pa.field(name, kind, metadata={"unit": unit}) for name, unit, kind in columns])


def flown_row(log: FlightLog, findings: Sequence[Finding], *, verdict: str, wall_s: float, machine: str) -> Row:
    """What a campaign keeps of a flight.

    Args:
        log: with plant rows at the physics rate.
        findings: its audit.
        verdict: `satisfied`, `violated`, `lost` or `incomplete`.
        wall_s: how long it took to fly [s].
        machine: the processor that flew it.
    """
    row: Row = {
        "status": log.status,
        "verdict": verdict,
        "reason": log.reason,
        "violated": verdict not in (HARMLESS, INCOMPLETE),
        "crashed": str(Phase.CRASHED) in log.control.phase,
        "duration": round(float(log.plant.t[-1]), 9),
        "wall_s": wall_s,
        "machine": machine,
    }
    for finding in findings:
        name = finding.limit.name
        row[MARGIN + name] = finding.worst_margin if math.isfinite(finding.worst_margin) else None
        row[TIME_VIOLATED + name] = finding.time_violated
        unknown = finding.verdict == "incomplete" and verdict != "lost"  # a lost flight had to get there
        row[SATISFIED + name] = None if unknown else finding.satisfied
    row["worst_margin"], row["worst_constraint"] = worst_margin(findings)
    return row | (_numbers(log) if log.control.t.size else {})


def failed_row(reason: str, verdict: str = ERROR) -> Row:
    """The row of a flight that raised, whose process died, or that met a limit of time or memory."""
    return {"status": verdict, "verdict": verdict, "reason": reason, "violated": True, "crashed": False}


def worst_margin(findings: Iterable[Finding]) -> tuple[float | None, str | None]:
    """The smallest margin of the required constraints, tolerance included, as a share of half its band, and whose.

    At the physics rate or at the control samples, each with its own tolerance, whichever is smaller: it is negative
    where a constraint that was reached did not hold.  1 is the middle of a band, 0 the end of what is allowed; of a
    bound with one side alone, the share is of the bound's own magnitude.  A command at its own bound is no near miss:
    constraints of `speed` and `slew` count once they are violated.  None where no such constraint was reached.
    """
    shares = [
        (share, finding.limit.name)
        for finding in findings
        if finding.limit.required and math.isfinite(share := _share(finding))
        if share < 0.0 or finding.limit.signal not in _COMMANDED
    ]
    return min(shares, default=(None, None))


def make_table(rows: Iterable[Row], schema: pa.Schema) -> pa.Table:
    """Rows as a table, sorted by flight; what a row lacks is null, and text that is no Unicode has backslashes."""
    ordered = sorted(rows, key=lambda row: row["flight"])
    columns = [pa.array([_storable(row.get(field.name)) for row in ordered], field.type) for field in schema]
    return pa.Table.from_arrays(columns, schema=schema)


def split_times(table: pa.Table) -> tuple[pa.Table, pa.Table]:
    """What a seed determines, and what a clock measured, by flight."""
    times = [name for name, *_ in TIMING]
    return table.drop_columns(times), table.select(["flight", *times])


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
    return str(metadata.get(b"unit", b"-").decode())


def _numbers(log: FlightLog) -> Row:
    control = log.control
    tracked = metrics.tracking(control)
    accepted = sum(status in ACCEPTED for status in control.status)
    by_solver = np.array([by not in NO_SOLVER for by in control.answered_by])
    grounded = sum(status in (Phase.LANDED, Phase.CRASHED) for status in control.status)
    return {
        **{f"{measure}.{name}": tracked[measure][name] for measure in _MEASURES for name in REFERENCE_NAMES},
        **metrics.control(control),
        "peak_tilt": metrics.peak_tilt(log.plant.state),
        "fallback_periods": int(np.count_nonzero(control.fallback)),
        "fallback_max": int(control.fallback.max()),
        "unsolved_periods": control.t.size - accepted - grounded,
        "slack_max": float(control.slack.max()),
        "solver_periods": int(by_solver.sum()),
        "iterations.mean": float(control.iterations[by_solver].mean()) if by_solver.any() else None,
        "iterations.max": int(control.iterations[by_solver].max()) if by_solver.any() else None,
        **dict(zip(("step_p50_ms", "step_p99_ms"), np.percentile(log.timing.step_ms, [50, 99]).tolist(), strict=True)),
    }


def _share(finding: Finding) -> float:
    """A margin, tolerance included, as a share of half its band."""
    at_physics_rate = finding.worst_margin + finding.limit.tolerance
    at_samples = finding.worst_margin_sampled + finding.limit.tolerance_sampled
    nearest = np.fmin(at_physics_rate, at_samples) if math.isfinite(at_physics_rate) else at_physics_rate
    return float(nearest) / finding.limit.half_band


def _storable(value: object) -> object:
    """A text without lone surrogates, which no file holds; all else as it is."""
    return value.encode("utf-8", "backslashreplace").decode() if isinstance(value, str) else value


def numbers(table: pa.Table, name: str) -> Array:
    """(K,) a column of numbers or of truth values; NaN where a flight has none, or where there is no such column."""
    if name not in table.column_names:
        return np.full(table.num_rows, np.nan)
    return np.array(table[name].cast(pa.float64()).to_numpy(), float)


def flags(table: pa.Table, name: str, *, absent: bool) -> Flags:
    """(K,) a column of truth values, with `absent` where a flight has none."""
    return np.array(table[name].fill_null(absent).to_pylist(), bool)


def texts(table: pa.Table, name: str) -> Texts:
    """(K,) a column as text, `-` where a flight has none; truth values as `true` and `false`."""
    words = {None: "-", True: "true", False: "false"} if pa.types.is_boolean(table[name].type) else {None: "-"}
    return np.array([str(words.get(value, value)) for value in table[name].to_pylist()], object)


def verdicts(table: pa.Table) -> dict[str, Flags]:
    """(K,) which flights have each verdict."""
    found = texts(table, "verdict")
    return {verdict: np.asarray(found == verdict, bool) for verdict in VERDICTS}


def is_counted(table: pa.Table, event: Event) -> Flags:
    """(K,) which flights count for an event's share: of failure and violation, those that show whether it happened.

    An incomplete flight without it shows neither: it is left out, as it is no success.
    """
    if event.text not in ("failure", "violation") or "verdict" not in table.column_names:
        return np.ones(table.num_rows, bool)
    return np.asarray((texts(table, "verdict") != INCOMPLETE) | event.column(table), bool)


def draw_names(table: pa.Table) -> list[str]:
    """The varied parameters, in order."""
    return [name.removeprefix(DRAW) for name in table.column_names if name.startswith(DRAW)]


def constraint_names(table: pa.Table) -> list[str]:
    """The constraints of the scenario, in order."""
    return [name.removeprefix(SATISFIED) for name in table.column_names if name.startswith(SATISFIED)]


def metric_names(table: pa.Table) -> list[str]:
    """The columns that measure a flight by a number, `worst_margin` included."""
    return [
        field.name
        for field in table.schema
        if (pa.types.is_integer(field.type) or pa.types.is_floating(field.type))
        and not field.name.startswith(_NO_METRIC)
    ]


def is_number(table: pa.Table, name: str) -> bool:
    """Whether a column holds numbers, rather than texts or truth values."""
    kind = table.schema.field(name).type
    return bool(pa.types.is_integer(kind) or pa.types.is_floating(kind))
