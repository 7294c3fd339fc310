"""Parse nested tables as the dataclasses that declare them; what is wrong becomes one line per field.

Pydantic checks the values (`parse_table`). Its errors name a path: `find` looks up where that leads in the file and
which kinds of value are allowed there, and `describe` states field, allowed values and given value.
"""

from __future__ import annotations

import datetime
import difflib
import functools
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from itertools import islice
from types import NoneType, UnionType
from typing import Annotated, Any, Final, Literal, TypeVar, Union, cast, get_args, get_origin

from annotated_types import GroupedMetadata
from pydantic import Tag, TypeAdapter, ValidationError
from pydantic.fields import FieldInfo
from pydantic_core import ErrorDetails, SchemaValidator, core_schema

from quadsim.assets import DEEPEST
from quadsim.errors import InputError, ParameterError, UnknownNameError
from quadsim.scenarios.schema.base import LARGEST_WHOLE, STRICT, fields_of, is_table
from quadsim.vehicle import MEANT

TableType = TypeVar("TableType")

_LISTS: Final = (list, tuple, Sequence)  # types written as lists in a file
_TAGS: Final = ("type", "distribution")  # fields that distinguish tables
_NAMES: Final = {float: "number", int: "whole number", str: "text"}
_LIMITS: Final = {"gt": ">", "ge": ">=", "lt": "<", "le": "<="}
_WHY_ABSENT: Final = {
    "controller.commands": " with this controller: only robust, nonlinear and geometric can command thrust and rates; "
    "models and gains of the others are for rotor speeds",
}
"""Reasons why a controller lacks a field that a reader may expect."""
_REMOVED_FIELDS: Final = {
    "controller.compiled": "C always prepares the queries of robust, and Python those of unconstrained and "
    'constrained; solver = "core" solves in C',
}
"""Why fields of earlier versions were removed, and what is there instead."""
_WRITTEN_OTHERWISE: Final = ("dataclass", "tuple", "enum")
"""Pydantic's types that a file does not have: it has a table, a list or a text instead."""
_NO_SCHEMA: Final = ("default", "metadata", "expected")
"""Parts of pydantic's schemas that are values, not schemas."""
_UNKNOWN_FIELD: Final = ("extra_forbidden", "unexpected_keyword_argument")
"""Pydantic's kinds of error for a field that no table has."""
_PYDANTIC_ERRORS: Final = frozenset(get_args(core_schema.ErrorType))
"""Pydantic's kinds of error; an error of another kind states its rule."""


@dataclass(frozen=True, kw_only=True)
class Kind:
    """One of the allowed types of a value."""

    type: Any  # without its annotations
    metadata: tuple[Any, ...] = ()  # the annotations

    @property
    def fields(self) -> tuple[str, ...]:
        """Names of a table's fields; none for other kinds."""
        if is_table(self.type):
            return tuple(fields_of(self.type))
        return ()

    @property
    def is_list(self) -> bool:
        """Whether it is written as a list in a file."""
        return (get_origin(self.type) or self.type) in _LISTS

    @property
    def entries(self) -> tuple[Kind, ...]:
        """Kinds of the entries of a list, or of a table with free names."""
        origin = get_origin(self.type)
        arguments = get_args(self.type)
        if origin is tuple:
            return kinds_of(arguments[0])
        if origin in (*_LISTS, dict):
            return kinds_of(arguments[-1])
        return ()

    @property
    def choices(self) -> tuple[Any, ...]:
        """Allowed values, if they are enumerated."""
        if isinstance(self.type, type) and issubclass(self.type, Enum):
            return tuple(member.value for member in self.type)
        if get_origin(self.type) is Literal:
            return get_args(self.type)
        return ()

    @property
    def labels(self) -> set[str]:
        """Names that pydantic gives this kind in a union."""
        tags: set[str] = set()
        for note in self.metadata:
            if isinstance(note, Tag):
                tags.add(note.tag)
        for name in _TAGS:
            if name in self.fields:
                for kind in kinds_of(fields_of(self.type)[name].annotation):
                    tags.update(map(str, kind.choices))
        return tags or {getattr(self.type, "__name__", "")}

    @property
    def limits(self) -> dict[str, Any]:
        """Limits by the names of annotated_types."""
        return dict(_limits(self.metadata))

    @property
    def lengths(self) -> tuple[int, float]:
        """Smallest and largest number of a list's entries or a text's characters."""
        return self.limits.get("min_length") or 0, self.limits.get("max_length") or math.inf

    def __str__(self) -> str:
        """Return what is allowed, to end the sentence "must be ..."."""
        if self.choices:
            return self._choice()
        if self.is_list:
            return self._list()
        if self.type in _NAMES:
            return self._number_or_text()
        if self.type is bool:
            return "true or false"
        count = _count(*self.lengths)
        if count:
            return f"a table of {count}entries"
        return "a table"

    def _choice(self) -> str:
        texts = []
        for choice in self.choices:
            if choice is False:
                texts.append("false")
            else:
                texts.append(repr(choice))
        *others, last = texts
        if others:
            return f"one of {', '.join(others)} or {last}"
        return last

    def _list(self) -> str:
        types = {entry.type for entry in self.entries}
        if types <= {float, int}:
            entries = "numbers"
        elif types == {str}:
            entries = "texts"
        else:
            entries = "entries"
        return f"a list of {_count(*self.lengths)}{entries}"

    def _number_or_text(self) -> str:
        limits = self.limits
        bounds = []
        for name, sign in _LIMITS.items():
            if name in limits:
                bounds.append(f"{sign} {_number(limits[name])}")
        if self.type is float and not bounds:
            words = ["a finite number"]
        else:
            words = [f"a {_NAMES[self.type]}"]
        if bounds:
            words.append(" and ".join(bounds))
        count = _count(*self.lengths)
        if count:
            words.append(f"of {count}characters")
        if "pattern" in limits:
            words.append(f"of the form {limits['pattern']}")
        return " ".join(words)


