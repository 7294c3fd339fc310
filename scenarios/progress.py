"""How long work reports its progress."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator

Progress = Callable[[str, int, int], None]  # called with (what, done, total) during long work


def silent(stage: str, done: int, total: int) -> None:
    """Report no progress."""


@contextlib.contextmanager
def reporting(progress: Progress | bool) -> Iterator[Progress]:
    """What is called with the progress: bars on a terminal, none, or the caller's function."""
    if callable(progress):
        yield progress
    elif not progress:
        yield silent
    else:
        from scenarios.commands.console import progress_bars

        with progress_bars() as bars:
            yield bars
