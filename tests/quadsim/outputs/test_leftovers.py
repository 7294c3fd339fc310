"""What a killed process leaves is removed by the next one that writes there, and nothing else is."""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import shutil
import signal
import subprocess
import sys
import time as clock
from collections.abc import Iterator
from pathlib import Path

import pytest
from output_trees import KIND, contents, listing, make

from quadsim.outputs import (
    growing,
    staging,
    writing,
)

pytestmark = pytest.mark.usefixtures("renaming")


KILLED = """
import sys, time
from pathlib import Path
from quadsim.outputs import growing, writing, writing_file
target = Path(sys.argv[2])
if sys.argv[1] == "writing":
    with writing(target, "run") as work:
        (work / "figures").mkdir()
        (work / "figures" / "a.png").write_text("half")
        (work / "flight.parquet").write_text("half")
        with writing_file(work / "flight.mp4", ".mp4") as film:
            film.write_text("half")
            print("writing", flush=True)
            time.sleep(60)
elif sys.argv[1] == "growing":
    with growing(target, "campaign") as files:
        files.write({"a.txt": b"a"})
        print("writing", flush=True)
        time.sleep(60)
"""


@contextlib.contextmanager
def killed(how: str, target: Path, stop: signal.Signals = signal.SIGKILL) -> Iterator[Path]:
    """The staging directory of a process that was killed while it wrote."""
    with subprocess.Popen([sys.executable, "-c", KILLED, how, str(target)], stdout=subprocess.PIPE, text=True) as other:
        assert other.stdout is not None
        assert other.stdout.readline() == "writing\n"
        folder = target if how == "growing" else target.parent
        (left,) = folder.glob(".quadsim-*.partial")
        make(folder.parent / "beside") if how == "growing" else make(folder / "beside")
        assert left.exists()  # its process lives
        other.send_signal(stop)
        other.wait()
    assert left.exists()
    yield left


@pytest.mark.parametrize("how", ["writing", "growing"])
def test_leftovers_go_with_the_next_output_in_the_same_folder(tmp_path: Path, how: str) -> None:
    target = tmp_path / "x" / "run"
    target.parent.mkdir()
    with killed(how, target) as left:
        if how == "growing":
            with growing(target, "campaign"):
                pass
        else:
            make(target.parent / "other")
        assert not left.exists()
    assert not list(tmp_path.rglob("*.partial"))


def test_a_leftover_with_something_of_a_persons_in_it_stays(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    with killed("writing", tmp_path / "run") as left:
        (left / "work" / "thesis.txt").write_text("years")
        make(tmp_path / "other")
        assert listing(left) == ["owner.json", "work", "work/thesis.txt"]
        assert f"{left} holds files that are not quadsim's" in caplog.text


@pytest.mark.parametrize("change", ["another inode", "another host", "alive", "no owner", "nonsense", "locked"])
def test_what_may_be_foreign_is_not_touched(tmp_path: Path, change: str) -> None:
    with killed("writing", tmp_path / "run") as left:
        owner = json.loads((left / "owner.json").read_text())
        if change == "another inode":
            shutil.copytree(left, tmp_path / "copy")
            shutil.rmtree(left)
            (tmp_path / "copy").rename(left)
        elif change == "another host":
            (left / "owner.json").write_text(json.dumps({**owner, "host": "elsewhere"}))
        elif change == "alive":
            (left / "owner.json").write_text(json.dumps({**owner, **staging._identity(os.getpid())}))
        elif change == "no owner":
            (left / "owner.json").unlink()
        elif change == "nonsense":
            (left / "owner.json").write_text("[" * 100_000)
        before = contents(left)
        with contextlib.ExitStack() as stack:
            if change == "locked":
                handle = stack.enter_context((left / "owner.json").open("r+"))
                fcntl.flock(handle, fcntl.LOCK_EX)
            make(tmp_path / "other")
        assert contents(left) == before


def test_an_earlier_boot_of_this_machine_is_dead(tmp_path: Path) -> None:
    with killed("writing", tmp_path / "run") as left:
        owner = json.loads((left / "owner.json").read_text())
        (left / "owner.json").write_text(
            json.dumps({**owner, **staging._identity(os.getpid()), "boot": "before", "inode": owner["inode"]})
        )
        make(tmp_path / "other")
        assert not left.exists()


@pytest.mark.parametrize("moment", ["before the swap", "after the swap", "between two steps"])
def test_a_process_that_dies_while_it_swaps_costs_nothing(
    ours: Path, monkeypatch: pytest.MonkeyPatch, moment: str
) -> None:
    before = contents(ours)
    exchange, rename = staging.Staging._exchange, staging._rename

    def dies(self: staging.Staging, new: Path, target: Path) -> None:
        if moment == "after the swap":
            exchange(self, new, target)
        elif moment == "between two steps":
            new.with_name(staging._NAME).write_bytes(b"run")
            target.rename(new.with_name(staging._PREVIOUS))
        raise SystemExit

    with monkeypatch.context() as patch:
        patch.setattr(staging.Staging, "_exchange", dies)
        patch.setattr(staging.Staging, "close", lambda _: None)
        with pytest.raises(SystemExit), writing(ours, KIND) as partial:
            (partial / "new.txt").write_text("new")
    assert staging._rename is rename
    (left,) = ours.parent.glob(".quadsim-*.partial")
    owner = json.loads((left / "owner.json").read_text())
    (left / "owner.json").write_text(json.dumps({**owner, "started": "0"}))  # dead by now
    make(ours.parent / "other")
    assert not left.exists()
    if moment == "after the swap":
        assert listing(ours) == ["new.txt"]
    else:
        assert contents(ours) == before


def test_the_lock_of_another_user_s_leftover_is_no_licence(tmp_path: Path) -> None:
    with killed("writing", tmp_path / "run") as left:
        left.chmod(0o777)  # anybody may have put links into it
        before = contents(left)
        make(tmp_path / "other")
        assert contents(left) == before


def test_a_leftover_in_a_directory_of_ours_does_not_bar_it(tmp_path: Path) -> None:
    with killed("growing", tmp_path / "c"):
        pass
    with writing(tmp_path / "c", "campaign") as partial:
        (partial / "new.txt").write_text("new")
    assert listing(tmp_path / "c") == ["new.txt"]


def test_looking_for_leftovers_takes_no_time_where_there_are_many_files(tmp_path: Path) -> None:
    for i in range(2000):
        (tmp_path / f"{i}.txt").touch()
    started = clock.perf_counter()
    staging.clear_leftovers(tmp_path)
    assert clock.perf_counter() - started < 0.1
