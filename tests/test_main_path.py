"""One flight does each thing once, and what answers at once does so."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from collections import Counter
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
pytestmark = pytest.mark.slow("main path")

WATCHED = """
import json, os, sys
from collections import Counter
FOLDER = os.path.join(os.getcwd(), "quadsim", "")
calls = Counter()

def watch(frame, event, argument):
    if event == "call" and frame.f_code.co_filename.startswith(FOLDER):
        calls[frame.f_globals.get("__name__", "") + "." + frame.f_code.co_qualname] += 1

sys.argv = ["quadsim", *sys.argv[1:]]
sys.setprofile(watch)
from quadsim.commands.entry import main
status = main()
sys.setprofile(None)
print(json.dumps([status, calls]), file=sys.stderr)
"""


@pytest.fixture(scope="module")
def calls(tmp_path_factory: pytest.TempPathFactory) -> Counter[str]:
    """How often each function of ours is called in one `quadsim run hover`, with its figures and recording."""
    out = tmp_path_factory.mktemp("watched") / "run"
    command = [sys.executable, "-c", WATCHED, "run", "hover", "--out", str(out), "--set", "duration=0.5"]
    done = subprocess.run([*command, "--no-video"], cwd=ROOT, capture_output=True, text=True, check=True)
    status, counted = json.loads(done.stderr.splitlines()[-1])
    assert status == 0
    return Counter(counted)


def test_a_vehicle_is_loaded_once_and_a_course_is_built_once(calls: Counter[str]) -> None:
    assert calls["quadsim.vehicle.load_vehicle"] == 1
    course = re.compile(r"quadsim\.scenarios\.courses\..*\.build")
    assert [count for name, count in calls.items() if course.fullmatch(name)] == [1]


@pytest.mark.representative("main path")
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
