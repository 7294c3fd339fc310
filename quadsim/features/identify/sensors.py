"""Sensors are distrusted first: samples that jump away and back, counters that stop, rows that a radio held.

Such samples are cut before anything is sampled anew, averaged or fitted, and a note names sensor, time and value; a
sensor that fails too often makes the log one that cannot be used.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import find_objects, label, maximum_filter1d, median_filter

from quadsim.errors import InputError
from quadsim.features.identify.series import Column, held
from quadsim.state import Array

LONGEST_SPIKE: Final = 3  # samples, of which a log with a sample in `SPIKE_TIME` or more has one
SPIKE_TIME: Final = 0.03  # [s]: what lasts longer may be flown
FARTHEST: Final = 1.5  # how far a sample may be from the median about it, in ranges of all medians
LOUDEST: Final = 8.0  # the same in median distances, where a column hardly changes
COMMANDS_APART: Final = 3.0  # how far a command may be from 0, in the largest median: a real one may last one sample
LEAST_DROP: Final = 0.05  # share of a battery's voltage below which a change is no jump: it is logged to 0.1 V
MOST_CUT: Final = 0.01  # share of a sensor's samples that may be cut
TURN_AWAY = 1.0
TURNED_BACK = 0.5
"""Angles [rad]: an attitude that is farther than the first from both neighbours, which are nearer than the second."""
LENGTH: Final = 0.02  # by which the length of a quaternion may differ from 1
CARRYING: Final = 0.5  # share of the others' usual speed above which they carry a vehicle
LONGEST_HELD: Final = 1.0  # [s] for which a radio holds a row, and a counter a speed
IDLE: Final = 0.1  # share of a rotor's largest command below which it may stop
SLOWS_DOWN: Final = 0.1  # [s] for which such a command must last
MOST_STOPPED: Final = 0.05  # share of the flight in which a counter may have stopped
ROUNDING: Final = 1e-9  # [rad, rad/s, m/s]: below it, nothing has changed
SLOWEST_FRESH: Final = 20.0  # [Hz] at which rows must be new
HELD_TOO: Final = 0.9  # share of the held rows in which a column repeats that is held with them


class _Sensor(NamedTuple):
    columns: tuple[str, ...]
    unit: str


_ROTORS: Final = tuple(f"of rotor {i}" for i in (1, 2, 3, 4))
_AXES: Final = ("x", "y", "z")
_SENSORS: Final = {
    "position": _Sensor(tuple(f"position {axis}" for axis in _AXES), "m"),
    "velocity": _Sensor(tuple(f"velocity v{axis}" for axis in _AXES), "m/s"),
    "rates": _Sensor(tuple(f"body rate w{axis}" for axis in _AXES), "rad/s"),
    "specific_force": _Sensor(tuple(f"specific force a{axis}" for axis in _AXES), "m/s^2"),
    "commands": _Sensor(tuple(f"the command {rotor}" for rotor in _ROTORS), "rad/s"),
    "speeds": _Sensor(tuple(f"the measured speed {rotor}" for rotor in _ROTORS), "rad/s"),
    "voltage": _Sensor(("the voltage",), "V"),
    "attitude": _Sensor(("the attitude",), "-"),
}


def runs(mask: NDArray[np.bool_], shortest: int = 1) -> list[slice]:
    """Runs of true samples with at least the shortest length."""
    return [run for (run,) in find_objects(label(mask)[0]) if run.stop - run.start >= shortest]


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
        columns, unit = _SENSORS[field]
        if field == "attitude":
            off = _attitude_spikes(samples.values)[:, None]
        else:
            least = LEAST_DROP if field == "voltage" else 0.0
            off = _spikes(samples, command=field == "commands", least=least)
        if not off.any():
            continue
        for i in np.flatnonzero(off.any(axis=0)):
            row = int(np.argmax(off[:, i]))
            count = np.count_nonzero(off[:, i])
            if field == "attitude":
                logged = samples.values[row]
            else:
                logged = samples.values[row, i : i + 1]
            value = ", ".join(f"{number:.4g}" for number in logged)
            what = f"{name}: {columns[i]} is {value} {unit} at t = {samples.t[row]:.6g} s"
            if count > 1:
                more = f" and in {count - 1} more samples"
            else:
                more = ""
            if count > MOST_CUT * len(off):
                raise InputError(
                    f"{what}{more}, far from the samples beside; at most {MOST_CUT:.0%} of a sensor's samples may jump:"
                    " mend or leave out that sensor"
                )
            notes.append(f"{what}{more}, far from the samples beside: left out")
        values = samples.values.copy()
        values[off.any(axis=1)] = np.nan
        result[field] = samples._replace(values=values)
    return result, tuple(notes)


def _spikes(samples: Column, *, command: bool, least: float) -> NDArray[np.bool_]:
    """Samples (M, n) that are far from the median about them: by more than a share `least` of the largest median."""
    t, values = samples
    off = np.zeros(values.shape, bool)
    there = np.isfinite(values).all(axis=1)
    if np.count_nonzero(there) < 4 * LONGEST_SPIKE:
        return off
    rows = values[there]
    steps = np.diff(t)
    steps = steps[steps > 0.0]  # a battery's clock may be coarse
    if not steps.size:
        return off
    longest = round(SPIKE_TIME / float(np.median(steps)))
    size = 2 * min(max(longest, 1), LONGEST_SPIKE) + 1
    middle = median_filter(rows, size=(size, 1), mode="nearest")
    distance = np.abs(rows - middle)
    if command:
        off[there] = np.abs(rows) > COMMANDS_APART * np.abs(middle).max()
    else:
        farthest = FARTHEST * np.ptp(middle, axis=0) + LOUDEST * np.median(distance, axis=0)
        farthest = np.maximum(farthest, least * np.abs(middle).max(axis=0))
        off[there] = distance > farthest + ROUNDING
    return off


def _attitude_spikes(quaternion: Array) -> NDArray[np.bool_]:
    """Rows (M,) of another length than 1 while most have it, and those turned away from both neighbours."""
    norms = np.linalg.norm(quaternion, axis=1)
    finite = np.isfinite(norms)
    spikes = finite & (np.abs(norms - 1.0) > LENGTH)
    if np.count_nonzero(spikes) > MOST_CUT * len(spikes):
        spikes = np.zeros(len(spikes), bool)  # it was scaled, centred or misnamed
    rows = np.flatnonzero(finite & ~spikes)
    if len(rows) < 4 * LONGEST_SPIKE:
        return spikes
    unit = quaternion[rows] / norms[rows, None]

    def turn(step: int) -> Array:
        along = np.abs((unit[step:] * unit[:-step]).sum(axis=1))
        return np.asarray(2.0 * np.arccos(np.minimum(along, 1.0)))

    once = turn(1)
    twice = turn(2)
    away = (once[:-1] > TURN_AWAY) & (once[1:] > TURN_AWAY) & (twice < TURNED_BACK)
    spikes[rows[1:-1][away]] = True
    return spikes


def without_held_rows(name: str, series: Mapping[str, Column]) -> tuple[dict[str, Column], tuple[str, ...]]:
    """Return the series of a log without rows that a radio held: rates and attitude as in the row before.

    A series `fresh` says which rows are new, and of which something of the rotors is known; the others are NaN, of
    commands that were held with them linear.

    Raises:
        InputError: fewer than `SLOWEST_FRESH` rows per second are new.
    """
    if not {"rates", "attitude"} <= {*series} or series["rates"].t is not series["attitude"].t:
        return dict(series), ()
    t = series["rates"].t
    turning = np.concatenate([series["rates"].values, series["attitude"].values], axis=1)
    still = np.asarray((np.abs(np.diff(turning, axis=0)) <= ROUNDING).all(axis=1))
    if not still.any():
        return dict(series), ()
    period = float(np.median(np.diff(t)))
    repeated = np.append(False, still & ~at_rest(still, round(LONGEST_HELD / period)))
    if not repeated.any():
        return dict(series), ()
    moving = int(len(repeated) - np.count_nonzero(still & ~repeated[1:]))
    rate = (moving - int(repeated.sum())) / (moving * period)
    where = f"the first at t = {t[np.argmax(repeated)]:.6g} s"
    what = f"{name}: {repeated.mean():.0%} of its rows repeat rates and attitude of the one before, {where}"
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
        repeats = np.abs(np.diff(samples.values, axis=0)).max(axis=1, initial=0.0) <= ROUNDING
        if repeats[repeated[1:]].mean() < HELD_TOO:
            continue
        values = samples.values.copy()
        if field in ("commands", "throttle", "speeds"):
            known_rotors = ~repeated
        if field in ("commands", "throttle"):
            known = [np.interp(t, t[~repeated], column[~repeated]) for column in values.T]
            values = np.stack(known, axis=1)
        else:
            values[repeated] = np.nan
        result[field] = samples._replace(values=values)
    result["fresh"] = Column(t=t, values=np.stack([~repeated, known_rotors], axis=1).astype(float))
    return result, (f"{what}: left out",)


def at_rest(still: NDArray[np.bool_], longest: int) -> NDArray[np.bool_]:
    """Steps (N - 1,) at which a vehicle rests, of those at which nothing turns.

    A row that is held is followed by one that has moved, and a row that is held again: it is between steps that turn.
    Rest lasts from the log's first step on, or to its last, or longer than `longest` steps until more than one turns.
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
    there = np.isfinite(speeds).all(axis=1)
    if np.count_nonzero(there) < 2:
        return result, ()
    period = float(np.median(np.diff(t)))
    longest = round(LONGEST_HELD / period)
    sent = series.get("commands", series.get("throttle"))
    values = speeds.copy()
    notes = []
    for i in range(speeds.shape[1]):
        others = np.median(np.delete(speeds, i, axis=1), axis=1)
        turning = there & (np.nan_to_num(others) > CARRYING * np.quantile(others[there], 0.9))
        if sent is not None:
            wanted = np.nan_to_num(held(sent, t)[:, i])
            lately = maximum_filter1d(wanted, 2 * round(SLOWS_DOWN / period) + 1)
            turning &= lately > IDLE * wanted.max()
        stopped = turning & ((speeds[:, i] == 0.0) | _kept(speeds, i, longest))
        if not stopped.any():
            continue
        row = int(np.argmax(stopped))
        share = np.count_nonzero(stopped) / np.count_nonzero(turning)
        what = (
            f"{name}: the measured speed of rotor {i + 1} stays at {speeds[row, i]:.4g} rad/s from t = {t[row]:.6g} s "
            f"on while the others turn at {others[row]:.4g}, in {share:.1%} of the time that they turn"
        )
        if share > MOST_STOPPED:
            if {"commands", "throttle"} & {*series}:
                way = ", or name the commands alone"
            else:
                way = ""
            raise InputError(f"{what}: its counter is dead, at most {MOST_STOPPED:.0%} is allowed: mend it{way}")
        values[stopped] = np.nan
        notes.append(f"{what}: left out")
    result["speeds"] = Column(t=t, values=values)
    return result, tuple(notes)


def _kept(speeds: Array, rotor: int, longest: int) -> NDArray[np.bool_]:
    """Samples (M,) in which a rotor keeps its speed for long while the others change theirs."""
    steps = np.abs(np.diff(speeds, axis=0)) <= ROUNDING
    kept = np.zeros(len(speeds), bool)
    for run in runs(steps[:, rotor], max(longest, 1)):
        changing = ~np.delete(steps[run], rotor, axis=1)
        if changing.mean() > 0.5:
            kept[run.start : run.stop + 1] = True
    return kept
