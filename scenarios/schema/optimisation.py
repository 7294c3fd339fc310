"""What all MPCs of `[controller]` have in common: horizon, weights and bounds."""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Final, Literal

from annotated_types import Len, MaxLen, doc
from pydantic import Field, model_validator

from mpc.obstacles import AvoidanceSettings
from mpc.qp import KKT_EVERY
from mpc.solvers import ALIASES, CORE_OR_PIQP, SOLVERS, find_solver
from quadsim.controller import CORE
from quadsim.errors import UnknownNameError
from quadsim.fields import NonNegative, Number, Weight
from quadsim.flight.audit import TERMS
from quadsim.state import STATE_NAMES, STATE_UNITS
from scenarios.schema.base import MOST_ENTRIES, Horizon, Pair, Spec, require_ordered

ANGLES: Final = frozenset(name for name, unit in zip(STATE_NAMES, STATE_UNITS, strict=True) if unit.startswith("rad"))
"""States that scenario files give in degrees (per second)."""

Weights = Weight | Annotated[list[Weight], Len(4, 4)]  # one weight for all rotors, or one each


KktEvery = Annotated[int, Field(ge=1)]


class InputWeightsSpec(Spec):
    """What it costs to move the rotor speeds away from hover."""

    speed: Weights = Field(description="[1/(rad/s)^2] diagonal of Q_u: one weight for all rotors, or a list of four")


class RotorBoundsSpec(Spec):
    """Hard bounds on the rotor speeds and their steps, for every rotor."""

    speed: Pair | None = Field(default=None, description="[rad/s] absent: what the vehicle's rotors hold")
    slew: Pair | None = Field(
        default=None, description='[rad/s per period] only where inputs = "speed"; absent: no bound'
    )

    @model_validator(mode="after")
    def _check(self) -> RotorBoundsSpec:
        if self.speed is not None:
            require_ordered("speed", self.speed)
            if self.speed[0] < 0.0:
                raise ValueError(f"speed must have a lower bound >= 0 rad/s; got {self.speed}")
        if self.slew is not None:
            require_ordered("slew", self.slew)
            if not self.slew[0] <= 0.0 <= self.slew[1]:
                raise ValueError(f"slew must allow a speed to be held, so contain 0; got {self.slew}")
        return self


class InputBoundsSpec(RotorBoundsSpec):
    """Hard bounds on the rotor speeds and their steps, for every rotor."""

    speed: Pair = Field(description="[rad/s] u_min, u_max of every rotor.  Eq. (20)")
    slew: Pair = Field(description="[rad/s per period] delta_min, delta_max of every rotor.  Eq. (15)")


class WeightedSpec(Spec):
    """A law that minimises a weighted sum over a horizon."""

    horizon: Horizon = Field(description="[periods] N, how far it looks ahead")
    output_weights: Annotated[dict[str, Weight], Len(1)] = Field(
        description="diagonal of Q_y [1/unit of the state^2, rad for angles]; the states named here are C_r"
    )
    input_weights: InputWeightsSpec

    terminal: Literal["lqr"] | None = Field(
        default=None,
        description="weight of the last predicted state: lqr, of the Riccati equation; absent: as of all others",
    )
    compiled: bool = Field(
        default=False,
        description="fly the whole law in C, by the compiled core, in place of Python's steps",
    )

    @model_validator(mode="after")
    def _check_weights(self) -> WeightedSpec:
        require_states(self.output_weights, "output_weights")
        return self


class SoftSpec(Spec):
    """What violating a soft bound by e costs: l1 e + l2 e^2."""

    linear: Annotated[float, Field(ge=0.0, le=1e12)] = Field(
        default=2e5,
        description="[1/unit; rad for angles of output_bounds, the row's unit of a polytope] l1: exact where it is "
        "above the multipliers that hard bounds would have, as 1e8 nearly always is; but what is nearly hard fights "
        "back as hard where the model errs",
    )
    quadratic: Annotated[float, Field(ge=0.0, le=1e12)] = Field(default=1e4, description="[1/unit^2] l2")


