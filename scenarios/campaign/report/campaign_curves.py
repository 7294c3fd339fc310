"""A campaign's summary -> what its tables and figures list."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from scenarios.campaign.results.table import Summary
from scenarios.campaign.statistics.inference import ALPHA


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
