"""Any valid scenario, of random effects, events, sensors, courses and vehicles, flies without raising, and so again.

Flights take 0.2 to 0.4 s at 20 or 50 Hz; effects go from mild ones to such as lose the vehicle.
"""

from __future__ import annotations

import json
import re
import tempfile
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from drawn_events import HAPPENING, kind, number
from hypothesis import given, settings
from hypothesis import strategies as st

from quadsim.errors import InputError
from quadsim.flight.log import FlightLog
from quadsim.flight.parquet import write_log
from quadsim.rollout.flown import summarise
from quadsim.rollout.rollout import Rollout
from quadsim.scenarios.assembly import Assembly
from quadsim.scenarios.loading import parse_scenario
from quadsim.scenarios.preflight import checked
from quadsim.scenarios.schema.scenario import Scenario


def vector(size: float, length: int = 3) -> st.SearchStrategy[list[float]]:
    return st.lists(number(-size, size), min_size=length, max_size=length)


def some(
    fields: dict[str, st.SearchStrategy[Any]], **always: st.SearchStrategy[Any]
) -> st.SearchStrategy[dict[str, Any]]:
    """A table with any of the fields, and some that are always there."""
    return st.fixed_dictionaries(always, optional=fields)


PAYLOAD = some({"position": vector(0.2)}, mass=number(0.001, 5.0))
EFFECTS = some(
    {
        "rotors": some(
            {
                "rise": number(1e-4, 0.3),
                "fall": number(1e-4, 0.3),
                "acceleration": number(10.0, 1e5),
                "inertia": number(0.0, 1e-3),
                "efficiency": st.lists(number(0.0, 1.0), min_size=4, max_size=4),
            }
        ),
        "air": some(
            {
                "rotor_drag": number(0.0, 1e-3),
                "body_drag": st.lists(number(1e-3, 1.0), min_size=3, max_size=3),
                "wind": vector(20.0),
                "turbulence": some({"airspeed": number(0.1, 50.0)}, wind_speed_20ft=number(0.0, 30.0)),
            }
        ),
        "ground": some({"contact": st.booleans(), "effect": st.booleans(), "rotor_radius": number(0.01, 0.2)}),
        "load": some(
            {
                "mass_factor": number(0.5, 3.0),
                "inertia_factor": st.lists(number(0.5, 2.0), min_size=3, max_size=3),
                "centre_of_mass": vector(0.05),
                "payloads": st.lists(PAYLOAD, max_size=2),
            }
        ),
        "disturbance": some(
            {
                "force": vector(20.0),
                "torque": vector(2.0),
                "force_noise": number(0.0, 5.0),
                "torque_noise": number(0, 1),
                "force_deviation": st.lists(number(0.0, 5.0), min_size=3, max_size=3),
                "force_time": st.just([0.01, 0.1, 1.0]),
            }
        ),
        "battery": some(
            {"resistance": number(0.0, 0.5), "charge": number(0.0, 1.0), "exponent": number(0.0, 3.0)},
            cells=st.integers(1, 12),
            capacity=number(1e-3, 10.0),
        ),
    }
)
CONTROLLED = kind("controller", fields=some({"type": st.just("pid")}, horizon=st.integers(5, 30)))
EVENTS = st.lists(
    st.tuples(number(0.0, 0.19), HAPPENING | CONTROLLED).map(lambda drawn: {"at": drawn[0], **drawn[1]}), max_size=3
)
SENSOR = some(
    {
        "bias": number(-1.0, 1.0),
        "bias_walk": number(0.0, 1.0),
        "delay": st.sampled_from([0.0, 0.002, 0.03, 0.2]),
        "dropout": number(0.0, 1.0),
        "outliers": some({}, probability=number(0.0, 1.0), size=number(1.0, 100.0)),
    },
    rate=st.sampled_from([10.0, 100.0, 500.0]),
    noise=number(1e-3, 5.0),
)
SENSED = some(dict.fromkeys(["position", "velocity", "attitude", "rates"], SENSOR))
ESTIMATED = some(dict.fromkeys(["velocity", "rates"], SENSOR), position=SENSOR, attitude=SENSOR)
POINT = some({"yaw": number(-180.0, 180.0)}, position=vector(5.0))
POINTS = st.lists(POINT, min_size=1, max_size=4, unique_by=lambda point: round(sum(point["position"]), 2))
TURN = some({}, start=number(0.0, 0.4), yaw=number(-360.0, 360.0), rate=number(1.0, 400.0))
TURNS = st.lists(TURN, min_size=1, max_size=2, unique_by=lambda turn: turn["start"])
LOOP = {
    "turns": number(1.0, 3.0) | number(-3.0, -1.0),
    "yaw_along_path": st.booleans(),
    "angle": number(-180.0, 180.0),
    "response_time": number(0.0, 2.0),
    "start": number(0.0, 0.3),
}
RAMP = st.sampled_from([0.0, 0.01])
WINDOW = some({}, start=number(-0.1, 0.1), stop=number(0.11, 0.6), value=number(-5.0, 5.0))
COURSES = st.one_of(
    some({"response_time": number(0.0, 2.0), "x": st.lists(WINDOW, max_size=2), "yaw": st.lists(WINDOW, max_size=2)}),
    some({}, type=st.just("waypoints"), speed=number(0.1, 10.0), points=POINTS),
    some({}, type=st.just("minimum_snap"), speed=number(0.1, 10.0), points=POINTS),
    some(LOOP, type=st.just("circle"), ramp=RAMP, radius=number(0.1, 5.0), speed=number(0.1, 10.0)),
    some(LOOP, type=st.just("figure_eight"), ramp=RAMP, length=number(0.1, 5.0), period=number(0.5, 10.0)),
    some({}, type=st.just("yaw_turns"), turns=TURNS.map(lambda turns: sorted(turns, key=lambda turn: turn["start"]))),
)
VEHICLES = {  # the highest speed of its rotors, and how far they may move in a period [rad/s]
    "lopes2011": (250.0, 10.0),
    "crazyflie2": (2500.0, 200.0),
    "hummingbird": (838.0, 50.0),
}


