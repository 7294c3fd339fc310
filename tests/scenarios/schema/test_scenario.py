"""The scenario file: what it may contain, and the messages for everything else."""

from __future__ import annotations

import copy
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support import scenario_table

from mpc.ocp import Objective
from mpc.solvers import SOLVERS
from quadsim.assets import vehicle_path
from quadsim.errors import FileError, InputError, ParameterError, UnknownNameError
from quadsim.flight.audit import SIGNALS
from quadsim.state import STATE_NAMES
from quadsim.vehicle import OPTIONAL_PARAMETERS, VEHICLE_UNITS
from scenarios.build import resolve
from scenarios.limits import build_limits
from scenarios.loading import load_scenario, parse_scenario
from scenarios.parts.vehicle import build_vehicle
from scenarios.schema.problems import ScenarioError
from scenarios.schema.scenario import MOST_STEPS, Scenario
from scenarios.schema.settings import apply_setting
from scenarios.shipped import LIBRARY, scenario_names, scenario_path


def reread(scenario: Scenario) -> Scenario:
    return parse_scenario(tomllib.loads(scenario.to_toml()))


# --- what is right -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", scenario_names())
def test_every_file_of_the_library_comes_back_from_its_resolved_text(name: str) -> None:
    scenario = load_scenario(name)
    resolved = resolve(scenario, build_vehicle(scenario))
    assert scenario.name == name
    assert reread(scenario) == scenario
    assert reread(resolved) == resolved
    assert build_vehicle(reread(resolved)) == build_vehicle(scenario)
    numbers = resolved.vehicle.overrides()  # its file alone defines it
    assert numbers.keys() >= VEHICLE_UNITS.keys() - set(OPTIONAL_PARAMETERS)
    assert set(numbers) == {key for key in VEHICLE_UNITS if getattr(build_vehicle(scenario), key) is not None}


def test_defaults_are_written_out() -> None:
    table = tomllib.loads(parse_scenario(scenario_table()).to_toml())
    assert table["seed"] == 0
    assert (table["group"], table["expect"]) == ("other", "satisfied")
    assert table["log_rate"] == 200.0
    assert table["plant"] == {"timestep": 0.001, "integrator": "mujoco", "limit_speeds": False}
    at_rest = {"position": [0.0, 0.0, 0.0], "euler": [0.0, 0.0, 0.0], "cold": False, "on_reference": False}
    assert table["initial"] == at_rest
    assert table["controller"]["solver"] == "piqp-multistage"


def test_counts_follow_from_the_times() -> None:
    scenario = parse_scenario(scenario_table() | {"duration": 0.9, "control_period": 0.3, "log_rate": 100.0})
    assert (scenario.periods, scenario.steps_per_period, scenario.plant_stride) == (3, 300, 10)


def test_absent_bounds_are_infinite() -> None:
    limit, *_ = build_limits(
        parse_scenario(scenario_table() | {"constraints": [{"name": "a", "signal": "z", "lower": 1}]})
    )
    assert (limit.lower, limit.upper, limit.start, limit.stop) == (1.0, np.inf, 0.0, np.inf)


def test_a_vehicle_file_beside_the_scenario_is_found_and_stored_by_its_whole_path(tmp_path: Path) -> None:
    (tmp_path / "mine.toml").write_text(vehicle_path("lopes2011").read_text().replace("value = 4.0", "value = 3.0"))
    text = (LIBRARY / "hover.toml").read_text().replace('"lopes2011"', '"mine.toml"')
    (tmp_path / "course.toml").write_text(text)
    scenario = load_scenario(str(tmp_path / "course.toml"))
    assert scenario.vehicle.file == str(tmp_path / "mine.toml")
    assert build_vehicle(scenario).mass == 3.0


# --- what its description says was changed ---------------------------------------------------------------------------


