"""The 3-D scene of a live session, as films show it, and its recording.

Everything has few triangles: machines without a graphics card draw too.  Handles are viser's.
"""

from __future__ import annotations

import math
import threading
import time as clock
from collections import deque
from dataclasses import dataclass
from itertools import combinations
from types import SimpleNamespace
from typing import Any, Final

import mujoco
import numpy as np
import viser
from viser.infra._infra import WebsockMessageHandler

from quadsim.features.live import look
from quadsim.features.live.session import Frame, Session
from quadsim.flight.audit import SpaceLimit
from quadsim.mpc.laws import law_name
from quadsim.palette import COLOUR, Rgb, line_colour, rgb
from quadsim.report.film.frames import thin
from quadsim.sim.airframe import FLOOR, compile_model
from quadsim.sim.physics import Period
from quadsim.space import Obstacle, Region
from quadsim.state import Array

VIEW: Final = np.array([-5.5, -8.0, 4.5])  # from the first vehicle to a camera at the start, in arm lengths
FLAT: Final = {"cast_shadow": False, "receive_shadow": False}
FIELD: Final = math.radians(45.0)  # of view, as in films
TRAIL: Final = 200  # points of the flown path that stay
_PATH_PERIODS: Final = 2  # from one point of the flown path to the next; every point is sent anew with each
_COURSE_SEGMENTS: Final = 3000  # of the reference that are drawn
_COURSE_TOLERANCE: Final = 0.03  # how far they may be from it, in arm lengths
_RECORDED: Final = 180.0  # [s] of the flight that a recording has at most
_PAUSE: Final = 5e-4  # [s] after each period that is recorded, for the thread that flies
_ROOT: Final = "/flight"  # what moves as one in a recording
_SHADOW: Final = (84, 92, 101)
_TINTED: Final = ("front", "disc", "disc_front")  # materials in a vehicle's colour where there are two


@dataclass(frozen=True, kw_only=True)
class _Vehicle:
    """The handles of a vehicle, and of what is drawn of its flight."""

    colour: Rgb
    frame: Any  # what moves with it
    arrows: Any  # thrusts
    horizon: Any  # the predicted path
    path: Any  # the flown one
    trail: deque[Array]  # its points
    shadow: Any
    plumb: Any  # line from the shadow up to the vehicle


