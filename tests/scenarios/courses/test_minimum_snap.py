"""The smoothest polynomials: closed form, optimality, and an independent solution of the whole KKT system."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.interpolate import PPoly

from quadsim.scenarios.courses.minimum_snap import ACCELERATION_ORDER, SNAP, minimum_snap, smoothest
from quadsim.state import Array

TIMES = np.array([0.0, 1.5, 2.0, 5.0, 6.2])
VALUES = np.array([[0.0, 1.0], [2.0, -1.0], [1.0, 0.5], [4.0, 3.0], [0.0, 0.0]])


def kkt_solution(times: Array, values: Array, order: int) -> Array:
    """(n, 2 order, c) coefficients in t - t_i: min c'Qc, A c = b, with all conditions as rows of A, solved as one."""
    n = times.size - 1
    p = 2 * order
    powers = np.arange(p)

    def row(segment: int, t: float, k: int) -> Array:
        result = np.zeros(n * p)
        result[segment * p : (segment + 1) * p] = [math.perm(i, k) * t ** (i - k) if i >= k else 0.0 for i in powers]
        return result

    Q = np.zeros((n * p, n * p))
    rows = []
    right = []
    for i, T in enumerate(np.diff(times)):
        for a in range(order, p):
            for b in range(order, p):
                degree = a + b - 2 * order + 1
                Q[i * p + a, i * p + b] = math.perm(a, order) * math.perm(b, order) * T**degree / degree
        rows += [row(i, 0.0, 0), row(i, T, 0)]
        right += [values[i], values[i + 1]]
        for k in range(1, order):
            if i == 0:
                rows.append(row(0, 0.0, k))
            rows.append(row(i, T, k) - (row(i + 1, 0.0, k) if i + 1 < n else 0.0))
            right += [0.0 * values[0]] * (2 if i == 0 else 1)
    A = np.array(rows)
    kkt = np.block([[Q, A.T], [A, np.zeros((len(A), len(A)))]])
    solution = np.linalg.solve(kkt, np.vstack([np.zeros((n * p, values.shape[1])), np.array(right)]))
    return solution[: n * p].reshape(n, p, -1)


def test_one_segment_from_rest_to_rest_is_the_known_polynomial() -> None:
    curve = smoothest(np.array([2.0, 5.0]), np.array([[1.0], [3.0]]), SNAP)
    t = np.linspace(2.0, 5.0, 31)
    s = (t - 2.0) / 3.0
    np.testing.assert_allclose(
        curve(t)[:, 0], 1.0 + 2.0 * (35 * s**4 - 84 * s**5 + 70 * s**6 - 20 * s**7), rtol=0, atol=1e-12
    )


@pytest.mark.parametrize("order", [ACCELERATION_ORDER, SNAP])
def test_the_whole_kkt_system_has_the_same_solution(order: int) -> None:
    curve = smoothest(TIMES, VALUES, order)
    expected = PPoly(np.moveaxis(kkt_solution(TIMES, VALUES, order)[:, ::-1], 1, 0), TIMES)
    t = np.linspace(0.0, TIMES[-1], 200)
    for k in range(2 * order):
        size = np.abs(expected(t, k)).max()
        np.testing.assert_allclose(curve(t, k), expected(t, k), rtol=1e-6, atol=1e-8 * size)


def test_time_in_other_units_is_the_same_curve() -> None:
    slow = smoothest(1e4 * TIMES, VALUES, SNAP)
    fast = smoothest(1e-4 * TIMES, VALUES, SNAP)
    s = np.linspace(0.0, TIMES[-1], 50)
    np.testing.assert_allclose(slow(1e4 * s), fast(1e-4 * s), rtol=1e-9, atol=1e-9)


def test_a_path_has_the_snap_of_its_position_and_the_acceleration_of_its_yaw() -> None:
    start = np.array([0.0, 0.0, 1.0, 0.0])
    poses = np.array([[1.0, 2.0, 3.0, 1.0], [4.0, 0.0, 1.0, -1.0]])
    path = minimum_snap(start, poses, [2.0, 5.0])
    assert path.duration == 5.0
    assert path.kinks == ()
    np.testing.assert_allclose(path.pose(np.array([0.0, 2.0, 5.0])), [start, *poses], atol=1e-12)
    t = np.linspace(0.0, 5.0, 20)
    knots = np.array([0.0, 2.0, 5.0])
    np.testing.assert_allclose(path.pose(t)[:, 3], smoothest(knots, np.array([[0.0], [1], [-1]]), 2)(t)[:, 0])
