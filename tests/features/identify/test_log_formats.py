"""Logs of autopilots, written here by their documented formats: each gives the flight back in SI units and our axes."""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Iterable, Sequence
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
"""Turns the axes front, left, up into front, right, down and back."""
FULL = 838.0  # [rad/s] at full throttle
BAG_START = 50.0
"""The stamp of a bag at the flight's time 0 [s]."""


@pytest.fixture(scope="module")
def eight(tmp_path_factory: pytest.TempPathFactory) -> Record:
    """A figure eight of the Hummingbird: the flight that every format has to give back."""
    return read_record(write_log(fly_eight("hummingbird"), tmp_path_factory.mktemp("eight") / "eight.csv"))


def throttle(record: Record) -> Array:
    """The commands (K, 4) as shares of full throttle."""
    assert record.commands is not None
    return record.commands / FULL


def check_flight(read: Record, eight: Record, *, exact: float, shift: float = 0.0) -> None:
    """A log says what flew: motion at its times and the throttle that was in force; and it passes the checks.

    Args:
        read: the log.
        eight: what flew.
        exact: the largest difference of attitude, rates and throttle.
        shift: what the log's clock is ahead [s].
    """
    inner = slice(10, len(read.t) - 10)
    t = read.t[inner] - shift

    def at_its_times(rows: Array) -> Array:
        return np.stack([np.interp(t, eight.t, column) for column in rows.T], axis=1)

    np.testing.assert_allclose(read.rates[inner], at_its_times(eight.rates), atol=exact)
    np.testing.assert_allclose(read.attitude[inner], at_its_times(eight.attitude), atol=exact)
    if not read.inertial:
        np.testing.assert_allclose(read.velocity[inner], at_its_times(eight.velocity), atol=0.06)
    last_sent = np.searchsorted(eight.t, t + 1e-4) - 1  # rows whose time has come, but for rounding
    in_force = throttle(eight)[np.clip(last_sent, 0, None)]
    shares = read.throttle
    if shares is None:
        shares = throttle(read)
    np.testing.assert_allclose(shares[inner], in_force, atol=exact)
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
"""The letters of `struct` for those of a dataflash format."""
MARK = b"\xa3\x95"
"""What every message of a dataflash log begins with; its number follows."""
FMT = 0x80
"""The number of the message that describes a message."""


class Packer:
    """Packs dataflash messages by the formats of their names: the letters and the columns of each."""

    def __init__(self, formats: dict[str, tuple[str, str]]) -> None:
        self.formats = formats
        self.numbers = {name: 129 + i for i, name in enumerate(formats)}
        self.structs = {}
        for name, (letters, _) in formats.items():
            self.structs[name] = struct.Struct("<" + "".join(STRUCT[letter] for letter in letters))

    def packed(self, name: str, *values: object) -> bytes:
        """A message of a name."""
        return MARK + bytes([self.numbers[name]]) + self.structs[name].pack(*values)

    def descriptions(self) -> list[bytes]:
        """FMT of itself and of every other message."""
        parts = [self._description(FMT, 89, "FMT", "BBnNZ", "Type,Length,Name,Format,Columns")]
        for name, (letters, columns) in self.formats.items():
            size = len(MARK) + 1 + self.structs[name].size
            parts.append(self._description(self.numbers[name], size, name, letters, columns))
        return parts

    @staticmethod
    def _description(number: int, size: int, name: str, letters: str, columns: str) -> bytes:
        texts = (name.encode(), letters.encode(), columns.encode())
        return MARK + bytes([FMT]) + struct.pack("<BB4s16s64s", number, size, *texts)


