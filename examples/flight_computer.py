"""A flight computer: an exported controller in C as a program of its own, queried over a serial line.

The C is `serial.c` of the export, the same on a Cortex-M behind its UART; here the line is a pseudo-terminal, and this
script the autopilot at its other end.  Takes a C compiler and make:

    python examples/flight_computer.py
"""

from __future__ import annotations

import os
import pty
import select
import subprocess
import tempfile
import tty
from pathlib import Path

import quadsim
from quadsim.features.export.in_the_loop import Frames, SerialMPC
from quadsim.state import Array


class Terminal:
    """A program whose standard input and output are a pseudo-terminal."""

    def __init__(self, program: Path) -> None:
        self.line, end = pty.openpty()
        tty.setraw(end)
        self.process = subprocess.Popen([program], stdin=end, stdout=end)
        os.close(end)

    def send(self, data: bytes) -> None:
        """Send all of it."""
        os.write(self.line, data)

    def receive(self, count: int, patience: float = 5.0) -> bytes:
        """`count` bytes; fewer where none comes within the timeout."""
        data = b""
        while len(data) < count:
            readable, _, _ = select.select([self.line], [], [], patience)
            if not readable:
                break
            data += os.read(self.line, count - len(data))
        return data

    def close(self) -> None:
        """End the program."""
        self.process.kill()
        self.process.wait()
        os.close(self.line)


def main() -> None:
    """Two seconds of hover: the vehicle in MuJoCo, its controller at the other end of the line."""
    scenario = quadsim.load("hover", {"duration": 2.0})
    with tempfile.TemporaryDirectory() as scratch:
        directory = quadsim.export(scenario, Path(scratch) / "c")
        subprocess.run(["make", "--quiet", "-C", directory, "serial.elf"], check=True)
        terminal = Terminal(directory / "serial.elf")
        computer = SerialMPC(terminal, Frames("double"))

        def controller(now: quadsim.StepInputs, state: Array, reference: Array) -> Array:
            assert now.acting is not None
            if now.time <= 0.0:
                computer.reset(now.acting)
            return computer.step(now.time, state, reference, now.acting).command

        flight = quadsim.fly(scenario, controller=controller, progress=False)
        terminal.close()
    print(f"{flight.outcome}: {len(flight.command)} commands over the line, the last {flight.command[-1].round(2)}")


if __name__ == "__main__":
    main()
