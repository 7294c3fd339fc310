"""Navigation: the state that a controller receives, from measurements of the true state.

Without an estimator it is the last sample of each sensor to arrive, with one the filter's estimate
(`quadsim.sim.estimator`).  The loop asks for it at each control instant, an autopilot at its own rate.
"""

from __future__ import annotations

import copy
import ctypes
from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from quadsim.core.mirror import Struct, core_library
from quadsim.core.structs import SAMPLE, SampleFault, SensingStruct, SensorStruct
from quadsim.errors import ParameterError
from quadsim.rotation import body_to_euler_rates, euler_to_quaternion
from quadsim.sim.estimator import (
    MEAN_GYRO_BIAS,
    MEAN_QUATERNION,
    MEAN_RATES,
    ErrorStateFilter,
    EstimatorSettings,
    Tally,
)
from quadsim.sim.physics import PHYSICS, PhysicsSteps, physics_to_state
from quadsim.sim.sensing import KINDS, MEASURED, Sampler, Sensor, SensorFault, SensorName, truth
from quadsim.state import ANGLE_RATES, ANGLES, INDEX, N_STATES, POSITIONS, VELOCITIES, Array, YawUnwrapper
from quadsim.vehicle import Vehicle

_AHEAD: Final = 2000
"""Physics steps whose samples are drawn ahead."""


