"""Logs of autopilots, written here by their documented formats: each gives the flight back, in our units and frames."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from flown_logs import fly_eight, write_log

import quadsim
from quadsim.errors import FileError
from quadsim.rotation import quaternion_to_euler
from quadsim.state import Array
from scenarios.identify.checks import check_log, spans
from scenarios.identify.record import Record, read_record

pytestmark = pytest.mark.slow("identification")

DOWN = np.array([1.0, -1.0, -1.0])
FULL = 838.0  # [rad/s] at full throttle


@pytest.fixture(scope="module")
def eight(tmp_path_factory: pytest.TempPathFactory) -> Record:
    return read_record(write_log(fly_eight("hummingbird"), tmp_path_factory.mktemp("eight") / "eight.csv"))


def throttle(record: Record) -> Array:
    assert record.commands is not None
    return record.commands / FULL


def check_flight(read: Record, eight: Record, *, exact: float, shift: float = 0.0) -> None:
    """The log says what flew: attitude and rates at its times, the throttle of its rows, and passes the checks."""
    inner = slice(10, len(read.t) - 10)
    t = read.t[inner] - shift
    for name in ("rates", "attitude", "velocity"):
        if name == "velocity" and read.inertial:
            continue
        known = np.stack([np.interp(t, eight.t, column) for column in getattr(eight, name).T], axis=1)
        np.testing.assert_allclose(getattr(read, name)[inner], known, atol=0.06 if name == "velocity" else exact)
    sent = throttle(eight)[np.clip(np.searchsorted(eight.t, t + 1e-4) - 1, 0, None)]
    driving = read.throttle if read.throttle is not None else np.asarray(read.commands) / FULL
    np.testing.assert_allclose(driving[inner], sent, atol=exact)
    start = quadsim.load_vehicle("hummingbird")
    check_log(read, start, spans(read, start))


# ArduPilot


@dataclass(frozen=True)
class Message:
    """A message of a dataflash log: its format's letters and columns, then a row per time."""

    name: str
    letters: str
    columns: str
    t: Array
    rows: Array
    instances: tuple[int, ...] = ()  # of each row, in the column after the time


STRUCT = {"Q": "Q", "B": "B", "f": "f", "h": "h", "H": "H", "c": "h", "C": "H", "N": "16s"}


def dataflash(path: Path, messages: list[Message], parameters: dict[str, float]) -> Path:
    """Write a `.bin`: FMT of every message, the FMTU that tells instances, PARM, and the rows in order of time."""
    head = b"\xa3\x95"
    types = {name: 129 + i for i, name in enumerate(["PARM", "FMTU", *(message.name for message in messages)])}
    formats = {"PARM": ("QNff", "TimeUS,Name,Value,Default"), "FMTU": ("QBNN", "TimeUS,FmtType,UnitIds,MultIds")}
    formats |= {message.name: (f"Q{message.letters}", f"TimeUS,{message.columns}") for message in messages}
    parts = [
        head + b"\x80" + struct.pack("<BB4s16s64s", 0x80, 89, b"FMT", b"BBnNZ", b"Type,Length,Name,Format,Columns")
    ]
    packers = {}
    for name, (letters, columns) in formats.items():
        packers[name] = struct.Struct("<" + "".join(STRUCT[letter] for letter in letters))
        stated = types[name], 3 + packers[name].size, name.encode(), letters.encode(), columns.encode()
        parts.append(head + b"\x80" + struct.pack("<BB4s16s64s", *stated))
    for message in messages:
        if message.instances:
            units = b"s#" + b"-" * (len(message.letters) - 1)
            parts.append(head + bytes([types["FMTU"]]) + packers["FMTU"].pack(0, types[message.name], units, b""))
    for name, value in parameters.items():
        parts.append(head + bytes([types["PARM"]]) + packers["PARM"].pack(0, name.encode(), value, value))
    rows = []
    for message in messages:
        for i, (t, row) in enumerate(zip(message.t, message.rows, strict=True)):
            values = [*message.instances[i : i + 1], *row.tolist()]
            whole = [v if letter == "f" else round(v) for v, letter in zip(values, message.letters, strict=True)]
            packed = packers[message.name].pack(round(1e6 * t), *whole)
            rows.append((t, head + bytes([types[message.name]]) + packed))
    path.write_bytes(b"".join(parts + [row for _, row in sorted(rows, key=lambda row: row[0])]))
    return path


def ardupilot(record: Record) -> list[Message]:
    """What ArduPilot logs with fast attitude: front, right, down; angles in centidegrees; pulses of each motor."""
    angles = np.degrees(quaternion_to_euler(record.attitude)) * DOWN
    angles[:, 2] %= 360.0
    assert record.position is not None
    place = np.concatenate([record.velocity * DOWN, record.position * DOWN], axis=1)
    pulses = np.full((len(record.t), 8), 1500.0)
    pulses[:, 4:] = 1000.0 + 1000.0 * throttle(record)[:, [1, 0, 2, 3]]
    gyro, two = np.repeat(record.rates * DOWN, 2, axis=0), (0, 1) * len(record.t)
    gyro[1::2] += 1.0  # a second one that is wrong
    return [
        Message("IMU", "Bfff", "I,GyrX,GyrY,GyrZ", np.repeat(record.t, 2), gyro, two),
        Message("ATT", "ccC", "Roll,Pitch,Yaw", record.t, 100.0 * angles),
        Message("XKF1", "Bffffff", "C,VN,VE,VD,PN,PE,PD", record.t[::2], place[::2], (0,) * len(record.t[::2])),
        Message("RCOU", "HHHHHHHH", "C1,C2,C3,C4,C5,C6,C7,C8", record.t, pulses),
        Message("BAT", "f", "Volt", record.t[::50], np.full((len(record.t[::50]), 1), 11.1)),
        Message("ARM", "B", "ArmState", np.array([0.0, 0.3]), np.array([[0.0], [1.0]])),
    ]


SERVOS = {"SERVO5_FUNCTION": 34.0, "SERVO6_FUNCTION": 33.0, "SERVO7_FUNCTION": 35.0, "SERVO8_FUNCTION": 36.0}


def test_dataflash(tmp_path: Path, eight: Record) -> None:
    """The first instance of each sensor, the outputs that are motors, and what is flown while armed."""
    pytest.importorskip("pymavlink", reason="the extra logs is not installed")
    read = read_record(dataflash(tmp_path / "00000007.BIN", ardupilot(eight), SERVOS))
    check_flight(read, eight, exact=0.02)
    assert read.voltage == pytest.approx(11.1, abs=1e-6)
    assert read.flying is not None
    np.testing.assert_array_equal(read.flying, read.t >= 0.3)


def test_dataflash_of_another_kind_or_torn(tmp_path: Path, eight: Record, capfd: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("pymavlink", reason="the extra logs is not installed")
    (tmp_path / "log.bin").write_bytes(b"no log")
    with pytest.raises(FileError, match="is not a dataflash log"):
        read_record(tmp_path / "log.bin")
    path = dataflash(tmp_path / "torn.bin", ardupilot(eight), SERVOS)
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2] + b"\x00" * 700 + whole[len(whole) // 2 : -7])
    assert len(read_record(path).t) > 900
    assert capfd.readouterr() == ("", "")
    messages = [message for message in ardupilot(eight) if message.name != "ATT"]
    with pytest.raises(
        FileError, match=r"lacks attitude: columns XKQ\.Q1,.* or ATT\.Roll,.*; it has IMU, IMU.1., XKF1, RCOU"
    ):
        read_record(dataflash(tmp_path / "no.bin", messages, SERVOS))