def dataflash(path: Path, messages: list[Message], parameters: dict[str, float], clock: str = "TimeUS") -> Path:
    """Write a `.bin`: FMT of every message, the FMTU that names instances, PARM, and the rows in order of time."""
    stamp, ticks = {"TimeUS": ("Q", 1e6), "TimeMS": ("I", 1e3)}[clock]
    formats = {"PARM": ("QNff", "TimeUS,Name,Value,Default"), "FMTU": ("QBNN", "TimeUS,FmtType,UnitIds,MultIds")}
    for message in messages:
        formats[message.name] = (f"{stamp}{message.letters}", f"{clock},{message.columns}")
    packer = Packer(formats)
    parts = packer.descriptions()
    for message in messages:
        if message.instances:
            units = b"s#" + b"-" * (len(message.letters) - 1)  # # marks the column of the instance
            parts.append(packer.packed("FMTU", 0, packer.numbers[message.name], units, b""))
    for name, value in parameters.items():
        parts.append(packer.packed("PARM", 0, name.encode(), value, value))
    timed_rows = []
    for message in messages:
        for i, (t, row) in enumerate(zip(message.t, message.rows, strict=True)):
            values = row.tolist()
            if message.instances:
                values.insert(0, message.instances[i])
            timed_rows.append((t, packer.packed(message.name, round(ticks * t), *rounded(values, message.letters))))
    timed_rows.sort(key=lambda timed: timed[0])
    parts += [row for _, row in timed_rows]
    path.write_bytes(b"".join(parts))
    return path


def rounded(values: Sequence[float], letters: Sequence[str]) -> list[float]:
    """Whole numbers where a format's letter is not `f`."""
    return [value if letter == "f" else round(value) for value, letter in zip(values, letters, strict=True)]


def ardupilot(record: Record) -> list[Message]:
    """What ArduPilot logs with fast attitude: front, right, down; angles in centidegrees; pulses of each motor."""
    angles = np.degrees(quaternion_to_euler(record.attitude)) * DOWN
    angles[:, 2] %= 360.0
    assert record.position is not None
    motion = np.concatenate([record.velocity * DOWN, record.position * DOWN], axis=1)
    pulses = np.full((len(record.t), 8), 1500.0)
    pulses[:, 4:] = 1000.0 + 1000.0 * throttle(record)[:, [1, 0, 2, 3]]
    two_gyros = np.repeat(record.rates * DOWN, 2, axis=0)
    two_gyros[1::2] += 1.0  # the second one is wrong
    zero_and_one = (0, 1) * len(record.t)
    half_rate = record.t[::2]
    slow = record.t[::50]
    return [
        Message("IMU", "Bfff", "I,GyrX,GyrY,GyrZ", np.repeat(record.t, 2), two_gyros, zero_and_one),
        Message("ATT", "ccC", "Roll,Pitch,Yaw", record.t, 100.0 * angles),
        Message("XKF1", "Bffffff", "C,VN,VE,VD,PN,PE,PD", half_rate, motion[::2], (0,) * len(half_rate)),
        Message("RCOU", "HHHHHHHH", "C1,C2,C3,C4,C5,C6,C7,C8", record.t, pulses),
        Message("BAT", "f", "Volt", slow, np.full((len(slow), 1), 11.1)),
        Message("ARM", "B", "ArmState", np.array([0.0, 0.3]), np.array([[0.0], [1.0]])),
    ]


SERVOS = {"SERVO5_FUNCTION": 34.0, "SERVO6_FUNCTION": 33.0, "SERVO7_FUNCTION": 35.0, "SERVO8_FUNCTION": 36.0}
"""Outputs 5 to 8 drive the motors 2, 1, 3 and 4: function 33 is motor 1."""


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


def test_a_torn_dataflash_is_read_in_silence(tmp_path: Path, eight: Record, capfd: pytest.CaptureFixture[str]) -> None:
    """With zeros in its middle, and cut off within its last message."""
    pytest.importorskip("pymavlink", reason="the extra logs is not installed")
    path = dataflash(tmp_path / "torn.bin", ardupilot(eight), SERVOS)
    whole = path.read_bytes()
    middle = len(whole) // 2
    path.write_bytes(whole[:middle] + b"\x00" * 700 + whole[middle:-7])
    assert len(read_record(path).t) > 900
    assert capfd.readouterr() == ("", "")


