"""How sure an answer from many flights is: intervals, corrections for many tests, and paired comparisons.

Flights are taken as independent draws.  Draws spread evenly (Latin hypercube, Sobol', Halton) make estimates vary less
than that, so that the intervals are then wider than they need be.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any, Final

import numpy as np
import scipy
from numpy.typing import ArrayLike

from quadsim.state import Array

CONFIDENCE: Final = 0.95
ALPHA: Final = 0.05  # level of the tests


@dataclass(frozen=True, kw_only=True)
class Proportion:
    """A share of flights, with its Clopper-Pearson interval and its one-sided bounds."""

    count: int  # flights in which it happened
    flights: int
    share: float | None  # None of no flights
    lower: float
    upper: float
    lower_one_sided: float
    upper_one_sided: float


@dataclass(frozen=True, kw_only=True)
class PairedDifference:
    """The differences b - a of pairs."""

    pairs: int
    mean: float | None = None  # None of no pairs
    lower: float | None = None  # ends of the mean's t interval; None of fewer than two pairs
    upper: float | None = None


def upper_bounds(counts: ArrayLike, trials: ArrayLike, confidence: float = CONFIDENCE) -> Array:
    """One-sided upper bounds on proportions, one or (K,): the largest p that gives so few with chance 1 - confidence.

    In closed form, as scipy's `proportion_ci` searches to 1e-12 alone, which is too coarse for shares near 1e-9.
    Source: Clopper and Pearson, Biometrika 26 (1934); 1 where all happened, and of no trials.
    """
    counts, trials = np.asarray(counts, float), np.asarray(trials, float)
    some = counts < trials
    bounds = scipy.special.betaincinv(counts + 1.0, np.where(some, trials - counts, 1.0), confidence)
    return np.where(some, bounds, 1.0)


def lower_bounds(counts: ArrayLike, trials: ArrayLike, confidence: float = CONFIDENCE) -> Array:
    """One-sided lower bounds on proportions, one or (K,); 0 where none happened."""
    return 1.0 - upper_bounds(np.asarray(trials, float) - np.asarray(counts, float), trials, confidence)


def proportion(count: int, flights: int) -> Proportion:
    """A share of flights."""
    either = 0.5 * (1.0 + CONFIDENCE)
    return Proportion(
        count=count,
        flights=flights,
        share=count / flights if flights else None,
        lower=float(lower_bounds(count, flights, either)),
        upper=float(upper_bounds(count, flights, either)),
        lower_one_sided=float(lower_bounds(count, flights)),
        upper_one_sided=float(upper_bounds(count, flights)),
    )


def share_of(happened: np.ndarray[Any, np.dtype[np.bool_]]) -> dict[str, Any]:
    """The `Proportion` of the flights (K,) to which something happened, as plain data for JSON."""
    return asdict(proportion(int(happened.sum()), happened.size))


def holm(p_values: Sequence[float]) -> list[float]:
    """P-values of several tests, corrected so that the chance of any false find stays at the level.

    Source: Holm, Scandinavian Journal of Statistics 6 (1979).
    """
    order = np.argsort(p_values, kind="stable")
    factors = len(p_values) - np.arange(len(p_values))
    corrected = np.minimum(1.0, np.maximum.accumulate(factors * np.asarray(p_values, float)[order]))
    return [float(p) for p in corrected[np.argsort(order, kind="stable")]]


def mcnemar(only_a: int, only_b: int) -> float:
    """Two-sided p-value of McNemar's exact test: a discordant pair is as likely to be of the first as of the second."""
    discordant = only_a + only_b
    return float(scipy.stats.binomtest(only_a, discordant).pvalue) if discordant else 1.0


def paired_difference(a: Array, b: Array) -> PairedDifference:
    """Mean of b - a, (K,) finite each, with Student's t interval."""
    differences = np.asarray(b, float) - np.asarray(a, float)
    n = differences.size
    mean = float(differences.mean()) if n else None
    if mean is None or n < 2:
        return PairedDifference(pairs=n, mean=mean)
    half = float(scipy.stats.t.ppf(0.5 * (1.0 + CONFIDENCE), n - 1)) * float(differences.std(ddof=1)) / math.sqrt(n)
    return PairedDifference(pairs=n, mean=mean, lower=mean - half, upper=mean + half)
