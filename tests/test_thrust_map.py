"""A rotor's thrust as a map a1 u + a2 u^2, of its speed or of the throttle."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support import NO_PRODUCTS
from uneven import FILES, published, uneven

import quadsim
from quadsim.assets import vehicle_path
from quadsim.commands.cli import main
from quadsim.console.results import EXIT_WRONG_INPUT
from quadsim.errors import FileError, ParameterError
from quadsim.mpc.pilot.allocation import allocate, make_allocation
from quadsim.mpc.problem.model import continuous_model
from quadsim.plausibility import implausible
from quadsim.scenarios.assembly import Assembly
from quadsim.sim.autopilot import Autopilot, AutopilotSettings
from quadsim.sim.effects import Effects
from quadsim.sim.effects.battery import Battery
from quadsim.sim.physics import Integrator
from quadsim.sim.plant import Plant
from quadsim.state import INDEX, N_STATES
from quadsim.vehicle import Vehicle, altered, load_vehicle

HUMMINGBIRD = load_vehicle(vehicle_path("hummingbird"))
TOP = HUMMINGBIRD.thrust_coefficient * HUMMINGBIRD.speed_max**2  # N, of one rotor


def mapped(linear: float = 0.4) -> Vehicle:
    """The Hummingbird with so large a linear share of its largest thrust."""
    speed = HUMMINGBIRD.speed_max
    law = linear * TOP / speed, (1.0 - linear) * TOP / speed**2
    return altered(HUMMINGBIRD, {"thrust_of_speed": law, "speed_min": 100.0})


@pytest.mark.parametrize("integrator", ["mujoco", "rk4"])
@pytest.mark.parametrize("linear", [-0.05, 0.4, 1.0])
def test_the_plant_has_exactly_its_thrust_and_a_torque_in_proportion(linear: float, integrator: Integrator) -> None:
    vehicle = mapped(linear)
    speeds = np.array([300.0, 420.0, 510.0, 600.0])
    a1, a2 = vehicle.thrust_of_speed
    thrusts = a1 * speeds + a2 * speeds**2
    np.testing.assert_allclose(vehicle.thrusts(speeds), thrusts, rtol=1e-14)
    np.testing.assert_allclose(vehicle.speeds(thrusts), speeds, rtol=1e-12)
    with Plant(vehicle, integrator=integrator) as plant:
        flown = plant.advance(speeds, 1)
        np.testing.assert_allclose(flown["thrust"], [thrusts.sum()], rtol=1e-14)
        rates = plant.physics[-3:] / plant.timestep
        assert plant.advance(np.full(4, 1.0), 1)["thrust"] == pytest.approx(4.0 * max(a1 + a2, 0.0), abs=1e-15)
    x, y, _ = vehicle.hubs.T
    torque = [thrusts @ y, -thrusts @ x, vehicle.drag_to_thrust * thrusts @ np.array(vehicle.rotor_spins)]
    np.testing.assert_allclose(rates, np.array(torque) / vehicle.inertia, rtol=2e-3)


def test_a_map_without_linear_term_flies_as_its_coefficient_does() -> None:
    square = mapped(0.0)
    speeds = HUMMINGBIRD.hover_speed * np.array([0.9, 1.0, 1.1, 1.2])
    np.testing.assert_allclose(square.coefficients, HUMMINGBIRD.coefficients, rtol=1e-14)
    states = []
    for vehicle in (square, HUMMINGBIRD):
        with Plant(vehicle) as plant:
            plant.advance(speeds, 200)
            states.append(plant.state())
    np.testing.assert_allclose(states[0], states[1], rtol=1e-11, atol=1e-13)


@pytest.mark.parametrize("layout", ["plus", "uneven"])
def test_models_have_its_hover_and_its_slope(layout: str) -> None:
    vehicle = mapped()
    if layout == "uneven":
        top = 1.5e-5 * uneven().speed_max ** 2
        vehicle = altered(uneven(), {"thrust_of_speed": (0.4 * top / uneven().speed_max, 0.9e-5)})
    hover = vehicle.hover_speeds
    weight = vehicle.mass * vehicle.gravity
    np.testing.assert_allclose(vehicle.thrusts(hover), weight * vehicle.thrust_shares, rtol=1e-12)
    np.testing.assert_allclose(vehicle.allocation @ hover**2, [weight, 0.0, 0.0, 0.0], rtol=1e-9, atol=1e-9)
    a1, a2 = vehicle.thrust_of_speed
    slope = continuous_model(vehicle)[1][INDEX["vz"]] * vehicle.mass
    np.testing.assert_allclose(slope, a1 + 2.0 * a2 * hover, rtol=1e-12)
    with Plant(vehicle) as plant:
        plant.reset(np.zeros(N_STATES))
        plant.advance(hover, 500)
        np.testing.assert_allclose(plant.state(), 0.0, atol=1e-10)


@pytest.mark.parametrize("vehicle", [mapped(-0.05), mapped(), mapped(1.0), published("cf21b")], ids=lambda v: v.name)
def test_allocation_and_autopilot_invert_it(vehicle: Vehicle) -> None:
    allocation = make_allocation(vehicle)
    weight = vehicle.mass * vehicle.gravity
    speeds = vehicle.hover_speed * np.array([0.9, 1.0, 1.1, 1.2])
    thrusts, (x, y, _) = vehicle.thrusts(speeds), vehicle.hubs.T
    yaw = vehicle.drag_to_thrust * thrusts @ np.array(vehicle.rotor_spins)
    wrench = np.array([thrusts.sum(), thrusts @ y, -thrusts @ x, yaw])
    np.testing.assert_allclose(allocation.wrench(speeds), wrench, rtol=1e-9, atol=1e-12 * weight)
    low, high = (np.full(4, limit) for limit in (vehicle.speed_min, vehicle.speed_max))
    np.testing.assert_allclose(allocate(allocation, wrench, low, high), speeds, rtol=1e-9)
    assert allocate(allocation, 9.0 * weight * np.array([1.0, 0.0, 0.0, 0.0]), low, high) == pytest.approx(high)
    autopilot = Autopilot(vehicle, AutopilotSettings(delay=0.0))
    level = np.array([1.0, 0.0, 0.0, 0.0])
    for share in (0.7, 1.0, 1.4):
        answer = autopilot.speeds(0.0, share * weight * level, np.zeros(3), vehicle.hover_speeds, level)
        assert vehicle.thrusts(answer).sum() == pytest.approx(share * weight, rel=1e-9)


def test_power_is_torque_times_speed() -> None:
    battery = Battery(cells=4, capacity=2.0, hover_current=8.0).resolved(HUMMINGBIRD)
    vehicle = mapped()
    drawn = []
    for ratio in (1.0, 1.3):
        with Plant(vehicle, effects=Effects(battery=battery)) as plant:
            charge = plant.advance(ratio * vehicle.hover_speeds, 2)["battery"][:, 1]
            drawn.append(charge[0] - charge[1])
    speeds = vehicle.hover_speed * np.array([1.0, 1.3])
    power = speeds * vehicle.thrusts(np.stack([speeds] * 4, axis=1))[:, 0]
    assert drawn[1] / drawn[0] == pytest.approx(power[1] / power[0], rel=1e-6)
    assert drawn[0] == pytest.approx(8.0 * 1e-3 / (3600.0 * 2.0), rel=1e-4)


@pytest.mark.parametrize("law", ["constrained", "robust", "lqr", "pid", "geometric", "nonlinear"])
def test_six_laws_hold_the_height(law: str) -> None:
    base = quadsim.load("hover")
    vehicle = Assembly(base).vehicle
    a2 = 0.5 * vehicle.mean_coefficient
    changes: dict[str, Any] = {"vehicle.thrust_of_speed": [a2 * vehicle.hover_speed, a2], "duration": 3.0}
    if law in ("constrained", "robust"):
        changes |= {"controller.type": law}
    else:
        held = {"name": "hold_z", "signal": "z_error", "lower": -1e-6, "upper": 1e-6}
        changes |= {"controller": {"type": law}, "constraints": [held]}
    flight = quadsim.fly(base.replace(changes))
    assert flight.vehicle.thrust_of_speed == (a2 * vehicle.hover_speed, a2)
    assert flight.outcome == "satisfied"
    assert np.abs(flight.state["z"] - 1.0).max() < 1e-6


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"thrust_of_speed": (1e-4, 1e-6)}, "thrust_of_speed must be left out where thrust_coefficient is given: one"),
        ({"thrust_of_throttle": (1.0, 3.0)}, "thrust_of_throttle must be left out where thrust_coefficient is given"),
        ({"thrust_coefficient": None}, "thrust_coefficient must be given, or thrust_of_speed or thrust_of_throttle in"),
        (
            {"thrust_of_speed": (0.02, -1.5e-5), "thrust_coefficient": None},
            r"thrust_of_speed must be such that a1 w \+ a2 w\^2 is not negative and rises from w = 0 to 838 rad/s",
        ),
        (
            {"thrust_of_speed": (-1e-3, 1e-5), "thrust_coefficient": None},
            r"thrust_of_speed must be such that a1 w \+ a2 w\^2 is not negative and rises from w = 0",
        ),
        (
            {"thrust_of_throttle": (-0.5, 6.0), "thrust_coefficient": None},
            r"thrust_of_throttle must be such that a1 u \+ a2 u\^2 is not negative and rises from u = 0 to 1; got",
        ),
        (
            {"thrust_of_throttle": (7.0, -3.6), "thrust_coefficient": None},
            r"thrust_of_throttle must be such that a1 u \+ a2 u\^2 is not negative and rises from u = 0 to 1; got",
        ),
        ({"throttle_offset": 15.0}, "throttle_offset must be between -1 and 0.9, a share of full throttle; got 15.0"),
        (
            {"thrust_of_throttle": (-2.0, 8.0), "thrust_coefficient": None, "throttle_offset": -0.2},
            r"thrust_of_throttle must be such that a1 v \+ a2 v\^2 is not negative and rises from v = 0.166667 to 1",
        ),
        (
            {"thrust_of_speed": (1e-4, 1e-6), "thrust_coefficient": None},
            r"thrust_of_speed must be such that a rotor lifts 1\.756 N or more, or it cannot hover: it lifts 0\.786 N",
        ),
        (
            {"thrust_of_throttle": (0.5, 0.5), "thrust_coefficient": None},
            r"thrust_of_throttle must be such that a rotor lifts 1\.756 N or more, or it cannot hover: it lifts 1 N at",
        ),
        (
            {"thrust_of_speed": (1e-3, 1e-5), "thrust_coefficient": None, "speed_min": 600.0},
            "speed_min must be no higher than its hover speed",
        ),
        ({"thrust_of_speed": (1e-4,), "thrust_coefficient": None}, "thrust_of_speed must be a list of 2 numbers"),
    ],
)
def test_an_impossible_map_is_refused(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ParameterError, match=rf"^vehicle\.{message}"):
        replace(HUMMINGBIRD, **changes)


def test_a_wrong_map_is_one_message_on_the_command_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "mine.toml"
    text = (FILES / "cf21b.toml").read_text(encoding="utf-8")
    path.write_text(text.replace("[-2.9922e-06, 4.01903e-08]", "[-2.9922e-06, -4.01903e-08]"), encoding="utf-8")
    assert main(["check", "hover", "--set", f"vehicle.file={path}"]) == EXIT_WRONG_INPUT
    printed = capsys.readouterr()
    assert printed.out == ""
    assert printed.err.startswith("quadsim: ")
    assert "thrust_of_speed must be such that a1 w + a2 w^2 is not negative and rises from w = 767.24 to" in printed.err
    lines = [line for line in text.splitlines() if not line.startswith("thrust_of_speed")]
    path.write_text("\n".join(lines), encoding="utf-8")
    with pytest.raises(FileError, match=r"lacks thrust_coefficient$"):
        load_vehicle(path)


def test_an_override_in_one_form_takes_the_place_of_the_others() -> None:
    hover = published("cf21b").hover_speed
    square = load_vehicle(FILES / "cf21b.toml", {"thrust_coefficient": 4e-8})
    assert (square.thrust_of_speed, square.mean_coefficient) == (None, 4e-8)
    throttle = altered(square, {"thrust_of_throttle": (0.05, 0.15)})
    assert throttle.thrust_coefficient is None
    np.testing.assert_allclose(throttle.coefficients, 0.2 / throttle.speed_max**2)
    np.testing.assert_allclose(throttle.thrusts(np.full(4, throttle.speed_max)), 0.2)
    assert throttle.throttle_share == pytest.approx(0.75)
    assert altered(throttle, {"thrust_of_speed": published("cf21b").thrust_of_speed}).hover_speed == hover


def test_a_run_keeps_its_map(tmp_path: Path) -> None:
    scenario = quadsim.load("hover").replace({"vehicle.file": str(FILES / "cf21b.toml"), "duration": 0.2})
    scenario = scenario.replace({"constraints": [], "controller": {"type": "geometric"}})
    quadsim.run(scenario, out=tmp_path / "run", **NO_PRODUCTS)
    again = quadsim.read(tmp_path / "run")
    assert again.scenario.vehicle.thrust_of_speed == published("cf21b").thrust_of_speed
    assert again.vehicle.thrust_of_speed == published("cf21b").thrust_of_speed


@pytest.mark.parametrize(
    ("field", "unit", "factors"),
    [
        ("thrust_of_speed", "N/rpm and N/rpm^2", (math.pi / 30.0, (math.pi / 30.0) ** 2)),
        ("thrust_of_throttle", "g", (1.0 / 9.80665e-3,) * 2),
    ],
)
def test_a_map_in_another_unit_is_named(field: str, unit: str, factors: tuple[float, float]) -> None:
    """With its speeds in rpm, too, where the map is one of the speed."""
    of_speed = field == "thrust_of_speed"
    vehicle = published("cf21b") if of_speed else altered(HUMMINGBIRD, {field: (0.4 * TOP, 0.6 * TOP)})
    value = tuple(factor * number for factor, number in zip(factors, getattr(vehicle, field), strict=True))
    speeds = {name: getattr(vehicle, name) * 30.0 / math.pi for name in ("speed_min", "speed_max")} if of_speed else {}
    note = " ".join(implausible(replace(vehicle, **speeds, **{field: value})))
    assert unit in note
    assert field in note
    assert implausible(HUMMINGBIRD) == implausible(
        altered(HUMMINGBIRD, {field: getattr(mapped(0.0), field) or (0, TOP)})
    )
