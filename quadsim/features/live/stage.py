"""The 3-D scene of a live session, as films show it, and its recording.

Everything has few triangles: machines without a graphics card draw too.  Handles are viser's.
"""

from __future__ import annotations

import math
import threading
import time as clock
from collections import deque
from itertools import combinations
from types import SimpleNamespace
from typing import Any, Final

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
from quadsim.space import Obstacle, Region
from quadsim.state import Array

VIEW: Final = np.array([-5.5, -8.0, 4.5])  # from the first vehicle to a camera at the start, in arm lengths
FLAT: Final = {"cast_shadow": False, "receive_shadow": False}
FIELD: Final = math.radians(45.0)  # of view, as in films
TRAIL: Final = 200  # points of the flown path that stay
_EVERY: Final = 2  # periods from one to the next; every point is sent anew with each
_COURSE: Final = 3000  # segments of the reference that are drawn
_BEND: Final = 0.03  # how far they may be from it, in arm lengths
_SECONDS: Final = 180.0  # of the flight that a recording has at most
_REST: Final = 5e-4  # [s] after each period that is recorded, for the thread that flies
_ROOT: Final = "/flight"  # what moves as one in a recording
_SHADOW: Final = (84, 92, 101)
_TINTED: Final = ("front", "disc", "disc_front")  # materials in a vehicle's colour where there are two


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
        scene.set_up_direction("+z")
        scene.configure_environment_map(hdri=None)
        scene.configure_default_lights(enabled=False)
        scene.add_light_hemisphere("/light", intensity=2.5)
        scene.add_light_directional("/light/sun", intensity=2.0, position=(0.35, -0.25, 0.9))
        self._root = scene.add_frame(_ROOT, show_axes=False)
        vehicle = session.flights[0].actual
        self.unit = vehicle.longest_arm
        self._weight = vehicle.mass * vehicle.gravity
        self._rotors = vehicle.hubs
        self._thrusts = vehicle.thrusts
        model = compile_model(vehicle, visuals=True)
        alone = len(session.flights) == 1
        self._drop = float(model.geom(FLOOR).pos[2])  # from a vehicle to the floor that it stands on [m]
        self._square = look.square_side(self.unit)
        self._floor = scene.add_glb(f"{_ROOT}/floor", look.floor(self._square))
        target = rgb(COLOUR.reference)
        self._ahead = self._line("reference", _course(session), target, 2.0)
        self._goal = self._line("goal", _octahedron(0.5 * self.unit), target, 2.5)
        self._hand = self._line("hand", np.zeros((1, 2, 3)), rgb(COLOUR.disturbance), 5.0)
        self._colours: list[Rgb] = []
        self._frames = []
        self._arrows = []
        self._horizons = []
        self._paths = []
        self._shadows = []
        for i, flight in enumerate(session.flights):
            name = f"vehicle{i}"
            length = flight.loop.controller.horizon
            colour = rgb(line_colour(i))
            self._frames.append(scene.add_frame(f"{_ROOT}/{name}", show_axes=False))
            for material, (*paint, alpha), mesh in look.airframe(model):
                if alone or material not in _TINTED:
                    tint = tuple(paint)
                else:
                    tint = colour
                self._add(f"{name}/{material}", mesh, tint, opacity=None if alpha == 1.0 else alpha)
            arrows = np.zeros((len(self._rotors), 2, 3))
            widths = {"shaft_radius": 0.04 * self.unit, "head_radius": 0.09 * self.unit, "head_length": 0.2 * self.unit}
            self._colours.append(colour)
            self._arrows.append(scene.add_arrows(f"{_ROOT}/{name}/thrust", arrows, colour, **widths))
            predicted = rgb(COLOUR.predicted) if alone else colour
            self._horizons.append(self._line(f"horizon{i}", np.zeros((length, 2, 3)), predicted))
            self._paths.append(self._line(f"path{i}", np.zeros((TRAIL, 2, 3)), colour))
            shadow = self._add(f"shadow{i}", look.disc(0.9 * self.unit), _SHADOW)
            plumb = self._line(f"shadow{i}/plumb", np.array([[(0.0, 0.0, 0.0), (0.0, 0.0, 1.0)]]), _SHADOW, 1.0)
            self._shadows.append((shadow, plumb))
            if not alone:
                title = law_name(flight.loop.controller.name)
                top = (0.0, 0.0, (1.4 + 0.5 * i) * self.unit)
                scene.add_label(f"{_ROOT}/{name}/label", title, position=top, anchor="bottom-center")
                self._line(f"{name}/pole", np.array([[(0.0, 0.0, 0.0), top]]), colour, 1.5)
        self.mark = self._add("mark", look.disc(0.5 * self.unit), target, visible=False)
        self.grab = self._add("vehicle0/grab", look.grip(1.3 * self.unit), _SHADOW, opacity=0.001)
        self._trails = [deque[Array](maxlen=TRAIL + 1) for _ in session.flights]
        self._shown = deque[Frame](maxlen=round(_SECONDS / session.period))
        self._moving: list[tuple[Obstacle, Any]] = []
        self._regions: list[tuple[SpaceLimit, Any]] = []
        course = _course(session).reshape(-1, 3)
        low = course.min(axis=0) - 1.5
        high = course.max(axis=0) + 1.5
        for limit in session.limits:
            match limit:
                case SpaceLimit(shape=Region() as region):
                    line = self._line(f"regions/{limit.name}", region.edges(low, high), rgb(COLOUR.bound), 1.5)
                    self._regions.append((limit, line))
                case SpaceLimit(shape=Obstacle() as body):
                    handle = self._add(f"obstacles/{body.name}", look.obstacle(body), rgb(COLOUR.obstacle))
                    handle.position = body.position
                    if body.moves:
                        self._moving.append((body, handle))
        self.ground = 0.0
        self._events = 0
        self.reset()

    def show(self, frame: Frame) -> None:
        """Update the objects that change once per period."""
        self._shown.append(frame)
        for i, (sample, horizon) in enumerate(zip(frame.samples, frame.horizons, strict=True)):
            if sample is None:
                continue
            thrusts = frame.health * self._thrusts(sample.rotors)
            lengths = self.unit * len(self._rotors) / self._weight * thrusts
            sound = np.where(frame.health[:, None] == 1.0, self._colours[i], rgb(COLOUR.violated))
            self._arrows[i].colors = sound.astype(np.uint8)
            tips = self._rotors + np.outer(lengths, [0.0, 0.0, 1.0])
            self._arrows[i].points = np.stack([self._rotors, tips], axis=1).astype(np.float32)
            if frame.k % _EVERY == 0:
                self._trails[i].append(sample.position[-1])
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
            at = first.position[-1]
            self._goal.position = first.observation.reference[:3]
            self.ground = min(self.ground, at[2] + self._drop)
            self._floor.position = (*(2.0 * self._square * np.round(at[:2] / (2.0 * self._square))), self.ground)
            self._hand.points = np.array([[at, at + 30.0 * self.unit / self._weight * frame.pull]], np.float32)
        self._hand.visible = bool(frame.pull.any())
        for obstacle, handle in self._moving:
            handle.position = obstacle.positions(np.array([frame.time]))[0]
        for limit, handle in self._regions:
            handle.visible = limit.start <= frame.time <= limit.stop

    def pose(self, frame: Frame, share: float) -> Array:
        """Draw the vehicles at a fraction of the period; return the position of the first (3,) [m]."""
        for sample, handle, (shadow, plumb) in zip(frame.samples, self._frames, self._shadows, strict=True):
            if sample is not None:
                step = min(len(sample.steps) - 1, int(share * len(sample.steps)))
                at = handle.position = sample.position[step]
                handle.wxyz = sample.attitude[step]
                foot = self.ground + 0.01 * self.unit
                shadow.position = (*at[:2], foot)
                plumb.scale = (1.0, 1.0, float(at[2] - foot))
        return np.asarray(self._frames[0].position)

    def reset(self) -> None:
        """Clear the scene for a new flight."""
        course = self._ahead.points = _course(self._session)
        self.ground = min(0.0, float(course[..., 2].min())) + self._drop
        # those that have been seen
        self._events = 0
        self.mark.visible = False
        self._shown.clear()
        for trail, path in zip(self._trails, self._paths, strict=True):
            trail.clear()
            path.points = np.zeros((TRAIL, 2, 3), np.float32)

    def recorded(self, title: str) -> str:
        """The flight so far as one page that plays it without a network; callable from any thread.

        The scene moves instead of the camera: the first vehicle stays in the middle, and a viewer may turn it.
        """
        tape: Any = WebsockMessageHandler()  # takes the place of a server
        tape.get_message_buffer = lambda: SimpleNamespace(push=lambda message: None)
        record = tape.get_message_serializer(lambda message: message.include_in_scene_serialization)
        camera = viser.InitialCameraConfig(tape.queue_message)
        camera.position = self.unit * VIEW
        camera.look_at = np.zeros(3)
        camera.fov = FIELD
        lock = SimpleNamespace(_scene_lifecycle_lock=threading.RLock())
        owner: Any = SimpleNamespace(_websock_connection=tape, client_id="", _viser_server=lock)
        frames = list(self._shown)
        idle = SimpleNamespace()
        stage = Stage(viser.SceneApi(owner, idle, idle), self._session)
        for frame in frames:
            stage.show(frame)
            stage._root.position = -stage.pose(frame, 1.0)
            record.insert_sleep(self._session.period)
            clock.sleep(_REST)
        return look.dressed(record.as_html(), title)

    def _line(self, name: str, points: Array, colour: Rgb, thickness: float = 3.0) -> Any:
        style = {"thickness": thickness, "thickness_units": "screen"}
        return self._scene.add_line_segments(f"{_ROOT}/{name}", points.astype(np.float32), colour, **style)

    def _add(self, name: str, mesh: Any, colour: tuple[float, ...], **style: Any) -> Any:
        style = {"color": colour, "flat_shading": True, **FLAT, **style}
        return self._scene.add_mesh_simple(f"{_ROOT}/{name}", mesh.vertices, mesh.faces, **style)


def _octahedron(radius: float) -> Array:
    """(12, 2, 3) its edges, which hide no vehicle within."""
    corners = radius * np.concatenate([np.eye(3), -np.eye(3)])
    return np.array([pair for pair in combinations(corners, 2) if pair[0] @ pair[1] == 0.0])


def _segments(points: Array, count: int) -> Array:
    """(count, 2, 3) of a line through points, its last one repeated: the number must not change."""
    segments = np.repeat(points[-1][None, None], count, axis=0).repeat(2, axis=1)
    pairs = np.stack([points[:-1], points[1:]], axis=1)[-count:]
    segments[: len(pairs)] = pairs
    return segments.astype(np.float32)


def _course(session: Session) -> Array:
    """The reference over the scenario's whole time, thinned where it is straight, and cut off where it is too long."""
    course = np.asarray(session.flights[0].loop.course.preview(0, session.scenario.periods)[:, :3])
    rows = course[thin(course, _BEND * session.flights[0].actual.longest_arm)]
    return _segments(rows[: _COURSE + 1], _COURSE)
