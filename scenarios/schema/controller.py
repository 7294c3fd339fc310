"""`[controller]`: the law, its weights and its bounds."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from typing import Annotated, Any, Final, Literal

from pydantic import BeforeValidator, Discriminator, Field, Tag, ValidationError, model_validator
from pydantic_core import PydanticCustomError

from mpc.fallback.settings import FallbackSettings
from mpc.solvers import SOLVERS
from scenarios.schema.base import Spec
from scenarios.schema.baselines import GeometricSpec, LQRSpec, PIDSpec
from scenarios.schema.nonlinear import NonlinearSpec as NonlinearSpec
from scenarios.schema.optimisation import BoundedSpec, WeightedSpec, require_solver
from scenarios.schema.plugin import FORM, LAWS, PluginSpec, is_plugin
from scenarios.schema.problems import ScenarioError, describe_all
from scenarios.schema.robust import RobustSpec
from scenarios.schema.settings import set_field
from scenarios.schema.writing import is_absent


class UnconstrainedSpec(WeightedSpec):
    """The paper's unconstrained MPC, a constant gain (Sec. 4)."""

    type: Literal["unconstrained"] = Field(description="the control law, by its name in `quadsim list`")


class ConstrainedSpec(BoundedSpec):
    """The paper's constrained MPC, the optimum of a QP in every period (Sec. 5)."""

    type: Literal["constrained"] = Field(description="the control law, by its name in `quadsim list`")
    solver: str = Field(
        default="piqp-multistage",
        description="QP solver, by its name in `quadsim list`",
        json_schema_extra={"examples": [*SOLVERS]},
    )
    fallback: FallbackSettings | None = Field(
        default=None, description="absent: the last plan is held, shifted, and then the flight is given up"
    )

    @model_validator(mode="after")
    def _check(self) -> ConstrainedSpec:
        require_solver(self.solver)
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
    """A controller of which some fields have other values.

    Args:
        spec: the one before; of another, or of its own, `type` it is replaced whole.
        fields: values by dotted path; a table within changes what it names of the one there.

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
