"""The data files, in a wheel or a checkout, and how to read them."""

from __future__ import annotations

import os
import re
import tomllib
from collections.abc import Iterable
from pathlib import Path
from typing import Any, Final

from quadsim.errors import FileError, InputError, UnknownNameError
from quadsim.input_limits import LARGEST_TOML, MOST_ASSIGNMENTS, MOST_ENTRIES

DEEPEST: Final = 20  # deepest nesting of tables and lists; a scenario has a third of it
_KEY: Final = r"""(?:[\w-]++|"(?:[^"\\\n]|\\.)*+"|'[^'\n]*+')"""
_TOO_DEEP: Final = re.compile(rf"(?<![\w-]){_KEY}(?:[ \t]*+\.[ \t]*+{_KEY}){{{DEEPEST}}}")


def models_dir() -> Path:
    """Return the folder with `quadrotor.xml` and the vehicle files."""
    package = Path(__file__).resolve().parent
    for candidate in (package / "models", package.parent / "models"):
        if (candidate / "quadrotor.xml").is_file():
            return candidate
    raise FileError(package / "models", "quadrotor.xml is missing: the installation is incomplete, reinstall quadsim")


def own_packages() -> dict[str, str]:
    """Return the environment entry by which a child process finds this quadsim."""
    folders = (str(Path(__file__).resolve().parents[1]), os.environ.get("PYTHONPATH"))
    return {"PYTHONPATH": os.pathsep.join(filter(None, folders))}


def library_dir() -> Path:
    """Return the folder of the shipped flights, campaigns and papers: `scenarios` of a checkout, else in the wheel."""
    package = Path(__file__).resolve().parent
    for candidate in (package / "library", package.parent / "scenarios"):
        if (candidate / "variants.toml").is_file():
            return candidate
    raise FileError(package / "library", "variants.toml is missing: the installation is incomplete, reinstall quadsim")


def vehicle_names() -> list[str]:
    """Return the names of the shipped vehicles, sorted."""
    return sorted(path.stem for path in models_dir().glob("*.toml"))


def vehicle_path(name: str) -> Path:
    """Return the vehicle file of a shipped name, or a path ending in `.toml`.

    Raises:
        FileError, UnknownNameError: it does not exist.
    """
    if name.endswith(".toml"):
        if not Path(name).is_file():
            raise FileError(name, "no such vehicle file")
        return Path(name)
    path = models_dir() / f"{name}.toml"
    if not path.is_file():
        raise UnknownNameError("vehicle", name, vehicle_names(), hint="or give a path ending in .toml")
    return path


def read_toml(path: Path) -> dict[str, Any]:
    """Read a TOML file's tables.

    Raises:
        FileError: it is missing, unreadable, too large or not TOML.
    """
    try:
        if (size := path.stat().st_size) > LARGEST_TOML:
            raise FileError(path, f"must be of {LARGEST_TOML} or fewer bytes; got {size}")
        text = path.read_text(encoding="utf-8-sig")
        if (count := text.count("=")) > MOST_ASSIGNMENTS:  # before tomllib takes its time
            raise FileError(path, f"must assign at most {MOST_ASSIGNMENTS} values; it has {count} equals signs")
        return parse_toml(text)
    except FileError:
        raise
    except (OSError, UnicodeDecodeError) as error:
        raise FileError(path, f"cannot be read ({error})") from error
    except InputError as error:
        raise FileError(path, str(error)) from None
    except ValueError as error:  # includes numbers that Python cannot read
        raise FileError(path, f"is not valid TOML: {error}") from None


def parse_toml(text: str) -> dict[str, Any]:
    """Parse the tables of a TOML text.

    Raises:
        InputError: they are nested too deep, or one is too large.
        ValueError: it is not TOML.
    """
    deeper = InputError(f"must nest tables and lists at most {DEEPEST} deep")
    if _TOO_DEEP.search(text):  # tomllib needs gigabytes for a key of 40 000 dots
        raise deeper
    try:
        data = tomllib.loads(text)
    except RecursionError:
        raise deeper from None
    if _is_deeper(data, DEEPEST):
        raise deeper
    _require_small(data)
    return data


def _require_small(table: Any, name: str = "") -> None:
    """Refuse tables with more keys than any has."""
    if isinstance(table, dict) and len(table) > MOST_ENTRIES:
        raise InputError(f"{name or 'the file'} must have {MOST_ENTRIES} or fewer keys; got {len(table)}")
    entries: Iterable[tuple[object, Any]] = enumerate(table)
    if isinstance(table, dict):
        entries = table.items()
    for key, entry in entries:
        if isinstance(entry, dict | list):
            _require_small(entry, f"{name}.{key}".removeprefix("."))


def _is_deeper(value: Any, levels: int) -> bool:
    """Return whether tables and lists are nested more than `levels` deep."""
    layer = [value]
    for _ in range(levels + 1):
        deeper: list[Any] = []
        for table in layer:
            if isinstance(table, dict):
                deeper += table.values()
            elif isinstance(table, list):
                deeper += table
        layer = deeper
    return bool(layer)
