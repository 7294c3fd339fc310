"""Scenarios as commented TOML: nothing is lost, everything is stated, equal scenarios give equal texts."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Iterator
from typing import Any, get_origin

import pytest
from support import scenario_table

from quadsim.scenarios.assembly import Assembly
from quadsim.scenarios.catalogue import scenario_names
from quadsim.scenarios.loading import load_scenario, parse_scenario
from quadsim.scenarios.schema.base import fields_of, is_table
from quadsim.scenarios.schema.scenario import Scenario
from quadsim.scenarios.schema.writing import plain, tables_in


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


def fields_below(value: object, kind: type[Any], path: str) -> Iterator[tuple[type[Any], str, str]]:
    """Yield kind of table, its path and name of every field of a table and of those in it, present or absent."""
    for name, field in fields_of(kind).items():
        yield kind, path, name
        below = getattr(value, name, None)
        kinds = (type(below),) if is_table(type(below)) else tables_in(field.annotation)
        if (
            len(kinds) == 1
            and not isinstance(below, list | tuple)
            and get_origin(field.annotation) not in (list, tuple)
        ):
            yield from fields_below(below, kinds[0], f"{path}.{name}".removeprefix("."))


@pytest.mark.parametrize("name", scenario_names())
def test_every_field_is_printed_also_of_absent_tables(name: str) -> None:
    """An absent one where its kind of table first occurs."""
    assembly = Assembly(load_scenario(name))
    printed = set()
    table = ""
    for line in assembly.to_toml().splitlines():
        if heading := re.match(r"(?:# )?\[\[?([\w.]+)\]\]?(?:  #|$)", line):
            table = heading.group(1)
            printed.add((table.rpartition(".")[0], table.rpartition(".")[2]))
        elif field := re.match(r"(?:# )?(\w+) =", line):
            printed.add((table, field.group(1)))
    declared = [*fields_below(assembly.scenario, Scenario, "")]
    there = {(kind, field) for kind, path, field in declared if (path, field) in printed}
    missing = {(path, field) for kind, path, field in declared if (kind, field) not in there}
    assert not missing


def test_whole_numbers_may_stand_for_numbers() -> None:
    assert parse_scenario(scenario_table() | {"duration": 1}).duration == 1.0
    assert "duration = 1.0 " in parse_scenario(scenario_table() | {"duration": 1}).to_toml()
