"""`import quadsim`: what users call from Python."""

from __future__ import annotations

import functools
import importlib
import math
import re
from collections.abc import Callable
from pathlib import Path
from pkgutil import resolve_name
from types import ModuleType
from typing import Any

import numpy as np
import pytest

import quadsim
import quadsim.gym
from quadsim import mpc
from quadsim.controller import StepInputs
from quadsim.errors import InputError, OutputError, ParameterError, UnknownNameError
from quadsim.flight import rundir
from quadsim.flight.audit import Limit
from quadsim.rollout.flown import Flight
from quadsim.scenarios.schema.scenario import Scenario
from quadsim.state import Array
from quadsim.vehicle import Vehicle

Fly = Callable[..., Flight]


def hover_law(now: StepInputs, state: Array, reference: Array) -> Array:
    """A controller that other processes can import."""
    return np.full(4, 180.0 if now.time < 0.2 else 210.0)


class Gentle:
    """A controller with settings."""

    def __init__(self, vehicle: Vehicle, period: float, horizon: int, share: float = 1.0) -> None:
        self.speeds = np.full(4, share * vehicle.hover_speed)

    def step(self, now: StepInputs, state: Array, reference: Array) -> Array:
        return self.speeds


@pytest.fixture(scope="module")
def hover() -> Scenario:
    return quadsim.load("hover").replace({"duration": 1.0})


@pytest.fixture(scope="module")
def flight() -> Flight:
    return quadsim.fly(quadsim.load("paper-constrained").replace({"duration": 6.0}), progress=False)


PAGES_OF_THE_API = sorted((Path(__file__).resolve().parents[2] / "docs").glob("api*.md"))


def test_the_pages_of_the_api_have_every_public_name() -> None:
    text = "".join(path.read_text(encoding="utf-8") for path in PAGES_OF_THE_API)
    named = {*re.findall(r"^::: ((?:quadsim|quadsim\.gym|quadsim\.mpc)\.\w+)$", text, re.MULTILINE)}
    public = set()
    for package in (quadsim, quadsim.gym, mpc):
        for name in package.__all__:
            if not isinstance(getattr(package, name), ModuleType):
                public.add(f"{package.__name__}.{name}")
    assert named == public


def test_the_pages_of_the_api_list_members_that_exist() -> None:
    """Of each entry, the attributes, properties and fields that it shows."""
    text = "".join(path.read_text(encoding="utf-8") for path in PAGES_OF_THE_API)
    listed = re.findall(r"^::: ([\w.]+)\n    options:\n      members: \[([\w, ]+)\]$", text, re.MULTILINE)
    assert listed
    assert len(listed) == text.count("members:")
    for name, members in listed:
        public = resolve_name(name)
        there = {*dir(public), *getattr(public, "__dataclass_fields__", ())}
        assert {*members.split(", ")} <= there, name


def constraint_of(scenario: Scenario, name: str) -> Limit:
    (constraint,) = [constraint for constraint in scenario.constraints if constraint.name == name]
    return constraint


def test_a_scenario_is_changed_field_by_field() -> None:
    scenario = quadsim.load("paper-constrained", {"controller.horizon": 30})
    changed = scenario.replace(
        {"vehicle.mass": np.float64(4.2), "constraints.roll.upper": 4.0, "initial.euler.2": 10.0}
    )
    assert changed.controller.horizon == 30
    assert changed.vehicle.mass == 4.2
    assert changed.initial.euler == (0.0, 0.0, 10.0)
    assert constraint_of(changed, "roll").upper == 4.0
    assert scenario.vehicle.mass is None
    assert changed.replace({"vehicle.mass": None}).vehicle.mass is None
    one_sided = changed.replace({"constraints.roll.upper": None})
    assert constraint_of(one_sided, "roll").upper == math.inf
    with pytest.raises(InputError, match=r"controller\.horizn"):
        scenario.replace({"controller.horizn": 3})
    with pytest.raises(InputError, match="horizon"):
        scenario.replace({"controller.horizon": -1})
    with pytest.raises(InputError, match="no scenario named"):
        quadsim.load("nonsense")