class Stage:
    """A session in viser's scene.

    Attributes:
        unit: the vehicle's arm length [m].
        grab: what the mouse takes hold of.
        mark: a spot on the floor.
        ground: height of the floor, below the whole flight [m].
    """

    def __init__(self, scene: Any, session: Session) -> None:
        self._scene = scene
        self._session = session
        self._root = _lit_root(scene)
        vehicle = session.flights[0].actual
        self.unit = vehicle.longest_arm
        self._weight = vehicle.mass * vehicle.gravity
        self._rotors = vehicle.hubs
        self._thrusts = vehicle.thrusts
        model = compile_model(vehicle, visuals=True)
        self._drop = float(model.geom(FLOOR).pos[2])  # from a vehicle to the floor that it stands on [m]
        self._square = look.square_side(self.unit)
        self._floor = scene.add_glb(f"{_ROOT}/floor", look.floor(self._square))
        target = rgb(COLOUR.reference)
        self._ahead = self._line("reference", _course(session), target, 2.0)
        self._goal = self._line("goal", _octahedron(0.5 * self.unit), target, 2.5)
        self._hand = self._line("hand", np.zeros((1, 2, 3)), rgb(COLOUR.disturbance), 5.0)
        self._vehicles = [self._add_vehicle(i, model) for i in range(len(session.flights))]
        self.mark = self._add("mark", look.disc(0.5 * self.unit), target, visible=False)
        self.grab = self._add("vehicle0/grab", look.grip(1.3 * self.unit), _SHADOW, opacity=0.001)
        self._shown = deque[Frame](maxlen=round(_RECORDED / session.period))
        self._moving: list[tuple[Obstacle, Any]] = []
        self._regions: list[tuple[SpaceLimit, Any]] = []
        self._add_obstacles_and_regions()
        self.ground = 0.0
        self._events = 0  # those of the flight that have been seen
        self.reset()

    def _add_vehicle(self, i: int, model: mujoco.MjModel) -> _Vehicle:
        """Add a vehicle; of two each has its colour, and its controller's name on a pole."""
        name = f"vehicle{i}"
        flight = self._session.flights[i]
        is_alone = len(self._session.flights) == 1
        colour = rgb(line_colour(i))
        predicted = colour
        if is_alone:
            predicted = rgb(COLOUR.predicted)
        frame = self._scene.add_frame(f"{_ROOT}/{name}", show_axes=False)
        self._add_airframe(name, model, tint=None if is_alone else colour)
        widths = {"shaft_radius": 0.04 * self.unit, "head_radius": 0.09 * self.unit, "head_length": 0.2 * self.unit}
        points = np.zeros((len(self._rotors), 2, 3))
        arrows = self._scene.add_arrows(f"{_ROOT}/{name}/thrust", points, colour, **widths)
        length = flight.loop.controller.horizon
        handles = _Vehicle(
            colour=colour,
            frame=frame,
            arrows=arrows,
            horizon=self._line(f"horizon{i}", np.zeros((length, 2, 3)), predicted),
            path=self._line(f"path{i}", np.zeros((TRAIL, 2, 3)), colour),
            trail=deque(maxlen=TRAIL + 1),
            shadow=self._add(f"shadow{i}", look.disc(0.9 * self.unit), _SHADOW),
            plumb=self._line(f"shadow{i}/plumb", np.array([[(0.0, 0.0, 0.0), (0.0, 0.0, 1.0)]]), _SHADOW, 1.0),
        )
        if not is_alone:
            title = law_name(flight.loop.controller.name)
            top = (0.0, 0.0, (1.4 + 0.5 * i) * self.unit)
            self._scene.add_label(f"{_ROOT}/{name}/label", title, position=top, anchor="bottom-center")
            self._line(f"{name}/pole", np.array([[(0.0, 0.0, 0.0), top]]), colour, 1.5)
        return handles

    def _add_airframe(self, name: str, model: mujoco.MjModel, tint: tuple[float, ...] | None) -> None:
        """Add the meshes of a vehicle, some of them in its own colour if it has a tint."""
        for material, (*paint, alpha), mesh in look.airframe(model):
            colour = tuple(paint)
            if tint is not None and material in _TINTED:
                colour = tint
            opacity = None
            if alpha != 1.0:
                opacity = alpha
            self._add(f"{name}/{material}", mesh, colour, opacity=opacity)

    def _add_obstacles_and_regions(self) -> None:
        """Add what the flight's limits keep the vehicle out of, or within; regions are cut off around the course."""
        course = _course(self._session).reshape(-1, 3)
        low = course.min(axis=0) - 1.5
        high = course.max(axis=0) + 1.5
        for limit in self._session.limits:
            match limit:
                case SpaceLimit(shape=Region() as region):
                    line = self._line(f"regions/{limit.name}", region.edges(low, high), rgb(COLOUR.bound), 1.5)
                    self._regions.append((limit, line))
                case SpaceLimit(shape=Obstacle() as obstacle):
                    body = self._add(f"obstacles/{obstacle.name}", look.obstacle(obstacle), rgb(COLOUR.obstacle))
                    body.position = obstacle.position
                    if obstacle.moves:
                        self._moving.append((obstacle, body))

    def show(self, frame: Frame) -> None:
        """Update the objects that change once per period."""
        self._shown.append(frame)
        for vehicle, sample, horizon in zip(self._vehicles, frame.samples, frame.horizons, strict=True):
            if sample is None:
                continue
            self._show_thrusts(vehicle, sample.rotors, frame.health)
            if frame.k % _PATH_PERIODS == 0:
                vehicle.trail.append(sample.position[-1])
                vehicle.path.points = _segments(np.array(vehicle.trail), TRAIL)
            line = vehicle.horizon
            if horizon is not None:  # of another length than the first controller's, it is thinned
                points = np.linspace(0.0, len(horizon) - 1.0, min(len(horizon), len(line.points) + 1))
                line.points = _segments(horizon[points.round().astype(int)], len(line.points))
            line.visible = horizon is not None
        events = self._session.flights[0].scenario.events
        if any(event.type == "setpoint" for event in events[self._events :]):
            self._ahead.points = _course(self._session)
        self._events = len(events)
        if frame.samples[0] is not None:
            self._show_surroundings(frame.samples[0], frame.pull)
        self._hand.visible = bool(frame.pull.any())
        for obstacle, body in self._moving:
            body.position = obstacle.positions(np.array([frame.time]))[0]
        for limit, line in self._regions:
            line.visible = limit.start <= frame.time <= limit.stop

    def _show_thrusts(self, vehicle: _Vehicle, rotors: Array, health: Array) -> None:
        """Draw thrusts at speeds (4,) of rotors with a share of thrust left (4,), red where some is lost."""
        thrusts = health * self._thrusts(rotors)
        lengths = self.unit * len(self._rotors) / self._weight * thrusts
        tips = self._rotors + np.outer(lengths, [0.0, 0.0, 1.0])
        colours = np.where(health[:, None] == 1.0, vehicle.colour, rgb(COLOUR.violated))
        vehicle.arrows.colors = colours.astype(np.uint8)
        vehicle.arrows.points = np.stack([self._rotors, tips], axis=1).astype(np.float32)

    def _show_surroundings(self, sample: Period, pull: Array) -> None:
        """Move set-point, floor and hand to where the first vehicle is after a period; the floor by whole squares."""
        at = sample.position[-1]
        self._goal.position = sample.observation.reference[:3]
        self.ground = min(self.ground, at[2] + self._drop)
        x, y = 2.0 * self._square * np.round(at[:2] / (2.0 * self._square))
        self._floor.position = (x, y, self.ground)
        self._hand.points = np.array([[at, at + 30.0 * self.unit / self._weight * pull]], np.float32)

    def pose(self, frame: Frame, share: float) -> Array:
        """Draw the vehicles at a fraction of the period; return the position of the first (3,) [m]."""
        for sample, vehicle in zip(frame.samples, self._vehicles, strict=True):
            if sample is None:
                continue
            step = min(len(sample.steps) - 1, int(share * len(sample.steps)))
            at = sample.position[step]
            foot = self.ground + 0.01 * self.unit
            vehicle.frame.position = at
            vehicle.frame.wxyz = sample.attitude[step]
            vehicle.shadow.position = (*at[:2], foot)
            vehicle.plumb.scale = (1.0, 1.0, float(at[2] - foot))
        return np.asarray(self._vehicles[0].frame.position)

    def reset(self) -> None:
        """Clear the scene for a new flight."""
        course = _course(self._session)
        self._ahead.points = course
        self.ground = min(0.0, float(course[..., 2].min())) + self._drop
        self._events = 0
        self.mark.visible = False
        self._shown.clear()
        for vehicle in self._vehicles:
            vehicle.trail.clear()
            vehicle.path.points = np.zeros((TRAIL, 2, 3), np.float32)

    def recorded(self, title: str) -> str:
        """The flight so far as one page that plays it without a network; callable from any thread.

        The scene moves instead of the camera: the first vehicle stays in the middle, and a viewer may turn it.
        """
        messages: Any = WebsockMessageHandler()  # takes the place of a server
        messages.get_message_buffer = lambda: SimpleNamespace(push=lambda message: None)
        record = messages.get_message_serializer(lambda message: message.include_in_scene_serialization)
        camera = viser.InitialCameraConfig(messages.queue_message)
        camera.position = self.unit * VIEW
        camera.look_at = np.zeros(3)
        camera.fov = FIELD
        lock = SimpleNamespace(_scene_lifecycle_lock=threading.RLock())
        owner: Any = SimpleNamespace(_websock_connection=messages, client_id="", _viser_server=lock)
        frames = list(self._shown)
        idle = SimpleNamespace()
        stage = Stage(viser.SceneApi(owner, idle, idle), self._session)
        for frame in frames:
            stage.show(frame)
            stage._root.position = -stage.pose(frame, 1.0)
            record.insert_sleep(self._session.period)
            clock.sleep(_PAUSE)
        return look.adapted_page(record.as_html(), title)

    def _line(self, name: str, points: Array, colour: Rgb, thickness: float = 3.0) -> Any:
        style = {"thickness": thickness, "thickness_units": "screen"}
        return self._scene.add_line_segments(f"{_ROOT}/{name}", points.astype(np.float32), colour, **style)

    def _add(self, name: str, mesh: Any, colour: tuple[float, ...], **style: Any) -> Any:
        style = {"color": colour, "flat_shading": True, **FLAT, **style}
        return self._scene.add_mesh_simple(f"{_ROOT}/{name}", mesh.vertices, mesh.faces, **style)


