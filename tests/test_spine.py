"""How far a reader goes: the files that one flight enters, the calls to its controller, and the spine's length."""

from __future__ import annotations

import ast
import io
import json
import os
import re
import subprocess
import sys
import tokenize
from collections import Counter
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import pytest
from test_architecture import imports_of, modules

ROOT = Path(__file__).resolve().parent.parent
MOST_ENTERED, MOST_LOADED, MOST_FRAMES, LONGEST_CHAIN, SPINE_LINES = 88, 151, 8, 20, 2490
MOST_DATA_TYPES, MOST_CLASSES = 16, 75  # may only fall
pytestmark = pytest.mark.slow("spine")

COUNTED = "import runpy; runpy.run_path('tests/count_types.py', run_name='__main__')"
HELP = "import quadsim.commands.cli; quadsim.commands.cli.main(['--help'])"
WATCHED = """
import json, os, sys
from collections import Counter
PACKAGES = ("quadsim",)
FOLDERS = tuple(os.path.join(os.getcwd(), package, "") for package in PACKAGES)
entered, loaded, calls, frames, importing = set(), set(), Counter(), [], 0

def ours(frame):
    name = frame.f_globals.get("__name__", "")
    return name if name.partition(".")[0] in PACKAGES else ""

def watch(frame, event, _):  # a call
    global importing
    code = frame.f_code
    if not code.co_filename.startswith(FOLDERS) or not (name := ours(frame)):
        return
    if code.co_name == "<module>":
        importing += 1
        loaded.add(code.co_filename)
        frame.f_trace_lines = False
        return leave
    (loaded if importing else entered).add(code.co_filename)
    if importing:
        return
    calls[f"{name}.{code.co_qualname}"] += 1
    if code.co_name == "step" and name.startswith("quadsim.mpc.") and not frames:
        while frame is not None:
            frames.extend([f"{ours(frame)}.{frame.f_code.co_qualname}"] if ours(frame) else [])
            frame = frame.f_back

def leave(frame, event, _):
    global importing
    importing -= event == "return"
    return leave

sys.argv = ["quadsim", *sys.argv[1:]]
sys.settrace(watch)
from quadsim.commands.entry import main
status = main()
sys.settrace(None)
print(json.dumps([status, sorted(entered), sorted(loaded | entered), calls, frames]), file=sys.stderr)
"""


@pytest.fixture(scope="module")
def watched(tmp_path_factory: pytest.TempPathFactory) -> tuple[list[str], list[str], Counter[str], list[str]]:
    """Of one `quadsim run hover`: files whose functions run, files loaded, calls, and the frames of the first step."""
    out = tmp_path_factory.mktemp("watched") / "run"
    command = [sys.executable, "-c", WATCHED, "run", "hover", "--out", str(out), "--set", "duration=0.5"]
    done = subprocess.run([*command, "--no-video"], cwd=ROOT, capture_output=True, text=True, check=True)
    status, entered, loaded, calls, frames = json.loads(done.stderr.splitlines()[-1])
    assert status == 0
    return entered, loaded, Counter(calls), frames


def test_one_flight_enters_few_files(watched: Any) -> None:
    """With its tables, figures and recording; a file counts where a function of it runs, but at an import."""
    entered, loaded, _, _ = watched
    assert len(entered) <= MOST_ENTERED, entered
    assert len(loaded) <= MOST_LOADED, loaded


def test_a_vehicle_is_loaded_once_and_a_course_is_built_once(watched: Any) -> None:
    _, _, calls, _ = watched
    assert calls["quadsim.vehicle.load_vehicle"] == 1
    assert [
        count for name, count in calls.items() if re.fullmatch(r"quadsim\.scenarios\.courses\..*\.build", name)
    ] == [1]


def test_the_controller_s_first_step_is_few_calls_deep(watched: Any) -> None:
    *_, frames = watched
    assert frames[0].endswith(".step")
    assert len(frames) <= MOST_FRAMES, frames


def test_one_flight_has_few_kinds() -> None:
    """Data types of a control period, and classes of a flight, as `tests/count_types.py` counts them."""
    done = subprocess.run([sys.executable, "-c", COUNTED], cwd=ROOT, capture_output=True, text=True, check=True)
    data_types, classes = map(int, re.findall(r"^(\d+) ", done.stdout, re.M))
    assert 0 < data_types <= MOST_DATA_TYPES, done.stdout
    assert data_types < classes <= MOST_CLASSES, done.stdout


def spine() -> list[Path]:
    """The files that CONTRIBUTING.md lists to be read first, in this order."""
    paragraph = (
        (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8").partition("## The spine")[2].partition("\n## ")[0]
    )
    return [ROOT / name for name in re.findall(r"\]\(((?!tests)[\w/]+\.py)\)", paragraph)]


def code_lines(path: Path) -> set[int]:
    """The lines of a file that are code: no docstring, comment or blank line."""
    text = path.read_text(encoding="utf-8")
    documented = {
        line
        for node in ast.walk(ast.parse(text))
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)
        for line in range(node.lineno, (node.end_lineno or node.lineno) + 1)
    }
    return {*_lines_of_tokens(text)} - documented


def _lines_of_tokens(text: str) -> Iterator[int]:
    blank = {tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT, tokenize.ENDMARKER}
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type not in blank:
            yield from range(token.start[0], token.end[0] + 1)


@pytest.mark.witness("spine")
def test_the_spine_is_short() -> None:
    """Lines of code; of `app.py`, the last, what takes part in `quadsim run`."""
    files = spine()
    assert 10 <= len(files) <= 12
    *others, app = files
    functions = [node for node in ast.parse(app.read_text()).body if isinstance(node, ast.FunctionDef)]
    parts = [node for node in functions if node.name in ("run", "_announce")]
    run = {line for node in parts for line in range(node.lineno, (node.end_lineno or 0) + 1)}
    lengths = {path.name: len(code_lines(path)) for path in others} | {app.name: len(code_lines(app) & run)}
    assert sum(lengths.values()) <= SPINE_LINES, lengths


@pytest.mark.witness("spine")
def test_the_longest_chain_of_imports_is_short() -> None:
    ours = modules()
    graph = {
        name: {i.imported for i in imports_of(name, path.read_text(), {*ours}) if i.at_start} & {*ours} - {name}
        for name, path in ours.items()
    }

    @cache
    def chain(name: str) -> tuple[str, ...]:
        return (name, *max(map(chain, graph[name]), key=len, default=()))

    longest = max(map(chain, graph), key=len)
    assert len(longest) <= LONGEST_CHAIN, longest


@pytest.mark.witness("spine")
@pytest.mark.parametrize(
    ("code", "most"), [("import quadsim", 0.1), ("import quadsim.commands.cli as c; c.main(['-h'])", 0.3)]
)
def test_what_answers_at_once_does(code: str, most: float) -> None:
    """Processor time of the fastest of three, without the interpreter's own; twice that on a busy machine."""

    def seconds(text: str) -> float:
        before = os.times()
        subprocess.run([sys.executable, "-c", text], cwd=ROOT, capture_output=True, check=True)
        after = os.times()
        return after.children_user + after.children_system - before.children_user - before.children_system

    assert min(seconds(code) for _ in range(3)) - min(seconds("pass") for _ in range(3)) <= 2.0 * most
