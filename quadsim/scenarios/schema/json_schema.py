"""The scenario file as JSON Schema (Draft 2020-12), for editors: fields, types, ranges, units and meanings.

What no schema can express, such as a period that must be a whole multiple of another, is checked when the file is read.
"""

from __future__ import annotations

from typing import Any, Final

from pydantic.json_schema import GenerateJsonSchema
from pydantic_core import core_schema

from quadsim.scenarios.courses.table import DEFAULT, ReferenceTable
from quadsim.scenarios.schema.base import fields_of
from quadsim.scenarios.schema.problems import adapter
from quadsim.scenarios.schema.scenario import Scenario
from quadsim.scenarios.schema.writing import headline, is_absent, tables_in

DIALECT: Final = "https://json-schema.org/draft/2020-12/schema"
BASE: Final = {
    "type": "string",
    "description": "a scenario's name, or a path ending in .toml, over which this file is merged field by field",
}
_TABLES: Final = "#/$defs/"
_PARTIAL: Final = "Partial"  # prefix of tables that may be given in part


class _SchemaOfToml(GenerateJsonSchema):
    """Schema without titles and nulls: TOML leaves out absent fields."""

    schema_dialect = DIALECT

    def field_title_should_be_set(self, schema: Any) -> bool:
        """Titles such as `Control Period` add nothing to the name."""
        return False

    def nullable_schema(self, schema: core_schema.NullableSchema) -> dict[str, Any]:
        """Return the schema of a present value."""
        return self.generate_inner(schema["schema"])

    def dataclass_schema(self, schema: core_schema.DataclassSchema) -> dict[str, Any]:
        """The same with a settings dataclass's description of its fields; see `quadsim.fields`."""
        json_schema = super().dataclass_schema(schema)
        table = schema["cls"]
        json_schema["description"] = f"{headline(table)}."
        for name, field in fields_of(table).items():
            if field.description:
                json_schema["properties"][name]["description"] = field.description
        return json_schema

    def field_is_required(self, field: Any, total: bool) -> bool:
        """Whether a table must state a field; this includes its type, although that has only one value."""
        named = field.get("name") == "type" and field["schema"].get("default") != DEFAULT
        return named or super().field_is_required(field, total)

    def default_schema(self, schema: core_schema.WithDefaultSchema) -> dict[str, Any]:
        """The same without a default where that is to be absent."""
        if "default" in schema and is_absent(schema["default"]):
            return self.generate_inner(schema["schema"])
        return super().default_schema(schema)


def scenario_schema() -> dict[str, Any]:
    """The JSON Schema of scenario files, as nested tables; without an identifier, so that it may lie anywhere.

    A file with a `base` holds only what differs: none of its fields is required.

    Examples:
        >>> import quadsim
        >>> quadsim.scenario_schema()["title"]
        'A quadsim scenario'
    """
    whole = adapter(Scenario).json_schema(schema_generator=_SchemaOfToml)
    tables = whole.pop("$defs")
    difference = _loosened(whole)
    with_end = sorted(table.__name__ for table in tables_in(ReferenceTable) if hasattr(table, "until"))
    types_with_end = [tables[name]["properties"]["type"]["const"] for name in with_end]
    course_with_end = {
        "properties": {"reference": {"properties": {"type": {"enum": types_with_end}}, "required": ["type"]}}
    }
    whole["anyOf"] = [{"required": ["duration"]}, course_with_end]
    difference["properties"] = {"base": BASE, **difference["properties"]}
    partial = {_PARTIAL + name: _loosened(table) for name, table in tables.items()}
    return {
        "$schema": DIALECT,
        "title": "A quadsim scenario",
        "type": "object",
        "if": {"required": ["base"]},
        "then": difference,
        "else": whole,
        "$defs": {**tables, **partial},
    }


def _loosened(schema: Any) -> Any:
    """Return a part of the schema with nothing required and any fitting kind allowed."""
    if isinstance(schema, list):
        return [_loosened(entry) for entry in schema]
    if isinstance(schema, str):
        if schema.startswith(_TABLES):
            return schema.replace(_TABLES, _TABLES + _PARTIAL)
        return schema
    if not isinstance(schema, dict):
        return schema
    loosened = {}
    for key, value in schema.items():
        if key == "oneOf":
            loosened["anyOf"] = _loosened(value)
        elif key not in ("required", "discriminator"):
            loosened[key] = _loosened(value)
    return loosened
