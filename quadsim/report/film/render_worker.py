"""The child process that renders, `python -m quadsim.report.film.render_worker TASK [ARGUMENTS]`; see `video`.

MuJoCo reads MUJOCO_GL when it is imported and dies where the library is missing, so nothing is rendered in the process
that simulates.  Frames done are reported on stdout, one number per line.
"""

from __future__ import annotations

import itertools
import json
import pickle
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, BinaryIO, Final

import imageio
import mujoco
import numpy as np

from quadsim.controller import Phase
from quadsim.palette import COLOUR, rgba
from quadsim.report.figure import obstacles_in, region_edges
from quadsim.report.film.camera import REQUEST
from quadsim.report.film.captions import CaptionPainter
from quadsim.report.film.frames import Filmed, Footage, Shot, make_footage, thin
from quadsim.report.film.painter import Picture
from quadsim.sim.airframe import FLOOR, PROPELLER_NAMES, compile_model, obstacle_body
from quadsim.space import Obstacle
from quadsim.state import Array
from quadsim.vehicle import Vehicle

TRAIL_SECONDS: Final = 12.0  # how long the path flown stays in sight [s]
CAMERA_DISTANCE: Final = 6.8  # from camera to aim, in arm lengths; its azimuth and elevation below in degrees
CAMERA_AZIMUTH: Final = 125.0
CAMERA_ELEVATION: Final = -18.0
BLADE_SLOWDOWN: Final = 20.0  # blades are drawn turning this much slower than they do, so that an eye can follow
_DEEPEST_FLOOR: Final = 30.0  # the floor lies below the whole flight, but no deeper than this [m]
_LONGEST_ARROW: Final = 2.5  # cap on a thrust arrow, in arrows at hover
_MOST_GEOMS: Final = 2000
_COURSE_COLOUR: Final = rgba(COLOUR.reference, 0.8)
_HORIZON_COLOUR: Final = rgba(COLOUR.predicted)
_THRUST_COLOUR: Final = rgba(COLOUR.flown, 0.85)
_BROKEN_COLOUR: Final = rgba(COLOUR.violated)
_REGION_COLOUR: Final = rgba(COLOUR.bound, 0.5)
_SHADOW_COLOUR: Final = (0.05, 0.07, 0.10, 0.45)


def _camera(arm: float) -> mujoco.MjvCamera:
    """The camera that follows a vehicle of an arm length [m]."""
    camera = mujoco.MjvCamera()
    camera.distance = CAMERA_DISTANCE * arm
    camera.azimuth = CAMERA_AZIMUTH
    camera.elevation = CAMERA_ELEVATION
    return camera


def _renderer(model: mujoco.MjModel, width: int, height: int) -> mujoco.Renderer:
    """A quick renderer: without multisampling, shadows and reflections."""
    model.vis.quality.offsamples = 0
    model.vis.global_.offwidth = width
    model.vis.global_.offheight = height
    renderer = mujoco.Renderer(model, height, width, max_geom=_MOST_GEOMS)
    for flag in (mujoco.mjtRndFlag.mjRND_SHADOW, mujoco.mjtRndFlag.mjRND_REFLECTION):
        renderer.scene.flags[flag] = 0
    return renderer


def _place(
    data: mujoco.MjData,
    vehicle: Vehicle,
    obstacles: Sequence[Obstacle],
    pose: Sequence[float],
    turned: Sequence[float] | Array,
    time: float,
) -> None:
    """Put the vehicle at a pose (7,), its rotors turned by angles (4,) [rad], and obstacles where they are then."""
    model = data.model
    data.qpos[:7] = pose
    for name, angle, spin in zip(PROPELLER_NAMES, turned, vehicle.rotor_spins, strict=True):
        half = -0.5 * spin * angle / BLADE_SLOWDOWN  # a propeller turns against its reaction torque
        model.body(name).quat[:] = np.cos(half), 0.0, 0.0, np.sin(half)
    for obstacle in obstacles:
        if obstacle.moves:
            body = model.body(obstacle_body(obstacle)).id
            data.mocap_pos[model.body_mocapid[body]] = obstacle.positions(np.array([time]))[0]
    mujoco.mj_kinematics(model, data)
    mujoco.mj_camlight(model, data)


