"""The library of quadsim's C: who compiles it, and what happens to one that is missing, stale or broken."""

from __future__ import annotations

import ctypes
import errno
import os
import shlex
import shutil
import signal
import subprocess
import sys
import time as clock
from collections.abc import Callable
from pathlib import Path

import pytest

from quadsim.core import build, headers, library
from quadsim.core.build import LIBRARY, PLATFORM, ZIG, ZIG_TARGETS, CompilationError
from quadsim.core.library import load_from, load_library
from quadsim.core.mirror import check_layout, make_structs
from quadsim.errors import FileError

ANSWER = "quadsim/mpc/c/answer.c"


@pytest.fixture
def tree(tmp_path: Path) -> Path:
    """A folder of packages with a C function that answers 1; no library is there."""
    for folder in build.FOLDERS:
        (tmp_path / folder).mkdir(parents=True)
    shutil.copy2(build.ROOT / "quadsim/core/sources.c", tmp_path / "quadsim/core")
    answering(tmp_path, 1)
    return tmp_path


def answering(tree: Path, answer: int) -> None:
    (tree / ANSWER).write_text(f"int answer(void);\nint answer(void)\n{{\n    return {answer};\n}}\n")


@pytest.fixture
def no_compiler(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The only folder of the PATH, which is empty; there is no package ziglang either."""
    empty = tmp_path_factory.mktemp("bin")
    for name in ("CC", PLATFORM):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("PATH", str(empty))
    monkeypatch.setattr(build.importlib.util, "find_spec", lambda name: None)
    return empty


@pytest.fixture
def only_zig(no_compiler: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(build.importlib.util, "find_spec", lambda name: object() if name == "ziglang" else None)


def program(folder: Path, name: str) -> str:
    path = folder / name
    path.write_text("#!/bin/sh\n")
    path.chmod(0o755)
    return str(path)


# Who compiles


def test_the_system_s_compiler_comes_before_zig(no_compiler: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("clang", "gcc", "cc"):
        path = program(no_compiler, name)
        assert (build.compiler(), build.requirements()) == ([path], [])
    monkeypatch.setenv("CC", "ccache gcc-14 -m64")
    assert (build.compiler(), build.requirements()) == (["ccache", "gcc-14", "-m64"], [])


@pytest.mark.usefixtures("only_zig")
def test_without_one_zig_compiles_for_every_processor() -> None:
    assert build.requirements() == [ZIG]
    assert build.compiler() == [sys.executable, "-m", "ziglang", "cc", "-mcpu=baseline"]


@pytest.mark.parametrize("platform", ZIG_TARGETS)
@pytest.mark.usefixtures("only_zig")
def test_zig_compiles_what_is_published(platform: str, no_compiler: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    program(no_compiler, "cc")
    assert build.requirements() == []
    monkeypatch.setenv(PLATFORM, platform)
    assert (build.requirements(), build.platform_tag()) == ([ZIG], platform)
    assert build.compiler()[1:] == ["-m", "ziglang", "cc", "-target", ZIG_TARGETS[platform]]


@pytest.mark.parametrize(
    ("platform", "message"),
    [
        ("", rf"no C compiler \(cc, gcc, clang\), nor {ZIG}"),
        ("macosx_11_0_arm64", f"QUADSIM_PLATFORM needs the package {ZIG}"),
        ("win_amd64", r"QUADSIM_PLATFORM must be one of manylinux_2_28_x86_64, .*; got 'win_amd64'"),
    ],
)
@pytest.mark.usefixtures("no_compiler")
def test_what_is_missing_is_named(platform: str, message: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(PLATFORM, platform)
    with pytest.raises(CompilationError, match=message):
        build.compiler()


@pytest.mark.parametrize("kind", ["wheel", "editable"])
def test_pip_is_told_to_fetch_zig(kind: str, no_compiler: Path) -> None:
    code = f"import hatchling.build as b; print(b.get_requires_for_build_{kind}())"

    def required() -> str:
        command = [sys.executable, "-c", code]
        return subprocess.run(command, cwd=build.ROOT, capture_output=True, text=True, check=True).stdout

    assert ZIG in required()
    program(no_compiler, "cc")
    assert "ziglang" not in required()


# What is loaded


def test_a_missing_library_is_compiled(tree: Path) -> None:
    assert load_from(tree).answer() == 1
    assert [file.name for file in (tree / LIBRARY).parent.iterdir() if "_core" in file.name] == ["_core.so"]


def test_a_stale_library_is_replaced_and_not_overwritten(tree: Path) -> None:
    path = build.compile_library(tree)
    assert build.is_current(tree)
    answering(tree, 2)
    assert not build.is_current(tree)
    before = path.read_bytes()
    with path.open("rb") as mapped:
        assert load_from(tree).answer() == 2
        assert mapped.read() == before
    assert build.is_current(tree)


# Several processes at once

SLOW_COMPILER = """#!/bin/sh
echo compiling >> "$0.calls"
while [ ! -e "$0.release" ]; do sleep 0.05; done
exec cc "$@"
"""
LOADING = """
import logging, sys
from pathlib import Path
from quadsim.core.library import load_from
logging.basicConfig(format="%(message)s", level=logging.INFO)
print(load_from(Path(sys.argv[1])).answer())
"""


@pytest.fixture
def slow_compiler(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A compiler that notes each call in `cc.calls` beside it, and then waits until there is `cc.release`."""
    path = tmp_path_factory.mktemp("slow") / "cc"
    path.write_text(SLOW_COMPILER)
    path.chmod(0o755)
    monkeypatch.setenv("CC", shlex.quote(str(path)))
    return path


def loading(tree: Path) -> subprocess.Popen[str]:
    """Start a process that loads the library, and prints what its function answers."""
    return subprocess.Popen(
        [sys.executable, "-c", LOADING, tree],
        cwd=build.ROOT,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )


def release(compiler: Path) -> None:
    """Let the compiler compile, now and from now on."""
    compiler.with_suffix(".release").touch()


def wait_for_the_lock(process: subprocess.Popen[str]) -> None:
    """Return once a process has said that it waits for another one."""
    assert process.stderr is not None
    assert process.stderr.readline() == "waiting for another process, which compiles the C library\n"


def calls(compiler: Path, *, at_least: int = 0) -> int:
    """Return how often the compiler was called, once it was so often."""
    noted = compiler.with_suffix(".calls")
    deadline = clock.monotonic() + 60.0
    while clock.monotonic() < deadline:
        count = 0
        if noted.exists():
            count = noted.read_text().count("compiling")
        if count >= at_least:
            return count
        clock.sleep(0.02)
    raise TimeoutError(f"{compiler} was not called {at_least} times")


def test_one_process_compiles_and_the_others_wait_for_it(tree: Path, slow_compiler: Path) -> None:
    first = loading(tree)
    calls(slow_compiler, at_least=1)
    others = [loading(tree), loading(tree)]
    for process in others:
        wait_for_the_lock(process)
    release(slow_compiler)
    answers = [process.communicate(timeout=60.0) for process in (first, *others)]
    assert [answer for answer, _ in answers] == ["1\n"] * 3
    assert calls(slow_compiler) == 1
    assert "compiling the C library" in answers[0][1]
    assert [told for _, told in answers[1:]] == ["", ""], "they compile nothing"


def test_a_process_that_dies_while_it_compiles_holds_nobody_up(tree: Path, slow_compiler: Path) -> None:
    first = loading(tree)
    calls(slow_compiler, at_least=1)
    second = loading(tree)
    wait_for_the_lock(second)
    first.kill()
    calls(slow_compiler, at_least=2)
    os.killpg(first.pid, signal.SIGKILL)  # its compiler
    release(slow_compiler)
    assert second.communicate(timeout=60.0)[0] == "1\n"
    assert calls(slow_compiler) == 2
    first.communicate()


def test_a_file_system_without_locks_does_without(tree: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(folder: int, operation: int) -> None:
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr(library.fcntl, "flock", refuse)
    assert load_from(tree).answer() == 1
    assert not library.is_compiling()


def flag(tree: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(build, "FLAGS", (*build.FLAGS, "-DONE"))


def header(tree: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tree / ANSWER).with_name("answer.h").touch()


def rename(tree: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tree / ANSWER).rename((tree / ANSWER).with_name("reply.c"))


@pytest.mark.parametrize("change", [flag, header, rename])
def test_flags_headers_and_names_count_as_sources(
    change: Callable[[Path, pytest.MonkeyPatch], None], tree: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    build.compile_library(tree)
    change(tree, monkeypatch)
    assert not build.is_current(tree)


def test_without_sources_nothing_is_compared(tree: Path) -> None:
    build.compile_library(tree)
    for file in build.sources(tree):
        file.unlink()
    assert load_from(tree).answer() == 1


def test_a_library_of_another_machine_is_compiled_anew(tree: Path) -> None:
    (tree / LIBRARY).write_bytes(b"\xcf\xfa\xed\xfe" + build.stamp(tree).encode())
    assert build.is_current(tree)
    assert load_from(tree).answer() == 1


@pytest.mark.parametrize(
    ("content", "problem"),
    [(None, "is missing"), (b"\x7fELF", "was compiled from other sources"), ("stamp", r"cannot be loaded \(.*\)")],
)
@pytest.mark.usefixtures("no_compiler")
def test_what_cannot_be_compiled_is_refused(content: bytes | str | None, problem: str, tree: Path) -> None:
    if content is not None:
        (tree / LIBRARY).write_bytes(content if isinstance(content, bytes) else build.stamp(tree).encode())
    lacking = rf"and it cannot be compiled \(no C compiler \(cc, gcc, clang\), nor {ZIG}\)"
    with pytest.raises(FileError, match=rf"_core\.so: {problem}, {lacking}; run: pip install --force-reinstall --no-"):
        load_from(tree)
    (tree / "hatch_build.py").touch()
    with pytest.raises(FileError, match=rf"run: pip install --editable {tree}$"):
        load_from(tree)


def test_the_compiler_s_first_error_is_shown(tree: Path) -> None:
    (tree / ANSWER).write_text("#warning first\nint answer(void) { return one; }\n")
    with pytest.raises(FileError, match=r"answer\.c:2:\d+: error: .*one") as caught:
        load_from(tree)
    assert "\n" not in str(caught.value)
    assert not (tree / LIBRARY).exists()


def test_a_header_that_cannot_be_mirrored_is_named_by_its_line(tree: Path) -> None:
    (tree / ANSWER).with_name("answer.h").write_text("typedef struct wrong {\n    int flag : 1;\n} wrong;\n")
    with pytest.raises(FileError, match=r"cannot be compiled \(error: .*answer\.h: line 2: 'int flag : 1' is not a m"):
        load_from(tree)
    assert not (tree / LIBRARY).exists()


def test_the_library_states_where_the_compiler_puts_members(tree: Path) -> None:
    header = (tree / ANSWER).with_name("answer.h")
    header.write_text("typedef struct toy {\n    char flag;\n    double x[2];\n    int n;\n} toy;\n")
    structs = make_structs(headers.read_headers([header]))
    check_layout(load_from(tree), structs)
    header.write_text(header.read_text().replace("    int n;\n", "").replace("    char", "    int n;\n    char"))
    structs = make_structs(headers.read_headers([header]))
    with pytest.raises(ValueError, match=r"toy\.n has 4 bytes at 24, not 4 at 0"):
        check_layout(ctypes.CDLL(str(tree / LIBRARY)), structs)


def test_a_compiler_that_does_not_exist_is_named(tree: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CC", "no-such-compiler")
    with pytest.raises(FileError, match=r"cannot be compiled \(.*'no-such-compiler'\)"):
        load_from(tree)


def test_the_script_prints_the_library_or_all_that_the_compiler_says(tree: Path) -> None:
    script = shutil.copy2(build.__file__, tree / "quadsim" / "core")
    shutil.copy2(headers.__file__, tree / "quadsim" / "core")

    def run() -> subprocess.CompletedProcess[str]:
        return subprocess.run([sys.executable, script], capture_output=True, text=True)

    assert run().stdout == f"{tree / LIBRARY}\n"
    (tree / ANSWER).write_text("int answer(void) { return one + two; }\n")
    done = run()
    assert done.returncode == 1
    assert done.stderr.count("error: ") == 2
    assert "Traceback" not in done.stderr


def test_this_library_is_of_these_sources() -> None:
    assert load_library() is load_library()
    assert build.is_current()
    assert library.ROOT == build.ROOT == Path(__file__).parents[2]
