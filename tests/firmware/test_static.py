"""What compilers and analysers find in exported C: nothing, and what is planted there."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from firmware.conftest import Export, Run, defines_of, sources_of

from quadsim.mpc.export.targets import TARGETS

WARNINGS = [
    *("-std=c99", "-O3", "-Wall", "-Wextra", "-Wconversion", "-Wdouble-promotion", "-Wshadow", "-Wcast-qual", "-Wvla"),
    *("-pedantic", "-Werror", "-ffp-contract=off"),
]
TIDY = ",".join(
    [
        "-*,bugprone-*,cert-*,clang-analyzer-*,misc-no-recursion",
        "-bugprone-easily-swappable-parameters",  # (rows, columns) is an order that all of linear algebra shares
        "-bugprone-implicit-widening-of-multiplication-result",  # indices are below 2^20: the exporter refuses more
        "-bugprone-signed-char-misuse,-cert-str34-c",  # signed char is a small number here, no text
    ]
)
CPPCHECK = ["--quiet", "--std=c99", "--enable=warning,style,performance,portability", "--error-exitcode=1"]
CPPCHECK += ["--suppress=variableScope", "--suppress=unusedStructMember"]  # of members that other controllers use
ALLOWED = {"memcpy", "memmove", "memset"}
EXPORTS = {"double": ("cortex-m7", "double"), "float": ("cortex-m4f", "float")}
PROGRAMS = ("main.c", "serial.c", "vectors.c")
LAWS = {"linear": ("paper-constrained",), "nonlinear": ("autopilot", "duration=2.0")}
"""A scenario of each kind of law, and its settings."""


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("compiler", ["gcc", "clang", "arm-none-eabi-gcc"])
@pytest.mark.parametrize("precision", EXPORTS)
def test_compilers_give_no_warning(
    precision: str, compiler: str, law: str, exported: Export, run: Run, tmp_path: Path
) -> None:
    bare, (scenario, *settings) = compiler.startswith("arm"), LAWS[law]
    target = EXPORTS[precision] if bare else ("posix", precision)
    directory = exported(*target, *settings, scenario=scenario)
    machine = TARGETS[EXPORTS[precision][0]].machine.split() if bare else []
    programs = [directory / name for name in (*PROGRAMS, "startup.c" if bare else "posix.c")]
    for source in (*sources_of(directory), *programs):
        run(compiler, *machine, *defines_of(directory), *WARNINGS, "-c", source, "-o", tmp_path / "object.o")


def test_files_of_two_precisions_do_not_make_a_program(exported: Export, run: Run, tmp_path: Path) -> None:
    """Their memory differs: neither the numbers nor the core may be of the other."""
    directory = exported("posix", "double")
    core = tmp_path / "core.o"
    done = run("gcc", "-DQUADSIM_FLOAT", "-c", directory / "main.c", "-o", tmp_path / "main.o", check=False)
    assert "this export is of doubles" in done.stderr
    run("gcc", "-DQUADSIM_FLOAT", "-c", directory / "quadsim_core.c", "-o", core)
    others = [path for path in sources_of(directory) if path.name != "quadsim_core.c"]
    sources = [*others, *(directory / name for name in ("main.c", "vectors.c", "posix.c"))]
    done = run("gcc", *sources, core, "-o", tmp_path / "program", check=False)
    assert "undefined reference to `quadsim_work_start'" in done.stderr


@pytest.mark.parametrize("law", LAWS)
def test_analysers_find_nothing(law: str, exported: Export, run: Run, tmp_path: Path) -> None:
    scenario, *settings = LAWS[law]
    directory = exported("posix", "double", *settings, scenario=scenario)
    sources = [*sources_of(directory), *(directory / name for name in ("main.c", "serial.c", "posix.c"))]
    for source in sources:
        run("gcc", *defines_of(directory), *WARNINGS, "-O1", "-fanalyzer", "-c", source, "-o", tmp_path / "object.o")
    # In one precision: else cppcheck takes lengths in floats for those in doubles.
    run("cppcheck", *CPPCHECK, "-UQUADSIM_FLOAT", *sources, exported("cortex-m7", "double") / "startup.c")
    run("clang-tidy", "-quiet", f"-checks={TIDY}", "-warnings-as-errors=*", *sources, "--", "-std=c99")


def undefined(sources: list[Path], directory: Path, precision: str, run: Run, made: Path) -> set[str]:
    """Undefined symbols of sources together, compiled as the export in a directory."""
    target = TARGETS[EXPORTS[precision][0]]
    flags = [*target.machine.split(), *defines_of(directory), "-std=c99", "-O3", "-nostdlib", "-r"]
    run(target.compiler, *flags, *sources, "-o", made)
    return {line.split()[-1] for line in run("arm-none-eabi-nm", "-u", made).stdout.splitlines()}


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("precision", EXPORTS)
def test_a_controller_needs_the_library_for_copies_only(
    precision: str, law: str, exported: Export, run: Run, tmp_path: Path
) -> None:
    """No malloc, no mathematics, and in float no emulated doubles, which a Cortex-M4F would need."""
    scenario, *settings = LAWS[law]
    directory = exported(*EXPORTS[precision], *settings, scenario=scenario)
    assert undefined(sources_of(directory), directory, precision, run, tmp_path / "needed.o") <= ALLOWED


PLANTED = """
#include "quadsim_mpc.h"
#include <stdlib.h>
int quadsim_planted(int count, quadsim_real *numbers);
int quadsim_planted(int count, quadsim_real *numbers)
{{
    {body}
}}
"""
FAULTS = {
    "recursion": ("tidy", "return count > 0 ? quadsim_planted(count - 1, numbers) : 0;", "misc-no-recursion"),
    "allocation": ("nm", "numbers[0] = *(quadsim_real *)malloc(8);\n    return count;", "malloc"),
    "double in float": ("nm", "numbers[0] = (float)((double)numbers[0] * 0.1);\n    return count;", "__aeabi_d"),
    "promotion": ("gcc", "return numbers[0] * 0.1 > 1.0 ? count : 0;", "double-promotion"),
    "too small": ("gcc", "numbers[0] = 1e-60F;\n    return count;", "truncated to zero"),
    "beyond an array": ("cppcheck", "int few[2] = {{1, 2}};\n    return few[2] + count;", "arrayIndexOutOfBounds"),
    "array of unknown size": ("gcc", "int some[count];\n    some[0] = 1;\n    return some[0];", "vla"),
    "memory not set": (
        "gcc -fanalyzer",
        "int *some = malloc(4);\n    return some ? *some + count : 0;",
        "uninitialized",
    ),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_planted_faults_are_detected(fault: str, exported: Export, run: Run, tmp_path: Path) -> None:
    """Each trap that exported C could fall into: recursion, allocation, doubles, numbers too small and others."""
    tool, body, finding = FAULTS[fault]
    source = tmp_path / "planted.c"
    header = exported("cortex-m4f", "float")
    source.write_text(PLANTED.format(body=body.format()))
    include = f"-I{header}"
    if tool == "nm":
        for name in ("quadsim_core.h", "quadsim_guard.h", "quadsim_mpc.h"):
            shutil.copy(header / name, tmp_path)
        assert any(
            name.startswith(finding) for name in undefined([source], header, "float", run, tmp_path / "planted.o")
        )
        return
    commands = {
        "tidy": ["clang-tidy", "-quiet", f"-checks={TIDY}", "-warnings-as-errors=*", source, "--", "-std=c99", include],
        "cppcheck": ["cppcheck", *CPPCHECK, include, source],
    }
    compile = [*tool.split(), *defines_of(header), *WARNINGS, include, "-c", source, "-o", tmp_path / "planted.o"]
    done = run(*commands.get(tool, compile), check=False)
    assert done.returncode != 0
    assert finding in done.stdout + done.stderr
