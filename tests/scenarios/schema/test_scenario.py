"""The scenario file: what it may contain, and the messages for everything else."""

from __future__ import annotations

import tomllib
from pathlib import Path

import numpy as np
import pytest
from support import scenario_table

from quadsim.assets import vehicle_path
from quadsim.errors import UnknownNameError
from quadsim.scenarios.assembly import Assembly
from quadsim.scenarios.catalogue import FLIGHTS
from quadsim.scenarios.loading import load_scenario, parse_scenario
from quadsim.scenarios.schema.initial import Initial
from quadsim.scenarios.schema.problems import ScenarioError
from quadsim.scenarios.schema.scenario import Scenario


def reread(scenario: Scenario) -> Scenario:
    return parse_scenario(tomllib.loads(scenario.to_toml()))


# --- what is right -------------------------------------------------------------------------------------------------


def test_defaults_are_written_out() -> None:
    table = tomllib.loads(parse_scenario(scenario_table()).to_toml())
    assert table["seed"] == 0
    assert (table["group"], table["expect"]) == ("other", "satisfied")
    assert table["log_rate"] == 200.0
    assert table["plant"] == {"timestep": 0.001, "integrator": "mujoco", "limit_speeds": True}
    still = [0.0, 0.0, 0.0]
    at_rest = {"position": still, "euler": still, "velocity": still, "body_rates": still}
    assert table["initial"] == {**at_rest, "cold": False, "on_reference": False}
    law = Assembly(parse_scenario(scenario_table())).resolved.scenario.controller
    assert law.solver == "piqp"


def test_counts_follow_from_the_times() -> None:
    scenario = parse_scenario(scenario_table() | {"duration": 0.9, "control_period": 0.3, "log_rate": 100.0})
    assert (scenario.periods, scenario.steps_per_period, scenario.plant_stride) == (3, 300, 10)


def test_a_scenario_that_is_given_takes_another_seed() -> None:
    assert load_scenario(load_scenario("hover"), seed=7).seed == 7


def test_absent_bounds_are_infinite() -> None:
    limit, *_ = Assembly(
        parse_scenario(scenario_table() | {"constraints": [{"name": "a", "signal": "z", "lower": 1}]})
    ).limits
    assert (limit.lower, limit.upper, limit.start, limit.stop) == (1.0, np.inf, 0.0, np.inf)


def test_a_vehicle_file_beside_the_scenario_is_found_and_stored_by_its_whole_path(tmp_path: Path) -> None:
    (tmp_path / "mine.toml").write_text(vehicle_path("lopes2011").read_text().replace("value = 4.0", "value = 3.0"))
    text = (FLIGHTS / "hover.toml").read_text().replace('"lopes2011"', '"mine.toml"')
    (tmp_path / "course.toml").write_text(text)
    scenario = load_scenario(str(tmp_path / "course.toml"))
    assert scenario.vehicle.file == str(tmp_path / "mine.toml")
    assert Assembly(scenario).vehicle.mass == 3.0


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


# --- what is wrong with the file, a name or a setting --------------------------------------------------------------


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
    assert scenario.controller.input_weights.speed == (1.0, 2.0, 3.0, 4.0)


EVENT = '{type="gust", at=0.1, duration=0.2, velocity=[1.0, 0.0, 0.0]}'


def test_an_entry_without_a_name_is_set_by_its_index() -> None:
    both = f"events=[{EVENT}, {EVENT}]"
    drag = "effects.air.rotor_drag=1e-4"
    scenario = load_scenario("hover", [drag, both, "events.1.at=3", "events.1.velocity=[0, 2, 0]"])
    assert [event.at for event in scenario.events] == [0.1, 3.0]
    with pytest.raises(UnknownNameError, match="'2'"):
        load_scenario("hover", [both, "events.2.at=3"])
    with pytest.raises(ScenarioError, match=r"events\.1\.at"):
        load_scenario("hover", [both, "events.1.at=late"])


def test_a_number_of_a_list_is_set_by_its_index() -> None:
    assert load_scenario("hover", ["initial.euler.2=30.0"]).initial.euler == (0.0, 0.0, 30.0)
    with pytest.raises(UnknownNameError, match="'3'"):
        load_scenario(
            "hover", ["initial.position=[0.0, 0.0, 1.0]", "initial.euler=[0.0, 0.0, 0.0]", "initial.euler.3=1"]
        )


# --- tables in memory ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("path", "value", "rule"),
    [
        ("vehicle.mass", True, "a finite number"),
        ("vehicle.mass", "4.0", "a finite number"),
        ("controller.horizon", 10.0, "a whole number"),
        ("initial.cold", 1, "true or false"),
        pytest.param("controller.kkt_every", 10**5000, "a whole number >= 1; got a whole number of", id="digits"),
        ("initial.position", {1.0, 2.0, 3.0}, "a list of 3 numbers"),
        ("initial", Initial(), "a table"),
    ],
)
def test_values_in_memory_are_as_strict_as_those_of_a_file(path: str, value: object, rule: str) -> None:
    hover = load_scenario("hover")
    with pytest.raises(ScenarioError) as refused:
        hover.replace({path: value})
    assert any(line.startswith(f"{path} must be {rule}") for line in refused.value.problems)


def test_a_change_of_the_tables_afterwards_reaches_no_scenario() -> None:
    table = scenario_table() | {"constraints": [{"name": "a", "signal": "sum", "terms": {"x": 1}, "lower": 1}]}
    scenario = parse_scenario(table)
    table["constraints"][0]["terms"]["x"] = 2
    assert scenario.constraints[0].terms == {"x": 1.0}
    assert isinstance(scenario.constraints[0].lower, float)


def test_tables_within_themselves_are_refused() -> None:
    table = scenario_table()
    table["controller"]["within"] = table
    with pytest.raises(ScenarioError, match="must nest tables and lists at most"):
        Scenario.parse(table)
