"""Every target computes the same bits as the host over all recorded periods, within bounds on size, stack and work."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from firmware.conftest import Answer, Answers, Export, Measured, Run, defines_of, sources_of

from quadsim.features.export.in_the_loop import make_program
from quadsim.mpc.export.targets import INSTRUCTIONS_PER_TICK, TARGETS

HERE = Path(__file__).parent
BOARDS = [name for name, target in TARGETS.items() if target.board]
AARCH64 = ("CC=aarch64-linux-gnu-gcc", "MACHINE_LINK=-static", "RUN=qemu-aarch64")
OTHERS = {
    "cortex-m7": ("cortex-m7",),
    "cortex-m4f": ("cortex-m4f",),
    "aarch64": ("posix", *AARCH64),
    "host, unoptimised": ("posix", "CFLAGS=-O0 -std=c99"),
    "host, clang": ("posix", "CC=clang", "CFLAGS=-O3 -std=c99"),
}
PRECISIONS = ("double", "float")
CONTRACTED = "ALWAYS=-ffp-contract=fast"


@dataclass(frozen=True)
class Limits:
    """What a scenario's controller may take on a board.

    Attributes:
        boards: board and precision.
        steps: median, 99th percentile, most after the first, and the first [10^6 instructions].
        flash: code and constants, in doubles and in floats [kB].
        memory: the controller's struct and memory, in doubles and in floats [kB].
        stack: of a function, and in all recorded periods [B].
        periods: that are recorded.
        statuses: that occur.
    """

    boards: tuple[tuple[str, str], ...]
    steps: tuple[float, float, float, float]
    flash: dict[str, float]
    memory: dict[str, float]
    stack: tuple[int, int]
    periods: int
    statuses: set[int]


LAWS = {
    "paper-constrained": Limits(
        (("cortex-m7", "double"), ("cortex-m7", "float"), ("cortex-m4f", "float")),
        (0.1, 3.0, 7.0, 9.0),
        {"double": 200, "float": 134},
        {"double": 103, "float": 53},
        (1400, 4000),
        1200,
        {0, 1, 2},
    ),
    "nonlinear": Limits(
        (("cortex-m7", "double"),),
        (2.0, 10.0, 12.0, 12.0),
        {"double": 140},
        {"double": 115},
        (21_000, 22_000),
        600,
        {0, 2, 14},
    ),
    "autopilot": Limits(
        (("cortex-m7", "float"), ("cortex-m4f", "float")),
        (2.0, 5.0, 5.0, 5.0),
        {"float": 152},
        {"float": 40},
        (14_500, 8000),
        302,
        {0},
    ),
}
BOARDED = [(law, *board) for law, limits in LAWS.items() for board in limits.boards]
SAME = [
    *(("paper-constrained", precision, other) for precision in PRECISIONS for other in OTHERS),
    *(("nonlinear", "double", other) for other in ("cortex-m7", "host, clang")),
    *(("autopilot", "float", other) for other in ("cortex-m7", "cortex-m4f", "aarch64")),
]


def bits(found: list[Answer]) -> list[Answer]:
    """Without the ticks."""
    return [answer[:7] for answer in found]


@pytest.mark.parametrize("board", BOARDS)
def test_a_board_starts_counts_and_stops(board: str, exported: Export, run: Run, tmp_path: Path) -> None:
    target = TARGETS[board]
    directory = exported(board, "double")
    flags = f"{target.machine} -O3 -std=gnu99 -I {directory}".split()
    image = tmp_path / "bare.elf"
    link = f"-nostartfiles -T {directory / 'mps2.ld'} --specs=nano.specs".split()
    run(target.compiler, *flags, "-o", image, HERE / "bare.c", directory / "startup.c", *link)
    emulate = (*target.emulation, "-serial", "stdio", "-kernel", image)
    done = run(*emulate, input="abcq")
    assert (done.stdout, done.stderr) == ("bc", "as many ticks\n")
    for fault in "fn":
        assert run(*emulate, input=fault, check=False).returncode == 3


@pytest.mark.parametrize(("law", "precision", "other"), SAME)
def test_every_target_answers_the_same_bits(other: str, precision: str, law: str, answers: Answers) -> None:
    target, *make = OTHERS[other]
    host, result = (answers(at, precision, *how, scenario=law) for at, how in (("posix", ()), (target, make)))
    assert len(host) == LAWS[law].periods
    assert {int(answer[1], 16) for answer in host} == LAWS[law].statuses  # every way to an optimum
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


WASM = [
    *("clang", "--target=wasm32", "-O3", "-std=c99", "-ffp-contract=off", "-fno-builtin", "-nostdlib", "-Dmain=answer"),
    "-DPRINT_PERIODS=1",
    *("-Wl,--no-entry,--allow-undefined", "-Wl,--export=answer,--export=memory"),
]
STRING = """#include <stddef.h>
void *memcpy(void *restrict to, const void *restrict from, size_t bytes);
void *memmove(void *to, const void *from, size_t bytes);
void *memset(void *to, int value, size_t bytes);
"""
NODE = """
const bytes = new Uint8Array(require("fs").readFileSync(process.argv[1]));
let memory;
const text = at => { const all = new Uint8Array(memory.buffer), end = all.indexOf(0, at);
  return Buffer.from(all.subarray(at, end)).toString(); };
