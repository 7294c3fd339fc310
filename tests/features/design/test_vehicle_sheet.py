"""What a vehicle's numbers amount to, against closed forms and brute force, and what `quadsim vehicle` prints."""

from __future__ import annotations

import itertools
import json
import math
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import quadsim
from quadsim.assets import vehicle_names, vehicle_path
from quadsim.commands.cli import main
from quadsim.console.results import EXIT_DONE, EXIT_WRONG_INPUT
from quadsim.errors import InputError
from quadsim.features.design.authority import torque_ranges
from quadsim.features.design.vehicle_report import make_sheet
from quadsim.mpc.problem.model import continuous_model, hover_model
from quadsim.scenarios.assembly import Assembly
from quadsim.scenarios.loading import load_scenario
from quadsim.state import INDEX
from quadsim.vehicle import N_ROTORS, VEHICLE_UNITS, Vehicle, load_vehicle

VEHICLES = [load_vehicle(vehicle_path(name)) for name in vehicle_names()]
HUMMINGBIRD, LOPES = (load_vehicle(vehicle_path(n)) for n in ("hummingbird", "lopes2011"))
SKEWED = replace(HUMMINGBIRD, rotor_azimuths=(10.0, 100.0, -170.0, -80.0), speed_min=250.0)
EVERY = pytest.mark.parametrize("vehicle", VEHICLES, ids=lambda vehicle: vehicle.name)


def brute_force(vehicle: Vehicle, row: int) -> tuple[float, float]:
    """Extreme torques over the vertices of {thrust = weight} in the box of squared speeds: all but one at a bound."""
    thrust = vehicle.allocation[0]
    low = vehicle.speed_min**2
    high = vehicle.speed_max**2
    torques = []
    for free in range(N_ROTORS):
        others = [i for i in range(N_ROTORS) if i != free]
        for corner in itertools.product((low, high), repeat=N_ROTORS - 1):
            v = np.zeros(N_ROTORS)
            v[others] = corner
            v[free] = (vehicle.mass * vehicle.gravity - thrust[others] @ corner) / thrust[free]
            if low - 1e-6 <= v[free] <= high + 1e-6:
                torques.append(float(vehicle.allocation[row] @ v))
    return min(torques), max(torques)


@pytest.mark.parametrize("vehicle", [*VEHICLES, SKEWED], ids=[*vehicle_names(), "skewed"])
def test_torque_authority_is_that_of_the_best_vertex(vehicle: Vehicle) -> None:
    for row, torque in enumerate(torque_ranges(vehicle), start=1):
        low, high = brute_force(vehicle, row)
        assert (torque.lowest, torque.highest) == pytest.approx((low, high), rel=1e-9)
        inertia = vehicle.inertia[row - 1]
        assert (torque.lowest_acceleration, torque.highest_acceleration) == pytest.approx(
            (low / inertia, high / inertia)
        )
        assert low - 1e-12 <= torque.lowest_pure < 0.0 < torque.highest_pure <= high + 1e-12


@EVERY
def test_pure_torques_have_their_closed_forms(vehicle: Vehicle) -> None:
    """Without yaw torque each diagonal pair lifts half the weight; in yaw one pair lifts as much as it can."""
    weight = vehicle.mass * vehicle.gravity
    top = vehicle.thrust_coefficient * vehicle.speed_max**2
    swing = min(0.5 * weight, 2.0 * top - 0.5 * weight)  # between the two rotors of a pair
    pairs = 2.0 if abs(vehicle.rotor_azimuths[0]) == 45.0 else 1.0
    lean = math.cos(math.radians(45.0)) if pairs == 2.0 else 1.0
    x, y, z = torque_ranges(vehicle)
    assert x.highest_pure == y.highest_pure == pytest.approx(pairs * lean * vehicle.arm_length * swing)
    assert z.highest_pure == pytest.approx(vehicle.drag_to_thrust * min(weight, 4.0 * top - weight))
    assert z.lowest_pure == pytest.approx(-z.highest_pure)


