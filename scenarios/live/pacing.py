"""When periods are flown: at real time, slower or faster, one by one, or not at all.  The only clock of a session."""

from __future__ import annotations

import threading
import time as clock
from collections import deque
from collections.abc import Callable
from typing import Final, Protocol

from quadsim.errors import QuadsimError
from scenarios.live.session import Frame, Session

LATE: Final = 0.25  # [s] beyond which lost time is given up: no period is dropped, the flight is behind real time
POSES: Final = 2  # drawn in each period
_SPAN: Final = 2.0  # [s] over which the real-time factor is measured


class View(Protocol):
    """What shows a flight to people."""

    def show(self, frame: Frame, factor: float) -> None:
        """Show a period that has been flown; `factor` is simulated over real time."""
        ...

    def pose(self, frame: Frame, share: float) -> None:
        """Draw the vehicle at a share of the period, 0 to 1."""
        ...

    def ended(self, reason: str | None) -> None:
        """The flight has ended, with its reason, or has begun anew (None)."""
        ...


class Pace:
    """Pause, single periods, speed; set from any thread, read between periods.

    Attributes:
        speed: simulated over real time that is aimed at.
        factor: simulated over real time as it is.
    """

    def __init__(self, now: Callable[[], float] = clock.monotonic) -> None:
        self._now, self._changed = now, threading.Condition()
        self.speed, self.factor = 1.0, 1.0
        self._paused, self._single, self._stopped = False, 0, False
        self._orders: deque[Callable[[Session], None]] = deque()
        self._due, self._flown = now(), deque[tuple[float, float]]()

    @property
    def paused(self) -> bool:
        """Whether it is paused."""
        return self._paused

    @property
    def stopped(self) -> bool:
        """Whether the session is over."""
        return self._stopped

    def pause(self, paused: bool) -> None:
        """Pause or continue."""
        with self._changed:
            self._paused, self._due = paused, self._now()
            self._flown.clear()
            self._changed.notify()

    def single(self) -> None:
        """Fly one period while paused."""
        with self._changed:
            self._single += 1
            self._changed.notify()

    def stop(self) -> None:
        """End the session after this period."""
        with self._changed:
            self._stopped = True
            self._changed.notify()

    def order(self, what: Callable[[Session], None]) -> None:
        """Have something done between two periods, in the thread that flies."""
        with self._changed:
            self._orders.append(what)
            self._changed.notify()

    def drive(self, session: Session, view: View, until: Callable[[Frame], bool] = lambda frame: False) -> None:
        """Fly until `stop`, or until a frame is the last one; a flight that has ended waits for a reset."""
        self._due = self._now()
        while not self._stopped:
            while self._orders:
                self._orders.popleft()(session)
            if session.reason is not None or (self._paused and not self._single):
                with self._changed:
                    if not (self._stopped or self._orders or (self._single and session.reason is None)):
                        self._changed.wait(0.1)
                self._due = self._now()
                continue
            self._single = max(0, self._single - 1)
            try:
                frame = session.advance()
            except QuadsimError as error:
                session.reason = str(error)
                view.ended(session.reason)
                continue
            view.show(frame, self._measured(session.period))
            for share in range(1, POSES + 1):
                view.pose(frame, share / POSES)
                self._wait(session.period / self.speed / POSES)
            if session.reason is not None:
                view.ended(session.reason)
            if until(frame):
                return

    def _measured(self, period: float) -> float:
        """Simulated over real time of the last seconds."""
        now = self._now()
        self._flown.append((now, period))
        while self._flown and now - self._flown[0][0] > _SPAN:
            self._flown.popleft()
        span = now - self._flown[0][0]
        if span > 0.0:
            self.factor = sum(each for _, each in list(self._flown)[1:]) / span
        return self.factor

    def _wait(self, share: float) -> None:
        self._due += share
        late = self._now() - self._due
        if late > LATE:
            self._due = self._now()
        elif late < 0.0:
            with self._changed:
                self._changed.wait_for(lambda: self._stopped, -late)
