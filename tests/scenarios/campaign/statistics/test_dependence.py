"""Both measures of dependence against scipy, every permutation, and what they are to see."""

import itertools

import numpy as np
import pytest
from scipy import stats

from scenarios.campaign.statistics import Dependence, dependence


def related(x: np.ndarray, y: np.ndarray) -> Dependence | None:
    return dependence(x, y, np.random.default_rng(0))


def test_rank_correlation_is_scipys() -> None:
    rng = np.random.default_rng(2)
    x, y = rng.normal(size=200), np.round(rng.normal(size=200), 1)  # with ties
    y += 0.2 * x
    found = related(x, y)
    expected = stats.spearmanr(x, y)
    assert found is not None
    assert (found.rho, found.p, found.flights) == pytest.approx((expected.statistic, expected.pvalue, 200), rel=1e-9)


def test_rank_correlation_of_few_counts_all_permutations() -> None:
    x, y = np.array([3.0, 1.0, 4.0, 1.5, 5.0]), np.array([0.0, 0.0, 1.0, 0.0, 1.0])
    found = related(x, y)
    assert found is not None
    rho = [stats.spearmanr(x, np.array(order)).statistic for order in itertools.permutations(y)]
    beyond = np.mean(np.array(rho) >= found.rho - 1e-12)
    assert found.rho == pytest.approx(stats.spearmanr(x, y).statistic)
    assert found.p == pytest.approx(2.0 * beyond)
    perfect = related(np.arange(5.0), np.arange(5.0))
    assert perfect is not None
    assert (perfect.rho, perfect.p) == pytest.approx((1.0, 2.0 / 120.0))


def test_rank_correlation_of_what_is_not_there() -> None:
    x = np.arange(20.0)
    assert related(x, np.zeros(20)) is None
    assert related(x[:2], x[:2]) is None
    assert related(x, np.full(20, np.nan)) is None
    gaps = related(np.append(x, np.nan), np.append(-x, 3.0))
    assert gaps is not None
    assert (gaps.rho, gaps.flights) == (pytest.approx(-1.0), 20)
    with_loss = related(x, np.where(x > 17.0, -np.inf, -x))
    assert with_loss is not None
    assert with_loss.rho < -0.99


def bowl(n: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """A margin that falls on both sides of a mass of 1."""
    rng = np.random.default_rng(seed)
    mass = rng.uniform(0.8, 1.2, n)
    return mass, 0.9 - 3.0 * np.abs(mass - 1.0) + 0.1 * rng.normal(size=n)


@pytest.mark.parametrize("n", [30, 60, 1000])
def test_harm_at_both_ends_is_seen_by_xi_alone(n: int) -> None:
    mass, margin = bowl(n, 1)
    found = related(mass, margin)
    assert found is not None
    assert found.p > 0.05
    assert found.p_xi < 0.002
    assert found.xi > 0.25


def test_xi_is_scipys_with_its_asymptotic_law() -> None:
    x, y = bowl(300, 2)
    found, expected = related(x, y), stats.chatterjeexi(x, y)
    assert found is not None
    assert (found.xi, found.p_xi, found.flights) == (expected.statistic, expected.pvalue, 300)


@pytest.mark.parametrize(("ones", "zeros"), [(3, 5), (1, 6), (4, 4), (7, 2)])
def test_xi_of_an_event_has_an_exact_p_value(ones: int, zeros: int) -> None:
    """Against xi of every order of the flights."""
    n = ones + zeros
    x = np.arange(float(n))
    orders = [np.isin(np.arange(n), chosen).astype(float) for chosen in itertools.combinations(range(n), ones)]
    xis = np.array([stats.chatterjeexi(x, order).statistic for order in orders])
    for order, xi in zip(orders, xis, strict=True):
        found = related(x, order)
        assert found is not None
        assert found.p_xi == pytest.approx(np.mean(xis >= xi - 1e-9))


def test_the_p_value_of_xi_has_its_nominal_level() -> None:
    """Of few and many pairs, of numbers, of rare events, and of a varied parameter with few values."""
    rng = np.random.default_rng(3)
    for n, runs in ((15, 60), (60, 200), (300, 120)):
        for y_of in (lambda size: rng.normal(size=size), lambda size: (rng.random(size) < 0.1) * 1.0):
            for x_of in (lambda size: rng.uniform(size=size), lambda size: rng.integers(0, 4, size) * 1.0):
                found = [dependence(x_of(n), y_of(n), rng) for _ in range(runs)]
                p = np.array([one.p_xi for one in found if one is not None])
                assert np.mean(p < 0.05) < 0.05 + 3.0 * np.sqrt(0.05 * 0.95 / p.size), (n, p.size)


def test_xi_of_what_is_not_there() -> None:
    x = np.arange(20.0)
    assert related(np.zeros(20), x) is None
    with_loss = related(np.append(x, np.nan), np.where(np.arange(21) > 17, -np.inf, np.arange(21.0)))
    assert with_loss is not None
    assert with_loss.flights == 20
