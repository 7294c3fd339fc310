"""Flight logs of any make as one record: uniform samples in quadsim's frames and units.

A format's reader gives columns, `quantities.to_series` turns them into series in our units, each on its own clock;
`to_record` cuts the samples that failed, derives what is not logged, and samples all of it at t_k = t_0 + k T.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from quadsim.errors import FileError, InputError
from quadsim.features.identify import crazyflie, ulog
from quadsim.features.identify.bags import read_bag
from quadsim.features.identify.blackbox import read_blackbox
from quadsim.features.identify.dataflash import read_dataflash
from quadsim.features.identify.inertial import filled_velocity, integrated_velocity, levelled_attitude
from quadsim.features.identify.log_errors import reading_errors
from quadsim.features.identify.quantities import LoggedColumns, NamedQuantity, to_series
from quadsim.features.identify.sensors import (
    NORM_TOLERANCE,
    without_held_rows,
    without_spikes,
    without_stopped_counters,
)
from quadsim.features.identify.series import Column, interpolated, latest_samples
from quadsim.features.identify.tables import read_columns
from quadsim.flight.parquet import FLIGHT_FILE
from quadsim.state import Array, Indices

LONGEST_GAP: Final = 5.0  # periods that interpolation bridges; samples in longer gaps are NaN
SLOWEST_RATE: Final = 10.0  # [Hz] of a log
SLOWEST_COMMANDS: Final = 20.0  # [Hz] at which the rotors' outputs must be logged
FASTEST_RATE: Final = 250.0  # [Hz] above which samples are averaged: none of the parameters is as fast
SLOWEST_VELOCITY: Final = 0.04  # period [s] of a velocity above which an accelerometer gives it better
LONGEST_PAUSE: Final = 600.0  # [s] between two samples of one flight
MOST_TIMES_REPEATED: Final = 0.5  # share of rows whose repeated time is that of a row to drop, not of a coarse clock
STAMP_ROUNDING: Final = 6e-4  # [s] from a uniform clock's time to its stamp in milliseconds
STAMP_JITTER: Final = 0.05  # of a period: it must neither hold a command for a period too long nor open a gap
_LFS_POINTER: Final = b"version https://git-lfs"
HELD_INPUTS: Final = ("commands", "throttle")  # held from one sample to the next
ROTOR_INPUTS: Final = (*HELD_INPUTS, "speeds")
"""What a log may have of the rotors' outputs, one at least."""


class LogFormat(NamedTuple):
    """A kind of file that is a log."""

    title: str
    suffixes: tuple[str, ...]
    first_bytes: tuple[bytes, ...]  # of a file of this kind, whatever its suffix
    read: Callable[[Path, Sequence[NamedQuantity]], LoggedColumns]
    library: str = ""  # that `read` imports; it is installed with the extra `logs`


_BAG: Final = LogFormat(
    "bag", (".bag", ".mcap", ".db3"), (b"#ROSBAG", b"\x89MCAP", b"SQLite format 3"), read_bag, "rosbags"
)
FORMATS: Final = (
    LogFormat("table", (".csv", ".parquet"), (), read_columns),
    LogFormat("ULog", ulog.ULOGS, (b"ULog",), ulog.read_ulog, "pyulog"),
    LogFormat("Blackbox log", (".bbl", ".bfl"), (b"H Product:Blackbox",), read_blackbox, "orangebox"),
    LogFormat("log of a Crazyflie", (), crazyflie.FIRST_BYTES, crazyflie.read_crazyflie),
    _BAG,
    LogFormat("dataflash log", (".bin",), (b"\xa3\x95",), read_dataflash, "pymavlink"),
)


@dataclass(frozen=True, kw_only=True)
class Record:
    """A flight as it was logged: N samples, uniform in time; world z up, body x forward, y left, z up.

    Samples in gaps of the log are NaN; `quadsim.features.identify.checks.airborne_spans` leaves them out.
    """

    name: str  # of the log, for messages and sources
    t: Array  # (N,) [s]
    velocity: Array  # (N, 3) of the centre of mass, world [m/s]
    attitude: Array  # (N, 4) quaternion wxyz, body to world, sign continuous
    rates: Array  # (N, 3) body rates [rad/s]
    position: Array | None = None  # (N, 3) world [m]
    commands: Array | None = None  # (N, 4) rotor speeds commanded at t_k and held until t_{k+1} [rad/s]
    throttle: Array | None = None  # (N, 4) the same as a share of full throttle [-]; one of these three is there
    speeds: Array | None = None  # (N, 4) measured rotor speeds [rad/s]
    voltage: Array | None = None  # (N,) of the battery [V]
    flying: NDArray[np.bool_] | None = None  # (N,) whether its autopilot was armed and not landed
    fresh: NDArray[np.bool_] | None = None  # (N,) rows that a radio did not hold, where it held any
    rotors_unknown: float = 0.0  # share of rows in which the radio held the columns of the rotors too
    inertial: bool = False
    """Whether the velocity is the integral of an accelerometer: its changes are known, its mean and drift are not."""
    notes: tuple[str, ...] = ()  # what was derived or assumed in reading it
    advice: str = ""  # how its autopilot logs more

    @property
    def period(self) -> float:
        """Time between samples [s]."""
        return float(self.t[-1] - self.t[0]) / (self.t.size - 1)


