"""Take features away and see the rest pass: `make without-features`.

In a copy of the checkout each feature loses its folders, its tests, its pages and its lines in the two lists of
features, `quadsim/features/entries.py` and `quadsim/__init__.py`.  There `quadsim list` and `quadsim run hover` have to
work. Without all features, the remaining quick tests are run too; without a single one, all of them are collected,
which imports them, and those of the architecture are run.  What a test uses of features when it runs,
`test_without_features.py` holds to `USING`.

    python tests/without_features.py                # each feature by itself, then all at once
    python tests/without_features.py live campaign  # these two at once, with all quick tests
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
from quadsim.features.entries import FEATURES

ROOT: Final = Path(__file__).resolve().parent.parent
PARTS: Final = {
    "campaign": ("scenarios/campaigns", "docs/campaigns.md"),
    "design": (),
    "export": (
        "quadsim/mpc/export",
        "tests/features/export",
        "tests/firmware",
        "tests/exported_c.py",
        "docs/export.md",
    ),
    "gym": ("quadsim/gym.py", "docs/gym.md"),
    "identify": ("docs/identify.md",),
    "live": ("docs/live.md",),
    "papers": ("scenarios/papers",),
    "stability": ("tests/scaled_laws.py", "benchmarks/stability.py", "docs/stability.md"),
}
"""Folders, tests and pages of each feature, beside `quadsim/features/NAME` and `tests/features/NAME`."""

EVERY: Final = tuple(PARTS)
USING: Final = {
    "mpc/laws/test_delay.py": ("export",),
    "mpc/laws/test_law_in_c.py": ("export",),
    "mpc/laws/test_linear_targets.py": ("export",),
    "mpc/pilot/test_attitudes.py": ("export",),
    "mpc/laws/test_one_list_of_laws.py": ("design",),
    "test_palette.py": ("live",),
    "test_plausibility.py": ("design",),
    "features/gym/test_environment.py": ("campaign",),
    "features/gym/test_ppo.py": ("campaign",),
    "features/gym/test_vector.py": ("campaign",),
    "features/identify/test_border_of_logs.py": ("design",),
    "features/identify/test_identify.py": ("design",),
    "features/identify/test_identify_fit.py": ("design",),
    "features/identify/test_identify_logs.py": ("design",),
    "features/identify/test_log_formats.py": ("design",),
    "features/identify/test_noise.py": ("design",),
    "features/identify/test_sensors.py": ("design",),
    "commands/test_answer_first.py": ("campaign", "design", "identify"),
    "commands/test_api.py": EVERY,
    "scenarios/test_bounded_input.py": ("campaign", "identify"),
    "commands/test_cli.py": EVERY,
    "scenarios/test_derived.py": ("campaign", "design"),
    "commands/test_help.py": EVERY,
    "rollout/test_infeasibility.py": ("campaign",),
    "scenarios/test_initial.py": ("campaign", "gym"),
    "rollout/test_latency.py": ("design",),
    "scenarios/test_library.py": ("campaign",),
    "scenarios/test_limits.py": ("live",),
    "rollout/test_logged.py": ("campaign",),
    "rollout/test_piloted.py": ("design",),
    "rollout/test_velocity_weights.py": ("export",),
    "console/test_notebook.py": ("campaign",),
    "console/test_progress.py": ("campaign",),
    "rollout/test_verdicts.py": ("campaign",),
    "commands/test_versions.py": ("campaign",),
    "test_commands.py": EVERY,
    "test_docstrings.py": EVERY,
    "test_documents.py": EVERY,
    "test_examples.py": EVERY,
    "test_groups.py": EVERY,
    "test_packaging.py": EVERY,
    "test_refusals.py": ("campaign",),
    "test_without_features.py": EVERY,
    "test_snapshots.py": EVERY,
}
"""Modules of tests that use a feature beside its own, and are left out without it; `EVERY` of what lists all."""
COMMANDS: Final = (
    ("quadsim.commands.entry", "list"),
    ("quadsim.commands.entry", "run", "hover", "--no-video", "--no-recording", "--no-figures", "--overwrite"),
)
"""What has to work without any feature."""
QUICK: Final = (
    *("pytest", "-q", "-n", "2", "--dist", "loadscope"),
    *("-m", "not slow or representative", "--hypothesis-profile=quick"),
)
"""As `make test`."""
COLLECTED: Final = ("pytest", "-q", "-n", "0", "-k", "test_architecture")
"""Every test is collected, and those of the architecture are run."""


def copy_without(features: Iterable[str], folder: Path) -> None:
    """Copy the checkout, as git knows it, into a folder, without some features."""
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
    for feature in features:
        for part in (f"quadsim/features/{feature}", f"tests/features/{feature}", *PARTS[feature]):
            path = folder / part
            shutil.rmtree(path) if path.is_dir() else path.unlink(missing_ok=True)
        _drop_entry(folder / "quadsim" / "features" / "entries.py", feature)
        names = folder / "quadsim" / "__init__.py"
        lines = names.read_text(encoding="utf-8").splitlines(keepends=True)
        names.write_text("".join(line for line in lines if not re.search(rf"\bquadsim\.features\.{feature}\b", line)))


def _drop_entry(file: Path, feature: str) -> None:
    """Delete a feature's entry in `FEATURES`."""
    text = file.read_text(encoding="utf-8")
    lists = (node.value for node in ast.walk(ast.parse(text)) if isinstance(node, ast.AnnAssign))
    keys, values = next((d.keys, d.values) for d in lists if isinstance(d, ast.Dict))
    key, value = next(pair for pair in zip(keys, values, strict=True) if ast.literal_eval(pair[0]) == feature)
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
    """Take away each feature, or those that are named; returns 1 if something fails without them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("features", nargs="*", metavar="FEATURE", help=", ".join(FEATURES))
    chosen = parser.parse_args()
    if unknown := {*chosen.features} - {*FEATURES}:
        parser.error(f"FEATURE must be of {', '.join(FEATURES)}; got {', '.join(unknown)}")
    passed = []
    if not chosen.features:
        with ThreadPoolExecutor(2) as pool:
            passed += pool.map(lambda feature: _passes([feature], COLLECTED), FEATURES)
    passed.append(_passes(chosen.features or [*FEATURES], QUICK))
    return int(not all(passed))


def _passes(features: Sequence[str], tests: Sequence[str]) -> bool:
    """Return whether the commands, and then the tests, work in a copy without some features; print it."""
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch).resolve()
        copy_without(features, folder)
        failure = failure_of([*COMMANDS, tests], folder)
    print(f"without {', '.join(features)}: {'passes' if failure is None else failure}", flush=True)
    return failure is None


if __name__ == "__main__":
    sys.exit(main())
