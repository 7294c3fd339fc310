"""The moment of the air on the rotors: what laws and the estimator gain that know it, or that estimate it."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy_laws import inflow_moment, rotor_moment
from scipy.spatial.transform import Rotation
from uneven import published

import quadsim
from quadsim.errors import InputError
from quadsim.flight.log import FlightLog
from quadsim.mpc.laws.geometric import Geometric, GeometricController, Integrals
from quadsim.mpc.laws.nonlinear import Nonlinear
from quadsim.mpc.laws.parts.attitude import motion_of
from quadsim.mpc.laws.parts.nonlinear_mpc import NonlinearMPC
from quadsim.mpc.laws.parts.preview import Target
from quadsim.rollout.flown import Flight
from quadsim.rollout.rollout import Rollout
from quadsim.rotation import euler_to_body_rates
from quadsim.scenarios.schema.scenario import Scenario
from quadsim.state import ANGLE_RATES, ANGLES

MOMENT = 1e-5
DAMPING = 5e-3
VEHICLE = {"vehicle.rotor_moment": [MOMENT, MOMENT], "vehicle.rate_damping": [DAMPING] * 3}
AIR = {"rotor_drag": 0.0, "body_drag": [1e-9] * 3}  # nothing but the moment
FEEDFORWARD: dict[str, Any] = {"type": "geometric", "feedforward": True, "horizon": 20}
TILT = [{"name": "tilt", "signal": "tilt", "upper": 60.0}]


def figure_eight(**controller: Any) -> Scenario:
    law = {"controller": FEEDFORWARD | controller, "control_period": 0.02, "constraints": TILT}
    of_course = {"reference.period": 5.0, "duration": 12.0}
    return quadsim.load("hummingbird-figure-eight").replace(VEHICLE | {"effects.air": AIR} | law | of_course)


def test_the_model_is_that_of_the_plant() -> None:
    """With rotors that turn alike, whatever the motion."""
    vehicle = quadsim.load_vehicle("hummingbird")
    rng = np.random.default_rng(3)
    vehicle = replace(vehicle, rotor_moment=(2e-5, -3e-5), inflow_moment=(3e-3, -4e-3), rate_damping=(0.1, 0.2, 0.3))
    velocity, rates = rng.normal(size=(2, 3))
    expected = rotor_moment(vehicle, (2e-5, -3e-5), np.full(4, 400.0), Rotation.identity(), velocity, rates)
    expected += inflow_moment((3e-3, -4e-3), Rotation.identity(), velocity) - np.array([0.1, 0.2, 0.3]) * rates
    np.testing.assert_allclose(vehicle.air_moment(1600.0, velocity, rates), expected, atol=1e-15)


def position_error(flight: Flight) -> float:
    return math.hypot(*(flight.metrics[f"rmse.{axis}"] for axis in "xyz"))


@pytest.mark.slow("air")
@pytest.mark.representative("air")
def test_geometric_control_that_knows_it_follows_a_figure_eight_ten_times_as_closely() -> None:
    without, knowing = (quadsim.fly(figure_eight(**known), progress=False) for known in ({}, {"moment": True}))
    assert (without.outcome, knowing.outcome) == ("satisfied", "satisfied")
    assert position_error(without) > 0.08
    assert position_error(knowing) < 0.1 * position_error(without)


@pytest.mark.slow("air")
@pytest.mark.parametrize("inputs", ["thrust", "speed"])
def test_nonlinear_mpc_that_predicts_it_follows_a_circle_twenty_times_as_closely(inputs: str) -> None:
    """At 4 m/s; without it, the error is that of a torque that nothing balances."""
    course = quadsim.load("torrente-loop4-ideal")
    course = course.replace(
        {
            **{"vehicle.rotor_moment": [5.5e-5] * 2, "vehicle.rate_damping": [0.015] * 3},
            **{"effects.air": {"rotor_drag": 0.0}, "controller.inputs": inputs, "constraints": []},
        }
    )
    errors = [
        position_error(quadsim.fly(course.replace({"controller.moment": known}), progress=False))
        for known in (False, True)
    ]
    assert errors[0] > 0.05
    assert errors[1] < 0.05 * errors[0]


@pytest.mark.slow("air")
def test_its_observer_does_not_estimate_again_what_it_knows() -> None:
    """Of the observed torque, averaged over the flight, hardly anything is left."""
    left = []
    for known in ({}, {"moment": True}):
        with Rollout(figure_eight(disturbance={}, **known)) as rollout:
            seen: list[np.ndarray] = []
            law = rollout.loop.controller.law  # type: ignore[attr-defined]
            assert isinstance(law, GeometricController)
            assert law.observer is not None
            law.observer.log = lambda now, seen=seen, of=law.observer.foreseen: seen.append(of(0.01)[2])  # type: ignore[method-assign,misc]
            rollout.fly()
        left.append(float(np.sqrt(np.mean(np.square(seen)))))
    assert left[1] < 0.2 * left[0]


@pytest.mark.slow("air")
def test_the_estimator_that_knows_it_estimates_rates_without_a_gyro_better() -> None:
    sensing = {
        "sensors": {"position": {"rate": 100.0, "noise": 0.01}, "attitude": {"rate": 50.0, "noise": 1.0}},
        "estimator": {"type": "error_state", "acceleration_noise": 0.1, "angular_acceleration_noise": 0.3},
    }
    errors = []
    for known in (False, True):
        flight = quadsim.fly(figure_eight(moment=True).replace(sensing | {"estimator.moment": known}), progress=False)
        errors.append(rate_error(flight.log))
    assert errors[0] > 0.1
    assert errors[1] < 0.4 * errors[0]


def rate_error(log: FlightLog) -> float:
    """RMS error of the estimated body rates [rad/s]."""
    estimated, true = (
        euler_to_body_rates(x[:, ANGLES], x[:, ANGLE_RATES]) for x in (log.control.state, log.control.truth)
    )
    return float(np.sqrt(np.mean(np.square(estimated - true)[50:, :2])))


@pytest.mark.slow("air")
def test_linear_mpc_takes_it_through_its_disturbance_also_in_wind() -> None:
    """Hovering in wind, J^-1 m W v is a constant torque: the observer finds it, and the offset disappears."""
    wind = (3.0, -2.0)
    vehicle = quadsim.load_vehicle("hummingbird")
    hover = quadsim.load("hover").replace(
        {
            "vehicle": {"file": "hummingbird"},
            "control_period": 0.025,
            "duration": 8.0,
            "constraints": TILT,
            "effects.air": AIR | {"rotor_moment": [MOMENT, MOMENT], "wind": [*wind, 0.0]},
            "controller": {
                **{"type": "robust", "horizon": 30, "input_weights": {"speed": 1e-4}},
                "output_weights": {"x": 5.0, "y": 5.0, "z": 100.0, "yaw": 5.0},
                "input_bounds": {"speed": [0.0, 838.0], "slew": [-300.0, 300.0]},
                "output_bounds": {"roll": [-30.0, 30.0], "pitch": [-30.0, 30.0]},
            },
        }
    )
    ends = []
    found = np.empty(6)
    for settings in ({}, {"controller.offset_free": {}}):
        with Rollout(hover.replace(settings)) as rollout:
            flight = rollout.fly()
            found = rollout.loop.controller.law.disturbance  # type: ignore[attr-defined]
        ends.append(math.hypot(flight.metrics["final_error.x"], flight.metrics["final_error.y"]))
    assert ends[0] > 0.1
    assert ends[1] < 1e-3
    torque = replace(vehicle, rotor_moment=(MOMENT, MOMENT)).air_moment(
        4.0 * vehicle.hover_speed, np.array([-wind[0], -wind[1], 0.0]), np.zeros(3)
    )
    np.testing.assert_allclose(found[3:], torque / vehicle.inertia, rtol=5e-3, atol=1e-6)


def test_an_unknown_moment_is_refused() -> None:
    with pytest.raises(InputError, match=r"controller\.moment"):
        GeometricController(published("deadcat"), 0.02, Geometric(feedforward=True, moment=True))
    with pytest.raises(InputError, match="moment"):
        Geometric(moment=True)
    with pytest.raises(InputError, match=r"controller\.moment"):
        NonlinearMPC(published("deadcat"), period=0.02, settings=Nonlinear(moment=True))
    with pytest.raises(ValueError, match="moment"):
        Nonlinear(moment=True, commands="rates")
    with pytest.raises(InputError, match=r"estimator\.moment"):
        quadsim.fly(quadsim.load("satellite-navigation").replace({"estimator.moment": True}), progress=False)


def test_the_law_balances_it_at_the_motion_of_the_reference() -> None:
    vehicle = quadsim.load_vehicle("hummingbird")
    vehicle = replace(vehicle, rotor_moment=(MOMENT, MOMENT))
    target = Target(
        **{name: np.array(value) for name, value in {"position": [0.0] * 3, "velocity": [2.0, -1.0, 0.0]}.items()},
        **{"acceleration": np.zeros(3), "yaw": 0.0, "yaw_rate": 0.0, "yaw_acceleration": 0.0},
    )
    state = np.zeros(12)
    state[[1, 3]] = 2.0, -1.0
    wrenches = [
        GeometricController(vehicle, 0.02, Geometric(feedforward=True, moment=known)).wrench(
            motion_of(state), target, Integrals(translation=np.zeros(3), rotation=np.zeros(3))
        )[0]
        for known in (False, True)
    ]
    turning = 4.0 * vehicle.hover_speed
    np.testing.assert_allclose(
        wrenches[0][1:] - wrenches[1][1:], MOMENT * turning * np.array([-1.0, -2.0, 0.0]), atol=1e-12
    )
