"""Eq. (27): both formulations of the QP, against the KKT conditions, a second solver and each other."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from polish import polish
from support import flight_queries, paper_problem, paper_reference, random_problem

from quadsim.controller import SOLVED
from quadsim.mpc.forms.condensing import Condensed
from quadsim.mpc.forms.staged import Staged
from quadsim.mpc.problem.constraints import Constraint, Penalty
from quadsim.mpc.problem.ocp import Query
from quadsim.mpc.problem.qp import QP, Backend, Solution, kkt_residuals
from quadsim.mpc.solvers import SOLVERS, Formulation, QPSolver, make_backend
from quadsim.mpc.solvers.piqp import Piqp
from quadsim.rollout.flown import Flight
from quadsim.state import Array

STATE = np.zeros(12)
STATE[10] = np.pi / 6


@pytest.mark.parametrize("name", ["piqp-multistage", "piqp-dense", "daqp"])
def test_kkt_conditions_hold_over_the_flight(constrained_flight: Flight, name: str) -> None:
    problem = paper_problem()
    formulation = SOLVERS[name].formulate(problem)
    backend = make_backend(name)
    backend.setup(formulation.qp)
    active = 0
    for query in flight_queries(constrained_flight, problem, stride=40):
        qp = formulation.assemble(Query(*query))
        solution = backend.solve(qp)
        assert solution.status == SOLVED
        residuals = kkt_residuals(qp, solution)
        assert residuals.primal < 1e-6
        assert residuals.stationarity < 1e-4  # gradients are of order 1e4
        assert residuals.complementarity < 1e-4  # multipliers reach 1e3
        assert residuals.dual == 0.0
        active += solution.stats.active
    assert active > 50  # the flight does press against its bounds


def solved(formulation: Formulation, backend: Backend, query: Query) -> tuple[QP, Solution]:
    backend.setup(formulation.qp)
    qp = formulation.assemble(Query(*query))
    return qp, backend.solve(qp)


def at(solution: Solution, **parts: Array) -> Solution:
    return solution._replace(**parts)


def test_kkt_residuals_see_every_kind_of_fault() -> None:
    problem = paper_problem()
    formulation = Condensed(problem)
    backend = Piqp(dense=True)
    query = (STATE, problem.desired(paper_reference(60)[1:51]), problem.model.u_bar)
    qp, solution = solved(formulation, backend, query)
    assert kkt_residuals(qp, solution).worst < 1e-3
    assert kkt_residuals(qp, at(solution, x=solution.x + 1.0)).stationarity > 0.1
    assert kkt_residuals(qp, at(solution, x=solution.x * 3.0)).primal > 1.0
    assert kkt_residuals(qp, at(solution, z=solution.z + 1.0)).complementarity > 1.0
    assert np.isnan(kkt_residuals(replace(qp, h_l=qp.h_l * np.nan), solution).worst)  # never taken for optimal
    unbounded = replace(qp, x_u=np.full_like(qp.x_u, np.inf))
    assert kkt_residuals(unbounded, at(solution, z_box=solution.z_box + 1.0)).dual > 0.9


def test_answers_are_copies_that_the_next_solve_leaves_alone() -> None:
    problem = paper_problem()
    solver = QPSolver("piqp-multistage", problem)
    desired = problem.desired(paper_reference(60)[1:51])
    first = solver.solve(Query(STATE, desired, problem.model.u_bar))
    before = first.plan.copy(), first.certificate()[1].x.copy(), first.certificate()[1].y.copy()
    solver.solve(Query(-STATE, -desired, problem.model.u_bar))
    for now, then in zip((first.plan, first.certificate()[1].x, first.certificate()[1].y), before, strict=True):
        np.testing.assert_array_equal(now, then)


@pytest.mark.parametrize("build", [Condensed, Staged])
def test_a_problem_without_bounds_needs_no_qp(build: object) -> None:
    with pytest.raises(ValueError, match="bounds"):
        build(paper_problem("paper-unconstrained"))  # type: ignore[operator]


def test_first_inputs_are_exact_over_the_flight(constrained_flight: Flight) -> None:
    """Within 1e-3 rad/s of an active-set solver's, which ends at a vertex and not near one."""
    problem = paper_problem()
    ours = QPSolver("piqp-multistage", problem)
    exact = QPSolver("daqp", problem)
    queries = flight_queries(constrained_flight, problem, stride=15)
    errors = [np.abs(ours.solve(Query(*query)).plan[0] - exact.solve(Query(*query)).plan[0]).max() for query in queries]
    assert max(errors) < 1e-3


def test_multipliers_of_rows_are_those_of_the_qp_and_back() -> None:
    """Rows of single inputs are in the box, several of them at one bound, others tighter at some steps alone."""
    problem = paper_problem("paper-constrained", "controller.horizon=15")
    late = np.full((15, 4), 250.0)
    late[3:, 0] = 200.0
    again = Constraint(name="again", D=np.eye(4), lower=np.zeros(4), upper=np.full(4, 250.0))
    tighter = Constraint(name="late", D=np.eye(4), lower=np.full((15, 4), -1.0), upper=late)
    problem = replace(problem, constraints=(again, tighter))
    desired = problem.desired(np.tile([0.0, 0.0, 30.0, 0.0], (15, 1)))
    form = Condensed(problem)
    backend = Piqp(dense=True)
    qp, solution = solved(form, backend, (np.zeros(12), desired, problem.model.u_bar))
    optimum = polish(qp, solution)
    assert kkt_residuals(qp, optimum).worst < 1e-5
    rows = form.multipliers(optimum)
    active = {name for name, column in zip(problem.rows.names, rows.T, strict=True) if column.any()}
    assert {"slews", "inputs", "late"} <= active
    assert "again" not in active
    back = form.solution(form.inputs(optimum.x), form.slacks(optimum.x), rows)
    np.testing.assert_array_equal(back.z, optimum.z)
    np.testing.assert_array_equal(back.z_box, optimum.z_box)


def test_a_slack_has_the_multiplier_that_makes_its_gradient_zero() -> None:
    """l1 + 2 l2 e - |z| of each, none where that vanishes: at an optimum, wherever a bound is violated."""
    problem = random_problem(np.random.default_rng(0), horizon=4)
    assert problem.bounds is not None
    penalty = Penalty(l1=np.array([3.0]), l2=np.array([2.0]))
    form = Condensed(replace(problem, bounds=replace(problem.bounds, penalty=penalty)))
    multipliers = np.zeros((4, len(problem.rows.D)))
    slacks = np.array([[0.0], [1.0], [1.0], [1.0]])
    multipliers[:, 0] = [-2.0, 0.0, 5.0, 7.0]
    solution = form.solution(np.zeros((4, 2)), slacks, multipliers)
    scale = form.qp.c[8:] / 3.0  # l1 per unit of the QP's slack over that per unit of the row
    np.testing.assert_allclose(solution.z_box[8:] / scale, [-1.0, -7.0, -2.0, 0.0])
    np.testing.assert_allclose(form.slacks(solution.x), slacks)
