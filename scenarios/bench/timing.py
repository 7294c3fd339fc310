"""The one place where times are taken: of calls and commands, of whole runs in turns, and of a controller's steps.

What is compared is timed in turns, so that other load on the machine affects all of it.  Steps are timed as a
flight sees them: between two questions the plant flies a period, which leaves in the caches what it leaves there in a
flight.  A question is put a few times, and its time is the median: what a flight sees but for the machine's stalls.

The questions are put in segments of consecutive periods.  Within a segment a candidate answers all of them, as in a
flight from its last answer.  In each segment the candidates take their turns in random order.  A segment begins with
the period before it, which is not timed.
"""

from __future__ import annotations

import contextlib
import functools
import gc
import math
import os
import subprocess
import sys
import time as clock
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, NamedTuple, Protocol, TypeVar

import numpy as np
from threadpoolctl import threadpool_limits

from quadsim.state import Array

Found = TypeVar("Found")
SEGMENT: Final = 20  # consecutive periods that a candidate answers before it is the next one's turn


class Stopwatch:
    """Seconds since it was made, and those that calls took.

    Args:
        now: a clock [s]: `time.perf_counter`, or `time.thread_time`, which pauses while other processes run.
    """

    def __init__(self, now: Callable[[], float] = clock.perf_counter) -> None:
        self._now, self._started = now, now()
        self.laps: dict[str, list[float]] = {}  # seconds of each call that is watched, by what it is called

    @property
    def elapsed(self) -> float:
        """Seconds since it was made."""
        return self._now() - self._started

    def watch(self, owner: object, method: str, name: str) -> None:
        """Have each call of a method, of an object or of a class, leave its seconds in `laps[name]`."""
        function, laps, now = getattr(owner, method), self.laps.setdefault(name, []), self._now

        @functools.wraps(function)
        def timed(*arguments: Any, **named: Any) -> Any:
            started = now()
            try:
                return function(*arguments, **named)
            finally:
                laps.append(now() - started)

        setattr(owner, method, timed)

    def totals(self) -> dict[str, float]:
        """Seconds of all calls that were watched, by name; of those that were not called, nothing."""
        return {name: sum(laps) for name, laps in self.laps.items() if laps}

    def clear(self) -> None:
        """Forget all calls so far."""
        for laps in self.laps.values():
            laps.clear()


def in_turns(runs: Mapping[str, Callable[[], Found]], repeats: int) -> dict[str, list[Found]]:
    """What each of several runs returned, each repeatedly, in turns."""
    found: dict[str, list[Found]] = {name: [] for name in runs}
    for _ in range(repeats):
        for name, run in runs.items():
            found[name].append(run())
    return found


class CommandTime(NamedTuple):
    """What a command printed, its wall time, and the processor time of all its processes [s]."""

    output: str
    wall_s: float
    processor_s: float


def time_python(*arguments: str, tree: Path) -> CommandTime:
    """Run Python in a checkout, on one thread of linear algebra, and time it.

    Raises:
        SystemExit: with its output, where its exit status is neither 0 nor 1: a flight may violate its constraints.
    """
    import resource  # no such thing on Windows

    environment = {**os.environ, "PYTHONPATH": str(tree), "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    before, watch = resource.getrusage(resource.RUSAGE_CHILDREN), Stopwatch()
    done = subprocess.run([sys.executable, *arguments], cwd=tree, env=environment, capture_output=True, text=True)
    wall_s, after = watch.elapsed, resource.getrusage(resource.RUSAGE_CHILDREN)
    if done.returncode not in (0, 1):
        raise SystemExit(done.stderr)
    return CommandTime(done.stdout, wall_s, sum(after[:2]) - sum(before[:2]))


@contextlib.contextmanager
def one_core() -> Iterator[int | None]:
    """Hold the process to one of its cores; None where the system does not offer that."""
    if not hasattr(os, "sched_setaffinity"):
        yield None
        return
    allowed = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {max(allowed)})
    try:
        yield 1
    finally:
        os.sched_setaffinity(0, allowed)


@contextlib.contextmanager
def undisturbed() -> Iterator[None]:
    """Linear algebra on one thread; cycles are collected only on request."""
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


class Candidate(Protocol):
    """Something that answers questions, numbered by their period."""

    def prepare(self, period: int) -> None:
        """Get ready; not timed."""

    def answer(self) -> None:
        """Answer the question prepared for; timed."""


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
    timed: Sequence[range],
    *,
    between: Callable[[], None],
    repeats: int,
    rng: np.random.Generator,
    longest_pass: float = math.inf,
    patience: float = math.inf,
    now: Callable[[], float] = clock.perf_counter,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> dict[str, StepTimes]:
    """Put all questions to all candidates, `repeats` times.

    Args:
        candidates: by name.
        timed: segments of periods.
        between: what a flight does between two questions; not timed.
        repeats: passes over all questions.
        rng: decides the order within each segment.
        longest_pass: candidates whose first pass takes longer than this [s] make no other.
        patience: candidates that have not answered all in this time [s] are left out.
        now: see `Stopwatch`.
        progress: called with how many turns are done, of how many.

    Returns:
        Each candidate's times, in the order of the questions; none of those that left.
    """
    passes: dict[str, list[list[float]]] = {name: [] for name in candidates}
    total, done = repeats * len(timed) * len(candidates), 0
    with undisturbed():
        for _ in range(repeats):
            racing = [name for name, laps in passes.items() if sum(map(sum, laps[:1])) <= 1e3 * longest_pass]
            for name in racing:
                passes[name].append([])
            for segment in timed:
                gc.collect()
                for name in rng.permutation([name for name in racing if name in passes]).tolist():
                    left_ms = 1e3 * patience - sum(passes[name][-1])
                    passes[name][-1] += _turn(candidates[name], segment, between, left_ms, now)
                    if sum(passes[name][-1]) > 1e3 * patience:
                        del passes[name]
                    done += 1
                    progress(done, total)
    progress(total, total)
    return {name: StepTimes(ms=np.array(laps)) for name, laps in passes.items()}


def _turn(
    candidate: Candidate, segment: range, between: Callable[[], None], left_ms: float, now: Callable[[], float]
) -> list[float]:
    """The times of one segment [ms], or of as much of it as goes a little beyond the time left."""
    candidate.prepare(max(segment.start - 1, 0))
    candidate.answer()
    laps: list[float] = []
    for period in segment:
        if sum(laps) > left_ms:
            break
        candidate.prepare(period)
        between()
        started = now()
        candidate.answer()
        laps.append(1e3 * (now() - started))
    return laps
