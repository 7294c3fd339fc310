"""Courses from a CSV file."""

from __future__ import annotations

import csv
import hashlib
import io
import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path as FilePath
from typing import Annotated, Final, Literal

import numpy as np
from annotated_types import doc
from pydantic import StringConstraints

from quadsim.errors import FileError
from quadsim.input_limits import LARGEST_CSV
from quadsim.state import Array, unwrapped
from scenarios.courses.course import EXACT, Course, Path, Started, begin
from scenarios.courses.legs import polyline

POSE_HEADER: Final = ("t", "x", "y", "z", "yaw")
VELOCITY_HEADER: Final = ("vx", "vy", "vz")
LARGEST: Final = 1e6  # largest magnitude of a number in the table, as in the scenario file
MOST_ROWS: Final = 200_000  # rows below the header: 200 s at 1 kHz. Each is held in memory
ROUNDED: Final = range(2, 8)
"""Decimals of a rounded column: with fewer its numbers are exact, with more rounding cannot be detected."""


@dataclass(frozen=True, kw_only=True)
class Table:
    """A course's rows."""

    t: Array  # (n,) increasing, the first at least 0 [s]
    poses: Array  # (n, 4) x, y, z [m], yaw [rad], yaw unwrapped
    velocities: Array | None  # (n, 3) [m/s]; None where the file has none
    sha256: str  # hash of the file
    # one unit of the last decimal in each column of the poses [m, m, m, rad]; 0 where it is not rounded
    resolution: tuple[float, ...] = EXACT


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

    @property
    def content(self) -> bytes | None:
        """Content of the file of a table made by `tabulated`; None if it is read from a file."""
        content: bytes | None = vars(self).get("content")
        return content

    def build(self, initial: Array, gravity: float) -> Course:
        """As `Filtered.build`."""
        path = FilePath(self.file)
        table = read_table(path) if self.content is None else parse_table(path, self.content)
        if self.sha256 not in (None, table.sha256):
            raise FileError(self.file, f"is not the file of the scenario: its SHA-256 is not {self.sha256}")
        return begin(through_rows(table), start=self.start + float(table.t[0]), initial=initial)

    def located(self, directory: FilePath) -> Csv:
        """Return the table with absolute path and hash, so that a resolved scenario defines its flight.

        Raises:
            FileError: what is there is no such table.
        """
        for path in (directory / self.file, FilePath(self.file)):
            if path.is_file():
                return replace(self, file=str(path.resolve()), sha256=self.sha256 or read_table(path).sha256)
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


def read_table(path: FilePath) -> Table:
    """Read a file with the header `t,x,y,z,yaw` or `t,x,y,z,yaw,vx,vy,vz`, yaw in radians; see `parse_table`.

    Raises:
        FileError: it cannot be read, or as of `parse_table`.
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
    return parse_table(path, content)


def parse_table(path: FilePath, content: bytes) -> Table:
    """Parse the rows of a file's content.

    Yaw that changes by more than half a turn between rows is taken as wrapped, and unwrapped.

    Raises:
        FileError: naming the row (the header is row 1) and the column that is wrong.
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
    poses[:, 3] = unwrapped(poses[:, 3], float(poses[0, 3]))
    velocities = numbers[:, 5:] if len(header) > len(POSE_HEADER) else None
    resolution = tuple(_resolution(row[column] for row in rows[1:]) for column in range(1, 5))
    digest = hashlib.sha256(content).hexdigest()
    return Table(t=t, poses=poses, velocities=velocities, sha256=digest, resolution=resolution)


def through_rows(table: Table) -> Path:
    """Return the path from the first row, whose time becomes 0, to the last.

    Straight lines between rows, or where the table has velocities the cubics that meet them (cubic Hermite
    interpolation); yaw is straight either way.
    """
    t = table.t - table.t[0]
    straight = polyline(t, table.poses)
    if table.velocities is None:
        return replace(straight, resolution=table.resolution)
    from scipy.interpolate import CubicHermiteSpline

    cubics = CubicHermiteSpline(t, table.poses[:, :3], table.velocities)

    def pose(times: Array) -> Array:
        return np.hstack([cubics(times), straight.pose(times)[:, 3:]])

    return Path(pose=pose, duration=straight.duration, kinks=straight.kinks, resolution=table.resolution)


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
        if not math.isfinite(value) or abs(value) > LARGEST:
            raise FileError(path, f"{place}: must be a finite number within +-{LARGEST:g}; got {_short(cell)}")
        values.append(value)
    return values


def _header_text(header: tuple[str, ...]) -> str:
    """Describe a header without quoting it: the author of a scenario may not own the file that it names."""
    known = [name for name in header if name in POSE_HEADER + VELOCITY_HEADER]
    return f"{len(header)} columns (known: {','.join(known) if known else 'none'})" if header else "none"


def _short(text: str) -> str:
    return repr(text if len(text) <= 60 else text[:57] + "...")
