"""Logs of autopilots, written here by their documented formats: each gives the flight back, in our units and frames."""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from flown_logs import fly_eight, write_log

import quadsim
from quadsim.assets import vehicle_path
from quadsim.commands.cli import main
from quadsim.errors import FileError, InputError
from quadsim.features.identify.checks import airborne_spans, check_log
from quadsim.features.identify.model import prepare_segment
from quadsim.features.identify.quantities import NamedQuantity, read_map
from quadsim.features.identify.record import Record, read_record, to_record
from quadsim.features.identify.rotor_response import rotor_response
from quadsim.features.identify.rotors import lagged_rotors
from quadsim.features.identify.series import Column
from quadsim.features.identify.windows import to_world
from quadsim.rotation import conjugate, quaternion_to_euler
from quadsim.state import Array
from quadsim.vehicle import load_vehicle

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

    def at_its_times(rows: Array) -> Array:
        return np.stack([np.interp(t, eight.t, column) for column in rows.T], axis=1)

    np.testing.assert_allclose(read.rates[inner], at_its_times(eight.rates), atol=exact)
    np.testing.assert_allclose(read.attitude[inner], at_its_times(eight.attitude), atol=exact)
    if not read.inertial:
        np.testing.assert_allclose(read.velocity[inner], at_its_times(eight.velocity), atol=0.06)
    sent = throttle(eight)[np.clip(np.searchsorted(eight.t, t + 1e-4) - 1, 0, None)]
    shares = throttle(read) if read.throttle is None else read.throttle
    np.testing.assert_allclose(shares[inner], sent, atol=exact)
    start = quadsim.load_vehicle("hummingbird")
    check_log(read, start, airborne_spans(read, start))


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


STRUCT = {"Q": "Q", "I": "I", "B": "B", "f": "f", "h": "h", "H": "H", "c": "h", "C": "H", "N": "16s"}


def dataflash(path: Path, messages: list[Message], parameters: dict[str, float], clock: str = "TimeUS") -> Path:
    """Write a `.bin`: FMT of every message, the FMTU that names instances, PARM, and the rows in order of time."""
    stamp, ticks = {"TimeUS": ("Q", 1e6), "TimeMS": ("I", 1e3)}[clock]
    formats = {"PARM": ("QNff", "TimeUS,Name,Value,Default"), "FMTU": ("QBNN", "TimeUS,FmtType,UnitIds,MultIds")}
    for message in messages:
        formats[message.name] = (f"{stamp}{message.letters}", f"{clock},{message.columns}")
    numbers = {name: 129 + i for i, name in enumerate(formats)}
    packers = {}
    for name, (letters, _) in formats.items():
        packers[name] = struct.Struct("<" + "".join(STRUCT[letter] for letter in letters))

    def described(number: int, size: int, name: bytes, letters: bytes, columns: bytes) -> bytes:
        return b"\xa3\x95\x80" + struct.pack("<BB4s16s64s", number, size, name, letters, columns)

    def packed(name: str, *values: object) -> bytes:
        return b"\xa3\x95" + bytes([numbers[name]]) + packers[name].pack(*values)

    parts = [described(0x80, 89, b"FMT", b"BBnNZ", b"Type,Length,Name,Format,Columns")]
    for name, (letters, columns) in formats.items():
        size = 3 + packers[name].size
        parts.append(described(numbers[name], size, name.encode(), letters.encode(), columns.encode()))
    for message in messages:
        if message.instances:
            units = b"s#" + b"-" * (len(message.letters) - 1)
            parts.append(packed("FMTU", 0, numbers[message.name], units, b""))
    for name, value in parameters.items():
        parts.append(packed("PARM", 0, name.encode(), value, value))
    rows = []
    for message in messages:
        for i, (t, row) in enumerate(zip(message.t, message.rows, strict=True)):
            values = [*message.instances[i : i + 1], *row.tolist()]
            rows.append((t, packed(message.name, round(ticks * t), *rounded(values, message.letters))))
    rows.sort(key=lambda row: row[0])
    path.write_bytes(b"".join(parts) + b"".join(row for _, row in rows))
    return path


