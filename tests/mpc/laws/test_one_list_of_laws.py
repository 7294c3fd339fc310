"""One list of laws: a file in `quadsim/mpc/laws` is all that a new one takes, as CONTRIBUTING.md shows."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from quadsim.controller import ROTORS
from quadsim.core.library import load_library
from quadsim.mpc import laws as package
from quadsim.mpc.laws import law_name, laws, register
from quadsim.mpc.laws.parts.feedback import Baseline
from quadsim.mpc.laws.pid import PID
from quadsim.scenarios.loading import load_scenario
from quadsim.scenarios.plugin import Plugin
from quadsim.scenarios.schema.controllers import LAWS
from quadsim.scenarios.schema.scenario import Scenario
from quadsim.vehicle import Vehicle

ROOT = Path(__file__).resolve().parents[3]
EXAMPLE = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8").partition("## Example: a controller\n")[2]
LAW, LAW_TEST = re.findall(r"^```python\n(.*?)^```", EXAMPLE, re.DOTALL | re.MULTILINE)
(TRANSCRIPT,) = re.findall(r"^```console\n\$ (.*?)^```", EXAMPLE, re.DOTALL | re.MULTILINE)
SHOWN = [entry.splitlines() for entry in TRANSCRIPT.split("\n$ ")]
"""A command and the lines of its output that the example shows, each."""
COMMANDS = """
import contextlib, io, json, sys
from pathlib import Path
import quadsim
from quadsim.commands.cli import main
answers = {}
for name, command in json.loads(sys.argv[1]).items():
    out = io.StringIO()
    err = io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        status = main(command)
    answers[name] = [status, out.getvalue(), err.getvalue()]
answers["from"] = str(Path(quadsim.__file__).parents[1])
print(json.dumps(answers))
"""
BARE = ("--no-video", "--no-recording", "--no-figures")
FLY = ["run", "hover", *BARE, "--set", "duration=0.5"]


@pytest.fixture(scope="module")
def copy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of the tree with the example's two files."""
    load_library()  # so that it is current, and not compiled again in the copy
    folder = tmp_path_factory.mktemp("copy")
    for name in ("quadsim", "models", "scenarios"):
        shutil.copytree(ROOT / name, folder / name, ignore=shutil.ignore_patterns("__pycache__"))
    (folder / "quadsim" / "mpc" / "laws" / "pd.py").write_text(LAW, encoding="utf-8")
    (folder / "test_pd.py").write_text(LAW_TEST, encoding="utf-8")
    return folder


def run_python(folder: Path, *arguments: str) -> str:
    """Return what Python prints in a copy of the tree."""
    command = [sys.executable, *arguments]
    environment = os.environ | {"PYTHONPATH": str(folder)}
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def answers(copy: Path) -> dict[str, Any]:
    """Exit status, output and messages of commands, by name or as the example has them."""
    commands = {
        "list": ["list", "--json"],
        "schema": ["scenario", "--schema"],
        "run": [*FLY, "--set", "controller=pd", "--out", "flown"],
        "check": ["check", "flown", "--json"],
        "field": [*FLY, "--set", "controller=pd", "--set", "controller.bandwith=1", "--out", "field"],
        "name": [*FLY, "--set", "controller=pdd", "--out", "name"],
    }
    for line, *_ in SHOWN:
        _, *words = line.split()
        commands[line] = [*words, *BARE] if words[0] == "run" else words
    result: dict[str, Any] = json.loads(run_python(copy, "-c", COMMANDS, json.dumps(commands)))
    assert Path(result["from"]).resolve() == copy.resolve()
    return result


@pytest.mark.parametrize("command", [line for line, *_ in SHOWN])
def test_commands_of_the_example_print_what_it_shows(command: str, answers: dict[str, Any]) -> None:
    _, out, err = answers[command]
    printed = [line.split() for line in (out + err).splitlines()]
    ((_, *lines),) = [entry for entry in SHOWN if entry[0] == command]
    assert lines
    for line in lines:
        assert line.split() in printed


def test_the_test_of_the_example_passes(copy: Path) -> None:
    alone = ("-p", "no:cacheprovider", "-c", os.devnull, "--confcutdir=.")  # looks at no folder above the copy
    printed = run_python(copy, "-m", "pytest", "-q", *alone, "test_pd.py")
    assert "2 passed" in printed
    assert "ends with `2 passed`" in EXAMPLE


def test_a_law_in_one_new_file_is_in_the_list_after_those_that_ship(answers: dict[str, Any]) -> None:
    status, out, _ = answers["list"]
    listed = json.loads(out)["controllers"]
    assert (status, [*listed]) == (0, [*LAWS, "pd"])


