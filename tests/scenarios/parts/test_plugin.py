"""User-defined controllers: where they are looked for, how they are called, and the messages where they fail."""

from __future__ import annotations

import itertools
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support import NO_PRODUCTS

from quadsim.controller import Command, Statistics, StepInputs
from quadsim.errors import CommandError, InputError
from quadsim.rollout.rollout import Rollout
from quadsim.scenarios.assembly import Assembly
from quadsim.scenarios.loading import load_scenario
from quadsim.scenarios.plugin import PluginController
from quadsim.state import Array

HOVER = """
import numpy as np

class Hover:
    def __init__(self, vehicle, *, period, horizon, offset=0.0):
        self.speeds, self.received = np.full(4, vehicle.hover_speed + offset), (period, horizon)
    def step(self, now, state, reference):
        return self.speeds
"""
SCENARIO = 'base = "hover"\nname = "own"\nduration = 0.2\nconstraints = []\n'

Write = Callable[..., str]


@pytest.fixture
def written(tmp_path: Path) -> Iterator[Write]:
    """Writes a module under a name that nothing else has, and a scenario beside it; gives the scenario's path."""
    before = set(sys.modules)
    count = itertools.count()

    def write(code: str, controller: str = 'controller = "{module}:Hover"', *, module: str | None = None) -> str:
        name = module or f"custom_{abs(hash(str(tmp_path)))}_{next(count)}"
        folder = tmp_path / "beside"
        folder.mkdir(exist_ok=True)
        (folder / f"{name}.py").write_text(code)
        (folder / f"{name}.toml").write_text(SCENARIO + controller.replace("{module}", name))
        return str(folder / f"{name}.toml")

    yield write
    for name in set(sys.modules) - before:
        del sys.modules[name]


def build(path: str, *settings: str) -> PluginController:
    scenario = load_scenario(path, settings)
    law = Assembly(scenario).controller().law
    assert isinstance(law, PluginController)
    return law


def message(path: str) -> str:
    """The message for a controller that cannot be made; the module's name and folder left out."""
    with pytest.raises(InputError) as caught:
        build(path)
    file = Path(path)
    reported = str(caught.value).replace(str(file.parent), "FOLDER").replace(str(Path.cwd()), "HERE")
    return reported.replace(file.stem, "mine")


# --- found and called ----------------------------------------------------------------------------------------------


def test_it_is_found_beside_the_scenario_and_called_with_what_is_documented(written: Write) -> None:
    law = build(written(HOVER), "controller.horizon=7", "controller.settings.offset=2.0")
    command = law.step(StepInputs(), np.zeros(12), np.zeros((7, 4)))
    vehicle = Assembly(load_scenario("hover")).vehicle
    np.testing.assert_array_equal(command.speeds, np.full(4, vehicle.hover_speed + 2.0))
    np.testing.assert_array_equal(command.plan, np.tile(command.speeds, (7, 1)))
    assert law.law.received == (0.05, 7)
    assert (law.name, law.solver, law.horizon) == ("Hover", "", 7)


def test_a_resolved_file_flies_the_same_from_anywhere(written: Write, tmp_path: Path) -> None:
    first = Rollout(load_scenario(written(HOVER))).fly()
    (tmp_path / "resolved.toml").write_text(first.scenario.to_toml())
    again = Rollout(load_scenario(str(tmp_path / "resolved.toml"))).fly()
    np.testing.assert_array_equal(again.log.plant.state, first.log.plant.state)


def test_it_is_found_in_a_package_and_below_a_class(written: Write) -> None:
    path = written("")
    package = Path(path).parent / "custom_package"
    package.mkdir()
    (package / "__init__.py").write_text("")
    (package / "laws.py").write_text(HOVER.replace("class Hover:", "class Laws:\n  class Hover:"))
    Path(path).write_text(SCENARIO + 'controller = "custom_package.laws:Laws.Hover"')
    assert build(path).name == "Hover"


def entry(monkeypatch: pytest.MonkeyPatch, name: str, value: str) -> None:
    """Announce an entry point, as an installed package does."""
    points = metadata.EntryPoints([metadata.EntryPoint(name, value, "quadsim.controllers")])
    monkeypatch.setattr(metadata, "entry_points", lambda *, group: points.select(group=group))


def test_it_is_found_by_an_entry_point(written: Write, monkeypatch: pytest.MonkeyPatch) -> None:
    path = Path(written(HOVER, 'controller = "hold"'))
    entry(monkeypatch, "hold", f"{path.stem}:Hover")
    monkeypatch.syspath_prepend(path.parent)
    assert build(str(path)).name == "Hover"


# --- fitted to the protocol ----------------------------------------------------------------------------------------


def test_without_predict_a_run_has_no_horizon_and_with_it_has_one(written: Write, tmp_path: Path) -> None:
    outputs = {**NO_PRODUCTS, "recording": True}
    Rollout(load_scenario(written(HOVER))).fly().save(tmp_path / "without", **outputs)
    assert not (tmp_path / "without" / "horizon.parquet").exists()
    assert (tmp_path / "without" / "flight.rrd").is_file()
    predict = (
        "    def predict(self, states, plans):\n        return np.repeat(states[:, None], plans.shape[1], axis=1)\n"
    )
    Rollout(load_scenario(written(HOVER + predict))).fly().save(tmp_path / "with", **outputs)
    assert (tmp_path / "with" / "horizon.parquet").is_file()


FULL = """
from quadsim.controller import Command, Statistics
import numpy as np

class Hover:
    name, solver = "mine", "by-hand"
    def __init__(self, vehicle, period, horizon):
        self.horizon = horizon
    def reset(self, speeds):
        self.speeds = speeds
    def step(self, now, state, reference):
        state[:], reference[:] = np.nan, np.nan
        return Command(speeds=self.speeds, plan=np.tile(self.speeds, (self.horizon, 1)), stats=Statistics(iterations=3))
"""


