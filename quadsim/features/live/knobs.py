"""Controller fields that a user may change in flight, from their declarations."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

from quadsim.scenarios.schema.base import fields_of, is_table
from quadsim.scenarios.schema.controllers import AnyController
from quadsim.scenarios.schema.problems import Kind, kinds_of

KnobValue = float | int | bool | str | tuple[float, ...]

TURNED_FIELDS: Final = {
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
"""The fields that people turn, with their labels, by group; the rest are in "All fields"."""


@dataclass(frozen=True, kw_only=True)
class Knob:
    """A field with its value."""

    path: str  # dotted, in `[controller]`
    value: KnobValue  # as it is
    about: str  # unit and meaning
    minimum: float | None = None  # of a number, or each of a pair; None for none
    maximum: float | None = None  # likewise
    choices: tuple[str, ...] = ()  # of a text


def knobs(spec: AnyController) -> tuple[Knob, ...]:
    """Return the fields of a controller, except its type, long lists and settings of user-defined controllers."""
    return tuple(knob for knob in _walk("", spec, (Kind(type=type(spec)),), "") if knob.path != "type")


def _walk(path: str, value: Any, kinds: Sequence[Kind], about: str) -> Iterator[Knob]:
    below = f"{path}." if path else ""
    entries = [entry for kind in kinds for entry in kind.entries]
    pair = isinstance(value, list | tuple) and len(value) == 2 and all(isinstance(n, int | float) for n in value)
    if is_table(type(value)):
        for name, field in fields_of(type(value)).items():
            inner = kinds_of(field.annotation, tuple(field.metadata))
            yield from _walk(f"{below}{name}", getattr(value, name), inner, field.description or about)
    elif isinstance(value, Mapping):
        for name, entry in value.items():
            yield from _walk(f"{below}{name}", entry, entries, about)
    elif isinstance(value, str):
        choices = tuple(str(choice) for kind in kinds for choice in kind.choices)
        if len(choices) > 1:  # else there is nothing to choose
            yield Knob(path=path, value=value, about=about, choices=choices)
    elif pair or isinstance(value, int | float):
        numbers = entries if pair else kinds
        limits = next((kind.limits for kind in numbers if kind.type in (float, int, bool)), None)
        if limits is not None:  # else it is what a user's controller reads
            low, high = (limits.get(inside, limits.get(beyond)) for inside, beyond in (("ge", "gt"), ("le", "lt")))
            turned = tuple(map(float, value)) if pair else value
            yield Knob(path=path, value=turned, about=about, minimum=low, maximum=high)
