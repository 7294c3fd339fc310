"""A campaign's table -> `summary.json`: how often, how well, what drives it, and how sure that is."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any, Final

import numpy as np
import pyarrow as pa

from quadsim.errors import ParameterError
from quadsim.state import Array
from scenarios.campaign.results.events import EVENT_NAMES, INCOMPLETE, VERDICTS, Flags, parse_event
from scenarios.campaign.results.table import (
    DRAW,
    MARGIN,
    SATISFIED,
    Summary,
    constraint_names,
    draw_names,
    flags,
    is_counted,
    is_number,
    metric_names,
    numbers,
    texts,
    unit_of,
    verdicts,
)
from scenarios.campaign.statistics.dependence import dependence
from scenarios.campaign.statistics.inference import CONFIDENCE, holm, share_of

FAILURE: Final = parse_event("failure")
WORST_FLIGHTS: Final = 10
_PERCENTILES: Final = {"min": 0, "p5": 5, "p50": 50, "p95": 95, "p99": 99, "max": 100}
_GROUPS: Final = ((50, 5), (12, 3))
"""Flights from which a varied parameter's values are looked at in this many groups of about equal size."""


def estimate(table: pa.Table) -> dict[str, Any]:
    """Everything in a campaign's summary about its flights, as plain data for JSON.

    Keys: `flights`; `confidence` of every interval; `verdicts`, flights of each; `events` and `constraints`, by name,
    as proportions (`inference.Proportion`), a constraint's being that it did not hold, among the flights that reached
    it or were lost before; `metrics`, over the flights that have each; `parameters`, how the outcome depends on each
    varied parameter (`parameters`); `worst`, the ten worst flights.

    Incomplete flights are neither failures nor successes (`results.table.is_counted`): the shares of failure and
    violation, and `parameters`, leave them out.
    """
    return {
        "flights": table.num_rows,
        "confidence": CONFIDENCE,
        "verdicts": {verdict: int(found.sum()) for verdict, found in verdicts(table).items()},
        "events": {
            event.text: share_of(event.column(table)[is_counted(table, event)])
            for event in map(parse_event, EVENT_NAMES)
        },
        "metrics": {name: _metric(table, name) for name in metric_names(table)},
        "constraints": {name: _constraint(table, name) for name in constraint_names(table)},
        "parameters": parameters(table.filter(is_counted(table, FAILURE))),
        "worst": [_flight(table, int(i)) for i in ranking(table)[:WORST_FLIGHTS]],
    }


def worst_flight(table: pa.Table) -> int:
    """The number of the worst flight; see `ranking`.

    Raises:
        ParameterError: there is no flight.
    """
    if not table.num_rows:
        raise ParameterError("campaign", "flights", 0, "at least one, to find the worst")
    return int(table["flight"][int(ranking(table)[0])].as_py())


def ranking(table: pa.Table) -> np.ndarray[Any, np.dtype[np.intp]]:
    """(K,) rows of the table, from the worst flight on.

    By verdict (`Verdict.badness`); of one verdict, failed ones come first, then the smaller worst margin.  Flights
    without a margin come after those with one, by their RMS error in position, the largest first.  What is still equal
    is in the order of the flights' numbers.
    """
    badness = np.array([VERDICTS[name].badness for name in texts(table, "verdict")], int)
    margin = numbers(table, "worst_margin")
    errors = np.stack([np.nan_to_num(numbers(table, f"rmse.{axis}")) for axis in "xyz"])
    distance = np.where(np.isnan(margin), np.linalg.norm(errors, axis=0), 0.0)
    keys = (
        numbers(table, "flight"),
        -distance,
        np.where(np.isnan(margin), np.inf, margin),
        ~flags(table, "failed", absent=True),
        -badness,
    )
    return np.lexsort(keys)


def _metric(table: pa.Table, name: str) -> dict[str, Any]:
    values = numbers(table, name)
    values = values[np.isfinite(values)]
    found: dict[str, Any] = {"unit": unit_of(table, name), "flights": int(values.size)}
    if not values.size:
        return found | dict.fromkeys(("mean", "sd", *_PERCENTILES))
    percentiles = np.percentile(values, [*_PERCENTILES.values()]).tolist()
    return found | {
        "mean": float(values.mean()),
        "sd": float(values.std(ddof=1)) if values.size > 1 else None,
        **dict(zip(_PERCENTILES, percentiles, strict=True)),
    }


