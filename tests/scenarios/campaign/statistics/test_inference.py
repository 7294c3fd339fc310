"""Intervals and tests against closed forms, published numbers, other routes through scipy, and simulation."""

import math

import numpy as np
import pytest
from scipy import stats

from scenarios.campaign.statistics import (
    holm,
    lower_bounds,
    mcnemar,
    paired_difference,
    proportion,
    upper_bounds,
)


@pytest.mark.parametrize(("count", "trials"), [(0, 1), (1, 1), (0, 20), (3, 20), (37, 1000), (999, 1000), (10, 10)])
def test_the_interval_is_scipys(count: int, trials: int) -> None:
    found = proportion(count, trials)
    exact = stats.binomtest(count, trials).proportion_ci(0.95, method="exact")
    assert (found["lower"], found["upper"]) == pytest.approx((exact.low, exact.high), abs=1e-9)
    one_sided = stats.binomtest(count, trials, alternative="less").proportion_ci(0.95, method="exact")
    assert found["upper_one_sided"] == pytest.approx(one_sided.high, abs=1e-9)
    other = stats.binomtest(count, trials, alternative="greater").proportion_ci(0.9, method="exact")
    assert lower_bounds(count, trials, 0.9) == pytest.approx(other.low, abs=1e-9)
    assert found["share"] == count / trials


def test_bounds_in_closed_form() -> None:
    assert upper_bounds(0, 299, 0.95) == pytest.approx(1.0 - 0.05 ** (1.0 / 299.0), rel=1e-12)
    assert lower_bounds(50, 50, 0.99) == pytest.approx(0.01 ** (1.0 / 50.0), rel=1e-12)
    assert (upper_bounds(50, 50), lower_bounds(0, 50)) == (1.0, 0.0)
    nothing = proportion(0, 0)
    assert (nothing["share"], nothing["lower"], nothing["upper"], nothing["upper_one_sided"]) == (None, 0.0, 1.0, 1.0)


@pytest.mark.parametrize("p", [0.002, 0.03, 0.2, 0.5, 0.97])
@pytest.mark.parametrize("n", [5, 40, 400])
def test_bounds_have_their_nominal_coverage(n: int, p: float) -> None:
    """The coverage, summed over every possible count."""
    counts = np.arange(n + 1.0)
    chance = stats.binom.pmf(counts, n, p)
    trials = np.full(n + 1, float(n))
    for confidence in (0.9, 0.95, 0.99):
        assert chance[upper_bounds(counts, trials, confidence) >= p].sum() >= confidence - 1e-12
        assert chance[lower_bounds(counts, trials, confidence) <= p].sum() >= confidence - 1e-12


def test_intervals_cover_simulated_campaigns() -> None:
    rng = np.random.default_rng(1)
    found = [proportion(int(count), 300) for count in rng.binomial(300, 0.04, 2000)]
    covered = np.mean([one["lower"] <= 0.04 <= one["upper"] for one in found])
    assert 0.95 <= covered < 0.985


def test_holm_is_holms() -> None:
    assert holm([0.01, 0.04, 0.03, 0.005]) == pytest.approx([0.03, 0.06, 0.06, 0.02])  # p.adjust of R
    assert holm([0.5, 0.6]) == [1.0, 1.0]
    assert holm([]) == []


def test_holm_keeps_the_chance_of_a_false_find() -> None:
    p = np.random.default_rng(3).uniform(size=(4000, 9))
    assert np.mean([min(holm(list(row))) < 0.05 for row in p]) == pytest.approx(0.05, abs=0.012)


def test_mcnemar_in_closed_form() -> None:
    assert mcnemar(0, 0) == 1.0
    assert mcnemar(0, 6) == pytest.approx(2.0 / 2**6)
    assert mcnemar(5, 15) == pytest.approx(2.0 * sum(math.comb(20, k) for k in range(6)) / 2**20)
    assert mcnemar(15, 5) == mcnemar(5, 15)


def test_paired_difference_is_scipys() -> None:
    rng = np.random.default_rng(5)
    a = rng.normal(size=60)
    b = a + 0.3 + 0.5 * rng.normal(size=60)
    found = paired_difference(a, b)
    interval = stats.ttest_rel(b, a).confidence_interval(0.95)
    assert (found.mean, found.lower, found.upper) == pytest.approx((np.mean(b - a), interval.low, interval.high))


def test_paired_difference_covers() -> None:
    rng = np.random.default_rng(6)
    found = [paired_difference(np.zeros(40), rng.exponential(size=40)) for _ in range(600)]
    covered = [one.lower is not None and one.upper is not None and one.lower <= 1.0 <= one.upper for one in found]
    assert 0.89 < np.mean(covered) < 0.97  # of a skewed law, the t interval is a little short


def test_paired_difference_of_few() -> None:
    none = paired_difference(np.empty(0), np.empty(0))
    assert (none.pairs, none.mean, none.lower) == (0, None, None)
    one = paired_difference(np.array([1.0]), np.array([3.0]))
    assert (one.mean, one.lower) == (2.0, None)
    same = paired_difference(np.ones(30), np.ones(30))
    assert (same.mean, same.lower, same.upper) == (0.0, 0.0, 0.0)
