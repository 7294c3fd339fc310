"""The state in which steps are timed."""

from __future__ import annotations

import contextlib
import gc
from collections.abc import Iterator

from threadpoolctl import threadpool_limits


@contextlib.contextmanager
def undisturbed() -> Iterator[None]:
    """Linear algebra on one thread; no garbage collection but where it is asked for, and none of what is there now."""
    collecting = gc.isenabled()
    gc.collect()
    gc.freeze()
    gc.disable()
    try:
        with threadpool_limits(limits=1):
            yield
    finally:
        gc.unfreeze()
        if collecting:
            gc.enable()
