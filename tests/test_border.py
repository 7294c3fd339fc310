"""The border to user code: what it raises, answers, keeps, prints, or becomes by an edit."""

from __future__ import annotations

import asyncio
import json
import logging
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import quadsim
from quadsim.border import printing_to_stderr
from quadsim.errors import InputError, QuadsimError
from quadsim.vehicle import Vehicle

HOVER = 192.8  # [rad/s], near the hover speed of the vehicle below
SCENARIO = 'base = "hover"\nname = "own"\nduration = 0.2\nconstraints = []\ncontroller = "{module}:law"\n'
LAW = "import numpy as np\ndef law(now, state, reference):\n    {late}\n    return np.full(4, {speed})\n"


class OwnError(Exception):
    """One whose text cannot be made."""

    def __str__(self) -> str:
        raise RuntimeError("no text")


RAISED: dict[type[BaseException], object] = {
    asyncio.CancelledError: "task",
    GeneratorExit: "closed",
    BaseException: "bare",
    SystemExit: 3,
    StopIteration: 1,
    OwnError: None,
}


@pytest.fixture(params=RAISED, ids=lambda kind: kind.__name__)
def raised(request: pytest.FixtureRequest) -> BaseException:
    """One of this test alone: each time that an exception is raised its traceback grows."""
    return request.param(RAISED[request.param])


def raising(error: BaseException, start: float = 0.0, size: int = 4) -> Callable[..., Any]:
    def law(now: Any, *_: object) -> list[float]:
        if getattr(now, "time", now) > start:
            raise error
        return [HOVER if size == 4 else 0.0] * size

    return law


@pytest.fixture(scope="module")
def scenario() -> quadsim.Scenario:
    return quadsim.load("hover", {"duration": 0.3, "constraints": []})


def test_whatever_a_controller_raises_ends_its_flight_as_aborted(
    scenario: quadsim.Scenario, raised: BaseException
) -> None:
    flown = quadsim.fly(scenario, controller=raising(raised, 0.12), progress=False)
    assert (flown.outcome, flown.time.size) == ("aborted", 3)
    assert type(raised).__name__ in str(flown.log.reason)
    assert f'"{__file__}"' in flown.log.traceback[1]
    assert not any("quadsim/sim/loop.py" in line for line in flown.log.traceback)


def test_whatever_a_force_or_a_reference_raises_is_told_as_theirs(
    scenario: quadsim.Scenario, raised: BaseException
) -> None:
    flown = quadsim.fly(scenario, forces=[raising(raised, 0.101, 6)], progress=False)
    assert (flown.outcome, flown.time.size) == ("aborted", 2)
    assert f"the force law raised {'' if type(raised).__module__ == 'builtins' else type(raised).__module__}" in str(
        flown.log.reason
    )
    with pytest.raises(InputError, match=rf"reference: f\(0\.05\) cannot be used: {type(raised).__name__}"):
        quadsim.fly(scenario, reference=raising(raised), progress=False)


@pytest.mark.parametrize("part", ["__init__", "reset", "name", "step"])
def test_whatever_is_raised_before_the_flight_is_one_message(
    scenario: quadsim.Scenario, raised: BaseException, part: str
) -> None:
    def fail(*_: object, **__: object) -> None:
        raise raised

    parts = {"__init__": lambda self, *_, **__: None, "step": lambda *_: [HOVER] * 4}
    value = property(fail) if part in ("name", "step") else fail
    with pytest.raises(InputError, match=rf"^controller: .*: {type(raised).__name__}"):
        quadsim.fly(scenario, controller=type("Law", (), {**parts, part: value}), progress=False)


def test_an_autopilot_that_raises_ends_the_flight_or_is_refused(raised: BaseException) -> None:
    class Pilot:
        rate = 500.0
        takes_targets = True
        calls = 0

        def reset(self) -> None: ...

        def speeds(self, *_: object) -> object:
            self.calls += 1
            if self.calls > 10:
                raise raised
            return np.full(4, HOVER)

    rates = quadsim.load("autopilot", {"duration": 0.3})
    try:
        flown = quadsim.fly(rates, autopilot=Pilot(), progress=False)
    except InputError as error:
        assert f"autopilot: Pilot cannot be used: {type(raised).__name__}" in str(error)  # noqa: PT017
    else:
        assert (flown.outcome, type(raised).__name__ in str(flown.log.reason)) == ("aborted", True)


def test_complex_numbers_are_refused_and_numpy_warns_of_nothing(scenario: quadsim.Scenario) -> None:
    """With warnings as errors, as here, numpy's own would be in the reason."""
    turned = np.full(4, HOVER) + 3j
    flown = quadsim.fly(scenario, controller=lambda now, state, reference: turned, progress=False)
    assert flown.outcome == "lost"
    assert str(flown.log.reason).endswith("complex numbers, of which a command has none")
    flown = quadsim.fly(scenario, forces=[lambda time, state: np.zeros(6, complex)], progress=False)
    assert "complex numbers" in str(flown.log.reason)
    with pytest.raises(InputError, match="complex"):
        quadsim.fly(scenario, reference=lambda t: np.zeros(4, complex), progress=False)


