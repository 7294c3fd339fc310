"""The vehicle: Table 1, the torques of Sec. 2.2, and every number checked."""

from __future__ import annotations

import dataclasses
import json
import tomllib
from pathlib import Path

import numpy as np
import pytest
from uneven import PUBLISHED, published, uneven

from quadsim.assets import models_dir, vehicle_names, vehicle_path
from quadsim.errors import FileError, ParameterError, UnknownNameError
from quadsim.vehicle import OPTIONAL_PARAMETERS, VEHICLE_UNITS, Vehicle, altered, load_vehicle, vehicle_sources

FILE = vehicle_path("lopes2011")


def test_it_hovers_at_the_speed_of_table_1(vehicle: Vehicle) -> None:
    assert vehicle.hover_speed == pytest.approx(192.8, rel=1e-6)
    assert vehicle.thrust_coefficient == pytest.approx(4.0 * 9.81 / (4.0 * 192.8**2), rel=1e-6)
    assert (vehicle.mass, vehicle.gravity, vehicle.inertia) == (4.0, 9.81, (0.033, 0.033, 0.066))
    assert (vehicle.drag_to_thrust * vehicle.thrust_coefficient) == pytest.approx(0.024 * vehicle.thrust_coefficient)


def test_the_wrench_is_that_of_sec_2_2(vehicle: Vehicle) -> None:
    b = vehicle.thrust_coefficient
    d = vehicle.drag_to_thrust * vehicle.thrust_coefficient
    arm = vehicle.arm_length
    w = np.array([180.0, 190.0, 200.0, 215.0])
    w1, w2, w3, w4 = w**2
    expected = [
        b * (w1 + w2 + w3 + w4),
        b * arm * (w4 - w2),
        b * arm * (w3 - w1),
        d * (w1 - w2 + w3 - w4),
    ]
    np.testing.assert_allclose(vehicle.allocation @ w**2, expected, rtol=1e-12)
    np.testing.assert_allclose(vehicle.hubs, [[arm, 0, 0], [0, -arm, 0], [-arm, 0, 0], [0, arm, 0]], atol=1e-15)


@pytest.mark.parametrize("name", vehicle_names())
def test_every_vehicle_that_ships_gives_each_number_with_unit_and_source(name: str) -> None:
    data = tomllib.loads((models_dir() / f"{name}.toml").read_text(encoding="utf-8"))
    required = {"name", "description", *VEHICLE_UNITS} - set(OPTIONAL_PARAMETERS)
    assert required <= set(data) <= required | set(OPTIONAL_PARAMETERS)
    assert data["name"] == name
    sources = vehicle_sources(vehicle_path(name))
    assert list(sources) == [key for key in VEHICLE_UNITS if key in data]
    for key, source in sources.items():
        assert data[key]["unit"] == VEHICLE_UNITS[key]
        assert source == data[key]["source"]
        assert len(source) > 5
    vehicle = load_vehicle(vehicle_path(name))
    assert vehicle.name == name
    assert Vehicle(**json.loads(json.dumps(dataclasses.asdict(vehicle)))) == vehicle
    for key in OPTIONAL_PARAMETERS:
        assert (getattr(vehicle, key) is None) == (key not in data)


@pytest.mark.parametrize(
    ("name", "hover", "thrust_to_weight"),
    [("crazyflie2", 1697.0, 2.17), ("hummingbird", 453.2, 3.42), ("lopes2011", 192.8, 1.68)],
)
def test_shipped_vehicles_hover_as_published(name: str, hover: float, thrust_to_weight: float) -> None:
    """Bitcraze measures 58 g of thrust on 27 g; RotorS's Hummingbird weighs 0.716 kg on b = 8.54858e-6."""
    vehicle = load_vehicle(vehicle_path(name))
    assert vehicle.hover_speed == pytest.approx(hover, rel=1e-3)
    assert (vehicle.speed_max / vehicle.hover_speed) ** 2 == pytest.approx(thrust_to_weight, rel=5e-3)


