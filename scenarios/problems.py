"""What is wrong with a scenario file, in lines a person can act on."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Final

from pydantic import BaseModel
from pydantic_core import ErrorDetails

from quadsim.errors import InputError
from scenarios.places import find
from scenarios.spec import Scenario

_RULES: Final = {
    "greater_than": "> {gt}",
    "greater_than_equal": ">= {ge}",
    "less_than": "< {lt}",
    "less_than_equal": "<= {le}",
    "multiple_of": "a multiple of {multiple_of}",
    "finite_number": "a finite number",
    "float_type": "a number",
    "int_type": "a whole number",
    "string_type": "a text",
    "string_too_short": "a text of {min_length} or more characters",
    "string_too_long": "a text of {max_length} or fewer characters",
    "literal_error": "one of {expected}",
    "bool_type": "true or false",
    "list_type": "a list",
    "tuple_type": "a list",
    "dict_type": "a table",
    "model_type": "a table",
    "model_attributes_type": "a table",
    "too_short": "of {min_length} or more entries",
    "too_long": "of {max_length} or fewer entries",
    "string_pattern_mismatch": "of the form {pattern}",
    "union_tag_invalid": "one of {expected_tags} in its field {discriminator}",
    "union_tag_not_found": "a table with a field {discriminator}",
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


def describe(details: ErrorDetails, data: Mapping[str, Any], root: type[BaseModel] = Scenario) -> str:
    """One line about one field: its name, what is allowed, what was given.

    Args:
        details: what pydantic found.
        data: the file.
        root: what the file is to be.
    """
    place = find(details["loc"], data, root)
    field, kind, given, context = ".".join(place.names), details["type"], details["input"], {**details.get("ctx", {})}
    if kind == "missing":
        return f"{field} is missing"
    if kind == "extra_forbidden":
        allowed = find(details["loc"][:-1], data, root).fields
        guess = _guess(place.names[-1], allowed)
        return f"{field} is not a field of the scenario file{guess} (there are: {', '.join(allowed)})"
    if kind == "value_error":
        return ".".join([*place.names, str(context["error"])])
    if kind in ("too_short", "too_long") and place.exact_length is not None:
        return f"{field} must be a list of {place.exact_length} {place.entries}; got {given!r}"
    guess = ""
    if kind.startswith("union_tag"):
        quoted = context["discriminator"]  # in quotes where it is a field's name, and else a function of the spec's
        context["discriminator"] = name = quoted.strip("'") if quoted.startswith("'") else "type"
        given = given.get(name) if isinstance(given, Mapping) else given
        guess = _guess(given, context.get("expected_tags", "").strip("'").split("', '"))
    rule = _RULES[kind].format(**context) if kind in _RULES else details["msg"]
    return f"{field} must be {rule}; got {given!r}{guess}"


def _guess(given: object, allowed: Iterable[str]) -> str:
    near = difflib.get_close_matches(str(given), allowed, n=1)
    return f"; did you mean {near[0]!r}?" if near else ""
