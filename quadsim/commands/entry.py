"""The process of the `quadsim` command: its environment, set before any other import, its signals and streams.

Ctrl-C, SIGTERM and SIGHUP all raise `KeyboardInterrupt`, unless the process was started with them ignored, as by
`nohup`.  A command that received one of them ends with 128 and its number, as a shell expects, whatever it has kept.
"""

from __future__ import annotations

import contextlib
import io
import os
import signal
import sys
from types import FrameType
from typing import Final

from quadsim.interrupts import STOPS

_THREADS: Final = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
_RENDERERS: Final = ("", "egl", "osmesa", "glfw", "disable")


def main() -> int:
    """Run the command line of this process; returns the exit status."""
    _open_closed_streams()
    stops = _StopSignals()
    status = 0
    what_is_kept = "what was finished is kept, and nothing is half written"
    try:
        try:
            stops.handle()
            status = _work()
        finally:
            stops.working = False
    except BaseException as error:  # compiled modules and user code may turn `KeyboardInterrupt` into others
        stops.working = False
        if stops.first is None:
            raise
        if isinstance(error, KeyboardInterrupt):
            what_is_kept = str(error) or what_is_kept
    finally:
        stops.release()
    if stops.first is None:
        return status
    with contextlib.suppress(OSError):  # the terminal may be gone
        print(f"quadsim: interrupted ({stops.name}); {what_is_kept}", file=sys.stderr)
    return 128 + stops.first


class _StopSignals:
    """The signals that stop this process.

    The first one is remembered, because the exception that it raises may be caught by whatever code runs then, where a
    flight is kept, or get lost in a destructor or a compiled module.
    """

    first: signal.Signals | None = None
    working = True
    """Whether a signal raises `KeyboardInterrupt`; afterwards it is remembered only."""

    def __init__(self) -> None:
        self._handled = [stop for stop in STOPS if signal.getsignal(stop) is not signal.SIG_IGN]

    def handle(self) -> None:
        """Let each of them interrupt this process by `KeyboardInterrupt`, unless it is ignored."""
        for stop in self._handled:
            signal.signal(stop, self._interrupt)

    def release(self) -> None:
        """Leave the process to its signals: one that arrives while Python shuts down kills it."""
        signal.pthread_sigmask(signal.SIG_BLOCK, self._handled)
        for stop in self._handled:
            signal.signal(stop, signal.SIG_DFL)
        signal.pthread_sigmask(signal.SIG_UNBLOCK, self._handled)

    @property
    def name(self) -> str:
        """What a user calls the first one."""
        if self.first is None:
            return ""
        if self.first == signal.SIGINT:
            return "Ctrl-C"
        return self.first.name

    def _interrupt(self, number: int, frame: FrameType | None) -> None:
        if self.first is None:
            self.first = signal.Signals(number)
        if self.working:
            raise KeyboardInterrupt


def _work() -> int:
    """Set the environment and run the command; returns its exit status."""
    problem = _set_environment()
    if sys.stdout is None:
        problem = "stdout is closed; to do without what is printed: >/dev/null"
    if problem is not None:
        print(f"quadsim: {problem}", file=sys.stderr)
        return 2
    if isinstance(sys.stdout, io.TextIOWrapper) and sys.stdout.errors in ("strict", "surrogateescape"):
        sys.stdout.reconfigure(errors="backslashreplace")  # a terminal may lack characters
    from quadsim.commands.cli import main as run

    status = run()
    if "--json" in sys.argv:
        os.dup2(2, 1)  # user code may print at exit too
    return status


def _set_environment() -> str | None:
    """Set the environment of this process and its children; return what was wrong with it, or None."""
    os.environ["PYTHONSAFEPATH"] = "1"  # mujoco's import starts `python -c`, which would import from this directory
    os.environ.update(dict.fromkeys(_THREADS, "1"))  # results must not depend on the number of cores
    renderer = os.environ.pop("MUJOCO_GL", "")  # with a missing library, mujoco's import fails
    os.environ["QUADSIM_GL"] = renderer.strip().lower()
    if os.environ["QUADSIM_GL"] not in _RENDERERS:
        return f"MUJOCO_GL must be one of {', '.join(filter(None, _RENDERERS))}, or unset; got {renderer!r:.100}"
    epoch = os.environ.get("SOURCE_DATE_EPOCH", "0")
    if not (epoch.isascii() and epoch.isdigit() and len(epoch) <= 12):  # matplotlib reads it
        return f"SOURCE_DATE_EPOCH must be a whole number of seconds since 1970, or unset; got {epoch!r:.100}"
    return None


def _open_closed_streams() -> None:
    """Open the numbers of closed streams, or the next file would receive them and whatever is printed."""
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # gets the lowest number that is free
    if sys.stderr is None:
        sys.stderr = open(os.devnull, "w", encoding="utf-8")  # noqa: PTH123, SIM115


if __name__ == "__main__":
    sys.exit(main())