def _lit_root(scene: Any) -> Any:
    """Set up a scene's light, and return the frame of all that moves as one in a recording."""
    scene.set_up_direction("+z")
    scene.configure_environment_map(hdri=None)
    scene.configure_default_lights(enabled=False)
    scene.add_light_hemisphere("/light", intensity=2.5)
    scene.add_light_directional("/light/sun", intensity=2.0, position=(0.35, -0.25, 0.9))
    return scene.add_frame(_ROOT, show_axes=False)


def _octahedron(radius: float) -> Array:
    """(12, 2, 3) its edges, which hide no vehicle within."""
    corners = radius * np.concatenate([np.eye(3), -np.eye(3)])
    edges = [(start, end) for start, end in combinations(corners, 2) if start @ end == 0.0]
    return np.array(edges)


def _segments(points: Array, count: int) -> Array:
    """(count, 2, 3) of a line through points, its last one repeated: the number must not change."""
    segments = np.repeat(points[-1][None, None], count, axis=0).repeat(2, axis=1)
    pairs = np.stack([points[:-1], points[1:]], axis=1)[-count:]
    segments[: len(pairs)] = pairs
    return segments.astype(np.float32)


def _course(session: Session) -> Array:
    """The reference over the scenario's whole time, thinned where it is straight, and cut off where it is too long."""
    flight = session.flights[0]
    course = np.asarray(flight.loop.course.preview(0, session.scenario.periods)[:, :3])
    rows = course[thin(course, _COURSE_TOLERANCE * flight.actual.longest_arm)]
    return _segments(rows[: _COURSE_SEGMENTS + 1], _COURSE_SEGMENTS)
