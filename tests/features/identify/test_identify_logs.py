"""Flight logs, read and checked: what is wrong with a log is named in its refusal or in a note; good ones have none."""

from __future__ import annotations

import builtins
import re
import struct
import tomllib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.ndimage import uniform_filter1d

import quadsim
from quadsim.commands.cli import main
from quadsim.errors import FileError, InputError, MissingPackageError, ParameterError
from quadsim.features.identify.checks import airborne_spans, check_log
from quadsim.features.identify.record import Record, read_record
from quadsim.features.identify.rotors import lagged_rotors
from quadsim.features.identify.ulog import stated_rotors
from quadsim.features.identify.windows import to_world
from quadsim.flight.parquet import write_log
from quadsim.rollout.flown import Flight
from quadsim.rotation import conjugate, quaternion_to_euler
from quadsim.state import Array
from quadsim.vehicle import Vehicle

pytestmark = pytest.mark.slow("identification")

FIELDS = {
    "position": "x y z",
    "velocity": "vx vy vz",
    "attitude": "qw qx qy qz",
    "rates": "wx wy wz",
    "commands": "u1 u2 u3 u4",
}
"""Of a record, with the names of their columns."""
NOISE = {"position": 0.002, "velocity": 0.02, "attitude": 0.26, "rates": 0.43}  # [m], [m/s], [deg], [deg/s]
FULL = 838.0  # [rad/s] at full throttle
HALF_TURN = np.array([1.0, -1.0, -1.0])  # about x, of axes front, left, up into front, right, down and back
Corruption = Callable[[Record], Record]
"""What makes a good log a corrupted one."""
Topics = dict[str, tuple[str, Array, Array]]


def flown(vehicle: str, course: str, **changes: Any) -> Flight:
    """Eight seconds at 100 Hz through sensors, with torque noise of 0.01 N m s^0.5 for the Hummingbird's inertia."""
    scenario = quadsim.scenario(vehicle=vehicle, course=course, controller="geometric").scenario
    relative_inertia = quadsim.load_vehicle(vehicle).inertia[0] / quadsim.load_vehicle("hummingbird").inertia[0]
    noise = 0.01 * relative_inertia
    sensors = {f"sensors.{name}": {"rate": 100.0, "noise": value} for name, value in NOISE.items()}
    usual = {"duration": 8.0, "control_period": 0.01, "effects.disturbance.torque_noise": noise}
    return quadsim.fly(scenario.replace({**usual, **sensors, **changes}))


