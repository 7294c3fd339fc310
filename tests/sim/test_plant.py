"""The plant, against an independent integration of the Newton-Euler equations, and its refusals."""

from __future__ import annotations

import math
import subprocess
import sys
from pathlib import Path

import mujoco
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation
from uneven import uneven

from quadsim.core.stepping import step_address
from quadsim.errors import CommandError, DivergenceError, InputError, ParameterError
from quadsim.sim.autopilot import Autopilot
from quadsim.sim.effects import Disturbance, Effects, Ground, ThrustNoise
from quadsim.sim.effects.battery import Battery
from quadsim.sim.effects.rotors import RotorDynamics
from quadsim.sim.effects.turbulence import Dryden
from quadsim.sim.effects.wind import Air, Gust, WindField
from quadsim.sim.physics import Integrator, physics_to_state
from quadsim.sim.plant import Plant
from quadsim.state import Array, make_state
from quadsim.vehicle import Vehicle

PERIOD = 0.05
STEPS = 50


def newton_euler(vehicle: Vehicle, start: Array, holds: Array) -> Array:
    """The state (position, quaternion wxyz, velocity, body rates) after each row was held for a period, by DOP853."""
    J = vehicle.inertia_matrix

    def slope(_t: float, y: Array, thrust: float, torque: Array) -> Array:
        _, quaternion, velocity, rates = np.split(y, [3, 7, 10])
        w, x, yq, z = quaternion / np.linalg.norm(quaternion)
        up = Rotation.from_quat([x, yq, z, w]).apply([0.0, 0.0, 1.0])
        acceleration = thrust / vehicle.mass * up - [0.0, 0.0, vehicle.gravity]
        p, q, r = rates
        spin = 0.5 * np.array(
            [-x * p - yq * q - z * r, w * p + yq * r - z * q, w * q - x * r + z * p, w * r + x * q - yq * p]
        )
        angular = np.linalg.solve(J, torque - np.cross(rates, J @ rates))
        return np.concatenate([velocity, spin, acceleration, angular])

    y = start
    for speeds in holds:
        wrench = vehicle.allocation @ speeds**2
        y = solve_ivp(slope, (0, PERIOD), y, "DOP853", rtol=1e-12, atol=1e-12, args=(wrench[0], wrench[1:])).y[:, -1]
    return y


@pytest.mark.parametrize(("seed", "layout"), [(0, "even"), (1, "even"), (2, "uneven")])
def test_four_seconds_of_random_commands_match_newton_euler(vehicle: Vehicle, seed: int, layout: str) -> None:
    rng = np.random.default_rng(seed)
    vehicle = uneven() if layout == "uneven" else vehicle
    holds = vehicle.hover_speeds + rng.uniform(-8.0, 8.0, (80, 4))
    with Plant(vehicle) as plant:
        plant.reset(make_state(euler=(0.1, -0.2, 0.5)))
        start = plant.physics
        for speeds in holds:
            plant.advance(speeds, STEPS)
        end = plant.physics
    expected = newton_euler(vehicle, start[1:], holds)
    assert np.abs(end[1:4] - expected[:3]).max() < 1e-6
    assert np.abs(end[4:8] - expected[3:7] / np.linalg.norm(expected[3:7])).max() < 1e-6
    assert np.abs(end[11:14]).max() > 0.1  # it did tumble about


def test_free_fall_is_a_parabola(vehicle: Vehicle) -> None:
    with Plant(vehicle) as plant:
        plant.reset(make_state(position=(0.0, 0.0, 100.0)))
        plant.advance(np.zeros(4), 2000)
        assert plant.state()[4] == pytest.approx(100.0 - 0.5 * vehicle.gravity * 4.0, abs=1e-9)
        assert plant.time == pytest.approx(2.0)


def test_energy_and_angular_momentum_are_conserved_without_rotors(vehicle: Vehicle) -> None:
    inertia = np.array(vehicle.inertia)

    def invariants(physics: Array) -> tuple[float, Array]:
        position, quaternion, velocity, rates = np.split(physics[1:], [3, 7, 10])
        energy = 0.5 * vehicle.mass * velocity @ velocity + vehicle.mass * vehicle.gravity * position[2]
        momentum = Rotation.from_quat(np.roll(quaternion, -1)).apply(inertia * rates)
        return float(energy + 0.5 * rates @ (inertia * rates)), momentum

    spinning = make_state(position=(0.0, 0.0, 50.0))
    spinning[[7, 9, 11]] = 1.0, -2.0, 3.0
    with Plant(vehicle) as plant:
        plant.reset(spinning)
        energy, momentum = invariants(plant.physics)
        plant.advance(np.zeros(4), 3000)
        later_energy, later_momentum = invariants(plant.physics)
    assert later_energy == pytest.approx(energy, rel=1e-9)
    np.testing.assert_allclose(later_momentum, momentum, atol=1e-9)


