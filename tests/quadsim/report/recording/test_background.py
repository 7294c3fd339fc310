"""A recording written by another process: complete when its block ends, and every failure is the caller's."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from rerun.chunk import RrdReader

from quadsim.errors import FileError, OutputError
from quadsim.flight.parquet import PLANT_FILE
from quadsim.flight.rundir import RECORDING_FILE, load_run
from quadsim.report.recording import recording_in_background, write_recording


@pytest.fixture
def run_directory(short_run_directory: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(short_run_directory, tmp_path / "run"))


@pytest.fixture
def started(monkeypatch: pytest.MonkeyPatch) -> list[subprocess.Popen[bytes]]:
    """The processes that are started."""
    found: list[subprocess.Popen[bytes]] = []

    class Watched(subprocess.Popen[bytes]):
        def __init__(self, *arguments: object, **options: object) -> None:
            super().__init__(*arguments, **options)  # type: ignore[call-overload]
            found.append(self)

    monkeypatch.setattr("quadsim.report.recording.subprocess.Popen", Watched)
    return found


def test_it_is_the_recording_that_would_have_been_written_here(
    run_directory: Path, tmp_path: Path, started: list[subprocess.Popen[bytes]]
) -> None:
    with recording_in_background(run_directory, run_directory / RECORDING_FILE):
        assert os.getpgid(started[0].pid) == started[0].pid != os.getpgid(0), "a terminal's Ctrl-C does not reach it"
    write_recording(load_run(run_directory), tmp_path / "here.rrd")
    here, there = (
        {chunk.entity_path for chunk in RrdReader(path).stream().to_chunks()}
        for path in (tmp_path / "here.rrd", run_directory / RECORDING_FILE)
    )
    assert here == there
    assert not list(run_directory.glob(".*.partial"))


def test_every_failure_is_the_callers_with_its_type_and_values(
    run_directory: Path, started: list[subprocess.Popen[bytes]], monkeypatch: pytest.MonkeyPatch
) -> None:
    path = run_directory / RECORDING_FILE
    with pytest.raises(KeyboardInterrupt), recording_in_background(run_directory, path):
        raise KeyboardInterrupt
    assert (started[0].returncode or 0) < 0, "it is ended too"
    with monkeypatch.context() as patch:
        patch.setenv("RERUN", "off")
        off = "rerun is switched off by the environment variable RERUN"
        with pytest.raises(OutputError, match=off) as caught, recording_in_background(run_directory, path):
            pass
    assert caught.value.path == path
    (run_directory / PLANT_FILE).unlink()
    with pytest.raises(FileError, match=PLANT_FILE), recording_in_background(run_directory, path):
        pass
    monkeypatch.setattr(sys, "executable", "/bin/false")
    died = r"flight\.rrd: its process ended with status 1$"
    with pytest.raises(OutputError, match=died), recording_in_background(run_directory, path):
        pass
    assert not path.exists()
