"""What comes from outside in a log: whatever it is, it is read, or refused by a message that names it."""

from __future__ import annotations

import contextlib
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from flown_logs import COLUMNS, fly_eight, write_log

import quadsim
from quadsim.assets import vehicle_path
from quadsim.errors import FileError, InputError
from quadsim.features.identify.checks import airborne_spans
from quadsim.features.identify.log_errors import fitting_errors, reading_errors, scale_between, stated_number
from quadsim.features.identify.quantities import read_map
from quadsim.features.identify.record import read_record
from quadsim.features.identify.report import identify_logs
from quadsim.features.identify.rotors import lagged_rotors
from quadsim.features.identify.search import FreeParameter
from quadsim.flight.parquet import write_log as write_run
from quadsim.rollout.flown import Flight
from quadsim.scenarios.catalogue import scenario_names
from quadsim.state import Array
from quadsim.vehicle import load_vehicle

NAMES = COLUMNS.split(",")
LONGEST = 6.0  # [s] of a flight of the library whose log is identified
QUICK = ("polytopes", "paper-constrained-heavy", "nonlinear")
"""Flights without lag, whose logs say nothing of it; one that rests at first."""


@pytest.fixture(scope="module")
def eight(tmp_path_factory: pytest.TempPathFactory) -> Array:
    """The first seven seconds of a figure eight as a table (N, 18), a row per sample."""
    path = write_log(fly_eight("hummingbird"), tmp_path_factory.mktemp("eight") / "eight.csv")
    return np.asarray(np.loadtxt(path, delimiter=",", skiprows=1)[:700])


def table(path: Path, rows: Array) -> Path:
    np.savetxt(path, rows, fmt="%.9g", delimiter=",", header=COLUMNS, comments="")
    return path


def corrupted(path: Path, eight: Array, column: str, value: float, row: int | slice = 350) -> Path:
    rows = eight.copy()
    rows[row, NAMES.index(column)] = value
    return table(path, rows)


# Samples


@pytest.mark.parametrize(
    ("column", "value", "largest"),
    [
        ("x", 1e20, "position must be within +-1e+07 m"),
        ("vx", -1e20, "velocity must be within +-1000 m/s"),
        ("vx", 1e4, "velocity must be within +-1000 m/s"),
        ("qw", 1e20, "attitude must be within +-1000 -"),
        ("wy", 1e20, "rates must be within +-1000 rad/s"),
        ("u3", 1e20, "commands must be within +-1e+06 rad/s"),
    ],
)
def test_a_sample_that_no_vehicle_has_is_named(
    tmp_path: Path, eight: Array, column: str, value: float, largest: str
) -> None:
    path = corrupted(tmp_path / "one.csv", eight, column, value)
    with pytest.raises(InputError) as error:
        read_record(path)
    assert str(error.value) == (
        f"one.csv: {column} is {value:.4g} at t = 3.5 s; {largest}: correct the sample or its unit, or leave it empty"
    )


@pytest.mark.parametrize("value", [1e20, 1e5, -1e20, 0.0, np.nan, np.inf])
def test_a_time_that_is_none_is_refused(tmp_path: Path, eight: Array, value: float) -> None:
    """In the middle of a log, or at its end, where a jump would make a clock of any length."""
    for row in (350, -1):
        with pytest.raises(InputError, match=r"goes back|time jumps from 6\.98 to|each with a finite time"):
            read_record(corrupted(tmp_path / "time.csv", eight, "t", value, row))


@pytest.mark.parametrize("value", [np.nan, 0.0, 1.0, 1e3, 1e-310])
@pytest.mark.parametrize("column", ["x", "vx", "qw", "wy", "u3"])
def test_a_column_that_stands_still_is_read_and_checked_or_refused(
    tmp_path: Path, eight: Array, column: str, value: float
) -> None:
    """Nothing else is raised, not even a warning."""
    start = load_vehicle(vehicle_path("hummingbird"))
    with contextlib.suppress(InputError):
        airborne_spans(read_record(corrupted(tmp_path / "still.csv", eight, column, value, slice(None))), start)


