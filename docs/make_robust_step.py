"""Remake the section of docs/performance.md on the robust controller's steps: `python docs/make_robust_step.py BEFORE`.

Two checkouts, the one in the directory BEFORE and this one, fly the same flights in turns, each in its own process.
Times are of the processor, so that what else the machine does counts little.
"""

from __future__ import annotations

import argparse
import json
import os
import runpy
import statistics
import time as clock
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np
from make_outside import PAGE, ROOT, commit
from make_outside import TITLE as NEXT

TITLE: Final = "## A step of the robust controller"
RUNS: Final = 5
FLIGHTS: Final = range(4)
PAPER: Final = -1  # stands for the paper's own flight
COLUMNS: Final = {"p50": "ms", "p99": "ms", "max": "ms", "flight": "s"}
TEXT: Final = """\
Flights of `paper-robustness-robust`, and the paper's controller in `paper-constrained`, 60 s each, by two checkouts in
turns, `{before}` and `{after}`: the median over runs of each ({runs}), processor time, at a load average of {load:.0f}
on {cores} cores. A step is the whole of it, the robust one's fallback contract included, between two periods of flight.
`python docs/make_robust_step.py BEFORE` remakes this section, with a checkout of the former in the directory BEFORE.

{table}

- In {free:.0%} of the robust flights' periods the unconstrained optimum is the answer, and the rest of the step counts.
  One state is integrated, compared and turned in plain numbers, where arrays of three took several times as long. What
  does not change from one period to the next is computed once, and what nobody looks at in flight, the QP's own
  multipliers of a shortcut's optimum, is not computed.
- Where bounds on tilt are active, the search starts from the last period's active rows moved one step earlier, those
  of the horizon's last step held.
- Lagging rotors' speeds as collective, roll, pitch and yaw parts were tried, and are not done: the axes come apart, and
  a trial of the search has half the rows, but there are two searches and more trials, so that nothing is gained.
"""


def measure(flight: int) -> dict[str, float]:
    """Processor time of one flight [s], its steps' p50, p99 and maximum [ms], and the share without active rows."""
    from mpc.constrained import ConstrainedMPC
    from mpc.fallback.contract import Guarded
    from scenarios.campaign.plan import load_plan
    from scenarios.loading import load_scenario
    from scenarios.run import fly_scenario

    paper = flight == PAPER
    scenario = load_scenario("paper-constrained") if paper else load_plan("paper-robustness-robust").of(flight)
    # the harness is this checkout's, whichever one is measured
    stopwatch: Any = runpy.run_path(str(ROOT / "scenarios" / "bench" / "timing.py"))["Stopwatch"]
    watch = stopwatch(clock.thread_time)
    watch.watch(ConstrainedMPC if paper else Guarded, "step", "step")
    fly_scenario(scenario.model_copy(update={"duration": 1.0}))  # loads what is loaded late
    watch.clear()
    started = clock.thread_time()
    status = fly_scenario(scenario).log.control.status
    flown = clock.thread_time() - started
    p50, p99, largest = np.percentile(1e3 * np.array(watch.laps["step"]), [50.0, 99.0, 100.0]).tolist()
    free = status.count("unconstrained") / len(status)
    return {"flight": flown, "p50": p50, "p99": p99, "max": largest, "free": free}


def compare(before: Path, runs: int) -> tuple[list[tuple[str, ...]], float]:
    """A table with its head, and the share of periods without active rows."""
    from scenarios.bench.timing import in_turns, time_python

    def once(tree: Path, flight: int) -> dict[str, float]:
        measured: dict[str, float] = json.loads(
            time_python(str(Path(__file__)), "--measure", str(flight), tree=tree).output
        )
        return measured

    rows: list[tuple[str, ...]] = [("flight", *(f"{key}, {unit}" for key, unit in COLUMNS.items()), "p50, as a ratio")]
    free = []
    for flight in (*FLIGHTS, PAPER):
        trees = {"before": partial(once, before, flight), "after": partial(once, ROOT, flight)}
        earlier, now = in_turns(trees, runs).values()
        medians = [[statistics.median(run[key] for run in of) for of in (earlier, now)] for key in COLUMNS]
        ratio = statistics.median(after["p50"] / then["p50"] for then, after in zip(earlier, now, strict=True))
        name = "paper-constrained" if flight == PAPER else str(flight)
        rows.append((name, *(f"{then:#.3g} → {after:#.3g}" for then, after in medians), f"{ratio:.2f}"))
        if flight != PAPER:
            free.append(now[0]["free"])
    return rows, statistics.mean(free)


def main() -> None:
    """Measure two checkouts in turns and write the section."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("before", nargs="?", type=Path, help="directory of the checkout to compare with")
    parser.add_argument("--runs", type=int, default=RUNS, help="of each checkout")
    parser.add_argument("--measure", type=int, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.measure is not None:
        print(json.dumps(measure(options.measure)))
        return
    if options.before is None:
        parser.error("BEFORE is missing")
    from make_numbers import markdown

    before = options.before.resolve()
    rows, free = compare(before, options.runs)
    text = TEXT.format(
        table=markdown(rows).rstrip(),
        runs=options.runs,
        before=commit(before),
        after=commit(ROOT),
        free=free,
        load=os.getloadavg()[0],
        cores=os.cpu_count(),
    )
    page = PAGE.read_text(encoding="utf-8")
    start, title, rest = page.partition(NEXT)
    PAGE.write_text(f"{start.partition(TITLE)[0].rstrip()}\n\n{TITLE}\n\n{text}\n{title}{rest}", encoding="utf-8")


if __name__ == "__main__":
    main()
