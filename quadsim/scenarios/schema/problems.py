"""Messages about the errors in a scenario file: one line per field, with the allowed values."""

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
_REASONS: Final = {
    "controller.commands": " with this controller: only robust, nonlinear and geometric can command thrust and rates; "
    "models and gains of the others are for rotor speeds",
}
"""Reasons why a controller lacks a field that a reader may expect."""
_GONE: Final = {
    "controller.compiled": "C always prepares the queries of robust, and Python those of unconstrained and "
    'constrained; solver = "core" solves in C',
}
"""Why fields of earlier versions went, and what is there instead."""
_WRITTEN_OTHERWISE: Final = ("dataclass", "tuple", "enum")
"""Pydantic's types that a file does not have: it has a table, a list or a text instead."""
_NO_SCHEMA: Final = ("default", "metadata", "expected")
"""Parts of pydantic's schemas that are values, not schemas."""
_KNOWN: Final = frozenset(get_args(core_schema.ErrorType))  # pydantic's kinds of error; a custom one states its rule


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
        return kinds_of(arguments[0] if origin is tuple else arguments[-1]) if origin in (*_LISTS, dict) else ()

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
        tags = {note.tag for note in self.metadata if isinstance(note, Tag)}
        for name in {*_TAGS} & {*self.fields}:
            tags |= {str(choice) for kind in kinds_of(fields_of(self.type)[name].annotation) for choice in kind.choices}
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
            *rest, last = ("false" if choice is False else repr(choice) for choice in self.choices)
            if rest:
                return f"one of {', '.join(rest)} or {last}"
            return last
        limits = self.limits
        count = _count(*self.lengths)
        if self.is_list:
            held = {entry.type for entry in self.entries}
            return f"a list of {count}{'numbers' if held <= {float, int} else 'texts' if held == {str} else 'entries'}"
        if self.type in _NAMES:
            bounds = []
            for name, sign in _LIMITS.items():
                if name in limits:
                    bounds.append(f"{sign} {_number(limits[name])}")
            if self.type is float and not bounds:
                finite = "finite "
            else:
                finite = ""
            count = f"of {count}characters" if count else ""
            if "pattern" in limits:
                form = f"of the form {limits['pattern']}"
            else:
                form = ""
            return " ".join(filter(None, [f"a {finite}{_NAMES[self.type]}", " and ".join(bounds), count, form]))
        if self.type is bool:
            return "true or false"
        if count:
            return f"a table of {count}entries"
        return "a table"


def _limits(notes: Iterable[Any]) -> Iterator[tuple[str, Any]]:
    """Yield the limits in a field's annotations, by the names of annotated_types and pydantic."""
    for note in notes:
        if isinstance(note, FieldInfo):
            yield from _limits(note.metadata)
        elif isinstance(note, GroupedMetadata):
            yield from _limits(note)
        names = (*_LIMITS, "min_length", "max_length", "pattern")
        yield from ((name, getattr(note, name)) for name in names if getattr(note, name, None) is not None)


def _count(shortest: int, longest: float) -> str:
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
        return tuple(dict.fromkeys(name for kind in self.kinds for name in kind.fields))

    @property
    def is_of_wrong_length(self) -> bool:
        """Whether the value is a list that is too short or too long."""
        lists = [kind.lengths for kind in self.kinds if kind.is_list]
        return isinstance(self.given, list) and not any(low <= len(self.given) <= high for low, high in lists)


def find(path: Sequence[int | str], data: Any, root: type[Any]) -> FilePlace:
    """Return the place of one of pydantic's paths in a file of type `root`."""
    names: list[str] = []
    kinds: tuple[Kind, ...] = (Kind(type=root),)
    for part in path:
        named = tuple(kind for kind in kinds if part in kind.labels)
        fields = []
        for kind in kinds:
            if part in kind.fields:
                fields.append(fields_of(kind.type)[part])
        if isinstance(part, int):
            data = data[part]
            if isinstance(data, Mapping):
                name = data.get("name")
            else:
                name = None
            names.append(name if isinstance(name, str) and name else str(part))
            kinds = tuple(entry for kind in kinds for entry in kind.entries)
        elif len(kinds) > 1 and named:
            kinds = named
        elif fields or (isinstance(data, Mapping) and part in data):
            names.append(part)
            if isinstance(data, Mapping):
                data = data.get(part)
            else:
                data = None
            inner = [kinds_of(field.annotation, tuple(field.metadata)) for field in fields]
            kinds = tuple(kind for group in inner or [kind.entries for kind in kinds] for kind in group)
    return FilePlace(names=tuple(names), kinds=kinds, given=data)


def kinds_of(annotation: Any, metadata: tuple[Any, ...] = ()) -> tuple[Kind, ...]:
    """Return the kinds that a field's type allows, without None, which means absent."""
    origin = get_origin(annotation)
    if origin is Annotated:
        inner, *notes = get_args(annotation)
        return kinds_of(inner, (*metadata, *notes))
    if origin in (Union, UnionType):
        return tuple(kind for member in get_args(annotation) for kind in kinds_of(member, metadata))
    if annotation is NoneType:
        return ()
    return (Kind(type=annotation, metadata=metadata),)


_MOST_LINES: Final = 20  # problems listed in one message; the rest are counted
_MOST_DESCRIBED: Final = 200  # problems described; of the rest there are names
_MOST_ENTRIES: Final = 10
_LONGEST: Final = 200
"""Entries and characters of a given value that a message shows."""
_DEEPEST_SHOWN: Final = 4


