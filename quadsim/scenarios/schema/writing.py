"""A scenario as commented TOML: every field with its unit and meaning, the descriptions of `quadsim.scenarios.schema`.

What is written parses to the same scenario, and equal scenarios give equal texts.  What is not stated stands in
comments: a field that may be absent, and is, an absent table with its defaults, and a derived value with the word
`derived`.  A field is explained where its kind of table first occurs.
"""

from __future__ import annotations

import math
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Final, Literal, get_args, get_origin

import tomlkit
from pydantic.fields import FieldInfo
from pydantic_core import PydanticUndefined

from quadsim.scenarios.schema.base import fields_of, is_table

WIDTH: Final = 120
"""Longest line with a comment; a comment that does not fit beside its field is written above it."""
_LONG: Final = 76  # a list that is longer takes a line per entry


def headline(model: type[Any]) -> str:
    """Return the first line of a table class's docstring, without its full stop."""
    return (model.__doc__ or "").strip().partition("\n")[0].removesuffix(".")


def tables_in(annotation: Any) -> tuple[type[Any], ...]:
    """Return the table classes in a field's type: several for a union, none for numbers and texts."""
    if is_table(annotation):
        return (annotation,)
    return tuple(model for argument in get_args(annotation) for model in tables_in(argument))


def is_absent(value: object) -> bool:
    """Return whether a file leaves out a field with this value: None, or an infinite bound."""
    return value is None or (isinstance(value, float) and math.isinf(value))


def plain(value: Any) -> Any:
    """Return tables and lists as in JSON and TOML, without absent fields."""
    if is_table(type(value)):
        value = {name: getattr(value, name) for name in fields_of(type(value))}
    if isinstance(value, Mapping):
        return {name: plain(entry) for name, entry in value.items() if not is_absent(entry)}
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
    lines = _lines(model, "", set(), plain(model) if stated is None else stated, recorded or {})
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
    for name, field in sorted(fields_of(kind).items(), key=_type_first):
        value = getattr(model, name)
        if value == field.get_default(call_default_factory=True) and name != "type":
            continue
        comment = ""
        if (kind, name) not in explained:
            comment = " ".join((field.description or "").split())
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


def _lines(
    model: Any, path: str, explained: set[object], stated: Mapping[str, Any], recorded: Mapping[str, str]
) -> Iterator[str]:
    """Yield the lines of a table: numbers, texts and small lists, then its subtables, in order of declaration."""
    below: list[tuple[str, Any, str]] = []
    for name, field in sorted(fields_of(type(model)).items(), key=_type_first):
        value = getattr(model, name)
        kinds = tables_in(field.annotation)
        is_new = (type(model), name) not in explained
        explained.add((type(model), name))
        if is_new:
            comment = " ".join((field.description or "").split())
        else:
            comment = ""
        if is_table(type(value)):
            below.append((name, value, comment or headline(type(value)) if is_new else ""))
        elif isinstance(value, Mapping) or (value and kinds and not path):
            below.append((name, value, comment))
        elif is_absent(value) and kinds:
            if is_new:
                below.append((name, None, comment or "; ".join(map(headline, kinds))))
        elif is_absent(value):
            yield from _commented(f"# {name} =", comment) if is_new else ()
        elif name not in stated:
            yield from _commented(_unstated(_pair(name, value)), _labelled_as("derived", comment))
        else:
            yield from _about_entries(kinds) if kinds not in explained else ()
            explained.add(kinds)
            source = recorded.get(f"{path}{name}")
            yield from _commented(_pair(name, value), _labelled_as(f"of {source}", comment) if source else comment)
    for name, value, comment in below:
        if value is None:
            field = fields_of(type(model))[name]
            yield from _absent(f"{path}{name}", tables_in(field.annotation), comment, explained)
        elif isinstance(value, list | tuple):
            yield from ["", *_wrapped(comment)]
            several = len({type(entry) for entry in value}) > 1
            for entry in value:
                if (several or not comment) and type(entry) not in explained:
                    about = headline(type(entry))
                else:
                    about = ""
                explained.add(type(entry))
                lines = _lines(entry, f"{name}.", explained, plain(entry), recorded)
                yield from ["", *_commented(f"[[{name}]]", about), *lines]
        elif isinstance(value, Mapping):
            yield from ["", *_commented(f"[{path}{name}]", comment)]
            yield from (_pair(key, entry) for key, entry in value.items())
        elif name in stated:
            yield from ["", *_commented(f"[{path}{name}]", comment)]
            yield from _lines(value, f"{path}{name}.", explained, stated[name], recorded)
        else:
            yield from ["", *_commented(f"# [{path}{name}]", _labelled_as("derived", comment))]
            yield from _lines(value, f"{path}{name}.", explained, {}, recorded)


