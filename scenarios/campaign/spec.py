"""The campaign file: a scenario, what varies, how many flights, and what counts as failure."""

from __future__ import annotations

import math
from typing import Annotated, Any, Final, Literal

from annotated_types import MaxLen, MinLen
from pydantic import Field, model_validator

from quadsim.errors import InputError
from quadsim.fields import Positive
from scenarios.campaign.distributions import GridSpec, VarySpec
from scenarios.campaign.results.events import parse_event
from scenarios.schema.base import LARGEST_SEED, MOST_ENTRIES, Spec
from scenarios.schema.writing import to_toml

MOST_FLIGHTS: Final = 1_000_000


Sampling = Literal["random", "latin_hypercube", "sobol", "halton"]


class LimitsSpec(Spec):
    """What one flight may take before it is ended, as a result with the verdict `timeout` or `memory`."""

    flight: Positive = Field(default=600.0, description="[s] wall clock of a flight")
    step: Positive = Field(default=60.0, description="[s] wall clock of a control period, with its controller's step")
    memory: Annotated[float, Field(ge=100.0, le=1e9)] = Field(
        default=2000.0, description="[MB] of the flight's process, with whatever it starts"
    )


class CampaignSpec(Spec):
    """Many flights of one scenario."""

    name: Annotated[str, Field(pattern=r"^[a-z0-9][a-z0-9._-]*$", max_length=80)] = Field(
        description="letters a-z, digits and . _ -; names the campaign's directory"
    )
    description: str = Field(default="", description="one line")
    scenario: str = Field(description="a library name, or a path ending in .toml")
    set: dict[str, Any] = Field(
        default={}, description="a part of a scenario file, merged over the scenario field by field"
    )
    flights: Annotated[int, Field(ge=1, le=MOST_FLIGHTS)] = Field(description="how many")
    seed: Annotated[int, Field(ge=0, le=LARGEST_SEED)] = Field(
        default=0, description="of all draws, and of the seed of each flight"
    )
    sampling: Sampling = Field(
        default="random",
        description="how numbers are drawn: random (each flight by itself), or spread evenly over all that varies: "
        "latin_hypercube, sobol, halton",
    )
    failure: Annotated[list[str], MinLen(1), MaxLen(MOST_ENTRIES)] = Field(
        default=["violated"],
        description="a flight fails when any of these events happens: lost, violated, crashed, error, timeout, memory, "
        "or a column of the results compared with a number, e.g. rmse.z > 0.5",
    )
    limits: LimitsSpec = LimitsSpec()
    vary: Annotated[list[VarySpec], MaxLen(MOST_ENTRIES)] = Field(default=[], description="what varies")

    @model_validator(mode="after")
    def _check(self) -> CampaignSpec:
        names = [entry.name for entry in self.vary]
        if len(set(names)) < len(names):
            raise ValueError(f"vary must have distinct names; got {names}")
        self._check_fields()
        grids = [entry.name for entry in self.vary if isinstance(entry, GridSpec)]
        if grids and self.sampling in ("sobol", "halton"):
            rule = (
                f"random or latin_hypercube where there are grids ({', '.join(grids)}), whose turns go with its points"
            )
            raise ValueError(f"sampling must be {rule}; got {self.sampling!r}")
        cells = self.cells
        if self.flights % cells:
            rule = f"a multiple of the {cells} combinations of its grids"
            raise ValueError(f"flights must be {rule}; got {self.flights}")
        for text in self.failure:
            try:
                if parse_event(text).text == "failure":
                    raise InputError("failure is what this list defines")
            except InputError as error:
                raise ValueError(f"failure has an entry {text!r} that is no event: {error}") from error
        return self

    def _check_fields(self) -> None:
        """Refuse fields that two entries draw, and those that are not for drawing."""
        owners: dict[str, str] = {}
        for entry in self.vary:
            for field in entry.fields:
                if field == "seed":
                    raise ValueError(f"vary.{entry.name}.fields must not have seed: every flight has one of its own")
                if field.split(".")[-1] == "name":
                    raise ValueError(f"vary.{entry.name}.fields must not have {field}: results are identified by names")
                if field in owners:
                    raise ValueError(f"vary.{entry.name}.fields must not have {field}, which {owners[field]} draws")
                owners[field] = entry.name

    @property
    def cells(self) -> int:
        """Combinations that the grids make; 1 without any."""
        return math.prod(len(entry.values) for entry in self.vary if isinstance(entry, GridSpec))

    def to_toml(self) -> str:
        """The file with every field, defaults included; reading it gives this campaign again."""
        return to_toml(self)
