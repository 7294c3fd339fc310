"""The fallback contract: its levels one by one."""

from __future__ import annotations

import copy
import math
from dataclasses import replace

import numpy as np
import piqp
import pytest
from scripted_controller import (
    PERIOD,
    Scripted,
    advance,
    bounds,
    call,
    failing,
    following,
    guard,
    model,
    random_state,
    vehicle,
)

from quadsim.controller import ACCEPTED, Phase, StepInputs
from quadsim.errors import CommandError, ParameterError
from quadsim.mpc.guard.contract import FallbackSettings, Guard
from quadsim.mpc.pilot.pilot import Pilot
from quadsim.mpc.solvers.piqp import STATUS
from quadsim.state import INDEX, VELOCITY, Array


def test_a_good_answer_passes_unchanged() -> None:
    inner = Scripted()
    command = call(guard(inner))
    answer = inner.step(StepInputs(), np.zeros(12), np.zeros((30, 4)))
    np.testing.assert_array_equal(command.speeds, answer.speeds)
    np.testing.assert_array_equal(command.plan, answer.plan)
    assert (command.status, command.fallback, command.stats.iterations) == ("solved", 0, 7)
    guarded = guard(inner)
    assert (guarded.name, guarded.solver, guarded.horizon) == ("scripted", "none", 30)


@pytest.mark.parametrize("status", [*sorted({*STATUS.values()} - ACCEPTED), "invalid_data", "something else"])
def test_a_failed_period_flies_the_shifted_plan(status: str) -> None:
    commands = following(guard(Scripted(failing([1, 2], status=status))), 4)
    np.testing.assert_allclose(commands[1].speeds, commands[0].plan[1], atol=1e-9)
    np.testing.assert_allclose(commands[2].speeds, commands[0].plan[2], atol=1e-9)
    np.testing.assert_allclose(commands[2].plan[:28], commands[0].plan[2:], atol=1e-9)
    assert [command.fallback for command in commands] == [0, 1, 1, 0]
    assert [command.status for command in commands] == ["solved", status, status, "solved"]
    assert commands[1].stats.iterations == 7


def test_every_status_of_piqp_is_known() -> None:
    assert set(STATUS) == {getattr(piqp, name) for name in dir(piqp) if name.startswith("PIQP_")}


@pytest.mark.parametrize(
    ("error", "status"),
    [
        (CommandError("no", time=0.0), "command_error"),
        (np.linalg.LinAlgError("singular"), "lin_alg_error"),
        (FloatingPointError("overflow"), "floating_point_error"),
        (RuntimeError("of a compiled back end"), "runtime_error"),
    ],
)
def test_a_failure_that_is_raised_is_recorded(error: Exception, status: str) -> None:
    inner = Scripted({1: error})
    commands = following(guard(inner), 3)
    assert [command.fallback for command in commands] == [0, 1, 0]
    assert commands[1].status == status


@pytest.mark.parametrize("mistake", [TypeError, KeyError, AttributeError, NotImplementedError, RecursionError])
def test_a_programmer_s_mistake_is_not_hidden(mistake: type[Exception]) -> None:
    with pytest.raises(mistake):
        call(guard(Scripted({0: mistake("oops")})))


@pytest.mark.parametrize(
    ("answer", "status"),
    [
        ({"speeds": np.full(4, math.nan)}, "not_finite"),
        ({"plan": np.full((30, 4), math.inf)}, "not_finite"),
        ({"plan": np.vstack([np.full(4, math.nan), np.full((29, 4), 190.0)])}, "not_finite"),
        ({"speeds": np.full(3, 190.0)}, "wrong_shape"),
        ({"plan": np.full((29, 4), 190.0)}, "wrong_shape"),
        ({"speeds": np.full(4, 251.0)}, "out_of_bounds"),
        ({"speeds": np.full(4, 192.82 + 5.1)}, "out_of_bounds"),
    ],
)
def test_an_answer_that_only_claims_to_be_good_is_not_used(answer: dict[str, Array], status: str) -> None:
    commands = following(guard(Scripted({1: answer})), 2)
    assert (commands[1].status, commands[1].fallback) == (status, 1)
    np.testing.assert_allclose(commands[1].speeds, commands[0].plan[1], atol=1e-9)