def test_it_is_in_the_json_schema_with_its_field(answers: dict[str, Any]) -> None:
    status, out, _ = answers["schema"]
    definitions = json.loads(out)["$defs"]
    field = definitions["PDTable"]["properties"]["bandwidth"]
    assert (status, field["minimum"], field["maximum"]) == (0, 0.1, 10.0)
    assert "pd" in definitions["Plugin"]["properties"]["type"]["not"]["enum"]


def test_it_flies_under_its_display_name_and_passes_its_audit(copy: Path, answers: dict[str, Any]) -> None:
    status, out, err = answers["run"]
    assert status == 0, err
    assert "PD: 10 periods commanded" in out
    summary = json.loads((copy / "flown" / "summary.json").read_text(encoding="utf-8"))
    assert summary["controller"]["name"] == "pd"
    status, out, err = answers["check"]
    assert status == 0, out + err


def test_a_wrong_field_or_name_is_refused_with_the_right_one(copy: Path, answers: dict[str, Any]) -> None:
    assert [answers[name][0] for name in ("field", "name")] == [2, 2]
    assert "did you mean 'bandwidth'?" in answers["field"][2]
    assert "did you mean 'pd'?" in answers["name"][2]
    assert not (copy / "field").exists()
    assert not (copy / "name").exists()


def test_every_file_of_the_folder_registers_one_law() -> None:
    files = {path.stem for path in Path(package.__file__).parent.glob("*.py")} - {"__init__"}
    assert {*laws()} == {*LAWS} == files
    assert all(name == table.type for name, table in laws().items())


def test_two_laws_cannot_have_one_name() -> None:
    class Other(Baseline):
        type = "pid"

    with pytest.raises(ValueError, match=r"^two laws have the name 'pid': quadsim\.mpc\.laws\.pid and "):
        register(title="another", description="another PID")(Other)
    assert laws()["pid"] is PID
    assert (PID.title, PID.description, PID.place) == ("PID", "cascaded PID, as autopilots fly it", 6)


def test_a_table_without_a_law_is_refused(vehicle: Vehicle) -> None:
    with pytest.raises(NotImplementedError, match=r"^the table Baseline has no method `law`$"):
        Baseline().law(vehicle, 0.05)


def test_names_that_flights_recorded() -> None:
    assert (law_name("pid"), law_name("my_law")) == ("PID", "my_law")


def flight_with(name: str) -> Scenario:
    """A scenario that flies the law of a name."""
    library = {"unconstrained": "paper-unconstrained", "constrained": "paper-constrained", "robust": "robust"}
    return load_scenario(library.get(name, "hover"), [] if name in library else [f"controller={name}"])


@pytest.mark.parametrize("name", LAWS)
def test_a_table_builds_its_law_and_the_guard_around_it(name: str, vehicle: Vehicle) -> None:
    table = flight_with(name).controller
    law = table.law(vehicle, 0.05)
    assert (law.name, law.horizon) == (name, table.horizon)
    guard = table.guard(vehicle, 0.05)
    assert (guard is not None) == (name in ("robust", "nonlinear"))
    if guard is not None:
        without = replace(table, fallback=replace(table.fallback, enabled=False))
        assert without.guard(vehicle, 0.05) is None


def test_the_guard_of_targets_has_their_model_and_bounds(vehicle: Vehicle) -> None:
    lags = {"controller.commands": "rates", "controller.inner_lag": [0.05, 0.04, 0.04, 0.1]}
    table = flight_with("nonlinear").replace(lags).controller
    guard = table.guard(vehicle, 0.05)
    assert guard is not None
    assert guard.model.targets
    assert table.actuators(vehicle).targets
    weight = vehicle.mass * vehicle.gravity
    np.testing.assert_allclose(guard.model.u_bar, [weight, 0.0, 0.0, 0.0])


@pytest.mark.parametrize("name", LAWS)
def test_speeds_are_held_unless_an_inner_loop_or_an_autopilot_changes_them(name: str) -> None:
    scenario = flight_with(name)
    assert scenario.controller.holds_speeds
    if name in ("nonlinear", "geometric"):
        assert scenario.controller.commands == ROTORS
        assert not scenario.replace({"controller.commands": "rates"}).controller.holds_speeds
        assert not scenario.replace({"controller.indi": {}}).controller.holds_speeds


def test_of_a_users_law_it_is_not_known() -> None:
    assert not Plugin(type="my_module:Law").holds_speeds
