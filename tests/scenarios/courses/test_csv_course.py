"""Courses from CSV files: what is read, and the messages for every file that is wrong."""

from __future__ import annotations

import hashlib
import io
import math
from pathlib import Path

import numpy as np
import pytest

import quadsim
from quadsim.console.console import to_text
from quadsim.errors import FileError
from quadsim.scenarios.catalogue import scenario_names
from quadsim.scenarios.courses.csv_course import Csv, Table, read_course_table, through_rows
from quadsim.state import Array

ROWS = "0,0,0,1,0\n1,2,0,1,0.5\n3,2,4,2,1\n"


def write(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "course.csv"
    path.write_text(text, encoding="utf-8")
    return path


def test_a_table_is_read_with_its_hash(tmp_path: Path) -> None:
    path = write(tmp_path, f"t,x,y,z,yaw\n{ROWS}\n\n")
    table = read_course_table(path)
    np.testing.assert_array_equal(table.t, [0.0, 1.0, 3.0])
    np.testing.assert_array_equal(table.poses, [[0, 0, 1, 0], [2, 0, 1, 0.5], [2, 4, 2, 1]])
    assert table.velocities is None
    assert table.sha256 == hashlib.sha256(path.read_bytes()).hexdigest()


def test_what_spreadsheets_write_is_read_as_well(tmp_path: Path) -> None:
    """A byte order mark, carriage returns, quotes and blanks around numbers."""
    path = tmp_path / "course.csv"
    path.write_bytes(b'\xef\xbb\xbft,x,y,z,yaw\r\n0,"1.5", 2 ,3e0,-1\r\n1,0,0,0,0\r\n')
    np.testing.assert_array_equal(read_course_table(path).poses[0], [1.5, 2.0, 3.0, -1.0])


def test_it_is_known_to_how_many_decimals_a_column_is_rounded(tmp_path: Path) -> None:
    """Whole numbers are exact; of doubles in full nobody can know."""
    table = read_course_table(write(tmp_path, "t,x,y,z,yaw\n0,0.1234,1.5,3, 1e-3\n1,0.2,-2,4,0.30000000000000004\n"))
    assert table.resolution == (1e-4, 0.0, 0.0, 0.0)
    table = read_course_table(write(tmp_path, "t,x,y,z,yaw\n0,12.5e-3,1.25,0.123456789,0\n1,0,-2,4,0\n"))
    assert table.resolution == (1e-4, 1e-2, 0.0, 0.0)
    assert through_rows(table).resolution == table.resolution


def test_without_velocities_lines_are_straight(tmp_path: Path) -> None:
    path = through_rows(read_course_table(write(tmp_path, f"t,x,y,z,yaw\n{ROWS}")))
    poses = path.pose(np.array([0.0, 0.5, 1.0, 2.0, 3.0]))
    expected = [[0, 0, 1, 0], [1, 0, 1, 0.25], [2, 0, 1, 0.5], [2, 2, 1.5, 0.75], [2, 4, 2, 1]]
    np.testing.assert_allclose(poses, expected)
    assert (path.duration, path.kinks) == (3.0, (0.0, 1.0, 3.0))


def test_with_velocities_a_cubic_is_met_exactly() -> None:
    t = np.array([2.0, 2.5, 4.0, 4.2])
    cubic = np.array([[1.0, -2.0, 0.5], [0.3, 1.0, -1.0], [0.2, 0.0, 0.4], [-0.1, 0.05, 0.02]])

    def at(times: np.ndarray, order: int = 0) -> np.ndarray:
        return np.stack([np.polynomial.Polynomial(column).deriv(order)(times) for column in cubic.T], axis=1)

    table = Table(t=t, poses=np.column_stack([at(t), t]), velocities=at(t, 1), sha256="")
    path = through_rows(table)
    since = np.linspace(0.0, 2.2, 50)
    np.testing.assert_allclose(path.pose(since)[:, :3], at(2.0 + since), atol=1e-12)
    np.testing.assert_allclose(path.pose(since)[:, 3], 2.0 + since)


def test_yaw_that_wraps_is_unwrapped(tmp_path: Path) -> None:
    path = write(tmp_path, "t,x,y,z,yaw\n0,0,0,0,3.1\n1,0,0,0,-3.1\n2,0,0,0,-2.9\n")
    np.testing.assert_allclose(read_course_table(path).poses[:, 3], [3.1, math.tau - 3.1, math.tau - 2.9])


T = np.arange(0.0, 6.05, 0.1)
RADIUS = 2.0
RATE = 0.5
"""A circle, [m] and [rad/s]: 1 m/s."""


def circle(
    tmp_path: Path, *, velocity: Array | float | None = None, place: float = 1.0, yaw: Array | float = 0.0
) -> Path:
    """A table of the circle; velocity (none: no columns) and place are factors, yaw is the column [rad]."""
    angle = RATE * T
    position = RADIUS * np.stack([np.cos(angle), np.sin(angle), 0.0 * angle], axis=1) * place + [0.0, 0.0, 1.0]
    columns = [T, *position.T, yaw * np.ones_like(T)]
    if velocity is not None:
        columns += [*(RADIUS * RATE * np.stack([-np.sin(angle), np.cos(angle), 0.0 * angle], axis=1) * velocity).T]
    text = io.StringIO()
    np.savetxt(
        text,
        np.stack(columns, axis=1),
        delimiter=",",
        header="t,x,y,z,yaw,vx,vy,vz"[: 11 if velocity is None else 20],
        comments="",
    )
    return write(tmp_path, text.getvalue())


def test_columns_that_agree_have_no_notes(tmp_path: Path) -> None:
    assert read_course_table(circle(tmp_path, velocity=1.0)).notes == ()
    assert read_course_table(circle(tmp_path, yaw=RATE * T)).notes == ()
    for name in scenario_names():
        course = quadsim.load(name).reference
        if isinstance(course, Csv):
            assert read_course_table(Path(course.file)).notes == ()


@pytest.mark.parametrize(
    ("factor", "hint"),
    [(0.0, ""), (3.6, "; is it in km/h?"), (3.281, "; is it in ft/s?"), (-1.0, "; is its sign wrong?"), (0.5, "")],
)
def test_velocities_that_contradict_the_positions_are_noted_with_both_numbers(
    tmp_path: Path, factor: float, hint: str
) -> None:
    notes = read_course_table(circle(tmp_path, velocity=np.array([factor, 1.0, 1.0]))).notes
    moved = float(np.abs(np.diff(RADIUS * np.cos(RATE * T))).sum() / T[-1])
    said = abs(factor) * moved
    assert len(notes) == 1
    words = notes[0].split()
    assert notes[0].startswith("column vx is ")
    assert (float(words[3]), float(words[12])) == (pytest.approx(said, rel=2e-3), pytest.approx(moved, rel=1e-3))
    assert notes[0].endswith(f" m/s{hint}")


def test_velocities_at_rest_in_every_row_are_noted(tmp_path: Path) -> None:
    """Rows a second apart, between which the course would stop each time."""
    rows = "".join(f"{t},{1.5 * t},0,1,0,0,0,0\n" for t in range(9))
    (note,) = read_course_table(write(tmp_path, f"t,x,y,z,yaw,vx,vy,vz\n{rows}")).notes
    assert "vx is 0 m/s" in note
    assert "x moves at 1.5 m/s" in note


@pytest.mark.parametrize(("factor", "hint"), [(1000.0, "mm/s"), (100.0, "cm/s")])
def test_velocities_many_times_those_of_the_positions_are_refused(tmp_path: Path, factor: float, hint: str) -> None:
    with pytest.raises(FileError, match=rf"column vx: .* {hint}\?"):
        read_course_table(circle(tmp_path, velocity=factor))
    rows = "".join(f"{t / 10},0,0,1,0,100,0,0\n" for t in range(20))
    rule = "column vx: must agree with column x, which moves at 0 m/s on average; got 100 m/s"
    with pytest.raises(FileError, match=rule):
        read_course_table(write(tmp_path, f"t,x,y,z,yaw,vx,vy,vz\n{rows}"))


def test_positions_in_millimetres_are_noted_or_refused_by_their_size(tmp_path: Path) -> None:
    (note,) = read_course_table(circle(tmp_path, place=100.0)).notes
    assert "99.99 m/s" in note
    assert "in mm instead of m, 0.09999 m/s" in note
    rule = "must not make the course faster than 340 m/s on average; got 999.9 .if it is in mm instead of m, 0.9999 m/s"
    with pytest.raises(FileError, match=rule):
        read_course_table(circle(tmp_path, place=1000.0))
    still = "t,x,y,z,yaw\n0,0,0,1000,0\n10,0,0,1000,0\n"
    course = Csv(type="csv", file=str(write(tmp_path, still))).build(np.array([0.0, 0.0, 1.0, 0.0]), 9.81)
    (note,) = course.notes
    assert "999 m from the vehicle" in note


def test_yaw_in_degrees_is_noted_or_refused_by_its_size(tmp_path: Path) -> None:
    (note,) = read_course_table(circle(tmp_path, yaw=15.0 * T)).notes
    turned = "column yaw turns at 859.4 deg/s on average; if it is in degrees instead of radians, 15 deg/s"
    assert note == turned
    (note,) = read_course_table(circle(tmp_path, yaw=90.0)).notes
    assert note.startswith(
        "column yaw goes from 5157 to 5157 deg; if it is in degrees instead of radians, from 90 to 90"
    )
    (note,) = read_course_table(circle(tmp_path, yaw=7.5 * T)).notes
    assert "turns at 429.7 deg/s" in note
    (note,) = read_course_table(circle(tmp_path, yaw=6.0 * np.minimum(T, 5.9) - 0.3)).notes
    assert "turns at" in note
    rows = "".join(f"{t / 100},0,0,1,{0.45 * t}\n" for t in range(100))
    with pytest.raises(FileError, match=r"2578 .* 45 deg/s"):
        read_course_table(write(tmp_path, f"t,x,y,z,yaw\n{rows}"))
    wrapped = np.array([math.remainder(170.0 + 10.0 * t, 360.0) for t in T.tolist()])
    with pytest.raises(FileError, match=r"column yaw: .* degrees"):
        read_course_table(circle(tmp_path, yaw=wrapped))


def test_a_turn_of_yaw_per_row_is_refused_as_it_would_be_read_as_none(tmp_path: Path) -> None:
    rows = "".join(f"{t},0,0,1,{math.tau * t}\n" for t in range(7))
    with pytest.raises(FileError, match=r"row 3, column yaw: .* 6\.28319"):
        read_course_table(write(tmp_path, f"t,x,y,z,yaw\n{rows}"))


def test_the_notes_on_a_table_are_part_of_the_flights_summary(tmp_path: Path) -> None:
    table = {"type": "csv", "file": str(circle(tmp_path, yaw=15.0 * T))}
    changes = {"reference": table, "duration": 0.2, "initial.position": [2.0, 0.0, 1.0], "constraints": []}
    scenario = quadsim.load("robust").replace(changes)
    flight = quadsim.fly(scenario, progress=False)
    assert flight.summary["course"]["notes"] == quadsim.feasibility(scenario).notes
    assert any("column yaw turns at 859.4 deg/s" in note for note in flight.summary["course"]["notes"])
    assert "column yaw turns at 859.4 deg/s" in to_text(flight.shown())
