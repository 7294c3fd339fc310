"""The optimum in closed form: from a poor start it is found, and the KKT conditions say so."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import scipy.linalg
from hypothesis import given
from hypothesis import strategies as st
from support import paper_problem, paper_reference, random_axes

from mpc.exact.polish import DensePolish, RowPolish, polish
from mpc.exact.shortcut import Shortcut
from mpc.ocp import Problem
from mpc.paper.condensed import condensed
from mpc.qp import QP, Solution, Vectors, kkt_residuals
from mpc.solvers import SOLVERS, QPSolver, Route, make_backend
from mpc.solvers.piqp_dense import PiqpDense
from quadsim.controller import ACCEPTED, SOLVED
from quadsim.state import Array


@pytest.mark.parametrize("name", ["piqp-dense", "piqp-multistage"])
def test_polish_sharpens_a_solution_a_thousandfold(name: str) -> None:
    problem = paper_problem()
    formulation, backend = SOLVERS[name].formulate(problem), make_backend(name)
    backend.setup(formulation.qp)
    desired = problem.objective.desired(paper_reference(51)[1:])
    vectors = formulation.vectors(np.zeros(12), desired, problem.model.u_bar)
    qp, solution = formulation.qp.with_vectors(vectors), backend.solve(vectors)
    optimum = polish(qp, solution)
    assert optimum.active > 10
    assert kkt_residuals(qp, optimum).worst < 1e-3 * kkt_residuals(qp, solution).worst
    assert np.abs(optimum.x - solution.x).max() < 1e-2


def test_polish_adds_and_drops_constraints() -> None:
    """With one active constraint too few, or one too many, the optimum is the same."""
    problem = paper_problem()
    formulation, backend = condensed(problem), PiqpDense()
    backend.setup(formulation.qp)
    reference = paper_reference(100)
    for k in range(0, 40, 8):
        desired = problem.objective.desired(reference[k + 1 : k + 51])
        vectors = formulation.vectors(np.zeros(12), desired, problem.model.u_bar)
        qp = formulation.qp.with_vectors(vectors)
        optimum = polish(qp, backend.solve(vectors))
        few, many = optimum.z.copy(), optimum.z.copy()
        few[np.argmax(np.abs(few))] = 0.0
        many[np.argmin(np.abs(many))] = 1e3
        for z in (few, many):
            assert not np.array_equal(z, optimum.z)
            again = polish(qp, replace(optimum, z=z))
            np.testing.assert_allclose(again.x, optimum.x, atol=1e-6)
            assert kkt_residuals(qp, again).worst < 1e-6


def row_problem(rng: np.random.Generator, *, n: int, rows: int) -> tuple[QP, Array]:
    """A QP with bounds on rows alone, some of them infinite, and its minimiser without them."""
    factor = rng.normal(size=(n, n))
    P, c, infinite = factor @ factor.T + 0.1 * np.eye(n), 3.0 * rng.normal(size=n), np.full(n, np.inf)
    lower, upper = -rng.uniform(0.1, 1.0, rows), rng.uniform(0.1, 1.0, rows)
    lower[rng.random(rows) < 0.2] = -np.inf
    qp = QP(
        P=P,
        c=c,
        A=np.zeros((0, n)),
        b=np.zeros(0),
        G=rng.normal(size=(rows, n)),
        h_l=lower,
        h_u=upper,
        x_l=-infinite,
        x_u=infinite,
    )
    return qp, np.asarray(-np.linalg.solve(P, c))


@given(seed=st.integers(0, 10_000), rows=st.integers(1, 8), off=st.sampled_from([0.0, 1e-3, 1.0]))
def test_rows_are_polished_to_the_optimum(seed: int, rows: int, off: float) -> None:
    """From multipliers that are a little or a lot off; the KKT conditions are the judge."""
    rng = np.random.default_rng(seed)
    qp, free = row_problem(rng, n=8, rows=rows)
    polish = RowPolish(np.asarray(qp.P), np.asarray(qp.G))
    backend = PiqpDense()
    backend.setup(qp)
    rough = backend.solve(Vectors(c=qp.c, b=qp.b, h_l=qp.h_l, h_u=qp.h_u))
    z = polish.multipliers(qp.G @ free, rough.z + off * rng.normal(size=rows), qp.h_l, qp.h_u)
    assert z is not None
    exact = replace(rough, x=free - polish.R @ z, z=z, z_box=np.zeros(8))
    assert kkt_residuals(qp, exact).worst < 1e-8 * max(1.0, np.abs(z).max())
    np.testing.assert_allclose(exact.x, rough.x, atol=1e-3)


def test_rows_that_depend_on_each_other_share_their_multipliers() -> None:
    """The same row twice, both taken for active: no multipliers are the only ones, and those come near that were."""
    G, upper = np.array([[1.0, 0.0], [1.0, 0.0]]), np.ones(2)
    polish = RowPolish(np.eye(2), G)
    for near, exact in (([0.5, 0.5], [0.5, 0.5]), ([1.0, 0.0], [1.0, 0.0]), ([0.75, 0.25001], [0.74999, 0.25001])):
        z = polish.multipliers(np.full(2, 2.0), np.array(near), -upper, upper)
        np.testing.assert_allclose(np.asarray(z), exact, atol=1e-12)


def test_rounds_are_given_up() -> None:
    """Both rows are violated at first, and with both active one multiplier has the wrong sign: one round is too few."""
    polish, upper = RowPolish(np.eye(2), np.array([[1.0, 0.0], [0.6, 0.8]])), np.ones(2)
    free = np.array([2.0, 1.3])
    assert polish.multipliers(free, np.zeros(2), -upper, upper, most=1) is None
    np.testing.assert_allclose(np.asarray(polish.multipliers(free, np.zeros(2), -upper, upper)), [1.0, 0.0])


def certified(qp: QP, solution: Solution) -> Array | None:
    """The optimum x, in extended precision, of the rows that a solution calls active; None where it proves not to be.

    Feasible, with multipliers of the right signs and the gradient they must have, x is the one optimum of a strictly
    convex QP, whoever called what active.
    """
    n, wide = qp.c.size, np.longdouble
    rows = np.vstack([np.eye(n), np.asarray(qp.G)])
    lower, upper = np.concatenate([qp.x_l, qp.h_l]), np.concatenate([qp.x_u, qp.h_u])
    side = np.sign(np.concatenate([solution.z_box, solution.z]))
    active = np.flatnonzero(side)
    if active.size:
        _, size, order = scipy.linalg.qr(rows[active].T, mode="economic", pivoting=True)
        active = active[order[: np.count_nonzero(np.abs(size.diagonal()) > 1e-9 * abs(size[0, 0]))]]
    M, m = rows[active], active.size
    system = np.block([[np.asarray(qp.P), M.T], [M, np.zeros((m, m))]]).astype(wide)
    unit = 1.0 / np.sqrt(np.concatenate([np.diag(qp.P), np.ones(m)]).astype(wide))
    right_side = np.concatenate([-qp.c, np.where(side > 0, upper, lower)[active]]) * unit
    answer = eliminated(system * unit[:, None] * unit, right_side) * unit
    x, multipliers = answer[:n], answer[n:]
    values = rows.astype(wide) @ x
    feasible = np.maximum(values - upper, lower - values).max() < 1e-12
    right = m == 0 or (multipliers * side[active]).min() > -1e-13 * np.abs(multipliers).max()
    return np.asarray(x, dtype=float) if feasible and right else None


def eliminated(A: Any, b: Any) -> Any:
    """A x = b by Gauss, in the numbers' own precision, which LAPACK does not have."""
    A, b = A.copy(), b.copy()
    for i in range(b.size):
        pivot = i + np.argmax(np.abs(A[i:, i]))
        A[[i, pivot]], b[[i, pivot]] = A[[pivot, i]], b[[pivot, i]]
        factors = A[i + 1 :, i] / A[i, i]
        A[i + 1 :, i:] -= np.outer(factors, A[i, i:])
        b[i + 1 :] -= factors * b[i]
    for i in reversed(range(b.size)):
        b[i] = (b[i] - A[i, i + 1 :] @ b[i + 1 :]) / A[i, i]
    return b


