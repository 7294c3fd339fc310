"""The core's optimum against the KKT conditions, DAQP, PIQP and a peer; what it refuses and what PIQP answers."""

from __future__ import annotations

import copy
import gc
import pickle
import weakref
from collections import Counter
from collections.abc import Collection
from dataclasses import replace
from typing import Any

import numpy as np
import ocp_peer
import pytest
from _pytest.mark.structures import ParameterSet
from hypothesis import given
from hypothesis import strategies as st
from support import flight_queries, paper_problem, random_axes, random_problem

from quadsim.controller import ACCEPTED, CORE, GAIN, OPTIMAL, SOLVED, UNCONSTRAINED
from quadsim.errors import ParameterError
from quadsim.mpc.problem.constraints import Constraint, Penalty
from quadsim.mpc.problem.ocp import Equilibrium, Problem, Query, lqr_terminal_weight
from quadsim.mpc.problem.qp import kkt_residuals
from quadsim.mpc.solvers import Answer, Method, QPSolver
from quadsim.mpc.solvers.by_name import make_solver
from quadsim.mpc.solvers.core import PROBLEMS, Core, core_problem
from quadsim.mpc.solvers.core_axes import axes
from quadsim.rollout.flown import Flight
from quadsim.rollout.rollout import Rollout
from quadsim.scenarios.assembly import Assembly
from quadsim.scenarios.loading import load_scenario
from quadsim.state import Array

PIQP = "piqp-multistage"


def drawn_query(rng: np.random.Generator, problem: Problem) -> Query:
    """A set-point some metres away, a state off hover, and a command before that rotors may have had."""
    n = problem.model.n
    N = problem.horizon
    u_bar = problem.model.u_bar
    size = rng.choice([0.1, 0.5, 2.0])
    state = np.zeros(n)
    state[:12] = size * rng.normal(size=12) * np.tile([1.0, 0.5, 1.0, 0.5, 1.0, 0.5, 0.03, 0.1, 0.03, 0.1, 0.3, 0.3], 1)
    desired = np.tile(problem.desired(size * rng.normal(size=(1, 4)) * [3.0, 3.0, 2.0, 0.5]), (N, 1))
    return Query(state, desired, u_bar + rng.uniform(-5.0, 5.0, 4), problem.equilibrium)


def worst(problem: Problem, answer: Answer) -> float:
    """The largest KKT residual, multipliers relative to the largest."""
    assert answer.certificate is not None
    qp, solution = answer.certificate()
    residuals = kkt_residuals(qp, solution)
    scale = max(1.0, float(np.abs(solution.z).max(initial=0.0)))
    return max(residuals.primal, residuals.dual, residuals.stationarity / scale, residuals.complementarity / scale)


@pytest.mark.parametrize(
    ("name", "draws"),
    [("paper-constrained", 70), pytest.param("robust", 40, marks=pytest.mark.slow("core")), ("robust-lag50", 10)],
)
def test_drawn_states_are_answered_cold_and_warm_as_by_daqp(name: str, draws: int) -> None:
    """Warm, from the active set of another state altogether."""
    rng = np.random.default_rng(1)
    problem = paper_problem(name)
    cold = Core(problem)
    warm = Core(problem)
    daqp = QPSolver("daqp", problem)
    count = Counter[str]()
    for _ in range(draws):
        query = drawn_query(rng, problem)
        answers = cold.solve(query), warm.solve(query)
        cold.reset()
        daqp.reset()
        other = daqp.solve(query)
        count[answers[0].answered_by] += 1
        for answer in answers:
            assert (answer.status in ACCEPTED) == (other.status == SOLVED)
            if other.status == SOLVED:
                assert answer.answered_by in (GAIN, CORE)
                assert worst(problem, answer) < 1e-8
                np.testing.assert_allclose(answer.plan, other.plan, rtol=0.0, atol=1e-4)
            else:
                assert answer.answered_by == PIQP
    assert count[CORE] > draws // 2
    assert name != "paper-constrained" or min(count[GAIN], count[PIQP]) > 0  # soft bounds are never infeasible


