"""What commands print and pages say, kept as text in `tests/snapshots/` to be read in a review.

A session types the lines of one command in an empty folder.  `test_snapshots.py` compares what is printed with the
stored text; after an intended change remake it, and read its diff:

    python tests/snapshots.py              # remake every snapshot
    python tests/snapshots.py run compare  # remake those of these sessions

What differs between machines or between flights is replaced: the folder's path, times that a clock measured, versions,
and lengths that are rounding errors.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import os
import re
import shlex
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from html.parser import HTMLParser
from pathlib import Path
from typing import Final

import pytest
import qpsolvers
from flown_logs import fly_eight, write_log
from rich.console import Console
from support import draw_nothing, fly_here

from quadsim.commands.app import app
from quadsim.commands.cli import main

STORED: Final = Path(__file__).resolve().parent / "snapshots"
COLUMNS: Final = "100"
"""Width of the help [characters]."""

TABLES: Final = "--no-video --no-recording --no-figures"

VARYING: Final = (
    (r"median \S+, p99 \S+, max \S+ ms", "median #, p99 #, max # ms"),
    (r"set up in \S+ ms, first step in \S+ ms", "set up in # ms, first step in # ms"),
    (r"simulated in \S+ s\b", "simulated in # s"),
    (r"((?:median|percentile|maximum|step time) \[ms\](?: \|)?)[^\n]+", r"\1 #"),
    (r"((?:simulated in|with all files) \[s\] \|)[^\n]+", r"\1 #"),
    (r"(deadline misses \|)[^\n]+", r"\1 #"),
    (r"quadsim \S+, mujoco \S+, piqp \S+ on [^\n]+, \d+ cores", "quadsim #, mujoco #, piqp # on #, # cores"),
    (r"\(there are \d+: [^)]*\)", "(there are #: ...)"),
)
"""Patterns of what differs from one time to the next, with what is kept of it."""
ROUNDING: Final = re.compile(r" *-?\b\d(\.\d+e-0?[78]|(\.\d+)?e-(0?9|[1-9]\d))\b")
"""A number that only rounding made; a tolerance of 1e-08 stays."""
PROGRESS: Final = re.compile(r"quadsim: .* \d+ s so far")

PUSHED: Final = """
base = "hover"
name = "pushed"
description = "A hover under a steady push and a steady turn"
duration = 1.0
constraints = [
    {name = "roll", signal = "roll", lower = -5.0, upper = 5.0, tolerance = 0.05},
    {name = "hold_x", signal = "x_error", lower = -0.01, upper = 0.01},
    {name = "slow", signal = "speed", lower = 0.0, upper = 190.0, required = false},
]

[effects.disturbance]
force = [0.5, -0.3, -0.4]
torque = [0.0, 0.0, 0.001]
"""
STEADY: Final = """
base = "pushed.toml"
name = "steady"
description = "The same, with more weight on x"

[controller]
horizon = 40
output_weights = {x = 200.0}
"""
LITTLE: Final = """
name = "little"
description = "What is flown: a push with loads."
scenario = "pushed.toml"
flights = 6
failure = ["lost", "max_error.z > 0.05"]
set = {duration = 0.5}
vary = [{name = "mass", fields = ["effects.load.mass_factor"], distribution = "uniform", low = 0.9, high = 1.1}]
"""
FIRMER: Final = LITTLE.replace('"little"', '"firmer"').replace("pushed.toml", "steady.toml")
PAPER: Final = """
title = "A paper"
authors = "A. Author"
about = "A hover"

[[numbers]]
name = "time flown"
scenario = "hover"
set = {duration = 0.5, controller = {type = "pid"}}
measure = "duration"
unit = "s"
published = 0.5
absolute = 0.0
source = "Table 1"

