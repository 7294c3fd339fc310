"""Rows on disk: there once, whole or not at all, whatever dies in between."""

from __future__ import annotations

import contextlib
import errno
import math
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from quadsim.errors import FileError, OutputError
from quadsim.features.campaign import store
from quadsim.features.campaign.rows import (
    flown_row,
    make_schema,
    make_table,
    read_table,
    split_times,
    unit_of,
)
from quadsim.features.campaign.store import FLIGHTS_FILE, PARTS_DIR, TIMES_FILE, Store, read_flights
from quadsim.flight import rundir
from quadsim.flight.audit import Finding, Limit, audit, worst_finding
from quadsim.outputs import Growing, growing
from quadsim.rollout.flown import Flight
from quadsim.rollout.many import Row

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
        assert store.close(flights=3)[0]["flight"].to_pylist() == [1, 2], "those beyond the first three do not"


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
    write = Growing.write
    remove = Growing.remove

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
        assert store.close(flights=3)[0].num_rows == 3
    assert read_table(tmp_path / TIMES_FILE)["flight"].to_pylist() == [0, 1, 2]


def test_a_full_disk_is_reported_and_leaves_what_was_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    with store_in(tmp_path) as store:
        store.append([row(0)])
        with monkeypatch.context() as patch:
            patch.setattr(Path, "write_bytes", full)
            with pytest.raises(OutputError, match="space"):
                store.append([row(1)])
        assert flights(store) == [0]
        assert [path.name for path in (tmp_path / PARTS_DIR).iterdir()] == ["part-000000000.parquet"]


def test_a_part_of_another_campaign_is_refused(tmp_path: Path) -> None:
    with store_in(tmp_path, make_schema({}, [])) as store:
        store.append([row(0)])
    with store_in(tmp_path) as store, pytest.raises(FileError, match="columns"):
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


ROLL = Limit(name="roll", signal="roll", lower=-5.0, upper=5.0, tolerance=0.5)
SPEED = Limit(name="speed", signal="speed", lower=0.0, upper=250.0)


def finding(limit: Limit, margin: float, sampled: float | None = None) -> Finding:
    return Finding(
        limit=limit,
        peak_sampled=0.0,
        peak_plant=0.0,
        worst_margin_sampled=margin if sampled is None else sampled,
        worst_margin=margin,
        worst_time=0.0,
        time_violated=0.0,
    )


def test_a_row_follows_the_schema(short_run: Flight) -> None:
    schema = make_schema({"mass": (pa.float64(), "kg"), "kind": (pa.string(), "-")}, short_run.limits)
    row = flown_row(
        short_run.log, audit(short_run.log, short_run.limits), verdict="violated", wall_s=1.5, machine="x86"
    )
    known = {"flight", "seed", "draw.mass", "draw.kind", "failed"}
    assert {*row} | known == {*schema.names}
    table = make_table([{**row, "flight": 2, "seed": 1, "failed": True}], schema)
    assert table.schema == schema
    assert table["duration"].to_pylist() == [6.0]
    assert table["draw.mass"].to_pylist() == [None]
    units = {name: unit_of(table, name) for name in ("margin.roll", "rmse.x", "verdict", "draw.mass", "draw.kind")}
    assert units == {"margin.roll": "deg", "rmse.x": "m", "verdict": "-", "draw.mass": "kg", "draw.kind": "-"}


def test_a_row_agrees_with_the_summary(short_run: Flight) -> None:
    row = flown_row(
        short_run.log, audit(short_run.log, short_run.limits), verdict="satisfied", wall_s=0.0, machine="x86"
    )
    summary = short_run.summary
    assert row["rmse.z"] == summary["tracking"]["rmse"]["z"]
    assert row["slew_max"] == summary["control"]["slew_max"]
    assert row["iterations.max"] == summary["controller"]["iterations"]["max"]
    assert row["unsolved_periods"] == 0
    assert row["margin.arrival_x"] is None, "a window that was not reached"
    assert row["satisfied.arrival_x"] is None, "neither held nor violated"


def test_rows_are_sorted_and_clock_times_stand_apart(short_run: Flight) -> None:
    schema = make_schema({}, short_run.limits)
    rows = [{"flight": k, "seed": k, "failed": False, "wall_s": 1.0} for k in (2, 0, 1)]
    flights, times = split_times(make_table(rows, schema))
    assert flights["flight"].to_pylist() == [0, 1, 2]
    assert times.column_names == ["flight", "machine", "wall_s", "step_p50_ms", "step_p99_ms"]
    assert not {"machine", "wall_s", "step_p50_ms"} & {*flights.column_names}


@pytest.mark.parametrize(
    ("findings", "expected"),
    [
        ([], (None, None)),
        ([finding(ROLL, 4.5, 5.0)], (0.9, "roll")),
        ([finding(ROLL, -0.5, 0.0)], (-0.1, "roll")),
        ([finding(ROLL, 0.0, -0.5)], (-0.1, "roll")),
        ([finding(ROLL, 4.5, math.nan)], (0.9, "roll")),
        ([finding(replace(ROLL, tolerance=5.0), -3.0, -2.0)], (-0.6, "roll")),
        ([finding(replace(ROLL, required=False), -3.0)], (-0.6, "roll")),
        ([finding(replace(ROLL, required=False), -3.0), finding(replace(ROLL, name="a"), 5.0)], (1.0, "a")),
        ([finding(ROLL, math.nan)], (None, None)),
        ([finding(ROLL, 4.5, 5.0), finding(SPEED, 0.0)], (0.9, "roll")),
        ([finding(ROLL, 4.5, 5.0), finding(SPEED, -12.5)], (-0.1, "speed")),
        ([finding(replace(ROLL, lower=-math.inf), -3.0, -2.5)], (-0.6, "roll")),
        ([finding(replace(ROLL, lower=-math.inf, upper=0.0), -3.0, -2.5)], (-3.0, "roll")),
    ],
)
def test_the_worst_margin_is_a_share_of_half_the_band(
    findings: list[Finding], expected: tuple[float | None, str | None]
) -> None:
    worst = worst_finding(findings)
    assert (worst.limit.name if worst else None) == expected[1]
    assert (worst.share if worst else None) == (None if expected[0] is None else pytest.approx(expected[0]))


def test_text_that_is_no_unicode_is_stored() -> None:
    schema = make_schema({"kind": (pa.string(), "-")}, [])
    rows = [{"flight": 0, "draw.kind": "\udc80", "reason": "no file a\udcff \u00e4\n"}]
    table = make_table(rows, schema)
    assert table.select(["draw.kind", "reason"]).to_pylist() == [
        {"draw.kind": "\\udc80", "reason": "no file a\\udcff \u00e4\n"}
    ]


def test_a_folder_that_is_no_output_is_not_walked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """`--out /` is refused at once, and without following any link of the machine."""

    def walk(folder: Path) -> None:
        raise AssertionError(f"walks {folder}")

    monkeypatch.setattr(os, "walk", walk)
    assert not store.is_campaign(tmp_path)
    with pytest.raises(FileError, match="campaign"):
        store.read_manifest(tmp_path)
    with pytest.raises(FileError, match="run directory"):
        rundir.read_summary(tmp_path)
