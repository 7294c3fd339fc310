"""The noise d that a model leaves over along an axis: how large it is, how long it lasts, and its forecasts.

    d_k = integral of a(t) over the period + n_k+1 - n_k

a: an acceleration of deviation s, decaying with a time constant T (Ornstein-Uhlenbeck); n: the sensor's white noise of
deviation r.  `disturbance` gives s and T as a torque or a force, `prediction` starts from the forecasts.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.optimize import minimize
from scipy.signal import lfilter

from quadsim.state import Array, Indices

LONGEST_NOISE: Final = 10.0  # time constant [s]: what lasts longer is a trim
SHORTEST_NOISE: Final = 0.5  # time constant over the period: what is shorter is white
_FIRST_TIMES: Final = (0.03, 0.3)  # time constants that the search starts from [s]
_FIRST_SAMPLES: Final = 10_000  # that the search begins with
_SIMPLEX: Final = {"xatol": 1e-3, "fatol": 1e-3, "maxiter": 1000}  # of the search by Nelder and Mead
_MAX_SCORING_STEPS: Final = 8  # of Fisher's scoring, which ends the search
_LONGEST_STEP: Final = 0.5  # of it, in logarithms
_LEAST_STEP_GAIN: Final = 1e-3  # in the logarithm of the likelihood at which it ends
_SLOPE_STEP: Final = 1e-3  # for slopes of innovations by differences, in logarithms
_FARTHEST: Final = 50.0  # largest logarithm of a deviation that the search tries, either way
_LEAST_SPREAD: Final = 1e-9  # of misfits [rad/s, m/s]
_REGULAR: Final = 1e-6 * np.eye(3)  # information without which a number that nothing shows has none
_MEMORY: Final = 2000  # samples after which the error of a segment's first one has decayed


@dataclass(frozen=True, kw_only=True)
class AxisNoise:
    """What is not modelled along one axis, as an acceleration, and the noise of its sensor.

    With q = exp(-h / T), h the period, (1 - q / z) d_k is a moving average of second order, so that d has the
    innovations e = (1 - q / z) / C(z) d of a stationary Kalman filter; C follows from the autocovariances in closed
    form.  Forecasts of d are those of that filter: a acts on, decaying with T, and the error of the last sample is
    taken back (Box, Jenkins, Reinsel and Ljung, "Time Series Analysis", 5th ed., Secs. 5.1 and 5.2).
    """

    deviation: float = 0.0  # s [rad/s^2, m/s^2]
    time: float = 1.0  # T [s]
    sensor: float = 0.0  # r [rad/s, m/s]

    def _innovations_form(self, period: float) -> tuple[Array, Array, float]:
        """1 - q / z, C(z) and the innovations' variance."""
        decay = math.exp(-period / self.time)
        scale = (self.deviation * self.time) ** 2
        # autocovariances of the acceleration's increments, at lag 0 and 1
        lag_0 = 2.0 * scale * (period / self.time - 1.0 + decay)
        lag_1 = scale * (1.0 - decay) ** 2
        noise = self.sensor**2
        zeroth = (1.0 + decay**2) * lag_0 - 2.0 * decay * lag_1 + noise * (1.0 + (1.0 + decay) ** 2 + decay**2)
        first = lag_1 - decay * lag_0 - noise * (1.0 + decay) ** 2
        second = noise * decay
        moving_average = _factor(zeroth, first, second)
        variance = zeroth / float(moving_average @ moving_average)
        return np.array([1.0, -decay]), moving_average, variance

    def innovations(self, misfit: Array, period: float) -> tuple[Array, float]:
        """(N,) innovations of a misfit (N,), less the error of its first sample, and their variance."""
        autoregressive, moving_average, variance = self._innovations_form(period)
        innovations = lfilter(autoregressive, moving_average, misfit)
        impulse = np.eye(1, min(len(misfit), _MEMORY))[0]
        of_first_error = lfilter(autoregressive, moving_average, impulse)
        head = innovations[: len(of_first_error)]
        head -= float(of_first_error @ head) / float(of_first_error @ of_first_error) * of_first_error
        return innovations, variance

    def forecast(self, misfit: Array, period: float, starts: Indices, length: int) -> Array:
        """(W, length) expected misfits from W starts on, each by the misfits (N,) of the periods before it alone."""
        if not self.deviation and not self.sensor:
            return np.zeros((len(starts), length))
        autoregressive, moving_average, _ = self._innovations_form(period)
        decay = -autoregressive[1]
        innovations = np.concatenate([[0.0, 0.0], lfilter(autoregressive, moving_average, misfit)])
        last_misfit = np.concatenate([[0.0], misfit])[starts]
        last = innovations[starts + 1]
        last_but_one = innovations[starts]
        first = decay * last_misfit + moving_average[1] * last + moving_average[2] * last_but_one
        second = decay * first + moving_average[2] * last
        later = second[:, None] * decay ** np.arange(length - 1)
        return np.concatenate([first[:, None], later], axis=1)

    def forecast_errors(self, white: Array, period: float) -> Array:
        """(W, length) random errors of forecasts, from standard normal numbers (W, length)."""
        if not self.deviation and not self.sensor:
            return np.zeros(white.shape)
        autoregressive, moving_average, variance = self._innovations_form(period)
        return np.asarray(math.sqrt(variance) * lfilter(moving_average, autoregressive, white, axis=1))


