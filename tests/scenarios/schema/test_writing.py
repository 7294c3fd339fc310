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
    stated = Assembly(load_scenario(name))
    for assembly in (stated, stated.recorded):
        text = assembly.to_toml()
        again = parse_scenario(tomllib.loads(text))
        assert again == assembly.scenario
        assert again.ends_with_course == assembly.scenario.ends_with_course
        assert Assembly(again).to_toml() == text
        assert Assembly(again).recorded.to_toml() == stated.recorded.to_toml()


@pytest.mark.parametrize("name", scenario_names())
def test_comments_have_every_derived_value(name: str) -> None:
    assembly = Assembly(load_scenario(name))
    lines = assembly.to_toml().splitlines()
    marks = [i for i, line in enumerate(lines) if "# derived" in line]
    assert marks
    for i in marks:
        value_above = lines[i].startswith("# derived")
        j = next(j for j in range(i, len(lines)) if not value_above or " = " in lines[j] or lines[j].startswith("# ["))
        lines[j] = lines[j].removeprefix("# ")
    resolved = plain(assembly.resolved.scenario)
    resolved["events"] = plain(assembly.scenario)["events"]
    assert tomllib.loads("\n".join(lines)) == resolved


def test_whole_numbers_may_stand_for_numbers() -> None:
    assert parse_scenario(scenario_table() | {"duration": 1}).duration == 1.0
    assert "duration = 1.0 " in parse_scenario(scenario_table() | {"duration": 1}).to_toml()
