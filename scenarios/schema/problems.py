"""What is wrong with a scenario file, in lines a person can act on."""

from __future__ import annotations

import datetime
import difflib
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from types import NoneType, UnionType
from typing import Annotated, Any, Final, Literal, Union, get_args, get_origin

from annotated_types import Len, MaxLen, MinLen
from pydantic import BaseModel, Tag, ValidationError
from pydantic_core import ErrorDetails

from quadsim.errors import InputError, ParameterError, UnknownNameError
from quadsim.vehicle import MEANT
from scenarios.schema.base import fields_of, is_table

_LISTS: Final = (list, tuple, Sequence)  # types that are lists in a file


@dataclass(frozen=True, kw_only=True)
class Kind:
    """One of the types that a value may have."""

    type: Any  # less its annotations
    metadata: tuple[Any, ...] = ()  # these annotations

    @property
    def fields(self) -> tuple[str, ...]:
        """Names of the fields, of a table."""
        return tuple(fields_of(self.type)) if is_table(self.type) else ()

    @property
    def is_list(self) -> bool:
        """Whether it is a list in a file."""
        return (get_origin(self.type) or self.type) in _LISTS

    @property
    def labels(self) -> set[str]:
        """What pydantic calls this kind among several."""
        tags = {note.tag for note in self.metadata if isinstance(note, Tag)}
        if "type" in self.fields and get_origin(choice := fields_of(self.type)["type"].annotation) is Literal:
            tags |= {*get_args(choice)}
        return tags or {getattr(self.type, "__name__", "")}


@dataclass(frozen=True, kw_only=True)
class Place:
    """A place in the file."""

    names: tuple[str, ...]  # from the root; an entry of a list by its name, or else by its index
    kinds: tuple[Kind, ...]  # what may stand there; none where nothing may
    given: Any  # what stands there

    @property
    def fields(self) -> tuple[str, ...]:
        """Names of all fields of the tables that may stand there."""
        return tuple(dict.fromkeys(name for kind in self.kinds for name in kind.fields))

    @property
    def lengths(self) -> tuple[int, float]:
        """The least and the largest number of entries of a list."""
        notes = [note for kind in self.kinds if kind.is_list for note in kind.metadata]
        shortest = (note.min_length for note in notes if isinstance(note, Len | MinLen))
        longest = (note.max_length for note in notes if isinstance(note, Len | MaxLen))
        return next(shortest, 0), next(longest, None) or math.inf

    @property
    def entries(self) -> str:
        """What a list there holds."""
        held = {entry.type for kind in self.kinds if kind.is_list for entry in _entries(kind)}
        return "numbers" if held <= {float, int} else "texts" if held == {str} else "entries"


def find(path: Sequence[int | str], data: Any, root: type[BaseModel]) -> Place:
    """The place of a path of pydantic's in a file that is to be a `root`."""
    names: list[str] = []
    kinds: tuple[Kind, ...] = (Kind(type=root),)
    for part in path:
        named = tuple(kind for kind in kinds if part in kind.labels)
        fields = [fields_of(kind.type)[part] for kind in kinds if part in kind.fields]
        if isinstance(part, int):
            data = data[part]
            name = data.get("name") if isinstance(data, Mapping) else None
            names.append(name if isinstance(name, str) else str(part))
            kinds = tuple(entry for kind in kinds for entry in _entries(kind))
        elif len(kinds) > 1 and named:
            kinds = named
        elif fields or (isinstance(data, Mapping) and part in data):
            names.append(part)
            data = data.get(part) if isinstance(data, Mapping) else None
            inner = [kinds_of(field.annotation, tuple(field.metadata)) for field in fields] or map(_entries, kinds)
            kinds = tuple(kind for each in inner for kind in each)
    return Place(names=tuple(names), kinds=kinds, given=data)


