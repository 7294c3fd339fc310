"""`[controller]`: the law, its weights and its bounds."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from typing import Annotated, Any, Final, Literal

from annotated_types import Len, MaxLen
from pydantic import BeforeValidator, Discriminator, Field, Tag, ValidationError, model_validator
from pydantic_core import PydanticCustomError

from mpc.disturbance import RampSettings
from mpc.fallback.settings import FallbackSettings
from mpc.indi import INDISettings
from mpc.nonlinear.settings import Weights
from mpc.observer import ObserverSettings
from mpc.qp import KKT_EVERY
from mpc.robust.tightening import SHORTEST_LAG
from mpc.solvers import CORE_OR_PIQP, SOLVERS
from quadsim.controller import CORE
from quadsim.fields import NonNegative, Positive
from scenarios.schema.base import MOST_ENTRIES, Horizon, Lag, Pair, Spec, require_ordered
from scenarios.schema.baselines import GeometricSpec, LQRSpec, PIDSpec
from scenarios.schema.optimisation import (
    AvoidanceSpec,
    BoundedSpec,
    KktEvery,
    PolytopeSpec,
    RotorBoundsSpec,
    SoftSpec,
    WeightedSpec,
    require_solver,
)
from scenarios.schema.plugin import FORM, LAWS, PluginSpec, is_plugin
from scenarios.schema.problems import ScenarioError, describe_all
from scenarios.schema.robust import RobustSpec
from scenarios.schema.settings import set_field
from scenarios.schema.writing import is_absent

LINEAR: Final = ("x", "vx", "y", "vy", "z", "vz")  # states that are so of the quaternion model too
Terminal = NonNegative | Literal["none", "lqr"]
NonNegativeTriple = Annotated[list[NonNegative], Len(3, 3)]
PositiveTriple = Annotated[list[Positive], Len(3, 3)]


class UnconstrainedSpec(WeightedSpec):
    """The paper's unconstrained MPC, a constant gain (Sec. 4)."""

    type: Literal["unconstrained"] = Field(description="the control law, by its name in `quadsim list`")


class ConstrainedSpec(BoundedSpec):
    """The paper's constrained MPC, the optimum of a QP in every period (Sec. 5)."""

    type: Literal["constrained"] = Field(description="the control law, by its name in `quadsim list`")
    fallback: FallbackSettings | None = Field(
        default=None, description="absent: the last plan is held, shifted, and then the flight is given up"
    )


class NonlinearSpec(Spec):
    """Nonlinear MPC at any attitude: steps of sequential quadratic programming in every period."""

    type: Literal["nonlinear"] = Field(description="the control law, by its name in `quadsim list`")
    horizon: Horizon = Field(default=20, description="[periods] how far it looks ahead, a whole number of nodes")
    node: Positive | None = Field(
        default=None, description="[s] from one node to the next, whole periods; absent: one period"
    )
    iterations: Annotated[int, Field(ge=1, le=100)] = Field(
        default=1, description="most steps of sequential quadratic programming in a period; 1: the real-time iteration"
    )
    shift: bool | None = Field(
        default=None, description="whether the last plan is shifted by a node; absent: where a node is one period"
    )
    substeps: Annotated[int, Field(ge=1, le=100)] = Field(default=1, description="Runge-Kutta steps per node")
    inputs: Literal["thrust", "speed"] = Field(
        default="thrust", description="what the inputs are, as shares of the rotors' largest"
    )
    weights: Weights = Weights()
    attitude_error: Literal["error-state", "difference"] = Field(
        default="error-state",
        description="error-state: twice the vector part of q_r* q, the angle to first order; difference: the four "
        "components of q - q_r",
    )
    terminal: Terminal = Field(
        default="none", description="weight of the last node: none, lqr, or a factor on that of the others"
    )
    rotor_lag: Lag = Field(
        default=0.0,
        description='[s] time constant by which rotors follow that is predicted, 0 for none; "vehicle": its rotor_rise',
    )
    drag: NonNegativeTriple = Field(
        default=[0.0, 0.0, 0.0], description="[N s/m] linear drag that is predicted, along body x, y, z"
    )
    quadratic_drag: NonNegativeTriple = Field(
        default=[0.0, 0.0, 0.0], description="[N s^2/m^2] the same, of each component's square"
    )
    output_bounds: dict[str, Pair] = Field(
        default={}, description="[m, m/s] lower and upper bound, of positions and velocities by their states' names"
    )
    tilt: Annotated[float, Field(gt=0.0, lt=90.0)] | None = Field(
        default=None, description="[deg] largest angle between thrust axis and vertical; absent: no bound"
    )
    body_rate: Positive | PositiveTriple | None = Field(
        default=None, description="[deg/s] largest magnitude, one or about body x, y, z; absent: no bound"
    )
    soft: SoftSpec | None = Field(default=None, description="of the three above; absent: hard")
    avoidance: AvoidanceSpec | None = Field(
        default=None, description="absent: it knows of no obstacles, corridors or fence, which are audited all the same"
    )
    polytopes: Annotated[list[PolytopeSpec], MaxLen(MOST_ENTRIES)] = Field(
        default=[], description="bounds on sums of positions, velocities and, as inputs, rotor speeds; audited as well"
    )
    offset_free: ObserverSettings | None = None
    disturbance: RampSettings | None = Field(
        default=None, description="absent: no drag is fitted, no changing force followed; not beside offset_free"
    )
    indi: INDISettings | None = Field(default=None, description="absent: rotors hold the commands for a period")
    input_bounds: RotorBoundsSpec = RotorBoundsSpec()
    fallback: FallbackSettings = FallbackSettings()
    kkt_every: KktEvery = Field(
        default=KKT_EVERY,
        description="[periods] from one whose KKT residuals are computed and logged to the next; 1: all",
    )
    solver: str | None = Field(
        default=None,
        description="QP solver, by its name in `quadsim list`; absent: the fastest for the size",
        json_schema_extra={"examples": [*SOLVERS]},
    )

    @model_validator(mode="after")
    def _check(self) -> NonlinearSpec:
        if self.solver is not None:
            require_solver(self.solver)
            if self.solver in (CORE, CORE_OR_PIQP):
                rule = "a QP solver: the core takes no models that change"
                raise ValueError(f"solver must be {rule}; got {self.solver!r}")
        if self.rotor_lag != "vehicle" and 0.0 < self.rotor_lag < SHORTEST_LAG:
            raise ValueError(f"rotor_lag must be 0, or at least {SHORTEST_LAG:g} s; got {self.rotor_lag:g}")
        if self.attitude_error == "difference" and not isinstance(self.weights.attitude, float):
            raise ValueError(
                f'weights.attitude must be one number where attitude_error = "difference"; got {self.weights.attitude}'
            )
        if self.offset_free is not None and self.disturbance is not None:
            raise ValueError("disturbance must be absent where offset_free is given: both estimate the same force")
        for name, pair in self.output_bounds.items():
            if name not in LINEAR:
                raise ValueError(
                    f"output_bounds must be of {', '.join(LINEAR)}; got {name!r}: tilt bounds the attitude"
                )
            require_ordered(f"output_bounds.{name}", pair)
        if self.inputs == "thrust" and self.input_bounds.slew is not None:
            raise ValueError(
                'input_bounds.slew must be absent where inputs = "thrust", in which steps of speeds are not linear: '
                f'inputs = "speed"; got {self.input_bounds.slew}'
            )
        return self


