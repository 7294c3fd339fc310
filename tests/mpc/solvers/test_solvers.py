"""The solvers by name: what is installed, what is not, and answers to data that no solver can use."""

from __future__ import annotations

import importlib.util
import itertools
import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import qpsolvers
from scipy.sparse import csc_matrix
from support import constrained_mpc, flight_queries, paper_problem, paper_reference, random_problem

from quadsim.controller import CORE, GAIN, SOLVED, StepInputs
from quadsim.errors import MissingPackageError, PlanExhaustedError, UnknownNameError
from quadsim.mpc.forms.condensing import Condensed
from quadsim.mpc.forms.staged import Staged
from quadsim.mpc.problem.constraints import Penalty
from quadsim.mpc.problem.ocp import Query
from quadsim.mpc.problem.qp import QP, kkt_residuals
from quadsim.mpc.solvers import SOLVERS, Answer, QPSolver, find_solver, make_backend, solver_entries
from quadsim.mpc.solvers.by_name import make_solver
from quadsim.mpc.solvers.daqp import DaqpDense
from quadsim.mpc.solvers.piqp import Piqp
from quadsim.rollout.flown import Flight
from quadsim.rollout.rollout import Rollout
from quadsim.scenarios.loading import load_scenario

ALWAYS = ("piqp-multistage", "piqp-dense", "daqp", "clarabel")
"""What `make setup` installs."""


def infeasible(name: str) -> Answer:
    """A tilt and a turn that no bounded input undoes within the first period."""
    problem = paper_problem()
    tilted = np.zeros(12)
    tilted[6] = np.radians(30.0)
    tilted[7] = 5.0
    desired = problem.desired(np.zeros((50, 4)))
    return QPSolver(name, problem).solve(Query(tilted, desired, problem.model.u_bar))


@pytest.mark.parametrize("name", ALWAYS)
def test_an_infeasible_problem_is_not_called_solved(name: str) -> None:
    assert infeasible(name).status in {"primal_infeasible", "max_iterations", "numerics", "unsolved"}


@pytest.mark.parametrize("name", ["daqp", "clarabel"])
def test_a_failure_leaves_the_next_solve_alone(name: str) -> None:
    problem = paper_problem()
    solver = QPSolver(name, problem)
    desired = problem.desired(np.zeros((50, 4)))
    tilted = np.zeros(12)
    tilted[6] = np.radians(30.0)
    tilted[7] = 5.0
    assert solver.solve(Query(tilted, desired, problem.model.u_bar)).status in {"primal_infeasible", "unsolved"}
    hover = solver.solve(Query(np.zeros(12), desired, problem.model.u_bar))
    assert hover.status == SOLVED
    np.testing.assert_allclose(hover.plan, np.tile(problem.model.u_bar, (50, 1)), atol=1e-3)


@pytest.mark.parametrize(("place", "corrupted"), [(0, np.nan), (1, np.nan), (2, np.nan), (2, np.inf), (2, -np.inf)])
def test_data_that_is_not_finite_reaches_no_back_end(place: int, corrupted: float) -> None:
    problem = paper_problem()
    query = [np.zeros(12), problem.desired(np.zeros((50, 4))), problem.model.u_bar.copy()]
    query[place].flat[0] = corrupted
    solver = QPSolver("piqp-multistage", problem)
    answer = solver.solve(Query(*query))
    assert answer.status == "invalid_data"
    assert np.isnan(answer.plan).all()
    controller = constrained_mpc(problem, solver)
    controller.reset(problem.model.u_bar)
    with pytest.raises(PlanExhaustedError, match="invalid_data"):
        controller.step(StepInputs(), np.full(12, np.nan), paper_reference(51)[1:])


@pytest.mark.parametrize(
    ("settings", "by"),
    [
        ([], GAIN),
        (["controller.horizon=150"], GAIN),
        (["controller.horizon=200"], "piqp-multistage"),  # its matrices are too large
        (["controller.horizon=100", "controller.input_weights.speed=1e-6"], "piqp-multistage"),  # cond(H) forbids
    ],
)
def test_the_unconstrained_optimum_is_tried_first_unless_size_or_rounding_forbid(settings: list[str], by: str) -> None:
    """A little beside the reference; gain or not, it is the QP's optimum."""
    problem = paper_problem("paper-constrained", *settings)
    state = np.zeros(12)
    state[[0, 2, 4, 6, 8]] = [0.02, -0.03, -0.05, 0.002, -0.003]
    query = Query(1e-2 * state, np.zeros((problem.horizon, 4)), problem.model.u_bar)
    answer = make_solver("piqp", problem).solve(query)
    whole = QPSolver("piqp", problem).solve(query)
    assert answer.answered_by == by
    assert answer.certificate is not None
    assert kkt_residuals(*answer.certificate()).worst < 1e-5
    np.testing.assert_allclose(answer.plan[0], whole.plan[0], atol=1e-3)
    assert answer.stats.solve_s > 0.0


