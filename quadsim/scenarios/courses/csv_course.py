"""Courses from a CSV file."""

from __future__ import annotations

import csv
import hashlib
import io
import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path as FilePath
from typing import Annotated, Final, Literal

import numpy as np
from annotated_types import Ge, Le, doc
from pydantic import StringConstraints

from quadsim.errors import FileError
from quadsim.fields import Number
from quadsim.input_limits import LARGEST_CSV
from quadsim.scenarios.courses.course import EXACT, Course, Path, Started, begin
from quadsim.scenarios.courses.legs import polyline
from quadsim.state import Array, unwrapped
from quadsim.ties import TIE_SHARE, first_smallest

POSE_HEADER: Final = ("t", "x", "y", "z", "yaw")
VELOCITY_HEADER: Final = ("vx", "vy", "vz")
LARGEST_NUMBER: Final = 1e6  # largest magnitude of a number in the table, as in the scenario file
MOST_ROWS: Final = 200_000  # rows below the header: 200 s at 1 kHz. Each is held in memory
ROUNDED: Final = range(2, 8)
"""Decimals of a rounded column: with fewer its numbers are exact, with more rounding cannot be detected."""
FAR, FAST, FASTEST = 50.0, 50.0, 340.0
"""Distance of the first row from the vehicle [m] and mean speed [m/s] above which a table is doubted, those at which a
flight is lost by default, and mean speed above which it is refused, that of sound."""
TURNS, TURNING, FASTEST_TURNING = 5.0, 180.0, 2000.0
"""The same for yaw: turns in all, and mean rates [deg/s]; the last is the full scale of the usual gyroscopes."""
DISAGREEMENT: Final = 0.25
"""Mean difference between stated and covered velocity, over the larger of both, above which a table is doubted."""
SMALL: Final = 0.05  # such a difference that is never doubted [m/s]
ALIKE: Final = 0.04  # relative difference up to which a ratio is that of a unit
OVERSTATED: Final = 5.0  # stated over covered velocity, plus 1 m/s, above which a table is refused
Factor = Annotated[float, Ge(1e-3), Le(1e3)]  # of a table's lengths or times
MILLIMETRES: Final = 1000.0  # per m
SPEED_UNITS: Final = {"mm/s": 1000.0, "cm/s": 100.0, "km/h": 3.6, "ft/s": 3.281, "knots": 1.944}  # per m/s


@dataclass(frozen=True, kw_only=True)
class Table:
    """A course's rows."""

    t: Array  # (n,) increasing, the first at least 0 [s]
    poses: Array  # (n, 4) x, y, z [m], yaw [rad], yaw unwrapped
    velocities: Array | None  # (n, 3) [m/s]; None where the file has none
    sha256: str  # hash of the file
    # one unit of the last decimal in each column of the poses [m, m, m, rad]; 0 where it is not rounded
    resolution: tuple[float, ...] = EXACT
    notes: tuple[str, ...] = ()  # columns that contradict each other, or look as if they were in another unit


