"""How long work reports its progress."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator

Progress = Callable[[str, int, int], None]
"""Called with (what, done, total) during long work."""


def silent(stage: str, done: int, total: int) -> None:
    """Report progress to nobody."""


@contextlib.contextmanager
def reporting(progress: Progress | bool) -> Iterator[Progress]:
    """Who is called with the progress: bars on a terminal, nobody, or what the caller gave."""
    if callable(progress):
        yield progress
    elif not progress:
        yield silent
    else:
        from scenarios.commands.console import progress_bars

        with progress_bars(enabled=True) as bars:
            yield bars
