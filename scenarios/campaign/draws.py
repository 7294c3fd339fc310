"""What is drawn for each flight of a campaign.

Each flight's own generator is seeded by `SeedSequence([campaign seed, flight])`, so that neither the number of flights
nor the worker matters; spread samplings take the points of `scipy.stats.qmc` in order instead.  Points in the unit
cube become values through the inverse of each distribution function.
"""

from __future__ import annotations

import math
import warnings
from typing import TYPE_CHECKING, Final, assert_never

import numpy as np
import scipy  # whose `stats` takes half a second to load, where it is first used

from quadsim.state import Array
from scenarios.campaign.spec import (
    ChoiceSpec,
    GridSpec,
    IntegerSpec,
    LogUniformSpec,
    NormalSpec,
    UniformSpec,
    Value,
    VaryBase,
    VarySpec,
)

if TYPE_CHECKING:
    from scenarios.campaign.spec import CampaignSpec

_TAIL: Final = 1e-3  # share of a distribution beyond the values taken as its ends


class Draws:
    """The drawn values of a campaign's flights; the same for the same file, in any process and order."""

    def __init__(self, spec: CampaignSpec) -> None:
        self._spec = spec
        self._spread = None if spec.sampling == "random" else _spread_points(spec)
        self._repeats = _repeats(spec)

    def seed(self, flight: int) -> int:
        """The seed of a flight's scenario, a whole number of 63 bits."""
        return int(self._sequence(flight).generate_state(1, np.uint64)[0] >> np.uint64(1))

    def values(self, flight: int) -> dict[str, Value]:
        """What is drawn for a flight, by the names of the entries of `[[vary]]`."""
        point = self._point(flight)
        return {
            entry.name: entry.values[flight // self._repeats[entry.name] % len(entry.values)]
            if isinstance(entry, GridSpec)
            else quantile(entry, share)
            for entry, share in zip(self._spec.vary, point, strict=True)
        }

    def _point(self, flight: int) -> list[float]:
        """A point of the unit cube, one coordinate per entry, those of grids unused."""
        if self._spread is None:
            child = self._sequence(flight).spawn(1)[0]
            return list(np.random.default_rng(child).random(len(self._spec.vary)).tolist())
        return list(self._spread[flight].tolist())

    def _sequence(self, flight: int) -> np.random.SeedSequence:
        return np.random.SeedSequence([self._spec.seed, flight])


def quantile(entry: VarySpec, share: float) -> Value:
    """The value below which a share, from 0 to less than 1, of a distribution lies; of a list, in its order."""
    match entry:
        case UniformSpec():
            return entry.low + (entry.high - entry.low) * share
        case LogUniformSpec():
            return float(entry.low * (entry.high / entry.low) ** share)
        case NormalSpec():
            low, high = ((end - entry.mean) / entry.deviation for end in entry.ends)
            return float(scipy.stats.truncnorm.ppf(share, low, high, loc=entry.mean, scale=entry.deviation))
        case IntegerSpec():
            return entry.low + int((entry.high - entry.low + 1) * share)
        case ChoiceSpec():
            edges = np.cumsum(entry.weights or [1.0] * len(entry.values))
            return entry.values[int(np.searchsorted(edges, share * edges[-1], side="right"))]
        case GridSpec():
            return entry.values[int(share * len(entry.values))]
        case _:
            assert_never(entry)


def extremes(entry: VaryBase) -> list[Value]:
    """The values at the ends of a distribution, or all of a list: if these can be flown, the others can."""
    match entry:
        case ChoiceSpec() | GridSpec():
            return list(entry.values)
        case NormalSpec():
            ends = zip(entry.ends, (_TAIL, 1.0 - _TAIL), strict=True)
            return [end if math.isfinite(end) else quantile(entry, share) for end, share in ends]
        case UniformSpec() | LogUniformSpec() | IntegerSpec():
            return [entry.low, entry.high]
        case _:
            raise AssertionError(f"{type(entry).__name__} has no ends")


def _spread_points(spec: CampaignSpec) -> Array:
    """(K, d) points that fill the unit cube evenly."""
    size = len(spec.vary)
    if not size:
        return np.empty((spec.flights, 0))
    qmc = scipy.stats.qmc
    kinds = {"latin_hypercube": qmc.LatinHypercube, "sobol": qmc.Sobol, "halton": qmc.Halton}
    sampler = kinds[spec.sampling](size, rng=np.random.default_rng(np.random.SeedSequence(spec.seed)))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # Sobol's points are balanced best in powers of two
        points: Array = sampler.random(spec.flights)
    return np.minimum(points, np.nextafter(1.0, 0.0))


def _repeats(spec: CampaignSpec) -> dict[str, int]:
    """For how many flights in a row each grid keeps its value."""
    repeats: dict[str, int] = {}
    repeat = 1
    for entry in reversed(spec.vary):
        if isinstance(entry, GridSpec):
            repeats[entry.name] = repeat
            repeat *= len(entry.values)
    return repeats
