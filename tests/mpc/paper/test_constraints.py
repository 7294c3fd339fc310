"""Eqs. (12)-(20): the condensed rows against the inequalities they stand for."""

from __future__ import annotations

import numpy as np
import pytest
from support import paper_problem, random_problem

from mpc.paper.constraints import inequalities
from mpc.paper.prediction import prediction, rollout


@pytest.mark.parametrize("horizon", [1, 2, 9])
def test_rows_are_the_printed_inequalities_in_the_printed_order(horizon: int) -> None:
    rng = np.random.default_rng(horizon)
    problem = random_problem(rng, horizon=horizon, n_c=2)
    bounds, model = problem.bounds, problem.model
    assert bounds is not None
    rows = inequalities(prediction(model, horizon), bounds)
    state, before, plan = rng.normal(size=3), rng.normal(size=2), rng.normal(size=(horizon, 2))
    slack = rows.right_side(state, before, model.u_bar) - rows.A_ineq @ plan.ravel()
    outputs = rollout(model, state[None], plan[None])[0] @ bounds.C_c.T
    slews = np.diff(plan, axis=0, prepend=before[None])
    expected = [bounds.y_max - outputs, outputs - bounds.y_min, bounds.delta_max - slews, slews - bounds.delta_min]
    np.testing.assert_allclose(slack, np.concatenate([part.ravel() for part in expected]), atol=1e-12)


def test_shapes_and_pairs_of_the_paper() -> None:
    problem = paper_problem()
    assert problem.bounds is not None
    rows = inequalities(prediction(problem.model, 50), problem.bounds)
    assert rows.A_ineq.shape == (2 * 50 * 2 + 2 * 50 * 4, 200)
    outputs, slews = np.split(rows.A_ineq, [2 * rows.n_outputs])
    for upper, lower in (np.split(outputs, 2), np.split(slews, 2)):
        np.testing.assert_array_equal(upper, -lower)
    np.testing.assert_array_equal(rows.G1[400 // 2 :], 0.0)  # slew rows do not see the state
    np.testing.assert_array_equal(rows.u_max, np.full(200, 250.0))
