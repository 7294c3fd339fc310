"""A small vehicle whose commands take 60 ms over a radio link and leave every 25 ms: up to three are under way."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import quadsim
from quadsim.report.figure import commanded_speeds
from quadsim.rollout.flown import Flight
from quadsim.rollout.reaudit import reaudit
from quadsim.rollout.stored import read_flight
from quadsim.scenarios.schema.scenario import Scenario

pytestmark = pytest.mark.slow("latency")

LINK = 0.06  # [s]
KNOWN = {"controller.delay": LINK}


@pytest.fixture(scope="module")
def late() -> Scenario:
    """The hover made for a measured vehicle, lag and drag included, from 20 cm beside its set-point."""
    made = quadsim.scenario(vehicle="crazyflie2").scenario
    aside = {"x": [{"start": 0.0, "stop": 99.0, "value": 0.0}], "response_time": 0.0}
    changes = {"computation.delay": LINK, "initial.position": [0.2, 0.0, 1.0], "duration": 6.0, "reference": aside}
    settled = {f"constraints.{it.name}.start": 2.0 for it in made.constraints if it.name.startswith("hold")}
    return made.replace({**changes, **settled})


def flown(scenario: Scenario, **changes: Any) -> Flight:
    return quadsim.fly(scenario.replace(changes) if changes else scenario, progress=False)


@pytest.mark.representative("latency")
def test_a_law_that_knows_the_delay_survives_it(late: Scenario) -> None:
    """One that does not overturns; one told of a single period is worse than one told the truth."""
    known = flown(late, **KNOWN)
    told = flown(late, **{"controller.delay": 0.025})
    assert late.control_period == 0.025
    assert known.outcome == "satisfied"
    assert flown(late).outcome == "lost"
    assert known.summary["computation"]["missed"] == 0
    for flight, most in ((known, 1e-3), (told, 0.05)):
        assert np.abs(flight.state["x"][-40:]).max() < most
    assert np.abs(known.state["x"][-40:]).max() < 0.2 * np.abs(told.state["x"][-40:]).max()


def test_without_lag_rotors_turn_as_commanded_60_ms_before(late: Scenario) -> None:
    flight = flown(late, **KNOWN, **{"effects.rotors": None, "controller.rotor_lag": 0.0, "log_rate": 1000.0})
    commands = flight.log.control.speeds
    turning = flight.log.plant.speeds[:-1]
    shifted = np.repeat(commands, 25, axis=0)[: len(turning) - 60]
    np.testing.assert_array_equal(turning[60:], np.clip(shifted, 0.0, flight.vehicle.speed_max))
    np.testing.assert_array_equal(turning[:60], np.full((60, 4), flight.vehicle.hover_speed))


def test_its_run_is_written_drawn_and_audited_again(late: Scenario, tmp_path: Path) -> None:
    flight = flown(late, **KNOWN, duration=3.0)
    flight.save(tmp_path / "run", video=False)
    assert reaudit(tmp_path / "run").satisfied
    commanded = commanded_speeds(read_flight(tmp_path / "run").log)
    assert commanded is not None
    again = flown(flight.scenario)
    assert again.log.plant.state.tobytes() == flight.log.plant.state.tobytes()


def test_random_delays_and_stalls_beyond_a_period_are_reproducible(late: Scenario) -> None:
    slow = {"computation.jitter": 0.02, "events": [{"type": "stall", "at": 1.0, "duration": 0.1}], "duration": 2.0}
    one, two = (flown(late, **KNOWN, **slow) for _ in range(2))
    assert one.log.plant.state.tobytes() == two.log.plant.state.tobytes()
    assert 0 < one.summary["computation"]["missed"] < 80
    assert one.outcome != "lost"