def rounded(values: Sequence[float], letters: Sequence[str]) -> list[float]:
    """Whole numbers where a format's letter is not `f`."""
    return [value if letter == "f" else round(value) for value, letter in zip(values, letters, strict=True)]


def ardupilot(record: Record) -> list[Message]:
    """What ArduPilot logs with fast attitude: front, right, down; angles in centidegrees; pulses of each motor."""
    angles = np.degrees(quaternion_to_euler(record.attitude)) * DOWN
    angles[:, 2] %= 360.0
    assert record.position is not None
    place = np.concatenate([record.velocity * DOWN, record.position * DOWN], axis=1)
    pulses = np.full((len(record.t), 8), 1500.0)
    pulses[:, 4:] = 1000.0 + 1000.0 * throttle(record)[:, [1, 0, 2, 3]]
    gyro = np.repeat(record.rates * DOWN, 2, axis=0)
    gyro[1::2] += 1.0  # a second one that is wrong
    both = (0, 1) * len(record.t)
    return [
        Message("IMU", "Bfff", "I,GyrX,GyrY,GyrZ", np.repeat(record.t, 2), gyro, both),
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


def test_dataflash_from_before_3_3_has_milliseconds(tmp_path: Path, eight: Record) -> None:
    pytest.importorskip("pymavlink", reason="the extra logs is not installed")
    read = read_record(dataflash(tmp_path / "old.bin", ardupilot(eight), SERVOS, "TimeMS"))
    check_flight(read, eight, exact=0.02)


def test_dataflash_of_another_kind_or_torn(tmp_path: Path, eight: Record, capfd: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("pymavlink", reason="the extra logs is not installed")
    (tmp_path / "log.bin").write_bytes(b"no log")
    with pytest.raises(FileError, match="dataflash"):
        read_record(tmp_path / "log.bin")
    path = dataflash(tmp_path / "torn.bin", ardupilot(eight), SERVOS)
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2] + b"\x00" * 700 + whole[len(whole) // 2 : -7])
    assert len(read_record(path).t) > 900
    assert capfd.readouterr() == ("", "")
    messages = [message for message in ardupilot(eight) if message.name != "ATT"]
    path = dataflash(tmp_path / "no.bin", messages, SERVOS)
    with pytest.raises(FileError, match=r"XKQ\.Q1"):
        read_record(path)


@pytest.mark.parametrize(
    ("name", "value"),
    [("MOT_PWM_MIN", math.nan), ("MOT_PWM_MIN", 1e30), ("MOT_PWM_MIN", 3000.0), ("SERVO5_FUNCTION", math.nan)],
)
def test_dataflash_whose_parameters_say_nothing(tmp_path: Path, eight: Record, name: str, value: float) -> None:
    pytest.importorskip("pymavlink", reason="the extra logs is not installed")
    path = dataflash(tmp_path / "odd.bin", ardupilot(eight), {**SERVOS, name: value})
    with pytest.raises(FileError, match=rf"odd\.bin: states {name}( = (nan|1\.0.*e\+30); it must| and MAX from 3000)"):
        read_record(path)


# Columns by a map


MAP = """
[t]
columns = ["time (us)"]
unit = "us"

[rates]
columns = ["gyroADC[0]", "gyroADC[1]", "gyroADC[2]"]
unit = "deg/s"
frame = "FRD"

[velocity]
columns = ["north", "west", "vz"]
unit = "km/h"
sign = [1, 1, -1]

[attitude]
columns = ["q0", "q1", "q2", "q3"]
frame = "NED/FRD"

[throttle]
columns = ["motor[0]", "motor[1]", "motor[2]", "motor[3]"]
unit = "us"
"""


def numbered(pattern: str, rows: Array) -> dict[str, Array]:
    """Columns of an array by a name with their number."""
    return {pattern.format(i): column for i, column in enumerate(rows.T)}


def foreign(path: Path, record: Record) -> Path:
    """A table with names, units and frames of its own."""
    table = {"time (us)": 1e6 * record.t}
    table |= numbered("gyroADC[{}]", np.degrees(record.rates) * DOWN)
    table |= zip(("north", "west", "vz"), (3.6 * record.velocity * [1.0, 1.0, -1.0]).T, strict=True)
    table |= numbered("q{}", record.attitude * np.append(1.0, DOWN))
    table |= numbered("motor[{}]", 1000.0 + 1000.0 * throttle(record))
    np.savetxt(path, np.stack([*table.values()], axis=1), delimiter=", ", header=", ".join(table), comments="")
    return path


def mapped(path: Path, text: str) -> tuple[NamedQuantity, ...]:
    (path / "map.toml").write_text(text, encoding="utf-8")
    return read_map(path / "map.toml")


def test_any_table_by_a_map(tmp_path: Path, eight: Record) -> None:
    read = read_record(foreign(tmp_path / "foreign.csv", eight), columns=mapped(tmp_path, MAP))
    check_flight(read, eight, exact=1e-6)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("[rates]", "[gyro]", r"map.toml: has no table 'gyro'; there are t, position, velocity"),
        ('unit = "deg/s"', 'unit = "dps"', r"rates\.unit must be one of 'rad/s', 'deg/s'; got 'dps'"),
        ('frame = "FRD"', 'frame = "NED"', r"rates\.frame must be one of 'FLU', 'FRD'; got 'NED'"),
        ("[1, 1, -1]", "[1, 1]", r"velocity\.sign must be a list of 3 of 1 and -1; got \[1, 1\]"),
        ('["q0", ', "[", r"attitude\.columns must be a list of 4 names; got \['q1'"),
        ('unit = "km/h"', 'units = "km/h"', r"velocity has no 'units'; its fields are columns, unit, sign, frame"),
        ("[t]", "t = 3\n[t.x]", "not valid TOML|must be a table"),
        ("gyroADC[2]", "gyroADC[3]", r"foreign.csv: lacks what the map's rates\.columns names 'gyroADC\[3\]'; it has"),
        ('unit = "us"\n\n', "\n", r"[0-9.e-]+ samples per second, period"),
    ],
)
def test_maps_that_cannot_be_used(tmp_path: Path, eight: Record, old: str, new: str, message: str) -> None:
    assert old in MAP
    path = foreign(tmp_path / "foreign.csv", eight)
    with pytest.raises(InputError, match=message):
        read_record(path, columns=mapped(tmp_path, MAP.replace(old, new, 1)))


