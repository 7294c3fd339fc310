"""The time-varying QP: against the time-invariant one, a dense one by another solver, its KKT conditions, and LPs."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import scipy.linalg
import scipy.optimize
from support import paper_problem, paper_reference, random_problem

from mpc.constraints import Bounds, Penalty
from mpc.nonlinear.linearise import linearise
from mpc.nonlinear.model import nonlinear_model
from mpc.ocp import Objective, Problem
from mpc.qp import QP, kkt_residuals
from mpc.solvers._common import start
from mpc.solvers.daqp_dense import DaqpDense
from mpc.staged import Staged
from mpc.stagewise import LARGEST, StagewiseAnswer, StagewiseQP, _WithMore
from quadsim.controller import SOLVED
from quadsim.errors import ParameterError
from quadsim.state import Array
from quadsim.vehicle import Vehicle
from scenarios.run import Flight

LAG = 0.05
Query = tuple[Array, Array, Array, Array, Array, Array, Array]
"""A, B, c, x0, desired, u_before, u_reference."""


def flight_queries(flight: Flight, problem: Problem, stride: int) -> list[tuple[Array, Array, Array]]:
    """(xi(k), y_d, u(k-1)) of every `stride`-th period of a flight."""
    log, N = flight.log.control, problem.horizon
    reference = paper_reference(log.t.size + N)
    before = np.vstack([log.speeds_before, log.speeds[:-1]])
    return [
        (log.state[k], problem.objective.desired(reference[k + 1 : k + 1 + N]), before[k])
        for k in range(0, log.t.size, stride)
    ]


def constant(problem: Problem, state: Array, desired: Array, u_before: Array) -> Query:
    """A period of the time-invariant problem, in deviations from u_bar, where c = 0."""
    model, N = problem.model, problem.horizon
    A, B = np.tile(model.A, (N, 1, 1)), np.tile(model.B, (N, 1, 1))
    return A, B, np.zeros((N, model.n)), state, desired, u_before - model.u_bar, np.zeros(model.nu)


def in_deviations(problem: Problem) -> Bounds:
    assert problem.bounds is not None
    u_bar = problem.model.u_bar
    return replace(problem.bounds, u_min=problem.bounds.u_min - u_bar, u_max=problem.bounds.u_max - u_bar)


def random_query(rng: np.random.Generator, problem: Problem) -> Query:
    """Systems that differ from step to step, around the problem's own."""
    model, N = problem.model, problem.horizon
    A = model.A + 0.1 * rng.normal(size=(N, model.n, model.n))
    B = model.B + 0.3 * rng.normal(size=(N, model.n, model.nu))
    c = 0.2 * rng.normal(size=(N, model.n))
    desired = rng.normal(size=(N, len(problem.objective.C_r)))
    reference = model.u_bar + 0.1 * rng.normal(size=(N, model.nu))
    return A, B, c, 0.2 * rng.normal(size=model.n), desired, model.u_bar, reference


def condensed_map(query: Query) -> tuple[Array, Array]:
    """(N, n, N nu) and (N, n): states as functions of absolute inputs, by the recursion itself."""
    A, B, c, x0, *_ = query
    N, n, nu = B.shape
    slopes, offsets = np.zeros((N, n, N * nu)), np.zeros((N, n))
    slope, offset = np.zeros((n, N * nu)), x0
    for i in range(N):
        slope, offset = A[i] @ slope, A[i] @ offset + c[i]
        slope[:, i * nu : (i + 1) * nu] += B[i]
        slopes[i], offsets[i] = slope, offset
    return slopes, offsets