def _limits(notes: Iterable[Any]) -> Iterator[tuple[str, Any]]:
    """Yield the limits in a field's annotations, by the names of annotated_types and pydantic."""
    for note in notes:
        if isinstance(note, FieldInfo):
            yield from _limits(note.metadata)
        elif isinstance(note, GroupedMetadata):
            yield from _limits(note)
        for name in (*_LIMITS, "min_length", "max_length", "pattern"):
            limit = getattr(note, name, None)
            if limit is not None:
                yield name, limit


def _count(shortest: int, longest: float) -> str:
    """Return how many entries or characters are allowed, with a space behind; empty where any number is."""
    if shortest == longest:
        return f"{shortest} "
    if math.isinf(longest):
        if shortest:
            return f"{shortest} or more "
        return ""
    if shortest:
        return f"{shortest} to {longest} "
    return f"{longest} or fewer "


def _number(value: float) -> str:
    if isinstance(value, int):
        return str(value)
    return f"{value:.15g}"


@dataclass(frozen=True, kw_only=True)
class FilePlace:
    """A place in the file."""

    names: tuple[str, ...]  # from the root; an entry of a list by its name, or else by its index
    kinds: tuple[Kind, ...]  # allowed kinds; empty where nothing is allowed
    given: Any  # the value in the file

    @property
    def fields(self) -> tuple[str, ...]:
        """Names of all fields of the tables allowed there."""
        names: dict[str, None] = {}  # each once, in order
        for kind in self.kinds:
            names |= dict.fromkeys(kind.fields)
        return tuple(names)

    @property
    def is_of_wrong_length(self) -> bool:
        """Whether the value is a list that is too short or too long."""
        if not isinstance(self.given, list):
            return False
        for kind in self.kinds:
            if kind.is_list:
                shortest, longest = kind.lengths
                if shortest <= len(self.given) <= longest:
                    return False
        return True


def find(path: Sequence[int | str], data: Any, root: type[Any]) -> FilePlace:
    """Return the place of one of pydantic's paths in a file of type `root`."""
    names: list[str] = []
    kinds: tuple[Kind, ...] = (Kind(type=root),)
    for part in path:
        if isinstance(part, int):
            data = data[part]
            names.append(_entry_name(data, part))
            kinds = _entries_of(kinds)
            continue
        labelled = tuple(kind for kind in kinds if part in kind.labels)
        if len(kinds) > 1 and labelled:  # pydantic's name for a member of a union, which the file does not have
            kinds = labelled
            continue
        fields = [fields_of(kind.type)[part] for kind in kinds if part in kind.fields]
        if fields or (isinstance(data, Mapping) and part in data):
            names.append(part)
            if isinstance(data, Mapping):
                data = data.get(part)
            else:
                data = None
            if fields:
                kinds = _kinds_of_fields(fields)
            else:
                kinds = _entries_of(kinds)
    return FilePlace(names=tuple(names), kinds=kinds, given=data)


