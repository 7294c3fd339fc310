"""The error-state extended Kalman filter over time: it uses samples in the order they were taken, however late.

The filter runs at the fusion horizon, now less the largest delay: every sample taken before it has arrived and has been
used, in the order of time stamps.  Later samples are stored; each request for an estimate uses them on copies that run
up to now, so a late sample corrects the past it belongs to.  The copies after these samples are kept as starting points
of the next estimate, until a sample arrives that was taken earlier.  Rotor speeds, and contact with the ground, are
stored for each step since the horizon as well.
"""

from __future__ import annotations

import bisect
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from quadsim.errors import ParameterError
from quadsim.sim.error_state import (
    N_ERRORS,
    Drive,
    Estimate,
    EstimatorSettings,
    drive,
    inflate,
    lifts,
    motion_model,
    predict_estimate,
    retract,
    stand,
    update,
)
from quadsim.sim.sensing import AXES, Sample, Sensor, SensorName, in_si
from quadsim.state import Array
from quadsim.vehicle import Vehicle

LONGEST_STEP: Final = 0.01  # longest single prediction [s]
NEEDED: Final = (SensorName.POSITION, SensorName.ATTITUDE)
"""Sensors without which position or heading would drift without bound."""
_NAMES: Final = list(SensorName)
_LARGEST: Final = 1e6  # A mean or sample above this magnitude [SI units], or not a number, carries no information
_LARGEST_VARIANCE: Final = 1e15  # the same for the trace of a covariance


@dataclass(frozen=True, kw_only=True)
class Tally:
    """Counts of one sensor's samples."""

    accepted: int = 0  # used
    rejected: int = 0  # rejected: outside the gate, or not numbers
    nis: float = 0.0
    """Sum of the normalised innovations squared of those used; on average three per sample with a correct model."""


@dataclass(kw_only=True)
class _Track:
    """A filter at one instant; `refused` is the step since which every sample of a sensor has been rejected."""

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
    """Turns samples and rotor speeds into an estimate.  It never raises in flight and never returns NaN.

    Attributes:
        settings: its tuning.
    """

    def __init__(
        self, vehicle: Vehicle, sensors: Mapping[SensorName, Sensor], settings: EstimatorSettings, *, timestep: float
    ) -> None:
        """Prepare for the modelled vehicle, sensors and a physics step [s]; call `reset` before use.

        Raises:
            ParameterError: a sensor is missing, or has a noise of zero.
        """
        from scipy.special import chdtri  # whose package takes a while to load, and few flights have an estimator

        for name in NEEDED:
            if name not in sensors:
                raise ParameterError("estimator", "sensors", [*map(str, sensors)], f"such that {name} is among them")
        noises = {name: in_si(name, sensor.noise) for name, sensor in sensors.items()}
        for name, noise in noises.items():
            if min(noise) <= 0.0:
                rule = "positive on every axis, for the estimator to weigh it"
                raise ParameterError(f"sensors.{name}", "noise", sensors[name].noise, rule)
        self.settings = settings
        self._timestep = timestep
        self._model = motion_model(vehicle, settings)
        self._variances = {name: np.diag(np.square(noise)) for name, noise in noises.items()}
        self._horizon = max(sensor.latency(name, timestep) for name, sensor in sensors.items())
        self._gate = float(chdtri(len(AXES), 1.0 - settings.gate))
        self._patience = settings.patience / timestep
        self._stride = max(1, int(LONGEST_STEP / timestep + 1e-9))

    def reset(self, mean: Array, speeds: Array, rng: np.random.Generator) -> None:
        """Start at step 0, with rotor speeds (4,) in force [rad/s].

        The first estimate differs from the truth, a mean (16,) with zero gyro bias, by an error drawn from the initial
        covariance; its bias by the true bias.
        """
        error = self._initial() * rng.standard_normal(N_ERRORS)
        error[12:] = 0.0
        estimate = Estimate(mean=retract(mean, error), covariance=np.diag(np.square(self._initial())))
        tallies = {name: Tally() for name in self._variances}
        self._track = _Track(step=0, estimate=estimate, tallies=tallies)
        self._starts, self._speeds, self._on_ground = [0], speeds.copy(), False
        self._drives: list[Drive | None] = [drive(self._model, speeds)]
        self._waiting: list[Sample] = []
        self._ahead: list[_Track] = []  # one after each of the first waiting samples

    def _initial(self) -> Array:
        s = self.settings
        turned = map(math.radians, (s.initial_attitude, s.initial_rates, s.initial_gyro_bias))
        return np.repeat([s.initial_position, s.initial_velocity, *turned], 3)

    @property
    def tallies(self) -> dict[SensorName, Tally]:
        """Counts of each sensor's samples; those after the fusion horizon are not yet included."""
        return dict(self._track.tallies)

    def advance(self, commands: Array, samples: Iterable[Sample], first: int, *, on_ground: bool = False) -> None:
        """Record a segment of flight and run the filter up to the fusion horizon.

        Args:
            commands: (M, 4) rotor speeds in force during each physics step [rad/s].
            samples: what has arrived meanwhile, in any order.
            first: number of the first of these physics steps.
            on_ground: whether a land detector saw the vehicle on the ground at the start of the segment; it leaves the
                ground once the modelled thrust exceeds its weight.
        """
        changed = np.any(commands != np.vstack([self._speeds, commands[:-1]]), axis=1)
        changed[:1] |= on_ground is not self._on_ground
        for i in np.flatnonzero(changed).tolist():
            driven = drive(self._model, commands[i])
            self._starts.append(first + i)
            self._drives.append(None if on_ground and not lifts(self._model, driven) else driven)
        if len(commands):
            self._speeds, self._on_ground = commands[-1].copy(), on_ground
        horizon = first + len(commands) - self._horizon
        before = self._waiting.copy()
        for sample in samples:
            if np.abs(sample.value).max() < _LARGEST:  # false for NaN
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
        """Return the estimate at a physics step, no earlier than the previous request."""
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
                after = predict_estimate(self._model, track.estimate, driven, duration)
            size, spread = after.mean @ after.mean, after.covariance.trace()
            if not (size < _LARGEST**2 and spread < _LARGEST_VARIANCE):
                # The estimate is lost: keep the mean, restore the initial covariance, and let the sensors correct it.
                after = Estimate(mean=track.estimate.mean, covariance=np.diag(np.square(self._initial())))
            track.estimate, track.step = after, until

    def _use(self, track: _Track, sample: Sample) -> None:
        name = sample.sensor
        refused = sample.taken - track.refused.get(name, sample.taken)
        if refused >= self._patience > 0.0:
            track.estimate = inflate(track.estimate, name, sample.value, refused * self._timestep)
        after, distance = update(track.estimate, name, sample.value, self._variances[name], self._gate)
        if after is track.estimate:
            track.count(name, rejected=1)
            track.refused.setdefault(name, sample.taken)
            return
        track.estimate = after
        track.refused.pop(name, None)
        track.count(name, accepted=1, nis=distance)
