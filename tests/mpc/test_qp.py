"""Eq. (27): both formulations of the QP, against the KKT conditions, a second solver and each other."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support import paper_problem, paper_reference, random_problem

from mpc.ocp import Problem
from mpc.paper.condensed import condensed
from mpc.qp import QP, Backend, Formulation, Solution, Vectors, kkt_residuals
from mpc.solvers import SOLVERS, QPSolver, make_backend
from mpc.solvers.piqp_dense import PiqpDense
from mpc.solvers.piqp_sparse import PiqpMultistage
from mpc.staged import Staged
from quadsim.controller import SOLVED
from quadsim.state import Array
from scenarios.run import Flight

STATE = np.zeros(12)
STATE[10] = np.pi / 6


def flight_queries(flight: Flight, problem: Problem, stride: int) -> list[tuple[Array, Array, Array]]:
    """(xi(k), y_d, u(k-1)) of every `stride`-th period of a flight."""
    log, N = flight.log.control, problem.horizon
    reference = paper_reference(log.t.size + N)
    before = np.vstack([log.speeds_before, log.speeds[:-1]])
    return [
        (log.state[k], problem.objective.desired(reference[k + 1 : k + 1 + N]), before[k])
        for k in range(0, log.t.size, stride)
    ]


@pytest.mark.parametrize("name", ["piqp-multistage", "piqp-multistage-1", "piqp-dense", "daqp"])
def test_kkt_conditions_hold_over_the_flight(constrained_flight: Flight, name: str) -> None:
    problem = paper_problem()
    formulation, backend = SOLVERS[name].formulate(problem), make_backend(name)
    backend.setup(formulation.qp)
    active = 0
    for query in flight_queries(constrained_flight, problem, stride=20):
        vectors = formulation.vectors(*query)
        solution = backend.solve(vectors)
        assert solution.status == SOLVED
        residuals = kkt_residuals(formulation.qp.with_vectors(vectors), solution)
        assert residuals.primal < 1e-6
        assert residuals.stationarity < 1e-4  # gradients are of order 1e4
        assert residuals.complementarity < 1e-4  # multipliers reach 1e3
        assert residuals.dual == 0.0
        active += solution.active
    assert active > 100  # the flight does press against its bounds


def test_first_input_agrees_with_solvers_of_other_families(constrained_flight: Flight) -> None:
    """Interior point, active set, operator splitting; the last gives up on some, and says so."""
    problem = paper_problem()
    ours, daqp, osqp = (QPSolver(name, problem) for name in ("piqp-multistage", "daqp", "osqp"))
    agreed = 0
    for query in flight_queries(constrained_flight, problem, stride=75):
        plan = ours.solve(*query).plan
        np.testing.assert_allclose(daqp.solve(*query).plan[0], plan[0], atol=1e-3)
        other = osqp.solve(*query)
        assert other.solution.status in {SOLVED, "solved_inaccurate", "max_iterations"}
        if other.solution.status == SOLVED:
            np.testing.assert_allclose(other.plan[0], plan[0], atol=1e-3)
            agreed += other.solution.active > 0
    assert agreed >= 3  # also where constraints are active


@pytest.mark.parametrize("steps", [1, 3, 5, 7, 50, 80])
def test_every_stage_length_gives_the_condensed_optimum(steps: int) -> None:
    problem = paper_problem()
    reference = paper_reference(60)[1:51]
    plans = []
    for formulation, backend in (
        (condensed(problem), PiqpDense()),
        (Staged(problem, steps_per_stage=steps), PiqpMultistage()),
    ):
        backend.setup(formulation.qp)
        vectors = formulation.vectors(STATE, problem.objective.desired(reference), problem.model.u_bar)
        solution = backend.solve(vectors)
        assert solution.status == SOLVED
        plans.append(formulation.inputs(solution.x))
    np.testing.assert_allclose(plans[1], plans[0], atol=1e-3)


def solved(formulation: Formulation, backend: Backend, query: tuple[Array, Array, Array]) -> tuple[QP, Solution]:
    backend.setup(formulation.qp)
    vectors: Vectors = formulation.vectors(*query)
    return formulation.qp.with_vectors(vectors), backend.solve(vectors)


@settings(max_examples=60)
@given(seed=st.integers(0, 2**32 - 1), horizon=st.integers(1, 25), n=st.integers(1, 5), steps=st.integers(1, 9))
def test_random_systems_give_one_optimum_in_both_forms(seed: int, horizon: int, n: int, steps: int) -> None:
    """Random stable systems, weights, bounds and horizons; u(k-1) inside its bounds."""
    rng = np.random.default_rng(seed)
    problem = random_problem(rng, horizon=horizon, n=n, nu=int(rng.integers(1, 4)), n_c=int(rng.integers(0, 3)))
    assert problem.bounds is not None
    before = rng.uniform(problem.bounds.u_min, problem.bounds.u_max)
    query = (rng.normal(size=n) * 0.3, rng.normal(size=(horizon, n)), before)
    dense, structured = condensed(problem), Staged(problem, steps_per_stage=steps)
    qp, one = solved(dense, PiqpDense(), query)
    other_qp, two = solved(structured, PiqpMultistage(), query)
    assert (one.status == SOLVED) == (two.status == SOLVED)  # feasibility is no matter of form
    if one.status != SOLVED:
        return
    for program, solution in ((qp, one), (other_qp, two)):
        scale = max(1.0, float(np.abs(solution.z).max(initial=0.0)))
        assert kkt_residuals(program, solution).worst < 1e-4 * scale
    np.testing.assert_allclose(structured.inputs(two.x), dense.inputs(one.x), atol=1e-3)


def test_kkt_residuals_see_every_kind_of_fault() -> None:
    problem = paper_problem()
    formulation, backend = condensed(problem), PiqpDense()
    query = (STATE, problem.objective.desired(paper_reference(60)[1:51]), problem.model.u_bar)
    qp, solution = solved(formulation, backend, query)
    assert kkt_residuals(qp, solution).worst < 1e-3
    assert kkt_residuals(qp, replace(solution, x=solution.x + 1.0)).stationarity > 0.1
    assert kkt_residuals(qp, replace(solution, x=solution.x * 3.0)).primal > 1.0
    assert kkt_residuals(qp, replace(solution, z=solution.z + 1.0)).complementarity > 1.0
    assert np.isnan(kkt_residuals(replace(qp, h_l=qp.h_l * np.nan), solution).worst)  # never taken for optimal
    unbounded = replace(qp, x_u=np.full_like(qp.x_u, np.inf))
    assert kkt_residuals(unbounded, replace(solution, z_box=solution.z_box + 1.0)).dual > 0.9


def test_answers_are_copies_that_the_next_solve_leaves_alone() -> None:
    problem = paper_problem()
    solver = QPSolver("piqp-multistage", problem)
    desired = problem.objective.desired(paper_reference(60)[1:51])
    first = solver.solve(STATE, desired, problem.model.u_bar)
    kept = first.plan.copy(), first.solution.x.copy(), first.solution.y.copy()
    solver.solve(-STATE, -desired, problem.model.u_bar)
    for now, then in zip((first.plan, first.solution.x, first.solution.y), kept, strict=True):
        np.testing.assert_array_equal(now, then)


@pytest.mark.parametrize("build", [condensed, Staged])
def test_a_problem_without_bounds_needs_no_qp(build: object) -> None:
    with pytest.raises(ValueError, match="needs a problem with bounds"):
        build(paper_problem("paper-unconstrained"))  # type: ignore[operator]


def tight_slews(horizon: int = 50) -> Problem:
    """The paper's problem with rotors so slow that the whole plan is bound by them."""
    problem = paper_problem("paper-constrained", f"controller.horizon={horizon}")
    assert problem.bounds is not None
    return replace(problem, bounds=replace(problem.bounds, delta_min=np.full(4, -0.2), delta_max=np.full(4, 0.2)))


