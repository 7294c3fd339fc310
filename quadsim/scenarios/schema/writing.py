"""A scenario as commented TOML: every field with its unit and meaning, the descriptions of `quadsim.scenarios.schema`.

What is written parses to the same scenario, and equal scenarios give equal texts.  What is not stated stands in
comments: a field that may be absent, and is, an absent table with its defaults, and a derived value with the word
`derived`.  A field is explained where its kind of table first occurs.
"""

from __future__ import annotations

import math
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, Literal, get_args, get_origin

import tomlkit
from pydantic.fields import FieldInfo
from pydantic_core import PydanticUndefined

from quadsim.scenarios.schema.base import fields_of, is_table

LINE_WIDTH: Final = 120
"""Longest line with a comment; a comment that does not fit beside its field is written above it."""
_LONG: Final = 76  # a list that is longer takes a line per entry


def headline(model: type[Any]) -> str:
    """Return the first line of a table class's docstring, without its full stop."""
    return (model.__doc__ or "").strip().partition("\n")[0].removesuffix(".")


def tables_in(annotation: Any) -> tuple[type[Any], ...]:
    """Return the table classes in a field's type: several for a union, none for numbers and texts."""
    if is_table(annotation):
        return (annotation,)
    tables: list[type[Any]] = []
    for argument in get_args(annotation):
        tables += tables_in(argument)
    return tuple(tables)


def is_absent(value: object) -> bool:
    """Return whether a file leaves out a field with this value: None, or an infinite bound."""
    return value is None or (isinstance(value, float) and math.isinf(value))


def plain(value: Any) -> Any:
    """Return tables and lists as in JSON and TOML, without absent fields."""
    if is_table(type(value)):
        value = _present_fields(value)
    if isinstance(value, Mapping):
        present = {}
        for name, entry in value.items():
            if not is_absent(entry):
                present[name] = plain(entry)
        return present
    if isinstance(value, list | tuple):
        return [plain(entry) for entry in value]
    return value


def to_toml(model: Any, stated: Mapping[str, Any] | None = None, recorded: Mapping[str, str] | None = None) -> str:
    """Return a table as a TOML document.

    Args:
        model: the table.
        stated: as of `plain`, the fields that the document states; the others are derived and stand in comments.  By
            default all of `model`.
        recorded: by dotted path, the file that a field repeats; its comment names it.
    """
    if stated is None:
        stated = plain(model)
    lines = _Writer(recorded or {}).table(model, "", stated)
    return "\n".join(lines) + "\n"


def stated_lines(header: str, model: Any, explained: set[object]) -> list[str]:
    """Return a table with its header, without the fields that have their defaults.

    Args:
        header: its first line, `[name]` or `[[name]]`.
        model: the table.
        explained: kinds and names of the fields whose comments were written before; those of here are added.
    """
    kind = type(model)
    lines = [header]
    for name, field in _fields_type_first(kind):
        value = getattr(model, name)
        if value == field.get_default(call_default_factory=True) and name != "type":
            continue
        comment = ""
        if (kind, name) not in explained:
            comment = _description(field)
        explained.add((kind, name))
        lines += _commented(_pair(name, _without_defaults(value)), comment)
    return lines


def _without_defaults(value: Any) -> Any:
    """Return tables within a field as mappings of what differs from the defaults."""
    if isinstance(value, list | tuple):
        return [_without_defaults(entry) for entry in value]
    if not is_table(type(value)):
        return value
    stated: dict[str, Any] = {}
    for name, field in fields_of(type(value)).items():
        entry = getattr(value, name)
        if entry != field.get_default(call_default_factory=True):
            stated[name] = _without_defaults(entry)
    return stated


@dataclass(frozen=True, kw_only=True)
class _Entry:
    """A field of a table, with its value and what is said about it."""

    name: str
    value: Any
    kinds: tuple[type[Any], ...]  # of the tables in its type
    is_first: bool  # whether its kind of table has not occurred before
    comment: str  # its description where it is first, else empty

    def is_subtable(self, path: str) -> bool:
        """Return whether it has a header of its own, in a table at a path; lists have one in the outermost table."""
        if is_absent(self.value):
            return bool(self.kinds)
        if is_table(type(self.value)) or isinstance(self.value, Mapping):
            return True
        return bool(self.value and self.kinds and not path)