def peer(query: Query, objective: Objective, bounds: Bounds, penalty: Penalty | None) -> tuple[Array, Array, str]:
    """Plan, slack and status of a dense QP in the inputs and slacks alone, by an active-set solver."""
    slopes, offsets = condensed_map(query)
    *_, desired, u_before, reference = query
    N, nu = reference.shape
    n_c, n_s = len(bounds.C_c), N * len(bounds.C_c) if penalty else 0
    errors = np.concatenate(objective.C_r @ slopes)
    weight = np.kron(np.eye(N), objective.Q_y)
    input_weight = np.kron(np.eye(N), objective.Q_u)
    missed = (offsets @ objective.C_r.T - desired).ravel()
    H = 2.0 * (errors.T @ weight @ errors + input_weight)
    f = 2.0 * (errors.T @ weight @ missed - input_weight @ reference.ravel())
    outputs, known = np.concatenate(bounds.C_c @ slopes), (offsets @ bounds.C_c.T).ravel()
    slews = np.eye(N * nu) - np.eye(N * nu, k=-nu)
    before = np.concatenate([u_before, np.zeros((N - 1) * nu)])
    l1, l2 = (np.tile(of, N) for of in (penalty.l1, penalty.l2)) if penalty else (np.zeros(0), np.zeros(0))
    open_side, slack = np.full(N * n_c, math.inf), np.eye(N * n_c, n_s)
    y_min, y_max = np.tile(bounds.y_min, N) - known, np.tile(bounds.y_max, N) - known
    sides = [(y_min, open_side, 1.0), (-open_side, y_max, -1.0)]
    qp = QP(
        P=scipy.linalg.block_diag(H, np.diag(2.0 * l2)),
        c=np.concatenate([f, l1]),
        A=np.zeros((0, N * nu + n_s)),
        b=np.zeros(0),
        G=np.vstack(
            [
                *(np.hstack([outputs, sign * slack]) for *_, sign in sides),
                np.eye(*slews.shape, 0) @ np.hstack([slews, np.zeros((N * nu, n_s))]),
            ]
        ),
        h_l=np.concatenate([*(low for low, *_ in sides), np.tile(bounds.delta_min, N) + before]),
        h_u=np.concatenate([*(high for _, high, _ in sides), np.tile(bounds.delta_max, N) + before]),
        x_l=np.concatenate([np.tile(bounds.u_min, N), np.zeros(n_s)]),
        x_u=np.concatenate([np.tile(bounds.u_max, N), np.full(n_s, math.inf)]),
    )
    backend = DaqpDense()
    backend.setup(qp)
    solution = backend.solve(start(qp))
    return solution.x[: N * nu].reshape(N, nu), solution.x[N * nu :].reshape(N, -1), solution.status


def answered(
    query: Query, problem: Problem, penalty: Penalty | None, steps: int
) -> tuple[StagewiseQP, StagewiseAnswer]:
    assert problem.bounds is not None
    model = problem.model
    solver = StagewiseQP(
        problem.horizon, model.n, model.nu, problem.objective, problem.bounds, penalty, steps_per_stage=steps
    )
    return solver, solver.solve(*query)


def formulated(solver: StagewiseQP, query: Query) -> QP:
    A, B, *vectors = query
    return solver.formulate(solver.prepare(A, B), *vectors).qp


@pytest.mark.parametrize("steps", [1, 2, 5])
def test_constant_matrices_make_the_papers_plan(constrained_flight: Flight, steps: int) -> None:
    problem = paper_problem()
    bounds = in_deviations(problem)
    solver = StagewiseQP(50, 12, 4, problem.objective, bounds, steps_per_stage=steps)
    formulation, backend = Staged(problem), DaqpDense()
    backend.setup(formulation.qp)
    pressing = 0
    for query in flight_queries(constrained_flight, problem, stride=100):
        answer = solver.solve(*constant(problem, *query))
        exact = backend.solve(formulation.vectors(*query))
        assert answer.solution.status == exact.status == SOLVED
        np.testing.assert_allclose(answer.plan + problem.model.u_bar, formulation.inputs(exact.x), atol=1e-3)
        pressing += exact.active
    assert pressing > 100


@pytest.mark.parametrize("steps", [1, 2, 4])
@pytest.mark.parametrize("horizon", [1, 3, 7, 10])
@pytest.mark.parametrize("soft", [False, True])
def test_random_systems_that_change_agree_with_a_dense_solver(horizon: int, steps: int, soft: bool) -> None:
    rng = np.random.default_rng(100 * horizon + steps)
    solved = 0
    for _ in range(6):
        problem = random_problem(rng, horizon=horizon, n=3, nu=2, n_c=2)
        assert problem.bounds is not None
        penalty = Penalty(l1=np.array([30.0, 5.0]), l2=np.array([2.0, 0.0])) if soft else None
        query = random_query(rng, problem)
        plan, slack, status = peer(query, problem.objective, problem.bounds, penalty)
        solver, answer = answered(query, problem, penalty, steps)
        assert (answer.solution.status == SOLVED) == (status == SOLVED)
        if status != SOLVED:
            continue
        solved += 1
        np.testing.assert_allclose(answer.plan, plan, atol=2e-4)
        np.testing.assert_allclose(answer.slack, slack if soft else np.zeros((horizon, 2)), atol=2e-4)
        slopes, offsets = condensed_map(query)
        np.testing.assert_allclose(answer.states, slopes @ answer.plan.ravel() + offsets, atol=1e-6)
        assert kkt_residuals(formulated(solver, query), answer.solution).worst < 1e-5
    assert solved >= (6 if soft else 2)


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
    penalty = Penalty(l1=np.full(2, 30.0), l2=np.zeros(2)) if soft else None
    query = random_query(rng, problem)
    plan, _, status = peer(query, problem.objective, bounds, penalty)
    _, answer = answered(query, problem, penalty, 2)
    assert status == answer.solution.status == SOLVED
    np.testing.assert_allclose(answer.plan, plan, atol=2e-4)