@pytest.fixture(scope="module")
def run_directory(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A figure eight of the Hummingbird with a battery, as its run directory has it."""
    directory = tmp_path_factory.mktemp("eight")
    battery = {"effects.battery": {"cells": 3, "capacity": 2.0, "resistance": 0.02}}
    flight = flown("hummingbird", "figure-eight", **battery)
    write_log(directory, flight.log, plant_stride=5, metadata={})
    return directory


@pytest.fixture(scope="module")
def eight(run_directory: Path) -> Record:
    """That flight, as it is read: a good log."""
    return read_record(run_directory)


@pytest.fixture(scope="module")
def hummingbird() -> Vehicle:
    return quadsim.load_vehicle("hummingbird")


def notes(record: Record, vehicle: Vehicle) -> tuple[str, ...]:
    """What the checks of a log note about it; they raise where it cannot be used."""
    return check_log(record, vehicle, airborne_spans(record, vehicle))


def columns(record: Record, **others: Array) -> dict[str, Array]:
    """A table of a record's columns, with others in their place or beside them."""
    table = {"t": record.t}
    for field, names in FIELDS.items():
        table |= dict(zip(names.split(), getattr(record, field).T, strict=True))
    return {**table, **others}


def write_csv(path: Path, table: dict[str, Array], *, without: str = "", rows: Any = slice(None)) -> Path:
    """Write some rows of a table, but for the columns `without`; NaN is an empty cell."""
    kept = {name: values[rows] for name, values in table.items() if name not in without.split()}
    lines = [",".join(kept)]
    for row in np.stack([*kept.values()], axis=1).tolist():
        lines.append(",".join(map(repr, row)))
    path.write_text("\n".join(lines).replace("nan", "") + "\n")
    return path


def late(record: Record, count: int, *fields: str) -> Record:
    """The record with some fields `count` samples late: the others and not the times lack their first ones."""
    shifted: dict[str, Any] = {"t": record.t[:-count]}
    for name in FIELDS:
        rows = getattr(record, name)
        if name in fields:
            shifted[name] = rows[:-count]
        else:
            shifted[name] = rows[count:]
    return replace(record, **shifted, voltage=None)


# Reading


@pytest.mark.representative("identification")
def test_a_run_directory_is_a_log(run_directory: Path, eight: Record) -> None:
    """With a command for each period and the battery's voltage; quaternions of length one that do not change sign."""
    assert eight.name == read_record(run_directory / "flight.parquet").name == run_directory.name
    assert eight.commands is not None
    assert eight.position is not None
    assert eight.voltage is not None
    assert eight.t.size == 800
    assert eight.period == pytest.approx(0.01)
    assert 9.0 < eight.voltage.min() < eight.voltage.max() < 13.0
    np.testing.assert_allclose(np.linalg.norm(eight.attitude, axis=1), 1.0)
    cosine_of_half_turns = (eight.attitude[1:] * eight.attitude[:-1]).sum(axis=1)
    assert (cosine_of_half_turns > 0.9).all()


def test_csv_is_read_unchanged(tmp_path: Path, eight: Record) -> None:
    read = read_record(write_csv(tmp_path / "a.csv", columns(eight)))
    for name in ("t", *FIELDS):
        np.testing.assert_allclose(getattr(read, name), getattr(eight, name), atol=1e-12)
    assert read.speeds is None
    assert read.notes == ()


def test_other_names_units_and_separators(tmp_path: Path, eight: Record) -> None:
    """Microseconds, body rates p, q, r, Euler angles, rpm, semicolons."""
    assert eight.commands is not None
    table = {"timestamp": np.round(1e6 * eight.t)}
    table |= zip(["vx", "vy", "vz"], eight.velocity.T, strict=True)
    table |= zip(["p", "q", "r"], eight.rates.T, strict=True)
    table |= zip(["roll", "pitch", "yaw"], quaternion_to_euler(eight.attitude).T, strict=True)
    table |= zip(["m1_rpm", "m2_rpm", "m3_rpm", "m4_rpm"], eight.commands.T * 60.0 / (2.0 * np.pi), strict=True)
    path = write_csv(tmp_path / "b.csv", table)
    path.write_text(path.read_text().replace(",", ";"))
    read = read_record(path)
    np.testing.assert_allclose(read.t, eight.t, atol=1e-9)
    cosine_of_half_error = (read.attitude * eight.attitude).sum(axis=1)
    np.testing.assert_allclose(np.abs(cosine_of_half_error), 1.0)
    np.testing.assert_allclose(read.speeds, eight.commands)
    np.testing.assert_allclose(read.rates, eight.rates)
    np.testing.assert_allclose(read.velocity, eight.velocity)


@pytest.mark.parametrize("jitter", [0.0, 3e-3])
def test_clock_is_made_uniform(tmp_path: Path, eight: Record, jitter: float) -> None:
    """Rows with stamps in whole milliseconds stay as they are; with others they are interpolated, and commands held."""
    stamps = np.round(eight.t * 1.037, 3) + jitter * np.sin(np.arange(800.0))
    read = read_record(write_csv(tmp_path / "c.csv", columns(eight, t=stamps)))
    steps = np.diff(read.t)
    np.testing.assert_allclose(steps, steps[0])
    assert read.period == pytest.approx(0.01037, rel=1e-3)
    assert read.commands is not None
    assert eight.commands is not None
    assert set(read.commands[:, 0]) <= set(eight.commands[:, 0])
    if not jitter:
        np.testing.assert_allclose(read.rates, eight.rates)


def test_three_missing_rows_are_bridged_and_thirty_are_a_gap_that_is_left_out(
    tmp_path: Path, eight: Record, hummingbird: Vehicle
) -> None:
    assert eight.commands is not None
    rows = np.r_[0:100, 103:300, 330:800]
    read = read_record(write_csv(tmp_path / "d.csv", columns(eight), rows=rows))
    np.testing.assert_allclose(read.t, eight.t, atol=1e-9)
    assert read.commands is not None
    np.testing.assert_array_equal(read.commands[99:103], np.repeat(eight.commands[99:100], 4, axis=0))
    assert np.isnan(read.rates[300:330]).all()
    parts = airborne_spans(read, hummingbird)
    assert parts == [slice(0, 300), slice(330, 800)]
    (note,) = check_log(read, hummingbird, parts)
    assert "3.7 % of its samples" in note
    assert "t = 3 s" in note


def test_a_log_whose_longest_span_is_too_short_is_refused(tmp_path: Path, eight: Record, hummingbird: Vehicle) -> None:
    """A gap after 3 s, and 3.2 s after it."""
    record = read_record(write_csv(tmp_path / "e.csv", columns(eight), rows=np.r_[0:300, 330:650]))
    with pytest.raises(InputError, match=r"3\.. s"):
        airborne_spans(record, hummingbird)


def test_a_log_without_a_whole_row_is_refused(tmp_path: Path, eight: Record, hummingbird: Vehicle) -> None:
    nothing = np.full(800, np.nan)
    record = read_record(write_csv(tmp_path / "n.csv", columns(eight, vx=nothing)))
    with pytest.raises(InputError, match="0 % "):
        airborne_spans(record, hummingbird)
    path = write_csv(tmp_path / "n.csv", columns(eight, u4=nothing))
    with pytest.raises(InputError, match="rotor"):
        read_record(path)


@pytest.fixture(scope="module")
def lagged_speeds(eight: Record) -> Array:
    """The speeds of the Hummingbird's rotors, which lag behind the commands of `eight` [rad/s]."""
    assert eight.commands is not None
    return lagged_rotors(eight.commands, eight.period, rise=0.0125, fall=0.025, delay=0.0).speeds


def write_erpm(path: Path, record: Record, speeds: Array) -> Path:
    """A log of motors with 14 poles, 7 pairs, without commands; in row 50, the second rotor has no value, 65535."""
    erpm = {}
    for i in range(4):
        rpm = speeds[:, i] * 60.0 / (2.0 * np.pi)
        erpm[f"erpm{i + 1}"] = 7.0 * rpm
    erpm["erpm2"][50] = 65535
    return write_csv(path, {**columns(record), **erpm}, without="u1 u2 u3 u4")


def test_erpm_is_divided_by_the_pairs_of_poles(
    tmp_path: Path, eight: Record, lagged_speeds: Array, hummingbird: Vehicle
) -> None:
    """A missing value is interpolated."""
    read = read_record(write_erpm(tmp_path / "f.csv", eight, lagged_speeds), poles=14)
    assert read.speeds is not None
    np.testing.assert_allclose(read.speeds[:50], lagged_speeds[:50])
    np.testing.assert_allclose(read.speeds[50], read.speeds[[49, 51]].mean(axis=0))
    assert notes(read, hummingbird) == ()


@pytest.mark.parametrize(("poles", "cause"), [(28, "twice the motor's poles"), (2, "eRPM not divided")])
def test_a_wrong_number_of_poles_is_named(
    tmp_path: Path, eight: Record, lagged_speeds: Array, hummingbird: Vehicle, poles: int, cause: str
) -> None:
    record = read_record(write_erpm(tmp_path / "f.csv", eight, lagged_speeds), poles=poles)
    with pytest.raises(InputError, match=cause):
        notes(record, hummingbird)


def test_poles_are_stated_where_erpm_is_logged_and_nowhere_else(
    tmp_path: Path, eight: Record, lagged_speeds: Array
) -> None:
    """An even number of them."""
    path = write_erpm(tmp_path / "f.csv", eight, lagged_speeds)
    with pytest.raises(InputError, match="poles"):
        read_record(path)
    with pytest.raises(ParameterError, match="poles"):
        read_record(path, poles=7)
    without_erpm = write_csv(tmp_path / "g.csv", columns(eight))
    with pytest.raises(InputError, match="erpm"):
        read_record(without_erpm, poles=14)


def test_a_velocity_that_is_not_logged_is_taken_from_the_position(tmp_path: Path, eight: Record) -> None:
    read = read_record(write_csv(tmp_path / "h.csv", columns(eight), without="vx vy vz"))
    (note,) = read.notes
    assert note.startswith("h.csv: no velocity is logged")
    assert np.abs(read.velocity - eight.velocity).mean() < 0.2


@pytest.mark.parametrize(
    ("without", "lacks"),
    [
        ("t", "a column of time: one of t, t_s"),
        ("vx x", "velocity: columns vx,vy,vz or x,y,z"),
        ("qw", "attitude: columns qw,qx,qy,qz or roll,pitch,yaw"),
        ("wy", "body rates: columns wx,wy,wz;"),
        ("u3", "rotor commands or speeds: columns u1,u2,u3,u4 or throttle1,throttle2"),
    ],
)
def test_missing_columns_are_named(tmp_path: Path, eight: Record, without: str, lacks: str) -> None:
    path = write_csv(tmp_path / "i.csv", columns(eight), without=without)
    with pytest.raises(FileError) as error:
        read_record(path)
    assert f"lacks {lacks}" in str(error.value)
    assert "it has" in str(error.value)


def test_columns_of_one_name_are_refused(tmp_path: Path, eight: Record) -> None:
    path = write_csv(tmp_path / "twice.csv", columns(eight, **{"vx [km/h]": eight.velocity[:, 0]}))
    with pytest.raises(FileError, match="vx"):
        read_record(path)


def test_files_that_are_no_logs_are_refused(tmp_path: Path, eight: Record) -> None:
    (tmp_path / "empty").mkdir()
    (tmp_path / "log.txt").write_bytes(b"")
    (tmp_path / "log.csv").write_bytes(b"\x00\xff")
    (tmp_path / "log.ulg").write_bytes(b"no log at all")
    text = write_csv(tmp_path / "text.csv", columns(eight))
    text.write_text(text.read_text().replace("\n0.01,", "\n0.01 s,", 1))
    for name, problem in {
        "none.csv": "is missing",
        "empty": "has no flight.parquet",
        "log.txt": r"can be read \(these can: .csv, .parquet, .ulg",
        "log.csv": "lacks a column of time|is not a readable CSV",
        "log.ulg": "is not a readable ULog",
        "text.csv": "column t must be numbers",
    }.items():
        with pytest.raises(FileError, match=problem):
            read_record(tmp_path / name)


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        (lambda t: np.where(t > 3.0, t - 1.0, t), "goes back from 3 to 2.01 s at row 301"),
        (lambda t: np.round(t, 1), "stands still in .* first at row"),
        (lambda t: 20.0 * t, "5 samples per second, period 0.2 s; at least 10 Hz"),
    ],
)
def test_clocks_that_cannot_be_used_are_refused(
    tmp_path: Path, eight: Record, change: Callable[[Array], Array], problem: str
) -> None:
    path = write_csv(tmp_path / "j.csv", columns(eight, t=change(eight.t)))
    with pytest.raises(InputError, match=problem):
        read_record(path)


