"""The optimum in closed form: from a poor start it is found, and the KKT conditions say so."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support import paper_problem, paper_reference

from mpc.condensed import condensed
from mpc.polish import RowPolish, polish
from mpc.qp import QP, Vectors, kkt_residuals
from mpc.solvers import SOLVERS, make_backend
from mpc.solvers.piqp_dense import PiqpDense
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
    polish = RowPolish(np.asarray(qp.P), np.asarray(qp.G), qp.h_l, qp.h_u)
    backend = PiqpDense()
    backend.setup(qp)
    rough = backend.solve(Vectors(c=qp.c, b=qp.b, h_l=qp.h_l, h_u=qp.h_u))
    z = polish.multipliers(qp.G @ free, rough.z + off * rng.normal(size=rows))
    assert z is not None
    exact = replace(rough, x=free - polish.R @ z, z=z, z_box=np.zeros(8))
    assert kkt_residuals(qp, exact).worst < 1e-8 * max(1.0, np.abs(z).max())
    np.testing.assert_allclose(exact.x, rough.x, atol=1e-3)


def test_rows_that_depend_on_each_other_are_not_polished() -> None:
    """The same row twice, both taken for active."""
    G = np.array([[1.0, 0.0], [1.0, 0.0]])
    polish = RowPolish(np.eye(2), G, np.full(2, -1.0), np.full(2, 1.0))
    assert polish.multipliers(np.array([2.0, 2.0]), np.array([0.5, 0.5])) is None
    z = polish.multipliers(np.array([2.0, 0.5]), np.array([1.0, 0.0]))
    np.testing.assert_allclose(np.asarray(z), [1.0, 0.0])