def lagging(problem: Problem) -> tuple[Objective, Bounds]:
    """The paper's weights and bounds, for states that end with the rotor speeds."""
    assert problem.bounds is not None
    C_r, C_c = (np.pad(C, ((0, 0), (0, 4))) for C in (problem.objective.C_r, problem.bounds.C_c))
    return replace(problem.objective, C_r=C_r), replace(problem.bounds, C_c=C_c)


def along_flight(flight: Flight, vehicle: Vehicle, problem: Problem, stride: int) -> Iterator[Query]:
    """QPs of the nonlinear model with lag, each linearised about the plan before."""
    model = nonlinear_model(vehicle, 0.05, rotor_lag=LAG)
    hover = np.full(4, vehicle.hover_speed)
    for state, desired, before in flight_queries(flight, problem, stride):
        x0 = np.concatenate([state, before])
        A, B, c = linearise(model, np.tile(x0, (50, 1)), np.tile(hover, (50, 1)))
        yield A, B, c, x0, desired, before, hover


@pytest.mark.parametrize("steps", [1, 2, 5])
def test_updated_values_solve_as_a_fresh_setup(constrained_flight: Flight, vehicle: Vehicle, steps: int) -> None:
    """Soft bounds and lag, matrices of a tilting vehicle; hover, whose matrices have zeros elsewhere, comes last."""
    problem = paper_problem()
    objective, bounds = lagging(problem)
    penalty = Penalty(l1=np.full(2, 1e4), l2=np.full(2, 1e4))
    solver = StagewiseQP(50, 16, 4, objective, bounds, penalty, steps_per_stage=steps)
    queries = [*along_flight(constrained_flight, vehicle, problem, stride=240)]
    nnz = set()
    for query in [*queries[1:], queries[0]]:
        updated = solver.solve(*query)
        qp = formulated(solver, query)
        nnz.add((qp.P.nnz, qp.A.nnz, qp.G.nnz))
        fresh = StagewiseQP(50, 16, 4, objective, bounds, penalty, steps_per_stage=steps).solve(*query)
        assert updated.solution.status == SOLVED
        np.testing.assert_allclose(updated.plan, fresh.plan, atol=1e-3)
        residuals = kkt_residuals(qp, updated.solution)
        assert residuals.worst < 1e-4  # gradients and multipliers are of order 1e4
        assert residuals.primal < 1e-6
    assert len(nnz) == 1


def test_slack_is_zero_where_hard_bounds_cost_less_than_its_price(constrained_flight: Flight, vehicle: Vehicle) -> None:
    problem = paper_problem()
    objective, bounds = lagging(problem)
    price = 3e3
    hard = StagewiseQP(50, 16, 4, objective, bounds)
    soft = StagewiseQP(50, 16, 4, objective, bounds, Penalty(l1=np.full(2, price), l2=np.full(2, 1e4)))
    pressing = dear = 0
    for query in along_flight(constrained_flight, vehicle, problem, stride=40):
        strict, lenient = hard.solve(*query), soft.solve(*query)
        assert lenient.solution.status == SOLVED
        multiplier = np.abs(strict.solution.z[:100]).max()  # of the output bounds
        if strict.solution.status == SOLVED and multiplier < price:
            pressing += int(multiplier > 1.0)
            assert lenient.slack.max() < 1e-7
            np.testing.assert_allclose(lenient.plan[:10], strict.plan[:10], atol=1e-3)
        else:
            dear += int(lenient.slack.max() > 1e-4)
    assert pressing > 2
    assert dear > 0


