"""The fit of flight logs: parameters, their intervals, and the gates that refuse what a log cannot tell.

Two searches follow one another.  The first finds every number and its interval; the second finds the numbers that pass
their gates once more, the others held at what the vehicle file will say of them, so that the file is one fit.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, Final, NamedTuple

import numpy as np
from scipy.stats import t as student

from quadsim.errors import InputError
from quadsim.features.identify.disturbance import with_disturbance
from quadsim.features.identify.estimate import (
    VECTORS,
    FlightNumbers,
    Identification,
    ParameterEstimate,
    field_of,
    number_in,
)
from quadsim.features.identify.model import INCREMENTS, mean_voltage, stretch
from quadsim.features.identify.record import Record, part_of
from quadsim.features.identify.rotor_response import RotorResponse, response_speeds, rotor_response
from quadsim.features.identify.search import DRAG_AREAS, FLAT_BODY, NormalEquations, Search
from quadsim.state import Array
from quadsim.vehicle import VEHICLE_UNITS, Vehicle

INTERVAL_SHARE: Final = 0.95
WIDEST: Final = 0.25
"""Half-width of an interval, in logarithms, above which a log is said not to excite a parameter."""
MOST_COLOUR: Final = 0.2  # autocorrelation of the innovations above which intervals widen [-]
CHANCE: Final = 3.7
"""The same times sqrt(N) that noise of N samples stays below in 99 %, at 8 lags of 6 axes: more than 0.2 if N < 342."""
MOST_PRIOR: Final = 0.25  # share of the information on a parameter that rules and start may give
UNCARRIED: Final = 0.01  # share of the weight that thrust and drag may leave over, or carry too much
_NORMAL: Final = 1.96  # standard deviations on either side, of a normal distribution
_LONGEST_LAG: Final = 0.2  # of the autocorrelation [s]
_YAW: Final = "yaw steps of 40 deg, one per second, for 10 s"
_GUSTS: Final = 0.015  # of drag, by wind that changes faster than its knots
_WIND_TORQUE_FLOOR: Final = 0.01  # of what torques show, by such wind where `rotor_moment` turns it into torque
# How much more the prediction leaves out where speeds follow from a throttle's curve.
_THROTTLE_FLOOR_FACTOR: Final = 2.0
# Of inertia: noise of the gyro shrinks what commands explain, by 0.5 % where it is loud.
_GYRO_NOISE_FLOOR: Final = 0.004
_LAG_UNKNOWN = 0.4
_ANSWER_UNKNOWN = 0.15
_TORQUE_UNKNOWN = 0.08
"""Of a lag that is searched for, of one that measured speeds show, and of torques: deviations per share of the rows in
which a radio held what the log says of the rotors too."""
_TURNS: Final = "a figure eight with yaw steps, 20 s"
_FAST: Final = "a figure eight at 2 m/s or more, 20 s"
_CLIMBING: Final = "climbs and descents of 1 m/s while moving sideways at 2 m/s, 20 s"
_RISING: Final = "climbs and descents of 1 m/s, 20 s"
_MEASURE: Final = "log the rotors' speeds too"


class _Kind(NamedTuple):
    """How a parameter is judged and learnt."""

    axes: tuple[str, ...]  # whose innovations show it
    advice: str  # what to fly to learn it
    unit: str = ""  # where the vehicle file has none
    floor: float = 0.0015  # standard deviation, in units of the search, of what the prediction leaves out
    widest: float | None = None  # half-width allowed in units of the search, where not in shares of the value


_KINDS: Final = {
    "thrust_coefficient": _Kind(("vz",), "20 s in the air, climbing and sinking"),
    "inertia_x": _Kind(("roll",), "steps to the side or a figure eight, 20 s", "kg m^2", floor=_GYRO_NOISE_FLOOR),
    "inertia_y": _Kind(("pitch",), "steps forward or a figure eight, 20 s", "kg m^2", floor=_GYRO_NOISE_FLOOR),
    "inertia_z": _Kind(("roll", "pitch", "yaw"), _TURNS, "kg m^2", floor=_GYRO_NOISE_FLOOR),
    "drag_to_thrust": _Kind(("yaw",), _YAW, floor=_GYRO_NOISE_FLOOR),
    "rotor_rise": _Kind(("roll", "pitch", "yaw"), _YAW, floor=2.0 * _GYRO_NOISE_FLOOR),
    "rotor_fall": _Kind(("roll", "pitch", "yaw"), _YAW, floor=2.0 * _GYRO_NOISE_FLOOR),
    "rotor_inertia": _Kind(("yaw",), _YAW, floor=_GYRO_NOISE_FLOOR),
    "rotor_drag": _Kind(("vx", "vy"), _FAST, floor=_GUSTS),
    "inflow": _Kind(("vz",), _RISING, floor=0.02, widest=1.0),
    "rotor_moment_x": _Kind(("roll",), _FAST, floor=0.02, widest=0.5),
    "rotor_moment_y": _Kind(("pitch",), _FAST, floor=0.02, widest=0.5),
    "inflow_moment_x": _Kind(("roll",), _CLIMBING, floor=0.02, widest=1.0),
    "inflow_moment_y": _Kind(("pitch",), _CLIMBING, floor=0.02, widest=1.0),
    **{
        f"rate_damping_{axis}": _Kind((of,), _TURNS, floor=0.02, widest=4.0)
        for axis, of in zip("xyz", INCREMENTS, strict=False)
    },
    "body_drag": _Kind(("vx", "vy"), "straight legs at the highest speed, there and back", floor=_GUSTS),
    "delay": _Kind(("roll", "pitch", "yaw"), _TURNS, "s", floor=0.04, widest=2.0),
    "lateness": _Kind(("roll", "pitch", "yaw"), _TURNS, "s", widest=2.0),
    "offset_x": _Kind(("pitch",), "hover, 10 s", "m", floor=0.1, widest=5.0),
    "offset_y": _Kind(("roll",), "hover, 10 s", "m", floor=0.1, widest=5.0),
    "throttle_curve": _Kind(("vz",), "climbs and descents at full and little throttle", "-", widest=0.5),
    "voltage_exponent": _Kind(("vz",), "one flight from a full battery to an empty one", "-", widest=1.0),
}
_ANSWERS: Final = 0.015  # deviation, as a share, of what a first-order lag leaves out
_WIDEST_ANSWER: Final = {"delay": 0.01, "throttle_curve": 0.15, "voltage_exponent": 0.5}
_DAMPING: Final = ("rate_damping_x", "rate_damping_y", "rate_damping_z", "inflow")
"""Parameters that only slow a motion: none is below 0."""
_PER_FLIGHT: Final = ("delay", "lateness", "offset_x", "offset_y")
_PER_SPEED: Final = (
    *("thrust_coefficient", "rotor_inertia", "rotor_drag", "inflow"),
    *("rotor_moment_x", "rotor_moment_y"),
)
"""Parameters that a log of the throttle alone shows only times a power of the rotors' highest speed."""


