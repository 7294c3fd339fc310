"""The campaign file: scenario, number of flights, varied fields, failure; and the draws of each flight.

Each flight's own generator is seeded by `SeedSequence([campaign seed, flight])`, so that neither the number of flights
nor the worker matters; spread samplings take the points of `scipy.stats.qmc` in order instead.  A coordinate u of a
point in the unit cube becomes the value x = F^-1(u), F the distribution function.  `plan` puts it into the scenario.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any, Final, Literal

import numpy as np
import scipy  # whose `stats` takes half a second to load, where it is first used
from annotated_types import Ge, Le, MaxLen, MinLen, doc
from pydantic import Field

from quadsim.errors import InputError
from quadsim.features.campaign.events import parse_event
from quadsim.fields import Number, Positive, Seconds
from quadsim.input_limits import MOST_ENTRIES
from quadsim.scenarios.schema.base import LARGEST_WHOLE
from quadsim.scenarios.schema.writing import to_toml
from quadsim.state import Array

WholeNumber = Annotated[int, Ge(-LARGEST_WHOLE), Le(LARGEST_WHOLE)]
Seed = Annotated[int, Ge(0), Le(LARGEST_WHOLE)]
Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_-]*$"), MaxLen(60)]
Unit = Annotated[str, MaxLen(20), doc("of the values, for tables and plots")]
Value = bool | WholeNumber | Number | str | list[Number]
"""Values of a list to draw from: any value of a scenario's field except tables."""
MOST_FLIGHTS: Final = 1_000_000
_TAIL: Final = 1e-3  # probability beyond the quantiles taken as the ends of an unbounded distribution
_MOST_DEVIATIONS: Final = 8.0  # from the mean to a range from which something is still drawn


@dataclass(frozen=True, kw_only=True)
class Varied:
    """Common fields of the entries of `[[vary]]`."""

    name: Annotated[Name, doc("letters, digits, _ and -; the column `draw.NAME` of the results")]
    fields: Annotated[
        list[str],
        MinLen(1),
        MaxLen(MOST_ENTRIES),
        doc(
            "dotted paths into the scenario that all get the drawn value, as for --set; an entry of a list by its "
            "name or index"
        ),
    ]
    unit: Unit = "-"
    relative: Annotated[bool, doc("whether the sampled value multiplies the scenario's own")] = False
    distribution: str

    def quantile(self, share: float) -> Value:
        """Return the quantile of a share from 0 to less than 1; for a list, in its order."""
        raise NotImplementedError

    def extremes(self) -> list[Value]:
        """Return the values at the ends of the range, or all values of a list: where these fly, so do the others."""
        raise NotImplementedError


@dataclass(frozen=True, kw_only=True)
class _Ranged(Varied):
    low: Number
    high: Number

    def __post_init__(self) -> None:
        _require_range(self.low, self.high)

    def extremes(self) -> list[Value]:
        return [self.low, self.high]


@dataclass(frozen=True, kw_only=True)
class Uniform(_Ranged):
    """Every value between two bounds is equally likely."""

    distribution: Literal["uniform"]

    def quantile(self, share: float) -> Value:
        """See `Varied`."""
        return self.low + (self.high - self.low) * share


@dataclass(frozen=True, kw_only=True)
class LogUniform(_Ranged):
    """The logarithm is uniform: every factor is equally likely."""

    distribution: Literal["log_uniform"]
    low: Positive
    high: Positive

    def quantile(self, share: float) -> Value:
        """See `Varied`."""
        return float(self.low * (self.high / self.low) ** share)


@dataclass(frozen=True, kw_only=True)
class Integer(_Ranged):
    """Every whole number between two bounds, both included, is equally likely."""

    distribution: Literal["integer"]
    low: WholeNumber
    high: WholeNumber

    def quantile(self, share: float) -> Value:
        """See `Varied`."""
        return self.low + int((self.high - self.low + 1) * share)


