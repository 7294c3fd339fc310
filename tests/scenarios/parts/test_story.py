"""What happened in flight, in words."""

from __future__ import annotations

from typing import Any, get_args

import pytest

from quadsim.rollout.flight_events import prepared, story
from quadsim.scenarios.assembly import Assembly
from quadsim.scenarios.loading import load_scenario
from quadsim.scenarios.schema.base import fields_of
from quadsim.scenarios.schema.events import Event
from quadsim.scenarios.schema.scenario import Scenario

TEXTS = [
    ({"type": "rotor_loss", "rotor": 2, "loss": 0.2, "duration": 3.0}, "rotor 2 loses 20 % for 3 s"),
    ({"type": "rotor_lag", "rise": 0.03}, "rotors lag by 0.03 s"),
    ({"type": "rotor_lag", "rise": 0.03, "fall": 0.05}, "rotors lag by 0.03 s, 0.05 s downwards"),
    ({"type": "mass", "factor": 1.1}, "the mass is 1.1 times the file's"),
    ({"type": "payload_pickup", "mass": 0.4}, "0.4 kg are picked up"),
    ({"type": "payload_drop"}, "the payloads are dropped"),
    ({"type": "push", "force": [3.0, 4.0, 0.0], "duration": 0.2}, "a push of 5 N for 0.2 s"),
    ({"type": "gust", "velocity": [3.0, 4.0, 0.0], "duration": 2.0}, "a gust of 5 m/s for 2 s"),
    ({"type": "wind", "velocity": [0.0, 2.0, 0.0]}, "the mean wind is 2 m/s"),
    (
        {"type": "sensor_fault", "sensor": "position", "fault": "nan", "duration": 0.5},
        "the position sensor gives no numbers for 0.5 s",
    ),
    ({"type": "stall", "duration": 0.1}, "the computer stalls for 0.1 s"),
    ({"type": "setpoint", "x": 0.5, "yaw": 90.0}, "set-point x 0.5 m, yaw 90 deg"),
    ({"type": "controller", "fields": {"horizon": 30}}, "controller: horizon = 30"),
]


def scenario(events: list[dict[str, Any]]) -> Scenario:
    data = load_scenario("hover", ["effects.air.rotor_drag=1e-4", "effects.load.payloads=[{mass=0.1}]"])
    return data.replace({"events": [{"at": 1.0, **event} for event in events]})


@pytest.mark.parametrize(("event", "text"), TEXTS)
def test_each_kind_is_reported_in_its_words(event: dict[str, Any], text: str) -> None:
    assert story(scenario([event]), 10.0) == [{"time": 1.0, "text": text}]


def test_every_kind_of_event_is_reported() -> None:
    kinds = {get_args(fields_of(kind)["type"].annotation)[0] for kind in get_args(get_args(Event)[0])}
    assert {event["type"] for event, _ in TEXTS} == kinds


def test_many_of_a_kind_are_reported_in_one() -> None:
    pushes = [{"at": 1.0 + 0.1 * i, "type": "push", "force": [1.0 + i, 0.0, 0.0], "duration": 0.1} for i in range(9)]
    entries = story(scenario([*pushes, {"at": 1.35, "type": "stall", "duration": 0.1}]), 10.0)
    assert [entry["text"] for entry in entries] == [
        "4 times until 1.3 s: a push of 1 N for 0.1 s first, a push of 4 N for 0.1 s last",
        "the computer stalls for 0.1 s",
        "5 times until 1.8 s: a push of 5 N for 0.1 s first, a push of 9 N for 0.1 s last",
    ]


def test_what_changes_nothing_or_comes_later_is_not_reported() -> None:
    flown = scenario([{"type": "stall", "duration": 0.1}])
    live = prepared(Assembly(flown))
    assert len(live.events) > 5
    assert [entry["text"] for entry in story(live, 10.0)] == ["the computer stalls for 0.1 s"]
    assert story(flown, 1.0) == []
