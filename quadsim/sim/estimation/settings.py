"""Settings of the estimator: process noise, initial covariance, rejection of outliers."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from annotated_types import Gt, Lt, doc

from quadsim.fields import NonNegative


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
