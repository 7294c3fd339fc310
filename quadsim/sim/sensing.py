"""Sensors: samples of the true motion that arrive late, wrong or never, and faults of sensors.

    sample = truth + bias + random walk + noise,

taken every `stride` physics steps, heard `latency` later.  Errors are drawn here; the core adds the truth.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Annotated, Final

import numpy as np
from annotated_types import Ge, Le, Len, doc
from numpy.typing import NDArray

from quadsim.core.structs import SampleFault
from quadsim.fields import Fraction, NonNegative, Number
from quadsim.rotation import Vector3, quaternion_to_euler
from quadsim.sim.physics import PHYSICS, whole
from quadsim.state import Array

AXES: Final = (0, 1, 2)
Deviations = NonNegative | Annotated[tuple[NonNegative, ...], Len(3, 3)]
"""One standard deviation for all three axes, or one per axis."""
Offsets = Number | Annotated[tuple[Number, ...], Len(3, 3)]  # one offset for all three axes, or one per axis


class SensorName(StrEnum):
    """The measurable quantities, three numbers each."""

    POSITION = "position"  # x, y, z [m], world
    VELOCITY = "velocity"  # vx, vy, vz [m/s], world
    ATTITUDE = "attitude"
    """Roll, pitch, yaw [rad]; errors are rotation vectors in the body frame, q_measured = q * exp(error)."""
    RATES = "rates"  # p, q, r [rad/s], body: a rate gyro


KINDS: Final = {name: kind for kind, name in enumerate(SensorName)}
"""The sensors' numbers in the core."""


@dataclass(frozen=True, kw_only=True)
class Outliers:
    """Gross errors: samples whose noise is drawn from a wider distribution.

    The contaminated normal distribution (1 - probability) N(0, noise^2) + probability N(0, (size noise)^2), all axes
    together.  Huber, "Robust estimation of a location parameter", Annals of Mathematical Statistics 35 (1964), Sec. 1.
    """

    probability: Annotated[Fraction, doc("[-] probability of an outlier")]
    size: Annotated[float, Ge(1.0), Le(1e6), doc("[-] factor on the noise")]


@dataclass(frozen=True, kw_only=True)
class Sensor:
    """One sensor, in scenario files' unit of what it measures: m, m/s, deg or deg/s; see `in_si`.

    A sample taken at t = j / rate is value + bias + walk(t) + noise.  It arrives `delay` later, or is lost.  The
    variance of walk(t) is bias_walk^2 t.
    """

    rate: Annotated[
        float, Ge(0.01), Le(1e4), doc("[Hz] samples per second, the first at t = 0; a divisor of the physics rate")
    ]
    delay: Annotated[
        float, Ge(0.0), Le(10.0), doc("[s] from taking a sample to its arrival, a whole number of physics steps")
    ] = 0.0
    dropout: Annotated[Fraction, doc("[-] probability of a sample being lost")] = 0.0
    outliers: Annotated[Outliers | None, doc("absent: no outliers")] = None
    noise: Annotated[
        Deviations, doc("[the sensor's unit] standard deviation from sample to sample, one for all axes or x, y, z")
    ] = 0.0
    bias: Annotated[
        Offsets,
        doc("[the sensor's unit] constant offset, of attitude a rotation about the body axes; one or x, y, z"),
    ] = 0.0
    bias_walk: Annotated[Deviations, doc("[the sensor's unit/sqrt(s)] random walk of the offset, one or x, y, z")] = 0.0

    def stride(self, name: SensorName, timestep: float) -> int:
        """Return the physics steps between samples.

        Raises:
            ParameterError: the rate does not divide the physics rate.
        """
        rule = f"a divisor of the physics rate of {1.0 / timestep:g} Hz"
        return whole(f"sensors.{name}", "rate", self.rate, 1.0 / (self.rate * timestep), rule)

    def latency(self, name: SensorName, timestep: float) -> int:
        """Return the physics steps from a sample to its arrival.

        Raises:
            ParameterError: the delay is not a whole number of physics steps.
        """
        rule = f"a whole multiple of the physics step of {timestep} s"
        return whole(f"sensors.{name}", "delay", self.delay, self.delay / timestep, rule, smallest=0)


def in_si(name: SensorName, value: float | Sequence[float]) -> Vector3:
    """Return a number of a sensor's settings, or one per axis, as three in SI units."""
    if isinstance(value, float | int):
        x, y, z = [value] * 3
    else:
        x, y, z = value
    if name in (SensorName.ATTITUDE, SensorName.RATES):
        unit = math.radians(1.0)
    else:
        unit = 1.0
    return unit * x, unit * y, unit * z


class FaultKind(StrEnum):
    """The kinds of temporary sensor faults."""

    DROPOUT = "dropout"  # no samples
    FREEZE = "freeze"  # every sample repeats the last one before the fault
    NAN = "nan"  # samples are not numbers
    BIAS = "bias"  # an offset is added


@dataclass(frozen=True, kw_only=True)
class SensorFault:
    """A sensor's fault, for all samples taken at start <= t < stop."""

    sensor: SensorName  # the sensor
    kind: FaultKind  # the kind
    start: float  # [s]
    stop: float = math.inf  # [s]; infinite for a permanent fault
    axes: tuple[int, ...] = AXES  # indices of the numbers that become NaN
    offset: Vector3 = (0.0, 0.0, 0.0)
    """The offset, in the sensor's unit; a rotation vector in the body frame for attitude."""

    def window(self, timestep: float) -> tuple[int, int | None]:
        """Return the first physics step with the fault, and the first after it; None if it never ends."""
        first = math.ceil(self.start / timestep - 1e-6)  # rounding must not move an instant meant to be a step
        if math.isinf(self.stop):
            return first, None
        return first, math.ceil(self.stop / timestep - 1e-6)