def test_a_command_need_not_be_its_plan_s_first_row() -> None:
    speeds = model().u_bar + 1.0
    inner = Scripted({0: {"speeds": speeds}} | failing([1]))
    commands = following(guard(inner), 2)
    assert [command.fallback for command in commands] == [0, 1]
    np.testing.assert_array_equal(commands[0].plan[0], speeds)
    np.testing.assert_array_equal(commands[0].speeds, speeds)


def test_a_plan_that_is_flown_without_a_call_keeps_its_bounds() -> None:
    plan = np.tile(model().u_bar, (30, 1))
    plan[3:, 0] += 12.0  # in three periods of at most 5 rad/s
    command = call(guard(Scripted({0: {"plan": plan}})))
    assert command.fallback == 0
    np.testing.assert_allclose(command.plan[2:7, 0] - model().u_bar[0], [0.0, 5.0, 10.0, 12.0, 12.0])


def test_rounding_beyond_the_bounds_is_taken_away() -> None:
    high = np.full(4, 250.0 + 5e-7)
    command = call(guard(Scripted({0: {"speeds": high, "plan": np.tile(high, (30, 1))}})), acting=np.full(4, 249.0))
    assert command.fallback == 0
    assert command.speeds.tolist() == [250.0] * 4
    assert command.plan.max() == 250.0


@pytest.mark.parametrize("reference", [np.full((30, 4), math.nan), np.full((30, 4), 1e9), np.zeros((29, 4))])
def test_an_invalid_reference_is_not_passed_on(reference: Array) -> None:
    inner = Scripted()
    command = guard(inner).step(StepInputs(), np.zeros(12), reference)
    assert (command.status, command.fallback) == ("invalid_reference", 2)
    assert not inner.calls


def test_off_its_plan_the_vehicle_is_pulled_back() -> None:
    guarded = guard(Scripted(failing([1])))
    plan = call(guarded).plan
    off = np.zeros(12)
    off[INDEX["z"]] = -0.2
    command = call(guarded, off)
    assert command.fallback == 1
    assert (command.speeds > plan[1] + 1.0).all()  # too low: faster


@pytest.mark.parametrize(("channel", "value"), [("x", 0.51), ("vy", -1.1), ("roll", 0.21), ("yaw_rate", 1.1)])
def test_far_off_its_plan_the_vehicle_hovers(channel: str, value: float) -> None:
    guarded = guard(Scripted(failing(range(1, 9))))
    call(guarded)
    off = np.zeros(12)
    off[INDEX[channel]] = value
    assert call(guarded, 0.9 * off).fallback == 1
    assert call(guarded, off).fallback == 2
    assert call(guarded).fallback == 2  # the plan is given up permanently


@pytest.mark.parametrize(("horizon", "held"), [(30, 20), (8, 7)])
def test_levels_follow_one_another_and_recovery_is_automatic(horizon: int, held: int) -> None:
    inner = Scripted(failing(range(1, 200)), horizon=horizon)
    commands = following(guard(inner), 202)
    levels = [command.fallback for command in commands]
    assert levels == [0] + held * [1] + 100 * [2] + (199 - held - 100) * [3] + [0, 0]
    np.testing.assert_array_equal(inner.calls[-1][0].acting, commands[-2].speeds)


