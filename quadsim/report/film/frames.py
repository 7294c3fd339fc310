"""The content of a film's frames: a flight and its margins at frame times, and the camera's aim.  Plain numpy."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from quadsim.errors import FileError
from quadsim.flight.audit import Limit, Mask, margins_at, margins_sampled
from quadsim.flight.log import FlightLog
from quadsim.flight.record import FlightRecord
from quadsim.report.flight_sentences import failure_sentences
from quadsim.rotation import euler_to_quaternion
from quadsim.state import EULER, POSITION, Array, Indices, tilt
from quadsim.ties import in_order
from quadsim.vehicle import Vehicle

_CAMERA_MEMORY: Final = 0.7  # time constant [s] of the camera's smoothing, forward and backward
_LEASH: Final = 0.6  # how far the camera's aim may be from the vehicle, in arm lengths per axis
_TOLERANCE: Final = 0.03  # how far a drawn path may be from the real one, in arm lengths


@dataclass(frozen=True, kw_only=True)
class Filmed:
    """What a film shows of a flight: what the processes that render it are given."""

    name: str  # the scenario's
    controller: str  # name of the control law
    vehicle: Vehicle  # the vehicle flown
    log: FlightLog
    limits: tuple[Limit, ...]  # the constraints it was audited against
    events: tuple[Mapping[str, Any], ...]  # `time` [s] and `text` of each
    failures: tuple[str, ...]  # sentences on what failed other than a constraint

    @property
    def end(self) -> float:
        """Last time of the flight [s]."""
        return float(self.log.plant.t[-1])


def filmed(flight: FlightRecord) -> Filmed:
    """Return what a film shows of a flight.

    Raises:
        FileError: the flight ended before its first control period.
    """
    if flight.log.control.t.size == 0 or flight.log.plant.t.size == 0:
        place = flight.directory or flight.name
        raise FileError(place, "holds nothing to film: the flight ended before its first control period")
    failures = failure_sentences(flight)
    if flight.log.reason is None and flight.departure is not None and flight.departure.leaving:
        failures.insert(0, flight.departure.sentence)
    return Filmed(
        name=flight.name,
        controller=flight.numbers["controller"].get("name", ""),
        vehicle=flight.actual,
        log=flight.log,
        limits=flight.limits,
        events=tuple(flight.numbers.get("events", ())),
        failures=tuple(failures),
    )


@dataclass(frozen=True, kw_only=True)
class Shot:
    """The frames to film, and their size."""

    width: int = 1280  # [pixels], even
    height: int = 720  # [pixels], even
    fps: int = 30  # frames per second of film
    speed: float = 1.0  # simulated seconds per second of film
    first: int = 0  # first frame to film
    count: int  # how many
    captions: bool = True  # which small pictures have no room for

    @property
    def times(self) -> Array:
        """(count,) simulated times of the frames [s]."""
        return self.speed / self.fps * np.arange(self.first, self.first + self.count, dtype=float)


@dataclass(frozen=True, kw_only=True)
class MarginTrack:
    """One limit's margins at frame times, in the limit's unit."""

    limit: Limit  # the limit
    now: Array  # (F,) signed margin; NaN outside the limit's time window
    worst: Array  # (F,) smallest margin so far, of the samples too; NaN before the limit's time window
    violated: Mask  # (F,) whether it is violated
    violated_before: Mask  # (F,) whether it is or has been violated
    share: float  # smallest margin of the whole flight as a share of half the band; inf if it never applies


def ranked_tracks(tracks: Iterable[MarginTrack]) -> list[MarginTrack]:
    """Return tracks in order: limits that are violated, the required ones first, then the others.

    In each group the nearest come first, and those whose shares are tied (`quadsim.ties`) in the order of the tracks.
    """
    required: list[MarginTrack] = []
    reported: list[MarginTrack] = []
    held: list[MarginTrack] = []
    for track in tracks:
        if not track.violated_before[-1:].any():
            held.append(track)
        elif track.limit.required:
            required.append(track)
        else:
            reported.append(track)
    ranked = []
    for group in (required, reported, held):
        order = in_order([track.share for track in group])
        ranked += [group[i] for i in order]
    return ranked


@dataclass(frozen=True, kw_only=True)
class Footage:
    """A flight at F frame times."""

    times: Array  # (F,) [s]
    period: Indices  # (F,) index of the control period each frame is in
    position: Array  # (F, 3) [m], world
    euler: Array  # (F, 3) roll, pitch, yaw [rad], of the plant row before the frame
    quaternion: Array  # (F, 4) attitude, scalar first
    tilt: Array | None
    """(F,) angle between the thrust axis and the vertical [rad], of the plant row before the frame; None of flights
    that Euler angles describe."""
    speeds: Array  # (F, 4) rotor speeds [rad/s]
    turned: Array  # (F, 4) angle each rotor has turned since the start [rad]
    aim: Array  # (F, 3) what the camera looks at [m]
    margins: tuple[MarginTrack, ...]  # one track per limit
    path_times: Array  # (P,) times of the flown path's points [s], at most a second apart
    path: Array  # (P, 3) flown path of the whole flight [m], thinned where it is straight
    course: Array  # (Q, 3) reference path of the whole flight [m], thinned
    wind: Array | None  # (F, 3) velocity of the air, world [m/s]; None without wind
    force: Array | None  # (F, 3) external force, world [N]; None where there is none


def make_footage(run: Filmed, times: Array) -> Footage:
    """Read a flight at frame times; times beyond the flight show its ends."""
    plant = run.log.plant
    times = np.clip(times, 0.0, run.end)
    before = np.clip(np.searchsorted(plant.t, times + 1e-9, side="right") - 1, 0, max(plant.t.size - 2, 0))
    after = np.minimum(before + 1, plant.t.size - 1)
    share = ((times - plant.t[before]) / np.where(after > before, plant.t[after] - plant.t[before], 1.0))[:, None]
    positions = plant.state[:, POSITION]
    position = (1.0 - share) * positions[before] + share * positions[after]
    steps = np.diff(plant.t, prepend=plant.t[:1])[:, None]
    turned = np.cumsum(steps * np.abs(plant.speeds), axis=0)
    tolerance = _TOLERANCE * run.vehicle.longest_arm
    seconds = np.searchsorted(plant.t, np.arange(plant.t[0], plant.t[-1]))
    path_rows = np.union1d(thin(positions, tolerance), seconds)
    course = run.log.control.reference[:, :3]
    tilts = None
    if plant.attitude is not None:
        tilts = tilt(plant.state[before])
    wind = None
    if plant.wind is not None:
        wind = plant.wind[before]
    force = None
    if plant.wrench is not None and np.any(plant.wrench[:, :3]):
        force = plant.wrench[before, :3]
    return Footage(
        times=times,
        period=_row_before(run.log.control.t, times),
        position=position,
        euler=plant.state[before][:, EULER],
        tilt=tilts,
        quaternion=_attitude_between(euler_to_quaternion(plant.state[:, EULER]), before, after, share),
        speeds=plant.speeds[before],
        turned=(1.0 - share) * turned[before] + share * turned[after],
        aim=_camera_aim(run, times, position),
        margins=tuple(_track(run, limit, times) for limit in run.limits),
        path_times=plant.t[path_rows],
        path=positions[path_rows],
        course=course[thin(course, tolerance)],
        wind=wind,
        force=force,
    )


def _attitude_between(attitudes: Array, before: Indices, after: Indices, share: Array) -> Array:
    """Quaternions (F, 4) at a share (F, 1) of the way from rows to others, by the shorter turn."""
    start = attitudes[before]
    end = attitudes[after]
    end = np.where((start * end).sum(axis=1, keepdims=True) < 0.0, -end, end)
    quaternion = (1.0 - share) * start + share * end
    return quaternion / np.linalg.norm(quaternion, axis=1, keepdims=True)


def _camera_aim(run: Filmed, times: Array, position: Array) -> Array:
    """What the camera looks at (F, 3) [m]: the smoothed path, never far from the vehicle's position (F, 3)."""
    plant = run.log.plant
    axes = plant.state[:, POSITION].T
    smooth = np.stack([np.interp(times, plant.t, _smooth(plant.t, axis)) for axis in axes], axis=1)
    leash = _LEASH * run.vehicle.longest_arm
    return position + np.clip(smooth - position, -leash, leash)


