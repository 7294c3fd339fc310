"""A run directory appears complete or not at all, and tells when it was tampered with."""

from __future__ import annotations

import errno
import hashlib
import json
import math
import shutil
from pathlib import Path
from typing import Any

import pytest

from quadsim import rundir
from quadsim.audit import audit
from quadsim.errors import FileError, OutputError
from quadsim.rundir import Run


def listing(directory: Path) -> list[str]:
    """Everything below a directory, hidden files included."""
    return sorted(path.relative_to(directory).as_posix() for path in directory.rglob("*"))


def write_half(target: Path, error: type[BaseException]) -> None:
    """Begin a directory and fail."""
    with rundir.writing(target) as partial:
        (partial / "new.txt").write_text("new")
        raise error("halfway")


@pytest.fixture
def copied(short_run_directory: Path, tmp_path: Path) -> Path:
    """A copy of the short run, to damage."""
    return shutil.copytree(short_run_directory, tmp_path / "run")


# --- writing -------------------------------------------------------------------------------------------------------


def test_a_directory_appears_when_the_block_ends(tmp_path: Path) -> None:
    target = tmp_path / "new" / "deep" / "run"
    with rundir.writing(target) as partial:
        (partial / "a.txt").write_text("a")
        assert not target.exists()
        assert partial.parent == target.parent  # the same file system: the last step is one rename
    assert listing(tmp_path) == ["new", "new/deep", "new/deep/run", "new/deep/run/a.txt"]
    assert target.stat().st_mode & 0o777 == 0o755


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt, MemoryError])
def test_nothing_is_left_when_the_block_fails(tmp_path: Path, error: type[BaseException]) -> None:
    with pytest.raises(error):
        write_half(tmp_path / "new" / "run", error)
    assert listing(tmp_path) == []


def test_a_disk_that_fills_up_is_said_and_leaves_nothing(tmp_path: Path) -> None:
    target = tmp_path / "new" / "run"
    with pytest.raises(OutputError, match=f"^cannot write {target}: No space left on device$"), rundir.writing(target):
        raise OSError(errno.ENOSPC, "No space left on device")
    assert listing(tmp_path) == []


def test_a_file_in_it_that_cannot_be_written_is_named_as_if_it_were_there(tmp_path: Path) -> None:
    with pytest.raises(OutputError) as caught, rundir.writing(tmp_path / "run") as partial:
        raise OutputError(partial / "figures" / "a.png", "no ink")
    assert str(caught.value) == f"cannot write {tmp_path}/run/figures/a.png: no ink"
    assert caught.value.path == tmp_path / "run" / "figures" / "a.png"
    assert listing(tmp_path) == []


def test_a_full_disk_is_said_before_anything_is_done(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shutil, "disk_usage", lambda _: shutil._ntuple_diskusage(10**9, 10**9 - 4096, 4096))
    with pytest.raises(OutputError, match="the disk is full"), rundir.writing(tmp_path / "new" / "run"):
        pytest.fail("the block must not be entered")
    assert listing(tmp_path) == []