COMPILED: Final = ("unconstrained", "constrained", "robust")


def _law(controller: object) -> str | None:
    """Which of the laws below a table is of; anything else is left for the message."""
    given = controller.get("type") if isinstance(controller, Mapping) else getattr(controller, "type", None)
    if not isinstance(given, str):
        return None
    return given if given in LAWS or not is_plugin(given) else FORM


def _spelt_out(controller: Any) -> Any:
    """A law's name alone as its table."""
    if isinstance(controller, str):
        return {"type": controller}
    if not isinstance(
        controller, Mapping | WeightedSpec | NonlinearSpec | LQRSpec | PIDSpec | GeometricSpec | PluginSpec
    ):
        raise PydanticCustomError("controller", "a table or a controller's name")
    if isinstance(controller, Mapping) and "compiled" in controller:
        law, value = controller.get("type"), controller["compiled"]
        if law in LAWS and law not in COMPILED:
            rule = f"absent for {law}: only MPC with fixed matrices ({', '.join(COMPILED)}) can be compiled"
            raise ValueError(f"compiled must be {rule}; got {value!r}")
    return controller


_Table = Annotated[
    Annotated[UnconstrainedSpec, Tag("unconstrained")]
    | Annotated[ConstrainedSpec, Tag("constrained")]
    | Annotated[RobustSpec, Tag("robust")]
    | Annotated[NonlinearSpec, Tag("nonlinear")]
    | Annotated[LQRSpec, Tag("lqr")]
    | Annotated[PIDSpec, Tag("pid")]
    | Annotated[GeometricSpec, Tag("geometric")]
    | Annotated[PluginSpec, Tag(FORM)],
    Discriminator(_law),
]
ControllerSpec = Annotated[_Table, BeforeValidator(_spelt_out, json_schema_input_type=_Table | str)]
"""Any of the laws, distinguished by its type; one whose fields all have defaults may be given by its name alone."""


class _Holder(Spec):
    """A table that has a controller, for messages to name it."""

    controller: ControllerSpec


def changed(spec: ControllerSpec, fields: Mapping[str, Any]) -> ControllerSpec:
    """A controller of which some fields, by dotted path, have other values; with a `type` it is replaced whole.

    Raises:
        ScenarioError: a field is not there, or its value is not allowed.
    """
    data: dict[str, Any] = {} if "type" in fields else _plain(spec.model_dump(mode="json"))
    for path, value in _leaves(fields):
        set_field(data, path, value, source="fields")
    found = {"controller": data}
    try:
        return _Holder.model_validate_json(json.dumps(found)).controller
    except ValidationError as error:
        raise ScenarioError("controller", describe_all(error, found, _Holder)) from error


def _leaves(fields: Mapping[str, Any], above: str = "") -> Iterator[tuple[str, Any]]:
    for name, value in fields.items():
        if isinstance(value, Mapping) and value:
            yield from _leaves(value, f"{above}{name}.")
        else:
            yield above + name, value


def _plain(value: Any) -> Any:
    """Tables without what is left out of a file."""
    if isinstance(value, dict):
        return {name: _plain(each) for name, each in value.items() if not is_absent(each)}
    return [_plain(each) for each in value] if isinstance(value, list) else value
