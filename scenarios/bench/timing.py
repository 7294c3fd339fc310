"""Candidates timed against each other in one process, so that what the machine does meanwhile meets them all.

Every step that is timed is timed here, in one way, as a flight sees it: between two questions the plant flies a period,
which leaves in the caches what it leaves there in a flight.  A question is put a few times, and its time is the median:
what a flight sees but for the machine's stalls.

The questions are put in segments of consecutive periods.  Within a segment a candidate answers all of them, as in a
flight from its last answer.  In each segment the candidates take their turns in random order.  A segment begins with
the period before it, which is not timed.
"""

from __future__ import annotations

import contextlib
import gc
import math
import time as clock
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Final, Protocol

import numpy as np
from threadpoolctl import threadpool_limits

from quadsim.state import Array


@contextlib.contextmanager
def undisturbed() -> Iterator[None]:
    """Linear algebra on one thread; cycles are collected where that is asked for alone."""
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


SEGMENT: Final = 20  # consecutive periods that a candidate answers before it is the next one's turn


class Candidate(Protocol):
    """Something that answers questions, numbered by the period they were asked in."""

    def prepare(self, period: int) -> None:
        """Get ready; not timed."""
        ...

    def answer(self) -> None:
        """Answer the question prepared for; timed."""
        ...


@dataclass(frozen=True, kw_only=True)
class StepTimes:
    """What a candidate's answers took."""

    ms: Array  # (repeats, questions) [ms]

    @property
    def median(self) -> Array:
        """(questions,) over the repeats [ms]."""
        return np.asarray(np.median(self.ms, axis=0))


def segments(periods: int, stride: int) -> list[range]:
    """Every `stride`-th segment of a flight."""
    return [range(start, min(start + SEGMENT, periods)) for start in range(0, periods, stride * SEGMENT)]


def time_in_turns(
    candidates: Mapping[str, Candidate],
    asked: Sequence[range],
    *,
    between: Callable[[], None],
    repeats: int,
    rng: np.random.Generator,
    longest_pass: float = math.inf,
    patience: float = math.inf,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> dict[str, StepTimes]:
    """Put all questions to all candidates, `repeats` times.

    Args:
        candidates: by name.
        asked: segments of periods.
        between: what a flight does between two questions; not timed.
        repeats: passes over all questions.
        rng: decides the order within each segment.
        longest_pass: candidates whose first pass takes longer than this [s] make no other.
        patience: candidates that have not answered all in this time [s] are left out.
        progress: called with how many turns are done, of how many.

    Returns:
        Each candidate's times, in the order of the questions; none of those that left.
    """
    passes: dict[str, list[list[float]]] = {name: [] for name in candidates}
    total, done = repeats * len(asked) * len(candidates), 0
    with undisturbed():
        for _ in range(repeats):
            racing = [name for name, laps in passes.items() if sum(map(sum, laps[:1])) <= 1e3 * longest_pass]
            for name in racing:
                passes[name].append([])
            for segment in asked:
                gc.collect()
                for name in rng.permutation([name for name in racing if name in passes]).tolist():
                    left_ms = 1e3 * patience - sum(passes[name][-1])
                    passes[name][-1] += _turn(candidates[name], segment, between, left_ms)
                    if sum(passes[name][-1]) > 1e3 * patience:
                        del passes[name]
                    done += 1
                    progress(done, total)
    progress(total, total)
    return {name: StepTimes(ms=np.array(laps)) for name, laps in passes.items()}


def _turn(candidate: Candidate, segment: range, between: Callable[[], None], left_ms: float) -> list[float]:
    """The times of one segment [ms], or of as much of it as goes a little beyond the time left."""
    candidate.prepare(max(segment.start - 1, 0))
    candidate.answer()
    laps: list[float] = []
    for period in segment:
        if sum(laps) > left_ms:
            break
        candidate.prepare(period)
        between()
        started = clock.perf_counter()
        candidate.answer()
        laps.append(1e3 * (clock.perf_counter() - started))
    return laps
