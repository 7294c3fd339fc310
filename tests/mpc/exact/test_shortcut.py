"""Shortcuts around the whole QP: exact where no other constraint is violated, with its solution."""

from __future__ import annotations

import gc
import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support import paper_problem, paper_reference, random_axes, random_problem

from mpc.constrained import ConstrainedMPC
from mpc.exact import shortcut as shortcut_module
from mpc.exact.shortcut import Shortcut, with_shortcut
from mpc.ocp import Problem, Query
from mpc.paper.condensed import Condensed
from mpc.paper.constraints import inequalities
from mpc.paper.prediction import prediction
from mpc.qp import kkt_residuals
from mpc.solvers import Answer, Method, QPSolver
from mpc.unconstrained import sequence_gains
from quadsim.controller import SOLVED, UNCONSTRAINED, Moment
from quadsim.state import Array
from scenarios.flight import Flight


def shortcut(problem: Problem, solver: str = "piqp-multistage") -> Shortcut:
    return Shortcut(problem, QPSolver(solver, problem))


def free_plan(problem: Problem, state: Array, desired: Array, u_before: Array) -> Array | None:
    """The plan, where no QP was needed."""
    answer = shortcut(problem).solve(Query(state, desired, u_before))
    assert (answer.method is Method.FREE) == (answer.status == UNCONSTRAINED)
    return answer.plan if answer.method is Method.FREE else None


def largest_residual(problem: Problem, answer: Answer, *query: Array) -> float:
    """Of a shortcut's answer, as a solution of the paper's condensed QP."""
    form = Condensed(problem)
    return kkt_residuals(form.pose(Query(*query)).qp, answer.certificate()[1]).worst


def unconstrained_optimum(problem: Problem, state: Array, desired: Array) -> Array:
    """(N, nu) by Eq. (22)."""
    gains = sequence_gains(problem)
    sequence = gains.K @ state + gains.G @ desired.ravel() + gains.L @ problem.model.u_bar
    return sequence.reshape(problem.horizon, -1)


def largest_violation(problem: Problem, plan: Array, state: Array, u_before: Array) -> float:
    """By how much a plan breaks the paper's inequalities, by their printed matrices."""
    assert problem.bounds is not None
    rows = inequalities(prediction(problem.model, problem.horizon), problem.bounds)
    u = plan.ravel()
    beyond = rows.A_ineq @ u - rows.right_side(state, u_before, problem.model.u_bar)
    return float(np.max(np.concatenate([beyond, u - rows.u_max, rows.u_min - u])))


@given(seed=st.integers(0, 10_000), horizon=st.integers(1, 8), size=st.sampled_from([0.01, 0.1, 0.5, 2.0]))
def test_no_qp_is_solved_where_and_only_where_every_constraint_holds(seed: int, horizon: int, size: float) -> None:
    rng = np.random.default_rng(seed)
    problem = random_problem(rng, horizon=horizon, n_c=2)
    state, desired = size * rng.normal(size=3), size * rng.normal(size=(horizon, 3))
    u_before = problem.model.u_bar + 0.1 * size * rng.normal(size=2)
    optimum = unconstrained_optimum(problem, state, desired)
    violation = largest_violation(problem, optimum, state, u_before)
    plan = free_plan(problem, state, desired, u_before)
    assert (plan is not None) == (violation <= 0.0) or abs(violation) < 1e-9
    if plan is not None:
        np.testing.assert_allclose(plan, optimum, atol=1e-9)


@given(
    seed=st.integers(0, 10_000),
    horizon=st.integers(1, 8),
    size=st.sampled_from([0.5, 2.0, 5.0]),
    room=st.sampled_from([1.0, 10.0, 1000.0]),
)
@settings(max_examples=60)
def test_axis_by_axis_is_the_whole_where_and_only_where_inputs_stay_in_bounds(
    seed: int, horizon: int, size: float, room: float
) -> None:
    rng = np.random.default_rng(seed)
    problem = random_axes(rng, horizon=horizon, room=room)
    n, nu = problem.model.n, problem.model.nu
    query = (size * rng.normal(size=n), size * rng.normal(size=(horizon, n)), problem.model.u_bar)
    found, whole = shortcut(problem).solve(Query(*query)), QPSolver("piqp-dense", problem).solve(Query(*query))
    if found.method is Method.WHOLE:
        bounds = problem.bounds
        assert bounds is not None
        far = np.full(nu, 1e9)
        wide = replace(bounds, u_min=bounds.u_min - far, u_max=bounds.u_max + far, delta_min=-far, delta_max=far)
        without = shortcut(replace(problem, bounds=wide)).solve(Query(*query))
        if without.status == SOLVED and without.method is not Method.WHOLE:
            steps = np.diff(without.plan, axis=0, prepend=query[2][None])
            inside = (bounds.u_min <= without.plan) & (without.plan <= bounds.u_max)
            assert not (inside & (bounds.delta_min <= steps) & (steps <= bounds.delta_max)).all()
    else:
        assert whole.status == SOLVED
        size = max(1.0, np.abs(whole.plan).max())
        np.testing.assert_allclose(found.plan, whole.plan, atol=1e-3 * size)
        assert largest_residual(problem, found, *query) < 1e-7 * size**2