def test_arrays_have_names_and_agree_with_the_tables(flight: Flight) -> None:
    table = flight.to_arrow()
    assert np.array_equal(flight.time, table["t"].to_numpy())
    assert np.array_equal(flight.state["x"], table["x"].to_numpy())
    assert np.array_equal(flight.command[:, 2], table["u3"].to_numpy())
    assert np.array_equal(flight.reference["yaw"], table["ref_yaw"].to_numpy())
    assert flight.measured["roll"] is not flight.state["roll"]
    assert len(flight.plant["w1"]) == len(flight.to_arrow("plant")) == 6001
    assert flight.metrics["rmse.x"] == flight.summary["tracking"]["rmse"]["x"]
    with pytest.raises(UnknownNameError, match="'wind'"):
        flight.to_arrow("wind")


def test_it_is_drawn(flight: Flight) -> None:
    import matplotlib as mpl

    mpl.use("Agg")
    axes = flight.plot("x", "roll", "speed")
    assert [panel.get_ylabel() for panel in axes] == ["x [m]", "roll [deg]", "speed [rad/s]"]
    assert len(axes[2].get_lines()) == 4
    assert len(flight.plot()) == 6
    assert flight.plot("xy")[0].get_xlabel() == "x [m]"
    with pytest.raises(UnknownNameError, match="'rol'") as refused:
        flight.plot("rol")
    message = str(refused.value)
    assert "did you mean 'roll'?" in message
    for name in ("x_error", "z_error", "margin.NAME", "command"):
        assert name in message
    page = flight._repr_html_()
    assert "<svg" in page
    for finding in flight.audit:
        assert finding.limit.name in page


def test_a_saved_flight_is_the_run_that_the_command_writes(flight: Flight, tmp_path: Path) -> None:
    """The same bytes of Parquet; read again it is the same."""
    flight.save(tmp_path / "saved", video=False, recording=False, figures=False)
    quadsim.run(flight.scenario, out=tmp_path / "run", video=False, recording=False, figures=False, progress=False)
    for name in ("flight.parquet", "plant.parquet", "horizon.parquet", "scenario.toml"):
        assert (tmp_path / "saved" / name).read_bytes() == (tmp_path / "run" / name).read_bytes()
    read = quadsim.read(tmp_path / "saved")
    assert [str(finding) for finding in read.audit] == [str(finding) for finding in flight.audit]
    assert (read.outcome, read.controller, read.solver) == (flight.outcome, flight.controller, flight.solver)
    assert read.scenario == flight.scenario
    assert np.array_equal(read.command, flight.command)
    assert read.metrics["rmse.z"] == flight.metrics["rmse.z"]
    assert not rundir.damaged_files(tmp_path / "saved", read.summary)
    with pytest.raises(OutputError, match="disk"):
        read.save(tmp_path / "again")


def test_a_custom_law_flies(hover: Scenario) -> None:
    by_function = quadsim.fly(hover, controller=hover_law, progress=False)
    assert by_function.controller == "hover_law"
    assert by_function.scenario.controller.type == f"{__name__}:hover_law"
    assert set(by_function.command[:, 0]) == {180.0, 210.0}

    by_class = quadsim.fly(hover, controller=functools.partial(Gentle, share=0.5), progress=False)
    assert by_class.scenario.controller.settings == {"share": 0.5}
    ready = Gentle(by_class.vehicle, 0.05, 50, share=0.5)
    assert np.array_equal(by_class.command, quadsim.fly(hover, controller=ready, progress=False).command)

    def local(now: StepInputs, state: Array, reference: Array) -> Array:
        return ready.speeds

    assert np.array_equal(by_class.command, quadsim.fly(hover, controller=local, progress=False).command)


@pytest.mark.parametrize(
    ("law", "message"),
    [
        (3.0, "a class or an object with a method step"),
        (lambda state, reference: state, r"or a function law.*; got the function .*<lambda>\(state, reference\)"),
        (functools.partial(Gentle, 0.5), "keyword arguments only"),
        (functools.partial(Gentle, shade=0.5), "unexpected keyword argument 'shade'"),
    ],
)
def test_what_is_no_law_is_refused(law: object, message: str, hover: Scenario) -> None:
    with pytest.raises(InputError, match=message):
        quadsim.fly(hover, controller=law, progress=False)


def pull(time: float, state: Array, newton: float = 0.5) -> Array:
    """A force to the left, world frame."""
    return np.array([0.0, newton, 0.0, 0.0, 0.0, 0.0])


