"""Attitudes as commands: what the autopilot makes of them is what the law asked for and what its model predicts."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import scipy.integrate

import quadsim
from quadsim.controller import StepInputs
from quadsim.errors import ExportError, InputError, ParameterError
from quadsim.features.export.exporter import c_controller
from quadsim.mpc.laws.nonlinear import Nonlinear
from quadsim.mpc.laws.parts.builders import build
from quadsim.mpc.pilot.attitudes import AttitudeTargets
from quadsim.mpc.problem.model import target_model
from quadsim.mpc.problem.rigidbody import inner_response
from quadsim.rotation import exponential, multiply
from quadsim.scenarios.assembly import Assembly
from quadsim.sim.autopilot import Autopilot, AutopilotSettings, identify_attitude_lags, identify_lags
from quadsim.state import INDEX
from quadsim.vehicle import Vehicle

LAGS = (0.12, 0.1, 0.5)
RATE_LAG = 0.035
ATTITUDE_LAG = 0.085
CIRCLE: dict[str, Any] = {
    "control_period": 0.02,
    "duration": 6.0,
    "reference": {
        "type": "ramped_circle",
        "radius": 2.0,
        "speed": 3.0,
        "acceleration": 2.0,
        "ramp": 0.5,
        "start": 0.5,
    },
    "controller": {"type": "nonlinear", "commands": "attitude", "node": 0.04, "terminal": "lqr"},
    "plant.limit_speeds": True,
    "autopilot": {},
    "effects.rotors": {},
    "constraints": [],
}


@pytest.mark.parametrize("attitude", [(1.0, 0.0, 0.0, 0.0), exponential((0.7, -0.4, 2.0))], ids=["level", "turned"])
def test_the_error_of_a_target_commands_the_body_rates(attitude: tuple[float, ...]) -> None:
    """2 vec(q* q_c) / tau_a, as the autopilot computes it."""
    q = np.array(attitude)
    command = np.array([7.0, 1.5, -0.8, 0.3])
    targets = AttitudeTargets(LAGS)
    target = targets.target(command, q)
    assert target[:4].tolist() == [7.0, 0.0, 0.0, 0.0]
    assert np.linalg.norm(target[4:]) == pytest.approx(1.0)
    error = multiply(q * [1.0, -1.0, -1.0, -1.0], target[4:])
    np.testing.assert_allclose(2.0 * error[1:] / LAGS, command[1:], rtol=1e-12)
    another = AttitudeTargets(LAGS)
    np.testing.assert_allclose(another.command(target, q), command, rtol=1e-12)
    np.testing.assert_allclose(another.command(np.append(target[:4], -target[4:]), q), command, rtol=1e-12)


def test_of_a_target_of_its_own_it_knows_what_was_asked_for_wherever_the_body_is_now() -> None:
    command = np.array([7.0, 1.5, -0.8, 0.3])
    targets = AttitudeTargets(LAGS)
    target = targets.target(command, np.array([1.0, 0.0, 0.0, 0.0]))
    turned = np.array(exponential((0.1, 0.0, 0.0)))
    assert targets.command(target, turned).tolist() == command.tolist()
    targets.reset()
    assert targets.command(target, turned)[1] < 1.5 - 0.5


def test_an_error_of_more_than_half_a_turn_does_not_exist() -> None:
    target = AttitudeTargets(LAGS).target(np.array([7.0, 40.0, 0.0, 0.0]), np.array([1.0, 0.0, 0.0, 0.0]))
    np.testing.assert_allclose(target[4:], [0.0, 1.0, 0.0, 0.0], atol=1e-12)


def test_the_shares_of_the_inner_loop_solve_its_equation() -> None:
    times = 0.01 * np.arange(6)

    def slope(time: float, motion: list[float]) -> list[float]:
        turn, rate = motion
        return [rate, (0.7 - turn / ATTITUDE_LAG - rate) / RATE_LAG]

    solution = scipy.integrate.solve_ivp(slope, (0.0, times[-1]), [0.0, -0.3], t_eval=times, rtol=1e-10, atol=1e-12)
    left, taken = inner_response(0.01, 6, RATE_LAG, ATTITUDE_LAG)
    np.testing.assert_allclose(-0.3 * left + 0.7 * (1.0 - left - taken), solution.y[1], atol=1e-9)


@pytest.mark.parametrize("lag", [0.0, RATE_LAG])
def test_rates_alone_follow_with_their_lag(lag: float) -> None:
    """The limit of an attitude's lag without end."""
    left, taken = inner_response(0.01, 6, lag, None)
    slow_left, slow_taken = inner_response(0.01, 6, lag, 1e6)
    assert not taken.any()
    np.testing.assert_allclose(slow_left, left, atol=2e-3 if lag else 1.0 + 1e-9)
    np.testing.assert_allclose((1.0 - slow_left - slow_taken)[1:], (1.0 - left)[1:], atol=1e-6)


