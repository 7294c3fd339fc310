"""`[controller]` of the laws to compare an MPC with; every field has a default."""

from __future__ import annotations

from typing import Annotated, Literal

from annotated_types import Len
from pydantic import Field, model_validator

from mpc.baselines.preview import PREVIEW_DEGREE, SMALLEST_PREVIEW
from mpc.disturbance import RampSettings
from mpc.indi import INDISettings
from quadsim.fields import NonNegative, Positive, Weight
from scenarios.schema.base import LARGEST_HORIZON, Spec
from scenarios.schema.optimisation import InputBoundsSpec, InputWeightsSpec, require_states

Tilt = Annotated[float, Field(ge=0.1, le=80.0)]


class _BaselineSpec(Spec):
    horizon: Annotated[int, Field(ge=SMALLEST_PREVIEW, le=LARGEST_HORIZON)] = Field(
        default=10, description="[periods] N, of the reference ahead, which give its velocity and acceleration"
    )
    input_bounds: InputBoundsSpec | None = Field(
        default=None,
        description="what commands are held to; absent: the speeds that the vehicle's rotors hold, and any step",
    )


class LQRSpec(_BaselineSpec):
    """LQR over an infinite horizon on the hover model."""

    type: Literal["lqr"] = Field(description="the control law, by its name in `quadsim list`")
    output_weights: Annotated[dict[str, Weight], Len(1)] | None = Field(
        default=None,
        description="diagonal of Q_y [1/unit of the state^2, rad for angles], of states by their names; "
        "absent: Bryson's rule for all twelve and the inputs",
    )
    input_weights: InputWeightsSpec | None = Field(
        default=None, description="[1/(rad/s)^2] diagonal of Q_u; given where output_weights are"
    )
    heading: bool = Field(default=True, description="whether errors are turned into axes along the present yaw")
    tilt: Tilt = Field(default=30.0, description="[deg] largest tilt commanded for position errors")

    @model_validator(mode="after")
    def _check(self) -> LQRSpec:
        if (self.output_weights is None) != (self.input_weights is None):
            raise ValueError("input_weights must be given where output_weights are, and nowhere else")
        require_states(self.output_weights or {}, "output_weights")
        return self


class _TunedSpec(_BaselineSpec):
    lag: NonNegative | None = Field(
        default=None,
        description="[s] lag of rotors and computer that gains allow for; absent: the vehicle's, or half a period",
    )
    tilt: Tilt = Field(default=45.0, description="[deg] largest tilt commanded")


class PIDSpec(_TunedSpec):
    """Cascaded PID as autopilots fly it."""

    type: Literal["pid"] = Field(description="the control law, by its name in `quadsim list`")
    velocity: Positive = Field(default=12.0, description="[m/s] largest velocity commanded")


class GeometricSpec(_TunedSpec):
    """Geometric tracking on SE(3)."""

    type: Literal["geometric"] = Field(description="the control law, by its name in `quadsim list`")
    integral: bool = Field(default=False, description="whether position and attitude errors are integrated")
    feedforward: bool = Field(
        default=False,
        description="whether the reference's jerk and snap are fed forward, and drag, by differential flatness",
    )
    drag: Annotated[list[NonNegative], Len(3, 3)] = Field(
        default=[0.0, 0.0, 0.0], description="[1/s] linear drag along body x, y, z that feedforward takes into account"
    )
    disturbance: RampSettings | None = Field(default=None, description="absent: what the model misses is not observed")
    indi: INDISettings | None = Field(default=None, description="absent: rotors hold the commands for a period")

    @model_validator(mode="after")
    def _check(self) -> GeometricSpec:
        if any(self.drag) and not self.feedforward:
            raise ValueError(f"drag must be zero where feedforward is not true; got {self.drag}")
        if self.feedforward and self.horizon <= PREVIEW_DEGREE:
            raise ValueError(
                f"horizon must be at least {PREVIEW_DEGREE + 1} where feedforward is true; got {self.horizon}"
            )
        return self
