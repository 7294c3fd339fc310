"""The named view of a state, and turns of a yaw."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from quadsim.state import (
    KEPT,
    STATE_NAMES,
    TURN,
    Array,
    ReferenceTurns,
    State,
    YawUnwrapper,
    follow_turns,
    nearest_turn,
    unwrapped,
    whole_turns,
    wrapped,
)


def test_a_state_s_entries_have_names_and_what_is_made_of_it_is_a_plain_array() -> None:
    numbers = np.arange(12.0)
    state = numbers.copy().view(State)
    assert [getattr(state, name) for name in STATE_NAMES] == numbers.tolist()
    assert type(state.pitch_rate) is float
    assert {*STATE_NAMES, "shape"} <= {*dir(state)}
    A = np.arange(36.0).reshape(3, 12)
    for made, plain in (
        (state[:3], numbers[:3]),
        (state[[0, 2, 4]], numbers[[0, 2, 4]]),
        (state - 1.0, numbers - 1.0),
        (A @ state, A @ numbers),
        (np.sin(state), np.sin(numbers)),
        (np.concatenate([state, state]), np.tile(numbers, 2)),
    ):
        assert type(made) is np.ndarray
        np.testing.assert_array_equal(made, plain)
    assert isinstance(state.sum(), np.float64)
    assert isinstance(state @ state, np.float64)
    state[4] = 7.0
    assert state.z == 7.0
    with pytest.raises(AttributeError, match="'rol'"):
        _ = state.rol


@given(st.floats(-1e3, 1e3))
def test_a_wrapped_angle_is_the_same_one_within_half_a_turn(angle: float) -> None:
    short = wrapped(angle)
    assert -math.pi < short <= math.pi
    assert math.cos(short - angle) == pytest.approx(1.0, abs=1e-12)
    assert wrapped(np.array([angle]))[0] == short
    assert nearest_turn(angle) == pytest.approx(short, abs=1e-5) or abs(short) > math.pi - 1e-5


@pytest.mark.parametrize("turns", [-3, -1, 0, 1, 2])
def test_half_a_turn_either_way_counts_as_plus_half_a_turn(turns: int) -> None:
    for half in (math.pi, -math.pi, math.nextafter(math.pi, 4.0), math.nextafter(-math.pi, -4.0)):
        assert abs(wrapped(half + TURN * turns)) == pytest.approx(math.pi)
        assert nearest_turn(half + TURN * turns) == pytest.approx(math.pi)
    assert wrapped(-math.pi) == math.pi
    assert nearest_turn(180.0 + 360.0 * turns, turn=360.0) == 180.0
    assert nearest_turn(-179.0 + 360.0 * turns, turn=360.0) == -179.0
    assert nearest_turn(10.0 + 360.0 * turns, to=700.0, turn=360.0) == 730.0


@given(st.lists(st.floats(-3.0, 3.0), min_size=1, max_size=20), st.lists(st.integers(-5, 5), min_size=20, max_size=20))
def test_whole_turns_between_samples_are_taken_away(steps: list[float], turns: list[int]) -> None:
    smooth = np.cumsum(steps)
    np.testing.assert_allclose(unwrapped(smooth + TURN * np.array(turns[: smooth.size]), 0.0), smooth, atol=1e-9)
    assert unwrapped(smooth, 0.0) is smooth


def headed(*yaws: float) -> Array:
    return np.column_stack([np.ones((len(yaws), 3)), np.radians(yaws)])


def test_a_reference_starts_on_the_vehicle_s_turn_and_goes_on_without_jumps() -> None:
    moved = ReferenceTurns().follow(headed(530.0, -179.0, 182.0, 900.0), math.radians(-150.0))
    np.testing.assert_allclose(moved, headed(-190.0, -179.0, -178.0, -180.0), atol=1e-12)
    already = headed(530.0, 541.0)
    assert ReferenceTurns().follow(already, math.radians(500.0)) is already
    for turns in (-2, 0, 1):  # half a turn away, it is always ahead on the same side
        np.testing.assert_allclose(ReferenceTurns().follow(headed(360.0 * turns), math.pi), headed(0.0), atol=1e-12)
    lost = headed(math.nan, 3.0)
    assert ReferenceTurns().follow(lost, 0.0) is lost


def test_a_reference_keeps_its_turn_while_noise_moves_the_vehicle_about_half_a_turn_away() -> None:
    turns = ReferenceTurns()
    rng = np.random.default_rng(2)
    assert turns.follow(headed(-0.1), math.radians(179.9))[0, 3] == math.radians(-0.1)
    for k in range(200):  # the reference itself is on another turn in each period
        seen = math.radians(180.0 + 3.0 * rng.standard_normal())
        moved = turns.follow(headed(-0.1 + 360.0 * (k % 3)), seen)
        assert moved[0, 3] == pytest.approx(math.radians(-0.1))
    assert turns.follow(headed(-0.1), KEPT - math.radians(0.2))[0, 3] == math.radians(-0.1)
    assert turns.follow(headed(-0.1), KEPT)[0, 3] == pytest.approx(math.radians(359.9))  # beyond it comes along,
    assert turns.follow(headed(-0.1), math.radians(175.0))[0, 3] == pytest.approx(math.radians(359.9))  # and stays
    turns.reset()
    assert turns.follow(headed(-0.1), math.radians(175.0))[0, 3] == math.radians(-0.1)


def test_turns_are_counted_from_minus_half_to_half() -> None:
    np.testing.assert_array_equal(
        whole_turns(np.radians([-180.0, -179.0, 0.0, 180.0, 181.0, 900.0])), [-1, 0, 0, 0, 1, 2]
    )


def test_a_loop_leaves_the_yaw_however_it_turns_upside_down() -> None:
    turns = YawUnwrapper(0.0)
    flown = ((math.pi, -2.78), (math.pi, 2.9), (0.1, 0.1))
    yaws = [turns.unwrapped(np.array([roll, 0.0, yaw])) for roll, yaw in flown]
    assert yaws == pytest.approx([-2.78, 2.9 - TURN, 0.1])


def test_many_references_follow_their_vehicles_turns_as_single_ones_do() -> None:
    """Turning references and vehicles, noise, leaps of the vehicle, and yaws that are no number."""
    rng = np.random.default_rng(3)
    count = 6
    rows = 5
    periods = 200
    rates = np.array([0.0, 0.3, -0.5, 2.0, 1.0, 0.2])
    firsts = np.full(count, np.nan)
    singles = [ReferenceTurns() for _ in range(count)]
    moved = 0
    for k in range(periods):
        instants = k + np.arange(rows)
        references = rng.standard_normal((count, rows, 4))
        references[:, :, 3] = wrapped(rates[:, None] * instants)
        yaws = rates * k + 0.5 * rng.standard_normal(count) + 7.0 * (rng.random(count) < 0.05)
        yaws[rng.random(count) < 0.02] = np.nan
        together = follow_turns(references, yaws, firsts)
        alone = np.stack([one.follow(references[i], float(yaws[i])) for i, one in enumerate(singles)])
        assert np.array_equal(together, alone)
        moved += not np.array_equal(together, references)
    assert moved > periods // 2
