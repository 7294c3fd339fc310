"""The form of data that a file holds: whatever wrote it, what is read has the declared types.

A form is a type, a tuple of forms of which one has to fit, a list of one form for each entry, a mapping for a table
with these fields at least, or `Each` for a table of any names.  A number is finite; true and false are none.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import NoneType
from typing import Any, Final

from quadsim.errors import FileError, printable

NUMBER: Final = float  # whole numbers too
MAYBE_NUMBER: Final = (float, NoneType)
MAYBE_TEXT: Final = (str, NoneType)
LARGEST_FILE: Final = 64_000_000  # size [bytes] of the largest file that is read
LARGEST_NUMBER: Final = 1e300  # beyond, a unit's factor makes it infinite
MOST_NAMED: Final = 10  # entries that one message names


@dataclass(frozen=True)
class Each:
    """A table of any names, whose values all have one form."""

    form: Any


@dataclass(frozen=True)
class Optional:
    """A field that may be missing; where it is there, it has this form."""

    form: Any


def misfits(value: Any, form: Any, name: str = "") -> Iterator[str]:
    """Names, with dots, of what does not have its form; the whole is called `it`."""
    if isinstance(form, Mapping) and isinstance(value, dict):
        for key, inner in form.items():
            place = f"{name}.{key}" if name else key
            if key in value:
                yield from misfits(value[key], inner.form if isinstance(inner, Optional) else inner, place)
            elif not isinstance(inner, Optional):
                yield place
    elif isinstance(form, Each) and isinstance(value, dict):
        for key, each in value.items():
            yield from misfits(each, form.form, f"{name}.{key}")
    elif isinstance(form, list) and isinstance(value, list):
        for i, each in enumerate(value):
            yield from misfits(each, form[0], f"{name}.{i}")
    elif isinstance(form, tuple):
        if all(any(True for _ in misfits(value, one)) for one in form):
            yield name or "it"
    elif not (isinstance(form, type) and _is(value, form)):
        yield name or "it"


def _is(value: Any, kind: type) -> bool:
    if kind in (int, float):
        whole = isinstance(value, int) and not isinstance(value, bool)
        return (whole or (kind is float and isinstance(value, float))) and abs(value) <= LARGEST_NUMBER
    return isinstance(value, kind)


def read_json(path: Path, form: Mapping[str, Any], what: str) -> dict[str, Any]:
    """A JSON object of a form from a file of quadsim's; messages call the file `what`.

    Raises:
        FileError: it cannot be read, is no strict JSON in Unicode, names an entry twice, or an entry is missing or of
            another form.
    """
    try:
        if path.stat().st_size > LARGEST_FILE:
            raise FileError(path, f"is not {what}: it must be of {LARGEST_FILE} or fewer bytes")
        found = json.loads(path.read_text(encoding="utf-8"), parse_constant=_refuse, object_pairs_hook=_table)
        json.dumps(found, ensure_ascii=False, allow_nan=False).encode()
    except (OSError, RecursionError, ValueError) as error:
        if isinstance(error, FileError):
            raise
        reason = "it is nested too deep" if isinstance(error, RecursionError) else printable(str(error))[:200]
        raise FileError(path, f"is not {what} ({reason})") from error
    if not isinstance(found, dict):
        raise FileError(path, f"is not {what}: it is no table")
    if wrong := [printable(name)[:100] for name in misfits(found, form)]:
        more = f" and {len(wrong) - MOST_NAMED} more" if len(wrong) > MOST_NAMED else ""
        raise FileError(path, f"is not {what}: it lacks or misstates {', '.join(wrong[:MOST_NAMED])}{more}")
    return found


def _refuse(constant: str) -> None:
    raise ValueError(f"{constant} is no number of JSON")


def _table(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    table = dict(pairs)
    if len(table) < len(pairs):
        names = [name for name, _ in pairs]
        raise ValueError(f"{next(name for name in names if names.count(name) > 1)!r:.100} is there twice")
    return table
