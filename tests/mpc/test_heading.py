"""The heading frame: what turns, and that the hover model does not care where it is headed."""

from __future__ import annotations

import math

import numpy as np
import pytest

from mpc.heading import predict_in_heading_frame, turn_horizontally
from mpc.model import hover_model
from mpc.prediction import rollout
from quadsim.state import INDEX
from quadsim.vehicle import Vehicle


def test_a_quarter_turn_takes_x_to_y() -> None:
    state = np.zeros(12)
    state[[INDEX["x"], INDEX["vy"]]] = 2.0, 3.0
    turned = turn_horizontally(state, np.array(0.5 * math.pi))
    assert turned[INDEX["y"]] == pytest.approx(2.0)
    assert turned[INDEX["vx"]] == pytest.approx(-3.0)


def test_a_prediction_turns_with_its_heading(vehicle: Vehicle) -> None:
    """Pitched by as much, the model at yaw psi goes along psi as it goes along x at yaw zero."""
    model, rng = hover_model(vehicle, 0.05), np.random.default_rng(1)
    state, plan = rng.normal(size=(1, 12)), model.u_bar + rng.normal(size=(1, 5, 4))
    state[0, INDEX["yaw"]] = 0.0
    ahead = rollout(model, state, plan)
    turned = turn_horizontally(state, np.array([2.0]))
    turned[0, INDEX["yaw"]] = 2.0
    predicted = predict_in_heading_frame(model, turned, plan)
    expected = turn_horizontally(ahead, np.full((1, 5), 2.0))
    expected[..., INDEX["yaw"]] += 2.0
    np.testing.assert_allclose(predicted, expected, atol=1e-12)
