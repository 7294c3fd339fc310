"""What a sensor is: what it measures, how often, how well; and what can befall it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum
from typing import Annotated, Final

from annotated_types import Ge, Le, doc

from quadsim.errors import ParameterError
from quadsim.fields import Fraction
from quadsim.rotation import Vector

AXES: Final = (0, 1, 2)


class SensorName(StrEnum):
    """What can be measured, three numbers each."""

    POSITION = "position"  # x, y, z [m], world
    VELOCITY = "velocity"  # vx, vy, vz [m/s], world
    ATTITUDE = "attitude"
    """Roll, pitch, yaw [rad]; errors are rotation vectors in the body frame, q_measured = q * exp(error)."""
    RATES = "rates"  # p, q, r [rad/s], body: a rate gyro


@dataclass(frozen=True, kw_only=True)
class Outliers:
    """Gross errors: samples whose noise is drawn from a wider distribution.

    The contaminated normal distribution (1 - probability) N(0, noise^2) + probability N(0, (size noise)^2), all axes
    together.  Huber, "Robust estimation of a location parameter", Annals of Mathematical Statistics 35 (1964), Sec. 1.
    """

    probability: Annotated[Fraction, doc("[-] of a sample being one")]
    size: Annotated[float, Ge(1.0), Le(1e6), doc("[-] how many times the noise it has")]


@dataclass(frozen=True, kw_only=True)
class Sampling:
    """When a sensor's samples are taken, when they arrive, and which do not."""

    rate: Annotated[
        float, Ge(0.01), Le(1e4), doc("[Hz] samples per second, the first at t = 0; a divisor of the physics rate")
    ]
    delay: Annotated[
        float, Ge(0.0), Le(10.0), doc("[s] from taking a sample to its arrival, a whole number of physics steps")
    ] = 0.0
    dropout: Annotated[Fraction, doc("[-] probability of a sample being lost")] = 0.0
    outliers: Annotated[Outliers | None, doc("absent: none")] = None


@dataclass(frozen=True, kw_only=True)
class Sensor(Sampling):
    """One sensor, in the unit of its name (see `SensorName`).

    A sample taken at t = j / rate is value + bias + walk(t) + noise.  It arrives `delay` later, or never.
    """

    name: SensorName  # what is measured
    noise: Vector = (0.0, 0.0, 0.0)  # standard deviation per axis, white from sample to sample
    bias: Vector = (0.0, 0.0, 0.0)  # constant offset per axis
    bias_walk: Vector = (0.0, 0.0, 0.0)
    """The bias's random walk per axis [unit/sqrt(s)]: its variance grows by bias_walk^2 t."""

    def stride(self, timestep: float) -> int:
        """Physics steps from one sample to the next.

        Raises:
            ParameterError: the rate does not divide the physics rate.
        """
        rule = f"a divisor of the physics rate of {1.0 / timestep:g} Hz"
        return whole(f"sensors.{self.name}", "rate", self.rate, 1.0 / (self.rate * timestep), rule)

    def latency(self, timestep: float) -> int:
        """Physics steps from taking a sample to its arrival.

        Raises:
            ParameterError: the delay is not a whole number of physics steps.
        """
        rule = f"a whole multiple of the physics step of {timestep} s"
        return whole(f"sensors.{self.name}", "delay", self.delay, self.delay / timestep, rule, smallest=0)


class FaultKind(StrEnum):
    """What can befall a sensor for a while."""

    DROPOUT = "dropout"  # no samples
    FREEZE = "freeze"  # every sample repeats the last one that got through before
    NAN = "nan"  # samples are not numbers
    BIAS = "bias"  # an offset is added


@dataclass(frozen=True, kw_only=True)
class SensorFault:
    """A sensor's fault, for all samples taken at start <= t < stop."""

    sensor: SensorName  # which one
    kind: FaultKind  # what happens
    start: float  # [s]
    stop: float = math.inf  # [s]; infinite where it is permanent
    axes: tuple[int, ...] = AXES  # which of the three numbers become NaN
    offset: Vector = (0.0, 0.0, 0.0)
    """What is added, in the sensor's unit; a rotation vector in the body frame for attitude."""

    def window(self, timestep: float) -> tuple[int, int | None]:
        """First physics step that it holds at, and the first that it does not; None where it never ends."""
        first = math.ceil(self.start / timestep - 1e-6)  # an instant meant to be a step is one, whatever the rounding
        return first, math.ceil(self.stop / timestep - 1e-6) if math.isfinite(self.stop) else None


def whole(owner: str, name: str, value: float, count: float, rule: str, *, smallest: int = 1) -> int:
    """The whole number that a count of physics steps is, which follows from a parameter.

    Raises:
        ParameterError: it is none, or too small.
    """
    steps = round(count)
    if steps < smallest or not math.isclose(steps, count, rel_tol=1e-9, abs_tol=1e-9):
        raise ParameterError(owner, name, value, rule)
    return steps
