"""`[controller]`: the law, its weights and its bounds."""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from typing import Annotated, Final, Literal

from annotated_types import Len
from pydantic import Discriminator, Field, Tag, model_validator

from mpc.solvers import SOLVERS
from quadsim.errors import UnknownNameError
from quadsim.state import STATE_NAMES, STATE_UNITS
from scenarios.spec.base import Pair, Spec, require_ordered

LARGEST_HORIZON: Final = 1000
ANGLES: Final = frozenset(name for name, unit in zip(STATE_NAMES, STATE_UNITS, strict=True) if unit.startswith("rad"))
"""States that scenario files give in degrees (per second)."""

Weight = Annotated[float, Field(gt=0.0, le=1e12)]


def _number_or_list(value: object) -> str:
    return "list" if isinstance(value, list) else "number"


Weights = Annotated[
    Annotated[Weight, Tag("number")] | Annotated[list[Weight], Len(4, 4), Tag("list")], Discriminator(_number_or_list)
]
"""One weight for all rotors, or one each."""


class InputWeightsSpec(Spec):
    """Diagonal of Q_u."""

    speed: Weights


class InputBoundsSpec(Spec):
    """Hard bounds on the rotor speeds and their steps, for every rotor."""

    speed: Pair = Field(description="u_min, u_max [rad/s].  Eq. (20)")
    slew: Pair = Field(description="delta_min, delta_max [rad/s per period].  Eq. (15)")

    @model_validator(mode="after")
    def _check(self) -> InputBoundsSpec:
        require_ordered("speed", self.speed)
        require_ordered("slew", self.slew)
        if self.speed[0] < 0.0:
            raise ValueError(f"speed must have a lower bound >= 0 rad/s; got {self.speed}")
        if not self.slew[0] <= 0.0 <= self.slew[1]:
            raise ValueError(f"slew must allow a speed to be held, so contain 0; got {self.slew}")
        return self


def _known_states(values: Mapping[str, object], name: str) -> None:
    for key in values:
        if key not in STATE_NAMES:
            near = difflib.get_close_matches(key, STATE_NAMES, n=1)
            guess = f"; did you mean {near[0]!r}?" if near else ""
            raise ValueError(f"{name}.{key} is not a state{guess} (there are: {', '.join(STATE_NAMES)})")


class _ControllerSpec(Spec):
    horizon: Annotated[int, Field(ge=1, le=LARGEST_HORIZON, description="N, control periods")]
    output_weights: Annotated[dict[str, Weight], Len(1)] = Field(description="C_r by its keys, diagonal of Q_y")
    input_weights: InputWeightsSpec

    @model_validator(mode="after")
    def _check_outputs(self) -> _ControllerSpec:
        _known_states(self.output_weights, "output_weights")
        return self


class UnconstrainedSpec(_ControllerSpec):
    """The paper's Sec. 4."""

    type: Literal["unconstrained"]


class ConstrainedSpec(_ControllerSpec):
    """The paper's Sec. 5."""

    type: Literal["constrained"]
    solver: str = Field(default="piqp-multistage", description="a name from `quadsim list`")
    shortcut: bool = Field(
        default=True, description="take the unconstrained optimum where no constraint bars it; exact"
    )
    output_bounds: dict[str, Pair] = Field(default={}, description="C_c by its keys; deg for angles, deg/s for rates")
    input_bounds: InputBoundsSpec

    @model_validator(mode="after")
    def _check(self) -> ConstrainedSpec:
        _known_states(self.output_bounds, "output_bounds")
        for name, pair in self.output_bounds.items():
            require_ordered(f"output_bounds.{name}", pair)
        if self.solver not in SOLVERS:
            raise ValueError(f"solver: {UnknownNameError('solver', self.solver, SOLVERS)}")
        return self
