"""The exported geometric law: recorded periods, its flight, what compilers and analysers find, and what it needs."""

from __future__ import annotations

import functools
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from exported_c import Host
from firmware.conftest import EVERY_PERIOD, Run, defines_of
from firmware.test_fuzz import HANGS, HERE, SANITIZERS
from firmware.test_static import ALLOWED, CPPCHECK, EXPORTS, TIDY, WARNINGS, undefined

import quadsim
from quadsim.errors import ExportError, ParameterError
from quadsim.features.export.exporter import c_controller, export
from quadsim.features.export.in_the_loop import fly_exported
from quadsim.mpc.export.ctext import Precision
from quadsim.mpc.export.geometric import CGeometric
from quadsim.mpc.export.targets import TARGETS
from quadsim.mpc.guard.structs import STATUSES
from quadsim.scenarios.assembly import Assembly
from quadsim.scenarios.schema.scenario import Scenario
from quadsim.state import make_state

FED_FORWARD = {"feedforward": True, "disturbance": {}, "drag": [0.3, 0.2, 0.1], "integral": True}
"""With the autopilot scenario's motion as its reference."""
LATE = {**FED_FORWARD, "delay": 0.013}
LAWS: dict[str, dict[str, Any]] = {
    "plain": {},
    "observing": {"disturbance": {}},
    "fed forward": FED_FORWARD,
    "late": LATE,
}
SOURCES = tuple(name for name in CGeometric.law_files if name.endswith(".c"))
OWN = ("quadsim_delay.c", "quadsim_ramp.c", "quadsim_geometric.c")
PRECISIONS = pytest.mark.parametrize("precision", ["double", "float"])

Exported = Callable[..., Path]


def scenario_of(law: str) -> Scenario:
    table = {"type": "geometric", "commands": "rates", **LAWS[law]}
    return quadsim.load("autopilot").replace({"controller": table, "duration": 1.5})


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> Exported:
    """The export of a law; each is written once."""

    @functools.cache
    def write(law: str, precision: Precision = "double", target: str = "posix") -> Path:
        return export(scenario_of(law), tmp_path_factory.mktemp("export") / "c", precision=precision, target=target)

    return write


def check(directory: Path, run: Run, *make: str) -> list[tuple[str, ...]]:
    """What a program answers to all recorded periods: number, status, changes, four commands, ticks."""
    done = run("make", "-C", directory, "check", *make, EVERY_PERIOD)
    lines = [tuple(line.split()) for line in (done.stdout + done.stderr).splitlines()]
    return [line for line in lines if len(line) == 8]


@PRECISIONS
@pytest.mark.parametrize("law", LAWS)
def test_every_recorded_period_agrees(law: str, precision: Precision, exported: Exported, run: Run) -> None:
    assert len(check(exported(law, precision), run)) == 75


def test_a_check_is_one_sentence_and_a_line_of_each_period_that_differs(
    exported: Exported, run: Run, tmp_path: Path
) -> None:
    directory = tmp_path / "c"
    shutil.copytree(exported("plain"), directory, ignore=shutil.ignore_patterns("*.o", "*.elf"))
    command = ("make", "--silent", "-C", directory, "check")
    assert run(*command).stdout == "every recorded period agrees\n"
    main = directory / "main.c"
    source = main.read_text()
    off = "const quadsim_real off = command[j] - recorded->command[j]"
    assert off in source
    main.write_text(source.replace(off, f"{off} + (quadsim_real)(k == 7)"))
    done = run(*command, check=False)
    line, sentence = done.stdout.splitlines()
    assert done.returncode != 0
    assert line.startswith("wrong: 00000007 ")
    assert len(line.split()) == 9
    assert sentence.startswith("wrong: a status or a command is not the recorded one; ")


@pytest.mark.parametrize("law", ["plain", "fed forward"])
def test_the_exported_law_flies_as_the_law(law: str, run: Run) -> None:
    """The same bits in doubles: it is the same file."""
    run("make", "--version")
    flown, c = (
        quadsim.fly(scenario_of(law), progress=False),
        fly_exported(scenario_of(law), target="posix", progress=False),
    )
    assert set(c.log.control.status) == {"commanded"}
    np.testing.assert_array_equal(c.log.plant.state, flown.log.plant.state)


def test_a_cortex_m7_computes_the_bits_of_this_machine(exported: Exported, run: Run, tmp_path: Path) -> None:
    target = TARGETS["cortex-m7"]
    run(target.compiler, "--version")
    run("qemu-system-arm", "--version")
    here, there = (check(exported("fed forward", "float", name), run) for name in ("posix", "cortex-m7"))
    assert [line[:7] for line in here] == [line[:7] for line in there]
    assert here


