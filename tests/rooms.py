"""Take rooms away and see the rest pass: `make rooms`.

In a copy of the checkout each room loses its folders, its tests, its pages and its lines in the two lists of rooms,
`scenarios/commands/rooms.py` and `quadsim/__init__.py`.  There `quadsim list` and `quadsim run hover` have to work.
Without all rooms, the remaining quick tests are run too; without a single one, all of them are collected, which imports
them, and those of the architecture are run.  What a test uses of rooms when it runs, `test_rooms.py` holds to `USING`.

    python tests/rooms.py                # each room by itself, then all at once
    python tests/rooms.py live campaign  # these two at once, with all quick tests
"""

from __future__ import annotations

import argparse
import ast
import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Final

from quadsim.core.build import LIBRARY
from scenarios.commands.rooms import ROOMS

ROOT: Final = Path(__file__).resolve().parent.parent
PARTS: Final = {
    "campaign": ("scenarios/library/campaigns", "docs/campaigns.md"),
    "design": (),
    "export": ("mpc/codegen", "tests/export", "tests/firmware", "tests/exported_c.py", "docs/export.md"),
    "gym": ("quadsim/gym.py", "docs/gym.md"),
    "identify": ("docs/identify.md",),
    "live": ("docs/live.md",),
    "papers": ("scenarios/library/papers",),
}
"""Folders, tests and pages of each room, beside `scenarios/NAME` and `tests/scenarios/NAME`."""

EVERY: Final = tuple(PARTS)
USING: Final = {
    "mpc/core/test_law.py": ("export",),
    "quadsim/test_palette.py": ("live",),
    "quadsim/test_plausibility.py": ("design",),
    "scenarios/gym/test_environment.py": ("campaign",),
    "scenarios/gym/test_ppo.py": ("campaign",),
    "scenarios/identify/test_identify.py": ("design",),
    "scenarios/identify/test_identify_fit.py": ("design",),
    "scenarios/identify/test_identify_logs.py": ("design",),
    "scenarios/identify/test_log_formats.py": ("design",),
    "scenarios/test_answer_first.py": ("campaign", "design", "identify"),
    "scenarios/test_api.py": EVERY,
    "scenarios/test_bounded_input.py": ("campaign", "identify"),
    "scenarios/test_cli.py": EVERY,
    "scenarios/test_derived.py": ("campaign", "design"),
    "scenarios/test_help.py": EVERY,
    "scenarios/test_infeasibility.py": ("campaign",),
    "scenarios/test_initial.py": ("campaign", "gym"),
    "scenarios/test_latency.py": ("design",),
    "scenarios/test_library.py": ("campaign",),
    "scenarios/test_limits.py": ("live",),
    "scenarios/test_logged.py": ("campaign",),
    "scenarios/test_piloted.py": ("design",),
    "scenarios/test_progress.py": ("campaign",),
    "scenarios/test_verdicts.py": ("campaign",),
    "scenarios/test_versions.py": ("campaign",),
    "test_commands.py": EVERY,
    "test_documents.py": EVERY,
    "test_examples.py": EVERY,
    "test_groups.py": EVERY,
    "test_own_packages.py": ("campaign",),
    "test_packaging.py": EVERY,
    "test_refusals.py": ("campaign",),
    "test_rooms.py": EVERY,
}
"""Modules of tests that use a room beside its own, and are left out without it; `EVERY` of what lists all."""
COMMANDS: Final = (
    ("scenarios.commands.entry", "list"),
    ("scenarios.commands.entry", "run", "hover", "--no-video", "--no-recording", "--no-figures", "--overwrite"),
)
"""What has to work without any room."""
QUICK: Final = (
    *("pytest", "-q", "-n", "2", "--dist", "loadscope", "-m", "not slow or witness", "--hypothesis-profile=quick"),
)
"""As `make test`."""
COLLECTED: Final = ("pytest", "-q", "-n", "0", "-k", "test_architecture")
"""Every test is collected, and those of the architecture are run."""


def copy_without(rooms: Iterable[str], folder: Path) -> None:
    """Copy the checkout, as git knows it, into a folder, without some rooms."""
    listed = subprocess.run(
        ["git", "ls-files", "--cached", "--others", "--exclude-standard", "-z"],
        cwd=ROOT,
        check=True,
        capture_output=True,
    )
    for name in listed.stdout.decode().rstrip("\0").split("\0"):
        if (ROOT / name).is_file():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, folder / name)
    if (ROOT / LIBRARY).is_file():
        shutil.copy2(ROOT / LIBRARY, folder / LIBRARY)
    for room in rooms:
        for part in (f"scenarios/{room}", f"tests/scenarios/{room}", *PARTS[room]):
            path = folder / part
            shutil.rmtree(path) if path.is_dir() else path.unlink(missing_ok=True)
        _drop_entry(folder / "scenarios" / "commands" / "rooms.py", room)
        names = folder / "quadsim" / "__init__.py"
        lines = names.read_text(encoding="utf-8").splitlines(keepends=True)
        names.write_text("".join(line for line in lines if not re.search(rf"\bscenarios\.{room}\b", line)))


def _drop_entry(file: Path, room: str) -> None:
    """Delete a room's entry in `ROOMS`."""
    text = file.read_text(encoding="utf-8")
    lists = (node.value for node in ast.walk(ast.parse(text)) if isinstance(node, ast.AnnAssign))
    keys, values = next((d.keys, d.values) for d in lists if isinstance(d, ast.Dict))
    key, value = next(pair for pair in zip(keys, values, strict=True) if ast.literal_eval(pair[0]) == room)
    lines = text.splitlines(keepends=True)
    del lines[key.lineno - 1 : value.end_lineno]
    file.write_text("".join(lines), encoding="utf-8")


def failure_of(commands: Iterable[Sequence[str]], folder: Path) -> str | None:
    """Run modules of Python in a copy; return the end of what the first that fails prints, None if none does."""
    environment = {**os.environ, "PYTHONPATH": str(folder)}
    for arguments in commands:
        command = [sys.executable, "-m", *arguments]
        done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)
        if done.returncode:
            return f"{' '.join(arguments)}\n{done.stdout[-6000:]}\n{done.stderr[-2000:]}"
    return None


def main() -> int:
    """Take away each room, or those that are named; returns 1 if something fails without them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("rooms", nargs="*", metavar="ROOM", help=", ".join(ROOMS))
    chosen = parser.parse_args()
    if unknown := {*chosen.rooms} - {*ROOMS}:
        parser.error(f"ROOM must be of {', '.join(ROOMS)}; got {', '.join(unknown)}")
    passed = []
    if not chosen.rooms:
        with ThreadPoolExecutor(2) as pool:
            passed += pool.map(lambda room: _passes([room], COLLECTED), ROOMS)
    passed.append(_passes(chosen.rooms or [*ROOMS], QUICK))
    return int(not all(passed))


def _passes(rooms: Sequence[str], tests: Sequence[str]) -> bool:
    """Return whether the commands, and then the tests, work in a copy without some rooms; print it."""
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch).resolve()
        copy_without(rooms, folder)
        failure = failure_of([*COMMANDS, tests], folder)
    print(f"without {', '.join(rooms)}: {'passes' if failure is None else failure}", flush=True)
    return failure is None


if __name__ == "__main__":
    sys.exit(main())
