"""Rotor dynamics against an integration of their differential equation, and what rotors do to the body."""

from __future__ import annotations

import math

import mujoco
import numpy as np
import pytest
from numpy_laws import respond
from scipy.integrate import solve_ivp

from quadsim.sim.effects import Effects
from quadsim.sim.effects.rotors import RotorChange, RotorDynamics
from quadsim.sim.plant import Plant
from quadsim.state import Array, make_state
from quadsim.vehicle import Vehicle

START = np.array([100.0, 150.0, 200.0, 240.0])
TARGET = np.array([220.0, 150.0, 120.0, 250.0])


def integrated(dynamics: RotorDynamics, elapsed: Array) -> Array:
    """dw/dt = clip((w_cmd - w) / tau, -a, a), by DOP853."""

    def slope(_t: float, speeds: Array) -> Array:
        gap = TARGET - speeds
        return np.clip(gap / np.where(gap >= 0.0, dynamics.rise, dynamics.fall), -dynamics.acceleration, None).clip(
            None, dynamics.acceleration
        )

    end = float(elapsed[-1])
    return solve_ivp(slope, (0.0, end), START, "DOP853", elapsed, rtol=1e-10, atol=1e-10, max_step=1e-3).y.T


@pytest.mark.parametrize("acceleration", [math.inf, 1500.0, 300.0])
def test_speeds_follow_the_differential_equation(acceleration: float) -> None:
    dynamics = RotorDynamics(rise=0.03, fall=0.07, acceleration=acceleration)
    elapsed = np.linspace(0.0, 0.5, 200)
    speeds, slopes = respond(dynamics, START, TARGET, elapsed)
    np.testing.assert_allclose(speeds, integrated(dynamics, elapsed), atol=1e-5)
    step = 1e-7
    later, _ = respond(dynamics, START, TARGET, elapsed + step)
    kinks = np.isclose(np.abs(slopes), acceleration)
    np.testing.assert_allclose(((later - speeds) / step)[~kinks], slopes[~kinks], rtol=1e-3, atol=1e-2)
    assert np.abs(slopes).max() <= acceleration


def test_a_rotor_without_lag_is_there_at_once_or_along_a_ramp() -> None:
    at_once, _ = respond(RotorDynamics(), START, TARGET, np.array([0.0, 0.1]))
    np.testing.assert_array_equal(at_once, [TARGET, TARGET])
    ramp, slopes = respond(RotorDynamics(acceleration=100.0), START, TARGET, np.array([0.5]))
    np.testing.assert_allclose(ramp, [[150.0, 150.0, 150.0, 250.0]])
    np.testing.assert_allclose(slopes, [[100.0, 0.0, -100.0, 0.0]])


def test_an_answer_in_two_parts_is_the_answer_in_one() -> None:
    dynamics = RotorDynamics(rise=0.02, fall=0.05, acceleration=900.0)
    first, _ = respond(dynamics, START, TARGET, np.array([0.03]))
    second, _ = respond(dynamics, first[0], TARGET, np.array([0.04]))
    whole, _ = respond(dynamics, START, TARGET, np.array([0.07]))
    np.testing.assert_allclose(second, whole, rtol=1e-12)


@pytest.mark.parametrize(
    "dynamics",
    [
        RotorDynamics(),
        RotorDynamics(rise=0.03, fall=0.07),
        RotorDynamics(acceleration=1500.0),
        RotorDynamics(rise=0.03, fall=0.07, acceleration=1500.0, inertia=1e-4),
        RotorDynamics(rise=0.02, acceleration=3000.0),
    ],
)
def test_the_rotors_of_the_plant_follow_that_law(vehicle: Vehicle, dynamics: RotorDynamics) -> None:
    """Their speeds, and by the torque about z their accelerations, as commands change."""
    commands = vehicle.hover_speed + np.random.default_rng(3).uniform(-40.0, 40.0, (4, 4))
    edges = 1e-3 * np.arange(31)
    speeds = START
    with Plant(vehicle, effects=Effects(rotors=dynamics)) as plant:
        plant.reset(make_state(position=(0.0, 0.0, 50.0)), START)
        for command in commands:
            flown = plant.advance(command, 30)
            rows, _ = respond(dynamics, speeds, command, edges)
            _, slopes = respond(dynamics, speeds, command, edges[:-1] + 5e-4)
            expected = rows[:-1]
            if dynamics.at_once:
                expected = np.tile(command, (30, 1))
            np.testing.assert_allclose(flown["speeds"], expected, rtol=1e-11)
            if dynamics.inertia:
                torque = dynamics.inertia * slopes @ np.array(vehicle.rotor_spins)
                np.testing.assert_allclose(flown["wrench"][:, 5], torque, atol=1e-12)
            speeds = plant.speeds
            np.testing.assert_allclose(speeds, rows[-1], rtol=1e-11)


def test_the_plant_climbs_as_its_lagging_rotors_do(vehicle: Vehicle) -> None:
    """Vertical motion under b w(t)^2 with w(t) = w_c + (w_0 - w_c) exp(-t / tau), integrated by hand."""
    tau = 0.05
    start = 180.0
    command = 210.0
    with Plant(vehicle, effects=Effects(rotors=RotorDynamics(rise=tau, fall=tau))) as plant:
        plant.reset(make_state(), np.full(4, start))
        flown = plant.advance(np.full(4, command), 400)
        t = 0.4
        gap = start - command
        lift = 4.0 * vehicle.thrust_coefficient / vehicle.mass
        decay = math.exp(-t / tau)
        impulse = command**2 * t + 2.0 * command * gap * tau * (1.0 - decay) + gap**2 * tau / 2.0 * (1.0 - decay**2)
        assert plant.state()[5] == pytest.approx(lift * impulse - vehicle.gravity * t, rel=1e-5)
        np.testing.assert_allclose(plant.speeds, command + gap * decay)
    np.testing.assert_allclose(flown["speeds"][0], start)


