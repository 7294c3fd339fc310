"""What a log shows of each parameter: its estimate with an interval, refused where it is not identifiable.

A number is identified if half its interval is at most 25 %, or an absolute width where it may be 0; if at most a
quarter of the information on it is prior; and if it makes a body.  `fit` has the first search judged, holds what is
refused, and has what a second search moves judged once more.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Final, NamedTuple

import numpy as np

from quadsim.features.identify.estimate import ParameterEstimate, field_of, number_in
from quadsim.features.identify.intervals import Intervals, student_quantile
from quadsim.features.identify.rotor_response import RotorResponse
from quadsim.features.identify.search import FLAT_BODY, Search
from quadsim.vehicle import VEHICLE_UNITS

WIDEST: Final = 0.25
"""Half-width of an interval, in logarithms, above which a log is said not to excite a parameter."""
MOST_PRIOR: Final = 0.25  # share of the information on a parameter that rules and start may give
MOST_WEIGHT_RESIDUAL: Final = 0.01  # share of the weight that thrust and drag may leave over, or carry too much
_WIDEST_STATED: Final = 1.1  # half-width above which a message states no number
_REPEATABLE: Final = 2.0  # times `WIDEST` that an interval may be for more of the same flight to help
_LARGEST_NEW_DEVIATION: Final = 0.5  # of the logarithm of a number that the start lacks, for it to count as identified

# What the prediction leaves out: standard deviations in units of the search.
_MODEL_ERROR: Final = 0.0015  # of a number without one of its own below
_GUST_ERROR: Final = 0.015  # of drag, by wind that changes faster than its knots
_GUST_TORQUE_ERROR: Final = 0.01  # of what torques show, by such wind where `rotor_moment` turns it into torque
# Of inertia: noise of the gyro shrinks what commands explain, by 0.5 % where it is loud.
_GYRO_NOISE_ERROR: Final = 0.004
_THROTTLE_ERROR_FACTOR: Final = 2.0  # how much more it leaves out where speeds follow from a throttle's curve
_FIRST_ORDER_ERROR: Final = 0.015  # of the rotors' response, as a share: what a first-order lag leaves out
# By held rows: per share of the rows in which a radio held what the log says of the rotors too, deviations of a lag
# that is searched for, of the response that measured speeds show, and of torques.
_HELD_LAG_ERROR: Final = 0.4
_HELD_RESPONSE_ERROR: Final = 0.15
_HELD_TORQUE_ERROR: Final = 0.08

_NOT_EXCITED: Final = "not excited"
_YAW_STEPS: Final = "yaw steps of 40 deg, one per second, for 10 s"
_TURNS: Final = "a figure eight with yaw steps, 20 s"
_FAST: Final = "a figure eight at 2 m/s or more, 20 s"
_CLIMBING: Final = "climbs and descents of 1 m/s while moving sideways at 2 m/s, 20 s"
_RISING: Final = "climbs and descents of 1 m/s, 20 s"
_LOG_SPEEDS: Final = "log the rotors' speeds too"


class _Gate(NamedTuple):
    """When a parameter counts as identified, and what to fly where it does not."""

    axes: tuple[str, ...]  # whose innovations show it
    advice: str  # what to fly to learn it
    unit: str = ""  # where the vehicle file has none
    model_error: float = _MODEL_ERROR
    widest: float | None = None  # half-width allowed in units of the search, where not in shares of the value


_TORQUE_AXES: Final = ("roll", "pitch", "yaw")
_GATES: Final = {
    "thrust_coefficient": _Gate(("vz",), "20 s in the air, climbing and sinking"),
    "inertia_x": _Gate(("roll",), "steps to the side or a figure eight, 20 s", "kg m^2", _GYRO_NOISE_ERROR),
    "inertia_y": _Gate(("pitch",), "steps forward or a figure eight, 20 s", "kg m^2", _GYRO_NOISE_ERROR),
    "inertia_z": _Gate(_TORQUE_AXES, _TURNS, "kg m^2", _GYRO_NOISE_ERROR),
    "drag_to_thrust": _Gate(("yaw",), _YAW_STEPS, model_error=_GYRO_NOISE_ERROR),
    "rotor_rise": _Gate(_TORQUE_AXES, _YAW_STEPS, model_error=2.0 * _GYRO_NOISE_ERROR),
    "rotor_fall": _Gate(_TORQUE_AXES, _YAW_STEPS, model_error=2.0 * _GYRO_NOISE_ERROR),
    "rotor_inertia": _Gate(("yaw",), _YAW_STEPS, model_error=_GYRO_NOISE_ERROR),
    "rotor_drag": _Gate(("vx", "vy"), _FAST, model_error=_GUST_ERROR),
    "inflow": _Gate(("vz",), _RISING, model_error=0.02, widest=1.0),
    "rotor_moment_x": _Gate(("roll",), _FAST, model_error=0.02, widest=0.5),
    "rotor_moment_y": _Gate(("pitch",), _FAST, model_error=0.02, widest=0.5),
    "inflow_moment_x": _Gate(("roll",), _CLIMBING, model_error=0.02, widest=1.0),
    "inflow_moment_y": _Gate(("pitch",), _CLIMBING, model_error=0.02, widest=1.0),
    "rate_damping_x": _Gate(("roll",), _TURNS, model_error=0.02, widest=4.0),
    "rate_damping_y": _Gate(("pitch",), _TURNS, model_error=0.02, widest=4.0),
    "rate_damping_z": _Gate(("yaw",), _TURNS, model_error=0.02, widest=4.0),
    "body_drag": _Gate(("vx", "vy"), "straight legs at the highest speed, there and back", model_error=_GUST_ERROR),
    "delay": _Gate(_TORQUE_AXES, _TURNS, "s", model_error=0.04, widest=2.0),
    "lateness": _Gate(_TORQUE_AXES, _TURNS, "s", widest=2.0),
    "offset_x": _Gate(("pitch",), "hover, 10 s", "m", model_error=0.1, widest=5.0),
    "offset_y": _Gate(("roll",), "hover, 10 s", "m", model_error=0.1, widest=5.0),
    "throttle_curve": _Gate(("vz",), "climbs and descents at full and little throttle", "-", widest=0.5),
    "voltage_exponent": _Gate(("vz",), "one flight from a full battery to an empty one", "-", widest=1.0),
}
_WIDEST_RESPONSE: Final = {"delay": 0.01, "throttle_curve": 0.15, "voltage_exponent": 0.5}
"""Half-width allowed of the rotors' response by measured speeds, where not in shares of the value."""
DAMPING: Final = ("rate_damping_x", "rate_damping_y", "rate_damping_z", "inflow")
"""Parameters that only slow a motion: none is below 0."""
_PER_FLIGHT: Final = ("delay", "lateness", "offset_x", "offset_y")
_SCALED_BY_SPEED: Final = (
    "thrust_coefficient",
    "rotor_inertia",
    "rotor_drag",
    "inflow",
    "rotor_moment_x",
    "rotor_moment_y",
)
"""Parameters that a log of the throttle alone shows only times a power of the rotors' highest speed."""


