"""Attack all that writes or reads files, and remake the counts on docs/safety.md: `make safety`, forty minutes."""

from __future__ import annotations

import argparse
import itertools
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from functools import partial

import safety_mutations
import safety_outputs
from make_numbers import ROOT, replace_in

from quadsim.report.table import Grid, grid_to_markdown, line
from scenarios.bench.timing import Stopwatch

SUMMARIES, CAMPAIGNS = (partial(safety_mutations.as_ordinary_user, kind) for kind in ("summaries", "campaigns"))
ATTACKS: dict[str, tuple[Callable[[int], Mapping[str, int]], int]] = {
    "Random trees and paths, for every command that writes": (safety_outputs.measure, 2000),
    "The same, drawn anew": (partial(safety_outputs.measure, number=1), 700),
    "Changed `summary.json` and tables of runs, read by every command": (SUMMARIES, 2000),
    "Changed files of campaigns, read by every command": (CAMPAIGNS, 2000),
    "Processes killed (SIGKILL) while they write": (safety_outputs.measure_kills, 40),
}
"""What was tried: by which function, and how often."""
PARALLEL = 4  # the first attacks run in parallel, in processes of their own, as an ordinary user


def counts(scale: float) -> str:
    """Go through all attacks; what came of each, as Markdown."""

    def go(what: str) -> str:
        watch = Stopwatch()
        attack, count = ATTACKS[what]
        found = attack(max(1, round(scale * count)))
        outcomes = "; ".join(f"{name.replace('_', ' ')} {number}" for name, number in found.items())
        print(f"{what}: {outcomes} ({watch.elapsed:.0f} s)", flush=True)
        return outcomes

    names = list(ATTACKS)
    with ThreadPoolExecutor() as beside:
        outcomes = list(beside.map(go, names[:PARALLEL]))
    outcomes += [go(name) for name in names[PARALLEL:]]
    lines = tuple(itertools.starmap(line, zip(names, outcomes, strict=True)))
    return grid_to_markdown(Grid(key="counts", title="What was tried", head=("attack", "outcome"), lines=lines))


def main() -> None:
    """Remake the page's counts."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scale", type=float, default=1.0, help="go through that share of the cases, and only print")
    options = parser.parse_args()
    table = counts(options.scale)
    if options.scale == 1.0:
        replace_in(ROOT / "docs" / "safety.md", "counts", table, command="make safety")


if __name__ == "__main__":
    main()