def test_quaternions_must_be_of_length_one(tmp_path: Path, eight: Record) -> None:
    path = write_csv(tmp_path / "k.csv", columns(eight, qw=eight.attitude[:, 0] - 0.5))
    with pytest.raises(InputError, match="norm"):
        read_record(path)


@pytest.mark.parametrize(
    ("names", "of", "factors", "offset", "rule"),
    [
        ("throttle1 throttle2 throttle3 throttle4", "u1 u2 u3 u4", 1.0, 1000.0, "throttle1..4 must be shares"),
        ("w1 w2 w3 w4", "u1 u2 u3 u4", [-1.0, 1.0, 1.0, 1.0], 0.0, "must be 0 or above"),
        ("roll pitch yaw", "qx qy qz", [40.0, 1.0, 1.0], 0.0, "must be in rad; got"),
    ],
)
def test_numbers_that_their_unit_cannot_have_are_refused(
    tmp_path: Path, eight: Record, names: str, of: str, factors: Any, offset: float, rule: str
) -> None:
    """Columns that are made of others, which the log does not have: pulses, a rotor that turns back, degrees."""
    table = columns(eight)
    originals = np.stack([table[name] for name in of.split()], axis=1)
    wrong = dict(zip(names.split(), (offset + originals * factors).T, strict=True))
    path = write_csv(tmp_path / "l.csv", table | wrong, without=of)
    with pytest.raises(InputError, match=rule):
        read_record(path)