@pytest.mark.parametrize("count", [0, 1, 2, 60])
def test_a_log_of_few_rows_is_refused(tmp_path: Path, eight: Array, count: int) -> None:
    start = load_vehicle(vehicle_path("hummingbird"))
    with pytest.raises(InputError):
        airborne_spans(read_record(table(tmp_path / "short.csv", eight[:count])), start)


def test_a_log_that_admits_no_fit_says_so(tmp_path: Path, eight: Array) -> None:
    """A rate that is 0 throughout says nothing of an inertia: its normal equations are singular."""
    path = corrupted(tmp_path / "flat.csv", eight, "wy", 0.0, slice(None))
    with pytest.raises(InputError, match=r"flat\.csv"):
        identify_logs([path], vehicle_path("hummingbird"))


# The guard


@pytest.mark.parametrize(
    "error", [KeyError("timestamp"), IndexError("no"), ZeroDivisionError("by 0"), OverflowError("inf"), MemoryError()]
)
def test_whatever_reading_raises_is_a_fault_of_the_log(error: Exception) -> None:
    named = rf"a\.log: is not a readable ULog \({type(error).__name__}: "
    with pytest.raises(FileError, match=named), reading_errors(Path("a.log"), "ULog", "pyulog"):
        raise error
    with pytest.raises(FileError, match="ours"), reading_errors(Path("a.log"), "ULog"):
        raise FileError(Path("b.log"), "ours")


def test_whatever_a_fit_raises_is_a_fault_of_its_logs() -> None:
    with pytest.raises(InputError, match="a, b"), fitting_errors("a, b"):
        np.linalg.solve(np.zeros((2, 2)), np.ones(2))


@pytest.mark.parametrize("value", [np.nan, np.inf, "x", "", None, 1e30, (1, 2), 1.5])
def test_what_a_log_states_of_itself_is_a_number_in_its_range(value: Any) -> None:
    with pytest.raises(FileError, match=r"a\.ulg: states COUNT = "):
        stated_number(Path("a.ulg"), {"COUNT": value}, "COUNT", 4, low=-5, high=9, whole=True)
    assert stated_number(Path("a.ulg"), {}, "COUNT", 4, whole=True) == 4.0
    assert stated_number(Path("a.ulg"), {"COUNT": "8"}, "COUNT", 4, whole=True) == 8.0


def test_the_ends_of_an_output_are_in_order() -> None:
    assert scale_between(Path("a.ulg"), "pulses", 1000.0, 2000.0) == {"zero": 1000.0, "scale": 1e-3}
    with pytest.raises(FileError, match=r"158\.0"):
        scale_between(Path("a.ulg"), "pulses", 158.0, 158.0)


# Rows that repeat the one before


def moved(eight: Array, change: Callable[[Array], None]) -> Array:
    rows = eight.copy()
    change(rows)
    return rows


def rest_first(rows: Array) -> None:
    """Two seconds of rest, which last until the eight goes on from there."""
    rows[:200, 1:14] = rows[200, 1:14]


def rest_between(rows: Array) -> None:
    rows[300:450, 1:14] = rows[300, 1:14]


def with_rounding(rows: Array) -> None:
    """As another processor has it: what repeats exactly here differs by rounding there."""
    rows[:, 1:14] += 1e-15 * np.random.default_rng(0).standard_normal((len(rows), 13))


@pytest.mark.parametrize("rest", [rest_first, rest_between])
@pytest.mark.parametrize("rounded", [False, True])
def test_rest_is_not_repeated_rows(eight: Array, tmp_path: Path, rest: Callable[[Array], None], rounded: bool) -> None:
    """On any processor the same verdict."""
    rows = moved(eight, rest)
    if rounded:
        with_rounding(rows)
    path = tmp_path / "rest.csv"
    np.savetxt(path, rows, fmt="%.17g", delimiter=",", header=COLUMNS, comments="")
    assert airborne_spans(read_record(path), load_vehicle(vehicle_path("hummingbird")))


