"""The unknown torque and force of logs, with intervals: what a search's parameters leave over, as a result.

Of each axis, `noise` gives the deviation s and the time constant T of an acceleration; times inertia or mass, it is a
torque or a force.  Half the interval of log s and log T is of the likelihood and of leaving out blocks, together.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np
from scipy.optimize import minimize_scalar

from quadsim.features.identify.estimate import DisturbanceEstimate, Identification
from quadsim.features.identify.intervals import student_quantile
from quadsim.features.identify.model import INCREMENTS, Segment
from quadsim.features.identify.noise import NoiseFit, identify_noise
from quadsim.features.identify.search import Search
from quadsim.state import Array

WIDEST_NOISE: Final = 1.4  # half-width of an interval, in logarithms, above which it identifies nothing: a factor of 4
LEAST_GAIN: Final = 5.0  # in the logarithm of the likelihood, from which noise is not that of the sensor alone
_NORMAL_BLOCKS: Final = 10**6  # of which Student's distribution is normal
_UNKNOWN: Final = 50.0  # half-width in logarithms from which nothing is known
_DECAY_HORIZONS: Final = (0.1, 0.25)  # [s] over which decaying rates are to predict themselves
_LONGEST_DECAY: Final = 100.0  # time constant of rates that do not decay [s]


def with_disturbance(identification: Identification, search: Search) -> Identification:
    """Return an identification with the torque and force that its search leaves over; wind's changes are a force."""
    segments = range(len(search.segments))
    steady = search.in_steady_wind(search.x)
    misfits = [search.misfit(steady, i)[0] for i in segments]
    periods = [segment.step for segment in search.segments]
    blocks = [search.rows(i) for i in segments]
    shortest = 2.0 * periods[0]
    is_inertial = any(segment.record.inertial for segment in search.segments)
    noise = []
    disturbance = []
    for place in range(len(INCREMENTS)):
        fit = identify_noise([misfit[:, place] for misfit in misfits], periods, blocks)
        noise.append(fit.noise)
        if place < 3:
            disturbance.append(_torque(place, fit, identification, shortest))
        else:
            disturbance.append(_force(place - 3, fit, identification, shortest, inertial=is_inertial))
    return replace(
        identification, noise=tuple(noise), disturbance=tuple(disturbance), rates_last=_decay_time(search.segments)
    )


def _torque(place: int, fit: NoiseFit, known: Identification, shortest: float) -> DisturbanceEstimate:
    """Return the unknown torque about a body axis."""
    axis = "xyz"[place]
    moment = known.vehicle.inertia[place]
    halves = _half_widths(fit)
    (inertia,) = (estimate for estimate in known.estimates if estimate.name == f"inertia_{axis}")
    # The vehicle may keep another inertia than was found.
    farthest = max(math.log(inertia.high / moment), math.log(moment / inertia.low))
    halves[0] = math.hypot(halves[0], farthest)
    fault = ""
    if fit.gain < LEAST_GAIN:
        fault = "none that the noise of the gyro does not explain"
    return _estimate("torque", axis, "N m", moment, fit, halves, fault or _fault(fit, halves, shortest))


def _force(place: int, fit: NoiseFit, known: Identification, shortest: float, *, inertial: bool) -> DisturbanceEstimate:
    """Return the unknown force along a world axis."""
    halves = _half_widths(fit)
    fault = ""
    if fit.gain < LEAST_GAIN:
        fault = "none that the noise of the velocity does not explain"
    elif inertial:
        fault = "no velocity is logged that an accelerometer's error does not move"
    fault = fault or _fault(fit, halves, shortest)
    return _estimate("force", "xyz"[place], "N", known.vehicle.mass, fit, halves, fault)


def _half_widths(fit: NoiseFit) -> Array:
    """(2,) half of the intervals of log s and log T."""
    blocks = len(fit.left_out)
    scatter = np.sqrt((blocks - 1) * fit.left_out.var(axis=0))
    explained = student_quantile(_NORMAL_BLOCKS) * fit.explained
    return np.asarray(np.hypot(explained, student_quantile(blocks) * scatter))


def _fault(fit: NoiseFit, halves: Array, shortest: float) -> str:
    """Why a log does not identify the noise of an axis, or an empty text."""
    if fit.noise.time < shortest:
        return "it changes from sample to sample"
    if halves.max() > WIDEST_NOISE:
        factor = np.exp(np.minimum(halves, _UNKNOWN)).max()
        return f"not excited: an interval is a factor of {factor:.2g}, allowed {math.exp(WIDEST_NOISE):.2g}"
    return ""


def _estimate(
    kind: str, axis: str, unit: str, scale: float, fit: NoiseFit, halves: Array, fault: str
) -> DisturbanceEstimate:
    """Return a torque or force, refused for a fault if there is one; `scale` is inertia or mass."""
    factors = np.exp(np.minimum(halves, _UNKNOWN))
    deviation = scale * fit.noise.deviation
    time = fit.noise.time
    return DisturbanceEstimate(
        kind=kind,
        axis=axis,
        unit=unit,
        deviation=deviation,
        deviation_interval=(float(deviation / factors[0]), float(deviation * factors[0])),
        time=time,
        time_interval=(float(time / factors[1]), float(time * factors[1])),
        refused=fault,
    )


def _decay_time(segments: Sequence[Segment]) -> float:
    """Time constant [s] with which decaying rates predict themselves best, by least squares over `_DECAY_HORIZONS`."""
    products = np.zeros(len(_DECAY_HORIZONS))
    squares = np.zeros(len(_DECAY_HORIZONS))
    for segment in segments:
        rates = segment.record.rates
        for i, horizon in enumerate(_DECAY_HORIZONS):
            later = max(1, round(horizon / segment.record.period))
            products[i] += float((rates[later:] * rates[:-later]).sum())
            squares[i] += float(np.square(rates[:-later]).sum())

    def error(log_time: float) -> float:
        decay = np.exp(-np.array(_DECAY_HORIZONS) / math.exp(log_time))
        return float(squares @ decay**2 - 2.0 * products @ decay)

    bounds = (math.log(segments[0].record.period), math.log(_LONGEST_DECAY))
    return math.exp(float(minimize_scalar(error, bounds=bounds, method="bounded").x))
