"""The cascade's limits, its anti-windup, and the LQR's limit of tilt."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from quadsim.controller import StepInputs
from quadsim.flight.log import FlightLog
from quadsim.mpc.laws.parts.preview import Target
from quadsim.mpc.laws.pid import Memory, desired_velocity, force_within
from quadsim.state import INDEX, Array, make_state
from quadsim.vehicle import Vehicle

REST = Target(
    position=np.zeros(3), velocity=np.zeros(3), acceleration=np.zeros(3), yaw=0.0, yaw_rate=0.0, yaw_acceleration=0.0
)


FRESH = Memory(velocity_integral=np.zeros(3), rate_integral=np.zeros(3))


def one_period(
    controller: Any, vehicle: Vehicle, state: Array, *, target: Target = REST, memory: Memory = FRESH
) -> tuple[Array, Memory]:
    return controller.fly(memory, state, target, np.zeros(4), np.full(4, vehicle.speed_max))


def test_the_desired_velocity_is_limited_and_keeps_its_direction(vehicle: Vehicle, build: Callable[..., Any]) -> None:
    gain = build("pid", vehicle).gains.bandwidths.position
    far = replace(REST, position=np.array([300.0, 400.0, -100.0]))
    np.testing.assert_allclose(desired_velocity(gain, 5.0, np.zeros(3), far), [3.0, 4.0, -5.0])
    near = replace(REST, position=np.array([1.0, 0.0, 0.0]), velocity=np.array([0.0, 0.5, 0.2]))
    np.testing.assert_allclose(desired_velocity(gain, 5.0, np.zeros(3), near), [gain, 0.5, 0.2])


@pytest.mark.parametrize("force", [(50.0, 0.0, 39.0), (0.0, -8.0, 90.0), (30.0, 40.0, 60.0), (3.0, 4.0, -20.0)])
def test_a_force_is_made_one_that_can_be_given(force: tuple[float, float, float]) -> None:
    given = force_within(np.array(force), weight=39.24, largest=56.0, tilt=math.radians(35.0))
    assert np.linalg.norm(given) <= 56.0 + 1e-9
    assert math.hypot(given[0], given[1]) <= given[2] * math.tan(math.radians(35.0)) + 1e-9
    assert given[2] >= 0.2 * 39.24 - 1e-9
    assert given[0] * force[1] == pytest.approx(given[1] * force[0])


def test_a_force_that_can_be_given_is_left_alone() -> None:
    force = np.array([5.0, -3.0, 40.0])
    np.testing.assert_array_equal(force_within(force, weight=39.24, largest=56.0, tilt=0.6), force)


def test_climbing_leaves_horizontal_acceleration_its_margin() -> None:
    given = force_within(np.array([20.0, 0.0, 500.0]), weight=39.24, largest=60.0, tilt=1.0)
    np.testing.assert_allclose(given, [18.0, 0.0, math.sqrt(60.0**2 - 18.0**2)])


@pytest.mark.parametrize("ratio", [1.001, 1.02, 1.15, 1.4, 2.0, 8.0])
def test_the_cap_of_the_thrust_is_never_below_the_weight(
    ratio: float, vehicle: Vehicle, build: Callable[..., Any]
) -> None:
    """Whatever the horizontal demand: half of the thrust above the weight is left to climb with."""
    weight = vehicle.mass * vehicle.gravity
    weak = replace(vehicle, speed_max=math.sqrt(ratio) * vehicle.hover_speed)
    largest = build("pid", weak)._largest
    assert weight + 0.5 * (ratio - 1.0) * weight <= largest + 1e-9
    assert largest <= ratio * weight + 1e-9
    for sideways in (0.0, 0.1, 1.0, 10.0):
        force = np.array([sideways * weight, 0.0, 20.0 * weight])
        given = force_within(force, weight=weight, largest=largest, tilt=math.radians(60.0))
        assert given[2] >= 0.5 * (weight + largest) - 1e-9
        assert np.linalg.norm(given) <= largest + 1e-9


@pytest.mark.parametrize("limit", [10.0, 25.0])
def test_tilt_stays_near_its_limit_in_flight(
    limit: float, vehicle: Vehicle, build: Callable[..., Any], fly_from: Callable[..., FlightLog]
) -> None:
    for law, beyond in (("pid", 1.1), ("geometric", 1.1), ("lqr", 1.15)):
        controller = build(law, vehicle, tilt=limit)
        log = fly_from(controller, vehicle, make_state(), periods=100, course=np.array([20.0, 0.0, 0.0, 0.0]))
        pitch = np.degrees(log.plant.state[:, INDEX["pitch"]])
        assert 0.8 * limit < pitch.max() < beyond * limit


def test_without_a_limit_of_tilt_the_lqr_is_linear(vehicle: Vehicle, build: Callable[..., Any]) -> None:
    controller = build("lqr", vehicle, tilt=math.inf)
    state = make_state(position=(-1e-3, 0.0, 0.0))
    answers = [controller._limited(scale * state) for scale in (1.0, 1e4)]
    np.testing.assert_allclose(answers[1], 1e4 * answers[0])
    limited = build("lqr", vehicle)
    np.testing.assert_array_equal(limited._limited(state), state)
    assert abs(limited._limited(1e4 * state)[0]) < 5.0


def test_derivatives_act_on_the_measurement_not_on_the_error(vehicle: Vehicle, build: Callable[..., Any]) -> None:
    """A target that jumps is not differentiated; a velocity that rises is held back."""
    controller = build("pid", vehicle)
    state = make_state()
    _, memory = one_period(controller, vehicle, state)
    jumped = replace(REST, position=np.array([0.0, 0.0, 0.1]))
    first = one_period(controller, vehicle, state, target=jumped, memory=memory)[0]
    again = one_period(controller, vehicle, state, target=jumped, memory=replace(memory, velocity=None, rates=None))[0]
    np.testing.assert_array_equal(first, again)
    slower = replace(memory, velocity=np.array([0.0, 0.0, -0.1]))
    held_back = one_period(controller, vehicle, state, memory=slower)[0]
    thrust = vehicle.thrust_coefficient * (held_back**2).sum()
    expected = vehicle.mass * (vehicle.gravity - controller.gains.velocity_derivative * 2.0)
    assert thrust == pytest.approx(expected)


def test_integrals_do_not_wind_up_against_limits(
    vehicle: Vehicle, build: Callable[..., Any], fly_from: Callable[..., FlightLog]
) -> None:
    """After seconds of an error that cannot be mended faster, the vehicle hardly overshoots."""
    controller = build("pid", vehicle)
    log = fly_from(controller, vehicle, make_state(), periods=400, course=np.array([40.0, 0.0, 20.0, 0.0])).control
    assert log.truth[:, INDEX["x"]].max() < 42.0
    assert log.truth[:, INDEX["z"]].max() < 21.5
    np.testing.assert_allclose(log.truth[-1, [0, 4]], [40.0, 20.0], atol=0.1)


def test_a_rate_integral_stops_where_the_mixer_has_no_more(vehicle: Vehicle, build: Callable[..., Any]) -> None:
    controller = build("pid", vehicle)
    state = make_state(euler=(math.radians(170.0), 0.0, 0.0))
    state[INDEX["roll_rate"]] = 60.0
    _, after = one_period(controller, vehicle, state)
    assert after.rate_integral[0] == 0.0
    _, after = one_period(controller, vehicle, make_state(euler=(0.01, 0.0, 0.0)))
    assert after.rate_integral[0] < 0.0


def test_the_lqr_plan_matches_its_models_rollout(vehicle: Vehicle, build: Callable[..., Any]) -> None:
    """Each planned command is the law's at the state predicted for it, for a target at rest."""
    controller = build("lqr", vehicle)
    state = make_state(position=(-0.1, 0.05, 0.02), euler=(0.0, 0.0, 0.3))
    pose = np.tile([0.0, 0.0, 0.0, 0.3], (controller.horizon, 1))
    command = controller.step(StepInputs(), state, pose)
    predicted = controller.predict(state[None], command.plan[None])[0]
    for i in range(controller.horizon - 1):
        again = controller.step(StepInputs(), predicted[i], pose)
        if i == 0:
            assert abs(predicted[i][INDEX["yaw"]] - 0.3) < 1e-9  # so that both see the same frame
        np.testing.assert_allclose(again.speeds, command.plan[i + 1], rtol=1e-6)


def test_a_turning_target_is_turned_with(vehicle: Vehicle, build: Callable[..., Any]) -> None:
    """On the heading and turning as fast, no yaw torque is demanded; tilted, the turn is still about world z."""
    controller = build("pid", vehicle)
    turning = replace(REST, yaw=0.4, yaw_rate=0.8)
    state = make_state(euler=(0.0, 0.0, 0.4))
    state[INDEX["yaw_rate"]] = 0.8
    speeds, _ = one_period(controller, vehicle, state, target=turning)
    np.testing.assert_allclose(speeds, vehicle.hover_speed, rtol=1e-9)
    still, _ = one_period(controller, vehicle, make_state(euler=(0.0, 0.0, 0.4)), target=turning)
    torque = (vehicle.allocation @ still**2)[3]
    assert torque == pytest.approx(vehicle.inertia[2] * controller.gains.bandwidths.yaw_rate * 0.8)
