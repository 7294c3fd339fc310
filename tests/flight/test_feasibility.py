"""What a course requires of a vehicle: against closed forms, balances of momentum, and every sentence."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from quadsim.flight.feasibility import STENCIL, Demand, assess, demand
from quadsim.rotation import body_to_world, euler_to_body_rates
from quadsim.state import EULER, EULER_RATE, INDEX, POSITION, VELOCITY, Array, tilt
from quadsim.vehicle import Vehicle

PERIOD = 0.01
ROLL = INDEX["roll"]
PITCH = INDEX["pitch"]


def demanded(
    vehicle: Vehicle, course: Callable[[Array], tuple[Array, ...]], *, period: float = PERIOD, seconds: float = 2.0
) -> tuple[Array, Demand]:
    """Times and demand of a course given as t -> x, y, z, yaw."""
    t = period * np.arange(-STENCIL, round(seconds / period) + 1 + STENCIL)
    poses = np.stack(np.broadcast_arrays(*course(t)), axis=1)
    return t[STENCIL:-STENCIL], demand(poses, period, vehicle)


def winding(t: Array) -> tuple[Array, ...]:
    """Something smooth in all four, with large angles."""
    return np.sin(1.5 * t), np.cos(t) + 0.3 * t**2, np.sin(2.0 * t), 0.8 * np.sin(1.1 * t) + t


def test_hover_requires_the_hover_speed_and_nothing_else(vehicle: Vehicle) -> None:
    _, result = demanded(vehicle, lambda t: (0.0 * t, 0.0 * t + 3.0, 0.0 * t - 1.0, 0.0 * t + 0.5))
    np.testing.assert_allclose(result.speeds, vehicle.hover_speed, rtol=1e-12)
    np.testing.assert_allclose(result.state[0], [0, 0, 3, 0, -1, 0, 0, 0, 0, 0, 0.5, 0], atol=1e-15)
    assert not result.torque.any()
    assert not tilt(result.state).any()


def test_a_circle_requires_the_tilt_of_its_centripetal_acceleration(vehicle: Vehicle) -> None:
    """tan(tilt) = v^2 / (r g), where v^2 / r of a sampled circle is r (2 - 2 cos(w h)) / h^2."""
    radius = 2.0
    rate = 1.2
    _, result = demanded(vehicle, lambda t: (radius * np.cos(rate * t), radius * np.sin(rate * t), 0.0 * t, 0.0 * t))
    sampled = radius * (2.0 - 2.0 * math.cos(rate * PERIOD)) / PERIOD**2
    np.testing.assert_allclose(tilt(result.state), math.atan(sampled / vehicle.gravity), rtol=1e-9)
    np.testing.assert_allclose(tilt(result.state), math.atan(radius * rate**2 / vehicle.gravity), rtol=2e-5)
    thrust = vehicle.mass * math.hypot(vehicle.gravity, radius * rate**2)
    np.testing.assert_allclose(result.thrust, thrust, rtol=1e-5)
    np.testing.assert_allclose(np.linalg.norm(result.state[:, VELOCITY], axis=1), radius * rate, rtol=1e-4)


def test_the_thrust_along_body_z_accelerates_the_vehicle_as_required(vehicle: Vehicle) -> None:
    _, result = demanded(vehicle, winding)
    up = body_to_world(result.state[:, EULER])[:, :, 2]
    acceleration = result.thrust[:, None] / vehicle.mass * up - [0.0, 0.0, vehicle.gravity]
    np.testing.assert_allclose(acceleration, result.acceleration, atol=1e-12)
    wrench = result.speeds**2 @ vehicle.allocation.T
    np.testing.assert_allclose(wrench, np.column_stack([result.thrust, result.torque]), atol=1e-9)


def test_the_torque_changes_the_angular_momentum() -> None:
    """d(R J w)/dt = R tau in the world frame, to second order in the period."""
    vehicle = lopsided()

    def imbalance(period: float) -> float:
        _, result = demanded(vehicle, winding, period=period)
        euler = result.state[:, EULER]
        rotation = body_to_world(euler)
        body_rates = euler_to_body_rates(euler, result.state[:, EULER_RATE])
        momentum = np.einsum("kij,kj->ki", rotation, np.array(vehicle.inertia) * body_rates)
        change = (momentum[2:] - momentum[:-2]) / (2.0 * period)
        return float(np.abs(change - np.einsum("kij,kj->ki", rotation, result.torque)[1:-1]).max())

    assert imbalance(0.01) < 0.03 * np.abs(demanded(vehicle, winding)[1].torque).max()
    assert imbalance(0.01) / imbalance(0.005) == pytest.approx(4.0, rel=0.05)


@given(turn=st.floats(-10.0, 10.0))
def test_the_same_course_in_another_direction_requires_the_same(turn: float) -> None:
    def turned(t: Array) -> tuple[Array, ...]:
        x, y, z, yaw = winding(t)
        return math.cos(turn) * x - math.sin(turn) * y, math.sin(turn) * x + math.cos(turn) * y, z, yaw + turn

    _, there = demanded(lopsided(), turned, seconds=0.2)
    _, here = demanded(lopsided(), winding, seconds=0.2)
    np.testing.assert_allclose(there.speeds, here.speeds, rtol=1e-5)


def test_the_demand_at_a_jump_is_left_out(vehicle: Vehicle) -> None:
    poses = np.zeros((14, 4))
    poses[7:, 0] = 1.0
    jumps = np.arange(13) == 6
    left_out = demand(poses, PERIOD, vehicle, jumps=jumps)
    counted = demand(poses, PERIOD, vehicle)
    assert np.abs(counted.acceleration).max() == pytest.approx(1.0 / PERIOD**2)
    assert np.flatnonzero(counted.acceleration[:, 0]).tolist() == [4, 5]
    assert not left_out.acceleration.any()
    assert not left_out.state[:, [*VELOCITY, *EULER, *EULER_RATE]].any()
    np.testing.assert_allclose(left_out.speeds, vehicle.hover_speed)
    assert np.flatnonzero(np.isnan(left_out.slews[:, 0])).tolist() == [2, 3, 4, 5, 6]
    np.testing.assert_array_equal(left_out.state[:, POSITION[0]], poses[2:-2, 0])


def test_a_kink_requires_a_tilt_but_no_torque(vehicle: Vehicle) -> None:
    """A leg at 0.1 m/s that begins at once: the acceleration that gains its speed within one period."""
    t = PERIOD * np.arange(-7, 7)
    poses = np.zeros((14, 4))
    poses[:, 0] = 0.1 * np.maximum(t, 0.0)
    kinks = (t[:-1] <= 0.0) & (t[1:] >= 0.0)
    result = demand(poses, PERIOD, vehicle, kinks=kinks)
    assert tilt(result.state).max() == pytest.approx(math.atan(0.1 / PERIOD / vehicle.gravity))
    np.testing.assert_allclose(result.torque, 0.0, atol=1e-9)
    assert np.abs(demand(poses, PERIOD, vehicle).torque).max() > 10.0


def test_a_course_within_all_limits_is_reported_feasible(vehicle: Vehicle) -> None:
    _, needed = demanded(vehicle, lambda t: (0.2 * np.cos(t), 0.2 * np.sin(t), 0.0 * t, 0.0 * t))
    result = assess(needed, vehicle, bounds={"roll": (-5.73, 5.73), "speed": (0.0, 250.0), "slew": (-10.0, 5.0)})
    assert result.problems == ()
    assert [each in result.sentence for each in ("1.17 deg", "5.73 deg", "0.2 m/s", "192.8")] == [True] * 4
    assert result.thrust_to_weight == pytest.approx(math.hypot(1.0, 0.2 / vehicle.gravity), rel=1e-5)
    assert result.acceleration == pytest.approx(0.2, rel=1e-4)
    assert result.yaw_rate == 0.0


def test_every_limit_and_bound_that_is_left_is_named(vehicle: Vehicle) -> None:
    _, needed = demanded(vehicle, lambda t: (np.sin(2.0 * t), 0.0 * t, np.sin(2.0 * t) * 0.5, 3.0 * t), seconds=6.0)
    bounds = {"roll": (-11.46, 11.46), "vx": (-1.0, 5.0), "yaw_rate": (-57.3, 57.3), "speed": (180.0, 260.0)}
    result = assess(needed, replace(vehicle, speed_max=200.0), bounds={**bounds, "slew": (-0.1, 0.1)}, jumps=(1.0,))
    assert [problem.split(" of ", 1)[1] for problem in result.problems] == [
        "rotor speed (rotor limit 200 rad/s)",
        "roll (limit 11.46 deg)",
        "roll (limit -11.46 deg)",
        "vx (limit -1 m/s)",
        "yaw_rate (limit 57.3 deg/s)",
        "rotor speed (limit 180 rad/s)",
        "rotor speed change per period (limit 0.1 rad/s)",
        "rotor speed change per period (limit -0.1 rad/s)",
    ]
    assert result.problems[0].startswith(f"{needed.speeds.max():.3g} rad/s of ")
    assert result.problems[3].startswith(f"{needed.state[:, INDEX['vx']].min():.3g} m/s of ")
    assert result.sentence == f"The course needs {result.problems[0]}; seven other limits are exceeded, too."
    assert result.yaw_rate == pytest.approx(math.degrees(3.0))
    turned = np.degrees(np.angle(np.exp(1j * needed.state[:, INDEX["yaw"]])))
    assert result.yaw == pytest.approx(np.abs(turned).max())  # nearly three turns are half a turn from zero at most
    within = assess(needed, replace(vehicle, speed_min=0.0, speed_max=1e3), jumps=(1.0,))
    assert within.problems == ()
    assert "at 1 s" in within.sentence
    assert f"{result.yaw:.1f} deg" in within.sentence


@pytest.mark.parametrize(
    ("rate", "bound", "shown"),
    [(114.6, 100.0, "115"), (114.2, 114.1, "114.2"), (40.04, 40.0, "40.04"), (999.96, 900.0, "1000")],
)
def test_a_value_has_the_digits_that_tell_it_from_its_limit(
    vehicle: Vehicle, rate: float, bound: float, shown: str
) -> None:
    _, needed = demanded(vehicle, lambda t: (0.0 * t, 0.0 * t, 0.0 * t, math.radians(rate) * t))
    (problem,) = assess(needed, vehicle, bounds={"yaw_rate": (-bound, bound)}).problems
    assert problem == f"{shown} deg/s of yaw_rate (limit {bound:g} deg/s)"


def test_falling_faster_than_free_is_thrust_downwards(vehicle: Vehicle) -> None:
    _, needed = demanded(vehicle, lambda t: (0.0 * t, 0.0 * t, -t * t * vehicle.gravity, 0.0 * t))
    result = assess(needed, vehicle)
    assert result.tilt == pytest.approx(180.0)


def test_a_torque_beyond_the_thrust_is_not_flyable(vehicle: Vehicle) -> None:
    _, needed = demanded(vehicle, lambda t: (0.0 * t, 0.0 * t, 0.0 * t, 2.0 * np.sin(8.0 * t)))
    result = assess(needed, vehicle)
    most = np.abs(needed.torque[:, 2]).max()  # [N m]; each rotor gives a quarter of it, at d / b per thrust
    least = 0.25 * (vehicle.mass * vehicle.gravity - most / vehicle.drag_to_thrust)
    assert result.thrust_min == pytest.approx(least)
    fast, pulled = result.problems
    assert f"{result.rotor_max:.3g} rad/s" in fast
    assert result.sentence == f"The course needs {fast}; another limit is exceeded, too."
    assert f"{least:.3g} N" in pulled
    assert result.rotor_min == 0.0
    bounded = assess(needed, vehicle, bounds={"speed": (0.0, 250.0)})
    assert bounded.problems == result.problems  # a bound as wide as the limit is not named again


def lopsided() -> Vehicle:
    """A vehicle whose three moments of inertia differ."""
    return Vehicle(
        name="lopsided",
        mass=1.2,
        gravity=9.81,
        inertia=(0.01, 0.02, 0.025),
        arm_length=0.2,
        rotor_azimuths=(0.0, -90.0, 180.0, 90.0),
        rotor_spins=(1, -1, 1, -1),
        thrust_coefficient=1e-5,
        drag_to_thrust=0.02,
        speed_min=0.0,
        speed_max=2000.0,
    )