def test_slack_is_the_smallest_where_hard_bounds_are_infeasible() -> None:
    """A price far above all else comes within a thousandth of the least total violation, a linear program's."""
    problem = paper_problem()
    assert problem.bounds is not None
    bounds = in_deviations(problem)
    penalty = Penalty(l1=np.full(2, 1e6), l2=np.zeros(2))
    tilted = np.zeros(12)
    tilted[[6, 7, 9]] = np.radians([12.0, 20.0, 15.0])
    query = constant(problem, tilted, problem.objective.desired(np.zeros((50, 4))), problem.model.u_bar)
    hard = StagewiseQP(50, 12, 4, problem.objective, bounds).solve(*query)
    assert hard.solution.status != SOLVED
    soft = StagewiseQP(50, 12, 4, problem.objective, bounds, penalty).solve(*query)
    assert soft.solution.status == SOLVED
    outputs = soft.states @ bounds.C_c.T
    violation = np.maximum(np.maximum(bounds.y_min - outputs, outputs - bounds.y_max), 0.0)
    np.testing.assert_allclose(soft.slack, violation, atol=1e-7)
    slopes, offsets = condensed_map(query)
    C, known = np.concatenate(bounds.C_c @ slopes), (offsets @ bounds.C_c.T).ravel()
    slews = np.eye(200) - np.eye(200, k=-4)
    none = np.zeros((200, 100))
    least = scipy.optimize.linprog(
        np.concatenate([np.zeros(200), np.ones(100)]),
        A_ub=np.block([[C, -np.eye(100)], [-C, -np.eye(100)], [slews, none], [-slews, none]]),
        b_ub=np.concatenate(
            [
                np.tile(bounds.y_max, 50) - known,
                known - np.tile(bounds.y_min, 50),
                np.tile(bounds.delta_max, 50),
                -np.tile(bounds.delta_min, 50),
            ]
        ),
        bounds=[*zip(np.tile(bounds.u_min, 50), np.tile(bounds.u_max, 50), strict=True), *[(0.0, None)] * 100],
    )
    assert least.status == 0
    assert soft.slack.sum() == pytest.approx(least.fun, rel=1e-3)
    assert least.fun > 0.01


def test_a_failure_leaves_the_next_solve_alone() -> None:
    problem = paper_problem()
    solver = StagewiseQP(50, 12, 4, problem.objective, in_deviations(problem))
    desired = problem.objective.desired(np.zeros((50, 4)))
    tilted = np.zeros(12)
    tilted[6], tilted[7] = np.radians(30.0), 5.0
    failed = solver.solve(*constant(problem, tilted, desired, problem.model.u_bar))
    assert failed.solution.status in {"primal_infeasible", "max_iterations", "numerics"}
    hover = solver.solve(*constant(problem, np.zeros(12), desired, problem.model.u_bar))
    assert hover.solution.status == SOLVED
    np.testing.assert_allclose(hover.plan, 0.0, atol=1e-3)


@pytest.mark.parametrize("place", range(7))
@pytest.mark.parametrize("spoilt", [math.nan, math.inf, -math.inf])
def test_data_that_is_not_finite_is_refused(place: int, spoilt: float) -> None:
    rng = np.random.default_rng(1)
    problem = random_problem(rng, horizon=4, n_c=1)
    query = random_query(rng, problem)
    solver, before = answered(query, problem, Penalty(l1=np.ones(1), l2=np.ones(1)), 2)
    wrong = [part.copy() for part in query]
    wrong[place].flat[0] = spoilt
    answer = solver.solve(*wrong)
    assert answer.solution.status == "invalid_data"
    assert answer.plan.shape == before.plan.shape
    assert answer.states.shape == before.states.shape
    assert answer.slack.shape == before.slack.shape
    assert all(np.isnan(part).all() for part in (answer.plan, answer.states, answer.slack, answer.solution.x))
    np.testing.assert_allclose(solver.solve(*query).plan, before.plan, atol=1e-9)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"N": 0}, r"controller\.horizon must be a whole number >= 1; got 0"),
        ({"steps_per_stage": 0}, r"controller\.steps_per_stage must be a whole number >= 1; got 0"),
        ({"n": 4}, r"controller\.C_r must be of shape \(3, 4\); got \(3, 3\)"),
        ({"nu": 3}, r"controller\.Q_u must be of shape \(3, 3\); got \(2, 2\)"),
        ({"penalty": Penalty(l1=np.ones(2), l2=np.ones(2))}, r"controller\.l1 must be of shape \(1,\); got \(2,\)"),
    ],
)
def test_shapes_that_do_not_fit_are_refused(changes: dict[str, object], message: str) -> None:
    problem = random_problem(np.random.default_rng(0), horizon=4)
    arguments = {"N": 4, "n": 3, "nu": 2, "objective": problem.objective, "bounds": problem.bounds}
    with pytest.raises(ParameterError, match=message):
        StagewiseQP(**{**arguments, **changes})  # type: ignore[arg-type]


