"""Compile the core beside its sources: for the build hook, and by hand as `python mpc/core/build.py`.

It needs the standard library alone and imports nothing of quadsim: the hook runs it in an environment of its own.
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
"""Without contraction all processors, and all levels of optimisation, have the same bits."""
UNIT: Final = "library.c"
"""What is compiled; it includes the other sources."""
NAME: Final = "_core.so"  # ctypes does not mind the suffix; macOS takes .so as well
COMPILERS: Final = ("cc", "gcc", "clang")


def source_hash(folder: Path = FOLDER) -> str:
    """Of all that the library's bits depend on but the compiler: flags, and sources by name."""
    digest = hashlib.sha256(" ".join(FLAGS).encode())
    for file in sorted((folder / "c").glob("*.[ch]")):
        digest.update(file.name.encode() + b"\0" + file.read_bytes())
    return digest.hexdigest()[:16]


def build(folder: Path = FOLDER) -> Path:
    """The library, compiled; it takes the place of an older one at once, which a process that uses it keeps.

    Raises:
        FileNotFoundError: there is no compiler.
        subprocess.CalledProcessError: it fails.
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