def _entry_name(entry: Any, i: int) -> str:
    """Return the name of a list's entry, or else its index."""
    if isinstance(entry, Mapping):
        name = entry.get("name")
        if isinstance(name, str) and name:
            return name
    return str(i)


def _entries_of(kinds: Iterable[Kind]) -> tuple[Kind, ...]:
    """Return the kinds of entry of lists, or of tables with free names, of these kinds."""
    entries: list[Kind] = []
    for kind in kinds:
        entries += kind.entries
    return tuple(entries)


def _kinds_of_fields(fields: Iterable[FieldInfo]) -> tuple[Kind, ...]:
    """Return the kinds that any of the fields allows."""
    kinds: list[Kind] = []
    for field in fields:
        kinds += kinds_of(field.annotation, tuple(field.metadata))
    return tuple(kinds)


def kinds_of(annotation: Any, metadata: tuple[Any, ...] = ()) -> tuple[Kind, ...]:
    """Return the kinds that a field's type allows, without None, which means absent."""
    origin = get_origin(annotation)
    if origin is Annotated:
        inner, *notes = get_args(annotation)
        return kinds_of(inner, (*metadata, *notes))
    if origin in (Union, UnionType):
        kinds: list[Kind] = []
        for member in get_args(annotation):
            kinds += kinds_of(member, metadata)
        return tuple(kinds)
    if annotation is NoneType:
        return ()
    return (Kind(type=annotation, metadata=metadata),)


_MOST_LINES: Final = 20  # problems listed in one message; the rest are counted
_MOST_DESCRIBED: Final = 200  # problems described; of the rest there are names
_MOST_ENTRIES: Final = 10
_LONGEST: Final = 200
"""Entries and characters of a given value that a message shows."""
_DEEPEST_SHOWN: Final = 4
"""Tables and lists within one another that a message shows of a given value."""


class ScenarioError(InputError):
    """A scenario file that cannot be flown.

    Attributes:
        problems: one line per field, with its name, the given value and the allowed ones.
    """

    def __init__(self, source: str, problems: Sequence[str]) -> None:
        not_listed = len(problems) - _MOST_LINES
        lines = [*problems[:_MOST_LINES]]
        if not_listed > 0:
            lines.append(f"and {not_listed} more")
        super().__init__(f"{source}: " + "\n  ".join(lines))
        self.source = source
        self.problems = tuple(problems)


def parse_table(kind: type[TableType], data: Mapping[str, Any], source: str, *, file: str = "scenario") -> TableType:
    """Parse nested tables as an instance of a table class.

    Raises:
        ScenarioError: the message starts with `source` and names every invalid field.
    """
    try:
        tables = _in_types_of_files(data)
        not_unicode = [*_texts_not_unicode(tables)]
    except RecursionError:
        raise ScenarioError(source, [f"must nest tables and lists at most {DEEPEST} deep"]) from None
    if not_unicode:
        raise ScenarioError(source, not_unicode)
    try:
        table: TableType = _validator(cast(Any, kind)).validate_python(tables)
    except ValidationError as error:
        raise ScenarioError(source, describe_all(error, data, kind, file=file)) from None
    return table