def _constraint(table: pa.Table, name: str) -> dict[str, Any]:
    margin = numbers(table, MARGIN + name)
    held = flags(table, SATISFIED + name, absent=False)
    unknown = [value is None for value in table[SATISFIED + name].to_pylist()]
    reached = ~(np.array(unknown, bool) & np.isin(texts(table, "verdict").astype(str), (INCOMPLETE, "violated")))
    worst = int(np.nanargmin(margin)) if np.isfinite(margin).any() else None
    return {
        "unit": unit_of(table, MARGIN + name),
        "not_satisfied": share_of(~held[reached]),
        "worst_margin": None if worst is None else float(margin[worst]),
        "worst_flight": None if worst is None else table["flight"][worst].as_py(),
    }


def _flight(table: pa.Table, row: int) -> dict[str, Any]:
    shown = ("flight", "verdict", "failed", "worst_margin", "worst_constraint", "duration", "reason")
    values = table.slice(row, 1).to_pylist()[0]
    return {name: values[name] for name in shown} | {"draws": {name: values[DRAW + name] for name in draw_names(table)}}


def parameters(table: pa.Table) -> dict[str, Any]:
    """A campaign's summary of each varied parameter, as plain data for JSON.

    Of a number: its `unit`; under `worst_margin` and `failed` how that depends on it (`dependence.Dependence`), None
    where there is nothing to relate; failures by `groups` of its values from the lowest on.  All p-values of all
    parameters, outcomes and measures together are corrected by Holm's method: `p_holm`, `p_xi_holm`.
    Of what is drawn from names or truth values: the failures by level.
    """
    failed = flags(table, "failed", absent=True)
    margin = numbers(table, "worst_margin")
    if not np.isnan(margin).all():  # one that was lost before it had any ranks below all others
        margin = np.where(np.isnan(margin) & verdicts(table)["lost"], -np.inf, margin)
    found: dict[str, Any] = {}
    tested: list[dict[str, Any]] = []
    for name in draw_names(table):
        if not is_number(table, DRAW + name):
            found[name] = _levels(table, name, failed)
            continue
        values = numbers(table, DRAW + name)
        found[name] = {"kind": "number", "unit": unit_of(table, DRAW + name)}
        for outcome, reached in (("worst_margin", margin), ("failed", failed.astype(float))):
            related = dependence(values, reached, np.random.default_rng(0))  # the same every time
            found[name][outcome] = None if related is None else asdict(related)
            tested += [] if related is None else [found[name][outcome]]
        found[name]["groups"] = _groups(values, failed)
    corrected = iter(holm([entry[key] for entry in tested for key in ("p", "p_xi")]))
    for entry in tested:
        entry |= {"p_holm": next(corrected), "p_xi_holm": next(corrected)}
    return found


def drivers(summary: Summary) -> dict[str, Mapping[str, Any]]:
    """The varied parameters on which an outcome may depend at all, the strongest first.

    They are ordered by how `worst_margin` depends on them, or else `failed`.
    """
    related = {
        name: found for name, found in summary["parameters"].items() if found.get("worst_margin") or found.get("failed")
    }

    def weakness(parameter: tuple[str, Mapping[str, Any]]) -> tuple[float, float]:
        found = parameter[1]["worst_margin"] or parameter[1]["failed"]
        return min(found["p_holm"], found["p_xi_holm"]), -max(abs(found["rho"]), found["xi"])

    return dict(sorted(related.items(), key=weakness))


def _levels(table: pa.Table, name: str, failed: Flags) -> dict[str, Any]:
    levels = texts(table, DRAW + name)
    shares = {level: share_of(failed[levels == level]) for level in sorted(set(levels))}
    return {"kind": "name", "unit": unit_of(table, DRAW + name), "levels": shares}


def _groups(values: Array, failed: Flags) -> list[dict[str, Any]]:
    """Failures by thirds or fifths of a varied parameter, or by its values if no more; none of few flights."""
    there = np.isfinite(values)
    values, failed = values[there], failed[there]
    size = next((groups for flights, groups in _GROUPS if values.size >= flights), 0)
    if not size:
        return []
    distinct = np.unique(values)
    cuts = distinct[1:] if distinct.size <= size else np.quantile(values, np.arange(1, size) / size)
    group = np.searchsorted(cuts, values, side="right")
    return [
        {"low": float(values[of].min()), "high": float(values[of].max()), **share_of(failed[of])}
        for of in (group == k for k in np.unique(group))
    ]
