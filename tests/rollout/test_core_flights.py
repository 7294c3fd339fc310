"""Flights in the core: the bits of the loop, whatever is drawn; and whatever the core does not fly is the loop's."""

from __future__ import annotations

import gc
from dataclasses import fields
from typing import Any

import numpy as np
import pytest

from quadsim.flight.log import ControlLog, PlantLog
from quadsim.mpc.laws.parts import core_law
from quadsim.rollout.flown import Flight
from quadsim.rollout.rollout import Rollout, fly_for_table
from quadsim.scenarios.loading import load_scenario
from quadsim.scenarios.schema.scenario import Scenario
from quadsim.sim.loop import uncollected

SHORT: dict[str, Any] = {"duration": 1.5, "constraints": []}
LAG = {"effects.rotors": {"rise": 0.02, "fall": 0.02}}
OUTLIERS = {"probability": 0.1, "size": 3.0}
SENSORS = {
    "sensors.position": {"rate": 100, "noise": 0.01},
    "sensors.velocity": {"rate": 100, "noise": 0.05},
    "sensors.attitude": {"rate": 100, "noise": 0.26},
    "sensors.rates": {"rate": 200, "noise": 0.3, "bias_walk": 0.1, "dropout": 0.1, "outliers": OUTLIERS},
}
WIND = {
    "effects.air": {
        "rotor_drag": 3e-4,
        "wind": [2.0, -1.0, 0.0],
        "turbulence": {"wind_speed_20ft": 6.0, "airspeed": 3.0},
    }
}
LOAD = {"effects.load": {"mass_factor": 1.1, "inertia_factor": [0.9, 0.9, 0.9]}}
GUST = {"type": "gust", "at": 0.7, "duration": 0.5, "velocity": [0.0, 2.0, 0.0]}
FAULT = {
    "type": "sensor_fault",
    "at": 0.9,
    "sensor": "position",
    "fault": "bias",
    "offset": [0.1, 0.0, 0.0],
    "duration": 0.4,
}
UNCHECKED = {"kkt_stationarity", "kkt_complementarity", "kkt_dual"}
"""What a flight in the core leaves out."""
CASES: dict[str, dict[str, Any]] = {
    "as it is": {},
    "own method": {"plant.integrator": "rk4"},
    "lag": LAG,
    "sensors": SENSORS,
    "estimator": {**SENSORS, "estimator": {"type": "error_state"}},
    "load": LOAD,
    "all": {**LAG, **SENSORS, **WIND, **LOAD},
    "all by the own method": {**LAG, **SENSORS, **WIND, **LOAD, "plant.integrator": "rk4"},
    "noise": {"effects.thrust_noise": {"loss": 0.05, "deviation": 0.1}},
    "disturbance": {"effects.disturbance": {"force": [0.3, 0.0, 0.0], "force_noise": 0.01}},
    "gust and fault": {**SENSORS, **WIND, "events": [GUST, FAULT]},
    "no parts": {"controller.soft": None, "controller.offset_free": None, "controller.tightening": None},
    "known delay": {"controller.delay": 0.03},
    "soft rows": {**LAG, **SENSORS, **WIND, "initial.euler": [6.0, 0.0, 0.0]},
    "start aside": {"initial.euler": [4.0, -4.0, 30.0], "initial.position": [0.2, 0.0, -0.1]},
}


def scenario_of(changes: dict[str, Any], name: str = "robust") -> Scenario:
    return load_scenario(name).replace({**SHORT, **changes})


def in_core(scenario: Scenario) -> Flight | None:
    """The flight in the core; it must be one that may be tried there."""
    rollout = Rollout(scenario)
    law = rollout.core_law
    assert law is not None
    return rollout.fly_in_core(law)


