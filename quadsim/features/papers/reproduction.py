"""Numbers of papers, one TOML file per paper, and their reproduction: theirs, ours, difference.

A number is of one of three kinds, which are never counted together: the paper prints it (`published`), somebody ran the
authors' public code to obtain it (`authors_code`), or another implementation of the same rules gave it
(`other_implementation`).  Ours is an entry of the flight's summary, within the tolerance of theirs or not.
"""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Final, Literal

from annotated_types import MaxLen, MinLen, doc

from quadsim.assets import read_toml
from quadsim.console.junit import Cases
from quadsim.console.progress import Progress, silent
from quadsim.console.results import EXIT_DONE, EXIT_FAILED, Shown, Tabular
from quadsim.errors import InputError
from quadsim.fields import NonNegative, Number, Positive
from quadsim.input_limits import MOST_ENTRIES
from quadsim.report.table import ABSENT, Cell, Grid, Mark, line
from quadsim.rollout.rollout import Rollout
from quadsim.scenarios.assembly import Assembly
from quadsim.scenarios.catalogue import paper_path, scenario_source
from quadsim.scenarios.loading import parse_scenario
from quadsim.scenarios.preflight import checked
from quadsim.scenarios.schema.base import PairList
from quadsim.scenarios.schema.bases import merge, read_scenario
from quadsim.scenarios.schema.problems import parse_table
from quadsim.scenarios.schema.scenario import Scenario

NUMBER_KINDS: Final = {
    "published": "published",
    "authors_code": "by the authors' code",
    "other_implementation": "by another implementation",
}
"""Where a number is from: the field of a paper's file that has it, and its name in sentences."""
_COLUMNS: Final = {"published": "published", "authors_code": "authors' code", "other_implementation": "other code"}
"""Their columns, short enough for a console."""
COUNTED: Final = {**NUMBER_KINDS, "claim": "claims checked and confirmed", "bar": "bars of something else, met"}
"""What is counted apart, and its name in sentences."""
_MEASURE_RULE: Final = "measure must lead to a number of the flight's summary"
_ROUNDING: Final = 1e-9
"""Share of a tolerance by which a difference may exceed it: what rounding adds."""
Text = Annotated[str, MinLen(1), MaxLen(300)]
Stated = Number | PairList


@dataclass(frozen=True, kw_only=True)
class PaperNumber:
    """A number of a paper, of its authors' code or of another implementation, and the flight that reproduces it."""

    name: Annotated[Text, doc("what it is, for tables")]
    scenario: Annotated[str, doc("a library name, or a path ending in .toml, relative to the paper's file")]
    set: Annotated[dict[str, Any], doc("tables that are merged over the scenario, as over a base")] = field(
        default_factory=dict
    )
    measure: Annotated[str, doc("dotted path into the flight's summary.json; an entry of a list by its name")] = (
        "tracking.position_error.mean"
    )
    unit: Annotated[str, MaxLen(20), doc("of the number, for tables")] = "m"
    published: Annotated[
        Stated | None, doc("[unit] the number that the paper prints, or the lowest and the highest of several")
    ] = None
    authors_code: Annotated[Stated | None, doc("[unit] in its place: obtained by running the authors' code")] = None
    other_implementation: Annotated[Stated | None, doc("[unit] in its place: by another implementation")] = None
    role: Annotated[
        Literal["number", "claim", "bar"],
        doc(
            "of a published number: one that the paper reports of what is flown; a claim of the paper, in words or a "
            "figure, put as a number; or a bar, which the paper reports of something else"
        ),
    ] = "number"
    relation: Annotated[Literal["equal", "at most", "at least"], doc("what ours is to be to theirs")] = "equal"
    absolute: Annotated[NonNegative | None, doc("[unit] tolerance; either absolute or relative")] = None
    relative: Annotated[Positive | None, doc("[-] tolerance as a share of the number")] = None
    source: Annotated[Text, doc("where the number is from")]

    def __post_init__(self) -> None:
        if len(self._given) != 1:
            given = ", ".join(self._given) or "none"
            raise ValueError(f"exactly one of {', '.join(NUMBER_KINDS)} must be given; got {given}")
        if self.role != "number" and self.published is None:
            raise ValueError(f"role must be number where published is absent; got {self.role}")
        if (self.absolute is None) == (self.relative is None):
            raise ValueError("absolute must be given, or relative, but not both")
        if self.relative is not None and not any(self.span):
            raise ValueError("absolute must be given where the number is 0")
        if isinstance(self.stated, list):
            low, high = self.stated
            if self.relation != "equal" or not low < high:
                raise ValueError(
                    f"{self.kind} must be a lower and a higher number of relation equal; got {[low, high]}"
                )

    @property
    def _given(self) -> list[str]:
        return [kind for kind in NUMBER_KINDS if getattr(self, kind) is not None]

    @property
    def kind(self) -> str:
        """Where the number is from: a key of `NUMBER_KINDS`."""
        return self._given[0]

    @property
    def counted_as(self) -> str:
        """What it is counted as: its kind, or its role where it is none of the paper's numbers of what is flown."""
        if self.role == "number":
            return self.kind
        return self.role

    @property
    def stated(self) -> float | list[float]:
        """The number [unit], or the lowest and the highest of several."""
        value: float | list[float] = getattr(self, self.kind)
        return value

    @property
    def span(self) -> tuple[float, float]:
        """The lowest and the highest of the stated numbers [unit]."""
        if isinstance(self.stated, list):
            low, high = self.stated
            return low, high
        return self.stated, self.stated

    @property
    def tolerance(self) -> float:
        """Allowed difference [unit]."""
        if self.absolute is not None:
            return self.absolute
        return (self.relative or 0.0) * max(map(abs, self.span))


