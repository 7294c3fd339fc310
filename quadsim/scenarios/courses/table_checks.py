"""What the columns of a course's table say of one another: contradictions, wrong units, impossible motions.

A number that may be meant is doubted, by a note to the user; one that cannot be meant is refused. Velocities are
compared with the positions covered between rows, accelerations with the velocities gained, and the mean speed and
yaw rate with what a vehicle can fly. `quadsim.scenarios.courses.csv_course` reads the table.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from pathlib import Path as FilePath
from typing import Final

import numpy as np

from quadsim.errors import FileError
from quadsim.state import Array
from quadsim.ties import TIE_SHARE, first_smallest

DOUBTED_DISTANCE: Final = 50.0  # of the first row from the vehicle [m], that at which a flight is lost by default
DOUBTED_SPEED: Final = 50.0  # mean speed [m/s], that at which a flight is lost by default
REFUSED_SPEED: Final = 340.0  # mean speed [m/s], that of sound
DOUBTED_TURNS: Final = 5.0  # of yaw in all
DOUBTED_YAW_RATE: Final = 180.0  # mean rate [deg/s]
REFUSED_YAW_RATE: Final = 2000.0  # mean rate [deg/s], the full scale of the usual gyroscopes
DOUBTED_SHARE: Final = 0.25
"""Mean difference between a stated and a computed derivative, over the larger of both, above which it is doubted."""
NEVER_DOUBTED: Final = 0.05  # such a difference that is never doubted [m/s, m/s^2]
UNIT_TOLERANCE: Final = 0.04  # relative difference up to which a ratio is that of a unit
REFUSED_OVERSTATEMENT: Final = 5.0  # stated over covered velocity, plus 1 m/s, above which a table is refused
MILLIMETRES: Final = 1000.0  # per m
SPEED_UNITS: Final = {"mm/s": 1000.0, "cm/s": 100.0, "km/h": 3.6, "ft/s": 3.281, "knots": 1.944}  # per m/s


def distance_notes(first: Array, vehicle: Array) -> Iterator[str]:
    """Yield a note on a first row (3,) [m] far from the vehicle (3,) [m]."""
    distance = math.dist(first, vehicle)
    if distance > DOUBTED_DISTANCE:
        distance_if_millimetres = math.dist(first / MILLIMETRES, vehicle)
        yield (
            f"columns x, y, z begin {distance:.4g} m from the vehicle; if they are in mm instead of m, "
            f"{distance_if_millimetres:.4g} m"
        )


def speed_notes(path: FilePath, t: Array, positions: Array) -> Iterator[str]:
    """Yield a note on positions (n, 3) [m] that move too fast on average; refuse what cannot be meant."""
    moves = np.diff(positions, axis=0)
    speed = float(np.linalg.norm(moves, axis=1).sum() / (t[-1] - t[0]))
    lengths = np.abs(moves).sum(axis=0)
    fastest_column = "xyz"[first_smallest(-lengths, TIE_SHARE * float(lengths.max()))]
    if speed > REFUSED_SPEED:
        limit = f"must not make the course faster than {REFUSED_SPEED:g} m/s on average"
        rule = f"column {fastest_column}: {limit}; got {speed:.4g}"
        raise FileError(path, f"{rule} (if it is in mm instead of m, {speed / MILLIMETRES:.4g} m/s)")
    if speed > DOUBTED_SPEED:
        yield (
            f"column {fastest_column}: the course moves at {speed:.4g} m/s on average; if it is in mm instead of m, "
            f"{speed / MILLIMETRES:.4g} m/s"
        )


def check_turns(path: FilePath, yaw: Array) -> None:
    """Refuse a column (n,) [rad] that counts turns, and so is not wrapped, with rows over half a turn apart."""
    if np.ptp(yaw) <= math.tau + 1e-3:
        return
    steps = np.diff(yaw)
    (too_large,) = np.nonzero(np.abs(steps) > math.pi)
    if too_large.size:
        i = int(too_large[0])
        rule = f"must be within half a turn, {math.pi:.4g} rad, of the row before = {yaw[i]:.6g}"
        why = f"the column spans {np.ptp(yaw) / math.tau:.3g} turns; is it in degrees instead of radians?"
        raise FileError(path, f"row {i + 3}, column yaw: {rule}; got {yaw[i + 1]:.6g} ({why})")


def yaw_notes(path: FilePath, t: Array, yaw: Array) -> Iterator[str]:
    """Yield a note on an unwrapped yaw (n,) [rad] that turns too fast or too far; refuse what cannot be meant."""
    rate = math.degrees(float(np.abs(np.diff(yaw)).sum() / (t[-1] - t[0])))
    turns_far = float(np.ptp(yaw)) > DOUBTED_TURNS * math.tau or abs(float(yaw[0])) > math.tau
    if rate > REFUSED_YAW_RATE:
        rule = f"column yaw: must not turn faster than {REFUSED_YAW_RATE:g} deg/s on average; got {rate:.4g}"
        raise FileError(path, f"{rule} (if it is in degrees instead of radians, {math.radians(rate):.4g} deg/s)")
    if rate > DOUBTED_YAW_RATE:
        yield (
            f"column yaw turns at {rate:.4g} deg/s on average; if it is in degrees instead of radians, "
            f"{math.radians(rate):.4g} deg/s"
        )
    elif turns_far:
        low = float(yaw.min())
        high = float(yaw.max())
        yield (
            f"column yaw goes from {math.degrees(low):.4g} to {math.degrees(high):.4g} deg; if it is in degrees "
            f"instead of radians, from {low:.4g} to {high:.4g} deg"
        )


def velocity_notes(
    path: FilePath, t: Array, poses: Array, velocities: Array, resolution: Sequence[float]
) -> Iterator[str]:
    """Yield notes on stated velocities (n, 3) [m/s] that contradict the positions; refuse what cannot be meant.

    Between rows, the mean of the two stated velocities is that of the covered distance up to the third derivative.
    """
    periods = np.diff(t)
    for name, position, velocity, unit in zip("xyz", poses.T, velocities.T, resolution, strict=False):
        covered = np.diff(position) / periods
        stated = 0.5 * (velocity[1:] + velocity[:-1])
        mean_covered = _mean_magnitude(covered, periods)
        mean_stated = _mean_magnitude(stated, periods)
        difference = _mean_magnitude(stated - covered, periods)
        rounding = 2.0 * unit * periods.size / float(periods.sum())
        if difference <= DOUBTED_SHARE * max(mean_covered, mean_stated) or difference <= NEVER_DOUBTED + rounding:
            continue
        hint = _velocity_hint(stated, covered, periods)
        if mean_stated > REFUSED_OVERSTATEMENT * (mean_covered + rounding) + 1.0:
            rule = f"must agree with column {name}, which moves at {mean_covered:.4g} m/s on average"
            raise FileError(path, f"column v{name}: {rule}; got {mean_stated:.4g} m/s{hint}")
        moves = f"column {name} moves at {mean_covered:.4g} m/s"
        yield f"column v{name} is {mean_stated:.4g} m/s on average, but {moves}{hint}"


def _velocity_hint(stated: Array, covered: Array, periods: Array) -> str:
    """Return what is probably wrong with stated velocities (n - 1,): their unit or their sign; empty if neither is."""
    mean_covered = _mean_magnitude(covered, periods)
    mean_stated = _mean_magnitude(stated, periods)
    if mean_covered > 0.0:
        ratio = mean_stated / mean_covered
        for unit, factor in SPEED_UNITS.items():
            if abs(ratio / factor - 1.0) < UNIT_TOLERANCE:
                return f"; is it in {unit}?"
    if _mean_magnitude(stated + covered, periods) < DOUBTED_SHARE * mean_stated:
        return "; is its sign wrong?"
    return ""


def acceleration_notes(t: Array, velocities: Array, accelerations: Array) -> Iterator[str]:
    """Yield a note on stated accelerations (n, 3) [m/s^2] that contradict the velocities."""
    periods = np.diff(t)
    for name, velocity, acceleration in zip("xyz", velocities.T, accelerations.T, strict=True):
        gained = np.diff(velocity) / periods
        stated = 0.5 * (acceleration[1:] + acceleration[:-1])
        mean_gained = _mean_magnitude(gained, periods)
        mean_stated = _mean_magnitude(stated, periods)
        difference = _mean_magnitude(stated - gained, periods)
        if difference <= DOUBTED_SHARE * max(mean_gained, mean_stated) + NEVER_DOUBTED:
            continue
        hint = ""
        if name == "z" and abs(float(np.mean(stated - gained)) - 9.8) < 0.5:
            hint = "; is gravity in it?"
        yield (
            f"column a{name} is {mean_stated:.4g} m/s^2 on average, but column v{name} changes by "
            f"{mean_gained:.4g} m/s^2{hint}"
        )


def _mean_magnitude(values: Array, periods: Array) -> float:
    """Return the mean magnitude of values (n - 1,) that hold for periods (n - 1,) [s]."""
    return float(periods @ np.abs(values) / periods.sum())