const env = { target_print: at => process.stdout.write(text(at)) };
WebAssembly.instantiate(bytes, { env }).then(({ instance }) => {
  memory = instance.exports.memory; process.exitCode = instance.exports.answer(); });
"""


@pytest.mark.parametrize(
    ("law", "precision"), [("paper-constrained", "double"), ("nonlinear", "double"), ("autopilot", "float")]
)
def test_webassembly_answers_the_same_bits(
    law: str, precision: str, exported: Export, answers: Answers, run: Run, tmp_path: Path
) -> None:
    directory = exported("posix", precision, scenario=law)
    (tmp_path / "string.h").write_text(STRING)
    programs = [directory / "main.c", directory / "vectors.c", HERE / "wasm.c"]
    include = ["-I", tmp_path, "-I", directory]
    module = tmp_path / "answer.wasm"
    run(*WASM, *defines_of(directory), *include, "-o", module, *programs, *sources_of(directory))
    done = run("node", "-e", NODE, module)
    lines = [tuple(line.split()) for line in done.stdout.splitlines()]
    assert bits([line for line in lines if len(line) == 8]) == bits(answers("posix", precision, scenario=law))


def test_contraction_would_change_bits(answers: Answers) -> None:
    """The flag is there for a reason: with it on, an aarch64 fuses products and sums."""
    assert bits(answers("posix", "double", *AARCH64, CONTRACTED)) != bits(answers("posix", "double"))


@pytest.mark.parametrize(("law", "board", "precision"), BOARDED)
def test_a_step_takes_few_instructions(
    law: str, board: str, precision: str, answers: Answers, measured: Measured
) -> None:
    """Instructions, not cycles: the emulator has neither caches nor wait states."""
    found = answers(board, precision, scenario=law)
    steps = np.array([int(answer[7], 16) * INSTRUCTIONS_PER_TICK for answer in found])
    result = {"p50": np.median(steps), "p99": np.percentile(steps, 99), "warm": steps[1:].max(), "first": steps[0]}
    measured(law, board, precision, **result)
    for number, most in zip(result.values(), LAWS[law].steps, strict=True):
        assert number <= 1e6 * most


@pytest.mark.parametrize(("law", "board", "precision"), BOARDED)
def test_a_controller_fits(
    law: str, board: str, precision: str, exported: Export, run: Run, measured: Measured, tmp_path: Path
) -> None:
    directory = exported(board, precision, scenario=law)
    tools = "arm-none-eabi-size"
    run(TARGETS[board].compiler, "--version")
    make_program(directory, "vectors.elf")
    numbers = tmp_path / "numbers.c"
    numbers.write_text('#include "quadsim_data.h"\nconst void *const used = &QUADSIM_CONTROLLER;\n')
    flags = [*TARGETS[board].machine.split(), *defines_of(directory), "-std=c99", "-I", directory]
    run(TARGETS[board].compiler, *flags, "-c", numbers, "-o", tmp_path / "numbers.o")
    sources = sources_of(directory)
    objects = [*(path.with_suffix(".o") for path in sources), tmp_path / "numbers.o"]
    sizes = [line.split()[:3] for line in run(tools, *objects).stdout.splitlines()[1:]]
    flash, data, zeroed = (sum(map(int, column)) for column in zip(*sizes, strict=True))
    symbols = run("arm-none-eabi-nm", "-S", directory / "main.o").stdout
    ram = sum(int(size, 16) for size in re.findall(r"^\S+ (\S+) b (?:law|memory)$", symbols, re.MULTILINE))
    measured(law, board, precision, flash=flash, ram=ram)
    assert flash <= 1e3 * LAWS[law].flash[precision]
    assert (data, zeroed) == (0, 0)  # no state but the caller's
    assert 0 < ram <= 1e3 * LAWS[law].memory[precision]
    frames = [line.split("\t") for path in sources for line in path.with_suffix(".su").read_text().splitlines()]
    assert {kind for _, _, kind in frames} == {"static"}
    assert max(int(size) for _, size, _ in frames) <= LAWS[law].stack[0]


@pytest.mark.parametrize(
    ("law", "board", "precision"), [case for case in BOARDED if case[1:] != ("cortex-m7", "float")]
)
def test_the_stack_is_small(board: str, precision: str, law: str, exported: Export, run: Run, tmp_path: Path) -> None:
    """Painted below main, and looked at after all recorded periods."""
    directory = exported(board, precision, scenario=law)
    target = TARGETS[board]
    image = tmp_path / "stack.elf"
    sources = [*sources_of(directory), *(directory / f"{name}.c" for name in ("vectors", "startup"))]
    flags = (
        f"{target.machine} {' '.join(defines_of(directory))} -O3 -std=gnu99 -ffp-contract=off -I {directory}".split()
    )
    link = f"-nostartfiles -T {directory / 'mps2.ld'} --specs=nano.specs".split()
    run(target.compiler, *flags, "-o", image, HERE / "stack.c", *sources, *link)
    done = run(*target.emulation, "-serial", "none", "-kernel", image)
    assert 0 < int(done.stderr, 16) <= LAWS[law].stack[1]
