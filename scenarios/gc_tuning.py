"""How often Python looks for cycles of objects that nobody holds any more."""

from __future__ import annotations

import gc


def settle() -> None:
    """Take all that this process has loaded for lasting, so that looking for cycles is quick from now on."""
    gc.collect()
    gc.freeze()


def collect_rarely() -> None:
    """Look for them less often in this process: flights make few of them, and looking takes time."""
    gc.set_threshold(100_000, 50, 100)