@dataclass(frozen=True, kw_only=True)
class Normal(Varied):
    """A normal distribution, truncated at `low` and `high`."""

    distribution: Literal["normal"]
    mean: Number
    deviation: Annotated[Positive, doc("standard deviation, before it is cut off")]
    low: Annotated[Number | None, doc("absent: no lower end")] = None
    high: Annotated[Number | None, doc("absent: no upper end")] = None

    def __post_init__(self) -> None:
        low, high = self._ends
        _require_range(low, high)
        reach = _MOST_DEVIATIONS * self.deviation
        if low > self.mean + reach or high < self.mean - reach:
            raise ValueError(
                f"mean must be within {_MOST_DEVIATIONS:g} standard deviations of the range {low:g} to {high:g}, or "
                f"nothing is ever drawn from there; got {self.mean:g} with deviation {self.deviation:g}"
            )

    @property
    def _ends(self) -> tuple[float, float]:
        """The ends of the range; infinite where there is none."""
        low = -math.inf
        high = math.inf
        if self.low is not None:
            low = self.low
        if self.high is not None:
            high = self.high
        return low, high

    def quantile(self, share: float) -> Value:
        """See `Varied`."""
        low, high = self._ends
        standard_low = (low - self.mean) / self.deviation
        standard_high = (high - self.mean) / self.deviation
        return float(scipy.stats.truncnorm.ppf(share, standard_low, standard_high, loc=self.mean, scale=self.deviation))

    def extremes(self) -> list[Value]:
        """See `Varied`."""
        low, high = self._ends
        return [
            low if math.isfinite(low) else self.quantile(_TAIL),
            high if math.isfinite(high) else self.quantile(1.0 - _TAIL),
        ]


@dataclass(frozen=True, kw_only=True)
class _Listed(Varied):
    values: Annotated[list[Value], MinLen(1), MaxLen(MOST_ENTRIES)]

    def __post_init__(self) -> None:
        kinds: set[type] = set()
        for value in self.values:
            if isinstance(value, bool | str | list):
                kinds.add(type(value))
            else:
                kinds.add(float)  # a whole number is of the same kind as any other
        if len(kinds) > 1:
            raise ValueError(f"values must all be of one kind; got {self.values}")
        distinct = set(map(str, self.values))
        if len(distinct) < len(self.values):
            raise ValueError(f"values must be distinct; got {self.values}")

    def extremes(self) -> list[Value]:
        return list(self.values)


@dataclass(frozen=True, kw_only=True)
class Choice(_Listed):
    """One of several values, with a weight each."""

    distribution: Literal["choice"]
    weights: Annotated[
        Annotated[list[Annotated[float, Ge(0.0), Le(1e6)]], MaxLen(MOST_ENTRIES)] | None,
        doc("one per value, of any sum; absent: all the same"),
    ] = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.weights is not None and len(self.weights) != len(self.values):
            raise ValueError(f"weights must be as many as values, {len(self.values)}; got {len(self.weights)}")
        if self.weights is not None and not sum(self.weights) > 0.0:
            raise ValueError(f"weights must not all be 0; got {self.weights}")

    def quantile(self, share: float) -> Value:
        """See `Varied`."""
        weights = self.weights or [1.0] * len(self.values)
        cumulative = np.cumsum(weights)
        place = np.searchsorted(cumulative, share * cumulative[-1], side="right")
        return self.values[int(place)]


@dataclass(frozen=True, kw_only=True)
class GridValues(_Listed):
    """Every value in turn; several grids give every combination, the last one changing fastest."""

    distribution: Literal["grid"]


Vary = Annotated[Uniform | LogUniform | Normal | Integer | Choice | GridValues, Field(discriminator="distribution")]


def _require_range(low: float, high: float) -> None:
    if not low < high:
        raise ValueError(f"low must be below high; got {low:g} and {high:g}")


def _require_separate_fields(entries: Sequence[Varied]) -> None:
    """Refuse fields that two entries replace, and fields that may not be replaced."""
    owners: dict[str, str] = {}
    for entry in entries:
        for path in entry.fields:
            refused = ""
            if path.split(".")[-1] == "name":
                refused = f"{path}: results are identified by names"
            elif path in owners:
                refused = f"{path}, which {owners[path]} draws"
            elif path == "seed":
                refused = "seed: every flight has one of its own"
            if refused:
                raise ValueError(f"vary.{entry.name}.fields must not have {refused}")
            owners[path] = entry.name


def _require_failure_event(text: str) -> None:
    """Refuse what cannot stand in the list `failure`: text that is no event, and failure itself."""
    try:
        if parse_event(text).text == "failure":
            raise InputError("failure is what this list defines")
    except InputError as error:
        raise ValueError(f"failure has an entry {text!r} that is no event: {error}") from None


@dataclass(frozen=True, kw_only=True)
class FlightLimits:
    """Limits of one flight; beyond them it ends with the verdict `timeout` or `memory`."""

    flight: Annotated[Seconds, doc("[s] wall clock of a flight")] = 600.0
    memory: Annotated[float, Ge(100.0), Le(1e9), doc("[MB] of the flight's process, beyond what it starts with")] = (
        2000.0
    )