@dataclass(frozen=True, kw_only=True)
class Csv(Started):
    """A table with the header t,x,y,z,yaw or t,x,y,z,yaw,vx,vy,vz; yaw in RADIANS, as in flight.parquet."""

    type: Annotated[Literal["csv"], doc("kind of course: a table in a file")]
    file: Annotated[
        str,
        doc(
            "path of the CSV file, relative to the scenario file; "
            "t [s] after start, x, y, z [m], yaw [rad] (radians, as ref_yaw in flight.parquet), vx, vy, vz [m/s]"
        ),
    ]
    sha256: Annotated[
        Annotated[str, StringConstraints(pattern="^[0-9a-f]{64}$")] | None,
        doc("hash of the file, recorded when it is read; a file with another hash is refused"),
    ] = None
    length_factor: Annotated[Factor, doc("[-] by which the table's lengths are multiplied")] = 1.0
    time_factor: Annotated[Factor, doc("[-] by which the table's times are multiplied; 2: at half its speed")] = 1.0
    lift: Annotated[Number, doc("[m] by which the course is raised, after length_factor")] = 0.0

    @property
    def content(self) -> bytes | None:
        """Content of the file of a table made by `tabulated`; None if it is read from a file."""
        content: bytes | None = vars(self).get("content")
        return content

    def build(self, initial: Array, gravity: float) -> Course:
        """As `Filtered.build`."""
        path = FilePath(self.file)
        table = read_course_table(path) if self.content is None else parse_rows(path, self.content)
        if self.sha256 not in (None, table.sha256):
            raise FileError(self.file, f"is not the file of the scenario: its SHA-256 is not {self.sha256}")
        table = self._rescaled_rows(table)
        course = begin(through_rows(table), start=self.start + float(table.t[0]), initial=initial)
        return replace(course, notes=(*course.notes, *_far(table.poses[0, :3], initial[:3])))

    def rescaled(self, *, length: float, time: float, lift: float) -> Csv:
        """Return the course with lengths and times multiplied, `start` included, and then raised [m]."""
        return replace(
            self,
            start=time * self.start,
            response_time=time * self.response_time,
            repeat=None if self.repeat is None else time * self.repeat,
            length_factor=length * self.length_factor,
            time_factor=time * self.time_factor,
            lift=length * self.lift + lift,
        )

    def _rescaled_rows(self, table: Table) -> Table:
        """Return the rows with both factors, raised; the table itself where nothing changes."""
        if (self.length_factor, self.time_factor, self.lift) == (1.0, 1.0, 0.0):
            return table
        scale = np.array([self.length_factor, self.length_factor, self.length_factor, 1.0])
        poses = table.poses * scale + np.array([0.0, 0.0, self.lift, 0.0])
        velocities = table.velocities
        if velocities is not None:
            velocities = velocities * (self.length_factor / self.time_factor)
        resolution = tuple((scale * table.resolution).tolist())
        return replace(table, t=self.time_factor * table.t, poses=poses, velocities=velocities, resolution=resolution)

    def located(self, directory: FilePath) -> Csv:
        """Return the table with absolute path and hash, so that a resolved scenario defines its flight.

        Raises:
            FileError: what is there is no such table.
        """
        for path in (directory / self.file, FilePath(self.file)):
            if path.is_file():
                return replace(self, file=str(path.resolve()), sha256=self.sha256 or read_course_table(path).sha256)
        return self


def tabulated(file: str, t: Array, poses: Array) -> Csv:
    """Return a course of poses (n, 4) x, y, z [m], yaw [rad] at times t (n,) [s], with its file in memory.

    Every digit is written, with an exponent: no column looks rounded.
    """
    rows = (",".join(f"{value:.16e}" for value in row) for row in np.column_stack([t, poses]))
    content = "\n".join([",".join(POSE_HEADER), *rows, ""]).encode()
    course = Csv(type="csv", file=file, sha256=hashlib.sha256(content).hexdigest())
    vars(course).update(content=content)
    return course


def read_course_table(path: FilePath) -> Table:
    """Read a file with the header `t,x,y,z,yaw` or `t,x,y,z,yaw,vx,vy,vz`, yaw in radians; see `parse_rows`.

    Raises:
        FileError: it cannot be read, or as of `parse_rows`.
    """
    try:
        if path.exists() and not path.is_file():
            raise FileError(path, "cannot be read (it is not a file)")
        if (size := path.stat().st_size) > LARGEST_CSV:
            raise FileError(path, f"must be of {LARGEST_CSV} or fewer bytes; got {size}")
        content = path.read_bytes()
    except FileError:
        raise
    except (OSError, ValueError) as error:  # the latter for a null byte
        raise FileError(path, f"cannot be read ({error})") from error
    return parse_rows(path, content)


