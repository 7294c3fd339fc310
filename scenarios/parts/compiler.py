"""Exported C, compiled once and cached by its hash in the user's cache directory."""

from __future__ import annotations

import hashlib
import os
import shutil
import stat
import subprocess
import tempfile
from collections.abc import Callable, Hashable, Mapping, Sequence
from pathlib import Path
from typing import Final

from mpc.export.compiled import CompiledMPC
from mpc.export.source import Exportable, part, sources
from quadsim.errors import CompilerError, OutputError
from quadsim.outputs import writing_file

FLAGS: Final = ("-std=c99", "-O3", "-ffp-contract=off", "-fPIC", "-shared")
"""Without contraction all processors, and all levels of optimisation, have the same bits."""
ROOM_PER_STEP: Final = 5
"""Active rows that there is room for, per step of the horizon: all that are independent, and memory is no matter here.
Rotors that spin up from standstill at their largest steps take more of both than an export has."""
CHANGES: Final = 3000  # the same of the changes of the active set in a search
COMPILERS: Final = ("cc", "gcc", "clang")


_READY: dict[Hashable, tuple[Path, Exportable]] = {}
"""What this process has compiled, or found: a campaign's flights mostly have the same controller."""


def compiled_controller(key: Hashable, make: Callable[[], Exportable]) -> CompiledMPC:
    """A controller as compiled C; `make` is called where its key is new to this process.

    Raises:
        ExportError: this controller cannot be exported.
        CompilerError: there is no compiler, or it fails.
        OutputError: the cache directory cannot be written.
    """
    if key not in _READY:
        law = make()
        room = ROOM_PER_STEP * law.problem.horizon
        _READY[key] = compiled(sources(law, precision="double", title=law.name), room, CHANGES), law
    return CompiledMPC(*_READY[key])


def compiled(files: Mapping[str, str], room: int | None = None, changes: int | None = None) -> Path:
    """The shared library of a controller's files and of `shim.c`, from the cache where it is there.

    `room` for active rows, and the most `changes` of the active set in a search, are the export's own where None.

    Raises:
        CompilerError: there is no compiler, or it fails.
        OutputError: the cache directory cannot be written, or is not the user's alone.
    """
    compiler = _compiler()
    sources = {**files, "shim.c": part("shim.c")}
    sizes = {"ROOM": room, "CHANGES": changes}
    flags = (*FLAGS, *(f"-DQUADSIM_{name}={size}" for name, size in sizes.items() if size is not None))
    digest = hashlib.sha256()
    version = subprocess.run([compiler, "--version"], capture_output=True, text=True, check=False).stdout
    for text in (version, *flags, *(f"{name}\0{sources[name]}" for name in sorted(sources))):
        digest.update(text.encode() + b"\0")
    library = _cache() / f"{digest.hexdigest()}.so"
    if not library.exists():
        content = _compile(compiler, flags, sources)
        try:
            with writing_file(library) as file:
                file.write_bytes(content)
        except OutputError:
            if not library.exists():  # else another process was sooner
                raise
    return library


def _compiler() -> str:
    named = os.environ.get("CC")
    found = next(filter(None, map(shutil.which, [named] if named else COMPILERS)), None)
    if found is None:
        looked = f"CC = {named!r}" if named else ", ".join(COMPILERS)
        raise CompilerError(
            f"no C compiler found ({looked}); install one, e.g. apt-get install gcc, or leave out controller.compiled"
        )
    return found


def _compile(compiler: str, flags: Sequence[str], sources: Mapping[str, str]) -> bytes:
    with tempfile.TemporaryDirectory(prefix="quadsim-c-") as name:
        folder = Path(name)
        for file, text in sources.items():
            (folder / file).write_text(text, encoding="utf-8")
        command = [compiler, *flags, "-o", "shim.so", "shim.c"]
        done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
        if done.returncode:
            raise CompilerError(f"{' '.join(command)} failed: {(done.stderr or done.stdout).strip()[:2000]}")
        return (folder / "shim.so").read_bytes()


def _cache() -> Path:
    """The directory, made where there is none; refused where others could put code there.

    Raises:
        OutputError: it cannot be made, or is not the user's alone.
    """
    base = Path(os.environ.get("XDG_CACHE_HOME", ""))
    folder = (base if base.is_absolute() else Path("~/.cache")) / "quadsim" / "compiled"
    try:
        folder = folder.expanduser()
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        found = folder.lstat()
    except (OSError, RuntimeError) as error:  # RuntimeError: there is no home
        reason = error.strerror if isinstance(error, OSError) else error
        raise OutputError(folder, f"{reason}; XDG_CACHE_HOME may name another place") from error
    if not stat.S_ISDIR(found.st_mode) or found.st_uid != os.getuid() or found.st_mode & 0o022:
        raise OutputError(folder, "it holds code that will be run, so it has to be yours and writable by you alone")
    return folder
