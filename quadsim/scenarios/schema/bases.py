"""`base = "paper-constrained"`: a scenario file with only its differences from another one.

`read_scenario` reads a file, its base, the base of that and so on, and merges their tables field by field (`merge`);
`quadsim.scenarios.loading` parses the result.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Final

from quadsim.assets import DEEPEST, read_toml
from quadsim.errors import FileError, InputError, ParameterError
from quadsim.scenarios.catalogue import VARIANTS, Source, scenario_source, source_label
from quadsim.scenarios.plugin import located
from quadsim.scenarios.schema.settings import RECORDED, leaves, note_changes, restate, set_field, state_bounds

_TOLERANCES: Final = ("tolerance", "tolerance_sampled")
_NOT_INHERITED: Final = ("group", "expect")
"""Fields that a file does not take from its base."""


def locate_files(data: dict[str, Any], directory: Path) -> None:
    """Make paths that are relative to a file's folder independent of it, in place."""
    for name, ending in (("vehicle", ".toml"), (RECORDED, ".toml"), ("reference", "")):
        table = data.get(name)
        if not isinstance(table, dict):
            continue
        file = table.get("file")
        if isinstance(file, str) and file.endswith(ending) and (directory / file).is_file():
            table["file"] = str((directory / file).resolve())
    if "controller" in data:
        data["controller"] = located(data["controller"], directory)
    if isinstance(data.get("forces"), list):
        data["forces"] = [located(force, directory) for force in data["forces"]]


def read_scenario(name: str) -> dict[str, Any]:
    """Return a scenario's tables, by its name or file: merged over its base, and so on; those of a variant changed.

    Raises:
        FileError: a file is missing, too large, is not TOML, or is its own base in the end; a variant sets what cannot
            be set.
        ParameterError: `base` is not a text.
    """
    return read_merged(scenario_source(name), scenario_source, locate_files)


def read_merged(
    source: Source,
    find: Callable[[str], Source],
    locate: Callable[[dict[str, Any], Path], None],
    above: tuple[Path, ...] = (),
) -> dict[str, Any]:
    """Return tables, merged over their base, the base of that, and so on.

    `find` gives what a name means; `locate` makes the paths in a base independent of its folder, in place; `above` are
    the files that led here.

    Raises:
        FileError, ParameterError: as `read_scenario`.
    """
    file, changes = source
    data = _merged(file, find, locate, above)
    for field, value in changes.items():
        try:
            set_field(data, field, value, source="set")
        except InputError as error:
            raise FileError(VARIANTS, f"{changes['name']}.set.{field}: {error}") from None
    return data


def _merged(
    path: Path,
    find: Callable[[str], Source],
    locate: Callable[[dict[str, Any], Path], None],
    above: tuple[Path, ...],
) -> dict[str, Any]:
    """Return the tables of a file, merged over its base; arguments as of `read_merged`."""
    data = _read(path)
    if "base" not in data:
        return data
    name = data.pop("base")
    if not isinstance(name, str):
        raise ParameterError(path.name, "base", name, "a scenario's name or a path ending in .toml")
    base = _find_base(path, name, find)
    base_file, _ = base
    chain = (*above, path.resolve())
    _check_chain(path, chain, base)
    inherited = read_merged(base, find, locate, chain)
    locate(inherited, base_file.parent)
    if "controller" in data:
        state_bounds(inherited, data["controller"])
    for key in _NOT_INHERITED:
        inherited.pop(key, None)
    merged = merge(inherited, data)
    if "description" not in data:
        note_changes(merged, data)
    return merged


def _check_chain(path: Path, chain: tuple[Path, ...], base: Source) -> None:
    """Refuse a base that is among the files that led to it, and too many of them."""
    base_file, _ = base
    if base_file.resolve() in chain:
        labels = [file.name for file in chain]
        labels.append(source_label(base))
        raise FileError(path, f"is its own base: {' -> '.join(labels)}")
    if len(chain) > DEEPEST:
        raise FileError(path, f"must have at most {DEEPEST} bases above one another")


