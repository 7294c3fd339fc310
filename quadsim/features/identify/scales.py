"""Scales of a log: columns that say the same of one motion, and gravity, must agree in size, not only in sign.

A factor k of b = k a + noise lies between cov(a, b) / var(a) and var(b) / cov(a, b), whichever of the two is noisy; a
column is called wrong only where both bounds are.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from quadsim.errors import InputError
from quadsim.features.identify.correlation import Pairs, moments, pairs_of, stride
from quadsim.features.identify.record import Record
from quadsim.features.identify.windows import body_z, half_window, mean, rate_over_window, turn_rate
from quadsim.state import Array
from quadsim.vehicle import Vehicle

_TOLERANCE: Final = 0.07
"""By which three columns may differ together: state estimators differ by 5 % from what they were fed, axis by axis."""
_OF_ONE: Final = 0.25  # by which one column alone may
_WINDOW: Final = 0.2  # [s] over which motions are compared
_ALIKE: Final = 0.9  # least correlation of two motions whose scales are compared
_SAME = 0.03
_NEAR = 0.05
"""Within which the factors of three columns are one, and a factor is a clock's or a unit's."""
_UNITS: Final = {
    "gyro": ((180.0 / math.pi, "deg/s"), (2.0, "a gyro at twice the full scale that was assumed"),
             (0.5, "a gyro at half the full scale that was assumed")),
    "speed": ((3.6, "km/h"), (3.2808, "ft/s"), (1.9438, "knots"), (2.2369, "mph"), (100.0, "cm/s"), (1000.0, "mm/s")),
}  # fmt: skip
"""Factors by which a unit is mistaken."""


class ScaleFactor(NamedTuple):
    """Bounds of the factor between two columns."""

    low: float
    high: float

    @property
    def value(self) -> float:
        """The likely factor."""
        return math.sqrt(self.low * self.high)

    def off(self, tolerance: float = _TOLERANCE) -> bool:
        """Whether it cannot be 1."""
        return self.low > 1.0 + tolerance or self.high < 1.0 / (1.0 + tolerance)

    def like(self, other: float, within: float) -> bool:
        """Whether it is another factor, within a share."""
        return abs(math.log(self.value / other)) < within


def check_scales(record: Record, parts: Sequence[slice], vehicle: Vehicle) -> None:
    """Compare gyro with attitude, velocity with position, and both with gravity.

    Raises:
        InputError: naming the columns, their factor and the likely unit.
    """
    turns = _factors(pairs_of(
        record, parts,
        lambda part: turn_rate(record.attitude[part], record.period, _WINDOW),
        lambda part: _turned(record.rates[part], record.period),
    ))  # fmt: skip
    falls = _factor(*_tilts(record, parts, vehicle.gravity))
    moves: list[ScaleFactor | None] = [None] * 3
    if (position := record.position) is not None:
        moves = _factors(pairs_of(
            record, parts,
            lambda part: rate_over_window(position[part], record.period, _WINDOW),
            lambda part: mean(record.velocity[part], record.period, _WINDOW),
        ))  # fmt: skip
    turn = _common(turns)
    move = _common(moves)
    name = record.name
    if turn is not None and turn.off():
        moved = move is not None and move.like(turn.value, _NEAR)
        if moved or (falls is not None and falls.like(1.0 / turn.value, _NEAR)):
            raise InputError(
                f"{name}: gyro against attitude and velocity against {'position' if moved else 'gravity'} say that the "
                f"clock runs {turn.value:.3g} times as fast as the flight: correct t"
            )
        if falls is not None and not record.inertial and falls.like(turn.value, abs(math.log(falls.value))):
            raise InputError(
                f"{name}: the attitude turns {1.0 / turn.value:.3g} times as far as the gyro says, and tilts "
                f"{1.0 / falls.value:.3g} times as far as the velocity shows: it is the attitude that is off, not the "
                "gyro; give a better estimate, or leave it out beside ax, ay, az"
            )
    _refuse(name, "wx wy wz", turns, turn, "the rates at which the attitude turns", "gyro", "rad/s")
    if falls is None or not falls.off():  # gravity speaks for the velocity: small differences are the position's
        if move is not None and move.off(_OF_ONE):
            factor = 1.0 / move.value
            if abs(math.log(factor / 100.0)) < _NEAR:
                likely = " likely in cm;"
            else:
                likely = ""
            what = f"{name}: x, y, z are {factor:.3g} times the integral of vx, vy, vz;{likely}"
            raise InputError(f"{what} give m and m/s")
    else:
        _refuse(name, "vx vy vz", moves, move, "the slope of the position", "speed", "m/s")
    if falls is not None and falls.off():
        raise InputError(
            f"{name}: vx, vy change {falls.value:.3g} times as fast as tilt and gravity make them"
            f"{_likely(falls.value, 'speed')}; give them in m/s, and t in s"
        )


def _refuse(
    name: str,
    columns: str,
    factors: Sequence[ScaleFactor | None],
    common: ScaleFactor | None,
    what: str,
    kind: str,
    unit: str,
) -> None:
    """Refuse three columns together, or those of them that are off."""
    if common is not None and common.off():
        names = ", ".join(columns.split())
        value = common.value
    else:
        wrong = {}
        for of, f in zip(columns.split(), factors, strict=True):
            if f is not None and f.off(_OF_ONE):
                wrong[of] = f
        if not wrong:
            return
        names = ", ".join(wrong)
        value = next(iter(wrong.values())).value
    verb = "are" if "," in names else "is"
    raise InputError(f"{name}: {names} {verb} {value:.3g} times {what}{_likely(value, kind)}; give {unit}")


def _likely(factor: float, kind: str) -> str:
    near = [unit for of, unit in _UNITS[kind] if abs(math.log(max(factor, 1e-9) / of)) < _NEAR]
    if near:
        return f": likely {near[0]}"
    return ""


def _common(factors: Sequence[ScaleFactor | None]) -> ScaleFactor | None:
    """The factor of three columns, where there is one for those that show any."""
    known = [factor for factor in factors if factor is not None]
    if not known:
        return None
    middle = math.exp(float(np.mean([math.log(max(factor.value, 1e-9)) for factor in known])))
    return ScaleFactor(*(float(np.median(of)) for of in zip(*known, strict=True))) if all(
        factor.like(middle, _SAME) for factor in known
    ) else None  # fmt: skip


def _factors(pairs: Pairs) -> list[ScaleFactor | None]:
    """ScaleFactor from each column of the first to that of the second."""
    covariance, first, second = moments(pairs)
    return [_factor(float(covariance[i, i]), float(first[i]), float(second[i])) for i in range(len(first))]


def _factor(covariance: float, first: float, second: float) -> ScaleFactor | None:
    """Nothing where the two are not alike, but for a second that stands still while the first moves."""
    if covariance <= _ALIKE * math.sqrt(first * second) or not first:
        return None
    return ScaleFactor(covariance / first, second / covariance)


def _turned(rates: Array, period: float) -> Array:
    """Rates (N, 3) at which the gyro says that the attitude turns over a window, as `turn_rate` of attitudes."""
    half = half_window(period, _WINDOW)
    if np.abs(rates).max() * _WINDOW > math.pi:  # it turns as often as it likes
        return mean(rates, period, _WINDOW)
    steps = 0.5 * period * (rates[1:] + rates[:-1])
    count = len(rates) - 2 * half
    turn = Rotation.identity(count)
    for k in range(2 * half):
        turn = turn * Rotation.from_rotvec(steps[k : k + count])
    return np.pad(turn.as_rotvec() / (2 * half * period), ((half, half), (0, 0)), mode="edge")


def _tilts(record: Record, parts: Sequence[slice], gravity: float) -> tuple[float, float, float]:
    """Covariance and variances of what tilt and gravity give in level acceleration, and of that, drag taken out."""
    step = stride(record.period)
    known: list[Array] = []
    seen: list[Array] = []
    drag: list[Array] = []
    for part in parts:
        axis = mean(body_z(record.attitude[part]), record.period, _WINDOW)[::step]
        change = rate_over_window(record.velocity[part], record.period, _WINDOW)[::step]
        speed = mean(record.velocity[part], record.period, _WINDOW)[::step]
        given = (gravity + change[:, 2:]) * axis[:, :2] / np.maximum(axis[:, 2:], 0.3)
        for rows, of in ((known, given), (seen, change[:, :2]), (drag, speed[:, :2])):
            rows.append((of - of.mean(axis=0)).ravel())
    a, b, v = (np.concatenate(rows) for rows in (known, seen, drag))
    a, b = (of - v * float(of @ v) / max(float(v @ v), 1e-30) for of in (a, b))
    return float(a @ b), float(a @ a), float(b @ b)
