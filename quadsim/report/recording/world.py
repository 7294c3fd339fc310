"""The 3-D views of a recording, and its look: timeline, grouping of signals into plots, colours."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any, Final

import mujoco
import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from quadsim.controller import Phase
from quadsim.flight.audit import SIGNALS
from quadsim.flight.log import ControlLog, FlightLog
from quadsim.flight.record import FlightRecord
from quadsim.palette import COLOUR, line_colour, on_dark, rgb
from quadsim.report.figure import obstacles_in, region_edges
from quadsim.rotation import euler_to_quaternion
from quadsim.sim.airframe import DISC_NAMES, DRAWN_ARM, FLOOR, compile_model
from quadsim.space import Solid
from quadsim.state import EULER, POSITION, Array
from quadsim.vehicle import N_ROTORS, Vehicle

TIMELINE: Final = "sim_time"

PANELS: Final[dict[str, tuple[str, ...]]] = {
    "Position": ("x", "y", "z"),
    "Roll and pitch": ("roll", "pitch"),
    "Rotor speeds": ("speed",),
    "Collective thrust": ("thrust",),
    "Steps of the rotor speeds, per period": ("slew",),
    "Velocity": ("vx", "vy", "vz"),
    "Position errors": ("x_error", "y_error", "z_error"),
    "Climb acceleration": ("climb_acceleration",),
    "Attitude rates": ("roll_rate", "pitch_rate", "yaw_rate"),
    "Body rates": ("body_rate_x", "body_rate_y", "body_rate_z"),
    "Yaw and tilt": ("yaw", "tilt", "yaw_error"),
    "Position as measured, less the true one": ("x_estimate_error", "y_estimate_error", "z_estimate_error"),
    "Attitude as measured, less the true one": ("roll_estimate_error", "pitch_estimate_error", "yaw_estimate_error"),
}
"""Title of each plot, and its signals; every signal is in one, so that every limit is drawn."""
assert sorted(itertools.chain.from_iterable(PANELS.values())) == sorted(SIGNALS)
_ANY_ATTITUDE: Final = {
    "Roll and pitch": ("Tilt", ("tilt",)),
    "Yaw and tilt": ("Roll, pitch and yaw", ("roll", "pitch", "yaw", "yaw_error")),
}
"""What takes a plot's place where the vehicle may turn upside down: Euler angles jump there."""
FRONT_PANELS: Final = 4  # how many of the plots are seen first

Colour = tuple[int, int, int, int]


def panels(log: FlightLog) -> dict[str, tuple[str, ...]]:
    """The plots of a flight, `FRONT_PANELS` of them first."""
    if log.plant.attitude is None:
        return PANELS
    shown = {}
    for title, names in PANELS.items():
        other_title, other_names = _ANY_ATTITUDE.get(title, (title, names))
        shown[other_title] = other_names
    return shown


def on_screen(colour: str, opacity: int = 255) -> Colour:
    """A colour lightened: the viewer's background is black, or for some white."""
    return *rgb(on_dark(colour)), opacity


SERIES: Final = tuple(on_screen(line_colour(i)) for i in range(N_ROTORS))
REFERENCE: Final = on_screen(COLOUR.reference)
BOUND: Final = on_screen(COLOUR.bound)
DISTURBANCE: Final = on_screen(COLOUR.disturbance)
AXIS_COLOURS: Final = tuple(map(on_screen, (COLOUR.axis_x, COLOUR.axis_y, COLOUR.axis_z)))

VERDICT_COLOURS: Final = {
    "holds": on_screen(COLOUR.satisfied),
    "active": on_screen(COLOUR.warning),
    "violated": on_screen(COLOUR.violated),
    "not in force": (0, 0, 0, 0),
}


def time_column(t: Array) -> rr.TimeColumn:
    """Instants [s] on the recording's one timeline."""
    return rr.TimeColumn(TIMELINE, duration=t)


_FORCE_SCALE: Final = 5.0
"""How many times longer an external force is drawn than a thrust of its size: it would vanish inside the hull."""
_DASH: Final = 0.8  # length of a dash of the reference, in arm lengths; a gap is as long
_MOST_DASHES: Final = 500  # dashes and gaps together, of a path
_WIND_LENGTH: Final = 1.5  # how long a flight's strongest wind is drawn, in arm lengths


