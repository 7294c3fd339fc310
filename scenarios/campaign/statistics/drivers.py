"""What was drawn for the flights -> what goes with their outcome, how, and how sure that is."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict
from typing import Any, Final

import numpy as np
import pyarrow as pa

from quadsim.state import Array
from scenarios.campaign.results.events import Flags, parse_event
from scenarios.campaign.results.table import DRAW, draw_names, flags, is_number, numbers, texts, unit_of, verdicts
from scenarios.campaign.statistics.dependence import any_dependence, rank_correlation, trend
from scenarios.campaign.statistics.inference import holm, share_of
from scenarios.campaign.statistics.scatters import margin_ends
from scenarios.campaign.statistics.splits import best_splits

SPLIT_EVENTS: Final = ("failure", "violation", "lost")
"""Events for which a threshold is looked for, where they are not the same flights as an earlier one's."""
_GROUPS: Final = ((50, 5), (12, 3))
"""Flights from which a drawn number's values are looked at in so many groups of about equal size."""


def parameters(table: pa.Table) -> dict[str, Any]:
    """What a campaign's summary says of each drawn parameter, as plain data for JSON.

    Of a number: its `unit`; under `worst_margin` and `failed` Spearman's `rho` with that outcome and Chatterjee's `xi`
    of that outcome, with their p-values `p` and `p_xi`; under `splits`, by event, the threshold that best tells the
    flights with the event (`splits.Split`); failures by `groups` of its values from the lowest on;
    under `turn`, where the course of the worst margin turns, `highest` or `lowest` at a value, or None.  All p-values
    of all parameters, outcomes and measures together are corrected by Holm's method: `p_holm`, `p_xi_holm`.
    Of what is drawn from names or truth values: the failures by level.
    """
    failed = flags(table, "failed", absent=True)
    names = draw_names(table)
    drawn = {name: numbers(table, DRAW + name) for name in names if is_number(table, DRAW + name)}
    found: dict[str, Any] = {name: _levels(table, name, failed) for name in names if name not in drawn}
    margin = ranked_margins(table)
    outcomes = {"worst_margin": margin, "failed": failed.astype(float)}
    splits = {event: best_splits(drawn, happened) for event, happened in _events(table)}
    for name, values in drawn.items():
        found[name] = {
            "kind": "number",
            "unit": unit_of(table, DRAW + name),
            **{outcome: _association(values, reached) for outcome, reached in outcomes.items()},
            "splits": {event: asdict(split) for event, of in splits.items() if (split := of[name]) is not None},
            "turn": _turn(values, margin),
            "groups": _groups(values, failed),
        }
    _correct(found)
    return {name: found[name] for name in names}


def ranked_margins(table: pa.Table) -> Array:
    """(K,) the worst margin of each flight for ranks: -inf of one that was lost before it had any, NaN of one without.

    Where no flight has a margin, all are NaN.
    """
    margin = numbers(table, "worst_margin")
    if np.isnan(margin).all():
        return margin
    return np.where(np.isnan(margin) & verdicts(table)["lost"], -np.inf, margin)


def _events(table: pa.Table) -> Iterator[tuple[str, Flags]]:
    distinct: list[Flags] = []
    for event in SPLIT_EVENTS:
        happened = parse_event(event).column(table)
        if not any(np.array_equal(happened, earlier) for earlier in distinct):
            distinct.append(happened)
            yield event, happened


def _association(values: Array, outcome: Array) -> dict[str, Any] | None:
    """Both measures of how an outcome goes with a drawn number; None where there is nothing to relate."""
    correlation = rank_correlation(values, outcome)
    dependence = any_dependence(values, outcome, np.random.default_rng(0))  # as every time
    if correlation is None or dependence is None:
        return None
    return asdict(correlation) | {"xi": dependence.xi, "p_xi": dependence.p}


def _correct(found: dict[str, Any]) -> None:
    """Put every p-value's correction for the number of all of them beside it, in place."""
    tests: list[tuple[dict[str, Any], str]] = []
    for parameter in found.values():
        for outcome in ("worst_margin", "failed"):
            if parameter.get(outcome):
                tests += [(parameter[outcome], "p"), (parameter[outcome], "p_xi")]
        tests += [(split, "p") for split in parameter.get("splits", {}).values()]
    for (entry, key), corrected in zip(tests, holm([entry[key] for entry, key in tests]), strict=True):
        entry[f"{key}_holm"] = corrected


def _turn(values: Array, margin: Array) -> dict[str, Any] | None:
    there = ~np.isnan(margin)
    if not np.isfinite(margin).any():
        return None
    course = trend(values[there], np.clip(margin[there], *margin_ends(margin)))
    if course is None or course.turn is None:
        return None
    kind, at = course.turn
    return {"kind": kind, "at": at}


def _levels(table: pa.Table, name: str, failed: Flags) -> dict[str, Any]:
    levels = texts(table, DRAW + name)
    shares = {level: share_of(failed[levels == level]) for level in sorted(set(levels))}
    return {"kind": "name", "unit": unit_of(table, DRAW + name), "levels": shares}


def _groups(values: Array, failed: Flags) -> list[dict[str, Any]]:
    """Failures by thirds or fifths of a drawn number, or by its values where these are no more; none of few flights."""
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