def test_a_description_says_what_was_changed() -> None:
    text = load_scenario("hover").description
    changed = load_scenario("hover", ["controller.horizon=30", "controller.solver=piqp-dense", "seed=7", "name=mine"])
    assert changed.description == f'{text} (changed: controller.horizon = 30; controller.solver = "piqp-dense")'
    more = changed.replace({"controller.horizon": 40, "vehicle.mass": 4.123456789, "effects.air": None})
    parts = [
        'controller.solver = "piqp-dense"',
        "controller.horizon = 40",
        "vehicle.mass = 4.12346",
        "effects.air = absent",
    ]
    assert more.description == f"{text} (changed: {'; '.join(parts)})"
    assert parse_scenario(tomllib.loads(more.to_toml())).description == more.description


def test_a_description_of_one_s_own_stays_as_it_is() -> None:
    found = load_scenario("hover", ["controller.horizon=30", "description=mine"])
    assert found.description == "mine"
    assert load_scenario("hover").replace({"description": "mine"}).description == "mine"


def test_a_long_value_is_cut_in_a_description() -> None:
    events = [{"type": "push", "at": float(at), "duration": 0.1, "force": [0.1, 0.0, 0.0]} for at in range(9)]
    found = load_scenario("hover").replace({"events": events})
    assert found.description.endswith("...)")
    assert len(found.description) < 160


# --- what is wrong in one field ------------------------------------------------------------------------------------