@pytest.mark.parametrize(("l1", "l2"), [([-1.0], [0.0]), ([1.0], [math.nan]), ([1.0], [1.0, 2.0])])
def test_impossible_penalties_are_refused(l1: list[float], l2: list[float]) -> None:
    with pytest.raises(ParameterError, match=r"controller\.l[12] must be one finite number >= 0 per"):
        Penalty(l1=np.array(l1), l2=np.array(l2))


@pytest.mark.parametrize(("horizon", "steps"), [(1, 4), (3, 1), (7, 2), (10, 4)])
@pytest.mark.parametrize("soft", [False, True])
def test_weighted_moves_and_margins_agree_with_a_dense_solver(horizon: int, steps: int, soft: bool) -> None:
    """The peer's cost with |u(i) - u(i-1)|^2_Qd added, and bounds tightened, all written out once more."""
    rng = np.random.default_rng(horizon + 10 * steps)
    solved = 0
    for _ in range(6):
        problem = random_problem(rng, horizon=horizon, n=3, nu=2, n_c=2)
        bounds, objective = problem.bounds, problem.objective
        assert bounds is not None
        factor = rng.normal(size=(2, 2))
        move_weight = 3.0 * (factor @ factor.T)
        margins = 0.3 * rng.uniform(size=(horizon, 2)) * np.minimum(-bounds.y_min, bounds.y_max)
        penalty = Penalty(l1=np.array([30.0, 5.0]), l2=np.array([2.0, 0.5])) if soft else None
        query = random_query(rng, problem)
        *_, desired, before, reference = query
        solver = StagewiseQP(
            horizon, 3, 2, objective, bounds, penalty, move_weight=move_weight, margins=margins, steps_per_stage=steps
        )
        answer = solver.solve(*query)
        slopes, offsets = condensed_map(query)
        changing = np.eye(2 * horizon) - np.eye(2 * horizon, k=-2)
        last = np.concatenate([before, np.zeros(2 * horizon - 2)])
        moves = np.kron(np.eye(horizon), move_weight)
        errors, weight = np.concatenate(objective.C_r @ slopes), np.kron(np.eye(horizon), objective.Q_y)
        inputs = np.kron(np.eye(horizon), objective.Q_u)
        outputs, known = np.concatenate(bounds.C_c @ slopes), (offsets @ bounds.C_c.T).ravel()
        n_s = 2 * horizon if soft else 0
        l1, l2 = (np.tile(of, horizon) for of in (penalty.l1, penalty.l2)) if penalty else (np.zeros(0), np.zeros(0))
        slack, endless = np.eye(2 * horizon, n_s), np.full(2 * horizon, math.inf)
        missed = (offsets @ objective.C_r.T - desired).ravel()
        qp = QP(
            P=scipy.linalg.block_diag(
                2.0 * (errors.T @ weight @ errors + inputs + changing.T @ moves @ changing), np.diag(2.0 * l2)
            ),
            c=np.concatenate(
                [2.0 * (errors.T @ weight @ missed - inputs @ reference.ravel() - changing.T @ moves @ last), l1]
            ),
            A=np.zeros((0, 2 * horizon + n_s)),
            b=np.zeros(0),
            G=np.vstack(
                [
                    np.hstack([outputs, slack]),
                    np.hstack([outputs, -slack]),
                    np.hstack([changing, np.zeros((2 * horizon, n_s))]),
                ]
            ),
            h_l=np.concatenate(
                [(bounds.y_min + margins).ravel() - known, -endless, np.tile(bounds.delta_min, horizon) + last]
            ),
            h_u=np.concatenate(
                [endless, (bounds.y_max - margins).ravel() - known, np.tile(bounds.delta_max, horizon) + last]
            ),
            x_l=np.concatenate([np.tile(bounds.u_min, horizon), np.zeros(n_s)]),
            x_u=np.concatenate([np.tile(bounds.u_max, horizon), np.full(n_s, math.inf)]),
        )
        backend = DaqpDense()
        backend.setup(qp)
        exact = backend.solve(start(qp))
        assert (answer.solution.status == SOLVED) == (exact.status == SOLVED)
        if exact.status != SOLVED:
            continue
        solved += 1
        np.testing.assert_allclose(answer.plan.ravel(), exact.x[: 2 * horizon], atol=2e-4)
        np.testing.assert_allclose(answer.slack.ravel()[:n_s], exact.x[2 * horizon :], atol=2e-4)
    assert solved >= (6 if soft else 2)


