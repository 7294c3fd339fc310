"""The law of hover: the infinite horizon's gain, the same closed loop for every vehicle, and tilt within its bound."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import scipy.linalg
from scripted_controller import (
    PERIOD,
    Scripted,
    advance,
    bounds,
    call,
    failing,
    guard,
    level,
    model,
    pressed,
    random_state,
)

from quadsim.assets import vehicle_path
from quadsim.controller import Command
from quadsim.mpc.guard.answer import ActuatorBounds
from quadsim.mpc.guard.contract import FallbackSettings, Guard
from quadsim.mpc.guard.numbers import ACCEPTABLE, ACCEPTABLE_ACCELERATION, LARGEST_CLIMB, LARGEST_TURN, HoverGain
from quadsim.mpc.problem.equilibrium import Trim
from quadsim.mpc.problem.heading import anchored, predict_in_heading_frame, slope, turn, turn_horizontally
from quadsim.mpc.problem.model import hover_model
from quadsim.state import INDEX, Array
from quadsim.vehicle import load_vehicle

VEHICLES = ("lopes2011", "hummingbird", "crazyflie2")
SIDEWAYS = [INDEX[name] for name in ("x", "vx", "y", "vy")]
TILTS = [INDEX["roll"], INDEX["pitch"]]


def infinite_horizon(A: Array, pushed: Array) -> Array:
    """(4, 12) gain of the LQR, from the algebraic Riccati equation."""
    Q = np.diag(ACCEPTABLE**-2.0)
    R = np.diag(np.array(ACCEPTABLE_ACCELERATION) ** -2.0)
    P = scipy.linalg.solve_discrete_are(A, pushed, Q, R)
    return np.asarray(np.linalg.solve(R + pushed.T @ P @ pushed, pushed.T @ P @ A))


def changes(error: Array, tilt: float, rest: Array) -> Array:
    """(4,) changes of speeds that an error (12,) in the heading frame demands, with roll and pitch (2,) at rest."""
    S = slope(model())
    K = infinite_horizon(model().A, model().B @ np.linalg.inv(S))
    rows = K[[1, 2]]
    lean = rest - np.linalg.solve(rows[:, TILTS], rows[:, SIDEWAYS] @ error[SIDEWAYS])
    lean *= min(1.0, tilt / max(float(np.linalg.norm(lean)), tilt))
    upright = error.copy()
    upright[SIDEWAYS] = 0.0
    upright[TILTS] -= lean
    acceleration = -K @ upright
    acceleration[0] = np.clip(acceleration[0], -LARGEST_CLIMB, LARGEST_CLIMB)
    acceleration[3] = np.clip(acceleration[3], -LARGEST_TURN, LARGEST_TURN)
    return np.asarray(np.linalg.solve(S, acceleration))


def closed_loop(state: Array, sink: float, before: Array, tilt: float, horizon: int, trim: Trim) -> Array:
    """(N, 4) speeds of hover, sinking [m/s], from where the vehicle is, by the model turned by its yaw."""
    there = anchored(model(), trim)
    yaw = float(state[INDEX["yaw"]])
    rest = trim.state(yaw)
    seen = turn_horizontally(state, -yaw)
    target = np.zeros(12)
    for name in ("x", "y", "z", "yaw"):
        target[INDEX[name]] = seen[INDEX[name]]
    target[INDEX["vz"]] = -sink
    target[INDEX["z"]] -= sink * PERIOD
    plan = np.empty((horizon, 4))
    for i in range(horizon):
        speeds = trim.speeds + changes(seen - target, tilt, rest[TILTS])
        plan[i] = before = bounds().clip(speeds, before)
        seen = rest + there.A @ (seen - rest) + there.B @ (before - trim.speeds)
        target[INDEX["z"]] -= sink * PERIOD
    return plan


def hovering(state: Array, *, trim: Trim | None = None, horizon: int = 30, **settings: Any) -> Command:
    """The contract's command for a law that has no answer, at a state."""
    law = Scripted(failing(range(2)), horizon=horizon)
    if trim is not None:
        law.trim = trim  # type: ignore[attr-defined]
    return call(guard(law, settings=FallbackSettings(**settings)), state, acting=(trim or level()).speeds)


@pytest.mark.parametrize("name", VEHICLES)
def test_every_vehicle_has_the_same_closed_loop(name: str) -> None:
    hover = hover_model(load_vehicle(vehicle_path(name)), PERIOD)
    law = HoverGain.of_model(hover)
    closed = hover.A - hover.B @ np.linalg.solve(law.slope, law.gain)
    decay = np.sort(-np.log(np.abs(np.linalg.eigvals(closed))) / PERIOD)
    assert decay[0] > 1.5  # [1/s]
    reference = HoverGain.of_model(model())
    np.testing.assert_allclose(law.gain, reference.gain, rtol=1e-6, atol=1e-7)


def test_the_gain_is_the_infinite_horizon_s() -> None:
    """Also with weights on rotor speeds that are those on accelerations."""
    law = HoverGain.of_model(model())
    np.testing.assert_allclose(law.gain, infinite_horizon(model().A, model().B @ law.inverse), rtol=1e-6, atol=1e-9)
    weight = law.slope.T @ np.diag(np.array(ACCEPTABLE_ACCELERATION) ** -2.0) @ law.slope
    A = model().A
    B = model().B
    P = scipy.linalg.solve_discrete_are(A, B, np.diag(ACCEPTABLE**-2.0), weight)
    expected = np.linalg.solve(weight + B.T @ P @ B, B.T @ P @ A)
    np.testing.assert_allclose(law.inverse @ law.gain, expected, rtol=1e-6, atol=1e-7)


