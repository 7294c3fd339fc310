"""Flight logs of any make as one record: uniform samples in quadsim's frames and units."""

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
from quadsim.features.identify.border import reading
from quadsim.features.identify.dataflash import read_dataflash
from quadsim.features.identify.inertial import filled_in, integrated_velocity, levelled_attitude
from quadsim.features.identify.quantities import LoggedColumns, NamedQuantity, to_series
from quadsim.features.identify.sensors import without_held_rows, without_spikes, without_stopped_counters
from quadsim.features.identify.series import Column, held
from quadsim.features.identify.tables import read_columns
from quadsim.flight.parquet import FLIGHT_FILE
from quadsim.state import Array

LONGEST_GAP: Final = 5.0  # periods that interpolation bridges; samples in longer gaps are NaN
SLOWEST_RATE: Final = 10.0  # [Hz] of a log
SLOWEST_COMMANDS: Final = 20.0  # [Hz] at which the rotors' outputs must be logged
FASTEST_RATE: Final = 250.0  # [Hz] above which samples are averaged: none of the parameters is as fast
SLOWEST_VELOCITY: Final = 0.04  # period [s] of a velocity above which an accelerometer knows it better
LONGEST_PAUSE: Final = 600.0  # [s] between two samples of one flight
MOST_TIMES_REPEATED: Final = 0.5  # share of rows whose repeated time is that of a row to drop, not of a coarse clock
STAMP_ROUNDING: Final = 6e-4  # [s] from a uniform clock's time to its stamp in milliseconds
_LFS_POINTER: Final = b"version https://git-lfs"
INPUTS: Final = ("commands", "throttle", "speeds")


class LogFormat(NamedTuple):
    """A kind of file that is a log."""

    title: str
    suffixes: tuple[str, ...]
    first_bytes: tuple[bytes, ...]  # which also tell it
    read: Callable[[Path, Sequence[NamedQuantity]], LoggedColumns]
    library: str = ""  # that `read` imports, of the extra `logs`


FORMATS: Final = (
    LogFormat("table", (".csv", ".parquet"), (), read_columns),
    LogFormat("ULog", ulog.ULOGS, (b"ULog",), ulog.read_ulog, "pyulog"),
    LogFormat("Blackbox log", (".bbl", ".bfl"), (b"H Product:Blackbox",), read_blackbox, "orangebox"),
    LogFormat("log of a Crazyflie", (), crazyflie.FIRST_BYTES, crazyflie.read_crazyflie),
    LogFormat("bag", (".bag", ".mcap", ".db3"), (b"#ROSBAG", b"\x89MCAP", b"SQLite format 3"), read_bag, "rosbags"),
    LogFormat("dataflash log", (".bin",), (b"\xa3\x95",), read_dataflash, "pymavlink"),
)


