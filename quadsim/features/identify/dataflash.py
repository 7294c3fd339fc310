"""ArduPilot's dataflash logs (`.bin`), read by pymavlink's DFReader: columns `MESSAGE.Field` for `record`.

Its axes are front, right, down, those of the world north, east, down.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import replace
from io import StringIO
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from quadsim.errors import FileError
from quadsim.features.identify.log_errors import scale_between, stated_number
from quadsim.features.identify.quantities import LoggedColumns, NamedQuantity, logged_as
from quadsim.features.identify.series import Column, on_one_clock
from quadsim.vehicle import N_ROTORS

_NAMES: Final = (
    logged_as("rates", "IMU.GyrX IMU.GyrY IMU.GyrZ", down=True),
    logged_as("attitude", "XKQ.Q1 XKQ.Q2 XKQ.Q3 XKQ.Q4", down=True),
    logged_as("euler", "ATT.Roll ATT.Pitch ATT.Yaw", unit="deg", down=True),
    logged_as("position", "XKF1.PN XKF1.PE XKF1.PD", down=True),
    logged_as("velocity", "XKF1.VN XKF1.VE XKF1.VD", down=True),
    logged_as("specific_force", "IMU.AccX IMU.AccY IMU.AccZ", down=True),
    logged_as("throttle", "RCOU.C1 RCOU.C2 RCOU.C3 RCOU.C4", unit="us"),
    logged_as("speeds", "ESC.RPM ESC[1].RPM ESC[2].RPM ESC[3].RPM", unit="rpm"),
    logged_as("voltage", "BAT.Volt"),
    NamedQuantity(quantity="flying", columns=("ARM.ArmState",)),
)
_ADVICE: Final = (
    "set the bits 0 and 18 of LOG_BITMASK, fast attitude and fast IMU, and LOG_FILE_RATEMAX to 0; ArduCopter logs the "
    "outputs, RCOU, at 10 Hz whatever these say, so let the speed controllers report RPM (bidirectional DShot or ESC "
    "telemetry): it is logged as ESC"
)
_CLOCKS: Final = {"TimeUS": 1e-6, "TimeMS": 1e-3}
"""Fields with the time, and their units [s]; logs from before ArduPilot 3.3 have milliseconds."""
_FIRST_BYTES: Final = b"\xa3\x95"
_FIRST_MOTOR: Final = 33  # of SERVOn_FUNCTION
_OUTPUTS: Final = 16


def read_dataflash(path: Path, column_map: Sequence[NamedQuantity]) -> LoggedColumns:
    """Read the messages that are used: columns `MESSAGE.Field`, of the second instance on `MESSAGE[1].Field`.

    Raises:
        FileError: it is not a dataflash log, or has a parameter that says nothing.
    """
    used = set()
    for named in (*column_map, *_NAMES):
        used |= {column.partition(".")[0].partition("[")[0] for column in named.columns}
    messages, parameters = _messages(path, used)
    columns: dict[str, Column] = {}
    for name, rows in messages.items():
        clock = next(clock for clock in _CLOCKS if clock in rows.fields)
        table = {}
        for field, values in zip(rows.fields, np.array(rows.values, float).T, strict=True):
            table[f"{name}.{field}"] = values
        columns |= on_one_clock(table[f"{name}.{clock}"] * _CLOCKS[clock], table)
    if _samples(columns, "XKQ.Q1") < _samples(columns, "ATT.Roll"):  # the quaternion is logged more rarely
        columns = {name: column for name, column in columns.items() if not name.startswith("XKQ")}
    motors = _motor_outputs(path, parameters)
    quantities = []
    for named in _NAMES:
        if named.quantity == "throttle":
            named = replace(named, **motors)
        quantities.append(named)
    return LoggedColumns(columns=columns, quantities=quantities, advice=_ADVICE)


class _Rows(NamedTuple):
    """What one instance of a message logged."""

    fields: list[str]  # that are numbers
    values: list[tuple[float, ...]]


def _messages(path: Path, used: Collection[str]) -> tuple[dict[str, _Rows], dict[str, Any]]:
    """The rows of each message that is used and has a clock, and the parameters."""
    messages: dict[str, _Rows] = {}
    with redirect_stdout(StringIO()), redirect_stderr(StringIO()):
        from pymavlink.DFReader import DFReader_binary

        class Reader(DFReader_binary):  # type: ignore[misc]  # whose own fast index prints past Python
            init_arrays_fast = DFReader_binary.init_arrays

        with path.open("rb") as file:
            if file.read(2) != _FIRST_BYTES:
                raise FileError(path, "is not a readable dataflash log: it does not begin with a message")
        with Reader(str(path), zero_time_base=True) as log:
            while (message := log.recv_match(type=[*used, "PARM"])) is not None:
                kind = message.get_type()
                has_clock = any(clock in message.get_fieldnames() for clock in _CLOCKS)
                if kind not in used or not has_clock:
                    continue
                row = message.to_dict()
                instance_field = message.fmt.instance_field
                name = kind
                if instance_field and row[instance_field]:
                    name = f"{kind}[{row[instance_field]}]"
                if name not in messages:
                    numbers = [field for field, value in row.items() if isinstance(value, int | float)]
                    messages[name] = _Rows(numbers, [])
                rows = messages[name]
                rows.values.append(tuple(row[field] for field in rows.fields))
            return messages, {**log.params}


def _samples(columns: Mapping[str, Column], name: str) -> int:
    if name not in columns:
        return 0
    return columns[name].t.size


def _motor_outputs(path: Path, parameters: Mapping[str, Any]) -> dict[str, Any]:
    """Which outputs are the motors, and the pulses between which they are."""
    outputs_by_function = {}
    for i in range(1, 1 + _OUTPUTS):
        function = stated_number(path, parameters, f"SERVO{i}_FUNCTION", 0, whole=True)
        outputs_by_function[function] = i
    columns = []
    for i in range(N_ROTORS):
        output = outputs_by_function.get(_FIRST_MOTOR + i, 1 + i)
        columns.append(f"RCOU.C{output}")
    low = stated_number(path, parameters, "MOT_PWM_MIN", 0) or 1000.0  # 0: that of the radio
    high = stated_number(path, parameters, "MOT_PWM_MAX", 0) or 2000.0
    return {"columns": tuple(columns), **scale_between(path, "MOT_PWM_MIN and MAX", low, high)}