class FilmStage:
    """A vehicle in its scene, rendered off screen; use it as a context manager, it owns an OpenGL context.

    Besides the airframe and obstacles, frames show the regions in force, the reference path, the path flown in the last
    seconds, the predicted horizon, one thrust arrow per rotor (red beyond the speed limit) and a shadow with a plumb
    line to the floor.
    """

    def __init__(self, run: Filmed, footage: Footage, *, width: int, height: int) -> None:
        self._run = run
        self._footage = footage
        self._arm = run.vehicle.longest_arm
        self._obstacles = obstacles_in(run.limits)
        self._model = compile_model(run.vehicle, visuals=True, obstacles=self._obstacles)
        self._regions = list(region_edges(run.limits, run.log))
        lowest = max(float(footage.path[:, 2].min()), -_DEEPEST_FLOOR)
        self._floor = min(lowest, 0.0) + float(self._model.geom(FLOOR).pos[2])
        self._model.geom(FLOOR).pos[2] = self._floor
        self._data = mujoco.MjData(self._model)
        self._camera = _camera(self._arm)
        self._speed_bound = min((limit.upper for limit in run.limits if limit.signal == "speed"), default=np.inf)
        self._renderer = _renderer(self._model, width, height)

    def __enter__(self) -> FilmStage:
        return self

    def __exit__(self, *_: object) -> None:
        self._renderer.close()

    def render(self, i: int) -> Picture:
        """Frame `i` of the footage, (height, width, 3), without captions."""
        shown = self._footage
        pose = [*shown.position[i], *shown.quaternion[i]]
        _place(self._data, self._run.vehicle, self._obstacles, pose, shown.turned[i], shown.times[i])
        # The camera aims a little low, so that the vehicle appears above the captions.
        self._camera.lookat = shown.aim[i] - (0.0, 0.0, 0.55 * self._arm)
        self._renderer.update_scene(self._data, self._camera)
        self._draw_path(shown.course, 0.018, _COURSE_COLOUR)
        for region, edges in self._regions:
            if region.holds_at(shown.times[i : i + 1])[0]:
                for start, stop in edges:
                    self._connect(mujoco.mjtGeom.mjGEOM_CAPSULE, 0.04 * self._arm, start, stop, _REGION_COLOUR)
        self._draw_trail(i)
        self._draw_horizon(i)
        self._draw_thrusts(i)
        self._draw_shadow(i)
        return np.ascontiguousarray(self._renderer.render())

    def _connect(
        self, kind: mujoco.mjtGeom, width: float, start: Array, stop: Array, colour: tuple[float, float, float, float]
    ) -> None:
        """Draw a line, tube or arrow from one point to another, while the scene has room for it."""
        scene = self._renderer.scene
        if scene.ngeom >= scene.maxgeom:
            return
        geom = scene.geoms[scene.ngeom]
        mujoco.mjv_initGeom(geom, kind, np.zeros(3), np.zeros(3), np.zeros(9), np.array(colour, np.float32))
        mujoco.mjv_connector(geom, kind, width, start, stop)
        geom.category = mujoco.mjtCatBit.mjCAT_DECOR
        geom.emission = 0.25
        scene.ngeom += 1

    def _draw_path(self, points: Array, width: float, colour: tuple[float, float, float, float]) -> None:
        for start, stop in itertools.pairwise(points):
            self._connect(mujoco.mjtGeom.mjGEOM_CAPSULE, width * self._arm, start, stop, colour)

    def _draw_trail(self, i: int) -> None:
        now = self._footage.times[i]
        times = self._footage.path_times
        first, last = np.searchsorted(times, (now - TRAIL_SECONDS, now), side="right")
        points = np.concatenate([self._footage.path[first:last], self._footage.position[i : i + 1]])
        for j, (start, stop) in enumerate(itertools.pairwise(points)):
            age = (now - times[first + j]) / TRAIL_SECONDS
            colour = rgba(COLOUR.flown, float(np.clip(1.0 - age, 0.0, 1.0)))
            self._connect(mujoco.mjtGeom.mjGEOM_CAPSULE, 0.030 * self._arm, start, stop, colour)

    def _draw_horizon(self, i: int) -> None:
        k = self._footage.period[i]
        # A prediction ignores the ground: below it, it would fall on.
        if self._run.log.predicted is None or self._run.log.control.phase[k] != Phase.FLYING:
            return
        predicted = self._run.log.predicted[k].astype(float)
        self._draw_path(predicted[thin(predicted, 0.02 * self._arm)], 0.028, _HORIZON_COLOUR)

    def _draw_thrusts(self, i: int) -> None:
        hover = self._run.vehicle.hover_speed
        for name, speed in zip(PROPELLER_NAMES, self._footage.speeds[i], strict=True):
            body = self._data.body(name)
            length = 1.0 * self._arm * min(float(speed / hover) ** 2, _LONGEST_ARROW)
            if length < 0.02 * self._arm:
                continue
            if speed > self._speed_bound + 1e-6:
                colour = _BROKEN_COLOUR
            else:
                colour = _THRUST_COLOUR
            tip = body.xpos + length * body.xmat.reshape(3, 3)[:, 2]
            self._connect(mujoco.mjtGeom.mjGEOM_ARROW, 0.04 * self._arm, body.xpos, tip, colour)

    def _draw_shadow(self, i: int) -> None:
        foot = np.array([*self._footage.position[i, :2], self._floor + 0.004 * self._arm])
        thickness = np.array([0.0, 0.0, 0.004 * self._arm])
        self._connect(mujoco.mjtGeom.mjGEOM_CYLINDER, 0.9 * self._arm, foot, foot + thickness, _SHADOW_COLOUR)
        self._connect(mujoco.mjtGeom.mjGEOM_LINE, 1.0, self._footage.position[i], foot, _SHADOW_COLOUR)