def test_the_command_takes_a_map(tmp_path: Path, eight: Record, capsys: pytest.CaptureFixture[str]) -> None:
    path = foreign(tmp_path / "foreign.csv", eight)
    mapped(tmp_path, MAP)
    command = ["identify", str(path), "--vehicle", "hummingbird"]
    mine = tmp_path / "mine.toml"
    assert main([*command, "--columns", str(tmp_path / "map.toml"), "--out", str(mine), "--anyway"]) == 0
    assert load_vehicle(mine).inertia[0] == pytest.approx(0.007, rel=0.1)
    assert main([*command, "--columns", str(tmp_path / "none.toml")]) == 2
    assert "none.toml: cannot be read" in capsys.readouterr().err


# Bags


BAG_MAP = """
[rates]
columns = ["/imu.angular_velocity.x", "/imu.angular_velocity.y", "/imu.angular_velocity.z"]

[velocity]
columns = ["/odom.twist.twist.linear.x", "/odom.twist.twist.linear.y", "/odom.twist.twist.linear.z"]

[attitude]
columns = ["/odom.pose.pose.orientation.w", "/odom.pose.pose.orientation.x", "/odom.pose.pose.orientation.y",
           "/odom.pose.pose.orientation.z"]

[throttle]
columns = ["/motors.data[0]", "/motors.data[1]", "/motors.data[2]", "/motors.data[3]"]
"""


