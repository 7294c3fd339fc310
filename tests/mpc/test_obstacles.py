"""Half-spaces along plans, the optimum among them against a dense QP, and what is skipped or fails."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support import paper_problem

from quadsim.controller import SOLVED
from quadsim.errors import ParameterError
from quadsim.mpc.forms.condensing import Condensed
from quadsim.mpc.problem.ocp import Problem, Query, predicted
from quadsim.mpc.problem.paper import prediction
from quadsim.mpc.problem.qp import kkt_residuals
from quadsim.mpc.problem.tightening import TighteningSettings, position_margins
from quadsim.mpc.solvers import Answer, QPSolver
from quadsim.mpc.solvers.by_name import make_solver
from quadsim.mpc.solvers.piqp import Piqp
from quadsim.mpc.space import Avoidance, ObstacleQP, Shape, Space
from quadsim.space import Capsule, Corridor, Cylinder, Fence, Sphere
from quadsim.state import INDEX, POSITION, Array
from quadsim.vehicle import Vehicle

N = 30
PERIOD = 0.05
RADIUS = 0.4
PILLAR = Cylinder(name="pillar", position=(1.0, 0.45, 0.0), radius=0.2, height=5.0)
FENCE = Fence(position=(0.0, 0.0, 0.0), size=(9.0, 1.8, 3.0))


@pytest.fixture(scope="module")
def problem() -> Problem:
    bounds = [f"controller.output_bounds.{name}=[-30.0, 30.0]" for name in ("roll", "pitch")]
    return paper_problem(
        "paper-constrained", f"controller.horizon={N}", "controller.input_bounds.slew=[-50.0, 50.0]", *bounds
    )


def space(*shapes: Shape, soft: bool = False, horizon: int = N, **given: float) -> Space:
    settings = Avoidance(**{"margin": 0.0, "rows": 3, "iterations": 1} | given)  # type: ignore[arg-type]
    penalty = (1e5, 1e3) if soft else None
    return Space(shapes, radius=RADIUS, period=PERIOD, horizon=horizon, settings=settings, penalty=penalty)


def query(problem: Problem, *, goal: float = 2.0, speed: float = 0.8) -> Query:
    """Flying along x towards a goal."""
    state = np.zeros(12)
    reference = np.zeros((N, 4))
    state[INDEX["vx"]] = speed
    reference[:, 0] = goal
    return Query(state, problem.desired(reference), problem.model.u_bar)


def clearing(problem: Problem, among: Space, calls: list[Answer] | None = None) -> ObstacleQP:
    solver = QPSolver("piqp-multistage", problem, free_first=True)
    find = solver.solve

    def solve(posed: Query) -> Answer:
        answer = find(posed)
        if calls is not None:
            calls.append(answer)
        return answer

    solver.solve = solve  # type: ignore[method-assign]
    return ObstacleQP(problem, solver, among)


def positions(problem: Problem, posed: Query, answer: Answer) -> Array:
    """(N, 3) of an answer."""
    return predicted(problem, posed, answer.plan)[:, list(POSITION)]


def by_dense_qp(problem: Problem, posed: Query, normals: Array, bounds: Array) -> Array:
    """The plan (N, nu) of the condensed QP with hard half-spaces (S, N, 3), (S, N) as rows of its own."""
    form = Condensed(problem)
    maps = prediction(problem.model, N)
    qp = form.assemble(Query(*posed[:3]))
    chosen = np.zeros((len(bounds), N, N * 12))
    for i in range(N):
        chosen[:, i, 12 * i + np.array(POSITION)] = normals[:, i]
    rows = chosen.reshape(-1, N * 12)
    free = maps.Phi @ posed.state - maps.Psi @ np.tile(problem.model.u_bar, N)
    qp = replace(
        qp,
        G=np.vstack([qp.G, rows @ maps.Psi]),
        h_l=np.concatenate([qp.h_l, bounds.ravel() - rows @ free]),
        h_u=np.concatenate([qp.h_u, np.full(bounds.size, np.inf)]),
    )
    backend = Piqp(dense=True)
    backend.setup(qp)
    solution = backend.solve(qp)
    assert solution.status == SOLVED
    assert kkt_residuals(qp, solution).worst < 1e-3
    return form.inputs(solution.x)


numbers = st.floats(-2.0, 2.0)


@given(
    at=st.tuples(numbers, numbers, numbers),
    axis=st.tuples(numbers, numbers, st.floats(0.3, 1.0)),
    points=st.lists(st.tuples(numbers, numbers, numbers), min_size=5, max_size=5),
)
def test_positions_in_the_half_space_are_clear(
    at: tuple[float, ...], axis: tuple[float, float, float], points: list[tuple[float, ...]]
) -> None:
    log = Capsule(name="log", position=(0.2, 0.1, 0.0), axis=axis, radius=0.3)
    normals, bounds = space(log, horizon=1, margin=0.1).half_spaces(np.zeros(1), np.array([at]))
    p = 2.0 * np.array(points)
    outside = p @ normals[0, 0] >= bounds[0, 0]
    assert (log.clearance(np.zeros(5), p)[outside] >= RADIUS + 0.1 - 1e-9).all()
    onto = p + np.outer(bounds[0, 0] - p @ normals[0, 0], normals[0, 0])
    assert (log.clearance(np.zeros(5), onto) >= RADIUS + 0.1 - 1e-9).all()


def test_regions_are_exact_and_hold_in_their_window() -> None:
    tube = Corridor(name="tube", position=(0.0, 0.0, 0.0), size=(2.0, 4.0, 6.0), start=0.5, stop=1.0)
    t = PERIOD * np.arange(1, N + 1)
    normals, bounds = space(tube).half_spaces(t, np.zeros((N, 3)))
    in_force = (t > 0.5 - PERIOD) & (t < 1.0 + PERIOD)
    distance = -bounds  # at the origin
    np.testing.assert_allclose(distance[:, in_force], np.tile([[1], [2], [3], [1], [2], [3]], in_force.sum()) - RADIUS)
    assert (distance[:, ~in_force] > 100.0).all()
    assert normals.shape == (6, N, 3)


def test_the_optimum_is_that_of_a_dense_qp(problem: Problem) -> None:
    among = space(PILLAR, FENCE, rows=7)
    posed = query(problem)
    result = clearing(problem, among).solve(0.0, posed)
    assert result[0].status == SOLVED
    free = clearing(problem, space(Sphere(name="far", position=(50.0, 0.0, 0.0), radius=1.0))).solve(0.0, posed)
    assert np.abs(result[0].plan - free[0].plan).max() > 1.0
    normals, bounds = among.half_spaces(PERIOD * np.arange(1, N + 1), positions(problem, posed, free[0]))
    np.testing.assert_allclose(result[0].plan, by_dense_qp(problem, posed, normals, bounds), atol=2e-3)
    distance = (normals * positions(problem, posed, result[0])).sum(axis=2) - bounds
    assert distance.min() > -1e-5
    assert distance.min() < 1e-3  # active


def test_rows_are_added_until_all_half_spaces_are_satisfied(problem: Problem) -> None:
    posed = query(problem)
    few = space(PILLAR, FENCE, rows=1)
    many = space(PILLAR, FENCE, rows=7)
    ours, whole = (clearing(problem, among).solve(0.0, posed) for among in (few, many))
    np.testing.assert_allclose(ours[0].plan, whole[0].plan, atol=2e-3)
    normals, bounds = few.half_spaces(
        PERIOD * np.arange(1, N + 1),
        positions(
            problem,
            posed,
            clearing(problem, space(Sphere(name="far", position=(50.0, 0.0, 0.0), radius=1.0))).solve(0.0, posed)[0],
        ),
    )
    assert ((normals * positions(problem, posed, ours[0])).sum(axis=2) - bounds).min() > -1e-4


def test_where_the_way_is_clear_the_answer_is_the_solver_s(problem: Problem, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ObstacleQP, "_form", None)  # no QP of its own
    calls: list[Answer] = []
    beside = replace(PILLAR, position=(0.9, 3.0, 0.0))
    assert clearing(problem, space(beside, FENCE), calls).solve(0.0, query(problem))[0].plan is calls[0].plan


def test_a_moving_obstacle_counts_where_it_will_be(problem: Problem) -> None:
    """At t = 0 one ball is in the way and gone in time, the other is not yet there."""
    calls: list[Answer] = []
    gone = Sphere(name="gone", position=(1.0, 0.0, 0.0), radius=0.2, velocity=(0.0, 8.0, 0.0))
    result = clearing(problem, space(gone), calls).solve(0.0, query(problem))
    assert result[0].plan is calls[0].plan
    meeting = 22
    x = float(positions(problem, query(problem), result[0])[meeting - 1, 0])
    start = (x, 3.0 * meeting * PERIOD + 0.4, 0.0)
    comes = Sphere(name="comes", position=start, radius=0.2, velocity=(0.0, -3.0, 0.0))
    result = clearing(problem, space(replace(comes, velocity=(0.0, 0.0, 0.0))), calls).solve(0.0, query(problem))
    assert result[0].plan is calls[1].plan
    result = clearing(problem, space(comes, soft=True, iterations=20), calls).solve(0.0, query(problem))
    assert result[0].plan is not calls[2].plan
    t = PERIOD * np.arange(1, N + 1)
    places = positions(problem, query(problem), result[0])
    assert comes.clearance(t, places).min() > RADIUS - 1e-3


def test_axes_turned_by_a_yaw_make_no_difference(problem: Problem) -> None:
    posed = query(problem)
    yaw = 0.3
    turned = replace(PILLAR, position=(np.cos(yaw) - 0.45 * np.sin(yaw), np.sin(yaw) + 0.45 * np.cos(yaw), 0.0))
    plain = clearing(problem, space(PILLAR)).solve(0.0, posed)
    ours = clearing(problem, space(turned)).solve(0.0, posed, yaw)
    np.testing.assert_allclose(ours[0].plan, plain[0].plan, atol=1e-4)


def test_soft_half_spaces_give_way_and_hard_ones_are_named(problem: Problem) -> None:
    around = Sphere(name="around", position=(0.0, 0.0, 0.0), radius=3.0)
    soft = clearing(problem, space(around, soft=True)).solve(0.0, query(problem))
    assert soft[0].status == SOLVED
    assert soft[0].slacks.max() > 1.0
    hard = clearing(problem, space(around, FENCE)).solve(0.0, query(problem))
    assert hard[0].status != SOLVED
    assert [part.name for part in hard[1].constraints] == ["obstacle around", "keep_in"]
    assert hard[1].constraints[0].C is not None
    assert hard[1].constraints[0].C.shape == (N, 1, 12)


def test_solvers_that_need_equal_rows_refuse_varying_ones(problem: Problem) -> None:
    among = space(PILLAR)
    normals, bounds = among.half_spaces(np.zeros(N), np.zeros((N, 3)))
    constrained = replace(problem, constraints=among.constraints(normals, bounds, 12))
    with pytest.raises(ValueError, match="steps"):
        Condensed(constrained)
    with pytest.raises(ParameterError, match="QP solver"):
        make_solver("core", constrained)


def test_margins_grow_with_the_stated_disturbance(vehicle: Vehicle) -> None:
    small, large = (
        position_margins(vehicle, period=PERIOD, horizon=N, settings=TighteningSettings(acceleration=a))
        for a in (0.2, 0.6)
    )
    assert (np.diff(small, axis=0) >= 0.0).all()
    assert (large >= small).all()
    assert large[-1, 0] > 1.3 * small[-1, 0]
    tight = Space([PILLAR], radius=RADIUS, period=PERIOD, horizon=N, settings=Avoidance(margin=0.0), margins=large)
    at = np.tile([-1.0, 0.45, 0.0], (N, 1))
    more = tight.half_spaces(np.zeros(N), at)[1] - space(PILLAR).half_spaces(np.zeros(N), at)[1]
    np.testing.assert_allclose(more[0], large[:, 0], atol=1e-9)
