"""When periods are flown: at real time, slower or faster, one by one, or not at all.  The only clock of a session."""

from __future__ import annotations

import threading
import time as clock
from collections import deque
from collections.abc import Callable
from typing import TYPE_CHECKING, Final

from quadsim.errors import QuadsimError
from scenarios.live.session import Frame, Session

if TYPE_CHECKING:
    from scenarios.live.page import Page

LATE: Final = 0.25  # [s] beyond which lost time is given up: no period is dropped, the flight is behind real time
POSES: Final = 2  # drawn in each period
_IDLE: Final = 0.02  # [s] between looks for orders while nothing is flown


class Pace:
    """Pause, single periods, speed; set from any thread, read between periods.

    Attributes:
        speed: simulated over real time that is aimed at.
        paused: whether only single periods are flown.
    """

    def __init__(self, now: Callable[[], float] = clock.monotonic) -> None:
        self._now, self._stop, self._single = now, threading.Event(), threading.Semaphore(0)
        self.speed, self.paused = 1.0, False
        self._orders: deque[Callable[[Session], None]] = deque()

    def single(self) -> None:
        """Fly one period while paused."""
        self._single.release()

    def stop(self) -> None:
        """End the session after this period."""
        self._stop.set()

    def order(self, what: Callable[[Session], None]) -> None:
        """Have something done between two periods, in the thread that flies."""
        self._orders.append(what)

    def drive(self, session: Session, view: Page, until: Callable[[Frame], bool] = lambda frame: False) -> None:
        """Fly until `stop`, or until a frame is the last one; a flight that has ended waits for a reset."""
        due, flown = self._now(), deque[float](maxlen=round(2.0 / session.period) + 1)  # two seconds
        while not self._stop.is_set():
            while self._orders:
                self._orders.popleft()(session)
            if session.reason is not None or (self.paused and not self._single.acquire(blocking=False)):
                self._stop.wait(_IDLE)
                due = self._now()
                flown.clear()
                continue
            try:
                frame = session.advance()
            except QuadsimError as error:
                session.reason = str(error)
                view.ended(session.reason)
                continue
            flown.append(self._now())
            span = flown[-1] - flown[0]
            view.show(frame, (len(flown) - 1) * session.period / span if span > 0.0 else self.speed)
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
