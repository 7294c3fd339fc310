"""The JSON Schema of scenario files: it follows the models, without what no TOML file can hold."""

from __future__ import annotations

import tomllib
from typing import Any

import pytest
from jsonschema import Draft202012Validator

from quadsim.assets import read_toml
from quadsim.scenarios.catalogue import scenario_names, scenario_source
from quadsim.scenarios.loading import load_scenario
from quadsim.scenarios.schema.json_schema import scenario_schema

SCHEMA = scenario_schema()
VALIDATOR = Draft202012Validator(SCHEMA)


@pytest.mark.parametrize("name", scenario_names())
def test_the_library_is_valid(name: str) -> None:
    VALIDATOR.validate(read_toml(scenario_source(name)[0]))
    VALIDATOR.validate(tomllib.loads(load_scenario(name).to_toml()))


@pytest.mark.parametrize(
    "wrong",
    [
        {"base": "hover", "duraton": 3.0},
        {"base": "hover", "effects": {"rotors": {"rise": -1.0}}},
        {"base": "hover", "events": [{"type": "explosion", "at": 1.0}]},
        {"base": "hover", "reference": {"type": "circle", "radius": "large"}},
        {"base": 3},
        {"name": "alone"},
    ],
)
def test_what_is_wrong_is_invalid(wrong: dict[str, Any]) -> None:
    assert not VALIDATOR.is_valid(wrong)
    assert VALIDATOR.is_valid({"base": "hover", "effects": {"rotors": {"rise": 0.1}}, "controller": {"horizon": 9}})


def test_a_duration_is_required_where_the_course_has_no_end() -> None:
    table = tomllib.loads(load_scenario("hover").to_toml())
    circle = {"type": "circle", "radius": 1.0, "speed": 1.0}
    del table["duration"]
    assert not VALIDATOR.is_valid(table)
    assert VALIDATOR.is_valid(table | {"reference": circle})


def test_every_table_is_closed_and_described() -> None:
    for name, table in SCHEMA["$defs"].items():
        assert table["additionalProperties"] is False, name
        assert table["description"], name
