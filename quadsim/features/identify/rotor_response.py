"""How rotors respond to their commands: lag, delay, throttle curve and voltage, from the speeds that were measured.

w + tau dw/dt = w_target(u, V), tau that of rising or falling speed, with both sides below `CORNER`: a log that has the
commands less often than they are sent shows what is faster than it at a wrong frequency.  Least squares of its own,
before the search: the speeds by this response are the search's instruments.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, Final, NamedTuple

import numpy as np
from scipy.optimize import least_squares
from scipy.signal import butter, sosfiltfilt

from quadsim.features.identify.model import Parameters, Segment, demanded_speeds, voltages
from quadsim.features.identify.rotors import lagged_rotors, start_lag
from quadsim.features.identify.search import MIN_BLOCKS, SHORTEST_BLOCK
from quadsim.features.identify.series import interpolated
from quadsim.state import Array
from quadsim.vehicle import N_ROTORS, Vehicle

CORNER: Final = 6.0  # [Hz], a tenth of the log's rate if that is less
_EDGE: Final = 0.5  # [s] at the ends of a segment that the filter disturbs
_LEAST_SAG: Final = 0.005  # share of the voltage that it must change by to show what it does
_DELAY: Final = 2  # place of the delay in x, behind the two lags
_PERIOD_DEVIATION: Final = 0.25  # of the delay, in periods: a log does not show when in a period a command comes


class RotorResponse(NamedTuple):
    """A number of the rotors' response, and its deviation by leaving out blocks."""

    value: float
    deviation: float
    blocks: int


def rotor_response(segments: Sequence[Segment], vehicle: Vehicle, voltage: float) -> dict[str, RotorResponse]:
    """Fit the measured speeds of all segments by the commands or the throttle.

    Args:
        segments: segments with measured speeds and commands or throttle.
        vehicle: the start.
        voltage: at which the throttle curve holds [V].

    Returns:
        `rotor_rise`, `rotor_fall` and `delay` [s], and where the log shows them, `throttle_curve` and
        `voltage_exponent`.
    """
    period = segments[0].record.period
    fit = _ResponseFit(segments, vehicle, voltage)
    x = np.array([*fit.start.values(), *fit.log_speed_ratios()])
    scales = [0.01, 0.01, 0.005, *[0.3] * (len(x) - 3)]
    solution: Any = least_squares(lambda x: fit.errors(x).ravel(), x, x_scale=scales)
    if abs(solution.x[_DELAY]) < period:
        fit.held = {"delay": 0.0}
        solution = least_squares(lambda x: fit.errors(x).ravel(), solution.x, x_scale=scales)
    e = fit.errors(solution.x)
    J = solution.jac.reshape(len(e), N_ROTORS, -1)
    blocks = np.array_split(np.arange(len(e)), max(MIN_BLOCKS, round(len(e) * period / SHORTEST_BLOCK)))
    H = np.array([np.einsum("kri,krj->ij", J[rows], J[rows]) for rows in blocks])
    g = np.array([np.einsum("kri,kr->i", J[rows], e[rows]) for rows in blocks])
    H[:, _DELAY, _DELAY] += float("delay" in fit.held)  # on which nothing depends then
    total = H.sum(axis=0)
    left_out = np.stack([np.linalg.solve(total - h, side) for h, side in zip(H, g, strict=True)])
    deviations = np.sqrt((len(blocks) - 1.0) * left_out.var(axis=0))
    deviations[_DELAY] = math.hypot(deviations[_DELAY], _PERIOD_DEVIATION * period)
    solution.x[_DELAY] = fit.held.get("delay", solution.x[_DELAY])
    response = {}
    for i, name in enumerate(fit.start):
        response[name] = RotorResponse(float(solution.x[i]), float(deviations[i]), len(blocks))
    return response


class _ResponseFit:
    """The errors of the response's equation: x is what `start` names, then log of each rotor's speed over its command.

    Args:
        segments: segments with measured speeds and commands or throttle.
        vehicle: the start.
        voltage: at which the throttle curve holds [V].
    """

    def __init__(self, segments: Sequence[Segment], vehicle: Vehicle, voltage: float) -> None:
        record = segments[0].record
        self.segments = segments
        self.vehicle = vehicle
        self.voltage = voltage
        self.period = record.period
        self.held: dict[str, float] = {}
        lag = start_lag(vehicle)
        self.start = {"rotor_rise": lag, "rotor_fall": lag, "delay": 0.0}
        if record.commands is None:
            self.start["throttle_curve"] = vehicle.throttle_share
        logged = voltages(segments)
        if logged.size and np.ptp(logged) > _LEAST_SAG * voltage:
            self.start["voltage_exponent"] = 1.0
        self._low_pass = butter(2, min(CORNER, 0.1 / self.period), fs=1.0 / self.period, output="sos")
        self._speeds = [np.asarray(segment.record.speeds) for segment in segments]
        self._scale = float(np.mean(np.concatenate(self._speeds)))
        self._slow = []  # (N, 4) of each segment: the speeds below the corner, and their slope
        for speeds in self._speeds:
            slow = sosfiltfilt(self._low_pass, speeds, axis=0)
            self._slow.append((slow, np.gradient(slow, self.period, axis=0)))

    def log_speed_ratios(self) -> Array:
        """(4,) logarithm of each rotor's mean speed over its mean command, in the first segment."""
        parameters = Parameters.of(self.vehicle, voltage=self.voltage)
        commands = demanded_speeds(self.segments[0].record, self.vehicle, parameters)
        return np.asarray(np.log(self._speeds[0].mean(axis=0) / commands.mean(axis=0)))

    def errors(self, x: Array) -> Array:
        """(K, 4) left side less right side of all segments, over the mean speed."""
        numbers = dict(zip(self.start, x, strict=False)) | self.held
        rise = numbers.pop("rotor_rise")
        fall = numbers.pop("rotor_fall")
        delay = numbers.pop("delay")
        parameters = Parameters.of(self.vehicle, voltage=self.voltage, **numbers)
        ratios = np.exp(x[len(self.start) :])
        edge = round(_EDGE / self.period)
        rows = []
        for segment, (slow, change) in zip(self.segments, self._slow, strict=True):
            samples = np.arange(len(slow))
            late = samples - delay / self.period - 0.5  # a command that is held is half a period late in the mean
            commands = demanded_speeds(segment.record, self.vehicle, parameters)
            target = interpolated(late, samples, commands) * ratios
            left = slow + np.where(change > 0.0, rise, fall) * change
            error = left - sosfiltfilt(self._low_pass, target, axis=0)
            rows.append(error[edge:-edge] / self._scale)
        return np.concatenate(rows)


def response_speeds(segment: Segment, vehicle: Vehicle, voltage: float, response: Mapping[str, RotorResponse]) -> Array:
    """Speeds (N, 4) of a segment by its commands and a response; in the mean those that were measured [rad/s]."""
    numbers = {name: number.value for name, number in response.items()}
    p = Parameters.of(vehicle, voltage=voltage, **numbers)
    commands = demanded_speeds(segment.record, vehicle, p)
    rotors = lagged_rotors(commands, segment.record.period, rise=p.rotor_rise, fall=p.rotor_fall, delay=p.delay)
    means = np.asarray(segment.record.speeds).mean(axis=0)
    return np.asarray(rotors.speeds * means / rotors.speeds.mean(axis=0))