def part_of(record: Record, span: slice) -> Record:
    """A span of a record as one of its own."""
    cut: dict[str, Any] = {}
    for name, rows in vars(record).items():
        if isinstance(rows, np.ndarray):
            cut[name] = rows[span]
    return replace(record, **cut)


def new_rows(record: Record) -> Indices:
    """The rows that a radio did not hold."""
    if record.fresh is None:
        return np.arange(len(record.t))
    return np.flatnonzero(record.fresh)


def in_parts(rows: Array, parts: Sequence[slice]) -> Array:
    """The rows in some parts of a record, one after the other."""
    return np.concatenate([rows[part] for part in parts])


def rotor_inputs(record: Record) -> Array:
    """What drives the rotors (N, 4): measured speeds, else the commands or the throttle."""
    if record.speeds is not None:
        return record.speeds
    if record.commands is not None:
        return record.commands
    return np.asarray(record.throttle)


def read_record(path: Path | str, *, poles: int | None = None, columns: Sequence[NamedQuantity] = ()) -> Record:
    """Read a log: a table, a run directory of quadsim or its `flight.parquet`, or an autopilot's log.

    Args:
        path: file or run directory.
        poles: magnets of each motor, for electrical speeds: eRPM / (poles / 2) = rpm.
        columns: a map of its columns (`quadsim.features.identify.quantities.read_map`).

    Raises:
        FileError: it is missing or damaged, or lacks a column; the message names what is allowed. Any other error that
            its values cause while it is read is raised as this one.
        MissingPackageError: its format needs a library that is not installed.
        InputError: its clock stands still or goes back, or it has fewer than 10 samples per second.
    """
    file = _file_of(Path(path))
    kind = _format_of(file)
    if kind.read is not read_columns and any(named.quantity == "t" for named in columns):
        raise InputError(f"{file.name}: has a clock of its own; leave [t] out of the map")
    name = file.name
    if name == FLIGHT_FILE:
        name = file.resolve().parent.name
    with reading_errors(file, kind.title, kind.library):
        log = kind.read(file, columns)
        series = to_series(file, log, columns, poles)
        record = to_record(name, series)
    return replace(record, advice=log.advice, notes=(*log.notes, *record.notes))


def _file_of(location: Path) -> Path:
    """The log at a location: the table of a run directory, or the location itself, a file or a bag of ROS 2."""
    is_bag = (location / "metadata.yaml").is_file()  # of ROS 2, a directory
    if is_bag or location.is_file():
        return location
    if not location.is_dir():
        raise FileError(location, "is missing, or not a file")
    table = location / FLIGHT_FILE
    if not table.is_file():
        raise FileError(location, "has no flight.parquet")
    return table


def _format_of(file: Path) -> LogFormat:
    """The format of a log, by its first bytes, else by its suffix."""
    if file.is_dir():
        return _BAG
    try:
        with file.open("rb") as opened:
            first = opened.read(64)
    except OSError as error:
        raise FileError(file, f"cannot be read ({error})") from error
    if first.startswith(_LFS_POINTER):
        raise FileError(file, "is a pointer of Git LFS, not the log itself: git lfs pull fetches it")
    for kind in FORMATS:
        if first.startswith(kind.first_bytes):
            return kind
    for kind in FORMATS:
        if file.suffix.lower() in kind.suffixes:
            return kind
    suffixes: list[str] = []
    for kind in FORMATS:
        suffixes += kind.suffixes
    listed = ", ".join(suffixes)
    raise FileError(file, f"is not a log that can be read (these can: {listed}, and those of a Crazyflie)")


