"""Remake docs/performance.md and its figure on this machine: `make numbers`.

Everything is measured by `quadsim bench`; here it becomes a page.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time as clock
from pathlib import Path

from make_numbers import Table, markdown, replace_in_readme
from PIL import Image

from quadsim.bench import FlightProfile, RenderProfile, SolverBench, flight_tables, render_tables, solver_tables
from quadsim.table import grid_to_markdown
from scenarios.bench.flight import bench_flight
from scenarios.bench.render import bench_render
from scenarios.bench.solvers import bench_solvers, section, write_bench
from scenarios.loading import load_scenario

ROOT = Path(__file__).resolve().parent.parent
SCENARIO = "paper-constrained"

REPEATS = 5

BEFORE_COMMIT = "bfa97b8"
BEFORE: Table = [
    ("60 s of paper-constrained", "time [s]"),
    ("QP solver", "1.06"),
    ("rest of the controller", "0.11"),
    ("physics", "0.43"),
    ("measurement", "0.05"),
    ("log, conversion to the paper's state", "0.17"),
    ("the flight", "1.80"),
]
"""Measured at `BEFORE_COMMIT`, before the shortcut, on a machine of the kind of the page's other numbers; there the
step had a median of 1.0 ms and a p99 of 1.5 ms."""


def whole_commands(flight: FlightProfile, film: RenderProfile) -> Table:
    """What a person waits for: the best of a few times, but for the film, whose time is long enough."""
    rows: Table = [
        ("what a person waits for, at best", "asked", "measured [s]"),
        ("60 s of constrained flight simulated, one core", "<= 1.2 s", f"{flight.best:.2f}"),
    ]
    with tempfile.TemporaryDirectory() as scratch:
        for label, asked, repeats, arguments in (
            ("`quadsim --help`", "<= 0.3 s", REPEATS, ["--help"]),
            (
                f"`quadsim run {SCENARIO} --no-video`",
                "<= 4 s",
                REPEATS,
                ["run", SCENARIO, "--no-video", "--out", f"{scratch}/run"],
            ),
            (
                f"`quadsim video`: the same 60 s, 1280x720 at 30 fps, {film.workers} cores",
                "<= 60 s",
                1,
                ["video", f"{scratch}/run"],
            ),
        ):
            rows.append((label, asked, f"{min(_wall_s(arguments) for _ in range(repeats)):.2f}"))
    return rows


def _wall_s(arguments: list[str]) -> float:
    """Wall time of one `quadsim` command [s]."""
    started = clock.perf_counter()
    subprocess.run([sys.executable, "-m", "scenarios.cli", *arguments], check=True, capture_output=True, cwd=ROOT)
    return clock.perf_counter() - started


def page(bench: SolverBench, flight: FlightProfile, film: RenderProfile, commands: str) -> str:
    """The whole page."""
    contenders, *others = solver_tables(bench)
    machine = bench.machine
    return "\n".join(
        [
            "# Performance\n\nMade by `make numbers` on one machine "
            f"({machine['processor']}, {machine['cores']} cores, no GPU); each table in one run: read the ratios.\n"
            f"`quadsim bench solvers`, `quadsim bench flight` and `quadsim bench render` measure the same on yours.\n",
            section(contenders),
            "![Time of a whole controller step of every contender, and its growth with the horizon](solvers.png)\n",
            *(section(grid) for grid in others),
            *(section(grid) for grid in flight_tables(flight)),
            f"Before, at commit {BEFORE_COMMIT}, when every period had its QP (step: median 1.0 ms, p99 1.5 ms); "
            "measured then, on a machine of the same kind, not in this run:\n\n"
            f"{markdown(BEFORE)}",
            *(section(grid) for grid in render_tables(film)),
            f"## Whole commands\n\n{commands}",
        ]
    )


def main() -> None:
    """Measure everything and write it."""
    scenario = load_scenario(SCENARIO)
    flight, film = bench_flight(scenario), bench_render(scenario)
    commands = markdown(whole_commands(flight, film))
    bench = bench_solvers(scenario)
    with tempfile.TemporaryDirectory() as scratch:
        write_bench(bench, Path(scratch))
        figure = Image.open(Path(scratch) / "solvers.png").convert("RGB")
        figure.quantize(64, dither=Image.Dither.NONE).save(ROOT / "docs" / "solvers.png", optimize=True)
    (ROOT / "docs" / "performance.md").write_text(page(bench, flight, film, commands), encoding="utf-8")
    replace_in_readme("times", commands)
    replace_in_readme("solvers", grid_to_markdown(solver_tables(bench)[0]))


if __name__ == "__main__":
    main()