def identify_records(
    records: Sequence[Record], spans: Sequence[Sequence[slice]], vehicle: Vehicle, *, wind: bool = False
) -> Identification:
    """Identify a vehicle from the parts of records that fly; its mass, arms and layout are taken as they are.

    Args:
        records: logs of one vehicle.
        spans: of each, the parts that fly.
        vehicle: the start.
        wind: whether wind is sought where the position is logged; it always is where only a velocity is.

    Raises:
        InputError: nothing flies, or the records differ in what they say of rotors and battery.
        ParameterError: what was identified makes no vehicle, such as one that cannot hover.
    """
    flown = []
    for flight, (record, own) in enumerate(zip(records, spans, strict=True)):
        for span in own:
            flown.append(stretch(part_of(record, span), flight))
    if {part.flight for part in flown} != {*range(len(records))}:
        raise InputError("no part of the logs flies")
    if len({(record.speeds is None, record.commands is None, record.voltage is None) for record in records}) > 1:
        names = ", ".join(record.name for record in records)
        raise InputError(f"logs fitted together must have the same columns of rotors and battery; got {names}")
    blows = wind or any(record.position is None or record.inertial for record in records)  # or its velocity drifts

    response: Mapping[str, RotorResponse] = {}
    if records[0].speeds is not None and (records[0].commands is not None or records[0].throttle is not None):
        voltage = mean_voltage(flown)
        response = rotor_response(flown, vehicle, voltage)
        flown = [replace(part, instrument_speeds=response_speeds(part, vehicle, voltage, response)) for part in flown]

    def searched(fixed: Mapping[str, float], found: Search | None = None) -> Search:
        search = Search(flown, vehicle, wind=blows, fixed=fixed)
        if found is not None:
            search.adopt(found)
        search.run()
        return search

    search = searched({})
    fit = _Fit(search, response)
    while undamped := {name: 0.0 for name in _impossible(search) if name in _DAMPING}:
        search = searched({**search.fixed, **undamped}, search)  # negative damping would stand for lag
        fit = _Fit(search, response, fit)
    held = fit.held()
    refined = searched(held, search)
    while refused := _impossible(refined) | fit.refuse_what_moved(refined):
        held |= refused
        refined = searched(held, refined)
    return with_disturbance(fit.result(refined), refined, _quantile)