def test_a_period_assembles_the_qp_that_is_solved_and_no_other(monkeypatch: pytest.MonkeyPatch) -> None:
    """The unconstrained optimum is tried without a QP, which its certificate alone needs."""
    problem = paper_problem()
    solver = make_solver("piqp", problem)
    assembled: list[str] = []
    for form in (Condensed, Staged):

        def counted(self: Any, query: Query, assemble: Any = form.assemble) -> QP:
            assembled.append(type(self).__name__)
            return assemble(self, query)

        monkeypatch.setattr(form, "assemble", counted)
    near, far = (Query(np.zeros(12), np.full((50, 4), by), problem.model.u_bar) for by in (1e-3, 5.0))
    answer = solver.solve(far)
    assert answer.answered_by == "piqp-multistage"
    assert assembled == ["Staged"]
    answer = solver.solve(near)
    assert answer.answered_by == GAIN
    assert assembled == ["Staged"]
    assert answer.certificate is not None
    assert kkt_residuals(*answer.certificate()).worst < 1e-5
    assert assembled == ["Staged", "Condensed"]


def test_equality_rows_and_multipliers() -> None:
    """On the stages' QP, which has equalities and free variables, and on the condensed one: KKT, and one optimum."""
    rng = np.random.default_rng(5)
    for _ in range(5):
        problem = random_problem(rng, horizon=6, n=3, nu=2, n_c=1)
        query = (0.1 * rng.normal(size=3), rng.normal(size=(6, 3)), problem.model.u_bar)
        plans = []
        for formulation in (Staged(problem), Condensed(problem)):
            backend = DaqpDense()
            peer = Piqp(dense=True)
            qp = formulation.assemble(Query(*query))
            backend.setup(formulation.qp)
            peer.setup(Condensed(problem).qp)
            expected = peer.solve(Condensed(problem).assemble(Query(*query)))
            solution = backend.solve(qp)
            assert solution.status == expected.status
            if solution.status != SOLVED:
                continue
            residuals = kkt_residuals(qp, solution)
            assert residuals.worst < 1e-3 * max(1.0, float(np.abs(solution.z).max(initial=0.0)))
            plans.append(formulation.inputs(solution.x))
        if plans:
            np.testing.assert_allclose(plans[0], plans[1], atol=1e-3)


def small_qp(rng: np.random.Generator, name: str) -> QP:
    """Equality, one-sided and two-sided rows, and a box open in part, in the matrices that a back end takes."""
    n = 5
    inf = math.inf
    root = rng.normal(size=(n, n))
    entry = find_solver(name)
    matrix = csc_matrix if isinstance(entry.formulate(paper_problem()), Staged) else np.asarray
    return QP(
        P=matrix(root @ root.T + np.eye(n)),
        c=10.0 * rng.normal(size=n),
        A=matrix(rng.normal(size=(1, n))),
        b=np.array([0.3]),
        G=matrix(rng.normal(size=(3, n))),
        h_l=np.array([-1.0, -inf, -1.0]),
        h_u=np.array([1.0, 1.0, inf]),
        x_l=np.array([-1.0, -inf, -1.0, -inf, -0.5]),
        x_u=np.array([1.0, 0.5, inf, inf, 0.5]),
    )