def test_a_dataflash_that_is_none_or_lacks_the_attitude_is_refused(tmp_path: Path, eight: Record) -> None:
    pytest.importorskip("pymavlink", reason="the extra logs is not installed")
    (tmp_path / "log.bin").write_bytes(b"no log")
    with pytest.raises(FileError, match="dataflash"):
        read_record(tmp_path / "log.bin")
    messages = [message for message in ardupilot(eight) if message.name != "ATT"]
    path = dataflash(tmp_path / "no.bin", messages, SERVOS)
    with pytest.raises(FileError, match=r"XKQ\.Q1"):
        read_record(path)


@pytest.mark.parametrize(
    ("name", "value"),
    [("MOT_PWM_MIN", math.nan), ("MOT_PWM_MIN", 1e30), ("MOT_PWM_MIN", 3000.0), ("SERVO5_FUNCTION", math.nan)],
)
def test_a_dataflash_with_impossible_parameters_is_refused(
    tmp_path: Path, eight: Record, name: str, value: float
) -> None:
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
    """The columns of an array, each named by the pattern with its number."""
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


def mapped(directory: Path, text: str) -> tuple[NamedQuantity, ...]:
    """Write a map of columns and read it."""
    path = directory / "map.toml"
    path.write_text(text, encoding="utf-8")
    return read_map(path)


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
def test_maps_that_cannot_be_used_are_refused(tmp_path: Path, eight: Record, old: str, new: str, message: str) -> None:
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


@dataclass(frozen=True)
class Messages:
    """Makes the messages of a bag from the types of its ROS; what a log does not need is 0."""

    types: dict[str, Any]
    ros1: bool

    def vector(self, x: float, y: float, z: float) -> Any:
        return self.types["geometry_msgs/msg/Vector3"](x, y, z)

    def attitude(self, quaternion: Array) -> Any:
        w, x, y, z = quaternion.tolist()
        return self.types["geometry_msgs/msg/Quaternion"](x, y, z, w)

    def header(self, stamp: int) -> Any:
        """Of a message that is stamped [ns]; those of ROS 1 have a sequence number."""
        seconds, nanoseconds = divmod(stamp, 10**9)
        time = self.types["builtin_interfaces/msg/Time"](seconds, nanoseconds)
        make = self.types["std_msgs/msg/Header"]
        if self.ros1:
            return make(0, time, "")
        return make(time, "")

    def imu(self, stamp: int, quaternion: Array, rates: Array) -> Any:
        covariance = np.zeros(9)
        attitude = (self.attitude(quaternion), covariance)
        turning = (self.vector(*rates.tolist()), covariance)
        acceleration = (self.vector(0.0, 0.0, 0.0), covariance)
        return self.types["sensor_msgs/msg/Imu"](self.header(stamp), *attitude, *turning, *acceleration)

    def odometry(self, stamp: int, quaternion: Array, velocity: Array) -> Any:
        origin = self.types["geometry_msgs/msg/Point"](0.0, 0.0, 0.0)
        pose = self.types["geometry_msgs/msg/Pose"](origin, self.attitude(quaternion))
        twist = self.types["geometry_msgs/msg/Twist"](self.vector(*velocity.tolist()), self.vector(0.0, 0.0, 0.0))
        covariance = np.zeros(36)
        return self.types["nav_msgs/msg/Odometry"](
            self.header(stamp),
            "",
            self.types["geometry_msgs/msg/PoseWithCovariance"](pose, covariance),
            self.types["geometry_msgs/msg/TwistWithCovariance"](twist, covariance),
        )

    def motors(self, shares: Array) -> Any:
        layout = self.types["std_msgs/msg/MultiArrayLayout"]([], 0)
        return self.types["std_msgs/msg/Float32MultiArray"](layout, shares.astype(np.float32))