# Checks


def negated(field: str, *axes: int) -> Corruption:
    """A field with the other sign along some axes."""
    signs = np.ones(3)
    signs[[*axes]] = -1.0
    return lambda record: replace(record, **{field: getattr(record, field) * signs})


def commanded(change: Callable[[Array], Array]) -> Corruption:
    """Other commands."""

    def corrupt(record: Record) -> Record:
        assert record.commands is not None
        return replace(record, commands=change(record.commands))

    return corrupt


def reordered(*order: int) -> Corruption:
    """The commands of the rotors in another order."""
    return commanded(lambda commands: commands[:, list(order)])


def z_down(record: Record) -> Record:
    """World and body axes with z down: NED and FRD."""
    turned = {name: getattr(record, name) * HALF_TURN for name in ("position", "velocity", "rates")}
    return replace(record, attitude=record.attitude * [1.0, *HALF_TURN], **turned)


def turned_world(record: Record) -> Record:
    """Position and velocity in a world that is turned by 90 deg against that of the attitude."""
    moved = {name: getattr(record, name)[:, [1, 0, 2]] * [1.0, -1.0, 1.0] for name in ("position", "velocity")}
    return replace(record, **moved)


def scaled(**factors: Any) -> Corruption:
    """Fields times factors."""

    def corrupt(record: Record) -> Record:
        return replace(record, **{name: factor * getattr(record, name) for name, factor in factors.items()})

    return corrupt


def without_position(corrupt: Corruption) -> Corruption:
    return lambda record: replace(corrupt(record), position=None)


def swapped_rates(record: Record) -> Record:
    return replace(record, rates=record.rates[:, [1, 0, 2]])


def still_about_x(record: Record) -> Record:
    """The rate about x stands still."""
    rates = record.rates.copy()
    rates[:, 0] = 0.1
    return replace(record, rates=rates)


def still_attitude(record: Record) -> Record:
    return replace(record, attitude=np.tile(record.attitude[0], (len(record.t), 1)))


def low_throttle(record: Record) -> Record:
    return replace(record, commands=None, throttle=np.full((len(record.t), 4), 0.1))


def inverse_attitude(record: Record) -> Record:
    return replace(record, attitude=conjugate(record.attitude))


def scalar_last(record: Record) -> Record:
    return replace(record, attitude=np.roll(record.attitude, -1, axis=1))


def velocity_in_the_body(record: Record) -> Record:
    return replace(record, velocity=to_world(conjugate(record.attitude), record.velocity))


def on_the_ground(record: Record) -> Record:
    """Rotors that idle, and sensors that see next to nothing."""
    return replace(
        record,
        commands=90.0 + 0.2 * np.sin(record.t[:, None] + np.arange(4.0)),
        velocity=0.02 * record.rates,
        rates=0.02 * record.rates,
        position=np.zeros_like(record.velocity),
    )


def held_by_a_radio(record: Record, times: int) -> Record:
    """Each row some times, in the place of those after it."""
    rows = {name: np.repeat(getattr(record, name)[::times], times, axis=0) for name in FIELDS}
    return replace(record, **rows)