def test_physics_converges_with_fourth_order(vehicle: Vehicle) -> None:
    rng = np.random.default_rng(3)
    holds = vehicle.hover_speed + rng.uniform(-30.0, 30.0, (10, 4))

    def after(timestep: float) -> Array:
        with Plant(vehicle, timestep=timestep) as plant:
            plant.reset(make_state())
            for speeds in holds:
                plant.advance(speeds, round(PERIOD / timestep))
            return plant.physics[1:]

    finest = after(0.05 / 400)
    errors = [np.abs(after(PERIOD / steps) - finest).max() for steps in (5, 10, 20)]
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    assert np.all(orders > 3.5), orders


def test_state_comes_out_with_euler_rates_and_unwrapped_yaw(vehicle: Vehicle) -> None:
    turning = make_state()
    turning[11] = 4.0
    with Plant(vehicle) as plant:
        plant.reset(turning)
        hover = plant.vehicle.hover_speeds
        yaws = []
        rows = []
        for _ in range(80):
            rows.append(plant.advance(hover, STEPS)["physics"])
            yaws.append(plant.state()[10])
    np.testing.assert_allclose(yaws, 4.0 * PERIOD * np.arange(1, 81), atol=1e-9)  # sixteen radians, no jump
    np.testing.assert_allclose(physics_to_state(np.concatenate(rows))[-1, 10], 16.0, atol=1e-9)


def test_start_is_the_state_requested(vehicle: Vehicle) -> None:
    requested = np.random.default_rng(0).uniform(-1, 1, 12)
    with Plant(vehicle) as plant:
        plant.reset(requested)
        np.testing.assert_allclose(plant.state(), requested, atol=1e-12)
        plant.reset(make_state(euler=(0.0, 0.0, 7.0)))  # a yaw beyond pi stays what it was
        np.testing.assert_allclose(plant.state()[10], 7.0, atol=1e-12)


@pytest.mark.parametrize(
    ("speeds", "message"),
    [
        ([np.nan, 190.0, 190.0, 190.0], "the command is not finite"),
        ([190.0, np.inf, 190.0, 190.0], "the command is not finite"),
        ([190.0, 190.0, 190.0], r"shape \(3,\), not \(4,\)"),
        ([1e9, 190.0, 190.0, 190.0], "beyond any rotor's speed"),
    ],
)
def test_bad_commands_are_refused_before_anything_moves(vehicle: Vehicle, speeds: list[float], message: str) -> None:
    with Plant(vehicle) as plant:
        plant.reset(make_state())
        with pytest.raises(CommandError, match=message):
            plant.advance(np.array(speeds), STEPS)
        assert plant.time == 0.0


