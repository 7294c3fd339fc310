"""Targets for an autopilot: the geometric law above an ideal inner loop of first-order lags."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import pytest
from numpy_geometric import attitude_error
from scipy.spatial.transform import Rotation

from quadsim.controller import Phase, StepInputs
from quadsim.errors import ParameterError
from quadsim.flight.log import FlightLog
from quadsim.mpc.estimate.disturbance import RampSettings
from quadsim.mpc.laws.geometric import Geometric, GeometricController, Integrals
from quadsim.mpc.laws.parts.attitude import motion_of
from quadsim.mpc.laws.parts.builders import build
from quadsim.mpc.laws.parts.preview import Target
from quadsim.mpc.problem.model import continuous_model
from quadsim.mpc.tables.commands import TargetBounds
from quadsim.rotation import body_to_euler_rates
from quadsim.state import EULER_RATE, INDEX, VELOCITY, Array, make_state
from quadsim.vehicle import Vehicle

pytestmark = pytest.mark.slow("targets")

PERIOD = 0.02
STEP = 0.005
FAST = (0.02, 0.035, 0.035, 0.1)
SLOW = (0.072, 0.037, 0.037, 0.06)
LAGS = pytest.mark.parametrize("lag", [FAST, SLOW], ids=["fast", "slow"])
COMMANDS = pytest.mark.parametrize("commands", ["rates", "attitude"])
AUTOPILOT = 7.0
"""Gain of the autopilot that takes attitudes [1/s]."""


class Flown(NamedTuple):
    """Of each period: position and velocity (K, 3), tilt (K,) [deg] and target (K, 4 or 8)."""

    position: Array
    velocity: Array
    tilt: Array
    targets: Array


def geometric(
    vehicle: Vehicle, inner_lag: tuple[float, ...], commands: Any = "rates", **others: Any
) -> GeometricController:
    return GeometricController(vehicle, PERIOD, Geometric(commands=commands, inner_lag=inner_lag, **others))


def fly(
    law: GeometricController,
    vehicle: Vehicle,
    course: Any,
    periods: int,
    *,
    lag: tuple[float, ...],
    start: Rotation | None = None,
    velocity: Array | None = None,
    scale: float = 1.0,
    force: Array | None = None,
) -> Flown:
    """A point mass whose thrust and body rates follow targets exponentially; `course` of time gives x, y, z, yaw."""
    m = vehicle.mass
    g = np.array([0.0, 0.0, vehicle.gravity])
    attitude = start or Rotation.identity()
    acting = np.array([m * vehicle.gravity, 0.0, 0.0, 0.0])
    position = course(0.0)[:3].copy()
    v = np.zeros(3) if velocity is None else velocity.copy()
    law.reset(acting)
    left = np.exp(-STEP / np.array(lag))
    share = np.array(lag) / STEP * (1.0 - left)
    flown: list[tuple[Array, Array, float, Array]] = []
    for k in range(periods):
        time = k * PERIOD
        euler = attitude.as_euler("ZYX")[::-1]
        state = make_state(position=tuple(position), euler=tuple(euler))
        state[list(VELOCITY)] = v
        state[list(EULER_RATE)] = body_to_euler_rates(euler, acting[1:])
        reference = np.array([course(time + (i + 1) * PERIOD) for i in range(law.horizon)])
        now = StepInputs(time=time, attitude=np.roll(attitude.as_quat(), 1), body_rates=acting[1:])
        target = law.step(now, state, reference).speeds
        up = float(attitude.as_matrix()[2, 2])
        flown.append((position.copy(), v.copy(), math.degrees(math.acos(min(up, 1.0))), target))
        for _ in range(round(PERIOD / STEP)):
            command = target[:4].copy()
            if target.size == 8:
                desired = Rotation.from_quat(np.roll(target[4:], -1)).as_matrix()
                command[1:] -= AUTOPILOT * attitude_error(attitude.as_matrix(), desired)
            thrust, *rates = command + share * (acting - command)  # means of the step
            acting = command + left * (acting - command)
            half = Rotation.from_rotvec(0.5 * STEP * np.array(rates))
            attitude = attitude * half
            acceleration = scale * thrust / m * attitude.as_matrix()[:, 2] - g + (0.0 if force is None else force)
            position = position + STEP * v + 0.5 * STEP**2 * acceleration
            v = v + STEP * acceleration
            attitude = attitude * half
    return Flown(*(np.array(column) for column in zip(*flown, strict=True)))


def at_rest(time: float) -> Array:
    return np.array([1.0, -2.0, 3.0, 0.4])


def circle(time: float) -> Array:
    """2 m/s on a radius of 2 m."""
    return np.array([2.0 * math.cos(time), 2.0 * math.sin(time), 1.0, 0.3 * time])


def at_hover(law: GeometricController, vehicle: Vehicle, lag: tuple[float, ...]) -> Array:
    """(12,) eigenvalues of the continuous loop at hover: rates follow with the lags, and thrust at once."""
    rest = np.zeros(3)
    target = Target(position=rest, velocity=rest, acceleration=rest, yaw=0.0, yaw_rate=0.0, yaw_acceleration=0.0)
    none = Integrals(translation=rest, rotation=rest)
    h = 1e-5

    def command(state: Array) -> Array:
        return law.targets(motion_of(state), target, none)[0]

    K = np.stack([(command(h * x) - command(-h * x)) / (2.0 * h) for x in np.eye(12)], axis=1)
    A, _ = continuous_model(vehicle)
    A[INDEX["vz"]] = K[0] / vehicle.mass
    for rate, row, tau in zip(EULER_RATE, K[1:], lag[1:], strict=True):
        A[rate] = (row - np.eye(12)[rate]) / tau
    return np.asarray(np.linalg.eigvals(A))


@pytest.mark.representative("targets")
@LAGS
def test_the_inner_loop_makes_the_lag_a_pole_beside_those_of_the_gains(
    vehicle: Vehicle, lag: tuple[float, ...]
) -> None:
    """(lag s^2 + s + k)(s^2 + k_v s + k_x), and k + k_v is that of a loop with this lag and half a period."""
    law = geometric(vehicle, lag)
    gains = law.gains
    pairs = [(1.0, gains.k_v, gains.k_x)] * 3
    pairs += [(tau, 1.0, k) for tau, k in zip(lag[1:], gains.k_attitude, strict=True)]
    expected = np.concatenate([np.roots(pair) for pair in pairs])
    np.testing.assert_allclose(
        np.sort_complex(at_hover(law, vehicle, lag).round(5)), np.sort_complex(expected.round(5)), atol=1e-3
    )
    assert gains.k_attitude[1] + gains.k_v == pytest.approx(0.5 / (0.5 * PERIOD + lag[1]))
    allowed = geometric(vehicle, lag, lag=0.1).gains
    assert allowed.k_attitude == pytest.approx([1.0 / 0.33, 1.0 / 0.33, gains.k_attitude[2]])


@pytest.mark.parametrize(
    ("lag", "commands"),
    [
        pytest.param(FAST, "attitude", marks=pytest.mark.representative("targets")),
        pytest.param(SLOW, "rates", marks=pytest.mark.representative("targets")),
        (FAST, "rates"),
        (SLOW, "attitude"),
    ],
)
def test_it_recovers_from_30_degrees(vehicle: Vehicle, lag: tuple[float, ...], commands: str) -> None:
    law = geometric(vehicle, lag, commands)
    start = Rotation.from_euler("ZX", [0.4, math.radians(30.0)])
    flown = fly(law, vehicle, at_rest, 200, lag=lag, start=start)
    away = np.linalg.norm(flown.position - at_rest(0.0)[:3], axis=1)
    assert flown.tilt[0] == pytest.approx(30.0)
    assert flown.tilt.max() < 30.5
    assert flown.tilt[50:].max() < 5.0
    assert away.max() < 0.2
    assert away[-1] < 1e-3
    np.testing.assert_allclose(flown.targets[-1, :4], [vehicle.mass * vehicle.gravity, 0, 0, 0], rtol=1e-3, atol=1e-2)


@LAGS
@COMMANDS
def test_a_circle_at_2_m_s_is_tracked(vehicle: Vehicle, lag: tuple[float, ...], commands: str) -> None:
    """To 2 mm with feed-forward of jerk and snap, which also leads the lags; to a centimetre without."""
    for feedforward, largest in ((True, 2e-3), (False, 1e-2)):
        law = geometric(vehicle, lag, commands, feedforward=feedforward)
        flown = fly(law, vehicle, circle, 250, lag=lag, velocity=np.array([0.0, 2.0, 0.0]))
        desired = np.array([circle(k * PERIOD)[:3] for k in range(250)])
        assert np.linalg.norm(flown.position - desired, axis=1)[200:].max() < largest


@LAGS
@COMMANDS
def test_an_observed_scale_of_the_thrust_leaves_no_offset(
    vehicle: Vehicle, lag: tuple[float, ...], commands: str
) -> None:
    """With 80 % it sags by g / 4 over k_x, 0.8 (g + k_x e) = g; with its scale observed, and wind, it does not."""
    plain = geometric(vehicle, lag, commands)
    flown = fly(plain, vehicle, at_rest, 200, lag=lag, scale=0.8)
    assert at_rest(0.0)[2] - flown.position[-1, 2] == pytest.approx(0.25 * vehicle.gravity / plain.gains.k_x, rel=0.01)
    observing = geometric(vehicle, lag, commands, feedforward=True, disturbance=RampSettings(thrust_scale=True))
    flown = fly(observing, vehicle, at_rest, 200, lag=lag, scale=0.8, force=np.array([0.8, -0.4, 0.0]))
    np.testing.assert_allclose(flown.position[-1], at_rest(0.0)[:3], atol=1e-4)
    assert np.linalg.norm(flown.position - at_rest(0.0)[:3], axis=1).max() < 0.05
    assert observing.observer is not None
    assert observing.observer.thrust_scale == pytest.approx(0.8, abs=1e-4)


def test_rotors_that_give_less_are_asked_for_more_thrust_and_torque(
    vehicle: Vehicle, build: Callable[..., Any], fly_from: Callable[..., FlightLog]
) -> None:
    weak = replace(vehicle, thrust_coefficient=0.8 * vehicle.thrust_coefficient)  # its torques are in proportion
    law = build("geometric", vehicle, disturbance=RampSettings(thrust_scale=True))
    log = fly_from(law, weak, make_state(), periods=150, course=np.array([0.5, 0.0, 0.0, 0.3]))
    np.testing.assert_allclose(log.control.truth[-1, [0, 2, 4]], [0.5, 0.0, 0.0], atol=2e-3)
    assert law.observer.thrust_scale == pytest.approx(0.8, abs=1e-3)
    np.testing.assert_allclose(law.observer.foreseen(0.0)[2], 0.0, atol=1e-2)


@COMMANDS
def test_the_translation_s_integral_removes_the_offset_and_the_autopilot_has_the_other(
    vehicle: Vehicle, commands: str
) -> None:
    law = geometric(vehicle, FAST, commands, integral=True)
    flown = fly(law, vehicle, at_rest, 700, lag=FAST, scale=0.8)
    np.testing.assert_allclose(flown.position[-1], at_rest(0.0)[:3], atol=2e-3)
    assert not law.integrals.rotation.any()


@pytest.mark.representative("targets")
@COMMANDS
def test_targets_stay_within_their_bounds_and_integrals_hold_there(vehicle: Vehicle, commands: str) -> None:
    weight = vehicle.mass * vehicle.gravity
    target_bounds = TargetBounds(thrust=(0.8 * weight, 1.2 * weight), body_rate=(40.0, 50.0, 20.0))
    bounds = target_bounds.actuators(vehicle)
    law = geometric(vehicle, FAST, commands, target_bounds=target_bounds, integral=True)
    far = np.tile([5.0, -5.0, 10.0, 2.0], (law.horizon, 1))
    start = Rotation.from_euler("ZX", [0.4, math.radians(30.0)])
    flown = fly(law, vehicle, lambda t: far[0] if t else at_rest(t), 100, lag=FAST, start=start)
    assert (flown.targets[:, :4] >= bounds.u_min).all()
    assert (flown.targets[:, :4] <= bounds.u_max).all()
    np.testing.assert_allclose(flown.targets[:, 0].max(), 1.2 * weight)
    law.reset(np.array([weight, 0.0, 0.0, 0.0]))
    for _ in range(20):
        assert law.step(StepInputs(), make_state(position=(0.0, 0.0, -30.0)), 0.0 * far).speeds[0] == 1.2 * weight
    assert not law.integrals.translation.any()


def test_the_commanded_attitude_is_that_in_the_middle_of_the_period(vehicle: Vehicle) -> None:
    """With feed-forward; on the circle it turns by half a period's rates more."""
    state = make_state(position=(2.0, 0.0, 1.0))
    rows = []
    state[INDEX["vy"]] = 2.0
    for feedforward in (False, True):
        law = geometric(vehicle, FAST, "attitude", feedforward=feedforward)
        reference = np.array([circle((i + 1) * PERIOD) for i in range(law.horizon)])
        row = law.step(StepInputs(attitude=np.array([1.0, 0, 0, 0]), body_rates=np.zeros(3)), state, reference).speeds
        _, desired = law.targets(
            motion_of(state), law.target(reference), Integrals(translation=np.zeros(3), rotation=np.zeros(3))
        )
        rows.append((row, desired))
    for (row, desired), half in zip(rows, (0.0, 0.5 * PERIOD), strict=True):
        commanded = Rotation.from_quat(np.roll(row[4:], -1)).as_matrix()
        turned = desired.attitude @ Rotation.from_rotvec(half * desired.rates).as_matrix()
        np.testing.assert_allclose(commanded, turned, atol=1e-6)


