"""Files that would take minutes to check or gigabytes to hold are refused at once, in one message."""

from __future__ import annotations

import time as clock
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from quadsim.errors import FileError, InputError
from quadsim.features.campaign.plan import load_plan
from quadsim.features.campaign.rows import read_table
from quadsim.features.identify.record import read_record
from quadsim.flight import parquet
from quadsim.flight.parquet import read_parquet
from quadsim.input_limits import MOST_ENTRIES, MOST_ROWS
from quadsim.scenarios.loading import load_scenario, parse_scenario
from quadsim.scenarios.schema.problems import ScenarioError
from quadsim.scenarios.schema.writing import plain
from quadsim.vehicle import load_vehicle

CONSTRAINT = '[[constraints]]\nname = "c{i}"\nsignal = "z"\nupper = {i}.0\n'
SPHERE = '[[obstacles]]\ntype = "sphere"\nname = "o{i}"\nposition = [{i}.0, 5.0, 1.0]\nradius = 0.1\n'
INNER = "[controller]\n" + "".join(f"k{i} = 1\n" for i in range(1001))
LONG = {
    "constraints": (CONSTRAINT, 5000, "long.toml: constraints must be a list of 1000 or fewer entries"),
    "obstacles": (SPHERE, 2000, "long.toml: obstacles must be a list of 1000 or fewer entries"),
    "few keys": ("k{i} = 1\n", MOST_ENTRIES, "long.toml: the file must have 1000 or fewer keys; got 1002"),
    "keys": ("k{i} = 1\n", 200_000, "long.toml: must assign at most 150000 values; it has 200002 equals signs"),
    "keys within": (INNER, 1, "long.toml: controller must have 1000 or fewer keys; got 1001"),
}


@pytest.mark.parametrize(("line", "count", "message"), LONG.values(), ids=LONG)
def test_a_file_of_too_many_entries_is_refused_at_once(line: str, count: int, message: str, tmp_path: Path) -> None:
    lines = "".join(line.replace("{i}", str(i)) for i in range(count))
    (tmp_path / "long.toml").write_text(f'base = "hover"\nname = "long"\n{lines}')
    started = clock.process_time()
    with pytest.raises(InputError) as caught:
        load_scenario(str(tmp_path / "long.toml"))
    assert clock.process_time() - started < 3.0  # a quarter of that, where no other test runs
    assert message in str(caught.value)


@pytest.mark.parametrize("load", [load_vehicle, lambda path: load_plan(str(path))], ids=["vehicle", "campaign"])
def test_other_files_have_the_same_limits(load: object, tmp_path: Path) -> None:
    (tmp_path / "x.toml").write_text("".join(f"k{i} = 1\n" for i in range(1001)))
    with pytest.raises(FileError, match="1001"):
        load(tmp_path / "x.toml")  # type: ignore[operator]


def test_as_many_obstacles_as_allowed_are_read(tmp_path: Path) -> None:
    spheres = "".join(SPHERE.replace("{i}", str(i)) for i in range(1000))
    (tmp_path / "many.toml").write_text(f'base = "hover"\nname = "many"\n{spheres}')
    scenario = load_scenario(str(tmp_path / "many.toml"))
    assert len(scenario.obstacles) == 1000
    assert "o999.position" in scenario.description


def test_many_problems_are_counted_and_some_described() -> None:
    events = [{"type": "push", "at": 1.0, "duration": 1.0, "force": [0.0, 0.0, 0.0], "odd": 1} for _ in range(1500)]
    started = clock.process_time()
    with pytest.raises(ScenarioError, match="1480") as caught:
        parse_scenario({**plain(load_scenario("hover")), "events": events})
    assert len(caught.value.problems) == 1500
    assert clock.process_time() - started < 6.0


def write_zeros(path: Path, rows: int, columns: str) -> None:
    """A table of zeros, a million rows at a time: some bytes on disk for each million."""
    with pq.ParquetWriter(path, pa.schema([(name, pa.float64()) for name in columns.split()])) as writer:
        for first in range(0, rows, 1_000_000):
            zeros = np.zeros(min(1_000_000, rows - first))
            writer.write_table(pa.table(dict.fromkeys(columns.split(), zeros)))


@pytest.mark.parametrize("read", [read_parquet, read_table, read_record])
def test_a_table_of_too_many_rows_is_not_read(read: object, tmp_path: Path) -> None:
    write_zeros(tmp_path / "bomb.parquet", MOST_ROWS + 1, "t")
    assert (tmp_path / "bomb.parquet").stat().st_size < 1e6
    allocated = pa.total_allocated_bytes()
    with pytest.raises(FileError, match="10000002, 1"):
        read(tmp_path / "bomb.parquet")  # type: ignore[operator]
    assert pa.total_allocated_bytes() - allocated < 1e6


def test_a_table_of_too_many_numbers_or_columns_is_not_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_zeros(tmp_path / "wide.parquet", 1000, "a b c")
    monkeypatch.setattr(parquet, "LARGEST_TABLE", 24_000)
    assert read_parquet(tmp_path / "wide.parquet").num_rows == 1000
    monkeypatch.setattr(parquet, "LARGEST_TABLE", 23_999)
    with pytest.raises(FileError, match="23999"):
        read_parquet(tmp_path / "wide.parquet")
    monkeypatch.setattr(parquet, "MOST_COLUMNS", 2)
    with pytest.raises(FileError, match="1000, 3"):
        read_parquet(tmp_path / "wide.parquet")


def test_a_text_that_is_stored_once_and_stands_in_every_row_is_not_unpacked(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(parquet, "LARGEST_TEXTS", 10_000_000)
    for length, rows in ((100_000, 1000), (1000, 1000)):
        column = pa.DictionaryArray.from_arrays(np.zeros(rows, np.int32), [length * "x"])
        pq.write_table(pa.table({"reason": column}), tmp_path / "texts.parquet", store_schema=False)
        assert (tmp_path / "texts.parquet").stat().st_size < 1e6
        if length * rows > 10_000_000:
            with pytest.raises(FileError, match="10000000"):
                read_parquet(tmp_path / "texts.parquet")
        else:
            assert read_parquet(tmp_path / "texts.parquet")["reason"].to_pylist() == rows * [length * "x"]


def test_a_table_that_is_read_in_batches_is_the_same(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    texts = pa.array([f"{i:05d}" for i in range(2000)])
    table = pa.table({"t": np.arange(2000.0), "reason": texts}).replace_schema_metadata({"a": "b"})
    pq.write_table(table, tmp_path / "t.parquet")
    monkeypatch.setattr(parquet, "LARGEST_TEXTS", 100_000)
    again = read_parquet(tmp_path / "t.parquet")
    assert again.equals(table, check_metadata=True)
    assert again["t"].num_chunks > 1
