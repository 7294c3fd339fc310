"""A recording written by a process of its own, while its caller does something else."""

from __future__ import annotations

import contextlib
import os
import pickle
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

from quadsim.errors import OutputError
from quadsim.flight.rundir import RECORDING_FILE


@contextlib.contextmanager
def recording_aside(directory: Path) -> Iterator[None]:
    """Write a run directory's recording while the block runs; it is complete once the block is left.

    A Ctrl-C does not reach the process, which has no terminal of its own: whatever ends the block early ends it too,
    and what it wrote until then is not under the recording's name.

    Raises:
        OutputError: the file cannot be written, as from `write_recording`.
    """
    packages = os.pathsep.join(filter(None, (str(Path(__file__).resolve().parents[3]), os.environ.get("PYTHONPATH"))))
    with subprocess.Popen(
        [sys.executable, "-m", "quadsim.report.recording", str(directory)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        env={**os.environ, "PYTHONPATH": packages},
        process_group=0,
    ) as process:
        try:
            yield
            raised, said = process.communicate()
        finally:
            process.kill()  # of no consequence to one that is done
    if raised:
        raise pickle.loads(raised)
    if process.returncode:
        last = said.decode(errors="replace").strip().rpartition("\n")[2]
        raise OutputError(directory / RECORDING_FILE, last or f"its process ended with status {process.returncode}")