@pytest.mark.parametrize(
    ("name", "turning"),
    [
        # CrazyS: front right and back left counter-clockwise.  RotorS: front and back clockwise.
        ("crazyflie2", {(1, -1): "ccw", (-1, -1): "cw", (-1, 1): "ccw", (1, 1): "cw"}),
        ("hummingbird", {(1, 0): "cw", (0, 1): "ccw", (-1, 0): "cw", (0, -1): "ccw"}),
    ],
)
def test_rotors_turn_as_published(name: str, turning: dict[tuple[int, int], str]) -> None:
    vehicle = load_vehicle(vehicle_path(name))
    result = {
        (round(float(np.sign(x))), round(float(np.sign(y)))): "cw" if spin > 0 else "ccw"  # torque opposes turning
        for (x, y, _), spin in zip(vehicle.hubs, vehicle.rotor_spins, strict=True)
    }
    assert result == turning
    np.testing.assert_allclose(np.hypot(*vehicle.hubs[:, :2].T), vehicle.arm_length)


def test_a_vehicle_may_hover_at_the_ends_of_its_range(vehicle: Vehicle) -> None:
    hover = vehicle.hover_speed
    assert dataclasses.replace(vehicle, speed_max=hover).speed_max == hover
    assert dataclasses.replace(vehicle, speed_min=hover).speed_min == hover


def test_overrides_replace_the_files_numbers() -> None:
    vehicle = load_vehicle(FILE, {"mass": 5.0, "inertia": [0.04, 0.04, 0.07], "body_drag": [0.01, 0.02, 0.03]})
    assert (vehicle.mass, vehicle.inertia, vehicle.gravity) == (5.0, (0.04, 0.04, 0.07), 9.81)
    assert (vehicle.body_drag, vehicle.rotor_rise) == ((0.01, 0.02, 0.03), None)
    with pytest.raises(UnknownNameError, match="'mas'"):
        load_vehicle(FILE, {"mas": 5.0})


def test_a_layout_by_positions_is_that_by_arms() -> None:
    arms = load_vehicle(vehicle_path("crazyflie2"))
    places = tuple(map(tuple, arms.hubs.tolist()))
    placed = dataclasses.replace(arms, arm_length=None, rotor_azimuths=None, rotor_positions=places)
    np.testing.assert_array_equal(placed.allocation, arms.allocation)
    np.testing.assert_array_equal(placed.hover_speeds, arms.hover_speeds)
    np.testing.assert_array_equal(arms.hover_speeds, np.full(4, arms.hover_speed))
    np.testing.assert_allclose(placed.azimuths, arms.azimuths)
    assert placed.longest_arm == pytest.approx(arms.longest_arm)
    assert placed.enclosing_radius == pytest.approx(arms.enclosing_radius)


@pytest.mark.parametrize("name", [*PUBLISHED, "uneven"])
def test_the_trim_carries_the_weight_without_torque(name: str) -> None:
    vehicle = uneven() if name == "uneven" else published(name)
    weight = vehicle.mass * vehicle.gravity
    wrench = vehicle.allocation @ vehicle.hover_speeds**2
    np.testing.assert_allclose(wrench, [weight, 0.0, 0.0, 0.0], atol=1e-12 * weight)
    assert vehicle.thrust_shares.sum() == pytest.approx(1.0)
    assert (np.ptp(vehicle.hover_speeds) > 1.0) == (name in ("deadcat", "uneven"))
    most = (vehicle.thrusts(np.full(4, vehicle.speed_max)) / vehicle.thrusts(vehicle.hover_speeds)).min()
    assert vehicle.level_thrust(vehicle.speed_max) == pytest.approx(weight * most)
    if vehicle.thrust_of_speed is None:
        assert most == pytest.approx((vehicle.speed_max / vehicle.hover_speeds.max()) ** 2)


