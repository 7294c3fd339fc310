"""`controller = "my_package.my_module:MyController"`: a plug-in controller, by the location of its code."""

from __future__ import annotations

import re
from collections.abc import Mapping
from importlib import metadata
from pathlib import Path
from typing import Any, Final

from pydantic import Field, model_validator

from quadsim.fields import is_plain
from scenarios.schema.base import Horizon, Spec

FORM: Final = "package.module:Class"  # what the text that names a controller looks like
ENTRY_POINTS: Final = "quadsim.controllers"
"""The group under which installed packages announce controllers by short names."""
GIVEN: Final = ("vehicle", "period", "horizon")  # arguments that every controller is called with
LAWS: Final = ("unconstrained", "constrained", "robust", "nonlinear", "lqr", "pid", "geometric")
"""The names of built-in controllers."""
_NAME: Final = r"[^\W\d]\w*(?:\.[^\W\d]\w*)*"


class _CodeSpec(Spec):
    type: str = Field(description="its code, as package.module:name")
    folder: str | None = Field(
        default=None,
        description="where its module is looked for first, from the scenario file; absent: beside that",
    )
    settings: dict[str, Any] = Field(default={}, description="what else it is called with, by the arguments' names")


class PluginSpec(_CodeSpec):
    """A controller of one's own, called as MyController(vehicle, period=..., horizon=..., **settings)."""

    type: str = Field(
        description="its code, as package.module:Class, or its name among the entry points quadsim.controllers",
        json_schema_extra={"not": {"enum": [*LAWS]}},
    )
    horizon: Horizon = Field(default=50, description="[periods] N, samples of the reference that a step is given")

    @model_validator(mode="after")
    def _check(self) -> PluginSpec:
        _check_code(self.type, self.settings, GIVEN)
        return self


class ForceSpec(_CodeSpec):
    """A force of one's own, called once per physics step; see `quadsim.sim.effects.Force`.

    A function force(time, state, **settings), or a class called as MyForce(vehicle, rng=..., **settings).
    """

    @model_validator(mode="after")
    def _check(self) -> ForceSpec:
        if ":" not in self.type:
            raise ValueError(f"type must be of the form {FORM}; got {self.type!r}")
        _check_code(self.type, self.settings, ("vehicle", "rng", "time", "state"))
        return self


def _check_code(place: str, settings: Mapping[str, Any], given: tuple[str, ...]) -> None:
    """Refuse a place that is none, and settings that are no arguments or cannot be written."""
    if ":" in place and not re.fullmatch(f"{_NAME}:{_NAME}", place):
        raise ValueError(f"type must be of the form {FORM}; got {place!r}")
    for name, value in settings.items():
        if not name.isidentifier() or name in given:
            raise ValueError(f"settings.{name} must be named as an argument is, other than {', '.join(given)}")
        if not is_plain(value):
            rule = "a finite number, a text, true or false, or a list or table of them"
            raise ValueError(f"settings.{name} must be {rule}; got {value}")


def is_plugin(name: str) -> bool:
    """Whether a text names code, or an entry point that there is."""
    return ":" in name or name in metadata.entry_points(group=ENTRY_POINTS).names


def located(controller: Any, beside: Path) -> Any:
    """A `[controller]` as a file gives it, its folder made independent of the file's, `beside`.

    That is its folder too, where none is given and the module is there.
    """
    table = {"type": controller} if isinstance(controller, str) else controller
    name = table.get("type") if isinstance(table, Mapping) else None
    if not isinstance(name, str) or ":" not in name:
        return controller
    given = table.get("folder")
    if isinstance(given, str) and (beside / given).is_dir():
        return {**table, "folder": str((beside / given).resolve())}
    first = beside / name.partition(":")[0].partition(".")[0]
    found = "folder" not in table and (first.is_dir() or first.with_suffix(".py").is_file())
    return {**table, "folder": str(beside.resolve())} if found else controller
