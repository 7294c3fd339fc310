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
from mpc.solvers import LARGEST_ENTRY, Answer, QPSolver
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
@pytest.mark.parametrize("number", [math.nan, math.inf, -math.inf, -1.1 * LARGEST_ENTRY])
def test_implausible_data_is_refused(part: str, number: float) -> None:
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
