"""Whether an outcome depends on a varied parameter: in one direction, in any form, or from a threshold on.

A rank correlation sees what rises or falls throughout, and is blind to what does harm at both ends.  Chatterjee's xi
sees any dependence, and needs more flights.  Of an event, Fisher's exact test chooses the threshold.  Its p-value
there is too good, since the best of many was taken; the chance that the best of all thresholds is as good where the
event has nothing to do with the number is found exactly, by following all orders of the flights at once (Boulesteix,
Biometrical Journal 48, 2006, with Fisher's p-value in place of chi-squared).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import scipy

from quadsim.state import Array
from scenarios.campaign.results.events import Flags
from scenarios.campaign.statistics.inference import Proportion, proportion

Counts = np.ndarray[Any, np.dtype[np.int_]]

_EXACT_UP_TO: Final = 8  # pairs up to which all permutations are counted for a rank correlation's p-value; 8! = 40 320
_PERMUTED_UP_TO: Final = 40
"""Pairs up to which xi's p-value is from permutations; beyond, its asymptotic law is as good."""
_PERMUTATIONS: Final = 9999
_GROUPS: Final = (5, 25)  # the fewest and the most groups that a curve is drawn through
_GROUPS_PER_ROOT: Final = 0.8  # groups, as a share of the square root of the flights
_POINTS: Final = 80
_TURN: Final = 0.3
"""Share of a curve's height by which both of its ends have to lie on one side of what is between them."""
_ROUNDING: Final = 1.0 + 1e-7  # p-values of which one is no larger than this times the other are the same


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
        found = scipy.stats.spearmanr(x, y)
        return Correlation(rho=float(found.statistic), p=float(found.pvalue), flights=x.size)
    centred = y - y.mean()
    scale = float(np.linalg.norm(x - x.mean()) * np.linalg.norm(centred))

    def statistic(ranks: Array, axis: int = -1) -> Any:
        return np.sum(ranks * centred, axis=axis) / scale

    test = scipy.stats.permutation_test(
        (x,), statistic, permutation_type="pairings", vectorized=True, n_resamples=np.inf
    )
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
        xi = float(scipy.stats.chatterjeexi(order, y).statistic)
        return Dependence(xi=xi, p=_p_of_few_runs(y > y.min()), flights=y.size)
    permuted = scipy.stats.PermutationMethod(n_resamples=_PERMUTATIONS, rng=rng)
    found = scipy.stats.chatterjeexi(order, y, method=permuted if y.size <= _PERMUTED_UP_TO else "asymptotic")
    return Dependence(xi=float(found.statistic), p=float(found.pvalue), flights=y.size)


def _ranked(x: Array, y: Array) -> tuple[Array, Array] | None:
    """Ranks of the pairs that have both; None where there is nothing to relate."""
    valid = ~(np.isnan(x) | np.isnan(y))
    x, y = scipy.stats.rankdata(x[valid]), scipy.stats.rankdata(y[valid])
    return None if x.size < 3 or np.ptp(x) == 0.0 or np.ptp(y) == 0.0 else (x, y)


def _p_of_few_runs(happened: Flags) -> float:
    """Probability of as few runs of equal values, when all orders are equally likely (Wald and Wolfowitz, 1940)."""
    ones = int(happened.sum())
    zeros = happened.size - ones
    runs = np.arange(2, int(np.count_nonzero(np.diff(happened))) + 2)
    fewer, more = runs // 2, (runs + 1) // 2  # runs of the one value and of the other, or the reverse

    def ways(of_ones: Counts, of_zeros: Counts) -> Array:
        return _log_binomial(ones - 1, of_ones - 1) + _log_binomial(zeros - 1, of_zeros - 1)

    found = np.logaddexp(ways(fewer, more), ways(more, fewer))
    return float(np.exp(scipy.special.logsumexp(found) - _log_binomial(happened.size, np.asarray(ones))))


def _log_binomial(n: int, k: Counts) -> Array:
    """Logarithm of n over k; minus infinity where k > n."""
    return np.asarray(scipy.special.gammaln(n + 1) - scipy.special.gammaln(k + 1) - scipy.special.gammaln(n - k + 1))


@dataclass(frozen=True, kw_only=True)
class Trend:
    """A smooth curve over a varied parameter."""

    x: Array  # (G,) values of the varied parameter, rising
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


