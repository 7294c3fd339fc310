"""The error-state extended Kalman filter over time: samples in the order they were taken, however late they arrive.

The filter stands at the fusion horizon, now less the largest delay: every sample taken before has arrived and has been
used, in the order of the time stamps.  What has arrived since is stored, and each time an estimate is requested it is
used on copies that run on to now; so a late sample corrects the past it belongs to.  The copy after each of these
samples is kept, and is where the next estimate goes on from, until a sample arrives that was taken before it.  Rotor
speeds, and whether the vehicle stood, are stored likewise for each step since the horizon.
"""

from __future__ import annotations

import bisect
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from quadsim.errors import ParameterError
from quadsim.sim.error_state import (
    N_ERRORS,
    Drive,
    Estimate,
    EstimatorSettings,
    doubt,
    drive,
    lifts,
    motion_model,
    predict,
    retract,
    stand,
    update,
)
from quadsim.sim.sensing import AXES, Sample, Sensor, SensorName
from quadsim.state import Array
from quadsim.vehicle import Vehicle

LONGEST_STEP: Final = 0.01  # longest prediction at once [s]
NEEDED: Final = (SensorName.POSITION, SensorName.ATTITUDE)
"""Sensors without which position or heading would drift without bound."""
_NAMES: Final = list(SensorName)
_LARGEST: Final = 1e6  # A mean or a sample beyond this in magnitude [SI units], or not a number, is no information
_LARGEST_VARIANCE: Final = 1e15  # the same for the trace of a covariance


@dataclass(frozen=True, kw_only=True)
class Tally:
    """What became of one sensor's samples."""

    accepted: int = 0  # how many were used
    rejected: int = 0  # how many were refused: outside the gate, or not numbers
    nis: float = 0.0
    """Sum of the normalised innovations squared of those used; three each on average, where all is as stated."""


@dataclass(kw_only=True)
class _Track:
    """A filter at one instant; `refused` holds the step since which every sample of a sensor has been refused."""

    step: int
    estimate: Estimate
    refused: dict[SensorName, int] = field(default_factory=dict)
    tallies: dict[SensorName, Tally] = field(default_factory=dict)

    def branch(self) -> _Track:
        return _Track(step=self.step, estimate=self.estimate, refused=dict(self.refused), tallies=dict(self.tallies))

    def count(self, name: SensorName, *, accepted: int = 0, rejected: int = 0, nis: float = 0.0) -> None:
        """Add to a sensor's tally."""
        old = self.tallies[name]
        self.tallies[name] = Tally(
            accepted=old.accepted + accepted, rejected=old.rejected + rejected, nis=old.nis + nis
        )


