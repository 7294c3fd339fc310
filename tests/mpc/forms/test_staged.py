"""The staged QP: against the condensed one, against a peer's optimum for models that change, and its KKT conditions."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import fields, replace

import numpy as np
import ocp_peer
import pytest
import scipy.optimize
from hypothesis import given
from hypothesis import strategies as st
from numpy_preparation import nonlinear_model
from ocp_peer import Period
from polish import polish
from scipy.sparse import csc_matrix
from support import (
    changing_period,
    flight_queries,
    linearised,
    paper_problem,
    paper_reference,
    random_problem,
    with_terms,
)

from quadsim.controller import SOLVED
from quadsim.mpc.forms.condensing import Condensed
from quadsim.mpc.forms.staged import Staged
from quadsim.mpc.problem.constraints import Constraint, Penalty
from quadsim.mpc.problem.ocp import Equilibrium, Problem, Query
from quadsim.mpc.problem.qp import QP, Solution, kkt_residuals
from quadsim.mpc.solvers import Formulation
from quadsim.mpc.solvers.piqp import Piqp
from quadsim.rollout.flown import Flight
from quadsim.state import Array
from quadsim.vehicle import Vehicle

LAG = 0.05


class Changing:
    """A problem whose model changes, with all states as variables."""

    def __init__(self, problem: Problem) -> None:
        self.form = Staged(problem)

    def qp(self, now: Period) -> QP:
        return self.form.assemble(now.query)

    def solve(self, now: Period) -> Solution:
        backend = Piqp()
        qp = self.qp(now)
        backend.setup(qp)
        return backend.solve(qp)

    def plan(self, solution: Solution) -> Array:
        return self.form.inputs(solution.x)

    def slacks(self, solution: Solution) -> Array:
        return self.form.slacks(solution.x)

    def states(self, solution: Solution) -> Array:
        return self.form.states(solution.x)


def softened(problem: Problem, l1: list[float], l2: list[float], *, largest: bool = False) -> Problem:
    assert problem.bounds is not None
    penalty = Penalty(l1=np.array(l1), l2=np.array(l2), largest=largest)
    return replace(problem, bounds=replace(problem.bounds, penalty=penalty))


def exact(form: Formulation, query: tuple[Array, Array, Array, Equilibrium]) -> tuple[Array, Array, float]:
    """Plan and slacks at a form's optimum, with its KKT residual over the size of its multipliers."""
    backend = Piqp() if isinstance(form, Staged) else Piqp(dense=True)
    backend.setup(form.qp)
    qp = form.assemble(Query(*query))
    solution = backend.solve(qp)
    assert solution.status == SOLVED
    optimum = polish(qp, solution)
    size = max(1.0, float(np.abs(np.concatenate([optimum.z, optimum.z_box])).max()))
    return form.inputs(optimum.x), form.slacks(optimum.x), kkt_residuals(qp, optimum).worst / size


@given(
    seed=st.integers(0, 2**32 - 1),
    horizon=st.integers(1, 12),
    n=st.integers(1, 4),
    nu=st.integers(1, 3),
    terms=st.sets(st.sampled_from(["soft", "margins", "Q_d", "P", "constraints"])),
    elsewhere=st.booleans(),
)
def test_the_optimum_equals_the_condensed_one(
    seed: int, horizon: int, n: int, nu: int, terms: set[str], elsewhere: bool
) -> None:
    """Of random problems with every term that there is, at rest in the origin or elsewhere; feasible by their start."""
    rng = np.random.default_rng(seed)
    problem = with_terms(rng, random_problem(rng, horizon=horizon, n=n, nu=nu, n_c=2), terms)
    model = problem.model
    rest = (
        Equilibrium(0.1 * rng.normal(size=n), model.u_bar + 0.05 * rng.normal(size=nu))
        if elsewhere
        else problem.equilibrium
    )
    before = model.u_bar + 0.05 * rng.normal(size=nu)
    query = 0.1 * rng.normal(size=n), rng.normal(size=(horizon, len(problem.objective.C_r))), before, rest
    staged = Staged(problem)
    solver = Piqp()
    solver.setup(staged.qp)
    peer = ocp_peer.optimum(problem, ocp_peer.period(problem, *query[:4]))
    if peer.solution.status != SOLVED:
        assert solver.solve(staged.assemble(Query(*query))).status != SOLVED
        return
    plan, slacks, residual = exact(staged, query)
    other, others, residual_of_condensed = exact(Condensed(problem), query)
    size = max(1.0, float(np.abs(other).max()))
    assert max(residual, residual_of_condensed) < 1e-8
    np.testing.assert_allclose(plan, other, rtol=0.0, atol=1e-8 * size)
    np.testing.assert_allclose(slacks, others, rtol=0.0, atol=1e-8 * size)
    np.testing.assert_allclose(plan, peer.plan, rtol=0.0, atol=1e-7 * size)