[[numbers]]
name = "time said"
scenario = "hover"
set = {duration = 0.5, controller = {type = "pid"}}
measure = "duration"
unit = "s"
published = 0.6
relative = 0.01
source = "Table 2"
"""
PULLED: Final = """
duration = 0.5
inputs = [{at = 0.1, type = "pull", to = [1.0, 0.0, 1.0]}]
"""


@dataclass(frozen=True, kw_only=True)
class Session:
    """Lines that are typed one after another, and pages that they make."""

    lines: tuple[str, ...]
    before: tuple[str, ...] = ()
    """Lines typed first, whose output is left to another session."""
    files: Mapping[str, str] = field(default_factory=dict)
    """Texts of files that are there at the start, by name."""
    pages: Mapping[str, str] = field(default_factory=dict)
    """Names of HTML files that are there at the end, by the name of the snapshot of their text."""
    prepare: Callable[[Path], object] | None = None
    """Fills the folder with what no text can give."""
    measured: tuple[str, ...] = ()
    """Titles of listings whose values are this machine's; their names are kept."""
    computed: bool = True
    """Whether rounding makes some of its numbers, which are replaced; those of files are not."""
    slow: str = ""
    """Group of slow tests, of a session that takes long."""


def _log_eight(folder: Path) -> None:
    """Write the log of a flown figure eight."""
    write_log(fly_eight("hummingbird"), folder / "eight.csv")


FLIGHTS: Final = {"pushed.toml": PUSHED, "steady.toml": STEADY}
CAMPAIGNS: Final = FLIGHTS | {"little.toml": LITTLE, "firmer.toml": FIRMER}

