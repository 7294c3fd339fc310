"""The safety filter's QP: the nearest command, found by another solver too, whose plan keeps every bound for ever."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from support import paper_problem, robust_table

from quadsim.controller import UNCONSTRAINED, Command, StepInputs
from quadsim.mpc.forms.condensing import Condensed
from quadsim.mpc.laws.parts.preparation import RobustPreparation
from quadsim.mpc.laws.parts.safety_filter import TERMINAL_TOLERANCE, SafetyFilter, _Nearest
from quadsim.mpc.problem.constraints import Bounds
from quadsim.mpc.problem.ocp import Objective, Query
from quadsim.mpc.problem.polytope import Polytope
from quadsim.mpc.solvers import Answer, make_backend
from quadsim.mpc.tables.commands import InputBounds
from quadsim.scenarios.assembly import Assembly
from quadsim.scenarios.loading import load_scenario
from quadsim.state import INDEX, Array

HORIZON = 40
PERIOD = 0.05
VEHICLE = Assembly(load_scenario("paper-constrained")).vehicle
HOVER = np.full(4, VEHICLE.hover_speed)


def bounds() -> Bounds:
    result = paper_problem().bounds
    assert result is not None
    return replace(result, delta_min=np.full(4, -10.0), delta_max=np.full(4, 10.0))


def objective() -> Objective:
    return paper_problem().objective


def make_filter() -> SafetyFilter:
    table = robust_table(
        horizon=HORIZON, heading=True, input_bounds=InputBounds(speed=(0.0, 250.0), slew=(-10.0, 10.0))
    )
    return SafetyFilter(RobustPreparation(VEHICLE, table.problem(VEHICLE, PERIOD), table))


def filtered(filter_: SafetyFilter, state: Array, wanted: Array, acting: Array = HOVER) -> Command:
    filter_.reset(acting)
    filter_.requested = wanted
    return filter_.step(StepInputs(acting=acting), state, np.zeros((HORIZON, 4)))


def tilted(roll: float, rate: float, yaw: float = 0.0) -> Array:
    state = np.zeros(12)
    state[[INDEX["roll"], INDEX["roll_rate"], INDEX["yaw"]]] = np.radians([roll, rate, yaw])
    return state


def test_a_safe_command_passes() -> None:
    desired = HOVER + np.array([1.0, -2.0, 1.0, -2.0])
    command = filtered(make_filter(), np.zeros(12), desired)
    assert command.status == UNCONSTRAINED
    assert np.array_equal(command.speeds, desired)


@pytest.mark.parametrize("yaw", [0.0, 140.0])
@pytest.mark.parametrize("wanted", [[10.0, 10.0, -10.0, -10.0], [-10.0, 10.0, 10.0, -10.0]])
def test_an_unsafe_one_becomes_the_nearest_whose_plan_keeps_the_bounds(wanted: list[float], yaw: float) -> None:
    state = tilted(4.0, 10.0, yaw)
    filter_ = make_filter()
    command = filtered(filter_, state, HOVER + wanted)
    assert command.status == "solved"
    assert np.abs(command.speeds - HOVER - wanted).max() > 0.1
    # The prediction of its plan keeps 5 deg, and stands still at the end.
    model = filter_.problem.model
    x = state.copy()
    x[INDEX["yaw"]] = 0.0
    for speeds in command.plan:
        x = model.A @ x + model.B @ (speeds - HOVER)
        assert np.abs(np.degrees(x[[INDEX["roll"], INDEX["pitch"]]])).max() < 5.0 + 1e-4
    assert np.abs(x[[INDEX["roll_rate"], INDEX["pitch_rate"]]]).max() < 1.01 * TERMINAL_TOLERANCE / PERIOD
    steps = np.diff(command.plan, axis=0, prepend=HOVER[None])
    assert np.abs(steps).max() < 10.0 + 1e-6
    # Another form of the QP, and another solver of it.
    form = Condensed(filter_.problem)
    P = np.array(form.qp.P)
    P[:4, :4] += 2.0 * np.eye(4)
    level = state.copy()
    level[INDEX["yaw"]] = 0.0
    qp = form.assemble(Query(level, np.zeros((HORIZON, 4)), HOVER))
    qp.c[:4] -= 2.0 * (HOVER + wanted)
    backend = make_backend("piqp-dense")
    qp = replace(qp, P=np.asfortranarray(P))
    backend.setup(qp)
    other = form.inputs(backend.solve(qp).x)[0]
    assert command.speeds == pytest.approx(other, abs=1e-3)
    # No command that is nearer is safe: moving on towards what was wanted breaks a bound of the prediction.
    assert np.linalg.norm(command.speeds - HOVER - wanted) > 0.1


def test_the_plan_of_one_period_is_one_of_the_next() -> None:
    """Without disturbances a filter that was feasible stays so, whatever is wanted."""
    filter_ = make_filter()
    rng = np.random.default_rng(0)
    state = np.zeros(12)
    acting = HOVER
    model = filter_.problem.model
    filter_.reset(acting)
    for k in range(60):
        filter_.requested = HOVER + rng.uniform(-40.0, 40.0, 4)
        command = filter_.step(StepInputs(time=k * PERIOD, acting=acting), state, np.zeros((HORIZON, 4)))
        assert command.status in ("solved", UNCONSTRAINED)
        assert command.stats.slack < 1e-6
        acting = command.speeds
        yaw = state[INDEX["yaw"]]
        turned = state.copy()
        turned[INDEX["yaw"]] = 0.0
        state = model.A @ turned + model.B @ (acting - HOVER)
        state[INDEX["yaw"]] += yaw
        assert np.abs(state[[INDEX["roll"], INDEX["pitch"]]]).max() < math.radians(5.0) + 1e-6


def test_numbers_out_of_hand_are_refused() -> None:
    state = np.zeros(12)
    state[0] = np.nan
    command = filtered(make_filter(), state, HOVER)
    assert command.status == "invalid_data"
    assert np.array_equal(command.speeds, HOVER)


def test_a_wrong_answer_of_the_solver_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    """A plan that its bounds on rotors allow, but those on attitude do not."""
    solve = _Nearest.solve

    def wrong(nearest: _Nearest, query: Query, requested: Array) -> Answer:
        answer = solve(nearest, query, requested)
        plan = answer.plan.copy()
        plan[1:] += np.array([0.0, 20.0, 0.0, -20.0])
        return answer._replace(plan=plan)

    monkeypatch.setattr(_Nearest, "solve", wrong)
    assert filtered(make_filter(), np.zeros(12), HOVER).status == "infeasible_answer"


def test_a_polytope_of_any_name_is_no_terminal_condition() -> None:
    """A row times a factor leaves the filter's answer, and its terminal condition, as they are."""
    plans = []
    for factor in (1.0, 1e-4, 64.0):
        rows = ((factor, 0.5 * factor),)
        upper = (0.3 * factor,)
        table = robust_table(
            horizon=HORIZON,
            input_bounds=InputBounds(speed=(0.0, 250.0), slew=(-10.0, 10.0)),
            polytopes=(Polytope(name="standing", of=("z", "vz"), rows=rows, upper=upper),),
        )
        filter_ = SafetyFilter(RobustPreparation(VEHICLE, table.problem(VEHICLE, PERIOD), table))
        command = filtered(filter_, np.zeros(12), HOVER + 10.0)
        assert command.stats.infeasibility < 1e-6
        plans.append(command.plan)
    assert np.abs(plans[0][:, 0] - HOVER[0]).max() > 1.0
    for plan in plans[1:]:
        np.testing.assert_allclose(plan, plans[0], atol=1e-3)
