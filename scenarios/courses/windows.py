"""When corridors hold whose window is one of the reference's path."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from quadsim.space import Corridor, Fence
from scenarios.courses.make import build_reference

if TYPE_CHECKING:
    from scenarios.schema.scenario import Scenario


def timed_regions(scenario: Scenario) -> tuple[Corridor | Fence, ...]:
    """The corridors, each with a window of time, then the fence.

    The reference is known before the flight, and where it is along its path never falls: a window of the one is a
    window of the other.

    Raises:
        InputError: the reference's path is over before a window begins, or cannot be built.
    """
    regions = scenario.regions
    if all(isinstance(region, Fence) or region.path is None for region in regions):
        return regions
    reference = build_reference(scenario, scenario.periods + 1)[:, :3]
    t = scenario.control_period * np.arange(len(reference), dtype=np.float64)
    return tuple(region if isinstance(region, Fence) else region.timed(t, reference) for region in regions)