ROBUST = some(
    {
        "soft": st.just({}),
        "offset_free": st.just({}),
        "tightening": st.just({}),
        "heading": st.booleans(),
        "rotor_lag": number(0.01, 0.2) | st.just("vehicle"),
        "delay": number(0.0, 0.02),
        "move_weight": number(0.01, 20.0),
        "fallback": st.sampled_from([{}, {"enabled": False}]),
    }
)


@st.composite
def tables(draw: st.DrawFn) -> dict[str, Any]:
    """Scenario files that are right field by field; what contradicts itself is drawn too."""
    vehicle = draw(st.sampled_from(sorted(VEHICLES)))
    fastest, step = VEHICLES[vehicle]
    period = draw(st.sampled_from([0.05, 0.02]))
    kind = draw(st.sampled_from(["constrained", "unconstrained", "robust", "robust", "lqr", "pid", "geometric"]))
    controller: dict[str, Any] = {"type": kind}
    if kind in ("constrained", "unconstrained", "robust"):
        controller |= {
            "horizon": draw(st.integers(1, 20)),
            "output_weights": {"x": 10.0, "y": 10.0, "z": 100.0, "yaw": 100.0},
            "input_weights": {"speed": 0.01},
        }
    if kind in ("constrained", "robust"):
        controller["output_bounds"] = draw(st.sampled_from([{}, {"roll": [-5.0, 5.0], "pitch": [-5.0, 5.0]}]))
        controller["input_bounds"] = {"speed": [0.0, fastest], "slew": [-2.0 * step, step]}
    if kind == "robust":
        controller |= draw(ROBUST)
    computation = {"delay": number(0.0, 0.1), "jitter": number(0.0, 0.1)}
    if kind in ("constrained", "robust"):
        time = number(0.0, 0.01)
        computation["per_iteration"] = st.fixed_dictionaries({"piqp": time, "core": time})
    optional = {
        "effects": EFFECTS,
        "events": EVENTS,
        "computation": some(computation),
    }
    table = {
        "name": "any",
        "description": "any scenario",
        "duration": round(period * draw(st.integers(4, round(0.2 / period) * 2)), 9),
        "control_period": period,
        "seed": draw(st.integers(0, 2**63 - 1)),
        "vehicle": {"file": vehicle},
        "plant": {"limit_speeds": draw(st.booleans())},
        "reference": draw(COURSES),
        "controller": controller,
        "constraints": [{"name": "roll", "signal": "roll", "lower": -5.0, "upper": 5.0}],
    }
    table |= draw(st.fixed_dictionaries({}, optional=optional))
    table |= draw(
        st.just({})
        | st.fixed_dictionaries({"sensors": SENSED})
        | st.fixed_dictionaries({"sensors": ESTIMATED, "estimator": st.just({"type": "error_state"})})
    )
    ground = table.get("effects", {}).get("ground", {"contact": False})
    if ground.get("contact", True) and draw(st.booleans()):
        table["initial"] = {"cold": draw(st.booleans()), "euler": [0.0, 0.0, draw(number(-180.0, 180.0))]}
    else:
        table["initial"] = {"position": [0.0, 0.0, draw(number(0.5, 2.0))], "euler": draw(vector(44.0))}
        table["initial"] |= {"velocity": draw(vector(5.0)), "body_rates": draw(vector(300.0))}
    return table


