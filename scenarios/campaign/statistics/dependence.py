"""Whether one number depends on another at all: in one direction, or in any way.

A rank correlation sees what rises or falls throughout, and is blind to what does harm at both ends.  Chatterjee's xi
sees any dependence, and asks for more flights.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from scipy import special, stats

from quadsim.state import Array

Counts = np.ndarray[Any, np.dtype[np.int_]]

_EXACT_UP_TO: Final = 8  # pairs up to which all permutations are counted for a rank correlation's p-value; 8! = 40 320
_PERMUTED_UP_TO: Final = 40
"""Pairs up to which xi's p-value is from permutations; beyond, its asymptotic law is as good."""
_PERMUTATIONS: Final = 9999


@dataclass(frozen=True, kw_only=True)
class Correlation:
    """Spearman's rank correlation."""

    rho: float  # from -1 to 1
    p: float  # two-sided p-value of no association
    flights: int  # pairs it was taken over


@dataclass(frozen=True, kw_only=True)
class Dependence:
    """Chatterjee's xi."""

    xi: float  # about 0 where there is no dependence, 1 where the one number is a function of the other
    p: float  # one-sided p-value of no dependence
    flights: int  # pairs it was taken over


def rank_correlation(x: Array, y: Array) -> Correlation | None:
    """Spearman's rank correlation of pairs x, y (K,), ties at their mean rank.

    The p-value counts all permutations of up to 8 pairs, and is from Student's t beyond.  Pairs with a NaN do not
    count, infinities have their rank.  None of fewer than three pairs, or where one side is always the same.
    """
    pairs = _ranked(x, y)
    if pairs is None:
        return None
    x, y = pairs
    if x.size > _EXACT_UP_TO:
        found = stats.spearmanr(x, y)
        return Correlation(rho=float(found.statistic), p=float(found.pvalue), flights=x.size)
    centred = y - y.mean()
    scale = float(np.linalg.norm(x - x.mean()) * np.linalg.norm(centred))

    def statistic(ranks: Array, axis: int = -1) -> Any:
        return np.sum(ranks * centred, axis=axis) / scale

    test = stats.permutation_test((x,), statistic, permutation_type="pairings", vectorized=True, n_resamples=np.inf)
    return Correlation(rho=float(test.statistic), p=float(test.pvalue), flights=x.size)


def any_dependence(x: Array, y: Array, rng: np.random.Generator) -> Dependence | None:
    """Chatterjee's xi of y on x, (K,) each: how near y is to a function of x, of whatever shape.

    Pairs count as for `rank_correlation`.  Equal values of x are put in an order at random, as its author advises.  The
    p-value of a y with two values, such as an event, is exact: xi then counts how often the event begins or ends as x
    grows, as the runs test does.  Else it is from 9999 permutations of up to 40 pairs, and beyond from xi's asymptotic
    law.  Source: Chatterjee, Journal of the American Statistical Association 116 (2021).
    """
    pairs = _ranked(x, y)
    if pairs is None:
        return None
    x, y = pairs
    y = y[np.lexsort((rng.random(x.size), x))]
    order = np.arange(float(y.size))
    if np.unique(y).size == 2:
        xi = float(stats.chatterjeexi(order, y).statistic)
        return Dependence(xi=xi, p=_p_of_few_runs(y > y.min()), flights=y.size)
    permuted = stats.PermutationMethod(n_resamples=_PERMUTATIONS, rng=rng)
    found = stats.chatterjeexi(order, y, method=permuted if y.size <= _PERMUTED_UP_TO else "asymptotic")
    return Dependence(xi=float(found.statistic), p=float(found.pvalue), flights=y.size)


def _ranked(x: Array, y: Array) -> tuple[Array, Array] | None:
    """Ranks of the pairs that have both; None where there is nothing to relate."""
    kept = ~(np.isnan(x) | np.isnan(y))
    x, y = stats.rankdata(x[kept]), stats.rankdata(y[kept])
    return None if x.size < 3 or np.ptp(x) == 0.0 or np.ptp(y) == 0.0 else (x, y)


