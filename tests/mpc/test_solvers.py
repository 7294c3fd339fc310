"""The solvers by name: what is installed, what is not, and answers to data that no solver can use."""

from __future__ import annotations

import importlib.util
from dataclasses import replace

import numpy as np
import pytest
from support import flight_queries, paper_problem, paper_reference, random_problem

from mpc.constrained import ConstrainedMPC
from mpc.paper.condensed import condensed
from mpc.qp import Solution, kkt_residuals
from mpc.solvers import SOLVERS, QPSolver, make_backend
from mpc.solvers.daqp_dense import DaqpDense
from mpc.solvers.osqp_sparse import OsqpSparse
from mpc.solvers.piqp_backends import PiqpDense
from mpc.staged import Staged
from quadsim.controller import SOLVED, Moment
from quadsim.errors import MissingPackageError, PlanExhaustedError, UnknownNameError
from scenarios.flight import Flight
from scenarios.loading import load_scenario
from scenarios.run import fly_scenario

ALWAYS = ("piqp-multistage", "piqp-multistage-1", "piqp-dense", "daqp", "osqp")
"""What `make setup` installs."""


def infeasible(name: str) -> Solution:
    """A tilt and a turn that no bounded input undoes within the first period."""
    problem = paper_problem()
    tilted = np.zeros(12)
    tilted[6], tilted[7] = np.radians(30.0), 5.0
    desired = problem.objective.desired(np.zeros((50, 4)))
    return QPSolver(name, problem).solve(tilted, desired, problem.model.u_bar).solution


@pytest.mark.parametrize("name", ALWAYS)
def test_an_infeasible_problem_is_not_called_solved(name: str) -> None:
    assert infeasible(name).status in {"primal_infeasible", "max_iterations", "numerics"}


@pytest.mark.parametrize("name", ["daqp", "osqp"])
def test_a_failure_leaves_the_next_solve_alone(name: str) -> None:
    problem = paper_problem()
    solver = QPSolver(name, problem)
    desired = problem.objective.desired(np.zeros((50, 4)))
    tilted = np.zeros(12)
    tilted[6], tilted[7] = np.radians(30.0), 5.0
    assert solver.solve(tilted, desired, problem.model.u_bar).solution.status == "primal_infeasible"
    hover = solver.solve(np.zeros(12), desired, problem.model.u_bar)
    assert hover.solution.status == SOLVED
    np.testing.assert_allclose(hover.plan, np.tile(problem.model.u_bar, (50, 1)), atol=1e-3)


@pytest.mark.parametrize(("place", "corrupted"), [(0, np.nan), (1, np.nan), (2, np.nan), (2, np.inf), (2, -np.inf)])
def test_data_that_is_not_finite_reaches_no_back_end(place: int, corrupted: float) -> None:
    problem = paper_problem()
    query = [np.zeros(12), problem.objective.desired(np.zeros((50, 4))), problem.model.u_bar.copy()]
    query[place].flat[0] = corrupted
    solver = QPSolver("piqp-multistage", problem)
    answer = solver.solve(*query)
    assert answer.solution.status == "invalid_data"
    assert np.isnan(answer.plan).all()
    controller = ConstrainedMPC(problem, solver, shortcut=False)
    controller.reset(problem.model.u_bar)
    with pytest.raises(PlanExhaustedError, match="invalid_data"):
        controller.step(Moment(), np.full(12, np.nan), paper_reference(51)[1:])


