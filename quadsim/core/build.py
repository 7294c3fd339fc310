"""Compile the library beside this file: run by the build hook, by the loader, or by hand as a script.

It needs only the standard library and `headers.py` beside it, and imports nothing of quadsim: the hook runs it in a
separate environment.
"""

from __future__ import annotations

import hashlib
import importlib.util
import os
import shlex
import shutil
import subprocess
import sys
import sysconfig
import tempfile
from pathlib import Path
from types import ModuleType
from typing import Final

ROOT: Final = Path(__file__).resolve().parents[2]
"""The folder of the package: a checkout, or `site-packages`."""
FOLDERS: Final = ("quadsim/core", "quadsim/mpc/c")
"""Every C file in them is compiled into the library."""
LIBRARY: Final = "quadsim/core/_core.so"  # the suffix is free for ctypes; macOS takes .so as well
_HEADERS: Final = Path(__file__).with_name("headers.py")
FLAGS: Final = ("-std=c99", "-O3", "-ffp-contract=off", "-fPIC", "-shared")
"""Without contraction, no optimisation level changes a bit of what these files compute by IEEE 754 arithmetic.

That is all of the controllers, whose elementary functions are arithmetic (`quadsim_math.h`), on every processor that
evaluates doubles as doubles.  The plant calls sin, cos, tan, exp and pow of the C library.  Their last bits may differ
by library, and by the variant that a library chooses for a processor; so may those of MuJoCo and of linear algebra.
"""
COMPILERS: Final = ("cc", "gcc", "clang")
"""The system's, in this order; `$CC` comes before them."""
ZIG: Final = "ziglang==0.17.1"
"""The wheel with a C compiler, for machines without one and for wheels to publish."""
PLATFORM: Final = "QUADSIM_PLATFORM"
"""Environment variable with the platform tag of a wheel to publish, of `ZIG_TARGETS`; unset for this machine's."""
ZIG_TARGETS: Final = {
    "manylinux_2_28_x86_64": "x86_64-linux-gnu.2.28",
    "manylinux_2_28_aarch64": "aarch64-linux-gnu.2.28",
    "macosx_11_0_arm64": "aarch64-macos.11.0",
}
"""zig's targets by platform tag, each for every processor and system that pip installs the tag on."""


class CompilationError(RuntimeError):
    """There is no compiler, or it fails; the message ends with what it printed."""


def sources(root: Path = ROOT) -> list[Path]:
    """Return the C files and headers."""
    return [file for folder in FOLDERS for file in sorted((root / folder).glob("*.[ch]"))]


def include(root: Path = ROOT) -> list[str]:
    """Return the options for our headers, which C files of `mpc` and the table of offsets include."""
    return [option for folder in FOLDERS for option in ("-I", str(root / folder))]


def write_layout(root: Path, folder: Path) -> Path:
    """Write the C file of the table of offsets that Python's mirrors are compared with; see `quadsim.core.headers`.

    Raises:
        CompilationError: a header has something that cannot be mirrored.
    """
    headers = _headers()
    try:
        declared = headers.read_headers(file for file in sources(root) if file.suffix == ".h")
    except headers.HeaderError as error:
        raise CompilationError(f"error: {error}") from error
    path = folder / "layout.c"
    path.write_text(headers.layout_source(declared), encoding="utf-8")
    return path


def stamp(root: Path = ROOT) -> str:
    """Return a text that identifies all that determines the library's bits but the compiler: flags and sources."""
    digest = hashlib.sha256(" ".join(FLAGS).encode() + _HEADERS.read_bytes())
    for file in sources(root):
        digest.update(file.relative_to(root).as_posix().encode() + b"\0" + file.read_bytes())
    return f"quadsim sources {digest.hexdigest()[:16]}"


def is_current(root: Path = ROOT) -> bool:
    """Return whether the library is of the sources beside it; a stale one need not be loaded to be recognised."""
    return not sources(root) or stamp(root).encode() in (root / LIBRARY).read_bytes()


def system_compiler() -> list[str]:
    """Return the command of `$CC`, else of the system's compiler; an empty list if there is none."""
    return shlex.split(os.environ.get("CC", "")) or [path for path in map(shutil.which, COMPILERS) if path][:1]


def to_publish() -> str:
    """Return the platform tag of a wheel to publish; an empty text without one.

    Raises:
        CompilationError: it is not one of `ZIG_TARGETS`.
    """
    platform = os.environ.get(PLATFORM, "")
    if platform and platform not in ZIG_TARGETS:
        raise CompilationError(f"{PLATFORM} must be one of {', '.join(ZIG_TARGETS)}; got {platform!r}")
    return platform


def requirements() -> list[str]:
    """Return the packages needed to compile: none if the system's compiler is used."""
    if to_publish() or not system_compiler():
        return [ZIG]
    return []


def compiler() -> list[str]:
    """Return the command of the compiler: the system's, else zig's.

    Raises:
        CompilationError: there is none.
    """
    if not requirements():
        return system_compiler()
    platform = to_publish()
    if importlib.util.find_spec("ziglang") is None:
        if platform:
            raise CompilationError(f"{PLATFORM} needs the package {ZIG}")
        raise CompilationError(f"no C compiler ({', '.join(COMPILERS)}), nor {ZIG}")
    target: tuple[str, ...] = ("-mcpu=baseline",)  # zig compiles for the processor at hand by default
    if platform:
        target = ("-target", ZIG_TARGETS[platform])
    return [sys.executable, "-m", "ziglang", "cc", *target]


def platform_tag() -> str:
    """Return the platform tag of the wheel that holds the library."""
    return to_publish() or sysconfig.get_platform().replace("-", "_").replace(".", "_")


def compile_library(root: Path = ROOT) -> Path:
    """Compile the library; it replaces an older one atomically, and running processes keep theirs.

    Raises:
        CompilationError: there is no compiler, it fails, a header cannot be mirrored, or the folder cannot be written.
    """
    library = root / LIBRARY
    units = []
    for file in sources(root):
        if file.suffix == ".c":
            units.append(str(file))
    command = [*compiler(), *FLAGS, *include(root), f'-DQUADSIM_SOURCES="{stamp(root)}"', *units]
    try:
        with (
            tempfile.TemporaryDirectory() as generated,  # not in the package, whose C files others may be hashing
            tempfile.TemporaryDirectory(dir=library.parent, prefix=f"{library.name}.") as scratch,
        ):
            partial = Path(scratch) / library.name
            command += [str(write_layout(root, Path(generated))), "-lm", "-o", str(partial)]
            environment = {"ZIG_GLOBAL_CACHE_DIR": generated, **os.environ}  # which is 70 MB
            done = subprocess.run(command, env=environment, capture_output=True, text=True)
            if done.returncode:
                raise CompilationError(f"{shlex.join(command[:1])} fails:\n{done.stderr}")
            partial.replace(library)
    except OSError as error:
        raise CompilationError(str(error)) from error
    return library


def _headers() -> ModuleType:
    """Load `headers.py` by its path: by its name it is not found where nothing of quadsim can be imported."""
    spec = importlib.util.spec_from_file_location("quadsim_headers", _HEADERS)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


if __name__ == "__main__":
    try:
        sys.stdout.write(f"{compile_library()}\n")
    except CompilationError as error:
        sys.exit(str(error))
