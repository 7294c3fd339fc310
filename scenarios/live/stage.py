"""What a live session shows in 3-D: vehicles, thrusts, horizons, reference, path, obstacles, regions and ground.

Handles are viser's; nothing here imports it.  Everything has few triangles: machines without a graphics card draw too.
"""

from __future__ import annotations

from collections import deque
from typing import Any, Final

import mujoco
import numpy as np

from quadsim.flight.audit import SpaceLimit
from quadsim.report.palette import BOUND, LINES, OBSTACLE, REFERENCE
from quadsim.sim.airframe import BODY, compile_model
from quadsim.space import Obstacle, Region, Solid
from quadsim.state import Array
from quadsim.vehicle import Vehicle
from scenarios.live.session import Frame, Session

TRAIL: Final = 200  # points of the flown path that stay
_EVERY: Final = 2  # periods from one to the next; every point is sent anew with each
_FACES: Final = 12  # of what is round
_WIDE: Final = 20.0  # [m] of ground, lines a metre apart
_COURSE: Final = 600  # points of the reference that are drawn
_SHADES: Final = ((40, 44, 52), (140, 150, 165))  # of the first vehicle and of the other one


def rgb(colour: str) -> tuple[int, int, int]:
    """A colour of the palette as viser takes it."""
    red, green, blue = (int(colour[i : i + 2], 16) for i in (1, 3, 5))
    return red, green, blue


