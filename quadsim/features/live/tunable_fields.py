"""Controller fields that a user may change in flight, from their declarations."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

from quadsim.scenarios.schema.base import fields_of, is_table
from quadsim.scenarios.schema.controllers import AnyController
from quadsim.scenarios.schema.problems import Kind, kinds_of

FieldValue = float | int | bool | str | tuple[float, ...]

MAIN_FIELDS: Final = {
    "Tracking weights": {
        "output_weights.x": "x [1/m²]",
        "output_weights.y": "y [1/m²]",
        "output_weights.z": "z [1/m²]",
        "output_weights.yaw": "yaw [1/rad²]",
        "weights.position": "position [1/m²]",
        "weights.attitude": "attitude [1/rad²]",
        "weights.velocity": "velocity [s²/m²]",
    },
    "Effort weights [1/(rad/s)²]": {
        "input_weights.speed": "speeds u",
        "move_weight": "steps Δu",
        "weights.input": "input",
        "weights.move": "moves",
    },
    "Bounds": {
        "output_bounds.roll": "roll [deg]",
        "output_bounds.pitch": "pitch [deg]",
        "input_bounds.slew": "step Δu [rad/s]",
        "tilt": "tilt [deg]",
        "velocity": "velocity [m/s]",
    },
    "Robustness": {"soft.linear": "slack weight", "rotor_lag": "rotor lag [s]"},
    "Solver": {"horizon": "N [periods]", "iterations": "iterations"},
}
"""The fields that people change most, with their labels, by group; the rest are in "All fields"."""


@dataclass(frozen=True, kw_only=True)
class TunableField:
    """A field with its value."""

    path: str  # dotted, in `[controller]`
    value: FieldValue  # as it is
    about: str  # unit and meaning
    minimum: float | None = None  # of a number, or each of a pair; None for none
    maximum: float | None = None  # likewise
    choices: tuple[str, ...] = ()  # of a text


def tunable_fields(spec: AnyController) -> tuple[TunableField, ...]:
    """Return the fields of a controller, except its type, long lists and settings of user-defined controllers."""
    fields = _fields("", spec, (Kind(type=type(spec)),), "")
    return tuple(field for field in fields if field.path != "type")


def _fields(path: str, value: Any, kinds: Sequence[Kind], about: str) -> Iterator[TunableField]:
    """Yield the fields of a value at a path, which is of one of some kinds; `about` is what the path is about."""
    if is_table(type(value)):
        for name, field in fields_of(type(value)).items():
            inner = kinds_of(field.annotation, tuple(field.metadata))
            yield from _fields(_below(path, name), getattr(value, name), inner, field.description or about)
    elif isinstance(value, Mapping):
        for name, entry in value.items():
            yield from _fields(_below(path, name), entry, _kinds_of_entries(kinds), about)
    elif isinstance(value, str):
        choices = [str(choice) for kind in kinds for choice in kind.choices]
        if len(choices) > 1:  # else there is nothing to choose
            yield TunableField(path=path, value=value, about=about, choices=tuple(choices))
    elif isinstance(value, int | float):
        yield from _number(path, value, kinds, about)
    elif isinstance(value, list | tuple) and len(value) == 2 and all(isinstance(n, int | float) for n in value):
        first, second = value
        yield from _number(path, (float(first), float(second)), _kinds_of_entries(kinds), about)


def _below(path: str, name: str) -> str:
    if path:
        return f"{path}.{name}"
    return name


def _kinds_of_entries(kinds: Sequence[Kind]) -> list[Kind]:
    """Return the kinds that an entry of a table or list may have."""
    entries = list[Kind]()
    for kind in kinds:
        entries += kind.entries
    return entries


def _number(path: str, value: FieldValue, kinds: Sequence[Kind], about: str) -> Iterator[TunableField]:
    """Yield a field of a number or a pair, with its limits; nothing if its declaration is of no number."""
    for kind in kinds:
        if kind.type in (float, int, bool):
            low = kind.limits.get("ge", kind.limits.get("gt"))
            high = kind.limits.get("le", kind.limits.get("lt"))
            yield TunableField(path=path, value=value, about=about, minimum=low, maximum=high)
            return
    # else it is what a user's controller reads
