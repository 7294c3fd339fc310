"""A scenario flown for every combination of some fields' values."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyarrow as pa

from quadsim.errors import ParameterError, UnknownNameError
from scenarios.assembly import Assembly
from scenarios.campaign.pilot import CampaignPilot, fly_flights
from scenarios.campaign.plan import Plan, parse_campaign
from scenarios.campaign.results.table import DRAW, make_table
from scenarios.flight import to_pandas
from scenarios.progress import Progress, silent
from scenarios.schema.scenario import Scenario


@dataclass(frozen=True)
class Sweep:
    """The flights of a sweep, a row each, with the units in the columns' metadata."""

    table: pa.Table  # what was swept, by dotted path; verdict; tracking errors; commands; margins; step times

    def __getitem__(self, column: str) -> np.ndarray[Any, Any]:
        """(flights,) of a column by its name.

        Raises:
            UnknownNameError: there is none.
        """
        if column not in self.table.column_names:
            raise UnknownNameError("column", column, self.table.column_names)
        return np.asarray(self.table[column].to_numpy())

    def __len__(self) -> int:
        """Flights."""
        return int(self.table.num_rows)

    def to_arrow(self) -> pa.Table:
        """The table."""
        return self.table

    def to_pandas(self) -> Any:
        """The table as a pandas DataFrame.

        Raises:
            MissingPackageError: pandas is not installed.
        """
        return to_pandas(self.table)


def fly_sweep(
    scenario: Scenario, values: Mapping[str, Sequence[Any]], workers: int | None = None, progress: Progress = silent
) -> Sweep:
    """Fly every combination of values, by dotted path, the last field varying fastest.

    Raises:
        InputError: a field does not exist, or a value is not allowed.
    """
    for path, tried in values.items():
        if isinstance(tried, str) or not len(tried):
            raise ParameterError("sweep", path, tried, "a list of values to try")
    lists = [getattr(tried, "tolist", lambda tried=tried: list(tried))() for tried in values.values()]
    entries = [
        {"name": f"field-{i}", "fields": [path], "distribution": "grid", "values": lists[i]}
        for i, path in enumerate(values)
    ]
    count = math.prod(map(len, lists))
    data = {"name": scenario.name, "scenario": scenario.name, "flights": count, "vary": entries}
    spec = parse_campaign(data, source="sweep")
    plan = Plan(spec, Assembly(scenario).with_vehicle, one_seed=True)
    plan.check()
    progress("sweep", 0, count)
    rows = []
    with closing(fly_flights(CampaignPilot(plan), range(count), workers=workers)) as flown:
        for row in flown:
            rows.append(row)
            progress("sweep", len(rows), count)
    table = make_table(rows, plan.schema).drop_columns(["flight", "seed", "failed"])
    table = table.rename_columns({f"{DRAW}field-{i}": path for i, path in enumerate(values)})
    return Sweep(table.select([*values, *(name for name in table.column_names if name not in values)]))
