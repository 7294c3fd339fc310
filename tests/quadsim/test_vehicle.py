"""The vehicle: Table 1, the torques of Sec. 2.2, and every number checked."""

from __future__ import annotations

import dataclasses
import json
import tomllib

import numpy as np
import pytest

from quadsim.assets import models_dir, vehicle_names, vehicle_path
from quadsim.errors import UnknownNameError
from quadsim.vehicle import OPTIONAL_PARAMETERS, VEHICLE_UNITS, Vehicle, load_vehicle, vehicle_sources

FILE = vehicle_path("lopes2011")


def test_it_hovers_at_the_speed_of_table_1(vehicle: Vehicle) -> None:
    assert vehicle.hover_speed == pytest.approx(192.8, rel=1e-6)
    assert vehicle.thrust_coefficient == pytest.approx(4.0 * 9.81 / (4.0 * 192.8**2), rel=1e-6)
    assert (vehicle.mass, vehicle.gravity, vehicle.inertia) == (4.0, 9.81, (0.033, 0.033, 0.066))
    assert (vehicle.drag_to_thrust * vehicle.thrust_coefficient) == pytest.approx(0.024 * vehicle.thrust_coefficient)


def test_the_wrench_is_that_of_sec_2_2(vehicle: Vehicle) -> None:
    b, d, arm = vehicle.thrust_coefficient, (vehicle.drag_to_thrust * vehicle.thrust_coefficient), vehicle.arm_length
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
    with pytest.raises(UnknownNameError, match=r"^no vehicle parameter named 'mas'; did you mean 'mass'\?"):
        load_vehicle(FILE, {"mas": 5.0})
