"""Sensors are distrusted first: what fails is named by sensor, rotor and time, and cut, or the log is refused."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from flown_logs import fly_eight, write_log
from scipy.spatial.transform import Rotation

from quadsim.assets import vehicle_path
from quadsim.errors import InputError
from quadsim.features.identify.checks import LOG_CHECKS, ROW_CHECKS, airborne_spans, check_log
from quadsim.features.identify.fit import identify_records
from quadsim.features.identify.intervals import deviation_between
from quadsim.features.identify.record import Record, read_record, to_record
from quadsim.features.identify.rotors import lagged_rotors
from quadsim.features.identify.sensors import without_spikes
from quadsim.features.identify.series import Column
from quadsim.state import Array
from quadsim.vehicle import load_vehicle

VEHICLE = load_vehicle(vehicle_path("hummingbird"))
RISE = 0.0125
FALL = 0.025
FIELDS = ("position", "velocity", "attitude", "rates", "commands", "speeds")


@pytest.fixture(scope="module")
def eight(tmp_path_factory: pytest.TempPathFactory) -> Record:
    """A figure eight with the rotors' commands, and their speeds with the noise of a counter."""
    record = read_record(
        write_log(fly_eight(vehicle_path("hummingbird")), tmp_path_factory.mktemp("log") / "eight.csv")
    )
    assert record.commands is not None
    speeds = lagged_rotors(record.commands, record.period, rise=RISE, fall=FALL, delay=0.0).speeds
    noise = np.random.default_rng(0).standard_normal(speeds.shape)
    return replace(record, speeds=speeds + noise)


def series_of(record: Record, **others: Array) -> dict[str, Column]:
    rows = {field: getattr(record, field) for field in FIELDS} | others
    return {field: Column(t=record.t, values=np.array(values)) for field, values in rows.items() if values is not None}


def read(record: Record, **others: Array) -> Record:
    return to_record("log", series_of(record, **others))


def notes(record: Record) -> tuple[str, ...]:
    return check_log(record, VEHICLE, airborne_spans(record, VEHICLE))


def put(record: Record, field: str, row: int | slice, column: int, value: float) -> Array:
    rows = np.array(getattr(record, field))
    rows[row, column] = value
    return rows


# Samples that jump


@pytest.mark.slow("identification")
@pytest.mark.representative("identification")
@pytest.mark.parametrize(
    ("field", "column", "value", "sensor"),
    [
        ("speeds", 2, 1e6, "the measured speed of rotor 3 is 1e+06 rad/s"),
        ("speeds", 0, 6000.0, "the measured speed of rotor 1 is 6000 rad/s"),
        ("commands", 1, 1e6, "the command of rotor 2 is 1e+06 rad/s"),
        ("velocity", 0, 900.0, "velocity vx is 900 m/s"),
        ("rates", 1, -800.0, "body rate wy is -800 rad/s"),
        ("position", 2, 1e5, "position z is 1e+05 m"),
        ("attitude", 0, 100.0, "the attitude is 100, "),
    ],
)
def test_a_sample_that_jumps_is_cut_and_named(
    eight: Record, field: str, column: int, value: float, sensor: str
) -> None:
    """By its sensor and time; nothing else of the log changes, and all of it still flies."""
    corrupted = read(eight, **{field: put(eight, field, 500, column, value)})
    (note,) = corrupted.notes
    assert note.startswith(f"log: {sensor}")
    assert f"at t = {eight.t[500]:.6g} s" in note
    assert airborne_spans(corrupted, VEHICLE) == airborne_spans(read(eight), VEHICLE)
    kept = np.arange(len(eight.t)) != 500
    np.testing.assert_array_equal(getattr(corrupted, field)[kept], getattr(read(eight), field)[kept])
    before, after = getattr(eight, field)[[499, 501]]
    tolerance = 1e-3 * np.abs(after).max()
    assert (getattr(corrupted, field)[500] >= np.minimum(before, after) - tolerance).all()
    assert (getattr(corrupted, field)[500] <= np.maximum(before, after) + tolerance).all()


def test_an_attitude_that_turns_away_and_back_is_cut(eight: Record) -> None:
    turned = (Rotation.from_quat(eight.attitude[500]) * Rotation.from_rotvec([2.0, 0.0, 0.0])).as_quat()
    rows = np.array(eight.attitude)
    rows[500] = turned
    (note,) = read(eight, attitude=rows).notes
    assert "the attitude is" in note