CORRUPTED: dict[str, Corruption] = {
    "wx is negated": negated("rates", 0),
    "wy is negated": negated("rates", 1),
    "wz is negated": negated("rates", 2),
    "wy and wz are negated": negated("rates", 1, 2),
    "5[67].* times the rates at which the attitude turns: likely deg/s": scaled(rates=180.0 / np.pi),
    "wx, wy, wz are 1.1 times the rates": scaled(rates=1.1),
    "wx, wy, wz are (2|2.01) times .*twice the full scale": scaled(rates=2.0),
    "wz is (2|1.99|2.01) times .*twice the full scale": scaled(rates=np.array([1.0, 1.0, 2.0])),
    "vx, vy, vz are 3.6 times the slope of the position: likely km/h": scaled(velocity=3.6),
    "vx, vy, vz are 1.1 times the slope": scaled(velocity=1.1),
    "x, y, z are 100 times .*likely in cm": scaled(position=100.0),
    "vx, vy change 3.* times as fast as tilt and gravity make them: likely ft/s": without_position(
        scaled(velocity=3.2808)
    ),
    "say that the clock runs (2|1.9.|2.0.) times as fast": scaled(t=2.0),
    "against gravity say that the clock runs 0.[89].* times as fast": without_position(scaled(t=0.9)),
    "wx stands still while the others change": still_about_x,
    "wx, wy, wz stand still while the motors run": scaled(rates=0.0),
    "qw, qx, qy, qz stand still": still_attitude,
    "outputs of rotor 2 never change": commanded(lambda commands: commands * [1.0, 0.0, 1.0, 1.0]),
    "motors never run: the rotors' outputs stay at 0.1: no flight": low_throttle,
    "50 % of its rows repeat|50% of its rows repeat": lambda record: held_by_a_radio(record, 2),
    "outputs change 9.89 times per second, and rates are logged 100 times": commanded(
        lambda commands: np.repeat(commands[::10], 10, axis=0)
    ),
    "wx and wy are swapped": swapped_rates,
    "world to body: negate qx, qy, qz": inverse_attitude,
    "in the order x, y, z, w": scalar_last,
    "NED, FRD": z_down,
    "slope of the position: vy is negated": negated("velocity", 1),
    "heading is -9. deg off": turned_world,
    "along the body's axes": velocity_in_the_body,
    "rates are (19|2[01]) ms late": lambda record: late(record, 2, "rates"),
    "velocity is 1[45]. ms late": lambda record: late(record, 15, "velocity", "position"),
    "rotors 1 and 2 are swapped: try the order u2,u1,u3,u4": reordered(1, 0, 2, 3),
    "another order: try the order u4,u1,u2,u3": reordered(1, 2, 3, 0),
    "rpm taken for rad/s": commanded(lambda commands: 9.549 * commands),
    "pole pairs given as poles": commanded(lambda commands: 2.0 * commands),
    "motors never run": commanded(np.zeros_like),
    "never flies.*change by 0 %, its altitude by 0": on_the_ground,
}
"""What the refusal of a log says, and what was done to the log."""


@pytest.mark.parametrize("name", CORRUPTED)
def test_corrupted_logs_are_refused_by_what_is_wrong_with_them(eight: Record, hummingbird: Vehicle, name: str) -> None:
    corrupted = CORRUPTED[name](eight)
    with pytest.raises(InputError, match=name) as error:
        notes(corrupted, hummingbird)
    assert str(error.value).startswith(f"{eight.name}: ")


@pytest.mark.parametrize("factor", [1.0, 1.5])
def test_good_log_passes(eight: Record, hummingbird: Vehicle, factor: float) -> None:
    """Without a note, also with a start whose thrust coefficient and inertia are half as high again."""
    inertia = tuple(factor * moment for moment in hummingbird.inertia)
    start = replace(hummingbird, thrust_coefficient=factor * hummingbird.thrust_coefficient, inertia=inertia)
    assert airborne_spans(eight, start) == [slice(0, 800)]
    assert notes(eight, start) == ()


@pytest.mark.parametrize(
    ("vehicle", "course", "seed"),
    [
        ("hummingbird", "hover", 1),
        ("hummingbird", "hover", 2),
        ("crazyflie2", "hover", 1),
        ("crazyflie2", "figure-eight", 1),
    ],
)
def test_closed_loops_with_torque_noise_pass(tmp_path: Path, vehicle: str, course: str, seed: int) -> None:
    """Without a note; yet swapped rotors, a frame turned by 45 deg and reversed spins are named.

    The feedback hides how commands and motion depend on each other: a regression of the one on the other is biased.
    """
    write_log(tmp_path, flown(vehicle, course, seed=seed).log, plant_stride=5, metadata={})
    record = read_record(tmp_path)
    start = quadsim.load_vehicle(vehicle)
    assert notes(record, start) == ()
    swapped = reordered(2, 1, 0, 3)(record)
    with pytest.raises(InputError, match="u3,u2,u1,u4"):
        notes(swapped, start)
    turned = replace(start, rotor_azimuths=tuple(azimuth + 45.0 for azimuth in start.rotor_azimuths))
    with pytest.raises(InputError, match="45 deg"):
        notes(record, turned)
    reversed_spins = replace(start, rotor_spins=tuple(-spin for spin in start.rotor_spins))
    with pytest.raises(InputError, match="rotor_spins"):
        notes(record, reversed_spins)


def test_small_shifts_are_notes(eight: Record, hummingbird: Vehicle) -> None:
    """Of 10 ms, and of about 40 ms."""
    (note,) = notes(late(eight, 1, "rates"), hummingbird)
    assert "the rates are 10 ms late against the attitude" in note
    (note,) = notes(late(eight, 4, "velocity", "position"), hummingbird)
    lateness = re.search(r"the velocity is (\d+)\S* ms late", note)
    assert lateness is not None
    assert 30 <= int(lateness[1]) < 50


def test_poor_logs_are_notes(eight: Record, hummingbird: Vehicle) -> None:
    """25 Hz, commands that are clipped, and a hover speed that is half as high again."""
    assert eight.commands is not None
    slow = replace(eight, **{name: getattr(eight, name)[::4] for name in ("t", *FIELDS, "voltage")})
    assert "25 Hz; below 50 Hz" in "\n".join(notes(slow, hummingbird))
    middle = np.median(eight.commands)
    clipped = replace(eight, commands=np.clip(eight.commands, 0.95 * middle, 1.05 * middle))
    assert "commands are at a limit" in "\n".join(notes(clipped, hummingbird))
    fast = "\n".join(notes(replace(eight, commands=1.5 * eight.commands), hummingbird))
    assert "1.49 times the start's hover speed" in fast
    assert "above the start's speed_max of 838 rad/s" in fast


