"""PX4's ULog, read by pyulog: columns `topic.field` for `record`, and the rotors that its parameters state.

Its axes are front, right, down, those of the world north, east, down.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import redirect_stdout
from dataclasses import replace
from io import StringIO
from pathlib import Path
from typing import Any, Final

import numpy as np

from quadsim.features.identify.log_errors import reading_errors, scale_between, stated_number
from quadsim.features.identify.quantities import HALF_TURN, LoggedColumns, NamedQuantity, logged_as
from quadsim.features.identify.series import Column, latest_samples, on_one_clock
from quadsim.vehicle import N_ROTORS

ULOGS: Final = (".ulg", ".ulog")
_ROTORS: Final = range(N_ROTORS)
_MOTORS: Final = logged_as("throttle", "actuator_motors.control[{}]")
_PULSES: Final = logged_as("throttle", "actuator_outputs.output[{}]", unit="us")
_NAMES: Final = (
    logged_as("rates", "vehicle_angular_velocity.xyz[{}]", down=True),
    logged_as("rates", "sensor_combined.gyro_rad[{}]", down=True),
    logged_as("attitude", "vehicle_attitude.q[{}]", down=True),
    logged_as("position", "vehicle_local_position.{}", each="x y z", down=True),
    logged_as("velocity", "vehicle_local_position.v{}", each="x y z", down=True),
    logged_as("specific_force", "sensor_combined.accelerometer_m_s2[{}]", down=True),
    logged_as("specific_force", "vehicle_acceleration.xyz[{}]", down=True),
    _MOTORS,
    _PULSES,
    logged_as("speeds", "esc_status.esc[{}].esc_rpm", unit="rpm"),
    logged_as("voltage", "battery_status.voltage_v"),
    NamedQuantity(quantity="flying", columns=("flying",)),
)
_STATES: Final = ("actuator_armed", "vehicle_land_detected")
_ADVICE: Final = "set SDLOG_PROFILE to 17, the default set and the high rate"
_FIRST_MOTOR: Final = 101  # of PWM_MAIN_FUNCn


def read_ulog(path: Path, column_map: Sequence[NamedQuantity]) -> LoggedColumns:
    """Read the topics of a ULog that are used: columns `topic.field`, each on the clock of its measurement.

    Raises:
        FileError: a parameter of it says nothing.
    """
    topics = [*_STATES]
    for named in (*column_map, *_NAMES):
        topics += [column.partition(".")[0] for column in named.columns]
    log = _parsed(path, topics)
    columns: dict[str, Column] = {}
    notes: list[str] = []
    if log.file_corruption:
        notes.append(f"{path.name}: it is damaged; what can be read of it is used")
    for data in sorted(log.data_list, key=lambda data: data.multi_id, reverse=True):  # the first instance of each
        stamps = data.data.get("timestamp_sample")
        if stamps is None or not np.any(stamps):
            stamps = data.data.get("timestamp")
        if stamps is None:
            notes.append(f"{path.name}: {data.name} has no time and is left out")
            continue
        table = {f"{data.name}.{field}": values for field, values in data.data.items()}
        columns |= on_one_clock(np.asarray(stamps, float) * 1e-6, table)
    for name, column in columns.items():
        if name.endswith("esc_rpm"):
            columns[name] = Column(column.t, np.abs(column.values))
    flying = _flying(columns)
    if flying is not None:
        columns["flying"] = flying
    quantities = [*_NAMES]
    if _PULSES.columns[0] in columns and _MOTORS.columns[0] not in columns:
        motors = replace(_PULSES, **_motor_outputs(path, log.initial_parameters))
        quantities[quantities.index(_PULSES)] = motors
    return LoggedColumns(columns=columns, quantities=quantities, advice=_ADVICE, notes=tuple(notes))


def stated_rotors(path: Path) -> str:
    """Return the rotors by a ULog's CA_ROTOR parameters, lines of a vehicle file; empty without, and of other logs.

    PX4 has them front, right, down, and a positive moment for a rotor that turns counter-clockwise from above.

    Raises:
        MissingPackageError: pyulog is not installed.
        FileError: it is not a ULog, or a parameter of it says nothing.
    """
    if path.suffix.lower() not in ULOGS or not path.is_file():
        return ""
    with reading_errors(path, "ULog", "pyulog"):
        stated = _parsed(path, _STATES).initial_parameters
    if stated_number(path, stated, "CA_ROTOR_COUNT", 0, whole=True) != N_ROTORS:
        return ""
    hubs = []
    moments = []
    spins = []
    for i in _ROTORS:
        hubs.append([stated_number(path, stated, f"CA_ROTOR{i}_P{axis}", 0.0) for axis in "XYZ"])
        moment = stated_number(path, stated, f"CA_ROTOR{i}_KM", 0.05)
        moments.append(moment)
        spins.append(-1 if moment > 0.0 else 1)
    positions = np.round(np.array(hubs) * HALF_TURN, 4) + 0.0  # never -0
    values = {
        "rotor_positions": (positions.tolist(), "m"),
        "rotor_spins": (spins, "-"),
        "drag_to_thrust": (round(float(np.abs(moments).mean()), 4), "m"),
    }
    lines = []
    for name, (value, unit) in values.items():
        lines.append(f'{name} = {{value = {value}, unit = "{unit}", source = "CA_ROTOR of {path.name}"}}')
    return "; ".join(lines)


def _parsed(path: Path, topics: Sequence[str]) -> Any:
    from pyulog import ULog

    with path.open("rb") as file, redirect_stdout(StringIO()):  # pyulog prints that a file is damaged
        return ULog(file, [*topics])


def _flying(columns: Mapping[str, Column]) -> Column | None:
    """Whether it is armed and not landed, as far as the log says so."""
    flying_states = {"actuator_armed.armed": 1.0, "vehicle_land_detected.landed": 0.0}
    known = [name for name in flying_states if name in columns]
    if not known:
        return None
    t = np.unique(np.concatenate([columns[name].t for name in known]))
    flying = np.ones(len(t), bool)
    for name in known:
        flying &= latest_samples(columns[name], t) == flying_states[name]
    return Column(t, flying.astype(float))


def _motor_outputs(path: Path, parameters: Mapping[str, Any]) -> dict[str, Any]:
    """Which outputs are the motors, and their shortest and longest pulses [us]; a negative one is the common one."""
    outputs_by_motor: dict[float, int] = {}
    for i in range(2 * N_ROTORS):
        function = stated_number(path, parameters, f"PWM_MAIN_FUNC{i + 1}", 0, whole=True)
        outputs_by_motor[function - _FIRST_MOTOR] = i

    def pulse(output: int, end: str, usual: float) -> float:
        names = (f"PWM_MAIN_{end}{output + 1}", f"PWM_MAIN_{end}", f"PWM_{end}")
        stated = [stated_number(path, parameters, name, -1.0) for name in names]
        return next((number for number in stated if number >= 0.0), usual)

    columns = []
    low = []
    high = []
    for motor in _ROTORS:
        output = outputs_by_motor.get(motor, motor)
        columns.append(f"actuator_outputs.output[{output}]")
        low.append(pulse(output, "MIN", 1000.0))
        high.append(pulse(output, "MAX", 2000.0))
    return {"columns": tuple(columns), **scale_between(path, "pulses of PWM_MAIN", low, high)}
