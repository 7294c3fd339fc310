"""The manifold of poses and rates: errors move means, and are found again."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from quadsim.sim.error_state import difference, retract

means = st.integers(0, 2**32 - 1).map(
    lambda seed: np.concatenate(
        [
            (rng := np.random.default_rng(seed)).normal(size=6),
            Rotation.random(rng=rng).as_quat(scalar_first=True),
            rng.normal(size=6),
        ]
    )
)
errors = st.lists(st.floats(-1.7, 1.7), min_size=15, max_size=15).map(np.array)


@given(mean=means, error=errors)
def test_the_difference_is_the_error_that_was_applied(mean: np.ndarray, error: np.ndarray) -> None:
    moved = retract(mean, error)
    np.testing.assert_allclose(difference(moved, mean), error, atol=1e-12)
    assert np.linalg.norm(moved[6:10]) == pytest.approx(1.0, abs=1e-15)


def test_an_attitude_error_turns_the_body_about_its_own_axes() -> None:
    mean, error = np.zeros(16), np.zeros(15)
    mean[6:10] = Rotation.from_euler("Z", 90, degrees=True).as_quat(scalar_first=True)
    error[6] = np.radians(10.0)  # about body x, which points along world y
    expected = Rotation.from_rotvec([0.0, np.radians(10.0), 0.0]) * Rotation.from_quat(mean[6:10], scalar_first=True)
    found = Rotation.from_quat(retract(mean, error)[6:10], scalar_first=True)
    assert (found * expected.inv()).magnitude() < 1e-12