def test_what_is_on_the_ground_is_cut(tmp_path: Path) -> None:
    """At most half a second after take-off, and a second before landing, go with it."""
    write_log(tmp_path, quadsim.fly("take-off-and-landing").log, plant_stride=5, metadata={})
    record = read_record(tmp_path)
    (part,) = airborne_spans(record, quadsim.load_vehicle("lopes2011"))
    assert record.position is not None
    aloft = record.t[record.position[:, 2] > 0.02]
    assert aloft[0] <= record.t[part.start] < aloft[0] + 0.5
    assert aloft[-1] - 1.0 < record.t[part.stop - 1] <= aloft[-1]


# ULog


def message(kind: str, payload: bytes) -> bytes:
    """A message of a ULog."""
    return struct.pack("<HB", len(payload), ord(kind)) + payload


def parameter(name: str, value: float) -> bytes:
    """The message (P) that states a parameter."""
    if isinstance(value, int):
        key = f"int32_t {name}".encode()
        number = struct.pack("<i", value)
    else:
        key = f"float {name}".encode()
        number = struct.pack("<f", value)
    return message("P", bytes([len(key)]) + key + number)


def data(topic: int, fields: str, times: Array, rows: Array) -> list[bytes]:
    """The messages (D) of a topic by its number; `fields` has its format."""
    letter = "f"
    if "esc" in fields:
        letter = "i"
        rows = rows.astype(int)
    if "bool" in fields:
        letter = "?"
    parts = []
    for t, row in zip(times, rows, strict=True):
        stamp = struct.pack("<HQ", topic, round(1e6 * t))
        parts.append(message("D", stamp + struct.pack(f"<{len(row)}{letter}", *row.tolist())))
    return parts


def ulog(path: Path, topics: Topics, formats: str = "", parameters: dict[str, float] | None = None) -> Path:
    """Write a ULog.

    Args:
        path: where.
        topics: by name, the format of their fields, times [s] and rows of numbers.
        formats: of types that fields have, one a line.
        parameters: numbers by name; a whole one is an int32_t.
    """
    parts = [b"ULog\x01\x12\x35\x01" + struct.pack("<Q", 0)]
    for line in formats.splitlines():
        parts.append(message("F", line.encode()))
    for name, (fields, _, _) in topics.items():
        parts.append(message("F", f"{name}:uint64_t timestamp;{fields}".encode()))
    for name, value in (parameters or {}).items():
        parts.append(parameter(name, value))
    for number, name in enumerate(topics):
        parts.append(message("A", struct.pack("<BH", 0, number) + name.encode()))
    for number, (fields, times, rows) in enumerate(topics.values()):
        parts += data(number, fields, times, rows)
    path.write_bytes(b"".join(parts))
    return path


def rows_before(record: Record, t: Array) -> Any:
    """The last rows before times; one at the time itself, but for rounding, is not before it."""
    return np.searchsorted(record.t, t - 1e-4) - 1


def commands_before(record: Record, t: Array) -> Array:
    """The commands of the last rows before times."""
    assert record.commands is not None
    return record.commands[rows_before(record, t)]


def px4_topics(record: Record) -> Topics:
    """A record as PX4 logs it: NED, FRD, every topic at its own rate, the rates 1 ms after the sample."""
    down = z_down(record)
    assert down.position is not None
    assert down.commands is not None
    local = np.concatenate([down.position, down.velocity], axis=1)
    return {
        "vehicle_angular_velocity": ("float[3] xyz;", down.t + 0.001, down.rates),
        "vehicle_attitude": ("float[4] q;", down.t, down.attitude),
        "vehicle_local_position": ("float x;float y;float z;float vx;float vy;float vz;", down.t[::2], local[::2]),
        "actuator_motors": ("float[4] control;", down.t, down.commands / FULL),
        "battery_status": ("float voltage_v;", down.t[::100], np.full((8, 1), 11.5)),
    }


def test_ulog(tmp_path: Path, eight: Record, hummingbird: Vehicle) -> None:
    """Its axes are turned into ours, its topics onto one clock, and it passes the checks."""
    record = read_record(ulog(tmp_path / "px4.ulg", px4_topics(eight)))
    inner = slice(10, 600)
    before = rows_before(eight, record.t[inner])
    assert record.throttle is not None
    np.testing.assert_allclose(record.throttle[inner], commands_before(eight, record.t[inner]) / FULL, rtol=1e-5)
    for name in ("velocity", "attitude", "position"):
        np.testing.assert_allclose(getattr(record, name)[inner], getattr(eight, name)[before], atol=0.2)
    np.testing.assert_allclose(record.rates[inner], eight.rates[before], atol=1e-5)
    assert record.voltage == pytest.approx(11.5)
    assert notes(record, hummingbird) == ()


