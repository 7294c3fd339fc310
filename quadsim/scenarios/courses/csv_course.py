"""Courses from a CSV file: its text becomes a `Table` of rows, and that a path through them.

`quadsim.scenarios.courses.table_formats` says which column is which quantity, and
`quadsim.scenarios.courses.table_checks` doubts or refuses numbers that contradict each other.
"""

from __future__ import annotations

import csv
import hashlib
import io
import math
from collections.abc import Iterable, Mapping, Sequence
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
from quadsim.rotation import quaternion_to_euler
from quadsim.scenarios.courses.course import CLOSEST, EXACT, Course, Path, Travelled, begin
from quadsim.scenarios.courses.legs import polyline
from quadsim.scenarios.courses.table_checks import (
    acceleration_notes,
    check_turns,
    distance_notes,
    speed_notes,
    velocity_notes,
    yaw_notes,
)
from quadsim.scenarios.courses.table_formats import (
    ACCELERATION_QUANTITIES,
    PIECE_DURATION,
    POLYNOMIAL_AXES,
    POLYNOMIAL_DEGREE,
    POLYNOMIALS,
    POSITION_QUANTITIES,
    QUATERNION_QUANTITIES,
    VELOCITY_QUANTITIES,
    nearest_format,
    table_format,
)
from quadsim.state import Array, unwrapped
from quadsim.ties import TIE_SHARE, first_smallest

POSE_HEADER: Final = ("t", "x", "y", "z", "yaw")
LARGEST_NUMBER: Final = 1e6  # largest magnitude of a number in the table, as in the scenario file
MOST_COURSE_ROWS: Final = 200_000  # rows below the header: 200 s at 1 kHz. Each is held in memory
ROUNDED_DECIMALS: Final = range(2, 8)
"""Decimals of a rounded column: with fewer its numbers are exact, with more rounding cannot be detected."""
TableFactor = Annotated[float, Ge(1e-3), Le(1e3)]  # of a table's lengths or times
OTHER_SEPARATORS: Final = {";": "semicolons", "\t": "tabs", " ": "spaces"}  # refused
QUATERNION_TOLERANCE: Final = 0.01  # largest difference of a quaternion's length from 1
LARGEST_GAP: Final = 0.01  # between a piece and the next [m, rad]


@dataclass(frozen=True, kw_only=True)
class Table:
    """A course's rows."""

    t: Array  # (n,) increasing, the first at least 0 [s]
    poses: Array  # (n, 4) x, y, z [m], yaw [rad], yaw unwrapped
    velocities: Array | None  # (n, 3) [m/s]; None where the file has none
    accelerations: Array | None = None  # (n, 3) [m/s^2]; None where the file has none, or no velocities
    has_yaw: bool = True  # whether the file states a heading; else it is the initial one
    pieces: Array | None = None
    """(n - 1, 4, 8) of a file of polynomials: the coefficients of x, y, z, yaw from the constant up, by time since the
    start of the piece; else None, and the rows say all."""
    sha256: str  # hash of the file
    # one unit of the last decimal in each column of the poses [m, m, m, rad]; 0 where it is not rounded
    resolution: tuple[float, ...] = EXACT
    notes: tuple[str, ...] = ()  # columns that contradict each other, or look as if they were in another unit


