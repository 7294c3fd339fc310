"""Eqs. (27)-(29): the constrained controller, and what it does when its solver fails."""

from __future__ import annotations

import numpy as np
import pytest
from support import constrained_mpc, paper_problem, paper_reference

from quadsim.controller import Command, Phase, StepInputs
from quadsim.errors import PlanExhaustedError
from quadsim.mpc.problem.ocp import Query
from quadsim.mpc.solvers import INVALID_DATA, Answer, QPSolver

STATE = np.zeros(12)
STATE[10] = np.pi / 6


class FaultySolver(QPSolver):
    """The real solver, whose answers are corrupted in chosen calls."""

    def __init__(self, faults: dict[int, str], horizon: int = 50) -> None:
        self.problem = paper_problem("paper-constrained", f"controller.horizon={horizon}")
        super().__init__("piqp-multistage", self.problem)
        self.faults = faults
        self.calls = 0

    def solve(self, query: Query) -> Answer:
        answer = super().solve(query)
        fault = self.faults.get(self.calls)
        self.calls += 1
        if fault == "not_finite":
            return answer._replace(plan=answer.plan * np.nan)
        if fault == "out_of_bounds":
            return answer._replace(plan=answer.plan + 100.0)
        if fault == "infeasible_answer":  # leaves the tilt bound, from its second step on
            return answer._replace(plan=answer.plan + np.outer(np.arange(50) > 0, [-3.0, 0.0, 3.0, 0.0]))
        if fault is not None:
            return answer._replace(status=fault, plan=answer.plan * 0.0)
        return answer


def fly(faults: dict[int, str], periods: int, horizon: int = 50) -> list[Command]:
    solver = FaultySolver(faults, horizon)
    controller = constrained_mpc(solver.problem, solver)
    controller.reset(solver.problem.model.u_bar)
    reference = paper_reference(periods + horizon + 1)
    return [
        controller.step(StepInputs(time=0.05 * k), STATE, reference[k + 1 : k + 1 + horizon]) for k in range(periods)
    ]


def test_commands_respect_their_hard_bounds_exactly() -> None:
    commands = fly({}, 12)
    speeds = np.array([command.speeds for command in commands])
    slews = np.diff(speeds, axis=0, prepend=paper_problem().model.u_bar[None])
    assert speeds.min() >= 0.0
    assert speeds.max() <= 250.0
    assert slews.min() >= -10.0 - 1e-12
    assert slews.max() <= 5.0 + 1e-12
    assert slews.max() == pytest.approx(5.0)  # the climb wants more
    assert {command.status for command in commands} == {"solved"}
    assert commands[0].stats.active > 0


@pytest.mark.parametrize(
    "fault", ["primal_infeasible", "max_iterations", "numerics", "not_finite", "out_of_bounds", "infeasible_answer"]
)
def test_anything_but_a_good_answer_holds_the_shifted_plan(fault: str) -> None:
    commands = fly({3: fault, 4: fault}, 6)
    last_good = commands[2].plan
    np.testing.assert_allclose(commands[3].speeds, last_good[1], atol=1e-6)
    np.testing.assert_allclose(commands[4].speeds, last_good[2], atol=1e-6)
    np.testing.assert_allclose(commands[4].plan[:48], last_good[2:], atol=1e-12)
    assert [command.fallback for command in commands] == [0, 0, 0, 1, 1, 0]
    assert [command.status for command in commands] == ["solved"] * 3 + [fault] * 2 + ["solved"]
    assert commands[5].fallback == 0  # recovery is automatic


def test_an_exhausted_plan_ends_the_flight_with_its_reason() -> None:
    horizon = 5
    faults = dict.fromkeys(range(1, 100), "numerics")
    assert len(fly(faults, horizon, horizon)) == horizon  # one solved, four held
    with pytest.raises(PlanExhaustedError, match=r"0\.250 s.* 4"):
        fly(faults, horizon + 1, horizon)


def test_a_failure_in_the_first_period_has_no_plan_to_hold() -> None:
    with pytest.raises(PlanExhaustedError, match="plan"):
        fly({0: "primal_infeasible"}, 1)


def test_reset_forgets_the_plan() -> None:
    solver = FaultySolver({1: "numerics"})
    controller = constrained_mpc(solver.problem, solver)
    reference = paper_reference(60)[1:51]
    controller.reset(solver.problem.model.u_bar)
    controller.step(StepInputs(), STATE, reference)
    controller.reset(solver.problem.model.u_bar)
    with pytest.raises(PlanExhaustedError):
        controller.step(StepInputs(), STATE, reference)


def test_slews_count_from_the_command_that_acts() -> None:
    """Where an earlier command was dropped, the next one is bound to what acts, not to what was commanded."""
    problem = paper_problem()
    controller = constrained_mpc(problem)
    reference = paper_reference(51)[1:]
    controller.reset(problem.model.u_bar)
    commanded = controller.step(StepInputs(), STATE, reference).speeds
    acting = commanded - 7.0
    after = controller.step(StepInputs(time=0.05, acting=acting), STATE, reference).speeds
    assert problem.bounds is not None
    np.testing.assert_allclose(after, acting + problem.bounds.delta_max, atol=1e-6)  # it climbs as fast as it may


def test_on_the_ground_the_plan_is_forgotten() -> None:
    solver = FaultySolver({1: "numerics"})
    controller = constrained_mpc(solver.problem, solver)
    reference = paper_reference(51)[1:]
    controller.step(StepInputs(), STATE, reference)
    controller.step(StepInputs(time=0.05, phase=Phase.LANDED), STATE, reference)
    with pytest.raises(PlanExhaustedError, match="plan"):
        controller.step(StepInputs(time=0.1), STATE, reference)


def test_the_heir_of_a_held_plan_holds_the_rest_of_it() -> None:
    reference = paper_reference(55)
    first, heir = (
        constrained_mpc(solver.problem, solver)
        for solver in (FaultySolver({1: "numerics"}), FaultySolver({0: "numerics"}))
    )
    plan = first.step(StepInputs(), STATE, reference[1:51]).plan
    first.step(StepInputs(time=0.05), STATE, reference[2:52])
    heir.adopt(first)
    command = heir.step(StepInputs(time=0.1, acting=plan[1]), STATE, reference[3:53])
    np.testing.assert_allclose(command.speeds, plan[2], atol=1e-6)


def test_what_was_not_measured_is_no_infeasible_period() -> None:
    controller = constrained_mpc(paper_problem())
    reference = paper_reference(51)[1:]
    controller.step(StepInputs(), STATE, reference)
    assert controller.step(StepInputs(time=0.05), STATE * np.nan, reference).status == INVALID_DATA
    assert controller.infeasible_period is None
