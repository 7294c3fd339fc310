"""A run directory is read back, and shows when it was modified."""

from __future__ import annotations

import json
import math
import shutil
from pathlib import Path
from typing import Any

import pytest

from quadsim.errors import FileError
from quadsim.flight import rundir
from quadsim.flight.audit import audit
from quadsim.flight.rundir import limit_from_json, limit_to_json
from quadsim.outputs import to_json
from quadsim.rollout.flown import Flight
from quadsim.rollout.stored import read_flight


@pytest.fixture
def copied(short_run_directory: Path, tmp_path: Path) -> Path:
    """A copy of the short run, to damage."""
    return shutil.copytree(short_run_directory, tmp_path / "run")


def test_a_run_is_read_back(short_run: Flight) -> None:
    assert short_run.name == "paper-constrained"
    assert short_run.vehicle.hover_speed == pytest.approx(192.8, rel=1e-6)
    assert short_run.log.status == "completed"
    assert [limit.name for limit in short_run.limits][:4] == ["roll", "pitch", "speed", "slew"]
    assert short_run.limits[0].stop == math.inf


def test_limits_come_back_from_the_summary(short_run: Flight) -> None:
    for finding, entry in zip(audit(short_run.log, short_run.limits), short_run.summary["constraints"], strict=True):
        assert limit_from_json(limit_to_json(finding)) == finding.limit
        assert limit_from_json(json.loads(json.dumps(entry))) == finding.limit
        if finding.limit.start > 6.0:  # a window not reached: null, not NaN
            assert entry["worst_margin"] is entry["peak_plant"] is entry["worst_time"] is None
            assert entry["satisfied"] is False


def test_damaged_and_missing_files_are_found(copied: Path) -> None:
    summary = rundir.read_summary(copied)
    assert {f"{name}.parquet" for name in ("flight", "timing", "plant", "horizon")} < set(summary["files"])
    assert rundir.damaged_files(copied, summary) == []
    (copied / "timing.parquet").unlink()
    with (copied / "scenario.toml").open("a") as file:
        file.write("#")
    assert sorted(rundir.damaged_files(copied, summary)) == ["scenario.toml", "timing.parquet"]
    with pytest.raises(FileError, match="run directory"):
        rundir.read_summary(copied.parent)


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
        read_flight(copied)
