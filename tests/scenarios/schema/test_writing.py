"""Scenarios as commented TOML: nothing is lost, everything is stated, equal scenarios give equal texts."""

from __future__ import annotations

import tomllib
from typing import Any

import pytest
from pydantic import BaseModel
from support import scenario_table

from scenarios.build import resolve
from scenarios.loading import load_scenario, parse_scenario
from scenarios.parts.vehicle import build_vehicle
from scenarios.schema.base import fields_of
from scenarios.schema.scenario import Scenario
from scenarios.schema.writing import is_absent, tables_in
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


def test_whole_numbers_may_stand_for_numbers() -> None:
    assert parse_scenario(scenario_table() | {"duration": 1}).duration == 1.0
    assert "duration = 1.0 " in parse_scenario(scenario_table() | {"duration": 1}).to_toml()
