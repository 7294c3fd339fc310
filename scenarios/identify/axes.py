"""Axes, signs and clocks of a log: rates against the turning attitude, velocity against position, tilt and thrust.

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
from quadsim.rotation import conjugate
from quadsim.state import Array
from scenarios.identify.record import Record, driver
from scenarios.identify.windows import body_z, mean, slope, to_world, turn_rate

WINDOW: Final = 0.1  # [s] over which rates and thrust are compared
SLOW_WINDOW: Final = 0.2  # [s] for lateral accelerations
LONGEST_SHIFT: Final = 0.3  # [s] between clocks that is looked for
REFUSED_SHIFT: Final = 0.1  # [s]
SHOWN_SHIFT: Final = 5e-3  # [s]
GAIN: Final = 0.7  # by which the correlations of three axes must rise: one of -0.6 negated gains 1.2, and costs 0.5
READINGS: Final[dict[str, Callable[[Array], Array]]] = {
    "": lambda q: q,
    "the quaternion is world to body: negate qx, qy, qz": conjugate,
    "the quaternion's columns are in the order x, y, z, w": lambda q: np.roll(q, 1, axis=1),
    "the quaternion is world to body, its columns in the order x, y, z, w": lambda q: conjugate(np.roll(q, 1, axis=1)),
}
"""How the columns of the attitude may be meant."""
Pairs = Sequence[tuple[Array, Array]]


def check_axes(record: Record, parts: Sequence[slice], gravity: float) -> tuple[str, ...]:
    """Return notes on small shifts between clocks.

    Raises:
        InputError: an axis is negated or swapped, a frame is another, or a clock is more than 100 ms off.
    """
    _check_rates(record, parts)
    _check_velocity(record, parts)
    _check_tilt(record, parts, gravity)
    return tuple(_shift_notes(record, parts))


def _check_rates(record: Record, parts: Sequence[slice]) -> None:
    """Refuse rates that are not those at which the attitude turns."""
    gyro = [mean(record.rates[part], record.period, WINDOW) for part in parts]
    pairs = {
        reading: list(zip((_turns(record, part, meant) for part in parts), gyro, strict=True))
        for reading, meant in READINGS.items()
    }
    if better := _better(pairs, ("wx", "wy", "wz"), record.period):
        raise InputError(f"{record.name}: the rates are not those at which the attitude turns: {better}")


def _turns(record: Record, part: slice, meant: Callable[[Array], Array] = READINGS[""]) -> Array:
    return turn_rate(meant(record.attitude[part]), record.period, WINDOW)


def _check_velocity(record: Record, parts: Sequence[slice]) -> None:
    """Refuse a velocity that is not the slope of the position."""
    if record.position is None:
        return
    pairs = [
        (slope(record.position[p], record.period, WINDOW), mean(record.velocity[p], record.period, WINDOW))
        for p in parts
    ]
    if better := _better({"": pairs}, ("vx", "vy", "vz"), record.period):
        raise InputError(f"{record.name}: the velocity is not the slope of the position: {better}")
    turned = [mean(to_world(record.attitude[p], record.velocity[p]), record.period, WINDOW) for p in parts]
    total = max(sum(float(np.square(place).sum()) for place, _ in pairs), 1e-30)
    world, body = (
        sum(float(np.square(place - v).sum()) for (place, _), v in zip(pairs, read, strict=True)) / total
        for read in ([v for _, v in pairs], turned)
    )
    if world > 0.02 and world > 4.0 * body:
        raise InputError(
            f"{record.name}: vx, vy, vz are along the body's axes: turned into the world, they differ from the slope "
            f"of the position by {100.0 * math.sqrt(body):.0f} % instead of {100.0 * math.sqrt(world):.0f} %; give "
            "the velocity in the world"
        )


def _check_tilt(record: Record, parts: Sequence[slice], gravity: float) -> None:
    """Refuse a velocity that does not change as tilt and thrust make it."""
    falls = max(_lifting(record, parts, gravity, lag) for lag in (0.0, 0.05, 0.1)) < -0.4
    plain, direction = _tilt_fit(record, parts, mirrored=False)
    mirror, mirror_direction = _tilt_fit(record, parts, mirrored=True)
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
    pairs = []
    for part in parts:
        lift = np.square(driver(record)[part]).sum(axis=1, keepdims=True) * body_z(record.attitude[part])[:, 2:]
        climb = slope(record.velocity[part, 2:], record.period, SLOW_WINDOW)
        pairs.append((mean(gravity * lift / lift.mean(), record.period, SLOW_WINDOW), climb))
    covariance, lifts, climbs = _moments(pairs, round(lag / record.period))
    return 2.0 * float(covariance[0, 0]) / max(float(lifts[0] + climbs[0]), 1e-30)


def _tilt_fit(record: Record, parts: Sequence[slice], *, mirrored: bool, shift: int = 0) -> tuple[float, complex]:
    """Fit dv/dt = c b + d v + e, lateral, b the thrust axis `shift` samples earlier, c complex, d real, e per part.

    Returns:
        The share of dv/dt that it explains, and c [m/s^2]: its angle is that from tilt to acceleration.
    """
    rows, sides = [], []
    for part in parts:
        rate, velocity = slope(record.velocity[part], record.period, SLOW_WINDOW), record.velocity[part]
        axis = mean(body_z(record.attitude[part]), record.period, SLOW_WINDOW)
        a, b, v = (x[:, 0] + 1j * x[:, 1] for x in (rate, axis, mean(velocity, record.period, SLOW_WINDOW)))
        (b, a), (_, v) = _aligned(b, a, shift), _aligned(b, v, shift)
        b = b.conj() if mirrored else b
        columns = [x - x.mean() for x in (b, 1j * b, v, a)]
        rows.append(np.stack([np.concatenate([x.real, x.imag]) for x in columns[:3]], axis=1))
        sides.append(np.concatenate([columns[3].real, columns[3].imag]))
    matrix, side = np.concatenate(rows), np.concatenate(sides)
    solution = np.linalg.lstsq(matrix, side, rcond=None)[0]
    total = float(np.square(side).sum())
    explained = 1.0 - float(np.square(side - matrix @ solution).sum()) / total if total else 0.0
    return explained, complex(solution[0], solution[1])


def _shift_notes(record: Record, parts: Sequence[slice]) -> Iterator[str]:
    """Shifts between the clocks of attitude, rates and velocity."""
    pairs = [(_turns(record, part), mean(record.rates[part], record.period, WINDOW)) for part in parts]
    shifts = _shifts(record.period)
    like = np.array([_likeness(pairs, shift) for shift in shifts])
    if like.max() > 0.7:
        yield from _shift_note(record, "rates are", _peak(like, shifts) * record.period)
    unlike = 1.0 - np.array([_tilt_fit(record, parts, mirrored=False, shift=shift)[0] for shift in shifts])
    now, least = unlike[shifts.index(0)], unlike.min()
    if least < 0.7 and now > 1.3 * least and now > least + 4e-3:
        yield from _shift_note(record, "velocity is", _peak(-unlike, shifts) * record.period)


def _shift_note(record: Record, late: str, shift: float) -> Iterator[str]:
    if abs(shift) < SHOWN_SHIFT:
        return
    text = (
        f"{record.name}: the {late} {1e3 * abs(shift):.0f} ms {'late' if shift > 0 else 'early'} against the attitude"
    )
    if abs(shift) > REFUSED_SHIFT:
        raise InputError(f"{text}; at most {1e3 * REFUSED_SHIFT:.0f} ms are allowed: shift the columns onto one clock")
    yield f"{text}; shift its columns onto one clock for better estimates"


def _shifts(period: float) -> list[int]:
    """Shifts between two clocks [samples], some 10 ms apart."""
    step = max(1, round(0.01 / period))
    most = math.ceil(LONGEST_SHIFT / period / step)
    return [step * i for i in range(-most, most + 1)]


def _peak(values: Array, shifts: Sequence[int]) -> float:
    """Where the parabola through the largest value and its neighbours peaks [samples]."""
    top = int(np.clip(np.argmax(values), 1, len(values) - 2))
    before, at, after = values[top - 1 : top + 2]
    bend = before - 2.0 * at + after
    return shifts[top] + (0.5 * (before - after) / bend if bend < 0.0 else 0.0) * (shifts[1] - shifts[0])


def _aligned(first: Array, second: Array, shift: int) -> tuple[Array, Array]:
    """Rows k of the first beside rows k + shift of the second."""
    size = len(first) - abs(shift)
    return first[max(-shift, 0) :][:size], second[max(shift, 0) :][:size]


def _moments(pairs: Pairs, shift: int) -> tuple[Array, Array, Array]:
    """Covariances (n, m), and variances (n,) and (m,), of all parts, the mean of each removed."""
    aligned = [_aligned(a, b, shift) for a, b in pairs]
    free = [(a - a.mean(axis=0), b - b.mean(axis=0)) for a, b in aligned]
    a, b = (np.concatenate(rows) for rows in zip(*free, strict=True))
    return a.T @ b, np.square(a).sum(axis=0), np.square(b).sum(axis=0)


def _correlations(pairs: Pairs, shift: int) -> Array:
    """Correlations (n, m) of the columns of both, all parts together."""
    covariance, first, second = _moments(pairs, shift)
    return np.asarray(covariance / np.sqrt(np.maximum(np.outer(first, second), 1e-30)))


def _likeness(pairs: Pairs, shift: int) -> float:
    """Correlation of two vectors, all axes and parts together."""
    covariance, first, second = _moments(pairs, shift)
    return float(np.trace(covariance)) / math.sqrt(max(first.sum() * second.sum(), 1e-30))


def _better(pairs: Mapping[str, Pairs], names: Sequence[str], period: float) -> str:
    """What is to change in the second vectors of pairs so that they follow the first far better; empty if nothing.

    `pairs` are those of each reading of the first; a reading, a change and a shift each count against an explanation.
    """
    best, better = -9.0, ("", 0.0)
    for reading, of_reading in pairs.items():
        for shift in _shifts(period):
            correlations = _correlations(of_reading, shift)
            usual = float(np.trace(_correlations(pairs[""], shift)))
            for change, score in _changes(correlations, names):
                total = score - 0.7 * bool(reading) - abs(shift) * period / 0.3
                if total > best:
                    best, better = total, ("; ".join(filter(None, (reading, change))), score - usual)
    return better[0] if better[1] > GAIN else ""


def _changes(correlations: Array, names: Sequence[str]) -> Iterator[tuple[str, float]]:
    """Each change of three columns, empty for none, with the sum of correlations that it gives, less its own cost."""
    for order in permutations(range(3)):
        along = correlations[list(order), range(3)]
        negated = [name for name, value in zip(names, along, strict=True) if value < -0.25]
        moved = [name for i, name in enumerate(names) if order[i] != i]
        changes = [f"{' and '.join(moved)} are swapped"] if moved else []
        changes += [f"{' and '.join(negated)} {'is' if len(negated) == 1 else 'are'} negated"] if negated else []
        score = sum(-value if value < -0.25 else value for value in along.tolist())
        yield "; ".join(changes), score - 0.5 * len(negated) - 0.3 * len(moved)
    yield "", float(np.trace(correlations))
