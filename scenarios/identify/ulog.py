"""PX4's ULog as a log: world NED and body FRD become z up, x forward and y left."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

import numpy as np

from quadsim.errors import FileError, MissingPackageError
from quadsim.state import Array
from quadsim.vehicle import N_ROTORS
from scenarios.identify.columns import RPM
from scenarios.identify.series import SampledSeries

ULOGS: Final = (".ulg", ".ulog")
HALF_TURN: Final = np.array([1.0, -1.0, -1.0])  # about x: NED to north, west, up; FRD to x forward, y left, z up
_VECTOR: Final = tuple(f"xyz[{i}]" for i in range(3))
_QUATERNION: Final = tuple(f"q[{i}]" for i in range(4))
_ROTORS: Final = range(N_ROTORS)
_TOPICS: Final[dict[str, tuple[tuple[str, tuple[str, ...]], ...]]] = {
    "rates": (
        ("vehicle_angular_velocity", _VECTOR),
        ("sensor_combined", tuple(f"gyro_rad[{i}]" for i in range(3))),
    ),
    "attitude": (("vehicle_attitude", _QUATERNION),),
    "position": (("vehicle_local_position", ("x", "y", "z")),),
    "velocity": (("vehicle_local_position", ("vx", "vy", "vz")),),
    "throttle": (("actuator_motors", tuple(f"control[{i}]" for i in _ROTORS)),),
    "pwm": (("actuator_outputs", tuple(f"output[{i}]" for i in _ROTORS)),),
    "speeds": (("esc_status", tuple(f"esc[{i}].esc_rpm" for i in _ROTORS)),),
    "voltage": (("battery_status", ("voltage_v",)),),
}
"""Topics of each quantity and their fields, the best first."""
_PULSES: Final = (
    (1000.0, ("PWM_MAIN_MIN1", "PWM_MAIN_MIN", "PWM_MIN")),
    (2000.0, ("PWM_MAIN_MAX1", "PWM_MAIN_MAX", "PWM_MAX")),
)
"""Shortest and longest pulse of a motor [us]: what is usual, and the parameters that say otherwise."""
_NEEDED: Final = (("rates",), ("attitude",), ("velocity",), ("throttle", "pwm", "speeds"))


def read_ulog(path: Path) -> dict[str, SampledSeries]:
    """Read the series of a ULog by field of `scenarios.identify.record.Record`.

    Raises:
        MissingPackageError: pyulog is not installed.
        FileError: it is not a ULog, or lacks a topic.
    """
    try:
        from pyulog import ULog
    except ModuleNotFoundError as error:
        raise MissingPackageError("a ULog", "pyulog", extra="logs") from error
    names = sorted({topic for ways in _TOPICS.values() for topic, _ in ways})
    try:
        with path.open("rb") as file:  # which pyulog leaves open where it fails
            log = ULog(file, names)
    except Exception as error:  # pyulog raises whatever its parsing meets
        raise FileError(path, f"is not a readable ULog ({str(error)[:80]})") from error
    instances = sorted(log.data_list, key=lambda data: data.multi_id, reverse=True)
    topics = {data.name: data.data for data in instances}  # the first instance of each
    series = {field: found for field, ways in _TOPICS.items() if (found := _series(ways, topics)) is not None}
    for needed in _NEEDED:
        if not {*needed} & {*series}:
            ways = " or ".join(topic for field in needed for topic, _ in _TOPICS[field])
            raise FileError(path, f"lacks the topic {ways}; of those used it has {', '.join(topics) or 'none'}")
    pwm = series.pop("pwm", None)
    if pwm is not None and "throttle" not in series:
        low, high = (
            float(next((log.initial_parameters[name] for name in names if name in log.initial_parameters), usual))
            for usual, names in _PULSES
        )
        series["throttle"] = SampledSeries(t=pwm.t, values=(pwm.values - low) / (high - low))
    for field in ("rates", "velocity", "position"):
        if field in series:
            series[field] = SampledSeries(t=series[field].t, values=series[field].values * HALF_TURN)
    turn = series["attitude"]
    series["attitude"] = SampledSeries(t=turn.t, values=turn.values * [1.0, *HALF_TURN])
    if "speeds" in series:
        rpm = series.pop("speeds")
        if np.abs(rpm.values).max() > 0.0:  # speed controllers without telemetry report zeros
            series["speeds"] = SampledSeries(t=rpm.t, values=np.abs(rpm.values) * RPM)
    return series


def _series(ways: tuple[tuple[str, tuple[str, ...]], ...], topics: dict[str, Any]) -> SampledSeries | None:
    """The first of the topics that is there with all its fields, on the clock of its measurement."""
    for topic, fields in ways:
        data: dict[str, Array] = topics.get(topic, {})
        if {*fields} <= {*data}:
            stamps = data.get("timestamp_sample", data["timestamp"])
            t = np.asarray(stamps if np.any(stamps) else data["timestamp"], float) * 1e-6
            _, rows = np.unique(t, return_index=True)  # an estimator may publish one sample twice
            return SampledSeries(
                t=t[rows], values=np.stack([np.asarray(data[name], float)[rows] for name in fields], axis=1)
            )
    return None
