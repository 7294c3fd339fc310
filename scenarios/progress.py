"""How long work reports its progress."""

from __future__ import annotations

from collections.abc import Callable

Progress = Callable[[str, int, int], None]
"""Called with (what, done, total) during long work."""


def silent(stage: str, done: int, total: int) -> None:
    """Report progress to nobody."""
