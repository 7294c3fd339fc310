"""A scenario as commented TOML: every field with its unit and meaning, the descriptions of `scenarios.schema`.

What is written parses to the same scenario, and equal scenarios give equal texts.  A field that may be absent, and is,
stands there commented out.  In a list of tables each field is explained where it first occurs.
"""

from __future__ import annotations

import math
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, Literal, get_args, get_origin

import tomlkit
from pydantic.fields import FieldInfo
from tomlkit.container import Container
from tomlkit.items import Item, Table

from scenarios.schema.base import fields_of, is_table


def headline(model: type[Any]) -> str:
    """What a table is, in one line: the first of its class's docstring, less its full stop."""
    return (model.__doc__ or "").strip().partition("\n")[0].removesuffix(".")


def tables_in(annotation: Any) -> tuple[type[Any], ...]:
    """The kinds of table that a field's type is or holds: several for a union of them, none for numbers and texts."""
    if is_table(annotation):
        return (annotation,)
    return tuple(model for argument in get_args(annotation) for model in tables_in(argument))


def is_absent(value: object) -> bool:
    """Whether a field with this value is left out of a file: one without a value, or an infinite bound."""
    return value is None or (isinstance(value, float) and math.isinf(value))


WIDTH: Final = 120
"""No line is longer for its comment's sake: a comment that does not fit beside its field stands above it."""
_NEAREST, _FARTHEST = 23, 44
"""Comments line up behind the widest field of their table, or behind the one or the other of these widths."""
_LONG: Final = WIDTH - _FARTHEST  # A list that is longer takes a line per entry

_Explained = set[tuple[type[Any], str]]  # fields that an earlier entry of the same list explains


@dataclass(frozen=True, kw_only=True)
class _Line:
    """A field to be written."""

    key: str  # its name
    text: str  # what is written of it, less its comment
    value: Item | None  # what it is; None for one that is absent
    comment: str  # its description, beside it where that fits
    above: tuple[str, ...] = ()  # comments before it, line by line


def to_toml(model: Any) -> str:
    """A model as a TOML document."""
    document = tomlkit.document()
    _fill(document, model, (), None)
    return document.as_string()


def _fill(container: Container | Table, model: Any, path: tuple[str, ...], explained: _Explained | None) -> None:
    """Write a model: first its numbers, texts and small lists, then the tables below it, each in the model's order."""
    fields = fields_of(type(model))
    lines: list[_Line] = []
    below: list[tuple[str, Any, str]] = []
    listed: set[tuple[type[Any], ...]] = set()
    for name in sorted(fields, key=lambda name: name != "type"):
        value, kinds = getattr(model, name), tables_in(fields[name].annotation)
        explained_above = explained is not None and (type(model), name) in explained
        if explained is not None:
            explained.add((type(model), name))
        comment = "" if explained_above else _squeezed(fields[name].description or "")
        if is_table(type(value)):
            below.append((name, value, "" if explained_above else comment or headline(type(value))))
        elif isinstance(value, Mapping) or (value and kinds and not path):
            below.append((name, value, comment))
        elif is_absent(value):
            if not explained_above:
                lines.append(_absent((*path, name), kinds, comment))
        else:
            above = () if explained_above or kinds in listed else _about_entries(kinds)
            listed.add(kinds)
            lines.append(_present(name, value, comment, above))
    _write(container, lines)
    for name, value, comment in below:
        if isinstance(value, list | tuple):
            _write_entries(container, name, value, comment)
            continue
        table = _table((*path, name), comment)
        if is_table(type(value)):
            _fill(table, value, (*path, name), explained)
        else:
            _write(table, [_present(key, entry, "") for key, entry in value.items()])
        container.append(name, table)


def _write_entries(container: Container | Table, name: str, entries: Sequence[Any], comment: str) -> None:
    """A list of tables, each below a header of its own."""
    rows = tomlkit.aot()
    explained: _Explained = set()
    several = len({type(entry) for entry in entries}) > 1
    for entry in entries:
        is_new = all(kind is not type(entry) for kind, _ in explained)
        table = _table((f"[{name}]",), headline(type(entry)) if is_new and (several or not comment) else "")
        _fill(table, entry, (name,), explained)
        rows.append(table)
    container.add(tomlkit.nl())
    for line in textwrap.wrap(comment, WIDTH - 2):
        container.add(tomlkit.comment(line))
    container.append(name, rows)


