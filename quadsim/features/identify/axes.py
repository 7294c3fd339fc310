"""Axes and signs of a log: rates against the turning attitude, velocity against position, tilt and thrust.

A column is called wrong only where another reading explains the motion far better; a log with little motion passes.
"""

from __future__ import annotations

import cmath
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import permutations
from typing import Final

import numpy as np

from quadsim.errors import InputError
from quadsim.features.identify.correlation import Pairs, aligned, correlations, moments, pairs_of, shifts, stride
from quadsim.features.identify.record import Record, driver
from quadsim.features.identify.windows import body_z, mean, rate_over_window, to_world, turn_rate
from quadsim.rotation import conjugate
from quadsim.state import Array
from quadsim.vehicle import Vehicle

WINDOW: Final = 0.1  # [s] over which rates and thrust are compared
SLOW_WINDOW: Final = 0.2  # [s] for lateral accelerations
LEAST_RISE: Final = 0.7
"""By which the correlations of three axes must rise: one of -0.6 negated gains 1.2, and costs 0.5."""
READINGS: Final[dict[str, Callable[[Array], Array]]] = {
    "": lambda q: q,
    "the quaternion is world to body: negate qx, qy, qz": conjugate,
    "the quaternion's columns are in the order x, y, z, w": lambda q: np.roll(q, 1, axis=1),
    "the quaternion is world to body, its columns in the order x, y, z, w": lambda q: conjugate(np.roll(q, 1, axis=1)),
}
"""How the columns of the attitude may be meant."""
Lateral = Sequence[tuple[Array, Array, Array]]
"""Acceleration, thrust axis and velocity in each part, level: x + i y, one row per tick."""


def check_rate_axes(record: Record, parts: Sequence[slice], vehicle: Vehicle) -> None:
    """Refuse rates and an attitude that do not turn alike.

    Raises:
        InputError: naming the columns that are negated, swapped, or in another frame.
    """
    readings = {reading: turning_pairs(record, parts, meant) for reading, meant in READINGS.items()}
    if better := _better(readings, ("wx", "wy", "wz"), record.period):
        raise InputError(f"{record.name}: the rates are not those at which the attitude turns: {better}")


def turning_pairs(record: Record, parts: Sequence[slice], meant: Callable[[Array], Array] = READINGS[""]) -> Pairs:
    """Rates at which the attitude turns, and those of the gyro."""
    return pairs_of(
        record,
        parts,
        lambda part: turn_rate(meant(record.attitude[part]), record.period, WINDOW),
        lambda part: mean(record.rates[part], record.period, WINDOW),
    )


def lateral_motion(record: Record, parts: Sequence[slice]) -> Lateral:
    """What `tilt_fit` fits."""
    step = stride(record.period)
    motion = []
    for part in parts:
        velocity = record.velocity[part]
        axis = body_z(record.attitude[part])
        rows = [rate_over_window(velocity, record.period, SLOW_WINDOW)]
        rows += [mean(values, record.period, SLOW_WINDOW) for values in (axis, velocity)]
        acceleration, axis, velocity = (x[::step, 0] + 1j * x[::step, 1] for x in rows)
        motion.append((acceleration, axis, velocity))
    return motion


def tilt_fit(motion: Lateral, *, mirrored: bool = False, shift: int = 0) -> tuple[float, complex]:
    """Fit dv/dt = c b + d v + e, b the thrust axis `shift` ticks earlier, c complex, d real, e per part.

    Returns:
        The share of dv/dt that it explains, and c [m/s^2]: its angle is that from tilt to acceleration.
    """
    rows = []
    sides = []
    for acceleration, axis, velocity in motion:
        b, a = aligned(axis.conj() if mirrored else axis, acceleration, shift)
        _, v = aligned(axis, velocity, shift)
        *known, side = (np.concatenate([x.real, x.imag]) for x in (x - x.mean() for x in (b, 1j * b, v, a)))
        rows.append(np.stack(known, axis=1))
        sides.append(side)
    matrix = np.concatenate(rows)
    side = np.concatenate(sides)
    solution = np.linalg.lstsq(matrix, side, rcond=None)[0]
    total = float(np.square(side).sum())
    if total:
        explained = 1.0 - float(np.square(side - matrix @ solution).sum()) / total
    else:
        explained = 0.0
    return explained, complex(solution[0], solution[1])


def check_velocity_axes(record: Record, parts: Sequence[slice], vehicle: Vehicle) -> None:
    """Refuse a velocity that is not the slope of the position.

    Raises:
        InputError: naming the columns that are negated, swapped, or along the body's axes.
    """
    position = np.asarray(record.position)

    def beside_slope(velocity: Array) -> Pairs:
        return pairs_of(
            record,
            parts,
            lambda part: rate_over_window(position[part], record.period, WINDOW),
            lambda part: mean(velocity[part], record.period, WINDOW),
        )

    logged = beside_slope(record.velocity)
    if better := _better({"": logged}, ("vx", "vy", "vz"), record.period):
        raise InputError(f"{record.name}: the velocity is not the slope of the position: {better}")
    off, off_if_turned = (_difference(p) for p in (logged, beside_slope(to_world(record.attitude, record.velocity))))
    if off > 0.1 and off > 2.0 * off_if_turned:
        raise InputError(
            f"{record.name}: vx, vy, vz are along the body's axes: turned into the world, they differ from the slope "
            f"of the position by {100.0 * off_if_turned:.0f} % instead of {100.0 * off:.0f} %; give them in the world"
        )