def test_prepared_matrices_serve_many_periods(constrained_flight: Flight, vehicle: Vehicle) -> None:
    """Used again, used in turn with others, and after data that was refused, they solve as freshly made ones."""
    problem = paper_problem()
    objective, bounds = lagging(problem)
    penalty = Penalty(l1=np.full(2, 2e5), l2=np.full(2, 1e4))

    def made() -> StagewiseQP:
        return StagewiseQP(50, 16, 4, objective, bounds, penalty, move_weight=5.0 * np.eye(4))

    kept, queries = made(), [*along_flight(constrained_flight, vehicle, problem, stride=240)]
    sets = [kept.prepare(*query[:2]) for query in queries[:2]]
    for which, query in [(0, queries[0]), (0, queries[1]), (1, queries[2]), (1, queries[3]), (0, queries[4])]:
        vectors = query[2:]
        answer = kept.solve_prepared(sets[which], *vectors)
        fresh = made().solve(sets[which].A, sets[which].B, *vectors)
        assert answer.solution.status == fresh.solution.status == SOLVED
        np.testing.assert_allclose(answer.plan, fresh.plan, atol=1e-3)
        np.testing.assert_allclose(answer.states, fresh.states, atol=1e-4)
        spoilt = [math.nan * vectors[0], *vectors[1:]]
        assert kept.solve_prepared(sets[which], *spoilt).solution.status == "invalid_data"


def test_matrices_are_handed_over_once(monkeypatch: pytest.MonkeyPatch) -> None:
    problem = random_problem(np.random.default_rng(1), horizon=6)
    A, B, *vectors = random_query(np.random.default_rng(2), problem)
    solver, _ = answered((A, B, *vectors), problem, None, 2)
    told: list[set[str]] = []

    class Listening(_WithMore):
        def __init__(self, solver: Any, more: dict[str, Any]) -> None:
            told.append(set(more))
            super().__init__(solver, more)

    monkeypatch.setattr("mpc.stagewise._WithMore", Listening)
    matrices, others = solver.prepare(A, B), solver.prepare(A, 2.0 * B)
    for held in (matrices, matrices, others, matrices):
        solver.solve_prepared(held, *vectors)
    assert ["P" in names for names in told] == [True, False, True, True]


def test_numbers_of_no_vehicle_are_refused() -> None:
    problem = random_problem(np.random.default_rng(1), horizon=4)
    query = random_query(np.random.default_rng(2), problem)
    solver, _ = answered(query, problem, None, 2)
    for place in range(len(query)):
        wrong = [part.copy() for part in query]
        wrong[place].flat[0] = -1.1 * LARGEST
        assert solver.solve(*wrong).solution.status == "invalid_data"


@pytest.mark.parametrize(
    ("option", "message"),
    [
        ({"move_weight": np.eye(3)}, r"controller\.move_weight must be a symmetric matrix of shape \(2, 2\)"),
        ({"move_weight": np.array([[1.0, 0.5], [0.0, 1.0]])}, r"controller\.move_weight must be a symmetric matrix"),
        ({"move_weight": -np.eye(2)}, r"controller\.move_weight must be .* without negative eigenvalues"),
        ({"move_weight": np.full((2, 2), math.nan)}, r"controller\.move_weight must be a symmetric matrix"),
        ({"margins": np.zeros((3, 1))}, r"controller\.margins must be finite numbers >= 0 of shape \(4, 1\)"),
        ({"margins": np.full((4, 1), -0.1)}, r"controller\.margins must be finite numbers >= 0 of shape \(4, 1\)"),
        ({"margins": np.full((4, 1), 100.0)}, r"controller\.margins must be less than half of what is between"),
    ],
)
def test_options_that_are_not_possible_are_refused(option: dict[str, Array], message: str) -> None:
    problem = random_problem(np.random.default_rng(0), horizon=4)
    assert problem.bounds is not None
    with pytest.raises(ParameterError, match=message):
        StagewiseQP(4, 3, 2, problem.objective, problem.bounds, **option)  # type: ignore[arg-type]
