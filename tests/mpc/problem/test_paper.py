"""Eqs. (2)-(19): the prediction map against recursion and MuJoCo, cost and rows against what they condense."""

from __future__ import annotations

import numpy as np
import pytest
from support import paper_problem, random_problem

from quadsim.mpc.forms.condensing import Condensed
from quadsim.mpc.problem.model import hover_model
from quadsim.mpc.problem.ocp import Problem, Query
from quadsim.mpc.problem.paper import cost, prediction, rollout, slew_matrix
from quadsim.mpc.problem.qp import QPRows
from quadsim.sim.plant import Plant
from quadsim.state import Array, make_state
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
    state = rng.normal(size=3)
    plan = rng.normal(size=(horizon, 2))
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


def eq_5(problem: Problem, state: Array, plan: Array, desired: Array) -> float:
    """The cost as printed, summed step by step."""
    objective = problem.objective
    u_bar = problem.model.u_bar
    total = 0.0
    for xi, u, y_d in zip(rollout(problem.model, state[None], plan[None])[0], plan, desired, strict=True):
        error = objective.C_r @ xi - y_d
        effort = u - u_bar
        total += error @ objective.Q_y @ error + effort @ objective.Q_u @ effort
    return float(total)


@pytest.mark.parametrize("horizon", [1, 3, 12])
def test_condensed_cost_differs_from_eq_5_by_a_constant(horizon: int) -> None:
    rng = np.random.default_rng(horizon)
    problem = random_problem(rng, horizon=horizon)
    terms = cost(prediction(problem.model, horizon), problem.objective)
    state = rng.normal(size=3)
    desired = rng.normal(size=(horizon, 3))
    gradient = terms.gradient(state, desired, problem.model.u_bar)
    differences = []
    for _ in range(5):
        plan = rng.normal(size=(horizon, 2)) * 3.0
        u = plan.ravel()
        differences.append(eq_5(problem, state, plan, desired) - (0.5 * u @ terms.H @ u + gradient @ u))
    np.testing.assert_allclose(differences, differences[0], rtol=1e-9)


def test_hessian_is_symmetric_positive_definite() -> None:
    problem = paper_problem()
    H = cost(prediction(problem.model, problem.horizon), problem.objective).H
    np.testing.assert_array_equal(H, H.T)
    assert np.linalg.eigvalsh(H)[0] >= 2 * 0.01 * (1 - 1e-9)  # 2 Q_u is a lower bound


def test_f3_is_minus_twice_q_u_repeated() -> None:
    """Erratum of Eq. (10), which prints +2."""
    problem = paper_problem()
    terms = cost(prediction(problem.model, problem.horizon), problem.objective)
    np.testing.assert_array_equal(terms.F3, np.tile(-2.0 * problem.objective.Q_u, (problem.horizon, 1)))


@pytest.mark.parametrize("name", ["paper-constrained", "paper-unconstrained"])
def test_at_hover_on_the_reference_the_optimum_is_u_bar(name: str) -> None:
    problem = paper_problem(name)
    terms = cost(prediction(problem.model, problem.horizon), problem.objective)
    hover = make_state(position=(3.0, -4.0, 10.0))
    desired = np.tile(problem.objective.C_r @ hover, (problem.horizon, 1))
    u_bar = problem.model.u_bar
    optimum = np.linalg.solve(terms.H, -terms.gradient(hover, desired, u_bar)).reshape(-1, 4)
    np.testing.assert_allclose(optimum, np.tile(u_bar, (problem.horizon, 1)), atol=1e-4)
    # With the sign that Eq. (10) prints, and no offset of the linearisation, the last inputs tend to -u_bar.
    as_printed = terms.F1 @ hover + terms.F2 @ desired.ravel() - terms.F3 @ u_bar
    last = np.linalg.solve(terms.H, -as_printed)[-4:]
    np.testing.assert_allclose(last, -u_bar, rtol=0.1)


@pytest.mark.parametrize("horizon", [1, 2, 9])
def test_rows_are_the_printed_inequalities(horizon: int) -> None:
    """A_ineq u <= G1 xi(k) + G2 u(k-1) + G3, with the offset of the linearisation.  Eqs. (14), (16)-(19)."""
    rng = np.random.default_rng(horizon)
    problem = random_problem(rng, horizon=horizon, n_c=2)
    bounds = problem.bounds
    model = problem.model
    assert bounds is not None
    state = rng.normal(size=3)
    before = rng.normal(size=2)
    plan = rng.normal(size=(horizon, 2))
    qp = Condensed(problem).assemble(Query(state, np.zeros((horizon, problem.objective.C_r.shape[0])), before))
    maps = prediction(model, horizon)
    steps = slew_matrix(horizon, 2)
    of_outputs = np.kron(np.eye(horizon), bounds.C_c)
    first = np.concatenate([before, np.zeros(2 * (horizon - 1))])
    outputs = of_outputs @ (maps.Phi @ state + maps.Psi @ (plan - model.u_bar).ravel())
    slews = steps @ plan.ravel() - first
    slack = [
        np.tile(bounds.y_max, horizon) - outputs,
        outputs - np.tile(bounds.y_min, horizon),
        np.tile(bounds.delta_max, horizon) - slews,
        slews - np.tile(bounds.delta_min, horizon),
    ]
    scale = np.tile(problem.rows.scale[QPRows(problem).origin], horizon)
    values = qp.G @ plan.ravel()
    ours = np.concatenate([qp.h_u - values, values - qp.h_l]) / np.tile(scale, 2)
    ours = np.sort(ours[np.isfinite(ours)])
    printed = np.sort(np.concatenate(slack))
    np.testing.assert_allclose(ours, printed, atol=1e-12)
