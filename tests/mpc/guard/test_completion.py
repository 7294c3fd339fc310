"""Dead completion: what is measured passes, what is missing or frozen follows the model."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import pytest
from scipy.linalg import block_diag
from scripted_controller import PERIOD, Scripted, advance, call, guard, model, pressed, random_state

from quadsim.controller import Phase
from quadsim.mpc.guard.contract import FallbackSettings
from quadsim.mpc.guard.numbers import ACCELERATION, NOISE, PLAUSIBLE, UNKNOWN, fallback_numbers
from quadsim.mpc.problem.equilibrium import Trim
from quadsim.mpc.problem.heading import turn
from quadsim.state import EULER, EULER_RATE, INDEX, POSITION, VELOCITY, Array

FOREVER = FallbackSettings(unseen=1e9)


class Completion:
    """The states that a law is given, which is asked however long nothing has been measured."""

    def __init__(self, trim: Trim | None = None) -> None:
        self.law = Scripted()
        if trim is not None:
            self.law.trim = trim  # type: ignore[attr-defined]
        self.guarded = guard(self.law, settings=FOREVER)

    def __call__(self, measured: Array, acting: Array, phase: Phase = Phase.FLYING) -> Array:
        """The state (12,) now, under the speeds (4,) since the last one."""
        call(self.guarded, measured, acting=acting, phase=phase)
        return self.law.calls[-1][1]

    @property
    def unseen(self) -> Array:
        """(12,) periods since each channel was measured."""
        unseen = self.law.calls[-1][0].unseen
        assert unseen is not None
        return unseen


def process_noise() -> Array:
    """(12, 12) of accelerations, white from one period to the next, along each coordinate and about each angle."""
    gain = np.array([[0.5 * PERIOD**2], [PERIOD]])
    pairs = [sigma**2 * gain @ gain.T for sigma in ACCELERATION]
    return block_diag(*3 * pairs[:1], *3 * pairs[1:])


def filtered(measured: Array, speeds: Array, trim: Trim) -> Array:
    """States (K, 12) of a Kalman filter with all measured channels (K, 12) at once, under speeds (K, 4) before each."""
    state = np.zeros(12)
    P = np.diag(UNKNOWN**2)
    R = np.diag(NOISE**2)
    states = []
    for row, command in zip(measured, speeds, strict=True):
        T = turn(float(state[INDEX["yaw"]]))
        A = T @ model().A @ T.T
        predicted = advance(state, command, trim)
        P = A @ P @ A.T + process_noise()
        seen = np.flatnonzero(np.isfinite(row))
        K = P[:, seen] @ np.linalg.inv(P[np.ix_(seen, seen)] + R[np.ix_(seen, seen)])
        state = predicted + K @ (row[seen] - predicted[seen])
        state[seen] = row[seen]  # measured channels pass unchanged
        P = P - K @ P[seen]
        if len(seen) == 12:
            P = R
        states.append(state)
    return np.array(states)


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
    completion = Completion()
    known = [completion(states[0], model().u_bar)]
    for state, command in zip(states[1:], speeds, strict=True):
        measured = state.copy()
        measured[list(missing)] = value
        known.append(completion(measured, command))
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
    x = INDEX["x"]
    vx = INDEX["vx"]
    blind = complete(states, speeds, (x, vx))
    corrected = complete(states, speeds, (vx,))
    assert abs(blind[-1] - states[-1])[vx] == pytest.approx(1.0)  # 1 m/s^2 for 1 s
    assert abs(corrected[-1] - states[-1])[vx] < 0.3


@pytest.mark.parametrize("seed", range(4))
def test_the_state_is_a_kalman_filter_s(seed: int) -> None:
    """Of whatever channels are measured, of a vehicle that is pressed, whatever its heading."""
    rng = np.random.default_rng(seed)
    speeds = pressed().speeds + rng.uniform(-1.0, 1.0, (40, 4))
    states = [0.1 * rng.normal(size=12)]
    states[0][INDEX["yaw"]] = rng.uniform(-3.0, 3.0)
    for command in speeds[1:]:
        states.append(advance(states[-1], command, pressed()) + 1e-3 * rng.normal(size=12))
    measured = np.array(states)
    measured[1:][rng.uniform(size=(39, 12)) < 0.4] = math.nan
    measured[20:25] = math.nan
    completion = Completion(pressed())
    known = np.array([completion(row, command) for row, command in zip(measured, speeds, strict=True)])
    np.testing.assert_allclose(known, filtered(measured, speeds, pressed()), rtol=1e-8, atol=1e-9)


@pytest.mark.parametrize("group", [POSITION, VELOCITY, EULER, EULER_RATE, tuple(range(12))])
def test_frozen_numbers_are_missing_ones(group: Sequence[int]) -> None:
    states, speeds = moving(20)
    completion = Completion()
    completion(states[0], model().u_bar)
    for state, command in zip(states[1:], speeds, strict=True):
        measured = state.copy()
        measured[list(group)] = states[0][list(group)]
        known = completion(measured, command)
        np.testing.assert_allclose(known, state, atol=5e-2)  # until the prediction has left the numbers, they are taken
    assert completion.unseen[list(group)].min() > 0
    assert completion(state + 1e-6, command).tolist() == (state + 1e-6).tolist()
    assert not completion.unseen.any()


def test_a_vehicle_at_rest_or_on_the_ground_is_not_frozen() -> None:
    completion = Completion()
    rest = np.zeros(12)
    for _ in range(3):
        completion(rest, model().u_bar)
    assert not completion.unseen.any()
    for phase in (Phase.LANDED, Phase.ARMED, Phase.CRASHED):
        completion(rest, np.zeros(4), phase)
        assert not completion.unseen.any()
    completion(rest, np.zeros(4))
    assert completion.unseen.any()


def test_channels_missing_for_long_are_recovered_from_the_rest() -> None:
    completion = Completion()
    states, speeds = moving(100)
    completion(states[0], speeds[0])
    for _ in range(1000):
        completion(np.full(12, math.nan), model().u_bar)
    tilting = [INDEX[name] for name in ("roll", "roll_rate", "pitch", "pitch_rate")]  # seen in how it moves
    for state, command in zip(states, speeds, strict=False):
        measured = state.copy()
        measured[tilting] = math.nan
        known = completion(measured, command)
    np.testing.assert_allclose(known[tilting], state[tilting], atol=0.05)


def test_nothing_measured_ever_stays_finite() -> None:
    completion = Completion()
    rng = np.random.default_rng(7)
    for k in range(1000):
        seen = rng.normal(size=12) if k % 250 == 0 else np.zeros(3)
        known = completion(seen, rng.uniform(-1e5, 1e5, 4))
        assert (np.abs(known) <= PLAUSIBLE).all()


def test_the_process_noise_is_an_acceleration_constant_over_a_period() -> None:
    """The C has the upper triangles of one pair of a coordinate and its rate, and of one of an angle and its rate."""
    process = fallback_numbers(model(), None, FallbackSettings().within({}))["process"]
    pairs = (process_noise()[:2, :2], process_noise()[6:8, 6:8])
    np.testing.assert_allclose(process, np.concatenate([pair[np.triu_indices(2)] for pair in pairs]))