def test_rows_left_out_at_first_are_found_where_they_bind() -> None:
    """Slews late in the plan seldom bind; where they do, the answer is that of the whole QP, and tells its cost."""
    problem = tight_slews()
    query = np.zeros(12), problem.objective.desired(paper_reference(51)[1:]), problem.model.u_bar
    formulation, backend = Staged(problem), PiqpMultistage()
    backend.setup(formulation.qp)
    vectors = formulation.vectors(*query)
    solution = backend.solve(vectors)
    late = solution.z[-formulation.qp.seldom :]
    assert np.abs(late).max() > 1.0
    assert kkt_residuals(formulation.qp.with_vectors(vectors), solution).worst < 1e-4
    whole = PiqpMultistage()
    whole.setup(replace(formulation.qp, seldom=0))
    alone = whole.solve(vectors)
    np.testing.assert_array_equal(solution.x, alone.x)
    assert solution.iterations > alone.iterations


def test_rows_left_out_at_first_do_not_bind_over_the_flight(constrained_flight: Flight) -> None:
    """And then one smaller QP gives the whole one's solution."""
    problem = paper_problem()
    formulation = Staged(problem)
    assert formulation.qp.seldom == 4 * (50 - 32)
    once, whole = PiqpMultistage(), PiqpMultistage()
    once.setup(formulation.qp)
    whole.setup(replace(formulation.qp, seldom=0))
    for query in flight_queries(constrained_flight, problem, stride=25):
        vectors = formulation.vectors(*query)
        solution, alone = once.solve(vectors), whole.solve(vectors)
        assert solution.z.shape == alone.z.shape
        assert not solution.z[-formulation.qp.seldom :].any()
        assert kkt_residuals(formulation.qp.with_vectors(vectors), solution).worst < 1e-4
        np.testing.assert_allclose(formulation.inputs(solution.x)[0], formulation.inputs(alone.x)[0], atol=1e-3)