def kinds_of(annotation: Any, metadata: tuple[Any, ...] = ()) -> tuple[Kind, ...]:
    """All that a field's type allows, less None, which is a field that is absent."""
    origin = get_origin(annotation)
    if origin is Annotated:
        inner, *notes = get_args(annotation)
        return kinds_of(inner, (*metadata, *notes))
    if origin in (Union, UnionType):
        return tuple(kind for member in get_args(annotation) for kind in kinds_of(member, metadata))
    return () if annotation is NoneType else (Kind(type=annotation, metadata=metadata),)


def _entries(kind: Kind) -> tuple[Kind, ...]:
    """What a list, or a table with names of the writer's choice, holds."""
    origin, arguments = get_origin(kind.type), get_args(kind.type)
    return kinds_of(arguments[0] if origin is tuple else arguments[-1]) if origin in (*_LISTS, dict) else ()


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
    "enum": "one of {expected}",
    "bool_type": "true or false",
    "list_type": "a list",
    "tuple_type": "a list",
    "dict_type": "a table",
    "model_type": "a table",
    "model_attributes_type": "a table",
    "dataclass_type": "a table",
    "too_short": "of {min_length} or more entries",
    "too_long": "of {max_length} or fewer entries",
    "string_pattern_mismatch": "of the form {pattern}",
    "union_tag_invalid": "one of {expected_tags} in its field {discriminator}",
    "union_tag_not_found": "a table with a field {discriminator}",
}
"""How pydantic's kinds of error end the sentence "must be ..."."""
_OF_TYPE: Final = frozenset({"float_type", "list_type", "tuple_type", "is_instance_of", "sequence_str"})
"""Those that say that a value is no number, or no list."""
_MOST_LINES: Final = 20  # problems that one message names; it only counts the rest
_MOST_ENTRIES: Final = 10
_LONGEST: Final = 200
"""Entries, and characters, that a message shows of what was given."""
_DEEPEST_SHOWN: Final = 4


class ScenarioError(InputError):
    """A scenario file that cannot be flown.

    Attributes:
        problems: one line per field, each naming it, what was given and what is allowed.
    """

    def __init__(self, source: str, problems: Sequence[str]) -> None:
        unsaid = len(problems) - _MOST_LINES
        lines = [*problems[:_MOST_LINES], *([f"and {unsaid} more"] if unsaid > 0 else [])]
        super().__init__(f"{source}: " + "\n  ".join(lines))
        self.source, self.problems = source, tuple(problems)


def describe_all(
    error: ValidationError, data: Mapping[str, Any], root: type[BaseModel], *, file: str = "scenario"
) -> list[str]:
    """A line about each wrong field; of a list, that it is too long, or else which of its entries are wrong.

    Fields that are missing come last: what is missing may only be misspelt.  Arguments as for `describe`.
    """
    found = _of_given_types(error.errors(include_url=False), data, root)
    found.sort(key=lambda details: details["type"] == "missing")
    unsaid: set[int] = set()
    for each in found:
        if each["type"] in ("too_short", "too_long"):
            place = each["loc"]
            entries = [id(other) for other in found if other is not each and other["loc"][: len(place)] == place]
            longer = len(each["input"]) > find(place, data, root).lengths[1]
            unsaid.update(entries if longer else [id(each)] if entries else [])
    return [describe(details, data, root, file=file) for details in found if id(details) not in unsaid]


def _of_given_types(found: list[ErrorDetails], data: Mapping[str, Any], root: type[BaseModel]) -> list[ErrorDetails]:
    """Without the errors that say of a field of several types that its value is not of one of the others."""
    kept = list(found)
    for each in reversed(found):
        field, kind = each["loc"][:-1], each["type"]
        other_type = kind in _OF_TYPE or (kind == "literal_error" and not isinstance(each["input"], str))
        if other_type and find(field, data, root).names == find(each["loc"], data, root).names:
            rest = [error for error in kept if error is not each]
            kept = rest if any(error["loc"][: len(field)] == field for error in rest) else kept
    return kept


