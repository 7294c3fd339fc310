"""Attitudes: Euler angles, their rates and unit quaternions, against SciPy and finite differences."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from quadsim.rotation import (
    Vector3,
    body_rates_of,
    body_to_euler_rates,
    body_to_world,
    conjugate,
    cross,
    euler_to_body_rates,
    euler_to_quaternion,
    exponential,
    logarithm,
    multiply,
    normalise,
    quaternion_to_euler,
)
from quadsim.sim.physics import physics_to_state
from quadsim.state import EULER_RATE, INDEX, REFERENCE_NAMES, REFERENCE_STATES, STATE_NAMES, Array, make_state


def attitudes(largest_pitch: float) -> st.SearchStrategy[Array]:
    """Roll, pitch, yaw [rad] short of the ends of their ranges."""
    turn = st.floats(-3.14, 3.14)
    return st.tuples(turn, st.floats(-largest_pitch, largest_pitch), turn).map(np.array)


rates = st.tuples(*[st.floats(-10.0, 10.0)] * 3).map(np.array)
vectors = st.tuples(*[st.floats(-1.8, 1.8)] * 3)
"""Rotation vectors no longer than pi."""


def test_the_state_is_that_of_the_paper() -> None:
    assert " ".join(STATE_NAMES) == "x vx y vy z vz roll roll_rate pitch pitch_rate yaw yaw_rate"
    assert [STATE_NAMES[i] for i in REFERENCE_STATES] == list(REFERENCE_NAMES)
    assert {name: STATE_NAMES.index(name) for name in STATE_NAMES} == INDEX


@given(euler=attitudes(1.57))
def test_euler_angles_and_rotations_are_those_of_scipy(euler: Array) -> None:
    expected = Rotation.from_euler("ZYX", euler[::-1])
    np.testing.assert_allclose(body_to_world(euler), expected.as_matrix(), atol=1e-14)
    quaternion = euler_to_quaternion(euler)
    assert abs(quaternion @ expected.as_quat(scalar_first=True)) == pytest.approx(1.0, abs=1e-14)  # q or -q


@given(euler=attitudes(1.5), body=rates)
def test_euler_angles_and_rates_come_back(euler: Array, body: Array) -> None:
    for sign in (1.0, -1.0):
        np.testing.assert_allclose(quaternion_to_euler(sign * euler_to_quaternion(euler)), euler, atol=1e-12)
    back = euler_to_body_rates(euler, body_to_euler_rates(euler, body))
    np.testing.assert_allclose(back, body, atol=1e-10)
    state = make_state(euler=(euler[0], euler[1], euler[2]))
    state[list(EULER_RATE)] = body_to_euler_rates(euler, body)
    np.testing.assert_allclose(body_rates_of(state.tolist()), back, rtol=1e-14, atol=1e-14)


@pytest.mark.parametrize("pitch", [90.0, -90.0])
def test_straight_up_and_down_give_a_pitch_and_no_nan(pitch: float) -> None:
    euler = quaternion_to_euler(euler_to_quaternion(np.radians([0.0, pitch, 0.0])))
    assert np.degrees(euler[1]) == pytest.approx(pitch, abs=1e-5)
    assert np.all(np.isfinite(euler))


@given(euler=attitudes(1.0), body=rates)
def test_euler_rates_are_the_slopes_of_the_angles(euler: Array, body: Array) -> None:
    """Turn by +-dt about the body rates and take the difference."""
    dt = 1e-5
    rotation = Rotation.from_euler("ZYX", euler[::-1])
    ahead, behind = (
        quaternion_to_euler((rotation * Rotation.from_rotvec(sign * dt * body)).as_quat(scalar_first=True))
        for sign in (1.0, -1.0)
    )
    difference = ahead - behind
    slope = (difference - 2.0 * np.pi * np.round(difference / (2.0 * np.pi))) / (2.0 * dt)
    np.testing.assert_allclose(body_to_euler_rates(euler, body), slope, rtol=1e-4, atol=1e-4)


def test_leading_dimensions_are_preserved() -> None:
    euler = np.random.default_rng(0).uniform(-1.0, 1.0, (4, 5, 3))
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


@given(a=vectors, b=vectors)
def test_products_are_those_of_scipy(a: Vector3, b: Vector3) -> None:
    expected = (Rotation.from_rotvec(a) * Rotation.from_rotvec(b)).as_quat(scalar_first=True)
    result = np.array(multiply(exponential(a), exponential(b)))
    assert abs(result @ expected) == pytest.approx(1.0, abs=1e-14)


@given(vector=vectors)
def test_the_logarithm_inverts_the_exponential(vector: Vector3) -> None:
    assert logarithm(exponential(vector)) == pytest.approx(vector, rel=1e-12, abs=1e-15)
    w, x, y, z = exponential(vector)
    assert logarithm((-w, -x, -y, -z)) == pytest.approx(vector, rel=1e-12, abs=1e-15)


@pytest.mark.parametrize("angle", [0.0, 1e-12, 0.99e-4, 1.01e-4, 1e-2, 3.0])
def test_small_angles_keep_their_digits(angle: float) -> None:
    assert exponential((angle, 0.0, 0.0)) == pytest.approx((math.cos(angle / 2), math.sin(angle / 2), 0, 0), rel=1e-15)
    assert logarithm(exponential((0.0, angle, 0.0))) == pytest.approx((0.0, angle, 0.0), rel=1e-12)


@given(a=vectors)
def test_a_rotation_and_its_conjugate_cancel(a: Vector3) -> None:
    q = exponential(a)
    assert multiply(q, conjugate(q)) == pytest.approx((1.0, 0.0, 0.0, 0.0), abs=1e-15)
    assert normalise((3.0 * q[0], 3.0 * q[1], 3.0 * q[2], 3.0 * q[3])) == pytest.approx(q, abs=1e-15)


def test_cross_products_are_numpy_s() -> None:
    a, b = np.random.default_rng(0).standard_normal((2, 5, 4, 3))
    np.testing.assert_array_equal(cross(a, b), np.cross(a, b))
    np.testing.assert_array_equal(cross(a[0, 0], b[0, 0]), np.cross(a[0, 0], b[0, 0]))


@given(vectors=st.lists(st.tuples(vectors, vectors), min_size=1, max_size=4))
def test_arrays_are_multiplied_as_each_of_their_rows_is(vectors: list[tuple[Vector3, Vector3]]) -> None:
    pairs = [(exponential(a), conjugate(exponential(b))) for a, b in vectors]
    a, b = (np.array(each) for each in zip(*pairs, strict=True))
    np.testing.assert_array_equal(multiply(a, conjugate(conjugate(b))), [multiply(p, q) for p, q in pairs])
