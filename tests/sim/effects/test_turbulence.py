"""Dryden turbulence: parameters, the exact time step, and the samples' statistics against MIL-F-8785C."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import expm

from quadsim.sim.effects import turbulence
from quadsim.sim.effects.turbulence import Dryden, Turbulence, discretise_filters
from quadsim.state import Array

DRYDEN = Dryden(altitude=6.096, wind_speed_20ft=7.7, airspeed=5.0)
STATIONARY = np.array([[1.0, 0.5], [0.5, 0.5]])
LATERAL = np.array([np.sqrt(1.5), (1.0 - np.sqrt(3.0)) / np.sqrt(2.0)])
RATIOS = [1e-6, 1e-4, 0.01, 0.5, 5.0]


def spectrum(dryden: Dryden, frequency: Array) -> Array:
    """(K, 3) Phi_u, Phi_v, Phi_w of MIL-F-8785C, Sec. 3.7.1.2, per hertz: Phi(Omega) dOmega / df."""
    wave_number = 2.0 * np.pi * frequency / dryden.airspeed  # [rad/m]
    x2 = np.square(wave_number[:, None] * dryden.lengths)
    scale = np.square(dryden.intensities) * dryden.lengths / np.pi
    longitudinal = 2.0 / (1.0 + x2)
    transverse = (1.0 + 3.0 * x2) / np.square(1.0 + x2)
    per_wave_number = scale * np.where([True, False, False], longitudinal, transverse)
    return per_wave_number * 2.0 * np.pi / dryden.airspeed


def autocovariance(dryden: Dryden, lag: Array) -> Array:
    """(K, 3) covariance of each component with itself `lag` [s] later."""
    r = lag[:, None] * dryden.airspeed / dryden.lengths
    return np.square(dryden.intensities) * np.exp(-r) * (1.0 - r * [0.0, 0.5, 0.5])


def test_lengths_and_intensities_at_100_feet() -> None:
    """MIL-F-8785C, Figs. 10 and 11, worked out in feet and knots: 0.177 + 0.0823 = 0.2593."""
    dryden = Dryden(altitude=30.48, wind_speed_20ft=15.0, airspeed=5.0)
    np.testing.assert_allclose(dryden.lengths / 0.3048, [505.17, 505.17, 100.0], rtol=1e-5)
    np.testing.assert_allclose(dryden.intensities, [1.715849 * 1.5, 1.715849 * 1.5, 1.5], rtol=1e-6)


def test_at_1000_feet_the_model_is_isotropic() -> None:
    """0.177 + 0.823 = 1: it meets the medium altitudes' model, where all three axes are alike."""
    dryden = Dryden(altitude=304.8, wind_speed_20ft=10.0, airspeed=5.0)
    np.testing.assert_allclose(dryden.lengths, 304.8, rtol=1e-12)
    np.testing.assert_allclose(dryden.intensities, 1.0, rtol=1e-12)


def test_the_spectra_integrate_to_the_variances() -> None:
    """What the tests compare with: one-sided, so over positive frequencies alone."""
    frequency = np.concatenate([[0.0], np.geomspace(1e-6, 1e5, 20_000)])
    np.testing.assert_allclose(
        np.trapezoid(spectrum(DRYDEN, frequency), frequency, axis=0), np.square(DRYDEN.intensities), rtol=1e-4
    )


@pytest.mark.parametrize("ratio", RATIOS)
def test_the_time_step_is_van_loans(ratio: float) -> None:
    """C. F. Van Loan, "Computing Integrals Involving the Matrix Exponential", 1978: exp of [[-F, G G'], [0, F']] dt."""
    transition, factor = discretise_filters(ratio)
    drift = np.array([[-1.0, 0.0], [1.0, -1.0]])
    noise = np.array([[2.0, 0.0], [0.0, 0.0]])
    exponential = expm(ratio * np.block([[-drift, noise], [np.zeros((2, 2)), drift.T]]))
    np.testing.assert_allclose(transition, exponential[2:, 2:].T, rtol=1e-10, atol=1e-12)
    covariance = exponential[2:, 2:].T @ exponential[:2, 2:]
    np.testing.assert_allclose(factor @ factor.T, covariance, rtol=1e-9)


@pytest.mark.parametrize("ratio", RATIOS)
def test_the_stationary_covariance_is_preserved_by_every_step(ratio: float) -> None:
    transition, factor = discretise_filters(ratio)
    np.testing.assert_allclose(transition @ STATIONARY @ transition.T + factor @ factor.T, STATIONARY, atol=1e-15)


def test_the_sampled_autocovariance_is_that_of_the_continuous_process() -> None:
    ratio = 0.3
    transition, _ = discretise_filters(ratio)
    for k in range(20):
        carried = np.linalg.matrix_power(transition, k) @ STATIONARY
        assert carried[0, 0] == pytest.approx(np.exp(-k * ratio), rel=1e-12)
        assert LATERAL @ carried @ LATERAL == pytest.approx(np.exp(-k * ratio) * (1.0 - k * ratio / 2.0), rel=1e-12)