def send_airframe(recording: rr.RecordingStream, vehicle: Vehicle) -> None:
    """The vehicle as films show it, in its body frame, but for rotor discs in the colours of the plots."""
    model = compile_model(vehicle, visuals=True)
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    disc_colours = {}
    for name, colour in zip(DISC_NAMES, SERIES, strict=True):
        disc_colours[name] = (*colour[:3], 110)
    for i in range(model.ngeom):
        geom = model.geom(i)
        if geom.name == FLOOR or geom.name.startswith("blades"):
            continue
        kind = mujoco.mjtGeom(int(geom.type[0])).name.removeprefix("mjGEOM_").lower()
        solid = Solid(kind, tuple(geom.size), data.geom_xpos[i].copy(), data.geom_xmat[i].reshape(3, 3).copy())
        lightened = 76 + 179 * model.mat_rgba[geom.matid[0]]  # the viewer's background may be black
        drawn_colour = disc_colours.get(geom.name) or tuple(map(int, lightened))
        recording.log(f"world/vehicle/body/{geom.name}", _part(solid, drawn_colour), static=True)
    unit = vehicle.longest_arm / DRAWN_ARM
    origins = vehicle.hubs + np.array([0.0, 0.0, 0.036 * unit])
    arrows = rr.Arrows3D.from_fields(origins=origins, radii=0.01 * unit, colors=list(SERIES))
    recording.log("world/vehicle/body/thrust", arrows, static=True)


def _part(solid: Solid, colour: Any) -> rr.AsComponents:
    """A solid, or an ellipsoid of half axes `size`."""
    a, b, _ = solid.size
    turned = {"quaternions": _vector_first(solid.quaternion)[None], "colors": colour, "fill_mode": "solid"}
    centres: Any = [solid.centre]
    match solid.kind:
        case "box":
            return rr.Boxes3D(centers=centres, half_sizes=[solid.size], **turned)
        case "cylinder":
            return rr.Cylinders3D(centers=centres, lengths=[2.0 * b], radii=[a], **turned)
        case "capsule":
            bottom = solid.centre - b * solid.turn[:, 2]
            return rr.Capsules3D(translations=[bottom], lengths=[2.0 * b], radii=[a], **turned)
        case "sphere":
            return rr.Ellipsoids3D(centers=centres, half_sizes=[(a, a, a)], **turned)
    return rr.Ellipsoids3D(centers=centres, half_sizes=[solid.size], **turned)


def send_scene(recording: rr.RecordingStream, run: FlightRecord) -> None:
    """Axes and paths, how the vehicle moves through them, and what the controller predicts."""
    plant = run.log.plant
    arm = run.actual.longest_arm
    _send_axes_and_paths(recording, run)
    _send_vehicle(recording, run)
    if plant.wrench is not None and np.any(plant.wrench[:, :3]):
        hover_thrust = run.actual.mass * run.actual.gravity / N_ROTORS
        scale = _FORCE_SCALE * arm / hover_thrust
        _send_arrows(recording, run, "external_force", scale * plant.wrench[:, :3], DISTURBANCE, behind=0.0)
    if plant.wind is not None and np.any(plant.wind):
        strongest = float(np.linalg.norm(plant.wind, axis=1).max())
        drawn = _WIND_LENGTH * arm / strongest * plant.wind
        _send_arrows(recording, run, "wind", drawn, DISTURBANCE, behind=1.3)
    if run.log.control.t.size:
        _send_flown(recording, run)
        if run.log.predicted is not None:
            _send_horizons(recording, run.log.control, run.log.predicted)


def _send_axes_and_paths(recording: rr.RecordingStream, run: FlightRecord) -> None:
    """What stays: the world's axes, the whole reference as dashes, and faintly the whole path."""
    arm = run.actual.longest_arm
    axes = rr.Arrows3D(
        origins=np.zeros((3, 3)),
        vectors=np.eye(3),
        radii=min(0.02, 0.06 * arm),
        colors=AXIS_COLOURS,
        labels=["x", "y", "z"],
    )
    recording.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    recording.log("world/axes", axes, static=True)
    dashes = _dashes(run.log.control.reference[:, :3], _DASH * arm)
    _log_lines(recording, "world/reference", REFERENCE, 1.2, dashes)
    _log_lines(recording, "world/path", on_screen(COLOUR.flown, 60), 1.0, [run.log.plant.state[:, POSITION]])