def test_what_a_vehicle_does_is_no_jump(eight: Record) -> None:
    assert read(eight).notes == ()
    turning = np.array([np.cos(0.5 * eight.t), 0.0 * eight.t, 0.0 * eight.t, np.sin(0.5 * eight.t)]).T
    assert read(eight, attitude=turning * np.where(np.arange(len(turning)) % 2, 1.0, -1.0)[:, None]).notes == ()


def test_a_sensor_that_jumps_all_the_time_is_refused(eight: Record) -> None:
    rows = np.array(eight.velocity)
    rows[100:1000:20, 1] = 700.0
    with pytest.raises(InputError, match=r"velocity vy is 700 m/s at t = 1 s and in 44 more samples"):
        read(eight, velocity=rows)


# Counters


def test_a_counter_that_stops_briefly_is_cut(eight: Record) -> None:
    corrupted = read(eight, speeds=put(eight, "speeds", slice(500, 504), 1, 0.0))
    (note,) = corrupted.notes
    assert re.match(r"log: the measured speed of rotor 2 stays at 0 rad/s from t = 5 s on while the others", note)
    assert corrupted.speeds is not None
    assert corrupted.speeds[500:504].min() > 100.0


@pytest.mark.parametrize("value", [0.0, 430.0])
def test_a_counter_that_is_dead_is_refused(eight: Record, value: float) -> None:
    """At 0, or where it was; the commands, where the log has them, do without it."""
    with pytest.raises(InputError, match=r"rotor 1 stays at .* its counter is dead.* or name the commands alone"):
        read(eight, speeds=put(eight, "speeds", slice(300, 700), 0, value))


# Rotors


@pytest.mark.parametrize("rotor", [0, 1, 2, 3])
@pytest.mark.parametrize("factor", [1.2, 0.8])
def test_a_rotor_whose_speeds_are_scaled_is_named(eight: Record, rotor: int, factor: float) -> None:
    """Against its command, and without commands against what balances the torques of the others."""
    assert eight.speeds is not None
    scales = np.ones(4)
    scales[rotor] = factor
    scaled = replace(eight, speeds=eight.speeds * scales)
    with pytest.raises(InputError, match=rf"rotor {rotor + 1} turns (1\.2|1\.19|0\.79|0\.8).* times as fast"):
        notes(scaled)
    with pytest.raises(
        InputError, match=rf"measured speed of rotor {rotor + 1} is (1\.2|1\.19|0\.79|0\.8).* times what balances"
    ):
        notes(replace(scaled, commands=None))


def test_commands_that_are_named_measured_speeds_are_found(eight: Record) -> None:
    with pytest.raises(InputError, match="the measured speeds are the commands"):
        notes(replace(eight, speeds=eight.commands))
    with pytest.raises(InputError, match=r"ms ago, as it does behind commands .* name them commands"):
        notes(replace(eight, speeds=eight.commands, commands=None))
    assert eight.speeds is not None
    for noise in (0.0, 10.0):
        loud = eight.speeds + noise * np.random.default_rng(1).standard_normal(eight.speeds.shape)
        assert notes(replace(eight, speeds=loud, commands=None)) == ()


# Gyro and attitude


def test_position_decides_whether_gyro_or_attitude_is_off(eight: Record) -> None:
    far = Rotation.from_rotvec(1.09 * Rotation.from_quat(eight.attitude, scalar_first=True).as_rotvec())
    with pytest.raises(InputError, match=r"the attitude turns 1\.\d+ times as far .* it is the attitude that is off"):
        notes(replace(eight, attitude=far.as_quat(scalar_first=True)))
    with pytest.raises(InputError, match=r"wx, wy, wz are 1\.1 times the rates at which the attitude turns"):
        notes(replace(eight, rates=1.1 * eight.rates))


# Rows that a radio holds


@pytest.mark.parametrize("share", [0.1, 0.25])
@pytest.mark.parametrize("driver", ["commands", "speeds"])
def test_intervals_hold_the_truth_without_the_rows_that_a_radio_held(eight: Record, share: float, driver: str) -> None:
    """Rates, attitude, velocity and position stand still while the rotors are logged on."""
    rng = np.random.default_rng(5)
    held = rng.random(len(eight.t)) < share
    held[0] = False
    source = np.maximum.accumulate(np.where(held, 0, np.arange(len(held))))
    rows = {name: getattr(eight, name)[source] for name in ("position", "velocity", "attitude", "rates")}
    rows["speeds" if driver == "commands" else "commands"] = None  # type: ignore[assignment]
    record = read(eight, **rows)
    assert record.fresh is not None
    assert np.count_nonzero(~record.fresh) == pytest.approx(np.count_nonzero(held), abs=2)
    assert re.search(r"log: \d+% of its rows repeat rates and attitude .*: left out", record.notes[0])
    found = identify_records([record], [airborne_spans(record, VEHICLE)], VEHICLE, wind=False)
    true = {f"inertia_{axis}": value for axis, value in zip("xyz", VEHICLE.inertia, strict=True)}
    true |= {name: getattr(VEHICLE, name) for name in ("thrust_coefficient", "drag_to_thrust", "rotor_inertia")}
    true |= {"rotor_rise": RISE, "rotor_fall": FALL}
    known = {e.name: e for e in found.estimates if not e.refused}
    assert {"thrust_coefficient", "inertia_x", "inertia_y"} <= {*known}
    assert not [name for name, e in known.items() if name in true and not e.low <= true[name] <= e.high]


