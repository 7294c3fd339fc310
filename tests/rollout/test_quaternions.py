"""Flights that may turn upside down: what is logged of their attitude, and what controllers receive of it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from quadsim.controller import Command, StepInputs
from quadsim.flight.parquet import read_log, write_log
from quadsim.mpc.guard.contract import completed_inputs
from quadsim.mpc.problem.rigidbody import thrust_axis
from quadsim.rollout.flown import Flight
from quadsim.rollout.rollout import Rollout
from quadsim.rotation import euler_to_body_rates, euler_to_quaternion, quaternion_to_euler
from quadsim.scenarios.loading import load_scenario
from quadsim.sim.physics import physics_to_state
from quadsim.state import ANGLE_RATES, ANGLES, INDEX, N_STATES, Array, YawUnwrapper, tilt


@pytest.fixture(scope="module")
def inverted() -> Flight:
    return Rollout(load_scenario("inverted-start", ["duration=1", *ARRIVED])).fly()


ARRIVED = [f"constraints.{name}.start=0.9" for name in ("back_upright", "back_in_height")]


class Listener:
    """Holds the rotors at one speed and keeps what it is given."""

    name = "listener"
    solver = ""
    horizon = 1

    def reset(self, speeds: Array) -> None:
        self.speeds = speeds
        self.heard = list[tuple[StepInputs, Array]]()

    def step(self, now: StepInputs, state: Array, reference: Array) -> Command:
        self.heard.append((now, state))
        return Command(speeds=self.speeds, plan=self.speeds[None])


def test_attitude_and_body_rates_are_logged_and_read_back(inverted: Flight, tmp_path: Path) -> None:
    log = inverted.log
    write_log(tmp_path, log, plant_stride=5, metadata={})
    again = read_log(tmp_path)
    assert again.control.attitude is not None
    assert again.plant.attitude is not None
    np.testing.assert_array_equal(again.control.attitude, log.control.attitude)
    np.testing.assert_array_equal(again.control.body_rates, log.control.body_rates)
    assert log.plant.attitude is not None
    np.testing.assert_array_equal(again.plant.attitude, log.plant.attitude[::5])
    assert np.abs(np.diff(log.plant.attitude, axis=0)).max() < 0.05  # without a jump of the sign
    np.testing.assert_allclose(tilt(log.plant.state), np.arccos(thrust_axis(log.plant.attitude)[:, 2]), atol=1e-6)
    assert np.degrees(tilt(log.plant.state)).max() == pytest.approx(180.0, abs=0.1)


@pytest.mark.slow("library")
def test_a_loop_by_sensors_is_flown_audited_and_logged(fly_once: Callable[..., Flight]) -> None:
    flight = fly_once("power-loop")
    assert flight.outcome == "satisfied"
    log = flight.log
    assert np.degrees(tilt(log.plant.state)).max() > 170.0
    yaw = np.degrees(log.plant.state[:, INDEX["yaw"]])
    assert abs(yaw[-1]) < 2.0  # as before the loop, in the plant, and at the samples as measured
    assert abs(np.degrees(log.control.state[-1, INDEX["yaw"]])) < 2.0
    rmse = flight.summary["estimation"]["rmse"]
    assert all(rmse[name] < np.radians(0.3) for name in ("roll", "pitch", "yaw"))
    assert np.degrees(np.abs(log.control.measured_error[:, ANGLES])).max() < 1.0  # past the vertical, too


@pytest.mark.parametrize("way", [1.0, -1.0])
def test_yaw_after_a_loop_is_that_before(way: float) -> None:
    """Through the vertical Euler's yaw turns by 180 deg; noise decides which way."""
    rng = np.random.default_rng(3)
    angle = way * np.linspace(0.0, 2.0 * np.pi, 200)
    before = 2.0 * np.pi + 0.3
    half = 0.5 * angle
    heading = euler_to_quaternion(np.array([0.0, 0.0, before]))
    turned = [_product(heading, np.array([np.cos(a), 0.0, np.sin(a), 0.0])) for a in half]
    noisy = np.array(turned) + 1e-3 * rng.normal(size=(200, 4))
    noisy /= np.linalg.norm(noisy, axis=1, keepdims=True)
    physics = np.zeros((200, 14))
    physics[:, 4:8] = noisy
    yaw = physics_to_state(physics, before)[:, INDEX["yaw"]]
    assert yaw[0] == pytest.approx(before, abs=0.02)
    assert yaw[-1] == pytest.approx(before, abs=0.02)
    turns = YawUnwrapper(before)
    np.testing.assert_allclose([turns.unwrapped(euler) for euler in quaternion_to_euler(noisy)], yaw, atol=1e-9)


def _product(p: Array, q: Array) -> Array:
    return np.concatenate([[p[0] * q[0] - p[1:] @ q[1:]], p[0] * q[1:] + q[0] * p[1:] + np.cross(p[1:], q[1:])])


@pytest.mark.parametrize("name", ["hover", "raw-sensors", "motion-capture"])
def test_controllers_receive_the_attitude_that_belongs_to_their_state(name: str) -> None:
    law = Listener()
    Rollout(load_scenario(name, ["duration=1"]), law).fly()
    before = None
    for now, state in law.heard:
        assert now.attitude is not None
        assert now.body_rates is not None
        euler = quaternion_to_euler(now.attitude)
        turned = np.angle(np.exp(1j * (euler - state[ANGLES])))
        np.testing.assert_allclose(turned, 0.0, atol=1e-9)
        np.testing.assert_allclose(euler_to_body_rates(state[ANGLES], state[ANGLE_RATES]), now.body_rates, atol=1e-9)
        assert before is None or before @ now.attitude > 0.0
        before = now.attitude


def test_predicted_channels_are_not_passed_on_as_measured() -> None:
    now = StepInputs(attitude=np.array([1.0, 0.0, 0.0, 0.0]), body_rates=np.ones(3))
    known = np.zeros(N_STATES)
    seen = np.zeros(N_STATES)
    whole = completed_inputs(now, np.ones(4), seen, known)
    assert whole.attitude is now.attitude
    assert whole.body_rates is now.body_rates
    for channels, attitude, rates in ((ANGLES, None, now.body_rates), (ANGLE_RATES, now.attitude, None)):
        unseen = seen.copy()
        unseen[channels] = 1.0
        partly = completed_inputs(now, np.ones(4), unseen, known)
        assert partly.attitude is attitude
        assert partly.body_rates is rates
    steep = known.copy()
    steep[8] = 1.55  # where rates of Euler angles are beyond belief, those of the body are not
    assert completed_inputs(now, np.ones(4), unseen, steep).body_rates is now.body_rates
