"""The linear MPC above an autopilot: thrust and body rates, or thrust and an attitude."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import scipy.integrate

import quadsim
from quadsim.controller import StepInputs
from quadsim.errors import ExportError, InputError
from quadsim.features.export.exporter import c_controller
from quadsim.mpc.estimate.observer import ObserverSettings
from quadsim.mpc.laws.parts.preparation import RobustPreparation
from quadsim.mpc.laws.robust import Robust
from quadsim.mpc.tables.commands import TargetWeights
from quadsim.rotation import body_to_euler_rates, euler_to_body_rates
from quadsim.scenarios.assembly import Assembly
from quadsim.state import ANGLE_RATES, ANGLES, POSITIONS, VELOCITIES, Array
from quadsim.vehicle import Vehicle

PERIOD = 0.02
LAGS = (0.0, 0.035, 0.03, 0.1)
ATTITUDE_LAGS = (0.12, 0.1, 0.5)
TABLE: dict[str, Any] = {
    "type": "robust",
    "horizon": 40,
    "heading": True,
    "offset_free": {},
    "soft": {},
    "terminal": "lqr",
    "output_weights": {"x": 10.0, "y": 10.0, "z": 20.0, "yaw": 10.0},
    "output_bounds": {"roll": [-20.0, 20.0], "pitch": [-20.0, 20.0]},
    "target_weights": {"thrust": 0.1, "body_rate": 0.1},
}
FLIGHT: dict[str, Any] = {
    "control_period": PERIOD,
    "duration": 8.0,
    "vehicle.file": "hummingbird",
    "reference": {"type": "ramped_circle", "radius": 2.0, "speed": 1.5, "acceleration": 1.0, "ramp": 0.5, "start": 0.5},
    "plant.limit_speeds": True,
    "effects.rotors": {"efficiency": [0.85] * 4},
    "effects.air": {"wind": [2.0, 0.0, 0.0]},
    "autopilot": {},
    "constraints": [],
}
COMMANDS = pytest.mark.parametrize("commands", ["rates", "attitude"])


def table(commands: str, **others: Any) -> Robust:
    lags: dict[str, Any] = {"inner_lag": LAGS}
    if commands == "attitude":
        lags["attitude_lag"] = ATTITUDE_LAGS
    weights = TargetWeights(thrust=0.1, body_rate=0.1)
    fields: dict[str, Any] = {"horizon": 10, "output_weights": {"x": 1.0}, "target_weights": weights}
    return Robust(commands=commands, **fields, **lags, **others)  # type: ignore[arg-type]


def flown(commands: str, **changes: Any) -> quadsim.Flight:
    controller = TABLE | {"commands": commands}
    scenario = quadsim.load("hover").replace({**FLIGHT, "controller": controller, **changes})
    return quadsim.fly(scenario, progress=False)


def integrated(vehicle: Vehicle, state: Array, command: Array, time: float, attitude_lags: Any) -> Array:
    """The state a time later, by scipy: the body rates and the turn so far are states of their own."""
    lags = np.array(LAGS[1:])

    def slope(_: float, at: Array) -> Array:
        position_velocity = at[:6]
        euler = at[6:9]
        rates = at[9:12]
        turn = at[12:]
        roll, pitch, yaw = euler
        axis = np.array(
            [
                np.cos(yaw) * np.sin(pitch) * np.cos(roll) + np.sin(yaw) * np.sin(roll),
                np.sin(yaw) * np.sin(pitch) * np.cos(roll) - np.cos(yaw) * np.sin(roll),
                np.cos(pitch) * np.cos(roll),
            ]
        )
        acceleration = command[0] / vehicle.mass * axis - [0.0, 0.0, vehicle.gravity]
        taken = 0.0 if attitude_lags is None else turn / np.array(attitude_lags)
        angular = (command[1:] - taken - rates) / lags
        return np.concatenate([position_velocity[3:], acceleration, body_to_euler_rates(euler, rates), angular, rates])

    rates = euler_to_body_rates(state[ANGLES], state[ANGLE_RATES])
    start = np.concatenate([state[POSITIONS], state[VELOCITIES], state[ANGLES], rates, np.zeros(3)])
    end = scipy.integrate.solve_ivp(slope, (0.0, time), start, rtol=1e-10, atol=1e-12).y[:, -1]
    later = np.empty(12)
    later[POSITIONS] = end[:3]
    later[VELOCITIES] = end[3:6]
    later[ANGLES] = end[6:9]
    later[ANGLE_RATES] = body_to_euler_rates(end[6:9], end[9:12])
    return later


def test_a_delay_is_bridged_by_the_inner_loop_s_equation(vehicle: Vehicle) -> None:
    """Over one and a half periods, from 20 deg of tilt and turning."""
    settings = table("rates", delay=1.5 * PERIOD)
    preparation = RobustPreparation(vehicle, settings.problem(vehicle, PERIOD), settings)
    weight = vehicle.mass * vehicle.gravity
    first = np.array([1.1 * weight, 1.0, -0.5, 0.2])
    second = np.array([0.9 * weight, -1.0, 0.8, 0.0])
    preparation.reset(first)
    state = np.array([0.1, 0.5, -0.2, 0.3, 1.0, -0.4, 0.35, 0.5, -0.2, 1.0, 0.3, -0.3])
    query = preparation.prepare(StepInputs(time=0.0), state, np.zeros((10, 4)), second)
    assert query is not None
    middle = integrated(vehicle, state, first, 0.5 * PERIOD, None)
    expected = integrated(vehicle, middle, second, PERIOD, None)
    np.testing.assert_allclose(query.state, expected, atol=2e-5)


@COMMANDS
def test_the_observer_expects_what_the_inner_loop_does(vehicle: Vehicle, commands: str) -> None:
    """A vehicle that moves as the equation says shows no disturbance."""
    lags = ATTITUDE_LAGS if commands == "attitude" else None
    settings = table(commands, offset_free=ObserverSettings())
    preparation = RobustPreparation(vehicle, settings.problem(vehicle, PERIOD), settings)
    command = np.array([1.05 * vehicle.mass * vehicle.gravity, 0.8, -0.6, 0.2])
    preparation.reset(command)
    state = np.array([0.0, 0.2, 0.0, -0.1, 1.0, 0.1, 0.1, 0.2, -0.1, 0.3, 0.2, -0.1])
    preparation.prepare(StepInputs(time=0.0), state, np.zeros((10, 4)), command)
    later = integrated(vehicle, state, command, PERIOD, lags)
    preparation.prepare(StepInputs(time=PERIOD), later, np.zeros((10, 4)), command)
    np.testing.assert_allclose(preparation.disturbance, np.zeros(6), atol=1e-4)


@COMMANDS
def test_worn_rotors_and_wind_leave_no_offset(commands: str) -> None:
    """On a circle at 1.5 m/s with rotors that give 85 %: as well as with rotor speeds, a few centimetres."""
    flight = flown(commands)
    assert flight.log.reason is None
    errors = flight.numbers["tracking"]["rmse"]
    assert max(errors[axis] for axis in "xyz") < 0.04
    target = flight.log.control.target
    assert target is not None
    assert (flight.log.control.target_attitude is not None) == (commands == "attitude")


def test_it_holds_its_place_in_wind_while_it_turns() -> None:
    start = {"reference": {"type": "steps"}, "initial.position": [0.3, -0.2, 1.0], "initial.euler": [0.0, 0.0, 130.0]}
    flight = flown("attitude", **start, duration=5.0)
    assert flight.log.reason is None
    assert np.degrees(flight.state["yaw"][0]) == pytest.approx(130.0, abs=1.0)
    assert np.degrees(flight.state["yaw"][-1]) == pytest.approx(0.0, abs=1.0)
    assert [flight.state[axis][-1] for axis in "xy"] == pytest.approx([0.3, -0.2], abs=0.01)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"target_weights": None}, "target_weights must be given where commands = "),
        ({"input_weights": {"speed": 0.1}}, "input_weights must be absent where commands = "),
        ({"input_bounds": {"speed": [0.0, 250.0], "slew": [-9.0, 9.0]}}, "input_bounds must be absent"),
        ({"rotor_lag": 0.02}, "rotor_lag must be absent"),
        ({"move_weight": 1.0}, "move_weight must be absent"),
        ({"tightening": {}}, "tightening must be absent"),
        ({"commands": "rates", "attitude_lag": [0.1, 0.1, 0.1]}, "attitude_lag must be absent"),
        ({"delay": 0.01}, 'delay must be zero where commands = "attitude"'),
        ({"commands": "rotors"}, "input_weights and input_bounds must be given where rotors are commanded"),
    ],
)
def test_fields_of_the_other_commands_are_refused(changes: dict[str, Any], message: str) -> None:
    controller = {
        name: value for name, value in (TABLE | {"commands": "attitude"} | changes).items() if value is not None
    }
    with pytest.raises(InputError, match=message):
        quadsim.load("hover").replace({**FLIGHT, "controller": controller})


def test_it_is_not_exported() -> None:
    scenario = quadsim.load("hover").replace({**FLIGHT, "controller": TABLE | {"commands": "rates"}})
    with pytest.raises(ExportError, match='commands = "rates"; exported is "rotors"'):
        c_controller(Assembly(scenario))


def test_rotor_speeds_take_over_from_targets_without_taking_them_for_speeds() -> None:
    """The estimate of the disturbance does not jump where the law changes in flight."""
    rotors = {
        "type": "robust",
        "commands": "rotors",
        "rotor_lag": 0.05,
        "offset_free": {},
        "horizon": 40,
        "heading": True,
        "soft": {},
        "output_weights": TABLE["output_weights"],
        "input_weights": {"speed": 1e-3},
        "input_bounds": {"speed": [0.0, 700.0], "slew": [-700.0, 700.0]},
    }
    event = {"type": "controller", "at": 1.0, "fields": rotors}
    hover = {"reference": {"type": "steps"}, "effects.air": {}, "events": [event], "duration": 1.5}
    scenario = quadsim.load("hover").replace({**FLIGHT, "controller": TABLE | {"commands": "rates"}, **hover})
    with quadsim.start(scenario) as flight:
        estimates = []
        while not flight.done:
            flight.step()
            estimates.append(flight.loop.controller.law.disturbance)
    change = np.abs(estimates[51] - estimates[49])
    assert change.max() < 0.2
