"""Who answered each period, against the calls that solvers really had, and what an answer is worth."""

from __future__ import annotations

from collections import Counter
from typing import Any

import numpy as np
import pytest
from support import paper_problem

from quadsim.mpc.guard.answer import INFEASIBLE, AnswerCheck
from quadsim.mpc.problem.ocp import Query, predicted
from quadsim.mpc.problem.qp import KKT_EVERY
from quadsim.mpc.solvers import QPSolver
from quadsim.mpc.solvers.piqp import Piqp
from quadsim.rollout.flown import summarise
from quadsim.rollout.rollout import Rollout
from quadsim.scenarios.assembly import preferring_core
from quadsim.scenarios.loading import load_scenario


@pytest.mark.slow("core")
@pytest.mark.parametrize(
    ("name", "settings", "answered_by"),
    [
        ("paper-constrained", (), {"gain": 607, "piqp-multistage": 593}),
        ("paper-constrained", ("controller.solver=core",), {"gain": 607, "core": 593}),
        ("robust", ("controller.solver=core",), {"gain": 196, "core": 404}),
    ],
)
def test_as_many_periods_are_a_solvers_as_it_had_calls(
    name: str, settings: tuple[str, ...], answered_by: dict[str, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    calls = Counter[str]()
    real = Piqp.solve
    monkeypatch.setattr(Piqp, "solve", lambda *given: (calls.update(["piqp-multistage"]), real(*given))[1])
    flight = Rollout(load_scenario(name, settings)).fly()
    counted: dict[str, Any] = summarise(flight)["controller"]
    assert counted["answered_by"] == answered_by == Counter(flight.log.control.answered_by)
    assert counted["answered_by"].get("piqp-multistage", 0) == calls["piqp-multistage"]
    assert (counted["iterations"] is None) == (not calls)


@pytest.mark.slow("core")
@pytest.mark.parametrize(
    "name", ["worn-rotor-hard-bounds", pytest.param("stalled-solver", marks=pytest.mark.representative("core"))]
)
def test_a_period_in_fallback_or_too_late_is_answered_by_the_fallback(name: str) -> None:
    control = Rollout(load_scenario(name)).fly().log.control
    fallback = control.fallback > 0
    assert fallback.any()
    np.testing.assert_array_equal(np.array(control.answered_by) == "fallback", fallback)


@pytest.mark.parametrize("every", [1, 7, KKT_EVERY])
def test_kkt_residuals_are_computed_as_often_as_stated(every: int) -> None:
    settings = ["duration=5", "controller.solver=core", f"controller.kkt_every={every}"]
    control = Rollout(load_scenario("paper-constrained", settings)).fly().log.control
    expected = np.arange(control.t.size) % every == 0
    for name in ("kkt_stationarity", "kkt_complementarity", "kkt_dual"):
        values = getattr(control, name)
        np.testing.assert_array_equal(np.isfinite(values), expected)
        assert values[expected].max() < 1e-5
    assert np.isfinite(control.infeasibility).all()


def test_infeasibility_is_the_largest_violation_of_a_row_step_by_step() -> None:
    """By the map and by prediction step by step, on plans that violate tilt, speed or slew."""
    problem = paper_problem()
    rng = np.random.default_rng(3)
    rows = problem.rows
    check = AnswerCheck(problem, 1)
    other = AnswerCheck(paper_problem("paper-constrained", "controller.horizon=50"), 1)
    solver = QPSolver("piqp-multistage", problem)
    for size in (0.0, 0.3, 3.0, 100.0):
        query = Query(0.01 * rng.normal(size=12), np.zeros((50, 4)), problem.model.u_bar)
        answer = solver.solve(query)
        answer = answer._replace(plan=answer.plan + size * rng.normal(size=answer.plan.shape))
        states = predicted(problem, query, answer.plan)
        steps = np.diff(answer.plan, axis=0, prepend=query.u_before[None])
        values = states @ rows.C.T + answer.plan @ rows.D.T + steps @ rows.E.T
        expected = max(float(np.maximum(values - rows.upper, rows.lower - values).max()), 0.0)
        for result in (check, other):
            checked, refused = result(problem, query, answer, None)
            assert checked.stats.infeasibility == pytest.approx(expected, rel=1e-9, abs=1e-11)
            assert (refused == "infeasible_answer") == (expected > INFEASIBLE)


@pytest.mark.parametrize(
    ("name", "settings", "solver"),
    [
        ("paper-constrained", (), "core"),
        ("paper-constrained", ("controller.solver=daqp",), "daqp"),
        ("paper-constrained", ("controller.horizon=900",), None),  # whose responses are too many for the core
        ("pillar", (), None),  # whose half-spaces differ from step to step
        ("hover", (), "core"),
    ],
)
def test_the_core_is_preferred_to_the_default_where_it_takes_the_problem(
    name: str, settings: tuple[str, ...], solver: str | None
) -> None:
    preferred = preferring_core(load_scenario(name, settings))
    assert preferred.controller.solver == solver


def test_a_controller_without_that_choice_stays_as_it_is() -> None:
    scenario = load_scenario("paper-unconstrained")
    assert preferring_core(scenario) is scenario