@dataclass(frozen=True, kw_only=True)
class PaperFile:
    """A paper and its reproduced numbers."""

    title: Annotated[Text, doc("of the paper")]
    authors: Annotated[Text | None, doc("of the paper; absent where it names none")] = None
    publication: Annotated[Text | None, doc("where and when it was published")] = None
    about: Annotated[Text, doc("what is reproduced, and what it is written from")]
    subject: Annotated[Text | None, doc("what its published numbers are of, for the count of these")] = None
    numbers: Annotated[list[PaperNumber], MinLen(1), MaxLen(MOST_ENTRIES), doc("its numbers, in order")]


@dataclass(frozen=True, kw_only=True)
class Paper(PaperFile):
    """A paper with the file that it was read from."""

    path: Path

    @property
    def name(self) -> str:
        """Short name of the paper."""
        return self.path.stem

    def scenario_of(self, number: PaperNumber) -> Scenario:
        """Return the scenario of a number."""
        name = number.scenario
        beside = self.path.parent / name
        if name.endswith(".toml") and beside.is_file():
            name = str(beside)
        data = merge(read_scenario(name), number.set)
        file, _ = scenario_source(name)
        scenario = parse_scenario(data, source=f"{number.name}: {number.scenario}", directory=file.parent)
        checked(Assembly(scenario))
        return scenario


def load_paper(name: str) -> Paper:
    """Read and check a shipped paper, or a path ending in `.toml`."""
    path = paper_path(name)
    file = parse_table(PaperFile, read_toml(path), path.name, file="paper")
    return Paper(path=path, **vars(file))