def _send_vehicle(recording: rr.RecordingStream, run: FlightRecord) -> None:
    """Where the vehicle is at each instant, how it is turned, and its thrusts.

    The body turns below an entity that only moves: views that start there follow the vehicle without tilting.
    """
    plant = run.log.plant
    thrusts = np.zeros((plant.t.size, N_ROTORS, 3))
    thrusts[..., 2] = run.actual.longest_arm * np.square(plant.speeds / run.actual.hover_speed)
    if plant.attitude is None:
        quaternions = euler_to_quaternion(plant.state[:, EULER])
    else:
        quaternions = plant.attitude
    moved = rr.Transform3D.columns(translation=plant.state[:, POSITION])
    turned = rr.Transform3D.columns(quaternion=_vector_first(quaternions))
    arrows = rr.Arrows3D.columns(vectors=thrusts.reshape(-1, 3)).partition([N_ROTORS] * plant.t.size)
    recording.send_columns("world/vehicle", [time_column(plant.t)], moved)
    recording.send_columns("world/vehicle/body", [time_column(plant.t)], turned)
    recording.send_columns("world/vehicle/body/thrust", [time_column(plant.t)], arrows)


def _send_flown(recording: rr.RecordingStream, run: FlightRecord) -> None:
    """The path of each control period, there from its end on."""
    plant = run.log.plant
    position = plant.state[:, POSITION]
    starts = np.searchsorted(plant.t, run.log.control.t - 1e-9)
    ends = np.append(starts[1:], plant.t.size - 1)
    pieces = [position[start : end + 1] for start, end in zip(starts, ends, strict=True)]
    _log_lines(recording, "world/flown", on_screen(COLOUR.flown), 2.2)
    recording.send_columns("world/flown", [time_column(plant.t[ends])], rr.LineStrips3D.columns(strips=pieces))


def _send_horizons(
    recording: rr.RecordingStream, control: ControlLog, predicted: np.ndarray[Any, np.dtype[np.float32]]
) -> None:
    """The predicted positions (K, N, 3), each from the measured one, while the vehicle flies."""
    strips = []
    for state, horizon, phase in zip(control.state, predicted, control.phase, strict=True):
        strip = np.concatenate([state[None, POSITION], horizon])
        # A prediction ignores the ground: below it, it would fall on.
        if phase != Phase.FLYING:
            strip = strip[:0]
        strips.append(strip)
    _log_lines(recording, "world/horizon", on_screen(COLOUR.predicted), 2.5)
    recording.send_columns("world/horizon", [time_column(control.t)], rr.LineStrips3D.columns(strips=strips))


def send_space(recording: rr.RecordingStream, run: FlightRecord) -> None:
    """Obstacles, which move where they do, and regions, which are there while they hold."""
    for obstacle in obstacles_in(run.limits):
        entity = f"world/obstacles/{obstacle.name}"
        for i, solid in enumerate(obstacle.solids):
            recording.log(f"{entity}/{i}", _part(solid, on_screen(COLOUR.obstacle)), static=True)
        if obstacle.moves:
            t = run.log.plant.t
            moving = rr.Transform3D.columns(translation=obstacle.positions(t))
            recording.send_columns(entity, [time_column(t)], moving)
        else:
            recording.log(entity, rr.Transform3D(translation=obstacle.position), static=True)
    for limit, edges in region_edges(run.limits, run.log):
        entity = f"world/regions/{limit.name}"
        _log_lines(recording, entity, BOUND, 1.2)
        times = [max(limit.start, 0.0)]
        counts = [len(edges)]
        if np.isfinite(limit.stop):
            times.append(limit.stop)
            counts.append(0)
        strips = rr.LineStrips3D.columns(strips=[*edges]).partition(counts)
        recording.send_columns(entity, [time_column(np.array(times))], strips)


