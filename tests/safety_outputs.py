"""Random trees, random paths, every command that writes: no foreign file may change by one byte."""

from __future__ import annotations

import contextlib
import hashlib
import io
import json
import os
import random
import shutil
import stat
import subprocess
import sys
import tempfile
import time as clock
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Final
from unittest import mock

from hypothesis import HealthCheck, Phase, assume, given, seed, settings
from hypothesis import strategies as st
from matplotlib.figure import Figure
from ordinary_user import counts_of

from quadsim.errors import OutputError
from quadsim.outputs import real_path, require_directory, require_file, staging
from quadsim.report.film import video
from quadsim.report.pages import comparison_page
from scenarios.campaign.report import campaign_page
from scenarios.cli import main

ROOT: Final = Path(__file__).resolve().parent.parent
SHORT: Final = (
    "--set",
    "duration=0.1",
    "--set",
    "controller.horizon=4",
    "--no-video",
    "--no-recording",
    "--no-figures",
)
CAMPAIGN: Final = """name = "small"
scenario = "hover"
flights = 2
set = { duration = 0.1, controller = { horizon = 4 } }
failure = ["lost"]
[[vary]]
name = "mass"
fields = ["vehicle.mass"]
distribution = "uniform"
low = 4.3
high = 4.5
"""
NAMES: Final = (
    *("p", "P", "run", "Run", "a.", "a..", "...", "é", "e\u0301", " x", "x\n", "-o", "[red]", "*", "~", "\udcff"),
    *("keep", "notes.md", "thesis.txt", ".draft.partial", ".quadsim-0.partial", ".lock", ".quadsim.json", "parts"),
    *("index.html", "summary.json", "scenario.toml", "campaign.toml", "manifest.json", "flight.mp4", "figures"),
)
LOCATIONS: Final = st.lists(
    st.sampled_from(
        [name for name in (*NAMES, "..", ".", "nope", "", "p", "p", "run", "run") if "partial" not in name]
    ),
    min_size=1,
    max_size=4,
).map("/".join)


@dataclass(frozen=True)
class Entry:
    """Something in a tree: a path of names below it, and what is there."""

    path: tuple[str, ...]
    kind: str
    content: str


ENTRIES: Final = st.builds(
    Entry,
    st.lists(st.sampled_from(NAMES), min_size=1, max_size=3).map(tuple),
    st.sampled_from(["file", "file", "folder", "link", "fifo", "run", "comparison", "campaign", "junit", "dead"]),
    st.one_of(st.sampled_from(["", "mine", "<meta name='generator' content='quadsim comparison'>"]), LOCATIONS),
)
SAVED: Final = st.builds(Entry, st.just(()), st.sampled_from(["file", "folder", "into"]), st.just("mine"))
"""What somebody saves at the target while the command runs."""


