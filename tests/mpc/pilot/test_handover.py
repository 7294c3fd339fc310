"""A controller that takes over goes on from the one before it."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import pytest

from quadsim.flight.log import FlightLog
from quadsim.rollout.rollout import Rollout
from quadsim.scenarios.loading import load_scenario
from quadsim.state import Array

DISTURBED = ["effects.disturbance={force=[0.4, -0.3, 0.0], torque=[0.0, 0.0, 0.01]}", "effects.load.mass_factor=1.1"]
LAWS: dict[str, tuple[str, list[str], dict[str, Any]]] = {
    "robust": ("robust", DISTURBED, {"horizon": 50}),
    "robust, another weight": ("robust", DISTURBED, {"output_weights.yaw": 100.001}),
    "constrained": ("paper-constrained", [], {"horizon": 50}),
    "nonlinear": ("nonlinear", [], {"iterations": 1}),
    "pid": ("hover", [*DISTURBED, "controller={type='pid', horizon=20}"], {"horizon": 20}),
    "geometric": ("hover", [*DISTURBED, "controller={type='geometric', horizon=20}"], {"horizon": 20}),
}


def flown(name: str, fields: dict[str, Any], changes: list[str], *, periods: int = 60, switch: int = 40) -> FlightLog:
    with Rollout(load_scenario(name, changes)) as started:
        while started.k < periods:
            if fields and started.k == switch:
                started.apply({"type": "controller", "fields": fields})
            started.step()
        return started.flight().log


def jump(log: FlightLog, other: FlightLog) -> Array:
    return np.abs(log.control.speeds - other.control.speeds).max(axis=1)


@cache
def unchanged(law: str) -> FlightLog:
    """The flight without a change."""
    name, changes, _ = LAWS[law]
    return flown(name, {}, changes)


@pytest.mark.parametrize("law", LAWS)
def test_the_same_numbers_make_no_bump(law: str) -> None:
    name, changes, fields = LAWS[law]
    away = jump(flown(name, fields, changes), unchanged("robust" if law.endswith("another weight") else law))
    assert away[:40].max() == 0.0
    assert away[40:].max() < 1e-3  # [rad/s]; solvers start cold, and so round otherwise


def test_without_what_was_learnt_there_is_one(monkeypatch: pytest.MonkeyPatch) -> None:
    """The test above if nothing were handed over: the observer restarts."""
    monkeypatch.setattr("quadsim.mpc.pilot.pilot.Pilot.adopt", lambda self, previous: None)
    name, changes, fields = LAWS["robust"]
    assert jump(flown(name, fields, changes), unchanged("robust"))[40:].max() > 0.5


def test_another_kind_of_controller_takes_over_the_disturbance() -> None:
    """From nonlinear to robust MPC and on to PID: each flies on, with plans of its own length."""
    changes = [*DISTURBED, "controller.offset_free={}"]
    with Rollout(load_scenario("robust", changes)) as started:
        while started.k < 60:
            started.step()
        learnt = started.loop.controller.law.disturbance  # type: ignore[attr-defined]
        started.apply({"type": "controller", "fields": {"type": "nonlinear", "offset_free": {}, "horizon": 10}})
        started.step()
        taken = started.loop.controller.law.disturbance  # type: ignore[attr-defined]
        np.testing.assert_allclose(taken, learnt, atol=0.1)
        assert np.abs(learnt).max() > 0.05
        started.apply({"type": "controller", "fields": {"type": "pid", "horizon": 12}})
        while started.k < 90:
            started.step()
        log = started.flight().log
    assert log.predicted is not None
    assert log.predicted.shape == (90, 10, 3)
    assert log.reason is None


def test_a_contract_s_level_of_fallback_goes_on() -> None:
    """Long without a position, and level hover's time is over: it descends, before and after a change."""
    events = "events=[{type='sensor_fault', sensor='position', fault='nan', at=1.0, duration=3.0}]"
    with Rollout(load_scenario("robust", [events, "controller.fallback.hover=0.3"])) as started:
        while started.k < 60:
            started.step()
        before = started.loop.last
        started.apply({"type": "controller", "fields": {"output_weights.x": 11.0}})
        after = started.step()
    assert before is not None
    assert before.command.fallback == after.command.fallback == 3
