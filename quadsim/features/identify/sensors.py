"""Samples that a sensor, a counter or a radio corrupted: jumps away and back, counters that stop, rows that are held.

A jump is farther from the median about it than 1.5 ranges of all medians.  Such samples are cut before `record`
resamples and averages anything, and a note names sensor, time and value; a sensor that fails too often makes the log
one that cannot be used.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import find_objects, label, maximum_filter1d, median_filter

from quadsim.errors import InputError
from quadsim.features.identify.series import Column, interpolated, latest_samples
from quadsim.state import Array

LONGEST_SPIKE: Final = 3  # samples, of which a log with a sample in `SPIKE_TIME` or more has one
SPIKE_TIME: Final = 0.03  # [s]: what lasts longer may be flown
SPIKE_OVER_RANGE: Final = 1.5  # how far a sample may be from the median about it, in ranges of all medians
SPIKE_OVER_NOISE: Final = 8.0  # what it may be farther, in median distances: a column may hardly change
COMMANDS_APART: Final = 3.0  # how far a command may be from 0, in the largest median: a real one may last one sample
LEAST_DROP: Final = 0.05  # share of a battery's voltage below which a change is no jump: it is logged to 0.1 V
MOST_CUT: Final = 0.01  # share of a sensor's samples that may be cut
# An attitude jumps that is turned by more than the first from both neighbours, which are nearer than the second [rad].
JUMP_ANGLE: Final = 1.0
NEIGHBOURS_ANGLE: Final = 0.5
NORM_TOLERANCE: Final = 0.02  # by which the norm of a quaternion may differ from 1
CARRYING: Final = 0.5  # share of the others' usual speed above which they carry a vehicle
LONGEST_HELD: Final = 1.0  # [s] for which a radio holds a row, and a counter a speed
IDLE: Final = 0.1  # share of a rotor's largest command below which it may stop
SLOWS_DOWN: Final = 0.1  # [s] for which such a command must last
MOST_STOPPED: Final = 0.05  # share of the flight in which a counter may have stopped
ROUNDING: Final = 1e-9  # [rad, rad/s, m/s]: below it, nothing has changed
SLOWEST_FRESH: Final = 20.0  # [Hz] at which rows must be new
HELD_TOO: Final = 0.9  # share of the held rows in which a column repeats, from which on it counts as held too


class _Sensor(NamedTuple):
    columns: tuple[str, ...]
    unit: str


def _sensor(pattern: str, numbers: str, unit: str) -> _Sensor:
    """A sensor whose columns a pattern names, with {} for each of some words."""
    return _Sensor(tuple(pattern.format(number) for number in numbers.split()), unit)


_SENSORS: Final = {
    "position": _sensor("position {}", "x y z", "m"),
    "velocity": _sensor("velocity v{}", "x y z", "m/s"),
    "rates": _sensor("body rate w{}", "x y z", "rad/s"),
    "specific_force": _sensor("specific force a{}", "x y z", "m/s^2"),
    "commands": _sensor("the command of rotor {}", "1 2 3 4", "rad/s"),
    "speeds": _sensor("the measured speed of rotor {}", "1 2 3 4", "rad/s"),
    "voltage": _Sensor(("the voltage",), "V"),
    "attitude": _Sensor(("the attitude",), "-"),
}


def runs(mask: NDArray[np.bool_], shortest: int = 1) -> list[slice]:
    """Runs of true samples with at least the shortest length."""
    return [run for (run,) in find_objects(label(mask)[0]) if run.stop - run.start >= shortest]


def still_steps(rates: Array, attitude: Array) -> NDArray[np.bool_]:
    """Steps (N - 1,) from row to row in which neither rates (N, 3) nor attitude (N, 4) change."""
    turning = np.concatenate([rates, attitude], axis=1)
    return np.asarray((np.abs(np.diff(turning, axis=0)) <= ROUNDING).all(axis=1))


def without_spikes(name: str, series: Mapping[str, Column]) -> tuple[dict[str, Column], tuple[str, ...]]:
    """Return the series of a log, NaN where a sensor jumps away and back, and a note of each such sensor.

    Raises:
        InputError: a sensor does so in more than `MOST_CUT` of its samples.
    """
    result = dict(series)
    notes = []
    for field, samples in series.items():
        if field not in _SENSORS:
            continue
        spikes = _spikes(field, samples)
        if not spikes.any():
            continue
        for column in np.flatnonzero(spikes.any(axis=0)).tolist():
            notes.append(_spike_note(name, field, samples, column, spikes[:, column]))
        values = samples.values.copy()
        values[spikes.any(axis=1)] = np.nan
        result[field] = samples._replace(values=values)
    return result, tuple(notes)


def _spike_note(name: str, field: str, samples: Column, column: int, spikes: NDArray[np.bool_]) -> str:
    """Name the first of a column's spikes (M,) and their number, or refuse the sensor where they are too many."""
    row = int(np.argmax(spikes))
    count = np.count_nonzero(spikes)
    if field == "attitude":
        logged = samples.values[row]
    else:
        logged = samples.values[row, column : column + 1]
    value = ", ".join(f"{number:.4g}" for number in logged)
    sensor = _SENSORS[field]
    what = f"{name}: {sensor.columns[column]} is {value} {sensor.unit} at t = {samples.t[row]:.6g} s"
    if count > 1:
        what += f" and in {count - 1} more samples"
    if count > MOST_CUT * len(spikes):
        raise InputError(
            f"{what}, far from the samples beside; at most {MOST_CUT:.0%} of a sensor's samples may jump:"
            " correct or leave out that sensor"
        )
    return f"{what}, far from the samples beside: left out"