def test_ulog_with_outputs_and_speeds(tmp_path: Path, eight: Record) -> None:
    """As old versions of PX4 log them: pulses from 1000 to 2000 us, whole rpm."""
    topics = px4_topics(eight)
    _, t, throttle = topics.pop("actuator_motors")
    rpm = FULL * throttle * 60.0 / (2.0 * np.pi)
    topics["actuator_outputs"] = ("float[4] output;", t, 1000.0 + 1000.0 * throttle)
    topics["esc_status"] = ("esc_report[4] esc;", t, np.round(rpm))
    record = read_record(ulog(tmp_path / "old.ulg", topics, formats="esc_report:int32_t esc_rpm;"))
    assert record.throttle is not None
    assert record.speeds is not None
    np.testing.assert_allclose(record.speeds, FULL * record.throttle, rtol=0.1)


def test_ulog_pulses_are_those_of_each_motor(tmp_path: Path, eight: Record) -> None:
    """Motors on outputs 5 to 8; a shortest pulse of -1 is the common one; below it, a motor stands."""
    topics = px4_topics(eight)
    _, t, throttle = topics.pop("actuator_motors")
    outputs = np.concatenate([np.full((len(t), 4), 900.0), 1100.0 + 800.0 * throttle], axis=1)
    outputs[:20, 4:] = 900.0
    topics["actuator_outputs"] = ("float[8] output;", t, outputs)
    stated: dict[str, float] = {"PWM_MAIN_MIN": 1100, "PWM_MAIN_MAX": 2000}
    for motor in range(4):
        output = 5 + motor
        stated[f"PWM_MAIN_FUNC{output}"] = 101 + motor
        stated[f"PWM_MAIN_MIN{output}"] = -1
        stated[f"PWM_MAIN_MAX{output}"] = 1900
    record = read_record(ulog(tmp_path / "pwm.ulg", topics, parameters=stated))
    assert record.throttle is not None
    inner = slice(50, 600)
    np.testing.assert_allclose(record.throttle[inner], commands_before(eight, record.t[inner]) / FULL, rtol=1e-5)
    np.testing.assert_array_equal(record.throttle[:10], 0.0)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("PWM_MAIN_FUNC1", np.nan),
        ("PWM_MAIN_FUNC1", np.inf),
        ("PWM_MAIN_MIN1", np.nan),
        ("PWM_MAIN_MIN", 2**31 - 1),
        ("PWM_MAIN_MIN", 2000),
    ],
)
def test_impossible_pulses_of_a_ulog_are_refused_where_they_matter(
    tmp_path: Path, eight: Record, name: str, value: float
) -> None:
    """Where its throttle is logged as pulses, and not where it is logged as a share."""
    topics = px4_topics(eight)
    assert read_record(ulog(tmp_path / "share.ulg", topics, parameters={name: value})).throttle is not None
    _, t, throttle = topics.pop("actuator_motors")
    topics["actuator_outputs"] = ("float[4] output;", t, 1000.0 + 1000.0 * throttle)
    with pytest.raises(FileError, match=rf"odd\.ulg: states ({name} = .*; it must be|pulses of PWM_MAIN from )"):
        read_record(ulog(tmp_path / "odd.ulg", topics, parameters={name: value}))


@pytest.mark.parametrize("value", [np.nan, np.inf, 4.5])
def test_rotors_of_a_ulog_that_are_no_number_are_refused(tmp_path: Path, eight: Record, value: float) -> None:
    path = ulog(tmp_path / "px4.ulg", px4_topics(eight), parameters={"CA_ROTOR_COUNT": value})
    with pytest.raises(FileError, match=r"px4\.ulg: .*CA_ROTOR_COUNT"):
        stated_rotors(path)


@pytest.mark.representative("identification")
def test_a_topic_of_a_ulog_without_time_is_left_out_with_a_note_or_refused_where_it_is_needed(
    tmp_path: Path, eight: Record, capfd: pytest.CaptureFixture[str]
) -> None:
    """Its reader prints nothing."""
    path = ulog(tmp_path / "px4.ulg", px4_topics(eight))
    whole = path.read_bytes()
    path.write_bytes(whole.replace(b"battery_status:uint64_t timestamp;", b"battery_status:uint64_t timestemp;"))
    record = read_record(path)
    assert record.voltage is None
    (note,) = record.notes
    assert "battery_status" in note
    path.write_bytes(whole.replace(b"vehicle_attitude:uint64_t timestamp;", b"vehicle_attitude:uint64_t timestemp;"))
    with pytest.raises(FileError, match="vehicle_attitude"):
        read_record(path)
    assert capfd.readouterr() == ("", "")


def test_ulog_knows_when_it_flies(tmp_path: Path, eight: Record, hummingbird: Vehicle) -> None:
    """While it is armed and has not landed; one that is never armed is refused."""
    topics = px4_topics(eight)
    topics["actuator_armed"] = ("bool armed;", np.array([0.0, 0.5, 7.8]), np.array([[False], [True], [False]]))
    topics["vehicle_land_detected"] = ("bool landed;", np.array([0.0, 1.0]), np.array([[True], [False]]))
    record = read_record(ulog(tmp_path / "armed.ulg", topics))
    (part,) = airborne_spans(record, hummingbird)
    np.testing.assert_allclose(record.t[[part.start, part.stop - 1]], [1.0, 7.8], atol=0.011)
    topics["actuator_armed"] = ("bool armed;", np.zeros(1), np.array([[False]]))
    parked = read_record(ulog(tmp_path / "parked.ulg", topics))
    with pytest.raises(InputError, match=r"parked\.ulg"):
        airborne_spans(parked, hummingbird)