@pytest.mark.parametrize("sinking", [False, True])
@pytest.mark.parametrize("seed", range(6))
def test_the_plan_of_hover_and_descent_is_the_closed_loop_of_the_equations(seed: int, sinking: bool) -> None:
    state = random_state(seed, 0.1)
    state[INDEX["yaw"]] = 3.0 * math.sin(seed)
    state[[INDEX["vx"], INDEX["vy"]]] *= 10.0 ** (seed % 3)
    trim = Trim(
        speeds=model().u_bar + 3.0 * np.random.default_rng(seed).normal(size=4),
        lift=np.array([-0.2, 0.1, 9.81]),
        twist=np.array([0.02, -0.01, 0.005]),
    )
    command = hovering(state, trim=trim, tilt=8.0, hover=0.0 if sinking else 5.0)
    expected = closed_loop(state, 0.5 if sinking else 0.0, trim.speeds, math.radians(8.0), 30, trim)
    assert command.fallback == (3 if sinking else 2)
    np.testing.assert_allclose(command.plan, expected, rtol=0.0, atol=1e-9)
    np.testing.assert_array_equal(command.speeds, command.plan[0])


@pytest.mark.parametrize("yaw", [0.0, 0.5, math.pi / 2, math.pi, -2.0])
def test_a_kept_plan_is_corrected_in_the_heading_frame(yaw: float) -> None:
    """By the equations, and so by the same as without a heading for an error that is turned."""
    guarded = guard(Scripted(failing([1])))
    start = np.zeros(12)
    start[INDEX["yaw"]] = yaw
    plan = call(guarded, start).plan
    error = random_state(2, 0.02)
    error[INDEX["yaw"]] = 0.0
    foreseen = guarded.predict(start[None], plan[None])
    assert foreseen is not None
    command = call(guarded, foreseen[0, 0] + turn(yaw) @ error, acting=plan[0])
    expected = plan[1] + changes(error, math.radians(10.0), np.zeros(2))
    assert command.fallback == 1
    np.testing.assert_allclose(command.speeds, bounds().clip(expected, plan[0]), atol=1e-9)
    np.testing.assert_allclose(command.plan[1:-1], bounds().clip_plan(plan[2:], command.speeds), atol=1e-9)


@pytest.mark.parametrize("yaw", [0.5, math.pi / 2, math.pi, -2.0])
def test_law_and_prediction_turn_with_the_heading(yaw: float) -> None:
    T = turn(yaw)
    state = random_state(3)
    speeds = model().u_bar + np.array([3.0, -2.0, 1.0, 0.5])
    state[INDEX["yaw"]] = 0.0
    ahead = np.zeros(12)
    ahead[INDEX["yaw"]] = yaw
    np.testing.assert_allclose(advance(T @ state + ahead, speeds), T @ advance(state, speeds) + ahead, atol=1e-12)
    np.testing.assert_allclose(hovering(T @ state + ahead).plan, hovering(state).plan, atol=1e-9)


def test_far_off_the_law_demands_its_largest_tilt_climb_and_turn_and_no_more() -> None:
    fast = np.zeros(12)
    fast[INDEX["vx"]] = 500.0
    fast[INDEX["pitch"]] = -0.15  # against +x
    np.testing.assert_allclose(hovering(fast, tilt=math.degrees(0.15)).speeds, model().u_bar, atol=1e-9)
    fast[INDEX["vz"]] = -100.0
    fast[INDEX["yaw_rate"]] = 50.0
    free = ActuatorBounds(u_min=np.zeros(4), u_max=np.full(4, 1e3), delta_min=[-1e3] * 4, delta_max=[1e3] * 4)
    for trim in (level(), pressed()):  # beside what holds the vehicle
        law = Scripted(failing([0]))
        law.trim = trim  # type: ignore[attr-defined]
        contract = guard(law, bounds=free, settings=FallbackSettings(tilt=math.degrees(0.15)))
        pulled = call(contract, fast, acting=trim.speeds).speeds - trim.speeds
        np.testing.assert_allclose((slope(model()) @ pulled)[[0, 3]], [LARGEST_CLIMB, -LARGEST_TURN])


def test_the_plan_of_the_descent_sinks_and_levels() -> None:
    state = random_state(4, 0.02)
    plan = hovering(state, horizon=200, hover=0.0).plan
    end = predict_in_heading_frame(model(), state[None], plan[None], level())[0, -1]
    assert end[INDEX["vz"]] == pytest.approx(-0.5, abs=1e-3)
    assert end[INDEX["z"]] - state[INDEX["z"]] == pytest.approx(-0.5 * 201 * PERIOD, abs=1e-2)
    held = np.zeros(12)
    for name in ("x", "y", "yaw"):
        held[INDEX[name]] = state[INDEX[name]]
    np.testing.assert_allclose(np.delete(end - held, [INDEX["z"], INDEX["vz"]]), 0.0, atol=1e-3)


def test_the_plan_of_hover_alone_is_that_of_a_law_without_an_answer() -> None:
    """As the advice on an infeasible period asks for it."""
    law = Scripted()
    state = random_state(5, 0.05)
    contract = Guard(model(), bounds=bounds())
    plan = contract.hover(law, state, model().u_bar)
    assert not law.calls
    np.testing.assert_array_equal(plan, hovering(state).plan)