class Jerks:
    """A random force that remembers its last value; its generator is the scenario's."""

    def __init__(self, vehicle: Vehicle, rng: np.random.Generator, share: float) -> None:
        self.weight = vehicle.mass * vehicle.gravity
        self.rng = rng
        self.share = share
        self.last = 0.0

    def reset(self) -> None:
        self.last = 0.0

    def __call__(self, time: float, state: Array) -> Array:
        self.last = 0.5 * self.last + self.share * self.weight * self.rng.standard_normal()
        return np.array([0.0, 0.0, self.last, 0.0, 0.0, 0.0])


def test_a_custom_force_acts(hover: Scenario) -> None:
    """As the same constant force from a scenario's file, to rounding; recorded with the plant's wrench."""
    free = hover.replace({"controller": {"type": "pid"}})
    pushed = quadsim.fly(free, forces=[functools.partial(pull, newton=0.7)], progress=False)
    same = quadsim.fly(free.replace({"effects.disturbance.force": [0.0, 0.7, 0.0]}), progress=False)
    np.testing.assert_allclose(pushed.state["y"], same.state["y"], atol=1e-12)
    assert pushed.state["y"].max() > 1e-3
    assert pushed.log.plant.wrench is not None
    assert pushed.log.plant.wrench[1:, 1].tolist() == pytest.approx([0.7] * 1000)
    assert [spec.settings for spec in pushed.scenario.forces] == [{"newton": 0.7}]


def test_a_force_with_memory_is_seeded(hover: Scenario) -> None:
    force = functools.partial(Jerks, share=0.01)
    first, again = (quadsim.fly(hover, forces=[force], progress=False) for _ in range(2))
    other = quadsim.fly(hover.replace({"seed": 5}), forces=[force], progress=False)
    assert np.array_equal(first.plant["vz"], again.plant["vz"])
    assert not np.array_equal(first.plant["vz"], other.plant["vz"])