def _p_of_few_runs(happened: np.ndarray[Any, np.dtype[np.bool_]]) -> float:
    """Probability of as few runs of equal values, when all orders are equally likely (Wald and Wolfowitz, 1940)."""
    ones = int(happened.sum())
    zeros = happened.size - ones
    runs = np.arange(2, int(np.count_nonzero(np.diff(happened))) + 2)
    fewer, more = runs // 2, (runs + 1) // 2  # runs of the one value and of the other, or the other way round

    def ways(of_ones: Counts, of_zeros: Counts) -> Array:
        return _log_binomial(ones - 1, of_ones - 1) + _log_binomial(zeros - 1, of_zeros - 1)

    found = np.logaddexp(ways(fewer, more), ways(more, fewer))
    return float(np.exp(special.logsumexp(found) - _log_binomial(happened.size, np.asarray(ones))))


def _log_binomial(n: int, k: Counts) -> Array:
    """Logarithm of n over k; minus infinity where k > n."""
    return np.asarray(special.gammaln(n + 1) - special.gammaln(k + 1) - special.gammaln(n - k + 1))


_GROUPS: Final = (5, 25)  # the fewest and the most groups that a curve is drawn through
_GROUPS_PER_ROOT: Final = 0.8  # groups, as a share of the square root of the flights
_POINTS: Final = 80
_TURN: Final = 0.3
"""Share of a curve's height by which both of its ends have to lie on one side of what is between them."""


@dataclass(frozen=True, kw_only=True)
class Trend:
    """A smooth curve over a drawn number."""

    x: Array  # (G,) values of the drawn number, rising
    y: Array  # (G,) what half of the flights near there exceed

    @property
    def turn(self) -> tuple[str, float] | None:
        """`highest` or `lowest`, and where, for a curve whose two ends lie both below that or both above it."""
        height = float(np.ptp(self.y))
        ends = self.y[[0, -1]]
        drop, rise = float(self.y.max() - ends.max()), float(ends.min() - self.y.min())
        if height == 0.0 or max(drop, rise) < _TURN * height:
            return None
        kind, extreme = ("highest", self.y.max()) if drop >= rise else ("lowest", self.y.min())
        return kind, float(np.median(self.x[np.abs(self.y - extreme) < 0.01 * height]))


def trend(x: Array, y: Array) -> Trend | None:
    """A cubic smoothing spline through the medians of groups of flights that are next to one another.

    Flights, finite x and y (K,), are sorted by x and parted into 5 to 25 groups of about equal size, 0.8 times as many
    as the square root of the flights.  Medians are taken since no outlier moves them; generalised cross-validation
    chooses how smooth the spline is, and it is cut off at the highest and the lowest median.  None of fewer than 40
    flights, or where x has too few values for five groups.
    Source: scipy.interpolate.make_smoothing_spline, after Woltring, Advances in Engineering Software 8 (1986).
    """
    from scipy.interpolate import make_smoothing_spline

    fewest, most = _GROUPS
    groups = min(most, int(_GROUPS_PER_ROOT * np.sqrt(x.size)))
    if groups < fewest:
        return None
    order = np.argsort(x, kind="stable")
    parts = np.array_split(order, groups)
    centres = np.array([np.median(x[part]) for part in parts])
    distinct, first = np.unique(centres, return_index=True)
    if distinct.size < fewest:
        return None
    medians = np.array([np.median(y[parts[i]]) for i in first])
    span = float(distinct[-1] - distinct[0])
    unit = (distinct - distinct[0]) / span
    at = np.linspace(0.0, 1.0, _POINTS)
    smooth = np.clip(make_smoothing_spline(unit, medians)(at), medians.min(), medians.max())
    return Trend(x=distinct[0] + span * at, y=np.asarray(smooth, float))
