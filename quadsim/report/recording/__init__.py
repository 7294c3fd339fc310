"""A finished run -> a rerun recording that opens with its layout, and the viewer it opens in."""

from __future__ import annotations

import contextlib
import hashlib
import os
import signal
import subprocess
import sys
import time as clock
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np

from quadsim.errors import FileError, OutputError, ViewerUnavailableError
from quadsim.flight.record import FlightRecord
from quadsim.outputs import writing_file

if TYPE_CHECKING:
    from rerun import RecordingStream

_CALL: Final = "import sys; from rerun_cli.__main__ import main; sys.exit(main())"
_VIEWER: Final = (sys.executable, "-P", "-c", _CALL, "--bind=127.0.0.1", "--port=auto")
"""Starts a viewer of its own, which only this machine can reach."""
_INTERRUPTED: Final = 130  # the viewer's exit status after Ctrl-C
_GRACE: Final = 2.0  # time that a viewer has to end by itself [s]


def write_recording(run: FlightRecord, path: Path) -> None:
    """Write a run, completed or not, as a new `.rrd` with its layout inside; it appears complete or not at all.

    Everything stands on one timeline, `sim_time`, the simulated time:

        world/...           vehicle, thrusts, external force, wind, flown path, reference, and the horizon predicted at
                            each control period of flight
        signals/NAME        what can be limited, by the names and in the units of `quadsim.flight.audit.SIGNALS`; of
                            flights that may turn upside down quaternion and body_rates as well
        reference/NAME      what x, y, z and yaw should be
        limits/NAME         the bounds, drawn with their signal
        margins/NAME        signed distance to the nearer bound at the control samples; negative = beyond the bound
        verdicts/NAME       its verdict: holds, active, violated
        solver/NAME         what each step of the controller took and answered
        effects/NAME        external force and torque, wind, commands that rotors do not follow at once; where there
                            are any
        events, summary     texts

    Raises:
        OutputError: the file cannot be written or is there already, or the environment switches rerun off.
    """
    with writing_file(path) as new:
        new.write_bytes(_encode(run, path))


def _encode(run: FlightRecord, path: Path) -> bytes:
    """The file's content, made in memory: rerun's own file writer hides from Python why it failed."""
    import rerun as rr

    recording = rr.RecordingStream(f"quadsim {run.name}", recording_id=_identity(run), send_properties=False)
    if not rr.is_enabled(recording):
        raise OutputError(path, "rerun is switched off by the environment variable RERUN")
    memory = recording.memory_recording()
    strict = rr.strict_mode()
    rr.set_strict_mode(True)  # otherwise what cannot be recorded is left out with a warning
    try:
        _send(recording, run)
        return bytes(memory.drain_as_bytes())
    finally:
        rr.set_strict_mode(strict)
        recording.disconnect()


def _identity(run: FlightRecord) -> str:
    """A name of its own for each flight: the viewer merges recordings that share one."""
    digest = hashlib.sha256(repr((asdict(run.actual), run.limits)).encode())
    for array in (run.log.control.state, run.log.control.reference, run.log.control.speeds, run.log.plant.state):
        digest.update(np.ascontiguousarray(array).tobytes())
    return f"{run.name}-{digest.hexdigest()[:16]}"


def _send(recording: RecordingStream, run: FlightRecord) -> None:
    """Send everything there is of a flight, and the layout in which the viewer shows it."""
    import rerun.blueprint as rrb

    from quadsim.report.recording.plots import send_plots, send_texts
    from quadsim.report.recording.world import TIMELINE, scene_views, send_airframe, send_scene, send_space

    recording.send_recording_name(run.name)
    send_airframe(recording, run.actual)
    send_scene(recording, run)
    send_space(recording, run)
    send_texts(recording, run)
    views = rrb.Horizontal(scene_views(run), send_plots(recording, run), column_shares=[4, 5])
    layout = rrb.Blueprint(  # nothing is left to be clicked or unfolded
        views,
        rrb.TimePanel(state="collapsed", timeline=TIMELINE, play_state="playing", loop_mode="all"),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        auto_layout=False,
        auto_views=False,
    )
    recording.send_blueprint(layout, make_active=True, make_default=True)


def viewer_problem() -> str | None:
    """Why rerun's own window cannot be opened on this machine, or None."""
    if sys.platform.startswith("linux") and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        return "there is no display (neither DISPLAY nor WAYLAND_DISPLAY is set)"
    return None


def open_viewer(path: Path, *, web: bool = False) -> None:
    """Show a recording in rerun's own window, or serve it, to this machine alone, for a browser.

    Returns when the viewer is closed or Ctrl-C is pressed.

    Raises:
        FileError: there is no such file.
        ViewerUnavailableError: there is no display, or the viewer failed.
    """
    if not path.is_file():
        raise FileError(path, "there is no such recording")
    command = list(_VIEWER)
    advice = "see its message above"
    if web:
        command += ["--web-viewer", "--web-viewer-port=0"]
    else:
        advice += ", or show it in a browser with --web"
        problem = viewer_problem()
        if problem:
            remedy = f"show it in a browser with --web, or open {path} on another machine"
            raise ViewerUnavailableError(f"{problem}: {remedy}")
    try:
        status = _run([*command, str(path)])
    except KeyboardInterrupt:  # also of SIGTERM and SIGHUP, see `quadsim.commands.entry`
        return
    if status not in (0, _INTERRUPTED):
        raise ViewerUnavailableError(f"the rerun viewer ended with status {status}; {advice}")


def _run(command: Sequence[str]) -> int:
    """Run a program and return its exit status; whatever ends the wait ends the program too, and those that it started.

    rerun's command starts the viewer as a process of its own, which would outlive it.
    """
    program = subprocess.Popen(command, start_new_session=True)
    try:
        return program.wait()
    finally:
        _end_group(program)
        program.wait()


def _end_group(leader: subprocess.Popen[bytes]) -> None:
    """End the processes of a group: by SIGTERM, and by SIGKILL those that do not heed it."""
    with contextlib.suppress(ProcessLookupError, PermissionError):  # all of them have ended
        os.killpg(leader.pid, signal.SIGTERM)
        deadline = clock.monotonic() + _GRACE
        while clock.monotonic() < deadline:
            clock.sleep(0.02)
            leader.poll()  # until then an ended leader counts as one of the group
            os.killpg(leader.pid, 0)
        os.killpg(leader.pid, signal.SIGKILL)
