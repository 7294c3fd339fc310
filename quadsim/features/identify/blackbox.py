"""Betaflight's Blackbox logs (`.bbl`, `.bfl`), read by orangebox: columns by their names in the log for `record`.

Betaflight's axes are ours: x forward, y left, z up.
"""

from __future__ import annotations

import logging
import math
import struct
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from quadsim.errors import FileError
from quadsim.features.identify.log_errors import scale_between, stated_number
from quadsim.features.identify.quantities import RPM, STANDARD_GRAVITY, LoggedColumns, NamedQuantity, logged_as
from quadsim.features.identify.series import Column, on_one_clock
from quadsim.state import Array

_ADVICE: Final = (
    "in Betaflight, set blackbox_disable_attitude, _acc, _rpm and _gyro to OFF, blackbox_sample_rate to 1/8"
)
_QUATERNION_SCALE: Final = 32767.0  # 1 in a component of the quaternion
_USUAL_POLES: Final = 14  # of a motor
_BITS_OF_ONE: Final = int.from_bytes(struct.pack(">f", 1.0))  # a header states a float by its bits
_LARGEST_GYRO_SCALE: Final = 1e3  # of a gyro's unit [deg/s]


def read_blackbox(path: Path, column_map: Sequence[NamedQuantity]) -> LoggedColumns:
    """Read the columns of a Blackbox log by their names in it; of several in one file, the longest.

    Of its quaternion a log has x, y, z; w is not negative.

    Raises:
        FileError: it has no frame, or a header that says nothing.
    """
    logging.getLogger("orangebox").addHandler(logging.NullHandler())  # else it warns of what it guesses
    from orangebox import Parser

    log = Parser.load(str(path), allow_invalid_header=True)
    begins = [*log.reader.log_pointers, path.stat().st_size]
    flights = len(begins) - 1
    longest = 1 + int(np.argmax(np.diff(begins)))
    log = Parser.load(str(path), longest, allow_invalid_header=True)
    names = log.field_names
    table = _frames(log, len(names))
    if "time" not in names or not table.size:
        raise FileError(path, "has no frame with a time")
    t = table[:, names.index("time")] * 1e-6
    columns = on_one_clock(t, dict(zip(names, table.T, strict=True)))
    _add_quaternion_w(columns)
    notes: tuple[str, ...] = ()
    if flights > 1:
        notes = (f"{path.name}: the longest of its {flights} flights is read",)
    return LoggedColumns(columns=columns, quantities=_quantities(path, log.headers), advice=_ADVICE, notes=notes)


def _frames(log: Any, size: int) -> Array:
    """(M, n) numbers of a log's frames, NaN where one is empty; a log that is cut off ends there."""
    rows: list[list[Any]] = []
    try:
        for frame in log.frames():
            rows.append([np.nan if value == "" else value for value in frame.data[:size]])
    except (IndexError, RuntimeError, TypeError, ValueError):
        if not rows:
            raise
    return np.array(rows, float)


def _add_quaternion_w(columns: dict[str, Column]) -> None:
    """Add the w of unit length to the x, y, z of a quaternion, where they are logged."""
    names = [f"imuQuaternion[{i}]" for i in range(3)]
    if not {*names} <= {*columns}:
        return
    x, y, z = (columns[name].values / _QUATERNION_SCALE for name in names)
    w = np.sqrt(np.maximum(1.0 - x * x - y * y - z * z, 0.0))
    columns["imuQuaternion.w"] = Column(columns["time"].t, _QUATERNION_SCALE * w)


def _quantities(path: Path, headers: Mapping[str, Any]) -> tuple[NamedQuantity, ...]:
    """What the columns are, in the units that the log's header states."""
    bits = stated_number(path, headers, "gyro_scale", _BITS_OF_ONE, low=0, high=2**32 - 1, whole=True)
    (degrees,) = struct.unpack("<f", struct.pack("<I", int(bits)))
    if not 0.0 < degrees < _LARGEST_GYRO_SCALE:
        raise FileError(path, f"states gyro_scale = {degrees:g}; it must be above 0 and below {_LARGEST_GYRO_SCALE:g}")
    if headers.get("blackbox_high_resolution") == 1:
        degrees *= 0.1
    ends = headers.get("motorOutput", (1000, 2000))
    if not isinstance(ends, list | tuple) or len(ends) != 2:
        raise FileError(path, f"states motorOutput = {ends!r:.80}; it must be two numbers, low and high")
    low, high = (stated_number(path, {"motorOutput": end}, "motorOutput", math.nan) for end in ends)
    poles = stated_number(path, headers, "motor_poles", _USUAL_POLES, low=2, high=200, whole=True)
    rpm = 100.0 / (0.5 * poles)  # of 100 electrical ones
    gravity = STANDARD_GRAVITY / stated_number(path, headers, "acc_1G", 2048, low=1)
    return (
        logged_as("rates", "gyroADC[{}]", scale=np.radians(degrees)),
        logged_as("attitude", "imuQuaternion{}", each=".w [0] [1] [2]", scale=1.0 / _QUATERNION_SCALE),
        logged_as("specific_force", "accSmooth[{}]", scale=gravity),
        logged_as("throttle", "motor[{}]", **scale_between(path, "motorOutput", low, high)),
        logged_as("speeds", "eRPM[{}]", scale=rpm * RPM),
        logged_as("voltage", "vbatLatest", unit="cV"),
    )