def _spikes(field: str, samples: Column) -> NDArray[np.bool_]:
    """Samples (M, n) that jump away and back; of an attitude (M, 1)."""
    if field == "attitude":
        return _attitude_spikes(samples.values)[:, None]
    if field == "voltage":
        return _column_spikes(samples, least=LEAST_DROP)
    return _column_spikes(samples, command=field == "commands")


def _column_spikes(samples: Column, *, command: bool = False, least: float = 0.0) -> NDArray[np.bool_]:
    """Samples (M, n) that are far from the median about them: by more than a share `least` of the largest median."""
    t, values = samples
    spikes = np.zeros(values.shape, bool)
    there = np.isfinite(values).all(axis=1)
    if np.count_nonzero(there) < 4 * LONGEST_SPIKE:
        return spikes
    rows = values[there]
    steps = np.diff(t)
    steps = steps[steps > 0.0]  # a battery's clock may be coarse
    if not steps.size:
        return spikes
    longest = round(SPIKE_TIME / float(np.median(steps)))
    size = 2 * min(max(longest, 1), LONGEST_SPIKE) + 1
    middle = median_filter(rows, size=(size, 1), mode="nearest")
    if command:
        spikes[there] = np.abs(rows) > COMMANDS_APART * np.abs(middle).max()
        return spikes
    distance = np.abs(rows - middle)
    farthest = SPIKE_OVER_RANGE * np.ptp(middle, axis=0) + SPIKE_OVER_NOISE * np.median(distance, axis=0)
    farthest = np.maximum(farthest, least * np.abs(middle).max(axis=0))
    spikes[there] = distance > farthest + ROUNDING
    return spikes


