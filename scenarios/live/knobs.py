"""The fields of a controller that a person may turn in flight, from the schema of scenario files."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any, Final

from scenarios.schema.controller import ControllerSpec
from scenarios.schema.json_schema import scenario_schema

LISTED: Final = 2  # longest list of numbers that is shown: pairs of bounds

Value = float | int | bool | str | tuple[float, ...]


@dataclass(frozen=True, kw_only=True)
class Knob:
    """A field with its value."""

    path: str  # dotted, in `[controller]`
    value: Value  # as it is
    about: str  # unit and meaning
    minimum: float | None = None  # of a number, or each of a pair; None for none
    maximum: float | None = None  # likewise
    choices: tuple[str, ...] = ()  # of a text


def knobs(spec: ControllerSpec) -> tuple[Knob, ...]:
    """Every field of a controller that has a value, but its type, lists of tables and what own code reads."""
    root = scenario_schema()
    schema = root["$defs"][type(spec).__name__]
    values = spec.model_dump(mode="json", exclude_none=True)
    return tuple(each for each in _walk("", values, schema, root) if each.path != "type")


def _walk(path: str, value: Any, schema: Mapping[str, Any], root: Mapping[str, Any]) -> Iterator[Knob]:
    schema, about = _plain(schema, root, value)
    if isinstance(value, Mapping):
        properties, others = schema.get("properties", {}), schema.get("additionalProperties", {})
        for name, entry in value.items():
            inner = properties.get(name, others)
            if isinstance(inner, Mapping):
                for knob in _walk(f"{path}.{name}" if path else name, entry, inner, root):
                    yield replace(knob, about=knob.about or about)
        return
    each = _plain(schema.get("items", {}), root, None)[0] if isinstance(value, list) else schema
    common: dict[str, Any] = {
        "path": path,
        "about": about,
        "minimum": each.get("minimum", each.get("exclusiveMinimum")),
        "maximum": each.get("maximum", each.get("exclusiveMaximum")),
    }
    if isinstance(value, bool | int | float):
        yield Knob(value=value, **common)
    elif isinstance(value, str):
        yield Knob(value=value, choices=tuple(each.get("enum", (value,))), **common)
    elif len(value) == LISTED and all(isinstance(entry, int | float) for entry in value):
        yield Knob(value=tuple(map(float, value)), **common)


def _plain(schema: Mapping[str, Any], root: Mapping[str, Any], value: Any) -> tuple[Mapping[str, Any], str]:
    """A schema without references and alternatives, as far as they describe a value, and what it is about."""
    about = schema.get("description", "")
    while True:
        if "$ref" in schema:
            schema = root["$defs"][schema["$ref"].rpartition("/")[2]]
        elif "anyOf" in schema or "oneOf" in schema:
            options = [each for each in schema.get("anyOf", schema.get("oneOf", ())) if each.get("type") != "null"]
            fitting = [each for each in options if isinstance(value, str) == (each.get("type") == "string")]
            schema = (fitting or options)[0]
        else:
            return schema, about
        about = about or schema.get("description", "")
