"""`base = "paper-constrained"`: a scenario file with only its differences from another one."""

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


def locate_files(data: dict[str, Any], directory: Path) -> None:
    """Make paths that are relative to a file's folder independent of it, in place."""
    for name, ending in (("vehicle", ".toml"), (RECORDED, ".toml"), ("reference", "")):
        if isinstance(data.get(name), dict):
            file = data[name].get("file")
        else:
            file = None
        if isinstance(file, str) and file.endswith(ending) and (directory / file).is_file():
            data[name]["file"] = str((directory / file).resolve())
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
    data = _read(path)
    if "base" not in data:
        return data
    name = data.pop("base")
    if not isinstance(name, str):
        raise ParameterError(path.name, "base", name, "a scenario's name or a path ending in .toml")
    base = _find_base(path, name, find)
    base_file, _ = base
    chain = (*above, path.resolve())
    if base_file.resolve() in chain:
        raise FileError(path, f"is its own base: {' -> '.join([*(file.name for file in chain), source_label(base)])}")
    if len(chain) > DEEPEST:
        raise FileError(path, f"must have at most {DEEPEST} bases above one another")
    inherited = read_merged(base, find, locate, chain)
    locate(inherited, base_file.parent)
    if "controller" in data:
        state_bounds(inherited, data["controller"])
    # Group and expected verdict are not inherited.
    merged = merge({key: value for key, value in inherited.items() if key not in ("group", "expect")}, data)
    if "description" not in data:
        note_changes(merged, data)
    return merged


def _find_base(path: Path, name: str, find: Callable[[str], Source]) -> Source:
    """Return where a base is: beside the file that names it, or in the library."""
    beside = path.parent / name
    return find(str(beside) if name.endswith(".toml") and beside.is_file() else name)


def replaced_tables(path: Path) -> dict[str, str]:
    """Return, by name, tables that replace the base's because their `type` differs: the old type and its file."""
    data = _read(path)
    if "base" not in data:
        return {}
    base = _find_base(path, data["base"], scenario_source)
    before = retyped(read_merged(base, scenario_source, locate_files), data)
    base_file, _ = base
    return replaced_tables(base_file) | {name: f"{kind!r} in {source_label(base)}" for name, kind in before.items()}


def retyped(before: Mapping[str, Any], after: Mapping[str, Any]) -> dict[str, str]:
    """Return the former type of each table whose type changes, by the table's name."""
    kinds = {}
    for name, table in before.items():
        if isinstance(table, dict) and "type" in table:
            kinds[name] = table["type"]
    now = {}
    for name, table in after.items():
        if isinstance(table, dict):
            now[name] = table.get("type", kinds.get(name))
    return {name: kind for name, kind in kinds.items() if name in now and now[name] != kind}


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
    merged = copy.deepcopy(dict(base))
    for key, value in over.items():
        before = merged.get(key)
        if (
            isinstance(before, dict)
            and isinstance(value, dict)
            and value.get("type", before.get("type")) == before.get("type")
        ):
            merged[key] = _merge(before, value)
        elif isinstance(before, list) and _named(before) and _named(value):
            entries = {entry["name"]: entry for entry in before}
            entries |= {
                entry["name"]: _merge(_restated(entries.get(entry["name"], {}), entry), entry) for entry in value
            }
            merged[key] = list(entries.values())
        else:
            merged[key] = copy.deepcopy(value)
    return merged


def _restated(before: Mapping[str, Any], entry: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return the base's entry, without its tolerances if the entry over it states bounds or tolerances."""
    if not {"lower", "upper", *_TOLERANCES} & entry.keys():
        return before
    return {key: value for key, value in before.items() if key not in _TOLERANCES}


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