class _Writer:
    """Writes tables; a field is explained where its kind of table first occurs."""

    def __init__(self, recorded: Mapping[str, str]) -> None:
        self._recorded = recorded
        self._explained: set[object] = set()

    def table(self, model: Any, path: str, stated: Mapping[str, Any]) -> Iterator[str]:
        """Yield the lines of a table: numbers, texts and small lists, then its subtables, in order of declaration."""
        subtables = []
        for name, field in _fields_type_first(type(model)):
            entry = self._entry(type(model), name, field, getattr(model, name))
            if entry.is_subtable(path):
                subtables.append(entry)
            else:
                yield from self._field(entry, path, stated)
        for entry in subtables:
            yield from self._subtable(entry, path, stated)

    def _entry(self, kind: type[Any], name: str, field: FieldInfo, value: Any) -> _Entry:
        is_first = (kind, name) not in self._explained
        self._explained.add((kind, name))
        comment = ""
        if is_first:
            comment = _description(field)
        kinds = tables_in(field.annotation)
        return _Entry(name=name, value=value, kinds=kinds, is_first=is_first, comment=comment)

    def _field(self, entry: _Entry, path: str, stated: Mapping[str, Any]) -> Iterator[str]:
        """Yield the lines of a number, a text or a small list."""
        comment = entry.comment
        if is_absent(entry.value):
            if entry.is_first:
                yield from _commented(f"# {entry.name} =", comment)
        elif entry.name not in stated:
            yield from _commented(_unstated(_pair(entry.name, entry.value)), _labelled_as("derived", comment))
        else:
            if entry.kinds not in self._explained:
                yield from _about_entries(entry.kinds)
            self._explained.add(entry.kinds)
            source = self._recorded.get(f"{path}{entry.name}")
            if source:
                comment = _labelled_as(f"of {source}", comment)
            yield from _commented(_pair(entry.name, entry.value), comment)

    def _subtable(self, entry: _Entry, path: str, stated: Mapping[str, Any]) -> Iterator[str]:
        """Yield a table within another one, or a list of tables, with its header."""
        place = f"{path}{entry.name}"
        value = entry.value
        comment = entry.comment
        if is_absent(value):
            if entry.is_first:
                yield from self._absent(place, entry.kinds, comment or _headlines(entry.kinds))
        elif isinstance(value, list | tuple):
            yield from self._list_of_tables(entry)
        elif isinstance(value, Mapping):
            yield from ["", *_commented(f"[{place}]", comment)]
            for key, number in value.items():
                yield _pair(key, number)
        else:
            if entry.is_first:
                comment = comment or headline(type(value))
            if entry.name in stated:
                yield from ["", *_commented(f"[{place}]", comment)]
                yield from self.table(value, f"{place}.", stated[entry.name])
            else:
                yield from ["", *_commented(f"# [{place}]", _labelled_as("derived", comment))]
                yield from self.table(value, f"{place}.", {})

    def _list_of_tables(self, entry: _Entry) -> Iterator[str]:
        """Yield a list of tables; a kind's headline stands where it first occurs, unless the comment says enough."""
        yield from ["", *_wrapped(entry.comment)]
        several = len({type(table) for table in entry.value}) > 1
        for table in entry.value:
            kind = type(table)
            about = ""
            if (several or not entry.comment) and kind not in self._explained:
                about = headline(kind)
            self._explained.add(kind)
            yield from ["", *_commented(f"[[{entry.name}]]", about)]
            yield from self.table(table, f"{entry.name}.", plain(table))

    def _absent(self, path: str, kinds: Sequence[type[Any]], comment: str) -> Iterator[str]:
        """Yield an absent table in comments: its fields with their defaults, then its subtables."""
        yield from ["", *_commented(f"# [{path}]", comment)]
        if len(kinds) > 1:
            yield from _about_entries(kinds)
            return
        (kind,) = kinds
        subtables = []
        for name, field in _fields_type_first(kind):
            default = field.get_default(call_default_factory=True)
            entry = self._entry(kind, name, field, default)
            if entry.kinds and not isinstance(default, list | tuple):
                subtables.append(entry)
            elif default is PydanticUndefined or is_absent(default):
                yield from _commented(f"# {name} =", entry.comment)
            else:
                yield from _commented(_unstated(_pair(name, plain(default))), entry.comment)
        for entry in subtables:
            about = entry.comment
            if entry.is_first:
                about = about or _headlines(entry.kinds)
            yield from self._absent(f"{path}.{entry.name}", entry.kinds, about)


