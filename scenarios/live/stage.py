"""The 3-D scene of a live session: vehicles, thrusts, horizons, reference, path, obstacles, regions and ground.

Handles are viser's; nothing here imports it.  Everything has few triangles: machines without a graphics card draw too.
"""

from __future__ import annotations

from collections import deque
from typing import Any, Final

import mujoco
import numpy as np

from quadsim.flight.audit import SpaceLimit
from quadsim.report.figure import BOUND, LINES, OBSTACLE, REFERENCE
from quadsim.sim.airframe import BODY, compile_model
from quadsim.space import Obstacle, Region
from quadsim.state import Array
from quadsim.vehicle import Vehicle
from scenarios.live.session import Frame, Session

TRAIL: Final = 200  # points of the flown path that stay
_EVERY: Final = 2  # periods from one to the next; every point is sent anew with each
_WIDE: Final = 20.0  # [m] of ground, lines a metre apart
_COURSE: Final = 600  # points of the reference that are drawn
_SHADES: Final = ("#282c34", "#8c96a5")  # of the first vehicle and of the other one
FLAT: Final = {"cast_shadow": False, "receive_shadow": False}


class Stage:
    """A session in viser's scene.

    Attributes:
        unit: the vehicle's arm length [m].
        frames: viser's frame of each vehicle.
        grab: what the mouse takes hold of.
    """

    def __init__(self, scene: Any, session: Session) -> None:
        self._scene, self._session = scene, session
        scene.set_up_direction("+z")
        scene.configure_default_lights(cast_shadow=False)
        scene.configure_environment_map(hdri=None)
        vehicle = session.flights[0].actual
        self.unit, self._weight = vehicle.arm_length, vehicle.mass * vehicle.gravity
        self._rotors, self._coefficient = np.array(vehicle.rotor_positions), vehicle.thrust_coefficient
        self._ground = self._line("/ground", _grid(), "#c8ccd2", 1.0)
        self._ahead = self._line("/reference", _course(session), REFERENCE, 1.5)
        self._hand = self._line("/hand", np.zeros((1, 2, 3)), BOUND, 4.0)
        self._goal = scene.add_icosphere("/goal", 0.25 * self.unit, rgb(REFERENCE), subdivisions=1, **FLAT)
        self.frames, self._arrows, self._horizons, self._paths = [], [], [], []
        for i, flight in enumerate(session.flights):
            name, length = f"/vehicle{i}", flight.loop.controller.horizon
            self.frames.append(scene.add_frame(name, show_axes=False))
            _add_airframe(scene, name, vehicle, _SHADES[i])
            self._arrows.append(self._line(f"{name}/thrust", np.zeros((len(self._rotors), 2, 3)), LINES[1]))
            self._horizons.append(self._line(f"/horizon{i}", np.zeros((length, 2, 3)), LINES[4 if i else 2]))
            self._paths.append(self._line(f"/path{i}", np.zeros((TRAIL, 2, 3)), LINES[4 if i else 0]))
        self.grab = scene.add_icosphere("/vehicle0/grab", 1.6 * self.unit, subdivisions=1, opacity=0.001, **FLAT)
        self._trails = [deque[Array](maxlen=TRAIL + 1) for _ in session.flights]
        self._events = 0  # that have been seen
        self._moving: list[tuple[Obstacle, Any]] = []
        self._regions: list[tuple[SpaceLimit, Any]] = []
        self._add_space()

    def show(self, frame: Frame) -> None:
        """Update the objects that change once per period."""
        for i, (sample, horizon) in enumerate(zip(frame.samples, frame.horizons, strict=True)):
            if sample is None:
                continue
            lengths = 1.2 * self.unit * len(self._rotors) / self._weight * self._coefficient * np.square(sample.rotors)
            tips = self._rotors + np.outer(lengths, [0.0, 0.0, 1.0])
            self._arrows[i].points = np.stack([self._rotors, tips], axis=1).astype(np.float32)
            if frame.k % _EVERY == 0:
                self._trails[i].append(sample.segment.physics[-1, 1:4])
                self._paths[i].points = _segments(np.array(self._trails[i]), TRAIL)
            line = self._horizons[i]
            if horizon is not None:  # of another length than the first controller's, it is thinned
                points = np.linspace(0.0, len(horizon) - 1.0, min(len(horizon), len(line.points) + 1))
                line.points = _segments(horizon[points.round().astype(int)], len(line.points))
            line.visible = horizon is not None
        events = self._session.flights[0].scenario.events
        if any(event.type == "setpoint" for event in events[self._events :]):
            self._ahead.points = _course(self._session)
        self._events = len(events)
        first = frame.samples[0]
        if first is not None:
            at = first.segment.physics[-1, 1:4]
            self._goal.position = first.observation.reference[:3]
            self._ground.position = (*np.round(at[:2]), 0.0)
            self._hand.points = np.array([[at, at + 30.0 * self.unit / self._weight * frame.pull]], np.float32)
        self._hand.visible = bool(frame.pull.any())
        for obstacle, handle in self._moving:
            handle.position = obstacle.positions(np.array([frame.time]))[0]
        for limit, handle in self._regions:
            handle.visible = limit.start <= frame.time <= limit.stop

    def pose(self, frame: Frame, share: float) -> Array:
        """Draw the vehicles at a fraction of the period; return the position of the first (3,) [m]."""
        for sample, handle in zip(frame.samples, self.frames, strict=True):
            if sample is not None:
                physics = sample.segment.physics
                row = physics[min(len(physics) - 1, int(share * len(physics)))]
                handle.position, handle.wxyz = row[1:4], row[4:8]
        return np.asarray(self.frames[0].position)

    def reset(self) -> None:
        """Clear the scene for a new flight."""
        self._events, self._ahead.points = 0, _course(self._session)
        for trail, path in zip(self._trails, self._paths, strict=True):
            trail.clear()
            path.points = np.zeros((TRAIL, 2, 3), np.float32)

    def _line(self, name: str, points: Array, colour: str, thickness: float = 3.0) -> Any:
        points = points.astype(np.float32)
        return self._scene.add_line_segments(name, points, rgb(colour), thickness=thickness, thickness_units="screen")

    def _add_space(self) -> None:
        course = _course(self._session).reshape(-1, 3)
        low, high = course.min(axis=0) - 1.5, course.max(axis=0) + 1.5
        for limit in self._session.limits:
            shape = limit.shape if isinstance(limit, SpaceLimit) else None
            if isinstance(limit, SpaceLimit) and isinstance(shape, Region):
                line = self._line(f"/regions/{limit.name}", shape.edges(low, high), LINES[5], 1.5)
                self._regions.append((limit, line))
            elif isinstance(shape, Obstacle):
                name = f"/obstacles/{shape.name}"
                handle = self._scene.add_frame(name, show_axes=False, position=shape.position)
                for i, solid in enumerate(shape.solids):
                    pose = {"position": solid.centre, "wxyz": solid.quaternion}
                    _add_solid(self._scene, f"{name}/{i}", solid.kind, solid.size, color=rgb(OBSTACLE), **pose)
                if shape.moves:
                    self._moving.append((shape, handle))


