"""From `[controller]` to a law: every field arrives, parts are absent unless given, the paper's two are as ever."""

from __future__ import annotations

import math
import tomllib
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from jsonschema import Draft202012Validator

from quadsim.controller import Controller
from quadsim.errors import ParameterError
from quadsim.mpc.estimate.observer import DisturbanceObserver, ObserverSettings
from quadsim.mpc.guard.answer import ActuatorBounds
from quadsim.mpc.laws.geometric import GeometricController
from quadsim.mpc.laws.lqr import LQR, bryson_objective
from quadsim.mpc.laws.nonlinear import Weights
from quadsim.mpc.laws.parts.linear import LinearMPC
from quadsim.mpc.laws.parts.nonlinear_mpc import NonlinearMPC
from quadsim.mpc.laws.parts.preparation import RobustPreparation
from quadsim.mpc.laws.pid import PID, CascadedPID
from quadsim.mpc.pilot.pilot import Pilot
from quadsim.mpc.problem.constraints import Bounds
from quadsim.mpc.problem.ocp import Objective
from quadsim.mpc.problem.tightening import TighteningSettings, margins
from quadsim.scenarios.assembly import Assembly
from quadsim.scenarios.loading import load_scenario, parse_scenario
from quadsim.scenarios.schema.json_schema import scenario_schema
from quadsim.scenarios.schema.scenario import Scenario

ROBUST: dict[str, Any] = {
    "type": "robust",
    "horizon": 20,
    "output_weights": {"x": 10.0, "y": 10.0, "z": 100.0, "yaw": 100.0},
    "input_weights": {"speed": 0.1},
    "output_bounds": {"roll": [-5.0, 5.0], "pitch": [-6.0, 4.5]},
    "input_bounds": {"speed": [0.0, 250.0], "slew": [-10.0, 5.0]},
}


def scenario(controller: Any, vehicle: str = "lopes2011") -> Scenario:
    return parse_scenario(
        {
            "name": "one",
            "description": "a step of 1 m",
            "duration": 2.0,
            "control_period": 0.05,
            "vehicle": {"file": vehicle},
            "initial": {"position": [0.0, 0.0, 1.0]},
            "reference": {"response_time": 1.0, "x": [{"start": 0.5, "stop": 9.0, "value": 1.0}]},
            "controller": controller,
        }
    )


def built(controller: Any, vehicle: str = "lopes2011") -> Pilot:
    one = scenario(controller, vehicle)
    return Assembly(one).controller()


def preparation_of(law: Controller) -> RobustPreparation:
    assert isinstance(law, LinearMPC)
    assert isinstance(law.preparation, RobustPreparation)
    return law.preparation


def robust(**parts: Any) -> RobustPreparation:
    return preparation_of(built({**ROBUST, "fallback": {"enabled": False}, **parts}).law)


def same(left: object, right: object) -> bool:
    """Equal, arrays element by element."""
    if isinstance(left, np.ndarray) or isinstance(right, np.ndarray):
        return np.array_equal(np.asarray(left, float), np.asarray(right, float))
    if hasattr(left, "__dataclass_fields__") and type(left) is type(right):
        return all(same(getattr(left, item.name), getattr(right, item.name)) for item in fields(left))  # type: ignore[arg-type]
    return left == right


# --- the robust one ------------------------------------------------------------------------------------------------


def test_of_the_robust_controller_every_part_is_absent_unless_given() -> None:
    """It then asks what the constrained controller asks; a turn of the heading has its limit, without effect."""
    law = robust()
    constrained = Assembly(scenario({**ROBUST, "type": "constrained"})).problem()
    assert same(law.problem, constrained)
    numbers = law._robust
    assert (law.delay, numbers.heading, numbers.observes, numbers.left_after_period) == (0.0, 0, 0, 0.0)
    assert numbers.largest_turn == math.radians(30.0)


