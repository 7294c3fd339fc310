"""Logs of the Crazyflie's micro SD card deck, a file without a suffix: every variable by its name for `record`.

The format is documented with the firmware (`usddeck.c`): 0xBC; version and number of event types, 16 bit; of each type
its number, name, and the count and names of its variables, which end in `(f)`, a letter of `struct`; then events, a
type, a time (1: 32 bit, in ms; 2: 64 bit, in us) and values; at last a CRC-32 of what is before it.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from quadsim.features.identify.quantities import LoggedColumns, NamedQuantity, logged_as
from quadsim.features.identify.series import Column, on_one_clock

FIRST_BYTES: Final = (b"\xbc\x01\x00", b"\xbc\x02\x00")
_UINT16: Final = struct.Struct("<H")
_EVENT_HEADS: Final = {1: (struct.Struct("<HI"), 1e-3), 2: (struct.Struct("<HQ"), 1e-6)}
"""Type and time of an event, and the time's unit [s], by version."""
_ROTORS: Final = "1 2 3 4"
_NAMES: Final = (
    logged_as("position", "stateEstimate.{}", each="x y z"),
    logged_as("velocity", "stateEstimate.v{}", each="x y z"),
    logged_as("specific_force", "acc.{}", each="x y z", unit="g"),
    logged_as("attitude", "stateEstimate.q{}", each="w x y z"),
    logged_as("euler", "stateEstimate.{}", each="roll pitch yaw", unit="deg", sign=(1.0, -1.0, 1.0)),  # nose up
    logged_as("rates", "gyro.{}", each="x y z", unit="deg/s"),
    logged_as("throttle", "pwm.m{}_pwm", each=_ROTORS, unit="16 bit"),
    logged_as("throttle", "motor.m{}", each=_ROTORS, unit="16 bit"),
    logged_as("speeds", "rpm.m{}", each=_ROTORS, unit="rpm"),
    logged_as("voltage", "pm.vbatMV", unit="mV"),
    logged_as("voltage", "pm.vbat"),
)
_ADVICE: Final = "in config.txt of the card, log stateEstimate.qw .. qz, vx .. vz, gyro, pwm and rpm at 100 Hz or more"


def read_crazyflie(path: Path, column_map: Sequence[NamedQuantity]) -> LoggedColumns:
    """Read every variable of the log, by its name, each on the clock of its event type."""
    data = path.read_bytes()
    content = data[:-4]
    check_sum = int.from_bytes(data[-4:], "little")
    notes: tuple[str, ...] = ()
    if zlib.crc32(content) != check_sum:
        notes = (f"{path.name}: its check sum is wrong: it is cut off or damaged",)
    return LoggedColumns(columns=_columns(content), quantities=_NAMES, advice=_ADVICE, notes=notes)


class _EventType(NamedTuple):
    """A kind of event: its variables, and the rows that were logged, each with its time."""

    variables: list[str]
    values: struct.Struct
    rows: list[tuple[Any, ...]]


class _Reader:
    """Reads numbers and texts one after the other."""

    def __init__(self, data: bytes, at: int) -> None:
        self.data = data
        self.at = at

    def unpack(self, layout: struct.Struct) -> tuple[Any, ...]:
        values = layout.unpack_from(self.data, self.at)
        self.at += layout.size
        return values

    def text(self) -> str:
        end = self.data.index(0, self.at)
        text = self.data[self.at : end].decode("ascii")
        self.at = end + 1
        return text

    def has(self, size: int) -> bool:
        """Whether as many bytes are left."""
        return self.at + size <= len(self.data)


def _columns(data: bytes) -> dict[str, Column]:
    reader = _Reader(data, 1)
    version, count = reader.unpack(struct.Struct("<HH"))
    head, unit = _EVENT_HEADS[version]
    types: dict[int, _EventType] = {}
    for _ in range(count):
        (number,) = reader.unpack(_UINT16)
        types[number] = _event_type(reader)
    while reader.has(head.size):
        number, stamp = reader.unpack(head)
        event = types[number]
        if not reader.has(event.values.size):  # it is cut off
            break
        event.rows.append((stamp * unit, *reader.unpack(event.values)))
    columns: dict[str, Column] = {}
    for event in types.values():
        if event.rows:
            times, *numbers = np.array(event.rows, float).T
            columns |= on_one_clock(times, dict(zip(event.variables, numbers, strict=True)))
    return columns


def _event_type(reader: _Reader) -> _EventType:
    """The variables of an event type, behind its number: their names end in a letter of `struct` in brackets."""
    reader.text()  # the name of the event
    (size,) = reader.unpack(_UINT16)
    names = []
    layout = "<"
    for _ in range(size):
        variable = reader.text()
        names.append(variable[: -len("(f)")])
        layout += variable[-2]
    return _EventType(names, struct.Struct(layout), [])