def test_what_user_code_keeps_and_changes_later_changes_nothing_that_was_flown(scenario: quadsim.Scenario) -> None:
    kept = np.zeros(4)

    def law(now: quadsim.StepInputs, state: Any, reference: Any) -> Any:
        kept[:] = HOVER + now.time
        for given in (state, reference, now.acting, now.attitude, now.body_rates):
            if given is not None:
                given[:] = 7.0
        return kept[:]

    flown = quadsim.fly(scenario, controller=law, progress=False)
    np.testing.assert_array_equal(flown.command[:, 0], HOVER + flown.time)
    with quadsim.start(scenario) as started:
        for _ in range(3):
            kept[:] = HOVER + started.k
            started.step(kept)
        np.testing.assert_array_equal(started.flight().command[:, 0], HOVER + np.arange(3))


def test_the_motion_that_a_controller_sees_is_not_its_own_to_change() -> None:
    def law(now: quadsim.StepInputs, state: object, reference: object) -> object:
        assert now.motion is not None
        now.motion.position[:] = 0.0
        return [HOVER] * 4

    flown = quadsim.fly(quadsim.load("power-loop", {"duration": 0.2}), controller=law, progress=False)
    assert "read-only" in str(flown.log.reason)


PRINTING = """
import atexit, ctypes, os, subprocess, sys
atexit.register(print, "at exit")
def law(now, state, reference):
    print("by Python")
    sys.__stdout__.write("by the stream")
    os.write(1, b"by the system")
    ctypes.CDLL(None).puts(b"by C")
    subprocess.run(["echo", "by a child"])
    return [192.8] * 4
"""


@pytest.mark.slow("process")
def test_stdout_has_the_result_alone_as_json_whatever_user_code_prints(tmp_path: Path) -> None:
    (tmp_path / "printing.py").write_text(PRINTING)
    (tmp_path / "s.toml").write_text(SCENARIO.format(module="printing"))
    command = [sys.executable, "-m", "quadsim.commands.entry", "check", "s.toml", "--json"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert json.loads(done.stdout)["scenario"] == "own", done.stderr
    for printed in ("by Python", "by the stream", "by the system", "by C", "by a child", "at exit"):
        assert printed in done.stderr


def test_where_streams_are_no_files_python_s_own_prints_go_to_stderr(capsys: pytest.CaptureFixture[str]) -> None:
    with printing_to_stderr():
        print("inside")
    print("outside")
    assert capsys.readouterr() == ("outside\n", "inside\n")


def first_speed(path: Path) -> float:
    return float(quadsim.fly(str(path), progress=False).command[0, 0])


def test_an_edited_module_is_flown_as_it_is_now_with_what_it_imports(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Twice within a second, at the same size: the clock of the file system would not tell."""
    (tmp_path / "edited_law.py").write_text("from edited_part import SPEED\ndef law(*_):\n    return [SPEED] * 4\n")
    (tmp_path / "s.toml").write_text(SCENARIO.format(module="edited_law"))
    for speed in (191.0, 192.0, 193.0):
        (tmp_path / "edited_part.py").write_text(f"SPEED = {speed}\n")
        assert first_speed(tmp_path / "s.toml") == speed
    said = [record.getMessage() for record in caplog.records if record.levelno == logging.WARNING]
    assert said == 2 * [f"{tmp_path / 'edited_part.py'} changed: edited_law is imported again"]


def test_modules_of_one_name_in_two_folders_are_each_their_own(tmp_path: Path) -> None:
    for folder, speed in (("a", 191.0), ("b", 192.0)):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "twin_law.py").write_text(LAW.format(late="pass", speed=speed))
        (tmp_path / folder / "s.toml").write_text(SCENARIO.format(module="twin_law"))
    assert [first_speed(tmp_path / folder / "s.toml") for folder in "abaab"] == [191.0, 192.0, 191.0, 191.0, 192.0]


def test_a_module_whose_file_is_the_same_keeps_its_state(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    counting = "count = []\ndef law(*_):\n    count.append(1)\n    return [190.0 + len(count)] * 4\n"
    (tmp_path / "counting_law.py").write_text(counting)
    (tmp_path / "s.toml").write_text(SCENARIO.format(module="counting_law"))
    assert (first_speed(tmp_path / "s.toml"), first_speed(tmp_path / "s.toml")) == (191.0, 195.0)
    assert not [record for record in caplog.records if record.levelno == logging.WARNING]


def test_an_error_of_ours_passes_only_where_it_is_named(vehicle: Vehicle) -> None:
    from quadsim.border import user_code

    ours = InputError("ours")
    for passing, expected in (((InputError,), "ours"), ((), "theirs: ours")):
        with (
            pytest.raises(QuadsimError, match=f"^{expected}$"),
            user_code(lambda error: InputError(f"theirs: {error}"), passing=passing),
        ):
            raise ours