@pytest.mark.parametrize("horizon", [1, 2, 17])
def test_the_papers_optimum_equals_the_condensed_one(horizon: int) -> None:
    problem = paper_problem("paper-constrained", f"controller.horizon={horizon}")
    state = np.zeros(12)
    state[10] = np.pi / 6
    query = state, problem.desired(paper_reference(horizon + 1)[1:]), problem.model.u_bar, problem.equilibrium
    plan, _, residual = exact(Staged(problem), query)
    other, _, _ = exact(Condensed(problem), query)
    assert residual < 1e-8
    np.testing.assert_allclose(plan, other, atol=1e-6)


def test_matrices_are_made_once_and_zeros_left_out() -> None:
    """A period changes vectors alone, so that PIQP keeps what it has scaled; its multistage factorisation is sparse."""
    problem = paper_problem()
    form = Staged(problem)
    rng = np.random.default_rng(0)
    query = Query(0.1 * rng.normal(size=12), rng.normal(size=(50, 4)), problem.model.u_bar)
    qp = form.assemble(query)
    for name in ("P", "A", "G", "x_l", "x_u"):
        assert getattr(qp, name) is getattr(form.qp, name)
    for matrix in (qp.P, qp.A, qp.G):
        assert isinstance(matrix, csc_matrix)
        assert matrix.data.all()
        assert matrix.has_sorted_indices


def test_rows_of_other_numbers_are_written_to_the_same_places() -> None:
    """Half-spaces that turn with the plan: a zero among them stays stored, and the QP is that of their own problem."""
    rng = np.random.default_rng(3)
    problem = paper_problem("paper-constrained", "controller.horizon=7")
    none = np.full((7, 2), np.inf)

    def with_rows(normals: Array) -> Problem:
        C = np.zeros((7, 2, 12))
        C[:, :, [0, 2, 4]] = normals
        rows = Constraint(name="planes", C=C, lower=-none, upper=np.tile(rng.uniform(1.0, 2.0, 2), (7, 1)))
        return replace(problem, constraints=(rows,))

    form = Staged(with_rows(np.full((7, 2, 3), 3.0**-0.5)))
    turned = rng.normal(size=(7, 2, 3))
    turned[3, 1] = [0.0, 1.0, 0.0]
    turned /= np.linalg.norm(turned, axis=2, keepdims=True)
    other = with_rows(turned)
    query = Query(0.1 * rng.normal(size=12), rng.normal(size=(7, 4)), problem.model.u_bar)
    qp = form.assemble(query, other)
    expected = Staged(other).assemble(query)
    np.testing.assert_array_equal(qp.G.indices, form.qp.G.indices)
    np.testing.assert_array_equal(qp.G.indptr, form.qp.G.indptr)
    assert not qp.G.data.all()
    for field in fields(QP):
        value = getattr(qp, field.name)
        wanted = getattr(expected, field.name)
        if isinstance(value, csc_matrix):
            value = value.toarray()
            wanted = wanted.toarray()
        np.testing.assert_array_equal(value, wanted)


# Models that change from step to step


@pytest.mark.parametrize("horizon", [1, 7])
@pytest.mark.parametrize("soft", [False, True, "largest"])
@pytest.mark.parametrize("terms", [(), ("Q_d", "margins"), ("P", "constraints")])
def test_systems_that_change_agree_with_a_peer(horizon: int, soft: bool | str, terms: tuple[str, ...]) -> None:
    """Moves weighed, bounds tightened, a terminal weight and further rows: the peer rolls all of them out by itself."""
    rng = np.random.default_rng(100 * horizon + 1)
    solved = 0
    for _ in range(8):
        problem = random_problem(rng, horizon=horizon, n=3, nu=2, n_c=2)
        if soft == "largest":
            problem = softened(problem, [5.0, 5.0], [2.0, 2.0], largest=True)
        elif soft:
            problem = softened(problem, [30.0, 5.0], [2.0, 0.0])
        problem = with_terms(rng, problem, terms)
        now = changing_period(rng, problem)
        peer = ocp_peer.optimum(problem, now)
        solver = Changing(problem)
        solution = solver.solve(now)
        assert (solution.status == SOLVED) == (peer.solution.status == SOLVED)
        if peer.solution.status != SOLVED:
            continue
        np.testing.assert_allclose(solver.plan(solution), peer.plan, atol=2e-4)
        np.testing.assert_allclose(solver.slacks(solution), peer.slacks, atol=2e-4)
        states = ocp_peer.trajectory(now, solver.plan(solution))[1:]
        np.testing.assert_allclose(solver.states(solution), states, atol=1e-6)
        size = max(1.0, float(np.abs(solution.z).max()))
        assert kkt_residuals(solver.qp(now), solution).worst < 1e-5 * size
        solved += 1
        if solved == 2:
            break
    assert solved == 2


