"""Take rooms away and see the rest pass: `make rooms`.

In a copy of the checkout each room loses its folders, its tests, its pages and its lines in the two lists of rooms,
`scenarios/commands/rooms.py` and `quadsim/__init__.py`; then `quadsim list`, `quadsim run hover` and the remaining
quick tests are run there.

    python tests/rooms.py                # each room by itself, then all at once
    python tests/rooms.py live campaign  # these two at once
"""

from __future__ import annotations

import argparse
import ast
import os
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Final

from quadsim.core.build import LIBRARY
from scenarios.commands.rooms import ROOMS

ROOT: Final = Path(__file__).resolve().parent.parent
PARTS: Final = {
    "campaign": ("scenarios/library/campaigns", "docs/campaigns.md", "docs/own-campaign.md", "docs/survive.md"),
    "design": (),
    "export": ("mpc/codegen", "tests/export", "tests/firmware", "tests/exported_c.py", "docs/export.md", "docs/fly.md"),
    "gym": ("quadsim/gym.py", "docs/gym.md"),
    "identify": ("docs/identify.md",),
    "live": ("docs/live.md",),
    "papers": ("scenarios/library/papers", "docs/papers.md"),
}
"""Folders, tests and pages of each room, beside `scenarios/NAME` and `tests/scenarios/NAME`."""

EVERY: Final = tuple(PARTS)
USING: Final = {
    "mpc/core/test_law.py": ("export",),
    "quadsim/test_palette.py": ("live",),
    "quadsim/test_plausibility.py": ("design",),
    "scenarios/test_answer_first.py": ("campaign", "design", "identify"),
    "scenarios/test_api.py": EVERY,
    "scenarios/test_bounded_input.py": ("campaign", "identify"),
    "scenarios/test_cli.py": EVERY,
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
    parser.add_argument(
        "--tests", default="-m 'not slow or witness'", help="arguments of pytest (default: %(default)s)"
    )
    chosen = parser.parse_args()
    if unknown := {*chosen.rooms} - {*ROOMS}:
        parser.error(f"ROOM must be of {', '.join(ROOMS)}; got {', '.join(unknown)}")
    failed = False
    for rooms in [chosen.rooms] if chosen.rooms else [*([room] for room in ROOMS), [*ROOMS]]:
        with tempfile.TemporaryDirectory() as scratch:
            folder = Path(scratch).resolve()
            copy_without(rooms, folder)
            tests = ["pytest", "-q", "-n", "2", "--dist", "loadscope", *shlex.split(chosen.tests)]
            failure = failure_of([*COMMANDS, tests], folder)
        print(f"without {', '.join(rooms)}: {'passes' if failure is None else failure}", flush=True)
        failed |= failure is not None
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
