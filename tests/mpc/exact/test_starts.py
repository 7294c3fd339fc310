"""Where the search for active rows starts decides how long it takes, not what it finds."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support import flight_queries, fly_once, paper_problem

from mpc.constraints import Constraint, Penalty
from mpc.exact.shortcut import Shortcut
from mpc.ocp import Problem, Query, Rest
from mpc.robust.controller import RobustMPC
from mpc.solvers import Answer, Formulation, Method, QPSolver, Solver
from quadsim.controller import ACCEPTED
from scenarios.build import build_controller, build_plant
from scenarios.flight import Flight
from scenarios.loading import load_scenario
from scenarios.parts.navigation import build_navigation
from scenarios.parts.vehicle import build_vehicle
from scenarios.reference import build_reference


class Recording:
    """A solver that records its queries."""

    def __init__(self, solver: Solver) -> None:
        self._solver = solver
        self.queries: list[Query] = []

    @property
    def name(self) -> str:
        return self._solver.name

    @property
    def formulation(self) -> Formulation:
        return self._solver.formulation

    def reset(self) -> None:
        self._solver.reset()

    def solve(self, query: Query) -> Answer:
        assert query.rest is not None
        rest = Rest(*(part.copy() for part in query.rest))
        self.queries.append(Query(*(part.copy() for part in query[:3]), rest))
        return self._solver.solve(query)


@pytest.fixture(scope="module")
def robust_queries() -> tuple[Problem, list[Query]]:
    """Twelve seconds of the robust controller in the wind, its bounds soft and tightened; and its problem."""
    scenario = load_scenario(
        "robust", ["duration=12.0", "effects.air.rotor_drag=3e-4", "effects.air.wind=[2.0, 1.0, 0.0]"]
    )
    vehicle = build_vehicle(scenario)
    with build_plant(scenario, vehicle) as plant:
        controller = build_controller(scenario, vehicle)
        inner = getattr(controller, "inner", controller)
        assert isinstance(inner, RobustMPC)
        assert isinstance(inner._solver, Shortcut)
        problem = inner._solver.formulation._problem
        inner._solver = recording = Recording(inner._solver)  # type: ignore[assignment]
        reference = build_reference(scenario, scenario.periods + inner.horizon)
        navigation = build_navigation(scenario, vehicle)
        fly_once(scenario, vehicle, plant, controller, reference, navigation=navigation)
    return problem, recording.queries


def agreed(problem: Problem, queries: list[Query], stride: int) -> dict[Method, int]:
    """How often each method was taken; each answer from a warm start is that from a cold one, in both senses.

    Rows count as held within 1e-9 of their bound, which late in the plan is worth 1e-6 rad/s: the whole plans agree
    less well than the first inputs.
    """
    warm, reset, fresh = (Shortcut(problem, QPSolver("piqp-multistage", problem)) for _ in range(3))
    empty = fresh._side.copy()
    methods = dict.fromkeys(Method, 0)
    for k, query in enumerate(queries):
        answer = warm.solve(query)
        methods[answer.method] += 1
        assert answer.status in ACCEPTED
        if k % stride:
            continue
        reset.reset()
        fresh._side = empty.copy()
        for cold in (reset, fresh):
            other = cold.solve(query)
            assert (other.method is Method.FREE) == (answer.method is Method.FREE)
            np.testing.assert_allclose(other.plan[0], answer.plan[0], rtol=1e-9, atol=0.0)
            np.testing.assert_allclose(other.plan, answer.plan, rtol=1e-7, atol=0.0)
            np.testing.assert_allclose(other.slacks, answer.slacks, rtol=0.0, atol=1e-9)
    return methods


def test_bounds_that_only_some_steps_have(constrained_flight: Flight) -> None:
    """A height that late steps alone are held below: what is active moves to where there is no bound."""
    problem = paper_problem()
    height = np.zeros((1, 12))
    height[0, 4] = 1.0
    upper = np.full((50, 1), np.inf)
    upper[20:] = 2.0
    late = Constraint(
        name="late",
        C=height,
        lower=np.full((50, 1), -np.inf),
        upper=upper,
        penalty=Penalty(l1=np.full(1, 100.0), l2=np.full(1, 10.0)),
    )
    problem = replace(problem, constraints=(late,))
    quick, whole = (Shortcut(problem, QPSolver("daqp", problem)) for _ in range(2))
    active = 0
    for query in flight_queries(constrained_flight, problem, stride=1)[20:80]:
        answer = quick.solve(query)
        whole.reset()
        expected = whole._whole.solve(query)
        assert answer.status in ACCEPTED
        assert expected.status in ACCEPTED
        np.testing.assert_allclose(answer.plan, expected.plan, atol=1e-5)
        active += bool(quick._side.reshape(50, -1)[20, -1])
        moved = quick._starts()[0]
        bound = np.where(moved > 0, problem.rows.upper.ravel(), problem.rows.lower.ravel())
        assert np.isfinite(bound[moved != 0]).all()
    assert active > 10


def test_over_the_papers_flight(constrained_flight: Flight) -> None:
    problem = paper_problem()
    queries = [query._replace(rest=problem.rest) for query in flight_queries(constrained_flight, problem, stride=1)]
    methods = agreed(problem, queries, stride=12)
    assert min(methods.values()) > 10
    assert methods[Method.AXES] > 300


def test_over_a_robust_flight(robust_queries: tuple[Problem, list[Query]]) -> None:
    problem, queries = robust_queries
    assert problem.rows.soft.size == 2
    assert len(queries) > 200
    methods = agreed(problem, queries, stride=6)
    assert methods[Method.FREE] > 20
    assert methods[Method.AXES] + methods[Method.WHOLE] > 20
