"""A sensor at work: from the true motion to samples that arrive late, wrong or never."""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from quadsim.rotation import exponential, multiply, quaternion_to_euler
from quadsim.sim.sensing.sensor import FaultKind, Sensor, SensorFault, SensorName
from quadsim.state import Array

_COLUMNS = {
    SensorName.POSITION: slice(1, 4),
    SensorName.VELOCITY: slice(8, 11),
    SensorName.ATTITUDE: slice(4, 8),
    SensorName.RATES: slice(11, 14),
}
"""Where a sensor's quantity is in MuJoCo's state; see `quadsim.sim.physics.physics_to_state`."""

Flags = NDArray[np.bool_]
Steps = NDArray[np.int64]


class Sample(NamedTuple):
    """One sample."""

    sensor: SensorName  # whose
    taken: int  # physics step at which it was taken, its time stamp
    arrival: int  # physics step from which it is known
    value: Array  # (3,) in the unit of the sensor's name


def truth(name: SensorName, physics: Array) -> Array:
    """A perfect sensor's samples (M, 3) of MuJoCo's states (M, 14)."""
    values = physics[:, _COLUMNS[name]]
    return quaternion_to_euler(values) if name is SensorName.ATTITUDE else values.copy()


class Sampler:
    """Takes a sensor's samples; the same ones again after a reset, however the time is cut into calls.

    Noise, bias, dropouts and outliers each draw from a generator of their own, so none changes another's draws.
    """

    def __init__(
        self, sensor: Sensor, *, timestep: float, faults: tuple[SensorFault, ...], rng: np.random.Generator
    ) -> None:
        self.sensor = sensor
        self._stride = sensor.stride(timestep)
        self._latency = sensor.latency(timestep)
        self._noise, self._bias = np.array(sensor.noise), np.array(sensor.bias)
        self._step = np.array(sensor.bias_walk) * math.sqrt(self._stride * timestep)
        self._timestep = timestep
        self.reschedule(faults)
        self._initial = tuple(rng.spawn(4))
        self.reset()

    @property
    def watched(self) -> bool:
        """Whether it knows of any fault, and so what a frozen sensor would repeat."""
        return bool(self._faults)

    def reschedule(self, faults: Sequence[SensorFault]) -> None:
        """Let these faults, of this sensor and others, take the place of those before."""
        of_this = (fault for fault in faults if fault.sensor is self.sensor.name)
        self._faults = tuple((fault, fault.window(self._timestep)) for fault in of_this)

    def reset(self) -> None:
        """Start again, with the same draws."""
        self._of_noise, self._of_bias, self._of_dropout, self._of_outliers = copy.deepcopy(self._initial)
        self._walked: Array | None = None
        self._through: Array | None = None

    def sample(self, physics: Array, first: int) -> list[Sample]:
        """The samples taken during a segment of motion, those lost left out.

        Of MuJoCo's states (M, 14) at successive physics steps, the first of number `first`; segments follow one another
        from step 0.
        """
        begin = -first % self._stride
        rows = physics[begin :: self._stride]
        count = len(rows)
        if not count:
            return []
        taken = np.arange(first + begin, first + len(physics), self._stride)
        errors = self._walk(count) + self._draw_noise(count) + 0.0  # which leaves no -0
        lost = self._of_dropout.random(count) < self.sensor.dropout
        befallen = [(fault, _within(taken, window)) for fault, window in self._faults]
        offset, frozen = np.zeros((count, 3)), np.zeros(count, dtype=bool)
        for fault, held in befallen:
            match fault.kind:
                case FaultKind.BIAS:
                    offset[held] += fault.offset
                case FaultKind.DROPOUT:
                    lost |= held
                case FaultKind.FREEZE:
                    frozen |= held
        values = self._measure(rows, errors + offset)
        if befallen:
            for value, gone, stuck in zip(values, lost, frozen, strict=True):
                if stuck and self._through is not None:
                    value[:] = self._through
                elif not gone:
                    self._through = value.copy()
        for fault, held in befallen:
            if fault.kind is FaultKind.NAN:
                values[np.ix_(np.flatnonzero(held), np.array(fault.axes))] = np.nan
        name, latency = self.sensor.name, self._latency
        return [
            Sample(name, step, step + latency, value)
            for step, value, gone in zip(taken.tolist(), values, lost.tolist(), strict=True)
            if not gone
        ]

    def _walk(self, count: int) -> Array:
        """(count, 3) bias at each sample: its constant at the first of all, then a random walk."""
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
        draws, outliers = self._of_outliers.random(count), self.sensor.outliers
        if outliers is not None:
            noise[draws < outliers.probability] *= outliers.size
        return noise

    def _measure(self, rows: Array, errors: Array) -> Array:
        name = self.sensor.name
        if name is not SensorName.ATTITUDE:
            return rows[:, _COLUMNS[name]] + errors
        turned = [
            multiply((w, x, y, z), exponential((a, b, c)))
            for (w, x, y, z), (a, b, c) in zip(rows[:, _COLUMNS[name]].tolist(), errors.tolist(), strict=True)
        ]
        return quaternion_to_euler(np.array(turned))


def _within(taken: Steps, window: tuple[int, int | None]) -> Flags:
    start, stop = window
    return (taken >= start) & ((taken < stop) if stop is not None else True)