def test_hover_brakes_then_holds_place_height_and_heading() -> None:
    guarded = guard(Scripted(failing(range(300))), settings=FallbackSettings(hover=100.0))
    state = np.zeros(12)
    state[[INDEX["vx"], INDEX["z"], INDEX["yaw"]]] = 2.0, 5.0, 2.5
    track = []
    for _ in range(250):
        state = advance(state, call(guarded, state).speeds)
        track.append(state)
    np.testing.assert_allclose(state[[INDEX["z"], INDEX["yaw"]]], [5.0, 2.5], atol=1e-3)
    np.testing.assert_allclose(state[list(VELOCITY)], 0.0, atol=2e-3)
    assert np.degrees(np.abs(np.array(track)[:, [INDEX["roll"], INDEX["pitch"]]])).max() < 12.0
    assert 1.0 < state[INDEX["x"]] < 4.0


def test_descent_sinks_at_its_speed() -> None:
    guarded = guard(Scripted(failing(range(300))), settings=FallbackSettings(hover=1.0, sink=0.4))
    commands = following(guarded, 150)
    assert [command.fallback for command in commands] == 20 * [2] + 130 * [3]
    state = np.zeros(12)
    for command in commands:
        state = advance(state, command.speeds)
    assert state[INDEX["vz"]] == pytest.approx(-0.4, abs=1e-3)
    assert state[INDEX["z"]] == pytest.approx(-0.4 * 130 * PERIOD, abs=0.02)


def test_a_missing_measurement_is_replaced_and_then_the_controller_is_not_called() -> None:
    inner = Scripted()
    guarded = guard(inner, settings=FallbackSettings(unseen=0.5))
    following(guarded, 3)
    blind = [call(guarded, np.full(12, math.nan)) for _ in range(12)]
    assert [command.fallback for command in blind] == 10 * [0] + 2 * [2]
    assert [command.status for command in blind] == 10 * ["solved"] + 2 * ["state_unknown"]
    assert np.isfinite([state for _, state in inner.calls]).all()
    assert call(guarded).fallback == 0


@pytest.mark.parametrize("acting", [np.full(4, math.nan), np.full(3, 190.0), np.full(4, 1e7), np.full(4, 190.0 + 1j)])
def test_an_impossible_command_in_force_is_replaced_by_its_own_last_one(acting: Array) -> None:
    inner = Scripted()
    guarded = guard(inner)
    last = call(guarded).speeds
    call(guarded, acting=acting)
    np.testing.assert_array_equal(inner.calls[1][0].acting, last)
    guarded.reset(acting)
    np.testing.assert_array_equal(inner.resets[-1], model().u_bar)


@pytest.mark.parametrize("horizon", [8, 30, 50])
def test_a_contract_goes_on_from_another(horizon: int) -> None:
    """With its plan, cut or extended by its last row, and the periods in fallback, and in hover, so far."""
    first = guard(Scripted(failing(range(1, 200))))
    state = np.zeros(12)
    commands = []
    for k in range(150):
        if k in (5, 60):
            second = guard(Scripted(failing(range(200)), horizon=horizon))
            second.reset(commands[-1].speeds)
            second.adopt(first)
            first = second
        commands.append(call(first, state))
        state = advance(state, commands[-1].speeds)
    last = min(horizon, 30) - 1
    for i, row in enumerate(commands[5].plan[1:], start=6):
        np.testing.assert_allclose(row, commands[0].plan[min(i, last)], atol=1e-9)
    held = min(20, last)
    assert [command.fallback for command in commands] == [0] + held * [1] + 100 * [2] + (49 - held) * [3]


def test_a_plan_of_other_commands_is_not_taken_over() -> None:
    targets = replace(model(), targets=True)
    first = guard(Scripted(failing(range(1, 9))))
    call(first)
    second = Pilot(Scripted(failing(range(9))), vehicle(), guard=Guard(targets, bounds=bounds()))
    second.reset(model().u_bar)
    second.adopt(first)
    assert call(second).fallback == 2


@pytest.mark.parametrize("horizon", [3, 10, 40])
def test_a_law_may_change_its_horizon_while_it_fails(horizon: int) -> None:
    """The state that its last plan leads to is then foreseen anew."""
    inner = Scripted(failing(range(1, 30)), horizon=5)
    guarded = guard(inner)
    state = np.zeros(12)
    levels = []
    for k in range(12):
        if k == 3:
            inner.horizon = horizon
        command = call(guarded, state)
        levels.append(command.fallback)
        state = advance(state, command.speeds)
    assert levels[:3] == [0, 1, 1]
    assert set(levels[3:]) <= {1, 2}