WRONG = {
    # given by --set on paper-constrained: the whole message after the file's name, or its beginning before " ..."
    "duraton=3": "duraton is not a field of the scenario file; did you mean 'duration'? (there are: name, ...",
    "controller.horizn=3": "controller.horizn is not a field of the scenario file; did you mean 'horizon'? ...",
    "vehicle.weight=3": "vehicle.weight is not a field of the scenario file (there are: file, mass, gravity, ...",
    "vehicle.rotor_lag=1": (
        "vehicle.rotor_lag is not a field of the scenario file; did you mean 'rotor_rise' and 'rotor_fall'? ..."
    ),
    "plant.step=1": "plant.step is not a field of the scenario file; did you mean 'timestep'? ...",
    "reference.x=[{start=0,stop=1,valu=2}]": "reference.x.0.valu is not a field of the scenario file; did you ...",
    "constraints.roll.upr=3": "constraints.roll.upr is not a field of the scenario file; did you mean 'upper'? ...",
    "name=3": "name must be a text; got 3",
    "name=A/B": "name must be of the form ^[a-z0-9][a-z0-9._-]*$; got 'A/B'",
    "duration=long": "duration must be a number; got 'long'",
    "duration=true": "duration must be a number; got True",
    "duration=nan": "duration must be a finite number; got nan",
    "duration=inf": "duration must be a finite number; got inf",
    "duration=0": "duration must be > 0.0; got 0",
    "duration=-1.0": "duration must be > 0.0; got -1.0",
    "duration=1e9": "duration must be <= 86400.0; got 1000000000.0",
    "control_period=0": "control_period must be > 0.0; got 0",
    "group=nowhere": "group must be one of 'paper', 'papers', 'courses', 'air', 'faults', 'ground', 'space', 'sensors' "
    "or 'other'; ...",
    "expect=fine": "expect must be one of 'satisfied', 'violated', 'lost', 'aborted' or 'incomplete'; got 'fine'",
    "name='" + 81 * "a" + "'": "name must be a text of 80 or fewer characters; got '" + 81 * "a" + "'",
    "seed=-1": "seed must be >= 0; got -1",
    "seed=1.5": "seed must be a whole number; got 1.5",
    "log_rate=0": "log_rate must be >= 0.01; got 0",
    "vehicle=3": "vehicle must be a table; got 3",
    "vehicle.file=3": "vehicle.file must be a text; got 3",
    "vehicle.mass=heavy": "vehicle.mass must be a number; got 'heavy'",
    "vehicle.inertia=[1, 1]": "vehicle.inertia must be a list of 3 numbers; got [1, 1]",
    "vehicle.rotor_spins=[1, 1, 1, 1, 1]": "vehicle.rotor_spins must be a list of 4 numbers; got [1, 1, 1, 1, 1]",
    "initial.position=[0, nan, 0]": "initial.position.1 must be a finite number; got nan",
    "initial.position=[0, 1e7, 0]": "initial.position.1 must be <= 1000000.0; got 10000000.0",
    "plant.timestep=0": "plant.timestep must be >= 1e-06; got 0",
    "plant.timestep=0.02": "plant.timestep must be <= 0.01; got 0.02",
    "plant.limit_speeds=1": "plant.limit_speeds must be true or false; got 1",
    "reference.response_time=-1": "reference.response_time must be >= 0.0; got -1",
    "reference.x=3": "reference.x must be a list; got 3",
    "reference.x=[3]": "reference.x.0 must be a table; got 3",
    "controller=3": "controller must be a table or a controller's name; got 3",
    "controller={horizon = 3}": "controller must be a table with a field type; got None",
    "controller={type = 'nonlinear', compiled = true}": (
        "controller.compiled must be absent for nonlinear: only MPC with fixed matrices "
        "(unconstrained, constrained, robust) can be compiled; got True"
    ),
    "controller.type=mpc": "controller must be one of 'unconstrained', 'constrained', 'robust', ...",
    "controller.horizon=0": "controller.horizon must be >= 1; got 0",
    "controller.horizon=1001": "controller.horizon must be <= 1000; got 1001",
    "controller.horizon=2.0": "controller.horizon must be a whole number; got 2.0",
    "controller.output_weights={}": "controller.output_weights must be of 1 or more entries; got {}",
    "controller.output_weights.x=0": "controller.output_weights.x must be > 0.0; got 0",
    "controller.output_weights.x=1e13": "controller.output_weights.x must be <= 1000000000000.0; got 10000000000000.0",
    "controller.output_weights.constrained=0": "controller.output_weights.constrained must be > 0.0; got 0",
    "controller.output_weights.zz=1": "controller.output_weights.zz is not a state; did you mean 'z'? (there are: ...",
    "controller.input_weights.speed=-1": "controller.input_weights.speed must be > 0.0; got -1",
    "controller.input_weights.speed=big": "controller.input_weights.speed must be a number; got 'big'",
    "controller.input_weights.speed=[1, 2]": "controller.input_weights.speed must be a list of 4 numbers; got [1, 2]",
    "controller.input_weights.speed=[1, 2, 0, 1]": "controller.input_weights.speed.2 must be > 0.0; got 0",
    "controller.solver=gurobi": "controller.solver: no solver named 'gurobi' (there are: ...",
    "controller.output_bounds.rol=[0, 1]": "controller.output_bounds.rol is not a state; did you mean 'roll'? ...",
    "controller.output_bounds.roll=[-5]": "controller.output_bounds.roll must be a list of 2 numbers; got [-5]",
    "constraints=3": "constraints must be a list; got 3",
    "constraints=[3]": "constraints.0 must be a table; got 3",
    "constraints.roll.tolerance=-1": "constraints.roll.tolerance must be >= 0.0; got -1",
    "constraints.roll.required=0": "constraints.roll.required must be true or false; got 0",
    "constraints.roll.signal=rol": "constraints.roll.signal: no signal named 'rol'; did you mean 'roll'? ...",
    "constraints.roll.name=a b": "constraints.a b.name must be of the form ^[A-Za-z0-9_.-]+$; got 'a b'",
    # fields that contradict each other
    "control_period=0.0505": (
        "control_period must be a whole multiple of the physics step plant.timestep = 0.001 s; got 0.0505"
    ),
    "duration=1.01": "duration must be a whole multiple of the control period = 0.05 s; got 1.01",
    "log_rate=300": (
        "log_rate must have a period that is a whole multiple of the physics step plant.timestep = 0.001 s; got 300.0"
    ),
    "initial.euler=[0, 90, 0]": (
        "initial.euler must have a roll within +-180 deg and a pitch within +-90 deg; got [0.0, 90.0, 0.0]"
    ),
    "controller={type='geometric',drag=[1,0,0]}": (
        "controller.drag must be zero where feedforward is not true; got [1.0, 0.0, 0.0]"
    ),
    "controller={type='geometric',feedforward=true,horizon=4}": (
        "controller.horizon must be at least 5 where feedforward is true; got 4"
    ),
    "controller={type='geometric',indi={rate=300}}": (
        "controller.indi.rate must be such that 1 / rate is a whole multiple of the physics step of 0.001 s; got 300.0"
    ),
    "controller={type='nonlinear',offset_free={},disturbance={}}": (
        "controller.disturbance must be absent where offset_free is given: both estimate the same force"
    ),
    "reference.x=[{start=2,stop=2,value=0}]": "reference.x.0.start must be below stop = 2.0; got 2.0",
    "controller.output_bounds.roll=[5, -5]": (
        "controller.output_bounds.roll must have its lower bound below its upper; got [5.0, -5.0]"
    ),
    "controller.input_bounds.speed=[250, 0]": (
        "controller.input_bounds.speed must have its lower bound below its upper; got [250.0, 0.0]"
    ),
    "controller.input_bounds.speed=[-1, 250]": (
        "controller.input_bounds.speed must have a lower bound >= 0 rad/s; got [-1.0, 250.0]"
    ),
    "controller.input_bounds.slew=[5, -10]": (
        "controller.input_bounds.slew must have its lower bound below its upper; got [5.0, -10.0]"
    ),
    "controller.input_bounds.slew=[1, 5]": (
        "controller.input_bounds.slew must allow a speed to be held, so contain 0; got [1.0, 5.0]"
    ),
    "constraints.arrival_x.lower=5": "constraints.arrival_x.lower must be below upper = 0.01; got 5.0",
    "constraints.roll.tolerance_sampled=1": (
        "constraints.roll.tolerance_sampled must be at most tolerance = 0.05; got 1.0"
    ),
    "constraints.roll.stop=-1": "constraints.roll.stop must be at least start = 0.0; got -1.0",
    "constraints.roll.name=pitch": "constraints must have distinct names; got ['pitch', 'pitch', 'speed', ...",
    "constraints=[{name='a', signal='x_error'}]": (
        "constraints.a must have lower, upper or both; no controller has bounds on x_error"
    ),
    "controller.type=unconstrained": (
        "controller.solver is not a field of the scenario file "
        "(there are: horizon, output_weights, input_weights, terminal, compiled, type)\n"
        "  controller.output_bounds is not ..."
    ),
}