@pytest.fixture(scope="module")
def smooth(eight: Record) -> Record:
    """`eight` with a velocity that is smooth enough to be differentiated."""
    return replace(eight, velocity=uniform_filter1d(eight.velocity, 9, axis=0))


def accelerometer(record: Record) -> tuple[str, Array, Array]:
    """The topic of an accelerometer: the specific force in FRD, at full rate."""
    without_gravity = np.gradient(record.velocity, record.t, axis=0) + np.array([0.0, 0.0, 9.81])
    specific_force = to_world(conjugate(record.attitude), without_gravity)  # along the body's axes
    return "float[3] accelerometer_m_s2;", record.t, specific_force * HALF_TURN


def test_the_accelerometer_fills_in_a_slow_velocity(tmp_path: Path, smooth: Record) -> None:
    """By default, PX4 logs its velocity at 10 Hz and its accelerometer at full rate."""
    topics = px4_topics(smooth)
    fields, t, local = topics["vehicle_local_position"]
    topics["vehicle_local_position"] = (fields, t[::5], local[::5])
    alone = read_record(ulog(tmp_path / "alone.ulg", topics))
    topics["sensor_combined"] = accelerometer(smooth)
    filled = read_record(ulog(tmp_path / "slow.ulg", topics))
    (note,) = filled.notes
    assert "the velocity is logged at 10 Hz" in note

    def roughness(read: Record) -> float:
        """The deviation, from sample to sample, of the error of vx."""
        inner = slice(100, 600)
        true = np.interp(read.t[inner], smooth.t, smooth.velocity[:, 0])
        return float(np.std(np.diff(true - read.velocity[inner, 0])))

    assert roughness(filled) < 0.6 * roughness(alone)


def test_the_accelerometer_stands_in_for_a_velocity_that_is_not_logged(tmp_path: Path, smooth: Record) -> None:
    topics = px4_topics(smooth)
    topics["sensor_combined"] = accelerometer(smooth)
    del topics["vehicle_local_position"]
    assert read_record(ulog(tmp_path / "imu.ulg", topics)).inertial


def test_advice_names_the_setting_of_the_autopilot(tmp_path: Path, eight: Record, hummingbird: Vehicle) -> None:
    """For outputs that change every tenth sample, and that are logged every tenth."""
    topics = px4_topics(eight)
    fields, t, throttle = topics["actuator_motors"]
    held = (fields, t, np.repeat(throttle[::10], 10, axis=0))
    rare = (fields, t[::10], throttle[::10])
    for topic in (held, rare):
        topics["actuator_motors"] = topic
        record = read_record(ulog(tmp_path / "default.ulg", topics))
        with pytest.raises(InputError, match=r"outputs change (9|10)\b.* log the outputs .*set SDLOG_PROFILE to 17"):
            airborne_spans(record, hummingbird)


def test_rotors_that_a_ulog_states_are_offered_for_the_start(
    tmp_path: Path, eight: Record, capsys: pytest.CaptureFixture[str]
) -> None:
    x = (0.1, -0.12, 0.11, -0.1)
    y = (0.2, -0.21, -0.2, 0.2)
    turns = (1.0, 1.0, -1.0, -1.0)
    stated: dict[str, float] = {"CA_ROTOR_COUNT": 4}
    for i in range(4):
        stated |= {f"CA_ROTOR{i}_PX": x[i], f"CA_ROTOR{i}_PY": y[i], f"CA_ROTOR{i}_PZ": -0.05}
        stated |= {f"CA_ROTOR{i}_KM": 0.06 * turns[i]}
    path = ulog(tmp_path / "px4.ulg", px4_topics(eight), parameters=stated)
    assert main(["identify", str(path)]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    _, _, offered = line.partition("rotor_azimuths: ")
    tables = tomllib.loads(offered.replace("; ", "\n"))
    hubs = [[x[i], -y[i], 0.05] for i in range(4)]  # of FRD
    np.testing.assert_allclose(tables["rotor_positions"]["value"], hubs)
    assert tables["rotor_spins"]["value"] == [-1, -1, 1, 1]
    assert tables["drag_to_thrust"] == {"value": 0.06, "unit": "m", "source": "CA_ROTOR of px4.ulg"}


def test_a_topic_that_a_ulog_lacks_is_named(tmp_path: Path, eight: Record) -> None:
    """With some of those that it has."""
    topics = px4_topics(eight)
    del topics["vehicle_attitude"]
    path = ulog(tmp_path / "short.ulg", topics)
    with pytest.raises(
        FileError,
        match=r"lacks attitude: columns vehicle_attitude\.q\[0\].*; it has (actuator_motors|vehicle_|battery_)",
    ):
        read_record(path)


def test_a_ulog_has_no_poles(tmp_path: Path, eight: Record) -> None:
    path = ulog(tmp_path / "px4.ulg", px4_topics(eight))
    with pytest.raises(InputError, match="poles"):
        read_record(path, poles=14)


def test_a_ulog_without_pyulog_names_the_package(
    tmp_path: Path, eight: Record, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = ulog(tmp_path / "px4.ulg", px4_topics(eight))
    real = builtins.__import__

    def without(name: str, *arguments: Any) -> Any:
        if name == "pyulog":
            raise ModuleNotFoundError(name)
        return real(name, *arguments)

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(MissingPackageError, match="'pyulog'"):
        read_record(path)
