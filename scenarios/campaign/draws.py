"""What is drawn for each flight of a campaign.

Each flight's own generator is seeded by `SeedSequence([campaign seed, flight])`, so that neither the number of flights
nor the worker matters; spread samplings take the points of `scipy.stats.qmc` in order instead.  Points in the unit
cube become values through the inverse of each distribution function.
"""

from __future__ import annotations

import warnings
from typing import TYPE_CHECKING

import numpy as np
import scipy

from quadsim.state import Array
from scenarios.campaign.spec import GridSpec, Value

if TYPE_CHECKING:
    from scenarios.campaign.spec import CampaignSpec


class Draws:
    """The drawn values of a campaign's flights; the same for the same file, in any process and order."""

    def __init__(self, spec: CampaignSpec) -> None:
        self._spec = spec
        self._spread = None if spec.sampling == "random" else _spread_points(spec)
        self._repeats: dict[str, int] = {}  # for how many flights in a row each grid keeps its value
        repeat = 1
        for entry in reversed(spec.vary):
            if isinstance(entry, GridSpec):
                self._repeats[entry.name] = repeat
                repeat *= len(entry.values)

    def seed(self, flight: int) -> int:
        """The seed of a flight's scenario, a whole number of 63 bits."""
        return int(self._sequence(flight).generate_state(1, np.uint64)[0] >> np.uint64(1))

    def values(self, flight: int) -> dict[str, Value]:
        """What is drawn for a flight, by the names of the entries of `[[vary]]`."""
        if self._spread is None:
            point = np.random.default_rng(self._sequence(flight).spawn(1)[0]).random(len(self._spec.vary))
        else:
            point = self._spread[flight]
        return {
            entry.name: entry.values[flight // self._repeats[entry.name] % len(entry.values)]
            if isinstance(entry, GridSpec)
            else entry.quantile(share)
            for entry, share in zip(self._spec.vary, point.tolist(), strict=True)
        }

    def _sequence(self, flight: int) -> np.random.SeedSequence:
        return np.random.SeedSequence([self._spec.seed, flight])


def _spread_points(spec: CampaignSpec) -> Array:
    """(K, d) points that fill the unit cube evenly."""
    if not spec.vary:
        return np.empty((spec.flights, 0))
    qmc = scipy.stats.qmc
    kinds = {"latin_hypercube": qmc.LatinHypercube, "sobol": qmc.Sobol, "halton": qmc.Halton}
    sampler = kinds[spec.sampling](len(spec.vary), rng=np.random.default_rng(np.random.SeedSequence(spec.seed)))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # Sobol's points are balanced best in powers of two
        points: Array = sampler.random(spec.flights)
    return np.minimum(points, np.nextafter(1.0, 0.0))