_WEAK: Final = "not excited"
_HOPELESS: Final = 1.1  # half-width above which its size is not told
_SHARED: Final = 0.02  # of what all flights say together, that is added to what one says alone
_NEARLY: Final = 2.0  # how much too wide an interval may be for more of the same flight to help


class _Fit:
    """What a search found, judged; of numbers that it held, what another found `before`."""

    def __init__(self, search: Search, response: Mapping[str, RotorResponse], before: _Fit | None = None) -> None:
        self.search = search
        self.vehicle = search.vehicle
        self.response = response
        blocks = search.blocks(instrumented=True)
        prior = search.prior(search.x)[1].H
        whole = _together(blocks, prior)
        H = whole.H
        self.cov = _covariance(whole)
        self.left_out = np.array([np.linalg.solve(H - block.H, block.g) for block in blocks])
        self.quantile = _quantile(len(blocks))
        self.rests = np.diag(self.cov) * np.diag(prior)
        self._by_flight = [_alone(flight, blocks, search, whole) for flight in range(search.flight_count)]
        record = search.parts[0].record
        self._blind = record.speeds is None  # to what the rotors do
        self._throttle = self._blind and record.commands is None
        self.colour = _colour(search)
        self.most_colour = max(MOST_COLOUR, CHANCE / min(map(len, search.innovations(search.x))) ** 0.5)
        self._blown = self._gusts_turn()
        self._rotors_unknown = max(part.record.rotors_unknown for part in search.parts)
        self.set_anew: set[str] = set()
        """Numbers that are refused and yet sought once more: where the log speaks against the start."""
        self.estimates = self._every_estimate()
        if before is not None:
            self.set_anew |= before.set_anew & {*search.fixed}
            known = self.estimates | {name: before.estimates[name] for name in search.fixed}
            self.estimates = {name: known[name] for name in _KINDS if name in known}

    def _half_width(self, shares: Mapping[int, float], axes: Sequence[str]) -> float:
        """Half of the interval of a sum of shares of x, in units of the search.

        It is of noise, wider where the innovations are coloured (Bartlett's variance of a mean); of the scatter by
        leaving out blocks; and of what the prediction leaves out, together.
        """
        row = np.zeros(len(self.search.x))
        row[[*shares]] = [*shares.values()]
        each = self.left_out @ row
        scatter = math.sqrt((len(each) - 1) * each.var())
        colour = max(self.colour[axis] for axis in axes)
        if colour > self.most_colour:
            widened = math.sqrt((1.0 + colour) / (1.0 - colour))
        else:
            widened = 1.0
        explained = math.sqrt(row @ self.cov @ row)
        beyond = math.hypot(scatter, self._floor(shares, axes), self._between_flights(row, widened))
        return math.hypot(_NORMAL * widened * explained, self.quantile * beyond)

    def _between_flights(self, row: Array, widened: float) -> float:
        """Deviation of a sum of x by what flights differ in beyond their noise."""
        each = np.array([step @ row for step, _ in self._by_flight])
        variances = np.array([row @ covariance @ row for _, covariance in self._by_flight])
        return deviation_between(each, widened**2 * variances)

    def _floor(self, shares: Mapping[int, float], axes: Sequence[str]) -> float:
        """Deviation of a sum of shares of x by what the prediction leaves out."""
        floor = max(_KINDS[self._kind(i)].floor for i in shares) * (_THROTTLE_FLOOR_FACTOR if self._throttle else 1.0)
        turns = {*axes} <= {"roll", "pitch", "yaw"} and all(self.search.free[i].scale is None for i in shares)
        if not turns:
            return floor
        lags = any(self._kind(i) in ("rotor_rise", "rotor_fall") for i in shares)
        unknown = self._rotors_unknown * (_LAG_UNKNOWN if lags else _TORQUE_UNKNOWN)
        return math.hypot(floor, unknown, _WIND_TORQUE_FLOOR if self._blown else 0.0)

    def _gusts_turn(self) -> bool:
        """Whether there is wind and, by two standard deviations, a moment that it makes a torque of."""
        sought = self.search.free
        deviations = np.sqrt(np.diag(self.cov))
        moments = [i for i, number in enumerate(sought) if number.name.startswith("rotor_moment")]
        blows = any(number.name == "wind" for number in sought)
        return blows and any(
            abs(sought[i].value(self.search.x[i])) > 2.0 * deviations[i] * (sought[i].scale or 0.0) for i in moments
        )

    def _kind(self, i: int) -> str:
        name = self.search.free[i].name
        if name == "delay" and not self._blind:
            return "lateness"
        return name

    def _every_estimate(self) -> dict[str, ParameterEstimate]:
        found = {name: self._estimate(name, at) for name, at in self._places().items()}
        if self.response:
            found |= self._response()
        elif "rotor_rise" not in found:
            why = "the log has the rotors' speeds but not their commands"
            lag = self.vehicle.rotor_rise or 0.0
            found |= {name: self._judged(name, lag, lag, lag, why) for name in ("rotor_rise", "rotor_fall")}
        return self._judged_together(found)

    def _places(self) -> dict[str, list[int]]:
        """Where each parameter is in x: one place, or one for each flight."""
        places: dict[str, list[int]] = {}
        for i in range(len(self.search.free)):
            if self._kind(i) in _KINDS:
                places.setdefault(self._kind(i), []).append(i)
        return places

    def _judged_together(self, found: dict[str, ParameterEstimate]) -> dict[str, ParameterEstimate]:
        """Refuse what cannot be told without a number that is refused."""
        lags = [name for name in ("rotor_rise", "rotor_fall") if found[name].refused]
        if lags and self._blind:
            why = f"{' and '.join(lags)} tell nothing, and no lag can be told from inertia without the rotors' speeds"
            found |= {
                name: replace(found[name], refused=why, advice=_MEASURE)
                for name in ("inertia_x", "inertia_y", "inertia_z")
                if not found[name].refused
            }
        if self._throttle:
            why = f"a log of the throttle shows it only for the highest speed of {self.vehicle.speed_max:g} rad/s, kept"
            for name in _PER_SPEED:
                if name in found:  # it is not where it was held, as below 0
                    found[name] = replace(found[name], refused=why, advice=_MEASURE)
        inertia = [found[f"inertia_{axis}"] for axis in "xyz"]
        used = [e.start if e.refused and e.start else e.value for e in inertia]
        if not inertia[2].refused and not _is_body(used):
            why = f"no body has it beside {used[0]:.4g} and {used[1]:.4g} about x and y"
            found["inertia_z"] = replace(inertia[2], refused=why, advice=_TURNS)
        if found["inertia_z"].refused and self._turns_by_a_known_amount():
            why = "only the yaw acceleration that it gives is identified, with inertia_z as kept"
            found["drag_to_thrust"] = replace(found["drag_to_thrust"], refused=why, advice=_TURNS)
            self.set_anew |= {"drag_to_thrust"}
        self.set_anew |= {*_PER_SPEED} if self._throttle else set()
        return {name: found[name] for name in _KINDS if name in found}

    def _response(self) -> dict[str, ParameterEstimate]:
        """How the rotors answer, where the log has both speeds and commands."""
        found = {}
        for name, response in self.response.items():
            kind = _KINDS[name]
            value = response.value
            unknown = _ANSWER_UNKNOWN * self._rotors_unknown
            spread = math.hypot(response.deviation, _ANSWERS * abs(value), unknown * abs(value))
            half = _quantile(response.blocks) * spread
            widest = _WIDEST_ANSWER.get(name, math.expm1(WIDEST) * abs(value))
            unit = kind.unit or VEHICLE_UNITS[name]
            if half > widest:
                why = f"{_WEAK}: the interval is +-{half:.2g} {unit}, allowed {widest:.2g}"
            else:
                why = ""
            if name in ("rotor_rise", "rotor_fall") and value <= 0.0:
                why = "no lag can be seen"
            found[name] = self._judged(name, value, value - half, value + half, why)
        return found

    def _turns_by_a_known_amount(self) -> bool:
        shares = {"drag_to_thrust": 1.0, "thrust_coefficient": 1.0, "inertia_z": -1.0}
        sought = {}
        for i, number in enumerate(self.search.free):
            if number.name in shares:
                sought[i] = shares[number.name]
        return self._half_width(sought, ("yaw",)) <= WIDEST

    def _estimate(self, name: str, places: Sequence[int]) -> ParameterEstimate:
        """One number, or the mean of those of each flight with an interval that holds each."""
        search = self.search
        kind = _KINDS[name]
        x = search.x[list(places)]
        number = search.free[places[0]]
        if len(places) == 1 and self._speaks_against_the_start(places[0]):
            self.set_anew.add(name)
        halves = np.array([self._half_width({i: 1.0}, kind.axes) for i in places])
        middle = float(np.average(x, weights=halves**-2.0))
        if len(places) == 1:
            half = float(halves.min())
        else:
            half = max(float(halves.min()), float(np.abs(x - middle).max()))
        value = number.value(middle)
        found = self._judged(
            name, value, number.value(middle - half), number.value(middle + half), self._weak(name, places, half, value)
        )
        if not WIDEST < half < _NEARLY * WIDEST or not found.refused.startswith(_WEAK):
            return found
        flown = sum(part.seconds for part in self.search.parts)
        return replace(found, advice=f"{found.advice}, or the same again, {flown * (half / WIDEST) ** 2:.0f} s in all")

    def _speaks_against_the_start(self, i: int) -> bool:
        """Whether a number is two standard deviations of what the innovations explain from the start's, or from 0."""
        number = self.search.free[i]
        deviation = math.sqrt(self.cov[i, i])
        if number.name in ("body_drag", *_PER_FLIGHT):
            return False
        absent = number.scale is None and number_in(self.vehicle, number.name) is None
        if absent:
            return deviation < 0.5
        return abs(self.search.x[i]) > 2.0 * deviation

    def _weak(self, name: str, places: Sequence[int], half: float, value: float) -> str:
        """Why a number that is searched for tells nothing, or nothing."""
        number = self.search.free[places[0]]
        kind = _KINDS[name]
        scale = number.scale
        if name.startswith("inertia_") and not self.search.settled:
            return f"{_WEAK}: the commands explain too little of the measured speeds"
        if name == "thrust_coefficient" and abs(left := self._uncarried()) > UNCARRIED:
            return f"with it, {left:.1%} of the weight is not carried, allowed {UNCARRIED:.0%}"
        if kind.widest is not None and scale is not None:
            if half > max(kind.widest, WIDEST * abs(value / scale) if name not in _PER_FLIGHT else 0.0):
                unit = kind.unit or VEHICLE_UNITS[field_of(name)]
                return f"{_WEAK}: the interval is +-{half * scale:.2g} {unit}, allowed {kind.widest * scale:.2g}"
        elif (relative := half if scale is None else half * scale / abs(value)) > WIDEST:
            return _not_excited(relative)
        if name in _DAMPING and value < 0.0:
            return f"below 0: it would drive the {'climb' if name == 'inflow' else 'turn'}"
        if name == "body_drag" and self.vehicle.body_drag is None:
            return "its ratio along x, y and z is not known: give body_drag in the start file"
        rests = max(self.rests[i] for i in places)
        if rests <= MOST_PRIOR:
            return ""
        return f"rests on a rule of thumb for {rests:.0%}, allowed {MOST_PRIOR:.0%}"

    def _uncarried(self) -> float:
        """Share of the weight that neither thrust nor drag carry, in the mean over all stretches."""
        search = self.search
        left = np.concatenate([search.misfit(search.x, i)[0][:, -1] for i in range(len(search.parts))])
        return float(left.mean()) / (self.vehicle.gravity * search.parts[0].step)

    def _judged(self, name: str, value: float, low: float, high: float, refused: str) -> ParameterEstimate:
        field = field_of(name)
        estimate = ParameterEstimate(
            name=name,
            unit=_KINDS[name].unit or VEHICLE_UNITS[field],
            value=value,
            low=min(low, high),
            high=max(low, high),
            start=None,
            refused=refused,
            advice=_KINDS[name].advice if refused else "",
            in_file=field in VEHICLE_UNITS,
        )
        return replace(estimate, start=number_in(self.vehicle, name) if estimate.in_file else None)

    def held(self) -> dict[str, float]:
        """What the second search does not seek: numbers that a gate refuses, at what the file will say of them."""
        refused = {name: e for name, e in self.estimates.items() if e.refused and name not in self.set_anew}
        held = {name: estimate.start or 0.0 for name, estimate in refused.items() if estimate.in_file}
        held |= {name: 0.0 for name in refused if name in ("offset_x", "offset_y")}
        held |= {"delay": 0.0} if {"delay", "lateness"} & {*refused} else {}
        held |= {"throttle_curve": self.vehicle.throttle_share} if "throttle_curve" in refused else {}
        held |= {"voltage_exponent": 0.0} if "voltage_exponent" in refused else {}
        known = {number.name for number in self.search.free} | {*self.search.fixed}
        return {**self.search.fixed} | {name: held[name] for name in held if name in known}

    def _moved_to(self, refined: Search) -> tuple[dict[str, float], dict[str, ParameterEstimate]]:
        """Values by what another search found, and the estimates that are not refused moved there."""
        numbers: dict[str, list[float]] = {}
        for number, value in zip(refined.free, refined.x, strict=False):
            numbers.setdefault(number.name, []).append(number.value(value))
        for name, value in refined.fixed.items():
            numbers.setdefault(name, [value])
        values = dict(refined.fixed)
        values |= {name: e.value for name, e in self.estimates.items() if name.startswith("rotor_") and not e.refused}
        found = {}
        for name in self.estimates:
            known = name == "lateness" or (name == "delay" and not self._blind)
            if name == "lateness":
                found[name] = numbers.get("delay", [])
            elif known:
                found[name] = []
            else:
                found[name] = numbers.get(name, [])
            if len(found[name]) == 1:
                values[name] = float(f"{found[name][0]:.6g}")
        # Each within its interval, the three together may make no body.
        inertia = []
        for axis in "xyz":
            inertia.append(values.get(f"inertia_{axis}", number_in(self.vehicle, f"inertia_{axis}") or 0.0))
        if not _is_body(inertia):
            values["inertia_z"] = float(f"{FLAT_BODY * (inertia[0] + inertia[1]):.6g}")
        moved = {}
        for name, each in found.items():
            if each and not self.estimates[name].refused:
                moved[name] = _moved(self.estimates[name], values.get(name, float(np.mean(each))))
        return values, moved

    def refuse_what_moved(self, refined: Search) -> dict[str, float]:
        """Judge the intervals that another search widened; return what is to be held since, as `held` does."""
        places = self._places()
        refused = {}
        for name, estimate in self._moved_to(refined)[1].items():
            number = self.search.free[places[name][0]]
            middle = number.coordinate(estimate.value)
            half = max(abs(number.coordinate(end) - middle) for end in (estimate.low, estimate.high))
            if why := self._weak(name, places[name], half, estimate.value):
                refused[name] = replace(estimate, refused=why, advice=_KINDS[name].advice)
        if not refused:
            return {}
        self.estimates = self._judged_together(self.estimates | refused)
        return {name: value for name, value in self.held().items() if name not in refined.fixed}

    def result(self, refined: Search) -> Identification:
        """Every estimate, and the vehicle with those that are not refused."""
        first = refined.parameters(refined.x, 0)
        values, moved = self._moved_to(refined)
        estimates = {**self.estimates, **moved}.values()
        flights = tuple(self._numbers_of(refined, flight) for flight in range(refined.flight_count))
        delay, offset, wind = (np.mean([numbers[i] for numbers in flights], axis=0).tolist() for i in range(3))
        return Identification(
            estimates=tuple(estimates),
            vehicle=self._assembled(values),
            delay=delay,
            offset=tuple(offset),
            wind=tuple(wind),
            flights=flights,
            throttle_curve=self._answer("throttle_curve", first.throttle_curve),
            voltage_exponent=self._answer("voltage_exponent", first.voltage_exponent),
            voltage=refined.voltage or None,
            yaw_trim=first.yaw_trim,
            whiteness=self.colour,
        )

    def _answer(self, name: str, sought: float) -> float:
        """A number of the response to throttle and voltage, where the log has measured speeds too."""
        estimate = self.estimates.get(name)
        if self._blind or estimate is None or estimate.refused:
            return sought
        return estimate.value

    def _numbers_of(self, refined: Search, flight: int) -> FlightNumbers:
        places = [i for i, part in enumerate(refined.parts) if part.flight == flight]
        each = [refined.parameters(refined.x, i) for i in places]
        wind = np.mean([p.wind.mean(axis=0) for p in each], axis=0)
        return FlightNumbers(each[0].delay, tuple(each[0].offset.tolist()), tuple(wind.tolist()))

    def _assembled(self, values: Mapping[str, float]) -> Vehicle:
        """The start's vehicle with other values; a vector that the start lacks is there if a number of it is known."""
        known = {name for name, e in self.estimates.items() if e.in_file and (not e.refused or name in self.set_anew)}
        known |= {"inertia_z"}  # which may have to suit the others
        changes: dict[str, Any] = {
            name: values[name] for name in known if name in VEHICLE_UNITS and name != "body_drag" and name in values
        }
        for name, axes in VECTORS.items():
            if known & {*(of := [f"{name}_{axis}" for axis in axes])}:
                changes[name] = tuple(values.get(one, number_in(self.vehicle, one) or 0.0) for one in of)
        if "body_drag" in known:
            ratio: Array = np.array(self.vehicle.body_drag or DRAG_AREAS)
            changes["body_drag"] = tuple((values["body_drag"] * ratio / ratio[0]).tolist())
        if "thrust_coefficient" in changes:
            changes |= {"thrust_of_speed": None, "thrust_of_throttle": None}
        return replace(self.vehicle, **changes)


