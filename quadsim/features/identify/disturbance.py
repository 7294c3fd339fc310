"""The unknown torque and force of logs, with intervals: what a search's parameters leave over, as a result."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Final

import numpy as np
from scipy.optimize import minimize_scalar

from quadsim.features.identify.estimate import DisturbanceEstimate, Identification
from quadsim.features.identify.model import INCREMENTS, Stretch
from quadsim.features.identify.noise import NoiseFit, identify_noise
from quadsim.features.identify.search import Search
from quadsim.state import Array

WIDEST_NOISE: Final = 1.4  # half-width of an interval, in logarithms, above which it tells nothing: a factor of 4
LEAST_GAIN: Final = 5.0  # in the logarithm of the likelihood, from which noise is not that of the sensor alone
_MANY: Final = 10**6  # blocks, of which Student's distribution is normal
_UNKNOWN: Final = 50.0  # half-width in logarithms from which nothing is known
_RATES_OVER: Final = (0.1, 0.25)  # horizons [s]
_LONGEST_RATES: Final = 100.0  # time constant of rates that do not decay [s]


def with_disturbance(
    identification: Identification, search: Search, quantile: Callable[[int], float]
) -> Identification:
    """Return an identification with the torque and force that its search leaves over; wind's changes are a force.

    `quantile` is that of an interval which the scatter of some blocks gives.
    """
    stretches = range(len(search.parts))
    steady = search.in_steady_wind(search.x)
    misfits = [search.misfit(steady, i)[0] for i in stretches]
    periods = [part.step for part in search.parts]
    blocks = [search.rows(i) for i in stretches]
    fits = []
    for axis in range(len(INCREMENTS)):
        fits.append(identify_noise([of[:, axis] for of in misfits], periods, blocks))
    inertial = any(part.record.inertial for part in search.parts)
    return replace(
        identification,
        noise=tuple(fit.noise for fit in fits),
        disturbance=tuple(
            _estimate(place, fit, identification, 2.0 * periods[0], quantile, inertial=inertial)
            for place, fit in enumerate(fits)
        ),
        rates_last=_rates_last(search.parts),
    )


def _estimate(
    place: int,
    fit: NoiseFit,
    known: Identification,
    shortest: float,
    quantile: Callable[[int], float],
    *,
    inertial: bool,
) -> DisturbanceEstimate:
    """Return the unknown torque about a body axis, or the force along a world axis, of a place in `INCREMENTS`."""
    axis = "xyz"[place % 3]
    blocks = len(fit.left_out)
    scatter = np.sqrt((blocks - 1) * fit.left_out.var(axis=0))
    halves: Array = np.hypot(quantile(_MANY) * fit.explained, quantile(blocks) * scatter)
    if place < 3:
        kind = "torque"
        unit = "N m"
        sensor = "gyro"
        scale = known.vehicle.inertia[place]
        (inertia,) = (estimate for estimate in known.estimates if estimate.name == f"inertia_{axis}")
        # The vehicle may keep another inertia than was found.
        farthest = max(math.log(inertia.high / scale), math.log(scale / inertia.low))
        halves[0] = math.hypot(halves[0], farthest)
    else:
        kind = "force"
        unit = "N"
        sensor = "velocity"
        scale = known.vehicle.mass
    factors = np.exp(np.minimum(halves, _UNKNOWN))
    deviation = scale * fit.noise.deviation
    time = fit.noise.time
    refused = ""
    if fit.gain < LEAST_GAIN:
        refused = f"none that the noise of the {sensor} does not explain"
    elif kind == "force" and inertial:
        refused = "no velocity is logged that an accelerometer's error does not move"
    elif time < shortest:
        refused = "it changes from sample to sample"
    elif halves.max() > WIDEST_NOISE:
        refused = f"not excited: an interval is a factor of {factors.max():.2g}, allowed {math.exp(WIDEST_NOISE):.2g}"
    return DisturbanceEstimate(
        kind=kind,
        axis=axis,
        unit=unit,
        deviation=deviation,
        deviation_interval=(float(deviation / factors[0]), float(deviation * factors[0])),
        time=time,
        time_interval=(float(time / factors[1]), float(time * factors[1])),
        refused=refused,
    )


def _rates_last(parts: Sequence[Stretch]) -> float:
    """Time constant [s] with which decaying body rates predict themselves best, by least squares over `_RATES_OVER`."""
    together = np.zeros(len(_RATES_OVER))
    squares = np.zeros(len(_RATES_OVER))
    for part in parts:
        rates = part.record.rates
        for i, horizon in enumerate(_RATES_OVER):
            later = max(1, round(horizon / part.record.period))
            together[i] += float((rates[later:] * rates[:-later]).sum())
            squares[i] += float(np.square(rates[:-later]).sum())

    def error(log_time: float) -> float:
        left = np.exp(-np.array(_RATES_OVER) / math.exp(log_time))
        return float(squares @ left**2 - 2.0 * together @ left)

    bounds = (math.log(parts[0].record.period), math.log(_LONGEST_RATES))
    return math.exp(float(minimize_scalar(error, bounds=bounds, method="bounded").x))
