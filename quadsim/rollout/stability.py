"""Whether a scenario's loop is stable: `quadsim.rollout.growth` with ordinary flights, and the line before a flight."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from quadsim.errors import InputError
from quadsim.rollout.growth import LONGEST_PAIR, SHORT_PAIR, SIZE, Growth, grown
from quadsim.rollout.rollout import started_plain
from quadsim.scenarios.assembly import Assembly
from quadsim.scenarios.mismatch import Unmodelled, unmodelled, worst_heading
from quadsim.scenarios.schema.scenario import Scenario


def measure_growth(
    scenario: Scenario,
    *,
    heading: float = 0.0,
    size: float = SIZE,
    changes: Mapping[str, Any] | None = None,
    longest: float = LONGEST_PAIR,
) -> Growth:
    """Return how the difference of a pair of hovers grows; see `quadsim.rollout.growth.grown`.

    Raises:
        InputError: a changed field is not allowed, or the parts cannot be built.
    """
    return grown(scenario, started_plain, heading=heading, size=size, changes=changes, longest=longest)


def instability_notes(assembly: Assembly) -> tuple[str, ...]:
    """Return a line where a loop is unstable with what its scenario states and its controller's model lacks.

    One pair is flown for some seconds at the worst stated point: the largest heading that the course holds, and the
    plant as it is.  Where the model lacks nothing, nothing is flown.
    """
    lacking = unmodelled(assembly)
    if not lacking:
        return ()
    try:
        result = measure_growth(assembly.scenario, heading=worst_heading(assembly), longest=SHORT_PAIR)
    except InputError:  # the flight itself will say what does not fit
        return ()
    if not result.notable:
        return ()
    return (_instability_note(assembly.scenario, lacking, result),)


def _instability_note(scenario: Scenario, lacking: tuple[Unmodelled, ...], result: Growth) -> str:
    """Say what grows, with what, and which fields let the model have it."""
    if result.ended or not result.rate > 0.0:
        grows = f"a hover ends {result.ended}"
    else:
        grows = f"a push grows {math.exp(result.rate):.3g}-fold a second"
    stated = ", ".join(entry.text for entry in lacking)
    remedies = "; ".join(entry.remedy for entry in lacking if entry.remedy)
    note = f"unstable: {grows} with what the model of {scenario.controller.type} lacks: {stated}; to try: {remedies}"
    if any(entry.quantity == "heading" for entry in lacking):
        note += "; stable up to: quadsim stability ... --heading 0 --over heading"
    return note