@EVERY
def test_hover_figures_have_their_closed_forms(vehicle: Vehicle) -> None:
    sheet = make_sheet(vehicle)
    b = vehicle.thrust_coefficient
    weight = vehicle.mass * vehicle.gravity
    lift = 4.0 * b * vehicle.speed_max**2
    assert sheet.weight == weight
    assert 4.0 * b * sheet.hover_speed**2 == pytest.approx(weight)
    assert sheet.hover_speed_rpm == pytest.approx(sheet.hover_speed / (2.0 * math.pi) * 60.0)
    assert sheet.thrust_to_weight == pytest.approx(lift / weight)
    assert sheet.climb_acceleration == pytest.approx((lift - weight) / vehicle.mass)
    assert lift * math.cos(math.radians(sheet.steady_tilt)) == pytest.approx(weight)
    assert sheet.speed_range_used == pytest.approx(sheet.hover_speed / vehicle.speed_max)
    step = 1e-4 * sheet.hover_speed
    rise = b * ((sheet.hover_speed + step) ** 2 - (sheet.hover_speed - step) ** 2) / (2.0 * step)
    assert sheet.thrust_slope == pytest.approx(rise)
    assert sheet.input_slopes["vz"] == pytest.approx(rise / vehicle.mass)
    assert sheet.input_slopes["yaw_rate"] == pytest.approx(rise * vehicle.drag_to_thrust / vehicle.inertia[2])


def test_a_vehicle_that_just_hovers_can_neither_tilt_nor_climb() -> None:
    sheet = make_sheet(replace(LOPES, speed_max=LOPES.hover_speed))
    assert (sheet.steady_tilt, sheet.climb_acceleration) == (0.0, 0.0)
    assert [torque.highest for torque in sheet.torques] == pytest.approx([0.0] * 3, abs=1e-9)


@EVERY
def test_the_linear_model_is_four_chains_of_integrators(vehicle: Vehicle) -> None:
    sheet = make_sheet(vehicle)
    assert sheet.integrator_chains == (4, 4, 2, 2)  # x over pitch, y over roll, z, yaw
    assert sheet.continuous_poles == (0.0,) * 12
    assert sheet.discrete_poles == (1.0,) * 12
    A_c, _ = continuous_model(vehicle)
    assert np.all(np.linalg.matrix_power(A_c, 4) == 0.0)
    assert A_c[INDEX["vx"], INDEX["pitch"]] == vehicle.gravity
    shifted = hover_model(vehicle, sheet.period).A - np.eye(12)  # nilpotent: every pole of A is 1
    assert np.abs(np.linalg.matrix_power(shifted, 4)).max() < 1e-15


def test_rotors_that_lag_add_their_poles() -> None:
    sheet = make_sheet(HUMMINGBIRD)
    assert sheet.lag_poles == {"rotor_rise": pytest.approx(-80.0), "rotor_fall": pytest.approx(-40.0)}
    discrete = {"rotor_rise": pytest.approx(math.exp(-4.0)), "rotor_fall": pytest.approx(math.exp(-2.0))}
    assert sheet.discrete_lag_poles == discrete
    assert make_sheet(LOPES).lag_poles == {}


