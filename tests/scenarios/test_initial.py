"""`[initial]`: a flight that starts at any state, against closed forms, and everybody who has to know of it."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import quadsim
import quadsim.gym
from quadsim.controller import StepInputs
from quadsim.errors import InputError
from quadsim.features.campaign.plan import make_plan
from quadsim.rollout.flown import Flight
from quadsim.rollout.rollout import Rollout
from quadsim.scenarios.loading import load_scenario, parse_scenario
from quadsim.scenarios.schema.bases import read_whole
from quadsim.scenarios.schema.scenario import Scenario
from quadsim.state import INDEX, Array

STOPPED = [0.0] * 4
VELOCITY = (2.0, -1.0, 6.0)
THROW: dict[str, Any] = {
    "initial.position": [0.5, -0.3, 40.0],
    "initial.euler": [35.0, -20.0, 130.0],
    "initial.velocity": [*VELOCITY],
    "initial.body_rates": [0.0, 0.0, 200.0],
    "initial.rotor_speeds": STOPPED,
    "duration": 1.5,
    "lost.tilt": False,
    "log_rate": 1000.0,
    "constraints": [],
    "controller": "geometric",
}
ABOUT_ALL = (150.0, -80.0, 60.0)  # deg/s


def thrown(**changes: Any) -> Scenario:
    return load_scenario("hover").replace({**THROW, **changes})


def holds(speeds: Array | list[float]) -> Any:
    return lambda now, state, reference: np.array(speeds)


def positions(flight: Flight) -> Array:
    return flight.log.plant.state[:, [0, 2, 4]]


@pytest.mark.parametrize("integrator", ["mujoco", "rk4"])
def test_with_stopped_rotors_it_flies_a_parabola_and_spins_evenly(integrator: str) -> None:
    flight = quadsim.fly(thrown(**{"plant.integrator": integrator}), controller=holds(STOPPED), progress=False)
    t = flight.log.plant.t[:, None]
    g = flight.vehicle.gravity
    parabola = [0.5, -0.3, 40.0] + t * VELOCITY - 0.5 * g * t**2 * [0.0, 0.0, 1.0]
    np.testing.assert_allclose(positions(flight), parabola, atol=1e-9)
    start = Rotation.from_euler("ZYX", [130.0, -20.0, 35.0], degrees=True)
    spun = start * Rotation.from_rotvec(np.radians([0.0, 0.0, 200.0]) * t)
    roll_pitch_yaw = flight.log.plant.state[:, [6, 8, 10]]
    flown = Rotation.from_euler("ZYX", roll_pitch_yaw[:, ::-1])
    assert (spun.inv() * flown).magnitude().max() < 1e-9


@pytest.mark.parametrize("integrator", ["mujoco", "rk4"])
def test_without_torque_angular_momentum_and_energy_are_kept(integrator: str) -> None:
    scenario = thrown(**{"plant.integrator": integrator, "initial.body_rates": [*ABOUT_ALL], "duration": 1.0})
    log = quadsim.fly(scenario, controller=holds(STOPPED), progress=False).log
    attitude = Rotation.from_euler("ZYX", log.plant.state[:, [10, 8, 6]])
    J = np.array(quadsim.load_vehicle("lopes2011").inertia)
    roll = log.plant.state[:, 6]
    pitch = log.plant.state[:, 8]
    a, b, c = log.plant.state[:, [7, 9, 11]].T
    rates = np.column_stack(
        [
            a - c * np.sin(pitch),
            b * np.cos(roll) + c * np.cos(pitch) * np.sin(roll),
            c * np.cos(pitch) * np.cos(roll) - b * np.sin(roll),
        ]
    )
    np.testing.assert_allclose(rates[0], np.radians(ABOUT_ALL), atol=1e-12)
    momentum = attitude.apply(J * rates)
    np.testing.assert_allclose(momentum, np.tile(momentum[0], (len(momentum), 1)), atol=1e-9)
    energy = np.square(rates) @ J
    np.testing.assert_allclose(energy, energy[0], rtol=1e-9)


def test_with_hover_thrust_it_flies_straight_on() -> None:
    level = {"initial.euler": [0.0, 0.0, 130.0], "initial.body_rates": [0.0] * 3, "initial.rotor_speeds": None}
    scenario = thrown(**level)
    hover = quadsim.load_vehicle("lopes2011").hover_speed
    flight = quadsim.fly(scenario, controller=holds([hover] * 4), progress=False)
    np.testing.assert_allclose(positions(flight), [0.5, -0.3, 40.0] + flight.log.plant.t[:, None] * VELOCITY, atol=1e-9)


def test_lagging_rotors_start_at_their_speeds_and_the_law_after_that_command() -> None:
    speeds = [120.0, 150.0, 180.0, 210.0]
    asked = []

    def law(now: StepInputs, state: Array, reference: Array) -> Array:
        asked.append(now.acting)
        return np.full(4, 200.0)

    lag = {"effects.rotors": {"rise": 0.04, "fall": 0.06}, "initial.rotor_speeds": speeds, "duration": 0.2}
    log = quadsim.fly(thrown(**lag), controller=law, progress=False).log
    np.testing.assert_array_equal(asked[0], speeds)
    np.testing.assert_array_equal(log.control.speeds_before, speeds)
    lags = np.where(np.array(speeds) < 200.0, 0.04, 0.06)
    expected = 200.0 + (np.array(speeds) - 200.0) * np.exp(-log.plant.t[:, None] / lags)
    np.testing.assert_allclose(log.plant.speeds, expected, atol=1e-9)


@pytest.mark.parametrize("name", ["constrained", "robust", "nonlinear", "lqr", "pid", "geometric"])
def test_every_controller_starts_after_the_initial_command(name: str) -> None:
    """From 20 rad/s below hover, bounded steps lead up from there."""
    speeds = [175.0, 170.0, 165.0, 170.0]
    law = {"type": name}
    if name == "nonlinear":
        law |= {"horizon": 20, "inputs": "speed"}
    scenario = load_scenario("robust" if name == "robust" else "hover", {"constraints": [], "duration": 0.3})
    if name not in ("constrained", "robust"):
        scenario = scenario.replace({"controller": law})
    bounds = {"speed": [0.0, 250.0], "slew": [-10.0, 10.0]}
    scenario = scenario.replace({"controller.input_bounds": bounds, "initial.rotor_speeds": speeds})
    command = quadsim.fly(scenario, progress=False).log.control.speeds
    steps = np.diff(command, axis=0, prepend=[speeds])
    assert np.abs(steps).max() == pytest.approx(10.0, abs=1e-3)
    assert command[-1].mean() > 190.0


def test_an_estimate_starts_at_the_velocity_and_rates() -> None:
    scenario = load_scenario("motion-capture").replace(
        {"initial.velocity": [*VELOCITY], "initial.body_rates": [*ABOUT_ALL], "duration": 0.5, "lost.tilt": False}
    )
    control = quadsim.fly(scenario, progress=False).log.control
    moving = [INDEX[name] for name in ("vx", "vy", "vz", "roll_rate", "pitch_rate", "yaw_rate")]
    apart = np.abs(control.state - control.truth)[0, moving]
    assert 0.0 < apart[:3].max() < 0.3  # its first estimate is drawn with 0.05 m/s and 1 deg/s
    assert 0.0 < apart[3:].max() < math.radians(6.0)
    np.testing.assert_allclose(control.truth[0, moving[:3]], VELOCITY)


def test_an_autopilot_starts_on_a_vehicle_that_turns() -> None:
    """Asked for the rates that it has, about its axis: nothing to do, nor for the derivative of filtered rates."""
    turning = math.radians(200.0)

    class Spins:
        commands = "rates"
        horizon = 1

        def step(self, now: StepInputs, state: Array, reference: Array) -> Array:
            vehicle = quadsim.load_vehicle("hummingbird")
            return np.array([vehicle.mass * vehicle.gravity, 0.0, 0.0, turning])

    gains = {"gyro_cutoff": 30.0, "d": [2.0, 2.0, 2.0], "d_cutoff": 20.0, "delay": 0.002}
    changes = {"vehicle.file": "hummingbird", "autopilot": gains, "controller": "pid", "initial.rotor_speeds": None}
    scenario = thrown(**changes).replace({"initial.euler": [0.0] * 3, "duration": 0.5, "control_period": 0.02})
    log = quadsim.fly(scenario, controller=Spins(), progress=False).log
    np.testing.assert_allclose(log.plant.state[:, INDEX["yaw_rate"]], turning, atol=1e-9)
    np.testing.assert_allclose(log.plant.speeds, quadsim.load_vehicle("hummingbird").hover_speed, atol=1e-6)


def test_the_resolved_file_starts_the_same_flight(tmp_path: Path) -> None:
    flight = quadsim.fly(thrown(duration=0.3), progress=False)
    flight.save(tmp_path / "run", video=False, recording=False, figures=False)
    again = parse_scenario(read_whole(tmp_path / "run" / "scenario.toml"))
    assert again.initial == flight.scenario.initial
    np.testing.assert_array_equal(quadsim.fly(again, progress=False).log.plant.state, flight.log.plant.state)


def test_live_flights_and_episodes_start_there_again_and_again() -> None:
    scenario = thrown(**{"duration": 0.3, "initial.body_rates": [*ABOUT_ALL]})
    flown = quadsim.fly(scenario, progress=False).log.control.state
    with Rollout(scenario, live=True) as live:
        np.testing.assert_array_equal(live.observation.state, flown[0])
    env = quadsim.gym.make_env(scenario, action="speeds", observation=("state", "command"))
    for _ in range(2):
        observation, _ = env.reset(seed=1)
        np.testing.assert_allclose(observation[:12], flown[0], rtol=1e-6)
        np.testing.assert_array_equal(observation[12:], STOPPED)
        env.step(np.full(4, 200.0, np.float32))
    env.close()


def test_sweeps_and_campaigns_draw_the_start() -> None:
    """A vector as a whole, by its numbers, or a list of speeds."""
    scenario = thrown(duration=0.1)
    ahead = [0.0, 1.0, 3.0]
    table = quadsim.sweep(scenario, {"initial.velocity.0": ahead}, progress=False)
    assert table.to_pandas()["initial.velocity.0"].tolist() == ahead
    entries = [
        {"fields": ["initial.velocity.0"], "distribution": "uniform", "low": -3.0, "high": 3.0},
        {
            "fields": ["initial.body_rates.0", "initial.body_rates.1"],
            "distribution": "uniform",
            "low": -9.0,
            "high": 9.0,
        },
        {"fields": ["initial.rotor_speeds"], "distribution": "choice", "values": [STOPPED, [90.0] * 4]},
    ]
    vary = [{"name": f"draw{i}", **entry} for i, entry in enumerate(entries)]
    plan = make_plan(scenario, {"flights": 8, "vary": vary})
    starts = [plan.of(flight).initial for flight in range(8)]
    assert len({start.velocity[0] for start in starts}) == 8
    assert all(start.velocity[1:] == VELOCITY[1:] for start in starts)
    assert all(start.body_rates[0] == start.body_rates[1] and start.body_rates[2] == 200.0 for start in starts)
    assert {start.rotor_speeds for start in starts} == {(0.0,) * 4, (90.0,) * 4}


def test_a_start_at_rest_is_the_start_without_the_fields() -> None:
    scenario = load_scenario("hover").replace({"duration": 0.5})
    hover = [quadsim.load_vehicle("lopes2011").hover_speed] * 4
    at_rest = {"initial.velocity": [0.0] * 3, "initial.body_rates": [0.0] * 3, "initial.rotor_speeds": hover}
    one, other = (quadsim.fly(each, progress=False).log for each in (scenario, scenario.replace(at_rest)))
    assert one.plant.state.tobytes() == other.plant.state.tobytes()
    assert one.control.speeds.tobytes() == other.control.speeds.tobytes()


@pytest.mark.parametrize(
    ("changes", "allowed"),
    [
        ({"initial.velocity": [0.5, 0.0, 0.0]}, True),  # along the floor
        ({"initial.velocity": [0.0, 0.0, 2.0]}, True),
        ({"initial.body_rates": [0.0, 0.0, 90.0]}, True),
        ({"initial.velocity": [0.0, 0.0, -0.1]}, False),
        ({"initial.body_rates": [90.0, 0.0, 0.0]}, False),
        ({"initial.body_rates": [90.0, 0.0, 0.0], "initial.velocity": [0.0, 0.0, 2.0]}, True),  # faster than its feet
    ],
)
def test_on_the_floor_no_part_starts_into_it(changes: dict[str, Any], allowed: bool) -> None:
    floor = {"effects.ground": {"contact": True}, "initial.position": [0.0] * 3, **changes}
    if allowed:
        load_scenario("hover", floor)
    else:
        with pytest.raises(InputError, match="floor"):
            load_scenario("hover", floor)
