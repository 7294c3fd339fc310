"""The Runge-Kutta plant: an independent integration, its order, MuJoCo's steps, and what it refuses."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from uneven import uneven

from quadsim.assets import vehicle_path
from quadsim.errors import ForceError
from quadsim.sim.effects import Disturbance, Effects, Ground, ThrustNoise
from quadsim.sim.effects.load import Load, MassChange
from quadsim.sim.effects.rotors import RotorDynamics
from quadsim.sim.effects.wind import Air, WindField
from quadsim.sim.physics import Integrator
from quadsim.sim.plant import Plant
from quadsim.state import Array
from quadsim.vehicle import Vehicle, load_vehicle

LINEAR = (0.3, 0.2, 0.05)
QUADRATIC = (0.08, 0.1, 0.12)
DRAG = Effects(air=Air(linear_drag=LINEAR, quadratic_drag=QUADRATIC))
START = np.array([0.0, 4.0, 0.0, -3.0, 20.0, 1.0, 0.4, 0.5, -0.7, -0.3, 1.0, 0.8])
SMOOTH = START + 8.0 * np.eye(12)[5]
"""From where no component of the velocity changes its sign in 0.4 s, at which the drag has a kink."""
SPEEDS = np.array([360.0, 380.0, 365.0, 375.0])


@pytest.fixture(scope="module")
def torrente() -> Vehicle:
    return load_vehicle(vehicle_path("torrente2021"))


def flown(vehicle: Vehicle, effects: Effects, steps: int, start: Array = START, **settings: Any) -> Array:
    """The last state of MuJoCo's order after so many steps."""
    with Plant(vehicle, effects=effects, **settings) as plant:
        plant.reset(start)
        return plant.advance(SPEEDS, steps)["physics"][-1]


def rates(x: Array, vehicle: Vehicle, wind: Array) -> Array:
    """The equations of motion with drag by component, written with matrices; x as MuJoCo has it, without the time."""
    w, a, b, c = x[3:7]
    R = np.array(
        [
            [1 - 2 * (b * b + c * c), 2 * (a * b - w * c), 2 * (a * c + w * b)],
            [2 * (a * b + w * c), 1 - 2 * (a * a + c * c), 2 * (b * c - w * a)],
            [2 * (a * c - w * b), 2 * (b * c + w * a), 1 - 2 * (a * a + b * b)],
        ]
    )
    v = x[7:10]
    omega = x[10:13]
    along = R.T @ (v - wind)
    drag = -np.array(LINEAR) * along - np.array(QUADRATIC) * along * np.abs(along)
    push, *torque = vehicle.allocation @ SPEEDS**2
    J = np.array(vehicle.inertia)
    p, q, r = omega
    turning = np.array([[0, -p, -q, -r], [p, 0, r, -q], [q, -r, 0, p], [r, q, -p, 0]])
    acceleration = R @ (np.array([0, 0, push]) + drag) / vehicle.mass - [0, 0, vehicle.gravity]
    return np.concatenate([v, 0.5 * turning @ x[3:7], acceleration, (torque - np.cross(omega, J * omega)) / J])


def exact(vehicle: Vehicle, duration: float, wind: Array, start: Array = START) -> Array:
    with Plant(vehicle) as plant:
        plant.reset(start)
        physics = plant.physics[1:]
    done = solve_ivp(
        lambda _, x: rates(x, vehicle, wind), (0.0, duration), physics, method="DOP853", rtol=1e-12, atol=1e-12
    )
    return np.asarray(done.y[:, -1])


def test_it_integrates_drag_by_component_as_an_independent_integration_does(torrente: Vehicle) -> None:
    end = flown(torrente, DRAG, 1000, timestep=5e-4, integrator="rk4")
    np.testing.assert_allclose(end[1:], exact(torrente, 0.5, np.zeros(3)), rtol=0.0, atol=1e-10)
    assert end[0] == pytest.approx(0.5)