def test_the_certificate_is_of_the_optimum_alone() -> None:
    """x^2 + y^2 with x >= 1: 1, 0; not where another row is called active, or none."""
    far = np.full(2, np.inf)
    qp = QP(P=2.0 * np.eye(2), c=np.zeros(2), A=np.zeros((0, 2)), b=np.zeros(0), G=np.array([[1.0, 0.0], [0.0, 1.0]]),
            h_l=np.array([1.0, -1.0]), h_u=far, x_l=-far, x_u=far)  # fmt: skip
    backend = PiqpDense()
    backend.setup(qp)
    solution = backend.solve(Vectors(c=qp.c, b=qp.b, h_l=qp.h_l, h_u=qp.h_u))
    for z, exact in (([-2.0, 0.0], True), ([0.0, 0.0], False), ([-2.0, -1.0], False)):
        x = certified(qp, replace(solution, z=np.array(z), z_box=np.zeros(2)))
        assert (x is not None) is exact
        if x is not None:
            np.testing.assert_array_equal(x, [1.0, 0.0])


def spread(problem: Problem, rng: np.random.Generator, ratio: float) -> Problem:
    """A problem whose output weights are up to a ratio apart."""
    size = ratio ** rng.uniform(0.0, 0.5, len(problem.objective.Q_y))
    weights = problem.objective.Q_y * size[:, None] * size
    return replace(problem, objective=replace(problem.objective, Q_y=0.5 * (weights + weights.T)))


