"""Logs of the Crazyflie's micro SD card deck, a file without a suffix.

The format is documented with the firmware (`usddeck.c`): 0xBC; version and number of event types, 16 bit; of each type
its number, name, and the count and names of its variables, which end in `(f)`, a letter of `struct`; then events, a
type, a time (1: 32 bit, in ms; 2: 64 bit, in us) and values; at last a CRC-32 of what is before it.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from quadsim.features.identify.quantities import LoggedColumns, NamedQuantity, logged_as
from quadsim.features.identify.series import Column, on_one_clock

FIRST_BYTES: Final = (b"\xbc\x01\x00", b"\xbc\x02\x00")
_STAMPS: Final = {1: (struct.Struct("<HI"), 1e-3), 2: (struct.Struct("<HQ"), 1e-6)}
_ROTORS: Final = "1 2 3 4"
_NAMES: Final = (
    logged_as("position", "stateEstimate.{}", each="x y z"),
    logged_as("velocity", "stateEstimate.v{}", each="x y z"),
    logged_as("specific_force", "acc.{}", each="x y z", unit="g"),
    logged_as("attitude", "stateEstimate.q{}", each="w x y z"),
    logged_as("euler", "stateEstimate.{}", each="roll pitch yaw", unit="deg", sign=(1.0, -1.0, 1.0)),  # nose up
    logged_as("rates", "gyro.{}", each="x y z", unit="deg/s"),
    *(logged_as("throttle", way, each=_ROTORS, unit="16 bit") for way in ("pwm.m{}_pwm", "motor.m{}")),
    logged_as("speeds", "rpm.m{}", each=_ROTORS, unit="rpm"),
    logged_as("voltage", "pm.vbatMV", unit="mV"),
    logged_as("voltage", "pm.vbat"),
)
_ADVICE: Final = "in config.txt of the card, log stateEstimate.qw .. qz, vx .. vz, gyro, pwm and rpm at 100 Hz or more"


def read_crazyflie(path: Path, given: Sequence[NamedQuantity]) -> LoggedColumns:
    """Read every variable of the log, by its name, each on the clock of its event type."""
    data = path.read_bytes()
    columns = _columns(data[:-4])
    whole = zlib.crc32(data[:-4]) == int.from_bytes(data[-4:], "little")
    notes = () if whole else (f"{path.name}: its check sum is wrong: it is cut off or damaged",)
    return LoggedColumns(columns=columns, quantities=_NAMES, advice=_ADVICE, notes=notes)


def _columns(data: bytes) -> dict[str, Column]:
    version, count = struct.unpack_from("<HH", data, 1)
    head, unit = _STAMPS[version]
    at = 5

    def name() -> str:
        nonlocal at
        end = data.index(0, at)
        text = data[at:end].decode("ascii")
        at = end + 1
        return text

    events: dict[int, tuple[list[str], struct.Struct, list[Any]]] = {}
    for _ in range(count):
        (number,) = struct.unpack_from("<H", data, at)
        at = at + 2
        name()  # of the event
        (size,) = struct.unpack_from("<H", data, at)
        at = at + 2
        variables = [name() for _ in range(size)]
        values = struct.Struct("<" + "".join(variable[-2] for variable in variables))
        events[number] = ([variable[:-3] for variable in variables], values, [])
    while at + head.size <= len(data):
        number, stamp = head.unpack_from(data, at)
        _, values, rows = events[number]
        if at + head.size + values.size > len(data):  # it is cut off
            break
        rows.append((stamp * unit, *values.unpack_from(data, at + head.size)))
        at += head.size + values.size
    columns: dict[str, Column] = {}
    for variables, _, rows in events.values():
        if rows:
            times, *numbers = np.array(rows, float).T
            columns |= on_one_clock(times, dict(zip(variables, numbers, strict=True)))
    return columns
