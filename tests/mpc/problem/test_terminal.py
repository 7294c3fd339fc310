"""The terminal weight of the Riccati equation: without constraints the horizon is as good as infinite."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scipy.linalg
from polish import polish
from support import paper_problem, random_problem

from quadsim.errors import ParameterError
from quadsim.mpc.forms.condensing import Condensed
from quadsim.mpc.forms.staged import Staged
from quadsim.mpc.problem.ocp import Equilibrium, Objective, Problem, Query, lqr_terminal_weight
from quadsim.mpc.solvers import Formulation, Method, QPSolver
from quadsim.mpc.solvers.core_axes import axes
from quadsim.mpc.solvers.piqp import Piqp
from quadsim.state import Array


def terminated(problem: Problem) -> Problem:
    P = lqr_terminal_weight(problem.model, problem.objective)
    return replace(problem, objective=replace(problem.objective, P=P))


def without_bounds(problem: Problem) -> Problem:
    """Bounds so far away that none is ever active."""
    assert problem.bounds is not None
    far = {name: getattr(problem.bounds, name) * 0.0 + 1e5 for name in ("y_max", "delta_max", "u_max")}
    near = {name.replace("max", "min"): -value for name, value in far.items()}
    return replace(problem, bounds=replace(problem.bounds, **far, **near))


def gain(problem: Problem) -> Array:
    """K (nu, n) of the infinite horizon, by iterating the Riccati difference equation."""
    A = problem.model.A
    B = problem.model.B
    Q = problem.objective.weights[0]
    R = problem.objective.Q_u
    P = Q
    for _ in range(20_000):
        K = np.linalg.solve(R + B.T @ P @ B, B.T @ P @ A)
        after = Q + A.T @ P @ (A - B @ K)
        after = 0.5 * (after + after.T)
        if np.abs(after - P).max() < 1e-14 * np.abs(after).max():
            break
        P = after
    return np.asarray(K)


def first_inputs(problem: Problem, query: tuple[Array, Array, Array, Equilibrium]) -> dict[str, Array]:
    """By the free optimum, the condensed QP and the staged one."""
    answer = QPSolver("piqp-multistage", problem, free_first=True).solve(Query(*query))
    assert answer.method is Method.FREE
    result = {"free": answer.plan[0]}
    forms: tuple[Formulation, ...] = (Condensed(problem), Staged(problem))
    for form in forms:
        backend = Piqp(dense=True) if isinstance(form, Condensed) else Piqp()
        backend.setup(form.qp)
        qp = form.assemble(Query(*query))
        result[type(form).__name__] = form.inputs(polish(qp, backend.solve(qp)).x)[0]
    return result


@pytest.mark.parametrize("horizon", [1, 2, 5, 20])
@pytest.mark.parametrize("elsewhere", [False, True])
def test_the_first_input_is_the_infinite_horizons(horizon: int, elsewhere: bool) -> None:
    """U = u_s - K (x - x_s), for any horizon, of random systems; rest need not be in the origin."""
    for seed in range(5):
        rng = np.random.default_rng(seed)
        problem = terminated(without_bounds(random_problem(rng, horizon=horizon, n=4, nu=2, n_c=2)))
        rest = Equilibrium(rng.normal(size=4), rng.normal(size=2)) if elsewhere else problem.equilibrium
        state = rest.x + rng.normal(size=4)
        desired = np.tile(rest.x, (horizon, 1))
        expected = rest.u - gain(problem) @ (state - rest.x)
        for name, result in first_inputs(problem, (state, desired, problem.model.u_bar, rest)).items():
            np.testing.assert_allclose(result, expected, atol=1e-8 * max(1.0, np.abs(expected).max()), err_msg=name)


@pytest.mark.parametrize("horizon", [1, 7, 50])
def test_the_papers_vehicle_flies_to_a_set_point_as_by_the_infinite_horizons_law(horizon: int) -> None:
    """Outputs are four of twelve states; rest may be tilted, as against wind, which is no error of the last state."""
    problem = terminated(without_bounds(paper_problem("paper-constrained", f"controller.horizon={horizon}")))
    K = gain(problem)
    u_bar = problem.model.u_bar
    state = 0.01 * np.random.default_rng(0).normal(size=12)
    reference = np.array([0.3, -0.2, 0.5, 0.1])
    goal = np.zeros(12)
    goal[[0, 2, 4, 10]] = reference
    tilted = np.zeros(12)
    tilted[[6, 8]] = 0.05, -0.03
    for rest in (problem.equilibrium, Equilibrium(tilted, u_bar + 1.0)):
        expected = rest.u - K @ (state - rest.x - goal)
        desired = problem.desired(np.tile(reference, (horizon, 1)))
        for name, result in first_inputs(problem, (state, desired, u_bar, rest)).items():
            np.testing.assert_allclose(result, expected, rtol=1e-8, err_msg=name)


def test_without_it_a_short_horizon_is_not_infinite() -> None:
    """What the tests above rest on."""
    problem = without_bounds(paper_problem("paper-constrained", "controller.horizon=7"))
    state = 0.01 * np.random.default_rng(0).normal(size=12)
    solver = QPSolver("piqp-multistage", problem, free_first=True)
    answer = solver.solve(Query(state, np.zeros((7, 4)), problem.model.u_bar))
    assert np.abs(answer.plan[0] - problem.model.u_bar + gain(problem) @ state).max() > 0.1


def test_it_equals_the_cost_to_come_to_rest() -> None:
    problem = random_problem(np.random.default_rng(4), horizon=3)
    P = lqr_terminal_weight(problem.model, problem.objective)
    K = gain(problem)
    model = problem.model
    closed = model.A - model.B @ K
    spent = scipy.linalg.solve_discrete_lyapunov(
        closed.T, problem.objective.weights[0] + K.T @ problem.objective.Q_u @ K
    )
    np.testing.assert_allclose(P, spent, rtol=1e-9, atol=1e-9)
    np.testing.assert_array_equal(P, P.T)


def test_the_axes_of_a_quadrotor_stay_apart() -> None:
    """Rounding in the Riccati equation's solution ties none of them."""
    problem = paper_problem()
    result = axes(problem)
    with_weight = axes(terminated(problem))
    assert [axis.states.tolist() for axis in with_weight] == [axis.states.tolist() for axis in result]
    assert len(result) == 4


@pytest.mark.parametrize("weights", ["{z=1.0}", "{y=1.0, z=1.0, yaw=1.0}", "{x=1.0, y=1.0, z=1.0}"])
def test_a_state_that_costs_nothing_and_does_not_come_to_rest_is_refused(weights: str) -> None:
    problem = paper_problem("paper-constrained", f"controller.output_weights={weights}")
    with pytest.raises(ParameterError, match=r"controller\.terminal"):
        lqr_terminal_weight(problem.model, problem.objective)


def test_an_uncontrollable_unstable_state_is_refused() -> None:
    problem = random_problem(np.random.default_rng(0), horizon=3)
    A = np.diag([1.1, 0.5, 0.5])
    B = problem.model.B.copy()
    B[0] = 0.0
    objective = Objective(C_r=np.eye(3), Q_y=np.eye(3), Q_u=np.eye(2))
    with pytest.raises(ParameterError, match=r"controller\.terminal"):
        lqr_terminal_weight(replace(problem.model, A=A, B=B), objective)