@pytest.mark.parametrize(("setting", "message"), WRONG.items(), ids=WRONG)
def test_a_wrong_field_is_named_with_what_was_given_and_what_is_allowed(setting: str, message: str) -> None:
    with pytest.raises(ScenarioError) as caught:
        load_scenario("paper-constrained", [setting])
    reported, source = str(caught.value), "paper-constrained.toml: "
    if message.endswith("..."):
        assert reported.startswith(source + message[:-3])
    else:
        assert reported == source + message
    assert caught.value.source == "paper-constrained.toml"
    assert caught.value.exit_status == 2


@pytest.mark.parametrize("field", ["name", "duration", "vehicle", "vehicle.file", "reference", "controller.horizon"])
def test_a_missing_field_is_named(field: str) -> None:
    table = scenario_table()
    *path, last = field.split(".")
    inner = table
    for key in path:
        inner = inner[key]
    del inner[last]
    with pytest.raises(ScenarioError, match=rf"^scenario: {field} is missing$"):
        parse_scenario(table)


def test_all_wrong_fields_are_named_at_once() -> None:
    with pytest.raises(ScenarioError) as caught:
        load_scenario("hover", ["controller.horizon=0", "vehicle.mass=true", "sed=1"])
    fields = [problem.split()[0] for problem in caught.value.problems]
    assert sorted(fields) == ["controller.horizon", "sed", "vehicle.mass"]


@pytest.mark.parametrize(
    ("settings", "count"),
    [
        (["duration=20", "plant.timestep=1e-6"], "at most 10000000 physics steps; got 20000000 of them"),
        (["duration=3600", "controller.horizon=1000"], "at most 10000000 planned steps; got 72000000 of them"),
    ],
)
def test_a_flight_that_would_not_fit_into_memory_is_refused(settings: list[str], count: str) -> None:
    assert MOST_STEPS == 10_000_000
    with pytest.raises(ScenarioError, match=f"duration must make {count}"):
        load_scenario("paper-constrained", settings)


