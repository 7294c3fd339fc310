"""The torque and the force that a model leaves over: how large they are, how long they last, what they will be.

What a flight measures of an axis from sample to sample, less what the parameters predict, is taken as

    d_k = integral of a(t) over the period + n_k+1 - n_k

with an acceleration a of standard deviation s that is forgotten with a time constant T (an Ornstein-Uhlenbeck process)
and the sensor's white noise n of deviation r.  With q = exp(-h / T), h the period, (1 - q / z) d_k is a moving average
of second order, so that d has the innovations e = (1 - q / z) / C(z) d of a stationary Kalman filter; C follows from
the autocovariances by factorisation, in closed form.  s, T and r are the likeliest for the innovations.  Forecasts of d
are those of that filter: a acts on, fading with T, and what the last sample was wrong by is taken back (Box, Jenkins,
Reinsel and Ljung, "Time Series Analysis", 5th ed., Secs. 5.1 and 5.2).
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
_TIMES: Final = (0.03, 0.3)  # time constants that the search starts from [s]
_STEP: Final = 1e-3  # of the slopes of innovations, in logarithms
_FARTHEST: Final = 50.0  # largest logarithm of a deviation that the search tries, either way
_LEAST_SPREAD: Final = 1e-9  # of misfits [rad/s, m/s]
_REGULAR: Final = 1e-6 * np.eye(3)  # information without which a number that nothing shows has none
_ENOUGH: Final = 10_000  # samples that the search begins with
_SCORING_STEPS: Final = 8  # of Fisher's scoring, which ends it
_SMALL: Final = 1e-3  # gain in the logarithm of the likelihood at which it ends
_REACH: Final = 2000  # samples after which a stretch has forgotten what was wrong with its first
_SEARCH: Final = {"xatol": 1e-3, "fatol": 1e-3, "maxiter": 1000}


@dataclass(frozen=True, kw_only=True)
class AxisNoise:
    """What is not modelled along one axis, as an acceleration, and the noise of its sensor."""

    deviation: float = 0.0  # s [rad/s^2, m/s^2]
    time: float = 1.0  # T [s]
    sensor: float = 0.0  # r [rad/s, m/s]

    def _innovations_form(self, period: float) -> tuple[Array, Array, float]:
        """1 - q / z, C(z) and the innovations' variance."""
        kept = math.exp(-period / self.time)
        scale = (self.deviation * self.time) ** 2
        same = 2.0 * scale * (period / self.time - 1.0 + kept)  # autocovariances of the acceleration's increments
        next_one = scale * (1.0 - kept) ** 2
        noise = self.sensor**2
        zeroth = (1.0 + kept**2) * same - 2.0 * kept * next_one + noise * (1.0 + (1.0 + kept) ** 2 + kept**2)
        first = next_one - kept * same - noise * (1.0 + kept) ** 2
        second = noise * kept
        moving = _factor(zeroth, first, second)
        return np.array([1.0, -kept]), moving, zeroth / float(moving @ moving)

    def innovations(self, misfit: Array, period: float) -> tuple[Array, float]:
        """(N,) innovations of a misfit (N,), less what is wrong with its first sample, and their variance."""
        fading, moving, variance = self._innovations_form(period)
        innovations = lfilter(fading, moving, misfit)
        of_start = lfilter(fading, moving, np.eye(1, min(len(misfit), _REACH))[0])
        head = innovations[: len(of_start)]
        head -= float(of_start @ head) / float(of_start @ of_start) * of_start
        return innovations, variance

    def forecast(self, misfit: Array, period: float, starts: Indices, length: int) -> Array:
        """(W, length) expected misfits from W starts on, each by the misfits (N,) of the periods before it alone."""
        if not self.deviation and not self.sensor:
            return np.zeros((len(starts), length))
        fading, moving, _ = self._innovations_form(period)
        kept = -fading[1]
        innovations = np.concatenate([[0.0, 0.0], lfilter(fading, moving, misfit)])
        before = np.concatenate([[0.0], misfit])[starts]
        last = innovations[starts + 1]
        first = kept * before + moving[1] * last + moving[2] * innovations[starts]
        second = kept * first + moving[2] * last
        later = second[:, None] * kept ** np.arange(length - 1)
        return np.concatenate([first[:, None], later], axis=1)

    def surprises(self, white: Array, period: float) -> Array:
        """(W, length) what comes on top of forecasts, from standard normal numbers (W, length)."""
        if not self.deviation and not self.sensor:
            return np.zeros(white.shape)
        fading, moving, variance = self._innovations_form(period)
        return np.asarray(math.sqrt(variance) * lfilter(moving, fading, white, axis=1))


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
        misfits: (N,) of each stretch of the logs.
        periods: between samples [s], of each stretch.
        blocks: of each stretch, the samples of the parts that are left out in turn.
    """
    spread = max(float(np.concatenate(misfits).std()), _LEAST_SPREAD)
    least = np.array([-_FARTHEST, math.log(SHORTEST_NOISE * periods[0]), -_FARTHEST])
    most = np.array([_FARTHEST, math.log(LONGEST_NOISE), _FARTHEST])

    def noise_of(x: Array) -> AxisNoise:
        deviation, time, sensor = np.exp(np.clip(x, least, most)).tolist()
        return AxisNoise(deviation=deviation, time=time, sensor=sensor)

    share = min(1.0, _ENOUGH / sum(map(len, misfits)))
    parts = [misfit[: math.ceil(share * len(misfit))] for misfit in misfits]

    def cost(x: Array) -> float:
        beyond = float(np.abs(x - np.clip(x, least, most)).sum())
        return beyond + _cost(noise_of(x), parts, periods)

    searches = []
    for time in _TIMES:
        first = np.log([0.3 * spread / periods[0], time, 0.5 * spread])
        searches.append(minimize(cost, first, method="Nelder-Mead", options=_SEARCH))
    x = min(searches, key=lambda search: float(search.fun)).x
    reached = _cost(noise_of(x), misfits, periods)
    for _ in range(_SCORING_STEPS):  # by all of it
        information, gradients = _information(x, noise_of, misfits, periods, blocks)
        total = information.sum(axis=0) + _REGULAR
        moved = x - np.clip(np.linalg.solve(total, gradients.sum(axis=0)), -0.5, 0.5)
        if (after := _cost(noise_of(moved), misfits, periods)) >= reached - _SMALL:
            break
        x = moved
        reached = after
    left_out = [np.linalg.solve(total - of, g) for of, g in zip(information, gradients, strict=True)]
    return NoiseFit(
        noise=noise_of(x),
        explained=np.sqrt(np.diag(np.linalg.inv(total)))[:2],
        left_out=np.array(left_out)[:, :2],
        gain=_cost_of_silence(misfits) - reached,
    )


def _cost(noise: AxisNoise, misfits: Sequence[Array], periods: Sequence[float]) -> float:
    """Negative logarithm of the likelihood of misfits, but for a constant."""
    cost = 0.0
    for misfit, period in zip(misfits, periods, strict=True):
        innovations, variance = noise.innovations(misfit, period)
        cost += 0.5 * float(innovations @ innovations) / variance + 0.5 * len(misfit) * math.log(variance)
    return cost


def _cost_of_silence(misfits: Sequence[Array]) -> float:
    """The same of the likeliest noise of the sensor alone: what it measured, summed up, is white about a constant."""
    sums = [np.cumsum(misfit) for misfit in misfits]
    squares = sum(float(np.square(of - of.mean()).sum()) for of in sums)
    samples = sum(map(len, misfits))
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
        of_variance = np.zeros(3)  # of its logarithm
        for i, step in enumerate(_STEP * np.eye(3)):
            after, variance_after = noise_of(x + step).innovations(misfit, period)
            before, variance_before = noise_of(x - step).innovations(misfit, period)
            slopes[:, i] = (after - before) / (2.0 * _STEP)
            of_variance[i] = math.log(variance_after / variance_before) / (2.0 * _STEP)
        for of in rows:
            J = slopes[of]
            excess = float(np.square(innovations[of]).sum()) / variance - len(of)
            information.append(J.T @ J / variance + 0.5 * len(of) * np.outer(of_variance, of_variance))
            gradients.append(J.T @ innovations[of] / variance - 0.5 * excess * of_variance)
    return np.array(information), np.array(gradients)


def _factor(zeroth: float, first: float, second: float) -> Array:
    """(3,) the polynomial 1 + c_1 / z + c_2 / z^2 without roots outside the unit circle, by autocovariances.

    With x = z + 1 / z the spectrum is zeroth + first x + second (x^2 - 2): each root x is a pair z and 1 / z.
    """
    polynomial = np.ones(1, complex)
    for x in np.roots([second, first, zeroth - 2.0 * second]).astype(complex):
        apart = np.sqrt(x * x - 4.0)
        root = min(0.5 * (x + apart), 0.5 * (x - apart), key=abs)
        polynomial = np.convolve(polynomial, [1.0, -root])
    moving = np.zeros(3)
    moving[: len(polynomial)] = polynomial.real
    return moving
