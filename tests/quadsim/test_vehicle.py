"""The vehicle: Table 1, the torques of Sec. 2.2, and every number checked."""

from __future__ import annotations

import dataclasses
import json
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from quadsim.assets import models_dir, vehicle_names, vehicle_path
from quadsim.errors import FileError, InputError, ParameterError, UnknownNameError
from quadsim.vehicle import OPTIONAL_PARAMETERS, VEHICLE_UNITS, Vehicle, load_vehicle, vehicle_sources

FILE = vehicle_path("lopes2011")
TOO_LOW = "vehicle.speed_max must be no lower than its hover speed"
TOO_HIGH = "vehicle.speed_min must be no higher than its hover speed"
CANNOT_HOVER = (
    "192.8 rad/s, or it cannot hover (rotors hold 0 to 150 rad/s; 4 kg weigh 39.24 N, the rotors lift 23.75 N at 150 "
    "rad/s)",
    "272.66 rad/s, or it cannot hover (rotors hold 0 to 250 rad/s; 8 kg weigh 78.48 N, the rotors lift 65.98 N at 250 "
    "rad/s)",
    "192.8 rad/s, or it cannot hover (rotors hold 200 to 250 rad/s; 4 kg weigh 39.24 N, the rotors lift 42.23 N at 200 "
    "rad/s)",
)


def test_it_hovers_at_the_speed_of_table_1(vehicle: Vehicle) -> None:
    assert vehicle.hover_speed == pytest.approx(192.8, rel=1e-6)
    assert vehicle.thrust_coefficient == pytest.approx(4.0 * 9.81 / (4.0 * 192.8**2), rel=1e-6)
    assert (vehicle.mass, vehicle.gravity, vehicle.inertia) == (4.0, 9.81, (0.033, 0.033, 0.066))
    assert vehicle.drag_coefficient == pytest.approx(0.024 * vehicle.thrust_coefficient)


def test_the_wrench_is_that_of_sec_2_2(vehicle: Vehicle) -> None:
    b, d, arm = vehicle.thrust_coefficient, vehicle.drag_coefficient, vehicle.arm_length
    w = np.array([180.0, 190.0, 200.0, 215.0])
    w1, w2, w3, w4 = w**2
    expected = [
        b * (w1 + w2 + w3 + w4),
        b * arm * (w4 - w2),
        b * arm * (w3 - w1),
        d * (w1 - w2 + w3 - w4),
    ]
    np.testing.assert_allclose(vehicle.allocation @ w**2, expected, rtol=1e-12)


