"""Processor in the loop: flights whose controller answers from an emulated Cortex-M, over its UART."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

import quadsim
from quadsim.commands.cli import main
from quadsim.errors import FlightError, MissingProgramError
from quadsim.features.export.in_the_loop import Frames, Program, SerialMPC, fly_exported, require_programs
from quadsim.mpc.export.targets import TARGETS
from quadsim.rollout.rollout import Rollout
from quadsim.scenarios.loading import load_scenario
from quadsim.sim.autopilot import Autopilot, AutopilotSettings

CASES = {
    "double": ("cortex-m7", "double", "paper-constrained", 1e-6),
    "float": ("cortex-m4f", "float", "paper-constrained", 0.1),
    "robust": ("posix", "double", "robust", 1e-6),
    "unconstrained": ("posix", "double", "paper-unconstrained", 1e-4),
    "nonlinear": ("posix", "double", "nonlinear", 1e-9),
    "rates": ("cortex-m7", "float", "autopilot", 0.05),
}
"""Target, precision, scenario, and how far commands of the two flights may be apart [rad/s]."""


@pytest.mark.parametrize("name", CASES)
def test_a_flight_by_the_target_is_the_flight_by_python(name: str) -> None:
    """The closed loop, so that a difference in one period comes back in all later ones."""
    target, precision, scenario, apart = CASES[name]
    compiler = TARGETS[target].compiler
    if shutil.which(compiler) is None:
        pytest.skip(f"{compiler} is not installed: make firmware")
    short = load_scenario(scenario, ["duration=6.0"])
    linear = scenario in ("paper-constrained", "robust")
    exact = short.replace({"controller.solver": "core"}) if linear else short
    result = fly_exported(short, target=target, precision=precision, progress=False)
    desired = Rollout(exact).fly()
    assert result.log.control.status == desired.log.control.status
    assert np.abs(result.command - desired.command).max() <= apart
    assert [finding.satisfied for finding in result.findings] == [finding.satisfied for finding in desired.findings]


def test_an_autopilot_passed_in_flies_the_targets_and_gives_the_law_its_lags() -> None:
    if shutil.which("cc") is None:
        pytest.skip("cc is not installed: make firmware")
    short = load_scenario("autopilot", ["duration=2.0", "effects.rotors={}", "sensors={}"])
    slow = Autopilot(quadsim.load_vehicle("hummingbird"), AutopilotSettings(p=(10.0, 10.0, 5.0)))
    result, desired, built_in = (
        fly_exported(short, target="posix", autopilot=slow, progress=False),
        quadsim.fly(short, autopilot=slow, progress=False),
        quadsim.fly(short, progress=False),
    )
    assert np.abs(result.command - desired.command).max() <= 1e-9
    flown, own, usual = (each.summary["controller"]["autopilot"] for each in (result, desired, built_in))
    assert flown == own
    assert flown["name"] == "Autopilot"
    assert min(flown["inner_lag"][1:3]) > 1.5 * max(usual["inner_lag"][1:3])


FAILURES = {
    "pushed beyond a hard bound": {
        "controller.soft.linear": 1e8,
        "controller.polytopes": [{"name": "ceiling", "of": ["vz"], "rows": [[1.0]], "upper": [0.4]}],
        "events": [{"type": "push", "at": 3.0, "duration": 0.5, "force": [0, 0, 25]}],
    },
    "a lost sensor": {
        "events": [{"type": "sensor_fault", "at": 2.0, "duration": 3.0, "sensor": "position", "fault": "nan"}],
    },
}


@pytest.mark.parametrize("failure", FAILURES)
def test_without_an_answer_the_target_flies_pythons_fallback(failure: str) -> None:
    if shutil.which("cc") is None:
        pytest.skip("cc is not installed: make firmware")
    scenario = load_scenario("robust").replace({"duration": 6.0} | FAILURES[failure])
    desired = Rollout(scenario).fly()
    result = fly_exported(scenario, target="posix", progress=False)
    assert max(desired.log.control.fallback) >= 1
    assert [*result.log.control.fallback] == [*desired.log.control.fallback]
    assert result.log.control.status == desired.log.control.status
    assert np.abs(result.command - desired.command).max() <= 1e-6


def test_on_the_ground_the_target_estimates_no_disturbance() -> None:
    """From cold rotors: an observer that took the ground for a force would command otherwise for seconds."""
    if shutil.which("cc") is None:
        pytest.skip("cc is not installed: make firmware")
    ground = ["duration=5.0", "initial.position=[0.0, 0.0, 0.0]", "initial.cold=true", "effects.ground.contact=true"]
    scenario = load_scenario("robust", ["actual.mass=4.4", *ground])
    desired = Rollout(scenario).fly()
    result = fly_exported(scenario, target="posix", progress=False)
    assert {"armed", "flying"} <= set(desired.log.control.phase)
    assert np.abs(result.command - desired.command).max() <= 1e-6


def test_the_command_flies_and_writes_a_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    arguments = ["export", "hover", "--set", "duration=1.0", "--out", "c", "--target", "cortex-m7", "--fly"]
    assert main(arguments) == 0
    assert (tmp_path / "c" / "startup.c").is_file()
    assert (tmp_path / "runs" / "hover-cortex-m7" / "summary.json").is_file()
    assert "C99 on Cortex-M7" in capsys.readouterr().out


def test_a_program_that_ends_ends_the_flight(tmp_path: Path) -> None:
    with Program(TARGETS["posix"], Path("/bin/true")) as line:
        law = SerialMPC(line, Frames("double"))
        with pytest.raises(FlightError, match=r"0\.500 s"):
            law.step(0.5, np.zeros(12), np.zeros((2, 4)), np.zeros(4))


def test_missing_tools_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", "")
    with pytest.raises(MissingProgramError, match=r"needs 'make': apt-get install .* qemu-system-arm"):
        require_programs(TARGETS["cortex-m7"], "to fly an exported controller")
