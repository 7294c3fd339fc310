"""A million steps under hostile commands, in threads: no stray access, no race, the bits of flights alone."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest

from quadsim.core.build import FLAGS, ROOT

CORE = ROOT / "quadsim" / "core"
UNITS = [
    *(CORE / f"quadsim_{name}.c" for name in ("batch", "plant", "inner")),
    Path(__file__).with_name("hostile_batch.c"),
]
STEPS = 1_000_000
THREADS = 4


def compiled(folder: Path, *options: str) -> Path:
    """Return the program, compiled with further options; skip the test where gcc lacks one."""
    program = folder / "hostile_batch"
    flags = [flag for flag in FLAGS if flag not in ("-O3", "-fPIC", "-shared")]
    command = ["gcc", *flags, "-D_POSIX_C_SOURCE=200809L", "-O1", "-g", "-Wall", "-Wextra", "-Werror", *options]
    command += ["-I", str(CORE), *map(str, UNITS), "-lm", "-pthread", "-o", str(program)]
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode and "cannot find" in done.stderr:
        pytest.skip(f"gcc lacks {options}")
    assert done.returncode == 0, done.stderr
    return program


def run(program: Path, threads: int, steps: int) -> str:
    done = subprocess.run([str(program), str(threads), str(steps)], capture_output=True, text=True, timeout=900)
    assert done.returncode == 0, done.stderr[-4000:]
    return done.stdout


def test_any_number_of_threads_flies_the_same(tmp_path: Path) -> None:
    program = compiled(tmp_path)
    outputs = {run(program, threads, 50_000) for threads in (1, 3, 48)}
    assert len(outputs) == 1
    flown, _, ended = (int(word) for word in outputs.pop().split() if word.isdigit())
    assert flown >= 50_000
    assert ended > 10


@pytest.mark.slow("core")
@pytest.mark.parametrize("sanitizers", ["address,undefined", "thread"])
def test_sanitizers_find_nothing_in_a_million_hostile_steps(sanitizers: str, tmp_path: Path) -> None:
    program = compiled(tmp_path, f"-fsanitize={sanitizers}", "-fno-sanitize-recover=all")
    output = run(program, THREADS, STEPS)
    assert int(output.split()[0]) >= STEPS
