"""A finished run -> a rerun recording that opens with its layout, and the viewer it opens in.

Everything stands on one timeline, `sim_time`, the simulated time:

    world/...           vehicle, thrusts, external force, wind, flown path, reference, and the horizon predicted at each
                        control period of flight
    signals/NAME        what can be limited, by the names and in the units of `quadsim.flight.audit.SIGNALS`
    reference/NAME      what x, y, z and yaw should be
    limits/NAME         the bounds, drawn with their signal
    margins/NAME        signed distance to the nearer bound at the control samples; negative = violated
    verdicts/NAME       what that says: holds, active, violated
    solver/NAME         what each step of the controller took and answered
    effects/NAME        external force and torque, wind, commands that rotors do not follow at once; where there are any
    events, summary     texts
"""

from __future__ import annotations

import hashlib
from pathlib import Path

import numpy as np

from quadsim.errors import OutputError
from quadsim.flight.rundir import Run
from quadsim.outputs import write_new
from quadsim.report.palette import line_colour
from quadsim.report.recording.child import recording_aside
from quadsim.report.recording.layout import blueprint
from quadsim.report.recording.signals import send_effects, send_limit, send_signals, send_solver
from quadsim.report.recording.style import on_screen
from quadsim.report.recording.texts import send_texts
from quadsim.report.recording.viewer import open_viewer, viewer_problem
from quadsim.report.recording.world import send_airframe, send_scene

__all__ = ["open_viewer", "recording_aside", "viewer_problem", "write_recording"]


def write_recording(run: Run, path: Path) -> None:
    """Write a run as a rerun recording with its layout inside; the file appears complete or not at all.

    Args:
        run: a run, completed or aborted, of any length.
        path: the `.rrd` to write; there must be none.

    Raises:
        OutputError: the file cannot be written or is there already, or the environment switches rerun off.
    """
    path = Path(path)
    write_new(path, _encode(run, path))


def _encode(run: Run, path: Path) -> bytes:
    """The file's content, made in memory: rerun's own file writer hides from Python why it failed."""
    import rerun as rr

    recording = rr.RecordingStream(f"quadsim {run.name}", recording_id=_identity(run), send_properties=False)
    if not rr.is_enabled(recording):
        raise OutputError(path, "rerun is switched off by the environment variable RERUN")
    memory = recording.memory_recording()
    strict = rr.strict_mode()
    rr.set_strict_mode(True)  # otherwise what cannot be recorded is left out with a warning
    try:
        recording.send_recording_name(run.name)
        recording.send_blueprint(blueprint(run), make_active=True, make_default=True)
        send_airframe(recording, run.vehicle)
        send_scene(recording, run)
        send_signals(recording, run.log)
        for limit in run.limits:
            peers = [peer.name for peer in run.limits if peer.unit == limit.unit]  # in one plot of margins
            send_limit(recording, limit, run.log, on_screen(line_colour(peers.index(limit.name))))
        send_solver(recording, run)
        send_effects(recording, run.log)
        send_texts(recording, run)
        return bytes(memory.drain_as_bytes())
    finally:
        rr.set_strict_mode(strict)
        recording.disconnect()


def _identity(run: Run) -> str:
    """The same for equal flights and different for others: the viewer merges recordings that share it."""
    digest = hashlib.sha256(repr((run.vehicle, run.limits)).encode())
    for array in (run.log.control.state, run.log.control.reference, run.log.control.speeds, run.log.plant.state):
        digest.update(np.ascontiguousarray(array).tobytes())
    return f"{run.name}-{digest.hexdigest()[:16]}"
