"""`[controller] type = "robust"`: the MPC for vehicles as they are, each part a field of its own."""

from __future__ import annotations

from typing import Annotated, Final, Literal

from pydantic import Field, model_validator

from mpc.fallback.settings import FallbackSettings
from mpc.observer import ObserverSettings
from mpc.robust.tightening import SHORTEST_LAG, TighteningSettings
from quadsim.fields import Weight
from scenarios.schema.base import Lag, Seconds
from scenarios.schema.optimisation import BoundedSpec, SoftSpec

TURNED: Final = frozenset({"x", "vx", "y", "vy", "yaw"})  # states that have other values in axes turned by the yaw


class RobustSpec(BoundedSpec):
    """The robust MPC: `constrained`, and beside it whatever of the parts below is given."""

    type: Literal["robust"] = Field(description="the control law, by its name in `quadsim list`")
    soft: SoftSpec | None = None
    rotor_lag: Lag = Field(
        default=0.0,
        description="[s] time constant of the rotor speeds that is predicted, 0 for none; "
        '"vehicle": the rotor_rise of the vehicle',
    )
    delay: Seconds = Field(
        default=0.0, description="[s] known time from measurement to command that is predicted through"
    )
    offset_free: ObserverSettings | None = None
    tightening: TighteningSettings | None = None
    heading: bool = Field(default=False, description="whether the hover model is turned by the present yaw")
    largest_turn: Annotated[float, Field(gt=0.0, le=180.0)] = Field(
        default=30.0,
        description="[deg] largest step of the yaw reference, from the present yaw or from one period to the next",
    )
    move_weight: Weight | None = Field(
        default=None, description="[1/(rad/s)^2] diagonal of Q_d, of a command's change from one period to the next"
    )
    fallback: FallbackSettings = FallbackSettings()

    @model_validator(mode="after")
    def _check(self) -> RobustSpec:
        if self.rotor_lag != "vehicle" and 0.0 < self.rotor_lag < SHORTEST_LAG:
            raise ValueError(f"rotor_lag must be 0, or at least {SHORTEST_LAG:g} s; got {self.rotor_lag:g}")
        if self.tightening is not None and not self.output_bounds:
            raise ValueError("tightening must be absent where there are no output_bounds to tighten")
        if self.heading:
            bounded = {"output_bounds": [*self.output_bounds], **{each.name: each.of for each in self.polytopes}}
            for name, states in bounded.items():
                turned = [state for state in states if state in TURNED]
                if turned:
                    raise ValueError(
                        f"{name} must not be of {', '.join(turned)} where heading turns the model: "
                        'heading = false, or type = "nonlinear"'
                    )
        return self
