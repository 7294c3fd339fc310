"""The flight log and its Parquet files."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from support import small_log

from quadsim.errors import FileError
from quadsim.flight.log import RESIDUALS, FlightLog
from quadsim.flight.parquet import FLIGHT_FILE, HORIZON_FILE, PLANT_FILE, TIMING_FILE, read_log, write_log

UNITS = {
    FLIGHT_FILE: (
        "t=s x=m vx=m/s y=m vy=m/s z=m vz=m/s roll=rad roll_rate=rad/s pitch=rad pitch_rate=rad/s yaw=rad "
        "yaw_rate=rad/s ref_x=m ref_y=m ref_z=m ref_yaw=rad u1=rad/s u2=rad/s u3=rad/s u4=rad/s status=- "
        "answered_by=- phase=- iterations=- active=- fallback=- slack=rad reported_primal=- "
        "reported_dual=- infeasibility=- kkt_stationarity=- kkt_complementarity=- kkt_dual=- delay=s "
        "true_x=m true_vx=m/s true_y=m true_vy=m/s true_z=m true_vz=m/s true_roll=rad true_roll_rate=rad/s "
        "true_pitch=rad true_pitch_rate=rad/s true_yaw=rad true_yaw_rate=rad/s"
    ),
    TIMING_FILE: "t=s solve_ms=ms step_ms=ms",
    PLANT_FILE: (
        "t=s x=m vx=m/s y=m vy=m/s z=m vz=m/s roll=rad roll_rate=rad/s pitch=rad pitch_rate=rad/s yaw=rad "
        "yaw_rate=rad/s w1=rad/s w2=rad/s w3=rad/s w4=rad/s force_x=N force_y=N force_z=N torque_x=N m torque_y=N m "
        "torque_z=N m wind_x=m/s wind_y=m/s wind_z=m/s voltage=V charge=-"
    ),
    HORIZON_FILE: "t=s predicted_x=m predicted_y=m predicted_z=m",
}


def write(directory: Path, log: FlightLog, stride: int = 1) -> None:
    write_log(directory, log, plant_stride=stride, metadata={"scenario": "made-up", "seed": "3"})


@pytest.mark.parametrize("periods", [0, 1, 7])
def test_a_flight_comes_back_bit_for_bit_and_equal_ones_give_equal_bytes(tmp_path: Path, periods: int) -> None:
    log = small_log(periods, reason="at t = 0.700 s: lost")
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        write(tmp_path / name, log)
    back = read_log(tmp_path / "a", reason=log.reason)
    for part in ("control", "timing", "plant"):
        one = getattr(back, part)
        other = getattr(log, part)
        for field in dataclasses.fields(one):
            np.testing.assert_array_equal(getattr(one, field.name), getattr(other, field.name), err_msg=field.name)
    np.testing.assert_array_equal(back.predicted, log.predicted)
    assert back.predicted is None or back.predicted.dtype == np.float32
    assert (back.status, back.reason) == ("aborted", "at t = 0.700 s: lost")
    for file in (tmp_path / "a").iterdir():
        assert file.read_bytes() == (tmp_path / "b" / file.name).read_bytes()


def test_the_plant_is_written_at_the_log_rate(tmp_path: Path) -> None:
    log = small_log(4, steps=5)
    write(tmp_path, log, stride=5)
    back = read_log(tmp_path)
    assert back.status == "completed"
    np.testing.assert_array_equal(back.plant.t, [0.0, 0.1, 0.2, 0.3, 0.4])
    np.testing.assert_array_equal(back.plant.state, log.plant.state[::5])


def test_slews_start_from_the_command_before_the_first() -> None:
    log = small_log(3).control
    expected = [log.speeds[0] - log.speeds_before, log.speeds[1] - log.speeds[0], log.speeds[2] - log.speeds[1]]
    np.testing.assert_array_equal(log.slews, expected)


def test_a_residual_that_was_not_computed_is_null_on_disk_and_nan_inside(tmp_path: Path) -> None:
    log = small_log(7)
    write(tmp_path, log)
    table = pq.read_table(tmp_path / FLIGHT_FILE)
    for name in RESIDUALS:
        values = getattr(log.control, name)
        assert table.schema.field(name).nullable
        assert table.column(name).null_count == np.count_nonzero(np.isnan(values)) == 4
        np.testing.assert_array_equal(getattr(read_log(tmp_path).control, name), values)
    assert not table.schema.field("slack").nullable
    sqp = np.vstack([[[0.2, 1.0], [np.nan, np.nan]], np.zeros((5, 2))])
    write(tmp_path, dataclasses.replace(log, control=dataclasses.replace(log.control, sqp=sqp)))
    table = pq.read_table(tmp_path / FLIGHT_FILE)
    assert table.column("sqp_defect").to_pylist()[:3] == [0.2, None, 0.0]
    np.testing.assert_array_equal(read_log(tmp_path).control.sqp, sqp)


def test_every_column_has_its_unit(tmp_path: Path) -> None:
    write(tmp_path, small_log())
    for name, units in UNITS.items():
        schema = pq.read_schema(tmp_path / name)
        assert " ".join(f"{field.name}={field.metadata[b'unit'].decode()}" for field in schema) == units
        assert (schema.metadata[b"scenario"], schema.metadata[b"seed"]) == (b"made-up", b"3")


def test_absent_signals_have_no_columns(tmp_path: Path) -> None:
    log = small_log()
    control = dataclasses.replace(log.control, truth=log.control.state)
    plant = dataclasses.replace(log.plant, wrench=None, wind=None, battery=None)
    write(tmp_path, dataclasses.replace(log, control=control, plant=plant))
    names = pq.read_schema(tmp_path / FLIGHT_FILE).names
    assert not [name for name in names if name.startswith("true_") or name == "sqp_defect"]
    assert pq.read_schema(tmp_path / PLANT_FILE).names[-1] == "w4"
    (tmp_path / HORIZON_FILE).unlink()
    back = read_log(tmp_path)
    assert back.plant.wrench is back.plant.wind is back.plant.battery is back.predicted is None
    np.testing.assert_array_equal(back.control.truth, log.control.state)
    assert back.control.measured_perfectly


@pytest.mark.parametrize("name", UNITS)
def test_a_damaged_or_missing_file_is_named(tmp_path: Path, name: str) -> None:
    """Cut off or overwritten anywhere: a typed error that names the file, or the reader noticed nothing; no crash."""
    write(tmp_path, small_log(100))
    intact = (tmp_path / name).read_bytes()
    for size in (0, 4, len(intact) // 2, len(intact) - 1):
        (tmp_path / name).write_bytes(intact[:size])
        with pytest.raises(FileError, match=f"{name}: "):
            read_log(tmp_path)
    rng = np.random.default_rng(0)
    noticed = 0
    for first in rng.integers(len(intact) - 8, size=15):
        (tmp_path / name).write_bytes(intact[:first] + rng.bytes(8) + intact[first + 8 :])
        try:
            read_log(tmp_path)
        except FileError:
            noticed += 1
    assert noticed > 0
    (tmp_path / name).unlink()
    if name != HORIZON_FILE:
        with pytest.raises(FileError, match=f"{name}: "):
            read_log(tmp_path)