SESSIONS: Final[dict[str, Session]] = {
    "quadsim": Session(lines=("--help", "rum hover", "run hover --sed 3", "list hover")),
    "list": Session(lines=("list --help", "list")),
    "run": Session(
        lines=(
            "run --help",
            f"run hover --set duration=0.5 {TABLES}",
            f"run pushed.toml {TABLES}",
            f"run steady.toml {TABLES} --set expect=violated",
            f"run pushed.toml {TABLES} --out unaudited --set constraints=[] --set controller='{{type=\"pid\"}}'",
            f"run hover {TABLES} --out lost --set duration=1 --set initial.euler=[20.0,0.0,0.0]",
            f"run figure-eight {TABLES} --out fast --set duration=1 --set reference.period=4 --set reference.ramp=0.2",
            "run hover --seed 3.7",
            "run hover --fps 0",
            f"run hover {TABLES} --out runs/pushed",
            "run nope",
        ),
        files=FLIGHTS,
    ),
    "check": Session(
        before=(f"run pushed.toml {TABLES}",),
        lines=(
            "check --help",
            "check runs/pushed --junit verdicts.xml",
            "check pushed.toml --set expect=lost --set constraints.hold_x.required=false",
            "check runs",
            "check runs/pushed --seed 1",
        ),
        files=FLIGHTS,
    ),
    "compare": Session(
        before=(f"run pushed.toml {TABLES}", f"run steady.toml {TABLES}"),
        lines=(
            "compare --help",
            "compare runs/pushed runs/steady --out page",
            "compare --out other",
            "compare runs/pushed runs/steady --name mine --out other",
            "compare runs/pushed nope --out other",
        ),
        files=FLIGHTS,
        pages={"compare-page": "page/index.html"},
    ),
    "plot": Session(
        before=(f"run pushed.toml {TABLES}",),
        lines=(
            "plot --help",
            "plot runs/pushed --signals z margin.roll --out z.pdf",
            "plot runs/pushed --signals altitude --out altitude.pdf",
        ),
        files=FLIGHTS,
    ),
    "video": Session(lines=("video --help", "video gone")),
    "view": Session(
        before=(f"run pushed.toml {TABLES}",),
        lines=("view --help", "view gone", "view runs/pushed"),
        files=FLIGHTS,
    ),
    "doctor": Session(
        lines=("doctor --help", "doctor"),
        measured=("machine", "packages", "rendering", "viewer", "many vehicles", "solvers"),
    ),
    "scenario": Session(
        lines=(
            "scenario --help",
            "scenario hover --set duration=0.5",
            "scenario --for hummingbird --course figure-eight",
            "scenario",
            "scenario --for nope",
        ),
        computed=False,
    ),
    "vehicle": Session(
        lines=(
            "vehicle --help",
            "vehicle hummingbird --scenario paper-constrained",
            "vehicle --template",
            "vehicle nope",
        ),
        computed=False,
    ),
    "campaign": Session(
        before=("campaign firmer.toml --no-report",),
        lines=(
            "campaign --help",
            "campaign little.toml --require 'P(lost) < 0.01 @ 95%' --junit gate.xml",
            "compare runs/campaigns/little runs/campaigns/firmer --out pairs",
            "campaign gone.toml",
            "campaign little.toml --require 'lost < 1%'",
            "compare runs/campaigns/little --out one",
        ),
        files=CAMPAIGNS,
        pages={"campaign-page": "runs/campaigns/little/index.html", "campaign-pairs-page": "pairs/index.html"},
    ),
    "replay": Session(
        before=("campaign little.toml --no-report",),
        lines=(
            "replay --help",
            f"replay runs/campaigns/little --worst {TABLES}",
            "replay runs/campaigns/little --flight 6",
            "replay runs --worst",
        ),
        files=CAMPAIGNS,
    ),
    "reproduce": Session(
        lines=("reproduce --help", "reproduce paper.toml", "reproduce nope"),
        files={"paper.toml": PAPER},
    ),
    "export": Session(
        lines=(
            "export --help",
            "export hover --set duration=1 --set controller.horizon=5 --out exported",
            "export hover",
            "export hover --set controller='{type=\"lqr\"}' --out other",
        )
    ),
    "live": Session(
        lines=("live --help", "live hover --script pulled.toml --no-browser", "live hover --script gone.toml"),
        files={"pulled.toml": PULLED},
    ),
    "stability": Session(
        lines=(
            "stability --help",
            "stability pushed.toml --over delay --workers 1",
            "stability pushed.toml --over heading --set controller.horizon=5",
            "stability hover --over weight",
            "stability hover --map delay",
            "stability nope",
        ),
        files=FLIGHTS,
    ),
    "identify": Session(
        lines=(
            "identify --help",
            "identify eight.csv --vehicle hummingbird --out mine.toml --page mine.html",
            "identify gone.csv --vehicle hummingbird",
        ),
        pages={"identify-page": "mine.html"},
        prepare=_log_eight,
        slow="identification",
    ),
}
"""By the word of the command."""


def play(session: Session, folder: Path) -> dict[str, str]:
    """Type a session's lines in an empty folder.

    Returns:
        The text of what was printed, under the empty name, and the texts of its pages by name.
    """
    for name, text in session.files.items():
        (folder / name).write_text(text, encoding="utf-8")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.setattr(app, "console", Console(width=int(COLUMNS)))  # that of help, which is made once a process
        patch.setenv("COLUMNS", COLUMNS)
        patch.setattr(qpsolvers, "available_solvers", ["clarabel"])  # those of set-up, whatever peers added
        patch.delenv("DISPLAY", raising=False)
        patch.delenv("WAYLAND_DISPLAY", raising=False)
        fly_here(patch)
        draw_nothing(patch)
        if session.prepare is not None:
            session.prepare(folder)
        for line in session.before:
            text = _typed(line)
            assert "exit status 2" not in text, text
        blocks = [_typed(line) for line in session.lines]
    text = "\n".join(blocks)
    for title in session.measured:
        text = re.sub(rf"(?<=\n{title}\n)(  .*\n)+", _unmeasured, text)
    text = _steady(text, folder)
    texts = {"": _without_rounding(text) if session.computed else text}
    for name, file in session.pages.items():
        reader = _PageText()
        reader.feed((folder / file).read_text(encoding="utf-8"))
        text = _without_rounding(_steady(reader.text(), folder))
        texts[name] = re.sub(" +", " ", text)
    return texts


