"""The 12-state: order, units and attitude kinematics, against SciPy and finite differences."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from quadsim.rotation import (
    body_rates_of,
    body_to_euler_rates,
    body_to_world,
    euler_to_body_rates,
    euler_to_quaternion,
    quaternion_to_euler,
)
from quadsim.sim.physics import physics_to_state
from quadsim.state import (
    EULER_RATE,
    INDEX,
    REFERENCE_NAMES,
    REFERENCE_STATES,
    STATE_NAMES,
    STATE_UNITS,
    Array,
    make_state,
)


def attitudes(largest_pitch: float) -> st.SearchStrategy[Array]:
    """Roll, pitch, yaw [rad] short of the ends of their ranges."""
    turn = st.floats(-3.14, 3.14)
    return st.tuples(turn, st.floats(-largest_pitch, largest_pitch), turn).map(np.array)


rates = st.tuples(*[st.floats(-10.0, 10.0)] * 3).map(np.array)


def scipy_rotation(euler: Array) -> Rotation:
    roll, pitch, yaw = euler
    return Rotation.from_euler("ZYX", [yaw, pitch, roll])


def test_the_state_is_that_of_the_paper() -> None:
    assert " ".join(STATE_NAMES) == "x vx y vy z vz roll roll_rate pitch pitch_rate yaw yaw_rate"
    assert STATE_UNITS == ("m", "m/s") * 3 + ("rad", "rad/s") * 3
    assert [STATE_NAMES[i] for i in REFERENCE_STATES] == list(REFERENCE_NAMES)
    assert {name: STATE_NAMES.index(name) for name in STATE_NAMES} == INDEX


@given(euler=attitudes(1.57))
def test_euler_angles_and_rotations_are_those_of_scipy(euler: Array) -> None:
    expected = scipy_rotation(euler)
    np.testing.assert_allclose(body_to_world(euler), expected.as_matrix(), atol=1e-14)
    x, y, z, w = expected.as_quat()
    quaternion = euler_to_quaternion(euler)
    assert abs(quaternion @ [w, x, y, z]) == pytest.approx(1.0, abs=1e-14)  # q and -q are one rotation


@given(euler=attitudes(1.5))
def test_euler_angles_come_back_from_the_quaternion(euler: Array) -> None:
    np.testing.assert_allclose(quaternion_to_euler(euler_to_quaternion(euler)), euler, atol=1e-12)
    np.testing.assert_allclose(quaternion_to_euler(-euler_to_quaternion(euler)), euler, atol=1e-12)


@pytest.mark.parametrize("pitch", [90.0, -90.0])
def test_straight_up_and_down_give_a_pitch_and_no_nan(pitch: float) -> None:
    euler = quaternion_to_euler(euler_to_quaternion(np.radians([0.0, pitch, 0.0])))
    assert np.degrees(euler[1]) == pytest.approx(pitch, abs=1e-5)
    assert np.all(np.isfinite(euler))


@given(euler=attitudes(1.5), body=rates)
def test_rates_come_back(euler: Array, body: Array) -> None:
    back = euler_to_body_rates(euler, body_to_euler_rates(euler, body))
    np.testing.assert_allclose(back, body, atol=1e-10)
    state = make_state(euler=(euler[0], euler[1], euler[2]))
    state[list(EULER_RATE)] = body_to_euler_rates(euler, body)
    np.testing.assert_allclose(body_rates_of(state.tolist()), back, rtol=1e-14, atol=1e-14)


@given(euler=attitudes(1.0), body=rates)
def test_euler_rates_are_the_slopes_of_the_angles(euler: Array, body: Array) -> None:
    """Turn by +-dt about the body rates and take the difference."""
    dt = 1e-5
    rotation = scipy_rotation(euler)

    def angles(duration: float) -> Array:
        x, y, z, w = (rotation * Rotation.from_rotvec(body * duration)).as_quat()
        return quaternion_to_euler(np.array([w, x, y, z]))

    difference = angles(dt) - angles(-dt)
    slope = (difference - 2.0 * np.pi * np.round(difference / (2.0 * np.pi))) / (2.0 * dt)
    np.testing.assert_allclose(body_to_euler_rates(euler, body), slope, rtol=1e-4, atol=1e-4)


def test_leading_dimensions_are_preserved() -> None:
    euler = np.random.default_rng(0).uniform(-1.0, 1.0, (4, 5, 3))
    assert body_to_world(euler).shape == (4, 5, 3, 3)
    assert euler_to_quaternion(euler).shape == (4, 5, 4)
    np.testing.assert_allclose(quaternion_to_euler(euler_to_quaternion(euler)), euler)
    for row in np.ndindex(4, 5):
        np.testing.assert_array_equal(body_to_world(euler)[row], body_to_world(euler[row]))
        np.testing.assert_array_equal(
            body_to_euler_rates(euler, euler)[row], body_to_euler_rates(euler[row], euler[row])
        )


def test_yaw_is_unwrapped_along_a_flight() -> None:
    yaw = np.linspace(0.0, 6.0 * np.pi, 200)
    physics = np.zeros((200, 14))
    physics[:, 4:8] = euler_to_quaternion(np.stack([0.0 * yaw, 0.0 * yaw, yaw], axis=1))
    np.testing.assert_allclose(physics_to_state(physics)[:, INDEX["yaw"]], yaw, atol=1e-9)
