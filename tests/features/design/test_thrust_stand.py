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
from quadsim.vehicle import load_vehicle, vehicle_sources

B, RATIO = 1.1e-5, 0.016
SPEEDS = np.linspace(150.0, 800.0, 12)


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
    mine, before = load_vehicle(tmp_path / "mine.toml"), load_vehicle(vehicle_path("hummingbird"))
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


def test_throttle_alone_gives_its_curve_and_a_coefficient_for_the_speed_kept(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    u = np.linspace(0.1, 1.0, 10)
    path = stand(tmp_path / "stand.csv", "throttle,thrust [N]", u, 7.0 * (0.3 * u + 0.7 * u**2))
    assert main(["vehicle", "hummingbird", "--thrust-stand", str(path), "--json"]) == 0
    numbers = json.loads(capsys.readouterr().out)
    np.testing.assert_allclose(numbers["throttle_curve"], (0.3, 0.7), rtol=1e-9)
    full = load_vehicle(vehicle_path("hummingbird")).speed_max
    assert numbers["thrust_coefficient"] == pytest.approx(7.0 / full**2)
    assert main(["vehicle", "--thrust-stand", str(path)]) == 0
    printed = capsys.readouterr().out
    assert "0.3 u + 0.7 u^2" in printed
    assert "750 rad/s" in printed


def test_its_coefficient_takes_the_place_of_a_map(tmp_path: Path) -> None:
    speeds = np.linspace(800.0, 2268.0, 8)
    path = stand(tmp_path / "stand.csv", "speed [rad/s],thrust [N]", speeds, 3.9e-8 * speeds**2)
    mine = tmp_path / "mine.toml"
    mine.write_text(quadsim.vehicle_report(FILES / "cf21b.toml", thrust_stand=path).content, encoding="utf-8")
    vehicle = load_vehicle(mine)
    assert (vehicle.thrust_of_speed, vehicle.thrust_coefficient) == (None, 3.9e-8)


def test_a_stand_that_stops_below_full_throttle_says_so(tmp_path: Path) -> None:
    table = SPEEDS / 1000.0, SPEEDS, B * SPEEDS**2
    text = quadsim.vehicle_report(
        thrust_stand=stand(tmp_path / "s.csv", "throttle,speed [rad/s],thrust [N]", *table)
    ).content
    assert "80% throttle" in text


@pytest.mark.parametrize(
    ("head", "change", "message"),
    [
        ("rpm,thrust", lambda rows: rows, "column 'thrust' must state its unit: thrust [N] or thrust [g]"),
        ("rpm,lift [N]", lambda rows: rows, "needs thrust [N] and rpm, speed [rad/s] or throttle; it has rpm"),
        ("rpm,speed [rad/s],thrust [N]", lambda rows: rows[:, [0, 0, 1]], "has two columns of speed; keep one"),
        ("rpm,thrust [N]", lambda rows: rows[:2], "needs 3 rows or more with the rotor turning; got 2"),
        ("rpm,thrust [N]", lambda rows: 0.0 * rows, "needs 3 rows or more with the rotor turning; got 12"),
        ("rpm,thrust [N]", lambda rows: rows * [1.0, -1.0], "row 2: thrust must be a number, 0 or above; got '-0"),
        ("throttle,thrust [N]", lambda rows: rows, "throttle must be a share, 0 to 1, or throttle [%]; got 800"),
        ("rpm,thrust [N]", lambda rows: rows + np.array([0.0, 5.0]), "thrust does not follow b w^2: 25%"),
        ("throttle,thrust [N]", lambda rows: rows / 1000.0, "throttle must reach 95% where no speed is measured"),
        ("rpm,thrust [N]", lambda rows: rows * np.nan, "row 2: speed must be a number, 0 or above; got 'nan'"),
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
