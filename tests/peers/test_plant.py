"""MuJoCo against RotorPy, open loop."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from peers import open_loop
from peers.checks import Check
from peers.open_loop import OpenLoop
from peers.rotorpy_plant import RotorPyPlant, make_multirotor
from uneven import uneven

from quadsim.errors import ParameterError
from quadsim.state import make_state
from quadsim.vehicle import Vehicle


@pytest.fixture(scope="module")
def measured(vehicle: Vehicle) -> OpenLoop:
    return open_loop.measure(vehicle)


def test_both_plants_fly_the_same(measured: OpenLoop, hold: Callable[[Check], None]) -> None:
    assert np.degrees(measured.tilt) > 90.0, "the vehicle stays upright: little of the dynamics is compared"
    for check in measured.checks:
        hold(check)


def test_the_difference_is_of_fourth_order_in_mujocos_step(measured: OpenLoop) -> None:
    """What is left is our integrator's error, and no other model: halving the step divides it by 16."""
    steps = np.log(open_loop.TIMESTEPS)
    for name in ("position", "attitude"):
        errors = np.log([getattr(difference, name) for difference in measured.differences])
        np.testing.assert_allclose(np.diff(errors) / np.diff(steps), 4.0, atol=0.3)


def test_both_fly_an_uneven_vehicle_the_same() -> None:
    """With products of inertia, and hubs anywhere; RotorPy's rotors have one thrust coefficient."""
    vehicle = replace(uneven(), thrust_coefficient=1.5e-5)
    speeds = open_loop.draw_speeds(vehicle, seed=0)
    ours = open_loop.fly_mujoco(vehicle, speeds, 1e-3)
    peer = open_loop.fly_rotorpy(vehicle, speeds)
    assert peer.tilt > np.radians(30.0)
    difference = open_loop.largest_difference([ours], [peer])
    assert max(difference.position, difference.attitude) < 1e-8


def test_a_wrong_inertia_is_seen(measured: OpenLoop) -> None:
    allowed = {check.what: check.allowed for check in measured.checks}
    assert min(measured.betrayal.position, measured.betrayal.attitude) > 1e3 * max(allowed.values())


def test_the_adapter_lands_where_rotorpys_own_step_does(vehicle: Vehicle) -> None:
    speeds = open_loop.draw_speeds(vehicle, seed=0)
    path = open_loop.fly_rotorpy(vehicle, speeds)
    plant = RotorPyPlant(vehicle)
    plant.reset(make_state())
    physics = np.array([plant.advance(held, 50)["physics"][-1] for held in speeds])
    np.testing.assert_allclose(physics[:, 1:4], path.position, rtol=0.0, atol=1e-12)
    np.testing.assert_allclose(physics[:, 0], open_loop.HOLD * np.arange(1, len(speeds) + 1))


def test_another_gravity_is_refused(vehicle: Vehicle) -> None:
    with pytest.raises(ParameterError, match="gravity"):
        make_multirotor(replace(vehicle, gravity=1.62))
