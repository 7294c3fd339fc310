"""Remake the section of docs/performance.md on a flight's time outside the QP: `python docs/make_outside.py BEFORE`.

Two checkouts, the one in the directory BEFORE and this one, fly, run and film the same in turns, each in a process of
its own.  Times are of processors, those of child processes included, so that what else the machine does counts little.
"""

from __future__ import annotations

import argparse
import importlib
import json
import runpy
import statistics
import subprocess
import tempfile
import time as clock
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Final

ROOT: Final = Path(__file__).resolve().parent.parent
PAGE: Final = ROOT / "docs" / "performance.md"
TITLE: Final = "## What a flight costs outside the QP"
RUNS: Final = 5
FLIGHTS: Final = {"a robust flight in wind": "robust", "`paper-constrained`": "paper-constrained"}
COMMANDS: Final = (
    ("`quadsim run paper-constrained --no-video`", "--no-video"),
    ("6 s of it, and the film alone", "--set", "duration=6.0", "--no-recording", "--no-figures"),
)
TEXT: Final = """\
The median of {runs} runs of each of two checkouts in turns, `{before}` and `{after}`, and of the ratios of neighbours;
processor time. `python docs/make_outside.py BEFORE` remakes this section, with a checkout of the former in the
directory BEFORE. The robust flight is the first of `paper-robustness-robust`: 60 s with rotor lag, rotor drag, wind,
turbulence and four sensors.

{table}

- What can be worked out ahead of the flight is, many at a time: the wind of 4096 physics steps, and noise, bias,
  dropouts and outliers of 256 samples of a sensor. What the rotors' speeds give to the forces is worked out for all
  steps of a control period at once.
- Forces that follow from the motion cannot be: each depends on the step before it. They are plain numbers in one
  function, a microsecond a step, and reach MuJoCo through its memory.
- MuJoCo's Python bindings read the clock before and after each part of a step, at every stage of Runge-Kutta, which
  took two fifths of it. No part is timed now.
- None of this changes a bit of a flight's numbers, nor a pixel of figures and films. What the whole flight gains
  besides is the controller's: exact optima from the last period's active set.
- No pass of Python's cycle collector over what was there before a flight falls into one of its steps, whatever is
  installed: it is frozen while the closed loop runs.
- A command imports what it takes, not what all commands take; figures are laid out without being drawn for it; a film
  keeps its words as pictures. What is left of a frame is the rasteriser's and the encoder's.
"""


def measure(name: str) -> dict[str, float]:
    """Processor seconds of one flight by the checkout that this process imports, by what they were spent on."""
    from scenarios.campaign.plan import load_plan
    from scenarios.loading import load_scenario

    runner = importlib.import_module("scenarios.run" if find_spec("scenarios.run") else "scenarios.runner")
    robust = load_plan("paper-robustness-robust").of(0)
    scenario = robust if name == "robust" else load_scenario(name)
    vehicle = runner.build_vehicle(robust)
    plant, navigation = (type(build(robust, vehicle)) for build in (runner.build_plant, runner.build_navigation))
    # the harness is this checkout's, whichever one is measured
    stopwatch: Any = runpy.run_path(str(ROOT / "scenarios" / "bench" / "timing.py"))["Stopwatch"]
    watch = stopwatch(clock.thread_time)
    for owner, method, piece in (
        (plant, "advance", "plant and its effects"),
        (plant, "state", "the true state"),
        (navigation, "advance", "sensors"),
        (navigation, "state", "sensors"),
    ):
        watch.watch(owner, method, piece)
    runner.fly_scenario(scenario.model_copy(update={"duration": 1.0}))  # loads what is loaded late
    watch.clear()
    watch.watch(runner, "fly_scenario", "the whole flight")
    runner.fly_scenario(scenario)
    return dict(watch.totals())


def _once(tree: Path, run: Path) -> Iterator[tuple[str, float]]:
    """All that is measured of a checkout, once; `run` is where its run goes."""
    from scenarios.bench.timing import time_python

    for label, name in FLIGHTS.items():
        pieces = json.loads(time_python(str(Path(__file__)), "--measure", name, tree=tree).output)
        yield from ((f"{label}: {piece}", seconds) for piece, seconds in pieces.items())
    for label, *arguments in COMMANDS:
        command = ("-m", "scenarios.cli", "run", "paper-constrained", "--out", str(run), *arguments)
        yield f"{label}, all processes", time_python(*command, tree=tree).processor_s


def compare(before: Path, runs: int) -> list[tuple[str, ...]]:
    """A table with its head: what it was, what it is, and the median of the ratios of neighbours."""
    from scenarios.bench.timing import in_turns

    with tempfile.TemporaryDirectory() as scratch:
        run = Path(scratch) / "run"
        once = {"before": lambda: dict(_once(before, run)), "after": lambda: dict(_once(ROOT, run))}
        earlier, now = in_turns(once, runs).values()
    rows: list[tuple[str, ...]] = [("processor time [s]", "before", "after", "ratio")]
    for name in earlier[0]:
        pairs = [(then[name], after[name]) for then, after in zip(earlier, now, strict=True)]
        old, new = (statistics.median(of_tree) for of_tree in zip(*pairs, strict=True))
        ratio = statistics.median(after / then for then, after in pairs)
        rows.append((name, f"{old:.2f}", f"{new:.2f}", f"{ratio:.2f}"))
    return rows


def commit(tree: Path) -> str:
    """What a checkout is of, in short."""
    command = ["git", "-C", str(tree), "rev-parse", "--short", "HEAD"]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()


def main() -> None:
    """Measure two checkouts in turns and write the section, the last of the page."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("before", nargs="?", type=Path, help="directory of the checkout to compare with")
    parser.add_argument("--runs", type=int, default=RUNS, help="of each checkout")
    parser.add_argument("--measure", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.measure is not None:
        print(json.dumps(measure(options.measure)))
        return
    if options.before is None:
        parser.error("BEFORE is missing")
    from make_numbers import markdown

    before, after = options.before.resolve(), commit(ROOT)
    table = markdown(compare(before, options.runs)).rstrip()
    text = TEXT.format(table=table, runs=options.runs, before=commit(before), after=after)
    page = PAGE.read_text(encoding="utf-8")
    PAGE.write_text(f"{page.partition(TITLE)[0].rstrip()}\n\n{TITLE}\n\n{text}", encoding="utf-8")


if __name__ == "__main__":
    main()