def _absent(path: str, kinds: Sequence[type[Any]], comment: str, explained: set[object]) -> Iterator[str]:
    """Yield an absent table in comments: its fields with their defaults, then its subtables."""
    yield from ["", *_commented(f"# [{path}]", comment)]
    if len(kinds) > 1:
        yield from _about_entries(kinds)
        return
    (kind,) = kinds
    below: list[tuple[str, tuple[type[Any], ...], str]] = []
    for name, field in sorted(fields_of(kind).items(), key=_type_first):
        is_new = (kind, name) not in explained
        explained.add((kind, name))
        if is_new:
            about = " ".join((field.description or "").split())
        else:
            about = ""
        default = field.get_default(call_default_factory=True)
        tables = tables_in(field.annotation)
        if tables and not isinstance(default, list | tuple):
            below.append((name, tables, about or "; ".join(map(headline, tables)) if is_new else ""))
        elif default is PydanticUndefined or is_absent(default):
            yield from _commented(f"# {name} =", about)
        else:
            yield from _commented(_unstated(_pair(name, plain(default))), about)
    for name, tables, about in below:
        yield from _absent(f"{path}.{name}", tables, about, explained)


def _unstated(text: str) -> str:
    """Return lines of TOML as comments."""
    return "\n".join(f"# {line}" for line in text.split("\n"))


def _labelled_as(label: str, comment: str) -> str:
    if comment:
        return f"{label}; {comment}"
    return label


def _about_entries(kinds: Sequence[type[Any]]) -> Iterator[str]:
    """Yield the comments on the tables in a small list; for several kinds only the fields' names."""
    for kind in kinds:
        if len(kinds) > 1:
            names = ", ".join(_labelled(name, info) for name, info in sorted(fields_of(kind).items(), key=_type_first))
            yield from _wrapped(f"{{{names}}}: {headline(kind)}", subsequent_indent="  ", break_on_hyphens=False)
            continue
        width = max(map(len, fields_of(kind)))
        yield from _wrapped(f"each {{{', '.join(fields_of(kind))}}}: {headline(kind)}")
        yield from (f"#   {name:<{width}}  {info.description or ''}" for name, info in fields_of(kind).items())


def _type_first(field: tuple[str, FieldInfo]) -> bool:
    return field[0] != "type"


def _labelled(name: str, info: FieldInfo) -> str:
    """Return a field's name; for a type field with its value."""
    if get_origin(info.annotation) is Literal:
        choices = get_args(info.annotation)
    else:
        choices = ()
    if name == "type" and len(choices) == 1:
        return f'{name} = "{choices[0]}"'
    return name


def _pair(name: str, value: Any) -> str:
    return f"{tomlkit.key(name).as_string()} = {_text(value)}"


def _text(value: Any) -> str:
    """Return a number, a text, a list or a small table as TOML."""
    if is_table(type(value)):
        value = {name: entry for name in fields_of(type(value)) if not is_absent(entry := getattr(value, name))}
    if isinstance(value, Mapping):
        return f"{{{', '.join(_pair(name, entry) for name, entry in value.items())}}}"
    if isinstance(value, list | tuple):
        entries = [*map(_text, value)]
        line = f"[{', '.join(entries)}]"
        if len(line) <= _LONG:
            return line
        return "[\n" + "".join(f"    {entry},\n" for entry in entries) + "]"
    return tomlkit.item(value).as_string()


def _commented(text: str, comment: str) -> list[str]:
    """Return a line with its comment beside it, or above it if it is long."""
    line = f"{text}  # {comment}" if comment else text
    if len(line) <= WIDTH and "\n" not in text:
        return [line]
    return [*_wrapped(comment), text]


def _wrapped(comment: str, **options: Any) -> list[str]:
    return [f"# {line}" for line in textwrap.wrap(comment, WIDTH - 2, **options)]