@dataclass(frozen=True, kw_only=True)
class NoiseFit:
    """The noise of an axis, and how well it is known."""

    noise: AxisNoise
    explained: Array  # (2,) standard deviations of log s and log T, as the likelihood gives them
    left_out: Array  # (B, 2) by which log s and log T move as each block of the logs is left out
    gain: float  # in the logarithm of the likelihood, over the sensor's noise alone


def identify_noise(misfits: Sequence[Array], periods: Sequence[float], blocks: Sequence[Sequence[Indices]]) -> NoiseFit:
    """Return the likeliest noise of an axis.

    Args:
        misfits: (N,) of each segment of the logs.
        periods: between samples [s], of each segment.
        blocks: of each segment, the samples of the parts that are left out in turn.
    """
    least = np.array([-_FARTHEST, math.log(SHORTEST_NOISE * periods[0]), -_FARTHEST])
    most = np.array([_FARTHEST, math.log(LONGEST_NOISE), _FARTHEST])

    def noise_of(x: Array) -> AxisNoise:
        deviation, time, sensor = np.exp(np.clip(x, least, most)).tolist()
        return AxisNoise(deviation=deviation, time=time, sensor=sensor)

    def cost(x: Array, misfits: Sequence[Array]) -> float:
        beyond = float(np.abs(x - np.clip(x, least, most)).sum())
        return beyond + _cost(noise_of(x), misfits, periods)

    x = _coarse_minimum(cost, misfits, periods)
    reached = _cost(noise_of(x), misfits, periods)
    for _ in range(_MAX_SCORING_STEPS):
        information, gradients = _information(x, noise_of, misfits, periods, blocks)
        total = information.sum(axis=0) + _REGULAR
        step = np.linalg.solve(total, gradients.sum(axis=0))
        moved = x - np.clip(step, -_LONGEST_STEP, _LONGEST_STEP)
        after = _cost(noise_of(moved), misfits, periods)
        if after >= reached - _LEAST_STEP_GAIN:
            break
        x = moved
        reached = after
    left_out = [np.linalg.solve(total - block, g) for block, g in zip(information, gradients, strict=True)]
    return NoiseFit(
        noise=noise_of(x),
        explained=np.sqrt(np.diag(np.linalg.inv(total)))[:2],
        left_out=np.array(left_out)[:, :2],
        gain=_cost_of_sensor_alone(misfits) - reached,
    )


