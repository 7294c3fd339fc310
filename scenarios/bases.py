"""`base = "paper-constrained"`: a scenario file that says only how it differs from another one."""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from quadsim.assets import read_toml
from quadsim.errors import FileError, ParameterError


def read_scenario(path: Path, find: Callable[[str], Path], *, above: tuple[Path, ...] = ()) -> dict[str, Any]:
    """A scenario file's tables, merged over those of its base, and that one's base, and so on.

    Args:
        path: the file.
        find: from a name to the file it means; see `scenarios.loading.scenario_path`.
        above: the files that led here.

    Raises:
        FileError: a file is missing, is not TOML, or is its own base in the end.
        ParameterError: `base` is not a text.
    """
    data = read_toml(path)
    if "base" not in data:
        return data
    name = data.pop("base")
    if not isinstance(name, str):
        raise ParameterError(path.name, "base", name, "a scenario's name or a path ending in .toml")
    beside = path.parent / name
    base = beside if name.endswith(".toml") and beside.is_file() else find(name)
    chain = (*above, path.resolve())
    if base.resolve() in chain:
        raise FileError(path, f"is its own base: {' -> '.join([*(file.name for file in chain), base.name])}")
    inherited = read_scenario(base, find, above=chain)
    _locate(inherited, base.parent)
    # The base's place in the library is its own.
    return merge({key: value for key, value in inherited.items() if key not in ("group", "expect")}, data)


def merge(base: Mapping[str, Any], over: Mapping[str, Any]) -> dict[str, Any]:
    """One table over another, field by field.

    A table of another `type` replaces the base's; entries of a list that have names are merged by name, new ones come
    after them; every other value replaces the base's.
    """
    merged = dict(copy.deepcopy(dict(base)))
    for key, value in over.items():
        before = merged.get(key)
        if (
            isinstance(before, dict)
            and isinstance(value, dict)
            and value.get("type", before.get("type")) == before.get("type")
        ):
            merged[key] = merge(before, value)
        elif isinstance(before, list) and _named(before) and _named(value):
            entries = {entry["name"]: entry for entry in before}
            entries |= {entry["name"]: merge(entries.get(entry["name"], {}), entry) for entry in value}
            merged[key] = list(entries.values())
        else:
            merged[key] = copy.deepcopy(value)
    return merged


def _named(value: Any) -> bool:
    """Whether a value is a list of tables that all have names."""
    return (
        isinstance(value, list) and bool(value) and all(isinstance(entry, dict) and "name" in entry for entry in value)
    )


def _locate(data: dict[str, Any], directory: Path) -> None:
    """Make paths that are relative to a base's folder independent of it."""
    for table, field in (("vehicle", "file"), ("reference", "file")):
        file = data.get(table, {}).get(field) if isinstance(data.get(table), dict) else None
        if isinstance(file, str) and (directory / file).is_file():
            data[table][field] = str((directory / file).resolve())
