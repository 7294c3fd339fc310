"""What all MPCs of `[controller]` have in common: horizon, weights and bounds."""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from typing import Annotated, Final

from annotated_types import Len
from pydantic import Discriminator, Field, Tag, model_validator

from quadsim.state import STATE_NAMES, STATE_UNITS
from scenarios.schema.base import Pair, Spec, require_ordered

LARGEST_HORIZON: Final = 1000
ANGLES: Final = frozenset(name for name, unit in zip(STATE_NAMES, STATE_UNITS, strict=True) if unit.startswith("rad"))
"""States that scenario files give in degrees (per second)."""

Weight = Annotated[float, Field(gt=0.0, le=1e12)]
Horizon = Annotated[int, Field(ge=1, le=LARGEST_HORIZON)]


def _number_or_list(value: object) -> str:
    return "list" if isinstance(value, list) else "number"


Weights = Annotated[
    Annotated[Weight, Tag("number")] | Annotated[list[Weight], Len(4, 4), Tag("list")], Discriminator(_number_or_list)
]
"""One weight for all rotors, or one each."""


class InputWeightsSpec(Spec):
    """What it costs to move the rotor speeds away from hover."""

    speed: Weights = Field(description="[1/(rad/s)^2] diagonal of Q_u: one weight for all rotors, or a list of four")


class InputBoundsSpec(Spec):
    """Hard bounds on the rotor speeds and their steps, for every rotor."""

    speed: Pair = Field(description="[rad/s] u_min, u_max of every rotor.  Eq. (20)")
    slew: Pair = Field(description="[rad/s per period] delta_min, delta_max of every rotor.  Eq. (15)")

    @model_validator(mode="after")
    def _check(self) -> InputBoundsSpec:
        require_ordered("speed", self.speed)
        require_ordered("slew", self.slew)
        if self.speed[0] < 0.0:
            raise ValueError(f"speed must have a lower bound >= 0 rad/s; got {self.speed}")
        if not self.slew[0] <= 0.0 <= self.slew[1]:
            raise ValueError(f"slew must allow a speed to be held, so contain 0; got {self.slew}")
        return self


class WeightedSpec(Spec):
    """A law that minimises a weighted sum over a horizon."""

    horizon: Horizon = Field(description="[periods] N, how far it looks ahead")
    output_weights: Annotated[dict[str, Weight], Len(1)] = Field(
        description="diagonal of Q_y [1/unit of the state^2, rad for angles]; the states named here are C_r"
    )
    input_weights: InputWeightsSpec

    @model_validator(mode="after")
    def _check_weights(self) -> WeightedSpec:
        require_states(self.output_weights, "output_weights")
        return self


class BoundedSpec(WeightedSpec):
    """One that also keeps bounds."""

    output_bounds: dict[str, Pair] = Field(
        default={}, description="[deg, deg/s, m, m/s] y_c_min, y_c_max; the states named here are C_c"
    )
    input_bounds: InputBoundsSpec

    @model_validator(mode="after")
    def _check_bounds(self) -> BoundedSpec:
        require_states(self.output_bounds, "output_bounds")
        for name, pair in self.output_bounds.items():
            require_ordered(f"output_bounds.{name}", pair)
        return self


def require_states(values: Mapping[str, object], name: str) -> None:
    """Refuse a table with an entry that is no state."""
    for key in values:
        if key not in STATE_NAMES:
            near = difflib.get_close_matches(key, STATE_NAMES, n=1)
            guess = f"; did you mean {near[0]!r}?" if near else ""
            raise ValueError(f"{name}.{key} is not a state{guess} (there are: {', '.join(STATE_NAMES)})")
