"""A row and its bounds times any factor say the same, so every solver must give the same answer."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from itertools import pairwise

import numpy as np
import pytest
from support import paper_problem

from quadsim.controller import SOLVED
from quadsim.mpc.guard.answer import AnswerCheck
from quadsim.mpc.problem.constraints import Constraint, Penalty
from quadsim.mpc.problem.ocp import InfeasiblePeriod, Problem, Query
from quadsim.mpc.solvers import Answer
from quadsim.mpc.solvers.by_name import make_solver
from quadsim.rollout.conflicts import Side, smallest_widening
from quadsim.state import INDEX, Array

SOLVERS = ("piqp-multistage", "piqp-dense", "daqp", "clarabel", "core")
FACTORS = (1e-8, 1e-6, 1e-5, 1e-4, 1e-2, 1e2, 1e4, 1e8)
HORIZON = 12
CLIMB = 30.0
"""Desired height [m], out of reach."""
LINEAR = 2e3
QUADRATIC = 1e2
"""Penalty of violating the soft row by 1 m."""


def problem_with(factor: float, *, soft: bool) -> Problem:
    """The paper's problem with two rows times a factor: height and climb, and the sum of rotor speeds."""
    problem = paper_problem("paper-constrained", f"controller.horizon={HORIZON}")
    C = np.zeros((1, 12))
    C[0, INDEX["z"]] = 1.0
    C[0, INDEX["vz"]] = 0.3
    penalty = Penalty(l1=np.array([LINEAR / factor]), l2=np.array([QUADRATIC / factor**2])) if soft else None
    top = -0.02 if soft else 0.1
    none = np.full(1, -np.inf)
    climb = Constraint(name="climb", C=factor * C, lower=none, upper=np.array([factor * top]), penalty=penalty)
    total = factor * (problem.model.u_bar.sum() + 40.0)
    rotors = Constraint(name="rotors", D=np.full((1, 4), factor), lower=none, upper=np.array([total]))
    return replace(problem, constraints=(climb, rotors))


def query_of(problem: Problem) -> Query:
    """At rest, far below the desired height."""
    desired = problem.objective.desired(np.tile([0.0, 0.0, CLIMB, 0.0], (HORIZON, 1)))
    return Query(np.zeros(12), desired, problem.model.u_bar)


@cache
def answered(name: str, factor: float, *, soft: bool) -> tuple[Answer, Array]:
    """A solver's answer to the query, and the multipliers of the constraints' rows."""
    problem = problem_with(factor, soft=soft)
    solver = make_solver(name, problem)
    answer = solver.solve(query_of(problem))
    assert answer.certificate is not None
    _, solution = answer.certificate()
    return answer, solver.formulation.multipliers(solution)


@pytest.mark.parametrize("soft", [False, True])
@pytest.mark.parametrize("factor", FACTORS)
@pytest.mark.parametrize("name", SOLVERS)
def test_the_unit_of_a_row_changes_no_answer(name: str, factor: float, soft: bool) -> None:
    usual, its_multipliers = answered(name, 1.0, soft=soft)
    answer, multipliers = answered(name, factor, soft=soft)
    assert (usual.status, answer.status) == (SOLVED, SOLVED)
    assert answer.answered_by == usual.answered_by
    assert np.abs(usual.plan - query_of(problem_with(1.0, soft=soft)).u_before).max() > 1.0
    np.testing.assert_allclose(answer.plan, usual.plan, atol=5e-3)
    np.testing.assert_allclose(answer.slacks / factor, usual.slacks, atol=1e-6)
    assert usual.slacks.size == HORIZON * soft
    size = np.abs(its_multipliers).max()
    np.testing.assert_allclose(factor * multipliers[:, -2:], its_multipliers[:, -2:], atol=1e-3 * size)
    assert np.abs(its_multipliers[:, -2:]).max() > 1.0


@pytest.mark.parametrize("factor", [2.0**-20, 2.0**13])
@pytest.mark.parametrize("name", ["piqp-multistage", "daqp", "core"])
def test_a_power_of_two_changes_no_bit(name: str, factor: float) -> None:
    usual, answer = (answered(name, each, soft=True)[0] for each in (1.0, factor))
    np.testing.assert_array_equal(answer.plan, usual.plan)
    np.testing.assert_array_equal(answer.slacks, factor * usual.slacks)


@pytest.mark.parametrize("factor", [1e-8, 1e-4, 1.0, 1e4])
def test_a_violation_counts_alike_in_every_unit(factor: float) -> None:
    """A plan that leaves the row by 5 cm is refused, whatever the row's unit."""
    problem = problem_with(factor, soft=False)
    query = query_of(problem)
    check = AnswerCheck(problem, 1)
    answer = make_solver("piqp", problem).solve(query)
    assert check(problem, query, answer, None)[1] is None
    without = replace(problem, constraints=())
    higher = make_solver("piqp", without).solve(query_of(without))
    _, reason = check(problem, query, higher._replace(certificate=answer.certificate), None)
    assert reason == "infeasible_answer"


def test_the_smallest_widening_is_in_the_row_s_unit() -> None:
    widenings = []
    for factor in (1e-6, 1.0, 1e4):
        problem = problem_with(factor, soft=False)
        state = np.zeros(12)
        state[INDEX["z"]] = 0.5
        query = query_of(problem)._replace(state=state)
        period = InfeasiblePeriod(problem=problem, query=query, status="primal_infeasible", time=0.0)
        place = len(problem.every_constraint) - 2
        widening = smallest_widening(period, [Side(place, 0, True)])
        assert widening is not None
        widenings.append(widening / factor)
    assert widenings[0] > 0.3
    for one, other in pairwise(widenings):
        assert one == pytest.approx(other, rel=1e-6)
