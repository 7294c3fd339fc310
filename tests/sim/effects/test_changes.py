"""Pushes, and changes of mass and rotor lag in flight, against closed forms."""

from __future__ import annotations

import math

import numpy as np
import pytest

from quadsim.errors import ParameterError
from quadsim.sim.effects import Effects, Push, PushChange
from quadsim.sim.effects.load import Load, MassChange
from quadsim.sim.effects.rotors import LagChange, RotorDynamics
from quadsim.sim.physics import Integrator
from quadsim.sim.plant import Plant
from quadsim.state import make_state
from quadsim.vehicle import Vehicle

HOLD = 200  # physics steps of 1 ms


def pushed(force: tuple[float, float, float], point: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> PushChange:
    return PushChange(at=0.0, pushes=(Push(at=0.0, duration=1.0, force=force, point=point),))


@pytest.mark.parametrize("integrator", ["mujoco", "rk4"])
def test_a_push_accelerates_by_its_force_while_it_lasts(vehicle: Vehicle, integrator: Integrator) -> None:
    changes = [pushed((1.5, -0.5, 2.0)), PushChange(at=0.1, pushes=())]
    with Plant(vehicle, changes=changes, integrator=integrator) as plant:
        flown = plant.advance(plant.vehicle.hover_speeds, HOLD)
    gained = np.array([1.5, -0.5, 2.0]) / vehicle.mass * 0.1
    np.testing.assert_allclose(flown["physics"][99:, 8:11], np.tile(gained, (HOLD - 99, 1)), atol=1e-12)
    np.testing.assert_array_equal(flown["wrench"][[0, 99, 100]], [[1.5, -0.5, 2.0, 0, 0, 0]] * 2 + [[0.0] * 6])


@pytest.mark.parametrize("integrator", ["mujoco", "rk4"])
def test_a_push_beside_the_centre_turns_the_vehicle(vehicle: Vehicle, integrator: Integrator) -> None:
    """A force along world x at the body's y turns it about z, by the lever arm that the yaw leaves."""
    yaw = 0.7
    arm = 0.2
    force = 0.3
    with Plant(vehicle, changes=[pushed((force, 0.0, 0.0), (0.0, arm, 0.0))], integrator=integrator) as plant:
        plant.reset(make_state(euler=(0.0, 0.0, yaw)))
        flown = plant.advance(plant.vehicle.hover_speeds, 20)
    torque = -arm * force * math.cos(yaw)
    np.testing.assert_allclose(flown["wrench"][0, 5], torque, rtol=1e-3)
    np.testing.assert_allclose(flown["physics"][-1, 13], torque / vehicle.inertia[2] * 0.02, rtol=1e-3)


def test_a_push_of_nothing_changes_no_bit(vehicle: Vehicle) -> None:
    with Plant(vehicle) as plain, Plant(vehicle, changes=[pushed((0.0, 0.0, 0.0))]) as ready:
        for plant in (plain, ready):
            plant.reset(make_state(euler=(0.1, -0.2, 0.3)))
        speeds = plain.vehicle.hover_speeds + np.array([1.0, -2.0, 3.0, 0.5])
        np.testing.assert_array_equal(plain.advance(speeds, HOLD)["physics"], ready.advance(speeds, HOLD)["physics"])
        assert ready.allows([pushed((1.0, 0.0, 0.0))])
        assert not plain.allows([pushed((1.0, 0.0, 0.0))])


def test_another_mass_hovers_no_more(vehicle: Vehicle) -> None:
    """(1 / factor - 1) g upwards; the factor takes the place of the load's, and a reset brings that back."""
    changes = [MassChange(at=0.1, factor=1.25)]
    effects = Effects(load=Load(mass_factor=2.0))
    with Plant(vehicle, effects=effects, changes=changes) as plant:
        for _ in range(2):
            plant.reset(make_state(euler=(0.0, 0.0, 0.0)))
            physics = plant.advance(plant.vehicle.hover_speeds, HOLD)["physics"]
            rises = [(1.0 / factor - 1.0) * vehicle.gravity for factor in (2.0, 1.25)]
            np.testing.assert_allclose(physics[[99, 199], 10], [0.1 * rises[0], 0.1 * sum(rises)], rtol=1e-9)


def test_rotors_follow_by_another_time_constant(vehicle: Vehicle) -> None:
    start = vehicle.hover_speed
    target = vehicle.hover_speed + 20.0
    changes = [LagChange(at=0.0, rise=0.05, fall=0.1), LagChange(at=0.1, rise=0.0, fall=0.0)]
    with Plant(vehicle, changes=changes) as plant:
        speeds = plant.advance(np.full(4, target), HOLD)["speeds"]
        steps = np.arange(100) * 1e-3
        np.testing.assert_allclose(speeds[:100, 0], target + (start - target) * np.exp(-steps / 0.05), rtol=1e-12)
        np.testing.assert_array_equal(speeds[100:], target)


def test_what_is_due_later_may_be_put_otherwise(vehicle: Vehicle) -> None:
    """Rescheduled midway, a plant flies as one scheduled from the start; what is past is not done again."""
    first = MassChange(at=0.05, factor=1.1)
    second = MassChange(at=0.15, factor=0.9)
    with Plant(vehicle, changes=[first, second]) as scheduled, Plant(vehicle, changes=[first]) as later:
        expected = scheduled.advance(scheduled.vehicle.hover_speeds, HOLD)["physics"]
        hover = later.vehicle.hover_speeds
        begin = later.advance(hover, 100)["physics"]
        later.reschedule([first, second])
        np.testing.assert_array_equal(
            np.vstack([begin, later.advance(later.vehicle.hover_speeds, 100)["physics"]]), expected
        )


def test_rotors_with_inertia_are_never_at_once() -> None:
    rotors = RotorDynamics(rise=0.05, fall=0.05, inertia=1e-5)
    assert rotors.lagging(LagChange(at=0.0, rise=0.1, fall=0.2)).fall == 0.2
    with pytest.raises(ParameterError, match="speed"):
        rotors.lagging(LagChange(at=0.0, rise=0.0, fall=0.1))