def test_rotors_sit_on_the_axes(vehicle: Vehicle) -> None:
    arm = vehicle.arm_length
    expected = [[arm, 0, 0], [0, -arm, 0], [-arm, 0, 0], [0, arm, 0]]
    np.testing.assert_allclose(vehicle.rotor_positions, expected, atol=1e-15)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        *(({name: 0.0}, f"vehicle.{name} must be positive; got 0.0") for name in ("mass", "gravity", "arm_length")),
        ({"thrust_coefficient": -1.0}, "vehicle.thrust_coefficient must be positive; got -1.0"),
        ({"drag_to_thrust": 0}, "vehicle.drag_to_thrust must be positive; got 0"),
        ({"speed_max": -250.0}, "vehicle.speed_max must be positive; got -250.0"),
        ({"mass": np.nan}, "vehicle.mass must be a finite number; got nan"),
        ({"mass": np.inf}, "vehicle.mass must be a finite number; got inf"),
        ({"mass": "4 kg"}, "vehicle.mass must be a finite number; got '4 kg'"),
        ({"mass": True}, "vehicle.mass must be a finite number; got True"),
        ({"mass": 1e-13}, "vehicle.mass must be between 1e-12 and 1e+06; got 1e-13"),
        ({"gravity": 1e7}, "vehicle.gravity must be between 1e-12 and 1e+06; got 10000000.0"),
        ({"speed_min": -1.0}, "vehicle.speed_min must be >= 0 rad/s; got -1.0"),
        (
            {"speed_max": 150.0},
            f"{TOO_LOW}, {CANNOT_HOVER[0]}; got 150.0",
        ),
        ({"mass": 8.0}, f"{TOO_LOW}, {CANNOT_HOVER[1]}; got 250.0"),
        (
            {"speed_min": 200.0},
            f"{TOO_HIGH}, {CANNOT_HOVER[2]}; got 200.0",
        ),
        *(
            ({name: 0.0}, f"vehicle.{name} must be positive; got 0.0")
            for name in OPTIONAL_PARAMETERS
            if name != "body_drag"
        ),
        ({"rotor_rise": -0.02}, "vehicle.rotor_rise must be positive; got -0.02"),
        ({"rotor_fall": np.nan}, "vehicle.rotor_fall must be a finite number; got nan"),
        ({"body_drag": 0.01}, "vehicle.body_drag must be a list of 3 numbers; got 0.01"),
        ({"body_drag": (0.01, 0.01, 0.0)}, "vehicle.body_drag must be positive; got 0.0"),
        ({"speed_min": 250.0}, "vehicle.speed_min must be below speed_max = 250.0; got 250.0"),
        ({"inertia": (0.03, 0.03)}, "vehicle.inertia must be a list of 3 numbers; got (0.03, 0.03)"),
        ({"inertia": 0.03}, "vehicle.inertia must be a list of 3 numbers; got 0.03"),
        ({"inertia": (0.03, 0.0, 0.03)}, "vehicle.inertia must be positive; got 0.0"),
        (
            {"inertia": (0.03, 0.03, 0.07)},
            "vehicle.inertia must be such that no moment exceeds the sum of the other two; got (0.03, 0.03, 0.07)",
        ),
        ({"rotor_azimuths": (0.0, 90.0)}, "vehicle.rotor_azimuths must be a list of 4 numbers; got (0.0, 90.0)"),
        (
            {"rotor_spins": (1, 1, 1, 2)},
            "vehicle.rotor_spins must be four values, each 1 or -1; got (1, 1, 1, 2)",
        ),
        ({"rotor_rise": 30.0}, "vehicle.rotor_rise must be above 0 and at most 1 s, usually 0.01 to 0.3 s; got 30.0"),
        ({"rotor_fall": 1.5}, "vehicle.rotor_fall must be above 0 and at most 1 s, usually 0.01 to 0.3 s; got 1.5"),
        # Layouts that cannot be controlled: neighbours turning one way, all rotors in one place, or on one line.
        *(
            (
                {"rotor_azimuths": azimuths, "rotor_spins": given},
                f"vehicle.rotor_spins must be alternating around the airframe, so that yaw is controlled: {right}; "
                f"got {given}",
            )
            for azimuths, given, right in (
                ((0.0, -90.0, 180.0, 90.0), (1, 1, 1, 1), (1, -1, 1, -1)),
                ((-45.0, -135.0, 135.0, 45.0), (1, 1, -1, -1), (1, -1, 1, -1)),
                ((45.0, -135.0, 135.0, -45.0), (-1, 1, -1, 1), (-1, -1, 1, 1)),  # numbered as PX4 does
                ((-45.0, -135.0, 135.0, 45.0), (-1, -1, -1, 1), (-1, 1, -1, 1)),  # would turn in hover
            )
        ),
        *(
            (change, f"vehicle.rotor_azimuths must be a layout that controls roll, pitch, yaw and thrust; got {given}")
            for change, given in (
                ({"rotor_azimuths": (0.0, 0.0, 0.0, 0.0)}, "(0.0, 0.0, 0.0, 0.0)"),
                ({"rotor_azimuths": (0.0, 180.0, 0.0, 180.0)}, "(0.0, 180.0, 0.0, 180.0)"),
            )
        ),
    ],
    ids=str,
)
def test_a_number_that_cannot_be_is_refused(vehicle: Vehicle, changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ParameterError) as caught:
        dataclasses.replace(vehicle, **changes)
    assert str(caught.value) == message


@pytest.mark.parametrize("azimuths", [(45.0, -45.0, -135.0, 135.0), (10.0, -80.0, -170.0, 100.0)])
def test_any_layout_that_can_be_controlled_is_taken(vehicle: Vehicle, azimuths: tuple[float, ...]) -> None:
    assert dataclasses.replace(vehicle, rotor_azimuths=azimuths).rotor_azimuths == azimuths


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
    found = {
        (round(float(np.sign(x))), round(float(np.sign(y)))): "cw" if spin > 0 else "ccw"  # torque opposes turning
        for (x, y, _), spin in zip(vehicle.rotor_positions, vehicle.rotor_spins, strict=True)
    }
    assert found == turning
    np.testing.assert_allclose(np.hypot(*vehicle.rotor_positions[:, :2].T), vehicle.arm_length)


