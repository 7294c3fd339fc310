"""What commands print and pages say is what the stored texts say; `python tests/snapshots.py` remakes them."""

from __future__ import annotations

from difflib import unified_diff
from pathlib import Path

import pytest
import snapshots
from snapshots import SESSIONS, STORED, play

from quadsim.commands.app import app

SLOW = pytest.mark.slow("identification")
QUICK = [name for name, session in SESSIONS.items() if not session.slow]
CASES = [pytest.param(name, marks=[] if name in QUICK else SLOW) for name in SESSIONS]


def test_every_command_has_a_session_and_every_snapshot_is_of_one() -> None:
    commands = {name for name in app if not name.startswith("-")}
    assert set(SESSIONS) == {"quadsim", *commands}
    pages = {page for session in SESSIONS.values() for page in session.pages}
    assert {path.stem for path in STORED.iterdir()} == {*SESSIONS, *pages}


@pytest.mark.parametrize("name", CASES)
def test_a_command_prints_and_its_pages_say_what_is_stored(name: str, tmp_path: Path) -> None:
    differences: list[str] = []
    for page, text in play(SESSIONS[name], tmp_path).items():
        file = snapshots.file_of(page or name)
        stored = file.read_text(encoding="utf-8").splitlines()
        differences += unified_diff(stored, text.splitlines(), f"{file.name}, stored", f"{file.name}, now", lineterm="")
    advice = f"after an intended change: python tests/snapshots.py {name}"
    assert not differences, "\n".join([*differences, advice])