class ErrorStateFilter:
    """Turns samples and rotor speeds into an estimate.  Never raises in flight, and never answers with NaN.

    Attributes:
        settings: its tuning.
    """

    def __init__(
        self, vehicle: Vehicle, sensors: Sequence[Sensor], settings: EstimatorSettings, *, timestep: float
    ) -> None:
        """Set up, to be reset before use, for the modelled vehicle and sensors and a physics step [s].

        Raises:
            ParameterError: a sensor is missing, or states a noise of zero.
        """
        from scipy.special import chdtri  # whose package takes a while to load, and few flights have an estimator

        names = [str(sensor.name) for sensor in sensors]
        for name in NEEDED:
            if name not in names:
                raise ParameterError("estimator", "sensors", names, f"such that {name} is among them")
        for sensor in sensors:
            if min(sensor.noise) <= 0.0:
                rule = "positive on every axis, for the estimator to weigh it"
                raise ParameterError(f"sensors.{sensor.name}", "noise", sensor.noise, rule)
        self.settings = settings
        self._timestep = timestep
        self._model = motion_model(vehicle, settings)
        self._variances = {sensor.name: np.diag(np.square(sensor.noise)) for sensor in sensors}
        self._horizon = max(sensor.latency(timestep) for sensor in sensors)
        self._gate = float(chdtri(len(AXES), 1.0 - settings.gate))
        self._patience = settings.patience / timestep
        self._stride = max(1, int(LONGEST_STEP / timestep + 1e-9))

    def reset(self, mean: Array, speeds: Array, rng: np.random.Generator) -> None:
        """Start at step 0, with rotor speeds (4,) in force [rad/s].

        The first estimate differs from the truth, a mean (16,) whose gyro bias is zero, by a drawn error of the initial
        covariance; the bias by what it is.
        """
        error = self._initial() * rng.standard_normal(N_ERRORS)
        error[12:] = 0.0
        estimate = Estimate(mean=retract(mean, error), covariance=np.diag(np.square(self._initial())))
        tallies = {name: Tally() for name in self._variances}
        self._track = _Track(step=0, estimate=estimate, tallies=tallies)
        self._starts, self._speeds, self._standing = [0], speeds.copy(), False
        self._drives: list[Drive | None] = [drive(self._model, speeds)]
        self._waiting: list[Sample] = []
        self._ahead: list[_Track] = []  # after each of the first that wait

    def _initial(self) -> Array:
        s = self.settings
        turned = map(math.radians, (s.initial_attitude, s.initial_rates, s.initial_gyro_bias))
        return np.repeat([s.initial_position, s.initial_velocity, *turned], 3)

    @property
    def tallies(self) -> dict[SensorName, Tally]:
        """What became of each sensor's samples, those after the fusion horizon not yet counted."""
        return dict(self._track.tallies)

    def advance(self, commands: Array, samples: Iterable[Sample], first: int, *, standing: bool = False) -> None:
        """Take note of a segment of flight and run the filter on to the fusion horizon.

        Args:
            commands: (M, 4) rotor speeds in force during each physics step [rad/s].
            samples: what has arrived meanwhile, in any order.
            first: number of the first of these physics steps.
            standing: whether a land detector has seen the vehicle on the ground when the segment began; it has left the
                ground once the modelled thrust exceeds its weight.
        """
        changed = np.any(commands != np.vstack([self._speeds, commands[:-1]]), axis=1)
        changed[:1] |= standing is not self._standing
        for i in np.flatnonzero(changed).tolist():
            driven = drive(self._model, commands[i])
            self._starts.append(first + i)
            self._drives.append(None if standing and not lifts(self._model, driven) else driven)
        if len(commands):
            self._speeds, self._standing = commands[-1].copy(), standing
        horizon = first + len(commands) - self._horizon
        before = self._waiting.copy()
        for sample in samples:
            if np.abs(sample.value).max() < _LARGEST:  # as NaN is not
                self._waiting.append(sample)
            else:
                for track in (self._track, *self._ahead):
                    track.count(sample.sensor, rejected=1)
        self._waiting.sort(key=lambda sample: (sample.taken, _NAMES.index(sample.sensor)))
        moved = (i for i, (one, other) in enumerate(zip(before, self._waiting, strict=False)) if one is not other)
        del self._ahead[next(moved, len(before)) :]
        ripe = bisect.bisect_right(self._waiting, horizon, key=lambda sample: sample.taken)
        used = min(ripe, len(self._ahead))
        if used:
            self._track = self._ahead[used - 1]
        for sample in self._waiting[used:ripe]:
            self._take(self._track, sample)
        del self._waiting[:ripe], self._ahead[:ripe]
        first = bisect.bisect_right(self._starts, self._track.step) - 1
        del self._starts[:first], self._drives[:first]

    def estimate(self, step: int) -> Estimate:
        """The estimate at a physics step, no earlier than the last one that was given."""
        track = self._ahead[-1] if self._ahead else self._track
        for sample in self._waiting[len(self._ahead) :]:
            track = track.branch()
            self._take(track, sample)
            self._ahead.append(track)
        track = track.branch()
        self._predict(track, step)
        return track.estimate

    def _take(self, track: _Track, sample: Sample) -> None:
        self._predict(track, sample.taken)
        self._use(track, sample)

    def _predict(self, track: _Track, step: int) -> None:
        while track.step < step:
            i = bisect.bisect_right(self._starts, track.step) - 1
            until = min(step, track.step + self._stride, *self._starts[i + 1 : i + 2])
            driven, duration = self._drives[i], (until - track.step) * self._timestep
            if driven is None:
                after = stand(self._model, track.estimate, duration)
            else:
                after = predict(self._model, track.estimate, driven, duration)
            size, spread = after.mean @ after.mean, after.covariance.trace()
            if not (size < _LARGEST**2 and spread < _LARGEST_VARIANCE):
                # Nothing is known any more: stay where it was, as unsure as at the start, and let the sensors speak.
                after = Estimate(mean=track.estimate.mean, covariance=np.diag(np.square(self._initial())))
            track.estimate, track.step = after, until

    def _use(self, track: _Track, sample: Sample) -> None:
        name = sample.sensor
        refused = sample.taken - track.refused.get(name, sample.taken)
        if refused >= self._patience > 0.0:
            track.estimate = doubt(track.estimate, name, sample.value, refused * self._timestep)
        after, distance = update(track.estimate, name, sample.value, self._variances[name], self._gate)
        if after is track.estimate:
            track.count(name, rejected=1)
            track.refused.setdefault(name, sample.taken)
            return
        track.estimate = after
        track.refused.pop(name, None)
        track.count(name, accepted=1, nis=distance)
