"""The policy of outputs: what is refused, what is taken, what is replaced, and what grows in place."""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
import sys
import tempfile
from contextlib import AbstractContextManager
from pathlib import Path

import pytest

from quadsim.errors import OutputError
from quadsim.outputs import absolute, adding, amend, growing, reserving, writing, writing_file


def tree(directory: Path) -> dict[str, bytes]:
    """Everything below a directory by relative path; links are not followed, folders have no content."""
    return {
        path.relative_to(directory).as_posix(): path.read_bytes() if path.is_file() and not path.is_symlink() else b""
        for path in sorted(directory.rglob("*"))
    }


def write(target: Path, text: str = "one", *, overwrite: bool = False) -> None:
    with writing(target, overwrite=overwrite) as work:
        (work / "table").write_text(text)
        (work / "figures").mkdir()
        (work / "figures" / "a.png").write_text(text)


def fail(making: AbstractContextManager[Path], error: BaseException) -> None:
    """Make half of something."""
    with making as place:
        (place / "half" if place.is_dir() else place).write_text("half")
        raise error


@pytest.fixture
def output(tmp_path: Path) -> Path:
    write(tmp_path / "place" / "run")
    return tmp_path / "place" / "run"


def test_a_directory_lists_its_files_with_their_digests(output: Path) -> None:
    files = json.loads((output / "summary.json").read_text())["files"]
    assert files == {
        name: "sha256:" + hashlib.sha256((output / name).read_bytes()).hexdigest()
        for name in ("figures/a.png", "table")
    }
    assert [path.name for path in output.parent.iterdir()] == ["run"]


@pytest.mark.parametrize("error", [ValueError(), KeyboardInterrupt(), OSError(28, "No space left on device")])
def test_what_fails_leaves_nothing_and_takes_its_new_parents_along(tmp_path: Path, error: BaseException) -> None:
    with pytest.raises((type(error), OutputError)):
        fail(writing(tmp_path / "a" / "b" / "run"), error)
    assert list(tmp_path.iterdir()) == []


def test_an_error_names_the_place_and_not_where_it_was_built(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match=r"/run/flight\.mp4"), writing(tmp_path / "run") as work:
        raise OutputError(work / "flight.mp4", "no")


def test_the_next_free_name_is_taken(tmp_path: Path) -> None:
    (tmp_path / "run-2").write_text("a file")
    for name in ("run", "run-3", "run-4"):
        with reserving(tmp_path / "run", free=True) as place:
            assert place.name == name
            write(place)


def test_paths_are_absolute_and_home_is_expanded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    assert absolute("a/../b") == tmp_path.resolve() / "b"
    assert absolute("~/x") == tmp_path.resolve() / "home" / "x"
    (tmp_path / "loop").symlink_to("loop")
    for odd in ("loop", "a\0b"):
        with pytest.raises(OutputError):
            absolute(odd)


def test_what_is_there_is_refused_and_stays(output: Path) -> None:
    before = tree(output)
    with pytest.raises(OutputError, match="empty"):
        write(output, "two")
    assert tree(output) == before


def test_to_overwrite_replaces_what_the_summary_lists(output: Path) -> None:
    with writing(output, overwrite=True) as work:
        (work / "other").write_text("two")
    assert tree(output).keys() == {"other", "summary.json"}


ADDED = {
    "a file": lambda run, _: (run / "notes.txt").write_text("mine"),
    "a file in figures": lambda run, _: (run / "figures" / "mine.png").write_text("mine"),
    "a link": lambda run, other: (run / "link").symlink_to(other),
    "a link for a listed file": lambda run, other: ((run / "table").unlink(), (run / "table").symlink_to(other)),
    "a fifo": lambda run, _: os.mkfifo(run / "fifo"),
    "no summary": lambda run, _: (run / "summary.json").unlink(),
    "a list that leads out": lambda run, other: (
        amend(run, {"files": {f"../{other.name}": "sha256:0"}}), (run / "x").write_text("mine")),
}  # fmt: skip


@pytest.mark.parametrize("change", ADDED.values(), ids=ADDED)
def test_to_overwrite_refuses_whatever_else_is_there_and_touches_nothing(output: Path, change: object) -> None:
    other = output.parent / "theirs"
    other.write_text("theirs")
    change(output, other)  # type: ignore[operator]
    before = tree(output.parent)
    with pytest.raises(OutputError, match=r"summary\.json"):
        write(output, "two", overwrite=True)
    assert tree(output.parent) == before