def test_wind_is_what_the_drag_is_against(torrente: Vehicle) -> None:
    wind = WindField(mean=(2.0, -1.0, 0.5), timestep=5e-4, rng=np.random.default_rng(0))
    end = flown(torrente, DRAG, 600, timestep=5e-4, integrator="rk4", wind=wind)
    np.testing.assert_allclose(end[1:], exact(torrente, 0.3, np.array([2.0, -1.0, 0.5])), rtol=0.0, atol=1e-10)


@pytest.mark.parametrize(("integrator", "order"), [("rk4", 4.0), ("mujoco", 2.0)])
def test_the_order_with_drag(integrator: Integrator, order: float, torrente: Vehicle) -> None:
    """MuJoCo's step holds what is applied from outside, evaluated in its middle: of second order."""
    reference = exact(torrente, 0.4, np.zeros(3), SMOOTH)
    errors = [
        np.abs(flown(torrente, DRAG, round(0.4 / h), SMOOTH, timestep=h, integrator=integrator)[1:] - reference).max()
        for h in (0.02, 0.01)
    ]
    assert math.log2(errors[0] / errors[1]) == pytest.approx(order, abs=0.35)


def test_mujocos_steps_differ_by_little_at_half_a_millisecond(torrente: Vehicle) -> None:
    ends = [flown(torrente, DRAG, 1000, timestep=5e-4, integrator=each) for each in ("rk4", "mujoco")]
    difference = np.abs(ends[0] - ends[1]).max()
    assert 1e-12 < difference < 1e-6


@pytest.mark.parametrize(
    "effects",
    [
        Effects(),
        Effects(rotors=RotorDynamics(rise=0.02, fall=0.03, inertia=1e-5)),
        Effects(air=Air(rotor_drag=2e-4)),
        Effects(ground=Ground(effect=True, contact=False, rotor_radius=0.12)),
        Effects(disturbance=Disturbance(force=(0.1, 0.0, -0.2), torque=(0.0, 0.01, 0.0), force_noise=1e-3)),
    ],
    ids=["none", "rotors", "rotor drag", "ground effect", "disturbance"],
)
def test_every_other_effect_acts_as_in_mujoco(effects: Effects, torrente: Vehicle) -> None:
    ends = [flown(torrente, effects, 300, timestep=1e-3, integrator=each) for each in ("rk4", "mujoco")]
    np.testing.assert_allclose(ends[0], ends[1], rtol=0.0, atol=2e-6)


@pytest.mark.parametrize("even", [True, False])
def test_other_mass_and_inertia_fly_as_in_mujoco(even: bool, torrente: Vehicle) -> None:
    vehicle = torrente if even else uneven()
    load = Effects(load=Load(mass_factor=1.2, inertia_factor=(0.95, 0.95, 0.9)))
    changes = [MassChange(at=0.1, factor=0.8)]
    ends = []
    for integrator in ("rk4", "mujoco"):
        ends.append(flown(vehicle, load, 300, timestep=1e-3, integrator=integrator, changes=changes))
    np.testing.assert_allclose(ends[0], ends[1], rtol=0.0, atol=2e-6)
    light = flown(vehicle, Effects(), 300, timestep=1e-3, integrator="rk4")
    assert np.abs(ends[0] - light).max() > 1e-2


def test_an_uneven_body_turns_as_in_mujoco() -> None:
    """With products of inertia, rotors at four heights and as many thrust coefficients."""
    vehicle, air = (
        uneven(),
        Effects(air=Air(rotor_drag=2e-4, rotor_moment=(1e-5, 2e-5), inflow_moment=(3e-3, 4e-3), inflow=3e-4)),
    )
    ends = [flown(vehicle, air, 300, timestep=5e-4, integrator=each) for each in ("rk4", "mujoco")]
    np.testing.assert_allclose(ends[0], ends[1], rtol=0.0, atol=2e-6)
    even = replace(vehicle, products_of_inertia=None)
    assert np.abs(ends[0] - flown(even, air, 300, timestep=5e-4, integrator="rk4")).max() > 1e-2