TOPICS = {
    "/imu": "sensor_msgs/msg/Imu",
    "/odom": "nav_msgs/msg/Odometry",
    "/motors": "std_msgs/msg/Float32MultiArray",
}


def open_bag(path: Path) -> tuple[Path, Any, Any]:
    """Open a bag by its suffix: the file of ROS 1, or the folder of ROS 2, which has no suffix.

    Returns:
        Its path, its writer, and the types of its messages.
    """
    from rosbags.rosbag1 import Writer as Writer1
    from rosbags.rosbag2 import StoragePlugin
    from rosbags.rosbag2 import Writer as Writer2
    from rosbags.typesys import Stores, get_typestore

    if path.suffix == ".bag":
        return path, Writer1(path), get_typestore(Stores.ROS1_NOETIC)
    plugin = {".db3": StoragePlugin.SQLITE3, ".mcap": StoragePlugin.MCAP}[path.suffix]
    folder = path.with_suffix("")
    return folder, Writer2(folder, version=9, storage_plugin=plugin), get_typestore(Stores.ROS2_HUMBLE)


def write_bag(path: Path, record: Record) -> Path:
    """Write the bag of `open_bag`; return its path.

    The motors' messages have no header: they arrive at the time at which the others are stamped, these 3 ms later.
    """
    bag, writer, store = open_bag(path)
    ros1 = path.suffix == ".bag"
    serialize = store.serialize_ros1 if ros1 else store.serialize_cdr
    messages = Messages(store.types, ros1)
    with writer:
        connections = {}
        for topic, name in TOPICS.items():
            connections[topic] = writer.add_connection(topic, name, typestore=store)

        def write(topic: str, time: int, message: Any) -> None:
            writer.write(connections[topic], time, serialize(message, TOPICS[topic]))

        for k, t in enumerate(record.t):
            stamp = round(1e9 * (t + BAG_START))
            arrival = stamp + 3_000_000
            write("/imu", arrival, messages.imu(stamp, record.attitude[k], record.rates[k]))
            write("/odom", arrival, messages.odometry(stamp, record.attitude[k], record.velocity[k]))
            write("/motors", stamp, messages.motors(throttle(record)[k]))
    return bag


@pytest.mark.parametrize("name", ["ros1.bag", "ros2.mcap", "ros2.db3"])
def test_bags(tmp_path: Path, eight: Record, name: str) -> None:
    """By the stamps of the headers, where there are any; of ROS 2, its folder or the one file in it."""
    pytest.importorskip("rosbags", reason="the extra logs is not installed")
    path = write_bag(tmp_path / name, eight)
    columns = mapped(tmp_path, BAG_MAP)
    check_flight(read_record(path, columns=columns), eight, exact=1e-6, shift=BAG_START)
    if path.is_dir():
        (file,) = path.glob(f"*{Path(name).suffix}")
        check_flight(read_record(file, columns=columns), eight, exact=1e-6, shift=BAG_START)


