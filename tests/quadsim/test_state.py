"""The named view of a state."""

from __future__ import annotations

import numpy as np
import pytest

from quadsim.state import STATE_NAMES, State


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
    with pytest.raises(AttributeError, match=r"a state has no 'rol'; did you mean 'roll'\? \(there are: x, vx, "):
        _ = state.rol
