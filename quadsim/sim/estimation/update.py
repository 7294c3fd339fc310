"""Update: what a sample changes in an estimate, and whether it is an outlier.

    r = z - h(x)    S = H P H' + R    K = P H' S^-1    e = K r    P <- P - K H P

The innovation of an attitude is the rotation vector from the estimate to the sample, so it is as good upside down as
level (Trawny and Roumeliotis, "Indirect Kalman filter for 3D attitude estimation", 2005, Sec. 3).  The normalised
innovation squared, r' S^-1 r, is chi-square with three degrees of freedom where model and noise are as stated.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from quadsim.rotation import conjugate, logarithm, multiply, of_euler
from quadsim.sim.estimation.estimate import (
    ATTITUDE,
    GYRO_BIAS,
    MEAN_GYRO_BIAS,
    MEAN_QUATERNION,
    MEAN_RATES,
    N_ERRORS,
    POSITION,
    RATES,
    VELOCITY,
    Estimate,
    retract,
)
from quadsim.sim.sensing.sensor import SensorName
from quadsim.state import Array, read_only

_BLOCKS: Final = {
    SensorName.POSITION: (POSITION,),
    SensorName.VELOCITY: (VELOCITY,),
    SensorName.ATTITUDE: (ATTITUDE,),
    SensorName.RATES: (RATES, GYRO_BIAS),
}
"""The parts of the error whose sum a sensor sees."""
_LEADS: Final = {
    SensorName.POSITION: (VELOCITY,),
    SensorName.VELOCITY: (),
    SensorName.ATTITUDE: (RATES, GYRO_BIAS),
    SensorName.RATES: (),
}
"""The parts whose errors add up in it over time; the gyro's bias does by way of the rates, which follow the gyro."""


def _observation(name: SensorName) -> Array:
    H = np.zeros((3, N_ERRORS))
    for block in _BLOCKS[name]:
        H[:, block] = np.eye(3)
    return read_only(H)


OBSERVATION: Final = {name: _observation(name) for name in SensorName}  # (3, 15) H of each sensor


def innovation(name: SensorName, mean: Array, value: Array) -> Array:
    """(3,) a sample (3,) less that predicted by the mean (16,), in the sensor's unit."""
    if name is SensorName.ATTITUDE:
        w, x, y, z = mean[MEAN_QUATERNION].tolist()
        roll, pitch, yaw = value.tolist()
        return np.array(logarithm(multiply(conjugate((w, x, y, z)), of_euler(roll, pitch, yaw))))
    if name is SensorName.RATES:
        return value - mean[MEAN_RATES] - mean[MEAN_GYRO_BIAS]
    return value - mean[_BLOCKS[name][0]]


def update(estimate: Estimate, name: SensorName, value: Array, variance: Array, gate: float) -> tuple[Estimate, float]:
    """The estimate after a sample (3,), and the sample's normalised innovation squared.

    A sample whose normalised innovation squared is not within the gate, or not a number, changes nothing.  The error is
    reset to zero without G = I - [dtheta / 2]x of Solà 2017, Eq. (287), which would turn the covariance by half the
    correction and is there neglected, too.  `variance` (3, 3) is R, of the sensor's noise.
    """
    H, P = OBSERVATION[name], estimate.covariance
    residual = innovation(name, estimate.mean, value)
    rows = H @ P
    weight = _inverse(rows @ H.T + variance)
    distance = float(residual @ weight @ residual)
    if not distance <= gate:
        return estimate, distance
    gain = rows.T @ weight
    P = P - gain @ rows
    return Estimate(mean=retract(estimate.mean, gain @ residual), covariance=0.5 * (P + P.T)), distance


def doubt(estimate: Estimate, name: SensorName, value: Array, refused: float) -> Estimate:
    """The estimate with its variance widened by as much as a sample (3,) disagrees with it, so that the sample passes.

    For the way back after divergence: the innovation squared is added to the variance of all that the sensor sees, and
    (innovation / time)^2 to that of the rates of change which may have caused its error in the meantime, in which all
    its samples were refused [s].
    """
    covariance = estimate.covariance.copy()
    squares = np.diag(np.square(innovation(name, estimate.mean, value)))
    for block in _BLOCKS[name]:
        covariance[block, block] += squares
    for block in _LEADS[name]:
        covariance[block, block] += squares / refused**2
    return Estimate(mean=estimate.mean, covariance=covariance)


def _inverse(S: Array) -> Array:
    """The inverse of a symmetric positive definite (3, 3) matrix by its cofactors: faster than a call of LAPACK."""
    (a, b, c), (_, d, e), (_, _, f) = S.tolist()
    A, B, C = d * f - e * e, c * e - b * f, b * e - c * d
    scale = 1.0 / (a * A + b * B + c * C)
    D, E, F = a * f - c * c, b * c - a * e, a * d - b * b
    return scale * np.array([[A, B, C], [B, D, E], [C, E, F]])
