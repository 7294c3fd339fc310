"""A campaign judged again by other tolerances, from the margins in its table."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pyarrow as pa

from quadsim.errors import InputError
from quadsim.features.campaign.events import HARMLESS, INCOMPLETE, CountedEvent
from quadsim.features.campaign.rows import MARGIN, SAMPLED, SATISFIED, TIME_VIOLATED, flags, null, numbers, texts
from quadsim.flight.audit import Limit, limit_differences


def judged_by(
    limits: Sequence[Limit], own: Sequence[Limit], table: pa.Table, failure: Sequence[CountedEvent]
) -> pa.Table:
    """Return a campaign's table as if its flights had been audited with the tolerances of other limits.

    The worst margins do not depend on tolerances.  Times beyond them do, and are left out.

    Args:
        limits: the limits whose tolerances and demands count.
        own: the limits of the campaign.
        table: its `flights.parquet`.
        failure: the events that count as failure.

    Raises:
        InputError: they differ in more than tolerances and demands; margins to other bounds are in no table.
    """
    theirs = {limit.name: limit for limit in limits}
    like = [_alike(limit, theirs.get(limit.name, limit)) for limit in own]
    if differences := limit_differences(limits, like):
        raise InputError(
            "a campaign's table has the margins to its own bounds alone, so it cannot be audited against others: "
            f"{'; '.join(differences[:4])}; fly it again with the same [[constraints]]"
        )
    held_all = np.ones(table.num_rows, bool)
    for limit in limits:
        margin = numbers(table, MARGIN + limit.name)
        sampled = numbers(table, SAMPLED + limit.name)
        unknown = null(table, SATISFIED + limit.name)
        held = ~unknown & np.isfinite(margin) & ~limit.violated(margin) & ~limit.violated(sampled, sampled=True)
        table = _put(table, SATISFIED + limit.name, pa.array(held.tolist(), mask=unknown))
        table = table.drop_columns([TIME_VIOLATED + limit.name])
        held_all &= held | unknown | (not limit.required)
    verdict = texts(table, "verdict")
    judged = np.isin(verdict.astype(str), (HARMLESS, "violated", INCOMPLETE))
    failed_by = np.array([value is not None for value in table["failed_by"].to_pylist()], bool)
    reached = np.all([~null(table, SATISFIED + limit.name) | (not limit.required) for limit in limits], axis=0)
    new = np.where(failed_by | ~held_all, "violated", np.where(reached, HARMLESS, INCOMPLETE))
    verdicts = np.where(judged, new, verdict)
    violated = np.where(judged, verdicts == "violated", flags(table, "violated", absent=True))
    table = _put(_put(table, "verdict", pa.array(verdicts.tolist())), "violated", pa.array(violated.tolist()))
    failed = np.any([event.column(table) for event in failure], axis=0)
    return _put(table, "failed", pa.array(failed.tolist()))


def _alike(limit: Limit, other: Limit) -> Limit:
    """Return a limit with the tolerances and demand of another."""
    tolerance, sampled = other.tolerances
    return replace(limit, tolerance=tolerance, tolerance_sampled=sampled, required=other.required)


def _put(table: pa.Table, name: str, values: pa.Array) -> pa.Table:
    """Return the table with other values in a column."""
    return table.set_column(table.column_names.index(name), table.schema.field(name), values)
