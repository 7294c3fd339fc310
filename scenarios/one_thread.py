"""Linear algebra on one thread: the matrices are small, and results do not depend on the core count."""

from __future__ import annotations

import threading
from typing import Any, Final

from threadpoolctl import ThreadpoolController


class OneThread:
    """Holds linear algebra to one thread in the whole process while anybody is inside, in whatever thread."""

    def __init__(self) -> None:
        self._lock, self._inside = threading.Lock(), 0
        self._controller: ThreadpoolController | None = None
        self._limit: Any = None

    def __enter__(self) -> None:
        with self._lock:
            if not self._inside:
                self._controller = self._controller or ThreadpoolController()
                self._limit = self._controller.limit(limits=1)
            self._inside += 1

    def __exit__(self, *_: object) -> None:
        with self._lock:
            self._inside -= 1
            if not self._inside:
                self._limit.restore_original_limits()

    def look_again(self) -> None:
        """Find the libraries that have been loaded since the first time, when next entered."""
        with self._lock:
            self._controller = None


ONE_THREAD: Final = OneThread()
