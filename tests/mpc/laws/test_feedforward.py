"""Feed-forward by differential flatness with drag: open loop along the flat inputs, and the law on the trajectory."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy_geometric import desired_attitude
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from quadsim.mpc.laws.geometric import DesiredAttitude, Geometric, GeometricController, Integrals
from quadsim.mpc.laws.parts.attitude import Measured, hat
from quadsim.mpc.laws.parts.preview import Target
from quadsim.mpc.problem.flatness import motion_along
from quadsim.state import Array
from quadsim.vehicle import Vehicle

PERIOD = 0.002
NONE = Integrals(translation=np.zeros(3), rotation=np.zeros(3))
DRAGS = [(0.0, 0.0, 0.0), (0.5, 0.5, 0.2), (0.6, 0.3, 0.1)]
AMPLITUDES = np.array([2.0, 1.5, 0.5])
RATES = np.array([1.1, 1.7, 1.3])
PHASES = np.array([0.3, 1.0, 2.0])


def sine(t: float) -> list[Array]:
    """Position to snap (3,) of a motion of three sines."""
    return [AMPLITUDES * RATES**n * np.sin(RATES * t + PHASES + 0.5 * n * np.pi) for n in range(5)]


def target_at(t: float) -> Target:
    """The three sines, and a heading that turns steadily."""
    position, velocity, acceleration, jerk, snap = sine(t)
    return Target(
        position=position,
        velocity=velocity,
        acceleration=acceleration,
        jerk=jerk,
        snap=snap,
        yaw=0.4 * t,
        yaw_rate=0.4,
        yaw_acceleration=0.0,
    )


def flat(vehicle: Vehicle, drag: Array, t: float) -> tuple[float, DesiredAttitude]:
    """Thrust [N] and attitude along the three sines."""
    m = vehicle.mass
    target = target_at(t)
    force = m * (target.acceleration + np.array([0.0, 0.0, vehicle.gravity])), m * target.jerk, m * target.snap
    momentum = m * target.velocity, m * target.acceleration, m * target.jerk
    c = np.cos(target.yaw)
    s = np.sin(target.yaw)
    heading = np.array([[c, s, 0.0], [-0.4 * s, 0.4 * c, 0.0], [-0.16 * c, -0.16 * s, 0.0]])
    desired = desired_attitude(force, momentum, drag, heading)
    return float(desired.attitude[:, 2] @ (force[0] + drag[2] * momentum[0])), desired


@pytest.mark.parametrize("drag", DRAGS)
def test_open_loop_along_the_flat_inputs_the_vehicle_stays_on_the_trajectory(
    vehicle: Vehicle, drag: tuple[float, float, float]
) -> None:
    """The body with rotor drag, integrated under thrust and torque alone."""
    vehicle = replace(vehicle, inertia=(0.02, 0.03, 0.04))
    D = np.array(drag)
    J = np.array(vehicle.inertia)
    m = vehicle.mass

    def slope(t: float, x: Array) -> Array:
        thrust, desired = flat(vehicle, D, t)
        R = x[3:12].reshape(3, 3)
        v = x[12:15]
        Omega = x[15:]
        torque = J * desired.acceleration + np.cross(desired.rates, J * desired.rates)
        acceleration = thrust / m * R[:, 2] - np.array([0.0, 0.0, vehicle.gravity]) - R @ (D * (R.T @ v))
        turning = (torque - np.cross(Omega, J * Omega)) / J
        return np.concatenate([v, (R @ hat(Omega)).ravel(), acceleration, turning])

    begin = target_at(0.0)
    start = flat(vehicle, D, 0.0)[1]
    x0 = np.concatenate([begin.position, start.attitude.ravel(), begin.velocity, start.rates])
    times = np.linspace(0.0, 3.0, 31)
    flown = solve_ivp(slope, (0.0, 3.0), x0, method="DOP853", t_eval=times, rtol=1e-11, atol=1e-12)
    desired = np.array([sine(t)[0] for t in times])
    np.testing.assert_allclose(flown.y[:3].T, desired, atol=1e-7)


@pytest.mark.parametrize("drag", DRAGS)
def test_on_the_trajectory_the_law_gives_the_flat_torque(vehicle: Vehicle, drag: tuple[float, float, float]) -> None:
    vehicle = replace(vehicle, inertia=(0.02, 0.03, 0.04))
    law = GeometricController(vehicle, PERIOD, Geometric(feedforward=True, drag=drag, tilt=80.0))
    J = np.array(vehicle.inertia)
    for t in (0.0, 0.7, 1.9):
        _, desired = flat(vehicle, np.array(drag), t)
        target = target_at(t)
        on_it = Measured(
            position=target.position,
            velocity=target.velocity,
            attitude=desired.attitude,
            rates=desired.rates,
            yaw=target.yaw,
        )
        wrench, commanded = law.wrench(on_it, target, NONE)
        np.testing.assert_allclose(commanded.attitude, desired.attitude, atol=1e-12)
        torque = J * desired.acceleration + np.cross(desired.rates, J * desired.rates)
        np.testing.assert_allclose(wrench[1:], torque, atol=1e-9 * np.abs(torque).max())
        later, before = (flat(vehicle, np.array(drag), t + ahead)[0] for ahead in (0.5 * PERIOD, 0.0))
        assert wrench[0] == pytest.approx(later, abs=0.05 * abs(later - before))  # of half a period on, to first order


def test_a_motion_s_samples_give_its_derivatives_and_near_its_end_as_many_as_they_can(vehicle: Vehicle) -> None:
    period = 0.02
    samples = [sine(period * k)[:3] for k in range(40)]
    motion = motion_along(*np.array(samples).transpose(1, 0, 2), period=period, vehicle=vehicle)
    law = GeometricController(vehicle, period, Geometric(feedforward=True))
    preview = np.zeros((10, 4))
    result = law.target(preview, motion.after(10))
    desired = sine(10 * period)
    for value, exact, share in zip(
        (result.position, result.velocity, result.acceleration, result.jerk, result.snap),
        desired,
        (1e-12, 1e-7, 1e-5, 1e-3, 2e-2),
        strict=True,
    ):
        np.testing.assert_allclose(value, exact, atol=share * np.abs(exact).max())
    assert result.heading is not None
    w, x, y, z = motion.attitude[10]
    np.testing.assert_allclose(result.heading[0], Rotation.from_quat([x, y, z, w]).as_matrix()[:, 0], atol=1e-12)
    for left in (1, 2, 3, 6):
        near_end = law.target(preview, motion.after(40 - left))
        np.testing.assert_allclose(near_end.position, motion.position[-left], atol=1e-12)
        assert bool(np.any(near_end.acceleration)) == (left >= 3)
        assert bool(np.any(near_end.snap)) == (left >= 5)