@pytest.mark.parametrize("name", ["Q_y", "Q_u"])
@pytest.mark.parametrize(
    "matrix",
    [
        [[1.0, 2.0], [2.0, 1.0]],  # indefinite
        [[1.0, 0.0], [0.0, 0.0]],  # semidefinite
        [[1.0, 0.5], [0.0, 1.0]],  # not symmetric
        [[np.nan, 0.0], [0.0, 1.0]],
    ],
)
def test_weights_that_are_not_positive_definite_are_refused(name: str, matrix: list[list[float]]) -> None:
    given = {"C_r": np.eye(2), "Q_y": np.eye(2), "Q_u": np.eye(2)} | {name: np.array(matrix)}
    with pytest.raises(ParameterError, match=f"^controller.{name} must be symmetric and positive definite; got "):
        Objective(**given)


# --- what is wrong with the file, a name or a setting --------------------------------------------------------------


def test_a_missing_file_is_named() -> None:
    with pytest.raises(FileError, match=r"^nowhere/mine.toml: no such scenario file$"):
        load_scenario("nowhere/mine.toml")


def test_a_directory_is_no_scenario_file(tmp_path: Path) -> None:
    (tmp_path / "x.toml").mkdir()
    with pytest.raises(FileError, match="no such scenario file"):
        load_scenario(str(tmp_path / "x.toml"))


def test_an_unknown_scenario_is_answered_with_those_there_are() -> None:
    with pytest.raises(UnknownNameError) as caught:
        scenario_path("paper-constraint")
    assert str(caught.value) == (
        "no scenario named 'paper-constraint'; did you mean 'paper-constrained'? "
        f"(there are: {', '.join(scenario_names())}); or give a path ending in .toml"
    )


@pytest.mark.parametrize(
    ("content", "problem"),
    [
        (b"name = ", "is not valid TOML: "),
        (b"name = 'a'\nname = 'b'\n", "is not valid TOML: "),
        (b"\xff\xfe\x00", "cannot be read "),
        (b"", "name is missing\n  description is missing"),
    ],
)
def test_a_file_that_is_no_scenario_is_refused(tmp_path: Path, content: bytes, problem: str) -> None:
    path = tmp_path / "bad.toml"
    path.write_bytes(content)
    with pytest.raises(InputError, match=rf"bad\.toml: {problem}"):
        load_scenario(str(path))


def test_an_unknown_vehicle_is_answered_with_those_there_are() -> None:
    with pytest.raises(
        UnknownNameError,
        match=r"no vehicle named 'lopes'; did you mean 'lopes2011'\? \(there are: crazyflie2, hummingbird, lopes2011",
    ):
        build_vehicle(load_scenario("hover", ["vehicle.file=lopes"]))


def test_a_missing_vehicle_file_is_named() -> None:
    with pytest.raises(FileError, match=r"^gone\.toml: no such vehicle file$"):
        build_vehicle(load_scenario("hover", ["vehicle.file=gone.toml"]))


@pytest.mark.parametrize("setting", ["duration", "=3", "a..b=3", ".a=3", "a.=3", ""])
def test_a_setting_must_be_a_path_and_a_value(setting: str) -> None:
    with pytest.raises(ParameterError) as caught:
        apply_setting({}, setting)
    assert str(caught.value) == f"--set must be of the form dotted.path=value; got {setting!r}"


def test_a_setting_does_not_go_through_a_number() -> None:
    with pytest.raises(
        ParameterError, match=r"^--set must be a path to a field; duration has none; got 'duration\.x=3'$"
    ):
        load_scenario("hover", ["duration.x=3"])


@pytest.mark.parametrize("name", ["rol", "0"])
def test_a_setting_names_a_constraint_that_there_is(name: str) -> None:
    with pytest.raises(UnknownNameError, match=rf"^no entry of constraints named '{name}'.*\(there are: .*roll.*\)$"):
        load_scenario("paper-constrained", [f"constraints.{name}.upper=3"])


