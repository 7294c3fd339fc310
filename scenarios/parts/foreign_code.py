"""Foreign code: where it is found and what it is, known before any of it runs."""

from __future__ import annotations

import contextlib
import hashlib
import importlib
import logging
import sys
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from importlib import metadata
from importlib.machinery import ModuleSpec
from pathlib import Path
from typing import Final

from scenarios.schema.plugin import ENTRY_POINTS, ForceSpec, PluginSpec

LOGGER: Final = logging.getLogger("quadsim.code")
"""Logs, before the code of a plug-in controller is imported, what is to run; the command line shows it."""


@dataclass(frozen=True, kw_only=True)
class Code:
    """The code that a scenario's `[controller]` or `[[forces]]` names."""

    what: str  # `controller` or `force`
    type: str  # what the scenario calls it
    module: str  # that is imported, and with it the packages it is in
    attribute: str  # what of it is called
    file: Path | None  # that the module is in; None where it is compiled into Python, or is not found
    root: Path | None  # the file, or the folder of the whole package that it is in; None without a file

    @property
    def digest(self) -> str | None:
        """SHA-256 of the code, the whole package's; None where it cannot be read."""
        try:
            return None if self.root is None else digest([self.root])
        except OSError:
            return None

    def __str__(self) -> str:
        where = "a module that is not found" if self.file is None else f"{self.file}, {self.digest}"
        return f"runs code that is not quadsim's: {self.what} {self.type} from {where}"


def find_code(spec: PluginSpec | ForceSpec) -> Code:
    """Where a controller's code is, found as it will be for its import, and nothing of it imported."""
    module, attribute = place(spec.type)
    with searched(folders_of(spec)):
        top = _origin(module.partition(".")[0])
        file = _origin(module)
    root = top.parent if top is not None and top.name == "__init__.py" else top or file
    what = "force" if isinstance(spec, ForceSpec) else "controller"
    return Code(what=what, type=spec.type, module=module, attribute=attribute, file=file, root=root)


def announce(spec: PluginSpec | ForceSpec) -> Code:
    """Report what is to run, before it does."""
    code = find_code(spec)
    LOGGER.info("%s", code)
    return code


def announce_recorded(spec: PluginSpec, recorded: object) -> None:
    """The same, and whether it is the code that flew a campaign, by its digest."""
    code = announce(spec)
    if recorded is not None and recorded == code.digest:
        LOGGER.info("that is the code which flew the campaign, by its digest")
    else:
        LOGGER.info("that is NOT the code which flew the campaign: recorded was %.100s", recorded)


def place(name: str) -> tuple[str, str]:
    """Module and attribute of a text, or of the entry point with that name."""
    if ":" not in name:
        entry = metadata.entry_points(group=ENTRY_POINTS)[name]
        return entry.module, entry.attr
    module, _, attribute = name.partition(":")
    return module, attribute


def folders_of(spec: PluginSpec | ForceSpec) -> list[str]:
    """Where a controller's module is looked for before the installed ones."""
    return list(dict.fromkeys([*([] if spec.folder is None else [spec.folder]), str(Path.cwd())]))


@contextlib.contextmanager
def searched(folders: Sequence[str]) -> Iterator[None]:
    """Folders that stand first on the import path for a while."""
    before = list(sys.path)
    sys.path[:0] = folders
    importlib.invalidate_caches()  # a file may be newer than the last look into its folder
    try:
        yield
    finally:
        sys.path[:] = before


def digest(paths: Iterable[Path]) -> str:
    """SHA-256 of the code, models and scenarios in files and folders."""
    found = hashlib.sha256()
    for root in paths:
        files = [root] if root.is_file() else sorted(root.rglob("*"))
        for path in files:
            if path.suffix in (".py", ".toml", ".xml") and path.is_file():
                found.update(f"{root.name}/{path.relative_to(root).as_posix()}\0".encode())
                found.update(path.read_bytes())
    return f"sha256:{found.hexdigest()}"


def _origin(module: str) -> Path | None:
    """The file of a module, found part by part: `importlib.util.find_spec` would import the packages it is in."""
    if module in sys.modules:  # which is what an import will give
        file = getattr(sys.modules[module], "__file__", None)
        return None if file is None else Path(file)
    found: ModuleSpec | None = None
    parts = module.split(".")
    for i in range(len(parts)):
        within = None if i == 0 else found.submodule_search_locations if found is not None else []
        if i and not within:
            return None
        found = _find(".".join(parts[: i + 1]), None if within is None else list(within))
        if found is None:
            return None
    return Path(found.origin) if found is not None and found.has_location and found.origin else None


def _find(name: str, within: list[str] | None) -> ModuleSpec | None:
    for finder in sys.meta_path:
        find = getattr(finder, "find_spec", None)
        spec = None if find is None else find(name, within)
        if spec is not None:
            return spec
    return None
