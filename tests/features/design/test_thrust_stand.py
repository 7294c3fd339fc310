"""A thrust stand's table gives back the rotor that was on it, says how well, and is refused by column and row."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
from uneven import FILES

import quadsim
from quadsim.assets import vehicle_path
from quadsim.commands.cli import main
from quadsim.errors import FileError
from quadsim.features.design.thrust_stand import fit_stand
from quadsim.vehicle import load_vehicle, vehicle_sources

B = 1.1e-5
RATIO = 0.016
SPEEDS = np.linspace(150.0, 800.0, 12)
SHARES = np.linspace(0.0, 1.0, 12)
LIFT = 2.0 * SHARES + 5.0 * SHARES**2  # [N]
GRAM = 9.80665e-3  # [N]


def stand(path: Path, head: str, *columns: np.ndarray) -> Path:
    np.savetxt(path, np.stack(columns, axis=1), delimiter=",", header=head, comments="", fmt="%.9g")
    return path


def with_noise(thrust: np.ndarray, share: float) -> np.ndarray:
    return thrust + share * thrust.max() * np.random.default_rng(1).standard_normal(len(thrust))


def test_speeds_give_both_coefficients(tmp_path: Path) -> None:
    """In the units of data sheets, and with the signs of a torque cell; the file flies as any other."""
    thrust = with_noise(B * SPEEDS**2, 0.01)
    torque = -100.0 * RATIO * B * SPEEDS**2
    path = stand(
        tmp_path / "stand.csv", "Throttle (%),RPM,Thrust (g),Torque (N cm),Current (A)",
        np.linspace(20.0, 100.0, 12), SPEEDS * 60.0 / math.tau, thrust / 9.80665e-3, torque, SPEEDS,
    )  # fmt: skip
    text = quadsim.vehicle_report("hummingbird", thrust_stand=path).content
    (tmp_path / "mine.toml").write_text(text, encoding="utf-8")
    mine = load_vehicle(tmp_path / "mine.toml")
    before = load_vehicle(vehicle_path("hummingbird"))
    assert mine.mean_coefficient == pytest.approx(B, rel=0.01)
    assert mine.drag_to_thrust == pytest.approx(RATIO, rel=0.01)
    assert mine.speed_max == pytest.approx(800.0)
    assert mine.inertia == before.inertia
    source = vehicle_sources(tmp_path / "mine.toml")["thrust_coefficient"]
    left = float(np.sqrt(np.square(thrust - B * SPEEDS**2).mean()) / thrust.max())
    assert source.startswith("thrust stand stand.csv, 12 rows")
    assert float(source.partition("to ")[2].partition("%")[0]) == pytest.approx(100.0 * left, abs=0.15)
    table = [line.split() for line in text.splitlines() if line.startswith("#") and line.endswith("%")]
    np.testing.assert_allclose([float(row[2]) for row in table], thrust, rtol=1e-3)
    np.testing.assert_allclose([float(row[3]) for row in table], B * SPEEDS**2, rtol=0.01)


def test_throttle_alone_gives_the_vehicles_map(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The map of a file is replaced by the table's, and no coefficient is made of a speed that nobody measured."""
    u = np.linspace(0.1, 1.0, 10)
    path = stand(tmp_path / "stand.csv", "throttle,thrust [N]", u, 7.0 * (0.3 * u + 0.7 * u**2))
    assert main(["vehicle", "hummingbird", "--thrust-stand", str(path), "--json"]) == 0
    numbers = json.loads(capsys.readouterr().out)
    np.testing.assert_allclose(numbers["thrust_of_throttle"], (2.1, 4.9), rtol=1e-9)
    assert "thrust_coefficient" not in numbers
    mine = tmp_path / "mine.toml"
    assert main(["vehicle", "hummingbird", "--thrust-stand", str(path), "--out", str(mine)]) == 0
    assert load_vehicle(mine).thrust_of_throttle == pytest.approx((2.1, 4.9))
    assert load_vehicle(mine).thrust_coefficient is None
    again = stand(tmp_path / "again.csv", "throttle,thrust [N]", u, 5.0 * (0.5 * u + 0.5 * u**2))
    text = quadsim.vehicle_report(mine, thrust_stand=again).content
    mine.write_text(text, encoding="utf-8")
    assert load_vehicle(mine).thrust_of_throttle == pytest.approx((2.5, 2.5))