def rgb(colour: str) -> tuple[int, int, int]:
    """Return a colour of the palette in viser's format."""
    red, green, blue = bytes.fromhex(colour[1:])
    return red, green, blue


def _add_airframe(scene: Any, name: str, vehicle: Vehicle, shade: str) -> None:
    """The airframe as films show it, rotor discs transparent."""
    model = compile_model(vehicle, visuals=True)
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)  # at the origin, level
    body = model.body(BODY).id
    for geom in range(model.ngeom):
        if model.body_rootid[model.geom_bodyid[geom]] == body and model.geom_group[geom] <= 2:
            kind, turn = mujoco.mjtGeom(model.geom_type[geom]).name, np.empty(4)
            mujoco.mju_mat2Quat(turn, data.geom_xmat[geom])
            look = {"color": rgb(shade), "opacity": 0.35 if "disc" in model.geom(geom).name else None}
            pose = {"position": data.geom_xpos[geom] - data.xpos[body], "wxyz": turn}
            kind = kind.removeprefix("mjGEOM_").lower()
            _add_solid(scene, f"{name}/part{geom}", kind, model.geom_size[geom], **look, **pose)


def _add_solid(scene: Any, name: str, kind: str, size: Any, **look: Any) -> None:
    """MuJoCo's shape of that name and size; a capsule without its caps."""
    a, b, c = map(float, size)
    if kind == "box":
        scene.add_box(name, dimensions=(2.0 * a, 2.0 * b, 2.0 * c), **look, **FLAT)
    elif kind in ("cylinder", "capsule"):
        scene.add_cylinder(name, radius=a, height=2.0 * b, radial_segments=24, **look, **FLAT)
    else:
        scale = (a, b, c) if kind == "ellipsoid" else (a, a, a)
        scene.add_icosphere(name, subdivisions=2 if kind == "sphere" else 1, scale=scale, **look, **FLAT)


def _segments(points: Array, count: int) -> Array:
    """(count, 2, 3) of a line through points, its last one repeated: the number must not change."""
    segments = np.repeat(points[-1][None, None], count, axis=0).repeat(2, axis=1)
    pairs = np.stack([points[:-1], points[1:]], axis=1)[-count:]
    segments[: len(pairs)] = pairs
    return segments.astype(np.float32)


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
    return np.array([*along, *across])