def test_the_hover_model_of_an_attitude_is_that_equation(vehicle: Vehicle) -> None:
    model = target_model(vehicle, 0.02, (0.0, RATE_LAG, RATE_LAG, 0.1), (ATTITUDE_LAG, ATTITUDE_LAG, 0.3))
    left, taken = inner_response(0.02, 2, RATE_LAG, ATTITUDE_LAG)
    rate = INDEX["roll_rate"]
    assert model.A[rate, rate] == pytest.approx(left[1])
    assert model.B[rate, 1] == pytest.approx(1.0 - left[1] - taken[1])


def test_lags_are_one_over_the_gain_of_the_attitude(vehicle: Vehicle) -> None:
    """Near it: what the rate loop's overshoot and the rotors add is in the fitted number."""
    settings = AutopilotSettings(attitude=(8.0, 6.0, 2.0))
    autopilot = Autopilot(vehicle, settings)
    rate_lags = identify_lags(vehicle, autopilot)[1:]
    lags = identify_attitude_lags(vehicle, autopilot, rate_lags)
    assert lags == pytest.approx([1.0 / 8.0, 1.0 / 6.0, 1.0 / 2.0], rel=0.25)


def test_an_attitude_that_is_not_reached_is_an_error(vehicle: Vehicle) -> None:
    autopilot = Autopilot(vehicle, AutopilotSettings(attitude=(8.0, 0.01, 2.0)))
    with pytest.raises(InputError, match="a step of pitch is not reached, so no lag fits it; state attitude_lag"):
        identify_attitude_lags(vehicle, autopilot, (0.03, 0.03, 0.05))


@pytest.fixture(scope="module", params=["hummingbird", "crazyflie2"])
def flights(request: pytest.FixtureRequest) -> dict[str, quadsim.Flight]:
    speed = {"hummingbird": 3.0, "crazyflie2": 1.5}[request.param]
    changes = CIRCLE | {"vehicle": {"file": request.param}}
    scenario = quadsim.load("hover").replace(changes).replace({"reference.speed": speed})
    return {
        commands: quadsim.fly(scenario.replace({"controller.commands": commands}), progress=False)
        for commands in ("rates", "attitude")
    }


def test_attitudes_fly_a_circle_nearly_as_well_as_body_rates(flights: dict[str, quadsim.Flight]) -> None:
    """Within twice the error, and below a centimetre."""
    errors = {}
    for commands, flight in flights.items():
        assert flight.log.reason is None
        errors[commands] = [flight.numbers["tracking"]["rmse"][axis] for axis in "xyz"]
    assert max(errors["attitude"]) < 0.01
    assert np.linalg.norm(errors["attitude"]) < 2.0 * np.linalg.norm(errors["rates"])