class Stage:
    """The scene of a session.

    Args:
        scene: viser's.
        session: what is shown.
    """

    def __init__(self, scene: Any, session: Session) -> None:
        import trimesh

        self._scene, self._session = scene, session
        scene.set_up_direction("+z")
        scene.configure_default_lights(cast_shadow=False)
        scene.configure_environment_map(hdri=None)
        vehicle = session.flights[0].actual
        self.unit = vehicle.arm_length
        self._rotors = np.array(vehicle.rotor_positions)
        self._thrust = 1.2 * vehicle.arm_length / (vehicle.mass * vehicle.gravity / len(self._rotors))
        self._coefficient = vehicle.thrust_coefficient
        self._ground = scene.add_line_segments(
            "/ground", points=_grid(), colors=(200, 204, 210), thickness=1.0, thickness_units="screen"
        )
        self.frames, self._arrows, self._horizons, self._paths = [], [], [], []
        for i in range(len(session.flights)):
            name = f"/vehicle{i}"
            self.frames.append(scene.add_frame(name, show_axes=False))
            for part, mesh in enumerate(_airframe(vehicle, _SHADES[i], trimesh)):
                scene.add_mesh_trimesh(f"{name}/part{part}", mesh, cast_shadow=False, receive_shadow=False)
            none, line = np.zeros((len(self._rotors), 2, 3)), {"thickness": 3.0, "thickness_units": "screen"}
            self._arrows.append(scene.add_line_segments(f"{name}/thrust", none, rgb(LINES[1]), **line))
            dark = rgb(LINES[2] if i == 0 else LINES[4])
            length = session.flights[i].loop.controller.horizon
            self._horizons.append(
                (length, scene.add_line_segments(f"/horizon{i}", np.zeros((length, 2, 3)), dark, **line))
            )
            flown = rgb(LINES[0] if i == 0 else LINES[4])
            self._paths.append(scene.add_line_segments(f"/path{i}", np.zeros((TRAIL, 2, 3)), flown, **line))
        self._trails = [deque[Array](maxlen=TRAIL + 1) for _ in session.flights]
        grey, red = rgb(REFERENCE), rgb(BOUND)
        self._ahead = scene.add_line_segments(
            "/reference", _course(session), grey, thickness=1.5, thickness_units="screen"
        )
        self._events = 0  # that have been seen
        self._now = scene.add_icosphere("/goal", radius=0.25 * self.unit, color=grey, subdivisions=1, cast_shadow=False)
        self._hand = scene.add_line_segments("/hand", np.zeros((1, 2, 3)), red, thickness=4.0, thickness_units="screen")
        self.grab = scene.add_icosphere("/vehicle0/grab", radius=1.6 * self.unit, subdivisions=1, opacity=0.001)
        self._moving: list[tuple[Obstacle, Any]] = []
        self._regions: list[tuple[SpaceLimit, Any]] = []
        self._add_space(trimesh)

    def show(self, frame: Frame) -> None:
        """What changes once in a period."""
        for i, (sample, horizon) in enumerate(zip(frame.samples, frame.horizons, strict=True)):
            if sample is None:
                continue
            thrusts = self._coefficient * np.square(sample.rotors)
            tips = self._rotors + np.outer(thrusts, [0.0, 0.0, self._thrust])
            self._arrows[i].points = np.stack([self._rotors, tips], axis=1).astype(np.float32)
            if frame.k % _EVERY == 0:
                self._trails[i].append(sample.segment.physics[-1, 1:4])
                self._paths[i].points = _segments(np.array(self._trails[i]), TRAIL)
            length, line = self._horizons[i]
            if horizon is not None:  # of another length than the first controller's, it is thinned
                points = np.linspace(0.0, len(horizon) - 1.0, min(len(horizon), length + 1)).round().astype(int)
                line.points = _segments(horizon[points], length)
            line.visible = horizon is not None
        events = self._session.flights[0].scenario.events
        if any(event.type == "setpoint" for event in events[self._events :]):
            self._ahead.points = _course(self._session)
        self._events = len(events)
        first = frame.samples[0]
        if first is not None:
            self._now.position = first.observation.reference[:3]
            self._ground.position = (*np.round(first.segment.physics[-1, 1:3]), 0.0)
            at, scale = first.segment.physics[-1, 1:4], 3.0 * self.unit / (0.1 * self._weight)
            self._hand.points = np.array([[at, at + scale * frame.pull]], dtype=np.float32)
        self._hand.visible = bool(frame.pull.any())
        for obstacle, handle in self._moving:
            handle.position = obstacle.positions(np.array([frame.time]))[0]
        for limit, handle in self._regions:
            handle.visible = limit.start <= frame.time <= limit.stop

    def pose(self, frame: Frame, share: float) -> Array:
        """Draw the vehicles at a share of the period; where the first is (3,) [m]."""
        for sample, handle in zip(frame.samples, self.frames, strict=True):
            if sample is not None:
                physics = sample.segment.physics
                row = physics[min(len(physics) - 1, int(share * len(physics)))]
                handle.position, handle.wxyz = row[1:4], row[4:8]
        at: Array = np.asarray(self.frames[0].position)
        return at

    def reset(self) -> None:
        """Nothing has been flown."""
        self._events, self._ahead.points = 0, _course(self._session)
        for trail, path in zip(self._trails, self._paths, strict=True):
            trail.clear()
            path.points = np.zeros((TRAIL, 2, 3), np.float32)

    @property
    def _weight(self) -> float:
        vehicle = self._session.flights[0].actual
        return vehicle.mass * vehicle.gravity

    def _add_space(self, trimesh: Any) -> None:
        limits = [limit for limit in self._session.limits if isinstance(limit, SpaceLimit)]
        course = _course(self._session).reshape(-1, 3)
        low, high = course.min(axis=0) - 1.5, course.max(axis=0) + 1.5
        for limit in limits:
            shape = limit.shape
            if isinstance(shape, Obstacle):
                handle = self._scene.add_frame(f"/obstacles/{shape.name}", show_axes=False, position=shape.position)
                for i, solid in enumerate(shape.solids):
                    mesh = _solid(solid, trimesh)
                    mesh.visual.face_colors = (*rgb(OBSTACLE), 255)
                    name = f"/obstacles/{shape.name}/{i}"
                    self._scene.add_mesh_trimesh(name, mesh, cast_shadow=False, receive_shadow=False)
                if shape.moves:
                    self._moving.append((shape, handle))
            elif isinstance(shape, Region):
                edges = shape.edges(low, high).astype(np.float32)
                look = {"thickness": 1.5, "thickness_units": "screen"}
                line = self._scene.add_line_segments(f"/regions/{limit.name}", edges, rgb(LINES[5]), **look)
                self._regions.append((limit, line))