@dataclass(frozen=True, kw_only=True)
class Csv(Travelled):
    """A table with the header t,x,y,z[,yaw][,vx,vy,vz][,ax,ay,az], or of another format; yaw in RADIANS."""

    type: Annotated[Literal["csv"], doc("kind of course: a table in a file")]
    file: Annotated[
        str,
        doc(
            "path of the CSV file, relative to the scenario file; t [s] after start, x, y, z [m], yaw [rad] (radians, "
            "as ref_yaw in flight.parquet; absent: the initial yaw), vx, vy, vz [m/s], ax, ay, az [m/s^2]; or "
            "polynomials by piece, or as of pmm_uav_planner and uav_trajectories (docs/conventions.md)"
        ),
    ]
    sha256: Annotated[
        Annotated[str, StringConstraints(pattern="^[0-9a-f]{64}$")] | None,
        doc("hash of the file, recorded when it is read; a file with another hash is refused"),
    ] = None
    length_factor: Annotated[TableFactor, doc("[-] by which the lengths of the file are multiplied")] = 1.0
    time_factor: Annotated[TableFactor, doc("[-] by which its times are multiplied; 2: at half its speed")] = 1.0
    lift: Annotated[Number, doc("[m] by which the course is raised, after length_factor")] = 0.0

    @property
    def content(self) -> bytes | None:
        """Content of the file of a table made by `tabulated`; None if it is read from a file."""
        content: bytes | None = vars(self).get("content")
        return content

    def build(self, initial: Array, gravity: float) -> Course:
        """As `Filtered.build`."""
        path = FilePath(self.file)
        if self.content is None:
            table = read_course_table(path)
        else:
            table = parse_rows(path, self.content)
        if self.sha256 not in (None, table.sha256):
            raise FileError(self.file, f"is not the file of the scenario: its SHA-256 is not {self.sha256}")
        if not table.has_yaw:
            initial_yaw = np.full(len(table.t), initial[3])
            table = replace(table, poses=np.column_stack([table.poses[:, :3], initial_yaw]))
        table = self._rescaled_rows(table)
        course = begin(through_rows(table), start=self.start + float(table.t[0]), initial=initial)
        return replace(course, notes=(*course.notes, *distance_notes(table.poses[0, :3], initial[:3])))

    def rescaled(self, *, length: float, time: float, lift: float) -> Csv:
        """Return the course with lengths and times multiplied, `start` included, and then raised [m]."""
        repeat = self.repeat
        if repeat is not None:
            repeat = time * repeat
        yaw_rate = self.yaw_rate
        if self.looks_ahead:
            yaw_rate = yaw_rate / time
        return replace(
            self,
            start=time * self.start,
            response_time=time * self.response_time,
            repeat=repeat,
            yaw_rate=yaw_rate,
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
        accelerations = table.accelerations
        if accelerations is not None:
            accelerations = accelerations * (self.length_factor / self.time_factor**2)
        pieces = table.pieces
        if pieces is not None:
            pieces = pieces * scale[:, None] / self.time_factor ** np.arange(POLYNOMIAL_DEGREE + 1)
            pieces[:, 2, 0] += self.lift
        return replace(
            table,
            t=self.time_factor * table.t,
            poses=poses,
            velocities=velocities,
            accelerations=accelerations,
            pieces=pieces,
            resolution=tuple((scale * table.resolution).tolist()),
        )

    def located(self, directory: FilePath) -> Csv:
        """Return the table with absolute path and hash, so that a resolved scenario defines its flight.

        Raises:
            FileError: what is there is no such table.
        """
        for path in (directory / self.file, FilePath(self.file)):
            if path.is_file():
                digest = self.sha256 or read_course_table(path).sha256
                return replace(self, file=str(path.resolve()), sha256=digest)
        return self


def tabulated(file: str, t: Array, poses: Array) -> Csv:
    """Return a course of poses (n, 4) x, y, z [m], yaw [rad] at times t (n,) [s], with its file in memory.

    Every digit is written, with an exponent: no column looks rounded.
    """
    lines = [",".join(POSE_HEADER)]
    for row in np.column_stack([t, poses]):
        lines.append(",".join(f"{value:.16e}" for value in row))
    content = "".join(f"{line}\n" for line in lines).encode()
    course = Csv(type="csv", file=file, sha256=hashlib.sha256(content).hexdigest())
    vars(course).update(content=content)
    return course


def read_course_table(path: FilePath) -> Table:
    """Read a file of one of `quadsim.scenarios.courses.table_formats.TABLE_FORMATS`, yaw in radians; see `parse_rows`.

    Raises:
        FileError: it cannot be read, or as of `parse_rows`.
    """
    try:
        if path.exists() and not path.is_file():
            raise FileError(path, "cannot be read (it is not a file)")
        size = path.stat().st_size
        if size > LARGEST_CSV:
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
    rows = _read_cells(path, content)
    header: tuple[str, ...] = ()
    if rows:
        header = tuple(cell.strip().lower() for cell in rows[0])
    if not header:
        raise FileError(path, "row 1: must be a header, such as t,x,y,z,yaw; the file is empty")
    known = table_format(header)
    if known is None:
        separator = _foreign_separator(header)
        if separator is not None:
            raise FileError(path, f"row 1: columns must be separated by commas; they are by {separator}")
        raise FileError(path, f"row 1: no known header, of {len(header)} columns; {nearest_format(header)}")
    kind, places = known
    fewest_rows = 2
    if kind is POLYNOMIALS:
        fewest_rows = 1
    if len(rows) < fewest_rows + 1:
        raise FileError(path, f"must have {fewest_rows} or more rows below its header; got {len(rows) - 1}")
    if len(rows) > MOST_COURSE_ROWS + 1:
        raise FileError(path, f"must have {MOST_COURSE_ROWS} or fewer rows below its header")
    numbers = np.array([_parse_row(path, number, row, header) for number, row in enumerate(rows[1:], start=2)])
    digest = hashlib.sha256(content).hexdigest()
    if kind is POLYNOMIALS:
        return _table_of_pieces(path, numbers, places, digest)
    return _table_of_rows(path, rows, numbers, places, digest)


def _read_cells(path: FilePath, content: bytes) -> list[list[str]]:
    """Return the cells of a file, row by row, without empty rows at its end and an empty last column."""
    try:
        lines = csv.reader(io.StringIO(content.decode("utf-8-sig"), newline=""), strict=True)
        rows = list(islice(lines, MOST_COURSE_ROWS + 2))
    except (ValueError, csv.Error) as error:
        raise FileError(path, f"cannot be read ({error})") from error
    while rows and not rows[-1]:
        rows.pop()
    if rows and len(rows[0]) > 1 and not any(row[-1].strip() for row in rows if row):
        return [row[:-1] for row in rows]  # lines that end with a comma
    return rows


def _foreign_separator(header: Sequence[str]) -> str | None:
    """Return what separates a header's columns where no comma does; None if nothing does."""
    if len(header) > 1:
        return None
    for separator, name in OTHER_SEPARATORS.items():
        if separator in header[0]:
            return name
    return None


def _table_of_rows(
    path: FilePath, rows: list[list[str]], numbers: Array, places: Mapping[str, int], digest: str
) -> Table:
    """Return the table of a file with a row per instant."""
    t = numbers[:, places["t"]]
    _check_increasing(path, t, rows, places["t"])
    positions = numbers[:, [places[quantity] for quantity in POSITION_QUANTITIES]]
    stated_yaw = _stated_yaw(path, numbers, places)
    heading = np.zeros(len(t))
    if stated_yaw is not None:
        heading = stated_yaw
    check_turns(path, heading)
    poses = np.column_stack([positions, unwrapped(heading, float(heading[0]))])
    velocities = _columns(numbers, places, VELOCITY_QUANTITIES)
    accelerations = _columns(numbers, places, ACCELERATION_QUANTITIES)
    resolution = _resolutions(rows, places)
    notes = [*speed_notes(path, t, positions), *yaw_notes(path, t, poses[:, 3])]
    if velocities is not None:
        notes += velocity_notes(path, t, poses, velocities, resolution)
        if accelerations is not None:
            notes += acceleration_notes(t, velocities, accelerations)
    elif accelerations is not None:
        notes.append(
            f"columns {','.join(ACCELERATION_QUANTITIES)} are not used without {','.join(VELOCITY_QUANTITIES)}"
        )
        accelerations = None
    return Table(
        t=t,
        poses=poses,
        velocities=velocities,
        accelerations=accelerations,
        has_yaw=stated_yaw is not None,
        sha256=digest,
        resolution=resolution,
        notes=tuple(notes),
    )


def _check_increasing(path: FilePath, t: Array, rows: list[list[str]], column: int) -> None:
    """Refuse times (n,) [s] that begin before 0 or do not increase; messages quote them as the file has them."""
    if t[0] < 0.0:
        raise FileError(path, f"row 2, column t: must be >= 0; got {rows[1][column]}")
    (late,) = np.nonzero(np.diff(t) <= 0.0)
    if late.size:
        number = int(late[0]) + 3
        rule = f"must be above that of the row before = {rows[number - 2][column]}"
        raise FileError(path, f"row {number}, column t: {rule}; got {rows[number - 1][column]}")


def _columns(numbers: Array, places: Mapping[str, int], quantities: Sequence[str]) -> Array | None:
    """(n, k) the numbers of quantities; None where the file has none."""
    if quantities[0] not in places:
        return None
    return numbers[:, [places[quantity] for quantity in quantities]]


def _stated_yaw(path: FilePath, numbers: Array, places: Mapping[str, int]) -> Array | None:
    """Return the yaw (n,) [rad] of a column, or else of quaternions; None where the file has neither."""
    yaw = _columns(numbers, places, ("yaw",))
    if yaw is not None:
        return yaw[:, 0].copy()
    quaternions = _columns(numbers, places, QUATERNION_QUANTITIES)
    if quaternions is not None:
        return _yaw_of(path, quaternions)
    return None


def _resolutions(rows: list[list[str]], places: Mapping[str, int]) -> tuple[float, ...]:
    """Return the resolutions of x, y, z [m] and yaw [rad]; 0 for a yaw that the file does not have."""
    resolutions = []
    for quantity in (*POSITION_QUANTITIES, "yaw"):
        if quantity in places:
            column = places[quantity]
            resolutions.append(_resolution(row[column] for row in rows[1:]))
        else:
            resolutions.append(0.0)
    return tuple(resolutions)


def _yaw_of(path: FilePath, quaternions: Array) -> Array:
    """Return the yaw (n,) [rad] of attitudes (n, 4), scalar first."""
    lengths = np.linalg.norm(quaternions, axis=1)
    (wrong,) = np.nonzero(np.abs(lengths - 1.0) > QUATERNION_TOLERANCE)
    if wrong.size:
        row = int(wrong[0]) + 2
        raise FileError(path, f"row {row}: the quaternion must be of length 1; got {lengths[wrong[0]]:.4g}")
    return quaternion_to_euler(quaternions / lengths[:, None])[:, 2]


def _table_of_pieces(path: FilePath, numbers: Array, places: Mapping[str, int], digest: str) -> Table:
    """Return the table of a file with a row per piece: its duration, and a polynomial of each axis."""
    durations = numbers[:, places[PIECE_DURATION]]
    (short,) = np.nonzero(durations < CLOSEST)
    if short.size:
        row = int(short[0]) + 2
        raise FileError(path, f"row {row}, column duration: must be {CLOSEST} s or more; got {durations[short[0]]:g}")
    has_yaw = "yaw^0" in places
    pieces = np.zeros((len(numbers), len(POLYNOMIAL_AXES), POLYNOMIAL_DEGREE + 1))
    for axis, name in enumerate(POLYNOMIAL_AXES):
        if name == "yaw" and not has_yaw:
            continue
        for i in range(POLYNOMIAL_DEGREE + 1):
            pieces[:, axis, i] = numbers[:, places[f"{name}^{i}"]]
    powers = durations[:, None] ** np.arange(POLYNOMIAL_DEGREE + 1)
    ends = np.einsum("nai,ni->na", pieces, powers)
    _check_gaps(path, starts=pieces[1:, :, 0], ends=ends[:-1])
    t = np.concatenate([[0.0], np.cumsum(durations)])
    poses = np.vstack([pieces[:, :, 0], ends[-1:]])
    notes = (*speed_notes(path, t, poses[:, :3]), *yaw_notes(path, t, poses[:, 3]))
    return Table(
        t=t,
        poses=poses,
        velocities=None,
        pieces=pieces,
        has_yaw=has_yaw,
        sha256=digest,
        notes=notes,
    )


def _check_gaps(path: FilePath, *, starts: Array, ends: Array) -> None:
    """Refuse pieces that do not start (n - 1, 4) where those before them end (n - 1, 4) [m, m, m, rad]."""
    gaps = np.abs(starts - ends)
    (apart,) = np.nonzero(gaps.max(axis=1, initial=0.0) > LARGEST_GAP)
    if apart.size:
        i = int(apart[0])
        gap = float(gaps[i].max())
        axis = POLYNOMIAL_AXES[first_smallest(-gaps[i], TIE_SHARE * gap)]
        rule = "must be where the piece before it ends"
        raise FileError(path, f"row {i + 3}, column {axis}^0: {rule}; it is {gap:.4g} off")


def through_rows(table: Table) -> Path:
    """Return the path from the first row, whose time becomes 0, to the last.

    Straight lines between rows; where the table has velocities the cubics that meet them (cubic Hermite interpolation),
    and where it has accelerations, too, the polynomials of degree 5; yaw is straight in all of these.  Of a table of
    polynomials it is those.
    """
    t = table.t - table.t[0]
    straight = polyline(t, table.poses)
    if table.pieces is not None:
        return replace(_through_pieces(t, table), notes=table.notes)
    if table.velocities is None:
        return replace(straight, resolution=table.resolution, notes=table.notes)
    from scipy.interpolate import BPoly

    known = [table.poses[:, :3], table.velocities]
    if table.accelerations is not None:
        known.append(table.accelerations)
    curve = BPoly.from_derivatives(t, np.stack(known, axis=1))

    def pose(times: Array) -> Array:
        return np.hstack([curve(times), straight.pose(times)[:, 3:]])

    return replace(straight, pose=pose, resolution=table.resolution, notes=table.notes)


def _through_pieces(t: Array, table: Table) -> Path:
    """Return the path of a table of polynomials, its pieces at times t (n,) [s]."""
    from scipy.interpolate import PPoly

    assert table.pieces is not None
    coefficients = np.moveaxis(table.pieces[:, :, ::-1], (0, 1, 2), (1, 2, 0))  # (8, n - 1, 4), the highest first
    curve = PPoly(coefficients, t)

    def pose(times: Array) -> Array:
        poses = np.asarray(curve(times))
        if not table.has_yaw:
            poses[:, 3] = table.poses[0, 3]
        return poses

    return Path(pose=pose, duration=float(t[-1]), kinks=tuple(t.tolist()))


def _resolution(cells: Iterable[str]) -> float:
    """Return one unit of a column's last decimal, or 0 if the column does not look rounded."""
    decimals = 0
    for cell in cells:
        digits, _, exponent = cell.strip().lower().partition("e")
        decimals = max(decimals, len(digits.partition(".")[2]) - int(exponent or 0))
    if decimals in ROUNDED_DECIMALS:
        return 10.0**-decimals
    return 0.0


def _parse_row(path: FilePath, number: int, row: list[str], header: tuple[str, ...]) -> list[float]:
    """Return the numbers of a row; the header is row 1."""
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


def _short(text: str) -> str:
    """Return a cell in quotes, its end cut off where it is long."""
    if len(text) > 60:
        text = text[:57] + "..."
    return repr(text)