def _difference(pairs: Pairs) -> float:
    """RMS difference of two vectors over the first's RMS."""
    difference, total = (np.concatenate(rows) for rows in zip(*((a - b, a) for a, b in pairs), strict=True))
    return float(np.linalg.norm(difference) / max(float(np.linalg.norm(total)), 1e-30))


def check_tilt(record: Record, parts: Sequence[slice], vehicle: Vehicle) -> None:
    """Refuse a velocity that does not change as tilt and thrust make it.

    Raises:
        InputError: naming the frame or the columns that are negated or swapped.
    """
    falls = max(_lifting(record, parts, vehicle.gravity, lag) for lag in (0.0, 0.05, 0.1)) < -0.4
    motion = lateral_motion(record, parts)
    plain, direction = tilt_fit(motion)
    mirror, mirror_direction = tilt_fit(motion, mirrored=True)
    heading = math.degrees(cmath.phase(direction))
    what = ""
    if mirror > 0.3 and mirror > plain + 0.2:
        turned = round(math.degrees(cmath.phase(mirror_direction)) / 90.0) % 4
        what = ("vy is negated", "vx and vy are swapped", "vx is negated", "vx and vy are swapped and negated")[turned]
        what = f"against the tilt, {what}{'; vz too: a world with z down' if falls else ''}"
    elif plain > 0.3 and abs(heading) > 135.0 and falls:
        what = "world and body have z down (NED, FRD): negate qy, qz, wy, wz, vy, vz, y, z"
    elif plain > 0.3 and abs(heading) > 30.0:
        what = f"against the tilt, the velocity's heading is {heading:.0f} deg off: one of them is in another frame"
        what += ", or z points down (NED, FRD)" if abs(heading) > 135.0 else ""
    elif falls:
        what = "more thrust makes it fall: vz is negated, or z points down"
    if what:
        raise InputError(f"{record.name}: {what}; give world z up, body x forward, y left, z up")


def _lifting(record: Record, parts: Sequence[slice], gravity: float, lag: float) -> float:
    """How like the upward acceleration is to that of the upward thrust `lag` [s] earlier: 1 the same, -1 opposite."""

    def lift(part: slice) -> Array:
        upward = np.square(driver(record)[part]).sum(axis=1, keepdims=True) * body_z(record.attitude[part])[:, 2:]
        return mean(gravity * upward / upward.mean(), record.period, SLOW_WINDOW)

    pairs = pairs_of(
        record, parts, lift, lambda part: rate_over_window(record.velocity[part, 2:], record.period, SLOW_WINDOW)
    )
    covariance, lifts, climbs = moments(pairs, round(lag / (stride(record.period) * record.period)))
    return 2.0 * float(covariance[0, 0]) / max(float(lifts[0] + climbs[0]), 1e-30)


def _better(readings: Mapping[str, Pairs], names: Sequence[str], period: float) -> str:
    """What is to change in the second vectors so that they follow the first far better; empty if nothing.

    `readings` has the pairs of each reading of the first. A reading, a change and a shift count against an explanation.
    """
    best = -9.0
    better = ("", 0.0)
    for shift in shifts(period):
        usual = float(np.trace(correlations(readings[""], shift)))
        cost = abs(shift) * stride(period) * period / 0.3
        for reading, pairs in readings.items():
            for change, score in _changes(correlations(pairs, shift), names):
                total = score - 0.7 * bool(reading) - cost
                if total > best:
                    best = total
                    better = ("; ".join(filter(None, (reading, change))), score - usual)
    if better[1] > LEAST_RISE:
        return better[0]
    return ""


def _changes(correlation: Array, names: Sequence[str]) -> Iterator[tuple[str, float]]:
    """Each change of three columns, empty for none, with the sum of correlations that it gives, less its own cost."""
    for order in permutations(range(3)):
        along = correlation[list(order), range(3)]
        negated = [name for name, value in zip(names, along, strict=True) if value < -0.25]
        moved = [name for i, name in enumerate(names) if order[i] != i]
        if moved:
            changes = [f"{' and '.join(moved)} are swapped"]
        else:
            changes = []
        changes += [f"{' and '.join(negated)} {'is' if len(negated) == 1 else 'are'} negated"] if negated else []
        score = sum(-value if value < -0.25 else value for value in along.tolist())
        yield "; ".join(changes), score - 0.5 * len(negated) - 0.3 * len(moved)
    yield "", float(np.trace(correlation))
