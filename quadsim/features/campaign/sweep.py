"""Sweeps: flights of a scenario for every combination of the values of some fields, as a tidy table.

A sweep is a campaign of grids alone (`plan`), all of whose flights have the scenario's seed; nothing is written.
"""

from __future__ import annotations

import itertools
import math
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import pyarrow as pa

from quadsim.console.progress import Progress, silent
from quadsim.console.results import Result, Shown
from quadsim.errors import InputError, ParameterError, UnknownNameError
from quadsim.features.campaign.campaign_file import CampaignFile, GridValues
from quadsim.features.campaign.plan import Plan, table_value
from quadsim.features.campaign.rows import DRAW, is_number, make_table, numbers
from quadsim.palette import COLOUR
from quadsim.report.figure import Bound, Figure, Panel, Series
from quadsim.rollout.flown import to_pandas
from quadsim.scenarios.assembly import Assembly
from quadsim.scenarios.schema.scenario import Scenario
from quadsim.scenarios.schema.settings import leaves, separate

_FIRST_RESULTS: Final = ("verdict", "worst_margin", "worst_constraint", "reason")  # columns after the swept fields
_SHOWN: Final = ("verdict", "rmse.x", "rmse.y", "rmse.z", "worst_margin", "worst_constraint")


@dataclass(frozen=True, repr=False)
class Sweep(Result):
    """The flights of a sweep as a tidy table: a row per flight.

    Its columns: each swept field by its dotted path, a list of numbers with a column for each; `verdict`,
    `worst_margin` and `worst_constraint`; then tracking errors and commands; the audit, as `margin.roll` (the smallest,
    at the physics rate), `time_violated.roll` and `satisfied.roll`; and step times.  Units are in their metadata.
    """

    name: str  # of the scenario
    fields: tuple[str, ...]  # columns that were swept
    table: pa.Table
    cut: int = 0  # flights that end before their course does

    def __getitem__(self, column: str) -> np.ndarray[Any, Any]:
        """Return a column (flights,) by name.

        Raises:
            UnknownNameError: there is none.
        """
        if column not in self.table.column_names:
            raise UnknownNameError("column", column, self.table.column_names)
        return np.asarray(self.table[column].to_numpy())

    def __len__(self) -> int:
        """Return the number of flights."""
        return int(self.table.num_rows)

    def _ipython_key_completions_(self) -> list[str]:
        """Return the column names, for completion in a notebook."""
        return list(self.table.column_names)

    def to_arrow(self) -> pa.Table:
        """The table."""
        return self.table

    def to_pandas(self) -> Any:
        """Return the table as a pandas DataFrame.

        Raises:
            MissingPackageError: pandas is not installed.
        """
        return to_pandas(self.table)

    def shown(self) -> Shown:
        """See `Result.shown`."""
        from quadsim.console import console

        counts = Counter(self["verdict"].tolist())
        verdicts = ", ".join(f"{count} {verdict}" for verdict, count in counts.items())
        lines = []
        for row in self.table.to_pylist():
            lines.append([_text(row[name]) for name in (*self.fields, *_SHOWN)])
        head = (*map(self._short_name, self.fields), *_SHOWN)
        title = f"sweep of {self.name}: {len(self)} flights, {verdicts}"
        yield console.table(title, head, lines, left=("verdict", "worst_constraint"))
        if self.cut:
            yield f"{self.cut} of {len(self)} flights end before their course does: the scenario states a duration"

    def _short_name(self, field: str) -> str:
        """Return the shortest end of a field's path that no other field has; a number in a list has its list's name."""
        parts = field.split(".")
        fewest = 2 if parts[-1].isdigit() else 1
        for count in range(fewest, len(parts)):
            end = ".".join(parts[-count:])
            if sum(f".{name}".endswith(f".{end}") for name in self.fields) == 1:
                return end
        return field

    def small_plot(self) -> Figure | None:
        """See `Result.small_plot`: the worst margin over the first field that is a number."""
        names = [name for name in self.fields if is_number(self.table, name)]
        if not names:
            return None
        x = numbers(self.table, names[0])
        y = numbers(self.table, "worst_margin")
        satisfied = self["verdict"] == "satisfied"
        kinds = (
            (satisfied, COLOUR.satisfied, "satisfied", "circle"),
            (~satisfied, COLOUR.violated, "not satisfied", "x"),
        )
        points = []
        for rows, colour, label, marker in kinds:
            if rows.any():
                points.append(
                    Series(x=x[rows], y=y[rows], colour=colour, label=label, style="points", width=5.0, marker=marker)
                )
        panel = Panel(
            title="worst margin, as a share of half its band",
            y_label="share",
            x_label=names[0],
            series=tuple(points),
            bounds=(Bound(value=0.0),),
            height=1.4,
        )
        return Figure(key="sweep", title="", panels=(panel,), columns=1)

    def to_json(self) -> list[dict[str, Any]]:
        """Return a table with one line per flight."""
        return [*self.table.to_pylist()]


