"""What all three laws have in common: hover, signs at any heading, refusals, bounds."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from quadsim.controller import Phase, StepInputs
from quadsim.errors import CommandError
from quadsim.mpc.tables.commands import InputBounds
from quadsim.state import INDEX, make_state
from quadsim.vehicle import Vehicle

Build = Callable[..., Any]
HEADINGS = [0.0, 90.0, 180.0, -135.0]

BOUNDS = InputBounds(speed=(0.0, 250.0), slew=(-10.0, 5.0))


def held(controller: Any, pose: Any) -> np.ndarray:
    return np.tile(np.asarray(pose, float), (controller.horizon, 1))


def first_wrench(controller: Any, vehicle: Vehicle, state: np.ndarray, pose: Any) -> np.ndarray:
    """[U, tau_x, tau_y, tau_z] that a fresh controller commands at once."""
    controller.reset(np.full(4, vehicle.hover_speed))
    return vehicle.allocation @ controller.step(StepInputs(), state, held(controller, pose)).speeds ** 2


@pytest.mark.parametrize("yaw", HEADINGS)
def test_at_rest_on_the_reference_the_command_is_hover(law: str, craft: Vehicle, build: Build, yaw: float) -> None:
    psi = math.radians(yaw)
    state = make_state(position=(1.0, -2.0, 3.0), euler=(0.0, 0.0, psi))
    controller = build(law, craft)
    for turns in (-1, 0, 2):  # the plant unwraps yaw, the reference may not
        command = controller.step(StepInputs(), state, held(controller, [1.0, -2.0, 3.0, psi + 2.0 * math.pi * turns]))
        np.testing.assert_allclose(command.speeds, craft.hover_speed, rtol=1e-9)
        assert command.plan.shape == (controller.horizon, 4)
        np.testing.assert_array_equal(command.plan[0], command.speeds)
        np.testing.assert_allclose(
            controller.predict(state[None], command.plan[None])[0], np.tile(state, (controller.horizon, 1)), atol=1e-6
        )


@pytest.mark.parametrize("yaw", HEADINGS)
def test_errors_are_answered_the_right_way_at_any_heading(law: str, craft: Vehicle, build: Build, yaw: float) -> None:
    """A target ahead pitches forward, tau_y > 0; one to the left rolls left, tau_x < 0; up is thrust."""
    psi = math.radians(yaw)
    controller = build(law, craft)
    state = make_state(euler=(0.0, 0.0, psi))
    weight = craft.mass * craft.gravity
    for offset, axis, sign in (((1.0, 0.0), 2, 1.0), ((0.0, 1.0), 1, -1.0)):
        x = 0.2 * (math.cos(psi) * offset[0] - math.sin(psi) * offset[1])
        y = 0.2 * (math.sin(psi) * offset[0] + math.cos(psi) * offset[1])
        wrench = first_wrench(controller, craft, state, [x, y, 0.0, psi])
        assert sign * wrench[axis] > 1e-4 * weight * craft.arm_length
        assert abs(wrench[3 - axis]) < 1e-6 * weight * craft.arm_length
    assert first_wrench(controller, craft, state, [0.0, 0.0, 0.1, psi])[0] > 1.005 * weight
    assert first_wrench(controller, craft, state, [0.0, 0.0, 0.0, psi + 0.1])[3] > 0.0
    assert first_wrench(controller, craft, state, [0.0, 0.0, 0.0, psi + 2.0 * math.pi - 0.1])[3] < 0.0


def test_without_its_heading_frame_the_lqr_pushes_the_wrong_way_round(vehicle: Vehicle, build: Build) -> None:
    state = make_state(euler=(0.0, 0.0, math.pi))
    pose = [-0.2, 0.0, 0.0, math.pi]
    assert first_wrench(build("lqr", vehicle), vehicle, state, pose)[2] > 0.0
    assert first_wrench(build("lqr", vehicle, heading=False), vehicle, state, pose)[2] < 0.0


def test_a_target_that_moves_is_followed_with_its_velocity(law: str, craft: Vehicle, build: Build) -> None:
    """Beside a target and as fast, there is nothing to correct."""
    controller = build(law, craft)
    state = make_state(euler=(0.0, 0.0, 0.5))
    state[[INDEX["vx"], INDEX["vy"], INDEX["vz"]]] = 0.4, -0.3, 0.2
    t = 0.05 * np.arange(1, controller.horizon + 1)
    reference = np.stack([0.4 * t, -0.3 * t, 0.2 * t, np.full_like(t, 0.5)], axis=1)
    command = controller.step(StepInputs(), state, reference)
    np.testing.assert_allclose(command.speeds, craft.hover_speed, rtol=1e-6)


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_a_state_or_reference_that_is_not_finite_is_refused_and_forgotten(
    law: str, vehicle: Vehicle, build: Build, value: float
) -> None:
    controller = build(law, vehicle)
    other = build(law, vehicle)
    state = make_state(position=(0.1, 0.2, 0.3))
    pose = [0.0, 0.0, 0.0, 0.1]
    broken = state.copy()
    broken[INDEX["vx"]] = value
    with pytest.raises(CommandError, match="vx"):
        controller.step(StepInputs(time=1.0), broken, held(controller, pose))
    with pytest.raises(CommandError, match="reference"):
        controller.step(StepInputs(time=1.0), state, held(controller, [value, 0.0, 0.0, 0.0]))
    answers = [one.step(StepInputs(), state, held(one, pose)).speeds for one in (controller, other)]
    np.testing.assert_array_equal(*answers)


@pytest.mark.parametrize("phase", [Phase.LANDED, Phase.CRASHED])
def test_on_the_ground_rotors_are_stopped_as_fast_as_slews_allow(
    law: str, vehicle: Vehicle, build: Build, phase: Phase
) -> None:
    bounds = InputBounds(speed=(20.0, 250.0), slew=(-10.0, 5.0))
    controller = build(law, vehicle, input_bounds=bounds)
    controller.reset(np.array([100.0, 25.0, 20.0, 200.0]))
    command = controller.step(StepInputs(phase=phase), np.full(12, math.nan), held(controller, np.zeros(4)))
    np.testing.assert_array_equal(command.speeds, [90.0, 20.0, 20.0, 190.0])
    assert command.status == str(phase)
    command = controller.step(StepInputs(phase=phase), np.zeros(12), held(controller, np.zeros(4)))
    np.testing.assert_array_equal(command.speeds, [80.0, 20.0, 20.0, 180.0])
    free = build(law, vehicle)
    command = free.step(StepInputs(phase=phase), np.zeros(12), held(free, np.zeros(4)))
    np.testing.assert_array_equal(command.speeds, 0.0)


@pytest.mark.parametrize("law", ["pid", "geometric"])
def test_integrals_wait_for_the_flight(law: str, vehicle: Vehicle, build: Build) -> None:
    """Armed on the ground an error that cannot be mended is not summed; in flight it is."""
    others = {"integral": True} if law == "geometric" else {}
    state = make_state()
    pose = [0.05, 0.0, 0.05, 0.0]
    answers = {}
    for phase in (Phase.ARMED, Phase.FLYING):
        controller = build(law, vehicle, **others)
        answers[phase] = [
            controller.step(StepInputs(phase=phase), state, held(controller, pose)).speeds for _ in range(20)
        ]
    np.testing.assert_allclose(answers[Phase.ARMED][-1], answers[Phase.ARMED][0], rtol=1e-12)
    assert answers[Phase.FLYING][-1].sum() > answers[Phase.FLYING][0].sum() + 0.5


@settings(max_examples=25, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(seed=st.integers(0, 2**32 - 1), size=st.sampled_from([0.1, 1.0, 10.0]))
def test_any_state_gets_a_command_within_speeds_and_slews(
    law: str, vehicle: Vehicle, build: Build, seed: int, size: float
) -> None:
    rng = np.random.default_rng(seed)
    controller = build(law, vehicle, input_bounds=BOUNDS)
    before = rng.uniform(0.0, 250.0, 4)
    controller.reset(before)
    for _ in range(3):
        state = size * rng.normal(size=12)
        pose = size * rng.normal(size=4)
        speeds = controller.step(StepInputs(), state, held(controller, pose)).speeds
        assert np.isfinite(speeds).all()
        assert speeds.min() >= 0.0
        assert speeds.max() <= 250.0
        assert (speeds - before).min() >= -10.0 - 1e-9
        assert (speeds - before).max() <= 5.0 + 1e-9
        before = speeds


@pytest.mark.parametrize("size", [1e2, 1e4, 1e6])
def test_default_bounds_are_the_vehicles(law: str, craft: Vehicle, build: Build, size: float) -> None:
    rng = np.random.default_rng(0)
    controller = build(law, craft)
    extremes = []
    for _ in range(12):
        state = size * rng.normal(size=12)
        pose = size * rng.normal(size=4)
        extremes.append(controller.step(StepInputs(), state, held(controller, pose)).speeds)
    assert np.min(extremes) >= craft.speed_min
    assert np.max(extremes) <= craft.speed_max
    assert np.max(extremes) > 1.1 * craft.hover_speed


def test_slews_count_from_the_command_in_force(law: str, vehicle: Vehicle, build: Build) -> None:
    controller = build(law, vehicle, input_bounds=BOUNDS)
    late = StepInputs(acting=np.full(4, 100.0))
    speeds = controller.step(late, make_state(), held(controller, [0.0, 0.0, 5.0, 0.0])).speeds
    np.testing.assert_allclose(speeds, 105.0)
