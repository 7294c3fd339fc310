"""A run directory is read back, and shows when it was modified."""

from __future__ import annotations

import hashlib
import json
import math
import shutil
from pathlib import Path
from typing import Any

import pytest

from quadsim.errors import FileError, OutputError
from quadsim.flight import rundir
from quadsim.flight.audit import audit
from quadsim.flight.rundir import Run
from quadsim.flight.summary import limit_from_json, limit_to_json
from quadsim.outputs import adding, to_json


@pytest.fixture
def copied(short_run_directory: Path, tmp_path: Path) -> Path:
    """A copy of the short run, to damage."""
    return shutil.copytree(short_run_directory, tmp_path / "run")


def test_a_run_is_read_back(short_run: Run) -> None:
    assert short_run.name == "paper-constrained"
    assert short_run.vehicle.hover_speed == pytest.approx(192.8, rel=1e-6)
    assert short_run.log.status == "completed"
    assert [limit.name for limit in short_run.limits][:4] == ["roll", "pitch", "speed", "slew"]
    assert short_run.limits[0].stop == math.inf


def test_limits_come_back_from_the_summary(short_run: Run) -> None:
    for finding, entry in zip(audit(short_run.log, short_run.limits), short_run.summary["constraints"], strict=True):
        assert limit_from_json(limit_to_json(finding)) == finding.limit
        assert limit_from_json(json.loads(json.dumps(entry))) == finding.limit
        if finding.limit.start > 6.0:  # a window not reached: null, not NaN
            assert entry["worst_margin"] is entry["peak_plant"] is entry["worst_time"] is None
            assert entry["satisfied"] is False


def test_every_file_but_the_summary_has_its_hash(short_run_directory: Path) -> None:
    summary = rundir.read_summary(short_run_directory)
    assert set(summary["files"]) == {
        "scenario.toml", "flight.parquet", "timing.parquet", "plant.parquet", "horizon.parquet",
    }  # fmt: skip
    for name, digest in summary["files"].items():
        assert digest == "sha256:" + hashlib.sha256((short_run_directory / name).read_bytes()).hexdigest()
    assert rundir.damaged_files(short_run_directory, summary) == []


def test_damaged_and_missing_files_are_found(copied: Path) -> None:
    (copied / "timing.parquet").unlink()
    with (copied / "scenario.toml").open("a") as file:
        file.write("#")
    assert sorted(rundir.damaged_files(copied, rundir.read_summary(copied))) == ["scenario.toml", "timing.parquet"]


def test_a_product_is_added_with_its_hash(copied: Path) -> None:
    before = rundir.read_summary(copied)
    for content in (b"film", b"another film"):
        with adding(copied, products={"flight.mp4": "made"}) as folder:
            (folder / "flight.mp4").write_bytes(content)
        after = rundir.read_summary(copied)
        assert set(after["files"]) - set(before["files"]) == {"flight.mp4"}
        assert {**after, "files": 0} == {**before, "files": 0, "products": {"flight.mp4": "made"}}
        assert rundir.damaged_files(copied, after) == []


def test_a_product_never_replaces_what_is_not_listed(copied: Path) -> None:
    (copied / "flight.mp4").write_bytes(b"mine")
    with pytest.raises(OutputError, match=r"flight\.mp4: summary\.json does not list it"), adding(copied) as folder:
        (folder / "flight.mp4").write_bytes(b"film")
    assert (copied / "flight.mp4").read_bytes() == b"mine"


def test_a_directory_without_a_summary_is_no_run(tmp_path: Path) -> None:
    with pytest.raises(FileError, match=r"is not a run directory: it has no summary\.json"):
        rundir.read_summary(tmp_path)
    with pytest.raises(FileError, match="is not a run directory"):
        rundir.read_summary(tmp_path / "missing")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"constraints": 3}, "it lacks or misstates constraints"),
        ({"satisfied": "yes", "files": None}, "it lacks or misstates satisfied, files"),
        ({"constraints": [{"name": "roll"}]}, r"constraints\.0 lacks or misstates signal, unit"),
        ({"constraints": [3]}, r"constraints\.0 lacks or misstates name"),
        ({"vehicle": {"mass": 3.0}}, "is damaged .*name"),
        ({"duration": True}, "it lacks or misstates duration$"),
        ({"constraints": [{"name": "roll", "shape": {}}]}, r"constraints\.0 lacks or misstates signal"),
    ],
)
def test_a_damaged_summary_is_refused(copied: Path, change: dict[str, Any], message: str) -> None:
    summary = rundir.read_summary(copied)
    (copied / "summary.json").write_text(to_json(summary | change))
    with pytest.raises(FileError, match=rf"summary\.json: .*{message}"):
        rundir.load_run(copied)
