"""The border to user code: whatever it raises, returns or prints, a flight keeps its result.

Every call of a user's controller, force, autopilot or reference goes through `user_code`; `quadsim.errors.RaisedError`
keeps the traceback, `numbers_of` what it answers.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from typing import Any

import numpy as np

from quadsim.errors import QuadsimError
from quadsim.state import Array


def user_code(
    error_of: Callable[[BaseException], QuadsimError], passing: tuple[type[QuadsimError], ...] = ()
) -> AbstractContextManager[None]:
    """Turn whatever user code raises into a `QuadsimError`.

    That is also what is no `Exception`, such as `asyncio.CancelledError`, `GeneratorExit`, or the `SystemExit` of
    `sys.exit`; only Ctrl-C passes.

    Args:
        error_of: makes the error of what was raised.
        passing: kinds of `QuadsimError` that pass unchanged.
    """
    return _UserCode(error_of, passing)


class _UserCode:
    """See `user_code`; a class, as a generator takes five times as long to enter, in every control period."""

    __slots__ = ("_error_of", "_passing")

    def __init__(
        self, error_of: Callable[[BaseException], QuadsimError], passing: tuple[type[QuadsimError], ...]
    ) -> None:
        self._error_of = error_of
        self._passing = passing

    def __enter__(self) -> None:
        pass

    def __exit__(self, kind: object, error: BaseException | None, frames: object) -> None:
        if error is not None and not isinstance(error, (KeyboardInterrupt, *self._passing)):
            raise self._error_of(error) from error


def numbers_of(answer: Any) -> Array:
    """Return a copy of a user's numbers, so that it does not change with the buffer of which it was a view.

    Raises:
        TypeError: they are complex, or no numbers.
        ValueError: they are no numbers.
    """
    if np.iscomplexobj(answer):  # numpy would drop the imaginary parts
        raise TypeError("complex numbers, of which a command has none")
    return np.array(answer, float)


@contextlib.contextmanager
def printing_to_stderr() -> Iterator[None]:
    """Send to stderr what is printed inside, also by compiled libraries and child processes: stdout has a result."""
    try:
        stdout = sys.stdout.fileno()
        stderr = sys.stderr.fileno()
    except (OSError, AttributeError, ValueError):  # in a notebook, or in a test, they may be no files
        with contextlib.redirect_stdout(sys.stderr):
            yield
        return
    sys.stdout.flush()
    kept = os.dup(stdout)
    try:
        os.dup2(stderr, stdout)
        yield
    finally:
        with contextlib.suppress(OSError, ValueError):
            sys.stdout.flush()
        ctypes.CDLL(None).fflush(None)  # C has a buffer of its own
        os.dup2(kept, stdout)
        os.close(kept)
