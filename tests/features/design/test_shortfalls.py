"""Bounds of a scenario that a vehicle cannot meet, and what `quadsim vehicle` and `quadsim scenario` report."""

from __future__ import annotations

import json
import tomllib

import numpy as np
import pytest

import quadsim
from quadsim.assets import vehicle_path
from quadsim.commands.cli import main
from quadsim.console.results import EXIT_DONE
from quadsim.errors import ParameterError
from quadsim.features.design.courses_by_rule import COURSES
from quadsim.features.design.first_scenario import DESIGNED_LAWS, first_scenario
from quadsim.features.design.shortfalls import shortfalls
from quadsim.scenarios.loading import load_scenario, parse_scenario
from quadsim.scenarios.schema.base import fields_of
from quadsim.sim.autopilot import AutopilotSettings
from quadsim.sim.effects import Disturbance
from quadsim.vehicle import ARMS, OPTIONAL_PARAMETERS, THRUST, VEHICLE_UNITS, Vehicle, load_vehicle

TEMPLATE = quadsim.vehicle_report(template=True).content
HUMMINGBIRD, LOPES = (load_vehicle(vehicle_path(name)) for name in ("hummingbird", "lopes2011"))


def test_hover_beyond_what_the_scenario_allows_is_reported_in_numbers() -> None:
    stated = ["constraints.speed.lower=0.0", "constraints.speed.upper=250.0"]
    result = shortfalls(load_scenario("hover", stated), HUMMINGBIRD)
    assert result[0].startswith("controller.input_bounds.speed: ")
    assert "453.2 rad/s" in result[0]
    assert "3.85 s" in result[1]
    assert result[2].startswith("constraint speed: ")


def test_each_other_bound_that_is_missed_has_a_line() -> None:
    scenario = load_scenario("robust", ["controller.rotor_lag=vehicle", "controller.output_bounds.roll=[-60.0, 60.0]"])
    result = shortfalls(scenario, LOPES)
    assert any(line.startswith("controller.output_bounds.roll: ") and "53.5 deg" in line for line in result)
    assert any(line.startswith("controller.rotor_lag ") for line in result)
    demanding = load_scenario("hummingbird-figure-eight", ["controller.input_bounds.speed=[460.0, 900.0]"])
    result = shortfalls(demanding, HUMMINGBIRD)
    assert "460" in result[0]
    assert "900 rad/s" in result[1]
    assert "838" in result[1]
    lqr = load_scenario("hover", ["controller={ type = 'lqr', tilt = 70.0 }"])
    assert [line.partition(":")[0] for line in shortfalls(lqr, LOPES)] == ["controller.tilt"]


def test_a_course_that_is_too_fast_is_reported_with_the_speed_at_which_it_fits() -> None:
    fast = load_scenario("hummingbird-figure-eight", ["reference.period=6.0", "duration=12.0"])
    result = shortfalls(fast, HUMMINGBIRD)
    assert len(result) >= 2
    assert "roll" in result[0]
    assert shortfalls(load_scenario("hummingbird-figure-eight"), HUMMINGBIRD) == ()


@pytest.mark.slow("first flights")
@pytest.mark.parametrize("law", DESIGNED_LAWS)
@pytest.mark.parametrize("course", COURSES)
def test_a_first_scenario_suits_its_vehicle(course: str, law: str) -> None:
    made = parse_scenario(first_scenario(HUMMINGBIRD, "hummingbird", course=course, law=law).to_data())
    assert shortfalls(made, HUMMINGBIRD) == ()


def test_the_template_documents_every_parameter() -> None:
    tables = tomllib.loads(TEMPLATE)
    instead = ("rotor_positions", "thrust_of_speed", "thrust_of_throttle")
    assert [*tables] == ["name", "description", *(name for name in VEHICLE_UNITS if name not in instead)]
    numbers = {name: table["value"] for name, table in tables.items() if isinstance(table, dict)}
    for name in instead:
        commented = TEMPLATE.partition(f"# [{name}]\n")[2].partition("\n\n")[0]
        tables[name] = tomllib.loads(commented.replace("# ", ""))
        with pytest.raises(ParameterError, match="other"):
            Vehicle(name="mine", **numbers, **{name: tables[name]["value"]})
        replaced = ARMS if name == "rotor_positions" else THRUST
        kept = {key: value for key, value in numbers.items() if key not in replaced}
        Vehicle(name="mine", **kept, **{name: tables[name]["value"]})
    text = " ".join(TEMPLATE.replace("# ", "").split())
    for name, unit in VEHICLE_UNITS.items():
        assert tables[name]["unit"] == unit
        meaning = (fields_of(Vehicle)[name].description or "").partition("] ")[2]
        assert f"{name}: {meaning} Find it: " in text
    assert text.count("May be left out:") == len(OPTIONAL_PARAMETERS) + 2  # disturbance and autopilot are comments
    disturbance = tomllib.loads(TEMPLATE.partition("# [disturbance]")[2].partition("\n\n")[0].replace("# ", ""))
    assert disturbance.pop("source")
    assert Disturbance(**disturbance).lasting(1e-3, np.random.default_rng(0)) is not None
    autopilot = tomllib.loads(TEMPLATE[TEMPLATE.index("# [autopilot]") :].replace("# ", ""))["autopilot"]
    assert autopilot["source"]
    assert AutopilotSettings(p=tuple(autopilot["p"])).p == (30.0, 30.0, 10.0)


def test_the_command_reports_them_where_a_scenario_is_named(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["vehicle", "hummingbird", "--scenario", "hummingbird-figure-eight", "--json"]) == EXIT_DONE
    assert json.loads(capsys.readouterr().out)["shortfalls"] == []
    assert main(["vehicle", "hummingbird", "--scenario", "hover", "--json"]) == EXIT_DONE
    assert len(json.loads(capsys.readouterr().out)["shortfalls"]) == 2
    assert main(["vehicle", "hummingbird", "--json"]) == EXIT_DONE
    assert "shortfalls" not in json.loads(capsys.readouterr().out)


def test_the_note_on_a_course_stands_once_after_the_verdict(capsys: pytest.CaptureFixture[str]) -> None:
    settings = ["reference.period=6.0", "reference.start=0.0", "duration=4.0"]
    main(["check", "hummingbird-figure-eight", *(part for setting in settings for part in ("--set", setting))])
    printed = capsys.readouterr()
    verdict, _, after = printed.out.partition("4.00 s flown")
    assert "The course" not in verdict + printed.err
    assert after.count("The course") == 1
