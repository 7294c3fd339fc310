"""Axes and signs of a log: rates against the turning attitude, velocity against position, tilt and thrust.

Three columns b follow a where the sum of their correlations is large; every order and every choice of signs of b is
tried.  A column is called wrong only where another reading explains the motion far better, so that a log with little
motion passes.  One of the checks before any fit.
"""

from __future__ import annotations

import cmath
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import permutations
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from quadsim.errors import InputError
from quadsim.features.identify.correlation import Pairs, aligned, correlations, moments, pairs_of, shifts, stride
from quadsim.features.identify.record import Record, rotor_inputs
from quadsim.features.identify.windows import body_z, mean_over_window, rate_over_window, to_world, turn_rate
from quadsim.rotation import conjugate
from quadsim.state import Array
from quadsim.vehicle import Vehicle

WINDOW: Final = 0.1  # [s] over which rates and thrust are compared
SLOW_WINDOW: Final = 0.2  # [s] for lateral accelerations
LEAST_RISE: Final = 0.7
"""By which the correlations of three axes must rise: one of -0.6 negated gains 1.2, and costs 0.5."""
NEGATED_BELOW: Final = -0.25  # correlation below which a column is taken for a negated one
# What a change must gain in the sum of correlations, so that noise makes none: per negated column, per column that
# changes its place, and for another reading of the quaternion.
NEGATION_COST: Final = 0.5
MOVE_COST: Final = 0.3
READING_COST: Final = 0.7
COSTLY_SHIFT: Final = 0.3  # [s] of shift between the clocks that counts as much as a correlation of 1
LIFT_LAGS: Final = (0.0, 0.05, 0.1)  # [s] of the rotors behind their inputs, of which the best counts
FALLING: Final = -0.4  # concordance of thrust and climb below which more thrust makes the vehicle fall
_LEAST_EXPLAINED: Final = 0.3  # share of the lateral acceleration that tilt must explain for its direction to count
MIRRORED_BETTER: Final = 0.2  # by which the mirrored tilt must explain more
OTHER_FRAME: Final = 30.0  # [deg] between the headings of tilt and velocity that is another frame
OPPOSITE_FRAME: Final = 135.0  # [deg] from which z may point down too


def _scalar_last(quaternion: Array) -> Array:
    """The quaternion of columns x, y, z, w."""
    return np.roll(quaternion, 1, axis=1)


def _as_logged(quaternion: Array) -> Array:
    return quaternion


READINGS: Final[dict[str, Callable[[Array], Array]]] = {
    "": _as_logged,
    "the quaternion is world to body: negate qx, qy, qz": conjugate,
    "the quaternion's columns are in the order x, y, z, w": _scalar_last,
    "the quaternion is world to body, its columns in the order x, y, z, w": lambda q: conjugate(_scalar_last(q)),
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
    correction = _correction(readings, ("wx", "wy", "wz"), record.period)
    if correction:
        raise InputError(f"{record.name}: the rates are not those at which the attitude turns: {correction}")


def turning_pairs(record: Record, parts: Sequence[slice], meant: Callable[[Array], Array] = _as_logged) -> Pairs:
    """Rates at which the attitude turns, and those of the gyro."""
    return pairs_of(
        record,
        parts,
        lambda part: turn_rate(meant(record.attitude[part]), record.period, WINDOW),
        lambda part: mean_over_window(record.rates[part], record.period, WINDOW),
    )


def lateral_motion(record: Record, parts: Sequence[slice]) -> Lateral:
    """What `tilt_fit` fits."""
    step = stride(record.period)

    def level(rows: Array) -> Array:
        return np.asarray(rows[::step, 0] + 1j * rows[::step, 1])

    motion = []
    for part in parts:
        velocity = record.velocity[part]
        axis = body_z(record.attitude[part])
        acceleration = level(rate_over_window(velocity, record.period, SLOW_WINDOW))
        mean_axis = level(mean_over_window(axis, record.period, SLOW_WINDOW))
        mean_velocity = level(mean_over_window(velocity, record.period, SLOW_WINDOW))
        motion.append((acceleration, mean_axis, mean_velocity))
    return motion


def tilt_fit(motion: Lateral, *, mirrored: bool = False, shift: int = 0) -> tuple[float, complex]:
    """Fit dv/dt = c b + d v + e, b the thrust axis `shift` ticks earlier, c complex, d real, e per part.

    Returns:
        The share of dv/dt that it explains, and c [m/s^2]: its angle is that from tilt to acceleration.
    """
    rows = []
    sides = []
    for acceleration, axis, velocity in motion:
        if mirrored:
            tilt = axis.conj()
        else:
            tilt = axis
        b, a = aligned(tilt, acceleration, shift)
        _, v = aligned(axis, velocity, shift)
        known = [_centred_parts(b), _centred_parts(1j * b), _centred_parts(v)]
        rows.append(np.stack(known, axis=1))
        sides.append(_centred_parts(a))
    matrix = np.concatenate(rows)
    side = np.concatenate(sides)
    solution = np.linalg.lstsq(matrix, side, rcond=None)[0]
    total = float(np.square(side).sum())
    explained = 0.0
    if total:
        explained = 1.0 - float(np.square(side - matrix @ solution).sum()) / total
    return explained, complex(solution[0], solution[1])


def _centred_parts(x: NDArray[Any]) -> Array:
    """Real parts (2 K,) and then imaginary ones of complex numbers (K,), less their mean."""
    centred = x - x.mean()
    return np.concatenate([centred.real, centred.imag])


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
            lambda part: mean_over_window(velocity[part], record.period, WINDOW),
        )

    logged = beside_slope(record.velocity)
    correction = _correction({"": logged}, ("vx", "vy", "vz"), record.period)
    if correction:
        raise InputError(f"{record.name}: the velocity is not the slope of the position: {correction}")
    turned = beside_slope(to_world(record.attitude, record.velocity))
    difference = _difference(logged)
    difference_if_turned = _difference(turned)
    if difference > 0.1 and difference > 2.0 * difference_if_turned:
        raise InputError(
            f"{record.name}: vx, vy, vz are along the body's axes: turned into the world, they differ from the slope "
            f"of the position by {100.0 * difference_if_turned:.0f} % instead of {100.0 * difference:.0f} %; give them "
            "in the world"
        )