@COMMANDS
def test_on_the_ground_it_asks_for_the_least_thrust_and_no_rates(vehicle: Vehicle, commands: str) -> None:
    law = geometric(vehicle, FAST, commands, disturbance=RampSettings(thrust_scale=True))
    reference = np.tile([0.0, 0.0, 1.0, 0.0], (law.horizon, 1))
    command = law.step(StepInputs(phase=Phase.LANDED), make_state(), reference)
    np.testing.assert_array_equal(command.speeds, [law.bounds.u_min[0], 0.0, 0.0, 0.0])
    for time, phase in ((0.1, Phase.ARMED), (0.2, Phase.FLYING)):
        command = law.step(StepInputs(time=time, phase=phase, acting=command.speeds), make_state(), reference)
    width = 4 if commands == "rates" else 8
    assert command.plan.shape == (law.horizon, width)
    np.testing.assert_array_equal(command.plan[1, :4], [vehicle.mass * vehicle.gravity, 0.0, 0.0, 0.0])
    assert law.predict(make_state()[None], command.plan[None]).shape == (1, law.horizon, 12)


def test_the_table_builds_the_law_and_audits_its_targets(vehicle: Vehicle) -> None:
    table = Geometric(commands="rates", inner_lag=SLOW, target_bounds=TargetBounds(body_rate=100.0), lag=0.05)
    law = table.law(vehicle, PERIOD)
    assert isinstance(law, GeometricController)
    assert law.gains.k_attitude[0] == pytest.approx(1.0 / 0.18)
    np.testing.assert_allclose(law.bounds.u_max[1:], math.radians(100.0))
    assert table.audited(vehicle)["body_rate_y"] == (-100.0, 100.0)
    assert "thrust" not in Geometric().audited(vehicle)
    with pytest.raises(ParameterError, match=r"controller\.inner_lag"):
        build(Geometric(commands="attitude"), vehicle, PERIOD)