@pytest.mark.slow("figures")
@pytest.mark.parametrize("name", vehicle_names())
def test_the_command_prints_figures_and_sources(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    vehicle = load_vehicle(vehicle_path(name))
    assert main(["vehicle", name, "--json"]) == EXIT_DONE
    sheet = json.loads(capsys.readouterr().out)
    assert (sheet["name"], sheet["description"]) == (vehicle.name, vehicle.description)
    assert sheet["derived"]["hover_speed"] == vehicle.hover_speed
    given = [key for key in VEHICLE_UNITS if getattr(vehicle, key) is not None]
    assert list(sheet["parameters"]) == given
    assert all(entry["unit"] == VEHICLE_UNITS[key] and entry["source"] for key, entry in sheet["parameters"].items())

    assert main(["vehicle", str(vehicle_path(name))]) == EXIT_DONE
    printed = " ".join(capsys.readouterr().out.split())
    for text in (vehicle.description, f"{vehicle.hover_speed:.4g}", *given):
        assert text in printed
    assert ("rotors that rise" in printed) == (vehicle.rotor_rise is not None)


def test_what_is_left_of_the_example_is_told_by_the_report_and_before_a_flight(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    template = quadsim.vehicle_report(template=True).content
    file = tmp_path / "mine.toml"
    count = len(re.findall(r'(?m)^source = "example"$', template))
    text = template.replace('source = "example"', 'source = "weighed"', 1)  # of the mass
    file.write_text(text, encoding="utf-8")
    left, description = quadsim.vehicle_report(file).leftovers
    assert left.startswith(
        f'mine.toml: {count - 1} of {count} values are of an example (source = "example"), not yours'
    )
    assert ": gravity, inertia" in left
    assert description.startswith("mine.toml: the description is of an example, not yours: 'An example: 1.5 kg")
    assert main(["vehicle", str(file)]) == EXIT_DONE
    assert left[:60] in capsys.readouterr().out
    flown = ("hover", "--set", f"vehicle.file={file}", "--set", "duration=0.1", "--set", "vehicle.gravity=9.8")
    for command in (
        ("run", "--out", str(tmp_path / "run"), "--no-video", "--no-figures", "--no-recording"),
        ("check",),
    ):
        main([*command, *flown])
        message = capsys.readouterr().err
        assert f"quadsim: mine.toml: {count - 2} of {count} values are of an example" in message
        assert "gravity" not in message
    main(["check", str(tmp_path / "run")])
    assert "example" not in capsys.readouterr().err, "its scenario states every number"
    ours = re.sub(r'(?m)^source = "example"$', 'source = "data sheet"', text).replace("An example: ", "")
    file.write_text(ours, encoding="utf-8")
    assert quadsim.vehicle_report(file).leftovers == ()


@pytest.mark.slow("first flights")
@pytest.mark.parametrize(
    ("field", "value", "axis"),
    [
        ("rotor_rise", "0.7", "thrust"),  # slower than any lag that is identified
        ("inertia", "[90.0, 90.0, 160.0]", "p"),  # more than the torque can turn in time
    ],
)
def test_a_vehicle_whose_autopilot_has_no_lag_is_reported_and_flies(
    field: str, value: str, axis: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["vehicle", "--template"]) == EXIT_DONE
    template = capsys.readouterr().out
    file = tmp_path / "slow.toml"
    text, count = re.subn(rf"(?m)^(\[{field}\]\nvalue = ).*", rf"\g<1>{value}", template)
    assert count == 1
    file.write_text(text, encoding="utf-8")
    why = f"autopilot: a step of {axis} is not reached, so no lag fits it; state inner_lag"
    assert main(["vehicle", str(file), "--json"]) == EXIT_DONE
    sheet = json.loads(capsys.readouterr().out)
    assert (sheet["autopilot"]["inner_lag"], sheet["autopilot"]["why"]) == (None, why)
    assert sheet["derived"]["hover_speed"] > 0.0
    assert main(["vehicle", str(file)]) == EXIT_DONE
    printed = " ".join(capsys.readouterr().out.split())
    assert why[:40] in printed
    with pytest.raises(InputError, match=f"a step of {axis} is not reached"):
        _ = Assembly(load_scenario("hover").replace({"vehicle.file": str(file)})).inner_lag


@pytest.mark.parametrize(("suffix", "start"), [("png", b"\x89PNG"), ("svg", b"<?xml"), ("pdf", b"%PDF")])
def test_the_command_draws_the_vehicle(
    suffix: str, start: bytes, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / f"drawing.{suffix}"
    command = ["vehicle", "hummingbird", "--out", str(file)]
    assert main(command) == EXIT_DONE
    assert f"drawing.{suffix}" in capsys.readouterr().out
    content = file.read_bytes()
    assert content.startswith(start)
    assert main(command) == EXIT_WRONG_INPUT
    output = capsys.readouterr()
    assert (output.out, file.name in output.err) == ("", True)
    assert main([*command, "--overwrite"]) == EXIT_DONE
    assert file.read_bytes() == content


def test_another_ending_is_refused_first(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["vehicle", "hummingbird", "--out", str(tmp_path / "v.jpg")]) == EXIT_WRONG_INPUT
    output = capsys.readouterr()
    assert output.out == ""
    assert "v.jpg" in output.err
    assert list(tmp_path.iterdir()) == []


def test_a_notebook_shows_the_drawing() -> None:
    page = quadsim.vehicle_report("hummingbird")._repr_html_()
    assert "<svg" in page
    assert all(f">{text}</text>" in page for text in ("front", "arm 0.170", "turns clockwise"))