def test_every_way_is_taken_by_random_problems() -> None:
    """What the test above rests on."""
    methods = []
    for seed in range(30):
        rng = np.random.default_rng(seed)
        problem = random_axes(rng, horizon=6, room=float(rng.choice([1.0, 1000.0])))
        size, n = rng.choice([0.1, 2.0]), problem.model.n
        query = Query(size * rng.normal(size=n), np.zeros((6, n)), problem.model.u_bar)
        methods.append(shortcut(problem).solve(query).method)
    assert min(methods.count(method) for method in Method) >= 3


@pytest.mark.parametrize("part", ["u_min", "u_max", "delta_min", "delta_max", "y_min", "y_max"])
def test_each_kind_of_constraint_is_seen(part: str) -> None:
    """A bound tightened until it is just beyond the optimum's extreme is inactive; just before it, active."""
    problem = paper_problem()
    assert problem.bounds is not None
    state, desired = np.zeros(12), np.zeros((50, 4))
    state[[0, 2, 4, 6, 8]] = [0.02, -0.03, -0.05, 0.002, -0.003]
    plan = free_plan(problem, state, desired, problem.model.u_bar)
    assert plan is not None
    maps = prediction(problem.model, 50)
    outputs = (maps.Phi @ state + maps.Psi @ (plan - problem.model.u_bar).ravel()).reshape(
        50, 12
    ) @ problem.bounds.C_c.T
    values = {
        "u": plan,
        "delta": np.diff(plan, axis=0, prepend=problem.model.u_bar[None]),
        "y": outputs,
    }[part.partition("_")[0]]
    inwards = 1.0 if part.endswith("min") else -1.0
    extreme = values.min(axis=0) if part.endswith("min") else values.max(axis=0)
    for distance, free in ((-1e-6, True), (1e-6, False)):
        bounds = replace(problem.bounds, **{part: extreme + inwards * distance})
        found = free_plan(replace(problem, bounds=bounds), state, desired, problem.model.u_bar)
        assert (found is not None) == free


@pytest.mark.parametrize("solver", ["piqp-multistage", "daqp"])
def test_its_answer_is_the_solution_of_the_whole_qp(constrained_flight: Flight, solver: str) -> None:
    """Over the paper's flight: the same plan, whichever method it is found."""
    problem, log = paper_problem(), constrained_flight.log.control
    quick, whole = shortcut(problem, solver), QPSolver("daqp", problem)
    reference = paper_reference(log.t.size + 50)
    before = np.vstack([log.speeds_before, log.speeds[:-1]])
    methods = []
    for k in range(0, log.t.size, 8):
        query = log.state[k], problem.objective.desired(reference[k + 1 : k + 51]), before[k]
        answer, expected = quick.solve(Query(*query)), whole.solve(Query(*query))
        assert expected.status == SOLVED
        assert largest_residual(problem, answer, *query) < 1e-7
        np.testing.assert_allclose(answer.plan, expected.plan, atol=1e-6)
        if answer.method is Method.AXES:
            assert answer.status == SOLVED
            assert min(answer.active, answer.iterations) > 0
        methods.append(answer.method)
    assert methods.count(Method.FREE) == sum(status == UNCONSTRAINED for status in log.status[::8])
    assert methods.count(Method.AXES) == pytest.approx(70, abs=4)
    assert methods.count(Method.WHOLE) == pytest.approx(6, abs=3)


def test_commands_with_and_without_it_are_the_same(constrained_flight: Flight) -> None:
    problem, log = paper_problem(), constrained_flight.log.control
    with_it, without = (
        ConstrainedMPC(problem, QPSolver("piqp-multistage", problem), shortcut=wanted) for wanted in (True, False)
    )
    reference = paper_reference(log.t.size + 50)
    statuses = set()
    for k in range(1, log.t.size, 40):
        commands = []
        for controller in (with_it, without):
            controller.reset(log.speeds[k - 1])
            commands.append(controller.step(Moment(time=0.05 * k), log.state[k], reference[k + 1 : k + 51]))
        statuses.add((commands[0].status, commands[1].status))
        np.testing.assert_allclose(commands[0].speeds, commands[1].speeds, atol=1e-4)
    assert statuses == {(SOLVED, SOLVED), (UNCONSTRAINED, SOLVED)}


