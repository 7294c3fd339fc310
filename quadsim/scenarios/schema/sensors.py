"""`[sensors.position]` and the other sensors, and `[estimator]`: which state a controller receives.

`quadsim.sim.sensing` samples the sensors and `quadsim.sim.estimator` filters the samples.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from annotated_types import doc

from quadsim.errors import ParameterError
from quadsim.sim.estimator import EstimatorSettings
from quadsim.sim.sensing import Sensor, SensorName


@dataclass(frozen=True, kw_only=True)
class Sensors:
    """Sensors of the state; without an estimator a missing sensor is perfect, with one it is absent.

    Numbers to start from:

    - Satellite navigation, as PX4's EKF2 takes it (defaults of `EKF2_GPS_P_NOISE`, `EKF2_GPS_V_NOISE`,
      `EKF2_GPS_DELAY`): position 0.5 m, velocity 0.3 m/s, both 0.11 s late.
    - Motion capture, as the Crazyflie's firmware takes it (`extPosStdDev`, `extQuatStdDev` of its localization
      service): position 0.01 m, attitude 4.5e-3 rad = 0.26 deg.
    - A MEMS rate gyro, the ADIS16448 as RotorS has it (`gazebo_imu_plugin.h`; Furrer et al., "RotorS", 2016): white
      noise of 2 x 35 / 3600 = 0.0194 deg/s/sqrt(Hz), so 0.0194 sqrt(rate) deg/s per sample, bias walk
      2 x 4 / 3600 = 0.0022 deg/s/sqrt(s), bias when switched on 0.5 deg/s (one standard deviation).
    """

    position: Annotated[Sensor | None, doc("[m] world frame: satellite navigation or motion capture")] = None
    velocity: Annotated[Sensor | None, doc("[m/s] world frame")] = None
    attitude: Annotated[
        Sensor | None, doc("[deg] roll, pitch, yaw, with errors that are small rotations about the body axes")
    ] = None
    rates: Annotated[Sensor | None, doc("[deg/s] body rates p, q, r: a rate gyro")] = None

    def present(self) -> dict[SensorName, Sensor]:
        """Return the sensors of the scenario."""
        present = {}
        for name in SensorName:
            sensor = getattr(self, name.value)
            if sensor is not None:
                present[name] = sensor
        return present


@dataclass(frozen=True, kw_only=True)
class EstimatorSpec(EstimatorSettings):
    """An error-state Kalman filter from the sensors and the modelled vehicle; see `quadsim.sim.estimator`."""

    type: Annotated[Literal["error_state"], doc("kind of estimator")]


def check_sensing(sensors: Sensors | None, estimator: EstimatorSpec | None, *, timestep: float) -> None:
    """Refuse sensors that do not fit the physics step, or that an estimator cannot work with.

    Raises:
        ValueError: the message starts with the field's name.
    """
    present: dict[SensorName, Sensor] = {}
    if sensors is not None:
        present = sensors.present()
    for name, sensor in present.items():
        try:
            sensor.stride(name, timestep)
            sensor.latency(name, timestep)
        except ParameterError as error:
            raise ValueError(str(error)) from None
        if estimator is not None and not np.all(np.array(sensor.noise) > 0.0):
            noise: object = sensor.noise
            if isinstance(noise, tuple):
                noise = list(noise)
            raise ValueError(
                f"sensors.{name}.noise must be positive, for the estimator to weigh its samples; got {noise}"
            )
    if estimator is None:
        return
    for name in (SensorName.POSITION, SensorName.ATTITUDE):
        if name not in present:
            names = [str(sensor_name) for sensor_name in present]
            raise ValueError(f"estimator must have sensors.{name} to work with; got {names}")