def scene_views(run: FlightRecord) -> rrb.Vertical:
    """Course and vehicle in space, and the summary."""
    behind = run.actual.longest_arm * np.array([-3.0, -3.5, 2.2])
    return rrb.Vertical(
        _view("Course", "/world", *_overview(run)),
        rrb.Horizontal(
            _view("Vehicle", "/world/vehicle", behind, np.zeros(3)),
            rrb.TextDocumentView(name="Summary", origin="/summary"),
        ),
        row_shares=[3, 2],
    )


def _overview(run: FlightRecord) -> tuple[Array, Array]:
    """Where the eye is and where it looks [m] to see the whole course."""
    path = run.log.plant.state[:, POSITION]
    path = path[np.isfinite(path).all(axis=1)]  # a flight that diverged ends in anything
    course = run.log.control.reference[:, :3]
    if not len(course):
        course = path
    low = course.min(axis=0)
    high = course.max(axis=0)
    least = 10 * run.actual.longest_arm
    slack = max(float((high - low).max()), least)
    path = np.clip(path, low - slack, high + slack)  # a lost vehicle leaves the picture
    low = np.minimum(low, path.min(axis=0))
    high = np.maximum(high, path.max(axis=0))
    centre = (low + high) / 2
    size = max(float(np.linalg.norm(high - low)), least)
    return centre + size * np.array([0.35, -0.9, 0.3]), centre


def _view(name: str, origin: str, eye: Array, target: Array) -> rrb.Spatial3DView:
    """The scene seen from a point at rest in the frame of `origin`, and the ground, in the frame of the world."""
    start = rrb.TimeRangeBoundary.infinite()
    now = rrb.TimeRangeBoundary.cursor_relative()
    return rrb.Spatial3DView(
        name=name,
        origin=origin,
        contents="/world/**",
        line_grid=rrb.LineGrid3D(visible=origin == "/world", spacing=1.0),
        eye_controls=rrb.EyeControls3D(position=eye, look_target=target),
        overrides={"/world/flown": rrb.VisibleTimeRanges(timeline=TIMELINE, start=start, end=now)},
    )


def _send_arrows(
    recording: rr.RecordingStream, run: FlightRecord, name: str, vectors: Array, colour: Colour, *, behind: float
) -> None:
    """Arrows (M, 3) above the rotor discs that move with the vehicle, begun by `behind` of their length before it."""
    entity = f"world/vehicle/{name}"
    unit = run.actual.longest_arm / DRAWN_ARM
    recording.log(entity, rr.Arrows3D.from_fields(radii=0.01 * unit, colors=colour), static=True)
    origins = np.array([0.0, 0.0, 0.08 * unit]) - behind * vectors
    columns = rr.Arrows3D.columns(vectors=vectors, origins=origins)
    recording.send_columns(entity, [time_column(run.log.plant.t)], columns)


def _log_lines(
    recording: rr.RecordingStream,
    entity: str,
    colour: Colour,
    width: float,
    strips: Sequence[Array] | None = None,
) -> None:
    """Lines that stay, or the look alone of lines to come; `width` in points on the screen."""
    look = rr.LineStrips3D.from_fields(strips=strips, radii=rr.Radius.ui_points(width), colors=colour)
    recording.log(entity, look, static=True)


def _dashes(points: Array, length: float) -> list[Array]:
    """A path (K, 3) [m] as dashes of a length [m], or longer where there would be very many; each follows the path."""
    if not len(points):
        return []
    steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    walked = np.concatenate([[0.0], np.cumsum(steps)])
    marks = np.arange(0.0, walked[-1], max(length, walked[-1] / _MOST_DASHES))
    stations = np.union1d(marks, walked)
    path = np.stack([np.interp(stations, walked, column) for column in points.T], axis=1)
    ends = np.searchsorted(stations, marks)
    return [path[start : end + 1] for start, end in zip(ends[::2], ends[1::2], strict=False)]


def _vector_first(quaternion: Array) -> Array:
    """Quaternions (..., 4) as rerun wants them: x, y, z, w."""
    return np.roll(quaternion, -1, axis=-1)
