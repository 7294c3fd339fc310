"""What is wrong with a scenario file, in lines a person can act on."""

from __future__ import annotations

import difflib
from collections.abc import Mapping, Sequence
from typing import Any, Final, get_args

from pydantic import BaseModel
from pydantic_core import ErrorDetails

from quadsim.errors import InputError
from scenarios.spec import Scenario

_RULES: Final = {
    "greater_than": "> {gt}",
    "greater_than_equal": ">= {ge}",
    "less_than_equal": "<= {le}",
    "finite_number": "a finite number",
    "float_type": "a number",
    "int_type": "a whole number",
    "string_type": "a text",
    "bool_type": "true or false",
    "list_type": "a list",
    "dict_type": "a table",
    "model_type": "a table",
    "model_attributes_type": "a table",
    "too_short": "of {min_length} or more entries",
    "too_long": "of {max_length} or fewer entries",
    "string_pattern_mismatch": "of the form {pattern}",
    "union_tag_invalid": "one of {expected_tags} in its field type",
    "union_tag_not_found": "a table with a field type",
}
"""How pydantic's kinds of error end the sentence "must be ..."."""


class ScenarioError(InputError):
    """A scenario file that cannot be flown.

    Attributes:
        problems: one line per field, each naming it, what was given and what is allowed.
    """

    def __init__(self, source: str, problems: Sequence[str]) -> None:
        super().__init__(f"{source}: " + "\n  ".join(problems))
        self.source, self.problems = source, tuple(problems)


def describe(details: ErrorDetails, data: Mapping[str, Any]) -> str:
    """One line about one field: its name, what is allowed, what was given."""
    location = _location(details["loc"], data)
    field = ".".join(location)
    kind, given, context = details["type"], details["input"], details.get("ctx", {})
    if kind.startswith("union_tag"):
        given = given.get("type") if isinstance(given, dict) else given
    if kind == "missing":
        return f"{'.'.join([*location, str(details['loc'][-1])])} is missing"
    if kind == "extra_forbidden":
        allowed = _siblings(details["loc"][:-1])
        near = difflib.get_close_matches(location[-1], allowed, n=1)
        guess = f"; did you mean {near[0]!r}?" if near else ""
        return f"{field} is not a field of the scenario file{guess} (there are: {', '.join(allowed)})"
    if kind == "value_error":
        return ".".join([*location, str(context["error"])])
    if kind in ("too_short", "too_long") and isinstance(given, list) and location[-1] != "output_weights":
        length = context.get("min_length", context.get("max_length"))
        return f"{field} must be a list of {length} numbers; got {given!r}"
    rule = _RULES[kind].format(**context) if kind in _RULES else details["msg"]
    return f"{field} must be {rule}; got {given!r}"


def _location(path: Sequence[int | str], data: Any) -> list[str]:
    """Names from the root to a field: pydantic's path less its labels of union members, a named entry by its name."""
    names: list[str] = []
    for part in path:
        if isinstance(part, int):
            data = data[part]
            name = data.get("name") if isinstance(data, dict) else None
            names.append(name if isinstance(name, str) else str(part))
        elif isinstance(data, Mapping) and part in data:
            data = data[part]
            names.append(part)
    return names


def _siblings(path: Sequence[int | str]) -> list[str]:
    """Field names allowed at a place in the file, for guessing what was meant."""
    models: list[type[BaseModel]] = [Scenario]
    for part in path:
        inner = [
            model
            for outer in models
            if part in outer.model_fields
            for model in _models_in(outer.model_fields[str(part)].annotation)
        ]
        tagged = [
            model
            for model in models
            if "type" in model.model_fields and part in get_args(model.model_fields["type"].annotation)
        ]
        models = inner or tagged or models
    return list(dict.fromkeys(name for model in models for name in model.model_fields))


def _models_in(annotation: Any) -> list[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [model for argument in getattr(annotation, "__args__", ()) for model in _models_in(argument)]