@pytest.mark.parametrize("name", vehicle_names())
def test_a_vehicle_survives_json(name: str) -> None:
    vehicle = load_vehicle(vehicle_path(name))
    assert Vehicle(**json.loads(json.dumps(dataclasses.asdict(vehicle)))) == vehicle


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


def edited(tmp_path: Path, old: str, new: str) -> Path:
    text = FILE.read_text(encoding="utf-8")
    assert text.count(old) == 1
    path = tmp_path / "mine.toml"
    path.write_text(text.replace(old, new), encoding="utf-8")
    return path


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('name = "lopes2011"', "name = 3", r"^vehicle\.name must be a text; got 3$"),
        ('name = "lopes2011"', "", r"mine\.toml: lacks name$"),
        (
            "[arm_length]",
            "[rotor_lag]",
            r"no vehicle parameter named 'rotor_lag'; did you mean 'rotor_rise' and 'rotor_fall'\?.*mine",
        ),
        ("[arm_length]", "[arm_lenght]", r"no vehicle parameter named 'arm_lenght'; did you mean 'arm_length'\?.*mine"),
        ('unit = "kg"\n', 'unit = "g"\n', r"^vehicle\.mass\.unit must be 'kg'; got 'g'$"),
        ('unit = "kg"\n', "", r"^vehicle\.mass must be a table with exactly value, unit and source; got "),
        ("value = 4.0\n", "value = -4.0\n", r"^vehicle\.mass must be positive; got -4\.0$"),
        ("value = 4.0\n", "value = nan\n", r"^vehicle\.mass must be a finite number; got nan$"),
        ("value = 4.0\n", "value = \n", r"mine\.toml: is not valid TOML: "),
        (
            'unit = "kg"\nsource = "Table 1"',
            'unit = "kg"\nsource = " "',
            r"^vehicle\.mass\.source must be a text saying",
        ),
    ],
)
def test_a_wrong_file_is_refused_with_what_is_wrong(tmp_path: Path, old: str, new: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        load_vehicle(edited(tmp_path, old, new))


def test_a_file_that_lacks_numbers_is_refused_with_their_names(tmp_path: Path) -> None:
    path = tmp_path / "few.toml"
    path.write_text('name = "few"\n[mass]\nvalue = 1.0\nunit = "kg"\nsource = "scales"\n')
    with pytest.raises(FileError, match=r"lacks gravity, inertia, arm_length, .*speed_max$"):
        load_vehicle(path)


def test_a_file_that_cannot_be_read_is_named(tmp_path: Path) -> None:
    with pytest.raises(FileError, match="cannot be read"):
        load_vehicle(tmp_path / "gone.toml")
    (tmp_path / "bytes.toml").write_bytes(b"\xff\xfe")
    with pytest.raises(FileError, match=r"bytes\.toml: cannot be read"):
        load_vehicle(tmp_path / "bytes.toml")


def test_a_layout_that_would_turn_in_hover_is_refused(vehicle: Vehicle) -> None:
    with pytest.raises(ParameterError, match="whose torques cancel when all rotors turn alike"):
        dataclasses.replace(vehicle, rotor_azimuths=(0.0, -90.0, 180.0, 45.0))


@pytest.mark.parametrize("text", ["value = " + "[" * 5000, "value = " + "9" * 5000])
def test_what_python_cannot_read_is_reported(tmp_path: Path, text: str) -> None:
    (tmp_path / "v.toml").write_text(f"[mass]\n{text}\n", encoding="utf-8")
    with pytest.raises(FileError, match=r"v\.toml: (is not valid TOML|must have at most 20 tables and lists)"):
        load_vehicle(tmp_path / "v.toml")


def test_a_number_of_thousands_of_digits_is_refused(tmp_path: Path) -> None:
    text = vehicle_path("lopes2011").read_text(encoding="utf-8").replace("value = 4.0", f"value = 0x{'f' * 5000}")
    (tmp_path / "v.toml").write_text("\ufeff" + text, encoding="utf-8")
    with pytest.raises(ParameterError, match=r"vehicle\.mass must be a finite number; got inf"):
        load_vehicle(tmp_path / "v.toml")
