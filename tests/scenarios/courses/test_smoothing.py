"""What a rounded course may have been before: within its last decimal, smoother, with its corners."""

from __future__ import annotations

import numpy as np
import pytest

from scenarios.courses.smoothing import within_rounding

T = np.arange(300) * 0.05
NONE = np.zeros(299, bool)


@pytest.mark.parametrize(("resolution", "share"), [(1e-2, 0.001), (1e-4, 0.01), (1e-6, 0.3)])
def test_fourth_differences_of_rounding_go(resolution: float, share: float) -> None:
    """The finer it is, the less of it there is to go."""
    true = 3.0 * np.sin(0.8 * T)
    values = np.round(true / resolution) * resolution
    found = within_rounding(values, resolution, NONE)
    assert np.abs(found - values).max() <= resolution
    rough, left = (np.abs(np.diff(each - true, 4)).max() for each in (values, found))
    assert left < share * rough


def test_exact_values_and_short_pieces_stay_as_they_are() -> None:
    values = np.random.default_rng(0).normal(size=300)
    np.testing.assert_array_equal(within_rounding(values, 0.0, NONE), values)
    breaks = np.zeros(299, bool)
    breaks[::5] = True
    np.testing.assert_array_equal(within_rounding(values, 0.01, breaks), values)