@dataclass(frozen=True, kw_only=True)
class Record:
    """A flight as it was logged: N samples, uniform in time; world z up, body x forward, y left, z up.

    Samples in gaps of the log are NaN; `quadsim.features.identify.checks.spans` leaves them out.
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
    rotors_unknown: float = 0.0  # share of rows in which the radio held what it says of the rotors too
    inertial: bool = False
    """Whether an accelerometer stands in for the velocity, which then has its changes, but neither mean nor drift."""
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


def driver(record: Record) -> Array:
    """What drives the rotors (N, 4): measured speeds, else the commands or the throttle."""
    rows = next(rows for rows in (record.speeds, record.commands, record.throttle) if rows is not None)
    return np.asarray(rows)


def read_record(path: Path | str, *, poles: int | None = None, columns: Sequence[NamedQuantity] = ()) -> Record:
    """Read a log: a table, a run directory of quadsim or its `flight.parquet`, or an autopilot's log.

    Args:
        path: file or run directory.
        poles: magnets of each motor, for electrical speeds: eRPM / (poles / 2) = rpm.
        columns: a map of its columns (`quadsim.features.identify.quantities.read_map`).

    Raises:
        FileError: it is missing or damaged, or lacks a column; the message names what is allowed. Whatever else its
            values make reading raise is such an error.
        MissingPackageError: its format needs a library that is not installed.
        InputError: its clock stands still or goes back, or it has fewer than 10 samples per second.
    """
    given = Path(path)
    bag = (given / "metadata.yaml").is_file()  # of ROS 2, a directory
    if given.is_dir() and not bag:
        file = given / FLIGHT_FILE
    else:
        file = given
    if not (file.is_file() or bag):
        raise FileError(given, "has no flight.parquet" if given.is_dir() else "is missing, or not a file")
    kind = _format_of(file)
    if kind.read is not read_columns and any(one.quantity == "t" for one in columns):
        raise InputError(f"{given.name}: has a clock of its own; leave [t] out of the map")
    with reading(file, kind.title, kind.library):
        log = kind.read(file, columns)
        series = to_series(file, log, columns, poles)
        record = to_record(file.resolve().parent.name if file.name == FLIGHT_FILE else file.name, series)
    return replace(record, advice=log.advice, notes=(*log.notes, *record.notes))


def _format_of(file: Path) -> LogFormat:
    if file.is_dir():
        return next(of for of in FORMATS if of.read is read_bag)
    try:
        with file.open("rb") as opened:
            first = opened.read(64)
    except OSError as error:
        raise FileError(file, f"cannot be read ({error})") from error
    if first.startswith(_LFS_POINTER):
        raise FileError(file, "is a pointer of Git LFS, not the log itself: git lfs pull fetches it")
    by_bytes = (of for of in FORMATS if first.startswith(of.first_bytes))
    by_suffix = (of for of in FORMATS if file.suffix.lower() in of.suffixes)
    if (found := next(by_bytes, None) or next(by_suffix, None)) is None:
        suffixes = ", ".join(suffix for of in FORMATS for suffix in of.suffixes)
        raise FileError(file, f"is not a log that can be read (these can: {suffixes}, and those of a Crazyflie)")
    return found


def to_record(name: str, series: Mapping[str, Column]) -> Record:
    """Sample the series of a log, by field of `Record`, on one uniform clock.

    Commands are held, all else is linear in time. Series that share a uniform clock stay as they are. The voltage
    has no gaps: it changes slowly; nor has `flying`, which changes rarely.
    """
    flying = series.get("flying")
    series, notes = _without_repeated_times(name, {field: of for field, of in series.items() if field != "flying"})
    for field, samples in series.items():
        if field != "voltage":
            _check_clock(name, field, samples.t)
    series, spikes = without_spikes(name, series)
    series, stops = without_stopped_counters(name, series)
    series, repeats = without_held_rows(name, series)
    notes = (*notes, *spikes, *stops, *repeats)
    voltage = series.pop("voltage", None)
    fresh = series.pop("fresh", None)
    force = series.pop("specific_force", None)
    optional = ("position", *INPUTS)
    series = {f: s for f, s in series.items() if f not in optional or np.isfinite(s.values).all(axis=1).any()}
    inertial = not {"velocity", "position"} & {*series}
    if inertial:
        assert force is not None
        series = {**series, "velocity": force}
        notes = (*notes, f"{name}: no velocity is logged; the accelerometer stands in for it")
    elif "velocity" not in series:
        place = series["position"]
        slope = np.gradient(place.values, place.t, axis=0)
        series = {**series, "velocity": Column(t=place.t, values=slope)}
        notes = (*notes, f"{name}: no velocity is logged; it is the central difference of the position")
    if "attitude" not in series:
        assert force is not None
        gyro = series["rates"]
        known = np.stack([np.interp(gyro.t, force.t, column) for column in force.values.T], axis=1)
        series["attitude"] = Column(t=gyro.t, values=levelled_attitude(gyro.t, gyro.values, known))
        notes = (*notes, f"{name}: no attitude is logged; it is the gyro's, levelled by the accelerometer")
    turn = series["attitude"]
    series = {**series, "attitude": turn._replace(values=_continuous(name, turn.values))}
    grid = _clock(name, series)
    values: dict[str, Any] = {
        field: _sampled(samples, grid, held=field in INPUTS[:2]) for field, samples in series.items()
    }
    values["attitude"] /= np.linalg.norm(values["attitude"], axis=1, keepdims=True)
    period = float(grid[1] - grid[0])
    if inertial:
        values["velocity"] = integrated_velocity(name, values["velocity"], values["attitude"], period)
    elif force is not None and (slow := _usual_period(series["velocity"].t)) > SLOWEST_VELOCITY:
        shown = integrated_velocity(name, _sampled(force, grid, held=False), values["attitude"], period)
        values["velocity"] = filled_in(values["velocity"], shown, round(2.0 * slow / period))
        notes = (*notes, f"{name}: the velocity is logged at {1.0 / slow:.3g} Hz; the accelerometer fills it in")
    if voltage is not None and (there := np.isfinite(voltage.values[:, 0])).any():
        values["voltage"] = np.interp(grid, voltage.t[there], voltage.values[there, 0])
    if fresh is not None:
        fresh_rows, known_rotors = held(fresh, grid + 0.05 * period).T
        values["fresh"] = fresh_rows
        values["rotors_unknown"] = np.full(len(grid), 1.0 - known_rotors.mean())
    if len(grid) > 10 * (size := int(1.0 / (FASTEST_RATE * period))) > 20:
        grid, values = _thinned(grid, values, size - 1 + size % 2)
        values["attitude"] /= np.linalg.norm(values["attitude"], axis=1, keepdims=True)
        rates = f"{1.0 / period:.0f} Hz, of which means at {1.0 / (grid[1] - grid[0]):.0f} Hz are used"
        notes = (*notes, f"{name}: {rates}")
    if flying is None:
        aloft = None
    else:
        aloft = held(Column(flying.t, flying.values[:, 0]), grid) > 0.5
    if "fresh" in values:
        values["fresh"] = values["fresh"] > 0.0
        values["rotors_unknown"] = float(values["rotors_unknown"][0])
    return Record(name=name, t=grid, flying=aloft, notes=notes, inertial=inertial, **values)


def _thinned(grid: Array, values: Mapping[str, Array], size: int) -> tuple[Array, dict[str, Any]]:
    """The mean of every `size` samples, odd, about their middle; of what is held, from there to the next middle."""
    count = len(grid) // size - 1
    half = size // 2
    means = {}
    for field, rows in values.items():
        begin = half if field in INPUTS[:2] else 0
        blocks = rows[begin : begin + count * size]
        means[field] = blocks.reshape(count, size, *rows.shape[1:]).mean(axis=1)
    return grid[half : half + count * size : size], means


def _without_repeated_times(name: str, series: Mapping[str, Column]) -> tuple[dict[str, Column], tuple[str, ...]]:
    """Return the series without rows that repeat a time, and a note of each clock; not where most rows do."""
    kept: dict[int, tuple[Array, NDArray[np.bool_]]] = {}
    notes = []
    result = dict(series)
    for field, samples in series.items():
        clock = id(samples.t)
        if clock not in kept:
            first = np.append(True, np.diff(samples.t) != 0.0)
            repeats = np.count_nonzero(~first)
            few = 0 < repeats <= MOST_TIMES_REPEATED * samples.t.size
            if few:
                kept[clock] = (samples.t[first], first)
            else:
                kept[clock] = (samples.t, np.ones(samples.t.size, bool))
            if few:
                row = int(np.argmin(first))
                where = f"the first at row {row}, t = {samples.t[row]:.6g} s"
                notes.append(f"{name}: {repeats} rows of {field} repeat a time, {where}: left out")
        t, first = kept[clock]
        if t is not samples.t:
            result[field] = Column(t=t, values=samples.values[first])
    return result, tuple(notes)


def _check_clock(name: str, field: str, t: Array) -> None:
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
    if norms.size and np.abs(norms - 1.0).max() > 0.02:
        raise InputError(
            f"{name}: attitude has quaternions of norm {norms.min():.3g} to {norms.max():.3g}; all must be 1 within "
            "2 %: look for a column that was scaled, centred or misnamed"
        )
    unit = quaternion[there] / norms[:, None]
    unit[1:] *= np.cumprod(np.where((unit[1:] * unit[:-1]).sum(axis=1) < 0.0, -1.0, 1.0))[:, None]
    result = quaternion.copy()
    result[there] = unit
    return result


def _usual_period(t: Array) -> float:
    """Mean step [s] of a clock outside its gaps."""
    steps = np.diff(t)
    return float(steps[steps <= 1.5 * np.median(steps)].mean())


def _clock(name: str, series: Mapping[str, Column]) -> Array:
    """The common clock: of the rates or of the commands, whichever is slower; where all fields have samples.

    Commands that are logged too rarely do not count: the checks name them.
    """
    driver = next((field for field in INPUTS if field in series), None)
    if driver is None:
        raise InputError(f"{name}: its commands, throttle and speeds have no row with a number for each rotor")
    clocks = [series["rates"].t, series[driver].t]
    if driver != "speeds" and _usual_period(clocks[1]) > 1.0 / (0.9 * SLOWEST_COMMANDS):
        del clocks[1]
    slower = max(clocks, key=_usual_period)
    period = _usual_period(slower)
    pause = int(np.argmax(np.diff(slower)))
    if slower[pause + 1] - slower[pause] > max(LONGEST_PAUSE, 100.0 * period):
        raise InputError(
            f"{name}: its time jumps from {slower[pause]:.6g} to {slower[pause + 1]:.6g} s; at most "
            f"{LONGEST_PAUSE:g} s may be between two samples: give one flight per log"
        )
    if 1.0 / period < 0.95 * SLOWEST_RATE:
        raise InputError(
            f"{name}: {1.0 / period:.3g} samples per second, period {period:.4g} s; at least {SLOWEST_RATE:g} Hz are "
            "needed and 100 Hz or more are good (is t in seconds?)"
        )
    start = max(s.t[0] for s in series.values())
    stop = min(s.t[-1] for s in series.values())
    if stop - start < 2.0 * period:
        raise InputError(f"{name}: its fields share no time: the last starts at {start:.6g} s, one ends at {stop:.6g}")
    if all(s.t is slower for s in series.values()):
        ticks = np.arange(slower.size) - 0.5 * (slower.size - 1)
        line = slower.mean() + ticks * float(ticks @ slower / (ticks @ ticks))
        off = np.abs(slower - line).max()
        if off <= 1e-6 * period + 4.0 * np.spacing(np.abs(slower).max()):
            return slower
        if off <= min(STAMP_ROUNDING, 0.25 * period):
            slower[:] = line  # stamps in whole milliseconds: the clock is uniform, its stamps are rounded
            return slower
    return np.asarray(start + period * np.arange(int((stop - start) / period + 1e-6) + 1))


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
    near = 0.05 * period  # a stamp's jitter must neither hold a command for a period too long nor open a gap
    before = np.clip(np.searchsorted(t, grid + near, side="right") - 1, 0, t.size - 1)
    after = np.minimum(np.searchsorted(t, grid - near, side="left"), t.size - 1)
    if held:
        sampled = values[before]
    else:
        sampled = np.stack([np.interp(grid, t, column) for column in values.T], axis=1)
    outside = (grid < t[0] - 0.5 * period) | (grid > t[-1] + (LONGEST_GAP if held else 0.5) * period)
    sampled[outside | (t[after] - t[before] > LONGEST_GAP * period + near)] = np.nan
    return np.asarray(sampled)