@pytest.mark.parametrize("compiler", ["gcc", "clang", "arm-none-eabi-gcc"])
@PRECISIONS
def test_compilers_give_no_warning(
    precision: Precision, compiler: str, exported: Exported, run: Run, tmp_path: Path
) -> None:
    machine = TARGETS[EXPORTS[precision][0]].machine.split() if compiler.startswith("arm") else []
    directory = exported("fed forward", precision)
    for name in (*OWN, "main.c", "serial.c"):
        run(compiler, *machine, *defines_of(directory), *WARNINGS, "-c", directory / name, "-o", tmp_path / "object.o")


def test_analysers_find_nothing(exported: Exported, run: Run, tmp_path: Path) -> None:
    directory = exported("fed forward")
    sources = [directory / name for name in OWN]
    for source in sources:
        run("gcc", *WARNINGS, "-O1", "-fanalyzer", "-c", source, "-o", tmp_path / "object.o")
    run("cppcheck", *CPPCHECK, "-UQUADSIM_FLOAT", *sources)
    run("clang-tidy", "-quiet", f"-checks={TIDY}", "-warnings-as-errors=*", *sources, "--", "-std=c99")


@PRECISIONS
def test_it_needs_the_library_for_copies_only(
    precision: Precision, exported: Exported, run: Run, tmp_path: Path
) -> None:
    directory = exported("fed forward", precision)
    sources = [directory / name for name in SOURCES]
    assert undefined(sources, directory, precision, run, tmp_path / "needed.o") <= ALLOWED


def test_sanitizers_find_nothing_in_recorded_periods(exported: Exported, run: Run, tmp_path: Path) -> None:
    directory = tmp_path / "c"
    shutil.copytree(exported("fed forward"), directory)
    flags = "-O1 -g -std=c99 -fsanitize=address,undefined -fno-sanitize-recover=all"
    assert check(directory, run, f"CFLAGS={flags}", "MACHINE_LINK=-fsanitize=address,undefined", "CC=gcc")


@PRECISIONS
def test_arbitrary_bytes_lead_to_commands_within_bounds(
    precision: Precision, exported: Exported, run: Run, tmp_path: Path
) -> None:
    directory = exported("fed forward", precision)
    program = tmp_path / "fuzz"
    flags = ["-g", "-O1", "-std=c99", *SANITIZERS, *defines_of(directory), "-DMOST_CHANGES=0", "-I", directory]
    built = run("clang", *flags, "-o", program, HERE / "fuzz.c", *(directory / name for name in SOURCES), check=False)
    if "cannot find" in built.stderr:
        pytest.skip("clang has no sanitizers: make firmware")
    assert built.returncode == 0, built.stderr
    run(program, "-runs=20000", f"-timeout={HANGS}", "-max_len=600", "-len_control=0", "-seed=1", cwd=tmp_path)


def test_without_an_answer_the_contract_flies(run: Run) -> None:
    """A reference that is none, then no measurement: the plan that was kept, hover, the descent, all within bounds."""
    run("cc", "--version")
    scenario = scenario_of("plain")
    host = Host(scenario)
    source = c_controller(scenario)
    weight = Assembly(scenario).vehicle.mass * 9.81
    state = make_state(position=(0.3, 0.0, 2.0))
    command = np.array([weight, 0.0, 0.0, 0.0])
    place = np.tile([0.0, 0.0, 2.0, 0.0], (source.horizon, 1))
    levels = []
    host.reset(command)
    for k in range(1400):
        reference = place if k < 20 else np.full_like(place, np.nan)
        reply = host.step(state if k < 200 else np.full(12, np.nan), reference, command)
        command = reply.command
        levels.append((STATUSES[reply.status], reply.fallback))
        assert source.bounds is not None
        assert (command >= source.bounds.u_min).all()
        assert (command <= source.bounds.u_max).all()
    ways = list(dict.fromkeys(levels))
    assert ways[:3] == [("commanded", 0), ("invalid_reference", 1), ("invalid_reference", 2)]
    assert ways[-1] == ("state_unknown", 3)


def test_other_commands_and_room_for_rows_are_refused() -> None:
    scenario = quadsim.load("autopilot").replace({"controller": {"type": "geometric", "commands": "attitude"}})
    with pytest.raises(ExportError, match=r'"attitude".*"rates"'):
        c_controller(scenario)
    with pytest.raises(ParameterError, match="--rows"):
        c_controller(scenario_of("plain"), rows=10)
