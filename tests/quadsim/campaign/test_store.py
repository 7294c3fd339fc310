"""Rows on disk: there once, whole or not at all, whatever dies in between."""

from __future__ import annotations

import errno
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pyarrow as pa
import pytest

from quadsim.campaign import store as module
from quadsim.campaign.store import FLIGHTS_FILE, PARTS_DIR, TIMES_FILE, Store, locked
from quadsim.campaign.table import Row, failed_row, make_schema, read_table
from quadsim.errors import FileError, OutputError

SCHEMA = make_schema({"mass": (pa.float64(), "kg")}, [])


def row(flight: int) -> Row:
    return {"flight": flight, "seed": 7, "draw.mass": 0.5 * flight, "failed": False, "wall_s": 1.0} | failed_row("x")


def flights(store: Store) -> list[int]:
    return list(store.table()["flight"].to_pylist())


def test_rows_come_back_sorted_from_whatever_parts(tmp_path: Path) -> None:
    store = Store(tmp_path, SCHEMA)
    store.append([row(3), row(1)])
    store.append([row(2)])
    store.append([])
    assert flights(Store(tmp_path, SCHEMA)) == [1, 2, 3]


def test_a_row_that_is_there_twice_counts_once(tmp_path: Path) -> None:
    store = Store(tmp_path, SCHEMA)
    store.append([row(1), row(2)])
    store.append([row(2), row(3)])
    assert flights(store) == [1, 2, 3]


def test_the_end_is_the_same_however_it_was_appended(tmp_path: Path) -> None:
    contents = []
    for name, groups in {"a": [[0, 1, 2, 3]], "b": [[3], [1, 0], [2]]}.items():
        (tmp_path / name).mkdir()
        store = Store(tmp_path / name, SCHEMA)
        for group in groups:
            store.append([row(flight) for flight in group])
        store.close(flights=4)
        assert not (tmp_path / name / PARTS_DIR).exists()
        contents.append([(tmp_path / name / file).read_bytes() for file in (FLIGHTS_FILE, TIMES_FILE)])
    assert contents[0] == contents[1]


def test_more_may_follow_on_what_was_closed(tmp_path: Path) -> None:
    store = Store(tmp_path, SCHEMA)
    store.append([row(0), row(1)])
    store.close(flights=2)
    store.append([row(2)])
    assert flights(store) == [0, 1, 2]
    store.close(flights=3)
    assert read_table(tmp_path / TIMES_FILE)["wall_s"].to_pylist() == [1.0, 1.0, 1.0]


def test_flights_beyond_those_that_count_are_left_out(tmp_path: Path) -> None:
    store = Store(tmp_path, SCHEMA)
    store.append([row(flight) for flight in range(5)])
    assert store.close(flights=3)["flight"].to_pylist() == [0, 1, 2]


def test_half_a_part_is_swept_away(tmp_path: Path) -> None:
    store = Store(tmp_path, SCHEMA)
    store.append([row(0)])
    leftover = tmp_path / PARTS_DIR / ".part-000000001.parquet.partial"
    leftover.write_bytes(b"PAR1 and no more")
    assert flights(store) == [0]
    assert not leftover.exists()


@pytest.mark.parametrize("dies_before", [TIMES_FILE, FLIGHTS_FILE, "parts go"])
def test_dying_while_closing_loses_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, dies_before: str) -> None:
    store = Store(tmp_path, SCHEMA)
    store.append([row(0), row(1)])
    store.close(flights=2)
    store.append([row(2)])
    write = module._write_durably

    def write_until(table: pa.Table, path: Path) -> None:
        if path.name == dies_before:
            raise KeyboardInterrupt
        write(table, path)

    def keep(*_: Any, **__: Any) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(module, "_write_durably", write_until)
        patch.setattr(module.shutil, "rmtree", keep)
        with pytest.raises(KeyboardInterrupt):
            store.close(flights=3)
    assert flights(store) == [0, 1, 2]
    assert store.close(flights=3).num_rows == 3
    assert read_table(tmp_path / TIMES_FILE)["flight"].to_pylist() == [0, 1, 2]


def test_a_full_disk_is_said_and_leaves_what_was_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    store = Store(tmp_path, SCHEMA)
    store.append([row(0)])

    def full(_: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", full)
        with pytest.raises(OutputError, match="No space left on device"):
            store.append([row(1)])
    assert flights(store) == [0]
    assert [path.name for path in (tmp_path / PARTS_DIR).iterdir()] == ["part-000000000.parquet"]


@pytest.mark.parametrize("damage", ["not Parquet", "another campaign's"])
def test_a_part_that_is_not_ours_is_refused(tmp_path: Path, damage: str) -> None:
    Store(tmp_path, make_schema({}, [])).append([row(0)])
    if damage == "not Parquet":
        next((tmp_path / PARTS_DIR).iterdir()).write_bytes(b"nonsense")
    with pytest.raises(FileError, match=r"is not a readable Parquet file|has other columns than this campaign"):
        Store(tmp_path, SCHEMA).table()


def test_a_directory_is_held_by_one_process_and_let_go_by_its_death(tmp_path: Path) -> None:
    code = (
        "import sys, time; from pathlib import Path; from quadsim.campaign.store import locked\n"
        "with locked(Path(sys.argv[1])):\n    print('held', flush=True)\n    time.sleep(60)"
    )
    with subprocess.Popen([sys.executable, "-c", code, str(tmp_path)], stdout=subprocess.PIPE, text=True) as other:
        assert other.stdout is not None
        assert other.stdout.readline() == "held\n"
        with pytest.raises(OutputError, match="another campaign is being flown there"), locked(tmp_path):
            pass
        other.kill()
    with locked(tmp_path):
        pass