@pytest.mark.usefixtures("campaigns_here")
def test_a_force_of_a_file_acts_in_a_sweep(hover: Scenario, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    source = "import numpy as np\ndef lift(time, state):\n    return np.array([0.0, 0.0, 1.0, 0.0, 0.0, 0.0])\n"
    (tmp_path / "my_forces.py").write_text(source)
    (tmp_path / "lifted.toml").write_text('base = "hover"\nduration = 1.0\n[[forces]]\ntype = "my_forces:lift"\n')
    by_file = quadsim.fly(tmp_path / "lifted.toml", progress=False)
    monkeypatch.syspath_prepend(str(tmp_path))
    lift = importlib.import_module("my_forces").lift
    assert np.array_equal(by_file.plant["z"], quadsim.fly(hover, forces=[lift], progress=False).plant["z"])
    swept = quadsim.sweep(hover, {"controller.horizon": [50]}, forces=[lift], workers=1, progress=False)
    assert swept["rmse.z"].tolist() == [by_file.metrics["rmse.z"]]


def test_a_force_that_fails_ends_the_flight_with_its_reason(hover: Scenario) -> None:
    def bad(time: float, state: Array) -> Array:
        return np.zeros(6) if time < 0.5 else np.full(5, np.nan)

    flown = quadsim.fly(hover, forces=[bad], progress=False)
    assert flown.outcome == "lost"
    assert "at t = 0.500 s: the force bad " in str(flown.log.reason)


def test_a_sweep_flies_every_combination(hover: Scenario) -> None:
    result = quadsim.sweep(
        hover,
        {"controller.horizon": [20, 30], "vehicle.mass": np.array([4.0, 4.5, 5.0])},
        workers=2,
        progress=False,
    )
    assert len(result) == 6
    assert result["controller.horizon"].tolist() == [20.0] * 3 + [30.0] * 3
    assert result["vehicle.mass"].tolist() == [4.0, 4.5, 5.0] * 2
    alone = quadsim.fly(hover.replace({"controller.horizon": 30, "vehicle.mass": 4.5}), progress=False)
    assert result["rmse.z"][4] == alone.metrics["rmse.z"]
    assert result.to_arrow().schema.field("rmse.z").metadata == {b"unit": b"m"}
    with pytest.raises(UnknownNameError, match="'rmse'"):
        result["rmse"]
    with pytest.raises(ParameterError, match="list"):
        quadsim.sweep(hover, {"controller.horizon": []})
    with pytest.raises(InputError, match="horizon"):
        quadsim.sweep(hover, {"controller.horizon": [0]}, workers=1)


def test_fields_are_swept_together(hover: Scenario) -> None:
    roll = "controller.output_bounds.roll"
    pitch = "controller.output_bounds.pitch"
    tried = [[-2.0, 2.0], ([-3.0, 3.0], [-4.0, 4.0])]  # one for both, and one for each
    result = quadsim.sweep(hover, {(roll, pitch): tried, "vehicle.mass": [4.0, 4.2]}, workers=1, progress=False)
    swept = [f"{roll}.0", f"{roll}.1", f"{pitch}.0", f"{pitch}.1"]
    assert result.table.column_names[:6] == [*swept, "vehicle.mass", "verdict"]
    assert result[f"{roll}.1"].tolist() == [2.0, 2.0, 3.0, 3.0]
    assert result[f"{pitch}.0"].tolist() == [-2.0, -2.0, -4.0, -4.0]
    alone = quadsim.fly(hover.replace({(roll, pitch): tried[1]}), progress=False)
    for finding in alone.audit:
        assert result[f"margin.{finding.limit.name}"][2] == finding.worst_margin
    frame = result.to_pandas()
    assert frame.shape == (4, len(result.table.column_names))
    assert frame.groupby("vehicle.mass")["margin.roll"].max().tolist() == pytest.approx([3.0, 3.0], abs=0.01)
    assert "4 satisfied" in repr(result).splitlines()[0]
    with pytest.raises(ParameterError, match="tuple"):
        hover.replace({(roll, pitch): (1, 2, 3)})


def test_whole_tables_are_swept(hover: Scenario) -> None:
    result = quadsim.sweep(hover, {"controller": [{"type": "pid"}, {"type": "lqr"}]}, workers=1, progress=False)
    assert result["controller.type"].tolist() == ["pid", "lqr"]


def test_a_custom_law_is_sent_to_other_processes_by_its_place(
    hover: Scenario, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    source = "import numpy as np\ndef steady(now, state, reference, speed=210.0):\n    return np.full(4, speed)\n"
    (tmp_path / "my_laws.py").write_text(source)
    monkeypatch.syspath_prepend(str(tmp_path))
    steady = importlib.import_module("my_laws").steady

    def swept(law: object) -> list[float]:
        result = quadsim.sweep(hover, {"vehicle.mass": [4.0, 5.0]}, controller=law, workers=1, progress=False)
        assert result["reason"].tolist() == [None, None]
        return result["speed_max"].tolist()

    assert swept(steady) == [210.0, 210.0]
    assert swept(functools.partial(steady, speed=190.0)) == [190.0, 190.0]

    def local(now: StepInputs, state: Array, reference: Array) -> Array:
        return np.zeros(4)

    for law in (local, object()):
        with pytest.raises(ParameterError, match="at the top level of a module"):
            quadsim.sweep(hover, {"vehicle.mass": [4.0]}, controller=law, workers=1)


@pytest.mark.usefixtures("undrawn")
def test_flights_are_compared(hover: Scenario, flight: Flight, tmp_path: Path) -> None:
    other = quadsim.fly(hover, progress=False)
    result = quadsim.compare(flight, other, progress=False)
    assert result.names == ("paper-constrained", "hover")
    assert result.page is None
    assert result.to_markdown().startswith("|")
    saved = other.save(tmp_path / "hover", video=False, recording=False)
    page = quadsim.compare(saved, out=tmp_path / "page", progress=False).page
    assert page == tmp_path / "page" / "index.html"
    assert "hover" in page.read_text()


@pytest.mark.usefixtures("undrawn")
def test_a_comparison_says_first_in_which_fields_the_controllers_differ(tmp_path: Path) -> None:
    """As the flights of `make demo`, which differ in weights and horizon, too; equal ones are not mentioned."""
    brief = {"duration": 0.2, "constraints": []}
    free = quadsim.load("paper-unconstrained", brief)
    bounded = quadsim.load("paper-constrained", brief)
    flown = quadsim.fly(bounded, progress=False)
    note = quadsim.compare(quadsim.fly(free, progress=False), flown, progress=False).notes[0]
    for words in ("type (unconstrained, constrained)", "horizon (100, 50)", "input_weights", "output_bounds"):
        assert words in note
    page = quadsim.compare(free, bounded, out=tmp_path / "page", video=False, progress=False).page
    opening = page.read_text(encoding="utf-8").partition("</h1>")[2].partition("<h2")[0]
    assert note in opening
    assert quadsim.compare(flown, bounded.replace({"seed": 3}), progress=False).notes == ()
    note = quadsim.compare(flown, bounded.replace({"controller.horizon": 60}), progress=False).notes[0]
    assert note.endswith(": differ in horizon (50, 60).")


def test_columns_of_a_comparison_have_the_names_that_they_are_given(hover: Scenario, flight: Flight) -> None:
    def falls(now: Any, state: Any, reference: Any) -> list[float]:
        return [0.0] * 4

    own = quadsim.fly(hover, controller=falls, progress=False)
    shipped = quadsim.fly(hover, progress=False)
    assert quadsim.compare(shipped, own, progress=False).names == ("hover (constrained MPC)", "hover (falls)")
    named = quadsim.compare(shipped, own, names=["theirs", "mine"], progress=False)
    assert named.names == ("theirs", "mine")
    assert "| theirs | mine |" in named.to_markdown()
    for names in (["mine"], ["mine", "mine"], ["mine", " "], "me", ["mine", 3]):
        with pytest.raises(ParameterError, match="names"):
            quadsim.compare(hover, flight, names=names, progress=False)


def test_what_is_handed_out_names_itself_in_a_few_lines() -> None:
    scenario = quadsim.load("hover").replace({"duration": 1.0})
    flight = quadsim.fly(scenario)
    assert repr(scenario).splitlines()[0] == "<Scenario hover: 1 s of lopes2011, steps by constrained"
    first, worst = repr(flight).splitlines()
    assert first == f"<Flight hover: {flight.outcome}, 1.00 s by constrained"
    name, margin = re.fullmatch(r" worst margin: (\S+) (\S+) .*>", worst).groups()
    assert float(margin) == pytest.approx(min(flight.margins[name]), abs=0.1)
    compared = repr(quadsim.compare(*[flight] * 6)).splitlines()
    assert compared[0] == "<FlightComparison of 6 flights"
    assert compared[1].endswith(f": {flight.outcome}")
    assert compared[2] == worst.removesuffix(">")
    assert compared[-1] == " and 2 more>"


@pytest.mark.slow("docstrings")
def test_a_notebook_shows_tables_and_a_small_plot(hover: Scenario, flight: Flight, tmp_path: Path) -> None:
    swept = quadsim.sweep(hover, {"controller.horizon": [20, 30]}, workers=1, progress=False)
    mass = {"name": "mass", "fields": ["vehicle.mass"], "distribution": "grid", "values": [3.9, 4.0, 4.1]}
    flown = quadsim.campaign(hover, vary=[mass], flights=3, workers=1, out=tmp_path / "c", progress=False)
    for shown in (hover, flight, quadsim.compare(flight, flight), swept, flown):
        page = shown._repr_html_()
        assert len(page) < 62_000, "it is stored with the notebook"
        assert "<svg" in page or "data:image/png" in page
    assert repr(flown).splitlines()[0].startswith("<CampaignResult hover: 0 of 3 flights failed")
    assert "<th>vehicle</th><td>lopes2011</td>" in hover._repr_html_()


@pytest.mark.parametrize(
    ("typed", "offered", "withheld"),
    [
        ('flight.state["', ["x", "yaw_rate"], []),
        ('flight.margins["', ["arrival_x", "roll"], []),
        ("flight.", ["outcome", "state", "margins", "to_pandas", "plot"], []),
        ("scenario.", ["controller", "duration", "replace", "fly", "to_toml"], ["altered", "require_consistent"]),
        ("quadsim.", ["fly", "sweep", "Scenario"], ["importlib", "TYPE_CHECKING", "annotations"]),
    ],
)
def test_ipython_with_jedi_completes(
    hover: Scenario, flight: Flight, typed: str, offered: list[str], withheld: list[str]
) -> None:
    from IPython.core.completer import IPCompleter, provisionalcompleter

    names = {"flight": flight, "scenario": hover, "quadsim": quadsim}
    completer = IPCompleter(namespace=names, use_jedi=True)
    completer.jedi_compute_type_timeout = 0
    with provisionalcompleter():
        result = {completion.text for completion in completer.completions(typed, len(typed))}
    assert {*offered} <= result
    assert not result & {*withheld}


def test_a_scenario_flies(hover: Scenario) -> None:
    assert hover.fly(progress=False).outcome == "satisfied"
