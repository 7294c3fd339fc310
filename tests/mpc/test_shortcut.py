"""The shortcut around the QP: it answers exactly where no constraint bars the way, and with the QP's own solution."""

from __future__ import annotations

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support import paper_problem, paper_reference, random_problem

from mpc import shortcut as module
from mpc.constrained import ConstrainedMPC
from mpc.constraints import inequalities
from mpc.prediction import prediction
from mpc.problem import Problem
from mpc.shortcut import Shortcut, make_shortcut
from mpc.solvers import QPSolver
from mpc.unconstrained import sequence_gains
from quadsim.controller import SOLVED, UNCONSTRAINED, Moment
from quadsim.state import Array
from scenarios.runner import Flight


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
def test_it_answers_where_and_only_where_every_constraint_holds(seed: int, horizon: int, size: float) -> None:
    rng = np.random.default_rng(seed)
    problem = random_problem(rng, horizon=horizon, n_c=2)
    state, desired = size * rng.normal(size=3), size * rng.normal(size=(horizon, 3))
    u_before = problem.model.u_bar + 0.1 * size * rng.normal(size=2)
    optimum = unconstrained_optimum(problem, state, desired)
    violation = largest_violation(problem, optimum, state, u_before)
    plan = Shortcut(problem).plan(state, desired, u_before)
    assert (plan is not None) == (violation <= 0.0) or abs(violation) < 1e-9
    if plan is not None:
        np.testing.assert_allclose(plan, optimum, atol=1e-9)


@pytest.mark.parametrize("part", ["u_min", "u_max", "delta_min", "delta_max", "y_min", "y_max"])
def test_each_kind_of_constraint_is_seen(part: str) -> None:
    """A bound drawn in until it is just beyond the optimum's extreme bars the way; just before, it does not."""
    problem = paper_problem()
    assert problem.bounds is not None
    state, desired = np.zeros(12), np.zeros((50, 4))
    state[[0, 2, 4, 6, 8]] = [0.02, -0.03, -0.05, 0.002, -0.003]
    plan = Shortcut(problem).plan(state, desired, problem.model.u_bar)
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
        found = Shortcut(replace(problem, bounds=bounds)).plan(state, desired, problem.model.u_bar)
        assert (found is not None) == free


def test_its_answer_is_the_solution_of_the_qp(constrained_flight: Flight) -> None:
    """Over the paper's flight: where the shortcut answers, the QP's solution is the same plan, with nothing active."""
    problem, log = paper_problem(), constrained_flight.log.control
    shortcut, solver = Shortcut(problem), QPSolver("piqp-multistage", problem)
    reference = paper_reference(log.t.size + 50)
    before = np.vstack([log.speeds_before, log.speeds[:-1]])
    answered = 0
    for k in range(0, log.t.size, 10):
        query = log.state[k], problem.objective.desired(reference[k + 1 : k + 51]), before[k]
        plan = shortcut.plan(*query)
        answer = solver.solve(*query)
        assert answer.solution.status == SOLVED
        if plan is not None:
            answered += 1
            np.testing.assert_allclose(plan, answer.plan, atol=1e-3)
            np.testing.assert_allclose(plan[0], answer.plan[0], atol=1e-4)
    assert answered == sum(status == UNCONSTRAINED for status in log.status[::10])
    assert 40 < answered < 80  # of 120


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
    shortcut, hover = Shortcut(problem), problem.model.u_bar
    desired = np.zeros((50, 4))
    assert shortcut.plan(np.zeros(12), desired, hover) is not None
    assert shortcut.plan(np.full(12, np.nan), desired, hover) is None
    assert shortcut.plan(np.zeros(12), desired * np.nan, hover) is None
    assert shortcut.plan(np.zeros(12), desired, hover * np.nan) is None


def test_there_is_none_where_its_map_is_too_large(monkeypatch: pytest.MonkeyPatch) -> None:
    assert make_shortcut(replace(paper_problem(), horizon=200)) is not None
    assert make_shortcut(replace(paper_problem(), horizon=250)) is None
    problem = paper_problem()

    def unfactorable(_: Problem) -> None:
        raise np.linalg.LinAlgError

    monkeypatch.setattr(module, "sequence_gains", unfactorable)
    assert make_shortcut(problem) is None


@pytest.mark.parametrize("height", [0.0, 8.0])
def test_steps_leave_no_memory_behind_and_allocate_nothing_large(height: float) -> None:
    """Both ways through a step: by the shortcut (at the reference) and by the QP (8 m below it)."""
    problem = paper_problem()
    controller = ConstrainedMPC(problem, QPSolver("piqp-multistage", problem))
    controller.reset(problem.model.u_bar)
    reference = np.tile([0.0, 0.0, height, 0.0], (50, 1))
    state = np.zeros(12)
    for _ in range(5):
        controller.step(Moment(), state, reference)
        controller.reset(problem.model.u_bar)
    tracemalloc.start()
    try:
        status = controller.step(Moment(), state, reference).status
        controller.reset(problem.model.u_bar)
        before, _ = tracemalloc.get_traced_memory()
        tracemalloc.reset_peak()
        for _ in range(50):
            controller.step(Moment(), state, reference)
            controller.reset(problem.model.u_bar)
        after, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert status == (SOLVED if height else UNCONSTRAINED)
    assert after - before < 2_000  # flat: less than 40 bytes a step
    assert peak - before < 64_000  # the condensed H alone has 320 kB


def test_without_output_bounds_the_inputs_decide() -> None:
    problem = paper_problem("paper-constrained", "controller.output_bounds={}")
    shortcut, far = Shortcut(problem), np.zeros(12)
    assert shortcut.plan(far, np.zeros((50, 4)), problem.model.u_bar) is not None
    far[4] = -100.0
    assert shortcut.plan(far, np.zeros((50, 4)), problem.model.u_bar) is None


@pytest.mark.parametrize("horizon", [50, 100, 200])
def test_it_is_exact_over_long_horizons(horizon: int) -> None:
    """Hover on the reference is u_bar throughout; a little beside it, the plan is the QP's."""
    problem = replace(paper_problem(), horizon=horizon)
    shortcut, desired = Shortcut(problem), np.zeros((horizon, 4))
    hover = shortcut.plan(np.zeros(12), desired, problem.model.u_bar)
    assert hover is not None
    np.testing.assert_allclose(hover, np.tile(problem.model.u_bar, (horizon, 1)), atol=1e-9)
    state = np.zeros(12)
    state[[0, 2, 4, 6, 8]] = [0.02, -0.03, -0.05, 0.002, -0.003]
    plan = shortcut.plan(state, desired, problem.model.u_bar)
    answer = QPSolver("piqp-multistage", problem).solve(state, desired, problem.model.u_bar)
    assert plan is not None
    np.testing.assert_allclose(plan[0], answer.plan[0], atol=1e-4)


def test_there_is_none_where_rounding_has_spoilt_the_gains() -> None:
    """A long horizon and inputs that cost next to nothing: cond(H) nears what double precision holds."""
    settings = ("controller.horizon=200", "controller.input_weights.speed=1e-5")
    problem = paper_problem("paper-constrained", *settings)
    assert make_shortcut(problem) is None
    with pytest.raises(np.linalg.LinAlgError):
        Shortcut(problem)