def describe(details: ErrorDetails, data: Mapping[str, Any], root: type[BaseModel], *, file: str = "scenario") -> str:
    """One line about one field of a file that is to be a `root`: its name, what is allowed, what was given."""
    place = find(details["loc"], data, root)
    field, kind, context = ".".join(place.names), details["type"], {**details.get("ctx", {})}
    given = details["input"] if details["loc"][-1:] == ("[key]",) else place.given
    if kind == "finite_number" and not isinstance(given, float):  # see `scenarios.schema.scenario.Scenario.read`
        kind = "float_type"
    if kind == "missing":
        return f"{field} is missing"
    if kind in ("extra_forbidden", "unexpected_keyword_argument"):
        allowed = find(details["loc"][:-1], data, root).fields
        if len(place.names) == 1 and field != "base":
            allowed += ("base",)  # which is gone once a file has been merged over its base
        guess = _guess(place.names[-1], allowed)
        return f"{field} is not a field of the {file} file{guess} (there are: {', '.join(allowed)})"
    if kind == "value_error":
        error = context["error"]
        if isinstance(error, ParameterError):  # of a dataclass, which does not know where it stands
            return str(ParameterError(field, error.name, error.value, error.rule))
        if isinstance(error, UnknownNameError):
            return f"{field}.{error.kind}: {error}"
        return ".".join([*place.names, str(error)])
    shortest, longest = place.lengths
    if kind in ("too_short", "too_long") and shortest and longest < math.inf:
        count = shortest if shortest == longest else f"{shortest} to {longest}"
        return f"{field} must be a list of {count} {place.entries}; got {shown(given)}"
    if kind == "too_long":
        return f"{field} must be {_RULES[kind].format(**context)}; got {len(given)}"
    guess = ""
    if kind.startswith("union_tag"):
        quoted = context["discriminator"]  # in quotes where it is a field's name, and else a function of the spec's
        context["discriminator"] = name = quoted.strip("'") if quoted.startswith("'") else "type"
        given = given.get(name) if isinstance(given, Mapping) else given
        guess = _guess(given, context.get("expected_tags", "").strip("'").split("', '"))
    rule = _RULES[kind].format(**context) if kind in _RULES else details["msg"]
    return f"{field} must be {rule}; got {shown(given)}{guess}"


def shown(value: object, depth: int = _DEEPEST_SHOWN) -> str:
    """What was given, as it would be written in Python, cut to what a line can take."""
    if isinstance(value, datetime.date | datetime.time):
        text = value.isoformat()
    elif isinstance(value, int) and value.bit_length() > 64:  # Python does not write out very long ones
        text = f"a whole number of {value.bit_length()} bits"
    elif isinstance(value, str):
        text = repr(value[: _LONGEST + 1])
    elif isinstance(value, Mapping | list) and depth == 0:
        text = "..."
    elif isinstance(value, Mapping):
        entries = [f"{shown(key)}: {shown(each, depth - 1)}" for key, each in islice(value.items(), _MOST_ENTRIES)]
        text = "{" + ", ".join([*entries, *(["..."] if len(value) > _MOST_ENTRIES else [])]) + "}"
    elif isinstance(value, list):
        entries = [shown(each, depth - 1) for each in value[:_MOST_ENTRIES]]
        text = "[" + ", ".join([*entries, *(["..."] if len(value) > _MOST_ENTRIES else [])]) + "]"
    else:
        text = repr(value)
    return text if len(text) <= _LONGEST else text[: _LONGEST - 3] + "..."


def _guess(given: object, allowed: Iterable[str]) -> str:
    allowed = [*allowed]
    meant = MEANT.get(str(given), ())
    near = meant if meant and {*meant} <= {*allowed} else difflib.get_close_matches(str(given), allowed, n=1)
    return f"; did you mean {' and '.join(map(repr, near))}?" if near else ""
