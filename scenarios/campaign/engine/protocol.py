"""What flies the flights of a campaign: protocols of engines and of pilots, and how much work is handed out at once."""

from __future__ import annotations

import gc
import pickle
import time as clock
from collections.abc import Generator, Sequence
from typing import TYPE_CHECKING, Final, NamedTuple, Protocol

from quadsim.errors import QuadsimError
from scenarios.campaign.results.table import Row
from scenarios.campaign.results.verdicts import ERROR, MEMORY
from scenarios.progress import Progress, silent

if TYPE_CHECKING:
    from scenarios.campaign.spec import LimitsSpec

MOST_DEATHS: Final = 10
"""Processes that may die while they fly a flight before it is given up: more than die by chance in one flight."""
ONE_THREAD: Final = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
"""Environment of a process that flies: results do not depend on the core count."""
CHUNK_S: Final = 10.0  # work handed out at once [s]: long against what handing it out costs, short against a campaign


class EngineError(QuadsimError):
    """The engine cannot go on; what it has answered stands."""


class Pilot(Protocol):
    """Flies flights, known by their numbers; pickled, and sent to each process once."""

    @property
    def limits(self) -> LimitsSpec:
        """Of each flight."""

    def prepare(self) -> None:
        """Load what flights need, once in each process that flies; what fails here is reported by the flights."""

    def fly(self, flight: int, progress: Progress = silent) -> Row:
        """The row of a flight, plain values; reports each control period that is flown."""

    def lost(self, flight: int, reason: str, verdict: str = ERROR) -> Row:
        """The row of a flight without a result: its process died or met a limit, or `fly` raised."""


class Engine(Protocol):
    """Has flights flown."""

    name: str  # for the manifest

    @property
    def workers(self) -> int:
        """Processes that fly at the same time."""

    def answers(self, pilot: Pilot, flights: Sequence[int]) -> Generator[Row]:
        """The rows, each flight's exactly once, in whatever order they come; closing the iterator stops all work.

        Raises:
            EngineError: no worker is left.
        """


class Answer(NamedTuple):
    """What became of a flight, and the seconds it took."""

    row: Row
    seconds: float


def fly_one(pilot: Pilot, flight: int, progress: Progress = silent) -> Answer:
    """Fly a flight; an exception makes it lost, and is the reason."""
    started = clock.perf_counter()
    try:
        row = pilot.fly(flight, progress)
        pickle.dumps(row)  # it has to get home
    except MemoryError as error:
        row = pilot.lost(flight, describe(error), MEMORY)
    except BaseException as error:  # a user-defined controller may exit, or raise what ends loops
        row = pilot.lost(flight, describe(error))
    gc.collect()  # what a flight leaves in cycles, a dozen megabytes sometimes, is not to wait for the next ones
    return Answer(row, clock.perf_counter() - started)


def describe(error: BaseException) -> str:
    """An exception in one line of printable text."""
    text = " ".join(f"{type(error).__name__}: {error}".split())
    return "".join(sign if sign.isprintable() else ascii(sign)[1:-1] for sign in text)


class Pace:
    """How long flights take, measured as they are answered, and so how many to hand out at once."""

    def __init__(self) -> None:
        self._seconds, self._flights = 0.0, 0

    def note(self, answer: Answer) -> None:
        """Take one more flight into account."""
        self._seconds += answer.seconds
        self._flights += 1

    def flights_in(self, seconds: float) -> int:
        """Flights that take so long [s]; none while nothing is known."""
        return int(seconds * self._flights / max(self._seconds, 1e-9))

    def chunk(self, waiting: int, workers: int) -> int:
        """Flights to hand to one worker: fewer near the end, so that all finish together."""
        return max(1, min(self.flights_in(CHUNK_S), fair_share(waiting, workers)))


def fair_share(waiting: int, workers: int) -> int:
    """Half of an equal share of what waits: so much a worker may take without making the others wait in the end."""
    return waiting // (2 * max(workers, 1))
