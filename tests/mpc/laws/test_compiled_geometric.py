"""The geometric law in C against its equations in NumPy."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy_geometric import NumpyGeometric, target_of_motion
from numpy_ramp import NumpyRamp
from scipy.spatial.transform import Rotation

from quadsim.controller import Phase, StepInputs
from quadsim.mpc.estimate.disturbance import RampSettings
from quadsim.mpc.laws.geometric import Geometric, GeometricController, Integrals
from quadsim.mpc.laws.parts.attitude import Measured, motion_of
from quadsim.mpc.laws.parts.preview import Target, differentiator, target_of
from quadsim.mpc.problem.flatness import motion_along
from quadsim.mpc.tables.commands import TargetBounds
from quadsim.rotation import euler_to_quaternion
from quadsim.state import EULER, Array
from quadsim.vehicle import Vehicle

PERIOD = 0.02
LAGS = (0.02, 0.035, 0.04, 0.1)
LAWS: dict[str, dict[str, Any]] = {
    "rotors": {"integral": True},
    "rotors fed forward": {"feedforward": True, "drag": (0.3, 0.2, 0.1), "moment": True},
    "rates": {"commands": "rates"},
    "rates fed forward": {"commands": "rates", "feedforward": True, "drag": (0.3, 0.3, 0.1), "integral": True},
    "rates with other drags": {"commands": "rates", "feedforward": True, "drag": (0.3, 0.1, 0.0)},
    "attitude": {"commands": "attitude"},
    "attitude fed forward": {"commands": "attitude", "feedforward": True},
}


@pytest.fixture
def heavy(vehicle: Vehicle) -> Vehicle:
    """With a full matrix of inertia and a moment of the air."""
    Ixx = vehicle.inertia[0]
    return replace(
        vehicle,
        inertia=(Ixx, 1.1 * Ixx, 1.5 * Ixx),
        products_of_inertia=(0.05 * Ixx, -0.1 * Ixx, 0.15 * Ixx),
        rotor_moment=(2e-5, -3e-5),
        inflow_moment=(3e-3, -4e-3),
        rate_damping=(0.1, 0.2, 0.3),
        inflow=3e-3,
    )


def settings_of(law: str) -> Geometric:
    table = LAWS[law]
    return Geometric(**table, **({"inner_lag": LAGS} if "commands" in table else {}))


def drawn(rng: np.random.Generator) -> tuple[Measured, Target, Integrals, tuple[Array, Array, Array]]:
    """A motion, a target, whose heading is a direction in one of three draws, integrals and a disturbance.

    In one of three draws the target is so far away that the tilt is limited.
    """
    far = rng.integers(3) == 0
    motion = Measured(
        position=rng.normal(size=3) * (10.0 if far else 0.2),
        velocity=rng.normal(size=3),
        attitude=Rotation.from_rotvec(rng.normal(size=3)).as_matrix(),
        rates=rng.normal(size=3),
        yaw=float(rng.uniform(-4.0, 4.0)),
    )
    yaw, yaw_rate, yaw_acceleration = rng.normal(size=3).tolist()
    target = Target(
        **dict(zip(("position", "velocity", "acceleration", "jerk", "snap"), rng.normal(size=(5, 3)), strict=True)),
        **{"yaw": yaw, "yaw_rate": yaw_rate, "yaw_acceleration": yaw_acceleration},
        heading=rng.normal(size=(3, 3)) if rng.integers(3) == 0 else None,
    )
    integrals = Integrals(translation=rng.normal(size=3), rotation=rng.normal(size=3))
    return motion, target, integrals, tuple(rng.normal(size=(3, 3)))


@pytest.mark.parametrize("name", LAWS)
def test_the_core_has_the_numbers_of_the_equations(heavy: Vehicle, name: str) -> None:
    settings = settings_of(name)
    rng = np.random.default_rng(7)
    law = GeometricController(heavy, PERIOD, settings)
    check = NumpyGeometric(heavy, PERIOD, settings)
    for _ in range(60):
        motion, target, integrals, disturbance = drawn(rng)
        results = [
            (each.wrench if settings.commands == "rotors" else each.targets)(motion, target, integrals, disturbance)
            for each in (law, check)
        ]
        (command, desired), (expected, attitude) = results
        np.testing.assert_allclose(command, expected, rtol=1e-9, atol=1e-9)
        for part, equation in vars(attitude).items():
            np.testing.assert_allclose(getattr(desired, part), equation, rtol=1e-9, atol=1e-9)
        after, sums = (each.integrate(integrals, motion, target, attitude) for each in (law, check))
        np.testing.assert_allclose(after.translation, sums.translation, atol=1e-12)
        np.testing.assert_allclose(after.rotation, sums.rotation, atol=1e-12)


def test_the_core_s_targets_are_those_of_the_differentiators(vehicle: Vehicle) -> None:
    """Of a preview, whose yaw may jump by whole turns, and of any number of samples of a course."""
    preview = np.cumsum(np.full((10, 4), 0.05), axis=0)
    preview[:, 3] += 3.0
    path = np.array([[np.sin(0.3 * k), np.cos(0.2 * k), 0.1 * k] for k in range(12)])
    motion = motion_along(path, np.gradient(path, axis=0), np.zeros((12, 3)), period=PERIOD, vehicle=vehicle)
    jumping = preview.copy()
    jumping[4:, 3] -= 2.0 * np.pi
    for settings, degree in ((Geometric(), 2), (Geometric(feedforward=True), 4)):
        law = GeometricController(vehicle, PERIOD, settings)
        expected = target_of(preview, differentiator(10, PERIOD, degree=degree))
        for reference in (preview, jumping):
            check_target(law.target(reference), expected)
    for first in range(12):
        rest = motion.after(first)
        check_target(law.target(preview, rest), target_of_motion(rest, np.zeros(3), PERIOD), of_yaw=False)


def check_target(target: Target, expected: Target, *, of_yaw: bool = True) -> None:
    for name, value in vars(expected).items():
        if value is not None and (of_yaw or "yaw" not in name):
            scale = float(np.abs(value).max())
            np.testing.assert_allclose(getattr(target, name), value, rtol=1e-8, atol=1e-9 + 1e-8 * scale)


@pytest.mark.parametrize("quaternions", [True, False])
def test_a_law_of_rates_is_its_parts_period_by_period(vehicle: Vehicle, quaternions: bool) -> None:
    """Observer, law, scale, bounds and integrals in one call; on the ground nothing is learnt or summed."""
    weight = vehicle.mass * vehicle.gravity
    rng = np.random.default_rng(11)
    bounds = TargetBounds(thrust=(0.7 * weight, 1.3 * weight), body_rate=120.0)
    observing = RampSettings(thrust_scale=True)
    settings = Geometric(
        **{"commands": "rates", "inner_lag": LAGS, "feedforward": True, "integral": True, "drag": (0.3, 0.2, 0.1)},
        disturbance=observing,
        target_bounds=bounds,
    )
    law = GeometricController(vehicle, PERIOD, settings)
    check = NumpyGeometric(vehicle, PERIOD, settings)
    hover = np.array([weight, 0.0, 0.0, 0.0])
    ramp = NumpyRamp(
        observing,
        vehicle,
        PERIOD,
        drag=np.array(settings.drag),
        quadratic_drag=np.zeros(3),
        moment=False,
        thrust_lag=LAGS[0],
        acting=hover[:1],
    )
    law.reset(hover)
    actuators = bounds.actuators(vehicle)
    integrals = Integrals(translation=np.zeros(3), rotation=np.zeros(3))
    operator = differentiator(settings.horizon, PERIOD, degree=4)
    command = hover
    held = 0
    for k in range(60):
        flying = k >= 5
        state = rng.normal(size=12) * 0.02
        reference = np.full((settings.horizon, 4), 0.001) * k
        attitude = euler_to_quaternion(state[list(EULER)]) if quaternions else None
        now = StepInputs(
            time=k * PERIOD, attitude=attitude, acting=command, phase=Phase.FLYING if flying else Phase.ARMED
        )
        motion = motion_of(state, attitude)
        target = target_of(reference, operator)
        disturbance = (np.zeros(3), np.zeros(3), np.zeros(3))
        kappa = 1.0
        if flying:
            ramp.update(k > 5, motion.velocity, motion.attitude, motion.rates, command[:1])
            disturbance = ramp.foreseen(0.5 * PERIOD)
            kappa = ramp.scale
        else:
            ramp.acting = command[:1]
        demanded, desired = check.targets(motion, target, integrals, disturbance)
        demanded[0] /= kappa
        expected = np.clip(demanded, actuators.u_min, actuators.u_max)
        if flying and np.array_equal(expected[:3], demanded[:3]):
            integrals = check.integrate(integrals, motion, target, desired)
        else:
            held += flying
        command = law.step(now, state, reference).speeds
        np.testing.assert_allclose(command, expected, rtol=1e-7, atol=1e-7)
        np.testing.assert_allclose(law.integrals.translation, integrals.translation, atol=1e-9)
    assert 0 < held < 55
    assert integrals.translation.any()


@pytest.mark.parametrize("commands", ["rotors", "rates"])
def test_a_restart_after_no_number_is_one_after_the_first_command(vehicle: Vehicle, commands: Any) -> None:
    """Without the fallback contract, too: otherwise the observer would never have a number again."""
    lags = (0.02, 0.02, 0.02, 0.05) if commands == "rates" else None
    settings = Geometric(commands=commands, inner_lag=lags, disturbance=RampSettings())
    controller = GeometricController(vehicle, 0.02, settings)
    assert controller.observer is not None
    controller.reset(np.full(4, np.nan))
    first = vehicle.mass * vehicle.gravity if commands == "rates" else 0.0
    np.testing.assert_array_equal(controller.observer.state.acting, [first, 0.0, 0.0, 0.0])
