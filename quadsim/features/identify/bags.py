"""Bags of ROS 1 and 2 (`.bag`, `.mcap`, `.db3`, or a directory), read by rosbags and a map of their columns.

A reader like those of the autopilots' formats: it gives `record` columns by name, each on the clock of its topic.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from quadsim.errors import FileError, InputError
from quadsim.features.identify.quantities import LoggedColumns, NamedQuantity
from quadsim.features.identify.series import Column, on_one_clock

_FIELD_OR_INDEX: Final = re.compile(r"\.?([A-Za-z_]\w*)|\[(\d+)\]")


def read_bag(path: Path, column_map: Sequence[NamedQuantity]) -> LoggedColumns:
    """Read the columns of a bag that a map names: `/topic.field.x` or `/topic.field[0]`.

    Each is on the clock of its topic: of the headers of its messages, or of their arrival where they have none.

    Raises:
        FileError: it has no message with such a field.
        InputError: there is no map.
    """
    if not column_map:
        raise InputError(f"{path.name}: a bag names no quantities: give --columns, a map of its topics")
    names_by_topic: dict[str, list[str]] = {}
    for named in column_map:
        for name in named.columns:
            names = names_by_topic.setdefault(name.partition(".")[0], [])
            if name not in names:
                names.append(name)
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    columns: dict[str, Column] = {}
    with AnyReader([path], default_typestore=get_typestore(Stores.LATEST)) as bag:
        for connection in bag.connections:
            columns[connection.topic] = Column(np.zeros(0), np.zeros(0))
        for topic, names in names_by_topic.items():
            rows = _rows(path, bag, topic, names)
            if rows:
                times, *values = np.array(rows, float).T
                columns |= on_one_clock(times, dict(zip(names, values, strict=True)))
    return LoggedColumns(columns=columns, quantities=column_map)


def _rows(path: Path, bag: Any, topic: str, names: Sequence[str]) -> list[list[float]]:
    """The time [s] and the numbers of each message of a topic."""
    connections = [connection for connection in bag.connections if connection.topic == topic]
    if not connections:
        return []  # rosbags would give the messages of all topics
    rows = []
    for connection, arrived, raw in bag.messages(connections):
        message: Any = bag.deserialize(raw, connection.msgtype)
        stamp = getattr(getattr(message, "header", None), "stamp", None)
        t = 1e-9 * arrived
        if stamp is not None:
            t = stamp.sec + 1e-9 * stamp.nanosec
        numbers = [_at(path, message, name) for name in names]
        rows.append([t, *numbers])
    return rows


def _at(path: Path, message: Any, name: str) -> float:
    """The number at the end of a path of fields and indices, of the topic's name the rest."""
    value = message
    for field, index in _FIELD_OR_INDEX.findall(name.partition(".")[2]):
        try:
            if field:
                value = getattr(value, field)
            else:
                value = value[int(index)]
        except (AttributeError, IndexError, TypeError) as error:
            fields = [key for key in getattr(value, "__dataclass_fields__", ()) if key != "__msgtype__"]
            size = np.size(value)
            there = ", ".join(fields) or f"{size} number{'s' * (size > 1)}"
            raise FileError(path, f"{name!r}: no {field or index} in {there}") from error
    try:
        return float(value)
    except (TypeError, ValueError) as error:
        raise FileError(path, f"{name!r} is not a number but {type(value).__name__}: name a field of it") from error
