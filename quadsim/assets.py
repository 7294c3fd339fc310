"""The data files: where they are, in a wheel or in a checkout, and how they are read."""

from __future__ import annotations

import os
import tomllib
from pathlib import Path
from typing import Any

from quadsim.errors import FileError, UnknownNameError


def models_dir() -> Path:
    """The folder with `quadrotor.xml` and the vehicle files."""
    package = Path(__file__).resolve().parent
    for candidate in (package / "models", package.parent / "models"):
        if (candidate / "quadrotor.xml").is_file():
            return candidate
    raise FileError(package / "models", "quadrotor.xml is missing: the installation is incomplete, reinstall quadsim")


def own_packages() -> dict[str, str]:
    """The entry of its environment by which a child process finds quadsim where this one did."""
    folders = (str(Path(__file__).resolve().parents[1]), os.environ.get("PYTHONPATH"))
    return {"PYTHONPATH": os.pathsep.join(filter(None, folders))}


def vehicle_names() -> list[str]:
    """Names of the vehicles that ship, sorted."""
    return sorted(path.stem for path in models_dir().glob("*.toml"))


def vehicle_path(name: str) -> Path:
    """The vehicle file for a shipped name or a path ending in `.toml`.

    Raises:
        FileError, UnknownNameError: there is none.
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
    """A TOML file's tables.

    Raises:
        FileError: it is missing, unreadable or not TOML.
    """
    try:
        return tomllib.loads(path.read_text(encoding="utf-8-sig"))
    except (OSError, UnicodeDecodeError) as error:
        raise FileError(path, f"cannot be read ({error})") from error
    except (ValueError, RecursionError) as error:  # also numbers and nesting beyond what Python reads
        raise FileError(path, f"is not valid TOML: {error}") from error