def to_record(name: str, series: Mapping[str, Column]) -> Record:
    """Sample the series of a log, by field of `Record`, on one uniform clock.

    Commands are held, all else is linear in time. Series that share a uniform clock stay as they are. Gaps of the
    voltage, which changes slowly, and of `flying`, which changes rarely, are bridged.
    """
    logged = dict(series)
    flying = logged.pop("flying", None)
    kept, notes = _without_failed_samples(name, logged)
    voltage = kept.pop("voltage", None)
    fresh = kept.pop("fresh", None)
    force = kept.pop("specific_force", None)
    kept = _without_empty(kept)
    inertial = not {"velocity", "position"} & {*kept}
    moving, derived = _with_motion(name, kept, force)
    notes += derived
    grid = _clock(name, moving)
    period = float(grid[1] - grid[0])
    values: dict[str, Any] = {}
    for field, column in moving.items():
        values[field] = _sampled(column, grid, held=field in HELD_INPUTS)
    _normalise_rows(values["attitude"])
    velocity_period = _usual_period(moving["velocity"].t)
    if inertial:
        values["velocity"] = integrated_velocity(name, values["velocity"], values["attitude"], period)
    elif force is not None and velocity_period > SLOWEST_VELOCITY:
        values["velocity"] = _filled_by_force(name, values, force, grid, velocity_period)
        rate = 1.0 / velocity_period
        notes.append(f"{name}: the velocity is logged at {rate:.3g} Hz; the accelerometer fills it in")
    if voltage is not None:
        there = np.isfinite(voltage.values[:, 0])
        if there.any():
            values["voltage"] = np.interp(grid, voltage.t[there], voltage.values[there, 0])
    if fresh is not None:  # as numbers on the grid, which may be averaged below
        fresh_rows, known_rotors = latest_samples(fresh, grid + STAMP_JITTER * period).T
        values["fresh"] = fresh_rows
        values["rotors_unknown"] = np.full(len(grid), 1.0 - known_rotors.mean())
    grid, values, averaged = _at_fastest_rate(name, grid, values)
    notes += averaged
    if "fresh" in values:  # a mean over rows of which any is new counts as new
        values["fresh"] = values["fresh"] > 0.0
        values["rotors_unknown"] = float(values["rotors_unknown"][0])
    if flying is not None:
        values["flying"] = latest_samples(Column(flying.t, flying.values[:, 0]), grid) > 0.5
    return Record(name=name, t=grid, notes=tuple(notes), inertial=inertial, **values)


def _filled_by_force(
    name: str, values: Mapping[str, Array], force: Column, grid: Array, velocity_period: float
) -> Array:
    """The velocity (N, 3) of a log that has it every `velocity_period` [s], filled in by the accelerometer."""
    period = float(grid[1] - grid[0])
    by_force = integrated_velocity(name, _sampled(force, grid, held=False), values["attitude"], period)
    return filled_velocity(values["velocity"], by_force, round(2.0 * velocity_period / period))


def _at_fastest_rate(name: str, grid: Array, values: dict[str, Any]) -> tuple[Array, dict[str, Any], list[str]]:
    """The grid, the values on it and a note: means of an odd number of samples, at `FASTEST_RATE` or just above it."""
    period = float(grid[1] - grid[0])
    size = int(1.0 / (FASTEST_RATE * period))
    if size <= 2 or len(grid) <= 10 * size:
        return grid, values, []
    odd_size = size
    if size % 2 == 0:
        odd_size = size - 1
    mean_grid, means = _block_means(grid, values, odd_size)
    _normalise_rows(means["attitude"])
    mean_rate = 1.0 / (mean_grid[1] - mean_grid[0])
    return mean_grid, means, [f"{name}: {1.0 / period:.0f} Hz, of which means at {mean_rate:.0f} Hz are used"]


def _normalise_rows(quaternions: Array) -> None:
    """Scale quaternions (N, 4) to norm 1, in place."""
    quaternions /= np.linalg.norm(quaternions, axis=1, keepdims=True)


def _without_failed_samples(name: str, series: dict[str, Column]) -> tuple[dict[str, Column], list[str]]:
    """Return the series without samples that a clock, a sensor or a radio corrupted, and a note of each fault."""
    series, repeats = _without_repeated_times(name, series)
    for field, column in series.items():
        if field != "voltage":
            _check_clock(name, field, column.t)
    series, spikes = without_spikes(name, series)
    series, stops = without_stopped_counters(name, series)
    series, held_rows = without_held_rows(name, series)
    return series, [*repeats, *spikes, *stops, *held_rows]


def _without_empty(series: Mapping[str, Column]) -> dict[str, Column]:
    """The series; a position or rotors' outputs without a single complete row are left out."""
    kept = {}
    for field, column in series.items():
        optional = field == "position" or field in ROTOR_INPUTS
        if not optional or np.isfinite(column.values).all(axis=1).any():
            kept[field] = column
    return kept