def _row_before(t: Array, times: Array) -> Indices:
    """The last row of increasing instants t at each of the times."""
    return np.clip(np.searchsorted(t, times + 1e-9, side="right") - 1, 0, t.size - 1)


def _track(run: Filmed, limit: Limit, times: Array) -> MarginTrack:
    """Follow a limit's margin at frame times."""
    t, values = limit.source.finest(run.log)
    margin = margins_at(limit, t, values)
    violated = limit.violated(margin)
    sampled = margins_sampled(limit, run.log)
    sample_rows = _row_before(t, run.log.control.t)
    np.fmin.at(margin, sample_rows, sampled)  # a violating command does not show in saturated rotors
    np.logical_or.at(violated, sample_rows, limit.violated(sampled, sampled=True))
    worst = np.fmin.accumulate(margin)
    violated_before = np.logical_or.accumulate(violated)
    share = float(worst[-1]) / limit.half_band
    if np.isnan(share):
        share = np.inf
    frame_rows = _row_before(t, times)
    return MarginTrack(
        limit=limit,
        now=margin[frame_rows],
        worst=worst[frame_rows],
        violated=violated[frame_rows],
        violated_before=violated_before[frame_rows],
        share=share,
    )


def _smooth(t: Array, values: Array) -> Array:
    """Filter by a first-order low-pass, forward then backward, so that the picture neither lags nor leads."""
    if t.size < 2:
        return values
    keep = float(np.exp(-(t[-1] - t[0]) / (t.size - 1) / _CAMERA_MEMORY))
    for _ in range(2):
        smooth = values.copy()
        for i in range(1, smooth.size):
            smooth[i] = keep * smooth[i - 1] + (1.0 - keep) * values[i]
        values = smooth[::-1]
    return values


def thin(points: Array, tolerance: float) -> Indices:
    """Rows of a path (n, 3) that show it within `tolerance` [m], first and last included (Ramer-Douglas-Peucker)."""
    thinned = {0, len(points) - 1}
    open_spans = [(0, len(points) - 1)]
    while open_spans:
        first, last = open_spans.pop()
        inner = points[first + 1 : last] - points[first]
        chord = points[last] - points[first]
        if not len(inner):
            continue
        along = np.clip(inner @ chord / max(float(chord @ chord), np.finfo(float).tiny), 0.0, 1.0)
        apart = np.linalg.norm(inner - along[:, None] * chord, axis=1)
        if apart.max() > tolerance:
            middle = first + 1 + int(np.argmax(apart))
            thinned.add(middle)
            open_spans += [(first, middle), (middle, last)]
    return np.array(sorted(thinned))
