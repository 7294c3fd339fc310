"""Dead completion: what is measured passes, what is missing or frozen follows the model."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import pytest
from scipy.linalg import block_diag
from scripted_controller import PERIOD, advance, level, model, random_state

from quadsim.mpc.guard.completion import ACCELERATION, PLAUSIBLE, StateCompletion
from quadsim.state import EULER, EULER_RATE, INDEX, POSITION, VELOCITY, Array


def moving(periods: int, *, acceleration: float = 0.0) -> tuple[Array, Array]:
    """States (K + 1, 12) of the model under commands (K, 4), pushed along x [m/s^2]."""
    speeds = model().u_bar + np.random.default_rng(5).uniform(-1.0, 1.0, (periods, 4))
    states = [random_state(6)]
    for command in speeds:
        states.append(advance(states[-1], command))
        states[-1][INDEX["vx"]] += acceleration * PERIOD
    return np.array(states), speeds


def complete(states: Array, speeds: Array, missing: Sequence[int], *, value: float = math.nan) -> Array:
    """What is made of states whose channels go missing after the first."""
    completion = StateCompletion(model())
    known = [completion.complete(states[0], model().u_bar, level())]
    for state, command in zip(states[1:], speeds, strict=True):
        measured = state.copy()
        measured[list(missing)] = value
        known.append(completion.complete(measured, command, level()))
    return np.array(known)


def test_measured_channels_pass_unchanged() -> None:
    states, speeds = moving(20)
    np.testing.assert_array_equal(complete(states, speeds, []), states)


@pytest.mark.parametrize("missing", [*[(channel,) for channel in range(12)], POSITION, EULER + EULER_RATE, range(12)])
def test_missing_channels_follow_the_model(missing: Sequence[int]) -> None:
    states, speeds = moving(20)
    known = complete(states, speeds, missing)
    np.testing.assert_allclose(known, states, atol=1e-9)
    there = np.setdiff1d(np.arange(12), missing)
    np.testing.assert_array_equal(known[:, there], states[:, there])


@pytest.mark.parametrize("value", [math.inf, -1e300, 2e5])
def test_implausible_numbers_are_missing_ones(value: float) -> None:
    states, speeds = moving(10)
    np.testing.assert_allclose(complete(states, speeds, POSITION, value=value), states, atol=1e-9)


def test_available_channels_correct_missing_ones() -> None:
    states, speeds = moving(20, acceleration=1.0)
    x, vx = INDEX["x"], INDEX["vx"]
    blind = complete(states, speeds, (x, vx))
    corrected = complete(states, speeds, (vx,))
    assert abs(blind[-1] - states[-1])[vx] == pytest.approx(1.0)  # 1 m/s^2 for 1 s
    assert abs(corrected[-1] - states[-1])[vx] < 0.3


@pytest.mark.parametrize("group", [POSITION, VELOCITY, EULER, EULER_RATE, tuple(range(12))])
def test_frozen_numbers_are_missing_ones(group: Sequence[int]) -> None:
    states, speeds = moving(20)
    completion = StateCompletion(model())
    completion.complete(states[0], model().u_bar, level())
    for state, command in zip(states[1:], speeds, strict=True):
        measured = state.copy()
        measured[list(group)] = states[0][list(group)]
        known = completion.complete(measured, command, level())
        np.testing.assert_allclose(known, state, atol=5e-2)  # until the prediction has left the numbers, they are taken
    assert completion.unseen[list(group)].min() > 0
    assert completion.complete(state + 1e-6, command, level()).tolist() == (state + 1e-6).tolist()
    assert not completion.unseen.any()


def test_a_vehicle_at_rest_or_on_the_ground_is_not_frozen() -> None:
    completion, rest = StateCompletion(model()), np.zeros(12)
    for _ in range(3):
        completion.complete(rest, model().u_bar, level())
    assert not completion.unseen.any()
    for _ in range(3):
        completion.complete(rest, np.zeros(4), level(), free=False)
    assert not completion.unseen.any()
    completion.complete(rest, np.zeros(4), level())
    assert completion.unseen.any()


def test_channels_missing_for_long_are_recovered_from_the_rest() -> None:
    completion = StateCompletion(model())
    for _ in range(1000):
        completion.complete(np.full(12, math.nan), model().u_bar, level())
    states, speeds = moving(100)
    tilting = [INDEX[name] for name in ("roll", "roll_rate", "pitch", "pitch_rate")]  # seen in how it moves
    for state, command in zip(states, speeds, strict=False):
        measured = state.copy()
        measured[tilting] = math.nan
        known = completion.complete(measured, command, level())
    np.testing.assert_allclose(known[tilting], state[tilting], atol=0.05)


def test_nothing_measured_ever_stays_finite() -> None:
    completion, rng = StateCompletion(model()), np.random.default_rng(7)
    for k in range(1000):
        seen = rng.normal(size=12) if k % 250 == 0 else np.zeros(3)
        known = completion.complete(seen, rng.uniform(-1e5, 1e5, 4), level())
        assert (np.abs(known) <= PLAUSIBLE).all()


def test_the_process_noise_is_an_acceleration_constant_over_a_period() -> None:
    """White from one period to the next, along each coordinate and about each angle."""
    gain = np.array([[0.5 * PERIOD**2], [PERIOD]])
    pairs = [sigma**2 * gain @ gain.T for sigma in ACCELERATION]
    np.testing.assert_allclose(StateCompletion(model())._process, block_diag(*3 * pairs[:1], *3 * pairs[1:]))
