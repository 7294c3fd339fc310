"""examples/casadi_mpc.py: a user's nonlinear MPC, written with CasADi, flies and is audited as any controller."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import casadi as cs
import numpy as np
import pytest

import quadsim
from quadsim import mpc

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"
SCENARIO = str(EXAMPLES / "casadi_mpc.toml")


@pytest.fixture(autouse=True)
def _importable(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.syspath_prepend(EXAMPLES)
    yield
    sys.modules.pop("casadi_mpc", None)


def test_its_model_linearised_at_hover_is_ours() -> None:
    """But for the chain from a rotor to x, whose terms of third order in the period its one step has in part."""
    import casadi_mpc

    vehicle = quadsim.load_vehicle("hummingbird")
    h = 0.05
    x = cs.SX.sym("x", 12)
    w = cs.SX.sym("w", 4)
    after = casadi_mpc.after(vehicle, h, x, w)
    jacobians = cs.Function("jacobians", [x, w], [cs.jacobian(after, x), cs.jacobian(after, w), after])
    A, B, hover = (np.array(part) for part in jacobians(np.zeros(12), np.ones(4)))
    ours = mpc.hover_model(vehicle, h)
    np.testing.assert_allclose(hover, 0.0, atol=1e-12)
    np.testing.assert_allclose(A, ours.A, atol=1.001 * 9.81 * h**3 / 12.0)
    at_once = [2 * i for i in range(2, 6)] + [2 * i + 1 for i in range(2, 6)]  # z, roll, pitch, yaw and their rates
    np.testing.assert_allclose(B[at_once] / vehicle.hover_speed, ours.B[at_once], rtol=1e-9, atol=1e-15)


def test_it_flies_the_figure_eight_within_its_bounds() -> None:
    flight = quadsim.fly(quadsim.load(SCENARIO).replace({"duration": 6.0}), progress=False)
    names = {finding.limit.name for finding in flight.audit}
    assert names >= {"roll", "pitch", "speed", "slew", "hold_x", "hold_y", "hold_z"}
    assert (flight.outcome, flight.solver) == ("satisfied", "ipopt")
    assert "no_plan" not in flight.logged
    assert max(flight.metrics[f"rmse.{axis}"] for axis in "xyz") < 0.03
    assert np.ptp(flight.state["x"]) > 1.9


def test_it_is_audited_by_its_own_bounds() -> None:
    """Of 3 deg, which are too few for this course: it stays within them, strays, and that is what is reported."""
    hold = {"name": "hold", "signal": "x_error", "lower": -0.1, "upper": 0.1}
    changes = {"controller.settings.tilt": 3.0, "duration": 4.0, "constraints": [hold]}
    scenario = quadsim.load(SCENARIO).replace(changes)
    flight = quadsim.fly(scenario, progress=False)
    findings = {finding.limit.name: finding for finding in flight.audit}
    assert (findings["pitch"].limit.lower, findings["pitch"].limit.upper) == (-3.0, 3.0)
    assert flight.outcome == "violated"
    assert not findings["hold"].satisfied
    assert findings["pitch"].worst_margin > -0.2


def test_without_a_plan_it_flies_on_and_says_so() -> None:
    """A start at 30 deg of roll, which no step can bring within 15."""
    scenario = quadsim.load(SCENARIO).replace({"initial.euler": [30.0, 0.0, 0.0], "duration": 0.1})
    flight = quadsim.fly(scenario, progress=False)
    assert flight.logged["no_plan"][0] == 1.0
    assert flight.outcome == "violated"