class JudgedFit:
    """What a search found, judged; of numbers that it held, what another found `before`.

    Args:
        search: that has run.
        response: the rotors' response, where the log has their speeds and their commands.
        before: the judgement of the search whose numbers this one held.
    """

    def __init__(self, search: Search, response: Mapping[str, RotorResponse], before: JudgedFit | None = None) -> None:
        self.search = search
        self.vehicle = search.vehicle
        self.intervals = Intervals(search)
        record = search.segments[0].record
        self.speeds_measured = record.speeds is not None
        self._throttle_only = record.speeds is None and record.commands is None
        self._gusts_turn = self._wind_makes_torque()
        self._rotors_unknown = max(segment.record.rotors_unknown for segment in search.segments)
        self.refitted: set[str] = set()
        """Numbers that are refused and yet estimated once more: where the log contradicts the start."""
        self.estimates = self._all_estimates(response)
        if before is not None:
            self.refitted |= before.refitted & {*search.fixed}
            for name in search.fixed:
                self.estimates[name] = before.estimates[name]
            self.estimates = _in_order(self.estimates)

    def held(self) -> dict[str, float]:
        """What the second search does not seek: numbers that a gate refuses, at what the file will say of them."""
        known = {*self.search.names, *self.search.fixed}
        held = dict(self.search.fixed)
        for name, estimate in self.estimates.items():
            if not estimate.refused or name in self.refitted:
                continue
            if name == "lateness":
                parameter = "delay"
            else:
                parameter = name
            value = 0.0
            if estimate.in_file:
                value = estimate.start or 0.0
            elif name == "throttle_curve":
                value = self.vehicle.throttle_share
            if parameter in known:
                held[parameter] = value
        return held

    def refuse_moved(self, refined: Search) -> dict[str, float]:
        """Judge the intervals that another search widened; return what is to be held since, as `held` does."""
        places = self._places()
        refused = {}
        _, moved = self.moved_to(refined)
        for name, estimate in moved.items():
            parameter = self.search.free[places[name][0]]
            middle = parameter.coordinate(estimate.value)
            half = max(abs(parameter.coordinate(end) - middle) for end in (estimate.low, estimate.high))
            fault = self._fault(name, places[name], half, estimate.value)
            if fault:
                refused[name] = replace(estimate, refused=fault, advice=_GATES[name].advice)
        if not refused:
            return {}
        self.estimates = self._judged_together(self.estimates | refused)
        return {name: value for name, value in self.held().items() if name not in refined.fixed}

    def moved_to(self, refined: Search) -> tuple[dict[str, float], dict[str, ParameterEstimate]]:
        """Values by what another search found, and the estimates that are not refused moved there."""
        numbers = _numbers_of(refined)
        values = dict(refined.fixed)
        for name, estimate in self.estimates.items():
            if name.startswith("rotor_") and not estimate.refused:
                values[name] = estimate.value
        of_estimates = {}
        for name in self.estimates:
            of_estimates[name] = numbers.get(self._searched_as(name), [])
            if len(of_estimates[name]) == 1:
                values[name] = float(f"{of_estimates[name][0]:.6g}")
        # Each within its interval, the three together may make no body.
        inertia = []
        for name in ("inertia_x", "inertia_y", "inertia_z"):
            inertia.append(values.get(name, number_in(self.vehicle, name) or 0.0))
        if not is_body(inertia):
            values["inertia_z"] = float(f"{FLAT_BODY * (inertia[0] + inertia[1]):.6g}")
        moved = {}
        for name, of_flights in of_estimates.items():
            estimate = self.estimates[name]
            if of_flights and not estimate.refused:
                moved[name] = _moved(estimate, values.get(name, float(np.mean(of_flights))))
        return values, moved

    def _searched_as(self, name: str) -> str:
        """The free parameter behind an estimate; a delay that measured speeds show is none."""
        if name == "lateness":
            return "delay"
        if name == "delay" and self.speeds_measured:
            return ""
        return name

    def _estimated_as(self, place: int) -> str:
        """The name of the estimate of a free parameter."""
        name = self.search.free[place].name
        if name == "delay" and self.speeds_measured:
            return "lateness"
        return name

    def _places(self) -> dict[str, list[int]]:
        """Where each parameter is in x: one place, or one for each flight."""
        places: dict[str, list[int]] = {}
        for place in range(len(self.search.free)):
            name = self._estimated_as(place)
            if name in _GATES:
                places.setdefault(name, []).append(place)
        return places

    def _half_width(self, shares: Mapping[int, float], axes: Sequence[str]) -> float:
        """Half of the interval of a sum of shares of x, by place, in units of the search."""
        return self.intervals.half_width(shares, axes, self._model_error([*shares], axes))

    def _model_error(self, places: Sequence[int], axes: Sequence[str]) -> float:
        """Deviation of a sum of numbers of x by what the prediction leaves out."""
        names = [self._estimated_as(place) for place in places]
        error = max(_GATES[name].model_error for name in names)
        if self._throttle_only:
            error *= _THROTTLE_ERROR_FACTOR
        logarithmic = all(self.search.free[place].scale is None for place in places)
        if not logarithmic or not {*axes} <= {*_TORQUE_AXES}:
            return error
        held_error = _HELD_TORQUE_ERROR
        if "rotor_rise" in names or "rotor_fall" in names:
            held_error = _HELD_LAG_ERROR
        gust_error = _GUST_TORQUE_ERROR if self._gusts_turn else 0.0
        return math.hypot(error, self._rotors_unknown * held_error, gust_error)

    def _wind_makes_torque(self) -> bool:
        """Whether there is wind and, by two standard deviations, a moment that it makes a torque of."""
        if "wind" not in self.search.names:
            return False
        deviations = np.sqrt(np.diag(self.intervals.covariance))
        for place, parameter in enumerate(self.search.free):
            if parameter.name.startswith("rotor_moment"):
                moment = parameter.value(self.search.x[place])
                if abs(moment) > 2.0 * deviations[place] * (parameter.scale or 0.0):
                    return True
        return False

    def _all_estimates(self, response: Mapping[str, RotorResponse]) -> dict[str, ParameterEstimate]:
        estimates = {}
        for name, places in self._places().items():
            estimates[name] = self._estimate(name, places)
        for name, number in response.items():
            estimates[name] = self._response_estimate(name, number)
        if "rotor_rise" not in estimates:
            fault = "the log has the rotors' speeds but not their commands"
            lag = self.vehicle.rotor_rise or 0.0
            for name in ("rotor_rise", "rotor_fall"):
                estimates[name] = self._judged(name, lag, (lag, lag), fault)
        return self._judged_together(estimates)

    def _estimate(self, name: str, places: Sequence[int]) -> ParameterEstimate:
        """One number, or the mean of those of each flight with an interval that holds each."""
        x = self.search.x[list(places)]
        parameter = self.search.free[places[0]]
        halves = np.array([self._half_width({place: 1.0}, _GATES[name].axes) for place in places])
        middle = float(np.average(x, weights=halves**-2.0))
        half = float(halves.min())
        if len(places) > 1:
            half = max(half, float(np.abs(x - middle).max()))
        elif self._contradicts_start(places[0]):
            self.refitted.add(name)
        value = parameter.value(middle)
        ends = (parameter.value(middle - half), parameter.value(middle + half))
        estimate = self._judged(name, value, ends, self._fault(name, places, half, value))
        if not WIDEST < half < _REPEATABLE * WIDEST or not estimate.refused.startswith(_NOT_EXCITED):
            return estimate
        needed = self.search.seconds * (half / WIDEST) ** 2
        return replace(estimate, advice=f"{estimate.advice}, or the same again, {needed:.0f} s in all")

    def _contradicts_start(self, place: int) -> bool:
        """Whether a number is two standard deviations, by the innovations' noise, away from the start's or from 0."""
        parameter = self.search.free[place]
        if parameter.name == "body_drag" or parameter.name in _PER_FLIGHT:
            return False
        deviation = math.sqrt(self.intervals.covariance[place, place])
        if parameter.scale is None and number_in(self.vehicle, parameter.name) is None:
            return deviation < _LARGEST_NEW_DEVIATION
        return abs(self.search.x[place]) > 2.0 * deviation

    def _fault(self, name: str, places: Sequence[int], half: float, value: float) -> str:
        """Why a number that is searched for is not identified, or nothing."""
        if name.startswith("inertia_") and not self.search.settled:
            return f"{_NOT_EXCITED}: the commands explain too little of the measured speeds"
        if name == "thrust_coefficient":
            residual = self._weight_residual()
            if abs(residual) > MOST_WEIGHT_RESIDUAL:
                return f"with it, {residual:.1%} of the weight is not carried, allowed {MOST_WEIGHT_RESIDUAL:.0%}"
        too_wide = _too_wide(name, self.search.free[places[0]].scale, half, value)
        if too_wide:
            return too_wide
        if name in DAMPING and value < 0.0:
            driven = "climb" if name == "inflow" else "turn"
            return f"below 0: it would drive the {driven}"
        if name == "body_drag" and self.vehicle.body_drag is None:
            return "its ratio along x, y and z is not known: give body_drag in the start file"
        prior_share = max(self.intervals.prior_shares[place] for place in places)
        if prior_share > MOST_PRIOR:
            return f"rests on a rule of thumb for {prior_share:.0%}, allowed {MOST_PRIOR:.0%}"
        return ""

    def _weight_residual(self) -> float:
        """Share of the weight that thrust and drag leave unbalanced, in the mean over all segments."""
        search = self.search
        lift_misfits = []
        for i in range(len(search.segments)):
            misfit, _ = search.misfit(search.x, i)
            lift_misfits.append(misfit[:, -1])
        mean = float(np.concatenate(lift_misfits).mean())
        return mean / (self.vehicle.gravity * search.segments[0].step)

    def _response_estimate(self, name: str, number: RotorResponse) -> ParameterEstimate:
        """A number of how the rotors respond, where the log has both speeds and commands."""
        value = number.value
        held_error = _HELD_RESPONSE_ERROR * self._rotors_unknown
        deviation = math.hypot(number.deviation, _FIRST_ORDER_ERROR * abs(value), held_error * abs(value))
        half = student_quantile(number.blocks) * deviation
        widest = _WIDEST_RESPONSE.get(name, math.expm1(WIDEST) * abs(value))
        fault = ""
        if half > widest:
            fault = f"{_NOT_EXCITED}: the interval is +-{half:.2g} {_unit_of(name)}, allowed {widest:.2g}"
        if name in ("rotor_rise", "rotor_fall") and value <= 0.0:
            fault = "no lag can be seen"
        return self._judged(name, value, (value - half, value + half), fault)

    def _judged(self, name: str, value: float, ends: tuple[float, float], fault: str) -> ParameterEstimate:
        """The estimate of a number, refused for a fault if there is one."""
        in_file = field_of(name) in VEHICLE_UNITS
        return ParameterEstimate(
            name=name,
            unit=_unit_of(name),
            value=value,
            low=min(ends),
            high=max(ends),
            start=number_in(self.vehicle, name) if in_file else None,
            refused=fault,
            advice=_GATES[name].advice if fault else "",
            in_file=in_file,
        )

    def _judged_together(self, estimates: dict[str, ParameterEstimate]) -> dict[str, ParameterEstimate]:
        """Refuse the numbers that are not identifiable without one that is refused."""

        def refuse(name: str, fault: str, advice: str) -> None:
            estimates[name] = replace(estimates[name], refused=fault, advice=advice)

        lags = [name for name in ("rotor_rise", "rotor_fall") if estimates[name].refused]
        if lags and not self.speeds_measured:
            unknown = " and ".join(lags)
            fault = f"{unknown} tell nothing, and no lag can be told from inertia without the rotors' speeds"
            for name in ("inertia_x", "inertia_y", "inertia_z"):
                if not estimates[name].refused:
                    refuse(name, fault, _LOG_SPEEDS)
        if self._throttle_only:
            highest = f"{self.vehicle.speed_max:g} rad/s"
            fault = f"a log of the throttle shows it only for the highest speed of {highest}, kept"
            for name in _SCALED_BY_SPEED:
                if name in estimates:  # it is not where it was held, as below 0
                    refuse(name, fault, _LOG_SPEEDS)
            self.refitted |= {*_SCALED_BY_SPEED}
        inertia = []
        for name in ("inertia_x", "inertia_y", "inertia_z"):
            estimate = estimates[name]
            inertia.append(estimate.start if estimate.refused and estimate.start else estimate.value)
        if not estimates["inertia_z"].refused and not is_body(inertia):
            fault = f"no body has it beside {inertia[0]:.4g} and {inertia[1]:.4g} about x and y"
            refuse("inertia_z", fault, _TURNS)
        if estimates["inertia_z"].refused and self._identifies_yaw_acceleration():
            fault = "only the yaw acceleration that it gives is identified, with inertia_z as kept"
            refuse("drag_to_thrust", fault, _TURNS)
            self.refitted.add("drag_to_thrust")
        return _in_order(estimates)

    def _identifies_yaw_acceleration(self) -> bool:
        """Whether d b / J_z, drag to thrust times thrust over inertia, is known where none of them may be."""
        exponents = {"drag_to_thrust": 1.0, "thrust_coefficient": 1.0, "inertia_z": -1.0}
        shares = {}
        for place, parameter in enumerate(self.search.free):
            if parameter.name in exponents:
                shares[place] = exponents[parameter.name]
        return self._half_width(shares, ("yaw",)) <= WIDEST