def test_user_defined_forces_act_too_and_are_refused_when_invalid(torrente: Vehicle) -> None:
    def spring(_: float, state: Array) -> Array:
        return np.array([*(-2.0 * state[[0, 2, 4]]), 0.0, 0.0, 0.0])

    ends = [flown(torrente, Effects(), 300, integrator=each, forces=[spring]) for each in ("rk4", "mujoco")]
    np.testing.assert_allclose(ends[0], ends[1], rtol=0.0, atol=1e-9)
    assert np.abs(ends[0] - flown(torrente, Effects(), 300, integrator="rk4")).max() > 1e-3
    with pytest.raises(ForceError):
        flown(torrente, Effects(), 3, integrator="rk4", forces=[lambda *_: np.zeros(5)])


def test_its_wrench_is_the_mean_of_what_acted(torrente: Vehicle) -> None:
    """Impulse: m dv is what gravity, the rotors and the recorded force gave."""
    with Plant(torrente, effects=DRAG, timestep=5e-4, integrator="rk4") as plant:
        plant.reset(START)
        flown = plant.advance(np.zeros(4), 200)
    gained = flown["physics"][-1, 8:11] - START[[1, 3, 5]]
    fallen = np.array([0.0, 0.0, -torrente.gravity * 0.1])
    np.testing.assert_allclose(gained - fallen, flown["wrench"][:, :3].sum(axis=0) * 5e-4 / torrente.mass, atol=1e-12)


def test_drag_along_the_axes_alone_slows_a_fall_as_its_closed_form(torrente: Vehicle) -> None:
    """Without thrust, level: m dw/dt = m g - k w^2 has w = w_t tanh(g t / w_t)."""
    terminal = math.sqrt(torrente.mass * torrente.gravity / 0.08)
    for integrator in ("rk4", "mujoco"):
        with Plant(torrente, effects=Effects(air=Air(quadratic_drag=(0.0, 0.0, 0.08))), integrator=integrator) as plant:
            plant.advance(np.zeros(4), 1500)
            assert plant.state()[5] == pytest.approx(-terminal * math.tanh(9.81 * 1.5 / terminal), rel=1e-6)


def test_thrust_noise_has_the_mean_and_the_deviation_that_are_stated(torrente: Vehicle) -> None:
    """Of the collective thrust: its share has a quarter of the variance of one rotor's, as these are independent."""
    noisy = Effects(thrust_noise=ThrustNoise(loss=0.06, deviation=0.02))
    count = 20_000
    full = 4.0 * torrente.thrust_coefficient * torrente.speed_max**2
    with Plant(torrente, effects=noisy, timestep=1e-4, integrator="rk4") as plant:
        for share in (0.1, 0.5, 0.9):
            plant.reset(np.zeros(12))
            given = plant.advance(np.full(4, torrente.speed_max * math.sqrt(share)), count)["thrust"] / full
            assert (share - given).mean() == pytest.approx(0.06 * share**2, abs=3e-4 * math.sqrt(share))
            assert given.std() == pytest.approx(0.5 * 0.02 * math.sqrt(share), rel=0.02)
            assert abs(np.corrcoef(given[1:], given[:-1])[0, 1]) < 0.03
        for speed in (0.0, 1e-3, torrente.speed_max, 1.2 * torrente.speed_max):
            plant.reset(np.zeros(12))
            given = plant.advance(np.full(4, speed), 500)["thrust"] / full
            assert given.min() >= 0.0
            assert given.max() <= 1.0
            assert speed > 0.0 or not given.any()


def test_thrust_noise_is_drawn_anew_in_each_step_and_again_after_a_reset(torrente: Vehicle) -> None:
    noisy = Effects(thrust_noise=ThrustNoise(deviation=0.02))
    for integrator in ("rk4", "mujoco"):
        with Plant(torrente, effects=noisy, timestep=5e-4, integrator=integrator) as plant:
            first = plant.advance(SPEEDS, 400)["physics"]
            plant.reset(np.zeros(12))
            np.testing.assert_array_equal(plant.advance(SPEEDS, 400)["physics"], first)
        gains = np.diff(first[:, 10]) / 5e-4
        assert gains.std() == pytest.approx(2.0 * 0.02 * 20.0 * math.sqrt((SPEEDS[0] / 1000) ** 2), rel=0.15)
