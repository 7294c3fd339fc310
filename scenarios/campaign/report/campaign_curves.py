"""A campaign -> what is drawn of it, on a page and on paper alike."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import pyarrow as pa

from quadsim.state import Array
from scenarios.campaign.results.table import Summary, numbers, unit_of, verdicts
from scenarios.campaign.results.verdicts import VERDICTS
from scenarios.campaign.statistics.inference import ALPHA
from scenarios.campaign.statistics.scatters import lowest_shown, robust_ends
from scenarios.campaign.statistics.wording import label

MAIN_METRICS: Final = (
    "worst_margin",
    *(f"rmse.{name}" for name in ("x", "y", "z", "yaw")),
    "peak_tilt",
    "total_variation",
    "fallback_periods",
)
"""What a reader of a campaign looks for first."""
_BINS: Final = 40


@dataclass(frozen=True, kw_only=True)
class Histogram:
    """How a metric is distributed, by verdict."""

    name: str  # the metric
    label: str  # its name, with its unit and what is not shown in its place
    edges: Array  # (B + 1,) ends of the bins
    counts: dict[str, Array]  # flights in each bin, (B,), by verdict


def histograms(table: pa.Table) -> list[Histogram]:
    """The main metrics that differ between flights."""
    by_verdict = verdicts(table)
    found = []
    for name in MAIN_METRICS:
        values = numbers(table, name)
        finite = values[np.isfinite(values)]
        if finite.size < 2 or np.ptp(finite) == 0.0:
            continue
        least = lowest_shown(finite) if name == "worst_margin" else -np.inf
        edges = _edges(finite, least, whole=pa.types.is_integer(table.schema.field(name).type))
        inside = np.clip(values, edges[0], edges[-1])
        counts = {
            v: np.histogram(inside[of & np.isfinite(values)], edges)[0].astype(float) for v, of in by_verdict.items()
        }
        beyond = int(np.count_nonzero((finite < edges[0]) | (finite > edges[-1])))
        parts = f"; {beyond} beyond, in the end bars" if beyond else ""
        found.append(Histogram(name=name, label=label(name, unit_of(table, name)) + parts, edges=edges, counts=counts))
    return found


def drivers(summary: Summary) -> dict[str, Mapping[str, Any]]:
    """The entries of the varied parameters on which an outcome may depend at all, the strongest first.

    They are ordered by how `worst_margin` depends on them, or else `failed`.
    """
    related = {
        name: found for name, found in summary["parameters"].items() if found.get("worst_margin") or found.get("failed")
    }

    def weakness(parameter: tuple[str, Mapping[str, Any]]) -> tuple[float, float]:
        found = parameter[1]["worst_margin"] or parameter[1]["failed"]
        return min(found["p_holm"], found["p_xi_holm"]), -max(abs(found["rho"]), found["xi"])

    return dict(sorted(related.items(), key=weakness))


def sure_splits(summary: Summary) -> Iterator[tuple[str, str, str, Mapping[str, Any]]]:
    """Event, varied parameter, its unit and its threshold, of those beyond chance: by event, the surest first."""
    found = summary["parameters"]
    events = dict.fromkeys(event for parameter in found.values() for event in parameter.get("splits", {}))
    for event in events:
        parts = [
            (parameter["splits"][event]["p_there"], name)
            for name, parameter in found.items()
            if parameter.get("splits", {}).get(event, {"p_holm": 1.0})["p_holm"] < ALPHA
        ]
        for _, name in sorted(parts):
            yield event, name, found[name]["unit"], found[name]["splits"][event]


def converging(summary: Summary) -> dict[str, str]:
    """The events whose shares are drawn over n, with the headings of their panels; two that are the same are one."""
    curves = summary["convergence"]
    if curves["failure"] == curves["violation"]:
        return {"failure": "failed flights, the same as violations [%]"}
    return {"failure": "failed flights [%]", "violation": "violations [%]"}


def convergence_range(summary: Summary, events: Sequence[str]) -> tuple[float, float]:
    """Ends of the axis of shares [%]: those of the intervals of the last nine tenths of all flights."""
    curves = summary["convergence"]
    n = np.asarray(curves["flights"], float)
    settled = n >= 0.1 * n[-1]
    highest = max(float(np.max(np.asarray(curves[event]["upper"])[settled])) for event in events)
    lowest = min(float(np.min(np.asarray(curves[event]["lower"])[settled])) for event in events)
    room = 0.08 * (highest - lowest)
    return 100.0 * max(lowest - room, -0.02 * (highest - lowest)), 100.0 * min(highest + room, 1.0 + 0.25 * room)


def present(table: pa.Table) -> list[str]:
    """The verdicts that occur."""
    found = verdicts(table)
    return [verdict for verdict in VERDICTS if found[verdict].any()]


def _edges(values: Array, least: float, *, whole: bool) -> Array:
    """Bins of one width over the values, without the few that are far out; 0 is an edge where it is among them."""
    low, high = robust_ends(values)
    low = max(low, least)
    bins = min(_BINS, max(8, int(2.0 * np.sqrt(values.size))))
    if whole:
        width = max(1.0, np.ceil((high - low + 1.0) / bins))
        return np.arange(np.floor(low) - 0.5, high + width, width)
    width = (high - low) / bins
    first, last = np.floor(low / width), np.ceil(high / width)
    return np.asarray(width * np.arange(first, last + 1.0), float)
