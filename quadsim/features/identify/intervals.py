"""The intervals of what a search found: how far a number, or a sum of numbers, may be from the truth in 95 % of cases.

Half a width is q_N w s_e, of noise, and q_t (s_b^2 + s_f^2 + s_m^2)^(1/2), of the scatter by leaving out blocks, of
what flights differ by and of what the model leaves out, together; q_N and q_t are the quantiles of the normal and of
Student's distribution.  `judgement` decides by these what a log identifies.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np
from scipy.stats import t as student

from quadsim.features.identify.model import INCREMENTS
from quadsim.features.identify.search import NormalEquations, Search, joined
from quadsim.state import Array

INTERVAL_SHARE: Final = 0.95
MAX_AUTOCORRELATION: Final = 0.2  # of the innovations, above which intervals widen [-]
CHANCE_AUTOCORRELATION: Final = 3.7
"""The same times sqrt(N) that noise of N samples stays below in 99 %, at 8 lags of 6 axes: more than 0.2 if N < 342."""
_NORMAL_QUANTILE: Final = 1.96  # of `INTERVAL_SHARE`, in standard deviations
_LONGEST_LAG: Final = 0.2  # of the autocorrelation [s]
_SHARED_INFORMATION: Final = 0.02  # share of the information of all flights that is added to that of one alone


class Intervals:
    """The uncertainty of a search's numbers: by noise, by blocks left out, and by what flights differ in."""

    def __init__(self, search: Search) -> None:
        blocks = search.blocks(instrumented=True)
        _, prior = search.prior(search.x)
        whole = _with_information(blocks, prior.H)
        self.covariance = _covariance(whole)
        self.prior_shares = np.diag(self.covariance) * np.diag(prior.H)  # of the information on each number of x
        self.autocorrelation = _autocorrelation(search)
        self._left_out = np.array([np.linalg.solve(whole.H - block.H, block.g) for block in blocks])
        self._quantile = student_quantile(len(blocks))
        shortest = min(map(len, search.innovations(search.x)))
        self._max_autocorrelation = max(MAX_AUTOCORRELATION, CHANCE_AUTOCORRELATION / shortest**0.5)
        self._flights = []  # of each, how far it alone would move x, and the covariance of that
        blocks_by_flight: list[list[NormalEquations]] = [[] for _ in range(search.flight_count)]
        for block, flight in zip(blocks, search.flight_of_blocks(), strict=True):
            blocks_by_flight[flight].append(block)
        for of_flight in blocks_by_flight:
            self._flights.append(_flight_alone(of_flight, whole))

    def half_width(self, shares: Mapping[int, float], axes: Sequence[str], model_error: float) -> float:
        """Half of the interval of a sum of shares of x, by place, in units of the search.

        It is wider where the innovations of the axes that show it are coloured (Bartlett's variance of a mean).

        Args:
            shares: of the numbers of x, by place.
            axes: whose innovations show the sum.
            model_error: deviation of the sum by what the prediction leaves out.
        """
        row = np.zeros(len(self.covariance))
        row[[*shares]] = [*shares.values()]
        left_out = self._left_out @ row
        scatter = math.sqrt((len(left_out) - 1) * left_out.var())
        autocorrelation = max(self.autocorrelation[axis] for axis in axes)
        widened = 1.0
        if autocorrelation > self._max_autocorrelation:
            widened = math.sqrt((1.0 + autocorrelation) / (1.0 - autocorrelation))
        explained = math.sqrt(row @ self.covariance @ row)
        beyond = math.hypot(scatter, model_error, self._between_flights(row, widened))
        return math.hypot(_NORMAL_QUANTILE * widened * explained, self._quantile * beyond)

    def _between_flights(self, row: Array, widened: float) -> float:
        """Deviation of a sum of x by what flights differ in beyond their noise."""
        steps = np.array([step @ row for step, _ in self._flights])
        variances = np.array([row @ covariance @ row for _, covariance in self._flights])
        return deviation_between(steps, widened**2 * variances)


def student_quantile(blocks: int) -> float:
    """Half of the interval that the scatter of some blocks gives, in standard deviations."""
    return float(student.ppf(0.5 + 0.5 * INTERVAL_SHARE, max(blocks - 1, 1)))


def deviation_between(values: Array, variances: Array) -> float:
    """Return the deviation of the weighted mean of some flights' values by what they differ in beyond their noise.

    The variance between flights is that of DerSimonian and Laird, "Meta-analysis in clinical trials", Controlled
    Clinical Trials 7 (1986): (sum w d^2 - (F - 1)) / (sum w - sum w^2 / sum w), w = 1 / variance, 0 at least.

    Args:
        values: of each flight (F,).
        variances: of their noise (F,).
    """
    if len(values) < 2:
        return 0.0
    weights = 1.0 / variances
    total = float(weights.sum())
    differences = values - float(weights @ values) / total
    excess = float(weights @ differences**2) - (len(values) - 1)
    between = max(excess, 0.0) / (total - float(weights @ weights) / total)
    return math.sqrt(between * float(weights @ weights)) / total


def _with_information(blocks: Sequence[NormalEquations], information: Array) -> NormalEquations:
    """All blocks as one, and information on x (X, X) besides."""
    whole = joined(blocks)
    return NormalEquations(whole.H + information, whole.g, whole.S + information)


def _covariance(equations: NormalEquations) -> Array:
    """Covariance of x: H^-1 S H^-T, H^-1 without instruments."""
    inverse = np.linalg.inv(equations.H)
    return np.asarray(inverse @ equations.S @ inverse.T)


def _flight_alone(blocks: Sequence[NormalEquations], whole: NormalEquations) -> tuple[Array, Array]:
    """How far a flight alone, by its blocks, would move x from what all flights gave together, and its covariance."""
    alone = _with_information(blocks, _SHARED_INFORMATION * whole.H)
    alone = alone._replace(S=alone.S + _SHARED_INFORMATION * (whole.S - whole.H))
    return np.asarray(-np.linalg.solve(alone.H, alone.g)), _covariance(alone)


def _autocorrelation(search: Search) -> dict[str, float]:
    """Largest |autocorrelation| of each axis's innovations at lags up to `_LONGEST_LAG`."""
    largest = np.zeros(len(INCREMENTS))
    for segment, innovations in zip(search.segments, search.innovations(search.x), strict=True):
        e = innovations - innovations.mean(axis=0)
        variance = (e**2).mean(axis=0)
        lags = max(1, round(_LONGEST_LAG / segment.step))
        for lag in range(1, 1 + lags):
            largest = np.maximum(largest, np.abs((e[lag:] * e[:-lag]).mean(axis=0)) / variance)
    return dict(zip(INCREMENTS, np.minimum(largest, 0.99).tolist(), strict=True))
