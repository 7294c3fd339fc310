"""Every QP back end there is: hopeless data comes back as a status, nothing is printed, and flights name them."""

from __future__ import annotations

import numpy as np
import pytest
from support import paper_problem, paper_reference

from quadsim.commands.cli import main
from quadsim.console.results import EXIT_DONE
from quadsim.controller import SOLVED
from quadsim.mpc.problem.ocp import Query
from quadsim.mpc.solvers import SOLVERS, QPSolver, find_solver, make_backend
from quadsim.mpc.solvers.qpsolvers import UNSOLVED

NAMES = (*SOLVERS, "clarabel", "osqp", "proxqp", "quadprog")


@pytest.mark.parametrize("name", NAMES)
def test_an_infeasible_qp_is_reported_and_harms_no_later_one(name: str, capfd: pytest.CaptureFixture[str]) -> None:
    problem = paper_problem()
    solver = QPSolver(name, problem)
    tilted = np.zeros(12)
    tilted[6] = np.radians(30.0)
    tilted[7] = 5.0
    hovering = problem.desired(np.zeros((50, 4)))
    assert solver.solve(Query(tilted, hovering, problem.model.u_bar)).status in {"primal_infeasible", UNSOLVED}
    hover = solver.solve(Query(np.zeros(12), hovering, problem.model.u_bar))
    assert hover.status == SOLVED
    np.testing.assert_allclose(hover.plan, np.tile(problem.model.u_bar, (50, 1)), atol=1e-3)
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("name", NAMES)
def test_nothing_in_a_first_solve_is_printed(name: str, capfd: pytest.CaptureFixture[str]) -> None:
    problem = paper_problem()
    formulation = find_solver(name).formulate(problem)
    backend = make_backend(name)
    backend.setup(formulation.qp)
    desired = problem.desired(paper_reference(51)[1:])
    solution = backend.solve(formulation.assemble(Query(np.zeros(12), desired, problem.model.u_bar)))
    assert solution.status in {SOLVED, UNSOLVED}
    assert solution.stats.solve_s > 0.0
    assert solution.stats.iterations >= 0
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("name", NAMES)
def test_a_scenario_names_its_solver(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    settings = (f"controller.solver={name}", "duration=1.0")
    assert main(["check", "hover", *(word for setting in settings for word in ("--set", setting))]) == EXIT_DONE
    assert name in capsys.readouterr().out