def test_a_law_may_change_its_horizon() -> None:
    inner = Scripted(failing([1, 3]))
    guarded = guard(inner)
    state = np.zeros(12)
    for horizon in (30, 5, 5, 40):
        inner.horizon = horizon
        command = call(guarded, state)
        assert command.plan.shape == (horizon, 4)
        state = advance(state, command.speeds)
    assert command.fallback == 1
    inner.horizon = 0
    with pytest.raises(ParameterError, match=r"controller\.horizon must be at least 1; got 0"):
        call(guarded, state)


def test_a_contract_has_addresses_and_is_not_copied() -> None:
    contract = Guard(model(), bounds=bounds())
    with pytest.raises(TypeError, match="cannot be copied or pickled"):
        copy.deepcopy(contract)


def test_reset_forgets_plan_and_measurements() -> None:
    guarded = guard(Scripted(failing([1, 2])))
    call(guarded)
    guarded.reset(model().u_bar)
    assert call(guarded).fallback == 2
    guarded.reset(model().u_bar)
    unmeasured = np.zeros(12)
    unmeasured[0] = math.nan
    assert call(guarded, unmeasured).status == "state_unknown"


@pytest.mark.parametrize("phase", [Phase.LANDED, Phase.CRASHED])
def test_on_the_ground_rotors_stop_whatever_the_controller_answers(phase: Phase) -> None:
    inner = Scripted({1: RuntimeError("no")})
    guarded = guard(inner)
    for state in (np.zeros(12), np.zeros(12), np.full(12, math.nan)):
        command = call(guarded, state, phase=phase, acting=np.full(4, 15.0))
        assert (command.status, command.fallback, command.speeds.tolist()) == (str(phase), 0, [5.0] * 4)
    assert inner.calls[0][0].phase is phase


def test_prediction_is_the_inner_controller_s_where_it_has_one() -> None:
    inner = Scripted()
    guarded = guard(inner)
    states = random_state(8)[None]
    plans = np.tile(model().u_bar, (1, 30, 1))
    expected = inner.predict(states, plans)
    np.testing.assert_array_equal(guarded.predict(states, plans), expected)
    inner.predict = lambda states, plans: np.zeros(3)  # type: ignore[method-assign]
    np.testing.assert_allclose(guarded.predict(states, plans), expected, atol=0.3)

    def broken(states: Array, plans: Array) -> Array:
        raise ZeroDivisionError

    inner.predict = broken  # type: ignore[method-assign]
    assert guarded.predict(states, plans).shape == (1, 30, 12)


def test_the_controller_receives_what_is_predicted() -> None:
    inner = Scripted()
    guarded = guard(inner)
    partly = np.zeros(12)
    partly[INDEX["vz"]] = math.nan
    for time, state in enumerate((np.zeros(12), partly, partly, np.zeros(12))):
        call(guarded, state, time=float(time))
    moments = [now for now, _ in inner.calls]
    assert all(now.unseen is not None for now in moments)
    assert [now.time for now in moments] == [0.0, 1.0, 2.0, 3.0]
    unseen = np.array([now.unseen for now in moments])
    assert unseen[:, INDEX["vz"]].tolist() == [0.0, 1.0, 2.0, 0.0]
    assert not np.delete(unseen, INDEX["vz"], axis=1).any()


@pytest.mark.parametrize("turns", [200, -10_000])
def test_a_yaw_counts_its_turns(turns: int) -> None:
    state = np.zeros(12)
    state[INDEX["yaw"]] = math.tau * turns
    reference = np.zeros((30, 4))
    reference[:, 3] = math.tau * turns
    assert guard(Scripted()).step(StepInputs(), state, reference).status == "solved"