def held_by_a_radio(path: Path, eight: Array, times: int, *, rounded: bool) -> Path:
    rows = eight.copy()
    rows[:, 1:14] = np.repeat(eight[::times, 1:14], times, axis=0)[: len(rows)]
    if rounded:
        with_rounding(rows)
    np.savetxt(path, rows, fmt="%.17g", delimiter=",", header=COLUMNS, comments="")
    return path


@pytest.mark.parametrize("times", [2, 3, 10, 150])
@pytest.mark.parametrize("rounded", [False, True])
def test_rows_that_a_radio_holds_are_left_out(eight: Array, tmp_path: Path, times: int, rounded: bool) -> None:
    """For two samples or for more than a second, as what follows has moved once and is held again.

    Where too few are new, the log is refused.
    """
    path = held_by_a_radio(tmp_path / "radio.csv", eight, times, rounded=rounded)
    if times > 5:
        with pytest.raises(InputError, match=r"radio\.csv: [6-9]\d% of its rows repeat .* rows per second are new"):
            read_record(path)
        return
    record = read_record(path)
    assert record.fresh is not None
    assert record.fresh.sum() == pytest.approx(len(eight) / times, abs=5)
    assert re.match(r"radio\.csv: [56]\d% of its rows repeat", record.notes[0])
    (part,) = airborne_spans(record, load_vehicle(vehicle_path("hummingbird")))
    assert part.stop - part.start > len(eight) - 2 * times


def test_rows_that_repeat_a_time_are_left_out(eight: Array, tmp_path: Path) -> None:
    whole = read_record(table(tmp_path / "whole.csv", eight))
    twice = np.insert(eight, [200, 500], eight[[199, 499]], axis=0)
    read = read_record(table(tmp_path / "twice.csv", twice))
    np.testing.assert_array_equal(read.rates, whole.rates)
    assert any("2 rows of" in note and "repeat a time, the first at row 200" in note for note in read.notes)


# Logs among others, and files that are none


def test_a_log_that_cannot_be_used_is_left_out_with_a_line(eight: Array, tmp_path: Path) -> None:
    """Of several; where none is left, its error is the end."""
    good = table(tmp_path / "good.csv", eight)
    still = eight.copy()
    still[:, NAMES.index("u1") :] = 400.0
    bad = table(tmp_path / "bad.csv", still)
    start = vehicle_path("hummingbird")
    result = identify_logs([good, bad], start)
    assert result.logs == ("good.csv",)
    assert result.notes[0].startswith("left out: bad.csv: the motors never run")
    alone = identify_logs([good], start)
    assert [one.value for one in result.identification.estimates] == [
        one.value for one in alone.identification.estimates
    ]
    with pytest.raises(InputError, match="the motors never run"):
        identify_logs([bad], start)
    with pytest.raises(FileError, match="is missing"):
        identify_logs([good, tmp_path / "none.csv"], start)


def test_a_pointer_of_git_lfs_is_named(tmp_path: Path) -> None:
    path = tmp_path / "flight.csv"
    path.write_text("version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 1\n")
    with pytest.raises(FileError, match="git lfs pull"):
        read_record(path)


@pytest.mark.parametrize(("excess", "read"), [(0.001, True), (0.05, False)])
def test_a_throttle_a_little_above_full_is_full(eight: Array, tmp_path: Path, excess: float, read: bool) -> None:
    rows = eight.copy()
    first = NAMES.index("u1")
    rows[:, first : first + 4] /= rows[:, first : first + 4].max() / (1.0 + excess)
    header = COLUMNS.replace("u1,u2,u3,u4", "throttle1,throttle2,throttle3,throttle4")
    path = tmp_path / "throttle.csv"
    np.savetxt(path, rows, fmt="%.9g", delimiter=",", header=header, comments="")
    if not read:
        with pytest.raises(InputError, match="0 to 1"):
            read_record(path)
        return
    throttle = read_record(path).throttle
    assert throttle is not None
    assert throttle.max() == 1.0


