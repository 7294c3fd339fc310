"""Trajectories as planners write them: which columns are what, and what a header is refused with."""

from __future__ import annotations

import math
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from quadsim.errors import FileError
from quadsim.scenarios.courses.csv_course import Csv, read_course_table, through_rows
from quadsim.scenarios.courses.table_formats import TABLE_FORMATS, nearest_format, table_format
from quadsim.state import Array

T = np.arange(0.0, 2.01, 0.25)


def circle(t: Array) -> tuple[Array, Array, Array]:
    """Position, velocity and acceleration (n, 3) on a circle of 1 m at 1 rad/s, 1 m high."""
    zero = np.zeros_like(t)
    position = np.column_stack([np.cos(t), np.sin(t), 1.0 + zero])
    velocity = np.column_stack([-np.sin(t), np.cos(t), zero])
    acceleration = np.column_stack([-np.cos(t), -np.sin(t), zero])
    return position, velocity, acceleration


def write(tmp_path: Path, header: str, *columns: Array) -> Path:
    path = tmp_path / "course.csv"
    rows = [",".join(f"{value:.17e}" for value in row) for row in np.column_stack(columns)]
    path.write_text("\n".join([header, *rows, ""]), encoding="utf-8")
    return path


@pytest.mark.parametrize(
    "header",
    [
        "t,x,y,z,vx,vy,vz,ax,ay,az",
        "t,p_x,p_y,p_z,v_x,v_y,v_z,a_x,a_y,a_z",
        "t,posx,posy,posz,velx,vely,velz,accx,accy,accz",
        "T, X, Y, Z, VX, VY, VZ, AX, AY, AZ",
    ],
)
def test_with_accelerations_the_curve_meets_them(tmp_path: Path, header: str) -> None:
    table = read_course_table(write(tmp_path, header, T, *circle(T)))
    assert not table.has_yaw
    assert table.notes == ()
    path = through_rows(table)
    since = np.linspace(0.0, 2.0, 321)
    np.testing.assert_allclose(path.pose(since)[:, :3], circle(since)[0], atol=2e-7)
    h = 1e-3
    inside = since[8:-8]
    curved = (path.pose(inside + h) - 2.0 * path.pose(inside) + path.pose(inside - h))[:, :3] / h**2
    np.testing.assert_allclose(curved, circle(inside)[2], atol=2e-3)


def test_columns_stand_in_any_order(tmp_path: Path) -> None:
    position, velocity, _ = circle(T)
    path = write(tmp_path, "vx,vy,vz,yaw,z,y,x,t", velocity, 0.1 * T, position[:, ::-1], T)
    table = read_course_table(path)
    np.testing.assert_array_equal(table.poses, np.column_stack([position, 0.1 * T]))
    np.testing.assert_array_equal(table.velocities, velocity)


def test_a_quaternion_gives_the_heading(tmp_path: Path) -> None:
    position, velocity, _ = circle(T)
    yaw = 3.0 + T
    quaternion = np.column_stack([np.cos(0.5 * yaw), 0.0 * T, 0.0 * T, np.sin(0.5 * yaw)])
    header = "t,p_x,p_y,p_z,q_w,q_x,q_y,q_z,v_x,v_y,v_z,w_x,w_y,w_z,u_1,u_2,u_3,u_4"
    table = read_course_table(write(tmp_path, header, T, position, quaternion, velocity, np.zeros((len(T), 7))))
    assert table.has_yaw
    np.testing.assert_allclose(np.diff(table.poses[:, 3]), 0.25, atol=1e-12)
    assert math.remainder(table.poses[0, 3] - 3.0, math.tau) == pytest.approx(0.0, abs=1e-12)
    with pytest.raises(FileError, match="row 2: the quaternion must be of length 1; got 2"):
        read_course_table(write(tmp_path, header, T, position, 2.0 * quaternion, velocity, np.zeros((len(T), 7))))


POLYNOMIAL_HEADER = ",".join(["duration", *(f"{axis}^{i}" for axis in ("x", "y", "z", "yaw") for i in range(8))])


def pieces(*, gap: float = 0.0) -> list[list[float]]:
    """Two pieces of 2 and 1 s: x = t^2 and its tangent on, y = 0, z = 1, yaw = t."""
    none = [0.0] * 8

    def axis(*coefficients: float) -> list[float]:
        return [*coefficients, *none[len(coefficients) :]]

    first = [2.0, *axis(0.0, 0.0, 1.0), *none, *axis(1.0), *axis(0.0, 1.0)]
    second = [1.0, *axis(4.0 + gap, 4.0), *none, *axis(1.0), *axis(2.0, 1.0)]
    return [first, second]


def polynomials(tmp_path: Path, rows: list[list[float]], header: str = POLYNOMIAL_HEADER, end: str = "") -> Path:
    path = tmp_path / "pieces.csv"
    lines = [header + end, *(",".join(map(repr, row)) + end for row in rows)]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