def _impossible(search: Search) -> dict[str, float]:
    """Numbers that were found and make no vehicle, with what takes their place: they are to be held at it."""
    p = search.parameters(search.x, 0)
    sought = {number.name for number in search.free}
    held = {}
    for axis, value in zip("xyz", p.rate_damping, strict=True):
        if value < 0.0:
            held[f"rate_damping_{axis}"] = 0.0
    if p.inflow < 0.0:
        held["inflow"] = 0.0
    held = {name: value for name, value in held.items() if name in sought}
    inertia = p.inertia.tolist()
    if not _is_body(inertia) and search.fixed.get("inertia_z") != (flat := FLAT_BODY * (inertia[0] + inertia[1])):
        held["inertia_z"] = flat
    return held


def _moved(estimate: ParameterEstimate, value: float) -> ParameterEstimate:
    """What the second search found, its interval that of both: what they differ by is not known either."""
    moved = value - estimate.value
    low = estimate.low + min(moved, 0.0)
    high = estimate.high + max(moved, 0.0)
    return replace(estimate, value=value, low=low, high=high)


def _together(blocks: Sequence[NormalEquations], prior: Array) -> NormalEquations:
    """All blocks and the priors' information as one."""
    H, g, S = (np.sum(each, axis=0) for each in zip(*blocks, strict=True))
    return NormalEquations(H + prior, g, S + prior)