class Navigation:
    """Sensors with or without an estimator.

    Without an estimator, the controller receives the last sample of each sensor to arrive, however old, and the true
    value where there is no sensor; until the first sample arrives, the true value at t = 0. With an estimator, it
    receives the estimate from the available sensors.

    Attributes:
        attitude: quaternion (4,), wxyz, body to world, sign continuous, and body rates (3,) [rad/s], of the last
            `state`.
        filter: the estimator; None without one.

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
        faulty = {fault.sensor for fault in faults}
        faulty -= sensors.keys()
        if estimator is not None and faulty:
            rule = f"on a sensor that the estimator has ({', '.join(sensors)})"
            raise ParameterError("fault", "sensor", str(min(faulty)), rule)
        sampled = dict(sensors)
        for name in sorted(faulty):  # of a perfect sensor
            sampled[name] = Sensor(rate=1.0 / timestep)
        self._timestep = timestep
        self._rng, *others = rng.spawn(1 + len(SensorName))
        generators = dict(zip(SensorName, others, strict=True))
        samplers = []
        for name, sensor in sampled.items():
            samplers.append(Sampler(name, sensor, timestep=timestep, faults=tuple(faults), rng=generators[name]))
        self._samplers = tuple(samplers)
        self.filter: ErrorStateFilter | None = None
        if estimator is not None:
            self.filter = ErrorStateFilter(vehicle, sensors, estimator, timestep=timestep)

    def has(self, sensor: SensorName) -> bool:
        """Whether a sensor takes samples, and so may fail."""
        return any(sampler.name is sensor for sampler in self._samplers)

    def reschedule(self, faults: Sequence[SensorFault]) -> None:
        """Replace the faults of the sensors that there are; samples already taken stay."""
        self._prepared = self._step + 1
        for k, (sampler, struct) in enumerate(zip(self._samplers, self._structs, strict=False)):
            sampler.reschedule(faults)
            taken = self._step // struct.stride + 1 - struct.first
            values, sample_faults = self._samples[k]
            self._samples[k] = values[:taken], sample_faults[:taken]

    def reset(self, physics: Array, speeds: Array, yaw: float = 0.0) -> None:
        """Restart at MuJoCo's state (14,) and rotor speeds [rad/s] with the same draws; yaw is near `yaw` [rad]."""
        self._step = 0
        self._yaw = YawUnwrapper(yaw)
        self._physics = physics.copy()
        self._prepared = 0  # physics steps for whose samples there is room
        self.attitude: tuple[Array, Array] = physics[PHYSICS["attitude"]].copy(), physics[PHYSICS["body_rates"]].copy()
        samplers = self._samplers
        self._structs = (SensorStruct * max(len(samplers), 1))()
        self._sensing = SensingStruct(sensors=ctypes.addressof(self._structs), count=len(samplers))
        self._sensing.attitude[:], self._sensing.rates[:] = self.attitude
        self._samples = [(np.empty((0, 3)), np.empty(0, np.uint8)) for _ in samplers]
        self._passed = [0] * len(samplers)  # samples that the filter has
        for sampler, struct in zip(samplers, self._structs, strict=False):
            sampler.reset()
            struct.kind = KINDS[sampler.name]
            struct.stride = sampler.stride
            struct.latency = sampler.latency
            struct.held[:] = truth(sampler.name, physics[None])[0]
        if self.filter is not None:
            names = ("position", "velocity", "attitude", "body_rates")
            known = [physics[PHYSICS[name]] for name in names]
            self.filter.reset(np.concatenate([*known, np.zeros(3)]), speeds, copy.deepcopy(self._rng))
        self._prepare(1)
        motion = np.ascontiguousarray(physics[1:])
        core_library().quadsim_sense(self._sensing, 0, motion.ctypes.data)
        self._hear(0, physics)
        if self.filter is not None:
            self.filter.advance(np.empty((0, len(speeds))), self._arrived())

    def begin(self, steps: int) -> Struct:
        """Draw the errors of the samples of the next physics steps; return what takes them."""
        self._prepare(self._step + 1 + steps)
        return self._sensing

    def record(self, flown: PhysicsSteps, *, on_ground: bool = False) -> None:
        """Record the flight since `begin`; `on_ground` is the land detector's state at its start."""
        if not len(flown):
            return
        self._step = self._step + len(flown)
        self._physics = flown["physics"][-1].copy()
        self._hear(self._step, self._physics)
        if self.filter is not None:
            self.filter.advance(flown["commands"], self._arrived(), on_ground=on_ground)

    def sensed(self, physics: Array) -> tuple[Array, Array]:
        """What an autopilot measures at MuJoCo's state (14,): attitude (4,), wxyz, body to world, body rates [rad/s].

        The newest finite sample of each sensor, the true value where there is none; with an estimator, rates less the
        bias that it estimated at the last control instant.
        """
        self._hear(round(float(physics[0]) / self._timestep), physics)
        return np.array(self._sensing.attitude), np.array(self._sensing.rates)

    def state(self) -> Array:
        """Return (12,) the state that the controller receives now: the paper's order, yaw unwrapped."""
        row = self._physics.copy()
        angles = None
        if self.filter is not None:
            mean, _ = self.filter.estimate()
            self._sensing.bias[:] = mean[MEAN_GYRO_BIAS]
            row[1:] = np.concatenate([mean[0:3], mean[MEAN_QUATERNION], mean[3:6], mean[MEAN_RATES]])
        else:
            for sampler, struct in zip(self._samplers, self._structs, strict=False):
                if sampler.name is SensorName.ATTITUDE:
                    angles = np.array(struct.held)
                    row[PHYSICS["attitude"]] = euler_to_quaternion(angles)
                else:
                    row[MEASURED[sampler.name]] = struct.held
        quaternion = row[PHYSICS["attitude"]]
        rates = row[PHYSICS["body_rates"]]
        sign = 1.0
        if quaternion @ self.attitude[0] < 0.0:
            sign = -1.0
        self.attitude = sign * quaternion, rates
        if angles is None:
            state: Array = physics_to_state(row[None])[0]
        else:  # as they were measured: one that is no number leaves the others alone
            state = np.empty(N_STATES)
            state[POSITIONS] = row[PHYSICS["position"]]
            state[VELOCITIES] = row[PHYSICS["velocity"]]
            state[ANGLES] = angles
            state[ANGLE_RATES] = body_to_euler_rates(angles, rates)
        state[INDEX["yaw"]] = self._yaw.unwrapped(state[ANGLES])
        return state

    @property
    def tallies(self) -> dict[SensorName, Tally]:
        """Counts of each sensor's samples in the estimator; empty without one."""
        if self.filter is None:
            return {}
        return self.filter.tallies

    def _prepare(self, stop: int) -> None:
        """Make room for the samples taken before a physics step, with their errors; drop those no longer needed.

        Room is made for many steps ahead, as each draw of random numbers has a price.
        """
        if stop <= self._prepared:
            return
        start = self._prepared
        stop = stop + _AHEAD
        self._prepared = stop
        for k, sampler in enumerate(self._samplers):
            struct = self._structs[k]
            values, sample_faults = self._samples[k]
            first = -(-start // struct.stride)
            end = -(-stop // struct.stride)
            heard = struct.heard
            if self.filter is not None:
                heard = min(heard, self._passed[k])
            drop = max(min(heard, first) - struct.first, 0)
            errors, fresh = sampler.draw(first, end - first)
            values = np.concatenate([values[drop:], errors])
            sample_faults = np.concatenate([sample_faults[drop:], fresh])
            self._samples[k] = (values, sample_faults)
            struct.first = struct.first + drop
            struct.values = values.ctypes.data
            struct.faults = sample_faults.ctypes.data

    def _hear(self, step: int, physics: Array) -> None:
        """Hold the newest sample of each sensor to arrive by a physics step, at MuJoCo's state (14,)."""
        motion = np.ascontiguousarray(physics[1:])
        core_library().quadsim_hear(self._sensing, step, motion.ctypes.data)

    def _arrived(self) -> list[NDArray[np.void]]:
        """Return the samples that have arrived since the last call, without lost ones."""
        arrived = []
        for k, (values, sample_faults) in enumerate(self._samples):
            struct = self._structs[k]
            passed = self._passed[k]
            last = (self._step - struct.latency) // struct.stride + 1
            if last <= passed:
                continue
            rows = slice(passed - struct.first, last - struct.first)
            fresh = np.empty(last - passed, SAMPLE)
            fresh["taken"] = struct.stride * np.arange(passed, last)
            fresh["kind"] = struct.kind
            fresh["value"] = values[rows]
            arrived.append(fresh[sample_faults[rows] & SampleFault.LOST == 0])
            self._passed[k] = last
        return arrived