def _in_types_of_files(value: Any) -> Any:
    """Return a copy of nested tables in the types of files, which no later change of the caller's tables reaches.

    What no file holds, as a number of 65 bits, and no field takes, as a date, becomes infinity, which all refuse.
    """
    if isinstance(value, dict):
        return {str(key): _in_types_of_files(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_in_types_of_files(entry) for entry in value]
    if value is None or isinstance(value, bool):
        return value
    if isinstance(value, int) and abs(value) <= LARGEST_WHOLE:
        return int(value)
    if isinstance(value, float):
        return float(value)
    if isinstance(value, str):
        return str(value)
    return math.inf


def _texts_not_unicode(data: Any, names: tuple[str, ...] = ()) -> Iterator[str]:
    """Yield a line about each text that no file of ours can hold, such as the path of a folder that is not UTF-8."""
    if isinstance(data, Mapping):
        for name, entry in data.items():
            yield from _texts_not_unicode(entry, (*names, str(name)))
    elif isinstance(data, list):
        for i, entry in enumerate(data):
            yield from _texts_not_unicode(entry, (*names, str(i)))
    elif isinstance(data, str) and any("\ud800" <= character <= "\udfff" for character in data):
        yield f"{'.'.join(names)} must be UTF-8, as every path and text; got {shown(data)}; rename it"


@functools.cache
def adapter(kind: Any) -> TypeAdapter[Any]:
    """Return the strict parser of a table class, which refuses unknown fields."""
    kind.__pydantic_config__ = STRICT  # of tables within, too
    return TypeAdapter(kind)


@functools.cache
def _validator(kind: Any) -> SchemaValidator:
    """Return what makes a table class of nested dicts and lists."""
    return SchemaValidator(_accepting_dicts_and_lists(adapter(kind).core_schema))


def _accepting_dicts_and_lists(schema: Any) -> Any:
    """Return pydantic's schema with tables that may be dicts, and tuples that may be lists.

    Everything within stays strict: as in a file, 1 is a number, but true and "1" are none.
    """
    if isinstance(schema, list):
        return [_accepting_dicts_and_lists(entry) for entry in schema]
    if not isinstance(schema, dict):
        return schema
    relaxed = {}
    for name, entry in schema.items():
        if name in _NO_SCHEMA:
            relaxed[name] = entry
        else:
            relaxed[name] = _accepting_dicts_and_lists(entry)
    if relaxed.get("type") in _WRITTEN_OTHERWISE:
        relaxed["strict"] = False
    return relaxed


def describe_all(
    error: ValidationError, data: Mapping[str, Any], root: type[Any], *, file: str = "scenario"
) -> list[str]:
    """Return a line about each invalid field; for a list, that it is too long, or its invalid entries.

    Missing fields come last, since they may only be misspelt.  Arguments as for `describe`.
    """
    wrong: dict[tuple[str, ...], ErrorDetails] = {}
    lists_of_wrong_length: set[tuple[str, ...]] = set()
    for details in sorted(error.errors(include_url=False), key=lambda details: details["type"] == "missing"):
        details = _about_whole_list(details, data, root)
        place = find(details["loc"], data, root)
        wrong.setdefault(place.names, details)
        if details["type"] in ("too_short", "too_long") and place.is_of_wrong_length:
            lists_of_wrong_length.add(place.names)
    with_wrong_parts: set[tuple[str, ...]] = set()
    for names in wrong:
        with_wrong_parts |= _enclosing(names)
    described = []
    for names, details in wrong.items():
        if lists_of_wrong_length & _enclosing(names):
            continue
        if names in lists_of_wrong_length or names not in with_wrong_parts:
            described.append(details)
    lines = [describe(details, data, root, file=file) for details in described[:_MOST_DESCRIBED]]
    for details in described[_MOST_DESCRIBED:]:
        lines.append(".".join(map(str, details["loc"])))
    return lines


def _about_whole_list(details: ErrorDetails, data: Any, root: type[Any]) -> ErrorDetails:
    """Return an error about an entry as one about its list, if that has a wrong length: then its entries do not matter.

    Other errors are returned as they are.
    """
    for i, part in enumerate(details["loc"]):
        if isinstance(part, int) and find(details["loc"][:i], data, root).is_of_wrong_length:
            return {**details, "loc": details["loc"][:i], "type": "too_long"}
    return details


def _enclosing(names: tuple[str, ...]) -> set[tuple[str, ...]]:
    """Return the places of the tables and lists around a place."""
    return {names[:i] for i in range(len(names))}


def describe(details: ErrorDetails, data: Mapping[str, Any], root: type[Any], *, file: str = "scenario") -> str:
    """Return one line about a field of a file of type `root`: its name, the allowed and the given value."""
    place = find(details["loc"], data, root)
    field = ".".join(place.names)
    kind = details["type"]
    if kind == "missing":
        return f"{field} is missing"
    if kind in _UNKNOWN_FIELD:
        allowed = find(details["loc"][:-1], data, root).fields
        return _about_unknown_field(place, allowed, file)
    if kind == "value_error":
        return _about_refused_value(place, details["ctx"]["error"])
    if kind.startswith("union_tag"):
        return _about_type(place, details["ctx"])
    if kind in _PYDANTIC_ERRORS:
        rule = " or ".join(dict.fromkeys(map(str, place.kinds)))
    else:
        rule = details["msg"]
    choices: list[str] = []
    for allowed_kind in place.kinds:
        choices += map(str, allowed_kind.choices)
    return f"{field} must be {rule}; got {shown(place.given)}{_guess(place.given, choices)}"


def _about_unknown_field(place: FilePlace, allowed: tuple[str, ...], file: str) -> str:
    """Return the line about a field that is none; `allowed` are the fields of its table."""
    field = ".".join(place.names)
    if field in _REMOVED_FIELDS:
        return f"{field} must be left out, as it went ({_REMOVED_FIELDS[field]}); got {shown(place.given)}"
    if len(place.names) == 1 and field != "base":
        allowed += ("base",)  # which is gone once a file has been merged over its base
    hint = _WHY_ABSENT.get(field) or _guess(place.names[-1], allowed)
    return f"{field} is not a field of the {file} file{hint} (there are: {', '.join(allowed)})"


def _about_refused_value(place: FilePlace, cause: Exception) -> str:
    """Return the line about a value that its table refused, which does not know where in the file it stands."""
    field = ".".join(place.names)
    if isinstance(cause, ParameterError):
        return str(ParameterError(field, cause.name, cause.value, cause.rule))
    if isinstance(cause, UnknownNameError):
        return f"{field}.{cause.kind}: {cause}"
    return ".".join([*place.names, str(cause)])


def _about_type(place: FilePlace, context: Mapping[str, Any]) -> str:
    """Return the line about a table whose type, or another field that distinguishes tables, is missing or unknown.

    `context` is that of pydantic's error.
    """
    discriminator = context["discriminator"]  # in quotes where it is a field's name, else the name of a function
    if discriminator.startswith("'"):
        name = discriminator.strip("'")
    else:
        name = "type"
    expected = context.get("expected_tags")
    if not expected:
        labels: list[str] = []
        for kind in place.kinds:
            labels += map(repr, kind.labels)
        expected = ", ".join(labels)
    given = place.given
    if isinstance(given, Mapping):
        given = given.get(name)
    choices = expected.strip("'").split("', '")
    field = ".".join([*place.names, name])
    return f"{field} must be one of {expected}; got {shown(given)}{_guess(given, choices)}"


def shown(value: object, depth: int = _DEEPEST_SHOWN) -> str:
    """Return a given value as Python source, shortened to fit on a line."""
    if isinstance(value, datetime.date | datetime.time):
        text = value.isoformat()
    elif isinstance(value, int) and value.bit_length() > 64:  # Python does not write out very long ones
        text = f"a whole number of {value.bit_length()} bits"
    elif isinstance(value, str):
        text = repr(value[: _LONGEST + 1])
    elif isinstance(value, Mapping | list) and depth == 0:
        text = "..."
    elif isinstance(value, Mapping):
        entries = []
        for key, entry in islice(value.items(), _MOST_ENTRIES):
            entries.append(f"{shown(key)}: {shown(entry, depth - 1)}")
        if len(value) > _MOST_ENTRIES:
            entries.append("...")
        text = "{" + ", ".join(entries) + "}"
    elif isinstance(value, list):
        entries = [shown(entry, depth - 1) for entry in value[:_MOST_ENTRIES]]
        if len(value) > _MOST_ENTRIES:
            entries.append("...")
        text = "[" + ", ".join(entries) + "]"
    else:
        text = repr(value)
    if len(text) <= _LONGEST:
        return text
    return text[: _LONGEST - 3] + "..."


def _guess(given: object, allowed: Sequence[str]) -> str:
    """Return the allowed name that was probably meant, as the end of a message; empty where none is near."""
    if not isinstance(given, str):
        return ""
    names = [*MEANT.get(given, ())]
    if not names or not {*names} <= {*allowed}:
        names = difflib.get_close_matches(given, allowed, n=1)
    if not names:
        return ""
    return f"; did you mean {' and '.join(map(repr, names))}?"
