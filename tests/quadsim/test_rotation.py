"""Unit quaternions, against SciPy."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from quadsim.rotation import (
    Vector,
    conjugate,
    euler_to_quaternion,
    exponential,
    logarithm,
    multiply,
    normalise,
    of_euler,
)

vectors = st.tuples(*[st.floats(-1.8, 1.8)] * 3)
"""Rotation vectors no longer than pi."""


@given(a=vectors, b=vectors)
def test_products_are_those_of_scipy(a: Vector, b: Vector) -> None:
    expected = (Rotation.from_rotvec(a) * Rotation.from_rotvec(b)).as_quat(scalar_first=True)
    found = np.array(multiply(exponential(a), exponential(b)))
    assert abs(found @ expected) == pytest.approx(1.0, abs=1e-14)  # q and -q are one rotation


@given(vector=vectors)
def test_the_logarithm_inverts_the_exponential(vector: Vector) -> None:
    assert logarithm(exponential(vector)) == pytest.approx(vector, rel=1e-12, abs=1e-15)
    w, x, y, z = exponential(vector)
    assert logarithm((-w, -x, -y, -z)) == pytest.approx(vector, rel=1e-12, abs=1e-15)


@pytest.mark.parametrize("angle", [0.0, 1e-12, 0.99e-4, 1.01e-4, 1e-2, 3.0])
def test_small_angles_keep_their_digits(angle: float) -> None:
    assert exponential((angle, 0.0, 0.0)) == pytest.approx((math.cos(angle / 2), math.sin(angle / 2), 0, 0), rel=1e-15)
    assert logarithm(exponential((0.0, angle, 0.0))) == pytest.approx((0.0, angle, 0.0), rel=1e-12)


@given(a=vectors)
def test_a_rotation_and_its_conjugate_cancel(a: Vector) -> None:
    q = exponential(a)
    assert multiply(q, conjugate(q)) == pytest.approx((1.0, 0.0, 0.0, 0.0), abs=1e-15)
    assert normalise((3.0 * q[0], 3.0 * q[1], 3.0 * q[2], 3.0 * q[3])) == pytest.approx(q, abs=1e-15)


@given(euler=st.tuples(*[st.floats(-3.2, 3.2)] * 3))
def test_euler_angles_are_those_of_the_state(euler: Vector) -> None:
    np.testing.assert_allclose(of_euler(*euler), euler_to_quaternion(np.array(euler)), atol=1e-15)


@given(vectors=st.lists(st.tuples(vectors, vectors), min_size=1, max_size=4))
def test_arrays_are_multiplied_as_each_of_their_rows_is(vectors: list[tuple[Vector, Vector]]) -> None:
    pairs = [(exponential(a), conjugate(exponential(b))) for a, b in vectors]
    a, b = (np.array(each) for each in zip(*pairs, strict=True))
    np.testing.assert_array_equal(multiply(a, conjugate(conjugate(b))), [multiply(p, q) for p, q in pairs])
