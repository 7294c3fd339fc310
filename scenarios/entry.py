"""The process of the `quadsim` command: whoever tells it to stop, from its first moment on, ends it in order.

Ctrl-C, SIGTERM and SIGHUP all are `KeyboardInterrupt`, unless the process was started with them ignored, as by `nohup`.
"""

from __future__ import annotations

import contextlib
import os
import signal
import sys
from typing import Final

_STOPS: Final = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


def main() -> int:
    """Run the command line of this process; returns the exit status."""
    heard = [stop for stop in _STOPS if signal.getsignal(stop) is not signal.SIG_IGN]
    try:
        for stop in heard:
            signal.signal(stop, signal.default_int_handler)
        _open_what_is_closed()
        if sys.stdout is None:
            print("quadsim: stdout is closed; to do without what is printed: >/dev/null", file=sys.stderr)
            return 2
        from scenarios.cli import main as run

        return run()
    except KeyboardInterrupt:
        with contextlib.suppress(OSError):  # the terminal may be gone
            print("quadsim: interrupted (Ctrl-C); nothing half written was left behind", file=sys.stderr)
        return 1
    finally:
        for stop in heard:  # what is done is done, and the status says how
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