@pytest.mark.parametrize("name", ALWAYS)
def test_every_part_of_a_qp_may_change_from_one_solve_to_the_next(name: str) -> None:
    """By the KKT conditions of what was asked, there and back, bounds that open and close included.

    Other solvers of qpsolvers have the same back end as clarabel.  The core is none: it solves one problem, whose
    queries alone change.
    """
    rng = np.random.default_rng(2)
    inf = math.inf
    qp = small_qp(rng, name)
    other = small_qp(rng, name)
    changes = {
        **{part: getattr(other, part) for part in ("P", "c", "A", "G")},
        "b": np.array([-0.4]),
        "h_l": np.array([-1.0, -inf, 2.5]),
        "h_u": np.array([1.0, 0.2, 0.1]),
        "x_l": np.array([0.3, -inf, -1.0, -0.1, -0.5]),
        "x_u": np.array([1.0, 0.5, -0.2, 0.1, inf]),
    }
    cases = [qp, *(step for part, value in changes.items() for step in (replace(qp, **{part: value}), qp))]
    opened = replace(qp, h_l=np.full(3, -inf), h_u=np.array([inf, 0.0, inf]))
    cases += [opened, qp, replace(qp, x_l=np.full(5, -inf), x_u=np.full(5, inf)), qp, replace(opened, P=other.P), qp]
    backend = make_backend(name)
    answers = []
    backend.setup(qp)
    for case in cases:
        solution = backend.solve(case)
        assert solution.status == SOLVED
        assert kkt_residuals(case, solution).worst < 1e-5
        answers.append(solution.x)
    still = [i for i, (x, y) in enumerate(itertools.pairwise(answers)) if np.abs(y - x).max() < 1e-2]
    assert not still, "these changes move no optimum, so that nothing is tested"


@pytest.mark.slow("core")
def test_a_flight_by_daqp_holds_its_audit_and_is_the_same(constrained_flight: Flight) -> None:
    flight = Rollout(load_scenario("paper-constrained", ["controller.solver=daqp"])).fly()
    assert (flight.solver, constrained_flight.solver) == ("daqp", "piqp-multistage")
    assert flight.satisfied
    assert flight.log.control.fallback.max() == 0
    np.testing.assert_allclose(flight.log.control.speeds, constrained_flight.log.control.speeds, atol=0.01)


def test_unknown_solver_lists_those_there_are() -> None:
    with pytest.raises(UnknownNameError, match="'piqp-dens'"):
        QPSolver("piqp-dens", paper_problem())
    with pytest.raises(UnknownNameError, match="'core'"):
        QPSolver(CORE, paper_problem())
    with pytest.raises(UnknownNameError, match="'piqp-multistage-1' was removed: use 'piqp-multistage'"):
        QPSolver("piqp-multistage-1", paper_problem())
    assert {"clarabel", "quadprog"} & {*solver_entries()} <= {*qpsolvers.available_solvers}


def test_without_qpsolvers_its_names_say_how_to_install_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda module: None)
    with pytest.raises(UnknownNameError, match="'clarabel'"):
        find_solver("clarabel")


def test_piqp_is_the_staged_one_and_no_other_packages() -> None:
    assert find_solver("piqp") is SOLVERS["piqp-multistage"]
    assert "piqp" not in solver_entries()
    assert isinstance(make_backend("piqp"), Piqp)


def test_a_solver_of_qpsolvers_keeps_nothing_and_meets_the_kkt_conditions(constrained_flight: Flight) -> None:
    """Multipliers included, of box, rows and slacks: from either side, and none at infinity."""
    problem = paper_problem("paper-constrained", "controller.horizon=15")
    assert problem.bounds is not None
    soft = Penalty(l1=np.full(2, 1e4), l2=np.full(2, 1e4))
    problem = replace(problem, bounds=replace(problem.bounds, penalty=soft, u_max=np.full(4, np.inf)))
    active = 0
    for query in flight_queries(constrained_flight, problem, stride=120):
        answers = [QPSolver(name, problem).solve(query) for name in ("clarabel", "piqp-dense")]
        assert [answer.status for answer in answers] == [SOLVED, SOLVED]
        np.testing.assert_allclose(answers[0].plan[0], answers[1].plan[0], atol=1e-3)
        assert answers[0].certificate is not None
        qp, solution = answers[0].certificate()
        assert kkt_residuals(qp, solution).worst < 1e-3 * max(1.0, float(np.abs(solution.z).max()))
        active += answers[0].stats.active
    assert active > 10


def test_a_solver_that_is_not_installed_names_its_package(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda module: None)
    with pytest.raises(MissingPackageError, match="'daqp'"):
        make_backend("daqp")
    assert SOLVERS["daqp"].line == "not installed: pip install 'quadsim[daqp]'"
    assert not SOLVERS["daqp"].installed