def test_bags_that_cannot_be_read(tmp_path: Path, eight: Record) -> None:
    pytest.importorskip("rosbags", reason="the extra logs is not installed")
    path = write_bag(tmp_path / "ros1.bag", eight)
    with pytest.raises(InputError, match="--columns"):
        read_record(path)
    for old, new, message in (  # edits of the map
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
    without_throttle, _, _ = BAG_MAP.partition("[throttle]")
    with pytest.raises(FileError, match="commands"):
        read_record(path, columns=mapped(tmp_path, without_throttle))
    (tmp_path / "torn.mcap").write_bytes(b"\x89MCAP0\r\n nothing")
    with pytest.raises(FileError, match="bag"):
        read_record(tmp_path / "torn.mcap", columns=mapped(tmp_path, BAG_MAP))


# Betaflight


def variable(value: int, *, signed: bool) -> bytes:
    """A number in 7 bits per byte, the lowest first, the eighth set where more follow; a signed one in zigzag."""
    if signed:
        value = ((value << 1) ^ (value >> 31)) & 0xFFFFFFFF
    parts = []
    while value > 0x7F:
        parts.append((value & 0x7F) | 0x80)
        value >>= 7
    parts.append(value)
    return bytes(parts)


def blackbox(path: Path, columns: dict[str, Array], **headers: object) -> Path:
    """Write a `.bbl`: its header, every 8th frame whole (I), the others as changes from the one before (P), its end."""
    parts = [header_of(columns, headers)]
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


def header_of(columns: Iterable[str], headers: dict[str, object]) -> bytes:
    """The lines of a `.bbl` before its frames: how frames are encoded, and other headers."""
    names = [*columns]
    stated: dict[str, object] = {"Data version": 2, "I interval": 8, "P interval": 1}
    stated["Field I name"] = ",".join(names)
    # Predictor 0 is none, 1 the frame before; encoding 0 is signed, of variable length.
    of_every_field = {"I signed": "1", "I predictor": "0", "I encoding": "0", "P predictor": "1", "P encoding": "0"}
    for field, number in of_every_field.items():
        stated[f"Field {field}"] = ",".join([number] * len(names))
    lines = ["H Product:Blackbox flight data recorder by Nicholas Sherlock\n"]
    for name, value in (stated | headers).items():
        lines.append(f"H {name}:{value}\n")
    return "".join(lines).encode()


def rotor_speeds(record: Record) -> Array:
    """The speeds of the Hummingbird's rotors, which lag behind the record's commands [rad/s]."""
    assert record.commands is not None
    return lagged_rotors(record.commands, record.period, rise=0.0125, fall=0.025, delay=0.0).speeds


def betaflight(record: Record) -> dict[str, Array]:
    """Gyro in 0.1 deg/s, accelerometer of 2048 per g, the quaternion's vector, DShot, speeds in 100 eRPM."""
    without_gravity = np.gradient(record.velocity, record.t, axis=0) + np.array([0.0, 0.0, 9.81])
    specific_force = to_world(conjugate(record.attitude), without_gravity)  # along the body's axes
    quaternion = record.attitude * np.sign(record.attitude[:, :1])  # its scalar, which is not logged, is positive
    rpm = rotor_speeds(record) * 60.0 / (2.0 * np.pi)
    pole_pairs = 6.0
    table = {"loopIteration": np.arange(len(record.t)) * 1.0, "time": 1e6 * (record.t + 3.0)}
    table |= numbered("gyroADC[{}]", 10.0 * np.degrees(record.rates))
    table |= numbered("accSmooth[{}]", specific_force * 2048.0 / 9.80665)
    table |= numbered("imuQuaternion[{}]", 32767.0 * quaternion[:, 1:])
    table |= numbered("motor[{}]", 158.0 + (2047.0 - 158.0) * throttle(record))
    table |= numbered("eRPM[{}]", rpm * pole_pairs / 100.0)
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


def beginning(table: dict[str, Array]) -> dict[str, Array]:
    """The first 50 rows of a table."""
    return {name: column[:50] for name, column in table.items()}


def without(table: dict[str, Array], *starts: str) -> dict[str, Array]:
    """A table without the columns whose names start so."""
    return {name: column for name, column in table.items() if not name.startswith(starts)}


def test_blackbox_by_the_units_of_its_header(tmp_path: Path, eight: Record) -> None:
    """Of two flights in a file, the longer one."""
    pytest.importorskip("orangebox", reason="the extra logs is not installed")
    path = blackbox(tmp_path / "LOG00001.BFL", betaflight(eight), **HEADERS)
    short = blackbox(tmp_path / "short.bbl", beginning(betaflight(eight)), **HEADERS)
    path.write_bytes(short.read_bytes() + path.read_bytes())
    read = read_record(path)
    assert read.inertial
    assert "2 flights" in read.notes[0]
    check_flight(read, eight, exact=2e-3, shift=3.0)
    assert read.voltage == pytest.approx(15.87)
    assert read.speeds is not None
    np.testing.assert_allclose(read.speeds, rotor_speeds(eight), atol=2.0)


def test_a_blackbox_that_is_cut_off_ends_there(tmp_path: Path, eight: Record) -> None:
    pytest.importorskip("orangebox", reason="the extra logs is not installed")
    path = blackbox(tmp_path / "LOG00001.BFL", betaflight(eight), **HEADERS)
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) * 3 // 4])
    assert 0.6 * len(eight.t) < len(read_record(path).t) < 0.9 * len(eight.t)


