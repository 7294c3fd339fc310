"""Processor in the loop: a flight whose controller is an exported one, on its target or in the target's emulator.

The programs of an export are built with its Makefile and run; queries and answers pass the serial line of
`quadsim/mpc/export/c/serial.c` as frames with a checksum.  `MPCInTheLoop` is the controller that a rollout then flies:
it sends each period's state and the reference's new row, and waits for the command.
"""

from __future__ import annotations

import contextlib
import os
import select
import shutil
import struct
import subprocess
import tempfile
import zlib
from collections.abc import Callable
from dataclasses import replace
from enum import IntEnum
from pathlib import Path
from types import TracebackType
from typing import Final, Literal, NamedTuple, Protocol

import numpy as np

from quadsim.console.progress import Progress, reporting
from quadsim.controller import (
    COMMANDED,
    CORE,
    FALLBACK,
    GAIN,
    GROUNDED,
    LAW,
    NOT_CONVERGED,
    SOLVED,
    UNCONSTRAINED,
    AutopilotLoop,
    Command,
    Phase,
    StepInputs,
    stopped,
)
from quadsim.errors import FlightError, MissingProgramError, QuadsimError
from quadsim.features.export.exporter import c_controller, programs
from quadsim.flight.audit import COMMAND_SIGNALS, Limit
from quadsim.mpc.export.ctext import Precision
from quadsim.mpc.export.source import CSource
from quadsim.mpc.export.targets import EMULATOR, TARGETS, Machine
from quadsim.mpc.guard.structs import STATUSES
from quadsim.mpc.laws.parts.nonlinear_law import measured_state, reference_rows
from quadsim.mpc.pilot.pilot import Pilot
from quadsim.outputs import reserving
from quadsim.rollout.flown import Flight
from quadsim.rollout.rollout import Rollout
from quadsim.scenarios.assembly import Assembly
from quadsim.scenarios.loading import load_scenario
from quadsim.scenarios.schema.scenario import Scenario
from quadsim.state import N_STATES, REFERENCE_STATES, Array
from quadsim.vehicle import N_ROTORS

ANSWERERS: Final = {UNCONSTRAINED: GAIN, SOLVED: CORE, NOT_CONVERGED: CORE, COMMANDED: LAW}
"""`answered_by` of a command that is flown as it is, by its status."""
CROSS_PACKAGES: Final = "make gcc-arm-none-eabi libnewlib-arm-none-eabi qemu-system-arm"
HOST_PACKAGES: Final = "make gcc libc6-dev"
LONGEST_ANSWER: Final = 120.0
"""How long an answer of the emulated processor may take [s]; the longest step takes a second."""


def require_programs(target: Machine, what: str) -> None:
    """Refuse a target whose compiler or emulator is not installed.

    Raises:
        MissingProgramError: one is not installed.
    """
    programs = ["make", target.compiler]
    packages = HOST_PACKAGES
    if target.board:
        programs.append(EMULATOR)
        packages = CROSS_PACKAGES
    for program in programs:
        if shutil.which(program) is None:
            raise MissingProgramError(what, program, packages=packages)


def make_program(directory: Path, program: str, *settings: str) -> Path:
    """Make a program of an export, a target of its Makefile, with settings of its variables, e.g. `CC=clang`.

    Raises:
        QuadsimError: it cannot be built; with the compiler's first words.
    """
    done = subprocess.run(["make", "-C", str(directory), program, *settings], capture_output=True, text=True)
    if done.returncode:
        raise QuadsimError(f"{directory / program} cannot be built: {_first_error(done.stderr)}")
    return directory / program


def _first_error(output: str) -> str:
    """Return the first line of a compiler's messages that says error, or else the first line."""
    lines = output.splitlines()
    for line in lines:
        if "error" in line:
            return line
    if lines:
        return lines[0]
    return "make fails"


class Program:
    """A program that runs, and the serial line to it; see `Line`."""

    def __init__(self, target: Machine, image: Path) -> None:
        if target.board:
            command = [*target.emulation, "-serial", "stdio", "-kernel", str(image)]
        else:
            command = [str(image)]
        self._process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, bufsize=0
        )

    def __enter__(self) -> Program:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self._process.kill()
        self._process.communicate()

    def send(self, data: bytes) -> None:
        """Send all bytes; none if the program has ended."""
        assert self._process.stdin is not None
        with contextlib.suppress(BrokenPipeError):
            self._process.stdin.write(data)

    def receive(self, count: int) -> bytes:
        """Return `count` bytes; fewer if the program has ended, or sends nothing for `LONGEST_ANSWER`."""
        assert self._process.stdout is not None
        line = self._process.stdout.fileno()
        data = b""
        while len(data) < count:
            readable, _, _ = select.select([line], [], [], LONGEST_ANSWER)
            if not readable:
                break
            more = os.read(line, count - len(data))
            if not more:
                break
            data += more
        return data


