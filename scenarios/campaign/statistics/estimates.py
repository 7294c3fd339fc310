"""A campaign's table -> `summary.json`: how often, how well, what drives it, and how sure that is."""

from __future__ import annotations

import math
from typing import Any, Final

import numpy as np
import pyarrow as pa

from quadsim.errors import ParameterError
from scenarios.campaign.results.events import EVENT_NAMES, parse_event
from scenarios.campaign.results.table import (
    DRAW,
    MARGIN,
    SATISFIED,
    constraint_names,
    draw_names,
    flags,
    metric_names,
    numbers,
    texts,
    unit_of,
    verdicts,
)
from scenarios.campaign.results.verdicts import VERDICTS
from scenarios.campaign.statistics.drivers import parameters
from scenarios.campaign.statistics.inference import CONFIDENCE, lower_bounds, share_of, upper_bounds

WORST_FLIGHTS: Final = 10
_CURVE_POINTS: Final = 80


def estimate(table: pa.Table) -> dict[str, Any]:
    """Everything a campaign's summary says of its flights, as plain data for JSON.

    Keys: `flights`; `confidence` of every interval; `verdicts`, flights of each; `events` and `constraints`, by name,
    as proportions (`inference.Proportion`), a constraint's being that it did not hold or was not
    reached; `metrics`, over the flights that have each; `parameters`, how the outcome goes with each drawn parameter
    (`drivers.parameters`); `worst`, the ten worst flights; `convergence` of the shares of failure and
    violation over the first n flights.
    """
    return {
        "flights": table.num_rows,
        "confidence": CONFIDENCE,
        "verdicts": {verdict: int(found.sum()) for verdict, found in verdicts(table).items()},
        "events": {name: share_of(parse_event(name).column(table)) for name in EVENT_NAMES},
        "metrics": {name: _metric(table, name) for name in metric_names(table)},
        "constraints": {name: _constraint(table, name) for name in constraint_names(table)},
        "parameters": parameters(table),
        "worst": [_flight(table, int(i)) for i in ranking(table)[:WORST_FLIGHTS]],
        "convergence": _convergence(table),
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

    Lost flights come before those that raised, these before those that met a limit of time or memory, and these before
    violated and satisfied ones; among these, failed ones come
    first, then the smaller worst margin.  Flights without a margin come after those with one, by their RMS error in
    position, the largest first.  What is still equal is in the order of the flights' numbers.
    """
    known = {name: verdict.badness for name, verdict in VERDICTS.items()}
    badness = np.array([known.get(name, max(known.values())) for name in texts(table, "verdict")], int)
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
        return found | dict.fromkeys(("mean", "sd", "min", "p5", "p50", "p95", "p99", "max"))
    percentiles = np.percentile(values, [5, 50, 95, 99]).tolist()
    return found | {
        "mean": float(values.mean()),
        "sd": float(values.std(ddof=1)) if values.size > 1 else None,
        "min": float(values.min()),
        **dict(zip(("p5", "p50", "p95", "p99"), percentiles, strict=True)),
        "max": float(values.max()),
    }


def _constraint(table: pa.Table, name: str) -> dict[str, Any]:
    margin = numbers(table, MARGIN + name)
    found: dict[str, Any] = {
        "unit": unit_of(table, MARGIN + name),
        "not_satisfied": share_of(~flags(table, SATISFIED + name, absent=False)),
        "worst_margin": None,
        "worst_flight": None,
    }
    if np.isfinite(margin).any():
        row = int(np.nanargmin(margin))
        found |= {"worst_margin": float(margin[row]), "worst_flight": table["flight"][row].as_py()}
    return found


def _flight(table: pa.Table, row: int) -> dict[str, Any]:
    shown = ("flight", "verdict", "failed", "worst_margin", "worst_constraint", "duration", "reason")
    values = table.slice(row, 1).to_pylist()[0]
    margin = values["worst_margin"]
    if margin is not None and not math.isfinite(margin):
        values["worst_margin"] = None
    return {name: values[name] for name in shown} | {"draws": {name: values[DRAW + name] for name in draw_names(table)}}


def _convergence(table: pa.Table) -> dict[str, Any]:
    """Shares over the first n flights, n evenly spread on a logarithmic scale."""
    total = table.num_rows
    n = np.unique(np.round(np.geomspace(1.0, total, _CURVE_POINTS)).astype(int)) if total else np.empty(0, int)
    either = 0.5 * (1.0 + CONFIDENCE)
    found: dict[str, Any] = {"flights": n.tolist()}
    for name in ("failure", "violation"):
        counts = np.cumsum(parse_event(name).column(table))[n - 1]
        found[name] = {
            "share": (counts / n).tolist(),
            "lower": lower_bounds(counts, n, either).tolist(),
            "upper": upper_bounds(counts, n, either).tolist(),
        }
    return found
