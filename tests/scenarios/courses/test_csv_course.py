"""Courses from CSV files: what is read, and the messages for every file that is wrong."""

from __future__ import annotations

import hashlib
import math
from pathlib import Path

import numpy as np

from scenarios.courses.csv_course import Table, read_table, through_rows

ROWS = "0,0,0,1,0\n1,2,0,1,0.5\n3,2,4,2,1\n"


def write(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "course.csv"
    path.write_text(text, encoding="utf-8")
    return path


def test_a_table_is_read_with_its_hash(tmp_path: Path) -> None:
    path = write(tmp_path, f"t,x,y,z,yaw\n{ROWS}\n\n")
    table = read_table(path)
    np.testing.assert_array_equal(table.t, [0.0, 1.0, 3.0])
    np.testing.assert_array_equal(table.poses, [[0, 0, 1, 0], [2, 0, 1, 0.5], [2, 4, 2, 1]])
    assert table.velocities is None
    assert table.sha256 == hashlib.sha256(path.read_bytes()).hexdigest()


def test_what_spreadsheets_write_is_read_as_well(tmp_path: Path) -> None:
    """A byte order mark, carriage returns, quotes and blanks around numbers."""
    path = tmp_path / "course.csv"
    path.write_bytes(b'\xef\xbb\xbft,x,y,z,yaw\r\n0,"1.5", 2 ,3e0,-1\r\n1,0,0,0,0\r\n')
    np.testing.assert_array_equal(read_table(path).poses[0], [1.5, 2.0, 3.0, -1.0])


def test_it_is_known_to_how_many_decimals_a_column_is_rounded(tmp_path: Path) -> None:
    """Whole numbers are exact; of doubles in full nobody can know."""
    table = read_table(write(tmp_path, "t,x,y,z,yaw\n0,0.1234,1.5,3, 1e-3\n1,0.2,-2,4,0.30000000000000004\n"))
    assert table.resolution == (1e-4, 0.0, 0.0, 0.0)
    table = read_table(write(tmp_path, "t,x,y,z,yaw\n0,12.5e-3,1.25,0.123456789,0\n1,0,-2,4,0\n"))
    assert table.resolution == (1e-4, 1e-2, 0.0, 0.0)
    assert through_rows(table).resolution == table.resolution


def test_without_velocities_lines_are_straight(tmp_path: Path) -> None:
    path = through_rows(read_table(write(tmp_path, f"t,x,y,z,yaw\n{ROWS}")))
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
    path, since = through_rows(table), np.linspace(0.0, 2.2, 50)
    np.testing.assert_allclose(path.pose(since)[:, :3], at(2.0 + since), atol=1e-12)
    np.testing.assert_allclose(path.pose(since)[:, 3], 2.0 + since)


def test_yaw_that_wraps_is_unwrapped(tmp_path: Path) -> None:
    path = write(tmp_path, "t,x,y,z,yaw\n0,0,0,0,3.1\n1,0,0,0,-3.1\n2,0,0,0,-2.9\n")
    np.testing.assert_allclose(read_table(path).poses[:, 3], [3.1, math.tau - 3.1, math.tau - 2.9])
