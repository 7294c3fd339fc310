"""Steps from arbitrary bytes, under the sanitizers: no fault, no hang, and commands within their bounds."""

from __future__ import annotations

import os
import re
from pathlib import Path

import pytest
from firmware.conftest import Export, Run, defines_of, sources_of

HERE = Path(__file__).parent
SANITIZERS = ["-fsanitize=fuzzer,address,undefined", "-fno-sanitize-recover=all"]
SECONDS = 8
"""Of each controller; the variable FUZZ_RUNS has a number of inputs instead, of four steps or so each."""
LONGEST = 7200
"""Seconds of those."""
HANGS = 30
"""Seconds of one input that are taken for a hang; the hardest takes half a second on a busy machine."""
SHORT = ("controller.horizon=10", "duration=5")
CONTROLLERS = {
    "short": ("paper-constrained", "double", *SHORT),
    "short, float": ("paper-constrained", "float", *SHORT),
    "whole": ("paper-constrained", "double"),
    "robust": ("robust", "double", *SHORT),
    "robust, float": ("robust", "float", *SHORT),
    "nonlinear": ("nonlinear", "double", "duration=5"),
    "rates": ("autopilot", "double", "duration=3"),
    "rates, float": ("autopilot", "float", "duration=3"),
}


@pytest.mark.parametrize("name", CONTROLLERS)
def test_arbitrary_bytes_lead_to_commands_within_bounds(name: str, exported: Export, run: Run, tmp_path: Path) -> None:
    """A short horizon makes many steps; the whole one has the paths that only many active rows take."""
    scenario, *settings = CONTROLLERS[name]
    directory = exported("posix", *settings, scenario=scenario)
    program = tmp_path / "fuzz"
    define = [*defines_of(directory), "-I", directory]
    compile = ["clang", "-g", "-O3", "-std=c99", "-ffp-contract=off", *SANITIZERS, *define]
    built = run(*compile, "-o", program, HERE / "fuzz.c", *sources_of(directory), check=False)
    if "cannot find" in built.stderr:
        pytest.skip("clang has no sanitizers: make firmware")
    assert built.returncode == 0, built.stderr
    runs = os.environ.get("FUZZ_RUNS")
    length = f"-runs={runs}" if runs else f"-max_total_time={SECONDS}"
    done = run(
        program, length, f"-timeout={HANGS}", "-max_len=600", "-len_control=0", "-seed=1", cwd=tmp_path, timeout=LONGEST
    )
    (steps,) = re.findall(r"^steps: (\d+)$", done.stdout, re.MULTILINE)
    print(f"{name}: {steps} steps from arbitrary bytes")
    assert int(steps) > 20  # hundreds, on a machine with nothing else to do


def test_a_command_out_of_bounds_is_detected(exported: Export, run: Run, tmp_path: Path) -> None:
    """The target can fail: with a controller that does not clip, it does at once."""
    directory = exported("posix", "double", "controller.horizon=10", "duration=5")
    text = (directory / "quadsim_guard.c").read_text()
    clip = "command[j] = clipped(wanted[j], lower, upper);"
    assert clip in text
    (tmp_path / "quadsim_guard.c").write_text(text.replace(clip, "(void)upper, command[j] = lower + wanted[j];"))
    compile = ["clang", "-O1", "-std=c99", *SANITIZERS, "-I", tmp_path, "-I", directory]
    sources = [
        HERE / "fuzz.c",
        tmp_path / "quadsim_guard.c",
        *(path for path in sources_of(directory) if path.name != "quadsim_guard.c"),
    ]
    built = run(*compile, "-o", tmp_path / "fuzz", *sources, check=False)
    if "cannot find" in built.stderr:
        pytest.skip("clang has no sanitizers: make firmware")
    done = run(tmp_path / "fuzz", "-runs=2000", "-max_len=600", "-len_control=0", cwd=tmp_path, check=False)
    assert done.returncode != 0
    assert "violated: bounds on" in done.stderr
