"""The fields of a controller that a person may turn in flight, from the schema of scenario files."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from scenarios.schema.controllers import AnyController
from scenarios.schema.json_schema import scenario_schema
from scenarios.schema.writing import plain

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


def knobs(spec: AnyController) -> tuple[Knob, ...]:
    """Every field of a controller that has a value, but its type, longer lists and what a user's controller reads."""
    root = scenario_schema()
    values = {name: value for name, value in plain(spec).items() if name != "type"}
    return tuple(_walk("", values, root["$defs"][type(spec).__name__], "", root))


def _walk(path: str, value: Any, schema: Mapping[str, Any], about: str, root: Mapping[str, Any]) -> Iterator[Knob]:
    schema, found = _plain(schema, root, value)
    about = found or about
    if isinstance(value, Mapping):
        properties, others = schema.get("properties", {}), schema.get("additionalProperties", {})
        for name, entry in value.items():
            inner = properties.get(name, others)
            if isinstance(inner, Mapping):
                yield from _walk(f"{path}.{name}" if path else name, entry, inner, about, root)
        return
    entry = _plain(schema.get("items", {}), root, None)[0] if isinstance(value, list) else schema
    if isinstance(value, list):
        if len(value) != 2 or not all(isinstance(number, int | float) for number in value):
            return
        value = tuple(map(float, value))
    yield Knob(
        path=path,
        value=value,
        about=about,
        minimum=entry.get("minimum", entry.get("exclusiveMinimum")),
        maximum=entry.get("maximum", entry.get("exclusiveMaximum")),
        choices=tuple(entry.get("enum", (value,))) if isinstance(value, str) else (),
    )


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