def test_only_what_is_below_is_ever_unlinked(output: Path) -> None:
    other = output.parent / "theirs"
    other.write_text("theirs")
    amend(output, {"files": {"../theirs": "sha256:0", str(other): "sha256:0"}})
    write(output, "two", overwrite=True)
    assert other.read_text() == "theirs"


def test_what_comes_in_while_it_is_made_stays_and_so_does_what_was_made(output: Path) -> None:
    def others_come_in() -> None:
        with writing(output, overwrite=True) as work:
            (work / "new").write_text("new")
            (output / "mine").write_text("mine")

    with pytest.raises(OutputError, match=r"does not list mine; .*; what was made is in ") as caught:
        others_come_in()
    assert (output / "mine").read_text() == "mine"
    assert (output / "table").read_text() == "one"
    assert (Path(caught.value.problem.partition("what was made is in ")[2]) / "new").read_text() == "new"


def test_what_is_added_is_listed_and_nothing_is_where_it_fails(output: Path) -> None:
    before = tree(output.parent)
    with pytest.raises(KeyboardInterrupt):
        fail(adding(output), KeyboardInterrupt())
    assert tree(output.parent) == before
    with adding(output, note="x") as folder:
        (folder / "film").write_text("whole")
    summary = json.loads((output / "summary.json").read_text())
    assert (summary["note"], set(summary["files"])) == ("x", {"figures/a.png", "film", "table"})
    write(output, "two", overwrite=True)


def test_a_file_is_written_whole_and_replaced_only_on_request(tmp_path: Path) -> None:
    path = tmp_path / "film.mp4"
    with writing_file(path) as new:
        new.write_text("one")
    with pytest.raises(OutputError, match="exists"), writing_file(path):
        pytest.fail("not to be reached")
    with pytest.raises(ValueError, match="half"):
        fail(writing_file(path, overwrite=True), ValueError("half"))
    assert tree(tmp_path) == {"film.mp4": b"one"}
    with writing_file(path, overwrite=True) as new:
        new.write_text("two")
    assert tree(tmp_path) == {"film.mp4": b"two"}


def test_a_directory_grows_in_place_and_ends_with_its_list(tmp_path: Path) -> None:
    target = tmp_path / "campaign"
    with growing(target, "manifest.json") as files:
        files.write({"manifest.json": b"{}", "parts/1": b"1"})
    with growing(target, "manifest.json") as files:
        files.write({"parts/2": b"2", "rows": b"12"})
        files.remove(["parts/1", "parts/2", "gone"])
        files.finish({"name": "x"})
    assert tree(target).keys() == {".lock", "manifest.json", "rows", "summary.json"}
    assert set(json.loads((target / "summary.json").read_text())["files"]) == {"manifest.json", "rows"}
    with growing(target, "manifest.json") as files:
        files.finish({"name": "x"}, unhashed=["manifest.json", "gone"])
    summary = json.loads((target / "summary.json").read_text())
    assert (set(summary["files"]), summary["unhashed"]) == ({"rows"}, ["manifest.json"])
    with growing(target, "manifest.json", overwrite=True) as files:
        assert tree(target).keys() == {".lock"}
    assert not list(tmp_path.glob("campaign/*"))


def test_one_of_something_else_or_with_a_link_is_refused(tmp_path: Path) -> None:
    (tmp_path / "mine").write_text("mine")
    with pytest.raises(OutputError, match="empty"), growing(tmp_path, "manifest.json"):
        pass
    (tmp_path / "manifest.json").write_text("{}")
    (tmp_path / "parts").symlink_to(tmp_path.parent)
    with pytest.raises(OutputError, match="links"), growing(tmp_path, "manifest.json"):
        pass