@dataclass(frozen=True, kw_only=True)
class Reproduced:
    """One number."""

    spec: PaperNumber  # theirs
    ours: float | None  # of our flight [unit]; None where it ended early
    reason: str | None = None  # why it did

    @property
    def difference(self) -> float | None:
        """Ours minus theirs, or minus the nearest of several [unit]."""
        if self.ours is None:
            return None
        low, high = self.spec.span
        nearest = min(max(self.ours, low), high)
        return self.ours - nearest

    @property
    def within(self) -> bool:
        """Whether our number is within the file's tolerance; false if the flight ended early."""
        if self.difference is None:
            return False
        if self.spec.relation == "equal":
            beyond = abs(self.difference)
        elif self.spec.relation == "at most":
            beyond = self.difference
        else:
            beyond = -self.difference
        return beyond <= self.spec.tolerance * (1.0 + _ROUNDING)

    def to_json(self) -> dict[str, Any]:
        """Return the number and its reproduction as plain data."""
        spec = self.spec
        return {
            "name": spec.name,
            "scenario": spec.scenario,
            "set": spec.set,
            "measure": spec.measure,
            "unit": spec.unit,
            "source": spec.source,
            "published": spec.published,
            "authors_code": spec.authors_code,
            "other_implementation": spec.other_implementation,
            "kind": spec.kind,
            "role": spec.role,
            "relation": spec.relation,
            "tolerance": spec.tolerance,
            "ours": self.ours,
            "difference": self.difference,
            "within": self.within,
            "reason": self.reason,
        }

    @property
    def sentence(self) -> str:
        """The verdict for a report."""
        spec = self.spec
        source = NUMBER_KINDS[spec.kind]
        if spec.role != "number":
            source += f", a {spec.role}"
        theirs = f"{source}: {self._theirs} {spec.unit}"
        ours = self._shown(self.ours)
        difference = self._shown(self.difference, "+")
        text = f"{theirs}; ours {ours} (difference {difference}, tolerance {self._tolerance})"
        if self.reason:
            return f"{text}: {self.reason}"
        return text

    def cells(self, kinds: Sequence[str]) -> tuple[Cell, ...]:
        """Its line of a table with a column for each of some kinds."""
        spec = self.spec
        theirs = []
        for kind in kinds:
            theirs.append(self._theirs if kind == spec.kind else ABSENT)
        if self.within:
            verdict = Cell(text="yes", mark=Mark.GOOD)
        else:
            verdict = Cell(text="no", mark=Mark.BAD)
        return line(
            spec.name,
            spec.unit,
            *theirs,
            self._shown(self.ours),
            self._shown(self.difference, "+"),
            self._tolerance,
            verdict,
        )

    @property
    def _theirs(self) -> str:
        """What ours is compared with: `0.241`, `0.1163 to 0.1164` or `at most 0.02`."""
        low, high = self.spec.span
        if low == high:
            text = f"{low:g}"
        else:
            text = f"{low:g} to {high:g}"
        if self.spec.relation == "equal":
            return text
        return f"{self.spec.relation} {text}"

    @property
    def _tolerance(self) -> str:
        """The tolerance as stated: `0.01`, in the number's unit, or `5 %`."""
        spec = self.spec
        if spec.relative is None:
            return f"{spec.tolerance:.2g}"
        return f"{100.0 * spec.relative:g} %"

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

    @property
    def counts(self) -> dict[str, tuple[int, int]]:
        """How many are within their tolerance, of how many, by `PaperNumber.counted_as`."""
        within = Counter[str]()
        total = Counter[str]()
        for number in self.numbers:
            total[number.spec.counted_as] += 1
            within[number.spec.counted_as] += number.within
        counts = {}
        for name in COUNTED:
            if name in total:
                counts[name] = (within[name], total[name])
        return counts

    @property
    def sentence(self) -> str:
        """The counts, each kind apart: `published: 1 of 1; by the authors' code: 8 of 8`."""
        parts = []
        for name, (within, count) in self.counts.items():
            part = f"{COUNTED[name]}: {within} of {count}"
            if name == "published" and self.paper.subject:
                part += f" of {self.paper.subject}"
            parts.append(part)
        return "; ".join(parts)

    def to_json(self) -> dict[str, Any]:
        """Return the paper, how many of its numbers are reproduced, and each of them as plain data."""
        counts = {}
        for name, (within, count) in self.counts.items():
            counts[name] = {"within": within, "of": count}
        return {
            "name": self.paper.name,
            "title": self.paper.title,
            "authors": self.paper.authors,
            "publication": self.paper.publication,
            "reproduced": self.within,
            "sentence": self.sentence,
            "counts": counts,
            "numbers": [number.to_json() for number in self.numbers],
        }

    @property
    def grid(self) -> Grid:
        """The table; a kind that no number is of has no column."""
        paper = self.paper
        citation = ", ".join(filter(None, [paper.authors, paper.publication]))
        used = {number.spec.kind for number in self.numbers}
        kinds = []
        columns = []
        for kind, column in _COLUMNS.items():
            if kind in used:
                kinds.append(kind)
                columns.append(column)
        if all(number.spec.counted_as == "claim" for number in self.numbers):
            columns = ["claimed"]
        return Grid(
            key=paper.name,
            title=paper.title,
            head=("number", "unit", *columns, "ours", "difference", "tolerance", "within"),
            lines=tuple(number.cells(kinds) for number in self.numbers),
            note=". ".join(filter(None, [self.sentence, citation, paper.about])),
        )


