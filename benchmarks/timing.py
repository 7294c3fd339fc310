"""What the benchmarks share: options, tables, JSON, and times taken in turns on undisturbed cores."""

from __future__ import annotations

import argparse
import contextlib
import gc
import json
import sys
import time as clock
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table
from threadpoolctl import threadpool_limits

from quadsim.console.progress import Progress, reporting, silent
from quadsim.errors import FlightError, QuadsimError
from quadsim.flight.metrics import percentiles
from quadsim.rollout.machine import machine, versions
from quadsim.rollout.rollout import Rollout
from quadsim.scenarios.schema.scenario import Scenario
from quadsim.state import Array

Record = dict[str, Any]


def options(about: str | None, **extra: Mapping[str, Any]) -> argparse.Namespace:
    """The command line of a benchmark: `--json`, `--quick`, and options of its own."""
    parser = argparse.ArgumentParser(description=about, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, metavar="FILE", help="write all numbers there; a figure goes beside it")
    parser.add_argument("--quick", action="store_true", help="a small part of it, in seconds")
    for name, keywords in extra.items():
        parser.add_argument(f"--{name}", **keywords)
    return parser.parse_args()


def run(measure: Callable[[Progress], list[Record]], title: str, file: Path | None) -> list[Record]:
    """Measure, print the records as a table and, where there is a file, write them with machine and versions.

    `measure` reports its progress, of which stderr gets a line every ten seconds.

    Wrong input ends the script with exit status 2 and one message.
    """
    try:
        if file is not None:
            file.parent.mkdir(parents=True, exist_ok=True)
        with reporting(True, "the measurement", bars=False) as report:
            records = measure(report)
        if file is not None:
            data = {"records": records, "machine": machine(), "versions": versions()}
            file.write_text(json.dumps(data, indent=2) + "\n", encoding="utf-8")
    except (QuadsimError, OSError) as error:
        print(f"{Path(sys.argv[0]).name}: {error}", file=sys.stderr)
        raise SystemExit(2) from None
    show(records, title)
    return records


def show(records: Sequence[Record], title: str) -> None:
    """Print records as a table for each kind, by their first key; keys are its head, lists are for the JSON file."""
    kinds: dict[str, list[Record]] = {}
    for record in records:
        kinds.setdefault(next(iter(record)), []).append(record)
    for alike in kinds.values():
        table = Table(title=title, title_justify="left")
        keys = [*dict.fromkeys(k for record in alike for k in record if not isinstance(record[k], list))]
        for key in keys:
            table.add_column(key.replace("_", " "), overflow="fold")
        for record in alike:
            table.add_row(*(_cell(record.get(key)) for key in keys))
        Console(width=None if sys.stdout.isatty() else 200).print(table)


def _cell(value: object) -> str:
    if isinstance(value, float):
        return f"{value:.3g}"
    return "-" if value is None else str(value)


@contextlib.contextmanager
def undisturbed() -> Iterator[None]:
    """Linear algebra on one thread, and no garbage collection."""
    gc.collect()
    gc.disable()
    try:
        with threadpool_limits(limits=1):
            yield
    finally:
        gc.enable()


class Stopwatch:
    """Seconds since it was made, and those that watched calls took, by a clock such as `time.thread_time`."""

    def __init__(self, now: Callable[[], float] = clock.perf_counter) -> None:
        self._now, self._started = now, now()
        self.laps: dict[str, list[float]] = {}  # [s] of each call, by its name

    @property
    def elapsed(self) -> float:
        """Seconds since it was made."""
        return self._now() - self._started

    def watch(self, owner: object, method: str, name: str) -> None:
        """Have each call of a method leave its seconds in `laps[name]`."""
        function, laps = getattr(owner, method), self.laps.setdefault(name, [])

        def timed(*arguments: Any, **named: Any) -> Any:
            started = self._now()
            try:
                return function(*arguments, **named)
            finally:
                laps.append(self._now() - started)

        setattr(owner, method, timed)


def flown(scenario: Scenario) -> tuple[list[float], float, int]:
    """Processor time of each step of a flight's controller, and of all of the flight [s]; and its physics steps."""
    with Rollout(scenario) as flight:
        watch = Stopwatch(clock.thread_time)
        watch.watch(flight.loop.controller, "step", "controller")
        try:
            while not flight.done:
                flight.loop.step()
        except FlightError:
            pass
        return watch.laps["controller"], watch.elapsed, round(flight.loop.time / scenario.plant.timestep)


def step_quantiles(ms: Array) -> Record:
    """Median, 99th percentile and maximum of step times (K,) [ms]."""
    quantiles = percentiles(ms)
    return {f"{name}_ms": float(quantiles[name]) for name in ("p50", "p99", "max")}


def time_in_turns(
    candidates: Mapping[str, tuple[Callable[[int], None], Callable[[], object]]],
    segments: Sequence[range],
    *,
    between: Callable[[], object],
    repeats: int,
    rng: np.random.Generator,
    progress: Progress = silent,
) -> dict[str, Array]:
    """Put the same questions to all candidates, in turns, so that other load on the machine affects all of them.

    Args:
        candidates: what prepares for a period, not timed, and what answers it.
        segments: consecutive periods that a candidate answers before it is the next one's turn.
        between: what a flight does between two answers, which leaves in the caches what it leaves there in a flight.
        repeats: passes over all questions.
        rng: decides the order within each segment.
        progress: called between segments.

    Returns:
        Each candidate's times of its questions in order, the median of the repeats [ms].
    """
    laps: dict[str, list[list[float]]] = {name: [[] for _ in range(repeats)] for name in candidates}
    with undisturbed():
        for i in range(repeats):
            for j, segment in enumerate(segments):
                progress("solvers", i * len(segments) + j, repeats * len(segments))
                gc.collect()
                for name in rng.permutation(list(candidates)).tolist():
                    prepare, answer = candidates[name]
                    prepare(max(segment.start - 1, 0))
                    answer()  # from a cold start; not counted
                    for period in segment:
                        prepare(period)
                        between()
                        started = clock.perf_counter()
                        answer()
                        laps[name][i].append(1e3 * (clock.perf_counter() - started))
    return {name: np.asarray(np.median(passes, axis=0)) for name, passes in laps.items()}
