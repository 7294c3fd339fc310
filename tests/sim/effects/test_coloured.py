"""Random force and torque that last: the process's moments, and what the plant makes of them."""

from __future__ import annotations

import numpy as np
import pytest

from quadsim.errors import InputError
from quadsim.sim.effects import Disturbance, Effects
from quadsim.sim.effects.coloured import ColouredNoise
from quadsim.sim.plant import Plant
from quadsim.state import Array
from quadsim.vehicle import Vehicle

DEVIATIONS = np.array([2.0, 0.5])
TIMES = np.array([0.05, 0.4])


def noise(seed: int = 0, timestep: float = 1e-2) -> ColouredNoise:
    return ColouredNoise(DEVIATIONS, TIMES, timestep=timestep, rng=np.random.default_rng(seed))


def test_it_has_its_deviation_and_forgets_with_its_time_constant() -> None:
    samples = noise().advance(200_000)
    np.testing.assert_allclose(samples.std(axis=0), DEVIATIONS, rtol=0.03)
    for lag in (1, 5, 20):
        correlation = (samples[lag:] * samples[:-lag]).mean(axis=0) / DEVIATIONS**2
        np.testing.assert_allclose(correlation, np.exp(-lag * 1e-2 / TIMES), atol=0.04)
    assert np.corrcoef(samples.T)[0, 1] == pytest.approx(0.0, abs=0.02)


def test_it_is_stationary_from_the_first_sample_on() -> None:
    first = np.array([noise(seed).advance(1)[0] for seed in range(2000)])
    np.testing.assert_allclose(first.std(axis=0), DEVIATIONS, rtol=0.06)


def test_it_is_the_same_however_it_is_cut_and_rewound() -> None:
    whole = noise().advance(100)
    process = noise()
    np.testing.assert_array_equal(np.concatenate([process.advance(steps) for steps in (1, 39, 60)]), whole)
    process.reset()
    np.testing.assert_array_equal(process.advance(100), whole)


@pytest.mark.parametrize("kind", ["force", "torque"])
def test_a_deviation_needs_its_time_constants(kind: str) -> None:
    with pytest.raises(InputError, match=f"{kind}_time must be three time constants"):
        Disturbance(**{f"{kind}_deviation": (0.0, 1.0, 0.0)})  # type: ignore[arg-type]
    assert Disturbance(torque_time=(1.0, 1.0, 1.0)).lasting(1e-3, np.random.default_rng(0)) is None


def hovered(vehicle: Vehicle, disturbance: Disturbance, seed: int = 0) -> Array:
    """(14,) motion after 0.5 s of hover thrust."""
    with Plant(vehicle, effects=Effects(disturbance=disturbance), rng=np.random.default_rng(seed)) as plant:
        plant.advance(vehicle.hover_speeds, 500)
        return plant.physics


def test_the_plant_is_pushed_and_turned_by_it(vehicle: Vehicle) -> None:
    """Speed and rate after 0.5 s have the deviation of the process's integral."""
    mass = vehicle.mass
    inertia = vehicle.inertia[0]
    force = (0.5 * mass, 0.0, 0.0)  # [N]
    torque = (0.01 * inertia, 0.0, 0.0)  # [N m], so small that the thrust's tilt adds little
    acting = Disturbance(
        force_deviation=force, force_time=(0.2, 1.0, 1.0), torque_deviation=torque, torque_time=(0.1, 1.0, 1.0)
    )
    after = np.array([hovered(vehicle, acting, seed) for seed in range(60)])
    over = 0.5 / np.array([0.2, 0.1])
    spread = np.array([0.5, 0.01]) * np.array([0.2, 0.1]) * np.sqrt(2.0 * (over - 1.0 + np.exp(-over)))
    np.testing.assert_allclose(after[:, [8, 11]].std(axis=0), spread, rtol=0.3)


def test_what_does_not_last_keeps_its_draws(vehicle: Vehicle) -> None:
    """A deviation of next to nothing changes next to nothing: white noise is drawn as before."""
    white = {"force_noise": 0.1, "torque_noise": 1e-4}
    alone = hovered(vehicle, Disturbance(**white))  # type: ignore[arg-type]
    both = Disturbance(**white, force_deviation=(1e-12, 0.0, 0.0), force_time=(1.0, 1.0, 1.0))  # type: ignore[arg-type]
    np.testing.assert_allclose(hovered(vehicle, both), alone, atol=1e-9)
