"""Scenarios as commented TOML: nothing is lost, everything is stated, equal scenarios give equal texts."""

from __future__ import annotations

import tomllib
from typing import Annotated, Any, Literal

import pytest
from pydantic import BaseModel, Field
from support import scenario_table

from scenarios.build import resolve
from scenarios.loading import load_scenario, parse_scenario
from scenarios.parts.vehicle import build_vehicle
from scenarios.schema.base import fields_of
from scenarios.schema.scenario import Scenario
from scenarios.schema.writing import WIDTH, headline, is_absent, tables_in, to_toml
from scenarios.shipped import scenario_names

EFFECTS = {
    "rotors": {"rise": 0.02, "efficiency": [1.0, 0.9, 1.0, 1.0]},
    "air": {"wind": [1.0, 0.0, 0.0], "turbulence": {"wind_speed_20ft": 7.7}},
    "ground": {"contact": True, "effect": True, "rotor_radius": 0.1},
    "load": {"mass_factor": 1.2, "payloads": [{"mass": 0.1}, {"mass": 0.2, "position": [0.1, 0.0, 0.0]}]},
    "disturbance": {"force": [0.1, 0.0, 0.0], "force_noise": 0.01},
}
EVENTS = [
    {"type": "gust", "at": 0.1, "duration": 0.5, "velocity": [1.0, 2.0, 3.0]},
    {"type": "rotor_loss", "at": 0.2, "rotor": 2, "loss": 0.2},
    {"type": "gust", "at": 0.3, "duration": 0.5, "velocity": [1.0, 2.0, 3.0]},
    {"type": "payload_drop", "at": 0.4},
]
REFERENCES: list[dict[str, Any]] = [
    {"x": [{"start": 0.0, "stop": 0.5, "value": 1.0}]},
    {"type": "waypoints", "points": [{"position": [1.0, 2.0, 3.0]}, {"position": [1.0, 2.0, 4.0], "hold": 2.0}]},
    {"type": "circle", "radius": 2.0, "period": 10.0},
]


def present(value: Any) -> Any:
    """What a file has of a table: what is not absent."""
    if isinstance(value, dict):
        return {key: present(each) for key, each in value.items() if not is_absent(each)}
    return [present(each) for each in value] if isinstance(value, list) else value


def everything(reference: dict[str, Any]) -> Scenario:
    """A scenario with something in every table."""
    table = scenario_table() | {"effects": EFFECTS, "events": EVENTS, "reference": reference}
    return parse_scenario(table | {"computation": {"delay": 0.01}, "group": "air", "expect": "lost"})


def every_table(kind: type[BaseModel], found: dict[type[BaseModel], None]) -> dict[type[BaseModel], None]:
    """A kind of table and all that stand below it."""
    if kind not in found:
        found[kind] = None
        for info in fields_of(kind).values():
            for below in tables_in(info.annotation):
                every_table(below, found)
    return found


SHIPPED = [resolve(scenario, build_vehicle(scenario)) for scenario in map(load_scenario, scenario_names())]
ALL = [*SHIPPED, *map(everything, REFERENCES)]


@pytest.mark.parametrize("scenario", ALL, ids=lambda scenario: f"{scenario.name}-{scenario.reference.type}")
def test_what_is_written_is_read_again_and_written_the_same(scenario: Scenario) -> None:
    text = scenario.to_toml()
    again = parse_scenario(tomllib.loads(text))
    assert again == scenario
    assert again.to_toml() == text
    assert tomllib.loads(text) == present(scenario.model_dump(mode="json"))


@pytest.mark.parametrize("scenario", ALL, ids=lambda scenario: f"{scenario.name}-{scenario.reference.type}")
def test_lines_are_narrow_and_end_without_spaces(scenario: Scenario) -> None:
    lines = scenario.to_toml().splitlines()
    assert [line for line in lines if line != line.rstrip() or ("# " in line and len(line) > WIDTH)] == []


@pytest.mark.parametrize("kind", every_table(Scenario, {}), ids=lambda kind: kind.__name__)
def test_every_field_is_described(kind: type[BaseModel]) -> None:
    """By its own words, or, of a table, by those of its class."""
    assert headline(kind) != headline(BaseModel)
    for name, info in fields_of(kind).items():
        tables = tables_in(info.annotation)
        assert info.description or (tables and all(map(headline, tables))), f"{kind.__name__}.{name}"


class Small(BaseModel):
    """A small table. Not this."""

    start: float = Field(description="[s] begin")
    stop: float | None = Field(default=None, description="[s] end")


class Switch(BaseModel):
    """Turns on."""

    at: float = Field(description="[s] when")
    type: Literal["switch"] = Field(description="which")


class Drop(BaseModel):
    """Lets go."""

    at: float = Field(description="[s] when")
    type: Literal["drop"] = Field(description="which")
    inner: Small | None = None


class Course(BaseModel):
    """Windows."""

    first: list[Small] = Field(description="some windows")
    more: list[Small] = Field(default=[], description="others")


class Whole(BaseModel):
    """Everything."""

    number: float = Field(description="[m] a number")
    gone: float | None = Field(default=None, description="[m] absent")
    off: Small | None = None
    words: dict[str, list[float]] = Field(description="by name")
    table: Small = Field(description="a table " + "of many words " * 9)
    course: Course
    acts: list[Annotated[Switch | Drop, Field(discriminator="type")]] = Field(description="what happens")


def test_the_text_is_as_one_would_write_it() -> None:
    small = Small(start=1.0)
    acts = [Switch(at=1.0, type="switch"), Drop(at=2.0, type="drop", inner=small), Drop(at=3.0, type="drop")]
    whole = Whole(number=0.5, words={"a b": [1.0]}, table=small, course=Course(first=[small] * 6), acts=acts)
    assert to_toml(whole) == (
        "number = 0.5             # [m] a number\n"
        "# gone =                 # [m] absent\n"
        "# [off]                  # A small table. Not this\n"
        "\n"
        '[words]                  # by name\n"a b" = [1.0]\n'
        "\n"
        "[table]\n"
        f"# a table {' '.join(['of many words'] * 7)} of many\n"
        "# words of many words\n"
        "start = 1.0              # [s] begin\n"
        "# stop =                 # [s] end\n"
        "\n"
        "[course]                 # Windows\n"
        "# each {start, stop}: A small table. Not this\n"
        "#   start  [s] begin\n"
        "#   stop   [s] end\n"
        "# some windows\n"
        "first = [\n" + "    {start = 1.0},\n" * 6 + "]\n"
        "more = []                # others\n"
        "\n"
        "# what happens\n"
        "\n"
        "[[acts]]                 # Turns on\n"
        'type = "switch"          # which\n'
        "at = 1.0                 # [s] when\n"
        "\n"
        "[[acts]]                 # Lets go\n"
        'type = "drop"            # which\n'
        "at = 2.0                 # [s] when\n"
        "\n"
        "[acts.inner]             # A small table. Not this\n"
        "start = 1.0              # [s] begin\n"
        "# stop =                 # [s] end\n"
        "\n"
        "[[acts]]\n"
        'type = "drop"\n'
        "at = 3.0\n"
    )


def test_whole_numbers_may_stand_for_numbers() -> None:
    assert parse_scenario(scenario_table() | {"duration": 1}).duration == 1.0
    assert "duration = 1.0 " in parse_scenario(scenario_table() | {"duration": 1}).to_toml()
