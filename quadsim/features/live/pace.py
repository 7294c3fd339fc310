"""The only clock of a live session: it flies periods in real time, faster, slower or one by one."""

from __future__ import annotations

import threading
import time as clock
from collections import deque
from collections.abc import Callable
from typing import Any, Final

from quadsim.errors import QuadsimError
from quadsim.features.live.session import Frame, Session

LATE: Final = 0.25  # [s] beyond which lost time is given up: no period is dropped, the flight is behind real time
POSES: Final = 2  # drawn in each period
_IDLE: Final = 0.02  # [s] between looks for orders while nothing is flown


class Pace:
    """Pause, single periods, speed; set from any thread, read between periods.

    Attributes:
        speed: simulated over real time that is aimed at.
        paused: whether only single periods are flown.
        waiting: whether it is paused until somebody looks.
        single: flies one period while paused.
        stop: ends the session after this period.
        order: calls a function of the session between two periods, in the flying thread.
    """

    def __init__(self, now: Callable[[], float] = clock.monotonic, *, waiting: bool = False) -> None:
        self._now = now
        self._stop = threading.Event()
        self._single = threading.Semaphore(0)
        self._orders: deque[Callable[[Session], None]] = deque()
        self.speed = 1.0
        self.paused = waiting
        self.waiting = waiting
        self.single = self._single.release
        self.stop = self._stop.set
        self.order = self._orders.append

    def drive(self, session: Session, view: Any, until: Callable[[Frame], bool] = lambda frame: False) -> None:
        """Fly until `stop` or the last frame, shown by a `Page`; a flight that ended waits for a reset."""
        # two seconds
        due = self._now()
        recent = deque[float](maxlen=round(2.0 / session.period) + 1)
        while not self._stop.is_set():
            while self._orders:
                self._orders.popleft()(session)
            if session.reason is not None or (self.paused and not self._single.acquire(blocking=False)):
                self._stop.wait(_IDLE)
                due = self._now()
                recent.clear()
                continue
            try:
                frame = session.advance()
            except QuadsimError as error:
                session.reason = str(error)
                view.ended(session.reason)
                continue
            recent.append(self._now())
            span = recent[-1] - recent[0]
            view.show(frame, (len(recent) - 1) * session.period / span if span > 0.0 else self.speed)
            for share in range(1, POSES + 1):
                view.pose(frame, share / POSES)
                due += session.period / self.speed / POSES
                if (late := self._now() - due) > LATE:
                    due += late
                self._stop.wait(max(0.0, -late))
            if session.reason is not None:
                view.ended(session.reason)
            if until(frame):
                return