def _covariance(equations: NormalEquations) -> Array:
    """Covariance of x: H^-1 S H^-T, H^-1 without instruments."""
    inverse = np.linalg.inv(equations.H)
    return np.asarray(inverse @ equations.S @ inverse.T)


def deviation_between(each: Array, variances: Array) -> float:
    """Return the deviation of the weighted mean of some flights' values by what they differ in beyond their noise.

    The variance between flights is that of DerSimonian and Laird, "Meta-analysis in clinical trials", Controlled
    Clinical Trials 7 (1986): (sum w d^2 - (F - 1)) / (sum w - sum w^2 / sum w), w = 1 / variance, 0 at least.

    Args:
        each: value of each flight (F,).
        variances: of their noise (F,).
    """
    if len(each) < 2:
        return 0.0
    weights = 1.0 / variances
    total = float(weights.sum())
    apart = each - float(weights @ each) / total
    excess = float(weights @ apart**2) - (len(each) - 1)
    between = max(excess, 0.0) / (total - float(weights @ weights) / total)
    return math.sqrt(between * float(weights @ weights)) / total


def _alone(
    flight: int, blocks: Sequence[NormalEquations], search: Search, whole: NormalEquations
) -> tuple[Array, Array]:
    """How far a flight alone would move x from what all flights gave together, and its covariance."""
    own = [block for block, of in zip(blocks, search.flight_of_blocks(), strict=True) if of == flight]
    alone = _together(own, _SHARED * whole.H)
    alone = alone._replace(S=alone.S + _SHARED * (whole.S - whole.H))
    return np.asarray(-np.linalg.solve(alone.H, alone.g)), _covariance(alone)


