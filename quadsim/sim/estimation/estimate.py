"""An estimate: a mean on the manifold of poses and rates, and the covariance of its small error.

The error is e = [dp dv dtheta domega db], 15 numbers: position and velocity in the world frame, attitude as a rotation
vector in the body frame (q_true = q * exp(dtheta)), body rates and gyro bias.  Solà 2017, Secs. 5.1.1 and 5.3.1;
multiplicative in the sense of Markley, "Attitude error representations for Kalman filtering", JGCD 26 (2003).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Final

import numpy as np
from annotated_types import Gt, Lt, doc

from quadsim.fields import NonNegative
from quadsim.rotation import conjugate, exponential, logarithm, multiply, normalise
from quadsim.state import Array

POSITION: Final = slice(0, 3)
VELOCITY: Final = slice(3, 6)
ATTITUDE: Final = slice(6, 9)
RATES: Final = slice(9, 12)
GYRO_BIAS: Final = slice(12, 15)
N_ERRORS: Final = 15

MEAN_QUATERNION: Final = slice(6, 10)
MEAN_RATES: Final = slice(10, 13)
MEAN_GYRO_BIAS: Final = slice(13, 16)


@dataclass(frozen=True, kw_only=True)
class EstimatorSettings:
    """Tuning of the error-state filter.

    Densities are those of white noise on all three axes alike: integrated for a time t they give the standard deviation
    density sqrt(t).  The gate is that of the chi-square test of a sample's innovation.
    """

    acceleration_noise: Annotated[NonNegative, doc("[m/s^2/sqrt(Hz)] unmodelled white acceleration")] = 0.3
    angular_acceleration_noise: Annotated[
        NonNegative, doc("[rad/s^2/sqrt(Hz)] white angular acceleration that it does not explain")
    ] = 1.0
    gyro_bias_walk: Annotated[NonNegative, doc("[deg/s/sqrt(s)] random walk of the gyro's bias")] = 0.002
    initial_position: Annotated[NonNegative, doc("[m] standard deviation of the first estimate's error, per axis")] = (
        0.05
    )
    initial_velocity: Annotated[NonNegative, doc("[m/s] the same")] = 0.05
    initial_attitude: Annotated[NonNegative, doc("[deg] the same, about each body axis")] = 1.0
    initial_rates: Annotated[NonNegative, doc("[deg/s] the same")] = 1.0
    initial_gyro_bias: Annotated[NonNegative, doc("[deg/s] the same, of a bias first taken as zero")] = 0.5
    gate: Annotated[
        float, Gt(0.0), Lt(1.0), doc("[-] probability with which a right sample passes the test of its innovation")
    ] = 0.9999
    patience: Annotated[
        NonNegative, doc("[s] after which a sensor that was rejected all along is accepted again; 0 for never")
    ] = 1.0


@dataclass(frozen=True, kw_only=True)
class Estimate:
    """The estimated state of the vehicle."""

    mean: Array  # (16,) position [m], velocity [m/s] (world), quaternion wxyz, rates [rad/s] (body), gyro bias [rad/s]
    covariance: Array  # (15, 15) of the error


def retract(mean: Array, error: Array) -> Array:
    """The mean (16,) moved by an error (15,); Solà 2017, Eq. (283)."""
    moved = np.empty_like(mean)
    moved[:6] = mean[:6] + error[:6]
    w, x, y, z = mean[MEAN_QUATERNION].tolist()
    a, b, c = error[ATTITUDE].tolist()
    moved[MEAN_QUATERNION] = normalise(multiply((w, x, y, z), exponential((a, b, c))))
    moved[10:] = mean[10:] + error[9:]
    return moved


def difference(mean: Array, other: Array) -> Array:
    """The error (15,) of `other` against `mean`, such that moving `other` by it gives `mean`; inverts `retract`."""
    error = np.empty(N_ERRORS)
    error[:6] = mean[:6] - other[:6]
    error[9:] = mean[10:] - other[10:]
    w, x, y, z = mean[MEAN_QUATERNION].tolist()
    a, b, c, d = other[MEAN_QUATERNION].tolist()
    error[ATTITUDE] = logarithm(multiply(conjugate((a, b, c, d)), (w, x, y, z)))
    return error