def test_first_inputs_are_exact_over_the_flight(constrained_flight: Flight) -> None:
    """Within 1e-3 rad/s of an active-set solver's, which ends at a vertex and not near one."""
    problem = paper_problem()
    ours, exact = QPSolver("piqp-multistage", problem), QPSolver("daqp", problem)
    queries = flight_queries(constrained_flight, problem, stride=2)
    errors = [np.abs(ours.solve(*query).plan[0] - exact.solve(*query).plan[0]).max() for query in queries]
    assert max(errors) < 1e-3


@pytest.mark.parametrize("steps", [1, 4, 5, 50, 60])
def test_stages_cover_the_horizon(steps: int) -> None:
    """Whatever M, and whatever is left for the first stage and the last, the QP is the same."""
    problem = paper_problem()
    query = np.zeros(12), problem.objective.desired(paper_reference(51)[1:]), problem.model.u_bar
    expected = QPSolver("piqp-dense", problem).solve(*query).plan
    formulation, backend = Staged(problem, steps_per_stage=steps), PiqpMultistage()
    backend.setup(formulation.qp)
    solution = backend.solve(formulation.vectors(*query))
    np.testing.assert_allclose(formulation.inputs(solution.x)[0], expected[0], atol=1e-3)
    np.testing.assert_allclose(formulation.inputs(solution.x), expected, atol=0.05)


def test_products_of_rounding_are_left_out() -> None:
    """Rotors on body x do not roll the vehicle, though cos(90 deg) is not zero in binary."""
    qp = Staged(paper_problem()).qp
    outputs = abs(qp.G[:100]).tocsr()
    for row in (outputs[i].data for i in range(outputs.shape[0]) if outputs[i].nnz):
        assert row.min() > 1e-12 * row.max()
