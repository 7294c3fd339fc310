"""Every target computes the same bits as the host over all recorded periods, within bounds on size, stack and work."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from firmware.conftest import Answer, Answers, Export, Measured, Run

from mpc.codegen.targets import INSTRUCTIONS_PER_TICK, TARGETS
from scenarios.export.in_the_loop import make_program

HERE = Path(__file__).parent
CONTROLLER = ("quadsim_guard", "quadsim_mpc", "quadsim_core")
BOARDS = [name for name, target in TARGETS.items() if target.board]
AARCH64 = ("CC=aarch64-linux-gnu-gcc", "MACHINE_LINK=-static", "RUN=qemu-aarch64")
OTHERS = {
    "cortex-m7": ("cortex-m7",),
    "cortex-m4f": ("cortex-m4f",),
    "aarch64": ("posix", *AARCH64),
    "host, unoptimised": ("posix", "CFLAGS=-O0 -std=c99"),
    "host, clang": ("posix", "CC=clang", "CFLAGS=-O3 -std=c99"),
}
DEFINES = {"double": [], "float": ["-DQUADSIM_FLOAT"]}
CONTRACTED = "ALWAYS=-ffp-contract=fast"
MEDIAN, RARE, WARM, COLD = 0.1e6, 3e6, 7e6, 9e6
"""Instructions of a step at most, of the Cortex-M7 in double and of both in float: p50, p99, warm, the first."""
FLASH, MEMORY = {"double": 200_000, "float": 125_000}, {"double": 103_000, "float": 53_000}
"""Bytes at most: of code and constants; of the controller's struct and memory."""
FRAME, STACK = 1400, 4000
"""Bytes at most: of a function; in all."""


def bits(found: list[Answer]) -> list[Answer]:
    """Without the ticks."""
    return [answer[:7] for answer in found]


@pytest.mark.parametrize("board", BOARDS)
def test_a_board_starts_counts_and_stops(board: str, exported: Export, run: Run, tmp_path: Path) -> None:
    target, directory = TARGETS[board], exported(board, "double")
    flags = f"{target.machine} -O3 -std=gnu99 -I {directory}".split()
    image = tmp_path / "bare.elf"
    link = f"-nostartfiles -T {directory / 'mps2.ld'} --specs=nano.specs".split()
    run(target.compiler, *flags, "-o", image, HERE / "bare.c", directory / "startup.c", *link)
    emulate = (*target.emulation, "-serial", "stdio", "-kernel", image)
    done = run(*emulate, input="abcq")
    assert (done.stdout, done.stderr) == ("bc", "as many ticks\n")
    for fault in "fn":
        assert run(*emulate, input=fault, check=False).returncode == 3


@pytest.mark.parametrize("precision", ["double", "float"])
@pytest.mark.parametrize("other", OTHERS)
def test_every_target_answers_the_same_bits(other: str, precision: str, answers: Answers) -> None:
    target, *make = OTHERS[other]
    host, result = answers("posix", precision), answers(target, precision, *make)
    assert len(host) == 1200
    assert {int(answer[1], 16) for answer in host} == {0, 1, 2}  # every way to an optimum
    assert bits(result) == bits(host)


@pytest.mark.parametrize(
    ("other", "precision"), [("cortex-m7", "double"), ("cortex-m4f", "float"), ("aarch64", "float")]
)
def test_the_robust_controller_too(other: str, precision: str, answers: Answers) -> None:
    """With its observer, its lagging rotors and its sines."""
    target, *make = OTHERS[other]
    host = answers("posix", precision, scenario="robust")
    assert len(host) == 600
    assert bits(answers(target, precision, *make, scenario="robust")) == bits(host)


def test_contraction_would_change_bits(answers: Answers) -> None:
    """The flag is there for a reason: with it on, an aarch64 fuses products and sums."""
    assert bits(answers("posix", "double", *AARCH64, CONTRACTED)) != bits(answers("posix", "double"))


@pytest.mark.parametrize(
    ("board", "precision"), [("cortex-m7", "double"), ("cortex-m7", "float"), ("cortex-m4f", "float")]
)
def test_a_step_takes_few_instructions(board: str, precision: str, answers: Answers, measured: Measured) -> None:
    """Instructions, not cycles: the emulator has neither caches nor wait states."""
    steps = np.array([int(answer[7], 16) * INSTRUCTIONS_PER_TICK for answer in answers(board, precision)])
    result = {"p50": np.median(steps), "p99": np.percentile(steps, 99), "warm": steps[1:].max(), "first": steps[0]}
    measured(board, precision, **result)
    assert result["p50"] <= MEDIAN
    assert result["p99"] <= RARE
    assert result["warm"] <= WARM
    assert result["first"] <= COLD


@pytest.mark.parametrize(
    ("board", "precision"), [("cortex-m7", "double"), ("cortex-m7", "float"), ("cortex-m4f", "float")]
)
def test_a_controller_fits(
    board: str, precision: str, exported: Export, run: Run, measured: Measured, tmp_path: Path
) -> None:
    directory, tools = exported(board, precision), "arm-none-eabi-size"
    run(TARGETS[board].compiler, "--version")
    make_program(directory, "vectors.elf")
    numbers = tmp_path / "numbers.c"
    numbers.write_text('#include "quadsim_data.h"\nconst quadsim_controller *const used = &QUADSIM_CONTROLLER;\n')
    flags = [*TARGETS[board].machine.split(), *DEFINES[precision], "-std=c99", "-I", directory]
    run(TARGETS[board].compiler, *flags, "-c", numbers, "-o", tmp_path / "numbers.o")
    objects = [*(directory / f"{name}.o" for name in CONTROLLER), tmp_path / "numbers.o"]
    sizes = [line.split()[:3] for line in run(tools, *objects).stdout.splitlines()[1:]]
    flash, data, zeroed = (sum(map(int, column)) for column in zip(*sizes, strict=True))
    assert flash <= FLASH[precision]
    assert (data, zeroed) == (0, 0)  # no state but the caller's
    symbols = run("arm-none-eabi-nm", "-S", directory / "main.o").stdout
    ram = sum(int(size, 16) for size in re.findall(r"^\S+ (\S+) b (?:mpc|memory)$", symbols, re.MULTILINE))
    measured(board, precision, flash=flash, ram=ram)
    assert 0 < ram <= MEMORY[precision]
    frames = [line.split("\t") for name in CONTROLLER for line in (directory / f"{name}.su").read_text().splitlines()]
    assert {kind for _, _, kind in frames} == {"static"}
    assert max(int(size) for _, size, _ in frames) <= FRAME


@pytest.mark.parametrize(("board", "precision"), [("cortex-m7", "double"), ("cortex-m4f", "float")])
def test_the_stack_is_small(board: str, precision: str, exported: Export, run: Run, tmp_path: Path) -> None:
    """Painted below main, and looked at after all recorded periods."""
    directory = exported(board, precision)
    target, image = TARGETS[board], tmp_path / "stack.elf"
    sources = [directory / f"{name}.c" for name in (*CONTROLLER, "vectors", "startup")]
    flags = f"{target.machine} {' '.join(DEFINES[precision])} -O3 -std=gnu99 -ffp-contract=off -I {directory}".split()
    link = f"-nostartfiles -T {directory / 'mps2.ld'} --specs=nano.specs".split()
    run(target.compiler, *flags, "-o", image, HERE / "stack.c", *sources, *link)
    done = run(*target.emulation, "-serial", "none", "-kernel", image)
    assert 0 < int(done.stderr, 16) <= STACK