@dataclass(frozen=True, kw_only=True)
class Split:
    """A threshold on a varied parameter."""

    threshold: float  # a round number from `below` to `above`: flights up to it are on the low side
    below: float  # the largest value on the low side
    above: float  # the smallest value on the high side
    low: Proportion  # how often the event happened on the low side
    high: Proportion  # how often on the high side
    p_there: float  # Fisher's two-sided p-value at this threshold, as if it had been chosen beforehand
    p: float  # probability that the best threshold is as good by chance


def best_splits(columns: Mapping[str, Array], happened: Flags) -> dict[str, Split | None]:
    """The best threshold on each of several varied parameters, (K,) by name, for an event that happened (K,) or not.

    None of a number that is always the same or not always there, and of an event that happened never or always.
    """
    if happened.all() or not happened.any():
        return dict.fromkeys(columns)
    varying = {name: values for name, values in columns.items() if np.isfinite(values).all() and np.ptp(values) > 0.0}
    if not varying:
        return dict.fromkeys(columns)
    flights = happened.size
    rare = happened if 2 * happened.sum() <= flights else ~happened  # the same test, and fewer counts to follow
    count = int(rare.sum())
    orders = {name: np.argsort(values, kind="stable") for name, values in varying.items()}
    ranked = np.stack([varying[name][order] for name, order in orders.items()])  # (D, K)
    counts = np.stack([np.cumsum(rare[order], dtype=np.int_) for order in orders.values()])[:, :-1]  # (D, K - 1)
    allowed = np.diff(ranked) > 0.0
    chances = np.where(allowed, _fisher(counts, flights, count), np.inf)
    cuts = np.argmin(chances, axis=1)
    best = chances[np.arange(cuts.size), cuts]
    p_values = _chances_of_as_good(best, allowed, flights, count)
    found: dict[str, Split | None] = dict.fromkeys(columns)
    for i, name in enumerate(varying):
        size = int(cuts[i]) + 1
        low = happened[orders[name]][:size]
        below, above = float(ranked[i, size - 1]), float(ranked[i, size])
        found[name] = Split(
            threshold=_round_number(below, above),
            below=below,
            above=above,
            low=proportion(int(low.sum()), size),
            high=proportion(int(happened.sum() - low.sum()), flights - size),
            p_there=float(best[i]),
            p=float(p_values[i]),
        )
    return found


def _fisher(counts: Counts, flights: int, count: int) -> Array:
    """(D, K - 1) p-values at each cut, of this many events among the first 1, 2, ... flights."""
    found = np.empty(counts.shape)
    for size, tails in enumerate(_tails(flights, count)):
        found[:, size] = tails[counts[:, size]]
    return found


def _chances_of_as_good(best: Array, allowed: Flags, flights: int, count: int) -> Array:
    """(D,) probability that any allowed cut has a p-value as small as the best, when all orders are equally likely.

    The number of events among the first flights is a Markov chain.  Loop invariant: `alive[:, j]` is the probability
    of j events among the first `size` flights, with no cut so far as good as the best.
    """
    alive = np.zeros((best.size, count + 1))
    alive[:, 0] = 1.0
    as_good = np.zeros(best.size)
    j = np.arange(count + 1)
    for size, tails in enumerate(_tails(flights, count), start=1):
        next_has_it = (count - j) / (flights - size + 1.0)
        moved = alive * next_has_it
        alive -= moved
        alive[:, 1:] += moved[:, :-1]
        beyond = (tails <= best[:, None] * _ROUNDING) & allowed[:, size - 1, None]
        as_good += np.sum(alive, axis=1, where=beyond)
        alive[beyond] = 0.0
    return np.minimum(as_good, 1.0)


def _tails(flights: int, count: int) -> Iterator[Array]:
    """(count + 1,) Fisher's two-sided p-value of each count among the first 1, 2, ..., flights - 1 flights."""
    chance = np.zeros(count + 1)  # hypergeometric, from one size to the next
    chance[0] = 1.0
    j = np.arange(count + 1)
    for size in range(1, flights):
        moved = chance * ((count - j) / (flights - size + 1.0))
        chance -= moved
        chance[1:] += moved[:-1]
        at_most, at_least = np.cumsum(chance), np.cumsum(chance[::-1])[::-1]
        yield np.minimum(1.0, 2.0 * np.minimum(at_most, at_least))


def _round_number(below: float, above: float) -> float:
    """The number of the fewest digits that is at least `below` and less than `above`."""
    middle = 0.5 * (below + above)
    candidates = (float(f"{middle:.{digits}g}") for digits in range(1, 17))
    return next((number for number in candidates if below <= number < above), below)
