"""Courses at another size, pace and height: the numbers of every field scale by the unit that it declares."""

from __future__ import annotations

import math
from typing import get_args

import numpy as np
import pytest

from quadsim.flight.audit import Limit
from quadsim.scenarios.assembly import Assembly
from quadsim.scenarios.catalogue import scenario_names
from quadsim.scenarios.courses.ramped import RampedCircle, RampedLemniscate
from quadsim.scenarios.loading import load_scenario
from quadsim.scenarios.scaling import Scale, leading_unit, scaled_limit, scaled_table
from quadsim.scenarios.schema.base import fields_of, is_table
from quadsim.space import AnyObstacle, Capsule, Corridor, Fence, Sphere

SCALE = Scale(length=0.4, time=1.7, lift=0.3)
AXES = np.array([0.4, 0.4, 0.4, 1.0])
RAISED = np.array([0.0, 0.0, 0.3, 0.0])


@pytest.mark.parametrize("name", scenario_names())
def test_a_scaled_course_is_the_course_scaled(name: str) -> None:
    scenario = load_scenario(name)
    assembly = Assembly(scenario)
    course = assembly.course
    scaled = scaled_table(scenario.reference, SCALE).build(AXES * assembly.initial_pose + RAISED, 9.81)
    until = min(course.end, scenario.duration)
    t = np.linspace(0.0, until, 500)[1:-1] + 1e-4
    expected = AXES * course.sample(t) + RAISED
    poses = scaled.sample(1.7 * t)
    columns = slice(0, 3) if course.free_heading else slice(0, 4)  # a free heading depends on gravity, too
    step = 0.0
    if isinstance(scenario.reference, RampedCircle | RampedLemniscate):  # each of its 5 phases has whole steps
        step = 5 * 0.4 * scenario.reference.speed * scenario.reference.sampling
    np.testing.assert_allclose(poses[:, columns], expected[:, columns], atol=1e-4 + step)
    assert scaled.end == pytest.approx(1.7 * course.end, abs=0.2)


def test_every_number_of_a_course_and_of_space_has_a_unit_that_scales() -> None:
    kinds = [*get_args(AnyObstacle), Corridor, Fence]
    kinds += [type(load_scenario(name).reference) for name in scenario_names()]
    seen = set()
    for kind in kinds:
        for name, field in fields_of(kind).items():
            if is_table(field.annotation) or name in {"type", "name", "points", "turns", "path", "x", "y", "z"}:
                continue
            unit = leading_unit(field.description)
            Scale(length=2.0, time=3.0).number(1.0, unit)
            seen.add(unit)
    assert seen >= {"m", "s", "m/s", "m/s^2", "deg/s", "deg"}


def test_units_scale_as_what_they_measure() -> None:
    scale = Scale(length=2.0, time=4.0)
    assert scale.number(3.0, "m") == 6.0
    assert scale.number(3.0, "s") == 12.0
    assert scale.number(3.0, "m/s") == 1.5
    assert scale.number(3.0, "m/s^2") == 0.375
    assert scale.number(3.0, "deg/s") == 0.75
    assert scale.number(3.0, "deg") == 3.0
    with pytest.raises(KeyError):
        scale.number(3.0, "N")


def test_obstacles_and_regions_keep_their_clearances_in_proportion() -> None:
    ball = Sphere(name="ball", position=(1.0, 2.0, 3.0), radius=0.5, start=1.0, velocity=(1.0, 0.0, -2.0))
    rod = Capsule(name="rod", position=(0.0, 1.0, 2.0), axis=(1.0, 0.0, 1.0), radius=0.2)
    half_spaces = Fence(rows=((0.0, 0.0, 1.0), (1.0, 0.0, -2.0)), upper=(4.0, 1.0))
    rng = np.random.default_rng(5)
    points = rng.uniform(-3.0, 5.0, (50, 3))
    t = rng.uniform(0.0, 4.0, 50)
    for shape in (ball, rod, half_spaces):
        clearance = scaled_table(shape, SCALE).clearance(1.7 * t, 0.4 * points + RAISED[:3])
        np.testing.assert_allclose(clearance, 0.4 * shape.clearance(t, points), atol=1e-5)


def test_a_limit_keeps_its_window_in_proportion_and_has_the_tolerances_of_its_new_bounds() -> None:
    limit = Limit(name="low", signal="z", lower=0.5, tolerance=0.2, start=2.0, stop=3.0)
    scaled = scaled_limit(limit, SCALE)
    assert (scaled.lower, scaled.upper, scaled.start, scaled.stop) == (0.5, math.inf, 3.4, 5.1)
    assert scaled.tolerances == (pytest.approx(0.005), pytest.approx(0.001))
    sinking = scaled_limit(Limit(name="descent", signal="vz", lower=-0.5), SCALE)
    assert sinking.lower == pytest.approx(-0.5 * 0.4 / 1.7, rel=1e-5)
    assert scaled_limit(Limit(name="tilt", signal="tilt", upper=30.0), SCALE).upper == 30.0
