"""ArduPilot's dataflash logs (`.bin`), read by pymavlink's DFReader."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import replace
from io import StringIO
from pathlib import Path
from typing import Any, Final

import numpy as np

from quadsim.errors import FileError
from quadsim.features.identify.border import between, stated_number
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


def read_dataflash(path: Path, given: Sequence[NamedQuantity]) -> LoggedColumns:
    """Read the messages that are used: columns `MESSAGE.Field`, of the second instance on `MESSAGE[1].Field`.

    Raises:
        FileError: it is not a dataflash log, or has a parameter that says nothing.
    """
    used = {column.partition(".")[0].partition("[")[0] for one in (*given, *_NAMES) for column in one.columns}
    columns: dict[str, Column] = {}
    rows: dict[str, list[tuple[float, ...]]] = {}
    fields: dict[str, list[str]] = {}
    with redirect_stdout(StringIO()), redirect_stderr(StringIO()):
        from pymavlink.DFReader import DFReader_binary

        class Reader(DFReader_binary):  # type: ignore[misc]  # whose own fast index prints past Python
            init_arrays_fast = DFReader_binary.init_arrays

        with path.open("rb") as file:
            if file.read(2) != _FIRST_BYTES:
                raise FileError(path, "is not a readable dataflash log: it does not begin with a message")
        with Reader(str(path), zero_time_base=True) as log:
            while (message := log.recv_match(type=[*used, "PARM"])) is not None:
                clock = next((name for name in _CLOCKS if name in message.get_fieldnames()), None)
                if (kind := message.get_type()) in used and clock is not None:
                    of = message.fmt.instance_field
                    row = message.to_dict()
                    name = f"{kind}[{row[of]}]" if of and row[of] else kind
                    fields.setdefault(name, [key for key, value in row.items() if isinstance(value, int | float)])
                    rows.setdefault(name, []).append(tuple(row[key] for key in fields[name]))
            parameters = {**log.params}
    for name, of in fields.items():
        table = {}
        for field, values in zip(of, np.array(rows[name], float).T, strict=True):
            table[f"{name}.{field}"] = values
        clock = next(clock for clock in _CLOCKS if f"{name}.{clock}" in table)
        columns |= on_one_clock(table[f"{name}.{clock}"] * _CLOCKS[clock], table)
    turns = [columns[name].t.size if name in columns else 0 for name in ("XKQ.Q1", "ATT.Roll")]
    if turns[0] < turns[1]:
        columns = {name: column for name, column in columns.items() if not name.startswith("XKQ")}
    functions = (stated_number(path, parameters, f"SERVO{i}_FUNCTION", 0, whole=True) for i in range(1, 1 + _OUTPUTS))
    motors = {function: i for i, function in enumerate(functions, start=1)}
    outputs = tuple(f"RCOU.C{motors.get(_FIRST_MOTOR + i, 1 + i)}" for i in range(N_ROTORS))
    low = stated_number(path, parameters, "MOT_PWM_MIN", 0) or 1000.0  # 0: that of the radio
    high = stated_number(path, parameters, "MOT_PWM_MAX", 0) or 2000.0
    pulses: dict[str, Any] = {"columns": outputs, **between(path, "MOT_PWM_MIN and MAX", low, high)}
    names = [replace(one, **pulses) if one.quantity == "throttle" else one for one in _NAMES]
    return LoggedColumns(columns=columns, quantities=names, advice=_ADVICE)
