"""One threshold: found where it was put, with the exact chance that the best of all is as good."""

import itertools
import math

import numpy as np
import pytest
from scipy import stats

from scenarios.campaign.statistics.dependence import Split, best_splits


def best(values: np.ndarray, happened: np.ndarray) -> Split:
    found = best_splits({"x": values}, happened)["x"]
    assert found is not None
    return found


def test_losses_above_a_lag_are_found_within_the_spacing() -> None:
    """Four of forty, all above 75 ms: the cause of a campaign's losses, which it did not report."""
    rng = np.random.default_rng(0)
    lag = np.concatenate([rng.uniform(0.0, 0.075, 36), rng.uniform(0.0755, 0.08, 4)])
    draws = {"lag": lag, "mass": rng.uniform(0.8, 1.2, 40)}
    lost = lag > 0.075
    found = best_splits(draws, lost)["lag"]
    assert found is not None
    assert found.below == lag[~lost].max() <= found.threshold < found.above == lag[lost].min()
    assert (found.high.count, found.high.flights, found.low.count, found.low.flights) == (4, 4, 0, 36)
    exact = stats.binomtest(0, 36).proportion_ci(0.95)
    assert found.low.upper == pytest.approx(exact.high)
    assert found.p < 1e-4
    elsewhere = best_splits(draws, lost)["mass"]
    assert elsewhere is not None
    assert elsewhere.p > 0.05


@pytest.mark.parametrize("share", [0.02, 0.3, 0.8])
def test_a_noisy_threshold_is_found_near_where_it_was_put(share: float) -> None:
    rng = np.random.default_rng(1)
    lag = rng.uniform(0.0, 0.008, 1000)
    failed = rng.random(1000) < np.where(lag > 0.006, 0.5 + share / 2.0, share / 2.0)
    found = best(lag, failed)
    assert found.threshold == pytest.approx(0.006, abs=3e-4)
    assert found.p < 1e-10
    assert found.low.flights + found.high.flights == 1000
    assert found.low.count == np.count_nonzero(failed & (lag <= found.threshold))
    mirrored = best(-lag, failed)
    assert (mirrored.below, mirrored.above) == (-found.above, -found.below)
    assert mirrored.p == pytest.approx(found.p, rel=1e-6)


def test_the_p_value_there_is_fishers() -> None:
    rng = np.random.default_rng(2)
    x, happened = rng.uniform(size=60), rng.random(60) < 0.3
    found = best(x, happened)
    low, high = found.low, found.high
    tails = [
        stats.fisher_exact(
            [[low.count, low.flights - low.count], [high.count, high.flights - high.count]], alternative=side
        ).pvalue
        for side in ("less", "greater")
    ]
    assert found.p_there == pytest.approx(2.0 * min(tails))


@pytest.mark.parametrize("x", [np.arange(11.0), np.array([0, 0, 0, 1, 1, 2, 2, 2, 3, 4, 4], float)])
@pytest.mark.parametrize("count", [1, 3, 8])
def test_the_choice_of_the_threshold_is_paid_for_exactly(x: np.ndarray, count: int) -> None:
    """Against the best threshold of every order of the flights, ties included."""
    orders = [np.isin(np.arange(x.size), chosen) for chosen in itertools.combinations(range(x.size), count)]
    found = [best(x, order) for order in orders]
    chances = np.array([one.p_there for one in found])
    for one in found:
        assert one.p == pytest.approx(np.mean(chances <= one.p_there * (1.0 + 1e-7)))


def test_false_thresholds_have_their_nominal_rate() -> None:
    rng = np.random.default_rng(3)
    for count in (3, 16, 56):
        draws = {str(i): rng.uniform(size=80) for i in range(600)}
        p = np.array([one.p for one in best_splits(draws, np.arange(80) < count).values() if one is not None])
        assert p.size == 600
        assert np.mean(p < 0.05) < 0.05 + 3.0 * np.sqrt(0.05 * 0.95 / p.size)


def test_there_is_no_threshold_where_nothing_differs() -> None:
    x = np.arange(20.0)
    draws = {"x": x, "same": np.ones(20), "gap": np.where(x > 18, np.nan, x)}
    assert best_splits(draws, np.zeros(20, bool)) == dict.fromkeys(draws)
    assert best_splits(draws, np.ones(20, bool)) == dict.fromkeys(draws)
    found = best_splits(draws, x > 9)
    assert found["x"] is not None
    assert (found["same"], found["gap"]) == (None, None)
    assert (found["x"].threshold, found["x"].p) == (9.5, pytest.approx(2.0 / math.comb(20, 10)))
