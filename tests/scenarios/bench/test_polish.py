"""The optimum in closed form: from a poor start it is found, by the KKT conditions."""

from __future__ import annotations

import numpy as np
import pytest
from support import paper_problem, paper_reference

from mpc.ocp import Query
from mpc.paper.condensed import Condensed
from mpc.qp import kkt_residuals
from mpc.solvers import SOLVERS, make_backend
from mpc.solvers.piqp_backends import PiqpDense
from scenarios.bench.polish import polish


@pytest.mark.parametrize("name", ["piqp-dense", "piqp-multistage"])
def test_polish_sharpens_a_solution_a_thousandfold(name: str) -> None:
    problem = paper_problem()
    formulation, backend = SOLVERS[name].formulate(problem), make_backend(name)
    backend.setup(formulation.qp)
    desired = problem.objective.desired(paper_reference(51)[1:])
    qp = formulation.pose(Query(np.zeros(12), desired, problem.model.u_bar)).qp
    solution = backend.solve(qp)
    optimum = polish(qp, solution)
    assert optimum.active > 10
    assert kkt_residuals(qp, optimum).worst < 1e-3 * kkt_residuals(qp, solution).worst
    assert np.abs(optimum.x - solution.x).max() < 1e-2


def test_polish_adds_and_drops_constraints() -> None:
    """With one active constraint too few, or one too many, the optimum is the same."""
    problem = paper_problem()
    formulation, backend = Condensed(problem), PiqpDense()
    backend.setup(formulation.qp)
    reference = paper_reference(100)
    for k in range(0, 40, 8):
        desired = problem.objective.desired(reference[k + 1 : k + 51])
        qp = formulation.pose(Query(np.zeros(12), desired, problem.model.u_bar)).qp
        optimum = polish(qp, backend.solve(qp))
        few, many = optimum.z.copy(), optimum.z.copy()
        few[np.argmax(np.abs(few))] = 0.0
        many[np.argmin(np.abs(many))] = 1e3
        for z in (few, many):
            assert not np.array_equal(z, optimum.z)
            again = polish(qp, optimum._replace(z=z))
            np.testing.assert_allclose(again.x, optimum.x, atol=1e-6)
            assert kkt_residuals(qp, again).worst < 1e-6
