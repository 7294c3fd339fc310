"""`python -m quadsim.report.recording RUN FILE`: what `recording_in_background` starts; stdout has a pickled error."""

from __future__ import annotations

import pickle
import sys
import traceback
from pathlib import Path

from quadsim.flight.rundir import load_run
from quadsim.report.recording import write_recording


def main(directory: Path, path: Path) -> int:
    """Write the recording of a run directory to a file; returns the exit status."""
    try:
        write_recording(load_run(directory), path)
    except Exception as error:
        error.add_note(traceback.format_exc())
        sys.stdout.buffer.write(pickle.dumps(error))
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1]), Path(sys.argv[2])))