@pytest.fixture(scope="module")
def record() -> Array:
    """Samples 20 ms apart for eleven hours: 4800 correlation times of u and v, 34000 of w."""
    return Turbulence(DRYDEN, timestep=0.02, rng=np.random.default_rng(1)).advance(2**21)


def welch(record: Array, *, rate: float, size: int) -> tuple[Array, Array]:
    """Frequencies (K,) [Hz] and one-sided spectra (K, 3) of a record, by Welch's method with half overlapping windows.

    SciPy's, without the second that its package takes to load.
    """
    window = np.hanning(size + 1)[:-1, None]
    starts = range(0, len(record) - size + 1, size // 2)
    segments = (record[first : first + size] for first in starts)
    power = sum(np.square(np.abs(np.fft.rfft(window * (each - each.mean(axis=0)), axis=0))) for each in segments)
    return np.fft.rfftfreq(size, 1.0 / rate), 2.0 * power / (len(starts) * rate * np.square(window).sum())


def test_the_spectra_are_those_of_the_specification(record: Array) -> None:
    """By Welch's method.  The mean over a band B of a record T is known to 1 / sqrt(B T), 0.4 to 0.9 % here.

    Four of them are allowed, and 1 % for what sampling folds over from beyond 25 Hz and the window spreads.
    """
    frequency, density = welch(record, rate=50.0, size=4096)
    for low, high in ((0.07, 0.35), (0.35, 0.8), (0.8, 1.6), (1.6, 3.0)):
        band = (frequency >= low) & (frequency < high)
        ratio = np.mean(density[band] / spectrum(DRYDEN, frequency[band]), axis=0)
        np.testing.assert_allclose(ratio, 1.0, atol=0.01 + 4.0 / np.sqrt(band.sum() * len(record) / 4096))


def test_variances_and_covariances_in_time(record: Array) -> None:
    """Known to sigma^2 sqrt(2 tau / T) at most, 2 % for u and v and 0.8 % for w; four times that is allowed."""
    variance = np.square(DRYDEN.intensities)
    assert np.all(np.abs(record.var(axis=0) - variance) < variance * [0.08, 0.08, 0.03])
    for lag in (1, 10, 50, 100):
        measured = np.mean(record[:-lag] * record[lag:], axis=0)
        expected = autocovariance(DRYDEN, np.array([0.02 * lag]))[0]
        assert np.all(np.abs(measured - expected) < variance * [0.08, 0.08, 0.03])
    np.testing.assert_allclose(np.corrcoef(record.T), np.eye(3), atol=0.06)


def test_steps_as_long_as_the_correlation_are_exact_as_well() -> None:
    """One sample per second, 0.8 correlation times of w: any approximate filter is far off.

    The standard deviation of a covariance over the record T is sigma^2 sqrt(2 tau / T) at most, 0.8 % for u and v and
    0.3 % for w; four of them are allowed.
    """
    record = Turbulence(DRYDEN, timestep=1.0, rng=np.random.default_rng(2)).advance(2**18)
    variance = np.square(DRYDEN.intensities)
    for lag in (0, 1, 2, 4):
        measured = np.mean(record[: len(record) - lag] * record[lag:], axis=0)
        expected = autocovariance(DRYDEN, np.array([float(lag)]))[0]
        assert np.all(np.abs(measured - expected) < variance * [0.035, 0.035, 0.015])


def test_it_is_stationary_from_the_first_sample_on(monkeypatch: pytest.MonkeyPatch) -> None:
    """Over 1000 seeds a variance is known to sqrt(2/1000) = 4.5 %; four times that is allowed."""
    monkeypatch.setattr(turbulence, "_BLOCK", 2)  # nothing is made that is not looked at
    starts = [Turbulence(DRYDEN, timestep=1.0, rng=np.random.default_rng(seed)).advance(2) for seed in range(1000)]
    first, second = np.moveaxis(np.array(starts), 1, 0)
    variance = np.square(DRYDEN.intensities)
    np.testing.assert_allclose(np.mean(first**2, axis=0) / variance, 1.0, atol=0.18)
    np.testing.assert_allclose(np.mean(second**2, axis=0) / variance, 1.0, atol=0.18)
    following = autocovariance(DRYDEN, np.array([1.0]))[0] / variance
    np.testing.assert_allclose(np.mean(first * second, axis=0) / variance, following, atol=0.18)


def test_blocks_join_without_a_seam() -> None:
    """Neighbouring samples are close wherever blocks of 4096 meet."""
    samples = Turbulence(DRYDEN, timestep=1e-3, rng=np.random.default_rng(5)).advance(5 * 4096)
    steps = np.abs(np.diff(samples, axis=0))
    scale = steps.std(axis=0)
    assert np.all(steps[4095::4096] < 6.0 * scale)


def test_no_wind_speed_gives_no_turbulence() -> None:
    calm = Dryden(altitude=6.0, wind_speed_20ft=0.0, airspeed=1.0)
    np.testing.assert_array_equal(Turbulence(calm, timestep=1e-3, rng=np.random.default_rng(0)).advance(10), 0.0)
