"""Published numbers of papers, one TOML file per paper, and their reproduction: published, ours, difference."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Final, Literal

from annotated_types import MaxLen, MinLen, doc

from quadsim.assets import read_toml
from quadsim.errors import InputError
from quadsim.fields import NonNegative, Number, Positive
from quadsim.input_limits import MOST_ENTRIES
from quadsim.report.table import ABSENT, Cell, Grid, Mark, line
from scenarios.assembly import Assembly
from scenarios.catalogue import paper_path, scenario_source
from scenarios.commands.junit import Cases
from scenarios.loading import parse_scenario
from scenarios.progress import Progress, silent
from scenarios.results import EXIT_DONE, EXIT_FAILED, Result, Shown
from scenarios.rollout import Rollout
from scenarios.schema.base import PairList
from scenarios.schema.bases import merge, read_scenario
from scenarios.schema.problems import parse_table
from scenarios.schema.scenario import Scenario

HEAD: Final = ("number", "unit", "published", "ours", "difference", "tolerance", "reproduced")
_RULE: Final = "measure must lead to a number of the flight's summary"
Text = Annotated[str, MinLen(1), MaxLen(300)]


@dataclass(frozen=True, kw_only=True)
class PublishedNumber:
    """One published number, and the flight that reproduces it."""

    name: Annotated[Text, doc("what it is, for tables")]
    scenario: Annotated[str, doc("a library name, or a path ending in .toml, relative to the paper's file")]
    set: Annotated[dict[str, Any], doc("tables that are merged over the scenario, as over a base")] = field(
        default_factory=dict
    )
    measure: Annotated[str, doc("dotted path into the flight's summary.json; an entry of a list by its name")] = (
        "tracking.position_error.mean"
    )
    unit: Annotated[str, MaxLen(20), doc("of the number, for tables")] = "m"
    published: Annotated[Number | PairList, doc("[unit] the number, or the lowest and the highest of several")]
    relation: Annotated[Literal["equal", "at most", "at least"], doc("what ours is to be to the published one")] = (
        "equal"
    )
    absolute: Annotated[NonNegative | None, doc("[unit] tolerance; either absolute or relative")] = None
    relative: Annotated[Positive | None, doc("[-] tolerance as a share of the published number")] = None
    source: Annotated[Text, doc("where the published number is from")]

    def __post_init__(self) -> None:
        if (self.absolute is None) == (self.relative is None):
            raise ValueError("absolute must be given, or relative, but not both")
        if self.relative is not None and not any(self.span):
            raise ValueError("absolute must be given where the published number is 0")
        if isinstance(self.published, list):
            low, high = self.published
            if self.relation != "equal" or not low < high:
                raise ValueError(f"published must be a lower and a higher number of relation equal; got {[low, high]}")

    @property
    def span(self) -> tuple[float, float]:
        """The lowest and the highest published number."""
        low, high = self.published if isinstance(self.published, list) else (self.published, self.published)
        return low, high

    @property
    def tolerance(self) -> float:
        """Allowed difference [unit]."""
        return self.absolute if self.absolute is not None else (self.relative or 0.0) * max(map(abs, self.span))


@dataclass(frozen=True, kw_only=True)
class PaperFile:
    """A paper and its reproduced numbers."""

    title: Annotated[Text, doc("of the paper")]
    authors: Annotated[Text | None, doc("of the paper; absent where it names none")] = None
    publication: Annotated[Text | None, doc("where and when it was published")] = None
    about: Annotated[Text, doc("what is reproduced, and what it is written from")]
    numbers: Annotated[list[PublishedNumber], MinLen(1), MaxLen(MOST_ENTRIES), doc("its numbers, in order")]


@dataclass(frozen=True, kw_only=True)
class Paper(PaperFile):
    """A paper with the file that it was read from."""

    path: Path

    @property
    def name(self) -> str:
        """Short name of the paper."""
        return self.path.stem

    def scenario_of(self, number: PublishedNumber) -> Scenario:
        """Return the scenario of a number."""
        beside = self.path.parent / number.scenario
        own_file = number.scenario.endswith(".toml") and beside.is_file()
        name = str(beside) if own_file else number.scenario
        data, (file, _) = merge(read_scenario(name), number.set), scenario_source(name)
        scenario = parse_scenario(data, source=f"{number.name}: {number.scenario}", directory=file.parent)
        Assembly(scenario).check()
        return scenario


def load_paper(name: str) -> Paper:
    """Read and check a shipped paper, or a path ending in `.toml`."""
    path = paper_path(name)
    return Paper(path=path, **vars(parse_table(PaperFile, read_toml(path), path.name, file="paper")))


@dataclass(frozen=True, kw_only=True)
class Reproduced:
    """One number."""

    spec: PublishedNumber  # the published one
    ours: float | None  # of our flight [unit]; None where it ended early
    reason: str | None = None  # why it did

    @property
    def difference(self) -> float | None:
        """Ours minus the published number, or the nearest of several [unit]."""
        low, high = self.spec.span
        return None if self.ours is None else self.ours - min(max(self.ours, low), high)

    @property
    def within(self) -> bool:
        """Whether our number is within the file's tolerance; false if the flight ended early."""
        if self.difference is None:
            return False
        beyond = {"equal": abs(self.difference), "at most": self.difference, "at least": -self.difference}
        return beyond[self.spec.relation] <= self.spec.tolerance * (1.0 + 1e-9)

    def to_json(self) -> dict[str, Any]:
        """Return the number and its reproduction as plain data."""
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
        """Return a value to a tenth of the tolerance, or to four digits without a tolerance."""
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
        """Return the number and its reproduction as plain data."""
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

    def verdicts(self) -> tuple[str, Cases]:
        """See `scenarios.commands.junit.Judged`."""
        numbers = [(entry.paper.name, number) for entry in self for number in entry.numbers]
        return "reproduce", [(f"{paper}: {it.spec.name}", it.within, it.sentence) for paper, it in numbers]

    def shown(self) -> Shown:
        """See `Result.shown`."""
        from scenarios import console

        return console.grids([paper.grid for paper in self], left=("number",))

    def to_json(self) -> dict[str, Any]:
        """Return the number and its reproduction as plain data."""
        return {"reproduced": not self.exit_status, "papers": [paper.to_json() for paper in self]}


def reproduce_paper(paper: Paper, progress: Progress = silent) -> Reproduction:
    """Fly a paper's numbers, every flight only once; see `quadsim.reproduce`."""
    scenarios = [paper.scenario_of(number) for number in paper.numbers]
    summaries: dict[str, dict[str, Any]] = {}
    reproduced, what, count = [], f"{paper.name}: numbers", len(scenarios)
    for done, (number, scenario) in enumerate(zip(paper.numbers, scenarios, strict=True)):
        progress(what, done, count)
        key = json.dumps([number.scenario, number.set], sort_keys=True, default=str)
        if key not in summaries:
            summaries[key] = dict(Rollout(scenario).fly().summary)
        reproduced.append(_measured(number, summaries[key]))
    progress(what, count, count)
    return Reproduction(paper=paper, numbers=tuple(reproduced))


def _measured(spec: PublishedNumber, summary: dict[str, Any]) -> Reproduced:
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