def parse_rows(path: FilePath, content: bytes) -> Table:
    """Parse the rows of a file's content.

    Yaw that changes by more than half a turn between rows is taken as wrapped, and unwrapped.

    Raises:
        FileError: naming the row (the header is row 1) and the column that is wrong; or columns contradict each other,
            or are in another unit, beyond doubt.
    """
    try:
        lines = csv.reader(io.StringIO(content.decode("utf-8-sig"), newline=""), strict=True)
        rows = list(islice(lines, MOST_ROWS + 2))
    except (ValueError, csv.Error) as error:
        raise FileError(path, f"cannot be read ({error})") from error
    while rows and not rows[-1]:
        rows.pop()
    header = tuple(rows[0]) if rows else ()
    if header not in (POSE_HEADER, POSE_HEADER + VELOCITY_HEADER):
        wanted = f"{','.join(POSE_HEADER)} or {','.join(POSE_HEADER + VELOCITY_HEADER)}"
        raise FileError(path, f"row 1: the header must be {wanted}; got {_header_text(header)}")
    if len(rows) < 3:
        raise FileError(path, f"must have 2 or more rows below its header; got {len(rows) - 1}")
    if len(rows) > MOST_ROWS + 1:
        raise FileError(path, f"must have {MOST_ROWS} or fewer rows below its header")
    numbers = np.array([_parse_row(path, number, row, header) for number, row in enumerate(rows[1:], start=2)])
    t = numbers[:, 0]
    if t[0] < 0.0:
        raise FileError(path, f"row 2, column t: must be >= 0; got {rows[1][0]}")
    (late,) = np.nonzero(np.diff(t) <= 0.0)
    if late.size:
        number = int(late[0]) + 3
        rule = f"must be above that of the row before = {rows[number - 2][0]}"
        raise FileError(path, f"row {number}, column t: {rule}; got {rows[number - 1][0]}")
    poses = numbers[:, 1:5].copy()
    _check_turns(path, poses[:, 3])
    poses[:, 3] = unwrapped(poses[:, 3], float(poses[0, 3]))
    velocities = numbers[:, 5:] if len(header) > len(POSE_HEADER) else None
    resolution = tuple(_resolution(row[column] for row in rows[1:]) for column in range(1, 5))
    digest = hashlib.sha256(content).hexdigest()
    notes = [*_speed_notes(path, t, poses[:, :3]), *_yaw_notes(path, t, poses[:, 3])]
    if velocities is not None:
        notes += _velocity_notes(path, t, poses, velocities, resolution)
    return Table(t=t, poses=poses, velocities=velocities, sha256=digest, resolution=resolution, notes=tuple(notes))


def _far(first: Array, vehicle: Array) -> Iterator[str]:
    """Yield a note on a first row (3,) [m] far from the vehicle (3,) [m]."""
    if (distance := math.dist(first, vehicle)) > FAR:
        millimetres = math.dist(first / MILLIMETRES, vehicle)
        yield (
            f"columns x, y, z begin {distance:.4g} m from the vehicle; if they are in mm instead of m, "
            f"{millimetres:.4g} m"
        )


def _speed_notes(path: FilePath, t: Array, positions: Array) -> Iterator[str]:
    """Yield a note on positions (n, 3) [m] that move too fast on average; refuse what cannot be meant."""
    lengths = np.abs(np.diff(positions, axis=0)).sum(axis=0)
    speed = float(np.linalg.norm(np.diff(positions, axis=0), axis=1).sum() / (t[-1] - t[0]))
    column = "xyz"[first_smallest(-lengths, TIE_SHARE * float(lengths.max()))]
    if speed > FASTEST:
        rule = f"column {column}: must not make the course faster than {FASTEST:g} m/s on average; got {speed:.4g}"
        raise FileError(path, f"{rule} (if it is in mm instead of m, {speed / MILLIMETRES:.4g} m/s)")
    if speed > FAST:
        yield (
            f"column {column}: the course moves at {speed:.4g} m/s on average; if it is in mm instead of m, "
            f"{speed / MILLIMETRES:.4g} m/s"
        )


def _check_turns(path: FilePath, yaw: Array) -> None:
    """Refuse a column (n,) [rad] that counts turns, and so is not wrapped, with rows over half a turn apart."""
    if np.ptp(yaw) <= math.tau + 1e-3:
        return
    steps = np.diff(yaw)
    (beyond,) = np.nonzero(np.abs(steps) > math.pi)
    if beyond.size:
        i = int(beyond[0])
        rule = f"must be within half a turn, {math.pi:.4g} rad, of the row before = {yaw[i]:.6g}"
        why = f"the column spans {np.ptp(yaw) / math.tau:.3g} turns; is it in degrees instead of radians?"
        raise FileError(path, f"row {i + 3}, column yaw: {rule}; got {yaw[i + 1]:.6g} ({why})")


def _yaw_notes(path: FilePath, t: Array, yaw: Array) -> Iterator[str]:
    """Yield a note on an unwrapped yaw (n,) [rad] that turns too fast or too far; refuse what cannot be meant."""
    rate = math.degrees(float(np.abs(np.diff(yaw)).sum() / (t[-1] - t[0])))
    many = float(np.ptp(yaw)) > TURNS * math.tau or abs(float(yaw[0])) > math.tau
    if rate > FASTEST_TURNING:
        rule = f"column yaw: must not turn faster than {FASTEST_TURNING:g} deg/s on average; got {rate:.4g}"
        raise FileError(path, f"{rule} (if it is in degrees instead of radians, {math.radians(rate):.4g} deg/s)")
    if rate > TURNING:
        yield (
            f"column yaw turns at {rate:.4g} deg/s on average; if it is in degrees instead of radians, "
            f"{math.radians(rate):.4g} deg/s"
        )
    elif many:
        low, high = float(yaw.min()), float(yaw.max())
        yield (
            f"column yaw goes from {math.degrees(low):.4g} to {math.degrees(high):.4g} deg; if it is in degrees "
            f"instead of radians, from {low:.4g} to {high:.4g} deg"
        )