def test_a_table_of_blackbox_decode(eight: Array, tmp_path: Path) -> None:
    """Its time is in microseconds by its name; its accelerometer counts 2048 to the g."""
    names = COLUMNS.replace("t,", "time (us),", 1)
    rows = eight.copy()
    rows[:, 0] *= 1e6
    counts = np.tile([0.0, 0.0, 2048.0], (len(rows), 1))
    path = tmp_path / "decoded.csv"
    header = names + ",accSmooth[0],accSmooth[1],accSmooth[2]"
    np.savetxt(path, np.hstack([rows, counts]), fmt="%.9g", delimiter=",", header=header, comments="")
    assert read_record(path).period == pytest.approx(0.01, rel=1e-3)
    meaning = tmp_path / "map.toml"
    meaning.write_text(
        '[specific_force]\ncolumns = ["accSmooth[0]", "accSmooth[1]", "accSmooth[2]"]\nunit = "g/2048"\n'
    )
    (force,) = read_map(meaning)
    assert 2048.0 * force.scale == pytest.approx(9.80665)


def test_the_first_error_names_the_map_and_what_it_knows(eight: Array, tmp_path: Path) -> None:
    path = tmp_path / "other.csv"
    np.savetxt(path, eight, fmt="%.9g", delimiter=",", header=COLUMNS.replace("wx", "omega"), comments="")
    with pytest.raises(FileError, match=r"--columns.*position, velocity, specific_force"):
        read_record(path)


# Lags


def test_rotors_without_lag_have_their_commands_at_once() -> None:
    """Also where a command comes at the sample itself: no time passes there, and 0 over 0 is nothing."""
    commands = np.random.default_rng(0).uniform(100.0, 200.0, (50, 4))
    for lag in (0.0, 1e-310, 1e-12):
        turning = lagged_rotors(commands, 0.01, rise=lag, fall=lag, delay=0.0)
        np.testing.assert_allclose(turning.mean, commands[:-1], rtol=1e-3)
        assert np.isfinite(turning.square).all()


def test_a_number_that_is_sought_stays_within_what_a_vehicle_may_have() -> None:
    lag = FreeParameter("rotor_rise", 0.03, None, 1.5)
    assert lag.value(0.0) == 0.03
    assert lag.value(-1e4) == pytest.approx(1e-6)
    assert lag.value(1e4) == pytest.approx(1e6)


# The library's own flights


def flown(name: str) -> Flight:
    """The first seconds of a flight of the library, or all of one that has its events later."""
    scenario = quadsim.load(name)
    if scenario.duration > LONGEST:
        periods = int(LONGEST / scenario.control_period)
        try:
            scenario = scenario.replace({"duration": periods * scenario.control_period})
        except InputError:
            scenario = quadsim.load(name)
    return quadsim.fly(scenario, progress=False)


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=[] if name in QUICK else pytest.mark.slow("identification"))
        for name in scenario_names()
    ],
)
def test_the_log_of_any_flight_is_identified_or_refused(name: str, tmp_path: Path) -> None:
    """Without a warning; what is found is a number, with an interval that holds it."""
    flight = flown(name)
    write_run(tmp_path, flight.log, plant_stride=5, metadata={})
    start = vehicle_path(flight.scenario.vehicle.file)
    try:
        result = identify_logs([tmp_path], start)
    except InputError:
        if name in QUICK:
            raise
        return
    for estimate in result.identification.estimates:
        assert np.isfinite(estimate.value)
        assert estimate.low <= estimate.value <= estimate.high