def differences(one: Flight, other: Flight) -> set[str]:
    """Fields of the logs that differ by any bit."""
    differing = set()
    for table in (ControlLog, PlantLog):
        name = "control" if table is ControlLog else "plant"
        for field in fields(table):
            a = getattr(getattr(one.log, name), field.name)
            b = getattr(getattr(other.log, name), field.name)
            if isinstance(a, np.ndarray):
                same = isinstance(b, np.ndarray) and a.dtype == b.dtype and a.tobytes() == b.tobytes()
            else:
                same = a == b
            if not same:
                differing.add(field.name)
    return differing


@pytest.mark.parametrize("case", CASES)
def test_it_has_the_bits_of_the_loop(case: str) -> None:
    scenario = scenario_of(CASES[case])
    flight = in_core(scenario)
    usual = Rollout(scenario).fly()
    assert flight is not None
    assert differences(flight, usual) == UNCHECKED
    # By their numbers as printed, which are exact: some are NaN, which equals nothing.
    assert [repr(vars(finding)) for finding in flight.findings] == [repr(vars(finding)) for finding in usual.findings]
    assert (flight.outcome, flight.reason) == (usual.outcome, usual.reason)
    assert flight.scenario == usual.scenario


def test_it_flies_constraints_that_are_active() -> None:
    """Or nothing above would show that rows, slacks and the search have the same bits."""
    flight = in_core(scenario_of(CASES["soft rows"]))
    assert flight is not None
    control = flight.log.control
    assert {"solved", "unconstrained"} == set(control.status)
    assert control.active.max() > 0
    assert control.iterations.max() > 0
    assert control.slack.max() > 0.0


@pytest.mark.parametrize(
    ("name", "changes"),
    [
        ("paper-constrained", {}),
        ("hover", {}),
        ("robust", {"controller.solver": "piqp"}),
        ("robust", {"computation": {"delay": 0.01}}),
        ("robust", {"events": [{"type": "setpoint", "at": 1.0, "x": 1.0}]}),
        ("robust", {"events": [{"type": "controller", "at": 1.0, "fields": {"horizon": 30}}]}),
        ("robust", {"effects.ground": {"contact": True}, "initial.position": [0.0, 0.0, 1.0]}),
    ],
)
def test_what_needs_more_than_the_core_is_the_loops(name: str, changes: dict[str, Any]) -> None:
    scenario = scenario_of(changes, name)
    with Rollout(scenario) as rollout:
        assert rollout.core_law is None
    assert differences(fly_for_table(scenario), Rollout(scenario).fly()) == set()


def test_users_code_is_the_loops() -> None:
    scenario = scenario_of({})
    with Rollout(scenario, forces=[lambda time, state: np.zeros(6)]) as rollout:
        assert rollout.core_law is None


@pytest.mark.parametrize(
    "changes",
    [
        {"controller.soft": None, "controller.tightening": None, "initial.euler": [20.0, 0.0, 0.0]},
        {"lost.distance": 0.01, **WIND},
        {"initial.euler": [0.0, 0.0, -170.0], "initial.body_rates": [0.0, 0.0, -200.0]},
    ],
    ids=["no answer", "lost", "turned away"],
)
def test_it_gives_up_what_does_not_go_as_usual(changes: dict[str, Any]) -> None:
    scenario = scenario_of(changes)
    assert in_core(scenario) is None
    again = fly_for_table(scenario)
    usual = Rollout(scenario).fly()
    assert differences(again, usual) == set()
    assert (again.outcome, again.reason) == (usual.outcome, usual.reason)


def test_it_gives_up_an_answer_that_violates_the_problem(monkeypatch: pytest.MonkeyPatch) -> None:
    scenario = scenario_of({})
    assert in_core(scenario) is not None
    monkeypatch.setattr(core_law, "INFEASIBLE", -1.0)
    assert in_core(scenario) is None


def test_a_pass_of_the_collector_spares_what_an_outer_block_froze() -> None:
    gc.unfreeze()  # what another test of this process may have frozen
    with uncollected():
        frozen = gc.get_freeze_count()
        assert frozen > 0
        with uncollected():
            pass
        assert gc.get_freeze_count() == frozen
    assert gc.get_freeze_count() == 0
