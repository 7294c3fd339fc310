"""The process of the `quadsim` command: any stop signal, from its first moment on, ends it in order.

Ctrl-C, SIGTERM and SIGHUP all are `KeyboardInterrupt`, unless the process was started with them ignored, as by `nohup`.
"""

from __future__ import annotations

import contextlib
import io
import math
import os
import signal
import sys
import time as clock
from types import FrameType
from typing import Final

_STOPS: Final = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
_PATIENCE_S: Final = 1.0
"""Within which another signal is the same one: what is cleared up meanwhile is not to be interrupted."""
_LONGEST_IMPORT_S: Final = 5.0  # all of ours together take a fifth of that, on a busy machine more


class _Stop:
    """Makes Ctrl-C of a signal; who goes away, or is impatient, sends several.

    Python ignores an exception that comes up in a destructor or a callback, of which imports have many; a compiled
    module that is being imported makes an ImportError of it, which whoever can do without that module ignores.  Such a
    Ctrl-C is raised once more, and none within an import, unless that does not end.

    Attributes:
        heard: whether there was one.
    """

    def __init__(self) -> None:
        self._first = self._last = -math.inf

    @property
    def heard(self) -> bool:
        return math.isfinite(self._last)

    def raise_again(self, ignored: sys.UnraisableHookArgs) -> None:
        """See `sys.unraisablehook`."""
        if issubclass(ignored.exc_type, KeyboardInterrupt):
            self._raise_soon()
        else:
            sys.__unraisablehook__(ignored)

    def __call__(self, number: int, frame: FrameType | None) -> None:
        """See `signal.signal`."""
        now = clock.monotonic()
        if number != signal.SIGALRM:
            before, self._last = self._last, now
            if now - before <= _PATIENCE_S:
                return
            if now - self._first > _LONGEST_IMPORT_S:
                self._first = now
        if _is_importing(frame) and now - self._first < _LONGEST_IMPORT_S:
            self._raise_soon()
        else:
            raise KeyboardInterrupt

    def _raise_soon(self) -> None:
        signal.signal(signal.SIGALRM, self)
        signal.setitimer(signal.ITIMER_REAL, 0.01)


def _is_importing(frame: FrameType | None) -> bool:
    while frame is not None and not frame.f_code.co_filename.startswith("<frozen importlib"):
        frame = frame.f_back
    return frame is not None


def main() -> int:
    """Run the command line of this process; returns the exit status."""
    heard = [stop for stop in _STOPS if signal.getsignal(stop) is not signal.SIG_IGN]
    handler = _Stop()
    try:
        for stop in heard:
            signal.signal(stop, handler)
        sys.unraisablehook = handler.raise_again
        _open_what_is_closed()
        if sys.stdout is None:
            print("quadsim: stdout is closed; to do without what is printed: >/dev/null", file=sys.stderr)
            return 2
        if isinstance(sys.stdout, io.TextIOWrapper) and sys.stdout.errors in ("strict", "surrogateescape"):
            sys.stdout.reconfigure(errors="backslashreplace")  # a terminal may lack characters
        from scenarios.cli import main as run

        if handler.heard:  # and swallowed by what was imported
            raise KeyboardInterrupt
        return run()
    except (KeyboardInterrupt, ImportError, SystemError) as error:
        if not (isinstance(error, KeyboardInterrupt) or handler.heard):
            raise
        signal.setitimer(signal.ITIMER_REAL, 0.0)  # a stop that was to be raised after an import is answered here
        with contextlib.suppress(OSError):  # the terminal may be gone
            print("quadsim: interrupted (Ctrl-C); nothing half written was left behind", file=sys.stderr)
        return 1
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        for stop in heard:  # what is done is done, and the status reports how
            signal.signal(stop, signal.SIG_IGN)


def _open_what_is_closed() -> None:
    """Take the numbers of streams that are closed, or the next file would get them, and what is printed with them."""
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # gets the lowest number that is free
    if sys.stderr is None:
        sys.stderr = open(os.devnull, "w", encoding="utf-8")  # noqa: PTH123, SIM115