MARK: Final = 0x4D504351
"""With which every frame begins, as in `serial.c`."""
_STRUCT_LETTERS: Final = {"double": "d", "float": "f"}


class QueryKind(IntEnum):
    """The kind of a query."""

    START = 0  # begin anew after u(-1), of hover where it is no number; the reference its one row throughout
    ROW = 1  # take one more row of the reference
    STEP = 2  # take one more row and solve
    STAND = 3  # the same while the ground holds the vehicle, which shows no disturbance


SolvingQuery = Literal[QueryKind.STEP, QueryKind.STAND]


class Reply(NamedTuple):
    """An answer: the number of its query, u(k) (4,) [rad/s], a status of `quadsim_mpc.h`, and the fallback level."""

    number: int
    command: Array
    status: int
    fallback: int


class Line(Protocol):
    """A serial line."""

    def send(self, data: bytes) -> None:
        """Send all bytes."""
        ...

    def receive(self, count: int) -> bytes:
        """Return `count` bytes; fewer if the other end has closed or no longer answers."""
        ...


class Frames:
    """Queries and answers as bytes, in a precision, of so many numbers of a state and of a row of the reference."""

    def __init__(self, precision: str, state: int = N_STATES, row: int = len(REFERENCE_STATES)) -> None:
        letter = _STRUCT_LETTERS[precision]
        self._question = struct.Struct(f"<2I{state + row + N_ROTORS}{letter}2I")
        self._answer = struct.Struct(f"<2I{N_ROTORS}{letter}2HI")

    @property
    def answer_size(self) -> int:
        """Bytes of an answer."""
        return self._answer.size

    def question(self, kind: QueryKind, number: int, state: Array, row: Array, acting: Array) -> bytes:
        """A query with its checksum; what its kind does not take may be anything."""
        data = self._question.pack(MARK, number % 2**32, *state, *row, *acting, kind, 0)[:-4]
        return data + zlib.crc32(data).to_bytes(4, "little")

    def reply(self, data: bytes) -> Reply | None:
        """Return the answer in these bytes, or None."""
        if len(data) != self._answer.size:
            return None
        mark, number, *command, status, fallback, checksum = self._answer.unpack(data)
        if mark != MARK or checksum != zlib.crc32(data[:-4]):
            return None
        return Reply(number, np.array(command, np.float64), status, fallback)


class SerialMPC:
    """An exported controller at the other end of a serial line, by its numbers' bytes."""

    def __init__(self, line: Line, frames: Frames) -> None:
        self._line = line
        self._frames = frames
        self._number = 0
        self._window = np.zeros((0, 0))
        self._speeds = np.zeros(N_ROTORS)

    def reset(self, speeds: Array) -> None:
        """Restart after u(-1) (4,) [rad/s]."""
        self._speeds = np.array(speeds, float)
        self._window = np.zeros((0, 0))

    def step(
        self, time: float, state: Array, reference: Array, acting: Array, kind: SolvingQuery = QueryKind.STEP
    ) -> Reply:
        """The answer at t_k [s] to x(k), the reference and u(k-1) (4,), as the exported controller takes them.

        Where the reference is the last one moved on, its last row alone is sent.

        Raises:
            FlightError: no answer came, or none that is whole.
        """
        if not len(self._window):
            self._query(time, QueryKind.START, state, reference[0], self._speeds)
        if not np.array_equal(self._window[1:], reference[:-1]):
            for row in reference[:-1]:
                self._query(time, QueryKind.ROW, state, row, acting)
        self._window = np.array(reference)
        return self._query(time, kind, state, reference[-1], acting)

    def _query(self, time: float, kind: QueryKind, state: Array, row: Array, acting: Array) -> Reply:
        self._number += 1
        self._line.send(self._frames.question(kind, self._number, state, row, acting))
        while True:
            reply = self._frames.reply(self._line.receive(self._frames.answer_size))
            if reply is None:
                problem = f"the controller at the serial line gave no answer to question {self._number}"
                raise FlightError(problem, time=time)
            if reply.number == self._number:  # else what its watchdog had sent meanwhile
                return reply


