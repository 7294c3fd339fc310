"""Ramped courses and their reference motion: published check values, flatness, and what does not go together."""

from __future__ import annotations

import math
import tomllib
from typing import Any

import numpy as np
import pytest

from quadsim.motion import Motion
from quadsim.mpc.problem.flatness import attitudes, motion_along
from quadsim.rotation import quaternion_to_euler
from quadsim.scenarios.assembly import Assembly
from quadsim.scenarios.loading import load_scenario
from quadsim.scenarios.schema.problems import ScenarioError
from quadsim.scenarios.schema.scenario import Scenario
from quadsim.state import Array
from quadsim.vehicle import Vehicle

PERIOD = 0.02
# Of the specification of the paper's simulation: sample, position, quaternion, velocity, body rates, thrusts over 20 N.
CHECKS: dict[str, dict[int, str]] = {
    "torrente-loop8-ideal": {
        0: "0 0 1 1 0 0 0 0 0 0 0 0.001257 0 0.122483 0.122767 0.122767 0.122483",
        100: "0.613333 -0.03776 1 0.998657 0.016473 0.04912 -0.000658 1.002372 -0.123893 0 "
        "0.060734 -0.011098 -0.000036 0.123373 0.122977 0.123173 0.123624",
        500: "4.876984 -6.102281 1 0.529202 0.298282 -0.346093 -0.714978 -1.82388 -8.069667 0 "
        "0.102196 -1.387647 0.000119 0.213968 0.213711 0.206847 0.207541",
        999: "-1.84707 -9.646324 1 -0.276701 -0.000013 0.000001 -0.960956 0 0 0 "
        "-0.000684 0.003709 0 0.122739 0.12246 0.122511 0.12279",
    },
    "torrente-lemniscate8-ideal": {
        100: "-0.03776 0.608701 1 0.998885 -0.044234 -0.016486 0.000684 -0.123893 0.979605 0 "
        "0.045665 -0.060887 0.00005 0.122879 0.12263 0.123491 0.123695",
        500: "-6.102281 -1.075161 1 0.848429 -0.356415 0.242788 0.306904 -8.069667 -7.469042 0 "
        "-1.943781 2.871643 -0.004176 0.213241 0.082275 0.181419 0.304061",
    },
}


def motion_of(scenario: Scenario) -> tuple[Motion, Vehicle]:
    vehicle = Assembly(scenario).vehicle
    motion = Assembly(scenario).motion
    assert motion is not None
    return motion, vehicle


def changed(**fields: Any) -> Scenario:
    base = load_scenario("torrente-loop8-ideal")
    return base.replace({f"reference.{name}": value for name, value in fields.items()})


@pytest.mark.parametrize("fields", [{"speed": 6.0}, {"speed": 6.005, "ramp": 1.99}, {"start": 1.5}, {"sampling": 0.03}])
def test_a_flight_without_a_duration_ends_with_its_course(fields: dict[str, float]) -> None:
    scenario = changed(**fields)
    least = Assembly(scenario).course.end + scenario.reference.sampling  # type: ignore[union-attr]
    assert least - 1e-9 <= scenario.duration < least + scenario.control_period
    again = Scenario.parse(tomllib.loads(scenario.to_toml()))
    assert again == scenario
    slower = {"reference.speed": 5.0}
    assert again.replace(slower).duration == scenario.replace(slower).duration != scenario.duration


def test_turns_end_a_flight_too() -> None:
    eight = load_scenario("hummingbird-figure-eight").replace({"duration": None, "reference.response_time": 0.0})
    assert abs(eight.duration - Assembly(eight).course.end) <= eight.control_period
    with pytest.raises(ScenarioError, match="duration"):
        eight.replace({"duration": None, "reference.turns": 1e5, "control_period": 0.05, "plant.timestep": 0.01})


@pytest.mark.parametrize("name", CHECKS)
def test_the_motion_is_that_of_the_specification(name: str) -> None:
    motion, _ = motion_of(load_scenario(name))
    assert len(motion) == 1000
    for k, text in CHECKS[name].items():
        rows = (motion.position, motion.attitude, motion.velocity, motion.body_rates, motion.thrusts / 20.0)
        np.testing.assert_allclose(np.concatenate([row[k] for row in rows]), [*map(float, text.split())], atol=6e-7)


