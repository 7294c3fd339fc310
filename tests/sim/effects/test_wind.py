"""Wind: mean, changes and gusts against closed forms, for any number of steps drawn at once."""

from __future__ import annotations

import numpy as np
import pytest

from quadsim.sim.effects.turbulence import Dryden
from quadsim.sim.effects.wind import Gust, WindChange, WindField, gust_velocity
from quadsim.state import Array

STEP = 1e-3
DRYDEN = Dryden(altitude=6.0, wind_speed_20ft=8.0, airspeed=5.0)


def field(
    *,
    mean: tuple[float, float, float] = (0.0, 0.0, 0.0),
    gusts: tuple[Gust, ...] = (),
    turbulence: Dryden | None = None,
    changes: tuple[WindChange, ...] = (),
    seed: int = 0,
) -> WindField:
    rng = np.random.default_rng(seed)
    return WindField(mean=mean, gusts=gusts, turbulence=turbulence, timestep=STEP, rng=rng, changes=changes)


def middles(steps: int) -> Array:
    return STEP * (np.arange(steps) + 0.5)


def test_a_gust_has_the_1_cosine_shape() -> None:
    gust = Gust(at=0.2, duration=0.5, velocity=(4.0, -2.0, 1.0))
    t = middles(1000)
    expected = np.where((t > 0.2) & (t < 0.7), np.sin(np.pi * (t - 0.2) / 0.5) ** 2, 0.0)  # (1 - cos 2 a) / 2
    wind = field(gusts=(gust,)).advance(1000)
    np.testing.assert_allclose(wind, expected[:, None] * [4.0, -2.0, 1.0], atol=1e-12)


def test_a_gust_peaks_halfway_and_is_calm_outside() -> None:
    gust = Gust(at=1.0, duration=3.0, velocity=(0.0, 5.0, 0.0))
    velocity = gust_velocity([gust], np.array([0.0, 1.0, 1.75, 2.5, 3.25, 4.0, 9.0]))
    np.testing.assert_allclose(velocity[:, 1], [0.0, 0.0, 2.5, 5.0, 2.5, 0.0, 0.0], atol=1e-12)


def test_a_gust_blows_half_its_peak_on_average() -> None:
    """Its integral is v T / 2; sums at the middles of equal steps are exact for a whole period of a cosine."""
    gust = Gust(at=0.3, duration=0.4, velocity=(7.0, 0.0, -3.0))
    way = STEP * field(gusts=(gust,)).advance(1000).sum(axis=0)
    np.testing.assert_allclose(way, np.array([7.0, 0.0, -3.0]) * 0.4 / 2.0, atol=1e-12)


def test_gusts_and_mean_add_up() -> None:
    gusts = tuple(Gust(at=start, duration=0.5, velocity=(1.0, 2.0, 3.0)) for start in (0.1, 0.3))
    apart = sum(field(gusts=(gust,)).advance(1000) for gust in gusts)
    together = field(mean=(-1.0, 0.5, 0.25), gusts=gusts).advance(1000)
    np.testing.assert_allclose(together, apart + np.array([-1.0, 0.5, 0.25]), atol=1e-12)


def test_the_mean_steps_at_its_time_and_stays() -> None:
    changes = (WindChange(at=0.75, velocity=(0.0, 0.0, 0.0)), WindChange(at=0.25, velocity=(0.0, 3.0, 1.0)))
    wind = field(mean=(2.0, 0.0, 0.0), changes=changes).advance(1000)
    np.testing.assert_array_equal(wind[:250], np.tile([2.0, 0.0, 0.0], (250, 1)))
    np.testing.assert_array_equal(wind[250:750], np.tile([0.0, 3.0, 1.0], (500, 1)))
    np.testing.assert_array_equal(wind[750:], 0.0)


def test_a_change_counts_from_its_own_instant_on() -> None:
    wind = field(changes=(WindChange(at=STEP * 100.5, velocity=(1.0, 0.0, 0.0)),)).advance(200)
    np.testing.assert_array_equal(wind[:, 0], np.repeat([0.0, 1.0], 100))


def test_of_two_changes_at_one_time_the_later_counts() -> None:
    changes = tuple(WindChange(at=0.0, velocity=(speed, 0.0, 0.0)) for speed in (1.0, 2.0))
    np.testing.assert_array_equal(field(mean=(9.0, 0.0, 0.0), changes=changes).advance(3)[:, 0], 2.0)


@pytest.mark.parametrize("parts", [(1,) * 300 + (5700,), (50,) * 120, (4095, 1, 1, 1903), (0, 6000)])
def test_the_wind_does_not_depend_on_how_many_steps_are_drawn_at_once(parts: tuple[int, ...]) -> None:
    """To the last bit, across the blocks that turbulence is made in."""

    def make() -> WindField:
        gust = Gust(at=0.1, duration=5.0, velocity=(1.0, 2.0, 3.0))
        change = WindChange(at=0.123, velocity=(0.0, 1.0, 0.0))
        return field(mean=(3.0, 4.0, 0.5), gusts=(gust,), turbulence=DRYDEN, changes=(change,))

    pieces = []
    source = make()
    for steps in parts:
        pieces.append(source.advance(steps))
        assert pieces[-1].shape == (steps, 3)
    np.testing.assert_array_equal(np.concatenate(pieces), make().advance(6000))


def test_reset_gives_the_same_wind_again() -> None:
    wind = field(mean=(1.0, 0.0, 0.0), gusts=(Gust(at=0.0, duration=1.0, velocity=(1.0, 1.0, 1.0)),), turbulence=DRYDEN)
    first = wind.advance(5000)
    assert not np.array_equal(wind.advance(5000), first)
    wind.reset()
    np.testing.assert_array_equal(wind.advance(5000), first)


def test_a_seed_gives_its_own_turbulence_whatever_else_draws_from_the_generator() -> None:
    rng = np.random.default_rng(3)
    wind = WindField(mean=(0.0, 0.0, 0.0), turbulence=DRYDEN, timestep=STEP, rng=rng)
    rng.normal(size=100)
    np.testing.assert_array_equal(wind.advance(100), field(turbulence=DRYDEN, seed=3).advance(100))
    assert not np.array_equal(
        field(turbulence=DRYDEN, seed=4).advance(100), field(turbulence=DRYDEN, seed=3).advance(100)
    )


def test_turbulence_turns_with_the_mean_wind() -> None:
    """What is along x in a wind from behind is along y in a wind to the left; upwards it is the same."""
    still = field(turbulence=DRYDEN).advance(200)
    along_x = field(mean=(5.0, 0.0, 1.0), turbulence=DRYDEN).advance(200) - [5.0, 0.0, 1.0]
    along_y = field(mean=(0.0, 5.0, 1.0), turbulence=DRYDEN).advance(200) - [0.0, 5.0, 1.0]
    oblique = field(mean=(3.0, 4.0, 1.0), turbulence=DRYDEN).advance(200) - [3.0, 4.0, 1.0]
    u, v, w = still.T
    np.testing.assert_allclose(along_x, still, atol=1e-12)
    np.testing.assert_allclose(along_y, np.stack([-v, u, w], axis=1), atol=1e-12)
    np.testing.assert_allclose(oblique, np.stack([0.6 * u - 0.8 * v, 0.8 * u + 0.6 * v, w], axis=1), atol=1e-12)