def write_bag(path: Path, record: Record) -> Path:
    """A bag of ROS 1, a directory of ROS 2, or its one file: the motors' messages have no header."""
    from rosbags.rosbag1 import Writer as Writer1
    from rosbags.rosbag2 import StoragePlugin
    from rosbags.rosbag2 import Writer as Writer2
    from rosbags.typesys import Stores, get_typestore

    ros1 = path.suffix == ".bag"
    if ros1:
        store = get_typestore(Stores.ROS1_NOETIC)
        serialize = store.serialize_ros1
        whole = path
        writer = Writer1(whole)
    else:
        store = get_typestore(Stores.ROS2_HUMBLE)
        serialize = store.serialize_cdr
        whole = path.with_suffix("")
        plugin = StoragePlugin.SQLITE3 if path.suffix == ".db3" else StoragePlugin.MCAP
        writer = Writer2(whole, version=9, storage_plugin=plugin)

    def made(name: str, *values: object) -> Any:
        """A message, or a part of one."""
        return store.types[name](*values)

    def vector(x: float, y: float, z: float) -> Any:
        return made("geometry_msgs/msg/Vector3", x, y, z)

    def header(stamp: int) -> Any:
        time = made("builtin_interfaces/msg/Time", stamp // 10**9, stamp % 10**9)
        return made("std_msgs/msg/Header", 0, time, "") if ros1 else made("std_msgs/msg/Header", time, "")

    def imu(stamp: int, attitude: Any, rates: Array) -> Any:
        unknown = np.zeros(9)
        measured = (attitude, unknown, vector(*rates.tolist()), unknown, vector(0.0, 0.0, 0.0), unknown)
        return made("sensor_msgs/msg/Imu", header(stamp), *measured)

    def odometry(stamp: int, attitude: Any, velocity: Array) -> Any:
        pose = made("geometry_msgs/msg/Pose", made("geometry_msgs/msg/Point", 0.0, 0.0, 0.0), attitude)
        twist = made("geometry_msgs/msg/Twist", vector(*velocity.tolist()), vector(0.0, 0.0, 0.0))
        return made(
            "nav_msgs/msg/Odometry",
            header(stamp),
            "",
            made("geometry_msgs/msg/PoseWithCovariance", pose, np.zeros(36)),
            made("geometry_msgs/msg/TwistWithCovariance", twist, np.zeros(36)),
        )

    def motors(shares: Array) -> Any:
        layout = made("std_msgs/msg/MultiArrayLayout", [], 0)
        return made("std_msgs/msg/Float32MultiArray", layout, shares.astype(np.float32))

    with writer:
        topics = {"/imu": "sensor_msgs/msg/Imu", "/odom": "nav_msgs/msg/Odometry"}
        topics["/motors"] = "std_msgs/msg/Float32MultiArray"
        connections = {}
        for topic, name in topics.items():
            connections[topic] = writer.add_connection(topic, name, typestore=store)
        for k, t in enumerate(record.t):
            stamp = round(1e9 * (t + 50.0))
            arrived = stamp + 3_000_000  # after it was stamped
            w, x, y, z = record.attitude[k].tolist()
            attitude = made("geometry_msgs/msg/Quaternion", x, y, z, w)
            for topic, message, time in (
                ("/imu", imu(stamp, attitude, record.rates[k]), arrived),
                ("/odom", odometry(stamp, attitude, record.velocity[k]), arrived),
                ("/motors", motors(throttle(record)[k]), stamp),
            ):
                connection = connections[topic]
                writer.write(connection, time, serialize(message, connection.msgtype))
    return whole


@pytest.mark.parametrize("name", ["ros1.bag", "ros2.mcap", "ros2.db3"])
def test_bags(tmp_path: Path, eight: Record, name: str) -> None:
    """By the stamps of the headers, where there are any."""
    pytest.importorskip("rosbags", reason="the extra logs is not installed")
    path = write_bag(tmp_path / name, eight)
    columns = mapped(tmp_path, BAG_MAP)
    check_flight(read_record(path, columns=columns), eight, exact=1e-6, shift=50.0)
    if path.is_dir():
        (alone,) = (file for file in path.iterdir() if file.suffix == Path(name).suffix)
        assert len(read_record(alone, columns=columns).t) == len(eight.t)


def test_bags_that_cannot_be_read(tmp_path: Path, eight: Record) -> None:
    pytest.importorskip("rosbags", reason="the extra logs is not installed")
    path = write_bag(tmp_path / "ros1.bag", eight)
    with pytest.raises(InputError, match="--columns"):
        read_record(path)
    for old, new, message in (
        ("velocity.x", "velocities.x", r"'/imu\.angular_velocities\.x': no angular_velocities in header, orientation"),
        ("data[0]", "data[7]", r"'/motors\.data\[7\]': no 7 in 4 numbers"),
        ("/imu.angular_velocity.x", "/imu.angular_velocity", r"is not a number but .*Vector3.*: name a field of it"),
        ("/imu", "/gyro", r"the map's rates\.columns names '/gyro.*; it has /imu, /odom, /motors"),
        ("[attitude]", "[position]", r"position\.columns must be a list of 3 names"),
    ):
        with pytest.raises(FileError, match=message):
            read_record(path, columns=mapped(tmp_path, BAG_MAP.replace(old, new)))
    with pytest.raises(InputError, match="clock"):
        read_record(path, columns=mapped(tmp_path, BAG_MAP + '[t]\ncolumns = ["/imu.header.stamp.sec"]'))
    cut = BAG_MAP.partition("[throttle]")[0]
    with pytest.raises(FileError, match="commands"):
        read_record(path, columns=mapped(tmp_path, cut))
    (tmp_path / "torn.mcap").write_bytes(b"\x89MCAP0\r\n nothing")
    with pytest.raises(FileError, match="bag"):
        read_record(tmp_path / "torn.mcap", columns=mapped(tmp_path, BAG_MAP))


# Betaflight


def variable(value: int, *, signed: bool) -> bytes:
    """A number in 7 bits per byte, the lowest first; a signed one in zigzag."""
    if signed:
        value = (value << 1 ^ value >> 31) & 0xFFFFFFFF
    parts = []
    while value > 127:
        parts.append(value & 127 | 128)
        value >>= 7
    return bytes([*parts, value])


def blackbox(path: Path, columns: dict[str, Array], **headers: object) -> Path:
    """Write a `.bbl`: every 8th frame whole, the others as changes from the one before, and the end of the log."""
    stated: dict[str, object] = {"Data version": 2, "I interval": 8, "P interval": 1}
    stated["Field I name"] = ",".join(columns)
    fields = {"I signed": "1", "I predictor": "0", "I encoding": "0", "P predictor": "1", "P encoding": "0"}
    for field, number in fields.items():
        stated[f"Field {field}"] = ",".join([number] * len(columns))
    lines = ["H Product:Blackbox flight data recorder by Nicholas Sherlock\n"]
    for name, value in (stated | headers).items():
        lines.append(f"H {name}:{value}\n")
    parts = ["".join(lines).encode()]
    table = np.rint(np.stack([*columns.values()], axis=1)).astype(int)
    for k, row in enumerate(table):
        if k % 8 == 0:
            parts.append(b"I")
            changes = row
        else:
            parts.append(b"P")
            changes = row - table[k - 1]
        parts += [variable(int(value), signed=True) for value in changes]
    parts.append(b"E\xffEnd of log\x00")
    path.write_bytes(b"".join(parts))
    return path


def turning_speeds(record: Record) -> Array:
    """Rotors of the Hummingbird behind the record's commands [rad/s]."""
    assert record.commands is not None
    return lagged_rotors(record.commands, record.period, rise=0.0125, fall=0.025, delay=0.0).speeds


def betaflight(record: Record) -> dict[str, Array]:
    """Gyro in 0.1 deg/s, accelerometer of 2048 per g, the quaternion's vector, DShot, speeds in 100 eRPM."""
    falling = np.gradient(record.velocity, record.t, axis=0) + np.array([0.0, 0.0, 9.81])
    force = to_world(conjugate(record.attitude), falling)
    turn = record.attitude * np.sign(record.attitude[:, :1])
    speeds = turning_speeds(record) * 60.0 / (2.0 * np.pi) * 6.0 / 100.0
    table = {"loopIteration": np.arange(len(record.t)) * 1.0, "time": 1e6 * (record.t + 3.0)}
    table |= numbered("gyroADC[{}]", 10.0 * np.degrees(record.rates))
    table |= numbered("accSmooth[{}]", force * 2048.0 / 9.80665)
    table |= numbered("imuQuaternion[{}]", 32767.0 * turn[:, 1:])
    table |= numbered("motor[{}]", 158.0 + (2047.0 - 158.0) * throttle(record))
    table |= numbered("eRPM[{}]", speeds)
    table["vbatLatest"] = np.full(len(record.t), 1587.0)
    return table


HEADERS = {
    "Firmware revision": "Betaflight 4.6.0",
    "gyro_scale": "0x3f800000",
    "acc_1G": 2048,
    "motorOutput": "158,2047",
    "motor_poles": 12,
    "blackbox_high_resolution": 1,
}


def test_blackbox(tmp_path: Path, eight: Record) -> None:
    """Units by its header; the longest of the flights in a file; a log that is cut off ends there."""
    pytest.importorskip("orangebox", reason="the extra logs is not installed")
    path = blackbox(tmp_path / "LOG00001.BFL", betaflight(eight), **HEADERS)
    whole = path.read_bytes()
    beginning = {name: column[:50] for name, column in betaflight(eight).items()}
    short = blackbox(tmp_path / "short.bbl", beginning, **HEADERS)
    path.write_bytes(short.read_bytes() + whole)
    read = read_record(path)
    assert read.inertial
    assert "2 flights" in read.notes[0]
    check_flight(read, eight, exact=2e-3, shift=3.0)
    assert read.voltage == pytest.approx(15.87)
    assert read.speeds is not None
    np.testing.assert_allclose(read.speeds, turning_speeds(eight), atol=2.0)
    path.write_bytes(whole[: len(whole) * 3 // 4])
    assert 0.6 * len(eight.t) < len(read_record(path).t) < 0.9 * len(eight.t)


def test_blackbox_that_cannot_be_used(tmp_path: Path, eight: Record) -> None:
    pytest.importorskip("orangebox", reason="the extra logs is not installed")
    (tmp_path / "log.bbl").write_bytes(b"H Product:Blackbox flight data recorder\nnothing")
    with pytest.raises(FileError, match=r"Blackbox|frame"):
        read_record(tmp_path / "log.bbl")
    table = {name: of for name, of in betaflight(eight).items() if not name.startswith(("imuQ", "acc"))}
    with pytest.raises(FileError, match=r"lacks velocity: .*it has loopIteration.*set blackbox_disable_attitude, _acc"):
        read_record(blackbox(tmp_path / "default.bbl", table, **HEADERS))


@pytest.mark.representative("identification")
@pytest.mark.parametrize(
    ("header", "value", "message"),
    [
        ("motorOutput", "158,158", r"motorOutput from 158\.0 to 158\.0; the longest must be above the shortest"),
        ("motorOutput", "158", "motorOutput = 158; it must be two numbers"),
        ("motorOutput", "1,2,3", r"motorOutput = \[1, 2, 3\]; it must be two numbers"),
        ("motorOutput", "a,b", "motorOutput = 'a'; it must be a number"),
        ("motorOutput", "", "motorOutput = ''; it must be two numbers"),
        ("acc_1G", 0, "acc_1G = 0; it must be a number from 1"),
        ("acc_1G", "x", "acc_1G = 'x'; it must be a number"),
        ("motor_poles", 0, "motor_poles = 0; it must be a whole number from 2"),
        ("motor_poles", "q", "motor_poles = 'q'; it must be a whole number"),
        ("gyro_scale", "0x1ffffffff", "gyro_scale = 8589934591; it must be a whole number"),
        ("gyro_scale", "-1", "gyro_scale = -1; it must be a whole number"),
        ("gyro_scale", "abc", "gyro_scale = 'abc'; it must be a whole number"),
        ("gyro_scale", "0x7fc00000", "gyro_scale = nan; it must be above 0"),
        ("gyro_scale", "0x7f800000", "gyro_scale = inf; it must be above 0"),
        ("gyro_scale", "0", "gyro_scale = 0; it must be above 0"),
    ],
)
def test_a_blackbox_whose_header_says_nothing_is_refused(
    tmp_path: Path, eight: Record, header: str, value: object, message: str
) -> None:
    pytest.importorskip("orangebox", reason="the extra logs is not installed")
    short = {name: column[:50] for name, column in betaflight(eight).items()}
    path = blackbox(tmp_path / "log.bbl", short, **{**HEADERS, header: value})
    with pytest.raises(FileError, match=rf"log\.bbl: states {message}"):
        read_record(path)


def test_a_log_without_attitude_is_levelled_by_its_accelerometer(tmp_path: Path, eight: Record) -> None:
    """As Betaflight up to 4.5 logs it: its tilt comes within 2 deg, its heading begins at 0."""
    pytest.importorskip("orangebox", reason="the extra logs is not installed")
    table = {name: of for name, of in betaflight(eight).items() if not name.startswith("imuQ")}
    read = read_record(blackbox(tmp_path / "default.bbl", table, **HEADERS))
    assert "no attitude is logged" in read.notes[-1]
    vertical = np.tile([0.0, 0.0, 1.0], (len(eight.t), 1))
    up = to_world(conjugate(read.attitude), vertical)  # which no heading changes
    known = to_world(conjugate(eight.attitude), vertical)
    assert np.abs(known[:, :2]).max() > 0.2
    np.testing.assert_allclose(up, known, atol=np.radians(2.0))
    commanded = {name: of for name, of in table.items() if not name.startswith("eRPM")}
    blackbox(tmp_path / "default.bbl", commanded, **HEADERS)
    identified = quadsim.identify(tmp_path / "default.bbl", vehicle="hummingbird").vehicle
    np.testing.assert_allclose(identified.inertia, load_vehicle(vehicle_path("hummingbird")).inertia, rtol=0.03)


# Crazyflie


def micro_sd(path: Path, events: dict[str, dict[str, Array]], version: int) -> Path:
    """Write a log of the micro SD card deck: events by name, each with `t` [s] and variables by `name(letter)`."""
    clock, ticks = {1: ("I", 1e3), 2: ("Q", 1e6)}[version]
    parts = [b"\xbc" + struct.pack("<HH", version, len(events))]
    rows = []
    for number, (event, variables) in enumerate(events.items()):
        names = [name for name in variables if name != "t"]
        letters = [name[-2] for name in names]
        parts.append(struct.pack("<H", number) + f"{event}\0".encode() + struct.pack("<H", len(names)))
        for name in names:
            parts.append(f"{name}\0".encode())
        form = f"<H{clock}{''.join(letters)}"
        for t, *values in zip(variables["t"], *(variables[name] for name in names), strict=True):
            rows.append((t, struct.pack(form, number, round(ticks * t), *rounded(values, letters))))
    rows.sort(key=lambda row: row[0])
    data = b"".join(parts) + b"".join(row for _, row in rows)
    path.write_bytes(data + struct.pack("<I", zlib.crc32(data)))
    return path


def crazyflie(record: Record, *, angles: bool) -> dict[str, dict[str, Array]]:
    """What its estimator has, gyro in deg/s, outputs of 16 bit; the battery in an event of its own."""
    outputs = 65535.0 * throttle(record)
    motion = {"t": record.t}
    motion |= lettered("stateEstimate.v{}(f)", "xyz", record.velocity)
    motion |= lettered("gyro.{}(f)", "xyz", np.degrees(record.rates))
    if angles:
        roll, pitch, yaw = np.degrees(quaternion_to_euler(record.attitude)).T
        motion |= {"stateEstimate.roll(f)": roll, "stateEstimate.pitch(f)": -pitch, "stateEstimate.yaw(f)": yaw}
        motion |= lettered("pwm.m{}_pwm(H)", "1234", outputs)
    else:
        motion |= lettered("stateEstimate.q{}(f)", "wxyz", record.attitude)
        motion |= lettered("motor.m{}(I)", "1234", outputs)
    slow = record.t[::20]
    battery = {"t": slow, "pm.vbatMV(H)": np.full(len(slow), 3912.0)}
    return {"fixedFrequency": motion, "battery": battery}


def lettered(pattern: str, letters: str, rows: Array) -> dict[str, Array]:
    """Columns of an array by a name with their letter."""
    return {pattern.format(letter): column for letter, column in zip(letters, rows.T, strict=True)}


@pytest.mark.parametrize(("version", "angles"), [(1, False), (2, True)])
def test_crazyflie(tmp_path: Path, eight: Record, version: int, angles: bool) -> None:
    read = read_record(micro_sd(tmp_path / "log00", crazyflie(eight, angles=angles), version))
    check_flight(read, eight, exact=2e-5)
    assert read.voltage == pytest.approx(3.912)


def test_crazyflie_that_cannot_be_used(tmp_path: Path, eight: Record) -> None:
    path = micro_sd(tmp_path / "log00", crazyflie(eight, angles=False), 2)
    whole = path.read_bytes()
    for corrupted in (whole[:5] + b"\xff" + whole[6:], whole[:200], whole[:20]):
        path.write_bytes(corrupted)
        with pytest.raises(FileError, match="Crazyflie"):
            read_record(path)
    path.write_bytes(whole[: len(whole) // 2])
    (note,) = read_record(path).notes
    assert "check sum" in note
    events = crazyflie(eight, angles=False)
    del events["fixedFrequency"]["gyro.y(f)"]
    path = micro_sd(tmp_path / "log01", events, 2)
    with pytest.raises(FileError, match=r"gyro\.x"):
        read_record(path)


def test_a_voltage_that_stands_still_shows_nothing(eight: Record) -> None:
    vehicle = quadsim.load_vehicle("hummingbird")
    turning = lagged_rotors(np.asarray(eight.commands), eight.period, rise=0.02, fall=0.03, delay=0.0)
    flown = replace(eight, speeds=turning.speeds, throttle=throttle(eight), commands=None)
    still = replace(flown, voltage=np.full(len(eight.t), 11.1))
    sagging = replace(flown, voltage=np.linspace(12.0, 11.0, len(eight.t)))
    of_still = rotor_response([prepare_segment(still, 0)], vehicle, 11.1)
    of_sagging = rotor_response([prepare_segment(sagging, 0)], vehicle, 11.1)
    assert of_still["rotor_rise"].value == pytest.approx(0.02, abs=3e-3)
    assert of_sagging["rotor_rise"].value == pytest.approx(0.02, abs=3e-3)
    assert {*of_sagging} - {*of_still} == {"voltage_exponent"}


def test_a_fast_log_is_averaged_without_a_shift() -> None:
    """At 1 kHz, three samples each: what is measured about their middle, commands over the time they are held."""
    t = np.arange(4000) * 1e-3
    motion = np.sin(t[:, None] * [20.0, 21.0, 22.0])
    rows = {"rates": motion, "velocity": motion, "attitude": np.tile([1.0, 0.0, 0.0, 0.0], (4000, 1))}
    rows["commands"] = 100.0 + np.arange(4000.0)[:, None] * [1.0, 1.0, 1.0, 1.0]
    read = to_record("fast", {name: Column(t=t, values=of) for name, of in rows.items()})
    (note,) = read.notes
    assert "333 Hz" in note
    np.testing.assert_allclose(read.rates, np.sin(read.t[:, None] * [20.0, 21.0, 22.0]), atol=2e-4)
    assert read.commands is not None
    np.testing.assert_allclose(read.commands[:, 0], 100.0 + 1e3 * read.t + 1.0)  # k, k + 1 and k + 2 from t_k on
