"""`[controller] type = "robust"`: the MPC for vehicles as they are, each part a field of its own."""

from __future__ import annotations

from typing import Annotated, Final, Literal

from pydantic import Discriminator, Field, Tag, model_validator

from mpc.robust.observer import ObserverSettings
from mpc.robust.tightening import SHORTEST_LAG, TighteningSettings
from scenarios.schema.base import NonNegative, Positive, Spec
from scenarios.schema.fallback import FallbackSpec
from scenarios.schema.optimisation import BoundedSpec, SoftSpec, Weight

_OBSERVER: Final = ObserverSettings()
_TIGHTENING: Final = TighteningSettings()

Seconds = Annotated[float, Field(ge=0.0, le=10.0)]


def _number_or_text(value: object) -> str:
    return "text" if isinstance(value, str) else "number"


Lag = Annotated[
    Annotated[Seconds, Tag("number")] | Annotated[Literal["vehicle"], Tag("text")], Discriminator(_number_or_text)
]
"""A time constant, or that of the vehicle file."""


class OffsetFreeSpec(Spec):
    """Unmodelled force and torque: estimated, predicted and compensated."""

    velocity_noise: Positive = Field(default=_OBSERVER.velocity_noise, description="[m/s] of a measured velocity")
    rate_noise: Positive = Field(default=_OBSERVER.rate_noise, description="[rad/s] of a measured body rate")
    velocity_walk: Positive = Field(
        default=_OBSERVER.velocity_walk, description="[m/s] change of a velocity in a period that is no lasting force"
    )
    rate_walk: Positive = Field(default=_OBSERVER.rate_walk, description="[rad/s] the same of a body rate")
    force_walk: Positive = Field(
        default=_OBSERVER.force_walk, description="[m/s^2] change of the force's acceleration in a period"
    )
    torque_walk: Positive = Field(
        default=_OBSERVER.torque_walk, description="[rad/s^2] change of the torque's angular acceleration in a period"
    )
    largest_force: Positive = Field(default=_OBSERVER.largest_force, description="[m/s^2] larger estimates are clipped")
    largest_torque: Positive = Field(
        default=_OBSERVER.largest_torque, description="[rad/s^2] larger estimates are clipped"
    )


class TighteningSpec(Spec):
    """Output bounds tightened, so that they hold under disturbances within stated bounds, and between samples."""

    acceleration: NonNegative = Field(
        default=_TIGHTENING.acceleration,
        description="[m/s^2] bound on a disturbance's acceleration along each axis, world frame",
    )
    angular_acceleration: NonNegative = Field(
        default=_TIGHTENING.angular_acceleration, description="[rad/s^2] the same of angular ones, body frame"
    )
    turning: NonNegative = Field(
        default=_TIGHTENING.turning,
        description="[unit of the state/s^2, rad for angles] largest second derivative of an output at its bound",
    )


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
    offset_free: OffsetFreeSpec | None = None
    tightening: TighteningSpec | None = None
    heading: bool = Field(default=False, description="whether the hover model is turned by the present yaw")
    largest_turn: Annotated[float, Field(gt=0.0, le=180.0)] = Field(
        default=30.0,
        description="[deg] how far it is asked to turn at once, from the present yaw or from one period to the next",
    )
    move_weight: Weight | None = Field(
        default=None, description="[1/(rad/s)^2] diagonal of Q_d, of a command's change from one period to the next"
    )
    linearisation: Literal["hover", "state", "trajectory"] = Field(
        default="hover",
        description="where the model is linearised: at hover, once; at the present state; or along the last plan, one "
        "step of sequential quadratic programming each period",
    )
    fallback: FallbackSpec = FallbackSpec()

    @model_validator(mode="after")
    def _check(self) -> RobustSpec:
        if self.rotor_lag != "vehicle" and 0.0 < self.rotor_lag < SHORTEST_LAG:
            raise ValueError(f"rotor_lag must be 0, or at least {SHORTEST_LAG:g} s; got {self.rotor_lag:g}")
        if self.tightening is not None and not self.output_bounds:
            raise ValueError("tightening must be absent where there are no output_bounds to tighten")
        if self.terminal is not None and self.linearisation != "hover":
            raise ValueError(f'terminal must be absent where linearisation is not "hover"; got {self.terminal!r}')
        for polytope in self.polytopes:
            turned = [name for name in polytope.of if name in ("x", "vx", "y", "vy")]
            if turned and self.heading and self.linearisation == "hover":
                raise ValueError(
                    f"polytopes: {polytope.name} must not be of {', '.join(turned)} where heading turns the hover "
                    'model: heading = false, or linearisation = "trajectory"'
                )
        return self