@pytest.mark.parametrize(("ratio", "room", "off", "exact"), [(1.0, 1.0, 1e-8, 1e-11), (1e9, 10.0, 1e-3, 2e-6)])
def test_whole_qps_are_polished_to_the_optimum(ratio: float, room: float, off: float, exact: float) -> None:
    """Random ones, with weights up to a billion apart: every one that has an active constraint is certified."""
    found = []
    for seed in range(60):
        rng = np.random.default_rng(seed)
        problem = spread(random_axes(rng, horizon=6, room=room), rng, ratio)
        query = 2.0 * rng.normal(size=7), 2.0 * rng.normal(size=(6, 7)), problem.model.u_bar
        solver = QPSolver("piqp-multistage", problem)
        near = solver.formulation.condensed(solver.solve(*query).solution)
        if near.status != SOLVED or not near.active:
            continue
        formulation = condensed(problem)
        qp = formulation.qp.with_vectors(formulation.vectors(*query))
        polished = DensePolish(formulation.qp).optimum(qp, near)
        x = certified(qp, polished)
        assert x is not None
        found.append((np.abs(near.x - x).max(), np.abs(polished.x - x).max()))
    errors, left = np.array(found).T
    assert errors.size > 30
    assert errors.max() > off
    assert left.max() < exact


@pytest.mark.parametrize(("ratio", "exact"), [(1.0, 1e-10), (1e9, 1e-5)])
def test_every_way_ends_at_the_optimum(ratio: float, exact: float) -> None:
    """Without a QP, axis by axis and by the whole QP: docs/controllers.md tells these numbers."""
    errors: dict[Route, list[float]] = {way: [] for way in Route}
    asked = 0
    for seed in range(100):
        rng = np.random.default_rng(seed)
        problem = spread(random_axes(rng, horizon=6, room=float(rng.choice([1.0, 10.0, 1000.0]))), rng, ratio)
        size = float(rng.choice([0.05, 2.0]))
        query = size * rng.normal(size=7), size * rng.normal(size=(6, 7)), problem.model.u_bar
        answer = Shortcut(problem, QPSolver("piqp-multistage", problem)).solve(*query)
        if answer.solution.status not in ACCEPTED:
            continue
        formulation = condensed(problem)
        x = certified(formulation.qp.with_vectors(formulation.vectors(*query)), answer.solution)
        asked += 1
        if x is not None:
            errors[answer.route].append(np.abs(answer.plan.ravel() - x).max())
    assert min(map(len, errors.values())) > 10
    assert sum(map(len, errors.values())) >= 0.95 * asked
    assert max(map(max, errors.values())) < exact


def vertex() -> tuple[QP, Solution]:
    """The paper's vehicle told to drop 100 m: its rotors slow down by 10 rad/s a step, and then stand still.

    The twentieth step of 10 rad/s from 192.8 would end below zero; with hover at 200 rad/s it ends there, and the step,
    those before it and the bound of zero depend on each other.
    """
    problem = paper_problem()
    problem = replace(problem, model=replace(problem.model, u_bar=np.full(4, 200.0)))
    solver, state, desired = QPSolver("piqp-multistage", problem), np.zeros(12), np.zeros((50, 4))
    state[4] = 100.0
    query = state, desired, problem.model.u_bar
    formulation = condensed(problem)
    near = solver.formulation.condensed(solver.solve(*query).solution)
    return formulation.qp.with_vectors(formulation.vectors(*query)), near


def test_active_constraints_may_depend_on_each_other() -> None:
    qp, near = vertex()
    assert near.status == SOLVED
    polished = DensePolish(qp).optimum(qp, near)
    assert polished is not near
    active = np.concatenate([polished.z_box, polished.z]) != 0.0
    rows = np.vstack([np.eye(qp.c.size), np.asarray(qp.G)])[active]
    assert np.linalg.matrix_rank(rows) < len(rows)
    assert kkt_residuals(qp, polished).worst < 1e-3 * kkt_residuals(qp, near).worst
    np.testing.assert_allclose(polished.x, polish(qp, near).x, atol=1e-6)


def test_what_is_no_better_is_not_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    """The given solution stands where the rounds have no end, or their end is not the optimum."""
    qp, near = vertex()
    polished = DensePolish(qp)
    assert polished.optimum(qp, near) is not near
    right = RowPolish.multipliers
    monkeypatch.setattr(RowPolish, "multipliers", lambda *given, **most: np.abs(right(*given, **most)))
    assert polished.optimum(qp, near) is near
    monkeypatch.setattr(RowPolish, "multipliers", lambda *_, **__: None)
    assert polished.optimum(qp, near) is near
