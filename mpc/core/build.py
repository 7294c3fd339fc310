"""Compile the core beside its sources: run by the build hook, or by hand as `python mpc/core/build.py`.

It needs only the standard library and imports nothing of quadsim: the hook runs it in a separate environment.
"""

from __future__ import annotations

import hashlib
import os
import shlex
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Final

FOLDER: Final = Path(__file__).resolve().parent
FLAGS: Final = ("-std=c99", "-O3", "-ffp-contract=off", "-fPIC", "-shared")
"""Without contraction, results are bitwise equal on all processors and at all optimisation levels."""
UNIT: Final = "library.c"
"""The file to compile; it includes the other sources."""
NAME: Final = "_core.so"  # the suffix is free for ctypes; macOS takes .so as well
COMPILERS: Final = ("cc", "gcc", "clang")


def source_hash(folder: Path = FOLDER) -> str:
    """Hash everything that determines the library's bits, except the compiler: flags, and sources by name."""
    digest = hashlib.sha256(" ".join(FLAGS).encode())
    for file in sorted((folder / "c").glob("*.[ch]")):
        digest.update(file.name.encode() + b"\0" + file.read_bytes())
    return digest.hexdigest()[:16]


def build(folder: Path = FOLDER) -> Path:
    """Compile the library; it replaces an older one atomically, and running processes keep theirs.

    Raises:
        FileNotFoundError: there is no compiler.
        subprocess.CalledProcessError: the compiler fails.
    """
    named = shlex.split(os.environ.get("CC", ""))
    compiler = named or [path for path in map(shutil.which, COMPILERS) if path][:1]
    if not compiler:
        raise FileNotFoundError(f"no C compiler found ({', '.join(COMPILERS)})")
    library, partial = folder / NAME, folder / f"{NAME}.{os.getpid()}"
    define = f'-DQUADSIM_SOURCE="{source_hash(folder)}"'
    command = [*compiler, *FLAGS, define, "-o", str(partial), str(folder / "c" / UNIT)]
    try:
        subprocess.run(command, check=True, capture_output=True, text=True)
        partial.replace(library)
    finally:
        partial.unlink(missing_ok=True)
    return library


if __name__ == "__main__":
    sys.stdout.write(f"{build()}\n")
