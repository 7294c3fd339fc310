"""The QP of a model that changes, as the controller solves it: refusals, failures, and the states that it predicts."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import ocp_peer
import pytest
from ocp_peer import Period
from support import changing_period, paper_problem, random_problem

from mpc.constraints import Penalty
from mpc.ocp import Problem
from mpc.solvers import LARGEST, Answer, QPSolver
from quadsim.controller import ACCEPTED, SOLVED, UNCONSTRAINED


def soft_problem() -> Problem:
    problem = random_problem(np.random.default_rng(1), horizon=4, n_c=1)
    assert problem.bounds is not None
    return replace(problem, bounds=replace(problem.bounds, penalty=Penalty(l1=np.ones(1), l2=np.ones(1))))


def changing(problem: Problem, name: str = "piqp-multistage", *, free_first: bool = False) -> QPSolver:
    return QPSolver(name, problem, changing=True, free_first=free_first)


def solved(solver: QPSolver, now: Period) -> Answer:
    return solver.solve(now.query)


PARTS = ("A", "B", "c", "state", "desired", "u_before", "u_rest")


def corrupted(now: Period, part: str, number: float) -> Period:
    """With one number of it another."""
    if part == "u_rest":
        u = now.equilibrium.u.copy()
        u.flat[0] = number
        return replace(now, equilibrium=now.equilibrium._replace(u=u))
    wrong = getattr(now, part).copy()
    wrong.flat[0] = number
    return replace(now, **{part: wrong})


@pytest.mark.parametrize("part", PARTS)
@pytest.mark.parametrize("number", [math.nan, math.inf, -math.inf, -1.1 * LARGEST])
def test_data_that_is_not_finite_or_of_no_vehicle_is_refused(part: str, number: float) -> None:
    """With answers of the usual shapes, and without harm to what is solved next."""
    problem = soft_problem()
    now, solver = changing_period(np.random.default_rng(2), problem), changing(problem)
    before = solved(solver, now)
    answer = solved(solver, corrupted(now, part, number))
    assert answer.status == "invalid_data"
    assert answer.states is None
    for ours, usual in ((answer.plan, before.plan), (answer.slacks, before.slacks)):
        assert ours.shape == usual.shape
        assert np.isnan(ours).all()
    assert answer.certificate is None
    np.testing.assert_allclose(solved(solver, now).plan, before.plan, atol=1e-9)


def test_an_answer_has_the_states_of_its_plan() -> None:
    problem = soft_problem()
    solver = changing(problem)
    for seed in range(5):
        now = changing_period(np.random.default_rng(seed), problem)
        answer = solved(solver, now)
        assert answer.status == SOLVED
        assert answer.states is not None
        np.testing.assert_allclose(answer.states, ocp_peer.trajectory(now, answer.plan)[1:], atol=1e-6)


def test_a_failure_leaves_the_next_solve_alone_and_has_no_states() -> None:
    problem = paper_problem()
    solver = changing(problem)
    desired, u_bar = problem.objective.desired(np.zeros((50, 4))), problem.model.u_bar
    tilted = np.zeros(12)
    tilted[6], tilted[7] = np.radians(30.0), 5.0
    failed = solved(solver, ocp_peer.period(problem, tilted, desired, u_bar))
    assert failed.status in {"primal_infeasible", "max_iterations", "numerics"}
    assert failed.status not in ACCEPTED
    assert failed.states is None
    hover = solved(solver, ocp_peer.period(problem, np.zeros(12), desired, u_bar))
    assert hover.status == SOLVED
    np.testing.assert_allclose(hover.plan, np.tile(u_bar, (50, 1)), atol=1e-3)


@pytest.mark.parametrize("solver", ["piqp-dense", "daqp"])
@pytest.mark.parametrize("terminal", [0.0, 3.0])
def test_condensed_and_staged_forms_have_one_optimum(solver: str, terminal: float) -> None:
    """With weights of changes and of the last state, inputs pulled to others in each step, and without these."""
    rng = np.random.default_rng(7)
    problem = soft_problem()
    Q_d = 0.3 * np.eye(problem.model.nu)
    objective = replace(problem.objective, Q_d=Q_d, P=terminal * problem.objective.weights[0])
    problem = replace(problem, objective=objective)
    ways = changing(problem), changing(problem, solver), changing(problem, solver, free_first=True)
    for _ in range(8):
        now = changing_period(rng, problem)
        u = now.equilibrium.u + 0.2 * rng.normal(size=(problem.horizon, problem.model.nu))
        now = replace(now, equilibrium=now.equilibrium._replace(u=u))
        staged, condensed, free_first = (solved(way, now) for way in ways)
        for other in (condensed, free_first):
            assert {staged.status, other.status} <= ACCEPTED
            np.testing.assert_allclose(other.plan, staged.plan, atol=1e-4)
            np.testing.assert_allclose(other.slacks, staged.slacks, atol=1e-4)
        assert condensed.states is not None
        assert staged.states is not None
        np.testing.assert_allclose(condensed.states, staged.states, atol=1e-4)


def test_the_unconstrained_optimum_is_answered_where_it_violates_nothing() -> None:
    problem = soft_problem()
    wide = replace(
        problem.bounds,
        **{side: getattr(problem.bounds, side) * 1e4 for side in ("y_min", "y_max", "delta_min", "delta_max")},
    )
    assert problem.bounds is not None
    centre = problem.model.u_bar
    wide = replace(wide, u_min=centre - 1e4, u_max=centre + 1e4)
    problem = replace(problem, bounds=wide)
    now = changing_period(np.random.default_rng(3), problem)
    way = changing(problem, "piqp-dense", free_first=True)
    answer = solved(way, now)
    assert answer.status == UNCONSTRAINED
    np.testing.assert_allclose(answer.plan, solved(changing(problem), now).plan, atol=1e-5)
