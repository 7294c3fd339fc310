"""Whether an outcome depends on a varied parameter: in one direction, or in any form.

A rank correlation sees what rises or falls throughout, and is blind to what does harm at both ends.  Chatterjee's xi
sees any dependence, and needs more flights.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import scipy

from quadsim.state import Array
from scenarios.campaign.results.events import Flags

_EXACT_UP_TO: Final = 8  # pairs up to which all permutations are counted for a rank correlation's p-value; 8! = 40 320
_PERMUTED_UP_TO: Final = (
    40  # pairs up to which xi's p-value is from permutations; beyond, its asymptotic law is as good
)
_PERMUTATIONS: Final = 9999


@dataclass(frozen=True, kw_only=True)
class Dependence:
    """How an outcome depends on a number."""

    rho: float  # Spearman's rank correlation, from -1 to 1
    p: float  # its two-sided p-value
    xi: float  # Chatterjee's xi: about 0 where there is no dependence, 1 where the outcome is a function of the number
    p_xi: float  # its one-sided p-value
    flights: int  # pairs


def dependence(x: Array, y: Array, rng: np.random.Generator) -> Dependence | None:
    """How y depends on x, (K,) each, by two measures; ties have their mean rank.

    Pairs with a NaN do not count, infinities have their rank.  rho's p-value counts all permutations of up to 8 pairs,
    and is from Student's t beyond.  xi puts equal values of x in an order at random, as its author advises; its p-value
    is from permutations of up to 40 pairs and from its asymptotic law beyond.  Of a y with two values, such as an
    event, it is exact: that law is wrong for rare ones (300 flights, 2 %: p < 0.005 in 4 of 100 by chance).  None of
    fewer than three pairs, or where one side is always the same.
    Source: Chatterjee, Journal of the American Statistical Association 116 (2021).
    """
    there = ~(np.isnan(x) | np.isnan(y))
    x, y = scipy.stats.rankdata(x[there]), scipy.stats.rankdata(y[there])
    if x.size < 3 or np.ptp(x) == 0.0 or np.ptp(y) == 0.0:
        return None
    rho, p = _spearman(x, y)
    y = y[np.lexsort((rng.random(x.size), x))]
    permuted = scipy.stats.PermutationMethod(n_resamples=_PERMUTATIONS, rng=rng)
    event = np.unique(y).size == 2
    method = permuted if y.size <= _PERMUTED_UP_TO and not event else "asymptotic"
    xi = scipy.stats.chatterjeexi(np.arange(y.size), y, method=method)
    p_xi = _p_of_few_runs(y > y.min()) if event else float(xi.pvalue)
    return Dependence(rho=rho, p=p, xi=float(xi.statistic), p_xi=p_xi, flights=y.size)


def _spearman(x: Array, y: Array) -> tuple[float, float]:
    """Rank correlation of ranks, and its p-value."""
    if x.size > _EXACT_UP_TO:
        found = scipy.stats.spearmanr(x, y)
        return float(found.statistic), float(found.pvalue)
    y = (y - y.mean()) / (np.linalg.norm(x - x.mean()) * np.linalg.norm(y - y.mean()))

    def correlation(ranks: Array, axis: int = -1) -> Any:
        return np.sum(ranks * y, axis=axis)

    test = scipy.stats.permutation_test((x,), correlation, permutation_type="pairings", n_resamples=np.inf)
    return float(test.statistic), float(test.pvalue)


def _p_of_few_runs(happened: Flags) -> float:
    """Probability of as few runs of equal values, when all orders are equally likely (Wald and Wolfowitz, 1940).

    Of an event, xi counts such runs.
    """
    ones, zeros = int(happened.sum()), int((~happened).sum())
    runs = np.arange(2, np.count_nonzero(np.diff(happened)) + 2)
    fewer, more = runs // 2, (runs + 1) // 2  # runs of the one value and of the other, or the reverse

    def ways(of_ones: Any, of_zeros: Any) -> Array:
        return _log_binomial(ones - 1, of_ones - 1) + _log_binomial(zeros - 1, of_zeros - 1)

    either = np.logaddexp(ways(fewer, more), ways(more, fewer))
    return float(np.exp(scipy.special.logsumexp(either) - _log_binomial(happened.size, ones)))


def _log_binomial(n: int, k: Any) -> Array:
    """Logarithm of n over k; minus infinity where k > n."""
    gammaln = scipy.special.gammaln
    return np.asarray(gammaln(n + 1) - gammaln(k + 1) - gammaln(n - k + 1))