def test_blackbox_that_cannot_be_used(tmp_path: Path, eight: Record) -> None:
    pytest.importorskip("orangebox", reason="the extra logs is not installed")
    (tmp_path / "log.bbl").write_bytes(b"H Product:Blackbox flight data recorder\nnothing")
    with pytest.raises(FileError, match=r"Blackbox|frame"):
        read_record(tmp_path / "log.bbl")
    table = without(betaflight(eight), "imuQ", "acc")
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
    path = blackbox(tmp_path / "log.bbl", beginning(betaflight(eight)), **{**HEADERS, header: value})
    with pytest.raises(FileError, match=rf"log\.bbl: states {message}"):
        read_record(path)


def test_a_log_without_attitude_is_levelled_by_its_accelerometer(tmp_path: Path, eight: Record) -> None:
    """As Betaflight up to 4.5 logs it: tilts within 2 deg, headings from 0 on, and inertias within 3 %."""
    pytest.importorskip("orangebox", reason="the extra logs is not installed")
    table = without(betaflight(eight), "imuQ")
    read = read_record(blackbox(tmp_path / "default.bbl", table, **HEADERS))
    assert "no attitude is logged" in read.notes[-1]
    assert quaternion_to_euler(read.attitude)[0, 2] == pytest.approx(0.0, abs=0.01)
    vertical = np.tile([0.0, 0.0, 1.0], (len(eight.t), 1))
    up = to_world(conjugate(read.attitude), vertical)  # in the body, which no heading changes
    known = to_world(conjugate(eight.attitude), vertical)
    assert np.abs(known[:, :2]).max() > 0.2
    np.testing.assert_allclose(up, known, atol=np.radians(2.0))
    blackbox(tmp_path / "default.bbl", without(table, "eRPM"), **HEADERS)
    identified = quadsim.identify(tmp_path / "default.bbl", vehicle="hummingbird").vehicle
    np.testing.assert_allclose(identified.inertia, load_vehicle(vehicle_path("hummingbird")).inertia, rtol=0.03)


# Crazyflie


def micro_sd(path: Path, events: dict[str, dict[str, Array]], version: int) -> Path:
    """Write a log of the micro SD card deck: events by name, each with `t` [s] and variables by `name(letter)`."""
    clock, ticks = {1: ("I", 1e3), 2: ("Q", 1e6)}[version]
    parts = [b"\xbc" + struct.pack("<HH", version, len(events))]
    timed_rows = []
    for number, (event, variables) in enumerate(events.items()):
        names = [name for name in variables if name != "t"]
        letters = [name[-2] for name in names]  # between the parentheses
        parts.append(struct.pack("<H", number) + f"{event}\0".encode() + struct.pack("<H", len(names)))
        for name in names:
            parts.append(f"{name}\0".encode())
        form = f"<H{clock}{''.join(letters)}"
        columns = [variables[name] for name in names]
        for t, *values in zip(variables["t"], *columns, strict=True):
            timed_rows.append((t, struct.pack(form, number, round(ticks * t), *rounded(values, letters))))
    timed_rows.sort(key=lambda timed: timed[0])
    parts += [row for _, row in timed_rows]
    data = b"".join(parts)
    path.write_bytes(data + struct.pack("<I", zlib.crc32(data)))
    return path