def _table(path: tuple[str, ...], comment: str) -> Table:
    """An empty table with a comment beside its header, or below it where that is long."""
    table = tomlkit.table()
    header = f"[{'.'.join(path)}]"
    space = _space(header, _NEAREST)
    if len(f"{header}{space}# {comment}") > WIDTH:
        for line in textwrap.wrap(comment, WIDTH - 2):
            table.add(tomlkit.comment(line))
    elif comment:
        table.comment(comment)
        table.trivia.comment_ws = space
    return table


def _present(name: str, value: Any, comment: str, above: tuple[str, ...] = ()) -> _Line:
    item = _item(value)
    text = f"{tomlkit.key(name).as_string()} = {item.as_string()}"
    return _Line(key=name, text=text, value=item, comment=comment, above=above)


def _absent(path: tuple[str, ...], kinds: Sequence[type[Any]], comment: str) -> _Line:
    text = f"# [{'.'.join(path)}]" if kinds else f"# {path[-1]} ="
    return _Line(key=path[-1], text=text, value=None, comment=comment or "; ".join(map(headline, kinds)))


def _about_entries(kinds: Sequence[type[Any]]) -> tuple[str, ...]:
    """The comments of the tables in a small list; of several kinds the fields' names alone."""
    lines = []
    for kind in kinds:
        if len(kinds) > 1:
            names = (_labelled(name, info) for name, info in sorted(fields_of(kind).items(), key=_type_first))
            lines += textwrap.wrap(
                f"{{{', '.join(names)}}}: {headline(kind)}", WIDTH - 2, subsequent_indent="  ", break_on_hyphens=False
            )
            continue
        width = max(map(len, fields_of(kind)))
        lines += textwrap.wrap(f"each {{{', '.join(fields_of(kind))}}}: {headline(kind)}", WIDTH - 2)
        lines += [f"  {name:<{width}}  {info.description or ''}" for name, info in fields_of(kind).items()]
    return tuple(lines)


def _type_first(field: tuple[str, FieldInfo]) -> bool:
    return field[0] != "type"


def _labelled(name: str, info: FieldInfo) -> str:
    """A field's name, and of one that distinguishes types its value too."""
    choices = get_args(info.annotation) if get_origin(info.annotation) is Literal else ()
    return f'{name} = "{choices[0]}"' if name == "type" and len(choices) == 1 else name


def _item(value: Any) -> Item:
    """A number, a text, or a list or small table of them."""
    if is_table(type(value)):
        value = {name: entry for name in fields_of(type(value)) if not is_absent(entry := getattr(value, name))}
    if isinstance(value, Mapping):
        table = tomlkit.inline_table()
        for name, entry in value.items():
            table.append(name, _item(entry))
        return table
    if isinstance(value, list | tuple):
        array = tomlkit.array()
        for entry in value:
            array.append(_item(entry))
        return array.multiline(len(array.as_string()) > _LONG)
    return tomlkit.item(value)


def _write(container: Container | Table, lines: Sequence[_Line]) -> None:
    """Put fields into a table, their comments one below the other."""
    widths = [len(line.text) for line in lines if line.comment]
    column = max([_NEAREST, *(width for width in widths if width <= _FARTHEST)])
    for line in lines:
        for text in line.above:
            container.add(tomlkit.comment(text))
        space, beside = _space(line.text, column), line.comment
        if "\n" in line.text or len(f"{line.text}{space}# {beside}") > WIDTH:
            beside = ""
            for text in textwrap.wrap(line.comment, WIDTH - 2):
                container.add(tomlkit.comment(text))
        if line.value is None:
            container.add(tomlkit.comment(line.text.removeprefix("# ") + (f"{space}# {beside}" if beside else "")))
            continue
        if beside:
            line.value.comment(beside)
            line.value.trivia.comment_ws = space
        container.append(line.key, line.value)


def _space(text: str, column: int) -> str:
    return " " * (max(column - len(text), 0) + 2)


def _squeezed(text: str) -> str:
    """A text with single spaces, on one line."""
    return " ".join(text.split())