BOUNDS = Bounds(
    C_c=np.eye(12)[[6, 8]],
    y_min=np.radians([-5.0, -6.0]),
    y_max=np.radians([5.0, 4.5]),
    delta_min=np.full(4, -10.0),
    delta_max=np.full(4, 5.0),
    u_min=np.zeros(4),
    u_max=np.full(4, 250.0),
)
PARTS: dict[str, tuple[Any, Callable[[RobustPreparation], object], Any]] = {
    "rotor_lag": (0.03, lambda law: law._robust.left_after_period, math.exp(-0.05 / 0.03)),
    "delay": (0.02, lambda law: law.delay, 0.02),
    "offset_free": (
        {"force_walk": 0.7},
        lambda law: law._robust.observes and np.array(law._robust.gain),
        DisturbanceObserver(ObserverSettings(force_walk=0.7), 0.05).gain,
    ),
    "heading": (True, lambda law: law._robust.heading, True),
    "largest_turn": (90.0, lambda law: law._robust.largest_turn, math.radians(90.0)),
    "move_weight": (2.0, lambda law: law.problem.objective.Q_d, 2.0 * np.eye(4)),
}


@pytest.mark.parametrize("part", PARTS)
def test_a_part_is_switched_on_alone(part: str) -> None:
    given, _, expected = PARTS[part]
    law = robust(**{part: given})
    for name, (_, value_of, _) in PARTS.items():
        assert same(value_of(law), expected if name == part else value_of(robust()))


def test_soft_bounds_have_their_penalties() -> None:
    bounds = robust(soft={"linear": 3.0}).problem.bounds
    assert bounds is not None
    assert bounds.penalty is not None
    np.testing.assert_array_equal([bounds.penalty.l1, bounds.penalty.l2], [[3.0, 3.0], [1e4, 1e4]])


def test_tightening_is_that_of_the_stated_bounds_lag_and_delay() -> None:
    law = robust(tightening={"acceleration": 0.2, "turning": 1.0}, rotor_lag=0.02, delay=0.01)
    assert law.problem.bounds is not None
    drawn_in = law.problem.bounds.margins
    expected = margins(
        Assembly(scenario(ROBUST)).vehicle,
        period=0.05,
        horizon=20,
        bounds=BOUNDS,
        settings=TighteningSettings(acceleration=0.2, turning=1.0),
        rotor_lag=0.02,
        delay=0.01,
    )
    assert drawn_in is not None
    np.testing.assert_array_equal(drawn_in, expected)


def test_weights_and_bounds_arrive_in_si_units() -> None:
    problem = Assembly(scenario(ROBUST)).problem()
    assert problem.bounds is not None
    assert same(problem.bounds, BOUNDS)
    objective = Objective(C_r=np.eye(12)[[0, 2, 4, 10]], Q_y=np.diag([10.0, 10.0, 100.0, 100.0]), Q_u=0.1 * np.eye(4))
    assert same(problem.objective, objective)


def test_the_vehicles_lag_is_its_rotor_rise() -> None:
    lag = {"rotor_lag": "vehicle", "fallback": {"enabled": False}}
    law = built(
        {**ROBUST, **lag, "input_bounds": {"speed": [0.0, 800.0], "slew": [-50.0, 50.0]}},
        "hummingbird",
    )
    vehicle = Assembly(scenario(ROBUST, "hummingbird")).vehicle
    assert vehicle.rotor_rise
    assert preparation_of(law.law)._robust.left_after_period == math.exp(-0.05 / vehicle.rotor_rise)


# --- fallback ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("bounds", "given", "tilt"),
    [
        ({"roll": [-5.0, 5.0], "pitch": [-6.0, 4.5]}, {}, 0.8 * 4.5),
        ({"roll": [-5.0, 5.0]}, {"tilt": 7.0}, 7.0),
        ({"roll": [-40.0, 40.0]}, {}, 10.0),
        ({"roll": [1.0, 40.0]}, {}, 0.5),
        ({}, {}, 10.0),
    ],
)
def test_the_fallback_is_on_and_keeps_well_within_the_bounds_on_tilt(
    bounds: dict[str, Any], given: dict[str, Any], tilt: float
) -> None:
    law = built({**ROBUST, "output_bounds": bounds, "fallback": given})
    assert law.guard is not None
    preparation_of(law.law)
    assert law.guard.numbers.tilt == pytest.approx(math.radians(tilt), rel=1e-12)
    assert law.name == "robust"