SCENARIOS = {  # periods by who answered them; what these would be, were they the prototype's, is in no other place
    "paper-constrained": ["duration=12.0"],
    "paper-constrained-lag20": [],
    "polytopes": ["duration=8.0"],
    "robust": ["duration=12.0"],
    "robust-lag50": ["duration=8.0"],
    "hummingbird-figure-eight": ["duration=6.0"],
}


SLOW = pytest.mark.slow("core")
REPRESENTATIVE = pytest.mark.representative("core")


def marked(name: str) -> ParameterSet:
    marks = [SLOW, REPRESENTATIVE] if name == "paper-constrained" else [SLOW]
    return pytest.param(name, marks=marks)


@pytest.mark.parametrize("name", [marked(name) for name in SCENARIOS])
def test_flights_are_exact_in_every_period_and_those_of_piqp(name: str) -> None:
    settings = [*SCENARIOS[name], "controller.kkt_every=1"]
    flight, other = (Rollout(load_scenario(name, [*settings, f"controller.solver={by}"])).fly() for by in (CORE, PIQP))
    control = flight.log.control
    theirs = other.log.control
    ours = np.isin(control.answered_by, [GAIN, CORE])
    assert ours.mean() > 0.9 or name == "paper-constrained-lag20"
    for residual in ("kkt_stationarity", "kkt_complementarity", "kkt_dual", "infeasibility"):
        assert getattr(control, residual)[ours].max() < 1e-6
    answered, as_well = ([status in OPTIMAL for status in each.status] for each in (control, theirs))
    assert answered == as_well  # where there is no answer, PIQP does not always tell why
    np.testing.assert_allclose(control.speeds, theirs.speeds, rtol=0.0, atol=2e-2)


TERMS = ("Q_d", "P", "rest")


def drawn(rng: np.random.Generator, terms: Collection[str], *, size: float, wider: float) -> tuple[Problem, Query]:
    """Three systems in one, with a query; moves are weighed in proportion to inputs, so that the axes stay apart."""
    problem = random_axes(rng, horizon=5, wider=wider)
    objective = problem.objective
    model = problem.model
    if "Q_d" in terms:
        objective = replace(objective, Q_d=3.0 * objective.Q_u)
    if "P" in terms:
        objective = replace(objective, P=lqr_terminal_weight(model, objective))
    rest = problem.equilibrium
    if "rest" in terms:
        rest = Equilibrium(0.1 * rng.normal(size=7), model.u_bar + 0.1 * wider * rng.normal(size=4))
    before = model.u_bar + 0.01 * rng.normal(size=4)
    query = Query(size * rng.normal(size=7), size * rng.normal(size=(5, 7)), before, rest)
    return replace(problem, objective=objective), query


@given(
    seed=st.integers(0, 2**32 - 1),
    terms=st.sets(st.sampled_from(TERMS)),
    size=st.sampled_from([0.05, 0.5, 2.0]),
    wider=st.sampled_from([1.0, 10.0, 1000.0]),
)
def test_every_way_ends_at_the_peers_optimum(seed: int, terms: set[str], size: float, wider: float) -> None:
    problem, query = drawn(np.random.default_rng(seed), terms, size=size, wider=wider)
    answer = Core(problem).solve(query)
    peer = ocp_peer.optimum(problem, ocp_peer.period(problem, *query[:4]))
    assert (answer.status in ACCEPTED) == (peer.solution.status == SOLVED)
    if peer.solution.status == SOLVED:
        scale = max(1.0, float(np.abs(peer.plan).max()))
        np.testing.assert_allclose(answer.plan, peer.plan, rtol=0.0, atol=1e-7 * scale)


