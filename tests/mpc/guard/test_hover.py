"""The law of hover: the infinite horizon's gain, the same closed loop for every vehicle, and tilt within its bound."""

from __future__ import annotations

import math

import numpy as np
import pytest
import scipy.linalg
from scripted_controller import PERIOD, advance, bounds, level, model, random_state

from quadsim.assets import vehicle_path
from quadsim.mpc.guard.hover import ACCEPTABLE, ACCEPTABLE_ACCELERATION, HoverLaw
from quadsim.mpc.problem.heading import predict_in_heading_frame, turn
from quadsim.mpc.problem.model import hover_model
from quadsim.state import INDEX
from quadsim.vehicle import load_vehicle

VEHICLES = ("lopes2011", "hummingbird", "crazyflie2")


@pytest.mark.parametrize("name", VEHICLES)
def test_every_vehicle_has_the_same_closed_loop(name: str) -> None:
    hover = hover_model(load_vehicle(vehicle_path(name)), PERIOD)
    law = HoverLaw(hover, tilt=0.2)
    closed = hover.A - hover.B @ np.linalg.solve(law.slope, law.gain)
    decay = np.sort(-np.log(np.abs(np.linalg.eigvals(closed))) / PERIOD)
    assert decay[0] > 1.5  # [1/s]
    reference = HoverLaw(model(), tilt=0.2)
    np.testing.assert_allclose(law.gain, reference.gain, rtol=1e-6, atol=1e-7)


def test_the_gain_is_the_infinite_horizon_s() -> None:
    law = HoverLaw(model(), tilt=0.2)
    weight = law.slope.T @ np.diag(np.array(ACCEPTABLE_ACCELERATION) ** -2.0) @ law.slope
    A, B = model().A, model().B
    P = scipy.linalg.solve_discrete_are(A, B, np.diag(ACCEPTABLE**-2.0), weight)
    expected = np.linalg.solve(weight + B.T @ P @ B, B.T @ P @ A)
    error = random_state(1, 1e-3)
    np.testing.assert_allclose(law.correction(error, 0.0), -expected @ error, rtol=1e-6)


@pytest.mark.parametrize("yaw", [0.5, math.pi / 2, math.pi, -2.0])
def test_law_and_prediction_turn_with_the_heading(yaw: float) -> None:
    law, T, error = HoverLaw(model(), tilt=0.2), turn(yaw), random_state(2)
    np.testing.assert_allclose(law.correction(T @ error, yaw), law.correction(error, 0.0), atol=1e-12)
    state, speeds = random_state(3), model().u_bar + np.array([3.0, -2.0, 1.0, 0.5])
    state[INDEX["yaw"]] = 0.0
    ahead = np.zeros(12)
    ahead[INDEX["yaw"]] = yaw
    np.testing.assert_allclose(advance(T @ state + ahead, speeds), T @ advance(state, speeds) + ahead, atol=1e-12)


def test_far_away_the_law_demands_its_largest_tilt_and_no_more() -> None:
    law = HoverLaw(model(), tilt=0.15)
    leaning = np.zeros(12)
    leaning[INDEX["x"]] = -500.0
    leaning[INDEX["pitch"]] = 0.15  # towards +x
    np.testing.assert_allclose(law.correction(leaning, 0.0), 0.0, atol=1e-9)
    leaning[INDEX["z"]] = -500.0
    leaning[INDEX["yaw"]] = 50.0
    np.testing.assert_allclose((law.slope @ law.correction(leaning, 0.0))[[0, 3]], [2.0, -2.0])


def test_the_law_s_plan_is_its_closed_loop() -> None:
    law, state, target = HoverLaw(model(), tilt=0.2), random_state(4, 0.05), np.zeros(12)
    target[INDEX["vz"]] = -0.5
    plan = law.plan(state, target, model().u_bar, bounds(), 200, level())
    state = predict_in_heading_frame(model(), state[None], plan[None], level())[0, -1]
    assert state[INDEX["vz"]] == pytest.approx(-0.5, abs=1e-3)
    assert state[INDEX["z"]] == pytest.approx(-0.5 * 200 * PERIOD, abs=1e-2)
    np.testing.assert_allclose(np.delete(state, [INDEX["z"], INDEX["vz"]]), 0.0, atol=1e-3)