@pytest.mark.parametrize("heading", ["free", "held"])
@pytest.mark.parametrize("name", ["loop8", "lemniscate8"])
def test_the_motion_is_flat(name: str, heading: str) -> None:
    """The thrust axis carries a + g; rates are those of the attitudes; torque and thrust are those of the rotors."""
    motion, vehicle = motion_of(load_scenario(f"torrente-{name}-ideal", [f"reference.heading={heading}"]))
    w, x, y, z = motion.attitude.T
    axis = np.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], axis=1)
    collective = motion.thrusts.sum(axis=1)
    pushed = collective[:, None] / vehicle.mass * axis - [0.0, 0.0, vehicle.gravity]
    np.testing.assert_allclose(pushed, motion.acceleration, atol=1e-10)
    np.testing.assert_allclose(np.linalg.norm(motion.attitude, axis=1), 1.0, atol=1e-14)
    assert (motion.attitude[1:] * motion.attitude[:-1]).sum(axis=1).min() > 0.99
    half = motion.velocity[2:] - motion.velocity[:-2]  # central differences of the exact velocities
    np.testing.assert_allclose(half / (2 * PERIOD), motion.acceleration[1:-1], atol=0.15)
    if heading == "free":
        assert np.abs(motion.body_rates[:, 2]).max() < 0.09
    else:  # body y at a right angle to world x
        np.testing.assert_allclose(2 * (x * y - w * z), 0.0, atol=1e-12)


def test_a_free_heading_drifts_as_specified_and_the_reference_has_its_yaw() -> None:
    scenario = load_scenario("torrente-loop8-ideal")
    motion, _ = motion_of(scenario)
    reference = Assembly(scenario).reference(1010)
    euler = quaternion_to_euler(motion.attitude)
    np.testing.assert_allclose(np.angle(np.exp(1j * (reference[:1000, 3] - euler[:, 2]))), 0.0, atol=1e-9)
    assert reference[999, 3] == pytest.approx(-3.7023, abs=1e-3)  # at rest and level, yaw is the heading
    np.testing.assert_array_equal(reference[999:], np.tile(reference[999], (11, 1)))


def test_the_heading_begins_at_the_initial_yaw() -> None:
    """A turned start turns body rates and attitudes with it, and nothing else."""
    base = load_scenario("torrente-loop8-ideal")
    turned = base.replace({"initial.euler": [0.0, 0.0, 40.0]})
    (plain, _), (other, _) = motion_of(base), motion_of(turned)
    np.testing.assert_allclose(other.position, plain.position, atol=1e-12)
    cos = math.cos(math.radians(40.0))
    sin = math.sin(math.radians(40.0))
    x, y, z = plain.body_rates.T
    np.testing.assert_allclose(other.body_rates, np.stack([cos * x + sin * y, cos * y - sin * x, z], axis=1), atol=1e-9)


def test_it_waits_for_its_start_at_rest() -> None:
    scenario = load_scenario("torrente-loop8-ideal", ["reference.start=1.0", "duration=22.0"])
    motion, _ = motion_of(scenario)
    assert len(motion) == 1050
    np.testing.assert_array_equal(motion.velocity[:50], 0.0)
    later = motion.after(50)
    plain, _ = motion_of(load_scenario("torrente-loop8-ideal"))
    np.testing.assert_allclose(later.position, plain.position, atol=1e-12)
    np.testing.assert_allclose(later.attitude, plain.attitude, atol=1e-12)


def test_a_flight_starts_in_the_state_of_the_reference() -> None:
    scenario = load_scenario("torrente-loop8-ideal")
    motion, _ = motion_of(scenario)
    state = Assembly(scenario).initial_state(motion)
    np.testing.assert_allclose(state, [0, 0, 0, 0, 1, 0, 0, 0, 0, 0.001257, 0, 0], atol=6e-7)
    at_rest = scenario.replace({"initial.on_reference": False})
    np.testing.assert_array_equal(Assembly(at_rest).initial_state(motion)[5:], 0.0)


def test_flatness_of_a_hover_that_turns() -> None:
    """A heading held along a turning direction leaves its rate about body z, and the torque of its acceleration."""
    vehicle = Assembly(load_scenario("torrente-loop4-ideal")).vehicle
    t = PERIOD * np.arange(200)
    yaw: Array = 0.4 * t**2
    still = np.zeros((200, 3))
    motion = motion_along(still, still, still, period=PERIOD, vehicle=vehicle, yaw=yaw)
    np.testing.assert_allclose(motion.body_rates[2:-2, 2], 0.8 * t[2:-2], atol=1e-3)
    torque_z = motion.thrusts @ (vehicle.allocation[3] / vehicle.thrust_coefficient)
    np.testing.assert_allclose(torque_z[4:-4], 0.06 * 0.8, atol=1e-3)
    attitude, _ = attitudes(still, period=PERIOD, gravity=9.81, yaw=0.7)
    np.testing.assert_allclose(quaternion_to_euler(attitude)[:, 2], 0.7)