@pytest.mark.parametrize("end", ["", ","])
def test_polynomials_are_flown_as_they_are(tmp_path: Path, end: str) -> None:
    path = through_rows(read_course_table(polynomials(tmp_path, pieces(), end=end)))
    assert path.duration == 3.0
    t = np.array([0.0, 0.5, 1.999, 2.5, 3.0])
    expected = np.column_stack([np.where(t < 2.0, t**2, 4.0 * t - 4.0), 0.0 * t, 1.0 + 0.0 * t, t])
    np.testing.assert_allclose(path.pose(t), expected, atol=1e-12)


def test_polynomials_scale_as_tables_do(tmp_path: Path) -> None:
    file = str(polynomials(tmp_path, pieces()))
    initial = np.array([0.0, 0.0, 1.0, 0.0])
    course = Csv(type="csv", file=file).build(initial, 9.81)
    scaled = Csv(type="csv", file=file, length_factor=2.0, time_factor=3.0, lift=0.5).build(initial, 9.81)
    t = np.linspace(0.01, 3.0, 50)
    expected = course.sample(t) * [2.0, 2.0, 2.0, 1.0] + [0.0, 0.0, 0.5, 0.0]
    np.testing.assert_allclose(scaled.sample(3.0 * t), expected, atol=1e-9)


def test_without_a_heading_it_is_the_initial_one(tmp_path: Path) -> None:
    rows = [row[:25] for row in pieces()]
    header = ",".join(POLYNOMIAL_HEADER.split(",")[:25])
    course = Csv(type="csv", file=str(polynomials(tmp_path, rows, header))).build(np.array([0, 0, 1, 0.7]), 9.81)
    np.testing.assert_allclose(course.sample(np.linspace(0.0, 4.0, 9))[:, 3], 0.7)


def test_pieces_that_do_not_meet_are_refused(tmp_path: Path) -> None:
    with pytest.raises(FileError, match=r"row 3, column x\^0: must be where the piece before it ends; it is 0\.1 off"):
        read_course_table(polynomials(tmp_path, pieces(gap=0.1)))
    rows = pieces()
    rows[1][0] = 0.0
    with pytest.raises(FileError, match=r"row 3, column duration: must be 0\.001 s or more; got 0"):
        read_course_table(polynomials(tmp_path, rows))


def test_accelerations_that_contradict_the_velocities_are_doubted(tmp_path: Path) -> None:
    position, velocity, acceleration = circle(T)
    acceleration[:, 2] += 9.81
    table = read_course_table(write(tmp_path, "t,x,y,z,vx,vy,vz,ax,ay,az", T, position, velocity, acceleration))
    (note,) = table.notes
    assert note.startswith("column az is 9.81 m/s^2 on average, but column vz changes by")
    assert note.endswith("is gravity in it?")


@pytest.mark.parametrize(
    ("header", "parts"),
    [
        ("t,x,y,yaw", ["the nearest known format is quadsim: t,x,y,z,[yaw],[vx,vy,vz],[ax,ay,az]", "missing: z"]),
        ("t,p_x,p_y,p_z,v_x", ["pmm_uav_planner", "missing: v_y,v_z"]),
        ("time,posx,posy,posz,velx,vely,velz", ["uav_trajectories, sampled", "missing: t", "1 column is not of it"]),
        ("x^0,duration,x^1", ["polynomials by piece", "missing: x^2,x^3,x^4,x^5,x^6,x^7, ..."]),
        ("a,b", ["quadsim: t,x,y,z", "2 columns are not of it"]),
        ("t,x,y,z,x", ["a column occurs twice"]),
    ],
)
def test_a_refusal_names_the_nearest_format(tmp_path: Path, header: str, parts: list[str]) -> None:
    path = tmp_path / "course.csv"
    path.write_text(header + "\n1,2\n2,3\n", encoding="utf-8")
    with pytest.raises(FileError) as caught:
        read_course_table(path)
    text = str(caught.value)
    places = [text.index(part) for part in parts]
    assert all(before < after for before, after in pairwise(places))


@pytest.mark.parametrize(("separator", "name"), [(";", "semicolons"), ("\t", "tabs"), (" ", "spaces")])
def test_columns_that_no_comma_separates_are_refused_by_their_separator(
    tmp_path: Path, separator: str, name: str
) -> None:
    path = tmp_path / "course.csv"
    path.write_text(f"{separator.join('txyz')}\n", encoding="utf-8")
    with pytest.raises(FileError, match=f"row 1: columns must be separated by commas; they are by {name}"):
        read_course_table(path)


def test_a_header_is_not_quoted() -> None:
    assert "secret" not in nearest_format(["t", "x", "secret"])


@pytest.mark.parametrize("entry", TABLE_FORMATS, ids=lambda entry: entry.name)
def test_every_format_knows_its_own_headers(entry: object) -> None:
    for known in TABLE_FORMATS:
        header = [known.columns[quantity] for quantity in known.needed]
        found = table_format(header)
        assert found is not None
        assert found[0] is known