def _velocity_notes(
    path: FilePath, t: Array, poses: Array, velocities: Array, resolution: Sequence[float]
) -> Iterator[str]:
    """Yield notes on stated velocities (n, 3) [m/s] that contradict the positions; refuse what cannot be meant.

    Between rows, the mean of the two stated velocities is that of the covered distance up to the third derivative.
    """
    periods = np.diff(t)

    def mean(values: Array) -> float:
        return float(periods @ np.abs(values) / periods.sum())

    for name, place, velocity, unit in zip("xyz", poses.T, velocities.T, resolution, strict=False):
        covered, stated = np.diff(place) / periods, 0.5 * (velocity[1:] + velocity[:-1])
        moved, said, off = mean(covered), mean(stated), mean(stated - covered)
        rounding = 2.0 * unit * periods.size / float(periods.sum())
        if off <= DISAGREEMENT * max(moved, said) or off <= SMALL + rounding:
            continue
        ratio = said / moved if moved > 0.0 else math.inf
        likely = [f"; is it in {known}?" for known, factor in SPEED_UNITS.items() if abs(ratio / factor - 1.0) < ALIKE]
        likely += ["; is its sign wrong?"] if mean(stated + covered) < DISAGREEMENT * said else []
        hint = likely[0] if likely else ""
        if said > OVERSTATED * (moved + rounding) + 1.0:
            rule = f"column v{name}: must agree with column {name}, which moves at {moved:.4g} m/s on average"
            raise FileError(path, f"{rule}; got {said:.4g} m/s{hint}")
        yield f"column v{name} is {said:.4g} m/s on average, but column {name} moves at {moved:.4g} m/s{hint}"


def through_rows(table: Table) -> Path:
    """Return the path from the first row, whose time becomes 0, to the last.

    Straight lines between rows, or where the table has velocities the cubics that meet them (cubic Hermite
    interpolation); yaw is straight either way.
    """
    t = table.t - table.t[0]
    straight = polyline(t, table.poses)
    if table.velocities is None:
        return replace(straight, resolution=table.resolution, notes=table.notes)
    from scipy.interpolate import CubicHermiteSpline

    cubics = CubicHermiteSpline(t, table.poses[:, :3], table.velocities)

    def pose(times: Array) -> Array:
        return np.hstack([cubics(times), straight.pose(times)[:, 3:]])

    return replace(straight, pose=pose, resolution=table.resolution, notes=table.notes)


def _resolution(cells: Iterable[str]) -> float:
    """Return one unit of a column's last decimal, or 0 if the column does not look rounded."""
    decimals = 0
    for cell in cells:
        digits, _, exponent = cell.strip().lower().partition("e")
        decimals = max(decimals, len(digits.partition(".")[2]) - int(exponent or 0))
    return 10.0**-decimals if decimals in ROUNDED else 0.0


def _parse_row(path: FilePath, number: int, row: list[str], header: tuple[str, ...]) -> list[float]:
    if len(row) != len(header):
        raise FileError(path, f"row {number}: must have {len(header)} cells ({','.join(header)}); got {len(row)}")
    values = []
    for name, cell in zip(header, row, strict=True):
        place = f"row {number}, column {name}"
        if not cell.strip():
            raise FileError(path, f"{place}: is empty")
        try:
            if "_" in cell:  # which Python reads over
                raise ValueError
            value = float(cell)
        except ValueError:
            raise FileError(path, f"{place}: must be a number; got {_short(cell)}") from None
        if not math.isfinite(value) or abs(value) > LARGEST_NUMBER:
            raise FileError(path, f"{place}: must be a finite number within +-{LARGEST_NUMBER:g}; got {_short(cell)}")
        values.append(value)
    return values


def _header_text(header: tuple[str, ...]) -> str:
    """Describe a header without quoting it: the author of a scenario may not own the file that it names."""
    known = [name for name in header if name in POSE_HEADER + VELOCITY_HEADER]
    return f"{len(header)} columns (known: {','.join(known) if known else 'none'})" if header else "none"


def _short(text: str) -> str:
    return repr(text if len(text) <= 60 else text[:57] + "...")
