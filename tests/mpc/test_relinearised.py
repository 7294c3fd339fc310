"""The QP of a model that changes, as the controller solves it: refusals, failures, and what it remembers."""

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
from mpc.relinearised import LARGEST, Relinearised
from mpc.solvers import Answer
from quadsim.controller import ACCEPTED, SOLVED


def soft_problem() -> Problem:
    problem = random_problem(np.random.default_rng(1), horizon=4, n_c=1)
    assert problem.bounds is not None
    return replace(problem, bounds=replace(problem.bounds, penalty=Penalty(l1=np.ones(1), l2=np.ones(1))))


def solved(solver: Relinearised, now: Period) -> Answer:
    return solver.solve(now.A, now.B, now.c, now.state, now.desired, now.u_before, now.rest)


PARTS = ("A", "B", "c", "state", "desired", "u_before", "u_rest")


def spoilt(now: Period, part: str, number: float) -> Period:
    """With one number of it another."""
    if part == "u_rest":
        u = now.rest.u.copy()
        u.flat[0] = number
        return replace(now, rest=now.rest._replace(u=u))
    wrong = getattr(now, part).copy()
    wrong.flat[0] = number
    return replace(now, **{part: wrong})


@pytest.mark.parametrize("part", PARTS)
@pytest.mark.parametrize("number", [math.nan, math.inf, -math.inf, -1.1 * LARGEST])
def test_data_that_is_not_finite_or_of_no_vehicle_is_refused(part: str, number: float) -> None:
    """With answers of the usual shapes, and without harm to what is solved next."""
    problem = soft_problem()
    now, solver = changing_period(np.random.default_rng(2), problem), Relinearised(problem)
    before = solved(solver, now)
    answer = solved(solver, spoilt(now, part, number))
    assert answer.solution.status == "invalid_data"
    assert solver.last is None
    for ours, usual in ((answer.plan, before.plan), (answer.slacks, before.slacks)):
        assert ours.shape == usual.shape
        assert np.isnan(ours).all()
    assert np.isnan(answer.solution.x).all()
    np.testing.assert_allclose(solved(solver, now).plan, before.plan, atol=1e-9)


def test_it_remembers_the_states_of_its_plan() -> None:
    problem = soft_problem()
    solver = Relinearised(problem)
    assert solver.last is None
    for seed in range(5):
        now = changing_period(np.random.default_rng(seed), problem)
        answer = solved(solver, now)
        assert answer.solution.status == SOLVED
        assert solver.last is not None
        states, plan = solver.last
        np.testing.assert_array_equal(plan, answer.plan)
        np.testing.assert_allclose(states, ocp_peer.trajectory(now, plan)[1:], atol=1e-6)


def test_a_failure_leaves_the_next_solve_alone_and_nothing_to_remember() -> None:
    problem = paper_problem()
    solver = Relinearised(problem)
    desired, u_bar = problem.objective.desired(np.zeros((50, 4))), problem.model.u_bar
    tilted = np.zeros(12)
    tilted[6], tilted[7] = np.radians(30.0), 5.0
    failed = solved(solver, ocp_peer.period(problem, tilted, desired, u_bar))
    assert failed.solution.status in {"primal_infeasible", "max_iterations", "numerics"}
    assert failed.solution.status not in ACCEPTED
    assert solver.last is None
    hover = solved(solver, ocp_peer.period(problem, np.zeros(12), desired, u_bar))
    assert hover.solution.status == SOLVED
    np.testing.assert_allclose(hover.plan, np.tile(u_bar, (50, 1)), atol=1e-3)
