"""Which of several tied numbers gives its name: the same one whatever the processor's last digits are."""

from __future__ import annotations

import math

import numpy as np
import pytest

from quadsim.ties import TIE_SHARE, first_smallest, in_order, tied

NOISE = 3e-6
"""How far other linear algebra kernels moved a share, in a library flight."""


def test_the_first_within_the_window_of_the_smallest_counts() -> None:
    assert first_smallest([0.5, 0.1 + 0.9 * TIE_SHARE, 0.1, 0.3]) == 1
    assert first_smallest([0.5, 0.1 + 1.1 * TIE_SHARE, 0.1, 0.3]) == 2
    assert tied([0.1, 0.3, 0.1]).tolist() == [0, 2]
    assert first_smallest([3.0, 2.0, 1.5], window=0.6) == 1
    assert first_smallest([3.0, 2.0, 1.5], window=0.0) == 2


def test_what_is_missing_or_has_no_bound_has_its_place() -> None:
    assert first_smallest([1.0, math.nan, 0.0]) == 1, "as numpy's argmin has it: a margin that is NaN is a violation"
    assert first_smallest([math.inf, math.inf]) == 0
    assert first_smallest([0.0, -math.inf]) == 1
    assert in_order([math.inf, 0.2, -math.inf, 0.1]).tolist() == [2, 3, 1, 0]
    assert in_order([]).tolist() == []


def test_the_order_is_by_size_and_of_tied_ones_as_they_stand() -> None:
    values = np.array([0.3, 0.1 + 0.5 * TIE_SHARE, 0.2, 0.1, 0.2 - 0.5 * TIE_SHARE])
    assert in_order(values).tolist() == [1, 3, 2, 4, 0]
    assert in_order(values)[0] == first_smallest(values)
    assert in_order(values, window=0.0).tolist() == [3, 1, 4, 2, 0]


@pytest.mark.parametrize(("values", "window"), [([], TIE_SHARE), ([1.0], -1.0), ([1.0], math.nan)])
def test_nothing_to_choose_from_and_no_window_are_refused(values: list[float], window: float) -> None:
    with pytest.raises(ValueError, match="window"):
        tied(values, window)


def test_noise_in_the_last_digits_changes_no_choice() -> None:
    rng = np.random.default_rng(0)
    shares = np.array([0.4, 0.25, 0.1, 0.25, 0.1, 0.7, 0.4])
    for _ in range(200):
        noisy = shares + rng.uniform(-NOISE, NOISE, shares.size)
        assert first_smallest(noisy) == 2
        assert in_order(noisy).tolist() == [2, 4, 1, 3, 0, 6, 5]
