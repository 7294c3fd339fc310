"""One list of laws: a file in `quadsim/mpc/laws` is all that a new one takes."""

from __future__ import annotations

import json
import os
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
ADDED = '''
"""A law of one speed: the share of hover's that its table states."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Final, Literal

import numpy as np
from annotated_types import Gt, Le, doc

from quadsim.controller import Command, StepInputs
from quadsim.mpc.laws.parts.feedback import Baseline, FeedbackLaw
from quadsim.mpc.laws import register
from quadsim.mpc.space import Shape
from quadsim.state import Array
from quadsim.vehicle import Vehicle


class OneSpeed(FeedbackLaw):
    """Four rotors at one speed."""

    name: Final = "one-speed"

    def __init__(self, vehicle: Vehicle, period: float, settings: OneSpeedTable) -> None:
        self._speed = settings.share * vehicle.hover_speeds
        super().__init__(vehicle, period, settings)

    def _command(self, now: StepInputs, state: Array, reference: Array, before: Array) -> Command:
        return self._held_for_a_period(np.array(self._speed))


@register(title="a single speed", description="hover's rotor speed, times a share")
@dataclass(frozen=True, kw_only=True)
class OneSpeedTable(Baseline):
    """One speed."""

    type: Annotated[Literal["one-speed"], doc("the controller, by its name in `quadsim list`")] = "one-speed"
    share: Annotated[float, Gt(0.0), Le(2.0), doc("[-] of the hover speed")] = 1.0

    def law(self, vehicle: Vehicle, period: float, shapes: Sequence[Shape] = ()) -> OneSpeed:
        """See `quadsim.mpc.tables.controller.ControllerTable.law`."""
        return OneSpeed(vehicle, period, self)
'''
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
def answers(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """Exit status, output and messages of commands in a copy of the tree with a law more, in one new file."""
    load_library()  # so that it is current, and not compiled again in the copy
    copy = tmp_path_factory.mktemp("copy")
    for folder in ("quadsim", "models", "scenarios"):
        shutil.copytree(ROOT / folder, copy / folder, ignore=shutil.ignore_patterns("__pycache__"))
    (copy / "quadsim" / "mpc" / "laws" / "one_speed.py").write_text(ADDED.lstrip(), encoding="utf-8")
    commands = {
        "list": ["list", "--json"],
        "schema": ["scenario", "--schema"],
        "run": [*FLY, "--set", "controller=one-speed", "--out", "flown"],
        "check": ["check", "flown", "--json"],
        "resolved": ["scenario", "hover", "--set", "controller=one-speed"],
        "value": [*FLY, "--set", "controller=one-speed", "--set", "controller.share=3", "--out", "value"],
        "field": [*FLY, "--set", "controller=one-speed", "--set", "controller.shore=1", "--out", "field"],
        "name": [*FLY, "--set", "controller=one-sped", "--out", "name"],
    }
    done = subprocess.run(
        [sys.executable, "-c", COMMANDS, json.dumps(commands)],
        cwd=copy,
        env=os.environ | {"PYTHONPATH": str(copy)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    result: dict[str, Any] = json.loads(done.stdout)
    result["left"] = sorted(path.name for path in copy.iterdir())
    result["summary"] = json.loads((copy / "flown" / "summary.json").read_text(encoding="utf-8"))
    assert Path(result["from"]).resolve() == copy.resolve()
    return result


def test_a_law_in_one_new_file_is_in_the_list_after_those_that_ship(answers: dict[str, Any]) -> None:
    status, out, _ = answers["list"]
    listed = json.loads(out)["controllers"]
    assert (status, [*listed]) == (0, [*LAWS, "one-speed"])
    assert listed["one-speed"] == "hover's rotor speed, times a share"


def test_it_is_in_the_json_schema_with_its_field(answers: dict[str, Any]) -> None:
    status, out, _ = answers["schema"]
    definitions = json.loads(out)["$defs"]
    field = definitions["OneSpeedTable"]["properties"]["share"]
    assert (status, field["exclusiveMinimum"], field["maximum"]) == (0, 0.0, 2.0)
    assert "one-speed" in definitions["Plugin"]["properties"]["type"]["not"]["enum"]


def test_it_flies_and_is_called_by_its_display_name(answers: dict[str, Any]) -> None:
    status, out, err = answers["run"]
    assert status == 0, err
    assert answers["summary"]["controller"]["name"] == "one-speed"
    assert "a single speed" in out


def test_its_run_passes_its_audit(answers: dict[str, Any]) -> None:
    status, out, err = answers["check"]
    assert status == 0, out + err


def test_its_fields_are_written_with_their_meaning(answers: dict[str, Any]) -> None:
    status, out, _ = answers["resolved"]
    assert status == 0
    assert "share = 1.0" in out
    assert "[-] of the hover speed" in out


def test_a_wrong_value_field_or_name_is_refused(answers: dict[str, Any]) -> None:
    assert [answers[name][0] for name in ("value", "field", "name")] == [2, 2, 2]
    assert "controller.share must be a number > 0 and <= 2; got 3" in answers["value"][2]
    assert "controller.shore" in answers["field"][2]
    assert "did you mean 'share'?" in answers["field"][2]
    assert "did you mean 'one-speed'?" in answers["name"][2]
    assert answers["left"] == ["flown", "models", "quadsim", "scenarios"]


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