SampleFlags = NDArray[np.bool_]
SampleFaults = NDArray[np.uint8]
"""What is wrong with each sample: sums of `SampleFault`s."""
StepIndices = NDArray[np.int64]


MEASURED: Final = {
    SensorName.POSITION: PHYSICS["position"],
    SensorName.VELOCITY: PHYSICS["velocity"],
    SensorName.ATTITUDE: PHYSICS["attitude"],
    SensorName.RATES: PHYSICS["body_rates"],
}
"""The columns of MuJoCo's state that each sensor measures."""


def truth(name: SensorName, physics: Array) -> Array:
    """Return a perfect sensor's samples (M, 3) of MuJoCo's states (M, 14)."""
    values = physics[:, MEASURED[name]]
    if name is SensorName.ATTITUDE:
        return quaternion_to_euler(values)
    return values.copy()


class Sampler:
    """Takes a sensor's samples; they are reproducible after a reset, however the time is cut into calls.

    Noise, bias, dropouts and outliers have separate random generators, so none changes another's draws.
    """

    def __init__(
        self,
        name: SensorName,
        sensor: Sensor,
        *,
        timestep: float,
        faults: tuple[SensorFault, ...],
        rng: np.random.Generator,
    ) -> None:
        self.name = name
        self._sensor = sensor
        self.stride = sensor.stride(name, timestep)
        self.latency = sensor.latency(name, timestep)
        self._noise = np.array(in_si(name, sensor.noise))
        self._bias = np.array(in_si(name, sensor.bias))
        self._step = np.array(in_si(name, sensor.bias_walk)) * math.sqrt(self.stride * timestep)
        self._timestep = timestep
        self.reschedule(faults)
        self._of_noise, self._of_bias, self._of_dropout, self._of_outliers = self._generators = rng.spawn(4)
        self._initial = [generator.bit_generator.state for generator in self._generators]
        self.reset()

    def reschedule(self, faults: Sequence[SensorFault]) -> None:
        """Replace the faults; those of other sensors are ignored."""
        own_faults = []
        for fault in faults:
            if fault.sensor is self.name:
                own_faults.append((fault, fault.window(self._timestep)))
        self._faults = tuple(own_faults)

    def reset(self) -> None:
        """Restart with the same draws."""
        for generator, state in zip(self._generators, self._initial, strict=True):
            generator.bit_generator.state = state
        self._walked: Array | None = None
        self._first = 0  # of the samples whose draws are kept
        self._errors = np.empty((0, 3))
        self._sample_faults = np.empty(0, np.uint8)

    def draw(self, first: int, count: int) -> tuple[Array, SampleFaults]:
        """Draw the errors (count, 3) of the samples from number `first` on, and what is wrong with each (count,).

        An attitude's error is a rotation vector in the body frame.  Calls follow one another from sample 0; one may
        begin with any sample of the call before, for faults that have been rescheduled since.
        """
        past = first - self._first
        self._first = first
        self._errors = self._errors[past:]
        self._sample_faults = self._sample_faults[past:]
        missing = count - len(self._errors)
        if missing > 0:
            errors = self._walk(missing) + self._draw_noise(missing) + 0.0  # turns -0 into 0
            lost = self._of_dropout.random(missing) < self._sensor.dropout
            self._errors = np.concatenate([self._errors, errors])
            self._sample_faults = np.concatenate(
                [self._sample_faults, lost.astype(np.uint8) * np.uint8(SampleFault.LOST)]
            )
        errors = self._errors[:count].copy()
        sample_faults = self._sample_faults[:count].copy()
        if not self._faults:
            return errors, sample_faults
        taken = self.stride * np.arange(first, first + count)
        for fault, window in self._faults:
            within = _within(taken, window)
            match fault.kind:
                case FaultKind.BIAS:
                    errors[within] += fault.offset
                case FaultKind.DROPOUT:
                    sample_faults[within] |= SampleFault.LOST
                case FaultKind.FREEZE:
                    sample_faults[within] |= SampleFault.FROZEN
                case FaultKind.NAN:
                    for axis in fault.axes:
                        sample_faults[within] |= SampleFault.NO_NUMBER << axis
        return errors, sample_faults

    def _walk(self, count: int) -> Array:
        """Return (count, 3) the bias at each sample: constant at the first of all, then a random walk."""
        steps = self._step * self._of_bias.standard_normal((count, 3))
        if self._walked is None:
            steps[0] = self._bias
        else:
            steps[0] += self._walked
        biases: Array = np.cumsum(steps, axis=0)
        self._walked = biases[-1]
        return biases

    def _draw_noise(self, count: int) -> Array:
        noise = self._noise * self._of_noise.standard_normal((count, 3))
        draws = self._of_outliers.random(count)
        outliers = self._sensor.outliers
        if outliers is not None:
            noise[draws < outliers.probability] *= outliers.size
        return noise


def _within(taken: StepIndices, window: tuple[int, int | None]) -> SampleFlags:
    start, stop = window
    if stop is None:
        return taken >= start
    return (taken >= start) & (taken < stop)