@pytest.mark.parametrize("terms", [(), ("Q_d",), ("P",), ("rest",), TERMS])
def test_every_way_is_taken(terms: tuple[str, ...]) -> None:
    """What the test above rests on; and that these terms leave the axes apart."""
    methods = []
    for seed in range(15):
        rng = np.random.default_rng(seed)
        size = float(rng.choice([0.05, 2.0]))
        wider = float(rng.choice([1.0, 1000.0]))
        problem, query = drawn(rng, terms, size=size, wider=wider)
        assert len(axes(problem)) == 3
        answer = Core(problem).solve(query)
        methods.append(answer.method)
        if answer.status in ACCEPTED:
            free = answer.method is Method.FREE
            assert (answer.status, answer.answered_by) == ((UNCONSTRAINED, GAIN) if free else (SOLVED, CORE))
    assert {*methods} == {*Method}


def test_moves_that_tie_the_axes_leave_one_piece() -> None:
    """By a weight on the change of one rotor alone, which is part of all of them; the optimum is the peer's still."""
    problem, query = drawn(np.random.default_rng(1), (), size=0.05, wider=1000.0)
    tied = replace(problem, objective=replace(problem.objective, Q_d=np.diag([1.0, 0.0, 0.0, 0.0])))
    assert len(axes(tied)) == 1
    peer = ocp_peer.optimum(tied, ocp_peer.period(tied, *query[:4]))
    np.testing.assert_allclose(Core(tied).solve(query).plan, peer.plan, atol=1e-8)


def test_bounds_that_only_some_steps_have(constrained_flight: Flight) -> None:
    """A height that late steps alone are held below: what is active moves to where there is no bound."""
    problem = paper_problem()
    height = np.zeros((1, 12))
    upper = np.full((50, 1), np.inf)
    height[0, 4] = 1.0
    upper[20:] = 2.0
    penalty = Penalty(l1=np.full(1, 100.0), l2=np.full(1, 10.0))
    late = Constraint(name="late", C=height, lower=np.full((50, 1), -np.inf), upper=upper, penalty=penalty)
    problem = replace(problem, constraints=(late,))
    core = Core(problem)
    violated = 0
    for query in flight_queries(constrained_flight, problem, stride=1)[20:80]:
        answer = core.solve(query)
        assert answer.answered_by in (GAIN, CORE)
        assert worst(problem, answer) < 1e-8
        violated += answer.slacks.max() > 1e-3
    assert violated > 10


def test_active_constraints_that_depend_on_each_other() -> None:
    """The paper's vehicle commanded to drop 100 m: its rotors slow down by 10 rad/s a step, and then stand still.

    With hover at 200 rad/s the twentieth step ends at zero: that step, those before it and the bound of zero depend on
    each other.
    """
    problem = paper_problem()
    problem = replace(problem, model=replace(problem.model, u_bar=np.full(4, 200.0)))
    state = np.zeros(12)
    state[4] = 100.0
    query = Query(state, np.zeros((50, 4)), problem.model.u_bar)
    answer = Core(problem).solve(query)
    assert answer.status == SOLVED
    assert worst(problem, answer) < 1e-6
    np.testing.assert_allclose(answer.plan, QPSolver(PIQP, problem).solve(query).plan, atol=1e-2)


# What PIQP answers, and what is refused


def tilted(problem: Problem) -> Query:
    """A roll that no torque could bring back within its bounds before the first predicted state."""
    state = np.zeros(12)
    state[6] = np.radians(30.0)
    state[7] = 5.0
    return Query(state, np.zeros((problem.horizon, 4)), problem.model.u_bar)


def test_piqp_answers_infeasible_abandoned_and_invalid_problems(monkeypatch: pytest.MonkeyPatch) -> None:
    """From a warm start as from a cold one, and no back end is set up before."""
    problem = paper_problem()
    core = Core(problem)
    climb = Query(np.zeros(12), np.tile([0.0, 0.0, 5.0, 0.0], (50, 1)), problem.model.u_bar)
    assert core.solve(climb).answered_by == CORE
    assert core._optimum._piqp is None
    for _ in range(2):
        answer = core.solve(tilted(problem))
        assert (answer.status, answer.answered_by) == ("primal_infeasible", PIQP)
        assert core._library.quadsim_optimise(*core._arguments) in (3, 4)  # infeasible, or given up
        core.reset()
    for place in range(3):
        given = [np.array(part) for part in climb[:3]]
        given[place].flat[0] = np.nan
        assert core.solve(Query(*given)).status == "invalid_data"
    optimum = core.solve(climb)
    core.reset()
    monkeypatch.setattr(core.shared.struct, "changes", 2)
    answer = core.solve(climb)
    assert (answer.status, answer.answered_by, answer.method) == (SOLVED, PIQP, Method.WHOLE)
    np.testing.assert_allclose(answer.plan[0], optimum.plan[0], atol=1e-3)


