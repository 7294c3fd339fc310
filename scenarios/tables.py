"""Which kinds of table a field of the scenario file may hold, and what they are."""

from __future__ import annotations

from typing import Any, get_args

from pydantic import BaseModel


def headline(model: type[BaseModel]) -> str:
    """What a table is, in one line: the first of its class's docstring, less its full stop."""
    return (model.__doc__ or "").strip().partition("\n")[0].removesuffix(".")


def tables_in(annotation: Any) -> tuple[type[BaseModel], ...]:
    """The kinds of table that a field's type is or holds: several for a union of them, none for numbers and texts."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return (annotation,)
    return tuple(model for argument in get_args(annotation) for model in tables_in(argument))
