"""Outputs appear complete or not at all, and nothing that we did not write is ever replaced or removed."""

from __future__ import annotations

import contextlib
import errno
import math
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from xml.etree import ElementTree

import imageio.v3 as imageio
import numpy as np
import pytest
from output_trees import KIND, contents, listing, make, write_half

from quadsim.errors import OutputError
from quadsim.outputs import (
    growing,
    manifest,
    paths,
    real_path,
    require_directory,
    require_file,
    staging,
    write_json,
    writing,
    writing_file,
)

pytestmark = pytest.mark.usefixtures("renaming")


# --- directories ---------------------------------------------------------------------------------------------------


def test_a_directory_appears_when_the_block_ends(tmp_path: Path) -> None:
    target = tmp_path / "new" / "deep" / "run"
    with writing(target, KIND) as partial:
        (partial / "a.txt").write_text("a")
        assert not target.exists()
    assert listing(tmp_path) == ["new", "new/deep", "new/deep/run", "new/deep/run/a.txt"]
    assert target.stat().st_mode == target.parent.stat().st_mode  # as the umask has it


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt, MemoryError])
def test_nothing_is_left_when_the_block_fails(tmp_path: Path, error: type[BaseException]) -> None:
    with pytest.raises(error):
        write_half(tmp_path / "new" / "run", error)
    assert listing(tmp_path) == []


def test_a_disk_that_fills_up_is_reported_and_leaves_nothing(tmp_path: Path) -> None:
    target = tmp_path / "new" / "run"
    with pytest.raises(OutputError, match=f"^cannot write {target}: No space left"), writing(target, KIND):
        raise OSError(errno.ENOSPC, "No space left on device")
    assert listing(tmp_path) == []


def test_a_file_in_it_that_cannot_be_written_is_named_as_if_it_were_there(tmp_path: Path) -> None:
    with pytest.raises(OutputError) as caught, writing(tmp_path / "run", KIND) as partial:
        raise OutputError(partial / "figures" / "a.png", "no ink")
    assert str(caught.value) == f"cannot write {tmp_path}/run/figures/a.png: no ink"
    assert listing(tmp_path) == []


def test_a_full_disk_is_reported_before_anything_is_done(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shutil, "disk_usage", lambda _: shutil._ntuple_diskusage(10**9, 10**9 - 4096, 4096))
    with pytest.raises(OutputError, match="the disk is full"), writing(tmp_path / "new" / "run", KIND):
        pytest.fail("the block must not be entered")
    assert listing(tmp_path) == []


