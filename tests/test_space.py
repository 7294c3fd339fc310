"""Signed distances and normals against brute force, paths, regions and their edges."""

from __future__ import annotations

import itertools
import json
import math

import mujoco
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from quadsim.errors import InputError
from quadsim.space import (
    AnyObstacle,
    Box,
    Capsule,
    Corridor,
    Cylinder,
    Fence,
    Place,
    Solid,
    Solids,
    Sphere,
    Wall,
    footprint,
    shape_from_json,
    shape_to_json,
)
from quadsim.state import Array

STILL = np.zeros(1)
numbers = st.floats(-2.0, 2.0)
lengths = st.floats(0.2, 2.0)
vectors = st.tuples(numbers, numbers, numbers)
shared = {"name": st.just("it"), "position": vectors}
boxes = st.builds(Box, **shared, size=st.tuples(lengths, lengths, lengths), yaw=st.floats(-180.0, 180.0))
walls = st.builds(
    Wall,
    **shared,
    size=st.tuples(lengths, st.floats(1.5, 2.5), st.floats(1.5, 2.5)),
    yaw=st.floats(-180.0, 180.0),
    window=st.tuples(st.floats(0.3, 0.8), st.floats(0.3, 0.8)),
    window_centre=st.tuples(st.floats(-0.3, 0.3), st.floats(-0.3, 0.3)),
)
round_ones = st.one_of(
    st.builds(Sphere, **shared, radius=lengths),
    st.builds(Capsule, **shared, axis=vectors.filter(lambda v: math.hypot(*v) > 0.2), radius=lengths),
    st.builds(Cylinder, **shared, radius=lengths, height=lengths),
)
obstacles: st.SearchStrategy[AnyObstacle] = st.one_of(boxes, round_ones, walls)


def holds(obstacle: AnyObstacle, points: Array) -> np.ndarray:
    """Whether points (K, 3) lie inside, computed without distances."""
    x, y, z = (points - obstacle.position).T
    if isinstance(obstacle, Sphere):
        return x**2 + y**2 + z**2 <= obstacle.radius**2
    if isinstance(obstacle, Cylinder):
        return (x**2 + y**2 <= obstacle.radius**2) & (np.abs(z) <= obstacle.height / 2)
    if isinstance(obstacle, Capsule):
        along = np.linspace(-0.5, 0.5, 4001)[:, None] * np.array(obstacle.axis)
        return np.array(
            [np.linalg.norm(p - along, axis=1).min() <= obstacle.radius for p in points - obstacle.position]
        )
    yaw = math.radians(obstacle.yaw)
    along = math.cos(yaw) * x + math.sin(yaw) * y
    across = math.cos(yaw) * y - math.sin(yaw) * x
    local = np.stack([along, across, z], axis=1)
    inside = (np.abs(local) <= np.array(obstacle.size) / 2).all(axis=1)
    if isinstance(obstacle, Wall):
        inside &= ~(np.abs(local[:, 1:] - obstacle.window_centre) < np.array(obstacle.window) / 2).all(axis=1)
    return inside


@given(obstacle=obstacles, points=st.lists(vectors, min_size=4, max_size=4))
def test_the_nearest_point_is_of_the_surface(obstacle: AnyObstacle, points: list[tuple[float, float, float]]) -> None:
    p = 2.0 * np.array(points)
    distances, normals = obstacle.clearances(np.zeros(len(p)), p)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=2), 1.0, atol=1e-12)
    nearest = distances.argmin(axis=0), np.arange(len(p))
    distance = distances[nearest]
    normal = normals[nearest]
    far = np.abs(distance) > 1e-5
    np.testing.assert_array_equal((distance < 0.0)[far], holds(obstacle, p)[far])
    if isinstance(obstacle, Wall):  # whose solids overlap
        far &= distance > 0.0
    foot = p - distance[:, None] * normal
    assert holds(obstacle, foot - 1e-5 * normal)[far].all()
    assert not holds(obstacle, foot + 1e-5 * normal)[far].any()