def test_settings_replace_add_and_reach_into_constraints() -> None:
    scenario = load_scenario(
        "paper-constrained",
        [
            "controller.horizon = 30",
            "vehicle.arm_length=0.25",
            "constraints.roll.upper=4.5",
            "controller.input_weights.speed=[1, 2, 3, 4]",
            "description=no quotes needed",
        ],
    )
    assert scenario.controller.horizon == 30
    assert scenario.vehicle.arm_length == 0.25
    assert scenario.constraints[0].upper == 4.5
    assert scenario.description == "no quotes needed"
    assert scenario.controller.input_weights.speed == [1.0, 2.0, 3.0, 4.0]


# --- any file ------------------------------------------------------------------------------------------------------

positive = st.floats(1e-6, 1e6)
ordinary = st.floats(-1e6, 1e6)
pair = st.lists(ordinary, min_size=2, max_size=2, unique=True).map(sorted)


@st.composite
def windows(draw: st.DrawFn) -> list[dict[str, float]]:
    pairs = draw(st.lists(pair, max_size=2))
    return [{"start": start, "stop": stop, "value": draw(ordinary)} for start, stop in pairs]


@st.composite
def constraints(draw: st.DrawFn) -> list[dict[str, Any]]:
    names = draw(st.lists(st.from_regex(r"[A-Za-z0-9_.-]{1,8}", fullmatch=True), unique=True, max_size=3))
    entries = []
    for name in names:
        (lower, upper), (start, stop) = draw(pair), draw(pair)
        tolerance = draw(st.floats(0.0, 10.0))
        entry = {
            "name": name,
            "signal": draw(st.sampled_from(sorted(SIGNALS))),
            "lower": lower,
            "upper": upper,
            "tolerance": tolerance,
            "tolerance_sampled": draw(st.floats(0.0, tolerance)),
            "required": draw(st.booleans()),
            "start": start,
            "stop": stop,
        }
        for absent in draw(st.sets(st.sampled_from(["lower", "required", "stop"]))):
            del entry[absent]
        entries.append(entry)
    return entries


@st.composite
def controllers(draw: st.DrawFn) -> dict[str, Any]:
    states = st.sampled_from(STATE_NAMES)
    table: dict[str, Any] = {
        "type": draw(st.sampled_from(["constrained", "unconstrained"])),
        "horizon": draw(st.integers(1, 200)),
        "output_weights": draw(st.dictionaries(states, positive, min_size=1)),
        "input_weights": {"speed": draw(positive | st.lists(positive, min_size=4, max_size=4))},
    }
    if table["type"] == "constrained":
        table["solver"] = draw(st.sampled_from(sorted(SOLVERS)))
        table["output_bounds"] = draw(st.dictionaries(states, pair))
        slow, fast = draw(st.floats(0.0, 100.0)), draw(st.floats(101.0, 1000.0))
        table["input_bounds"] = {"speed": [slow, fast], "slew": [-draw(positive), draw(positive)]}
    return table


@st.composite
def tables(draw: st.DrawFn) -> dict[str, Any]:
    """Scenario files that are right."""
    steps = draw(st.integers(1, 200))
    period = round(1e-3 * steps, 6)
    return {
        "name": draw(st.from_regex(r"[a-z0-9][a-z0-9._-]{0,20}", fullmatch=True)),
        "description": draw(st.text(st.characters(exclude_categories=["Cs"]), max_size=20)),
        "duration": round(period * draw(st.integers(1, 5000)), 6),
        "control_period": period,
        "seed": draw(st.integers(0, 2**40)),
        "log_rate": draw(st.sampled_from([1000.0, 500.0, 200.0, 100.0, 40.0])),
        "vehicle": {"file": "lopes2011"} | draw(st.dictionaries(st.sampled_from(["mass", "arm_length"]), positive)),
        "initial": {
            "position": draw(st.lists(ordinary, min_size=3, max_size=3)),
            "euler": draw(st.lists(st.floats(-89.0, 89.0), min_size=3, max_size=3)),
        },
        "plant": {"timestep": 0.001, "limit_speeds": draw(st.booleans())},
        "reference": {"response_time": draw(st.floats(0.0, 100.0))}
        | draw(st.dictionaries(st.sampled_from(["x", "y", "z", "yaw"]), windows())),
        "controller": draw(controllers()),
        "constraints": draw(constraints()),
    }


