"""Circle, helix and figure eight: their shape, their speed, and how they begin and end."""

from __future__ import annotations

import math

import numpy as np
import pytest

from quadsim.scenarios.courses.course import Path, begin
from quadsim.scenarios.courses.loops import Loop, circle, figure_eight, fly_round, ramped
from quadsim.state import Array

CENTRE = np.array([1.0, -2.0, 3.0])
THETA = np.linspace(0.0, 4.0 * math.pi, 801)
LOOPS = {
    "circle": circle(centre=CENTRE, radius=2.0, angle=0.3),
    "clockwise": circle(centre=CENTRE, radius=2.0, angle=0.3, clockwise=True),
    "helix": circle(centre=CENTRE, radius=2.0, climb_per_turn=1.5),
    "eight": figure_eight(centre=CENTRE, half_length=3.0, half_width=1.5, angle=0.7),
    "clockwise eight": figure_eight(centre=CENTRE, half_length=3.0, half_width=1.5, angle=-2.0, clockwise=True),
    "thin eight": figure_eight(centre=CENTRE, half_length=3.0, half_width=0.1),
}


def flown(loop: Loop, *, ramp: float = 2.0, yaw: float = 0.0) -> Path:
    return fly_round(loop, turn_time=10.0, turns=2.0, ramp=ramp, yaw=yaw)


def derivative(values: Array, step: float) -> Array:
    return (values[2:] - values[:-2]) / (2.0 * step)


def test_a_circle_has_its_radius_and_begins_at_its_angle() -> None:
    for name, turn in (("circle", 1.0), ("clockwise", -1.0)):
        position = LOOPS[name].position(THETA) - CENTRE
        np.testing.assert_allclose(np.hypot(position[:, 0], position[:, 1]), 2.0, rtol=1e-14)
        np.testing.assert_array_equal(position[:, 2], 0.0)
        angles = np.unwrap(np.arctan2(position[:, 1], position[:, 0]))
        np.testing.assert_allclose(angles, 0.3 + turn * THETA, atol=1e-12)


def test_a_helix_climbs_by_its_pitch_per_turn() -> None:
    position = LOOPS["helix"].position(np.array([0.0, math.pi, 4.0 * math.pi]))
    np.testing.assert_allclose(position[:, 2] - CENTRE[2], [0.0, 0.75, 3.0])


def test_a_figure_eight_is_the_lemniscate_of_gerono() -> None:
    """With y scaled to b = a / 2, its implicit equation is x^4 = a^2 (x^2 - y^2)."""
    loop = figure_eight(centre=np.zeros(3), half_length=3.0, half_width=1.0)
    x, y, z = loop.position(THETA).T
    y = 1.5 * y
    np.testing.assert_allclose(x**4, 9.0 * (x**2 - y**2), atol=1e-12)
    assert not z.any()
    assert x.max() == pytest.approx(3.0)
    assert (y / 1.5).max() == pytest.approx(1.0, rel=1e-4)
    first = slice(1, 200)  # the half at positive x, counter-clockwise about its middle
    assert np.all(np.diff(np.unwrap(np.arctan2(y[first], x[first] - 1.5))) > 0.0)


def test_the_rate_of_a_ramped_angle_is_the_known_polynomial() -> None:
    rate = 0.7
    ramp = 2.0
    total = 4.0
    h = 1e-4
    t = np.arange(0.0, total / rate + ramp, h)
    result = derivative(ramped(t, rate=rate, total=total, ramp=ramp), h)
    s = np.clip(np.minimum(t, total / rate + ramp - t)[1:-1] / ramp, 0.0, 1.0)
    expected = rate * (35 * s**4 - 84 * s**5 + 70 * s**6 - 20 * s**7)
    np.testing.assert_allclose(result, expected, atol=1e-8)


@pytest.mark.parametrize("ramp", [0.0, 2.0])
def test_two_turns_take_two_turn_times_and_a_ramp_and_end_where_they_began(ramp: float) -> None:
    path = flown(LOOPS["circle"], ramp=ramp)
    assert path.duration == pytest.approx(20.0 + ramp)
    begun, ended = path.pose(np.array([0.0, path.duration]))
    np.testing.assert_allclose(begun, ended, atol=1e-12)
    h = 1e-3
    cruise = np.arange(3.0, 15.0, h)
    speed = np.linalg.norm(derivative(path.pose(cruise)[:, :3], h), axis=1)
    np.testing.assert_allclose(speed, math.tau * 2.0 / 10.0, rtol=1e-6)


@pytest.mark.parametrize("yaw", [0.4, -7.0])
def test_yaw_is_held(yaw: float) -> None:
    course = begin(flown(LOOPS["eight"], yaw=yaw), start=0.0, initial=np.array([*CENTRE, yaw]))
    np.testing.assert_array_equal(course.sample(np.linspace(0.0, 22.0, 500))[:, 3], yaw)
