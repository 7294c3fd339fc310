"""Every QP back end there is: hopeless data comes back as a status, nothing is printed, and flights name them."""

from __future__ import annotations

import ctypes

import numpy as np
import pytest
from support import paper_problem, paper_reference

from mpc.solvers import SOLVERS, QPSolver, make_backend
from mpc.solvers.highs_sparse import hushed
from quadsim.controller import SOLVED
from scenarios.cli import main
from scenarios.commands import EXIT_DONE


@pytest.mark.parametrize("name", SOLVERS)
def test_an_infeasible_qp_is_reported_and_harms_no_later_one(name: str, capfd: pytest.CaptureFixture[str]) -> None:
    problem = paper_problem()
    solver = QPSolver(name, problem)
    tilted = np.zeros(12)
    tilted[6], tilted[7] = np.radians(30.0), 5.0
    hovering = problem.objective.desired(np.zeros((50, 4)))
    assert solver.solve(tilted, hovering, problem.model.u_bar).solution.status == "primal_infeasible"
    hover = solver.solve(np.zeros(12), hovering, problem.model.u_bar)
    if name != "highs":  # calls this one non-convex
        assert hover.solution.status == SOLVED
        np.testing.assert_allclose(hover.plan, np.tile(problem.model.u_bar, (50, 1)), atol=1e-3)
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("name", SOLVERS)
def test_nan_reaches_no_back_end(name: str) -> None:
    problem = paper_problem()
    desired = problem.objective.desired(paper_reference(51)[1:])
    solution = QPSolver(name, problem).solve(np.full(12, np.nan), desired, problem.model.u_bar).solution
    assert solution.status == "invalid_data"


@pytest.mark.parametrize("name", SOLVERS)
def test_nothing_in_a_first_solve_is_printed(name: str, capfd: pytest.CaptureFixture[str]) -> None:
    problem = paper_problem()
    formulation, backend = SOLVERS[name].formulate(problem), make_backend(name)
    backend.setup(formulation.qp)
    desired = problem.objective.desired(paper_reference(51)[1:])
    solution = backend.solve(formulation.vectors(np.zeros(12), desired, problem.model.u_bar))
    assert solution.status in {SOLVED, "max_iterations"}
    assert solution.solve_s > 0.0
    assert solution.iterations >= 0
    assert capfd.readouterr() == ("", "")


def test_output_of_highs_from_c_is_suppressed(capfd: pytest.CaptureFixture[str]) -> None:
    """Its QP solver prints `error` now and then, not each time on the same data."""
    libc = ctypes.CDLL(None)
    with hushed():
        libc.puts(b"error")
    libc.puts(b"heard again")
    libc.fflush(None)
    assert capfd.readouterr() == ("heard again\n", "")


@pytest.mark.parametrize("name", sorted(set(SOLVERS) - {"highs"}))
def test_a_scenario_names_its_solver(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    settings = (f"controller.solver={name}", "controller.shortcut=false", "duration=1.0")
    assert main(["check", "hover", *(word for setting in settings for word in ("--set", setting))]) == EXIT_DONE
    assert name in capsys.readouterr().out