def _is_body(inertia: Sequence[float]) -> bool:
    """Whether none of three moments of inertia exceeds the sum of the others."""
    return 2.0 * max(inertia) < sum(inertia)


def _quantile(blocks: int) -> float:
    """Student's, two-sided."""
    return float(student.ppf(0.5 + 0.5 * INTERVAL_SHARE, max(blocks - 1, 1)))


def _not_excited(half: float) -> str:
    if half < _HOPELESS:
        width = f"+-{np.expm1(half):.0%}"
    else:
        width = f"more than +-{np.expm1(_HOPELESS):.0%}"
    return f"{_WEAK}: the interval is {width}, allowed {np.expm1(WIDEST):.0%}"


def _colour(search: Search) -> dict[str, float]:
    """Largest |autocorrelation| of each axis's innovations at lags up to `_LONGEST_LAG`."""
    colour = np.zeros(len(INCREMENTS))
    for part, innovations in zip(search.parts, search.innovations(search.x), strict=True):
        e = innovations - innovations.mean(axis=0)
        for lag in range(1, 1 + max(1, round(_LONGEST_LAG / part.step))):
            colour = np.maximum(colour, np.abs((e[lag:] * e[:-lag]).mean(axis=0)) / (e**2).mean(axis=0))
    return dict(zip(INCREMENTS, np.minimum(colour, 0.99).tolist(), strict=True))