def _with_motion(name: str, series: Mapping[str, Column], force: Column | None) -> tuple[dict[str, Column], list[str]]:
    """Return the series with a velocity and a continuous attitude, and a note of each that had to be derived.

    Without velocity and position, the specific force takes the velocity's place, to be integrated later.
    """
    result = dict(series)
    notes = []
    if "velocity" not in series:
        if "position" in series:
            position = series["position"]
            slope = np.gradient(position.values, position.t, axis=0)
            result["velocity"] = Column(t=position.t, values=slope)
            notes.append(f"{name}: no velocity is logged; it is the central difference of the position")
        else:
            assert force is not None
            result["velocity"] = force
            notes.append(f"{name}: no velocity is logged; the accelerometer stands in for it")
    if "attitude" not in series:
        assert force is not None
        gyro = series["rates"]
        force_at_gyro = interpolated(gyro.t, force.t, force.values)
        result["attitude"] = Column(t=gyro.t, values=levelled_attitude(gyro.t, gyro.values, force_at_gyro))
        notes.append(f"{name}: no attitude is logged; it is the gyro's, levelled by the accelerometer")
    attitude = result["attitude"]
    result["attitude"] = attitude._replace(values=_continuous(name, attitude.values))
    return result, notes


def _block_means(grid: Array, values: Mapping[str, Array], size: int) -> tuple[Array, dict[str, Any]]:
    """The middle times of blocks of `size` samples, odd, and the means of the values over each block.

    Inputs that are held act from their sample on: their mean is that from the middle of a block to the next middle.
    """
    count = len(grid) // size - 1
    half = size // 2
    means = {}
    for field, rows in values.items():
        begin = 0
        if field in HELD_INPUTS:
            begin = half
        blocks = rows[begin : begin + count * size]
        means[field] = blocks.reshape(count, size, *rows.shape[1:]).mean(axis=1)
    return grid[half : half + count * size : size], means


def _without_repeated_times(name: str, series: Mapping[str, Column]) -> tuple[dict[str, Column], list[str]]:
    """Return the series without rows that repeat a time, and a note of each clock.

    A clock that repeats most of its times is too coarse, and stays as it is.
    """
    first_rows: dict[int, NDArray[np.bool_]] = {}  # of each clock, the rows that repeat no time
    new_clocks: dict[int, Array] = {}
    notes = []
    result = dict(series)
    for field, column in series.items():
        clock = id(column.t)
        if clock not in new_clocks:
            first = np.append(True, np.diff(column.t) != 0.0)
            repeats = np.count_nonzero(~first)
            first_rows[clock] = first
            new_clocks[clock] = column.t
            if 0 < repeats <= MOST_TIMES_REPEATED * column.t.size:
                new_clocks[clock] = column.t[first]
                row = int(np.argmin(first))
                where = f"the first at row {row}, t = {column.t[row]:.6g} s"
                notes.append(f"{name}: {repeats} rows of {field} repeat a time, {where}: left out")
        t = new_clocks[clock]
        if t is not column.t:
            result[field] = Column(t=t, values=column.values[first_rows[clock]])
    return result, notes


def _check_clock(name: str, field: str, t: Array) -> None:
    """Refuse a clock that is too short, goes back or stands still."""
    steps = np.diff(t)
    if t.size < 2 or not np.isfinite(t).all():
        raise InputError(f"{name}: {field} needs at least 2 samples, each with a finite time; got {t.size} rows")
    if (steps < 0.0).any():
        row = int(np.argmax(steps < 0.0)) + 1
        raise InputError(
            f"{name}: the time of {field} goes back from {t[row - 1]:.6g} to {t[row]:.6g} s at row {row}; give one "
            "flight per log, in order of time"
        )
    if (steps == 0.0).any():
        row = int(np.argmax(steps == 0.0)) + 1
        raise InputError(
            f"{name}: the time of {field} stands still in {np.count_nonzero(steps == 0.0)} rows, first at row {row}, "
            f"t = {t[row]:.6g} s; log it with more digits"
        )


def _continuous(name: str, quaternion: Array) -> Array:
    """Unit quaternions (M, 4), each with the sign nearer to the one before; rows with NaN stay."""
    there = np.isfinite(quaternion).all(axis=1)
    norms = np.linalg.norm(quaternion[there], axis=1)
    if norms.size and np.abs(norms - 1.0).max() > NORM_TOLERANCE:
        raise InputError(
            f"{name}: attitude has quaternions of norm {norms.min():.3g} to {norms.max():.3g}; all must be 1 within "
            f"{100.0 * NORM_TOLERANCE:.0f} %: look for a column that was scaled, centred or misnamed"
        )
    unit = quaternion[there] / norms[:, None]
    flips = np.where((unit[1:] * unit[:-1]).sum(axis=1) < 0.0, -1.0, 1.0)
    unit[1:] *= np.cumprod(flips)[:, None]
    result = quaternion.copy()
    result[there] = unit
    return result


