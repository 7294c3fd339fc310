"""How rotors answer their commands: lag, delay, throttle curve and voltage, from the speeds that were measured.

w + tau dw/dt = w_target(u, V), tau that of rising or falling speed, with both sides below `CORNER`: a log that has the
commands less often than they are sent shows what is faster than it at a wrong frequency.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, Final, NamedTuple

import numpy as np
from scipy.optimize import least_squares
from scipy.signal import butter, sosfiltfilt

from quadsim.features.identify.model import Parameters, Stretch, commanded
from quadsim.features.identify.rotors import lagging
from quadsim.state import Array
from quadsim.vehicle import N_ROTORS, Vehicle

CORNER: Final = 6.0  # [Hz], a tenth of the log's rate if that is less
_EDGE: Final = 0.5  # [s] at the ends of a stretch that the filter disturbs
_BLOCK: Final = 3.0  # [s] that are left out in turn
_FEWEST: Final = 6  # blocks
_SAG: Final = 0.005  # share of the voltage that it must change by to show what it does


class RotorResponse(NamedTuple):
    """A number of the rotors' response, and its deviation by leaving out blocks."""

    value: float
    deviation: float
    blocks: int


def rotor_response(parts: Sequence[Stretch], vehicle: Vehicle, voltage: float) -> dict[str, RotorResponse]:
    """Fit the measured speeds of all stretches by the commands or the throttle.

    Args:
        parts: stretches with measured speeds and commands or throttle.
        vehicle: the start.
        voltage: at which the throttle curve holds [V].

    Returns:
        `rotor_rise`, `rotor_fall` and `delay` [s], and where the log shows them, `throttle_curve` and
        `voltage_exponent`.
    """
    record = parts[0].record
    lag = vehicle.rotor_rise or vehicle.rotor_fall or 0.03
    start = {"rotor_rise": lag, "rotor_fall": lag, "delay": 0.0}
    start |= {"throttle_curve": vehicle.throttle_share} if record.commands is None else {}
    voltages = [part.record.voltage for part in parts if part.record.voltage is not None]
    sags = bool(voltages) and np.ptp(np.concatenate(voltages)) > _SAG * voltage
    start |= {"voltage_exponent": 1.0} if sags else {}
    period = record.period
    edge = round(_EDGE / record.period)
    low_pass = butter(2, min(CORNER, 0.1 / period), fs=1.0 / period, output="sos")
    speeds = [np.asarray(part.record.speeds) for part in parts]
    known = []
    for rows in speeds:
        slow = sosfiltfilt(low_pass, rows, axis=0)
        known.append((slow, np.gradient(slow, period, axis=0)))
    scale = float(np.mean(np.concatenate(speeds)))

    def errors(x: Array) -> Array:
        """(K, 4) left side less right side of all stretches, over the mean speed."""
        numbers = dict(zip(start, x, strict=False)) | held
        rise, fall, delay = (numbers.pop(name) for name in ("rotor_rise", "rotor_fall", "delay"))
        p = Parameters.of(vehicle, voltage=voltage, **numbers)
        rows = []
        for part, (slow, change) in zip(parts, known, strict=True):
            target = commanded(part.record, vehicle, p)
            n = np.arange(len(slow))
            late = n - delay / period - 0.5  # a command that is held is half a period late in the mean
            target = np.stack([np.interp(late, n, column) for column in target.T], axis=1) * np.exp(x[len(start) :])
            left = slow + np.where(change > 0.0, rise, fall) * change
            rows.append((left - sosfiltfilt(low_pass, target, axis=0))[edge:-edge] / scale)
        return np.concatenate(rows)

    means = speeds[0].mean(axis=0) / commanded(record, vehicle, Parameters.of(vehicle, voltage=voltage)).mean(axis=0)
    x = np.array([*start.values(), *np.log(means)])
    held: dict[str, float] = {}
    scales = [0.01, 0.01, 0.005, *[0.3] * (len(x) - 3)]
    found: Any = least_squares(lambda x: errors(x).ravel(), x, x_scale=scales)
    if abs(found.x[2]) < period:  # a log does not tell when in a period a command comes
        held = {"delay": 0.0}
        found = least_squares(lambda x: errors(x).ravel(), found.x, x_scale=scales)
    e = errors(found.x)
    J = found.jac.reshape(len(e), N_ROTORS, -1)
    blocks = np.array_split(np.arange(len(e)), max(_FEWEST, round(len(e) * period / _BLOCK)))
    H = np.array([np.einsum("kri,krj->ij", J[of], J[of]) for of in blocks])
    g = np.array([np.einsum("kri,kr->i", J[of], e[of]) for of in blocks])
    H[:, 2, 2] += float("delay" in held)  # of which nothing depends on it
    left_out = np.stack([np.linalg.solve(H.sum(axis=0) - h, side) for h, side in zip(H, g, strict=True)])
    deviations = np.sqrt((len(blocks) - 1.0) * left_out.var(axis=0))
    deviations[2] = math.hypot(deviations[2], 0.25 * period)
    found.x[2] = held.get("delay", found.x[2])
    return {name: RotorResponse(float(found.x[i]), float(deviations[i]), len(blocks)) for i, name in enumerate(start)}


def foretold_speeds(part: Stretch, vehicle: Vehicle, voltage: float, response: Mapping[str, RotorResponse]) -> Array:
    """Speeds (N, 4) of a stretch by its commands and a response; in the mean those that were measured [rad/s]."""
    numbers = {name: of.value for name, of in response.items()}
    p = Parameters.of(vehicle, voltage=voltage, **numbers)
    commands = commanded(part.record, vehicle, p)
    rotors = lagging(commands, part.record.period, rise=p.rotor_rise, fall=p.rotor_fall, delay=p.delay)
    means = np.asarray(part.record.speeds).mean(axis=0)
    return np.asarray(rotors.speeds * means / rotors.speeds.mean(axis=0))
