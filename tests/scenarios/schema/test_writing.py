"""Scenarios as commented TOML: nothing is lost, everything is stated, equal scenarios give equal texts."""

from __future__ import annotations

import tomllib

import pytest
from support import scenario_table

from scenarios.assembly import Assembly
from scenarios.catalogue import scenario_names
from scenarios.loading import load_scenario, parse_scenario
from scenarios.schema.writing import plain


@pytest.mark.parametrize("name", scenario_names())
def test_what_is_written_is_read_again_and_written_the_same(name: str) -> None:
    scenario = Assembly(load_scenario(name)).resolved.scenario
    text = scenario.to_toml()
    again = parse_scenario(tomllib.loads(text))
    assert again == scenario
    assert again.to_toml() == text
    assert tomllib.loads(text) == plain(scenario)


def test_whole_numbers_may_stand_for_numbers() -> None:
    assert parse_scenario(scenario_table() | {"duration": 1}).duration == 1.0
    assert "duration = 1.0 " in parse_scenario(scenario_table() | {"duration": 1}).to_toml()