@pytest.mark.parametrize(
    ("head", "columns"),
    [
        ("ESC signal (\u00b5s),Thrust (gf)", (1000.0 + 1000.0 * SHARES, LIFT / GRAM)),
        ("esc signal [\u03bcs],Thrust [kgf]", (1000.0 + 1000.0 * SHARES, 1e-3 * LIFT / GRAM)),
        ("throttle [us],thrust [g]", (1000.0 + 1000.0 * SHARES, LIFT / GRAM)),
        ("PWM (%),Thrust (lbf)", (100.0 * SHARES, LIFT / 4.4482216)),
        ("Throttle,Thrust (mN)", (SHARES, 1e3 * LIFT)),
    ],
)
def test_headers_as_stands_write_them(tmp_path: Path, head: str, columns: tuple[np.ndarray, ...]) -> None:
    fit = fit_stand(stand(tmp_path / "stand.csv", head, *columns))
    assert fit.thrust_of_throttle == pytest.approx((2.0, 5.0), rel=1e-6)


@pytest.mark.parametrize(
    ("offset", "linear"), [(0.05, 0.0), (0.15, 0.0), (0.15, 0.4), (0.2, 1.0), (0.3, 0.0), (-0.25, 0.0), (-0.25, 0.4)]
)
def test_a_curve_that_does_not_begin_at_no_throttle_has_its_offset(
    tmp_path: Path, offset: float, linear: float
) -> None:
    """With a dead band, or with an idle speed; the file is one of a vehicle, and the next stand takes it back."""
    u = np.linspace(0.0, 1.0, 21)
    v = np.maximum((u - offset) / (1.0 - offset), 0.0)
    thrust = 7.0 * (linear * v + (1.0 - linear) * v**2)
    path, mine = stand(tmp_path / "stand.csv", "throttle,thrust [N]", u, thrust), tmp_path / "mine.toml"
    assert main(["vehicle", "hummingbird", "--thrust-stand", str(path), "--out", str(mine)]) == 0
    vehicle = load_vehicle(mine)
    assert vehicle.thrust_of_throttle is not None
    found = vehicle.effective_throttle(u)
    a1, a2 = vehicle.thrust_of_throttle
    np.testing.assert_allclose(a1 * found + a2 * found**2, thrust, atol=0.02 * 7.0)
    again = stand(tmp_path / "again.csv", "throttle,thrust [N]", u, LIFT[-1] * (0.3 * u + 0.7 * u**2))
    mine.write_text(quadsim.vehicle_report(mine, thrust_stand=again).content, encoding="utf-8")
    assert load_vehicle(mine).throttle_offset == 0.0


def test_a_line_of_speed_over_throttle_has_its_offset(tmp_path: Path) -> None:
    u = np.linspace(0.1, 1.0, 10)
    head = "throttle,speed [rad/s],thrust [N]"
    speed = 160.0 + 640.0 * u
    fit = fit_stand(stand(tmp_path / "idle.csv", head, u, speed, B * speed**2))
    assert fit.throttle_offset == pytest.approx(-0.25)
    assert fit.thrust_coefficient == pytest.approx(B)
    straight = fit_stand(stand(tmp_path / "straight.csv", head, u, 800.0 * u, B * (800.0 * u) ** 2))
    assert straight.throttle_offset == 0.0
    above = fit_stand(stand(tmp_path / "above.csv", head, u[4:], speed[4:], B * speed[4:] ** 2))
    assert above.throttle_offset is None


def test_a_linear_term_of_the_speed_is_taken_where_it_leaves_less(tmp_path: Path) -> None:
    share = SPEEDS / SPEEDS[-1]
    head = "speed [rad/s],thrust [N]"
    fit = fit_stand(stand(tmp_path / "linear.csv", head, SPEEDS, 7.0 * (0.3 * share + 0.7 * share**2)))
    assert fit.thrust_of_speed == pytest.approx((7.0 * 0.3 / 800.0, 7.0 * 0.7 / 800.0**2))
    assert fit.thrust_coefficient is None
    late = stand(tmp_path / "late.csv", head, SPEEDS, 7.0 * (1.2 * share**2 - 0.2 * share))
    assert fit_stand(late, speed_min=0.0).thrust_coefficient is not None, "it would pull at low speeds"
    assert fit_stand(late, speed_min=140.0).thrust_of_speed == pytest.approx((-1.4 / 800.0, 8.4 / 800.0**2))


def test_a_vehicle_that_is_too_heavy_for_the_rotors_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The template's mass is an example: the file is written, to be filled in."""
    path, mine = (
        stand(tmp_path / "small.csv", "speed [rad/s],thrust [N]", SPEEDS, 1e-6 * SPEEDS**2),
        tmp_path / "m.toml",
    )
    assert main(["vehicle", "--thrust-stand", str(path), "--out", str(mine)]) == 0
    printed = capsys.readouterr().out
    assert "not yet a vehicle, other numbers than the stand's must suit it: vehicle.speed_max must be" in printed
    assert "# not yet a vehicle" in mine.read_text(encoding="utf-8")


