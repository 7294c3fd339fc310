"""The program behind a serial line, on a pseudo-terminal: frames that are dropped, doubled, cut and corrupt."""

from __future__ import annotations

import math
import random
import subprocess
import sys
import time as clock
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from firmware.conftest import Answers, Export, Run

from quadsim.assets import vehicle_path
from quadsim.features.export.in_the_loop import Frames, QueryKind, Reply, SerialMPC, make_program
from quadsim.features.export.record import Recording, record
from quadsim.mpc.guard.structs import STATUSES
from quadsim.scenarios.loading import load_scenario
from quadsim.state import Array
from quadsim.vehicle import load_vehicle

ROOT = Path(__file__).resolve().parents[2]
sys.path.append(str(ROOT / "examples"))
from flight_computer import Terminal  # noqa: E402

SHORT = "duration=3.0"
N = 50
MISSED = STATUSES.index("missed")
NOTHING = np.zeros(4)


@pytest.fixture(scope="module")
def recorded() -> Recording:
    return record(load_scenario("paper-constrained", [SHORT]))


@pytest.fixture
def terminal(exported: Export, run: Run) -> Iterator[Terminal]:
    run("make", "--version"), run("cc", "--version")
    result = Terminal(make_program(exported("posix", "double", SHORT), "serial.elf"))
    yield result
    result.close()


class Autopilot:
    """The other end: numbers its questions, and can corrupt them."""

    def __init__(self, line: Terminal, recorded: Recording) -> None:
        self.line = line
        self.recorded = recorded
        self.frames = Frames("double")
        self.number = 0

    def question(self, kind: QueryKind, row: Array, k: int = 0) -> bytes:
        self.number += 1
        acting = self.recorded.before if kind is QueryKind.START else self.recorded.acting[k]
        return self.frames.question(kind, self.number, self.recorded.state[k], row, acting)

    def start(self) -> None:
        """Fill the window but for the last row of the first period."""
        self.send(self.question(QueryKind.START, self.recorded.path[0]))
        for row in self.recorded.path[1 : N - 1]:
            self.send(self.question(QueryKind.ROW, row))

    def period(self, k: int) -> bytes:
        return self.question(QueryKind.STEP, self.recorded.path[k + N - 1], k)

    def send(self, data: bytes) -> Reply:
        """The answer to a question, but for what the watchdog has sent meanwhile, on a busy machine."""
        self.line.send(data)
        return self.hear_last()

    def hear_last(self) -> Reply:
        reply = self.hear()
        while reply.number != self.number:
            reply = self.hear()
        return reply

    def hear(self, patience: float = 5.0) -> Reply:
        reply = self.frames.reply(self.line.receive(self.frames.answer_size, patience))
        assert reply is not None
        return reply


def test_answers_are_those_of_the_recorded_periods(terminal: Terminal, recorded: Recording) -> None:
    pilot = Autopilot(terminal, recorded)
    pilot.start()
    for k in range(len(recorded.state)):
        reply = pilot.send(pilot.period(k))
        assert (reply.number, reply.status) == (pilot.number, recorded.status[k])
        assert np.abs(reply.command - recorded.command[k]).max() <= 1e-8


@pytest.mark.parametrize("acting", [math.nan, math.inf, -math.inf, 2e6])
def test_a_start_after_what_is_no_command_is_one_after_hover(
    terminal: Terminal, recorded: Recording, acting: float
) -> None:
    """Its answer, and those to rows, are a command that can be flown."""
    pilot = Autopilot(terminal, recorded)
    pilot.number = 1
    started = pilot.send(
        pilot.frames.question(QueryKind.START, 1, recorded.state[0], recorded.path[0], np.full(4, acting))
    )
    row = pilot.send(pilot.question(QueryKind.ROW, recorded.path[0]))
    hover = load_vehicle(vehicle_path("lopes2011")).hover_speeds
    np.testing.assert_allclose(started.command, hover, rtol=1e-12)
    np.testing.assert_array_equal(row.command, started.command)
    assert {started.status, row.status} == {MISSED}