@pytest.mark.parametrize("soft", [False, True])
def test_bounds_at_infinity_are_none(soft: bool) -> None:
    rng = np.random.default_rng(8)
    problem = random_problem(rng, horizon=6, n=3, nu=2, n_c=2)
    assert problem.bounds is not None
    endless = np.array([-math.inf, -math.inf])
    above = np.array([1.0, math.inf])
    below = np.array([-0.1, -math.inf])
    bounds = replace(problem.bounds, y_min=below, y_max=-endless, delta_min=endless, delta_max=above)
    problem = replace(problem, bounds=bounds)
    if soft:
        problem = softened(problem, [30.0, 30.0], [0.0, 0.0])
    now = changing_period(rng, problem)
    solver = Changing(problem)
    peer = ocp_peer.optimum(problem, now)
    solution = solver.solve(now)
    assert peer.solution.status == solution.status == SOLVED
    np.testing.assert_allclose(solver.plan(solution), peer.plan, atol=2e-4)


def lagging(problem: Problem, vehicle: Vehicle) -> Problem:
    """The paper's weights and bounds, for states that end with the rotor speeds."""
    assert problem.bounds is not None
    C_r, C_c = (np.pad(C, ((0, 0), (0, 4))) for C in (problem.objective.C_r, problem.bounds.C_c))
    hover = np.full(4, vehicle.hover_speed)
    model = nonlinear_model(vehicle, 0.05, rotor_lag=LAG)
    A, B, _ = linearised(model, np.concatenate([np.zeros(12), hover]), hover)
    return replace(
        problem,
        model=replace(problem.model, A=A, B=B),
        objective=replace(problem.objective, C_r=C_r),
        bounds=replace(problem.bounds, C_c=C_c),
    )


def along_flight(flight: Flight, vehicle: Vehicle, problem: Problem, stride: int) -> Iterator[Period]:
    """Periods of the nonlinear model with lag, each linearised at the state where it begins."""
    model = nonlinear_model(vehicle, 0.05, rotor_lag=LAG)
    hover = np.full(4, vehicle.hover_speed)
    for state, desired, before, *_ in flight_queries(flight, problem, stride):
        x0 = np.concatenate([state, before])
        A, B, c = (np.repeat(part[None], 50, axis=0) for part in linearised(model, x0, hover))
        rest = Equilibrium(np.zeros(16), hover)
        yield Period(A=A, B=B, c=c, state=x0, desired=desired, u_before=before, equilibrium=rest)


# Soft bounds


def test_slack_is_zero_where_hard_bounds_cost_less_than_its_price(constrained_flight: Flight, vehicle: Vehicle) -> None:
    problem = lagging(paper_problem(), vehicle)
    price = 3e3
    hard = Changing(problem)
    soft = Changing(softened(problem, [price, price], [1e4, 1e4]))
    pressing = dear = 0
    for now in along_flight(constrained_flight, vehicle, problem, stride=40):
        strict = hard.solve(now)
        lenient = soft.solve(now)
        assert lenient.status == SOLVED
        multiplier = np.abs(hard.form.multipliers(strict)[:, :2]).max()  # of the output bounds
        if strict.status == SOLVED and multiplier < price:
            pressing += int(multiplier > 1.0)
            assert soft.slacks(lenient).max() < 1e-7
            np.testing.assert_allclose(soft.plan(lenient)[:10], hard.plan(strict)[:10], atol=1e-3)
        else:
            dear += int(soft.slacks(lenient).max() > 1e-4)
    assert pressing > 2
    assert dear > 0


def test_slack_is_the_smallest_where_hard_bounds_are_infeasible() -> None:
    """A price far above all else comes within a thousandth of the least total violation, a linear program's."""
    problem = paper_problem()
    bounds = problem.bounds
    assert bounds is not None
    tilted = np.zeros(12)
    tilted[[6, 7, 9]] = np.radians([12.0, 20.0, 15.0])
    desired = problem.desired(np.zeros((50, 4)))
    u_bar = problem.model.u_bar
    now = ocp_peer.period(problem, tilted, desired, u_bar)
    assert Changing(problem).solve(now).status != SOLVED
    lenient = softened(problem, [1e6, 1e6], [0.0, 0.0])
    solver = Changing(lenient)
    solution = solver.solve(now)
    assert solution.status == SOLVED
    plan = solver.plan(solution)
    slacks = solver.slacks(solution)
    np.testing.assert_allclose(slacks, ocp_peer.violation(bounds.constraints[0], now, plan), atol=1e-7)
    # The same rows, probed, with slacks to be minimised alone.
    qp = ocp_peer.dense_qp(lenient, now)
    above = np.isfinite(qp.h_u)
    below = np.isfinite(qp.h_l)
    least = scipy.optimize.linprog(
        np.concatenate([np.zeros(200), np.ones(100)]),
        A_ub=np.vstack([qp.G[above], -qp.G[below]]),
        b_ub=np.concatenate([qp.h_u[above], -qp.h_l[below]]),
        bounds=[*[(None, None)] * 200, *[(0.0, None)] * 100],
    )
    assert least.status == 0
    assert slacks.sum() == pytest.approx(least.fun, rel=1e-3)
    assert least.fun > 0.01