def test_one_process_at_a_time_writes(tmp_path: Path) -> None:
    """Neither grows it, nor replaces it, while another writes there."""
    target = tmp_path / "c"
    with growing(target, "manifest.json") as files:
        files.write({"manifest.json": b"{}"})
        files.finish({})
    script = (
        "import sys; from quadsim.outputs import growing\n"
        "with growing(sys.argv[1], 'manifest.json'): print('held', flush=True); sys.stdin.read()\n"
    )
    with subprocess.Popen(
        [sys.executable, "-c", script, str(target)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as other:
        assert other.stdout is not None
        assert other.stdout.readline() == "held\n"
        for overwrite in (False, True):
            again = growing(target, "manifest.json", overwrite=overwrite)
            with pytest.raises(OutputError, match="process"), again:
                pass
        with pytest.raises(OutputError, match="process"):
            write(target, overwrite=True)
    write(target, overwrite=True)


def begin(target: Path, *files: str) -> None:
    """Begin to grow a directory in a process that is killed when it has written some files."""
    script = (
        "import os, sys; from quadsim.outputs import growing\n"
        "with growing(sys.argv[1], 'manifest.json', first=('one.toml', 'two.toml')) as files:\n"
        "    for name in sys.argv[2:]: files.write({name: b'begun'})\n"
        "    os.mkdir(f'{sys.argv[1]}/.quadsim-ab_cd012.partial')\n"
        "    os.kill(os.getpid(), 9)\n"
    )
    assert subprocess.run([sys.executable, "-c", script, str(target), *files], check=False).returncode == -9


@pytest.mark.parametrize("overwrite", [False, True])
@pytest.mark.parametrize("files", [(), ("one.toml",), ("one.toml", "two.toml")], ids=len)
def test_a_directory_of_a_process_that_was_killed_as_it_began_is_begun_anew(
    tmp_path: Path, files: tuple[str, ...], overwrite: bool
) -> None:
    begin(tmp_path / "c", *files)
    assert set(files) | {".lock"} < tree(tmp_path / "c").keys()
    with growing(tmp_path / "c", "manifest.json", overwrite=overwrite, first=("one.toml", "two.toml")) as growth:
        growth.write({"one.toml": b"1", "two.toml": b"2", "manifest.json": b"{}"})
        growth.finish({})
    assert tree(tmp_path / "c").keys() == {".lock", "one.toml", "two.toml", "manifest.json", "summary.json"}


def test_what_else_stands_beside_a_lock_is_somebody_s(tmp_path: Path) -> None:
    for name, lock in (("theirs", b"pid 7"), ("ours", b"quadsim\n"), ("empty", b"")):
        (tmp_path / name).mkdir()
        (tmp_path / name / ".lock").write_bytes(lock)
        (tmp_path / name / ("notes" if name == "ours" else "one.toml")).write_text("mine")
        before = tree(tmp_path / name)
        for overwrite in (False, True):
            again = growing(tmp_path / name, "manifest.json", overwrite=overwrite, first=("one.toml",))
            with pytest.raises(OutputError, match=r"empty|summary\.json"), again:
                pass
        assert tree(tmp_path / name) == before


def test_a_half_written_folder_of_a_killed_process_is_in_nobody_s_way(output: Path) -> None:
    partial = output / ".quadsim-x0y1z2_3.partial"
    partial.mkdir()
    (partial / "half").write_text("half")
    (output / ".quadsim-notes").mkdir()
    with pytest.raises(OutputError, match=r"\.quadsim-notes"):
        write(output, overwrite=True)
    (output / ".quadsim-notes").rmdir()
    write(output, "two", overwrite=True)
    assert tree(output).keys() == {"figures", "figures/a.png", "summary.json", "table"}


def test_to_overwrite_what_grows_names_the_process_that_writes_there(tmp_path: Path) -> None:
    target = tmp_path / "c"
    with growing(target, "manifest.json") as files:
        files.write({"manifest.json": b"{}"})  # there is no summary as long as it grows
        again = growing(target, "manifest.json", overwrite=True)
        with pytest.raises(OutputError, match="process"), again:
            pass


def test_a_place_that_cannot_be_read_is_refused_and_nothing_is_left_beside_it() -> None:
    """As a user who is not root, for whom nothing is unreadable."""
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)
        place.chmod(0o777)
        is_root = os.geteuid() == 0
        if is_root:
            os.seteuid(65534)
        try:
            (place / "closed").mkdir(mode=0o000)
            for overwrite in (False, True):
                with pytest.raises(OutputError, match="Permission"):
                    write(place / "closed", overwrite=overwrite)
            (place / "entered").mkdir()
            (place / "entered").chmod(0o555)
            write(place / "entered")
            assert (place / "entered").stat().st_mode & 0o777 == 0o555
            assert {path.name for path in place.iterdir()} == {"closed", "entered"}
            (place / "entered").chmod(0o755)
        finally:
            if is_root:
                os.seteuid(0)