def test_the_fallback_of_the_constrained_one_is_off_unless_given() -> None:
    table = {**ROBUST, "type": "constrained"}
    assert isinstance(built(table).law, LinearMPC)
    assert built(table).guard is None
    assert built({**table, "fallback": {"enabled": False}}).guard is None
    assert built({**table, "fallback": {}}).guard is not None


# --- baselines -----------------------------------------------------------------------------------------------------


def test_the_baselines_need_no_more_than_their_names() -> None:
    kinds = {"lqr": LQR, "pid": CascadedPID, "geometric": GeometricController}
    for name, kind in kinds.items():
        law = built(name).law
        assert type(law) is kind
        assert (law.name, law.horizon) == (name, 10)


NONLINEAR: dict[str, Any] = {
    "type": "nonlinear",
    "horizon": 12,
    "node": 0.15,
    "iterations": 3,
    "shift": True,
    "substeps": 2,
    "inputs": "speed",
    "weights": {
        "position": [1.0, 2.0, 3.0], "attitude": 4.0, "velocity": 5.0, "body_rates": 6.0, "input": 7.0, "move": 8.0,
    },
    "attitude_error": "difference",
    "terminal": 2.0,
    "rotor_lag": 0.03,
    "drag": [0.1, 0.2, 0.3],
    "quadratic_drag": [0.4, 0.5, 0.6],
    "output_bounds": {"vx": [-1.0, 2.0]},
    "tilt": 20.0,
    "body_rate": [90.0, 180.0, 45.0],
    "soft": {"linear": 9.0, "quadratic": 10.0},
    "polytopes": [{"name": "wall", "of": ["x", "y"], "rows": [[1.0, 1.0]], "upper": [4.0]}],
    "offset_free": {"force_walk": 0.3},
    "input_bounds": {"speed": [10.0, 200.0], "slew": [-30.0, 20.0]},
    "fallback": {"enabled": False},
}  # fmt: skip


def test_fields_of_nonlinear_mpc_arrive() -> None:
    law = built(NONLINEAR).law
    assert isinstance(law, NonlinearMPC)
    made = law.settings
    x = math.radians(1.0)
    assert (law.horizon, law.problem.horizon, law.numbers.stride, law.solver) == (12, 4, 3, "core")
    assert (made.iterations, made.shift, made.substeps, made.inputs) == (3, True, 2, "speed")
    weights = Weights(position=(1.0, 2.0, 3.0), attitude=4.0, velocity=5.0, body_rates=6.0, input=7.0, move=8.0)
    assert made.weights == weights
    assert (made.attitude_error, made.terminal, made.rotor_lag) == ("difference", 2.0, 0.03)
    assert (made.drag, made.quadratic_drag) == ((0.1, 0.2, 0.3), (0.4, 0.5, 0.6))
    assert law._observer is not None
    np.testing.assert_array_equal(law._observer.gain, DisturbanceObserver(ObserverSettings(force_walk=0.3), 0.05).gain)
    constraints = {part.name: part for part in law.problem.every_constraint}
    assert constraints["tilt"].upper == pytest.approx(math.sin(20.0 * x) * math.cos(math.pi / 12.0))
    assert constraints["body_rates"].upper == pytest.approx((90.0 * x, 180.0 * x, 45.0 * x))
    assert constraints["body_rates"].penalty is not None
    np.testing.assert_array_equal(constraints["body_rates"].penalty.l1, 9.0)
    np.testing.assert_array_equal(constraints["body_rates"].penalty.l2, 10.0)
    assert list(constraints) == ["inputs", "slews", "tilt", "body_rates", "outputs", "wall"]
    np.testing.assert_allclose(constraints["inputs"].upper, 200.0 / Assembly(scenario("pid")).vehicle.speed_max)
    assert constraints["outputs"].penalty is not None
    assert constraints["wall"].penalty is None


def test_nonlinear_mpc_needs_no_field_and_is_within_the_fallback_contract() -> None:
    law = built("nonlinear")
    assert law.guard is not None
    assert isinstance(law.law, NonlinearMPC)
    assert built({"type": "nonlinear", "fallback": {"enabled": False}}).guard is None