def _difference(pairs: Pairs) -> float:
    """RMS difference of two vectors over the first's RMS."""
    difference = np.concatenate([first - second for first, second in pairs])
    total = np.concatenate([first for first, _ in pairs])
    return float(np.linalg.norm(difference) / max(float(np.linalg.norm(total)), 1e-30))


def check_tilt(record: Record, parts: Sequence[slice], vehicle: Vehicle) -> None:
    """Refuse a velocity that does not change as tilt and thrust make it.

    Raises:
        InputError: naming the frame or the columns that are negated or swapped.
    """
    concordance = max(_lift_concordance(record, parts, vehicle.gravity, lag) for lag in LIFT_LAGS)
    fault = _tilt_fault(lateral_motion(record, parts), falls=concordance < FALLING)
    if fault:
        raise InputError(f"{record.name}: {fault}; give world z up, body x forward, y left, z up")


def _tilt_fault(motion: Lateral, *, falls: bool) -> str:
    """What is wrong with the velocity's axes against the tilt; `falls` where more thrust makes the vehicle fall."""
    plain, direction = tilt_fit(motion)
    mirror, mirror_direction = tilt_fit(motion, mirrored=True)
    heading = math.degrees(cmath.phase(direction))
    if mirror > _LEAST_EXPLAINED and mirror > plain + MIRRORED_BETTER:
        quarter_turns = round(math.degrees(cmath.phase(mirror_direction)) / 90.0) % 4
        faults = ("vy is negated", "vx and vy are swapped", "vx is negated", "vx and vy are swapped and negated")
        fault = f"against the tilt, {faults[quarter_turns]}"
        if falls:
            fault += "; vz too: a world with z down"
        return fault
    if plain > _LEAST_EXPLAINED and abs(heading) > OPPOSITE_FRAME and falls:
        return "world and body have z down (NED, FRD): negate qy, qz, wy, wz, vy, vz, y, z"
    if plain > _LEAST_EXPLAINED and abs(heading) > OTHER_FRAME:
        fault = f"against the tilt, the velocity's heading is {heading:.0f} deg off: one of them is in another frame"
        if abs(heading) > OPPOSITE_FRAME:
            fault += ", or z points down (NED, FRD)"
        return fault
    if falls:
        return "more thrust makes it fall: vz is negated, or z points down"
    return ""


def _lift_concordance(record: Record, parts: Sequence[slice], gravity: float, lag: float) -> float:
    """Concordance of the upward acceleration with that of the upward thrust `lag` [s] earlier: 1 equal, -1 opposite.

    It is 2 cov / (var + var) of the two.
    """

    def lift(part: slice) -> Array:
        thrust = np.square(rotor_inputs(record)[part]).sum(axis=1, keepdims=True)
        upward = thrust * body_z(record.attitude[part])[:, 2:]
        return mean_over_window(gravity * upward / upward.mean(), record.period, SLOW_WINDOW)

    def climb(part: slice) -> Array:
        return rate_over_window(record.velocity[part, 2:], record.period, SLOW_WINDOW)

    shift = round(lag / (stride(record.period) * record.period))
    covariance, lifts, climbs = moments(pairs_of(record, parts, lift, climb), shift)
    return 2.0 * float(covariance[0, 0]) / max(float(lifts[0] + climbs[0]), 1e-30)


def _correction(readings: Mapping[str, Pairs], names: Sequence[str], period: float) -> str:
    """What is to change in the second vectors so that they follow the first far better; empty if nothing.

    `readings` has the pairs of each reading of the first. A reading, a change and a shift count against an explanation.
    """
    best = -9.0
    correction = ""
    rise = 0.0
    for shift in shifts(period):
        as_logged = float(np.trace(correlations(readings[""], shift)))
        cost_of_shift = abs(shift) * stride(period) * period / COSTLY_SHIFT
        for reading, pairs in readings.items():
            for change, score in _changes(correlations(pairs, shift), names):
                total = score - READING_COST * bool(reading) - cost_of_shift
                if total > best:
                    best = total
                    correction = "; ".join(text for text in (reading, change) if text)
                    rise = score - as_logged
    if rise > LEAST_RISE:
        return correction
    return ""


def _changes(correlation: Array, names: Sequence[str]) -> Iterator[tuple[str, float]]:
    """Each change of three columns, empty for none, with the sum of correlations that it gives, less its own cost."""
    for order in permutations(range(3)):
        along = correlation[list(order), range(3)].tolist()
        moved = [name for i, name in enumerate(names) if order[i] != i]
        negated = [name for name, value in zip(names, along, strict=True) if value < NEGATED_BELOW]
        changes = []
        if moved:
            changes.append(f"{' and '.join(moved)} are swapped")
        if len(negated) == 1:
            changes.append(f"{negated[0]} is negated")
        elif negated:
            changes.append(f"{' and '.join(negated)} are negated")
        gains = [-value if value < NEGATED_BELOW else value for value in along]
        yield "; ".join(changes), sum(gains) - NEGATION_COST * len(negated) - MOVE_COST * len(moved)
    yield "", float(np.trace(correlation))
