"""Settings of the estimator: process noise, initial covariance, rejection of outliers."""

from __future__ import annotations

import math
from dataclasses import dataclass

from quadsim.errors import ParameterError


@dataclass(frozen=True, kw_only=True)
class EstimatorSettings:
    """Tuning of the error-state filter; validated when made.

    Densities are those of white noise on all three axes alike: integrated for a time t they give the standard deviation
    density sqrt(t).

    Attributes:
        acceleration_noise: unmodelled specific force [m/s^2/sqrt(Hz)].
        angular_acceleration_noise: angular acceleration it does not explain [rad/s^2/sqrt(Hz)].
        gyro_bias_walk: random walk of the rate gyro's bias [rad/s/sqrt(s)].
        initial_position: standard deviation of the first estimate's error, per axis [m].
        initial_velocity: the same [m/s].
        initial_attitude: the same, of the rotation vector [rad].
        initial_rates: the same [rad/s].
        initial_gyro_bias: the same of the gyro's bias, first estimated as zero [rad/s].
        gate: probability with which a right sample passes the chi-square test of its innovation.
        patience: a sensor whose every sample has been rejected for this long is accepted again [s]; 0 for never.

    Raises:
        ParameterError: a value is not finite or not possible.
    """

    acceleration_noise: float = 0.3
    angular_acceleration_noise: float = 1.0
    gyro_bias_walk: float = math.radians(0.002)
    initial_position: float = 0.05
    initial_velocity: float = 0.05
    initial_attitude: float = math.radians(1.0)
    initial_rates: float = math.radians(1.0)
    initial_gyro_bias: float = math.radians(0.5)
    gate: float = 0.9999
    patience: float = 1.0

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not math.isfinite(value) or value < 0.0:
                raise ParameterError("estimator", name, value, "a finite number >= 0")
        if not 0.0 < self.gate < 1.0:
            raise ParameterError("estimator", "gate", self.gate, "above 0 and below 1")
