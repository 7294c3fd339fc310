"""An export's programs: built with its Makefile and run, in an emulator where their processor is another."""

from __future__ import annotations

import contextlib
import os
import select
import shutil
import subprocess
from pathlib import Path
from types import TracebackType
from typing import Final

from mpc.export.targets import EMULATOR, Target
from quadsim.errors import MissingProgramError, QuadsimError

CROSS_PACKAGES: Final = "make gcc-arm-none-eabi libnewlib-arm-none-eabi qemu-system-arm"
HOST_PACKAGES: Final = "make gcc libc6-dev"
PATIENCE: Final = 120.0  # how long an answer of the emulated processor may take [s]; the longest step takes a second


def require_programs(target: Target, what: str) -> None:
    """Refuse what needs a compiler, or an emulator, that is not here.

    Raises:
        MissingProgramError: one is not installed.
    """
    for program in ("make", target.compiler, *([EMULATOR] if target.board else [])):
        if shutil.which(program) is None:
            raise MissingProgramError(what, program, packages=CROSS_PACKAGES if target.board else HOST_PACKAGES)


def build(directory: Path, program: str, *settings: str) -> Path:
    """Make a program of an export, a target of its Makefile, with settings of its variables, e.g. `CC=clang`.

    Raises:
        QuadsimError: it cannot be built; with the compiler's first words.
    """
    done = subprocess.run(["make", "-C", str(directory), program, *settings], capture_output=True, text=True)
    if done.returncode:
        errors = [line for line in done.stderr.splitlines() if "error" in line] or done.stderr.splitlines()
        raise QuadsimError(f"{directory / program} cannot be built: {errors[0] if errors else 'make fails'}")
    return directory / program


class Program:
    """A program that runs, and the serial line to it; see `scenarios.export.serial_line.Line`."""

    def __init__(self, target: Target, image: Path) -> None:
        command = [*target.emulation, "-serial", "stdio", "-kernel", str(image)] if target.board else [str(image)]
        self._process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, bufsize=0
        )

    def __enter__(self) -> Program:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self._process.kill()
        self._process.communicate()

    def send(self, data: bytes) -> None:
        """Send all of it; to a program that has ended nothing."""
        assert self._process.stdin is not None
        with contextlib.suppress(BrokenPipeError):
            self._process.stdin.write(data)

    def receive(self, count: int) -> bytes:
        """`count` bytes; fewer where the program has ended, or sends nothing for `PATIENCE`."""
        assert self._process.stdout is not None
        line, data = self._process.stdout.fileno(), b""
        while len(data) < count and select.select([line], [], [], PATIENCE)[0]:
            more = os.read(line, count - len(data))
            if not more:
                break
            data += more
        return data