def _text(value: object) -> str:
    """A cell of the table."""
    if isinstance(value, float):
        return f"{value:.4g}"
    if value is None:
        return "-"
    return str(value)


def fly_sweep(
    scenario: Scenario, values: Mapping[Any, Sequence[Any]], workers: int | None = None, progress: Progress = silent
) -> Sweep:
    """Fly every combination of values, by dotted path, the last field varying fastest; see `quadsim.sweep`."""
    entries = [_grid(fields, tried) for fields, tried in values.items()]
    count = math.prod(len(entry.values) for entry in entries)
    try:
        spec = CampaignFile(name=scenario.name, scenario=scenario.name, flights=count, vary=[*entries])
    except ValueError as error:
        raise InputError(f"sweep: {error}") from None
    plan = Plan(spec, Assembly(scenario).recorded.scenario, one_seed=True)
    plan.check()
    progress("sweep", 0, count)
    rows = []
    with closing(plan.fly_all(range(count), workers=workers)) as flown:
        for row in flown:
            rows.append(row)
            progress("sweep", len(rows), count)
    cut = sum(_is_cut(plan, flight) for flight in range(count))
    swept = _swept_columns(entries)
    results = _result_columns(make_table(rows, plan.schema), entries)
    fields = []
    for name, column in swept.items():
        fields.append(pa.field(name, column.type))
    schema = pa.schema([*fields, *results.schema])
    whole = pa.Table.from_arrays([*swept.values(), *results.columns], schema=schema)
    return Sweep(scenario.name, tuple(swept), whole, cut)


def _result_columns(table: pa.Table, entries: Sequence[GridValues]) -> pa.Table:
    """Return what was measured of each flight, the most important columns first."""
    left_out = {"flight", "seed", "failed", *_FIRST_RESULTS}
    left_out.update(DRAW + entry.name for entry in entries)
    others = [name for name in table.column_names if name not in left_out]
    return table.select([*_FIRST_RESULTS, *others])


def _is_cut(plan: Plan, flight: int) -> bool:
    """Return whether a flight ends before its course does; one that cannot be flown does not."""
    try:
        return Assembly(plan.of(flight)).course_cut is not None
    except InputError:
        return False


def _grid(fields: str | tuple[str, ...], tried: Sequence[Any]) -> GridValues:
    """Return the values of a field, or of several together, after checking each."""
    if isinstance(fields, str):
        owner = fields
    else:
        owner = f"({', '.join(fields)})"
    if isinstance(tried, str) or not hasattr(tried, "__len__") or not len(tried):
        raise ParameterError("sweep", owner, tried, "a list of values to try")
    values = []
    for value in tried:
        plain = value.tolist() if hasattr(value, "tolist") else value
        if not isinstance(fields, str):
            plain = tuple(separate({fields: plain}, source="sweep").values())
        elif isinstance(plain, tuple):
            plain = list(plain)
        values.append(plain)
    if isinstance(fields, str):
        fields = (fields,)
    try:
        return GridValues(name=owner, fields=[*fields], distribution="grid", values=values)
    except ValueError as error:
        raise InputError(f"sweep.{owner}: {error}") from None


def _swept_columns(entries: Sequence[GridValues]) -> dict[str, pa.Array]:
    """Return the columns of the swept values, by the dotted path of each number or text."""
    rows: list[dict[str, Any]] = []
    paths: dict[str, None] = {}  # in the order in which they appear
    values = [entry.values for entry in entries]
    for combination in itertools.product(*values):
        together = {}
        for entry, value in zip(entries, combination, strict=True):
            together[tuple(entry.fields)] = value
        row = {}
        for path, leaf in leaves(separate(together, source="sweep"), entries=True):
            row[path] = table_value(leaf)
            paths[path] = None
        rows.append(row)
    columns = {}
    for path in paths:
        columns[path] = pa.array([row.get(path) for row in rows])
    return columns
