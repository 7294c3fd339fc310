"""Carry out the tunings that ship, and remake docs/tuning.md with its figures: `make tuning`.

On two quiet cores the flights take less than half an hour each.  They are saved under runs/tunings/, and resumed where
they were stopped; remove that folder to fly them all anew.  With --there nothing is flown, and the page is made of the
tunings as they are, which an earlier version of the code may have flown.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from make_numbers import copy_figure, write_page

import quadsim
from quadsim.flight.summary import read_json
from quadsim.report.table import Grid, format_number, line, section
from scenarios.shipped import tuning_names
from scenarios.tuning.objective import parse_expression
from scenarios.tuning.report import tuning_tables

MADE_OF = Path("runs") / "tunings"
BESIDE = {"paper-robust": "paper-constrained"}  # a scenario whose nominal flight stands beside a tuning's


def carry_out(name: str, *, there: bool, workers: int | None) -> Path:
    """One tuning, or what is missing of it; its directory."""
    directory = MADE_OF / name
    return directory if there else quadsim.tune(name, out=directory, workers=workers, resume=True).directory


def nominal(directory: Path, summary: dict[str, Any]) -> Grid:
    """The start and the answer as they fly with nothing drawn, and what is to stand beside them."""
    flown: dict[str, str | Path] = {"start": directory / "scenario.toml", "best": directory / "best.toml"}
    flown |= {name: name for tuning, name in BESIDE.items() if tuning == summary["tuning"]}
    flights = [quadsim.fly(quadsim.load(file), progress=False) for file in flown.values()]
    lines = []
    for objective in summary["objectives"]:
        expression = parse_expression(objective["expression"])
        numbers = (expression.value({**flight.metrics, **flight.summary["control"]}) for flight in flights)
        lines.append(line(f"{objective['name']} [{objective['unit']}]", *map(format_number, numbers)))
    for axis in ("x", "y", "z"):
        lines.append(line(f"rmse.{axis} [m]", *(format_number(flight.metrics[f"rmse.{axis}"]) for flight in flights)))
    lines.append(line("verdict", *(flight.outcome for flight in flights)))
    return Grid(key="nominal", title="With nothing drawn", head=("one flight each", *flown), lines=tuple(lines))


def part(name: str, directory: Path) -> str:
    """One tuning's section."""
    summary = read_json(directory / "summary.json", {}, "a tuning's summary")
    manifest = read_json(directory / "manifest.json", {}, "a tuning's manifest")
    copy_figure(directory / "tuning.png", f"tuning-{name}.png", 256)
    machine = manifest["machine"]
    return "\n".join(
        [
            f"## {name}\n\n{summary['description']}.\n",
            f"**{tuning_tables.verdict_sentence(summary)}.**\n",
            "".join(f"- {sentence}\n" for sentence in tuning_tables.sentences(summary)),
            f"![{name}: candidates, importance, fresh flights](tuning-{name}.png)\n",
            *(section(grid, 3) for grid in tuning_tables.tables(summary)),
            section(tuning_tables.importance_table(summary), 3),
            section(nominal(directory, summary), 3),
            f"Flown on {machine['processor']}, {machine['cores']} cores.\n",
        ]
    )


def main() -> None:
    """Fly, and write."""
    parser = argparse.ArgumentParser(description="the tunings' page")
    parser.add_argument("--there", action="store_true", help="of the tunings that are there, flying none")
    parser.add_argument("--workers", type=int, help="processes; one per core where absent")
    options = parser.parse_args()
    names = [name for name in tuning_names() if not options.there or (MADE_OF / name / "summary.json").is_file()]
    parts = [part(name, carry_out(name, there=options.there, workers=options.workers)) for name in names]
    write_page(
        "tuning.md",
        "# What tuning finds\n\nMade by `make tuning` from the tunings that ship, as [tune.md](tune.md) describes.\n"
        "Search: the draws that chose the answer; fresh: draws that chose nothing.\n",
        *parts,
    )


if __name__ == "__main__":
    main()
