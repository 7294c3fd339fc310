"""Eqs. (21)-(26): the gains, against the LQR and against the optimum they stand for."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scipy.linalg
from support import paper_problem, paper_reference

from quadsim.controller import StepInputs
from quadsim.errors import ParameterError
from quadsim.mpc.laws.unconstrained import UnconstrainedMPC, sequence_gains
from quadsim.state import Array


def lqr_gain(A: Array, B: Array, Q: Array, R: Array) -> Array:
    P = scipy.linalg.solve_discrete_are(A, B, Q, R)
    return -np.linalg.solve(R + B.T @ P @ B, B.T @ P @ A)


def test_gain_converges_to_the_lqr_with_the_horizon() -> None:
    problem = paper_problem("paper-unconstrained")
    lqr = lqr_gain(problem.model.A, problem.model.B, problem.objective.Q_y, problem.objective.Q_u)
    differences = []
    for horizon in (10, 20, 40, 60, 80, 100):
        K_N = sequence_gains(replace(problem, horizon=horizon)).K[:4]
        differences.append(np.linalg.norm(K_N - lqr) / np.linalg.norm(lqr))
    assert differences == sorted(differences, reverse=True)
    assert differences[-1] < 1e-3


def test_gain_equals_the_finite_horizon_riccati_recursion() -> None:
    problem = paper_problem("paper-unconstrained")
    A = problem.model.A
    B = problem.model.B
    Q = problem.objective.Q_y
    R = problem.objective.Q_u
    P = Q
    for _ in range(problem.horizon):
        K = -np.linalg.solve(R + B.T @ P @ B, B.T @ P @ A)
        P = Q + A.T @ P @ (A + B @ K)
    np.testing.assert_allclose(sequence_gains(problem).K[:4], K, rtol=1e-6, atol=1e-8)


def test_feedforward_of_u_bar_is_the_identity() -> None:
    """What Eq. (26) is for; with F3 as printed it would be far from it."""
    gains = sequence_gains(paper_problem("paper-unconstrained"))
    np.testing.assert_allclose(gains.L[:4], np.eye(4), atol=1e-7)


def test_a_weight_on_input_changes_is_refused() -> None:
    """Its optimum depends on u(k-1), for which the law has no gain."""
    problem = paper_problem("paper-unconstrained")
    weighted = replace(problem, objective=replace(problem.objective, Q_d=0.1 * np.eye(4)))
    with pytest.raises(ParameterError, match="Q_d must be None or zero"):
        UnconstrainedMPC(weighted)
    UnconstrainedMPC(replace(problem, objective=replace(problem.objective, Q_d=np.zeros((4, 4)))))


def test_weights_with_thirteen_entries_are_read_as_twelve() -> None:
    """Erratum of Eq. (33): 10 on z (5th) and yaw (11th), 1 elsewhere."""
    Q_y = paper_problem("paper-unconstrained").objective.Q_y
    np.testing.assert_array_equal(np.diag(Q_y), [1, 1, 1, 1, 10, 1, 1, 1, 1, 1, 10, 1])


def test_step_is_the_first_action_of_the_sequence() -> None:
    problem = paper_problem("paper-unconstrained")
    controller = UnconstrainedMPC(problem)
    reference = paper_reference(300)[150:250]
    state = np.random.default_rng(0).normal(size=12) * 0.1
    command = controller.step(StepInputs(), state, reference)
    gains = controller.gains
    desired = np.zeros((100, 12))
    desired[:, [0, 2, 4, 10]] = reference
    expected = (gains.K @ state + gains.G @ desired.ravel() + gains.L @ problem.model.u_bar)[:4]
    np.testing.assert_allclose(command.speeds, expected, rtol=1e-12)
    assert command.plan.shape == (100, 4)
    np.testing.assert_array_equal(command.plan[0], command.speeds)