def test_divergence_is_raised_and_not_reset_away(
    vehicle: Vehicle, capfd: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with Plant(vehicle) as plant:
        plant.reset(make_state())
        with pytest.raises(DivergenceError, match="diverged"):
            plant.advance(np.array([9e4, 0.0, 0.0, 0.0]), 50_000)
    assert capfd.readouterr() == ("", "")
    assert list(tmp_path.iterdir()) == []  # no MUJOCO_LOG.TXT


def test_rotors_saturate_only_where_the_scenario_limits_them(vehicle: Vehicle) -> None:
    fast = np.full(4, 300.0)
    with Plant(vehicle) as free, Plant(vehicle, limit_speeds=True) as limited:
        for plant, speed in ((free, 300.0), (limited, vehicle.speed_max)):
            plant.reset(make_state())
            np.testing.assert_array_equal(plant.advance(fast, 100)["commands"], np.full((100, 4), speed))
            thrust = 4 * vehicle.thrust_coefficient * speed**2
            climb = 0.5 * (thrust / vehicle.mass - vehicle.gravity) * 0.1**2
            assert plant.state()[4] == pytest.approx(climb, rel=1e-9)
        np.testing.assert_array_equal(free.advance(-fast, 1)["commands"], np.zeros((1, 4)))  # none pushes down


@pytest.mark.parametrize("state", [np.zeros(11), np.full(12, np.nan)])
def test_impossible_starts_are_refused(vehicle: Vehicle, state: Array) -> None:
    with Plant(vehicle) as plant, pytest.raises(ParameterError, match=r"plant\.state"):
        plant.reset(state)


def test_equal_commands_give_equal_bits(vehicle: Vehicle) -> None:
    holds = vehicle.hover_speed + np.random.default_rng(1).uniform(-8, 8, (20, 4))

    def fly() -> Array:
        with Plant(vehicle) as plant:
            plant.reset(make_state())
            return np.concatenate([plant.advance(speeds, STEPS)["physics"] for speeds in holds])

    np.testing.assert_array_equal(fly(), fly())


def test_steps_are_not_timed(vehicle: Vehicle) -> None:
    """Reading the clock in every step would take 40 % of its time."""
    with Plant(vehicle) as plant:
        plant.advance(np.full(4, vehicle.hover_speed), steps=50)
        assert plant._data.timer[mujoco.mjtTimer.mjTIMER_STEP].duration == 0.0


def test_callbacks_of_the_users_own_stay() -> None:
    code = (
        "import mujoco; mujoco.set_mjcb_control(print); import quadsim.sim.plant\n"
        "assert mujoco.get_mjcb_control() is print; mujoco.set_mjcb_control(None)"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_a_vehicle_is_lost_at_the_step_that_leaves_the_plausible(vehicle: Vehicle) -> None:
    """1000 km away, at 2 km/s: the first state beyond a million metres ends the flight."""
    state = make_state(position=(999_999.0, 0.0, 0.0))
    state[1] = 2000.0
    with Plant(vehicle) as plant:
        plant.reset(state)
        with pytest.raises(DivergenceError, match=r"0\.001 s: .*diverged"):
            plant.advance(plant.vehicle.hover_speeds, 10)
        state[0] = 999_900.0
        plant.reset(state)
        assert plant.advance(plant.vehicle.hover_speeds, 10)["physics"][-1, 1] == pytest.approx(999_920.0)


def test_a_fatal_error_of_mujoco_ends_the_flight_and_not_the_process(vehicle: Vehicle) -> None:
    """In its bindings it stays the exception that it is."""
    with Plant(vehicle) as plant:
        plant.advance(plant.vehicle.hover_speeds, 5)
        before = plant.physics
        integrator = plant.model.opt.integrator
        plant.model.opt.integrator = 99
        with pytest.raises(DivergenceError, match=r"0\.005 s: .*diverged"):
            plant.advance(plant.vehicle.hover_speeds, 5)
        assert np.array_equal(plant.physics, before)
        with pytest.raises(mujoco.FatalError, match="integrator"):
            mujoco.mj_step(plant.model, mujoco.MjData(plant.model))
        plant.model.opt.integrator = integrator
        plant.reset(make_state())
        assert np.array_equal(plant.advance(plant.vehicle.hover_speeds, 5)["physics"][-1], before)


@pytest.mark.parametrize("number", [0, 2])
def test_a_target_that_is_no_number_is_refused(vehicle: Vehicle, number: int) -> None:
    autopilot = Autopilot(vehicle)
    target = np.array([vehicle.mass * vehicle.gravity, 0.0, 0.0, 0.0])
    target[number] = math.nan
    with Plant(vehicle) as plant:
        loop = autopilot.engage(target, plant.speeds)
        loop.stride = 1
        plant.begin(20)
        with pytest.raises(CommandError, match=r"0\.001 s"):  # after its delay
            plant.hold(target, 20, loop=loop)


def test_a_release_of_mujoco_that_lacks_what_is_needed_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    step_address.cache_clear()
    monkeypatch.setattr(mujoco, "__file__", "/nowhere/__init__.py")
    with pytest.raises(InputError, match=r"MuJoCo \d.* cannot be stepped from C \(.*\): install a release that pyproj"):
        step_address()
    monkeypatch.undo()
    assert step_address() > 0


@pytest.mark.parametrize("integrator", ["mujoco", "rk4"])
def test_results_have_the_same_bits_however_time_is_cut(vehicle: Vehicle, integrator: Integrator) -> None:
    """Holds of 20 steps and of 1, with all that changes from step to step, down to the ground and past an obstacle."""
    contact = integrator == "mujoco"
    effects = Effects(
        rotors=RotorDynamics(rise=0.02, fall=0.04, acceleration=4e3, inertia=5e-5),
        air=Air(rotor_drag=1e-3, linear_drag=(0.1, 0.1, 0.1), body_drag=(0.02, 0.02, 0.03) if contact else None),
        ground=Ground(contact=contact, effect=True, rotor_radius=0.12),
        disturbance=Disturbance(
            force=(0.1, 0.0, 0.0),
            force_noise=0.01,
            torque_noise=1e-4,
            force_deviation=(0.1, 0.0, 0.2),
            force_time=(0.1, 0.2, 0.3),
        ),
        thrust_noise=ThrustNoise(loss=0.02, deviation=0.01),
        battery=Battery(cells=4, capacity=0.05, hover_current=40.0, reference_voltage=16.0),
    )
    wind = WindField(
        mean=(2.0, 1.0, 0.0),
        gusts=(Gust(at=0.1, duration=0.2, velocity=(3.0, 0.0, 0.0)),),
        turbulence=Dryden(wind_speed_20ft=8.0, airspeed=4.0),
        timestep=1e-3,
        rng=np.random.default_rng(1),
    )
    commands = vehicle.hover_speed * np.random.default_rng(2).uniform(0.6, 1.0, (40, 4))
    flights = []
    for steps in (20, 1):
        with Plant(
            vehicle, effects=effects, wind=wind, rng=np.random.default_rng(3), limit_speeds=True, integrator=integrator
        ) as plant:
            plant.reset(make_state(position=(0.0, 0.0, 0.3)))
            parts = [plant.advance(command, steps) for command in commands for _ in range(20 // steps)]
            flights.append(np.concatenate(parts))
    assert flights[0].tobytes() == flights[1].tobytes()
    assert (abs(flights[0]["physics"][-1, 3]) < 0.01) == contact  # it stands on the ground
