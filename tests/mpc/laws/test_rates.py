"""Targets of an inner loop as inputs, thrust and body rates: the model, flights, bounds, fallback and refusals."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from support import advance_nodes, frame, linearise_nodes

from quadsim.assets import vehicle_path
from quadsim.controller import NOT_CONVERGED, Command, Controller, Phase, StepInputs
from quadsim.errors import FlightError, ParameterError
from quadsim.mpc.estimate.disturbance import RampSettings
from quadsim.mpc.estimate.observer import ObserverSettings
from quadsim.mpc.guard.contract import FallbackSettings
from quadsim.mpc.guard.numbers import HoverGain
from quadsim.mpc.laws.nonlinear import Nonlinear, Weights
from quadsim.mpc.laws.parts.builders import build
from quadsim.mpc.laws.parts.nonlinear_mpc import NonlinearMPC
from quadsim.mpc.pilot.indi import INDISettings
from quadsim.mpc.problem.constraints import Constraint, Soft
from quadsim.mpc.problem.model import target_model
from quadsim.mpc.problem.polytope import Polytope
from quadsim.mpc.problem.rigidbody import (
    N_BODY,
    RATE_SCALE,
    Inputs,
    P,
    Q,
    RigidBody,
    V,
    W,
    rigid_body,
    rotation,
    thrust_axis,
)
from quadsim.mpc.space import Avoidance
from quadsim.mpc.tables.commands import TargetBounds
from quadsim.rotation import body_to_euler_rates, euler_to_quaternion, quaternion_to_euler
from quadsim.space import Sphere
from quadsim.state import ANGLE_RATES, ANGLES, N_STATES, POSITIONS, VELOCITIES, Array
from quadsim.vehicle import load_vehicle

VEHICLE = load_vehicle(vehicle_path("hummingbird"))
LAG = (0.02, 0.035, 0.035, 0.1)
"""Time constants of the thrust and of the body rates [s]."""
LAGS = [LAG, (0.0, 0.035, 0.0, 0.1), (0.072, 0.0, 0.01, 0.0), (0.0, 0.0, 0.0, 0.0)]
OTHERS: list[dict[str, Any]] = [
    {},
    {"drag": np.array([0.3, 0.2, 0.1]), "quadratic_drag": np.array([0.08, 0.05, 0.02]), "thrust_scale": 0.8},
    {"acceleration": np.array([0.3, -0.2, 0.5])},
]
"""Other arguments of the model."""


def model_of(step: float = 0.05, lag: tuple[float, ...] = LAG, **others: Any) -> RigidBody:
    return rigid_body(VEHICLE, step, inputs=Inputs.RATES, lag=lag, **others)


def points(count: int = 6) -> tuple[Array, Array]:
    """States (count, 14) at any attitude, and targets as shares (count, 4)."""
    rng = np.random.default_rng(0)
    x = rng.normal(size=(count, 14))
    u = 0.2 * rng.normal(size=(count, 4))
    x[:, Q] /= np.linalg.norm(x[:, Q], axis=1, keepdims=True)
    x[:, N_BODY] = rng.uniform(0.1, 0.9, count)
    u[:, 0] = rng.uniform(0.1, 0.9, count)
    return x, u


# --- the model -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("lag", "substeps", "others"), [*itertools.product(LAGS, (1, 3), OTHERS)])
def test_derivatives_are_those_of_finite_differences(
    lag: tuple[float, ...], substeps: int, others: dict[str, Any]
) -> None:
    model = model_of(0.1, lag, substeps=substeps, **others)
    x, u = points()
    A, B, end = linearise_nodes(model, x, u)
    np.testing.assert_allclose(end, advance_nodes(model, x, u), rtol=1e-12, atol=1e-12)

    h = 1e-5

    def check(column: Array, above: Array, below: Array) -> None:
        expected = (above - below) / (2.0 * h)
        np.testing.assert_allclose(column, expected, rtol=1e-6, atol=1e-6 * np.abs(expected).max())

    for j, d in enumerate(h * np.eye(14)):
        check(A[:, :, j], advance_nodes(model, x + d, u), advance_nodes(model, x - d, u))
    for j, d in enumerate(h * np.eye(4)):
        check(B[:, :, j], advance_nodes(model, x, u + d), advance_nodes(model, x, u - d))


def test_derivatives_in_frames_are_those_of_multiplied_quaternions() -> None:
    """The quaternions of node i are in frame i, those of its end in frame i + 1."""
    model = model_of()
    x, u = points(3)
    frames = np.random.default_rng(1).normal(size=(4, 4))
    frames /= np.linalg.norm(frames, axis=1, keepdims=True)
    A, B, end = linearise_nodes(model, x, u, frames)
    A_plain, B_plain, end_plain = linearise_nodes(model, x, u)
    np.testing.assert_array_equal(end, end_plain)
    for i in range(3):
        before = np.eye(14)
        after = np.eye(14)
        before[Q, Q] = frame(frames[i])
        after[Q, Q] = frame(frames[i + 1])
        np.testing.assert_allclose(A[i], after @ A_plain[i] @ before.T, atol=1e-12)
        np.testing.assert_allclose(B[i], after @ B_plain[i], atol=1e-12)


@pytest.mark.parametrize("step", [1e-3, 0.05, 1.0, 30.0])
@pytest.mark.parametrize("lag", LAGS)
def test_rates_and_thrust_follow_exactly_whatever_the_step(step: float, lag: tuple[float, ...]) -> None:
    """A Runge-Kutta step of more than 2.8 time constants would diverge; without a lag they follow at once."""
    x, u = points()
    end = advance_nodes(model_of(step, lag), x, u)
    remaining = np.zeros(4)
    for i, time_constant in enumerate(lag):
        if time_constant > 0.0:
            remaining[i] = math.exp(-step / time_constant)
    thrust = u[:, 0]
    rates = RATE_SCALE * u[:, 1:]
    np.testing.assert_allclose(end[:, W], rates + remaining[1:] * (x[:, W] - rates))
    np.testing.assert_allclose(end[:, N_BODY], thrust + remaining[0] * (x[:, N_BODY] - thrust))


@pytest.mark.parametrize("others", OTHERS)
def test_it_moves_by_the_equations_of_the_rigid_body_and_four_lags(others: dict[str, Any]) -> None:
    """As a variable-step integrator solves the equations as they are written."""
    x, u = points(1)
    model = model_of(0.05, substeps=50, **others)
    target = model.scale * u[0]

    def slopes(_: float, y: Array) -> Array:
        w, *vector = y[Q]
        omega = y[W]
        thrust = y[N_BODY]
        R = rotation(y[Q])
        air = R.T @ y[V]
        drag = -(model.drag + model.quadratic_drag * np.abs(air)) * air
        force = np.array([0.0, 0.0, model.thrust_scale * thrust]) + drag
        of_quaternion = 0.5 * np.array([-np.dot(vector, omega), *(w * omega + np.cross(vector, omega))])
        of_velocity = R @ force / VEHICLE.mass + model.acceleration - [0.0, 0.0, VEHICLE.gravity]
        of_rates = (target[1:] - omega) / LAG[1:]
        of_thrust = (target[0] - thrust) / LAG[0]
        return np.concatenate([y[V], of_quaternion, of_velocity, of_rates, [of_thrust]])

    start = x[0].copy()
    start[N_BODY] *= model.scale[0]  # in N, in the place of a share
    end = solve_ivp(slopes, (0.0, 0.05), start, rtol=1e-11, atol=1e-12).y[:, -1]
    np.testing.assert_allclose(advance_nodes(model, x, u)[0, :N_BODY], end[:N_BODY], atol=1e-7)


# --- the controller ------------------------------------------------------------------------------------------------

WEIGHTS = Weights(position=20.0, attitude=(1.0, 1.0, 2.0), velocity=1.0, body_rates=0.02, input=0.1, move=0.04)
LEVEL = np.array([VEHICLE.mass * VEHICLE.gravity, 0.0, 0.0, 0.0])
"""The targets of level hover."""
Course = Callable[[float], tuple[float, ...]]


def table(**fields: Any) -> Nonlinear:
    """Nonlinear MPC that commands rates, with other fields."""
    usual = {"horizon": 40, "node": 0.04, "terminal": "lqr", "weights": WEIGHTS}
    return Nonlinear(**{"commands": "rates", "inner_lag": LAG, **usual, **fields})


def at_rest(**plant: Any) -> Array:
    """(14,) hover, with the thrust that the plant needs."""
    x = np.zeros(14)
    x[3] = 1.0
    x[N_BODY] = LEVEL[0] / model_of().scale[0] / plant.get("thrust_scale", 1.0)
    return x


def measured(x: Array) -> Array:
    """The state (12,) of a body x."""
    state = np.zeros(N_STATES)
    state[POSITIONS] = x[P]
    state[VELOCITIES] = x[V]
    state[ANGLES] = quaternion_to_euler(x[Q])
    state[ANGLE_RATES] = body_to_euler_rates(state[ANGLES], x[W])
    return state


def normalised(x: Array) -> Array:
    """A body whose quaternion has length one."""
    x = x.copy()
    x[Q] /= np.linalg.norm(x[Q])
    return x


STEP_TIME = 0.5
FLIGHT_STEP = 5e-3
"""Of the simulation in `fly` [s]."""


def still(_: float) -> tuple[float, ...]:
    """The course of a vehicle that hovers at the origin."""
    return (0.0, 0.0, 0.0, 0.0)


def step_of(*target: float, at: float = STEP_TIME) -> Course:
    """A course that steps from 0 to a target."""

    def course(time: float) -> tuple[float, ...]:
        if time >= at - 1e-9:
            return target
        return still(time)

    return course


def fly(
    controller: Controller, period: float, seconds: float, course: Course, x: Array | None = None, **plant: Any
) -> tuple[Array, list[Command]]:
    """States (K, 14) every 5 ms above an inner loop of exact lags, and the commands."""
    model = model_of(FLIGHT_STEP, **plant)
    if x is None:
        x = at_rest(**plant)
    states = []
    commands = []
    for k in range(round(seconds / period)):
        preview = np.array([course((k + 1 + i) * period) for i in range(controller.horizon)])
        now = StepInputs(time=k * period, attitude=x[Q].copy(), body_rates=x[W].copy())
        command = controller.step(now, measured(x), preview)
        commands.append(command)
        for _ in range(round(period / FLIGHT_STEP)):
            x = normalised(advance_nodes(model, x, command.speeds / model.scale))
            states.append(x)
    return np.array(states), commands


def tilts(states: Array) -> Array:
    """(K,) angles of the thrust axis from the vertical [deg]."""
    return np.degrees(np.arccos(np.clip(thrust_axis(states[:, Q])[:, 2], -1.0, 1.0)))


@pytest.mark.parametrize("axis", [0, 2])
def test_it_follows_a_previewed_step_quickly_with_small_overshoot(axis: int) -> None:
    target = np.zeros(4)
    target[axis] = 1.0
    states, commands = fly(build(table(), VEHICLE, 0.02), 0.02, 2.5, step_of(*target))
    position = states[:, axis]
    rise = FLIGHT_STEP * np.argmax(position > 0.9) - STEP_TIME
    assert rise < 0.3
    assert position.max() < 1.06
    np.testing.assert_allclose(states[-1, P], target[:3], atol=5e-3)
    bounds = TargetBounds().actuators(VEHICLE)
    rows = np.array([command.speeds for command in commands])
    assert np.all((rows >= bounds.u_min) & (rows <= bounds.u_max))
    assert {command.fallback for command in commands} == {0}


@pytest.mark.slow("nonlinear")
@pytest.mark.parametrize(("period", "node", "horizon"), [(0.02, 0.04, 40), (0.05, 0.05, 20)])
@pytest.mark.parametrize(("tilt", "linear"), [(20.0, 200.0), (20.0, 600.0), (30.0, 2000.0)])
def test_a_stiff_soft_tilt_does_not_turn_it_over(
    period: float, node: float, horizon: int, tilt: float, linear: float
) -> None:
    """On an unfiltered step in all directions; single SQP steps alone would turn over some of these flights."""
    soft = Soft(linear=linear, quadratic=10.0)
    made = table(horizon=horizon, node=node, tilt=tilt, soft=soft)
    states, _ = fly(build(made, VEHICLE, period), period, 3.5, step_of(1.0, 1.0, 1.0, math.radians(45.0)))
    assert tilts(states).max() < tilt + 0.5
    np.testing.assert_allclose(states[-1, P], 1.0, atol=0.02)


@pytest.mark.representative("nonlinear")
def test_targets_and_body_rates_hold_their_bounds() -> None:
    bounds = TargetBounds(thrust=(3.5, 8.0), body_rate=(120.0, 90.0, 60.0))
    made = table(target_bounds=bounds, body_rate=100.0, soft=Soft(linear=1e4, quadratic=10.0))
    states, commands = fly(build(made, VEHICLE, 0.02), 0.02, 2.5, step_of(1.0, 1.0, 1.0, math.radians(45.0)))
    rows = np.array([command.speeds for command in commands])
    largest = np.radians([120.0, 90.0, 60.0])
    assert rows[:, 0].min() >= 3.5
    assert rows[:, 0].max() == pytest.approx(8.0)
    assert np.abs(rows[:, 2]).max() == pytest.approx(largest[1])
    assert np.all(np.abs(rows[:, 1:]) <= largest + 1e-12)
    assert np.abs(np.degrees(states[:, W])).max() < 101.0
    sides = made.audited(VEHICLE)
    assert sides["thrust"] == (3.5, 8.0)
    assert [sides[f"body_rate_{axis}"][1] for axis in "xyz"] == [100.0, 90.0, 60.0]
    assert not {"speed", "slew"} & set(sides)


def test_bounds_of_targets_follow_the_vehicle() -> None:
    largest = 4.0 * VEHICLE.thrust_coefficient * VEHICLE.speed_max**2
    least = 0.5 * VEHICLE.mass * VEHICLE.gravity
    bounds = TargetBounds().actuators(VEHICLE)
    np.testing.assert_allclose(bounds.u_min, [least, *np.radians([-300.0, -300.0, -90.0])])
    np.testing.assert_allclose(bounds.u_max, [0.9 * largest, *np.radians([300.0, 300.0, 90.0])])
    assert np.isinf(bounds.delta_max).all()
    np.testing.assert_allclose(bounds.lowest(LEVEL), [least, 0.0, 0.0, 0.0])


def test_grounded_it_turns_nowhere_with_the_least_thrust() -> None:
    made = build(table(), VEHICLE, 0.02)
    least = [TargetBounds().actuators(VEHICLE).u_min[0], 0.0, 0.0, 0.0]
    for controller in (made, made.law):  # type: ignore[attr-defined]  # with and without its fallback contract
        preview = np.zeros((controller.horizon, 4))
        command = controller.step(StepInputs(phase=Phase.LANDED), np.zeros(N_STATES), preview)
        np.testing.assert_allclose(command.speeds, least)


@pytest.mark.slow("nonlinear")
def test_offset_free_it_finds_the_thrust_that_holds_the_height() -> None:
    weak = {"thrust_scale": 0.8}
    coarse = {"horizon": 20, "node": 0.05}
    sagging, _ = fly(build(table(**coarse), VEHICLE, 0.05), 0.05, 3.0, still, **weak)
    made = table(offset_free=ObserverSettings(), **coarse)
    states, commands = fly(build(made, VEHICLE, 0.05), 0.05, 6.0, still, **weak)
    assert sagging[-1, 2] < -0.03
    assert abs(states[-1, 2]) < 1e-3
    assert commands[-1].speeds[0] == pytest.approx(LEVEL[0] / 0.8, rel=1e-3)


@pytest.mark.slow("nonlinear")
@pytest.mark.parametrize(
    ("scaled", "thrust_scale", "acceleration"),
    [
        pytest.param(True, 0.8, 0.0, marks=pytest.mark.representative("nonlinear")),
        (False, 1.0, -0.2 / 0.8 * VEHICLE.gravity),
    ],
)
def test_the_observer_of_forces_finds_the_thrust_that_holds_the_height(
    scaled: bool, thrust_scale: float, acceleration: float
) -> None:
    """As a share of the commanded thrust, or as an acceleration where the share is not estimated."""
    made = table(disturbance=RampSettings(thrust_scale=scaled), horizon=20, node=0.05)
    controller = build(made, VEHICLE, 0.05)
    states, commands = fly(controller, 0.05, 4.0, still, thrust_scale=0.8)
    world = controller.law.struct.world  # type: ignore[attr-defined]
    np.testing.assert_allclose(states[-1, P], 0.0, atol=2e-3)
    assert commands[-1].speeds[0] == pytest.approx(LEVEL[0] / 0.8, rel=2e-3)
    assert world.thrust_scale == pytest.approx(thrust_scale, abs=2e-3)
    assert world.acceleration[2] == pytest.approx(acceleration, abs=0.05)
    np.testing.assert_array_equal(np.array(world.angular), 0.0)
    controller.step(StepInputs(phase=Phase.LANDED), np.zeros(N_STATES), np.zeros((controller.horizon, 4)))
    assert world.thrust_scale == 1.0, "a landing forgets it"


def test_a_controller_of_rotor_speeds_divides_by_the_thrust_scale_too() -> None:
    made = Nonlinear(disturbance=RampSettings(thrust_scale=True), inputs="speed", horizon=20, terminal="lqr")
    controller = build(made, VEHICLE, 0.05)
    model = rigid_body(VEHICLE, 0.05, inputs=Inputs.SPEED, thrust_scale=0.8)
    x = np.zeros(N_BODY)
    x[3] = 1.0
    for k in range(80):
        now = StepInputs(time=0.05 * k, attitude=x[Q].copy(), body_rates=x[W].copy())
        command = controller.step(now, measured(x), np.zeros((20, 4)))
        x = advance_nodes(model, x, command.speeds / VEHICLE.speed_max)
    assert abs(x[2]) < 2e-3
    np.testing.assert_allclose(command.speeds, VEHICLE.hover_speed / math.sqrt(0.8), rtol=1e-3)
    assert controller.law.struct.world.thrust_scale == pytest.approx(0.8, abs=2e-3)  # type: ignore[attr-defined]


def test_it_predicts_its_own_flight() -> None:
    controller = build(table(fallback=FallbackSettings(enabled=False)), VEHICLE, 0.02)
    x = at_rest()
    x[W] = 0.3, -0.2, 0.1
    states, commands = fly(controller, 0.02, 0.02, step_of(0.2, 0.1, 0.3, 0.0, at=0.0), x)
    start = np.zeros((1, N_STATES))
    start[:, ANGLE_RATES] = x[W]
    predicted = controller.predict(start, commands[0].plan[None])[0]
    np.testing.assert_allclose(predicted[0, POSITIONS], states[-1, P], atol=5e-3)
    np.testing.assert_allclose(predicted[0, ANGLES], quaternion_to_euler(states[-1, Q]), atol=1e-4)
    np.testing.assert_allclose(predicted[0, ANGLE_RATES], states[-1, W], atol=5e-3)


def test_it_takes_over_from_a_controller_of_rotors_without_a_jump() -> None:
    """And the other way round: the force is taken over; the torque is none of a controller that commands rates."""
    rotors = build(Nonlinear(offset_free=ObserverSettings()), VEHICLE, 0.02)
    rotors.law.learn(np.array([0.3, 0.0, 0.5, 1.0, 0.0, 0.0]))  # type: ignore[attr-defined]
    rotors.step(StepInputs(), np.zeros(N_STATES), np.zeros((rotors.horizon, 4)))
    rates = build(table(offset_free=ObserverSettings()), VEHICLE, 0.02)
    hover_speeds = np.full(4, VEHICLE.hover_speed)
    for controller, previous, hover in ((rates, rotors, LEVEL), (rotors, rates, hover_speeds)):
        controller.reset(hover)
        controller.adopt(previous)  # type: ignore[attr-defined]
        np.testing.assert_allclose(controller.law.disturbance[:3], [0.3, 0.0, 0.5])  # type: ignore[attr-defined]
        np.testing.assert_allclose(controller.law._acting, hover)  # type: ignore[attr-defined]
    np.testing.assert_array_equal(rates.law.disturbance[3:], 0.0)  # type: ignore[attr-defined]
    command = rates.step(StepInputs(), np.zeros(N_STATES), np.zeros((rates.horizon, 4)))
    assert command.fallback == 0
    assert command.speeds[0] == pytest.approx(LEVEL[0] * (1.0 - 0.5 / VEHICLE.gravity), rel=0.05)


def test_it_goes_around_an_obstacle() -> None:
    ball = Sphere(name="ball", position=(0.0, 0.8, 0.05), radius=0.2)
    made = table(avoidance=Avoidance(soft=Soft()), horizon=20, node=0.05)
    states, commands = fly(build(made, VEHICLE, 0.05, (ball,)), 0.05, 3.5, step_of(0.0, 1.6, 0.0, 0.0))
    clearance = np.linalg.norm(states[:, P] - np.array(ball.position), axis=1) - ball.radius
    assert clearance.min() > VEHICLE.enclosing_radius - 0.01
    np.testing.assert_allclose(states[-1, P], [0.0, 1.6, 0.0], atol=0.02)
    assert {command.fallback for command in commands} == {0}


def test_a_period_that_does_not_converge_is_kept_with_a_plan_that_follows_the_model() -> None:
    """For a diagnosis, which asks whether n SQP iterations make it converge: one does not."""
    controller = build(table(horizon=20, node=0.05, fallback=FallbackSettings(enabled=False)), VEHICLE, 0.05)
    state = np.zeros(N_STATES)
    upside_down = StepInputs(attitude=np.array([0.0, 1.0, 0.0, 0.0]))
    command = controller.step(upside_down, state, np.zeros((controller.horizon, 4)))
    period = controller.infeasible_period  # type: ignore[attr-defined]
    assert command.status == NOT_CONVERGED == period.status
    assert period.converges(1) is False
    law = controller.law  # type: ignore[attr-defined]
    states, inputs = law.stored_plan
    np.testing.assert_allclose(states[1:], advance_nodes(law.model, states[:-1], inputs), atol=1e-12)
    np.testing.assert_array_equal(states[0, Q], upside_down.attitude)


def test_upside_down_it_comes_back_though_its_steps_do_not_converge() -> None:
    """As each period starts from the cheaper rollout: of the last plan, or of geometric control."""
    controller = build(table(horizon=20, node=0.05, fallback=FallbackSettings(enabled=False)), VEHICLE, 0.05)
    model = model_of(0.05)
    x = np.zeros(N_BODY + 1)
    x[4] = 1.0  # half a turn about body x
    x[N_BODY] = 1.0
    unconverged = 0
    for k in range(80):
        now = StepInputs(time=0.05 * k, attitude=x[Q], body_rates=x[W])
        command = controller.step(now, measured(x), np.zeros((controller.horizon, 4)))
        unconverged += command.status == NOT_CONVERGED
        x = normalised(advance_nodes(model, x, command.speeds / model.scale))
    assert unconverged > 0
    assert np.linalg.norm(x[P]) < 0.05
    assert thrust_axis(x[Q])[2] > 0.999


# --- the fallback --------------------------------------------------------------------------------------------------

LEVEL_HOVER = 2
"""The depth of the fallback that returns to level hover."""


def fails(*_: object) -> Command:
    """Stands in for the step of a controller."""
    raise FlightError("no answer", time=0.0)


@pytest.mark.slow("nonlinear")
@pytest.mark.parametrize("period", [0.02, 0.05])
@pytest.mark.parametrize("lag", [LAG, (0.072, 0.072, 0.072, 0.15), (0.0, 0.0, 0.0, 0.0)])
def test_level_hover_returns_from_a_tilt_in_target_space(period: float, lag: tuple[float, ...]) -> None:
    model = target_model(VEHICLE, period, lag)
    hover = HoverGain.of_model(model)
    closed_loop = model.A - model.B @ np.linalg.solve(hover.slope, hover.gain)
    assert np.abs(np.linalg.eigvals(closed_loop)).max() < 1.0
    made = build(table(inner_lag=lag, horizon=1, node=None), VEHICLE, period)
    made.law.step = fails  # type: ignore[attr-defined]
    x = at_rest()
    x[Q] = euler_to_quaternion(np.radians([20.0, -8.0, 0.0]))
    states, commands = fly(made, period, 5.0, still, x, lag=lag)
    assert {command.fallback for command in commands} == {LEVEL_HOVER}
    assert {command.status for command in commands} == {"flight_error"}
    tilt = tilts(states)
    assert tilt.max() < 22.0
    assert tilt[-1] < 1.0
    assert np.linalg.norm(states[-1, V]) < 0.1


@pytest.mark.slow("nonlinear")
@pytest.mark.parametrize("known", [True, False])
def test_level_hover_holds_its_height_by_the_thrust_scale_that_is_estimated(known: bool) -> None:
    """Where it is not known, the vehicle sinks."""
    made = build(table(), VEHICLE, 0.02)
    if known:
        made.law.struct.trim.commands[0] /= 0.7  # type: ignore[attr-defined]  # as if it had been estimated
    made.law.step = fails  # type: ignore[attr-defined]
    states, commands = fly(made, 0.02, 4.0, still, thrust_scale=0.7)
    assert {command.fallback for command in commands} == {LEVEL_HOVER}
    holds_height = bool(np.abs(states[:, 2]).max() < 0.02)
    assert holds_height == known


def test_the_target_model_is_that_of_small_motions() -> None:
    model = target_model(VEHICLE, 0.02, LAG)
    states = 1e-4 * np.random.default_rng(5).normal(size=N_STATES)
    x = at_rest()
    x[P] = states[POSITIONS]
    x[V] = states[VELOCITIES]
    x[Q] = euler_to_quaternion(states[ANGLES])
    x[W] = states[ANGLE_RATES]
    u = LEVEL + np.array([0.0, 1e-4, -2e-4, 3e-4])
    end = advance_nodes(model_of(0.02, substeps=20), x, u / model_of().scale)
    expected = model.A @ states + model.B @ (u - model.u_bar)
    np.testing.assert_allclose(expected[POSITIONS], end[P], atol=1e-9)
    np.testing.assert_allclose(expected[VELOCITIES], end[V], atol=1e-7)
    np.testing.assert_allclose(expected[ANGLE_RATES], end[W], atol=1e-7)


# --- refusals ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("fields", "rule"),
    [
        ({"inputs": "speed"}, "inputs must be absent"),
        ({"rotor_lag": 0.02}, "rotor_lag must be absent"),
        ({"inner_lag": (1e-5, 0.0, 0.0, 0.0)}, "inner_lag must be 0, or at least 0.0001 s"),
        (
            {"polytopes": (Polytope(name="total", of=("speed_1", "speed_2"), rows=((1.0, 1.0),), upper=(300.0,)),)},
            "polytopes must be without rotor speeds",
        ),
    ],
)
def test_it_refuses_fields_of_the_other_space_of_commands(fields: dict[str, Any], rule: str) -> None:
    with pytest.raises(ValueError, match=rule):
        table(**fields)


def test_it_is_not_built_without_the_lag_of_its_inner_loop() -> None:
    with pytest.raises(ParameterError, match="inner_lag"):
        build(table(inner_lag=None), VEHICLE, 0.02)


@pytest.mark.parametrize("thrust", [(5.0, 4.0), (-1.0, 4.0)])
def test_it_refuses_bounds_on_thrust_that_are_reversed_or_negative(thrust: tuple[float, float]) -> None:
    with pytest.raises(ValueError, match="thrust"):
        TargetBounds(thrust=thrust)


@pytest.mark.parametrize("thrust", [(0.0, 1.0), (100.0, 200.0)])
def test_bounds_on_thrust_must_have_the_weight_between_them(thrust: tuple[float, float]) -> None:
    with pytest.raises(ParameterError, match=r"target_bounds\.thrust"):
        TargetBounds(thrust=thrust).actuators(VEHICLE)


@pytest.mark.parametrize("ratio", [1.1, 1.5, 3.5, 14.0])
def test_default_bounds_on_thrust_are_on_both_sides_of_the_weight(ratio: float) -> None:
    """The upper one leaves at least half of what the rotors have beyond the weight, whatever their ratio to it."""
    weight = VEHICLE.mass * VEHICLE.gravity
    speed = math.sqrt(ratio * weight / (4.0 * VEHICLE.thrust_coefficient))
    lower, upper = TargetBounds().audited(replace(VEHICLE, speed_max=speed))["thrust"]
    largest = ratio * weight
    assert lower == 0.5 * weight
    assert 0.5 * (weight + largest) * (1.0 - 1e-9) <= upper < largest


def test_a_thrust_scale_excludes_indi() -> None:
    with pytest.raises(ValueError, match="thrust_scale"):
        Nonlinear(indi=INDISettings(), disturbance=RampSettings(thrust_scale=True))


def test_rows_over_rotor_speeds_are_refused() -> None:
    row = Constraint(name="total", lower=np.zeros(1), upper=np.ones(1), D=np.ones((1, 4)))
    with pytest.raises(ParameterError, match="rotor speeds"):
        NonlinearMPC(VEHICLE, period=0.02, settings=table(), constraints=(row,))
