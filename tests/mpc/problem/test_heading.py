"""The heading frame: what turns, and that the hover model does not care where it is headed."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from numpy_preparation import equilibrium, nonlinear_model, twisted
from support import linearised

from quadsim.mpc.problem.heading import advance, anchored, predict_in_heading_frame, turn, turn_horizontally
from quadsim.mpc.problem.model import hover_model
from quadsim.mpc.problem.paper import rollout
from quadsim.state import INDEX
from quadsim.vehicle import Vehicle


def test_a_quarter_turn_takes_x_to_y() -> None:
    state = np.zeros(12)
    state[[INDEX["x"], INDEX["vy"]]] = 2.0, 3.0
    turned = turn_horizontally(state, np.array(0.5 * math.pi))
    assert turned[INDEX["y"]] == pytest.approx(2.0)
    assert turned[INDEX["vx"]] == pytest.approx(-3.0)


def test_the_matrix_of_a_turn_turns() -> None:
    state = np.random.default_rng(2).normal(size=12)
    np.testing.assert_allclose(turn(0.7) @ state, turn_horizontally(state, np.array(0.7)), atol=1e-15)


def test_a_prediction_turns_with_its_heading(vehicle: Vehicle) -> None:
    """Pitched by as much, the model at yaw psi goes along psi as it goes along x at yaw zero."""
    model = hover_model(vehicle, 0.05)
    rng = np.random.default_rng(1)
    state = rng.normal(size=(1, 12))
    plan = model.u_bar + rng.normal(size=(1, 5, 4))
    state[0, INDEX["yaw"]] = 0.0
    ahead = rollout(model, state, plan)
    turned = turn_horizontally(state, np.array([2.0]))
    turned[0, INDEX["yaw"]] = 2.0
    predicted = predict_in_heading_frame(model, turned, plan)
    expected = turn_horizontally(ahead, np.full((1, 5), 2.0))
    expected[..., INDEX["yaw"]] += 2.0
    np.testing.assert_allclose(predicted, expected, atol=1e-12)


@pytest.mark.parametrize("yaw", [0.0, 2.0])
def test_under_a_disturbance_it_is_anchored_where_the_vehicle_rests(vehicle: Vehicle, yaw: float) -> None:
    """There it stays; and a level vehicle at hover speed is pushed away as by the disturbance."""
    model = hover_model(vehicle, 0.05)
    push = np.array([0.3, -0.2, 0.25])
    disturbed = replace(
        nonlinear_model(vehicle, 0.05), acceleration=push, angular_acceleration=np.array([0.5, -0.3, 0.1])
    )
    trim = equilibrium(disturbed)
    rest = turn_horizontally(trim.state(yaw), np.array(yaw))
    rest[INDEX["yaw"]] = yaw
    np.testing.assert_allclose(advance(model, rest, trim.speeds, trim), rest, atol=1e-12)
    level = np.zeros(12)
    level[INDEX["yaw"]] = yaw
    moved = predict_in_heading_frame(model, level[None], np.tile(model.u_bar, (1, 1, 1)), trim)[0, 0]
    np.testing.assert_allclose(moved[[1, 3]], 0.05 * push[:2], rtol=0.05)
    np.testing.assert_allclose(moved[[5, 7, 9, 11]], 0.05 * np.array([0.25, 0.5, -0.3, 0.1]), rtol=0.05)


def test_the_anchored_model_is_the_nonlinear_ones_linearisation_at_rest(vehicle: Vehicle) -> None:
    """With a torque that goes with thrust, as a worn rotor's: at rest rotors differ then, and so do their slopes."""
    twist = np.array([2.2, -1.0, 0.1])
    plain = nonlinear_model(vehicle, 0.05, substeps=20)
    disturbed = replace(plain, effectiveness=twisted(plain.effectiveness, twist))
    trim = equilibrium(plain, twist)
    assert np.ptp(trim.speeds) > 20.0
    A, B, _ = linearised(disturbed, trim.state(), trim.speeds)
    model = anchored(hover_model(vehicle, 0.05), trim)
    np.testing.assert_allclose(model.A, A, atol=1e-7)
    np.testing.assert_allclose(model.B, B, atol=1e-7)
    np.testing.assert_array_equal(model.u_bar, trim.speeds)
