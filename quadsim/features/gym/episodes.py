"""The scenarios of an environment's episodes: one scenario with drawn seeds, or the drawn flights of a campaign.

`Episodes.draw` is called at each reset, by `environment.py` and `vector.py`; where something varies, `[set]` changes
the scenario, and a flight of the campaign gives the values of `[[vary]]`.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from quadsim.errors import ParameterError
from quadsim.features.entries import commands_of
from quadsim.scenarios.assembly import Assembly, preferring_core
from quadsim.scenarios.loading import load_scenario
from quadsim.scenarios.schema.base import LARGEST_WHOLE
from quadsim.scenarios.schema.scenario import Scenario
from quadsim.vehicle import Vehicle

Variation = str | Path | Sequence[Mapping[str, Any]]
"""A campaign's name or file, or entries as of its `[[vary]]`."""


@dataclass(frozen=True, kw_only=True)
class Episode:
    """What an episode flies.

    Attributes:
        scenario: the scenario, with its seed.
        flight: the number of the campaign's flight; None where nothing varies.
        draw: the values drawn, by the names of the campaign's entries.
    """

    scenario: Scenario
    flight: int | None
    draw: Mapping[str, Any]

    @property
    def info(self) -> dict[str, Any]:
        """What `info` has of it: `seed`; where something varies `flight` and `draw` too."""
        info: dict[str, Any] = {"seed": self.scenario.seed}
        if self.flight is not None:
            info |= {"flight": self.flight, "draw": dict(self.draw)}
        return info


class Episodes:
    """Draws an environment's episodes.

    Attributes:
        base: the scenario that they vary: with the campaign's `[set]`, where there is one.
        varied: whether a campaign varies it.
    """

    def __init__(self, scenario: Scenario | str | Path, vary: Variation | None) -> None:
        """Load and check.

        Raises:
            InputError: the scenario cannot be loaded, or what varies it is wrong.
        """
        loaded: Scenario = preferring_core(load_scenario(scenario))
        self._plan: Any = None
        if vary is not None:
            if isinstance(vary, str | Path):
                vary = str(vary)
            elif isinstance(vary, Mapping) or not isinstance(vary, Iterable):
                rule = "a campaign's name or file, or a list of tables as of its [[vary]]"
                raise ParameterError("", "vary", vary, rule)
            self._plan = commands_of("campaign").drawn_flights(loaded, vary)
            loaded = self._plan.scenario
        self.base = loaded
        self.varied = self._plan is not None

    def check_seed(self, seed: object) -> None:
        """Refuse what is no seed.

        Raises:
            ParameterError: it is not a whole number from 0 on.
        """
        if not (isinstance(seed, int | np.integer) and 0 <= seed <= LARGEST_WHOLE):
            raise ParameterError("", "seed", seed, f"from 0 to {LARGEST_WHOLE}")

    def draw(self, seed: int | None, options: Mapping[str, Any], rng: np.random.Generator) -> Episode:
        """Return the episode that starts.

        Args:
            seed: the scenario's, where nothing varies; None: drawn.
            options: `flight`, the number of the campaign's flight; drawn where absent.
            rng: the environment's own generator.

        Raises:
            ParameterError: an option is not allowed.
        """
        if self._plan is None:
            if options:
                raise ParameterError("", "options", dict(options), "absent where nothing varies")
            if seed is None:
                seed = int(rng.integers(2**31))
            else:
                seed = int(seed)
            return Episode(scenario=self.base.altered(seed=seed), flight=None, draw={})
        flights = self._plan.spec.flights
        if "flight" in options:
            flight = options["flight"]
        else:
            flight = int(rng.integers(flights))
        if set(options) - {"flight"} or not (isinstance(flight, int | np.integer) and 0 <= flight < flights):
            raise ParameterError("", "options", dict(options), f"absent, or a flight from 0 to {flights - 1}")
        return self.of_flight(int(flight))

    def of_flight(self, flight: int) -> Episode:
        """Return the episode of a flight of the campaign."""
        assert self._plan is not None
        return Episode(scenario=self._plan.of(flight), flight=flight, draw=self._plan.draws.values(flight))

    def assembly(self, scenario: Scenario) -> Assembly:
        """Return the parts of an episode, with the bounds of a user's controller where a campaign varies it."""
        vehicle = None
        if scenario.vehicle == self.base.vehicle and scenario.recorded == self.base.recorded:
            vehicle = self._vehicle  # its file is read once
        assembly = Assembly(scenario, vehicle)
        if self.varied:
            return assembly.audited()
        return assembly

    @cached_property
    def _vehicle(self) -> Vehicle:
        return Assembly(self.base).vehicle