@dataclass(frozen=True, kw_only=True)
class CampaignFile:
    """Many flights of one scenario."""

    name: Annotated[
        str,
        Field(pattern=r"^[a-z0-9][a-z0-9._-]*$"),
        MaxLen(80),
        doc("letters a-z, digits and . _ -; names the campaign's directory"),
    ]
    description: Annotated[str, doc("one line")] = ""
    scenario: Annotated[str, doc("a library name, or a path ending in .toml")]
    set: Annotated[dict[str, Any], doc("a part of a scenario file, merged over the scenario field by field")] = field(
        default_factory=dict
    )
    flights: Annotated[int, Ge(1), Le(MOST_FLIGHTS), doc("how many")]
    seed: Annotated[Seed, doc("of all draws, and of the seed of each flight")] = 0
    sampling: Annotated[
        Literal["random", "latin_hypercube", "sobol", "halton"],
        doc(
            "how numbers are drawn: random (each flight by itself), or spread evenly over all that varies: "
            "latin_hypercube, sobol, halton"
        ),
    ] = "random"
    failure: Annotated[
        list[str],
        MinLen(1),
        MaxLen(MOST_ENTRIES),
        doc(
            "a flight fails when any of these events happens: lost, violated, crashed, error, died, timeout, memory, "
            "or a column of the results compared with a number, e.g. rmse.z > 0.5"
        ),
    ] = field(default_factory=lambda: ["violated"])
    limits: FlightLimits = FlightLimits()
    vary: Annotated[list[Vary], MaxLen(MOST_ENTRIES), doc("what varies")] = field(default_factory=list)

    def __post_init__(self) -> None:
        names = [entry.name for entry in self.vary]
        if len(set(names)) < len(names):
            raise ValueError(f"vary must have distinct names; got {names}")
        _require_separate_fields(self.vary)
        grid_names = [grid.name for grid in self._grids]
        if grid_names and self.sampling in ("sobol", "halton"):
            grids = ", ".join(grid_names)
            rule = f"random or latin_hypercube where there are grids ({grids}), whose turns go with its points"
            raise ValueError(f"sampling must be {rule}; got {self.sampling!r}")
        if self.flights % self.cells:
            rule = f"a multiple of the {self.cells} combinations of its grids"
            raise ValueError(f"flights must be {rule}; got {self.flights}")
        for text in self.failure:
            _require_failure_event(text)

    @property
    def _grids(self) -> list[GridValues]:
        return [entry for entry in self.vary if isinstance(entry, GridValues)]

    @property
    def cells(self) -> int:
        """Number of combinations of the grids; 1 without any."""
        return math.prod(len(grid.values) for grid in self._grids)

    def to_toml(self) -> str:
        """Return the file with every field, defaults included; reading it gives this campaign."""
        return to_toml(self)


class Draws:
    """Drawn values of a campaign's flights; they depend only on the file, not on process or order."""

    def __init__(self, spec: CampaignFile) -> None:
        self._spec = spec
        if spec.sampling == "random":
            self._spread = None
        else:
            self._spread = _spread_points(spec)
        self._repeats: dict[str, int] = {}  # for how many flights in a row each grid keeps its value
        repeat = 1
        for entry in reversed(spec.vary):
            if isinstance(entry, GridValues):
                self._repeats[entry.name] = repeat
                repeat *= len(entry.values)

    def seed(self, flight: int) -> int:
        """Return the seed of a flight's scenario, a whole number of 63 bits."""
        return int(self._sequence(flight).generate_state(1, np.uint64)[0] >> np.uint64(1))

    def values(self, flight: int) -> dict[str, Value]:
        """Return the drawn values of a flight, by the names of the entries of `[[vary]]`."""
        if self._spread is None:
            (stream,) = self._sequence(flight).spawn(1)
            point = np.random.default_rng(stream).random(len(self._spec.vary))
        else:
            point = self._spread[flight]
        values: dict[str, Value] = {}
        for entry, share in zip(self._spec.vary, point.tolist(), strict=True):
            if isinstance(entry, GridValues):
                turn = flight // self._repeats[entry.name]
                values[entry.name] = entry.values[turn % len(entry.values)]
            else:
                values[entry.name] = entry.quantile(share)
        return values

    def _sequence(self, flight: int) -> np.random.SeedSequence:
        return np.random.SeedSequence([self._spec.seed, flight])


def _spread_points(spec: CampaignFile) -> Array:
    """(K, d) points that fill the unit cube evenly."""
    if not spec.vary:
        return np.empty((spec.flights, 0))
    qmc = scipy.stats.qmc
    samplers = {"latin_hypercube": qmc.LatinHypercube, "sobol": qmc.Sobol, "halton": qmc.Halton}
    rng = np.random.default_rng(np.random.SeedSequence(spec.seed))
    sampler = samplers[spec.sampling](len(spec.vary), rng=rng)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # Sobol's points are balanced best in powers of two
        points: Array = sampler.random(spec.flights)
    below_one = np.nextafter(1.0, 0.0)
    return np.minimum(points, below_one)