@settings(max_examples=60)
@given(table=tables())
def test_any_right_file_parses_and_comes_back_from_its_text(table: dict[str, Any]) -> None:
    scenario = parse_scenario(table)
    assert reread(scenario) == scenario
    assert scenario.periods * scenario.control_period == pytest.approx(table["duration"], rel=1e-9)


JUNK = st.sampled_from([None, True, "", "junk", -1.0, np.nan, np.inf, -np.inf, 1e300, [], [1.0], [[]], {}, {"junk": 1}])


def leaves(table: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """Paths to everything in nested tables and lists."""
    items = table.items() if isinstance(table, dict) else enumerate(table) if isinstance(table, list) else ()
    return [found for key, value in items for found in [(*path, key), *leaves(value, (*path, key))]]


@settings(max_examples=150)
@given(data=st.data())
def test_a_file_with_anything_anywhere_is_either_right_or_named_as_wrong(data: st.DataObject) -> None:
    """Whatever is put wherever: a scenario that its text gives again, or one typed error that names the field."""
    table = scenario_table()
    path = data.draw(st.sampled_from(leaves(table)))
    broken = copy.deepcopy(table)
    *outer, last = path
    inner: Any = broken
    for key in outer:
        inner = inner[key]
    how = data.draw(st.sampled_from(["replace", "remove", "misname"]))
    if how == "replace":
        inner[last] = data.draw(JUNK)
    else:
        value = inner.pop(last)
        if how == "misname" and isinstance(inner, dict):
            inner[f"{last}_"] = value
    try:
        scenario = parse_scenario(broken)
    except ScenarioError as error:
        message = str(error)
    else:
        assert reread(scenario) == scenario
        return
    assert str(path[0]) in message
    assert "Input should" not in message, "pydantic's own words"


EVENT = '{type="gust", at=0.1, duration=0.2, velocity=[1.0, 0.0, 0.0]}'


def test_an_entry_without_a_name_is_set_by_its_index() -> None:
    both = f"events=[{EVENT}, {EVENT}]"
    drag = "effects.air.rotor_drag=1e-4"
    scenario = load_scenario("hover", [drag, both, "events.1.at=3", "events.1.velocity=[0, 2, 0]"])
    assert [event.at for event in scenario.events] == [0.1, 3.0]
    with pytest.raises(UnknownNameError, match=r"^no entry of events named '2' \(there are: 0, 1\)$"):
        load_scenario("hover", [both, "events.2.at=3"])
    with pytest.raises(ScenarioError, match=r"events\.1\.at must be a number; got 'late'"):
        load_scenario("hover", [both, "events.1.at=late"])


@pytest.mark.parametrize(("setting", "field"), [("initial.position.0.x=3", "0"), ("events.0.at=3", "events")])
def test_a_setting_goes_through_tables_and_lists_alone(setting: str, field: str) -> None:
    table: dict[str, Any] = {"initial": {"position": [0.0, 0.0, 0.0]}, "events": []}
    with pytest.raises(ParameterError) as caught:
        apply_setting(table, setting)
    assert str(caught.value) == f"--set must be a path to a field; {field} has none; got {setting!r}"


def test_a_number_of_a_list_is_set_by_its_index() -> None:
    assert load_scenario("hover", ["initial.euler.2=30.0"]).initial.euler == [0.0, 0.0, 30.0]
    with pytest.raises(UnknownNameError, match=r"^no entry of initial\.euler named '3' \(there are: 0, 1, 2\)$"):
        load_scenario(
            "hover", ["initial.position=[0.0, 0.0, 1.0]", "initial.euler=[0.0, 0.0, 0.0]", "initial.euler.3=1"]
        )


def test_a_setting_that_names_a_whole_entry_of_a_list_is_refused() -> None:
    with pytest.raises(
        ParameterError, match=r"--set must be a path to a field; constraints\.roll is an entry of a list"
    ):
        load_scenario("paper-constrained", ["constraints.roll=5"])
