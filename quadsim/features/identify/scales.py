"""Scales of a log: columns that say the same of one motion, and gravity, must agree in size, not only in sign.

A factor k of b = k a + noise lies between cov(a, b) / var(a) and var(b) / cov(a, b), whichever of the two is noisy; a
column is called wrong only where both bounds are.  One of the checks before any fit, which relies on that of the axes.
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
from quadsim.features.identify.windows import body_z, half_window, mean_over_window, rate_over_window, turn_rate
from quadsim.state import Array
from quadsim.vehicle import Vehicle

_TOLERANCE: Final = 0.07
"""By which three columns may differ together: state estimators differ by 5 % from what they were fed, axis by axis."""
_TOLERANCE_OF_ONE: Final = 0.25  # by which one column alone may
_WINDOW: Final = 0.2  # [s] over which motions are compared
_LEAST_CORRELATION: Final = 0.9  # of two motions whose scales are compared
_COMMON: Final = 0.03  # in logarithms, within which the factors of three columns are one
_NEAR: Final = 0.05  # in logarithms, within which a factor is a clock's or a unit's
_MISTAKEN_UNITS: Final = {
    "gyro": (
        (180.0 / math.pi, "deg/s"),
        (2.0, "a gyro at twice the full scale that was assumed"),
        (0.5, "a gyro at half the full scale that was assumed"),
    ),
    "speed": (
        (3.6, "km/h"),
        (3.2808, "ft/s"),
        (1.9438, "knots"),
        (2.2369, "mph"),
        (100.0, "cm/s"),
        (1000.0, "mm/s"),
    ),
}
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
    name = record.name
    gyro_factors = _factors(_turning(record, parts))
    velocity_factors: list[ScaleFactor | None] = [None] * 3
    if record.position is not None:
        velocity_factors = _factors(_moving(record, parts, record.position))
    tilt_factor = _factor(*_tilt_moments(record, parts, vehicle.gravity))
    gyro = _common(gyro_factors)
    velocity = _common(velocity_factors)
    if gyro is not None and gyro.off():
        _refuse_clock_or_attitude(record, gyro, velocity, tilt_factor)
    _refuse(name, "wx wy wz", gyro_factors, gyro, "the rates at which the attitude turns", "gyro", "rad/s")
    if tilt_factor is not None and tilt_factor.off():
        _refuse(name, "vx vy vz", velocity_factors, velocity, "the slope of the position", "speed", "m/s")
        raise InputError(
            f"{name}: vx, vy change {tilt_factor.value:.3g} times as fast as tilt and gravity make them"
            f"{_likely(tilt_factor.value, 'speed')}; give them in m/s, and t in s"
        )
    # Gravity confirms the velocity, so that a small difference is an error of the position.
    if velocity is not None and velocity.off(_TOLERANCE_OF_ONE):
        factor = 1.0 / velocity.value
        likely = ""
        if abs(math.log(factor / 100.0)) < _NEAR:
            likely = " likely in cm;"
        raise InputError(f"{name}: x, y, z are {factor:.3g} times the integral of vx, vy, vz;{likely} give m and m/s")


def _turning(record: Record, parts: Sequence[slice]) -> Pairs:
    """Rates at which the attitude turns over a window, and the same by the gyro."""
    return pairs_of(
        record,
        parts,
        lambda part: turn_rate(record.attitude[part], record.period, _WINDOW),
        lambda part: _integrated_turn_rate(record.rates[part], record.period),
    )


def _moving(record: Record, parts: Sequence[slice], position: Array) -> Pairs:
    """Slope of the position over a window, and the mean velocity in it."""
    return pairs_of(
        record,
        parts,
        lambda part: rate_over_window(position[part], record.period, _WINDOW),
        lambda part: mean_over_window(record.velocity[part], record.period, _WINDOW),
    )


def _refuse_clock_or_attitude(
    record: Record, gyro: ScaleFactor, velocity: ScaleFactor | None, tilt: ScaleFactor | None
) -> None:
    """Refuse a clock or an attitude that is off where a second factor, of velocity or tilt, excludes the gyro."""
    by_position = velocity is not None and velocity.like(gyro.value, _NEAR)
    by_gravity = tilt is not None and tilt.like(1.0 / gyro.value, _NEAR)
    if by_position or by_gravity:
        raise InputError(
            f"{record.name}: gyro against attitude and velocity against {'position' if by_position else 'gravity'} "
            f"say that the clock runs {gyro.value:.3g} times as fast as the flight: correct t"
        )
    if tilt is not None and not record.inertial and tilt.like(gyro.value, abs(math.log(tilt.value))):
        raise InputError(
            f"{record.name}: the attitude turns {1.0 / gyro.value:.3g} times as far as the gyro says, and tilts "
            f"{1.0 / tilt.value:.3g} times as far as the velocity shows: it is the attitude that is off, not the "
            "gyro; give a better estimate, or leave it out beside ax, ay, az"
        )


def _refuse(
    name: str,
    columns: str,
    factors: Sequence[ScaleFactor | None],
    common: ScaleFactor | None,
    truth: str,
    kind: str,
    unit: str,
) -> None:
    """Refuse three columns together, or those of them that are off."""
    if common is not None and common.off():
        wrong = columns.split()
        value = common.value
    else:
        wrong = []
        values = []
        for column, factor in zip(columns.split(), factors, strict=True):
            if factor is not None and factor.off(_TOLERANCE_OF_ONE):
                wrong.append(column)
                values.append(factor.value)
        if not wrong:
            return
        value = values[0]
    verb = "are" if len(wrong) > 1 else "is"
    raise InputError(f"{name}: {', '.join(wrong)} {verb} {value:.3g} times {truth}{_likely(value, kind)}; give {unit}")


def _likely(factor: float, kind: str) -> str:
    for mistaken, unit in _MISTAKEN_UNITS[kind]:
        if abs(math.log(max(factor, 1e-9) / mistaken)) < _NEAR:
            return f": likely {unit}"
    return ""


def _common(factors: Sequence[ScaleFactor | None]) -> ScaleFactor | None:
    """The factor of three columns, where there is one for those that show any."""
    known = [factor for factor in factors if factor is not None]
    if not known:
        return None
    logarithms = [math.log(max(factor.value, 1e-9)) for factor in known]
    middle = math.exp(float(np.mean(logarithms)))
    if not all(factor.like(middle, _COMMON) for factor in known):
        return None
    low = float(np.median([factor.low for factor in known]))
    high = float(np.median([factor.high for factor in known]))
    return ScaleFactor(low, high)


def _factors(pairs: Pairs) -> list[ScaleFactor | None]:
    """Factor from each column of the first to that of the second."""
    covariance, first, second = moments(pairs)
    factors = []
    for i in range(len(first)):
        factors.append(_factor(float(covariance[i, i]), float(first[i]), float(second[i])))
    return factors


def _factor(covariance: float, first: float, second: float) -> ScaleFactor | None:
    """Nothing where the two are not alike, but for a second that stands still while the first moves."""
    if covariance <= _LEAST_CORRELATION * math.sqrt(first * second) or not first:
        return None
    return ScaleFactor(covariance / first, second / covariance)


def _integrated_turn_rate(rates: Array, period: float) -> Array:
    """Rates (N, 3) at which the gyro says that the attitude turns over a window, as `turn_rate` of attitudes."""
    half = half_window(period, _WINDOW)
    if np.abs(rates).max() * _WINDOW > math.pi:  # it turns as often as it likes
        return mean_over_window(rates, period, _WINDOW)
    steps = 0.5 * period * (rates[1:] + rates[:-1])
    count = len(rates) - 2 * half
    turn = Rotation.identity(count)
    for k in range(2 * half):
        turn = turn * Rotation.from_rotvec(steps[k : k + count])
    return np.pad(turn.as_rotvec() / (2 * half * period), ((half, half), (0, 0)), mode="edge")


def _tilt_moments(record: Record, parts: Sequence[slice], gravity: float) -> tuple[float, float, float]:
    """Covariance and variances of what tilt and gravity give in level acceleration, and of that, drag taken out."""
    step = stride(record.period)
    expected_parts: list[Array] = []
    measured_parts: list[Array] = []
    speed_parts: list[Array] = []
    for part in parts:
        axis = mean_over_window(body_z(record.attitude[part]), record.period, _WINDOW)[::step]
        acceleration = rate_over_window(record.velocity[part], record.period, _WINDOW)[::step]
        speed = mean_over_window(record.velocity[part], record.period, _WINDOW)[::step]
        upward = gravity + acceleration[:, 2:]
        expected_parts.append(_centred(upward * axis[:, :2] / np.maximum(axis[:, 2:], 0.3)))
        measured_parts.append(_centred(acceleration[:, :2]))
        speed_parts.append(_centred(speed[:, :2]))
    speeds = np.concatenate(speed_parts)
    expected = _without(np.concatenate(expected_parts), speeds)
    measured = _without(np.concatenate(measured_parts), speeds)
    return float(expected @ measured), float(expected @ expected), float(measured @ measured)


def _centred(rows: Array) -> Array:
    """Rows (K, n) less their mean, as one vector."""
    return (rows - rows.mean(axis=0)).ravel()


def _without(vector: Array, other: Array) -> Array:
    """A vector less its part along another."""
    return np.asarray(vector - other * float(vector @ other) / max(float(other @ other), 1e-30))