@given(obstacle=obstacles, point=vectors, step=vectors)
def test_the_normal_is_the_gradient_and_the_distance_no_steeper(
    obstacle: AnyObstacle, point: tuple[float, ...], step: tuple[float, ...]
) -> None:
    """As it is 0 on the surface, no point of that is nearer."""
    p = 2.0 * np.array([point])
    d = np.array([step])
    before, after = (obstacle.clearance(STILL, q)[0] for q in (p, p + d))
    assert abs(after - before) <= np.linalg.norm(d) + 1e-9
    for solid in obstacle.solids:
        relative = p - obstacle.position
        h = 1e-6
        normal = solid.clearance(relative)[1]
        slope = [
            (solid.clearance(relative + h * e)[0] - solid.clearance(relative - h * e)[0])[0] / (2 * h)
            for e in np.eye(3)
        ]
        if np.linalg.norm(slope) > 1.0 - 1e-6:  # else on a ridge, where it has none
            np.testing.assert_allclose(slope, normal[0], atol=1e-4)


@given(obstacle=obstacles, point=vectors)
def test_distances_are_those_of_mujoco(obstacle: AnyObstacle, point: tuple[float, ...]) -> None:
    spec = mujoco.MjSpec()
    for solid in obstacle.solids:
        kind = getattr(mujoco.mjtGeom, f"mjGEOM_{solid.kind.upper()}")
        spec.worldbody.add_geom(
            type=kind, size=solid.size, pos=np.array(obstacle.position) + solid.centre, quat=solid.quaternion
        )
    ball = spec.worldbody.add_body(pos=2.0 * np.array(point))
    ball.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[0.05, 0.0, 0.0])
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    ours = obstacle.clearances(STILL, 2.0 * np.array([point]))[0][:, 0] - 0.05
    theirs = [mujoco.mj_geomDistance(model, data, i, model.ngeom - 1, 50.0, None) for i in range(model.ngeom - 1)]
    for mine, its in zip(ours, theirs, strict=True):
        if mine > 1e-3:
            assert mine == pytest.approx(its, abs=2e-4)


def test_obstacles_move_as_stated() -> None:
    t = np.array([0.0, 1.0, 2.0, 3.0])
    ball = Sphere(
        name="ball", position=(1.0, 0.0, 2.0), radius=0.1, start=1.0, velocity=(2, 0, 3), acceleration=(0, 0, -9.81)
    )
    np.testing.assert_allclose(
        ball.positions(t), [[1, 0, 2], [1, 0, 2], [3, 0, 5 - 4.905], [5, 0, 8 - 4 * 4.905]], atol=1e-12
    )
    door = Box(
        name="door",
        position=(0.0, 0.0, 0.0),
        size=(1, 1, 1),
        path=(Place(time=2.0, position=(2.0, 0.0, 0.0)), Place(time=3.0, position=(2.0, 4.0, 0.0))),
    )
    np.testing.assert_allclose(door.positions(t), [[0, 0, 0], [1, 0, 0], [2, 0, 0], [2, 4, 0]])
    np.testing.assert_allclose(door.clearance(t, np.tile([2.0, 0.0, 0.0], (4, 1))), [1.5, 0.5, -0.5, 3.5])


@given(points=st.lists(vectors, min_size=3, max_size=9), size=st.tuples(lengths, lengths, lengths), yaw=numbers)
def test_a_region_s_clearance_is_the_ball_s_that_fits(
    points: list[tuple[float, float, float]], size: tuple[float, float, float], yaw: float
) -> None:
    box = Box(name="b", position=(0, 0, 0), size=size, yaw=yaw)
    region = Fence(position=(0, 0, 0), size=size, yaw=yaw)
    p = np.array(points)
    t = np.zeros(len(p))
    solid = box.clearance(np.zeros(len(p)), np.array(points))
    inside = solid < 0.0
    np.testing.assert_allclose(region.clearance(t, p)[inside], -solid[inside], atol=1e-12)
    assert (region.clearance(t, p)[~inside] >= -solid[~inside] - 1e-12).all()
    rows, upper = region.half_spaces
    polytope = Corridor(name="c", rows=tuple(map(tuple, 3.0 * rows)), upper=tuple(3.0 * upper))
    np.testing.assert_allclose(polytope.clearance(t, p), region.clearance(t, p), atol=1e-12)
    assert len(region.edges(np.full(3, -9.0), np.full(3, 9.0))) == 12