def crazyflie(record: Record, *, angles: bool) -> dict[str, dict[str, Array]]:
    """What its estimator has, gyro in deg/s, outputs of 16 bit; the battery in an event of its own.

    Args:
        record: what flew.
        angles: whether the attitude is logged as angles, whose pitch is positive with the nose up, and not as a
            quaternion.
    """
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
    """The columns of an array, each named by the pattern with its letter."""
    return {pattern.format(letter): column for letter, column in zip(letters, rows.T, strict=True)}


@pytest.mark.parametrize(("version", "angles"), [(1, False), (2, True)])
def test_crazyflie(tmp_path: Path, eight: Record, version: int, angles: bool) -> None:
    read = read_record(micro_sd(tmp_path / "log00", crazyflie(eight, angles=angles), version))
    check_flight(read, eight, exact=2e-5)
    assert read.voltage == pytest.approx(3.912)


def test_crazyflie_that_cannot_be_used(tmp_path: Path, eight: Record) -> None:
    path = micro_sd(tmp_path / "log00", crazyflie(eight, angles=False), 2)
    whole = path.read_bytes()
    wrong_byte = whole[:5] + b"\xff" + whole[6:]
    for corrupted in (wrong_byte, whole[:200], whole[:20]):
        path.write_bytes(corrupted)
        with pytest.raises(FileError, match="Crazyflie"):
            read_record(path)
    events = crazyflie(eight, angles=False)
    del events["fixedFrequency"]["gyro.y(f)"]
    path = micro_sd(tmp_path / "log01", events, 2)
    with pytest.raises(FileError, match=r"gyro\.x"):
        read_record(path)


def test_a_crazyflie_log_that_is_cut_off_is_read_with_a_note(tmp_path: Path, eight: Record) -> None:
    path = micro_sd(tmp_path / "log00", crazyflie(eight, angles=False), 2)
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    (note,) = read_record(path).notes
    assert "check sum" in note


def test_a_constant_voltage_shows_no_exponent_of_it(eight: Record) -> None:
    vehicle = quadsim.load_vehicle("hummingbird")
    turning = lagged_rotors(np.asarray(eight.commands), eight.period, rise=0.02, fall=0.03, delay=0.0)
    flown = replace(eight, speeds=turning.speeds, throttle=throttle(eight), commands=None)
    constant = replace(flown, voltage=np.full(len(eight.t), 11.1))
    sagging = replace(flown, voltage=np.linspace(12.0, 11.0, len(eight.t)))
    of_constant = rotor_response([prepare_segment(constant, 0)], vehicle, 11.1)
    of_sagging = rotor_response([prepare_segment(sagging, 0)], vehicle, 11.1)
    assert of_constant["rotor_rise"].value == pytest.approx(0.02, abs=3e-3)
    assert of_sagging["rotor_rise"].value == pytest.approx(0.02, abs=3e-3)
    assert of_sagging.keys() - of_constant.keys() == {"voltage_exponent"}


def test_a_fast_log_is_averaged_without_a_shift() -> None:
    """At 1 kHz, over three samples: measurements about a time, commands, which are held, from that time on."""
    t = np.arange(4000) * 1e-3
    motion = np.sin(t[:, None] * [20.0, 21.0, 22.0])
    growing = 100.0 + np.arange(4000.0)  # by 1 rad/s from sample to sample
    columns = {
        "rates": Column(t=t, values=motion),
        "velocity": Column(t=t, values=motion),
        "attitude": Column(t=t, values=np.tile([1.0, 0.0, 0.0, 0.0], (4000, 1))),
        "commands": Column(t=t, values=np.tile(growing[:, None], (1, 4))),
    }
    read = to_record("fast", columns)
    (note,) = read.notes
    assert "333 Hz" in note
    np.testing.assert_allclose(read.rates, np.sin(read.t[:, None] * [20.0, 21.0, 22.0]), atol=2e-4)
    assert read.commands is not None
    first_of_three = 100.0 + 1e3 * read.t
    np.testing.assert_allclose(read.commands[:, 0], first_of_three + 1.0)