def _unstated(text: str) -> str:
    """Return lines of TOML as comments."""
    return "\n".join(f"# {line}" for line in text.split("\n"))


def _labelled_as(label: str, comment: str) -> str:
    """Return a comment with a label before it."""
    if comment:
        return f"{label}; {comment}"
    return label


def _about_entries(kinds: Sequence[type[Any]]) -> Iterator[str]:
    """Yield the comments on the tables in a small list; for several kinds only the fields' names."""
    for kind in kinds:
        if len(kinds) > 1:
            names = ", ".join(_with_type(name, field) for name, field in _fields_type_first(kind))
            yield from _wrapped(f"{{{names}}}: {headline(kind)}", subsequent_indent="  ", break_on_hyphens=False)
            continue
        fields = fields_of(kind)
        width = max(map(len, fields))
        yield from _wrapped(f"each {{{', '.join(fields)}}}: {headline(kind)}")
        for name, field in fields.items():
            yield f"#   {name:<{width}}  {field.description or ''}"


def _fields_type_first(kind: type[Any]) -> list[tuple[str, FieldInfo]]:
    """Return the fields of a table in order of declaration, behind its type."""
    return sorted(fields_of(kind).items(), key=lambda named: named[0] != "type")


def _description(field: FieldInfo) -> str:
    """Return what a field's comment says, on one line."""
    return " ".join((field.description or "").split())


def _headlines(kinds: Sequence[type[Any]]) -> str:
    return "; ".join(map(headline, kinds))


def _with_type(name: str, field: FieldInfo) -> str:
    """Return a field's name; that of a type with its value, if it has only one."""
    if name == "type" and get_origin(field.annotation) is Literal:
        choices = get_args(field.annotation)
        if len(choices) == 1:
            return f'{name} = "{choices[0]}"'
    return name


def _pair(name: str, value: Any) -> str:
    return f"{tomlkit.key(name).as_string()} = {_text(value)}"


def _text(value: Any) -> str:
    """Return a number, a text, a list or a small table as TOML."""
    if is_table(type(value)):
        value = _present_fields(value)
    if isinstance(value, Mapping):
        pairs = ", ".join(_pair(name, entry) for name, entry in value.items())
        return f"{{{pairs}}}"
    if isinstance(value, list | tuple):
        entries = [*map(_text, value)]
        line = f"[{', '.join(entries)}]"
        if len(line) <= _LONG:
            return line
        return "[\n" + "".join(f"    {entry},\n" for entry in entries) + "]"
    return tomlkit.item(value).as_string()


def _present_fields(table: Any) -> dict[str, Any]:
    """Return the fields of a table that a file has."""
    present = {}
    for name in fields_of(type(table)):
        entry = getattr(table, name)
        if not is_absent(entry):
            present[name] = entry
    return present


def _commented(text: str, comment: str) -> list[str]:
    """Return a line with its comment beside it, or above it if it is long."""
    line = text
    if comment:
        line = f"{text}  # {comment}"
    if len(line) <= LINE_WIDTH and "\n" not in text:
        return [line]
    return [*_wrapped(comment), text]


def _wrapped(comment: str, **options: Any) -> list[str]:
    return [f"# {line}" for line in textwrap.wrap(comment, LINE_WIDTH - 2, **options)]