def _typed(line: str) -> str:
    """Return a command line with what it printed and its exit status."""
    stdout = io.StringIO()
    stderr = io.StringIO()
    with contextlib.redirect_stdout(stdout), contextlib.redirect_stderr(stderr):
        status = main(shlex.split(line))
    block = [f"$ quadsim {line}".rstrip()]
    block += [text.rstrip() for text in stdout.getvalue().splitlines()]
    block += [f"stderr: {text}" for text in stderr.getvalue().splitlines() if not PROGRESS.fullmatch(text)]
    block += [f"exit status {status}", ""]
    return "\n".join(block)


def _unmeasured(listing: re.Match[str]) -> str:
    """Return the lines of a listing with their names alone."""
    return re.sub(r"(?m)^(  \S+) .*$", r"\1  #", listing[0])


def _steady(text: str, folder: Path) -> str:
    """Replace what differs from one time to the next."""
    for place in {str(folder), os.path.realpath(folder)}:
        text = re.sub(rf"'({re.escape(place)}[^'\n]*)'", r"\1", text)  # quoted, where the folder's name has spaces
        text = text.replace(place, "/here")
    for pattern, kept in VARYING:
        text = re.sub(pattern, kept, text)
    return "\n".join(line.rstrip() for line in text.splitlines()) + "\n"


def _without_rounding(text: str) -> str:
    """Replace numbers that only rounding made, as wide as they were."""
    return ROUNDING.sub(lambda number: "~0".rjust(len(number[0])), text)


class _PageText(HTMLParser):
    """The words of a page, a line for each block; a row of a table is one line."""

    _SILENT: Final = ("script", "style", "svg", "head")
    _INLINE: Final = ("a", "abbr", "b", "code", "em", "i", "small", "strong", "sub", "sup")
    _CELLS: Final = ("td", "th")

    def __init__(self) -> None:
        super().__init__()
        self._parts: list[str] = []
        self._silent = 0

    def handle_starttag(self, tag: str, attrs: object) -> None:
        """See `HTMLParser.handle_starttag`."""
        if tag in self._SILENT:
            self._silent += 1
        elif tag == "span":
            self._parts.append(" ")
        elif tag not in (*self._INLINE, *self._CELLS):
            self._parts.append("\n")

    def handle_endtag(self, tag: str) -> None:
        """See `HTMLParser.handle_endtag`."""
        if tag in self._SILENT:
            self._silent -= 1
        elif tag in self._CELLS:
            self._parts.append(" | ")
        elif tag not in (*self._INLINE, "span"):
            self._parts.append("\n")

    def handle_data(self, data: str) -> None:
        """See `HTMLParser.handle_data`."""
        if not self._silent:
            self._parts.append(re.sub(r"\s+", " ", data))

    def text(self) -> str:
        """Return the lines that are not empty."""
        lines = [line.strip().removesuffix(" |") for line in "".join(self._parts).split("\n")]
        return "\n".join(line for line in lines if line.strip(" |"))


def file_of(name: str) -> Path:
    """Return the file of a snapshot."""
    return STORED / f"{name}.txt"


def remake(name: str) -> None:
    """Play a session, and store what it says."""
    with tempfile.TemporaryDirectory() as folder:
        texts = play(SESSIONS[name], Path(folder))
    for page, text in texts.items():
        file_of(page or name).write_text(text, encoding="utf-8")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Remake the snapshots of what commands print and pages say.")
    parser.add_argument("sessions", nargs="*", metavar="SESSION", help=f"of {', '.join(SESSIONS)} (default: all)")
    chosen = parser.parse_args().sessions or [*SESSIONS]
    STORED.mkdir(exist_ok=True)
    for session in chosen:
        remake(session)
