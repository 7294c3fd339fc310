"""`[sensors.position]` and the other sensors, and `[estimator]`.

Numbers to start from:

- Satellite navigation, as PX4's EKF2 takes it (defaults of `EKF2_GPS_P_NOISE`, `EKF2_GPS_V_NOISE`, `EKF2_GPS_DELAY`):
  position 0.5 m, velocity 0.3 m/s, both 0.11 s late.
- Motion capture, as the Crazyflie's firmware takes it (`extPosStdDev`, `extQuatStdDev` of its localization
  service): position 0.01 m, attitude 4.5e-3 rad = 0.26 deg.
- A MEMS rate gyro, the ADIS16448 as RotorS has it (`gazebo_imu_plugin.h`; Furrer et al., "RotorS", 2016): white noise
  of 2 x 35 / 3600 = 0.0194 deg/s/sqrt(Hz), so 0.0194 sqrt(rate) deg/s per sample, bias walk 2 x 4 / 3600 = 0.0022
  deg/s/sqrt(s), bias when switched on 0.5 deg/s (one standard deviation).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from annotated_types import Len, doc

from quadsim.errors import ParameterError
from quadsim.fields import NonNegative, Number, Vector
from quadsim.sim.error_state import EstimatorSettings
from quadsim.sim.sensing import Sampling, Sensor, SensorName

Deviations = NonNegative | Annotated[tuple[NonNegative, ...], Len(3, 3)]
"""One standard deviation for all three axes, or one per axis."""
Offsets = Number | Vector  # one offset for all three axes, or one per axis


@dataclass(frozen=True, kw_only=True)
class PositionSpec(Sampling):
    """Position, world frame: satellite navigation or motion capture."""

    noise: Annotated[Deviations, doc("[m] standard deviation, one for all axes or x, y, z")] = 0.0
    bias: Annotated[Offsets, doc("[m] constant offset, one for all axes or x, y, z")] = 0.0
    bias_walk: Annotated[Deviations, doc("[m/sqrt(s)] random walk of the offset")] = 0.0


@dataclass(frozen=True, kw_only=True)
class VelocitySpec(Sampling):
    """Velocity, world frame."""

    noise: Annotated[Deviations, doc("[m/s] standard deviation, one for all axes or x, y, z")] = 0.0
    bias: Annotated[Offsets, doc("[m/s] constant offset, one for all axes or x, y, z")] = 0.0
    bias_walk: Annotated[Deviations, doc("[m/s/sqrt(s)] random walk of the offset")] = 0.0


@dataclass(frozen=True, kw_only=True)
class AttitudeSpec(Sampling):
    """Roll, pitch and yaw, with errors that are small rotations about the body axes."""

    noise: Annotated[Deviations, doc("[deg] standard deviation, one for all body axes or x, y, z")] = 0.0
    bias: Annotated[Offsets, doc("[deg] constant rotation, one for all body axes or x, y, z")] = 0.0
    bias_walk: Annotated[Deviations, doc("[deg/sqrt(s)] random walk of that rotation")] = 0.0


@dataclass(frozen=True, kw_only=True)
class RatesSpec(Sampling):
    """Body rates p, q, r: a rate gyro."""

    noise: Annotated[Deviations, doc("[deg/s] standard deviation, one for all body axes or x, y, z")] = 0.0
    bias: Annotated[Offsets, doc("[deg/s] constant offset, one for all body axes or x, y, z")] = 0.0
    bias_walk: Annotated[Deviations, doc("[deg/s/sqrt(s)] random walk of the offset")] = 0.0


AnySensorSpec = PositionSpec | VelocitySpec | AttitudeSpec | RatesSpec


@dataclass(frozen=True, kw_only=True)
class SensorsSpec:
    """Sensors of the state; without an estimator a missing sensor is perfect, with one it is absent."""

    position: Annotated[PositionSpec | None, doc("[m] in the world frame")] = None
    velocity: Annotated[VelocitySpec | None, doc("[m/s] in the world frame")] = None
    attitude: Annotated[AttitudeSpec | None, doc("[deg] roll, pitch, yaw")] = None
    rates: Annotated[RatesSpec | None, doc("[deg/s] body rates")] = None

    def present(self) -> dict[SensorName, AnySensorSpec]:
        """Return the sensors of the scenario."""
        named = {name: getattr(self, name.value) for name in SensorName}
        return {name: spec for name, spec in named.items() if spec is not None}


@dataclass(frozen=True, kw_only=True)
class EstimatorSpec(EstimatorSettings):
    """An error-state Kalman filter from the sensors and the modelled vehicle; see `quadsim.sim.estimator`."""

    type: Annotated[Literal["error_state"], doc("kind of estimator")]


def check_sensing(sensors: SensorsSpec | None, estimator: EstimatorSpec | None, *, timestep: float) -> None:
    """Refuse sensors that do not fit the physics step, or that an estimator cannot work with.

    Raises:
        ValueError: the message starts with the field's name.
    """
    present = {} if sensors is None else sensors.present()
    for name, spec in present.items():
        probe = Sensor(name=name, rate=spec.rate, delay=spec.delay)
        try:
            probe.stride(timestep)
            probe.latency(timestep)
        except ParameterError as error:
            raise ValueError(str(error)) from error
        noise = [*spec.noise] if isinstance(spec.noise, tuple) else spec.noise
        if estimator is not None and not np.all(np.array(noise) > 0.0):
            raise ValueError(
                f"sensors.{name}.noise must be positive, for the estimator to weigh its samples; got {noise}"
            )
    missing = [name for name in (SensorName.POSITION, SensorName.ATTITUDE) if name not in present]
    if estimator is not None and missing:
        raise ValueError(f"estimator must have sensors.{missing[0]} to work with; got {[str(n) for n in present]}")
