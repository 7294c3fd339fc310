"""Derivatives of a reference from its preview."""

from __future__ import annotations

import numpy as np
import pytest

from quadsim.mpc.laws.parts.preview import differentiator, target_of


@pytest.mark.parametrize("samples", [3, 10, 25])
def test_a_parabola_is_differentiated_exactly(samples: int) -> None:
    t = 0.1 * np.arange(1, samples + 1)
    reference = np.stack([1.0 + 2.0 * t - 3.0 * t**2, 4.0 * t, t**2, 0.5 - t + 0.25 * t**2], axis=1)
    target = target_of(reference, differentiator(samples, 0.1))
    np.testing.assert_allclose(target.position, [1.0, 0.0, 0.0], atol=1e-10)
    np.testing.assert_allclose(target.velocity, [2.0, 4.0, 0.0], atol=1e-10)
    np.testing.assert_allclose(target.acceleration, [-6.0, 0.0, 2.0], atol=1e-9)
    assert (target.yaw, target.yaw_rate, target.yaw_acceleration) == pytest.approx((0.5, -1.0, 0.5))


def test_a_jump_of_the_velocity_becomes_a_hump_of_its_area() -> None:
    """Summed over the flight, the acceleration fed forward is the jump; it never pulls the other way."""
    period = 0.05
    samples = 10
    ramp = np.maximum(0.0, 6.0 * period * (np.arange(80) - 40))
    operator = differentiator(samples, period)
    accelerations = np.array([operator[2] @ ramp[k + 1 : k + 1 + samples] for k in range(80 - samples)])
    assert accelerations.sum() * period == pytest.approx(6.0)
    assert accelerations.min() > -1e-9
    assert accelerations.max() < 0.25 * 6.0 / period