def test_what_it_has_is_used_and_what_it_is_given_is_a_copy(written: Write) -> None:
    flight = Rollout(load_scenario(written(FULL))).fly()
    assert (flight.controller, flight.solver) == ("mine", "by-hand")
    assert set(flight.log.control.iterations.tolist()) == {3}
    assert np.isfinite(flight.log.control.state).all()
    assert flight.outcome == "unaudited"


@pytest.mark.parametrize("answer", ["None", "[1.0, 2.0, 3.0]", "'fast'", "[[1.0] * 4]", "object()"])
def test_an_answer_that_is_no_command_ends_the_flight_with_that_reason(written: Write, answer: str) -> None:
    flight = Rollout(load_scenario(written(HOVER.replace("return self.speeds", f"return {answer}")))).fly()
    assert flight.outcome == "lost"
    shown = answer.replace("[1.0] * 4", "[1.0, 1.0, 1.0, 1.0]").replace("object()", "<object object")
    assert str(flight.log.reason).startswith(f"at t = 0.000 s: Hover answered {shown}")
    assert ", neither a Command nor four rotor speeds [rad/s]: " in str(flight.log.reason)


def test_speeds_that_are_no_numbers_never_reach_the_plant(written: Write) -> None:
    flight = Rollout(load_scenario(written(HOVER.replace("self.speeds\n", "self.speeds * np.nan\n")))).fly()
    assert "not finite: [nan, nan, nan, nan]" in flight.log.reason


class Answers:
    """A law that overwrites its input and its answer, and returns a command changed in one part."""

    def __init__(self, **changes: Any) -> None:
        self._speeds = np.full(4, 190.0)
        self._plan = np.full((3, 4), 190.0)
        self._changes = changes

    def step(self, now: StepInputs, state: Array, reference: Array) -> Command:
        assert now.acting is not None
        for received in (now.acting, state, reference):
            received[:] = 7.0
        self._speeds += 1.0
        self._plan += 1.0
        return replace(Command(speeds=self._speeds, plan=self._plan), **self._changes)

    def predict(self, states: Array, plans: Array) -> Any:
        return self._changes.get("predicted", np.zeros((len(states), 3, 12)))


@pytest.mark.parametrize(
    ("part", "given", "rule"),
    [
        ("speeds", np.zeros(3), r"its speeds must have shape \(4,\); got \(3,\)"),
        ("speeds", None, "its speeds must have shape"),
        ("plan", np.zeros((2, 4)), r"its plan must have shape \(3, 4\); got \(2, 4\)"),
        ("status", None, "'NoneType' object has no attribute"),
        ("stats", Statistics(iterations=2.5), "'float' object cannot be interpreted as an integer"),  # type: ignore[arg-type]
        ("stats", (1, 2), r"its stats must be quadsim.Statistics; got \(1, 2\)"),
        ("inner", 500.0, "'float' object has no attribute 'rate'"),
    ],
)
def test_a_command_with_a_wrong_part_is_refused(part: str, given: Any, rule: str) -> None:
    law = PluginController(Answers(**{part: given}), 3)
    with pytest.raises(
        CommandError, match=rf"Answers answered .*, neither a Command nor four rotor speeds \[rad/s\]: {rule}"
    ):
        law.step(StepInputs(acting=np.ones(4)), np.zeros(12), np.zeros((3, 4)))


@pytest.mark.parametrize("given", [None, np.zeros((1, 3, 12)), np.zeros((2, 12))])
def test_a_prediction_of_another_shape_is_refused(given: Any) -> None:
    law = PluginController(Answers(predicted=given), 3)
    with pytest.raises(InputError, match=r"Answers\.predict"):
        law.predict(np.zeros((2, 12)), np.zeros((2, 3, 4)))


# --- what is wrong -------------------------------------------------------------------------------------------------

MEANT = ". Did you mean 'offset'?" if sys.version_info >= (3, 13) else ""
CALLED = "controller: mine:Hover cannot be called with vehicle, period, horizon"
WITH = '[controller]\ntype = "{module}:Hover"\nsettings = '
WRONG = {
    # name: (code, [controller], message)
    "its own bug": (
        HOVER.replace("        self.speeds,", "        None + 1\n        self.speeds,"),
        None,
        f"{CALLED}: TypeError: unsupported operand type(s) for +: 'NoneType' and 'int' (FOLDER/mine.py, line 6)",
    ),
    "raises": (
        "\n1 / 0\n",
        None,
        "controller.type: mine cannot be imported: ZeroDivisionError: division by zero (FOLDER/mine.py, line 2)",
    ),
    "attribute": (
        HOVER,
        'controller = "{module}:Hovr"',
        "no controller.type in mine named 'Hovr'; did you mean 'Hover'? (there are: Hover)",
    ),
    "module": (
        HOVER,
        'controller = "{module}_gone.law:Hover"',
        "controller.type: mine_gone.law cannot be imported: ModuleNotFoundError: No module named 'mine_gone'; it is "
        "looked for among what is installed, and in HERE",
    ),
    "unknown": (
        HOVER,
        WITH + "{ ofset = 1 }",
        f"{CALLED}, ofset: TypeError: Hover.__init__() got an unexpected keyword argument 'ofset'{MEANT}",
    ),
}


@pytest.mark.parametrize(("code", "controller", "expected"), WRONG.values(), ids=WRONG)
def test_one_message_names_field_module_attribute_and_line(
    written: Write, code: str, controller: str | None, expected: str
) -> None:
    path = written(code) if controller is None else written(code, controller)
    reported = message(path).removeprefix("mine.toml: ")
    assert reported == expected
