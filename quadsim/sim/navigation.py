"""Navigation: the state that a controller receives, from measurements of the true state."""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from operator import attrgetter

import numpy as np

from quadsim.errors import ParameterError
from quadsim.rotation import body_to_euler_rates, euler_to_quaternion, quaternion_to_euler
from quadsim.sim.error_state import MEAN_GYRO_BIAS, MEAN_QUATERNION, MEAN_RATES, EstimatorSettings
from quadsim.sim.estimator import ErrorStateFilter, Tally
from quadsim.sim.physics import PHYSICS
from quadsim.sim.sensing import Sample, Sampler, Sensor, SensorFault, SensorName, truth
from quadsim.state import ANGLE_RATES, ANGLES, N_STATES, POSITIONS, VELOCITIES, Array, YawTurns
from quadsim.vehicle import Vehicle


class Navigation:
    """Sensors with or without an estimator.

    Without an estimator, the controller receives the last sample of each sensor to arrive, however old, and the true
    value where there is no sensor; until the first sample arrives, the true value at t = 0. With an estimator, it
    receives the estimate from the available sensors.

    Attributes:
        attitude: quaternion (4,), wxyz, body to world, sign continuous, and body rates (3,) [rad/s], of the last
            `state`.

    Each sensor has its own random generator, so that adding a sensor, or noise, does not change the others' draws.
    """

    def __init__(
        self,
        vehicle: Vehicle,
        *,
        timestep: float,
        sensors: Mapping[SensorName, Sensor],
        rng: np.random.Generator,
        faults: Sequence[SensorFault] = (),
        estimator: EstimatorSettings | None = None,
    ) -> None:
        """Set up, to be reset before use.

        Args:
            vehicle: the modelled vehicle.
            timestep: physics step [s].
            sensors: the sensors; without an estimator, missing ones are perfect.
            rng: the source of all randomness.
            faults: faults of the sensors, including perfect ones.
            estimator: settings of the error-state filter, or None.

        Raises:
            ParameterError: times that are no whole physics steps, a fault of a sensor that is not there, or sensors
                that the estimator cannot work with.
        """
        faulty = {fault.sensor for fault in faults} - sensors.keys()
        if estimator is not None and faulty:
            rule = f"on a sensor that the estimator has ({', '.join(sensors)})"
            raise ParameterError("fault", "sensor", str(min(faulty)), rule)
        perfect = {name: Sensor(rate=1.0 / timestep) for name in sorted(faulty)}
        self._rng, *others = rng.spawn(1 + len(SensorName))
        generators = dict(zip(SensorName, others, strict=True))
        self._samplers = tuple(
            Sampler(name, sensor, timestep=timestep, faults=tuple(faults), rng=generators[name])
            for name, sensor in {**sensors, **perfect}.items()
        )
        sensed = {sampler.name for sampler in self._samplers}
        self._perfect = tuple(name for name in SensorName if name not in sensed)
        self._filter = None if estimator is None else ErrorStateFilter(vehicle, sensors, estimator, timestep=timestep)

    def watches(self, sensor: SensorName) -> bool:
        """Whether a sensor has had a fault in view from the start, and so may have another."""
        return any(sampler.watched for sampler in self._samplers if sampler.name is sensor)

    def reschedule(self, faults: Sequence[SensorFault]) -> None:
        """Replace the faults of watched sensors; samples already taken stay."""
        for sampler in self._samplers:
            sampler.reschedule(faults)

    def reset(self, physics: Array, speeds: Array, yaw: float = 0.0) -> None:
        """Restart at MuJoCo's state (14,) and rotor speeds [rad/s] with the same draws; yaw is near `yaw` [rad]."""
        self._step, self._yaw, self._physics = 0, YawTurns(yaw), physics.copy()
        self.attitude: tuple[Array, Array] = physics[PHYSICS["attitude"]].copy(), physics[PHYSICS["body_rates"]].copy()
        self._held = {name: truth(name, physics[None])[0] for name in SensorName}
        self._bias, self._sensed = np.zeros(3), self.attitude
        self._in_flight: list[Sample] = []
        for sampler in self._samplers:
            sampler.reset()
        if self._filter is not None:
            known = [physics[PHYSICS[name]] for name in ("position", "velocity", "attitude", "body_rates")]
            mean = np.concatenate([*known, np.zeros(3)])
            self._filter.reset(mean, speeds, copy.deepcopy(self._rng))
        self._receive(physics[None], first=0)
        if self._filter is not None:
            self._filter.advance(np.empty((0, len(speeds))), self._hear(), first=0)

    def advance(self, physics: Array, commands: Array, *, on_ground: bool = False) -> None:
        """Record a segment of flight: (M, 14) true states after each physics step, (M, 4) rotor speeds [rad/s].

        `on_ground` is the land detector's state at the start of the segment.
        """
        if not len(physics):
            return
        first, self._step, self._physics = self._step, self._step + len(physics), physics[-1].copy()
        self._receive(physics, first + 1)
        if self._filter is not None:
            self._filter.advance(commands, self._hear(), first, on_ground=on_ground)

    def sensed(self) -> tuple[Array, Array]:
        """What an autopilot measures now: attitude (4,), wxyz, body to world, and body rates (3,) [rad/s].

        The newest finite sample of each sensor, the true value where there is none; with an estimator, rates less their
        last estimated bias, and the attitude that it estimates where no sensor measures it.
        """
        if self._filter is None:
            self._hear()
        attitude, rates = self._physics[PHYSICS["attitude"]], self._physics[PHYSICS["body_rates"]]
        if SensorName.RATES not in self._perfect:
            rates = self._held[SensorName.RATES] - self._bias
        if SensorName.ATTITUDE not in self._perfect:
            attitude = euler_to_quaternion(self._held[SensorName.ATTITUDE])
        elif self._filter is not None:
            attitude = self._filter.estimate(self._step).mean[MEAN_QUATERNION]
        pairs = zip((attitude, rates), self._sensed, strict=True)
        new, rate = (now if np.isfinite(now).all() else before for now, before in pairs)
        self._sensed = new, rate
        return self._sensed

    def state(self) -> Array:
        """Return (12,) the state that the controller receives now: the paper's order, yaw unwrapped."""
        if self._filter is not None:
            mean = self._filter.estimate(self._step).mean
            self._bias = mean[MEAN_GYRO_BIAS].copy()
            received = {
                SensorName.POSITION: mean[0:3],
                SensorName.VELOCITY: mean[3:6],
                SensorName.ATTITUDE: quaternion_to_euler(mean[MEAN_QUATERNION]),
                SensorName.RATES: mean[MEAN_RATES],
            }
        else:
            self._hear()
            received = self._held | {name: truth(name, self._physics[None])[0] for name in self._perfect}
        euler = received[SensorName.ATTITUDE].copy()
        quaternion = euler_to_quaternion(euler) if self._filter is None else mean[MEAN_QUATERNION]
        sign = -1.0 if quaternion @ self.attitude[0] < 0.0 else 1.0
        self.attitude = sign * quaternion, received[SensorName.RATES].copy()
        state = np.empty(N_STATES)
        state[POSITIONS] = received[SensorName.POSITION]
        state[VELOCITIES] = received[SensorName.VELOCITY]
        state[ANGLE_RATES] = body_to_euler_rates(euler, received[SensorName.RATES])
        euler[2] = self._yaw.unwrapped(euler)
        state[ANGLES] = euler
        return state

    @property
    def tallies(self) -> dict[SensorName, Tally]:
        """Counts of each sensor's samples in the estimator; empty without one."""
        return {} if self._filter is None else self._filter.tallies

    def _receive(self, physics: Array, first: int) -> None:
        for sampler in self._samplers:
            self._in_flight += sampler.sample(physics, first)

    def _hear(self) -> list[Sample]:
        """Hold the newest value of each sensor, and return the samples that have arrived since the last call."""
        arrived = self._arrived()
        for sample in arrived:
            self._held[sample.sensor] = sample.value
        return arrived

    def _arrived(self) -> list[Sample]:
        """Return the samples that have arrived since the last call, oldest first; the others stay in transit."""
        arrived = [sample for sample in self._in_flight if sample.arrival <= self._step]
        self._in_flight = [sample for sample in self._in_flight if sample.arrival > self._step]
        return sorted(arrived, key=attrgetter("taken"))