def _attitude_spikes(quaternion: Array) -> NDArray[np.bool_]:
    """Rows (M,) of another length than 1 while most have it, and those turned away from both neighbours."""
    norms = np.linalg.norm(quaternion, axis=1)
    finite = np.isfinite(norms)
    spikes = finite & (np.abs(norms - 1.0) > NORM_TOLERANCE)
    if np.count_nonzero(spikes) > MOST_CUT * len(spikes):
        spikes = np.zeros(len(spikes), bool)  # it was scaled, centred or misnamed
    rows = np.flatnonzero(finite & ~spikes)
    if len(rows) < 4 * LONGEST_SPIKE:
        return spikes
    unit = quaternion[rows] / norms[rows, None]

    def turn(step: int) -> Array:
        along = np.abs((unit[step:] * unit[:-step]).sum(axis=1))
        return np.asarray(2.0 * np.arccos(np.minimum(along, 1.0)))

    to_next = turn(1)
    to_next_but_one = turn(2)
    far_from_both = (to_next[:-1] > JUMP_ANGLE) & (to_next[1:] > JUMP_ANGLE)
    jumps = far_from_both & (to_next_but_one < NEIGHBOURS_ANGLE)
    spikes[rows[1:-1][jumps]] = True
    return spikes


def without_held_rows(name: str, series: Mapping[str, Column]) -> tuple[dict[str, Column], tuple[str, ...]]:
    """Return the series of a log without rows that a radio held: rates and attitude as in the row before.

    A series `fresh` has two columns of 1 and 0: whether a row is new, and whether it has new values of the rotors.
    Held rows are NaN, but for commands that were held too, which are interpolated.

    Raises:
        InputError: fewer than `SLOWEST_FRESH` rows per second are new.
    """
    repeated = _repeated_rows(series)
    if not repeated.any():
        return dict(series), ()
    t = series["rates"].t
    where = f"the first at t = {t[np.argmax(repeated)]:.6g} s"
    what = f"{name}: {repeated.mean():.0%} of its rows repeat rates and attitude of the one before, {where}"
    rate = _fresh_rate(series, repeated)
    if rate < SLOWEST_FRESH:
        raise InputError(
            f"{what}, as a radio does that holds them; {rate:.3g} rows per second are new, {SLOWEST_FRESH:g} are "
            "needed: log faster, or on board"
        )
    result = dict(series)
    known_rotors = np.ones(len(t), bool)
    for field, samples in series.items():
        if samples.t is not t or field == "voltage":
            continue
        unchanged = np.abs(np.diff(samples.values, axis=0)).max(axis=1, initial=0.0) <= ROUNDING
        if unchanged[repeated[1:]].mean() < HELD_TOO:
            continue
        if field in ("commands", "throttle", "speeds"):
            known_rotors = ~repeated
        if field in ("commands", "throttle"):
            values = interpolated(t, t[~repeated], samples.values[~repeated])
        else:
            values = samples.values.copy()
            values[repeated] = np.nan
        result[field] = samples._replace(values=values)
    result["fresh"] = Column(t=t, values=np.stack([~repeated, known_rotors], axis=1).astype(float))
    return result, (f"{what}: left out",)


def _repeated_rows(series: Mapping[str, Column]) -> NDArray[np.bool_]:
    """Rows (N,) whose rates and attitude, on one clock, a radio held; none where the vehicle rests."""
    rates = series.get("rates")
    attitude = series.get("attitude")
    if rates is None or attitude is None or rates.t is not attitude.t:
        return np.zeros(0, bool)
    still = still_steps(rates.values, attitude.values)
    if not still.any():
        return np.zeros(0, bool)
    longest = round(LONGEST_HELD / float(np.median(np.diff(rates.t))))
    return np.append(False, still & ~at_rest(still, longest))


def _fresh_rate(series: Mapping[str, Column], repeated: NDArray[np.bool_]) -> float:
    """New rows per second while the vehicle moves [Hz]."""
    rates = series["rates"]
    still = still_steps(rates.values, series["attitude"].values)
    resting = np.count_nonzero(still & ~repeated[1:])
    moving = int(len(repeated) - resting)
    period = float(np.median(np.diff(rates.t)))
    return (moving - int(repeated.sum())) / (moving * period)