class PolytopeSpec(Spec):
    """Rows lower <= A v <= upper.

    Over states and rotor speeds: a geofence, a polytope of velocities, total thrust.  The flight is audited against the
    same rows, at the physics rate.
    """

    name: Annotated[str, Field(pattern=r"^[A-Za-z][A-Za-z0-9_-]*$")] = Field(
        description="what reports call it; of several rows name_1, name_2, ..."
    )
    of: Annotated[list[str], Len(1, len(TERMS))] = Field(
        description="v: states [m, m/s, deg, deg/s], speed_1 to speed_4 [rad/s]"
    )
    rows: Annotated[list[list[Number]], Len(1, MOST_ENTRIES)] = Field(description="A: one list of numbers per row")
    lower: list[Number] | None = Field(default=None, description="[unit of the row] one per row; absent: no bound")
    upper: list[Number] | None = Field(default=None, description="[unit of the row] one per row; absent: no bound")
    soft: SoftSpec | None = Field(default=None, description="absent: hard")
    tolerance: NonNegative = Field(default=0.0, description="[unit of the row] of the audit, at the physics rate")
    tolerance_sampled: NonNegative = Field(default=0.0, description="[unit of the row] of the audit, at the samples")
    required: bool = Field(default=True, description="false: measured and reported, never a failure")

    @model_validator(mode="after")
    def _check(self) -> PolytopeSpec:
        for name in self.of:
            if name not in TERMS:
                raise ValueError(f"of: {UnknownNameError('signal', name, TERMS)}")
        if len(set(self.of)) < len(self.of):
            raise ValueError(f"of must have distinct names; got {self.of}")
        for row in self.rows:
            if len(row) != len(self.of) or not any(row):
                raise ValueError(f"rows must be lists of {len(self.of)} numbers, not all 0; got {row}")
        if self.lower is None and self.upper is None:
            raise ValueError("lower must be given, or upper, or both")
        for side in ("lower", "upper"):
            bounds = getattr(self, side)
            if bounds is not None and len(bounds) != len(self.rows):
                raise ValueError(f"{side} must have one number per row, {len(self.rows)}; got {bounds}")
        if self.lower is not None and self.upper is not None:
            for below, above in zip(self.lower, self.upper, strict=True):
                if below >= above:
                    raise ValueError(f"lower must be below upper = {above}; got {below}")
        if self.tolerance_sampled > self.tolerance:
            raise ValueError(
                f"tolerance_sampled must be at most tolerance = {self.tolerance}; got {self.tolerance_sampled}"
            )
        return self

    @property
    def row_names(self) -> list[str]:
        """What the rows are called."""
        return [self.name] if len(self.rows) == 1 else [f"{self.name}_{i + 1}" for i in range(len(self.rows))]


@dataclass(frozen=True, kw_only=True)
class AvoidanceSpec(AvoidanceSettings):
    """Half-spaces that keep clear of obstacles, and within corridors and the fence."""

    soft: Annotated[SoftSpec | None, doc("[1/m, 1/m^2] what violating one costs; absent: hard")] = None


class BoundedSpec(WeightedSpec):
    """One that also keeps bounds."""

    output_bounds: dict[str, Pair] = Field(
        default={}, description="[deg, deg/s, m, m/s] y_c_min, y_c_max; the states named here are C_c"
    )
    input_bounds: InputBoundsSpec
    polytopes: Annotated[list[PolytopeSpec], MaxLen(MOST_ENTRIES)] = Field(
        default=[], description="further bounds on sums of states and rotor speeds; audited as well"
    )
    avoidance: AvoidanceSpec | None = Field(
        default=None, description="absent: it knows of no obstacles, corridors or fence, which are audited all the same"
    )
    solver: str = Field(
        default="piqp",
        description="who solves what the unconstrained optimum does not, by its name in `quadsim list`",
        json_schema_extra={"examples": [*ALIASES, *SOLVERS, CORE, CORE_OR_PIQP]},
    )
    kkt_every: KktEvery = Field(
        default=KKT_EVERY,
        description="[periods] from one whose KKT residuals are computed and logged to the next; 1: all",
    )

    @model_validator(mode="after")
    def _check_bounds(self) -> BoundedSpec:
        require_states(self.output_bounds, "output_bounds")
        for name, pair in self.output_bounds.items():
            require_ordered(f"output_bounds.{name}", pair)
        require_solver(self.solver)
        return self


def require_solver(name: str) -> None:
    """Refuse a solver that is not there."""
    try:
        find_solver(name)
    except UnknownNameError as error:
        raise ValueError(f"solver: {error}") from error


def require_states(values: Mapping[str, object], name: str) -> None:
    """Refuse a table with an entry that is no state."""
    for key in values:
        if key not in STATE_NAMES:
            near = difflib.get_close_matches(key, STATE_NAMES, n=1)
            guess = f"; did you mean {near[0]!r}?" if near else ""
            raise ValueError(f"{name}.{key} is not a state{guess} (there are: {', '.join(STATE_NAMES)})")
