"""What is drawn of a tuning: candidates, importance, and the pairs of fresh flights, as arrays."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import pyarrow as pa

from quadsim.report.palette import BOUND, LINES, REFERENCE
from quadsim.state import Array
from scenarios.campaign.statistics.wording import label
from scenarios.tuning.objective import parse_expression
from scenarios.tuning.spec import START

Summary = Mapping[str, Any]
KINDS: Final = {
    "dropped early": REFERENCE,
    "too many failures": BOUND,
    "flew all draws": LINES[0],
    "best": LINES[1],
    "start": LINES[2],
}
"""Kinds of candidate with their colours, in the order in which they are drawn."""
_FAR: Final = 3.0  # of the median over the best: candidates farther out are at the edge of the drawing


@dataclass(frozen=True, kw_only=True)
class Candidates:
    """The candidates of one kind in the first drawing."""

    kind: str
    numbers: list[int]
    x: Array  # the second objective, or the candidates' numbers
    y: Array  # the first objective


def candidates(summary: Summary) -> list[Candidates]:
    """The candidates that completed a flight, by kind."""
    two = len(summary["objectives"]) == 2
    of: dict[str, list[Mapping[str, Any]]] = {kind: [] for kind in KINDS}
    for each in summary["candidates"]:
        if each["completed"]:
            of[_kind(each, summary)].append(each)
    return [
        Candidates(
            kind=kind,
            numbers=[each["candidate"] for each in found],
            x=np.array([each["values"][1] if two else each["candidate"] for each in found], float),
            y=np.array([each["values"][0] for each in found], float),
        )
        for kind, found in of.items()
        if found
    ]


def ends(drawn: Sequence[Candidates], axis: str) -> tuple[float, float]:
    """The range of an axis that shows what matters: far candidates are beyond."""
    values = np.concatenate([getattr(each, axis) for each in drawn])
    low, middle = float(values.min()), float(np.median(values))
    high = min(float(values.max()), low + _FAR * max(middle - low, 1e-12))
    known = [float(value) for each in drawn if each.kind in ("start", "best") for value in getattr(each, axis)]
    high = max([high, *known])
    room = 0.06 * (high - low or abs(high) or 1.0)
    return low - room, high + room


def front(summary: Summary) -> tuple[Array, Array]:
    """The Pareto front as a line: second objective, first objective."""
    there = {each["candidate"]: each["values"] for each in summary["candidates"]}
    points = np.array([there[candidate] for candidate in summary["front"]], float).reshape(
        -1, len(summary["objectives"])
    )
    order = np.argsort(points[:, -1])
    return points[order, -1], points[order, 0]


def axis_labels(summary: Summary) -> tuple[str, str]:
    """Of the first drawing: horizontal and vertical."""
    names = [label(f"{each['name']}, {each['statistic']}", each["unit"]) for each in summary["objectives"]]
    return (names[1] if len(names) == 2 else "candidate"), names[0]


def pairs(summary: Summary, tables: Sequence[pa.Table], objective: int) -> tuple[Array, Array]:
    """An objective of the fresh flights that both completed: of the start, and of the answer."""
    expression = parse_expression(summary["objectives"][objective]["expression"])
    start, best = (
        np.array([expression.value(row) if row["status"] == "completed" else np.nan for row in table.to_pylist()])
        for table in tables
    )
    both = np.isfinite(start) & np.isfinite(best)
    return start[both], best[both]


def _kind(candidate: Mapping[str, Any], summary: Summary) -> str:
    if candidate["candidate"] == START:
        return "start"
    if candidate["candidate"] == summary["answer"]:
        return "best"
    if not candidate["feasible"]:
        return "too many failures"
    return "flew all draws" if candidate["flights"] == summary["draws"] else "dropped early"