class ScenarioError(InputError):
    """A scenario file that cannot be flown.

    Attributes:
        problems: one line per field, with its name, the given value and the allowed ones.
    """

    def __init__(self, source: str, problems: Sequence[str]) -> None:
        unsaid = len(problems) - _MOST_LINES
        lines = [*problems[:_MOST_LINES], *([f"and {unsaid} more"] if unsaid > 0 else [])]
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
        not_unicode = [*_not_unicode(tables)]
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


def _not_unicode(data: Any, names: tuple[str, ...] = ()) -> Iterator[str]:
    """Yield a line about each text that no file of ours can hold, such as the path of a folder that is not UTF-8."""
    if isinstance(data, Mapping | list):
        for name, entry in data.items() if isinstance(data, Mapping) else enumerate(data):
            yield from _not_unicode(entry, (*names, str(name)))
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
    return SchemaValidator(_of_dicts_and_lists(adapter(kind).core_schema))


def _of_dicts_and_lists(schema: Any) -> Any:
    """Return pydantic's schema with tables that may be dicts, and tuples that may be lists.

    Everything within stays strict: as in a file, 1 is a number, but true and "1" are none.
    """
    if isinstance(schema, list):
        return [_of_dicts_and_lists(entry) for entry in schema]
    if not isinstance(schema, dict):
        return schema
    relaxed = {}
    for name, entry in schema.items():
        relaxed[name] = entry if name in _NO_SCHEMA else _of_dicts_and_lists(entry)
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
    whole: set[tuple[str, ...]] = set()  # lists of a wrong length, whose entries do not matter
    for details in sorted(error.errors(include_url=False), key=lambda details: details["type"] == "missing"):
        for i, part in enumerate(details["loc"]):  # where a list is too long, its entries do not matter
            if isinstance(part, int) and find(details["loc"][:i], data, root).is_of_wrong_length:
                details = {**details, "loc": details["loc"][:i], "type": "too_long"}
                break
        place = find(details["loc"], data, root)
        wrong.setdefault(place.names, details)
        if details["type"] in ("too_short", "too_long") and place.is_of_wrong_length:
            whole.add(place.names)
    above = {names[:i] for names in wrong for i in range(len(names))}  # of what is wrong within
    told = [
        details
        for names, details in wrong.items()
        if not any(names[:i] in whole for i in range(len(names))) and (names in whole or names not in above)
    ]
    lines = [describe(details, data, root, file=file) for details in told[:_MOST_DESCRIBED]]
    return lines + [".".join(map(str, details["loc"])) for details in told[_MOST_DESCRIBED:]]


def describe(details: ErrorDetails, data: Mapping[str, Any], root: type[Any], *, file: str = "scenario") -> str:
    """Return one line about a field of a file of type `root`: its name, the allowed and the given value."""
    place = find(details["loc"], data, root)
    field = ".".join(place.names)
    kind = details["type"]
    given = place.given
    if kind == "missing":
        return f"{field} is missing"
    if kind in ("extra_forbidden", "unexpected_keyword_argument") and field in _GONE:
        return f"{field} must be left out, as it went ({_GONE[field]}); got {shown(given)}"
    if kind in ("extra_forbidden", "unexpected_keyword_argument"):
        allowed = find(details["loc"][:-1], data, root).fields
        if len(place.names) == 1 and field != "base":
            allowed += ("base",)  # which is gone once a file has been merged over its base
        hint = _REASONS.get(field) or _guess(place.names[-1], allowed)
        return f"{field} is not a field of the {file} file{hint} (there are: {', '.join(allowed)})"
    if kind == "value_error":
        cause = details["ctx"]["error"]
        if isinstance(cause, ParameterError):  # of a dataclass, which does not know where it stands
            return str(ParameterError(field, cause.name, cause.value, cause.rule))
        if isinstance(cause, UnknownNameError):
            return f"{field}.{cause.kind}: {cause}"
        return ".".join([*place.names, str(cause)])
    choices = [str(choice) for allowed in place.kinds for choice in allowed.choices]
    rule = " or ".join(dict.fromkeys(map(str, place.kinds)))
    if kind.startswith("union_tag"):
        quoted = details["ctx"][
            "discriminator"
        ]  # in quotes where it is a field's name, and else a function of the spec's
        if quoted.startswith("'"):
            name = quoted.strip("'")
        else:
            name = "type"
        expected = details["ctx"].get("expected_tags") or ", ".join(
            repr(each) for k in place.kinds for each in k.labels
        )
        choices = expected.strip("'").split("', '")
        if isinstance(given, Mapping):
            given = given.get(name)
        field = f"{field}.{name}"
        rule = f"one of {expected}"
    return f"{field} must be {rule if kind in _KNOWN else details['msg']}; got {shown(given)}{_guess(given, choices)}"


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
        text = "{" + ", ".join([*entries, *(["..."] if len(value) > _MOST_ENTRIES else [])]) + "}"
    elif isinstance(value, list):
        entries = [shown(entry, depth - 1) for entry in value[:_MOST_ENTRIES]]
        text = "[" + ", ".join([*entries, *(["..."] if len(value) > _MOST_ENTRIES else [])]) + "]"
    else:
        text = repr(value)
    if len(text) <= _LONGEST:
        return text
    return text[: _LONGEST - 3] + "..."


def _guess(given: object, allowed: Iterable[str]) -> str:
    if not isinstance(given, str):
        return ""
    allowed = [*allowed]
    meant = MEANT.get(given, ())
    near = meant if meant and {*meant} <= {*allowed} else difflib.get_close_matches(given, allowed, n=1)
    return f"; did you mean {' and '.join(map(repr, near))}?" if near else ""
