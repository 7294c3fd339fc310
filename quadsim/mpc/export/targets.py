"""The machines that an export can be made for, as the first lines of its Makefile.

A Cortex-M is emulated by QEMU on a board of its own; `posix` runs natively.  One more machine is an entry of `TARGETS`
and a C file that implements `c/target.h`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

EMULATOR: Final = "qemu-system-arm"
INSTRUCTIONS_PER_TICK: Final = 40
"""Instructions per tick of the emulated processors' clock, with `-icount shift=0`."""


@dataclass(frozen=True, kw_only=True)
class Machine:
    """A machine: how programs for it are compiled and run."""

    name: str  # value of `--target`
    title: str  # display name
    sources: tuple[str, ...]  # the file that implements `target.h`, and further sources
    compiler: str
    machine: str = ""  # compiler flags that choose the processor
    link: str = ""  # flags of the linker
    board: str = ""  # QEMU's name of the machine to emulate; empty to run programs natively

    @property
    def emulation(self) -> tuple[str, ...]:
        """The command that runs an image, up to the image and the serial line; empty without an emulator."""
        if not self.board:
            return ()
        options = f"-M {self.board} -nographic -monitor none -semihosting -icount shift=0"
        return (EMULATOR, *options.split())

    def makefile(self, defines: str) -> str:
        """Return the first lines of the Makefile."""
        run = ""
        if self.board:
            run = " ".join(["timeout 600", *self.emulation, "-serial none -kernel"])
        settings = {
            "COMPILER": self.compiler,
            "MACHINE": self.machine,
            "MACHINE_LINK": self.link,
            "TARGET": self.sources[0].replace(".c", ".o"),
            "RUN": run,
            "DEFINES": defines,
        }
        lines = []
        for name, value in settings.items():
            lines.append(f"{name} = {value}".rstrip() + "\n")
        return "".join(lines)


def _cortex(name: str, title: str, machine: str, board: str) -> Machine:
    """Return a Cortex-M on a board that QEMU emulates."""
    return Machine(
        name=name,
        title=title,
        sources=("startup.c", "mps2.ld"),
        compiler="arm-none-eabi-gcc",
        machine=f"{machine} -mfloat-abi=hard -mthumb -fno-tree-loop-distribute-patterns",  # no memmove made of a loop
        link="-nostartfiles -T mps2.ld --specs=nano.specs",
        board=board,
    )


TARGETS: Final = {
    target.name: target
    for target in (
        Machine(name="posix", title="POSIX", sources=("posix.c",), compiler="cc"),
        _cortex("cortex-m7", "Cortex-M7", "-mcpu=cortex-m7 -mfpu=fpv5-d16", "mps2-an500"),
        _cortex("cortex-m4f", "Cortex-M4F", "-mcpu=cortex-m4 -mfpu=fpv4-sp-d16", "mps2-an386"),
    )
}
"""Targets by name; the Cortex-M7 has a double-precision FPU, the Cortex-M4F a single-precision one."""
