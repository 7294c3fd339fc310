"""Attacks run as an ordinary user, who may read everything and write nowhere but in a directory of the test's own."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
_NOBODY, _MAY = 65534, "dac_read_search"


def counts_of(script: str, *arguments: str) -> dict[str, int]:
    """What a script below `tests/` counts, given on its last line as JSON; it runs in an empty directory.

    Raises:
        RuntimeError: it failed; what it printed.
    """
    with tempfile.TemporaryDirectory() as place:
        scratch = Path(place).resolve() / "scratch"
        scratch.mkdir()
        user: list[str] = []
        if os.geteuid() == 0:
            os.chown(scratch, _NOBODY, _NOBODY)
            Path(place).chmod(0o755)
            user = ["setpriv", f"--reuid={_NOBODY}", f"--regid={_NOBODY}", "--clear-groups"]
            user += [f"--{kind}=-all,+{_MAY}" for kind in ("inh-caps", "ambient-caps", "bounding-set")]
        folders = dict.fromkeys(("HOME", "TMPDIR", "MPLCONFIGDIR"), str(scratch))
        packages = {"PYTHONPATH": f"{ROOT}{os.pathsep}{ROOT / 'tests'}"}
        command = [*user, sys.executable, str(ROOT / "tests" / script), *arguments]
        done = subprocess.run(
            command, env={**os.environ, **folders, **packages}, cwd=scratch, capture_output=True, text=True
        )
    if done.returncode:
        raise RuntimeError(done.stdout + done.stderr)
    counts: dict[str, int] = json.loads(done.stdout.splitlines()[-1])
    return counts