def _coarse_minimum(
    cost: Callable[[Array, Sequence[Array]], float], misfits: Sequence[Array], periods: Sequence[float]
) -> Array:
    """Logarithms of deviation, time constant and sensor's deviation at the least cost of the first samples."""
    spread = max(float(np.concatenate(misfits).std()), _LEAST_SPREAD)
    share = min(1.0, _FIRST_SAMPLES / sum(map(len, misfits)))
    first = [misfit[: math.ceil(share * len(misfit))] for misfit in misfits]
    searches = []
    for time in _FIRST_TIMES:
        begin = np.log([0.3 * spread / periods[0], time, 0.5 * spread])
        searches.append(minimize(cost, begin, args=(first,), method="Nelder-Mead", options=_SIMPLEX))
    return np.asarray(min(searches, key=lambda search: float(search.fun)).x)


def _cost(noise: AxisNoise, misfits: Sequence[Array], periods: Sequence[float]) -> float:
    """Negative logarithm of the likelihood of misfits, but for a constant."""
    cost = 0.0
    for misfit, period in zip(misfits, periods, strict=True):
        innovations, variance = noise.innovations(misfit, period)
        cost += 0.5 * float(innovations @ innovations) / variance + 0.5 * len(misfit) * math.log(variance)
    return cost


def _cost_of_sensor_alone(misfits: Sequence[Array]) -> float:
    """The same of the likeliest noise of the sensor alone: what it measured, summed up, is white about a constant."""
    squares = 0.0
    samples = 0
    for misfit in misfits:
        measured = np.cumsum(misfit)
        squares += float(np.square(measured - measured.mean()).sum())
        samples += len(misfit)
    return 0.5 * samples * (1.0 + math.log(max(squares / samples, _LEAST_SPREAD**2)))


def _information(
    x: Array,
    noise_of: Callable[[Array], AxisNoise],
    misfits: Sequence[Array],
    periods: Sequence[float],
    blocks: Sequence[Sequence[Indices]],
) -> tuple[Array, Array]:
    """Expected information (B, 3, 3) on x of each block, and the cost's gradient (B, 3) there."""
    information = []
    gradients = []
    for misfit, period, rows in zip(misfits, periods, blocks, strict=True):
        innovations, variance = noise_of(x).innovations(misfit, period)
        slopes = np.zeros((len(misfit), 3))
        variance_slopes = np.zeros(3)  # of its logarithm
        for i, step in enumerate(_SLOPE_STEP * np.eye(3)):
            after, variance_after = noise_of(x + step).innovations(misfit, period)
            before, variance_before = noise_of(x - step).innovations(misfit, period)
            slopes[:, i] = (after - before) / (2.0 * _SLOPE_STEP)
            variance_slopes[i] = math.log(variance_after / variance_before) / (2.0 * _SLOPE_STEP)
        by_variance = np.outer(variance_slopes, variance_slopes)
        for block in rows:
            J = slopes[block]
            e = innovations[block]
            excess = float(np.square(e).sum()) / variance - len(block)
            information.append(J.T @ J / variance + 0.5 * len(block) * by_variance)
            gradients.append(J.T @ e / variance - 0.5 * excess * variance_slopes)
    return np.array(information), np.array(gradients)


def _factor(zeroth: float, first: float, second: float) -> Array:
    """(3,) the polynomial 1 + c_1 / z + c_2 / z^2 without roots outside the unit circle, by autocovariances.

    With x = z + 1 / z the spectrum is zeroth + first x + second (x^2 - 2): each root x is a pair z and 1 / z.
    """
    polynomial = np.ones(1, complex)
    for x in np.roots([second, first, zeroth - 2.0 * second]).astype(complex):
        discriminant = np.sqrt(x * x - 4.0)
        inner_root = min(0.5 * (x + discriminant), 0.5 * (x - discriminant), key=abs)
        polynomial = np.convolve(polynomial, [1.0, -inner_root])
    moving_average = np.zeros(3)
    moving_average[: len(polynomial)] = polynomial.real
    return moving_average