@pytest.mark.parametrize("unit", ["N m", "N*m", "N\u00b7m", "N-m", "Nm"])
def test_units_of_torque(tmp_path: Path, unit: str) -> None:
    columns = SPEEDS * 60.0 / math.tau, B * SPEEDS**2, RATIO * B * SPEEDS**2
    fit = fit_stand(stand(tmp_path / "stand.csv", f"Average RPM,Thrust (N),Torque ({unit})", *columns))
    assert fit.drag_to_thrust == pytest.approx(RATIO, rel=1e-6)


@pytest.mark.parametrize(
    ("text", "map_of_throttle"),
    [
        ("throttle;thrust [N]\n0;0\n50%;2,25\n75%;4,3125\n100%;7\n", (2.0, 5.0)),
        ("throttle\tthrust [N]\n0\t0\n0.5\t2.25\n0.75\t4.3125\n1\t7\n", (2.0, 5.0)),
    ],
)
def test_cells_as_stands_write_them(tmp_path: Path, text: str, map_of_throttle: tuple[float, float]) -> None:
    path = tmp_path / "stand.csv"
    path.write_text(text, encoding="utf-8")
    assert fit_stand(path).thrust_of_throttle == pytest.approx(map_of_throttle)


def test_a_propellers_coefficients_with_its_diameter(tmp_path: Path) -> None:
    """T = CT rho n^2 D^4 and Q = CP rho n^2 D^5 / (2 pi), n in turns per second."""
    turns = np.linspace(30.0, 120.0, 8)
    path = tmp_path / "prop.txt"
    rows = "\n".join(f"{60.0 * n:.1f}   0.11   0.045" for n in turns)
    path.write_text(f"RPM  CT  CP\n{rows}\n", encoding="utf-8")
    fit = fit_stand(path, diameter=0.254)
    assert fit.thrust_coefficient == pytest.approx(0.11 * 1.225 * 0.254**4 / math.tau**2, rel=1e-6)
    assert fit.drag_to_thrust == pytest.approx(0.045 / 0.11 * 0.254 / math.tau, rel=1e-6)
    with pytest.raises(FileError, match="--diameter"):
        fit_stand(path)


def test_a_tare_below_zero_stays_and_saturated_rows_are_left_out(tmp_path: Path) -> None:
    thrust = LIFT.copy()
    thrust[0] = -0.01
    u = np.append(SHARES, [0.0])
    fit = fit_stand(stand(tmp_path / "tare.csv", "throttle,thrust [N]", u, np.append(thrust, [-0.02])))
    assert fit.thrust_of_throttle == pytest.approx((2.0, 5.0), rel=0.02)
    flat = np.minimum(LIFT, LIFT[-3])
    saturated = fit_stand(stand(tmp_path / "flat.csv", "throttle,thrust [N]", SHARES, flat))
    assert saturated.thrust_of_throttle == pytest.approx((2.0, 5.0), rel=1e-6)
    (note,) = saturated.notes
    assert note.endswith(": row 12, 13")


def test_of_two_speeds_the_one_that_shows_the_rotor_is_taken(tmp_path: Path) -> None:
    rpm = SPEEDS * 60.0 / math.tau
    head = "Motor Electrical Speed (RPM),Motor Optical Speed (RPM),Thrust (N)"
    dead = fit_stand(stand(tmp_path / "dead.csv", head, rpm, 0.0 * rpm, B * SPEEDS**2))
    assert dead.thrust_coefficient == pytest.approx(B)
    assert "which is 0 throughout" in dead.notes[0]
    both = fit_stand(stand(tmp_path / "both.csv", head, 7.0 * rpm, rpm, B * SPEEDS**2))
    assert both.thrust_coefficient == pytest.approx(B)
    assert "which differs by up to 600%" in both.notes[0]