def test_a_measured_nan_is_never_feasible() -> None:
    problem = paper_problem()
    quick, hover = shortcut(problem), problem.model.u_bar
    desired = np.zeros((50, 4))
    assert quick.solve(Query(np.zeros(12), desired, hover)).method is Method.FREE
    for query in (
        (np.full(12, np.nan), desired, hover),
        (np.zeros(12), desired * np.nan, hover),
        (np.zeros(12), desired, hover * np.nan),
    ):
        answer = quick.solve(Query(*query))
        assert answer.method is Method.WHOLE
        assert answer.status == "invalid_data"


def test_what_no_axis_can_hold_is_reported_by_the_whole_qp() -> None:
    """A roll that no torque could bring back within its bounds before the first predicted state."""
    problem = paper_problem()
    tilted = np.zeros(12)
    tilted[6] = 0.5
    answer = shortcut(problem).solve(Query(tilted, np.zeros((50, 4)), problem.model.u_bar))
    assert answer.method is Method.WHOLE
    assert answer.status == "primal_infeasible"


def test_a_bound_that_no_axis_has_is_left_to_the_whole_qp() -> None:
    """An output made of nothing, beyond its bounds: infeasible, for any solution of the axes."""
    problem = paper_problem()
    assert problem.bounds is not None
    C_c, y_min = np.vstack([problem.bounds.C_c, np.zeros(12)]), np.append(problem.bounds.y_min, 0.5)
    bounds = replace(problem.bounds, C_c=C_c, y_min=y_min, y_max=np.append(problem.bounds.y_max, 1.0))
    desired = np.zeros((50, 4))
    desired[:, 0] = 3.0 * np.linspace(0.0, 1.0, 50) ** 4
    query = np.zeros(12), desired, problem.model.u_bar
    assert shortcut(problem).solve(Query(*query)).method is Method.AXES
    impossible = shortcut(replace(problem, bounds=bounds)).solve(Query(*query))
    assert (impossible.method, impossible.status) == (Method.WHOLE, "primal_infeasible")


@pytest.mark.parametrize("solver", ["piqp-multistage", "piqp-dense"])
def test_steps_may_be_bounded_for_some_inputs_alone(solver: str) -> None:
    """In the axes none are, in the whole those that are: the same optimum as with the others' bounds far away."""
    problem = paper_problem()
    assert problem.bounds is not None
    some, wide = problem.bounds.delta_max.copy(), problem.bounds.delta_max.copy()
    some[[0, 3]], wide[[0, 3]] = np.inf, 1e4
    desired = np.zeros((50, 4))
    desired[:, 0] = 10.0
    plans = []
    for upper in (some, wide):
        one = replace(problem, bounds=replace(problem.bounds, delta_max=upper, delta_min=-upper))
        answer = shortcut(one, solver).solve(Query(np.zeros(12), desired, problem.model.u_bar))
        assert (answer.method, answer.status) == (Method.WHOLE, SOLVED)
        plans.append(answer.plan)
    np.testing.assert_allclose(*plans, atol=1e-3)
    assert np.abs(np.diff(plans[0], axis=0)).max(axis=0)[[1, 2]].max() <= 5.0 + 1e-6


def test_failed_attempts_count() -> None:
    """Ten metres to the side at once: pitch can be held within 5 deg, at steps of the rotors beyond their bounds.

    The time that it took is added to the solver's, whose iterations are the ones that count.
    """
    problem = paper_problem()
    desired = np.zeros((50, 4))
    desired[:, 0] = 10.0
    query = np.zeros(12), desired, problem.model.u_bar
    whole = QPSolver("piqp-multistage", problem)
    given = whole.solve(Query(*query))
    answer = Shortcut(problem, whole).solve(Query(*query))
    assert answer.method is Method.WHOLE
    np.testing.assert_allclose(answer.plan, given.plan, atol=1e-3)
    assert answer.solve_s > given.solve_s
    assert answer.iterations == given.iterations
    assert answer.reported_primal == given.reported_primal
    assert (answer.answered_by, given.answered_by) == ("piqp-multistage", "piqp-multistage")


def test_answers_to_a_whole_qp_too_large_to_polish_stand(monkeypatch: pytest.MonkeyPatch) -> None:
    """500 rows and entries of the box, or 500^2 entries of the matrix that gives their multipliers."""
    problem = paper_problem()
    desired = np.zeros((50, 4))
    desired[:, 0] = 10.0
    query = np.zeros(12), desired, problem.model.u_bar
    whole = QPSolver("piqp-multistage", problem).solve(Query(*query)).plan
    for largest, polished in ((500**2, True), (500**2 - 1, False)):
        monkeypatch.setattr(shortcut_module, "LARGEST_MAP", largest)
        answer = shortcut(problem).solve(Query(*query))
        assert answer.method is Method.WHOLE
        assert (largest_residual(problem, answer, *query) < 1e-9) is polished
        assert np.array_equal(answer.plan, whole) is not polished


