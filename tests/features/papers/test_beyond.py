"""Better than published: below the errors of learned models without learning, and torques that INDI makes up for."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from quadsim.rollout.flown import Flight
from quadsim.state import VELOCITIES

Fly = Callable[..., Flight]
LEARNED = 0.020  # m, published of a learned model on the circle at 8 m/s, with noise
TORQUE = "effects.disturbance.torque=[0.2,-0.1,0.03]"


def error(flight: Flight) -> float:
    assert flight.log.reason is None
    return float(flight.metrics["position_error.mean"])


@pytest.mark.slow("papers")
@pytest.mark.parametrize(
    ("name", "settings", "share"),
    [("torrente-loop8-flatness", (), 0.4), ("torrente-loop8-all", ("controller.disturbance={}",), 0.7)],
    ids=["flatness", "nonlinear"],
)
def test_the_circle_at_8_m_s_is_flown_better_than_by_learned_models(
    fly_once: Fly, name: str, settings: tuple[str, ...], share: float
) -> None:
    """Ten seconds, in which it comes to its full speed, with a share of the published error; whole: make reproduce."""
    flight = fly_once(name, *settings, "seed=3", "duration=10", "constraints=[]")
    assert error(flight) < share * LEARNED
    assert np.linalg.norm(flight.log.control.truth[:, VELOCITIES], axis=1).max() > 8.0


@pytest.mark.slow("papers")
def test_nonlinear_mpc_with_indi_hardly_feels_a_constant_torque(fly_once: Fly) -> None:
    alone = error(fly_once("torrente-loop4-ideal", TORQUE, "duration=3"))
    assert alone > 0.02
    assert error(fly_once("torrente-loop4-ideal", TORQUE, "controller.indi={}", "duration=3")) < 0.02 * alone
