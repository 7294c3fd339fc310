"""The library's variants: each is a file of the library with other values of some fields."""

from __future__ import annotations

import tomllib
from functools import cache
from pathlib import Path
from typing import Any

import pytest

from quadsim.errors import FileError, InputError
from quadsim.scenarios import catalogue
from quadsim.scenarios.catalogue import FLIGHTS, VARIANTS, read_variants, scenario_names, variants
from quadsim.scenarios.loading import load_scenario
from quadsim.scenarios.schema.scenario import Scenario
from quadsim.scenarios.schema.settings import get_field

FILES = {path.stem for path in FLIGHTS.glob("*.toml")}


@cache
def shipped(name: str) -> Scenario:
    """A scenario of the library, read once."""
    return load_scenario(name)


def table(name: str) -> dict[str, Any]:
    """Every field of a scenario, but what names and describes it."""
    resolved = tomllib.loads(shipped(name).to_toml())
    return {key: value for key, value in resolved.items() if key not in ("name", "description")}


@pytest.fixture
def written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A table of variants in place of the library's, still to be written."""
    path = tmp_path / VARIANTS.name
    monkeypatch.setattr(catalogue, "VARIANTS", path)
    monkeypatch.setattr(catalogue, "variants", lambda: read_variants(path))
    return path


def test_names_are_of_files_or_of_variants() -> None:
    assert scenario_names() == sorted([*FILES, *variants()])
    assert not FILES & {*variants()}
    assert {row.base for row in variants().values()} <= FILES


@pytest.mark.parametrize("name", variants())
def test_a_variant_is_its_base_with_what_it_sets(name: str) -> None:
    row = variants()[name]
    scenario = shipped(name)
    base = shipped(row.base)
    assert (scenario.name, scenario.description) == (name, row.description)
    assert scenario == base.replace(row.set).altered(name=name, description=row.description)


def test_no_two_scenarios_are_the_same() -> None:
    tables: dict[str, str] = {}
    for name in scenario_names():
        assert tables.setdefault(str(table(name)), name) == name


@pytest.mark.parametrize("name", variants())
def test_every_field_that_a_variant_sets_is_another_than_its_bases(name: str) -> None:
    row = variants()[name]
    before = table(row.base)
    assert not [path for path, value in row.set.items() if get_field(before, path) == value]


def test_a_file_may_have_a_variant_as_its_base(tmp_path: Path) -> None:
    (tmp_path / "mine.toml").write_text('base = "robust-heavy"\nname = "mine"\nseed = 3\n')
    mine = load_scenario(tmp_path / "mine.toml")
    base = shipped("robust-heavy")
    assert mine.effects == base.effects
    assert mine.constraints == base.constraints
    assert (mine.name, mine.seed, mine.group, mine.description) == ("mine", 3, "other", base.description)


ROW = '[light]\nbase = "hover"\ndescription = "A light one"\nset = {{ {} }}\n'


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (ROW.replace("hover", "hovver"), "light.base: no scenario file named 'hovver'; did you mean 'hover'?"),
        (ROW.replace("hover", "robust-lag50"), "light.base: no scenario file named 'robust-lag50'"),
        (ROW.replace("base", "bas"), "light must be a table of base, description, set; got "),
        (ROW.replace("light", "hover"), "hover must not have the name of a file in flights/"),
        (ROW.format(""), "light.set must be a table that is not empty; got {}"),
        (ROW.replace('"A light one"', "3"), "light.description must be a text that is not empty; got 3"),
        ("light = 3", "light must be a table of base, description, set; got 3"),
    ],
)
def test_a_malformed_row_is_named(text: str, message: str, written: Path) -> None:
    written.write_text(text.replace("{{ {} }}", '{ "vehicle.mass" = 3.5 }'))
    with pytest.raises(FileError) as caught:
        load_scenario("light")
    assert str(caught.value).startswith(f"{written}: {message}")


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ('"vehicle.mas" = 3.5', "variants.toml, light: vehicle.mas is not a field of "),
        ('"controller.horizon" = 0', "variants.toml, light: controller.horizon must be a whole number >= 1"),
        ('"constraints.rol.upper" = 3.5', "variants.toml: light.set.constraints.rol.upper: no entry of constraints "),
        (
            '"duration.of" = 3.5',
            "variants.toml: light.set.duration.of: set must be a path to a field; duration has none",
        ),
        ('base = "circle"', "variants.toml, light: base is not a field of the scenario file"),
    ],
)
def test_a_field_that_cannot_be_set_is_named(fields: str, message: str, written: Path) -> None:
    written.write_text(ROW.format(fields))
    with pytest.raises(InputError) as caught:
        load_scenario("light")
    assert message in str(caught.value)
    assert str(caught.value).count("\n") <= 1
