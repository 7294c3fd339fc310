"""A vehicle from a flight log: command, vehicle file, page, prediction, and what is refused."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from browser import CLASHES, opened
from flown_logs import fly_eight, write_log
from uneven import FILES, published

import quadsim
from quadsim.assets import vehicle_path
from quadsim.commands.cli import main
from quadsim.errors import InputError, ParameterError
from quadsim.features.identify.estimate import Identification, ParameterEstimate, number_in
from quadsim.features.identify.model import Parameters, demanded_speeds, prepare_segment
from quadsim.features.identify.prediction import (
    HORIZONS,
    QUANTITIES,
    RESIDUAL_AFTER,
    PredictionErrors,
    hold_out,
    predict,
)
from quadsim.features.identify.record import Record, read_record
from quadsim.features.identify.report import IdentifiedVehicle
from quadsim.features.identify.search import Search
from quadsim.features.identify.vehicle_file import rounded, vehicle_text
from quadsim.rollout.flown import Flight
from quadsim.vehicle import altered, load_vehicle, vehicle_sources

pytestmark = pytest.mark.slow("identification")

TRUE = "hummingbird"


@pytest.fixture(scope="module")
def eight() -> Flight:
    return fly_eight(TRUE)


@pytest.fixture(scope="module")
def place(eight: Flight, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A directory with a log and a start file."""
    directory = tmp_path_factory.mktemp("identify")
    write_log(eight, directory / "eight.csv")
    text = vehicle_path(TRUE).read_text(encoding="utf-8")
    text = text.replace("8.54858e-6", "7.5e-6").replace("[0.007, 0.007, 0.012]", "[0.009, 0.009, 0.0139]")
    (directory / "start.toml").write_text(text, encoding="utf-8")
    return directory


@pytest.fixture(scope="module")
def identified(place: Path) -> IdentifiedVehicle:
    files = {"out": place / "mine.toml", "page": place / "mine.html"}
    return quadsim.identify(place / "eight.csv", vehicle=place / "start.toml", **files)