@pytest.mark.parametrize("kind", [DaqpDense, OsqpSparse])
def test_equality_rows_and_multipliers(kind: type[DaqpDense | OsqpSparse]) -> None:
    """On the stages' QP, which has equalities and free variables, and on the condensed one: KKT, and one optimum."""
    rng = np.random.default_rng(5)
    for _ in range(5):
        problem = random_problem(rng, horizon=6, n=3, nu=2, n_c=1)
        query = (0.1 * rng.normal(size=3), rng.normal(size=(6, 3)), problem.model.u_bar)
        plans = []
        for formulation in (Staged(problem, steps_per_stage=2), condensed(problem)):
            backend, peer = kind(), PiqpDense()
            vectors = formulation.vectors(*query)
            backend.setup(formulation.qp)
            peer.setup(condensed(problem).qp)
            expected = peer.solve(condensed(problem).vectors(*query))
            solution = backend.solve(vectors)
            assert solution.status == expected.status
            if solution.status != SOLVED:
                continue
            residuals = kkt_residuals(formulation.qp.with_vectors(vectors), solution)
            assert residuals.worst < 1e-3 * max(1.0, float(np.abs(solution.point.z).max(initial=0.0)))
            plans.append(formulation.inputs(solution.x))
        if plans:
            np.testing.assert_allclose(plans[0], plans[1], atol=1e-3)


def test_a_flight_by_daqp_holds_its_audit_and_is_the_same(constrained_flight: Flight) -> None:
    flight = fly_scenario(load_scenario("paper-constrained", ["controller.solver=daqp"]))
    assert (flight.solver, constrained_flight.solver) == ("daqp", "piqp-multistage")
    assert flight.satisfied
    assert flight.log.control.fallback.max() == 0
    np.testing.assert_allclose(flight.log.control.speeds, constrained_flight.log.control.speeds, atol=0.01)


def test_daqp_starts_from_the_active_set_one_step_earlier(constrained_flight: Flight) -> None:
    """Over whole QPs of the paper's flight: a third of the changes, the same optima."""
    problem = paper_problem()
    form = condensed(problem)
    later = form.qp.later
    assert later is not None
    rows = np.asarray(form.qp.G).reshape(50, -1, 200)
    for i in (3, 17):  # a row's values one step later are those of its entry in `later`, inputs one step later too
        own = 200 + i * rows.shape[1] + np.arange(rows.shape[1])
        np.testing.assert_array_equal(later[own], own + rows.shape[1])
        np.testing.assert_allclose(rows[i + 1][:, 4:], rows[i][:, :-4], atol=1e-9)
    np.testing.assert_array_equal(later[:200], [*range(4, 200), *range(196, 200)])
    changes, found = {}, {}
    for name, qp in (("moved", form.qp), ("unmoved", replace(form.qp, later=None))):
        backend = DaqpDense()
        backend.setup(qp)
        queries = flight_queries(constrained_flight, problem, stride=1)[800:900]
        solutions = [backend.solve(form.vectors(*query)) for query in queries]
        assert {solution.status for solution in solutions} == {SOLVED}
        changes[name] = sum(solution.iterations for solution in solutions)
        found[name] = np.array([solution.x for solution in solutions])
    assert changes["moved"] < changes["unmoved"] / 3
    np.testing.assert_allclose(found["moved"], found["unmoved"], atol=1e-5)


def test_unknown_solver_lists_those_there_are() -> None:
    with pytest.raises(UnknownNameError, match=r"no solver named 'piqp-dens'; did you mean 'piqp-dense'"):
        QPSolver("piqp-dens", paper_problem())


@pytest.mark.parametrize(
    ("name", "package", "extra"),
    [("daqp", "daqp", "daqp"), ("qpoases", "casadi", "solvers"), ("proxqp", "proxsuite", "solvers")],
)
def test_a_solver_that_is_not_installed_names_its_package(
    name: str, package: str, extra: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda module: None)
    with pytest.raises(MissingPackageError, match=rf"the solver '{name}' needs the package '{package}': pip install"):
        make_backend(name)
    assert SOLVERS[name].line == f"not installed: pip install 'quadsim[{extra}]'"
    assert not SOLVERS[name].installed


def test_entries_describe_themselves() -> None:
    for name in ALWAYS:
        entry = SOLVERS[name]
        assert entry.installed
        assert entry.line == entry.description
        assert entry.version[0].isdigit()
    absent = replace(SOLVERS["daqp"], package="a_package_that_does_not_exist")
    assert not absent.installed
