"""A paper's numbers flown: published, ours, difference."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Final

from quadsim.errors import InputError
from quadsim.report.table import ABSENT, Cell, Grid, Mark, line
from scenarios.papers.paper import NumberSpec, Paper, scenario_of
from scenarios.progress import Progress, silent
from scenarios.results import EXIT_DONE, EXIT_FAILED, Result, Shown
from scenarios.rollout import Rollout

HEAD: Final = ("number", "unit", "published", "ours", "difference", "tolerance", "reproduced")
_RULE: Final = "measure must lead to a number of the flight's summary"


@dataclass(frozen=True, kw_only=True)
class Reproduced:
    """One number."""

    spec: NumberSpec  # the published one
    ours: float | None  # of our flight [unit]; None where it ended early
    reason: str | None = None  # why it did

    @property
    def difference(self) -> float | None:
        """Ours minus the published number, or the nearest of several [unit]."""
        low, high = self.spec.span
        return None if self.ours is None else self.ours - min(max(self.ours, low), high)

    @property
    def within(self) -> bool:
        """Whether ours is within the file's tolerance; not, where the flight ended early."""
        if self.difference is None:
            return False
        beyond = {"equal": abs(self.difference), "at most": self.difference, "at least": -self.difference}
        return beyond[self.spec.relation] <= self.spec.tolerance * (1.0 + 1e-9)

    def to_json(self) -> dict[str, Any]:
        """All of it as plain data."""
        spec = self.spec
        return {
            **{name: getattr(spec, name) for name in ("name", "scenario", "set", "measure", "unit", "source")},
            **{name: getattr(spec, name) for name in ("published", "relation", "tolerance")},
            **{name: getattr(self, name) for name in ("ours", "difference", "within", "reason")},
        }

    @property
    def sentence(self) -> str:
        """The verdict for a report."""
        _, unit, published, ours, difference, tolerance, _ = (cell.text for cell in self.cells())
        text = f"published {published} {unit}, ours {ours} (difference {difference}, tolerance {tolerance})"
        return f"{text}: {self.reason}" if self.reason else text

    def cells(self) -> tuple[Cell, ...]:
        """Its line of the table."""
        spec = self.spec
        published = " to ".join(f"{value:g}" for value in sorted(set(spec.span)))
        relation = "" if spec.relation == "equal" else f"{spec.relation} "
        tolerance = f"{spec.tolerance:.2g}" if spec.relative is None else f"{100.0 * spec.relative:g} %"
        verdict = Cell(text="yes", mark=Mark.GOOD) if self.within else Cell(text="no", mark=Mark.BAD)
        return line(
            spec.name,
            spec.unit,
            f"{relation}{published}",
            self._shown(self.ours),
            self._shown(self.difference, "+"),
            tolerance,
            verdict,
        )

    def _shown(self, value: float | None, sign: str = "") -> str:
        """A value to a tenth of the tolerance, or to four digits where there is none."""
        if value is None:
            return ABSENT
        if not self.spec.tolerance:
            return f"{value:{sign}.4g}"
        digits = max(0, 1 - math.floor(math.log10(self.spec.tolerance)))
        return f"{round(value, digits) + 0.0:{sign}.{digits}f}"


@dataclass(frozen=True, kw_only=True)
class Reproduction:
    """A paper's numbers and ours."""

    paper: Paper
    numbers: tuple[Reproduced, ...]

    @property
    def within(self) -> bool:
        """Whether all numbers are reproduced."""
        return all(number.within for number in self.numbers)

    def to_json(self) -> dict[str, Any]:
        """All of it as plain data."""
        about = {name: getattr(self.paper, name) for name in ("name", "title", "authors", "publication")}
        return {**about, "reproduced": self.within, "numbers": [number.to_json() for number in self.numbers]}

    @property
    def grid(self) -> Grid:
        """The table."""
        paper = self.paper
        citation = ", ".join(filter(None, [paper.authors, paper.publication]))
        return Grid(
            key=paper.name,
            title=paper.title,
            head=HEAD,
            lines=tuple(number.cells() for number in self.numbers),
            note=". ".join(filter(None, [citation, paper.about])),
        )


class Reproductions(tuple[Reproduction, ...], Result):
    """One for each paper."""

    @property
    def exit_status(self) -> int:
        """See `Result.exit_status`; 1 where a number is not reproduced."""
        return EXIT_DONE if all(paper.within for paper in self) else EXIT_FAILED

    def shown(self) -> Shown:
        """See `Result.shown`."""
        from scenarios import console

        return console.grids([paper.grid for paper in self], left=("number",))

    def to_json(self) -> dict[str, Any]:
        """All of it as plain data."""
        return {"reproduced": not self.exit_status, "papers": [paper.to_json() for paper in self]}


def reproduce_paper(
    paper: Paper, progress: Progress = silent, *, chosen: Callable[[NumberSpec], bool] = lambda _: True
) -> Reproduction:
    """Fly a paper's numbers, each flight once whatever is measured of it.

    Args:
        paper: see `scenarios.papers.paper.load_paper`.
        progress: called with (what, done, total).
        chosen: which numbers.

    Raises:
        InputError: a number cannot be flown, or the flight's summary has no such number.
    """
    specs = [spec for spec in paper.numbers if chosen(spec)]
    scenarios = [scenario_of(paper, spec) for spec in specs]
    flown: dict[str, dict[str, Any]] = {}
    found = []
    for done, (spec, scenario) in enumerate(zip(specs, scenarios, strict=True)):
        progress(f"{paper.name}: numbers", done, len(specs))
        key = json.dumps([spec.scenario, spec.set], sort_keys=True, default=str)
        if key not in flown:
            flown[key] = dict(Rollout(scenario).fly().summary)
        found.append(_measured(spec, flown[key]))
    progress(f"{paper.name}: numbers", len(specs), len(specs))
    return Reproduction(paper=paper, numbers=tuple(found))


def _measured(spec: NumberSpec, summary: dict[str, Any]) -> Reproduced:
    if summary["status"] != "completed":
        return Reproduced(spec=spec, ours=None, reason=summary["reason"])
    value: Any = summary
    path = ""
    for key in spec.measure.split("."):
        if isinstance(value, list | tuple):
            value = {entry["name"] if path == "constraints" else str(i): entry for i, entry in enumerate(value)}
        there = value if isinstance(value, Mapping) else {}
        if key not in there:
            has = f" ({path or 'summary.json'} has: {', '.join(there)})" if there else ""
            raise InputError(f"{spec.name}: {_RULE}; got {spec.measure!r}{has}")
        path, value = f"{path}.{key}".lstrip("."), there[key]
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise InputError(f"{spec.name}: {_RULE}; got {spec.measure!r}")
    return Reproduced(spec=spec, ours=float(value))