def parquet(log: FlightLog, scenario: Scenario) -> dict[str, bytes]:
    """The Parquet files of a flight that no clock writes into, by name."""
    with tempfile.TemporaryDirectory() as directory:
        write_log(Path(directory), log, plant_stride=scenario.plant_stride, metadata={"scenario": scenario.name})
        return {name: (Path(directory) / name).read_bytes() for name in ("flight.parquet", "plant.parquet")}


def accepted(table: dict[str, Any]) -> Scenario | None:
    """The scenario, or None where it is refused by a typed error."""
    try:
        scenario = parse_scenario(table)
        checked(Assembly(scenario))
    except InputError:
        return None
    return scenario


@pytest.mark.representative("any scenario")
@settings(max_examples=3, derandomize=True, database=None)
@given(table=tables())
def test_a_few_valid_scenarios_fly_and_their_resolved_files_fly_them_again(table: dict[str, Any]) -> None:
    flies_and_flies_again(table)


@pytest.mark.slow("any scenario")
@settings(max_examples=25, derandomize=True, database=None)
@given(table=tables())
def test_any_valid_scenario_flies_and_its_resolved_file_flies_it_again(table: dict[str, Any]) -> None:
    flies_and_flies_again(table)


def flies_and_flies_again(table: dict[str, Any]) -> None:
    scenario = accepted(table)
    if scenario is None:
        return
    resolved = Assembly(scenario).resolved.scenario
    reread = parse_scenario(tomllib.loads(resolved.to_toml()))
    assert reread == resolved

    try:
        flight = Rollout(scenario).fly()
    except InputError:  # what only building the controller shows, such as margins wider than their bounds
        return
    again = Rollout(reread).fly()
    control = flight.log.control
    plant = flight.log.plant
    assert parquet(flight.log, scenario) == parquet(again.log, reread)
    assert flight.log.reason == again.log.reason
    assert flight.log.reason is None or re.match(r"at t = \d+\.\d{3} s: \w", flight.log.reason)
    if flight.log.reason is None:
        assert control.t.size == scenario.periods
    assert all(np.all(np.isfinite(rows)) for rows in (control.truth, control.speeds, plant.state, plant.speeds))
    if not any(getattr(each, "fault", None) == "nan" for each in scenario.events):
        assert np.all(np.isfinite(control.state))
    json.dumps(summarise(flight), allow_nan=False)
