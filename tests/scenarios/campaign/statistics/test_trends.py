"""The smooth curve through a cloud: near the truth, unmoved by outliers, and honest about where it turns."""

import numpy as np
import pytest

from scenarios.campaign.statistics.dependence import trend


@pytest.mark.parametrize("n", [60, 300, 3000])
def test_the_curve_is_near_the_median_that_was_put_in(n: int) -> None:
    rng = np.random.default_rng(n)
    x = rng.uniform(0.8, 1.2, n)
    y = 1.0 - 3.0 * np.abs(x - 1.0) + 0.1 * rng.normal(size=n)
    found = trend(x, y)
    assert found is not None
    inner = (found.x > 0.85) & (found.x < 1.15)
    assert np.max(np.abs(found.y - (1.0 - 3.0 * np.abs(found.x - 1.0)))[inner]) < 0.2
    assert found.turn is not None
    kind, at = found.turn
    assert kind == "highest"
    assert at == pytest.approx(1.0, abs=0.05)
    valley = trend(x, -y)
    assert valley is not None
    assert valley.turn == ("lowest", at)


def test_outliers_do_not_move_it() -> None:
    rng = np.random.default_rng(0)
    x = rng.uniform(size=400)
    y = x + 0.05 * rng.normal(size=400)
    spoiled = np.where(rng.random(400) < 0.05, -1e6, y)
    with_them, without = trend(x, spoiled), trend(x, y)
    assert with_them is not None
    assert without is not None
    assert np.max(np.abs(with_them.y - without.y)) < 0.1


def test_what_only_rises_or_stands_still_has_no_turn() -> None:
    x = np.random.default_rng(0).uniform(size=500)
    for y in (x, np.sqrt(x), np.ones(500), np.where(x > 0.7, -2.0, 1.0)):
        found = trend(x, y)
        assert found is not None
        assert found.turn is None
        assert y.min() <= found.y.min() <= found.y.max() <= y.max()


def test_too_little_has_no_curve() -> None:
    x = np.arange(39.0)
    assert trend(x, x) is None
    assert trend(np.arange(100) % 3.0, np.arange(100.0)) is None