def test_what_is_recorded_are_the_attitudes_and_no_rates(flights: dict[str, quadsim.Flight]) -> None:
    control = flights["attitude"].log.control
    assert control.target is not None
    assert control.target_attitude is not None
    assert not control.target[:, 1:].any()
    np.testing.assert_allclose(np.linalg.norm(control.target_attitude, axis=1), 1.0)
    flown = flights["attitude"].summary["controller"]["autopilot"]
    assert len(flown["attitude_lag"]) == 3
    assert "attitude_lag" not in flights["rates"].summary["controller"]["autopilot"]


def test_the_prediction_over_a_period_is_what_is_flown(flights: dict[str, quadsim.Flight]) -> None:
    """Of the attitude's rates: to a few percent of what they change."""
    errors = {}
    for commands, flight in flights.items():
        predicted = flight.log.foreseen
        assert predicted is not None
        rows = slice(60, -10)
        errors[commands] = np.abs(
            predicted[:-1, INDEX["roll_rate"]] - flight.log.control.state[1:, INDEX["roll_rate"]]
        )[rows].mean()
    assert errors["attitude"] < 3.0 * errors["rates"] + 0.02


def test_a_law_without_measured_attitude_turns_from_the_predicted_one(vehicle: Vehicle) -> None:
    table = Nonlinear(commands="attitude", inner_lag=(0.02, 0.03, 0.03, 0.1), attitude_lag=LAGS, horizon=10)
    pilot = build(table, vehicle, 0.02)
    pilot = type(pilot)(pilot.law, vehicle, guard=pilot.guard, inner=Autopilot(vehicle), attitudes=pilot.attitudes)
    pilot.reset(vehicle.hover_speeds)
    reference = np.zeros((10, 4))
    state = np.zeros(12)
    state[INDEX["roll"]] = 0.2
    pilot.step(StepInputs(time=0.0), state, reference)
    state[6:] = math.nan
    command = pilot.step(StepInputs(time=0.02), state, reference)
    assert np.isfinite(command.speeds).all()
    assert np.linalg.norm(command.speeds[4:]) == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"controller.attitude_lag": [0.1, 0.1]}, "attitude_lag"),
        ({"controller.attitude_lag": [0.1, 0.0, 0.1]}, "attitude_lag"),
        ({"controller.commands": "rates", "controller.attitude_lag": [0.1, 0.1, 0.1]}, "attitude_lag must be absent"),
        ({"controller.delay": 0.01}, 'delay must be zero where commands = "attitude"'),
        (
            {"computation": {"delay": 0.005, "plan": True}},
            r"computation\.plan must be false where controller\.commands",
        ),
    ],
)
def test_wrong_numbers_are_one_message(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        quadsim.fly(quadsim.load("hover").replace(CIRCLE).replace(changes), progress=False)


def test_a_table_alone_needs_the_lag(vehicle: Vehicle) -> None:
    with pytest.raises(ParameterError, match="attitude_lag must be three time constants"):
        build(Nonlinear(commands="attitude", inner_lag=(0.02, 0.03, 0.03, 0.1)), vehicle, 0.02)


def test_it_is_not_exported() -> None:
    with pytest.raises(ExportError, match='commands = "attitude"; exported are "rotors" and "rates"'):
        c_controller(Assembly(quadsim.load("hover").replace(CIRCLE)))


@pytest.mark.parametrize(
    ("commands", "words"),
    [
        ("rates", "neither a Command nor T, p, q, r: collective thrust"),
        ("attitude", "neither a Command nor T, p, q, r, w, x, y, z: collective"),
    ],
)
def test_an_answer_of_the_wrong_size_is_told_what_the_numbers_are(commands: str, words: str) -> None:
    class Short:
        def step(self, now: Any, state: Any, reference: Any) -> list[float]:
            return [1.0, 2.0]

    law = Short()
    law.commands = commands  # type: ignore[attr-defined]
    flight = quadsim.fly(quadsim.load("hover").replace({"duration": 0.2}), controller=law, progress=False)
    assert flight.log.reason is not None
    assert words in flight.log.reason