def test_a_doubled_question_is_solved_once_and_answered_twice(terminal: Terminal, recorded: Recording) -> None:
    pilot = Autopilot(terminal, recorded)
    pilot.start()
    for k in range(10):
        frame = pilot.period(k)
        first = pilot.send(frame + frame)
        again = pilot.hear_last()
        assert first.number == again.number == pilot.number
        assert np.array_equal(first.command, again.command)
        assert np.abs(first.command - recorded.command[k]).max() <= 1e-8  # a second step would have moved the window on


def test_corrupt_and_truncated_frames_are_dropped(terminal: Terminal, recorded: Recording) -> None:
    """Bits turned, ends missing, noise between frames, and noise that begins as a frame does."""
    pilot = Autopilot(terminal, recorded)
    draw = random.Random(1)
    pilot.start()
    for k in range(12):
        frame = bytearray(pilot.period(k))
        corrupted = bytearray(frame)
        corrupted[draw.randrange(len(corrupted))] ^= 1 << draw.randrange(8)
        terminal.send(
            [bytes(corrupted), bytes(frame[: draw.randrange(1, len(frame))]), draw.randbytes(97), frame[:4]][k % 4]
        )
        # What has come may take the place of a frame's first bytes until as many more have: whole ones follow.
        reply = pilot.send(bytes(frame) * 3)
        assert np.abs(reply.command - recorded.command[k]).max() <= 1e-8
        while terminal.receive(pilot.frames.answer_size, 0.02):
            pass


def test_lost_rows_of_the_reference_are_replaced_by_the_next(terminal: Terminal, recorded: Recording) -> None:
    """Three of ten periods are lost: answers go on, and differ only by the rows and the periods that were missed."""
    pilot = Autopilot(terminal, recorded)
    pilot.start()
    for k in range(10):
        frame = pilot.period(k)
        if k not in (3, 4, 7):
            reply = pilot.send(frame)
            assert reply.number == pilot.number
            assert reply.status <= 2
            assert np.abs(reply.command - recorded.command[k]).max() <= (1e-8 if k < 3 else 1e-2)


def test_an_old_question_is_not_answered(terminal: Terminal, recorded: Recording) -> None:
    pilot = Autopilot(terminal, recorded)
    pilot.start()
    old = pilot.period(0)
    pilot.send(old)
    fresh = pilot.send(pilot.period(1))
    pilot.line.send(old)
    late = pilot.hear()  # the watchdog's
    assert (late.number, late.status) == (fresh.number, MISSED)


def test_without_a_fresh_state_the_last_command_is_repeated(terminal: Terminal, recorded: Recording) -> None:
    """Each 100 ms, with a status that is no optimum, until a state comes; rows alone are no state."""
    assert terminal.receive(1, 0.4) == b""  # not before the first
    pilot = Autopilot(terminal, recorded)
    pilot.start()
    desired = pilot.send(pilot.period(0))
    heard = [pilot.hear()]
    started = clock.monotonic()
    while len(heard) < 5:
        heard.append(pilot.hear())
    assert 0.35 <= clock.monotonic() - started <= 3.0  # 0.4 s, and a busy machine
    assert {(reply.number, reply.status) for reply in heard} == {(desired.number, MISSED)}
    assert all(np.array_equal(reply.command, desired.command) for reply in heard)
    assert pilot.send(pilot.period(1)).status == recorded.status[1]


def test_a_flight_over_the_line_by_the_example() -> None:
    done = subprocess.run([sys.executable, ROOT / "examples" / "flight_computer.py"], capture_output=True, text=True)
    assert done.stdout.startswith("satisfied: 40 commands over the line"), done.stderr


def test_a_whole_flight_needs_one_row_a_period(terminal: Terminal, recorded: Recording, answers: Answers) -> None:
    sent: list[bytes] = []
    send = terminal.send
    terminal.send = lambda data: (sent.append(data), send(data))[1]  # type: ignore[method-assign]
    law = SerialMPC(terminal, Frames("double"))
    law.reset(recorded.before)
    for k in range(len(recorded.state)):
        reply = law.step(0.05 * k, recorded.state[k], recorded.path[k : k + N], recorded.acting[k])
        assert np.abs(reply.command - recorded.command[k]).max() <= 1e-8
    assert len(sent) == N + len(recorded.state)
