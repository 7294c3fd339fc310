"""What the vehicle weighs: mass properties against the parallel-axis theorem, and how the plant flies with them."""

from __future__ import annotations

import numpy as np
import pytest

from quadsim.sim.effects import Effects
from quadsim.sim.effects.load import Load, Payload, PayloadDrop, PayloadPickup, mass_properties
from quadsim.sim.plant import Plant
from quadsim.state import make_state
from quadsim.vehicle import Vehicle


def test_inertia_of_many_points_is_the_sum_over_points(vehicle: Vehicle) -> None:
    """The vehicle as six point masses with its moments of inertia, and two payloads: every point by itself."""
    ixx, iyy, izz = vehicle.inertia
    squares = 0.5 * np.array([iyy + izz - ixx, ixx + izz - iyy, ixx + iyy - izz]) / vehicle.mass
    reach = np.sqrt(3.0 * squares)  # of which the mean over the points are x^2, y^2, z^2
    points = [sign * reach[i] * np.eye(3)[i] for i in range(3) for sign in (1.0, -1.0)]
    payloads = [Payload(mass=0.7, position=(0.1, -0.2, -0.3)), Payload(mass=0.2, position=(0.0, 0.4, 0.05))]
    offset = np.array([0.02, -0.01, 0.03])
    masses = np.array([*[vehicle.mass / 6.0] * 6, 0.7, 0.2])
    positions = np.array([*[point + offset for point in points], *[payload.position for payload in payloads]])
    centre = masses @ positions / masses.sum()
    arms = positions - centre
    inertia = sum(m * (r @ r * np.eye(3) - np.outer(r, r)) for m, r in zip(masses, arms, strict=True))
    result = mass_properties(vehicle, Load(centre_of_mass=(0.02, -0.01, 0.03)), payloads)
    assert result.mass == pytest.approx(vehicle.mass + 0.9)
    np.testing.assert_allclose(result.centre, centre)
    np.testing.assert_allclose(result.inertia, inertia, atol=1e-12)


def test_a_heavier_vehicle_sinks_with_the_thrust_of_its_file(vehicle: Vehicle) -> None:
    with Plant(vehicle, effects=Effects(load=Load(mass_factor=1.25))) as plant:
        plant.reset(make_state(position=(0.0, 0.0, 100.0)))
        plant.advance(plant.vehicle.hover_speeds, 1000)
        assert plant.state()[4] == pytest.approx(100.0 - 0.5 * 0.2 * vehicle.gravity, rel=1e-9)


def test_inertia_errors_scale_angular_acceleration(vehicle: Vehicle) -> None:
    speeds = vehicle.hover_speed + np.array([2.0, -1.0, -1.0, 1.0])
    rates = {}
    for factors in ((1.0, 1.0, 1.0), (1.2, 1.1, 0.9)):
        with Plant(vehicle, effects=Effects(load=Load(inertia_factor=factors))) as plant:
            plant.reset(make_state())
            rates[factors] = plant.advance(speeds, 1)["physics"][0, 11:]
    np.testing.assert_allclose(rates[(1.0, 1.0, 1.0)] / rates[(1.2, 1.1, 0.9)], [1.2, 1.1, 0.9], rtol=1e-5)


def test_a_shifted_centre_of_mass_tips_the_vehicle(vehicle: Vehicle) -> None:
    """At hover thrust the body turns by m g c / (I + ...) about its centre of mass, and its origin swings around it."""
    shift = 0.01
    with Plant(vehicle, effects=Effects(load=Load(centre_of_mass=(shift, 0.0, 0.0)))) as plant:
        plant.reset(make_state(position=(0.0, 0.0, 100.0)))
        row = plant.advance(plant.vehicle.hover_speeds, 1)["physics"][0]
    weight = vehicle.mass * vehicle.gravity
    assert row[12] / 1e-3 == pytest.approx(shift * weight / vehicle.inertia[1], rel=1e-5)  # thrust behind the centre
    assert row[10] / 1e-3 == pytest.approx(
        shift * row[12] / 1e-3, rel=1e-5
    )  # the origin is behind the centre: it rises


def test_payload_is_taken_up_and_let_go(vehicle: Vehicle) -> None:
    changes = (
        PayloadPickup(at=0.5, mass=1.0),
        PayloadPickup(at=0.2, mass=1.0),
        PayloadDrop(at=1.0),
    )
    with Plant(vehicle, changes=changes) as plant:
        for _ in range(2):  # the second flight begins as the first did
            plant.reset(make_state(position=(0.0, 0.0, 100.0)))
            slopes = np.diff(plant.advance(plant.vehicle.hover_speeds, 1500)["physics"][:, 10]) / 1e-3
            m = vehicle.mass
            g = vehicle.gravity
            for first, last, carried in ((0, 199, 0.0), (200, 499, 1.0), (500, 999, 2.0), (1000, 1498, 0.0)):
                expected = m * g / (m + carried) - g
                np.testing.assert_allclose(slopes[max(first - 1, 0) : last], expected, rtol=1e-9, atol=1e-9)
