"""Places in a scenario file: from pydantic's path to the name a person would use, and to what may stand there.

Pydantic's paths also hold labels of its own: after a field that may be one of several kinds of table comes the tag of
the kind that was chosen, e.g. `controller.constrained.horizon`, and after a key that is wrong itself comes `[key]`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from annotated_types import Len, MaxLen, MinLen
from pydantic import BaseModel, Tag


@dataclass(frozen=True, kw_only=True)
class Kind:
    """One of the types that a value may have.

    Attributes:
        type: less its annotations.
        metadata: these annotations.
    """

    type: Any
    metadata: tuple[Any, ...] = ()

    @property
    def fields(self) -> tuple[str, ...]:
        """Names of the fields, of a table."""
        is_table = isinstance(self.type, type) and issubclass(self.type, BaseModel)
        return tuple(self.type.model_fields) if is_table else ()

    @property
    def labels(self) -> set[str]:
        """What pydantic calls this kind among several."""
        tags = {note.tag for note in self.metadata if isinstance(note, Tag)}
        if "type" in self.fields and get_origin(choice := self.type.model_fields["type"].annotation) is Literal:
            tags |= {*get_args(choice)}
        return tags or {getattr(self.type, "__name__", "")}


@dataclass(frozen=True, kw_only=True)
class Place:
    """A place in the file.

    Attributes:
        names: from the root; an entry of a list by its name, or else by its index.
        kinds: what may stand there; none where nothing may.
    """

    names: tuple[str, ...]
    kinds: tuple[Kind, ...]

    @property
    def fields(self) -> tuple[str, ...]:
        """Names of all fields of the tables that may stand there."""
        return tuple(dict.fromkeys(name for kind in self.kinds for name in kind.fields))

    @property
    def exact_length(self) -> int | None:
        """How long a list has to be, where that is one number."""
        for kind in self.kinds:
            notes = kind.metadata if kind.type is list or get_origin(kind.type) is list else ()
            shortest = {note.min_length for note in notes if isinstance(note, Len | MinLen)}
            longest = {note.max_length for note in notes if isinstance(note, Len | MaxLen)}
            if shortest and shortest == longest:
                return int(shortest.pop())
        return None

    @property
    def entries(self) -> str:
        """What a list there holds."""
        held = {entry.type for kind in self.kinds if get_origin(kind.type) is list for entry in _entries(kind)}
        return "numbers" if held <= {float, int} else "texts" if held == {str} else "entries"


def find(path: Sequence[int | str], data: Any, root: type[BaseModel]) -> Place:
    """The place of a path of pydantic's in a file that is to be a `root`."""
    names: list[str] = []
    kinds: tuple[Kind, ...] = (Kind(type=root),)
    for part in path:
        named = tuple(kind for kind in kinds if part in kind.labels)
        fields = [kind.type.model_fields[part] for kind in kinds if part in kind.fields]
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
    return Place(names=tuple(names), kinds=kinds)


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
    return kinds_of(get_args(kind.type)[-1]) if get_origin(kind.type) in (list, dict) else ()