@given(obstacle=obstacles)
def test_shapes_survive_json(obstacle: AnyObstacle) -> None:
    corridor = Corridor(name="c", position=(0, 0, 0), size=(1, 2, 3), start=1.0)
    along = Corridor(name="d", position=(0, 0, 0), size=(1, 2, 3), path=(1.0, 2.0))
    for shape in (obstacle, corridor, along, Fence(rows=((1.0, 0.0, 0.0),), upper=(3.0,))):
        assert shape_from_json(json.loads(json.dumps(shape_to_json(shape)))) == shape


def test_a_window_of_the_path_is_one_of_time() -> None:
    # rests at 0, 2 and 4 m
    t = np.arange(8.0)
    x = np.array([0.0, 0.0, 1.0, 2.0, 2.0, 2.0, 4.0, 4.0])
    positions = np.stack([x, -x, np.zeros(8)], axis=1) / math.sqrt(2.0)
    for path, window in {
        (0.0, 1.0): (0.0, 2.0),
        (0.5, 1.5): (1.5, 2.5),
        (2.0, 3.0): (3.0, 5.5),
        (1.0, 2.0): (2.0, 5.0),
        (3.0, 9.0): (5.5, math.inf),
    }.items():
        result = Corridor(name="c", position=(0, 0, 0), size=(1, 1, 1), path=path).timed(t, positions)
        assert (result.start, result.stop) == pytest.approx(window)
        assert result.path is None
    with pytest.raises(InputError, match=r"corridors\.c\.path"):
        Corridor(name="c", position=(0, 0, 0), size=(1, 1, 1), path=(4.5, 5.0)).timed(t, positions)


@given(shapes=st.lists(obstacles, min_size=1, max_size=5))
def test_many_are_measured_as_each_alone(shapes: list[AnyObstacle]) -> None:
    t = np.linspace(0.0, 3.0, 9)
    p = np.random.default_rng(0).normal(scale=2.0, size=(9, 3))
    for result, desired in zip(
        Solids(shapes).clearances(t, p),
        map(np.concatenate, zip(*(each.clearances(t, p) for each in shapes), strict=True)),
        strict=True,
    ):
        np.testing.assert_allclose(result, desired, atol=1e-14)


@given(obstacle=st.one_of(boxes, round_ones))
def test_footprints_are_as_wide_as_the_solid(obstacle: AnyObstacle) -> None:
    for solid, angle in itertools.product(obstacle.solids, np.linspace(0.0, math.pi, 5)):
        way = np.array([math.cos(angle), math.sin(angle), 0.0])
        outline = footprint(solid)
        gap, _ = solid.clearance(1e6 * way[None] + solid.centre)  # from so far away, to the plane that touches it
        reach = ((outline - solid.centre[:2]) @ way[:2]).max()
        assert 1e6 - gap[0] == pytest.approx(reach, abs=2e-2 * max(reach, 0.1))


@given(axis=st.tuples(*[st.floats(-1.0, 1.0)] * 3).filter(lambda axis: np.linalg.norm(axis) > 0.1))
def test_half_turns_about_any_axis_are_those_of_mujoco(axis: tuple[float, float, float]) -> None:
    unit = np.array(axis) / np.linalg.norm(axis)
    turn = 2.0 * np.outer(unit, unit) - np.eye(3)
    again = np.empty(9)
    mujoco.mju_quat2Mat(again, Solid(kind="box", size=(1.0, 1.0, 1.0), centre=np.zeros(3), turn=turn).quaternion)
    np.testing.assert_allclose(again.reshape(3, 3), turn, atol=1e-6)