NARROW = (
    "controller.tightening.acceleration must be smaller, or the bounds on vx wider: these leave 0.2 m/s on either "
    "side of their middle, of which 0.101 m/s would be given up and at most 0.1 m/s may be; got 0.5"
)
NO_LAG = (
    "controller.rotor_lag must be a number of seconds where the vehicle has no rotor_rise, and lopes2011 has none; "
    "got 'vehicle'"
)


@pytest.mark.parametrize(
    ("controller", "message"),
    [
        ({**ROBUST, "rotor_lag": "vehicle"}, NO_LAG),
        (
            {**ROBUST, "delay": 2.6, "horizon": 50},
            "controller.delay must be at most the horizon of 50 periods, 2.5 s; got 2.6",
        ),
        ({**ROBUST, "output_bounds": {"vx": [-0.2, 0.2]}, "tightening": {}}, NARROW),
        (
            {"type": "nonlinear", "node": 0.07},
            "controller.node must be a whole multiple of the control period of 0.05 s; got 0.07",
        ),
        (
            {"type": "nonlinear", "node": 0.15},
            "controller.horizon must be a whole number of nodes, 3 periods each; got 20",
        ),
    ],
)
def test_what_vehicle_period_and_bounds_do_not_allow_is_refused(controller: Any, message: str) -> None:
    with pytest.raises(ParameterError) as caught:
        built(controller)
    assert str(caught.value) == message


def test_fields_of_the_baselines_arrive() -> None:
    bounds = {"speed": [1.0, 300.0], "slew": [-20.0, 30.0]}
    lqr, pid, geometric = (
        built({"type": name, "horizon": 7, "tilt": 12.0, "input_bounds": bounds, **more}).law
        for name, more in {
            "lqr": {"heading": False},
            "pid": {"lag": 0.2, "velocity": 3.0},
            "geometric": {"lag": 0.2, "integral": True},
        }.items()
    )
    assert isinstance(lqr, LQR)
    assert isinstance(pid, CascadedPID)
    assert isinstance(geometric, GeometricController)
    for law in (lqr, pid, geometric):
        assert same(law.bounds, ActuatorBounds.alike((1.0, 300.0), (-20.0, 30.0)))
        assert law.horizon == 7
    assert lqr._largest_tilt == pid._largest_tilt == math.radians(12.0)
    assert geometric.numbers.slope == math.tan(math.radians(12.0))
    vehicle = Assembly(scenario("lqr")).vehicle
    assert same(lqr.objective, bryson_objective(vehicle))
    assert not lqr._heading
    assert pid._largest_velocity == 3.0
    assert pid.gains.bandwidths.rate == pytest.approx(1.0 / (2.0 * 0.225))
    assert geometric.gains.k_i > 0.0
    weighted = built({"type": "lqr", "output_weights": ROBUST["output_weights"], "input_weights": {"speed": 0.1}}).law
    assert isinstance(weighted, LQR)
    assert same(weighted.objective.Q_u, 0.1 * np.eye(4))


# --- the file ------------------------------------------------------------------------------------------------------


NESTED = {"gain": 2.0, "names": ["a"], "more": {"deep": [1, {"x": True}]}}
TABLES = ["pid", "a.b:C", {"type": "a:B", "settings": NESTED}]


@pytest.mark.parametrize("controller", TABLES, ids=str)
def test_it_comes_back_from_its_resolved_file_which_the_schema_allows(controller: Any) -> None:
    one = scenario(controller, "hummingbird")
    text = Assembly(one).resolved.scenario.to_toml()
    again = parse_scenario(tomllib.loads(text))
    assert again.controller == one.controller
    assert again.to_toml() == text
    validator = Draft202012Validator(scenario_schema())
    validator.validate(tomllib.loads(text))
    validator.validate({"base": "hover", "controller": controller})
    validator.validate(tomllib.loads(text) | {"controller": controller})


def test_a_name_alone_takes_fields_from_settings_and_from_files_over_it(tmp_path: Path) -> None:
    (tmp_path / "one.toml").write_text('base = "hover"\nname = "one"\ncontroller = "pid"\n')
    (tmp_path / "two.toml").write_text('base = "one.toml"\nname = "two"\n[controller]\ntilt = 20.0\n')
    result = load_scenario(str(tmp_path / "two.toml"), ["controller.horizon=4"]).controller
    assert result == PID(tilt=20.0, horizon=4)
