"""A weight on a velocity is one on its error from the course's: a moving course is tracked, by every law and solver."""

from __future__ import annotations

import shutil
from typing import Any

import numpy as np
import pytest
from exported_c import Host, replay

import quadsim
from quadsim.features.export.record import record
from quadsim.scenarios.schema.scenario import Scenario

WEIGHTS = {"x": 10.0, "vx": 50.0, "y": 10.0, "vy": 50.0, "z": 100.0, "yaw": 100.0}
INPUTS = {"input_weights": {"speed": 0.01}}
SHARED = {"horizon": 50, "output_weights": WEIGHTS, **INPUTS}
BOUNDS = {
    "output_bounds": {"roll": [-5.0, 5.0], "pitch": [-5.0, 5.0]},
    "input_bounds": {"speed": [0.0, 250.0], "slew": [-10.0, 5.0]},
}
LAWS: dict[str, dict[str, Any]] = {
    "unconstrained": {"type": "unconstrained", **SHARED},
    **{
        f"constrained by {solver}": {"type": "constrained", "solver": solver, **SHARED, **BOUNDS}
        for solver in ("piqp", "piqp-dense", "daqp", "core")
    },
    "constrained, terminal weight": {"type": "constrained", "terminal": "lqr", **SHARED, **BOUNDS},
    "robust by PIQP": {"type": "robust", "solver": "piqp", "heading": True, **SHARED, **BOUNDS},
    "robust": {"type": "robust", "heading": True, **SHARED, **BOUNDS},
    "nonlinear": {"type": "nonlinear", "weights": {"velocity": 50.0}},
}


def circle(controller: dict[str, Any], **changes: object) -> Scenario:
    """The library's circle at another heading, which a law that mixes up its axes would not survive."""
    start = {"initial.euler": [0.0, 0.0, 0.0]}
    return quadsim.load("circle", start | {"controller": controller, "constraints": []} | changes)


@pytest.mark.parametrize("law", LAWS)
def test_a_circle_is_tracked_with_weights_on_the_velocity(law: str) -> None:
    """The velocity of the circle, 1.2 m/s, would cost a metre if it were wanted at zero."""
    flight = quadsim.fly(circle(LAWS[law]), progress=False)
    assert flight.metrics["rmse.x"] < 2e-3
    assert flight.metrics["rmse.y"] < 2e-3


def test_the_lqr_tracks_it_as_without() -> None:
    """It lags by what it does not feed forward, but by no metre."""
    flight = quadsim.fly(circle({"type": "lqr", "output_weights": WEIGHTS, **INPUTS}), progress=False)
    assert flight.metrics["rmse.x"] < 0.2


def test_a_velocity_desired_at_zero_brakes() -> None:
    flight = quadsim.fly(circle(LAWS["unconstrained"] | {"desired_rates": "zero"}), progress=False)
    assert flight.metrics["rmse.x"] > 0.5


@pytest.mark.parametrize("delay", [0.0, 0.03, 0.12])
def test_a_known_delay_is_no_lag(delay: float) -> None:
    late = {"computation.delay": delay, "controller.delay": delay}
    flight = quadsim.fly(circle(LAWS["robust"]).replace(late), progress=False)
    assert flight.metrics["rmse.x"] < 5e-3


@pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler")
@pytest.mark.parametrize("law", ["unconstrained", "constrained by piqp", "robust"])
def test_the_exported_c_sends_what_flew(law: str) -> None:
    scenario = circle(LAWS[law], duration=9.0)
    flown = record(scenario)
    commands = np.array([reply.command for reply in replay(Host(scenario), flown)])
    np.testing.assert_allclose(commands, flown.command, atol=1e-8)
    assert np.ptp(flown.command) > 0.2