def test_turning_and_its_inverse_have_the_products_of_inertia() -> None:
    vehicle = uneven()
    rates = np.random.default_rng(0).normal(size=(5, 3))
    np.testing.assert_allclose(vehicle.momentum(rates), rates @ vehicle.inertia_matrix)
    np.testing.assert_allclose(vehicle.angular_acceleration(vehicle.momentum(rates)), rates)
    for each in (vehicle, dataclasses.replace(vehicle, products_of_inertia=None)):
        wrench = np.random.default_rng(1).normal(size=(4, 2))
        turned = np.linalg.solve(each.inertia_matrix, wrench[1:])
        np.testing.assert_allclose(each.accelerations(wrench), np.vstack([wrench[:1] / each.mass, turned]))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"rotor_positions": uneven().rotor_positions},
            "rotor_positions must be left out where arm_length and rotor_a",
        ),
        ({"arm_length": None}, "arm_length must be given with rotor_azimuths, or rotor_positions in place of both"),
        ({"rotor_azimuths": None}, "rotor_azimuths must be given with arm_length, or rotor_positions in place of both"),
        ({"rotor_azimuths": (0.0, 400.0, 180.0, 90.0)}, "rotor_azimuths must be within -360 and 360 deg"),
        ({"thrust_coefficient": (1.0, 2.0)}, r"thrust_coefficient must be a list of 4 numbers; got \(1.0, 2.0\)"),
        ({"thrust_coefficient": (1e-5, 1e-5, 1e-5, -1e-5)}, "thrust_coefficient must be positive; got -1e-05"),
        ({"products_of_inertia": (0.1, 0.0, 0.0)}, "products_of_inertia must be such that no principal moment exceeds"),
        ({"products_of_inertia": 0.1}, "products_of_inertia must be a list of 3 numbers; got 0.1"),
        ({"rotor_spins": (1, 1, -1, -1)}, r"rotor_spins must be alternating .*: \(1, -1, 1, -1\)"),
    ],
)
def test_a_layout_that_cannot_be_is_refused(vehicle: Vehicle, changes: dict[str, object], message: str) -> None:
    with pytest.raises(ParameterError, match=rf"^vehicle\.{message}"):
        dataclasses.replace(vehicle, **changes)


@pytest.mark.parametrize(
    ("places", "message"),
    [
        (((0.1, 0.1, 0.0),) * 4, "a layout that controls roll, pitch, yaw and thrust"),
        (((0.1, 0.1, 0.0), (0.1, -0.1), (-0.1, -0.1, 0.0), (-0.1, 0.1, 0.0)), "a list of 4 lists of 3 numbers"),
        (((0.3, -0.1, 0.0), (0.1, 0.1, 0.0), (0.3, 0.1, 0.0), (0.1, -0.1, 0.0)), "a layout in which every rotor lifts"),
        (((0.0, 0.0, 0.1),) * 4, "away from the centre of mass"),
    ],
)
def test_positions_that_cannot_hover_are_refused(places: tuple[tuple[float, ...], ...], message: str) -> None:
    with pytest.raises(ParameterError, match=r"^vehicle\.rotor_positions"):
        dataclasses.replace(uneven(), rotor_positions=places)


def test_what_public_files_get_wrong_is_refused_by_name() -> None:
    """MuJoCo Menagerie's yaw gears, and RotorPy's `crazyflie_params`."""
    with pytest.raises(ParameterError, match=r"\(-1, 1, -1, 1\)"):
        dataclasses.replace(published("x2"), rotor_spins=(-1, 1, 1, -1))
    with pytest.raises(ParameterError, match="inertia"):
        dataclasses.replace(published("cf-brushless"), inertia=(1.43e-5, 1.43e-5, 2.89e-5))


def test_overrides_in_one_form_take_the_place_of_the_other() -> None:
    places = [[0.2, -0.2, 0.0], [-0.2, -0.2, 0.0], [-0.2, 0.2, 0.0], [0.2, 0.2, 0.0]]
    placed = load_vehicle(FILE, {"rotor_positions": places})
    np.testing.assert_array_equal(placed.hubs, places)
    assert (placed.arm_length, placed.rotor_azimuths) == (None, None)
    arms = altered(placed, {"arm_length": 0.3, "rotor_azimuths": [0.0, -90.0, 180.0, 90.0]})
    np.testing.assert_array_equal(arms.hubs, load_vehicle(FILE).hubs)
    with pytest.raises(ParameterError, match="rotor_positions"):
        altered(placed, {"arm_length": 0.3})


def test_a_file_without_a_layout_lacks_both_of_its_parts(tmp_path: Path) -> None:
    path = tmp_path / "bare.toml"
    text = FILE.read_text(encoding="utf-8")
    path.write_text(text.partition("[arm_length]")[0] + "[rotor_spins]" + text.partition("[rotor_spins]")[2])
    with pytest.raises(FileError, match="arm_length"):
        load_vehicle(path)