# Commands as instruments, and flights that differ


def test_noise_of_measured_speeds_does_not_bias_the_inertia_where_commands_are_logged(eight: Record) -> None:
    assert eight.speeds is not None
    loud = eight.speeds + 15.0 * np.random.default_rng(2).standard_normal(eight.speeds.shape)
    parts = [airborne_spans(eight, VEHICLE)]
    errors = {}
    for name, record in {
        "alone": replace(eight, speeds=loud, commands=None),
        "both": replace(eight, speeds=loud),
    }.items():
        found = {e.name: e for e in identify_records([record], parts, VEHICLE).estimates}
        errors[name] = [found[f"inertia_{axis}"].value / VEHICLE.inertia["xy".index(axis)] - 1.0 for axis in "xy"]
        if name == "both":
            for i, axis in enumerate("xy"):
                assert found[f"inertia_{axis}"].low <= VEHICLE.inertia[i] <= found[f"inertia_{axis}"].high
    assert max(map(abs, errors["both"])) < 0.5 * min(errors["alone"])


def test_flights_that_contradict_each_other_widen_the_interval(eight: Record) -> None:
    """The second's gyro, scaled, makes its inertia another one."""
    fast = replace(eight, commands=None)
    other = replace(fast, name="other", rates=1.1 * eight.rates)
    again = replace(fast, name="again", rates=eight.rates + 1e-9)
    parts = [airborne_spans(eight, VEHICLE)] * 2
    widths = []
    for second in (again, other):
        found = identify_records([fast, second], parts, VEHICLE)
        (inertia,) = (e for e in found.estimates if e.name == "inertia_x")
        widths.append(float(np.log(inertia.high / inertia.low)))
    assert widths[1] > 2.0 * widths[0]


def test_what_flights_differ_by_beyond_their_noise_is_told_from_noise() -> None:
    """Of drawn flights, the mean of the estimated variance is the one they were drawn with."""
    rng = np.random.default_rng(0)
    variances = rng.uniform(0.5, 2.0, 8)
    alike = [deviation_between(np.sqrt(variances) * rng.standard_normal(8), variances) for _ in range(500)]
    apart = [
        deviation_between(np.sqrt(variances + 100.0) * rng.standard_normal(8), variances) ** 2 for _ in range(2000)
    ]
    assert np.mean(alike) < 0.2
    assert np.mean(apart) == pytest.approx(
        100.0 * float((variances**-2.0).sum() / (1.0 / variances).sum() ** 2), rel=0.1
    )
    assert deviation_between(np.ones(1), np.ones(1)) == 0.0
    assert deviation_between(np.ones(4), np.ones(4)) == 0.0


# The table


def test_every_check_is_a_row_that_says_what_holds() -> None:
    said = [check.holds for check in (*ROW_CHECKS, *LOG_CHECKS)]
    assert len({*said}) == len(said) == 17
    fields = {field for check in LOG_CHECKS for field in check.needs}
    assert fields <= {*Record.__dataclass_fields__}


def test_a_log_is_named_in_each_note(eight: Record, tmp_path: Path) -> None:
    record = replace(read(eight), name="mine.csv", notes=())
    for note in notes(record):
        assert note.startswith("mine.csv: ")


def test_a_battery_that_is_logged_to_a_tenth_of_a_volt_does_not_jump() -> None:
    t = 0.01 * np.arange(2000)
    volts = np.full((2000, 1), 12.0)
    volts[::30] = 11.9
    kept, notes = without_spikes("log.csv", {"voltage": Column(t=t, values=volts)})
    assert not notes
    assert np.isfinite(kept["voltage"].values).all()


def test_a_battery_s_clock_may_be_in_whole_seconds() -> None:
    t = np.floor(0.01 * np.arange(2000))
    volts = np.full((2000, 1), 12.0)
    volts[700] = 1e6
    _, notes = without_spikes("log.csv", {"voltage": Column(t=t, values=volts)})
    assert len(notes) == 1