def with_rows(count: int, *, shared: bool = False) -> Problem:
    """The paper's problem with so many more rows on x, perhaps with one slack for all."""
    C = np.zeros((count, 12))
    bound = np.full(count, 1e3)
    C[:, 0] = np.arange(1, count + 1)
    penalty = Penalty(l1=np.ones(count), l2=np.ones(count), largest=True) if shared else None
    rows = Constraint(name="rows", C=C, lower=-bound, upper=bound, penalty=penalty)
    return replace(paper_problem("paper-constrained", "controller.horizon=2"), constraints=(rows,))


@pytest.mark.parametrize(
    ("made", "rule"),
    [
        (lambda: random_problem(np.random.default_rng(0), horizon=3), "of 4 inputs; got '2 inputs'"),
        (lambda: random_problem(np.random.default_rng(0), horizon=2, n=21, nu=4), "at most 20; got '21 states of"),
        (lambda: with_rows(250), "at most 256; got '260 rows of a step'"),
        (lambda: with_rows(2, shared=True), "each with its own; got 'soft rows that share a slack'"),
        (lambda: paper_problem("paper-constrained", "controller.horizon=900"), "at most 1048576 numbers; they have "),
    ],
)
def test_problems_too_large_for_the_core_are_refused_with_the_number(made: Any, rule: str) -> None:
    with pytest.raises(ParameterError) as caught:
        make_solver(CORE, made())
    assert "controller.solver must be a QP solver such as 'piqp' for this problem" in str(caught.value)
    assert rule in str(caught.value)


def test_equal_problems_share_tables_with_a_finite_lifetime() -> None:
    settings = ("paper-constrained", "controller.horizon=2", "controller.input_bounds.slew=[-9.75, 4.75]")
    problem = paper_problem(*settings)  # of no other test, which might keep its tables
    first = core_problem(problem)
    assert core_problem(paper_problem(*settings)) is first
    assert problem.bounds is not None
    other = replace(problem, bounds=replace(problem.bounds, u_max=problem.bounds.u_max + 1.0))
    assert core_problem(other) is not first
    held = weakref.ref(first)
    del first
    for horizon in range(3, 3 + PROBLEMS):
        core_problem(replace(problem, horizon=horizon))
    gc.collect()
    assert held() is None


def test_controllers_that_share_tables_do_not_meddle() -> None:
    problem = paper_problem()
    rng = np.random.default_rng(2)
    queries = [drawn_query(rng, problem) for _ in range(10)]
    alone = Core(problem)
    one = Core(problem)
    other = Core(problem)
    for query, otherwise in zip(queries, reversed(queries), strict=True):
        expected = alone.solve(query)
        answer = one.solve(query)
        plan: Array = answer.plan.copy()
        other.solve(otherwise)
        np.testing.assert_array_equal(answer.plan, plan)
        np.testing.assert_array_equal(answer.plan, expected.plan)


def test_a_core_is_neither_copied_nor_pickled() -> None:
    core = Core(paper_problem())
    for attempt in (copy.copy, copy.deepcopy, pickle.dumps):
        with pytest.raises(TypeError, match="pickled"):
            attempt(core)


def test_half_spaces_are_no_matter_for_the_core() -> None:
    scenario = load_scenario("pillar", [f"controller.solver={CORE}"])
    with pytest.raises(ParameterError, match="solver"):
        Assembly(scenario).controller()