def test_one_rotor_or_four_is_asked_where_thrust_leaves_a_doubt(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The Hummingbird's four rotors together, as a stand under the whole vehicle shows them."""
    full = 1.1e-5 * 4.0 * SPEEDS**2
    path = stand(tmp_path / "all.csv", "speed [rad/s],thrust [N]", SPEEDS, full)
    mine = tmp_path / "mine.toml"
    assert main(["vehicle", "hummingbird", "--thrust-stand", str(path), "--out", str(mine)]) == 2
    printed = capsys.readouterr()
    assert "--rotors must be stated, 1 or 4" in printed.err
    assert "a vehicle of 0.716 kg would lift" in printed.err
    assert not mine.exists()
    for rotors, coefficient in (("4", 1.1e-5), ("1", 4.4e-5)):
        one = tmp_path / f"{rotors}.toml"
        command = ["vehicle", "hummingbird", "--thrust-stand", str(path), "--rotors", rotors, "--out", str(one)]
        assert main(command) == 0
        assert load_vehicle(one).thrust_coefficient == pytest.approx(coefficient, rel=1e-3)
        text = one.read_text(encoding="utf-8")
        assert ("12 rows of 4 rotors together, divided by 4" in text) == (rotors == "4")
    assert main(["vehicle", "hummingbird", "--rotors", "4"]) == 2
    assert main(["vehicle", "hummingbird", "--thrust-stand", str(path), "--rotors", "3"]) == 2


def test_its_coefficient_takes_the_place_of_a_map(tmp_path: Path) -> None:
    speeds = np.linspace(800.0, 2268.0, 8)
    path = stand(tmp_path / "stand.csv", "speed [rad/s],thrust [N]", speeds, 3.9e-8 * speeds**2)
    mine = tmp_path / "mine.toml"
    mine.write_text(quadsim.vehicle_report(FILES / "cf21b.toml", thrust_stand=path).content, encoding="utf-8")
    vehicle = load_vehicle(mine)
    assert (vehicle.thrust_of_speed, vehicle.thrust_coefficient) == (None, 3.9e-8)


def test_comments_stay_above_the_tables_that_they_explain(tmp_path: Path) -> None:
    """A table takes the place of its example, what it replaces stays as a comment, and the next stand takes it back."""
    template = quadsim.vehicle_report(template=True).content
    throttle = stand(tmp_path / "throttle.csv", "throttle,thrust [N]", SHARES, LIFT)
    mapped = quadsim.vehicle_report(thrust_stand=throttle).content
    (tmp_path / "mapped.toml").write_text(mapped, encoding="utf-8")
    speed = stand(tmp_path / "speed.csv", "speed [rad/s],thrust [N]", SPEEDS, B * SPEEDS**2)
    back = quadsim.vehicle_report(tmp_path / "mapped.toml", thrust_stand=speed).content
    assert (
        "# May be left out: with thrust_coefficient or thrust_of_speed.\n[thrust_of_throttle]\nvalue = [2.0, 5.0]"
        in mapped
    )
    assert "# [thrust_coefficient]\n# value = 1.5e-05\n" in mapped
    assert (
        "# May be left out: with thrust_of_speed or thrust_of_throttle.\n[thrust_coefficient]\nvalue = 1.1e-05" in back
    )
    explanations = [line for line in template.splitlines() if line.startswith(("# Find it", "# May be left out"))]
    for text in (mapped, back):
        assert [
            line for line in text.splitlines() if line.startswith(("# Find it", "# May be left out"))
        ] == explanations


def test_a_stand_that_stops_below_full_throttle_says_so(tmp_path: Path) -> None:
    table = SPEEDS / 1000.0, SPEEDS, B * SPEEDS**2
    text = quadsim.vehicle_report(
        thrust_stand=stand(tmp_path / "s.csv", "throttle,speed [rad/s],thrust [N]", *table)
    ).content
    assert "80% throttle" in text


@pytest.mark.parametrize(
    ("head", "change", "message"),
    [
        ("rpm,thrust", lambda rows: rows, "column 'thrust' must state its unit, one of thrust [N], thrust [mN]"),
        ("rpm,lift [N]", lambda rows: rows, "needs thrust [N] and rpm, speed [rad/s] or throttle, or a propeller"),
        ("rpm,thrust [N]", lambda rows: rows[:2], "needs 3 rows or more with the rotor turning; got 2"),
        ("rpm,thrust [N]", lambda rows: 0.0 * rows, "needs 3 rows or more with the rotor turning; got 12"),
        ("rpm,thrust [N]", lambda rows: rows * [1.0, -1.0], "row 13: thrust must be 0 or above but for a tare;"),
        ("throttle,thrust [N]", lambda rows: rows, "throttle must be a share, 0 to 1, throttle [%], or [us]"),
        ("rpm,thrust [N]", lambda rows: rows + np.array([0.0, 5.0]), "thrust does not follow b w^2: 25%"),
        (
            "rpm,thrust [N]",
            lambda rows: np.vstack([[0.0, 0.3], rows]),
            "row 2: thrust must be at most 0.141 N at speed 0, 2% of the largest; got 0.3 N. Tare the stand",
        ),
        ("throttle,thrust [N]", lambda rows: rows / 1000.0, "throttle must reach 95% where no speed is measured"),
        ("rpm,thrust [N]", lambda rows: rows * np.nan, "row 2: speed must be a number; got 'nan'"),
    ],
)  # fmt: skip
def test_tables_that_cannot_be_used(
    tmp_path: Path, head: str, change: object, message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    rows = change(np.stack([SPEEDS, B * SPEEDS**2], axis=1))  # type: ignore[operator]
    path = stand(tmp_path / "stand.csv", head, *rows.T)
    assert main(["vehicle", "--thrust-stand", str(path)]) == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    assert f"stand.csv: {message}" in printed.err
    assert main(["vehicle", "--thrust-stand", str(tmp_path / "none.csv")]) == 2
    assert main(["vehicle", "--thrust-stand", str(path), "--template"]) == 2
    assert "--template" in capsys.readouterr().err