class MPCInTheLoop:
    """An exported controller at the other end of a serial line, as a controller that flies.

    While landed the rotors are taken to their lowest speed as fast as their bounds allow, here and not there.

    Attributes:
        ways: how many periods had which status of `quadsim_guard.h`.
    """

    predict: Callable[[Array, Array], Array]  # absent: the plan stays on the target

    def __init__(self, line: Line, source: CSource, name: str, target: Machine) -> None:
        self.name = name
        self.solver = f"C99 on {target.title}"
        self.horizon = source.horizon
        self.commands = source.commands
        self.ways = [0] * len(STATUSES)
        self._serial = SerialMPC(line, Frames(source.precision, source.state, source.reference[1]))
        self._before = np.zeros(N_ROTORS)
        self._bounds = source.bounds
        self._whole = source.state > N_STATES
        self._rows = source.motion_rows

    def reset(self, speeds: Array) -> None:
        """See `quadsim.controller.Controller.reset`."""
        self._before = np.array(speeds, float)
        self.ways = [0] * len(STATUSES)
        self._serial.reset(speeds)

    def step(self, now: StepInputs, state: Array, reference: Array) -> Command:
        """See `quadsim.controller.Controller.step`.

        Raises:
            FlightError: no answer came over the line.
        """
        acting = self._before if now.acting is None else now.acting
        if now.phase in GROUNDED:
            if self._bounds is None:
                self._before = np.zeros(N_ROTORS)
            else:
                self._before = self._bounds.lowest(acting)
            self._serial.reset(self._before)
            return stopped(self._before.copy(), self.horizon, now.phase)
        kind: SolvingQuery = QueryKind.STAND
        if now.phase is Phase.FLYING:
            kind = QueryKind.STEP
        if self._whole:
            state = measured_state(now, state)
            reference = reference_rows(now, reference, self._rows)
        reply = self._serial.step(now.time, state, reference, acting, kind)
        self._before = reply.command
        status = STATUSES[reply.status]
        self.ways[reply.status] += 1
        return Command(
            speeds=reply.command.copy(),
            plan=np.tile(reply.command, (self.horizon, 1)),
            status=status,
            answered_by=ANSWERERS.get(status, FALLBACK),
            fallback=reply.fallback,
        )


def fly_exported(
    scenario: Scenario | str | Path,
    out: str | Path | None = None,
    *,
    precision: Precision = "double",
    target: str = "cortex-m7",
    autopilot: AutopilotLoop | None = None,
    progress: Progress | bool = True,
) -> Flight:
    """Fly a scenario with its controller exported, compiled and run by its target: processor in the loop.

    The controller's program is `serial.c` of the export, at the other end of a serial line: a Cortex-M's UART in QEMU,
    for `posix` a pipe.  Its queries and answers are bytes; the flight is audited as any other, but that a float
    may pass a bound on speeds and their steps by the spacing of floats there.

    Args:
        scenario: it, or its name or file.
        out: the run directory, without a film; nothing is written where absent.
        precision: of the controller's numbers, `double` or `float`.
        target: `cortex-m7`, `cortex-m4f` or `posix`.
        autopilot: flies the targets of the exported controller in place of the built-in one, and gives it its lags; see
            `quadsim.fly`.
        progress: see `quadsim.fly`.

    Raises:
        ExportError: this controller cannot be exported; the message gives the reason.
        MissingProgramError: a compiler or an emulator is not installed.

    Examples:
        >>> import quadsim
        >>> flight = quadsim.fly_exported("hover", target="cortex-m4f", precision="float")  # doctest: +SKIP
    """
    assembly = Assembly(load_scenario(scenario))
    machine = TARGETS[target]
    assembly.user_autopilot = autopilot
    source = c_controller(assembly, precision)
    files = source.files | programs(source, machine)
    require_programs(machine, "to fly an exported controller")
    if precision == "float" and source.bounds is not None:
        spacing = np.spacing(np.float32(source.bounds.u_max.max()))
        assembly = _with_float_tolerances(assembly, float(spacing))
    with tempfile.TemporaryDirectory(prefix="quadsim-") as scratch, reporting(progress, "the emulator") as report:
        directory = Path(scratch)
        for name, text in files.items():
            (directory / name).write_text(text, encoding="utf-8")
        # The emulated clock is not the flight's.
        image = make_program(directory, "serial.elf", "CPPFLAGS=-DWATCHDOG_MS=0")
        with Program(machine, image) as line:
            law = MPCInTheLoop(line, source, assembly.scenario.controller.type, machine)
            pilot = assembly.with_autopilot(Pilot(law, assembly.vehicle))
            if out is None:
                return Rollout(assembly, pilot).fly(report)
            with reserving(out) as place:
                flight = Rollout(assembly, pilot).fly(report)
                flight.save(place, video=False, progress=report)
                return replace(flight, directory=place)


def _with_float_tolerances(assembly: Assembly, spacing: float) -> Assembly:
    """The same with tolerances of at least `spacing` [rad/s] on speeds and their steps."""
    limits: list[Limit] = []
    for limit in assembly.with_bounds.constraints:
        if limit.signal in COMMAND_SIGNALS:
            plant, sampled = limit.tolerances
            limits.append(replace(limit, tolerance=max(spacing, plant), tolerance_sampled=max(spacing, sampled)))
        else:
            limits.append(limit)
    return assembly.of(assembly.scenario.altered(constraints=limits))