def frames(run: Filmed, shot: Shot) -> Iterator[Picture]:
    """The frames of a shot, each (height, width, 3)."""
    footage = make_footage(run, shot.times)
    overlay = None
    if shot.captions:
        overlay = CaptionPainter(run, footage, width=shot.width, height=shot.height, speed=shot.speed)
    with FilmStage(run, footage, width=shot.width, height=shot.height) as stage:
        for i in range(shot.count):
            picture = stage.render(i)
            if overlay is not None:
                picture = overlay.draw(picture, i)
            yield picture


def film_shot(run: Filmed, shot: Shot, path: Path) -> None:
    """Render a shot and encode it as H.264, reporting frames done on stdout."""
    writer: Any = imageio.get_writer(
        path,
        format="FFMPEG",
        fps=shot.fps,
        codec="libx264",
        pixelformat="yuv420p",
        quality=None,
        macro_block_size=1,
        ffmpeg_log_level="error",
        output_params=["-preset", "veryfast", "-crf", "23", "-threads", "1"],
    )
    with writer:
        for i, picture in enumerate(frames(run, shot), start=1):
            writer.append_data(picture)
            print(i, flush=True)


def serve(requests: BinaryIO, pictures: BinaryIO) -> None:
    """Draw one state after the other, as `quadsim.report.film.camera.Camera` requests them, until there are no more."""
    vehicle, obstacles, width, height = pickle.load(requests)
    model = compile_model(vehicle, visuals=True, obstacles=obstacles)
    data = mujoco.MjData(model)
    camera = _camera(vehicle.longest_arm)
    floor = float(model.geom(FLOOR).pos[2])
    lowest = 0.0
    with _renderer(model, width, height) as renderer:
        while len(request := requests.read(REQUEST.size)) == REQUEST.size:
            time, *numbers = REQUEST.unpack(request)
            pose = numbers[:7]
            reference = numbers[7:10]
            turned = numbers[10:]
            lowest = max(min(lowest, pose[2]), -_DEEPEST_FLOOR)
            model.geom(FLOOR).pos[2] = lowest + floor
            _place(data, vehicle, obstacles, pose, turned, time)
            camera.lookat = pose[:3]
            renderer.update_scene(data, camera)
            _draw_sphere(renderer.scene, np.array(reference), 0.15 * vehicle.longest_arm)
            pictures.write(renderer.render().tobytes())
            pictures.flush()


def _draw_sphere(scene: mujoco.MjvScene, centre: Array, radius: float) -> None:
    """Add a sphere in the colour of the reference to a scene."""
    size = np.full(3, radius)
    colour = np.array(_COURSE_COLOUR, np.float32)
    sphere = mujoco.mjtGeom.mjGEOM_SPHERE
    mujoco.mjv_initGeom(scene.geoms[scene.ngeom], sphere, size, centre, np.eye(3).ravel(), colour)
    scene.ngeom += 1


def carry_out(arguments: list[str]) -> None:
    """Do `serve` or `film FLIGHT SHOT MP4`, the flight a pickled `Filmed`."""
    match arguments:
        case ["serve"]:
            serve(sys.stdin.buffer, sys.stdout.buffer)
        case ["film", flight, shot, path]:
            run: Filmed = pickle.loads(Path(flight).read_bytes())
            film_shot(run, Shot(**json.loads(shot)), Path(path))
        case _:
            raise SystemExit(carry_out.__doc__)


if __name__ == "__main__":
    carry_out(sys.argv[1:])