@dataclass(kw_only=True)
class Inputs:
    """What commands read: a run, a comparison, a campaign, and files of verdicts, all of ours and intact."""

    folder: Path
    cases: int
    counted: Counter[str] = field(default_factory=Counter)

    def make(self) -> None:
        """Have the commands make them."""
        self.folder.mkdir()
        (self.folder / "small.toml").write_text(CAMPAIGN)
        for command in (
            ["run", "hover", *SHORT, "--out", self["run"]],
            ["check", self["run"], "--junit", self["junit"]],
            ["compare", self["run"], "--out", self["comparison"]],
            ["campaign", self["small.toml"], "--out", self["campaign"], "--workers", "1"],
        ):
            status, message = call(command)
            assert status == 0, message

    def most(self, writer: str) -> int:
        """How often a writer may go all the way."""
        most = WRITERS[writer][1]
        return most if self.cases >= MANY else min(most, max(1, most * self.cases // MANY))

    def __getitem__(self, name: str) -> str:
        return str(self.folder / name)


WRITERS: Final[dict[str, tuple[int, int]]] = {
    "run": (12, 10**9),
    "check": (6, 10**9),
    "junit": (12, 10**9),
    "replay": (8, 10**9),
    "campaign": (6, 40),
    "resume": (6, 60),
    "compare": (8, 30),
    "compare campaigns": (4, 30),
    "vehicle": (6, 15),
    "video": (6, 8),
    "bench solvers": (3, 3),
    "bench ladder": (3, 0),
}
"""How often each comes up, and how many may go all the way, fewer below `MANY` cases; the others only where they are
refused at the door."""
MANY: Final = 700


FORMS: Final = {"check": ".xml", "junit": ".xml", "vehicle": ".png", "video": ".gif"}
"""Of those that write a file by itself."""


def command_of(writer: str, inputs: Inputs, out: str) -> tuple[list[str], str | None]:
    """The command line that writes to a place, and whether it makes a directory of ours, of which kind."""
    given = f"--out={out}"
    match writer:
        case "run":
            return ["run", "hover", *SHORT, given], "run"
        case "check":
            return ["check", "hover", "--set", "duration=0.1", f"--junit={out}"], None
        case "junit":
            return ["check", inputs["run"], f"--junit={out}"], None
        case "replay":
            return ["replay", inputs["campaign"], "--no-video", "--no-recording", "--no-figures", given], "run"
        case "campaign":
            return ["campaign", inputs["small.toml"], "--workers", "1", given], "campaign"
        case "resume":
            return ["campaign", inputs["small.toml"], "--workers", "1", "--resume", given], "campaign"
        case "compare":
            return ["compare", inputs["run"], given], "comparison"
        case "compare campaigns":
            return ["compare", inputs["campaign"], inputs["campaign"], given], "campaign comparison"
        case "vehicle":
            return ["vehicle", "crazyflie2", f"{given}.png"], None
        case "video":
            return ["video", inputs["run"], f"{given}.gif"], None
        case "bench solvers":
            options = ("--repeats", "1", "--horizons", "none", "--solver", "piqp-multistage", "--stride", "2")
            return ["bench", "solvers", "--set", "duration=2", *options, given], "bench of solvers"
    return ["bench", "ladder", "--quick", given], "bench ladder"


def build(tree: Sequence[Entry], base: Path, inputs: Inputs) -> set[Path]:
    """Make a tree; the paths in it that are outputs of ours."""
    ours: set[Path] = set()
    for entry in tree:
        path = base.joinpath(*entry.path)
        with contextlib.suppress(OSError):  # a name that is taken, or below a file
            path.parent.mkdir(parents=True, exist_ok=True)
            if os.path.lexists(path) or any(parent in ours for parent in path.parents if entry.kind != "file"):
                continue
            match entry.kind:
                case "file":
                    path.write_bytes(os.fsencode(entry.content))
                case "folder":
                    path.mkdir()
                case "link":
                    path.symlink_to(entry.content or "..")
                case "fifo":
                    os.mkfifo(path)
                case "junit":
                    shutil.copyfile(inputs["junit"], path)
                    ours.add(path)
                case "dead":
                    shutil.copytree(inputs["run"], path)  # as if of a process that died, with a file beside it
                    (path / "owner.json").write_text('{"pid": 1, "inode": 0}')
                case _:
                    shutil.copytree(inputs[entry.kind], path)
                    ours |= {path, *path.rglob("*")}
    return ours


def state(base: Path) -> dict[str, str]:
    """Everything in a tree: its kind, and its content or where it leads."""
    found = {}
    for folder, folders, files in os.walk(base):
        for name in (*folders, *files):
            path = Path(folder, name)
            mode = path.lstat().st_mode
            what = stat.filemode(mode)
            if stat.S_ISLNK(mode):
                what += f" {path.readlink()}"
            elif stat.S_ISREG(mode):
                what += hashlib.sha256(path.read_bytes()).hexdigest()
            found[str(path)] = what
    return found


def call(command: Sequence[str]) -> tuple[int, str]:
    """Run a command line in this process: its exit status, and what it printed on stderr."""
    out = io.TextIOWrapper(io.BytesIO(), encoding="utf-8")
    err = io.TextIOWrapper(io.BytesIO(), encoding="utf-8", errors="backslashreplace")
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            status = main(command)
        except SystemExit as error:
            status = int(error.code or 0)
    err.flush()
    return status, err.buffer.getvalue().decode()  # type: ignore[attr-defined]


@contextlib.contextmanager
def saved_meanwhile(entry: Entry | None, target: Path, note: Callable[[], None]) -> Iterator[None]:
    """Somebody saves something at the target, or into it, right before it gets its name."""
    put = staging.Staging.put
    pending = [entry]

    def late(self: staging.Staging, new: Path, place: Path, problem: Callable[[Path], str | None]) -> None:
        saved = pending.pop() if pending and place == target else None
        if saved is not None:
            with contextlib.suppress(OSError):
                if saved.kind == "file":
                    target.write_bytes(b"mine") if not os.path.lexists(target) else None
                else:
                    target.mkdir(exist_ok=True)
                if saved.kind == "into":
                    (target / "thesis.txt").write_bytes(b"mine")
            note()
        put(self, new, place, problem)

    with mock.patch.object(staging.Staging, "put", late):
        yield


@contextlib.contextmanager
def sketched() -> Iterator[None]:
    """Pages have no plots; pictures and films are a few bytes each, written where and how the real ones are."""

    def save(_: Figure, file: IO[bytes], **__: object) -> None:
        file.write(b"picture")

    def work(commands: Sequence[Sequence[str]], *_: object) -> None:
        for command in commands:  # a renderer's file comes after its task and what that is about, ffmpeg's last
            renders = tuple(command[: len(video._WORKER)]) == video._WORKER
            Path(command[len(video._WORKER) + 2 if renders else -1]).write_bytes(b"film")

    with (
        mock.patch.object(Figure, "savefig", save),
        mock.patch.object(Figure, "get_layout_engine", return_value=None),
        mock.patch.object(video, "_work", work),
        mock.patch.object(video, "rendering_backend", return_value="none"),
        mock.patch.object(campaign_page, "campaign_plots", return_value={}),
        mock.patch.object(comparison_page, "comparison_plots", return_value=[]),
    ):
        yield


def check_case(
    base: Path, inputs: Inputs, tree: Sequence[Entry], writer: str, out: str, meanwhile: Entry | None
) -> None:
    """One case: build the tree, run the command in it, look at what became of it."""
    shutil.rmtree(base, ignore_errors=True)
    base.mkdir()
    ours = build(tree, base, inputs)
    os.chdir(base)
    command, kind = command_of(writer, inputs, out)
    place = next(part.partition("=")[2] for part in reversed(command) if part.startswith(("--out=", "--junit=")))
    refused = True
    try:
        target = real_path(place)
        require_directory(target, kind) if kind else require_file(target, FORMS[writer])
        refused = False
    except OutputError:
        target = base / "nowhere"
    assume(target.is_absolute() is False or target.is_relative_to(base) or refused)
    target = Path(os.path.realpath(target))
    if not refused and inputs.counted[f"{writer}: done"] >= inputs.most(writer):
        return
    before = {path: what for path, what in state(base).items() if Path(path) not in ours}
    whole = state(base)

    def note() -> None:
        nonlocal whole
        late = {path: what for path, what in state(base).items() if path in whole or ".quadsim-" not in path}
        before.update({path: what for path, what in late.items() if path not in whole and Path(path) not in ours})
        before.pop(str(target), None) if target.is_dir() and not any(target.iterdir()) else None
        whole = late

    with saved_meanwhile(meanwhile, target, note):
        status, message = call(command)
    after = state(base)
    inputs.counted["cases"] += 1
    inputs.counted[f"{writer}: {'done' if status != 2 else 'refused'}"] += 1
    assert status in (0, 1, 2), message
    assert "Traceback" not in message
    changed = {path for path, what in before.items() if after.get(path) != what}
    empty = {str(target)} if stat.S_ISDIR(target.lstat().st_mode if os.path.lexists(target) else 0) else set()
    assert not changed - empty, f"{sorted(changed - empty)} changed; {message}"
    if status == 2:
        assert message.count("\n") == 1, message
        assert message.startswith("quadsim: "), message
        assert after == whole, f"left behind or lost: {sorted(after.items() ^ whole.items())}; {message}"
    else:
        assert not [path for path in after if ".quadsim-" in path and path not in whole], "a staging directory stays"


def attack(scratch: Path, count: int, number: int) -> dict[str, int]:
    """Go through so many cases in a directory of one's own; how many were refused and done.

    Below `MANY` cases pictures are sketched: drawing them takes most of the time.
    """
    with sketched() if count < MANY else contextlib.nullcontext():
        return _attack(scratch, count, number)


def _attack(scratch: Path, count: int, number: int) -> dict[str, int]:
    inputs = Inputs(folder=scratch / "inputs", cases=count)
    inputs.make()
    before = state(inputs.folder)
    writers = [name for name, (weight, _) in WRITERS.items() for _ in range(weight)]

    @seed(number)
    @settings(
        max_examples=count,
        deadline=None,
        database=None,
        phases=[Phase.generate, Phase.shrink],
        suppress_health_check=list(HealthCheck),
    )
    @given(st.lists(ENTRIES, max_size=6), st.sampled_from(writers), LOCATIONS, st.none() | SAVED, st.booleans())
    def cases(tree: list[Entry], writer: str, place: str, meanwhile: Entry | None, absolute: bool) -> None:
        out = f"{scratch / 'case'}/{place}" if absolute else place
        try:
            check_case(scratch / "case", inputs, tree, writer, out, meanwhile)
        except AssertionError as error:
            error.add_note(f"{tree}\n{writer} to {out!r}, {meanwhile} saved meanwhile")
            raise

    cases()
    os.chdir(scratch)
    assert state(inputs.folder) == before, "what the commands read was changed"
    ends = {end: sum(n for name, n in inputs.counted.items() if name.endswith(end)) for end in ("refused", "done")}
    return {"cases": inputs.counted["cases"], **ends, "changed": 0}  # each case asserts it


def measure(count: int, number: int = 0) -> dict[str, int]:
    """Go through so many cases as an ordinary user, where this one is root; how many were refused and done.

    Raises:
        RuntimeError: a case failed; it is reported.
    """
    return counts_of(Path(__file__).name, str(count), str(number))


def measure_kills(count: int, number: int = 0) -> dict[str, int]:
    """Kill processes at random moments while they write; the next one in the same place clears up after them.

    Raises:
        AssertionError: something of ours is left, or something else changed.
    """
    rng = random.Random(number)
    counted = Counter(kills=0, leftovers=0)
    with tempfile.TemporaryDirectory() as place:
        base = Path(place)
        build(
            [Entry(("thesis.txt",), "file", "mine"), Entry((".draft.partial", "x"), "file", "mine")],
            base,
            Inputs(folder=base, cases=0),
        )
        before = state(base)
        (base / "small.toml").write_text(CAMPAIGN.replace("duration = 0.1", "duration = 5").replace("= 2", "= 20"))
        for kill in range(count):
            command = ["run", "hover", "--set", "duration=5", "--no-video", "--out", "run"]
            if kill % 2:
                command = ["campaign", "small.toml", "--workers", "1", "--out", "campaign", "--resume"]
            process = subprocess.Popen(
                [sys.executable, "-m", "scenarios.cli", *command],
                cwd=base,
                env={**os.environ, "PYTHONPATH": str(ROOT)},
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
            )
            while not list(base.rglob(".quadsim-*.partial")) and process.poll() is None:
                clock.sleep(0.01)
            clock.sleep(rng.uniform(0.0, 0.5))
            process.kill()
            process.wait()
            counted["kills"] += 1
            counted["leftovers"] += len(list(base.rglob(".quadsim-*.partial")))
        os.chdir(base)
        for command in (
            ["run", "hover", *SHORT, "--out", "run"],
            ["campaign", "small.toml", "--out", "campaign", "--resume"],
        ):
            status, message = call(command)
            assert status == 0, message
        os.chdir(ROOT)
        after = state(base)
        assert not [path for path in after if ".quadsim-" in path], "leftovers stay"
        assert {path: after.get(path) for path in before} == before
    return dict(counted)


if __name__ == "__main__":
    print(json.dumps(attack(Path.cwd(), int(sys.argv[1]), int(sys.argv[2]))))