def test_holding_a_command_in_pieces_changes_nothing(vehicle: Vehicle) -> None:
    effects = Effects(rotors=RotorDynamics(rise=0.02, fall=0.04, inertia=5e-5))
    commands = vehicle.hover_speed + np.random.default_rng(0).uniform(-20.0, 20.0, (6, 4))

    def fly(pieces: list[int]) -> Array:
        with Plant(vehicle, effects=effects) as plant:
            plant.reset(make_state())
            for command in commands:
                for steps in pieces:
                    plant.advance(command, steps)
            return plant.physics

    np.testing.assert_allclose(fly([50]), fly([7, 30, 13]), rtol=1e-9, atol=1e-9)


def spinning_bodies(vehicle: Vehicle, inertia: float, rates: Array, speeds: Array, slopes: Array) -> Array:
    """Angular acceleration of a free body that carries four real, hinged rotors, by MuJoCo's own dynamics.

    The rotors' inertia is taken out of the frame's, so that vehicle and rotors together have the vehicle's.
    """
    spec = mujoco.MjSpec()
    body = spec.worldbody.add_body(name="frame")
    body.add_freejoint()
    body.mass = vehicle.mass
    body.explicitinertial = True
    body.inertia = list(np.array(vehicle.inertia) - 4.0 * inertia * np.array([0.5, 0.5, 1.0]))
    for i, (place, spin) in enumerate(zip(vehicle.hubs, vehicle.rotor_spins, strict=True)):
        rotor = body.add_body(name=f"r{i}", pos=place)
        rotor.add_joint(name=f"j{i}", type=mujoco.mjtJoint.mjJNT_HINGE, axis=[0.0, 0.0, -float(spin)])
        rotor.mass = 1e-9
        rotor.inertia = [inertia / 2, inertia / 2, inertia]
        rotor.explicitinertial = True
    model = spec.compile()
    model.opt.gravity[:] = 0.0
    data = mujoco.MjData(model)
    data.qvel[3:6] = rates
    data.qvel[6:10] = speeds
    mujoco.mj_forward(model, data)
    # Motor torques that give the rotors the required accelerations relative to the body: solve M a + c = f for them.
    mass = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, mass)
    free = np.r_[0:6]
    known = mass[:6, 6:] @ slopes + data.qfrc_bias[:6]
    acceleration = np.linalg.solve(mass[np.ix_(free, free)], -known)
    return acceleration[3:6]


def test_gyroscopic_and_spin_up_torque_are_those_of_real_rotors(vehicle: Vehicle) -> None:
    inertia = 2e-3
    rates = np.array([0.6, -0.9, 0.3])
    speeds = np.array([150.0, 190.0, 230.0, 210.0])
    dynamics = RotorDynamics(rise=0.05, fall=0.05, inertia=inertia)
    target = speeds + np.array([4.0, -3.0, 2.0, 5.0])
    state = make_state(position=(0.0, 0.0, 50.0))
    state[[7, 9, 11]] = rates  # level, so that Euler and body rates agree
    with Plant(vehicle, effects=Effects(rotors=dynamics)) as plant:
        plant.reset(state, speeds)
        wrench = plant.advance(target, 1)["wrench"]
    (middle,), (slopes,) = respond(dynamics, speeds, target, np.array([5e-4]))
    expected = spinning_bodies(vehicle, inertia, rates, middle, slopes)
    bare = -np.cross(rates, np.array(vehicle.inertia) * rates) / vehicle.inertia
    np.testing.assert_allclose(wrench[0, 3:] / vehicle.inertia + bare, expected, rtol=1e-5)
    assert np.abs(wrench[0, 3:]).min() > 1e-3


def test_a_worn_rotor_gives_its_share(vehicle: Vehicle) -> None:
    worn = Effects(rotors=RotorDynamics(efficiency=(1.0, 0.8, 1.0, 1.0)))
    lost = (RotorChange(at=0.1, rotor=4, efficiency=0.0),)
    speeds = np.full(4, vehicle.hover_speed)
    with Plant(vehicle, effects=worn, changes=lost) as plant:
        plant.reset(make_state(position=(0.0, 0.0, 100.0)))
        plant.advance(speeds, 1)
        share = vehicle.thrust_coefficient * vehicle.hover_speed**2 * 1e-3
        arm, (ixx, _, izz) = vehicle.arm_length, vehicle.inertia
        spin = vehicle.rotor_spins[1] * vehicle.drag_to_thrust
        assert plant.physics[10] == pytest.approx(-0.2 * share / vehicle.mass, rel=1e-6)
        assert plant.physics[11] == pytest.approx(0.2 * arm * share / ixx, rel=1e-6)  # rotor 2 is on -y: it sinks there
        assert plant.physics[13] == pytest.approx(-0.2 * spin * share / izz, rel=1e-6)
        plant.advance(speeds, 99)
        before = plant.physics
        plant.advance(speeds, 1)
        gone = (plant.physics - before)[11] * ixx / 1e-3
        assert gone == pytest.approx((0.2 - 1.0) * arm * share / 1e-3, rel=1e-2)
