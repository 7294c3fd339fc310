"""A recording written by another process: complete when its block ends, and every failure is the caller's."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

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


def entities(path: Path) -> set[str]:
    from rerun.chunk import RrdReader

    return {chunk.entity_path for chunk in RrdReader(path).stream().to_chunks()}


def test_it_is_the_recording_that_would_have_been_written_here(run_directory: Path, tmp_path: Path) -> None:
    with recording_in_background(run_directory, run_directory / RECORDING_FILE):
        pass
    write_recording(load_run(run_directory), tmp_path / "here.rrd")
    assert entities(run_directory / RECORDING_FILE) == entities(tmp_path / "here.rrd")
    assert not list(run_directory.glob(".*.partial"))


def test_an_error_is_the_callers_with_its_type_and_values(run_directory: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("RERUN", "off")
    off = "rerun is switched off by the environment variable RERUN"
    with (
        pytest.raises(OutputError, match=off) as caught,
        recording_in_background(run_directory, run_directory / RECORDING_FILE),
    ):
        pass
    assert caught.value.path == run_directory / RECORDING_FILE
    assert not (run_directory / RECORDING_FILE).exists()


def test_a_run_that_cannot_be_read_is_named(run_directory: Path) -> None:
    (run_directory / PLANT_FILE).unlink()
    with (
        pytest.raises(FileError, match=PLANT_FILE),
        recording_in_background(run_directory, run_directory / RECORDING_FILE),
    ):
        pass


def test_a_process_that_dies_is_no_recording(run_directory: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "executable", "/bin/false")
    died = r"flight\.rrd: its process ended with status 1$"
    with pytest.raises(OutputError, match=died), recording_in_background(run_directory, run_directory / RECORDING_FILE):
        pass


def test_what_ends_the_block_ends_the_process(run_directory: Path, started: list[subprocess.Popen[bytes]]) -> None:
    with pytest.raises(KeyboardInterrupt), recording_in_background(run_directory, run_directory / RECORDING_FILE):
        raise KeyboardInterrupt
    (process,) = started
    assert process.returncode is not None
    assert process.returncode < 0
    assert not (run_directory / RECORDING_FILE).exists()


def test_a_ctrl_c_does_not_reach_the_process(run_directory: Path, started: list[subprocess.Popen[bytes]]) -> None:
    """A terminal interrupts the group of processes in its foreground."""
    with recording_in_background(run_directory, run_directory / RECORDING_FILE):
        assert os.getpgid(started[0].pid) == started[0].pid != os.getpgid(0)