def _usual_period(t: Array) -> float:
    """Mean step [s] of a clock outside its gaps."""
    steps = np.diff(t)
    return float(steps[steps <= 1.5 * np.median(steps)].mean())


def _clock(name: str, series: Mapping[str, Column]) -> Array:
    """The common uniform clock: that of rates or rotors' outputs, the slower, while all fields have samples."""
    slower = _slower_clock(name, series)
    period = _usual_period(slower)
    _check_steps(name, slower, period)
    start = max(column.t[0] for column in series.values())
    stop = min(column.t[-1] for column in series.values())
    if stop - start < 2.0 * period:
        raise InputError(f"{name}: its fields share no time: the last starts at {start:.6g} s, one ends at {stop:.6g}")
    is_shared = all(column.t is slower for column in series.values())
    if is_shared and _make_uniform(slower, period):
        return slower
    samples = int((stop - start) / period + 1e-6) + 1
    return np.asarray(start + period * np.arange(samples))


def _slower_clock(name: str, series: Mapping[str, Column]) -> Array:
    """The clock of the rates or of the rotors' outputs, whichever is slower.

    Commands that are logged too rarely do not count: the checks name them.
    """
    inputs = next((field for field in ROTOR_INPUTS if field in series), None)
    if inputs is None:
        raise InputError(f"{name}: its commands, throttle and speeds have no row with a number for each rotor")
    clock_of_rates = series["rates"].t
    clock_of_inputs = series[inputs].t
    rare = _usual_period(clock_of_inputs) > 1.0 / (0.9 * SLOWEST_COMMANDS)
    if inputs != "speeds" and rare:
        return clock_of_rates
    return max(clock_of_rates, clock_of_inputs, key=_usual_period)


def _check_steps(name: str, clock: Array, period: float) -> None:
    """Refuse a clock that pauses for too long, or that is too slow."""
    pause = int(np.argmax(np.diff(clock)))
    if clock[pause + 1] - clock[pause] > max(LONGEST_PAUSE, 100.0 * period):
        raise InputError(
            f"{name}: its time jumps from {clock[pause]:.6g} to {clock[pause + 1]:.6g} s; at most "
            f"{LONGEST_PAUSE:g} s may be between two samples: give one flight per log"
        )
    if 1.0 / period < 0.95 * SLOWEST_RATE:
        raise InputError(
            f"{name}: {1.0 / period:.3g} samples per second, period {period:.4g} s; at least {SLOWEST_RATE:g} Hz are "
            "needed and 100 Hz or more are good (is t in seconds?)"
        )


def _make_uniform(clock: Array, period: float) -> bool:
    """Whether a clock is uniform; one whose stamps are rounded, as to whole milliseconds, is made so in place."""
    ticks = np.arange(clock.size) - 0.5 * (clock.size - 1)
    line = clock.mean() + ticks * float(ticks @ clock / (ticks @ ticks))
    farthest = np.abs(clock - line).max()
    if farthest <= 1e-6 * period + 4.0 * np.spacing(np.abs(clock).max()):
        return True
    if farthest <= min(STAMP_ROUNDING, 0.25 * period):
        clock[:] = line
        return True
    return False


def _sampled(series: Column, grid: Array, *, held: bool) -> Array:
    """Values (N, n) of a series at the times of a grid, NaN in gaps."""
    there = np.isfinite(series.values).all(axis=1)
    if series.t is grid and there.all():
        return series.values
    if np.count_nonzero(there) < 2:
        return np.full((grid.size, series.values.shape[1]), np.nan)
    t = series.t[there]
    values = series.values[there]
    period = max(_usual_period(series.t), float(grid[1] - grid[0]))
    near = STAMP_JITTER * period
    before = np.clip(np.searchsorted(t, grid + near, side="right") - 1, 0, t.size - 1)
    after = np.minimum(np.searchsorted(t, grid - near, side="left"), t.size - 1)
    if held:
        sampled = values[before]
        longest_beyond = LONGEST_GAP
    else:
        sampled = interpolated(grid, t, values)
        longest_beyond = 0.5
    outside = (grid < t[0] - 0.5 * period) | (grid > t[-1] + longest_beyond * period)
    in_gap = t[after] - t[before] > LONGEST_GAP * period + near
    sampled[outside | in_gap] = np.nan
    return np.asarray(sampled)
