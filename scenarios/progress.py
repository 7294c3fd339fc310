"""How long work reports its progress."""

from __future__ import annotations

from collections.abc import Callable

Progress = Callable[[str, int, int], None]
"""Told (what, done, total) as long work goes on."""


def silent(stage: str, done: int, total: int) -> None:
    """Report progress to nobody."""