def _airframe(vehicle: Vehicle, shade: tuple[int, int, int], trimesh: Any) -> list[Any]:
    """The airframe as films show it, one mesh for all that is dark and one for the rotor discs."""
    model = compile_model(vehicle, visuals=True)
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    body = model.body(BODY).id
    origin, turn = data.xpos[body], data.xmat[body].reshape(3, 3)
    solid: list[Any] = []
    discs: list[Any] = []
    for geom in range(model.ngeom):
        if model.body_rootid[model.geom_bodyid[geom]] != body or model.geom_group[geom] > 2:
            continue
        kind = mujoco.mjtGeom(model.geom_type[geom]).name.removeprefix("mjGEOM_").lower()
        mesh = _primitive(kind, model.geom_size[geom], trimesh)
        if mesh is None:
            continue
        pose = np.eye(4)
        pose[:3, :3] = turn.T @ data.geom_xmat[geom].reshape(3, 3)
        pose[:3, 3] = turn.T @ (data.geom_xpos[geom] - origin)
        mesh.apply_transform(pose)
        (discs if "disc" in (model.geom(geom).name or "") else solid).append(mesh)
    parts = []
    for meshes, colour in ((solid, (*shade, 255)), (discs, (*shade, 90))):
        if meshes:
            whole = trimesh.util.concatenate(meshes)
            whole.visual.face_colors = colour
            parts.append(whole)
    return parts


def _solid(solid: Solid, trimesh: Any) -> Any:
    mesh = _primitive(solid.kind, solid.size, trimesh)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = solid.turn, solid.centre
    mesh.apply_transform(pose)
    return mesh


def _primitive(kind: str, size: Any, trimesh: Any) -> Any:
    """A mesh of MuJoCo's shape of that name and size; None for one that is not drawn."""
    make, (a, b, c) = trimesh.creation, (float(each) for each in size)
    match kind:
        case "box":
            return make.box(extents=(2.0 * a, 2.0 * b, 2.0 * c))
        case "sphere":
            return make.icosphere(subdivisions=2, radius=a)
        case "cylinder":
            return make.cylinder(radius=a, height=2.0 * b, sections=2 * _FACES)
        case "capsule":
            return make.capsule(radius=a, height=2.0 * b, count=(_FACES // 2, _FACES // 2))
        case "ellipsoid":
            mesh = make.icosphere(subdivisions=1, radius=1.0)
            mesh.apply_scale((a, b, c))
            return mesh
    return None


def _segments(points: Array, count: int) -> Array:
    """(count, 2, 3) of a line through points, its last one repeated: the number must not change."""
    found = np.repeat(points[-1][None, None], count, axis=0).repeat(2, axis=1)
    pairs = np.stack([points[:-1], points[1:]], axis=1)[-count:]
    found[: len(pairs)] = pairs
    return found.astype(np.float32)


def _course(session: Session) -> Array:
    """The reference over the scenario's whole time, thinned."""
    scenario = session.scenario
    every = max(1, scenario.periods // _COURSE)
    rows = session.flights[0].loop.course.preview(0, scenario.periods)[::every, :3]
    return _segments(np.asarray(rows), _COURSE + 1)


def _grid() -> Array:
    lines = np.arange(-_WIDE / 2.0, _WIDE / 2.0 + 0.5)
    along = [[(x, -_WIDE / 2.0, 0.0), (x, _WIDE / 2.0, 0.0)] for x in lines]
    across = [[(-_WIDE / 2.0, y, 0.0), (_WIDE / 2.0, y, 0.0)] for y in lines]
    return np.array([*along, *across], dtype=np.float32)
