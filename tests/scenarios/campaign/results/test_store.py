"""Rows on disk: there once, whole or not at all, whatever dies in between."""

from __future__ import annotations

import contextlib
import errno
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from quadsim.errors import FileError, OutputError
from quadsim.outputs import Growing, growing
from scenarios.campaign.rows import Row, make_schema, make_table, read_table
from scenarios.campaign.store import FLIGHTS_FILE, PARTS_DIR, TIMES_FILE, Store, read_flights

FAILED: Row = {"status": "error", "verdict": "error", "reason": "x", "violated": True, "crashed": False}
SCHEMA = make_schema({"mass": (pa.float64(), "kg")}, [])


@contextlib.contextmanager
def store_in(directory: Path, schema: pa.Schema = SCHEMA) -> Iterator[Store]:
    with growing(directory, "manifest.json") as files:
        files.write({"manifest.json": b"{}"})  # as every campaign has one
        yield Store(files, schema)


def row(flight: int) -> Row:
    return {"flight": flight, "seed": 7, "draw.mass": 0.5 * flight, "failed": False, "wall_s": 1.0} | FAILED


def flights(store: Store) -> list[int]:
    return list(store.table()["flight"].to_pylist())


def test_rows_come_back_sorted_from_whatever_parts(tmp_path: Path) -> None:
    with store_in(tmp_path) as store:
        store.append([row(3), row(1)])
        store.append([row(2), row(3)])
        store.append([])
    with store_in(tmp_path) as store:
        assert flights(store) == [1, 2, 3], "one that is there twice counts once"
        assert store.close(flights=3)["flight"].to_pylist() == [1, 2], "those beyond the first three do not"


def test_the_end_is_the_same_however_it_was_appended(tmp_path: Path) -> None:
    contents = []
    for name, groups in {"a": [[0, 1, 2, 3]], "b": [[3], [1, 0], [2]]}.items():
        with store_in(tmp_path / name) as store:
            for group in groups:
                store.append([row(flight) for flight in group])
            store.close(flights=4)
        assert not (tmp_path / name / PARTS_DIR).exists()
        contents.append([(tmp_path / name / file).read_bytes() for file in (FLIGHTS_FILE, TIMES_FILE)])
    assert contents[0] == contents[1]


def test_more_may_follow_on_what_was_closed(tmp_path: Path) -> None:
    with store_in(tmp_path) as store:
        store.append([row(0), row(1)])
        store.close(flights=2)
        store.append([row(2)])
        assert flights(store) == [0, 1, 2]
        store.close(flights=3)
    assert read_table(tmp_path / TIMES_FILE)["wall_s"].to_pylist() == [1.0, 1.0, 1.0]


@pytest.mark.parametrize("dies_before", [TIMES_FILE, FLIGHTS_FILE, "parts go"])
def test_dying_while_closing_loses_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, dies_before: str) -> None:
    with store_in(tmp_path) as store:
        store.append([row(0), row(1)])
        store.close(flights=2)
        store.append([row(2)])
    write, remove = Growing.write, Growing.remove

    def write_until(self: Growing, contents: Mapping[str, bytes]) -> None:
        for name, content in contents.items():
            if name == dies_before:
                raise KeyboardInterrupt
            write(self, {name: content})

    def remove_until(self: Growing, names: Sequence[str]) -> None:
        if dies_before == "parts go":
            raise KeyboardInterrupt
        remove(self, names)

    with monkeypatch.context() as patch:
        patch.setattr(Growing, "write", write_until)
        patch.setattr(Growing, "remove", remove_until)
        with pytest.raises(KeyboardInterrupt), store_in(tmp_path) as store:
            store.close(flights=3)
    with store_in(tmp_path) as store:
        assert flights(store) == [0, 1, 2]
        assert store.close(flights=3).num_rows == 3
    assert read_table(tmp_path / TIMES_FILE)["flight"].to_pylist() == [0, 1, 2]


def test_a_full_disk_is_reported_and_leaves_what_was_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    with store_in(tmp_path) as store:
        store.append([row(0)])
        with monkeypatch.context() as patch:
            patch.setattr(Path, "write_bytes", full)
            with pytest.raises(OutputError, match="No space left on device"):
                store.append([row(1)])
        assert flights(store) == [0]
        assert [path.name for path in (tmp_path / PARTS_DIR).iterdir()] == ["part-000000000.parquet"]


def test_a_part_of_another_campaign_is_refused(tmp_path: Path) -> None:
    with store_in(tmp_path, make_schema({}, [])) as store:
        store.append([row(0)])
    with store_in(tmp_path) as store, pytest.raises(FileError, match="has other columns than this campaign"):
        store.table()


@pytest.mark.parametrize(
    ("name", "values", "message"),
    [
        ("flight", [3, 3], "has flights that are not numbered upwards from 0"),
        ("flight", [-1, 3], "has flights that are not numbered upwards from 0"),
        ("failed", ["no", "yes"], "has other columns than this campaign"),
    ],
)
def test_a_table_that_others_changed_is_refused(tmp_path: Path, name: str, values: list[Any], message: str) -> None:
    table = make_table([row(1), row(2)], SCHEMA)
    table = table.set_column(table.column_names.index(name), name, pa.array(values))
    pq.write_table(table, tmp_path / "t.parquet")
    with pytest.raises(FileError, match=message):
        read_flights(tmp_path / "t.parquet", SCHEMA)
