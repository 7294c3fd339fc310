"""`python -m quadsim.report.recording RUN`: what `recording_in_background` starts; an error goes to stdout, pickled."""

from __future__ import annotations

import pickle
import sys
import traceback
from pathlib import Path

from quadsim.flight.rundir import RECORDING_FILE, load_run
from quadsim.report.recording import write_recording


def main(directory: Path) -> int:
    """Write the recording of a run directory; returns the exit status."""
    try:
        write_recording(load_run(directory), directory / RECORDING_FILE)
    except Exception as error:
        error.add_note(traceback.format_exc())
        sys.stdout.buffer.write(pickle.dumps(error))
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1])))