def test_there_is_none_where_its_map_is_too_large(monkeypatch: pytest.MonkeyPatch) -> None:
    costly = paper_problem("paper-constrained", "controller.input_weights.speed=10.0")  # for gains without rounding

    def tried(horizon: int) -> bool:
        problem = replace(costly, horizon=horizon)
        solver = QPSolver("piqp-multistage", problem)
        return with_shortcut(problem, solver) is not solver

    assert tried(400)
    assert not tried(420)

    def unfactorable(*_: object) -> None:
        raise np.linalg.LinAlgError

    monkeypatch.setattr("mpc.core.axes.condensed_cost", unfactorable)
    assert not tried(50)


@pytest.mark.parametrize(
    ("sideways", "height", "method"), [(0.0, 0.0, Method.FREE), (3.0, 0.0, Method.AXES), (0.0, 8.0, Method.WHOLE)]
)
def test_steps_leak_no_memory_and_allocate_nothing_large(sideways: float, height: float, method: Method) -> None:
    """All methods of a step: at the reference, before it moves away, 8 m below it."""
    problem = paper_problem()
    controller = ConstrainedMPC(problem, QPSolver("piqp-multistage", problem))
    controller.reset(problem.model.u_bar)
    reference = np.tile([0.0, 0.0, height, 0.0], (50, 1))
    reference[:, 0] = sideways * np.linspace(0.0, 1.0, 50) ** 4
    assert shortcut(problem).solve(Query(np.zeros(12), reference, problem.model.u_bar)).method is method
    state = np.zeros(12)

    def take_25_steps() -> str:
        for _ in range(25):
            status = controller.step(Moment(), state, reference).status
            controller.reset(problem.model.u_bar)
        return status

    gc.disable()  # a collection would empty the free list
    for size in range(1, 20):  # fills CPython's free lists of tuples, to which each step adds some
        list(map(tuple, np.zeros((3000, size))))
    tracemalloc.start()
    try:
        status = take_25_steps()
        before, _ = tracemalloc.get_traced_memory()
        tracemalloc.reset_peak()
        held = [before]
        for _ in range(6):  # Python's free lists fill up in the first ones; a leak grows in each
            take_25_steps()
            held.append(tracemalloc.get_traced_memory()[0])
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
        gc.enable()
    assert status == (UNCONSTRAINED if method is Method.FREE else SOLVED)
    assert np.diff(held).min() < 1_000  # flat, less than 40 bytes a step; something may be loaded once
    # The condensed H alone has 320 kB; the whole QP's polish needs that for its active rows, twice.
    assert peak - before < (800_000 if method is Method.WHOLE else 80_000)


def test_without_output_bounds_the_inputs_decide() -> None:
    problem = paper_problem("paper-constrained", "controller.output_bounds={}")
    quick, far = shortcut(problem), np.zeros(12)
    assert quick.solve(Query(far, np.zeros((50, 4)), problem.model.u_bar)).method is Method.FREE
    far[4] = -100.0
    assert quick.solve(Query(far, np.zeros((50, 4)), problem.model.u_bar)).method is Method.WHOLE


@pytest.mark.parametrize("horizon", [50, 100, 200])
def test_it_is_exact_over_long_horizons(horizon: int) -> None:
    """Hover on the reference is u_bar throughout; a little beside it, the plan is the QP's."""
    problem = replace(paper_problem(), horizon=horizon)
    desired = np.zeros((horizon, 4))
    hover = free_plan(problem, np.zeros(12), desired, problem.model.u_bar)
    assert hover is not None
    np.testing.assert_allclose(hover, np.tile(problem.model.u_bar, (horizon, 1)), atol=1e-9)
    state = np.zeros(12)
    state[[0, 2, 4, 6, 8]] = [0.02, -0.03, -0.05, 0.002, -0.003]
    plan = free_plan(problem, state, desired, problem.model.u_bar)
    answer = QPSolver("piqp-multistage", problem).solve(Query(state, desired, problem.model.u_bar))
    assert plan is not None
    np.testing.assert_allclose(plan[0], answer.plan[0], atol=1e-4)


def test_there_is_none_where_rounding_has_corrupted_the_gains() -> None:
    """A long horizon and inputs that cost next to nothing: cond(H) nears what double precision holds."""
    options = ("controller.horizon=200", "controller.input_weights.speed=1e-5")
    problem = paper_problem("paper-constrained", *options)
    solver = QPSolver("piqp-multistage", problem)
    assert with_shortcut(problem, solver) is solver
    with pytest.raises(np.linalg.LinAlgError):
        Shortcut(problem, solver)