def test_a_place_below_a_file_cannot_be_written(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("mine")
    with pytest.raises(OutputError, match=r"run: .*file is a file$"), writing(tmp_path / "file" / "run", KIND):
        pytest.fail("the block must not be entered")
    assert listing(tmp_path) == ["file"]


def test_an_earlier_one_is_replaced_whole(ours: Path) -> None:
    with writing(ours, KIND) as partial:
        (partial / "new.txt").write_text("new")
        assert (ours / "summary.txt").exists()
    assert listing(ours.parent) == ["run", "run/new.txt"]


def test_an_earlier_one_survives_a_failure(ours: Path) -> None:
    before = contents(ours.parent)
    with pytest.raises(ValueError, match="halfway"):
        write_half(ours, ValueError)
    assert contents(ours.parent) == before


def test_an_earlier_one_is_there_again_when_the_swap_fails(ours: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def failing(*_: object) -> bool:
        raise OSError(errno.EIO, "Input/output error")

    before = contents(ours.parent)
    monkeypatch.setattr(staging, "_rename", failing)
    with pytest.raises(OutputError, match="Input/output error"), writing(ours, KIND):
        pass
    assert contents(ours.parent) == before


def test_an_empty_directory_is_taken_with_its_mode(tmp_path: Path) -> None:
    (tmp_path / "run").mkdir(mode=0o700)
    make(tmp_path / "run")
    assert listing(tmp_path / "run") == ["figures", "figures/a.txt", "summary.txt"]
    assert (tmp_path / "run").stat().st_mode & 0o777 == 0o700


def add_file(run: Path) -> None:
    (run / "notes.md").write_text("mine")


def edit(run: Path) -> None:
    with (run / "summary.txt").open("a") as file:
        file.write("#")


def edit_manifest(run: Path) -> None:
    path = run / ".quadsim.json"
    path.write_text(path.read_text().replace('"kind"', '"note": "mine",\n  "kind"'))


FOREIGN: dict[str, Callable[[Path], object]] = {
    "a file": add_file,
    "an edited file": edit,
    "an empty folder": lambda run: (run / "mine").mkdir(),
    "a folder in a folder": lambda run: (run / "figures" / "mine").mkdir(),
    "a link": lambda run: (run / "link").symlink_to("/etc"),
    "a link in the place of a file": lambda run: ((run / "summary.txt").unlink(), (run / "summary.txt").symlink_to(
        run / "figures" / "a.txt"
    )),
    "a link in the place of a folder": lambda run: (
        (run / "figures").rename(run.parent / "figures"), (run / "figures").symlink_to(run.parent / "figures")
    ),
    "a FIFO": lambda run: os.mkfifo(run / "fifo"),
    "a FIFO in the place of a file": lambda run: ((run / "summary.txt").unlink(), os.mkfifo(run / "summary.txt")),
    "a lock with something in it": lambda run: (run / ".lock").write_text("mine"),
    "an edited manifest": edit_manifest,
    "no manifest": lambda run: (run / ".quadsim.json").unlink(),
}  # fmt: skip


@pytest.mark.parametrize("change", FOREIGN)
@pytest.mark.parametrize("when", ["before", "meanwhile"])
def test_what_holds_anything_else_is_never_replaced(ours: Path, change: str, when: str) -> None:
    if when == "before":
        FOREIGN[change](ours)
    before = contents(ours.parent)
    entered = False
    with pytest.raises(OutputError, match=r"choose another --out$"), writing(ours, KIND) as partial:  # noqa: PT012
        entered = True
        (partial / "new.txt").write_text("new")
        if when == "meanwhile":
            FOREIGN[change](ours)
            before = {path: known for path, known in contents(ours.parent).items() if ".partial" not in path}
    assert contents(ours.parent) == before
    assert entered == (when == "meanwhile")


def test_what_is_saved_where_nothing_was_stays(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match=r"\(thesis\.txt\)"), writing(tmp_path / "race", KIND):  # noqa: PT012
        (tmp_path / "race").mkdir()
        (tmp_path / "race" / "thesis.txt").write_text("years")
    assert listing(tmp_path) == ["race", "race/thesis.txt"]


def test_one_kind_does_not_replace_another(tmp_path: Path) -> None:
    make(tmp_path / "page", kind="comparison")
    before = contents(tmp_path)
    with pytest.raises(OutputError, match="a comparison is already there; choose another --out"):
        write_half(tmp_path / "page", AssertionError)
    assert contents(tmp_path) == before


@pytest.mark.parametrize("make_one", [lambda path: path.write_text("mine"), os.mkfifo])
def test_what_is_no_directory_is_never_replaced(tmp_path: Path, make_one: Callable[[Path], object]) -> None:
    make_one(tmp_path / "run")
    before = contents(tmp_path)
    with pytest.raises(OutputError, match="something else is already there"):
        write_half(tmp_path / "run", AssertionError)
    assert contents(tmp_path) == before


def test_the_current_directory_is_not_replaced(ours: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(ours)
    for place in (".", "", "../run"):
        with pytest.raises(OutputError, match="it is the current directory; name one to be made"):
            write_half(Path(place), AssertionError)


def test_a_hostile_manifest_reaches_nothing_outside(ours: Path) -> None:
    secret = ours.parent / "secret.txt"
    secret.write_text("mine")
    digest = manifest.digest_of(secret)
    (ours.parent / "way").mkdir()
    (ours.parent / "way" / "secret.txt").write_text("mine")
    (ours / "way").symlink_to(ours.parent / "way")
    files = {"../secret.txt": (digest,), str(secret): (digest,), "way/secret.txt": (digest,)}
    (ours / ".quadsim.json").write_bytes(manifest.Manifest(kind=KIND, files=files).encode())
    manifest.remove_listed(ours)  # has no manifest of ours
    files = {"way/secret.txt": (digest,)}
    (ours / ".quadsim.json").write_bytes(manifest.Manifest(kind=KIND, files=files).encode())
    manifest.remove_listed(ours)
    assert secret.read_text() == (ours.parent / "way" / "secret.txt").read_text() == "mine"


# --- where a path leads --------------------------------------------------------------------------------------------


def test_a_target_is_where_its_path_leads(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "p").mkdir()
    (tmp_path / "p" / "keep").touch()
    with pytest.raises(OutputError, match=r"p: something else is already there \(keep\)"):
        write_half(Path("nope/../p"), AssertionError)
    assert listing(tmp_path) == ["p", "p/keep"]
    (tmp_path / "link").symlink_to("real")
    make(Path("link"))
    assert (tmp_path / "link").is_symlink()
    make(Path("link"), more="again")
    assert (tmp_path / "real" / "more.txt").read_text() == "again"
    make(Path("a/../h3"))
    assert not (tmp_path / "a").exists()
    assert (tmp_path / "h3" / "summary.txt").exists()


@pytest.mark.parametrize(("given", "led"), [("a", "a"), ("./a/", "a"), ("a/b", "a/b"), ("a/../b", "/b")])
def test_a_path_without_links_and_dots_stays_as_it_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, given: str, led: str
) -> None:
    monkeypatch.chdir(tmp_path)
    expected = tmp_path / led[1:] if led.startswith("/") else Path(led)
    assert real_path(given) == expected


@pytest.mark.parametrize(("name", "message"), [("loop", "leads back to itself"), ("a\0b", "null byte")])
def test_a_path_that_does_not_exist_is_refused(tmp_path: Path, name: str, message: str) -> None:
    (tmp_path / "loop").symlink_to("pool")
    (tmp_path / "pool").symlink_to("loop")
    for refuse in (lambda path: require_directory(path, KIND), lambda path: require_file(path, ".xml")):
        with pytest.raises(OutputError, match=message):
            refuse(tmp_path / name)


# --- files by themselves -------------------------------------------------------------------------------------------


def content_of(form: str) -> bytes:
    if form == ".xml":
        return b"<?xml version='1.0' encoding='utf-8'?>\n<a><!-- b --></a>"
    return bytes(imageio.imwrite("<bytes>", np.zeros((32, 32, 3), np.uint8), extension=form))


def write_one(path: Path, form: str, content: bytes) -> None:
    with writing_file(path, form) as file:
        file.write_bytes(content)


@pytest.mark.parametrize("form", [".xml", ".png", ".gif"])
def test_a_file_of_ours_is_replaced_and_readable(tmp_path: Path, form: str) -> None:
    path, content = tmp_path / "file", content_of(form)
    for _ in range(2):
        write_one(path, form, content)
    assert path.read_bytes().startswith(content)
    if form == ".xml":
        assert ElementTree.parse(path).getroot().tag == "a"
    else:
        assert not imageio.imread(path.read_bytes(), extension=form).any()
    assert listing(tmp_path) == ["file"]


MINE: dict[str, Callable[[Path], object]] = {
    "another text": lambda path: path.write_text("mine"),
    "nothing in it": lambda path: path.touch(),
    "a FIFO": os.mkfifo,
    "one that was changed": lambda path: (write_one(path, ".xml", b"<a/>"), path.open("ab").write(b"\n<!-- me -->")),
    "one with another digest": lambda path: path.write_bytes(b"<b/>\n<!-- quadsim sha256:%s -->\n" % (b"0" * 64)),
    "a folder": lambda path: path.mkdir(),
}


@pytest.mark.parametrize("what", MINE)
@pytest.mark.parametrize("when", ["before", "meanwhile"])
@pytest.mark.filterwarnings("ignore::ResourceWarning")
def test_a_file_that_is_not_ours_is_never_replaced(tmp_path: Path, what: str, when: str) -> None:
    path = tmp_path / "file"
    if when == "before":
        MINE[what](path)
    before = contents(tmp_path)
    refused = pytest.raises(OutputError, match=r"is a folder|something else is already there")
    with refused, writing_file(path, ".xml") as file:
        file.write_bytes(b"<a/>")
        if when == "meanwhile":
            MINE[what](path)
            before = {name: known for name, known in contents(tmp_path).items() if ".partial" not in name}
    assert contents(tmp_path) == before


def test_a_link_to_a_file_is_followed_and_stays(tmp_path: Path) -> None:
    (tmp_path / "link").symlink_to("real")
    write_one(tmp_path / "link", ".xml", b"<a/>")
    assert (tmp_path / "link").is_symlink()
    assert (tmp_path / "real").read_bytes().startswith(b"<a/>")
    (tmp_path / "real").write_text("mine")
    with pytest.raises(OutputError, match="something else is already there"):
        write_one(tmp_path / "link", ".xml", b"<a/>")
    assert (tmp_path / "real").read_text() == "mine"


def test_json_is_strict(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="not JSON compliant"):
        write_json(tmp_path / "a.json", {"a": math.nan})
    assert listing(tmp_path) == []


# --- directories that grow -----------------------------------------------------------------------------------------


def test_files_are_added_replaced_and_removed(tmp_path: Path) -> None:
    for text in (b"one", b"two"):
        with growing(tmp_path / "c", "campaign") as files:
            files.write({"a.txt": text, "parts/b.txt": text})
    assert listing(tmp_path) == ["c", "c/a.txt", "c/parts", "c/parts/b.txt"]
    assert (tmp_path / "c" / "parts" / "b.txt").read_bytes() == b"two"
    with growing(tmp_path / "c", "campaign") as files:
        files.remove(["parts/b.txt", "never.txt"])
    assert listing(tmp_path) == ["c", "c/a.txt"]


@pytest.mark.parametrize("change", ["edited", "replaced by a link", "folder replaced by a link"])
def test_files_that_are_not_ours_are_not_touched(tmp_path: Path, change: str) -> None:
    with growing(tmp_path / "c", "campaign") as files:
        files.write({"parts/b.txt": b"one"})
        path = tmp_path / "c" / "parts" / "b.txt"
        if change == "edited":
            path.write_text("mine")
        elif change == "replaced by a link":
            path.rename(tmp_path / "b.txt")
            path.symlink_to(tmp_path / "b.txt")
        else:
            path.parent.rename(tmp_path / "parts")
            path.parent.symlink_to(tmp_path / "parts")
        for touch in (lambda: files.write({"parts/b.txt": b"two"}), lambda: files.remove(["parts/b.txt"])):
            with pytest.raises(OutputError, match="move it away first"):
                touch()
        (tmp_path / "c" / "more.txt").write_text("mine")
        with pytest.raises(OutputError, match=r"more.txt: it is not as quadsim wrote it"):
            files.write({"more.txt": b"ours"})
    assert path.read_bytes() == (b"mine" if change == "edited" else b"one")
    assert (tmp_path / "c" / "more.txt").read_text() == "mine"


@pytest.mark.parametrize("step", range(12))
def test_dying_at_any_step_leaves_nothing_that_is_unknown(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, step: int
) -> None:
    """The process is as good as dead when it renames for the `step`-th time."""
    with growing(tmp_path / "c", "campaign") as files:
        files.write({"a.txt": b"one"})
    steps = iter(range(step))
    put = staging.Staging.put

    def dies(self: staging.Staging, *arguments: object) -> None:
        if next(steps, None) is None:
            raise KeyboardInterrupt
        put(self, *arguments)  # type: ignore[arg-type]
        if next(steps, None) is None:
            raise KeyboardInterrupt

    with monkeypatch.context() as patch, contextlib.suppress(KeyboardInterrupt):
        patch.setattr(staging.Staging, "put", dies)
        with growing(tmp_path / "c", "campaign") as files:
            files.write({"a.txt": b"two", "b.txt": b"two"})
    with growing(tmp_path / "c", "campaign") as files:
        files.write({"a.txt": b"three", "b.txt": b"three"})
    assert listing(tmp_path) == ["c", "c/a.txt", "c/b.txt"]


def test_a_directory_is_held_by_one_process_and_let_go_by_its_death(tmp_path: Path) -> None:
    code = (
        "import sys, time; from quadsim.outputs import growing\n"
        "with growing(sys.argv[1], 'campaign') as files:\n    files.write({'a': b'a'}); print('held', flush=True)\n"
        "    time.sleep(60)"
    )
    with subprocess.Popen([sys.executable, "-c", code, str(tmp_path)], stdout=subprocess.PIPE, text=True) as other:
        assert other.stdout is not None
        assert other.stdout.readline() == "held\n"
        with pytest.raises(OutputError, match="another process is writing there"), growing(tmp_path, "campaign"):
            pass
        other.kill()
    with growing(tmp_path, "campaign"):
        pass
    assert listing(tmp_path) == ["a"]


def test_what_is_not_ours_does_not_grow(tmp_path: Path) -> None:
    (tmp_path / "theirs").mkdir()
    (tmp_path / "theirs" / ".draft.partial").write_text("mine")
    make(tmp_path / "run")
    before = contents(tmp_path)
    for name, message in {"theirs": r"\(\.draft\.partial\)", "run": "a run is already there"}.items():
        with pytest.raises(OutputError, match=message), growing(tmp_path / name, "campaign"):
            pytest.fail("the block must not be entered")
    assert contents(tmp_path) == before


def test_a_directory_to_which_nothing_was_added_is_as_before(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    for name in ("empty", "new/deep"):
        with pytest.raises(ValueError, match="halfway"), growing(tmp_path / name, "campaign"):
            raise ValueError("halfway")
    assert sorted(path.name for path in tmp_path.rglob("*")) == ["empty"]


# --- moments -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("how", ["directory", "file"])
def test_what_is_saved_into_the_new_one_before_it_goes_back_stays(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, how: str
) -> None:
    """Foreign files are found in the swap; at that moment more is saved where they were."""
    target = tmp_path / "target"
    exchange, times = staging.Staging._exchange, iter(range(9))

    def late(self: staging.Staging, slot: Path, place: Path) -> None:
        if next(times) == 0:  # after the first look
            (place / "first.txt").write_text("mine") if how == "directory" else place.write_text("mine")
            exchange(self, slot, place)
            if how == "directory":
                (place / "second.txt").write_text("mine")
            else:
                with place.open("a") as file:
                    file.write("mine")
        else:
            exchange(self, slot, place)

    make(target) if how == "directory" else write_one(target, ".xml", b"<a/>")
    monkeypatch.setattr(staging.Staging, "_exchange", late)
    with pytest.raises(OutputError):
        make(target) if how == "directory" else write_one(target, ".xml", b"<a/>")
    texts = [path.read_text() for path in tmp_path.rglob("*") if path.is_file()]
    assert sum(text.endswith("mine") for text in texts) == 2
    assert (target / "first.txt" if how == "directory" else target).read_text() == "mine"


@pytest.mark.parametrize("error", [PermissionError("no"), KeyboardInterrupt()])
def test_what_cannot_be_looked_at_again_goes_back(
    ours: Path, monkeypatch: pytest.MonkeyPatch, error: BaseException
) -> None:
    look, before = paths.problem_with_directory, contents(ours)

    def fails(path: Path, kind: str) -> str | None:
        if path.name == "work":  # in its slot
            raise error
        return look(path, kind)

    monkeypatch.setattr("quadsim.outputs.problem_with_directory", fails)
    with pytest.raises((OutputError, KeyboardInterrupt)):
        make(ours, more="more")
    monkeypatch.undo()
    assert contents(ours) == before
    assert [path.name for path in ours.parent.iterdir()] == ["run"]


@pytest.mark.parametrize("name", ["a\0b", "\ud800", "../x", "/etc/passwd", ""])
def test_a_manifest_with_names_that_cannot_be_is_none_of_ours(ours: Path, name: str) -> None:
    hostile = manifest.Manifest(kind=KIND, files={name: ("sha256:0",)})
    (ours / ".quadsim.json").write_bytes(hostile.encode())
    with pytest.raises(OutputError, match="something else is already there"):
        make(ours)
    make(ours.parent / "other")


def test_ctrl_c_in_a_step_of_a_directory_that_grows_is_no_change_by_others(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    put = staging.Staging.put

    def interrupted(self: staging.Staging, new: Path, target: Path, problem: Callable[[Path], str | None]) -> None:
        put(self, new, target, problem)
        raise KeyboardInterrupt

    with growing(tmp_path, "campaign") as files:
        files.write({"a.txt": b"one"})
        with monkeypatch.context() as patch:
            patch.setattr(staging.Staging, "put", interrupted)
            with pytest.raises(KeyboardInterrupt):
                files.write({"a.txt": b"two"})
        files.write({"a.txt": b"three"})
    assert (tmp_path / "a.txt").read_bytes() == b"three"


def test_a_persons_own_lock_file_stays(tmp_path: Path) -> None:
    (tmp_path / ".lock").touch()
    with pytest.raises(ValueError, match="halfway"), growing(tmp_path, "campaign"):
        raise ValueError("halfway")
    assert (tmp_path / ".lock").exists()


def test_a_film_is_not_replaced_by_verdicts(tmp_path: Path) -> None:
    write_one(tmp_path / "file", ".png", b"png")
    with pytest.raises(OutputError, match="something else is already there"):
        write_one(tmp_path / "file", ".xml", b"<a/>")