@pytest.fixture
def here(place: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A working directory with the log and the start file alone."""
    for name in ("eight.csv", "start.toml"):
        (tmp_path / name).write_bytes((place / name).read_bytes())
    monkeypatch.chdir(tmp_path)
    return tmp_path


def estimate(
    name: str, value: float, start: float | None, *, width: float = 0.02, refused: str = ""
) -> ParameterEstimate:
    """An estimate whose interval has a width of some share of its value."""
    low, high = sorted((value * (1.0 - 0.5 * width), value * (1.0 + 0.5 * width)))
    advice = "yaw steps" if refused else ""
    return ParameterEstimate(
        name=name, unit="-", value=value, low=low, high=high, start=start, refused=refused, advice=advice
    )  # fmt: skip


def test_the_command_finds_the_vehicle_that_flew(identified: IdentifiedVehicle) -> None:
    true = quadsim.load_vehicle(TRUE)
    found = identified.vehicle
    assert found.thrust_coefficient == pytest.approx(true.thrust_coefficient, rel=0.02)
    assert found.inertia[:2] == pytest.approx(true.inertia[:2], rel=0.05)
    errors = identified.prediction.errors
    assert (errors["identified"][-1] < 0.5 * errors["rates held"][-1]).all()
    assert (errors["identified"][-1, 1:] < errors["start"][-1, 1:]).all()


def test_the_file_loads_flies_and_says_where_each_number_is_from(identified: IdentifiedVehicle) -> None:
    assert identified.file is not None
    written = load_vehicle(identified.file)
    sources = vehicle_sources(identified.file)
    assert written.thrust_coefficient == pytest.approx(identified.vehicle.thrust_coefficient, rel=1e-3)
    assert written.inertia == pytest.approx(identified.vehicle.inertia, rel=1e-3)
    assert re.fullmatch(
        r"identified: 95 % within \S+ to \S+; start 7.5e-06; logs eight.csv", sources["thrust_coefficient"]
    )
    assert sources["mass"] == vehicle_sources(vehicle_path(TRUE))["mass"]
    assert identified.file.read_text(encoding="utf-8").startswith("# The AscTec Hummingbird.")
    first = quadsim.scenario(vehicle=identified.file).scenario
    assert quadsim.fly(first.replace({"duration": 2.0}), progress=False).outcome == "satisfied"


def test_the_page_has_every_parameter(identified: IdentifiedVehicle) -> None:
    assert identified.page is not None
    page = identified.page.read_text(encoding="utf-8")
    assert [f'id="{key}"' in page for key in ("intervals", "trace", "residuals", "horizon")] == [True] * 4
    assert all(entry.name in page for entry in identified.identification.estimates)


@pytest.mark.parametrize(("width", "dark"), [(1280, False), (390, True)])
def test_the_page_draws_in_a_browser(identified: IdentifiedVehicle, width: int, dark: bool) -> None:
    """Without a network, and with titles that neither meet nor leave the window."""
    assert identified.page is not None
    with opened(identified.page, width=width, dark=dark) as tab:
        plots = tab.locator(".plot")
        assert plots.count() == 4
        assert [plots.nth(i).evaluate(CLASHES) for i in range(4)] == [0, 0, 0, 0]
        assert tab.locator("text=NaN").count() == 0


def test_the_same_log_gives_the_same_bytes(identified: IdentifiedVehicle, here: Path) -> None:
    words = ["identify", "eight.csv", "--vehicle", "start.toml", "--out", "mine.toml", "--page", "mine.html"]
    assert main(words) == 0
    for first, name in ((identified.file, "mine.toml"), (identified.page, "mine.html")):
        assert first is not None
        assert (here / name).read_bytes() == first.read_bytes()


def test_another_log_can_be_predicted_and_json_has_all_of_it(
    eight: Flight, here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_log(eight, here / "other.csv", seed=1)
    words = ["identify", "eight.csv", "--vehicle", "start.toml", "--test", "other.csv", "--json"]
    assert main(words) == 0
    data = json.loads(capsys.readouterr().out)
    assert (data["logs"], data["test"], data["written"]) == (["eight.csv"], ["other.csv"], [])
    assert data["prediction"]["windows"] > 30
    assert data["prediction"]["errors"].keys() == {
        *("identified", "undisturbed", "start", "rates held", "rates decay", "floor"),
    }
    assert all(len(errors) == 10 for errors in data["prediction"]["errors"]["identified"].values())
    assert {"low", "high", "start", "refused"} <= data["estimates"][0].keys()
    assert sorted(path.name for path in here.iterdir()) == ["eight.csv", "other.csv", "start.toml"]


def test_what_a_gate_refuses_keeps_the_number_of_the_start_and_says_why(place: Path) -> None:
    start = load_vehicle(place / "start.toml")
    new = replace(start, thrust_coefficient=8.54321e-6, inertia=(0.0071, 0.0072, 0.0139))
    estimates = (
        estimate("thrust_coefficient", 8.54321e-6, 7.5e-6),
        estimate("inertia_x", 0.0071, 0.009),
        estimate("inertia_y", 0.0072, 0.009),
        estimate("inertia_z", 0.012, 0.0139, width=0.9, refused="no yaw excitation"),
        estimate("drag_to_thrust", 0.03, 0.016, width=2.0, refused="no yaw excitation"),
    )
    identification = Identification(estimates=estimates, vehicle=new, delay=0.0, offset=(0.0, 0.0))
    path = place / "refused.toml"
    path.write_text(vehicle_text(identification, place / "start.toml", ["a.csv", "b.csv"]), encoding="utf-8")
    written = load_vehicle(path)
    sources = vehicle_sources(path)
    before = vehicle_sources(place / "start.toml")
    assert written.inertia == (0.0071, 0.0072, 0.0139)
    assert written.drag_to_thrust == start.drag_to_thrust
    assert sources["drag_to_thrust"] == f"kept: no yaw excitation; {before['drag_to_thrust']}"
    assert "0.007029 to 0.007171; start 0.009" in sources["inertia"]
    assert sources["inertia"].endswith(f"logs a.csv, b.csv; {before['inertia']}")
    assert written == replace(new, thrust_coefficient=rounded(8.54321e-6, estimates[0]))


def test_an_identified_coefficient_takes_the_place_of_a_map(place: Path) -> None:
    start = published("cf21b")
    path = place / "unmapped.toml"
    assert number_in(start, "thrust_coefficient") == start.mean_coefficient
    thrust = estimate("thrust_coefficient", 3.9e-8, start.mean_coefficient)
    for refused in ("", "not excited"):
        new = start if refused else altered(start, {"thrust_coefficient": 3.9e-8})
        one = replace(thrust, refused=refused)
        identification = Identification(estimates=(one,), vehicle=new, delay=0.0, offset=(0.0, 0.0))
        path.write_text(vehicle_text(identification, FILES / "cf21b.toml", ["a.csv"]), encoding="utf-8")
        assert load_vehicle(path) == new


def test_a_throttle_map_gives_the_speeds_of_the_throttle() -> None:
    start = load_vehicle(vehicle_path(TRUE))
    top = start.mean_coefficient * start.speed_max**2
    mapped = altered(start, {"thrust_of_throttle": (0.4 * top, 0.6 * top)})
    u = np.linspace(0.1, 1.0, 40)
    columns = {name: np.zeros((40, 3)) for name in ("rates", "velocity")}
    throttle = np.stack([u] * 4, axis=1)
    level = np.tile([1.0, 0.0, 0.0, 0.0], (40, 1))
    record = Record(name="a", t=0.01 * np.arange(40), attitude=level, throttle=throttle, **columns)
    speeds = demanded_speeds(record, mapped, Parameters.of(mapped))
    np.testing.assert_allclose(mapped.thrusts(speeds), top * (0.4 * throttle + 0.6 * throttle**2), rtol=1e-12)
    search = Search([prepare_segment(record, 0)], mapped, wind=False)
    assert search.parameters(search.x, 0).throttle_curve == pytest.approx(0.6)


@pytest.mark.parametrize("offset", [0.2, -0.25])
def test_a_throttle_offset_is_where_the_speeds_begin(offset: float) -> None:
    """A line of speed over throttle, with a dead band or an idle speed, and a map of its thrust."""
    start = replace(load_vehicle(vehicle_path(TRUE)), throttle_offset=offset)
    u = np.linspace(0.0, 1.0, 11)
    columns = {name: np.zeros((11, 3)) for name in ("rates", "velocity")}
    throttle, level = np.stack([u] * 4, axis=1), np.tile([1.0, 0.0, 0.0, 0.0], (11, 1))
    record = Record(name="a", t=0.01 * np.arange(11), attitude=level, throttle=throttle, **columns)
    line = start.speed_max * np.maximum((throttle - offset) / (1.0 - offset), 0.0)
    np.testing.assert_allclose(demanded_speeds(record, start, Parameters.of(start)), line, rtol=1e-12, atol=1e-9)
    top = start.mean_coefficient * start.speed_max**2
    mapped, v = altered(start, {"thrust_of_throttle": (0.4 * top, 0.6 * top)}), line / start.speed_max
    speeds = demanded_speeds(record, mapped, Parameters.of(mapped))
    np.testing.assert_allclose(mapped.thrusts(speeds), top * (0.4 * v + 0.6 * v**2), rtol=1e-12, atol=1e-9)


def test_a_parameter_that_the_start_lacks_is_added(place: Path) -> None:
    start = replace(load_vehicle(vehicle_path("lopes2011")), rotor_rise=0.03)
    estimates = (estimate("rotor_rise", 0.03, None), estimate("rotor_fall", 0.9, None, refused="never slows down"))
    identification = Identification(estimates=estimates, vehicle=start, delay=0.0, offset=(0.0, 0.0))
    path = place / "added.toml"
    path.write_text(vehicle_text(identification, vehicle_path("lopes2011"), ["a.csv"]), encoding="utf-8")
    assert load_vehicle(path) == start
    assert vehicle_sources(path)["rotor_rise"] == "identified: 95 % within 0.0297 to 0.0303; logs a.csv"


def test_a_refused_number_that_does_not_suit_the_rest_is_set_and_says_so(place: Path) -> None:
    start = load_vehicle(place / "start.toml")
    estimates = (*(estimate(f"inertia_{axis}", 0.005, 0.009) for axis in "xy"),
                 estimate("inertia_z", 0.03, 0.0139, refused="no yaw excitation"))  # fmt: skip
    new = replace(start, inertia=(0.005, 0.005, 0.0087))
    identification = Identification(estimates=estimates, vehicle=new, delay=0.0, offset=(0.0, 0.0))
    path = place / "set.toml"
    path.write_text(vehicle_text(identification, place / "start.toml", ["a.csv"]), encoding="utf-8")
    assert load_vehicle(path).inertia == (0.005, 0.005, 0.0087)
    assert "z set to 0.0087: no yaw excitation; logs a.csv" in vehicle_sources(path)["inertia"]


def test_the_shortest_log_that_is_allowed_shows_the_thrust(place: Path, tmp_path: Path) -> None:
    rows = (place / "eight.csv").read_text(encoding="utf-8").splitlines()
    (tmp_path / "short.csv").write_text("\n".join(rows[:520]), encoding="utf-8")
    result = quadsim.identify(tmp_path / "short.csv", vehicle=place / "start.toml")
    thrust = next(e for e in result.identification.estimates if e.name == "thrust_coefficient")
    assert not thrust.refused
    assert thrust.low < load_vehicle(vehicle_path(TRUE)).thrust_coefficient < thrust.high


def test_values_have_the_digits_of_their_intervals() -> None:
    assert rounded(8.5432109e-6, estimate("b", 8.5432109e-6, None)) == 8.543e-6
    assert rounded(123.456, replace(estimate("b", 1.0, None), low=20.0, high=420.0)) == 123.0
    assert rounded(0.0012345, replace(estimate("b", 1.0, None), low=-1.0, high=1.0)) == 0.0012
    assert str(rounded(-1e-9, replace(estimate("b", 1.0, None), low=-1.0, high=0.0))) == "-1e-09"
    assert str(rounded(-0.0, replace(estimate("b", 1.0, None), low=-1.0, high=0.0))) == "0.0"
    assert rounded(0.123456789, replace(estimate("b", 1.0, None), low=1.0, high=1.0)) == 0.123456789


def test_the_true_vehicle_predicts_and_rates_are_held(eight: Flight, place: Path) -> None:
    true = load_vehicle(vehicle_path(TRUE))
    wrong = load_vehicle(place / "start.toml")
    record = read_record(place / "eight.csv")
    identification = Identification(estimates=(), vehicle=true, delay=0.0, offset=(0.0, 0.0))
    found = predict([record], [[slice(100, len(record.t))]], identification, wrong)
    noise = np.array([1e-3, 1e-2, 0.0, 1e-2]) * np.sqrt(8.0 / np.pi)  # mean norm of three normal numbers
    at_start = found.errors["identified"][1]
    after = found.errors["identified"][-1]
    assert (at_start < 2.0 * noise + [1e-3, 1e-3, 3e-3, 1e-2]).all()
    assert (after < 0.1 * found.errors["start"][-1] + 3.0 * noise + [0.01, 0.02, 0.01, 0.02]).all()
    held = found.trace.predicted["rates held"][..., 3:]
    assert held == pytest.approx(np.broadcast_to(held[:, :1], held.shape), abs=1e-12)
    assert found.trace.predicted["rates held"][:, 0] == pytest.approx(found.trace.measured[:, 0])
    assert [*QUANTITIES] == ["position", "velocity", "attitude", "body rates"]
    for name, left in found.residuals.items():
        norms = [np.linalg.norm(left[:, of], axis=1).mean() for of in (slice(3), slice(3, 6))]
        assert norms == pytest.approx(found.errors[name][HORIZONS.index(RESIDUAL_AFTER), [1, 3]])
    assert np.diff(found.ends) == pytest.approx(0.25)


def test_the_prediction_knows_delay_offset_and_wind(place: Path) -> None:
    """In place of a flight with them: what they change in a prediction by the true vehicle."""
    true = load_vehicle(vehicle_path(TRUE))
    record = read_record(place / "eight.csv")
    known = Identification(estimates=(), vehicle=true, delay=0.0, offset=(0.0, 0.0))

    def end(**changes: object) -> np.ndarray:
        changed = replace(known, **changes)  # type: ignore[arg-type]
        return predict([record], [[slice(300, 360)]], changed, true).trace.predicted["identified"][0, -1]

    still = end()
    t = 0.5
    weight = true.mass * true.gravity
    pitched = (end(offset=(1e-5, 0.0)) - still)[4]  # in front of the rotors' centre: nose down
    assert pitched == pytest.approx(1e-5 * weight * t / true.inertia[1], rel=0.2)
    turned = (end(yaw_trim=1e-5) - still)[5]
    assert turned == pytest.approx(1e-5 * t / true.inertia[2], rel=0.1)
    assert abs(end(wind=(1.0, 0.0, 0.0)) - still)[0] > 0.01
    assert abs(end(delay=0.02) - still)[3:].max() > 0.01


def test_a_vehicle_that_predicts_worse_is_said_to_and_written_only_anyway(
    here: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The identified vehicle has twice the errors of rates held, in body rates."""

    def doubled(*arguments: Any, **options: Any) -> PredictionErrors:
        found = predict(*arguments, **options)
        errors = {name: of.copy() for name, of in found.errors.items()}
        errors["identified"][:, 3] = 2.0 * errors["rates held"][:, 3]
        return replace(found, errors=errors)

    monkeypatch.setattr("quadsim.features.identify.report.predict", doubled)
    words = ["identify", "eight.csv", "--vehicle", "start.toml", "--out", "mine.toml"]
    assert main(words) == 0
    text = " ".join(capsys.readouterr().out.split())
    assert "worse" in text.partition(":")[0]
    assert "body rates than rates held, 2.00 2.00 times its error" in text
    assert "--anyway" in text
    assert not (here / "mine.toml").exists()
    assert main([*words, "--anyway", "--overwrite"]) == 0
    assert "quadsim run first.toml" not in capsys.readouterr().out
    assert (here / "mine.toml").exists()


def test_the_verdict_comes_first_with_the_errors_over_those_of_each_baseline(identified: IdentifiedVehicle) -> None:
    errors = {
        name: np.full((len(HORIZONS), 4), of)
        for name, of in (("identified", 1.0), ("start", 4.0), ("rates held", 2.0), ("rates decay", 5.0), ("floor", 0.9))
    }
    better = replace(identified.prediction, errors=errors)
    assert "0.25, 0.25, 0.25" in better.verdict
    assert "0.50, 0.50, 0.50" in better.verdict
    assert "0.20, 0.20, 0.20" in better.verdict
    assert not better.lost
    assert not better.at_floor
    lower = {**errors, "rates held": np.full((len(HORIZONS), 4), 0.5)}
    assert replace(better, errors=lower).at_floor == ("position", "velocity", "attitude", "body rates")
    far = {**lower, "floor": np.full((len(HORIZONS), 4), 0.5)}
    assert replace(better, errors=far).at_floor == ()
    assert identified.verdict.text == identified.prediction.verdict


def test_the_last_fifth_of_the_airborne_samples_is_held_out(place: Path) -> None:
    """Of 100 Hz; less than 2 s of a span are not fitted."""
    record = read_record(place / "eight.csv")
    for spans, fitted, held in (
        ([(0, 1000)], [(0, 800)], [(800, 1000)]),
        ([(0, 700), (750, 1050)], [(0, 700)], [(750, 1050)]),
        ([(50, 350), (400, 1100)], [(50, 350), (400, 900)], [(900, 1100)]),
    ):
        cut = hold_out(record, [slice(*span) for span in spans])
        assert cut == ([slice(*span) for span in fitted], [slice(*span) for span in held])


REFUSED: list[tuple[str, str]] = [
    ("", "identify needs a flight log: CSV, Parquet, an autopilot's, or a run directory"),
    ("eight.csv", "identify needs --vehicle, a start: mass and arm are in no log; quadsim vehicle --template"),
    ("eight.csv --vehicle none.toml", "none.toml: no such vehicle file"),
    ("none.csv --vehicle start.toml", "none.csv: is missing"),
    ("start.toml --vehicle start.toml", "start.toml: is not a log that can be read"),
    ("eight.csv --vehicle start.toml --out mine.yaml", "--out must be a file ending in .toml; got 'mine.yaml'"),
    ("eight.csv --vehicle start.toml --page mine", "--page must be a file ending in .html; got 'mine'"),
    ("eight.csv --vehicle start.toml --out start.toml", "start.toml: it already exists; choose another file"),
    ("eight.csv --vehicle start.toml --out no/mine.toml", "no/mine.toml: No such file or directory"),
    (
        "eight.csv --vehicle start.toml --test ./eight.csv",
        "--test must be a log that is not fitted too; got 'eight.csv'",
    ),
    ("eight.csv --vehicle start.toml --poles 14", "poles turn eRPM into speeds"),
    ("ground.csv --vehicle start.toml --out mine.toml --page mine.html", "ground.csv: the motors never run"),
    ("short.csv --vehicle start.toml --out mine.toml", "short.csv: flies for"),
]


@pytest.mark.parametrize(("words", "message"), REFUSED, ids=[words for words, _ in REFUSED])
def test_wrong_input_gives_one_message_and_leaves_nothing_behind(
    words: str, message: str, here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rows = (here / "eight.csv").read_text(encoding="utf-8").splitlines()
    still = [",".join([row.split(",")[0], *rows[1].split(",")[1:-4], *4 * ["100"]]) for row in rows[1:]]
    (here / "ground.csv").write_text("\n".join([rows[0], *still]), encoding="utf-8")
    (here / "short.csv").write_text("\n".join(rows[:350]), encoding="utf-8")
    before = sorted(here.iterdir())
    assert main(["identify", *words.split()]) == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    assert printed.err.count("\n") == 1
    assert message in printed.err
    assert sorted(here.iterdir()) == before


def test_a_vehicle_that_cannot_be_is_refused_with_what_to_check(here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As where the start's moment about z is kept, and is too large beside those that were identified."""

    def refuse(*_: object, **__: object) -> Identification:
        raise ParameterError("vehicle", "inertia", (0.007, 0.007, 0.015), "such that no moment exceeds the others")

    monkeypatch.setattr("quadsim.features.identify.report.identify_records", refuse)
    with pytest.raises(InputError, match=r"start\.toml .*vehicle\.inertia"):
        quadsim.identify("eight.csv", vehicle="start.toml", out="mine.toml")
    assert not (here / "mine.toml").exists()


def test_what_to_fly_and_what_a_scenario_takes_are_said_once(
    identified: IdentifiedVehicle, capsys: pytest.CaptureFixture[str]
) -> None:
    estimates = (
        estimate("thrust_coefficient", 8.5e-6, 7.5e-6),
        estimate("inertia_z", 0.012, 0.0139, refused="no yaw excitation"),
        estimate("rotor_fall", 0.02, None, refused="never slows down"),
        replace(estimate("delay", 0.0123456, None), in_file=False),
        replace(estimate("offset_x", -0.002, None), in_file=False),
    )
    vehicle = replace(identified.vehicle, inertia=(0.007, 0.007, 0.0139), rotor_fall=None)
    found = replace(identified.identification, estimates=estimates, vehicle=vehicle)
    replace(identified, identification=found).show()
    text = capsys.readouterr().out
    assert "3 of 5 " in text
    assert text.count("inertia_z, rotor_fall") == 2
    assert ("no yaw excitation" in text, "never slows down" in text) == (True, True)
    assert "computation.delay = 0.012346" in text
    assert (
        "quadsim run first.toml --set computation.delay=0.012346 --set 'effects.load.centre_of_mass=[-0.002, 0, 0]'"
        in text
    )