def is_body(inertia: Sequence[float]) -> bool:
    """Whether none of three moments of inertia exceeds the sum of the others."""
    return 2.0 * max(inertia) < sum(inertia)


def _in_order(estimates: Mapping[str, ParameterEstimate]) -> dict[str, ParameterEstimate]:
    """The estimates in the order of the gates."""
    return {name: estimates[name] for name in _GATES if name in estimates}


def _numbers_of(search: Search) -> dict[str, list[float]]:
    """What a search found or held, by name: one number, or one for each flight."""
    numbers: dict[str, list[float]] = {}
    for parameter, coordinate in zip(search.free, search.x, strict=False):
        numbers.setdefault(parameter.name, []).append(parameter.value(coordinate))
    for name, value in search.fixed.items():
        numbers.setdefault(name, [value])
    return numbers


def _moved(estimate: ParameterEstimate, value: float) -> ParameterEstimate:
    """What the second search found, its interval that of both: what they differ by is not known either."""
    move = value - estimate.value
    low = estimate.low + min(move, 0.0)
    high = estimate.high + max(move, 0.0)
    return replace(estimate, value=value, low=low, high=high)


def _unit_of(name: str) -> str:
    return _GATES[name].unit or VEHICLE_UNITS[field_of(name)]


def _too_wide(name: str, scale: float | None, half: float, value: float) -> str:
    """Why an interval of half a width, in units of the search, is too wide, or nothing."""
    widest = _GATES[name].widest
    if widest is not None and scale is not None:
        allowed = widest
        if name not in _PER_FLIGHT:
            allowed = max(widest, WIDEST * abs(value / scale))
        if half > allowed:
            width = f"{half * scale:.2g} {_unit_of(name)}"
            return f"{_NOT_EXCITED}: the interval is +-{width}, allowed {widest * scale:.2g}"
        return ""
    relative = half
    if scale is not None:
        relative = half * scale / abs(value)
    if relative > WIDEST:
        if relative < _WIDEST_STATED:
            width = f"+-{np.expm1(relative):.0%}"
        else:  # it may be too large for an exponential
            width = f"more than +-{np.expm1(_WIDEST_STATED):.0%}"
        return f"{_NOT_EXCITED}: the interval is {width}, allowed {np.expm1(WIDEST):.0%}"
    return ""
