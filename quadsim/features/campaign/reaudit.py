"""Re-audit of a campaign: its verdicts under other tolerances, from the margins in its table.

A constraint holds where the worst margins, at the physics rate and at the control samples, are within its tolerances.
`quadsim compare --constraints` uses it before `paired` compares the two tables.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pyarrow as pa

from quadsim.errors import InputError
from quadsim.features.campaign.events import ALL_SATISFIED, INCOMPLETE, CountedEvent, FlightFlags
from quadsim.features.campaign.rows import MARGIN, SAMPLED, SATISFIED, TIME_VIOLATED, flags, null, numbers, texts
from quadsim.flight.audit import Limit, limit_differences


def judged_by(
    limits: Sequence[Limit], audited: Sequence[Limit], table: pa.Table, failure: Sequence[CountedEvent]
) -> pa.Table:
    """Return a campaign's table as if its flights had been audited with the tolerances of other limits.

    The worst margins do not depend on tolerances.  Times beyond them do, and are left out.

    Args:
        limits: the limits whose tolerances and demands count.
        audited: the limits that the campaign was audited with.
        table: its `flights.parquet`.
        failure: the events that count as failure.

    Raises:
        InputError: they differ in more than tolerances and demands; margins to other bounds are in no table.
    """
    _require_same_bounds(limits, audited)
    all_held = np.ones(table.num_rows, bool)
    all_reached = np.ones(table.num_rows, bool)
    for limit in limits:
        unknown = null(table, SATISFIED + limit.name)
        held = _within_tolerances(table, limit) & ~unknown
        table = _with_column(table, SATISFIED + limit.name, held, unknown=unknown)
        table = table.drop_columns([TIME_VIOLATED + limit.name])
        if limit.required:
            all_held &= held | unknown
            all_reached &= ~unknown
    verdict = texts(table, "verdict")
    by_audit = np.isin(verdict.astype(str), (ALL_SATISFIED, "violated", INCOMPLETE))
    failed_by = ~null(table, "failed_by")
    audit_verdict = np.where(failed_by | ~all_held, "violated", np.where(all_reached, ALL_SATISFIED, INCOMPLETE))
    verdicts = np.where(by_audit, audit_verdict, verdict)
    violated = np.where(by_audit, verdicts == "violated", flags(table, "violated", absent=True))
    table = _with_column(table, "verdict", verdicts)
    table = _with_column(table, "violated", violated)
    failed = np.any([event.column(table) for event in failure], axis=0)
    return _with_column(table, "failed", failed)


def _require_same_bounds(limits: Sequence[Limit], audited: Sequence[Limit]) -> None:
    """Refuse limits that differ from a campaign's in more than tolerances and demands."""
    by_name = {limit.name: limit for limit in limits}
    with_their_tolerances = []
    for limit in audited:
        other = by_name.get(limit.name, limit)
        plant, sampled = other.tolerances
        with_their_tolerances.append(
            replace(limit, tolerance=plant, tolerance_sampled=sampled, required=other.required)
        )
    differences = limit_differences(limits, with_their_tolerances)
    if differences:
        raise InputError(
            "a campaign's table has the margins to its own bounds alone, so it cannot be audited against others: "
            f"{'; '.join(differences[:4])}; fly it again with the same [[constraints]]"
        )


def _within_tolerances(table: pa.Table, limit: Limit) -> FlightFlags:
    """(K,) whether a limit's worst margins are known and within its tolerances, flight by flight."""
    margin = numbers(table, MARGIN + limit.name)
    sampled = numbers(table, SAMPLED + limit.name)
    within = np.isfinite(margin) & ~limit.violated(margin) & ~limit.violated(sampled, sampled=True)
    return np.asarray(within, bool)


def _with_column(
    table: pa.Table, name: str, values: np.ndarray[Any, Any], *, unknown: FlightFlags | None = None
) -> pa.Table:
    """Return the table with other values (K,) in a column, null where they are unknown."""
    field = table.schema.field(name)
    column = pa.array(values.tolist(), field.type, mask=unknown)
    return table.set_column(table.column_names.index(name), field, column)