class Reproductions(tuple[Reproduction, ...], Tabular):
    """One for each paper."""

    @property
    def exit_status(self) -> int:
        """See `Result.exit_status`; 1 where a number is not reproduced."""
        if all(paper.within for paper in self):
            return EXIT_DONE
        return EXIT_FAILED

    def verdicts(self) -> tuple[str, Cases]:
        """See `quadsim.console.junit.Judged`."""
        cases = []
        for entry in self:
            for number in entry.numbers:
                cases.append((f"{entry.paper.name}: {number.spec.name}", number.within, number.sentence))
        return "reproduce", cases

    def records(self) -> list[dict[str, Any]]:
        """Return a row per number: theirs as `lowest` and `highest`, `ours`, `difference`, `tolerance`, `within`."""
        rows = []
        for entry in self:
            for number in entry.numbers:
                lowest, highest = number.spec.span
                rows.append(
                    {
                        "paper": entry.paper.name,
                        "number": number.spec.name,
                        "unit": number.spec.unit,
                        "counted_as": number.spec.counted_as,
                        "relation": number.spec.relation,
                        "lowest": lowest,
                        "highest": highest,
                        "ours": number.ours,
                        "difference": number.difference,
                        "tolerance": number.spec.tolerance,
                        "within": number.within,
                    }
                )
        return rows

    def shown(self) -> Shown:
        """See `Result.shown`."""
        from quadsim.console import console

        return console.grids([paper.grid for paper in self], left=("number",))

    def to_json(self) -> dict[str, Any]:
        """Return the number and its reproduction as plain data."""
        return {"reproduced": not self.exit_status, "papers": [paper.to_json() for paper in self]}


def reproduce_paper(paper: Paper, progress: Progress = silent) -> Reproduction:
    """Fly a paper's numbers, every flight only once; see `quadsim.reproduce`."""
    scenarios = [paper.scenario_of(number) for number in paper.numbers]
    summaries: dict[str, dict[str, Any]] = {}
    reproduced = []
    stage = f"{paper.name}: numbers"
    count = len(scenarios)
    for done, (number, scenario) in enumerate(zip(paper.numbers, scenarios, strict=True)):
        progress(stage, done, count)
        key = json.dumps([number.scenario, number.set], sort_keys=True, default=str)
        if key not in summaries:
            summaries[key] = dict(Rollout(scenario).fly().summary)
        reproduced.append(_measured(number, summaries[key]))
    progress(stage, count, count)
    return Reproduction(paper=paper, numbers=tuple(reproduced))


def _measured(spec: PaperNumber, summary: dict[str, Any]) -> Reproduced:
    """Return our number, which is an entry of a flight's summary; none of a flight that ended early.

    Raises:
        InputError: the summary has no such number.
    """
    if summary["status"] != "completed":
        return Reproduced(spec=spec, ours=None, reason=summary["reason"])
    value: Any = summary
    path = ""
    for key in spec.measure.split("."):
        entries = _entries(value, path)
        if key not in entries:
            message = f"{spec.name}: {_MEASURE_RULE}; got {spec.measure!r}"
            if entries:
                message += f" ({path or 'summary.json'} has: {', '.join(entries)})"
            raise InputError(message)
        value = entries[key]
        path = f"{path}.{key}".lstrip(".")
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise InputError(f"{spec.name}: {_MEASURE_RULE}; got {spec.measure!r}")
    return Reproduced(spec=spec, ours=float(value))


def _entries(value: Any, path: str) -> Mapping[str, Any]:
    """Return the entries of a table or a list of a summary: constraints by their names, those of other lists by number.

    Other values have none.
    """
    if isinstance(value, Mapping):
        return value
    if not isinstance(value, list | tuple):
        return {}
    entries = {}
    for i, entry in enumerate(value):
        key = entry["name"] if path == "constraints" else str(i)
        entries[key] = entry
    return entries