def test_a_place_below_a_file_cannot_be_written(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("mine")
    with pytest.raises(OutputError, match=r"run: .*file is a file$"), rundir.writing(tmp_path / "file" / "run"):
        pytest.fail("the block must not be entered")
    assert listing(tmp_path) == ["file"]


def test_an_earlier_run_is_replaced_whole(copied: Path) -> None:
    with rundir.writing(copied) as partial:
        (partial / "new.txt").write_text("new")
        assert rundir.is_run(copied)
    assert listing(copied.parent) == ["run", "run/new.txt"]


def test_an_earlier_run_survives_a_failure(copied: Path) -> None:
    before = rundir.file_hashes(copied)
    with pytest.raises(ValueError, match="halfway"):
        write_half(copied, ValueError)
    assert rundir.file_hashes(copied) == before
    assert [path.name for path in copied.parent.iterdir()] == ["run"]


def test_an_earlier_run_is_put_back_when_the_last_rename_fails(copied: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rename = Path.rename

    def failing(self: Path, target: Path) -> Path:
        if self.suffix == ".partial":
            raise OSError(errno.EIO, "Input/output error")
        return rename(self, target)

    before = rundir.file_hashes(copied)
    monkeypatch.setattr(Path, "rename", failing)
    with pytest.raises(OutputError, match="Input/output error"), rundir.writing(copied):
        pass
    assert rundir.file_hashes(copied) == before
    assert [path.name for path in copied.parent.iterdir()] == ["run"]


def test_an_empty_directory_is_taken(tmp_path: Path) -> None:
    (tmp_path / "run").mkdir()
    with rundir.writing(tmp_path / "run") as partial:
        (partial / "a.txt").write_text("a")
    assert listing(tmp_path) == ["run", "run/a.txt"]


@pytest.mark.parametrize("content", ["", "{}", '{"scenario": "theirs"}', "[1]"])
def test_what_is_not_a_run_is_never_replaced(tmp_path: Path, content: str) -> None:
    """Other people's directories hold a summary.json too."""
    (tmp_path / "theirs").mkdir()
    (tmp_path / "theirs" / "summary.json").write_text(content)
    with pytest.raises(OutputError, match="something else is already there; choose another --out"):
        write_half(tmp_path / "theirs", AssertionError)
    assert (tmp_path / "theirs" / "summary.json").read_text() == content


def test_a_run_with_something_of_ones_own_in_it_is_never_replaced(copied: Path) -> None:
    (copied / "notes.txt").write_text("mine")
    with pytest.raises(OutputError, match="something else is already there"):
        write_half(copied, AssertionError)
    assert (copied / "notes.txt").read_text() == "mine"


def test_a_file_is_never_replaced(tmp_path: Path) -> None:
    (tmp_path / "run").write_text("mine")
    with pytest.raises(OutputError, match="something else is already there"), rundir.writing(tmp_path / "run"):
        pytest.fail("the block must not be entered")
    assert (tmp_path / "run").read_text() == "mine"


def test_a_text_file_is_replaced_in_one_step_or_not_at_all(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.json"
    rundir.write_json(path, {"a": 1})
    rundir.write_json(path, {"a": 2})
    assert path.read_text() == '{\n  "a": 2\n}\n'

    def full(*_: object, **__: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Path, "replace", full)
    with pytest.raises(OutputError, match="No space left"):
        rundir.write_json(path, {"a": 3})
    assert json.loads(path.read_text()) == {"a": 2}
    assert listing(tmp_path) == ["a.json"]


def test_json_is_strict(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="not JSON compliant"):
        rundir.write_json(tmp_path / "a.json", {"a": math.nan})
    assert listing(tmp_path) == []


# --- reading -------------------------------------------------------------------------------------------------------


def test_a_run_is_read_back(short_run: Run) -> None:
    assert rundir.is_run(short_run.directory)
    assert short_run.name == "paper-constrained"
    assert short_run.vehicle.hover_speed == pytest.approx(192.8, rel=1e-6)
    assert short_run.log.status == "completed"
    assert [limit.name for limit in short_run.limits][:4] == ["roll", "pitch", "speed", "slew"]
    assert short_run.limits[0].stop == math.inf


def test_limits_come_back_from_the_summary(short_run: Run) -> None:
    for finding, entry in zip(audit(short_run.log, short_run.limits), short_run.summary["constraints"], strict=True):
        assert rundir.limit_from_json(rundir.limit_to_json(finding)) == finding.limit
        assert rundir.limit_from_json(json.loads(json.dumps(entry))) == finding.limit
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


def test_the_hash_of_a_product_that_is_added_is_taken_and_no_other(copied: Path) -> None:
    (copied / "figures").mkdir()
    (copied / "figures" / "a.png").write_bytes(b"png")
    (copied / "plant.parquet").write_bytes(b"another")
    before = rundir.read_summary(copied)
    rundir.refresh_hash(copied, "figures/a.png")
    after = rundir.read_summary(copied)
    assert set(after["files"]) - set(before["files"]) == {"figures/a.png"}
    assert {**after, "files": 0} == {**before, "files": 0}
    assert rundir.damaged_files(copied, after) == ["plant.parquet"]  # not hidden by the new product
    assert rundir.is_sealed(copied, after)


@pytest.mark.parametrize("content", [b"", b"{", b"[1]", b'"text"', b"\xff", b"{}"])
def test_what_is_no_summary_is_refused(copied: Path, content: bytes) -> None:
    (copied / "summary.json").write_bytes(content)
    with pytest.raises(FileError, match=r"summary\.json: is not a run's summary"):
        rundir.load_run(copied)
    assert not rundir.is_run(copied)


def test_a_directory_without_a_summary_is_no_run(tmp_path: Path) -> None:
    with pytest.raises(FileError, match=r"is not a run directory: it has no summary\.json"):
        rundir.read_summary(tmp_path)
    assert not rundir.is_run(tmp_path)
    assert not rundir.is_run(tmp_path / "nowhere")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"constraints": 3}, "it lacks or misstates constraints"),
        ({"satisfied": "yes", "files": None}, "it lacks or misstates satisfied, files"),
        ({"constraints": [{"name": "roll"}]}, r"it lacks or misstates constraints\.0\.signal, constraints\.0\.unit"),
        ({"constraints": [3]}, r"it lacks or misstates constraints\.0$"),
        ({"vehicle": {"mass": 3.0}}, r"it lacks or misstates vehicle\.name"),
        ({"duration": True, "seed": 1.5}, "it lacks or misstates duration, seed$"),
        ({"tracking": {"unit": 3}}, r"it lacks or misstates tracking\.unit, tracking\.rmse"),
        ({"reason": "at once"}, "contradicts itself: status is 'completed', and reason is 'at once'"),
    ],
)
def test_a_damaged_summary_is_refused(copied: Path, change: dict[str, Any], message: str) -> None:
    summary = rundir.read_summary(copied)
    rundir.write_json(copied / "summary.json", summary | change)
    with pytest.raises(FileError, match=rf"summary\.json: .*{message}"):
        rundir.load_run(copied)


def test_a_missing_entry_of_the_summary_is_named(copied: Path) -> None:
    summary = rundir.read_summary(copied)
    del summary["reason"], summary["vehicle"]
    rundir.write_json(copied / "summary.json", summary)
    with pytest.raises(FileError, match=r"it lacks or misstates reason, vehicle$"):
        rundir.load_run(copied)