def at_rest(still: NDArray[np.bool_], longest: int) -> NDArray[np.bool_]:
    """Steps (N - 1,) at which a vehicle rests, of those at which nothing turns.

    A radio that holds rows repeats each a few times, with single steps that turn in between.  A vehicle rests in a run
    of still steps that includes the log's first or last one, or is longer than `longest` with two turning steps on
    both sides.
    """
    rest = np.zeros_like(still)
    for run in runs(still):
        if run.start >= 2:
            before = still[run.start - 2 : run.start]
        else:
            before = still[:0]
        after = still[run.stop : run.stop + 2]
        at_an_end = run.start == 0 or run.stop == len(still)
        lasts = run.stop - run.start > longest and not before.any() and not after.any()
        rest[run] = at_an_end or lasts
    return rest


def without_stopped_counters(name: str, series: Mapping[str, Column]) -> tuple[dict[str, Column], tuple[str, ...]]:
    """Return the series of a log, NaN where the counter of a rotor stops while the others turn, and a note of each.

    Raises:
        InputError: one stops in more than `MOST_STOPPED` of the time in which the others turn.
    """
    result = dict(series)
    if "speeds" not in series:
        return result, ()
    t, speeds = series["speeds"]
    there = np.asarray(np.isfinite(speeds).all(axis=1))
    if np.count_nonzero(there) < 2:
        return result, ()
    values = speeds.copy()
    notes = []
    for rotor in range(speeds.shape[1]):
        turning = there & _has_to_turn(series, rotor, there)
        stopped = turning & ((speeds[:, rotor] == 0.0) | _stuck(series["speeds"], rotor))
        if not stopped.any():
            continue
        values[stopped] = np.nan
        row = int(np.argmax(stopped))
        others = float(np.median(np.delete(speeds[row], rotor)))
        share = np.count_nonzero(stopped) / np.count_nonzero(turning)
        what = (
            f"{name}: the measured speed of rotor {rotor + 1} stays at {speeds[row, rotor]:.4g} rad/s from "
            f"t = {t[row]:.6g} s on while the others turn at {others:.4g}, in {share:.1%} of the time that they turn"
        )
        if share > MOST_STOPPED:
            advice = "correct it"
            if "commands" in series or "throttle" in series:
                advice = "correct it, or name the commands alone"
            raise InputError(f"{what}: its counter is dead, at most {MOST_STOPPED:.0%} is allowed: {advice}")
        notes.append(f"{what}: left out")
    result["speeds"] = Column(t=t, values=values)
    return result, tuple(notes)


def _has_to_turn(series: Mapping[str, Column], rotor: int, there: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Samples (M,) in which the other rotors carry a vehicle, and a rotor's command, where logged, is no idle one."""
    t, speeds = series["speeds"]
    others = np.median(np.delete(speeds, rotor, axis=1), axis=1)
    turning = np.nan_to_num(others) > CARRYING * np.quantile(others[there], 0.9)
    commands = series.get("commands", series.get("throttle"))
    if commands is not None:
        command = np.nan_to_num(latest_samples(commands, t)[:, rotor])
        lately = 2 * round(SLOWS_DOWN / float(np.median(np.diff(t)))) + 1
        turning &= maximum_filter1d(command, lately) > IDLE * command.max()
    return np.asarray(turning)


def _stuck(samples: Column, rotor: int) -> NDArray[np.bool_]:
    """Samples (M,) in which a rotor keeps its speed for long while the others change theirs."""
    t, speeds = samples
    longest = round(LONGEST_HELD / float(np.median(np.diff(t))))
    unchanged = np.abs(np.diff(speeds, axis=0)) <= ROUNDING
    stuck = np.zeros(len(speeds), bool)
    for run in runs(unchanged[:, rotor], max(longest, 1)):
        changing = ~np.delete(unchanged[run], rotor, axis=1)
        if changing.mean() > 0.5:
            stuck[run.start : run.stop + 1] = True
    return stuck
