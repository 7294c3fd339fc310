"""`controller.compiled`: the exported C flies in place of Python's step."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import numpy as np
import pytest

import quadsim
from quadsim.errors import CompilerError, ExportError, OutputError
from scenarios.parts import compiler

pytestmark = pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler")

COMPILED = {"controller.compiled": True}
FLIGHTS = (
    *("paper-constrained", "paper-unconstrained", "robust", "robust-lag50", "crazyflie-steps", "figure-eight"),
    *("take-off-and-landing", "motion-capture"),
)


@pytest.mark.parametrize("name", FLIGHTS)
def test_a_compiled_flight_is_the_flight(name: str) -> None:
    scenario = quadsim.load(name)
    by_python = quadsim.fly(scenario, progress=False)
    by_c = quadsim.fly(scenario.replace(COMPILED), progress=False)
    assert by_c.summary["controller"]["solver"] == "compiled"
    assert by_c.satisfied == by_python.satisfied
    assert by_c.summary["controller"]["statuses"] == by_python.summary["controller"]["statuses"]
    assert by_c.summary["controller"]["fallbacks"] == by_python.summary["controller"]["fallbacks"]
    # what the exact optima differ by, and what a flight of a minute makes of that
    assert np.abs(by_c.log.control.speeds - by_python.log.control.speeds).max() <= 1e-5
    assert by_c.log.control.active.sum() == pytest.approx(by_python.log.control.active.sum(), rel=0.05)


def test_what_there_is_no_optimum_for_is_answered_as_on_the_target() -> None:
    flight = quadsim.fly(quadsim.load("paper-constrained-lag20", COMPILED), progress=False)
    assert {"clipped", "shifted"} & set(flight.summary["controller"]["statuses"])
    assert max(flight.log.control.fallback) >= 1


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(compiler, "_READY", {})
    return tmp_path / "quadsim" / "compiled"


def test_a_library_is_compiled_once_and_stored_for_the_user_only(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scenario = quadsim.load("hover", {**COMPILED, "duration": 0.5})
    quadsim.fly(scenario, progress=False)
    (library,) = cache.iterdir()
    assert cache.stat().st_mode & 0o777 == 0o700
    before = library.stat()
    monkeypatch.setattr(compiler, "_READY", {})
    monkeypatch.setattr(compiler, "_compile", lambda *_: pytest.fail("compiled again"))
    quadsim.fly(scenario, progress=False)
    assert library.stat() == before


def test_another_problem_is_another_library(cache: Path) -> None:
    for horizon in (10, 20):
        quadsim.fly(quadsim.load("hover", {**COMPILED, "duration": 0.2, "controller.horizon": horizon}), progress=False)
    assert len(list(cache.iterdir())) == 2


def test_a_cache_that_others_can_write_is_refused(cache: Path) -> None:
    cache.mkdir(parents=True)
    os.chmod(cache, 0o777)  # noqa: PTH101
    with pytest.raises(OutputError, match="writable by you alone"):
        quadsim.fly(quadsim.load("hover", {**COMPILED, "duration": 0.2}), progress=False)


def test_without_a_place_for_the_cache_the_variable_is_named(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scenario = quadsim.load("hover", {**COMPILED, "duration": 0.2})
    cache.parent.parent.joinpath("file").write_text("")
    monkeypatch.setenv("XDG_CACHE_HOME", str(cache.parent.parent / "file"))
    with pytest.raises(OutputError, match=r"file/quadsim/compiled: Not a directory; XDG_CACHE_HOME may name another"):
        quadsim.fly(scenario, progress=False)
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setattr("os.path.expanduser", lambda path: path)
    with pytest.raises(
        OutputError, match=r"~/\.cache/quadsim/compiled: .*home.*; XDG_CACHE_HOME may name another place"
    ):
        quadsim.fly(scenario, progress=False)


def test_a_missing_compiler_is_named(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CC", "no-such-compiler")
    with pytest.raises(CompilerError, match=r"no C compiler found .*no-such-compiler.*install one"):
        quadsim.fly(quadsim.load("hover", {**COMPILED, "duration": 0.2}), progress=False)


def test_what_cannot_be_exported_cannot_be_compiled() -> None:
    with pytest.raises(ExportError, match="half-spaces around obstacles"):
        quadsim.fly(quadsim.load("pillar", COMPILED), progress=False)
