"""The law on SE(3): its feed-forward against finite differences, and recovery from any attitude."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy_geometric import vee
from scipy.spatial.transform import Rotation

from quadsim.assets import vehicle_path
from quadsim.controller import StepInputs
from quadsim.flight.log import FlightLog
from quadsim.mpc.laws.geometric import DesiredAttitude, GeometricController, Integrals
from quadsim.mpc.laws.parts.attitude import Measured, motion_of
from quadsim.mpc.laws.parts.preview import Target
from quadsim.state import make_state, tilt
from quadsim.vehicle import Vehicle, load_vehicle

NONE = Integrals(translation=np.zeros(3), rotation=np.zeros(3))
MOTION = Measured(
    position=np.array([0.3, -0.2, 0.1]),
    velocity=np.array([0.5, 0.4, -0.3]),
    attitude=Rotation.from_euler("ZYX", [0.4, 0.2, -0.3]).as_matrix(),
    rates=np.array([0.3, -0.5, 0.4]),
    yaw=0.4,
)
TARGET = Target(
    position=np.array([0.5, 0.1, 0.3]),
    velocity=np.array([0.2, 0.3, 0.1]),
    acceleration=np.array([0.6, -0.4, 0.2]),
    yaw=0.6,
    yaw_rate=0.7,
    yaw_acceleration=-0.5,
)


def wanted_after(law: GeometricController, vehicle: Vehicle, h: float) -> tuple[np.ndarray, DesiredAttitude]:
    """R_c and the law's rates of it, `h` [s] on, the vehicle having moved under the law's thrust."""
    wrench, _ = law.wrench(MOTION, TARGET, NONE)
    acceleration = wrench[0] / vehicle.mass * MOTION.attitude[:, 2] - np.array([0.0, 0.0, vehicle.gravity])
    motion = replace(
        MOTION,
        position=MOTION.position + h * MOTION.velocity,
        velocity=MOTION.velocity + h * acceleration,
        attitude=MOTION.attitude @ Rotation.from_rotvec(h * MOTION.rates).as_matrix(),
    )
    target = replace(
        TARGET,
        position=TARGET.position + h * TARGET.velocity,
        velocity=TARGET.velocity + h * TARGET.acceleration,
        yaw=TARGET.yaw + h * TARGET.yaw_rate,
        yaw_rate=TARGET.yaw_rate + h * TARGET.yaw_acceleration,
    )
    _, desired = law.wrench(motion, target, NONE)
    return desired.attitude, desired


def test_the_desired_rates_and_their_change_are_those_of_the_wanted_attitude(
    craft: Vehicle, build: Callable[..., Any]
) -> None:
    law = build("geometric", craft)
    h = 1e-5
    now = wanted_after(law, craft, 0.0)[1]
    (R_after, after), (R_before, before) = wanted_after(law, craft, h), wanted_after(law, craft, -h)
    rates = vee(now.attitude.T @ (R_after - R_before) / (2.0 * h))
    assert np.abs(now.rates).max() > 0.1
    np.testing.assert_allclose(now.rates, rates, atol=1e-6)
    np.testing.assert_allclose(now.acceleration, (after.rates - before.rates) / (2.0 * h), atol=1e-5)


def test_thrust_lies_along_the_body_and_torque_leads_to_the_wanted_attitude(
    vehicle: Vehicle, build: Callable[..., Any]
) -> None:
    """Held at rest, Psi falls from any attitude under the moment alone: d/dt of Psi's rate is -e_R' (k_R e_R)."""
    law = build("geometric", vehicle)
    rng = np.random.default_rng(3)
    for attitude in Rotation.random(20, random_state=5).as_matrix():
        motion = replace(MOTION, attitude=attitude, rates=np.zeros(3), velocity=np.zeros(3), position=np.zeros(3))
        here = replace(
            TARGET, position=0.1 * rng.normal(size=3), velocity=np.zeros(3), acceleration=np.zeros(3), yaw_rate=0.0
        )
        wrench, desired = law.wrench(motion, here, NONE)
        at_rest = vee(desired.attitude.T @ attitude)
        ahead = -attitude.T @ desired.attitude @ desired.acceleration
        turning = wrench[1:] / np.array(vehicle.inertia)
        rates_wanted = attitude.T @ desired.attitude @ desired.rates
        np.testing.assert_allclose(turning, -law.k_R * at_rest + law.k_Omega * rates_wanted - ahead, atol=1e-9)


def test_a_force_beyond_the_tilt_limit_is_limited_and_counts_as_constant(
    vehicle: Vehicle, build: Callable[..., Any]
) -> None:
    law = build("geometric", vehicle, tilt=20.0)
    far = replace(TARGET, position=np.array([50.0, 0.0, 0.0]), yaw_rate=0.0, yaw_acceleration=0.0)
    _, desired = law.wrench(MOTION, far, NONE)
    assert math.degrees(math.acos(desired.attitude[2, 2])) == pytest.approx(20.0)
    np.testing.assert_allclose(desired.rates, 0.0, atol=1e-12)
    np.testing.assert_allclose(desired.acceleration, 0.0, atol=1e-12)


def test_a_heading_half_a_turn_away_is_sought_a_quarter_turn_away(vehicle: Vehicle, build: Callable[..., Any]) -> None:
    """Where e_R itself would vanish, it turns with all its might."""
    law = build("geometric", vehicle)
    state = make_state()
    rest = {"position": np.zeros(3), "velocity": np.zeros(3), "acceleration": np.zeros(3)}
    for yaw in (math.pi, -math.pi, 3.0):
        target = Target(**rest, yaw=yaw, yaw_rate=0.0, yaw_acceleration=0.0)
        wrench, _ = law.wrench(motion_of(state), target, NONE)
        assert abs(wrench[3]) == pytest.approx(law.k_R[2] * vehicle.inertia[2])


def test_integrals_stop_at_their_limits(vehicle: Vehicle, build: Callable[..., Any]) -> None:
    law = build("geometric", vehicle, integral=True)
    integrals = NONE
    law.numbers.sigma = 0.5
    law.numbers.sigma_R = 0.25
    for _ in range(200):
        _, desired = law.wrench(MOTION, TARGET, integrals)
        integrals = law.integrate(integrals, MOTION, TARGET, desired)
    np.testing.assert_allclose(np.abs(integrals.translation), 0.5)
    np.testing.assert_allclose(np.abs(integrals.rotation), 0.25)


@pytest.mark.slow("baselines")
@pytest.mark.parametrize(
    ("name", "euler"),
    [
        pytest.param("lopes2011", (120.0, 0.0, 0.0), marks=pytest.mark.representative("baselines")),
        ("hummingbird", (-120.0, 20.0, 90.0)),
        ("lopes2011", (170.0, 0.0, 0.0)),
        ("crazyflie2", (170.0, 0.0, 0.0)),
        ("crazyflie2", (0.0, 80.0, 45.0)),
    ],
)
def test_it_recovers_from_large_angles(
    name: str, build: Callable[..., Any], fly_from: Callable[..., FlightLog], euler: tuple[float, float, float]
) -> None:
    """From 100 m, at rest but tilted: upright within the flight, and back at its place."""
    craft = load_vehicle(vehicle_path(name))
    roll, pitch, yaw = np.radians(euler)
    state = make_state(position=(0.0, 0.0, 100.0), euler=(roll, pitch, yaw))
    controller = build("geometric", craft)
    log = fly_from(controller, craft, state, periods=360, course=np.array([0.0, 0.0, 100.0, yaw]))
    assert log.reason is None
    desired = Rotation.from_euler("Z", yaw).as_matrix()
    psi = [0.5 * (3.0 - np.trace(desired.T @ motion_of(row).attitude)) for row in log.control.truth]
    assert psi[0] > 0.8
    assert psi[-1] < 1e-3
    assert tilt(log.control.truth)[60:].max() < math.radians(75.0)
    assert log.plant.state[:, 4].min() > 0.0
    assert np.abs(log.control.truth[-1, [0, 2]]).max() < 0.5
    assert abs(log.control.truth[-1, 4] - 100.0) < 0.5


def test_the_gyroscopic_torque_of_a_spinning_body_is_compensated(
    hummingbird_like: Vehicle, build: Callable[..., Any]
) -> None:
    """Upright, with errors of rate alone, J Omega' is -J k_Omega Omega and nothing else."""
    law = build("geometric", hummingbird_like)
    inertia = np.array(hummingbird_like.inertia)
    rates = np.array([0.5, -0.4, 0.6])
    motion = Measured(position=np.zeros(3), velocity=np.zeros(3), attitude=np.eye(3), rates=rates, yaw=0.0)
    rest = {"position": np.zeros(3), "velocity": np.zeros(3), "acceleration": np.zeros(3)}
    target = Target(**rest, yaw=0.0, yaw_rate=0.0, yaw_acceleration=0.0)
    wrench, desired = law.wrench(motion, target, NONE)
    resulting = (wrench[1:] - np.cross(rates, inertia * rates)) / inertia
    np.testing.assert_allclose(resulting, desired.acceleration - law.k_Omega * rates, atol=1e-9)


def test_integrals_rest_while_the_rotors_have_no_more(vehicle: Vehicle, build: Callable[..., Any]) -> None:
    """Twenty periods far below the target at full thrust leave nothing to unwind."""
    controller = build("geometric", vehicle, integral=True)
    place = np.zeros((10, 4))
    below = make_state(position=(0.0, 0.0, -30.0))
    for _ in range(20):
        assert controller.step(StepInputs(), below, place).speeds.max() == pytest.approx(vehicle.speed_max)
    np.testing.assert_allclose(
        controller.step(StepInputs(), make_state(), place).speeds, vehicle.hover_speed, rtol=1e-9
    )


@pytest.fixture
def hummingbird_like(vehicle: Vehicle) -> Vehicle:
    """The paper's vehicle with three different moments of inertia."""
    return replace(vehicle, inertia=(0.02, 0.04, 0.05))