def _find_base(path: Path, name: str, find: Callable[[str], Source]) -> Source:
    """Return where a base is: beside the file that names it, or in the library."""
    beside = path.parent / name
    if name.endswith(".toml") and beside.is_file():
        return find(str(beside))
    return find(name)


def replaced_tables(path: Path) -> dict[str, str]:
    """Return, by name, tables that replace the base's because their `type` differs: the old type and its file."""
    data = _read(path)
    if "base" not in data:
        return {}
    base = _find_base(path, data["base"], scenario_source)
    inherited = read_merged(base, scenario_source, locate_files)
    base_file, _ = base
    replaced = replaced_tables(base_file)
    for name, kind in retyped(inherited, data).items():
        replaced[name] = f"{kind!r} in {source_label(base)}"
    return replaced


def retyped(before: Mapping[str, Any], after: Mapping[str, Any]) -> dict[str, str]:
    """Return the former type of each table whose type changes, by the table's name."""
    former = {}
    for name, table in before.items():
        over = after.get(name)
        if isinstance(table, dict) and isinstance(over, dict) and "type" in table:
            kind = table["type"]
            if over.get("type", kind) != kind:
                former[name] = kind
    return former


def read_whole(path: Path) -> dict[str, Any]:
    """Return the tables of a scenario file without a base, as in a run directory; no other file is read.

    Raises:
        FileError: it cannot be read, or has a base.
    """
    data = _read(path)
    if "base" in data:
        raise FileError(path, "has a base, and a run's scenario is whole")
    return data


def merge(base: Mapping[str, Any], over: Mapping[str, Any]) -> dict[str, Any]:
    """Merge a file's tables over another's, field by field; with what they replace goes what repeats it (`restate`).

    A table of another `type` replaces the base's; entries of a list that have names are merged by name, new ones come
    after them; every other value replaces the base's.  A base's tolerances belong to the base's bounds: they survive
    only in an entry that states neither bounds nor tolerances.
    """
    merged = copy.deepcopy(dict(base))
    for path, value in leaves(over):
        restate(merged, path, value)
    return _merge(merged, over)


def _merge(base: Mapping[str, Any], over: Mapping[str, Any]) -> dict[str, Any]:
    """Merge tables as `merge`, after what repeats a replaced value has been dropped."""
    merged = copy.deepcopy(dict(base))
    for key, value in over.items():
        before = merged.get(key)
        if isinstance(before, dict) and isinstance(value, dict) and _are_of_one_type(before, value):
            merged[key] = _merge(before, value)
        elif isinstance(before, list) and _named(before) and _named(value):
            merged[key] = _merge_entries(before, value)
        else:
            merged[key] = copy.deepcopy(value)
    return merged


def _are_of_one_type(before: Mapping[str, Any], over: Mapping[str, Any]) -> bool:
    """Return whether a table states no other type than the one that it is merged over."""
    return bool(over.get("type", before.get("type")) == before.get("type"))


def _merge_entries(base: list[dict[str, Any]], over: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Merge lists of tables by the tables' names."""
    entries: dict[str, dict[str, Any]] = {entry["name"]: entry for entry in base}
    for entry in over:
        name = entry["name"]
        before = entries.get(name, {})
        if {"lower", "upper", *_TOLERANCES} & entry.keys():  # the base's tolerances belong to the base's bounds
            before = {key: value for key, value in before.items() if key not in _TOLERANCES}
        entries[name] = _merge(before, entry)
    return list(entries.values())


def _read(path: Path) -> dict[str, Any]:
    """Return a file's tables."""
    data = read_toml(path)
    if isinstance(data.get("controller"), str):  # its name alone, which a table over it, or a setting, adds to
        data["controller"] = {"type": data["controller"]}
    return data


def _named(value: Any) -> bool:
    """Return whether a value is a list of tables with distinct names."""
    if not (isinstance(value, list) and value and all(isinstance(entry, dict) for entry in value)):
        return False
    names = [entry.get("name") for entry in value]
    return all(isinstance(name, str) for name in names) and len(set(names)) == len(names)
