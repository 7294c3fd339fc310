"""Eqs. (2)-(3): the prediction map, against recursion and against MuJoCo."""

from __future__ import annotations

import numpy as np
import pytest
from support import paper_problem, random_problem

from mpc.model import hover_model
from mpc.paper.prediction import prediction, rollout
from quadsim.sim.plant import Plant
from quadsim.state import make_state
from quadsim.vehicle import Vehicle


def prediction_error(vehicle: Vehicle, steps: int, size: float) -> float:
    """Largest difference between the linear prediction and MuJoCo after a deviation of relative size `size`."""
    model = hover_model(vehicle, 0.05)
    rng = np.random.default_rng(7)
    state = make_state(position=(1.0, 2.0, 3.0)) + 0.1 * size * rng.uniform(-1, 1, 12)
    plan = model.u_bar + 0.5 * size * rng.uniform(-1, 1, (steps, 4))
    flown = []
    with Plant(vehicle) as plant:
        plant.reset(state)
        for speeds in plan:
            plant.advance(speeds, 50)
            flown.append(plant.state())
    return float(np.abs(rollout(model, state[None], plan[None])[0] - np.array(flown)).max())


@pytest.mark.parametrize("horizon", [1, 2, 7, 50])
def test_stacked_prediction_equals_the_recursion(horizon: int) -> None:
    rng = np.random.default_rng(horizon)
    model = random_problem(rng, horizon=horizon).model
    maps = prediction(model, horizon)
    state, plan = rng.normal(size=3), rng.normal(size=(horizon, 2))
    stacked = maps.Phi @ state + maps.Psi @ (plan - model.u_bar).ravel()
    np.testing.assert_allclose(stacked.reshape(horizon, 3), rollout(model, state[None], plan[None])[0], atol=1e-12)


def test_blocks_are_those_of_eq_3() -> None:
    model = paper_problem().model
    maps = prediction(model, 4)
    Psi = maps.Psi.reshape(4, 12, 4, 4)
    np.testing.assert_allclose(Psi[2, :, 0], model.A @ model.A @ model.B, atol=1e-15)
    np.testing.assert_array_equal(Psi[2, :, 2], model.B)
    assert not Psi[1, :, 2:].any()  # the future does not act on the past
    np.testing.assert_allclose(maps.Phi[:12], model.A)


@pytest.mark.parametrize(("steps", "largest"), [(1, 1e-4), (50, 1e-2)])
def test_prediction_error_near_hover_falls_quadratically(vehicle: Vehicle, steps: int, largest: float) -> None:
    sizes = 0.1 * 0.5 ** np.arange(4)
    errors = np.array([prediction_error(vehicle, steps, size) for size in sizes])
    assert errors[-1] < largest
    orders = np.log2(errors[:-1] / errors[1:])
    np.testing.assert_allclose(orders, 2.0, atol=0.15)
