"""Bags of ROS 1 and 2 (`.bag`, `.mcap`, `.db3`, or a directory), read by rosbags and a map of their columns."""

from __future__ import annotations

import re
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np

from quadsim.errors import FileError, InputError
from quadsim.features.identify.quantities import LoggedColumns, NamedQuantity
from quadsim.features.identify.series import Column, on_one_clock

_STEP: Final = re.compile(r"\.?([A-Za-z_]\w*)|\[(\d+)\]")


def read_bag(path: Path, given: Sequence[NamedQuantity]) -> LoggedColumns:
    """Read the columns of a bag that a map names: `/topic.field.x` or `/topic.field[0]`.

    Each is on the clock of its topic: of the headers of its messages, or of their arrival where they have none.

    Raises:
        FileError: it has no message with such a field.
        InputError: there is no map.
    """
    if not given:
        raise InputError(f"{path.name}: a bag names no quantities: give --columns, a map of its topics")
    wanted: dict[str, list[str]] = {}
    for name in dict.fromkeys(column for one in given for column in one.columns):
        wanted.setdefault(name.partition(".")[0], []).append(name)
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    with AnyReader([path], default_typestore=get_typestore(Stores.LATEST)) as bag:
        columns = {connection.topic: Column(np.zeros(0), np.zeros(0)) for connection in bag.connections}
        for topic, names in wanted.items():
            connections = [connection for connection in bag.connections if connection.topic == topic]
            rows = []
            for connection, arrived, raw in bag.messages(connections) if connections else ():
                message: Any = bag.deserialize(raw, connection.msgtype)
                stamp = getattr(getattr(message, "header", None), "stamp", None)
                if stamp is None:
                    t = 1e-9 * arrived
                else:
                    t = stamp.sec + 1e-9 * stamp.nanosec
                rows.append([t, *map(partial(_at, path, message), names)])
            if rows:
                times, *values = np.array(rows, float).T
                columns |= on_one_clock(times, dict(zip(names, values, strict=True)))
    return LoggedColumns(columns=columns, quantities=given)


def _at(path: Path, message: Any, name: str) -> float:
    """The number at the end of a path of fields and indices, of the topic's name the rest."""
    value = message
    for field, index in _STEP.findall(name.partition(".")[2]):
        try:
            if field:
                value = getattr(value, field)
            else:
                value = value[int(index)]
        except (AttributeError, IndexError, TypeError) as error:
            fields = [key for key in getattr(value, "__dataclass_fields__", ()) if key != "__msgtype__"]
            there = ", ".join(fields) or f"{np.size(value)} number{'s' * (np.size(value) > 1)}"
            raise FileError(path, f"{name!r}: no {field or index} in {there}") from error
    try:
        return float(value)
    except (TypeError, ValueError) as error:
        raise FileError(path, f"{name!r} is not a number but {type(value).__name__}: name a field of it") from error
