"""The only clock of a live session: it flies periods in real time, faster, slower or one by one."""

from __future__ import annotations

import threading
import time as clock
from collections import deque
from collections.abc import Callable, Sequence
from typing import Any, Final

from quadsim.errors import QuadsimError
from quadsim.features.live.session import Frame, Session

LATE: Final = 0.25  # [s] beyond which lost time is given up: no period is dropped, the flight is behind real time
POSES: Final = 2  # drawn in each period
_IDLE: Final = 0.02  # [s] between looks for orders while nothing is flown
_MEASURED: Final = 2.0  # [s] of flight over which the real-time factor is measured


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
        due = self._now()
        recent = deque[float](maxlen=round(_MEASURED / session.period) + 1)  # when periods were flown
        while not self._stop.is_set():
            while self._orders:
                order = self._orders.popleft()
                order(session)
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
            view.show(frame, self._factor(recent, session.period))
            for share in range(1, POSES + 1):
                view.pose(frame, share / POSES)
                due = self._wait(due + session.period / self.speed / POSES)
            if session.reason is not None:
                view.ended(session.reason)
            if until(frame):
                return

    def _factor(self, recent: Sequence[float], period: float) -> float:
        """Return simulated over real time, from when the recent periods were flown; what is aimed at without any."""
        span = recent[-1] - recent[0]
        if span > 0.0:
            return (len(recent) - 1) * period / span
        return self.speed

    def _wait(self, due: float) -> float:
        """Wait until a time; return it, or a later one where too much time is lost to be made up for."""
        late = self._now() - due
        if late > LATE:
            due += late
        self._stop.wait(max(0.0, -late))
        return due
