"""The search for the parameters, by the errors e of a Kalman filter's predictions, axis by axis: the likeliest ones.

What a flight measures of an axis from sample to sample, less what the parameters predict, is a coloured noise d: white
and slow torques or forces, and differences of the sensor's noise.  Its innovations are e = A(z) / C(z) d, A and C of
second order and stable.  Parameters, A and C are those of the least sum over axes of N log(sum e^2) (Ljung, "System
Identification", 2nd ed., Sec. 7.2).  `fit` runs it and judges what it finds.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Final, NamedTuple

import numpy as np
from scipy.signal import lfilter

from quadsim.features.identify.estimate import VECTORS, field_of, number_in
from quadsim.features.identify.model import (
    INCREMENTS,
    Parameters,
    Segment,
    mean_voltage,
    predicted_increments,
    rotor_motion,
)
from quadsim.features.identify.record import Record
from quadsim.features.identify.rotors import RotorMotion, measured_rotors, start_lag
from quadsim.fields import floor_of
from quadsim.state import Array, Indices
from quadsim.vehicle import LARGEST, VEHICLE_UNITS, Vehicle

SETTLING: Final = 0.5  # time [s] after a segment begins until the rotor speeds assumed there have decayed
LONGEST_FORCE: Final = 2.0
"""Time [s] that an unknown force lasts: one that may last for ever would carry the weight in the thrust's place."""
LIFT_DEVIATION: Final = 0.002
"""Standard deviation of the mean lift over a log that is not the rotors' or drag, over the weight [-]."""
SHORTEST_BLOCK: Final = 3.0  # shortest part of a log that is left out in turn [s]
MIN_BLOCKS: Final = 6  # shorter ones of a log of less than 18 s: of 2, Student's t makes intervals useless
_MAX_BLOCKS: Final = 20
FLAT_BODY: Final = 0.87
"""Inertia_z over inertia_x + inertia_y of a typical quadrotor; of a plate it is 1."""
FLAT_BODY_DEVIATION: Final = 0.12  # standard deviation of its logarithm
DRAG_AREAS: Final = (1.0, 1.0, 2.0)  # along x, y, z to each other, where the start has none
_LAG_RATIO_DEVIATION: Final = 0.5  # standard deviation of log(rise / fall)

_KNOT_SPACING: Final = 0.5  # time between two instants of the wind [s], where `_MAX_KNOTS` allow
_MAX_KNOTS: Final = 120  # of all segments
_WIND_DEVIATION: Final = (2.0, 2.0, 0.7)  # standard deviation of the mean wind of a segment, world axes [m/s]
_WIND_CHANGE: Final = 0.2  # standard deviation of its change in one second, over that of the mean

_ORDER: Final = 2  # of A and C
_FIRST_REFLECTIONS: Final = (1.0, 0.0, -1.5, 0.5)  # reflection coefficients of A and C, before tanh
_REFLECTION_DEVIATION: Final = 3.0  # standard deviation of their priors
_FIRST_ERROR_DEVIATION: Final = 4.0  # the same of the error of a segment's first sample, in sigma

# of the search: its steps, how often and how far each is shortened, and the likelihood's gain that ends it
_MAX_STEPS: Final = 60
_MAX_TRIES: Final = 8
_LONGEST_STEP: Final = 0.6
_LEAST_GAIN: Final = 5e-3
# of the search with instruments, whose last step of the inertia is shorter than `_SETTLED`
_MAX_NEWTON_STEPS: Final = 30
_LONGEST_NEWTON_STEP: Final = 0.5
_SETTLED: Final = 2e-3
# for slopes by differences: steps of a logarithm, of a number over its scale, and of a number of the noise model
_LOG_STEP: Final = 1e-4
_SCALED_STEP: Final = 1e-2
_NOISE_STEP: Final = 1e-4
_ROTOR_PARAMETERS: Final = ("rotor_rise", "rotor_fall", "delay", "throttle_curve", "voltage_exponent")
"""Parameters that the rotors' speeds depend on."""


class FreeParameter(NamedTuple):
    """A number that is searched for by its x: start exp(x) where it is positive by nature, else start + scale x."""

    name: str
    start: float
    scale: float | None  # None for the logarithm
    deviation: float | None  # of the prior, in units of x; None without
    flight: int | None = None  # whose own it is; None for one of the vehicle
    segment: int | None = None  # of the segment whose own it is

    def value(self, x: float) -> float:
        """The number itself; one that is positive by nature stays within what a vehicle's numbers may be."""
        if self.scale is not None:
            return float(self.start + self.scale * x)
        least = floor_of(VEHICLE_UNITS[field_of(self.name)])
        within = np.clip(x, math.log(least / self.start), math.log(LARGEST / self.start))
        return float(self.start * np.exp(within))

    def coordinate(self, value: float) -> float:
        """The x of a value: the inverse of `value`."""
        if self.scale is None:
            return math.log(value / self.start)
        return (value - self.start) / self.scale


def _free_parameters(vehicle: Vehicle, segments: Sequence[Segment], *, wind: bool) -> Iterator[FreeParameter]:
    """What is searched for, from the vehicle of the start file on."""
    yield from _of_vehicle(vehicle)
    yield from _of_rotor_response(vehicle, segments[0].record)
    for flight in range(1 + segments[-1].flight):
        yield FreeParameter("delay", 0.0, 0.005, 4.0, flight)
        yield FreeParameter("offset_x", 0.0, 0.01 * vehicle.longest_arm, 10.0, flight)
        yield FreeParameter("offset_y", 0.0, 0.01 * vehicle.longest_arm, 10.0, flight)
    if not wind:
        return
    most_knots = max(2, _MAX_KNOTS // len(segments))
    for i, segment in enumerate(segments):
        knots = int(np.clip(np.ceil(segment.seconds / _KNOT_SPACING), 2, most_knots))
        for _ in range(knots):
            for deviation in _WIND_DEVIATION:
                yield FreeParameter("wind", 0.0, deviation, knots**0.5, segment.flight, i)


def _of_vehicle(vehicle: Vehicle) -> Iterator[FreeParameter]:
    """Numbers of thrust, inertia, drag and torque.

    Where the start has none, a number begins at a typical one: a rotor drag of 2 % of the weight per m/s, a body drag
    of a quarter of the arm's square, 6e-4 of inertia_z for a rotor's.  Scales are what acts in hover at 1 m/s or 1
    rad/s: moments of 1 % of weight times arm, a damping of inertia, an inflow that takes 2 % of the thrust.
    """
    weight = vehicle.mass * vehicle.gravity
    arm = vehicle.longest_arm
    hover = vehicle.hover_speed
    area = number_in(vehicle, "body_drag") or 0.25 * arm**2
    yield FreeParameter("thrust_coefficient", vehicle.mean_coefficient, None, None)
    for axis, moment in zip("xyz", vehicle.inertia, strict=True):
        yield FreeParameter(f"inertia_{axis}", moment, None, None)
    yield FreeParameter("drag_to_thrust", vehicle.drag_to_thrust, None, None)
    yield FreeParameter("rotor_inertia", vehicle.rotor_inertia or 6e-4 * vehicle.inertia[2], None, 1.0)
    yield FreeParameter("rotor_drag", vehicle.rotor_drag or 0.005 * weight / hover, None, 1.5)
    yield FreeParameter("body_drag", area, area, 1.0)
    for name in ("rotor_moment_x", "rotor_moment_y"):
        yield FreeParameter(name, number_in(vehicle, name) or 0.0, 0.01 * weight * arm / (4.0 * hover), 10.0)
    for name in ("inflow_moment_x", "inflow_moment_y"):
        yield FreeParameter(name, number_in(vehicle, name) or 0.0, 0.01 * weight * arm, 10.0)
    for axis, moment in zip("xyz", vehicle.inertia, strict=True):
        name = f"rate_damping_{axis}"
        yield FreeParameter(name, number_in(vehicle, name) or 0.0, moment, 10.0)
    yield FreeParameter("inflow", vehicle.inflow or 0.0, 0.02 * weight / (4.0 * hover), 5.0)
    yield FreeParameter("yaw_trim", 0.0, 0.01 * weight * vehicle.drag_to_thrust, 10.0)


def _of_rotor_response(vehicle: Vehicle, record: Record) -> Iterator[FreeParameter]:
    """Numbers by which the rotors follow what a log has of their outputs; none where their speeds were measured."""
    if record.speeds is not None:
        return
    lag = start_lag(vehicle)
    yield FreeParameter("rotor_rise", vehicle.rotor_rise or lag, None, 1.5)
    yield FreeParameter("rotor_fall", vehicle.rotor_fall or lag, None, 1.5)
    if record.throttle is not None:
        yield FreeParameter("throttle_curve", vehicle.throttle_share, 0.3, 1.0)
    elif record.voltage is not None:
        yield FreeParameter("voltage_exponent", 1.0, 0.5, 2.0)


class NormalEquations(NamedTuple):
    """Normal equations of some samples by their innovations e, slopes J, and instruments Z, else J: H dx = -g."""

    H: Array  # Z' J
    g: Array  # Z' e
    S: Array  # Z' Z, the covariance of g


class _JointPrior(NamedTuple):
    """A prior on several numbers at once: residual / deviation is standard normal."""

    slopes: Mapping[int, float]  # of the residual by x, by place
    residual: float
    deviation: float


class _Linearised(NamedTuple):
    """Innovations of a segment, and the lift that its blocks lack, with their slopes by all X numbers of x."""

    innovations: Array  # (N, 6)
    slopes: Array  # (N, 6, X)
    lift: Array  # (B,)
    lift_slopes: Array  # (B, X)


class Search:
    """The parameters of all segments at once, and what their innovations say of them.

    x has the free parameters, then the noise model of each flight and axis, then the errors of first samples.  A loop
    that feeds torque back through the commands does not bias the estimate, as each e_k is predicted from commands and
    samples before it alone (Ljung, Secs. 8.4 and 13.4).

    Noise of measured rotor speeds does: torques look larger than they are, and so do moments of inertia.  Where the
    commands are logged too, they are instruments (Sec. 7.6): by the moments of inertia about x and y, the innovations
    are made orthogonal not to their own slopes J but to Z, the slopes at the speeds that the commands predict, which
    share no noise with the measured ones: sum Z' e = 0 in place of sum J' e = 0.

    Args:
        segments: the segments, flight by flight.
        vehicle: the start.
        wind: whether the air may move.
        fixed: numbers that are not searched for, by name, in SI units.
    """

    def __init__(
        self, segments: Sequence[Segment], vehicle: Vehicle, *, wind: bool, fixed: Mapping[str, float] | None = None
    ) -> None:
        self.segments = segments
        self.vehicle = vehicle
        self.fixed = fixed or {}
        candidates = _free_parameters(vehicle, segments, wind=wind)
        self.free = [parameter for parameter in candidates if parameter.name not in self.fixed]
        self.voltage = mean_voltage(segments)
        self.flight_count = 1 + segments[-1].flight
        self._free_count = len(self.free)
        reflections = [*_FIRST_REFLECTIONS] * len(INCREMENTS) * self.flight_count
        first_errors = np.zeros(len(INCREMENTS) * len(segments))
        self._errors_begin = self._free_count + len(reflections)  # where the errors of first samples begin in x
        self.x = np.concatenate([np.zeros(self._free_count), reflections, first_errors])
        deviations = [parameter.deviation for parameter in self.free]
        deviations += [_REFLECTION_DEVIATION] * len(reflections)
        deviations += [_FIRST_ERROR_DEVIATION] * len(first_errors)
        self._weights = np.array([_weight(deviation) for deviation in deviations])
        self._force_decay = math.exp(-segments[0].step / LONGEST_FORCE)
        self._skip = []  # how many increments of each segment begin before its rotors have settled
        for segment in segments:
            settled = int(SETTLING / segment.record.period)
            self._skip.append(int(np.searchsorted(segment.starts, settled)))
        self.settled = True  # whether instruments, if there are any, gave moments of inertia
        self.sigma = np.ones((self.flight_count, len(INCREMENTS)))  # of the innovations of each flight [rad/s, m/s]
        self._winds = []  # (K, 3) where each segment's wind is in x
        for i in range(len(segments)):
            places = [place for place, parameter in enumerate(self.free) if parameter.segment == i]
            self._winds.append(np.array(places, int).reshape(-1, 3))

    @property
    def names(self) -> list[str]:
        """The names of the free parameters, by place in x."""
        return [parameter.name for parameter in self.free]

    @property
    def seconds(self) -> float:
        """How long all segments fly [s]."""
        return sum(segment.seconds for segment in self.segments)

    def in_steady_wind(self, x: Array) -> Array:
        """The same numbers with the wind of each segment at its mean."""
        steady = x.copy()
        for wind in self._winds:
            if len(wind):
                steady[wind] = x[wind].mean(axis=0)
        return steady

    def parameters(self, x: Array, index: int) -> Parameters:
        """The prediction's parameters for a segment."""
        flight = self.segments[index].flight
        numbers: dict[str, Any] = {}
        for parameter, coordinate in zip(self.free, x, strict=False):
            if parameter.segment is None and parameter.flight in (None, flight):
                numbers[parameter.name] = parameter.value(coordinate)
        numbers |= self.fixed
        numbers.setdefault("throttle_curve", self.vehicle.throttle_share)
        for name, axes in {**VECTORS, "offset": "xy"}.items():
            vector = []
            for axis in axes:
                vector.append(numbers.pop(f"{name}_{axis}"))
            numbers[name] = np.array(vector)
        areas = self.vehicle.body_drag or DRAG_AREAS
        numbers["body_drag"] = numbers["body_drag"] / areas[0] * np.array(areas)
        if len(self._winds[index]):
            numbers["wind"] = x[self._winds[index]] * _WIND_DEVIATION
        return Parameters(voltage=self.voltage, **numbers)

    def misfit(self, x: Array, index: int, rotors: RotorMotion | None = None) -> tuple[Array, RotorMotion]:
        """(N, 6) measured less predicted increments of a segment, and its rotors."""
        segment = self.segments[index]
        parameters = self.parameters(x, index)
        if rotors is None:
            rotors = rotor_motion(segment.record, self.vehicle, parameters)
        misfit = segment.misfit(predicted_increments(segment.motion, rotors, self.vehicle, parameters))
        return misfit[self._skip[index] :], rotors

    def _filtered(self, misfit: Array, x: Array, index: int, axis: int) -> Array:
        """A misfit (N, ...) of an axis through A(z) / C(z)."""
        noise = self._noise_places(index, axis)
        reflections = x[noise.start : noise.stop]
        top = _polynomial(np.tanh(reflections[:_ORDER]))
        bottom = _polynomial(np.tanh(reflections[_ORDER:]))
        if axis >= 3:  # of a force, A decays within `LONGEST_FORCE`
            top = self._force_decay ** np.arange(_ORDER + 1) * top
        return np.asarray(lfilter(top, bottom, misfit, axis=0))

    def _noise_places(self, index: int, axis: int) -> range:
        """Where in x the noise model of an axis of a segment is."""
        first = self._free_count + 2 * _ORDER * (len(INCREMENTS) * self.segments[index].flight + axis)
        return range(first, first + 2 * _ORDER)

    def _first_error_place(self, index: int, axis: int) -> int:
        """Where in x the error of the first sample of an axis of a segment is."""
        return self._errors_begin + len(INCREMENTS) * index + axis

    def _innovations_of_axis(self, misfit: Array, x: Array, index: int, axis: int) -> Array:
        """(N,) innovations of one axis: e = A(z) / C(z) d, the first d less the error of its sample."""
        corrected = misfit[:, axis].copy()
        corrected[0] += x[self._first_error_place(index, axis)] * self.sigma[self.segments[index].flight, axis]
        return self._filtered(corrected, x, index, axis)

    def _innovations(self, misfit: Array, x: Array, index: int) -> Array:
        columns = [self._innovations_of_axis(misfit, x, index, axis) for axis in range(len(INCREMENTS))]
        return np.stack(columns, axis=1)

    def innovations(self, x: Array) -> list[Array]:
        """(N, 6) of each segment."""
        innovations = []
        for i in range(len(self.segments)):
            misfit, _ = self.misfit(x, i)
            innovations.append(self._innovations(misfit, x, i))
        return innovations

    def _by_flight(self, rows: Sequence[Array]) -> list[Array]:
        """What the segments of each flight have, together."""
        by_flight: list[list[Array]] = [[] for _ in range(self.flight_count)]
        for segment, rows_of_segment in zip(self.segments, rows, strict=True):
            by_flight[segment.flight].append(rows_of_segment)
        return [np.concatenate(flight) for flight in by_flight]

    def prior(self, x: Array) -> tuple[float, NormalEquations]:
        """Half the squares of what the priors add, and their normal equations."""
        H = np.diag(self._weights)
        g = self._weights * x
        cost = 0.5 * float(self._weights @ x**2)
        for slopes, residual, deviation in self._joint_priors(x):
            slope = np.zeros(len(x))
            for place, share in slopes.items():
                slope[place] = share / deviation
            H += np.outer(slope, slope)
            g += slope * residual / deviation
            cost += 0.5 * (residual / deviation) ** 2
        return cost, NormalEquations(H, g, H)

    def _joint_priors(self, x: Array) -> Iterator[_JointPrior]:
        """A body that is about flat, rotors that rise about as fast as they fall, and wind that changes slowly."""
        places = dict(zip(self.names, range(self._free_count), strict=True))
        if "inertia_z" in places:
            inertia = self.parameters(x, 0).inertia
            level = inertia[0] + inertia[1]
            shares = {"inertia_z": 1.0, "inertia_x": -inertia[0] / level, "inertia_y": -inertia[1] / level}
            slopes = {}
            for name, share in shares.items():
                if name in places:
                    slopes[places[name]] = share
            yield _JointPrior(slopes, float(np.log(inertia[2] / level / FLAT_BODY)), FLAT_BODY_DEVIATION)
        if "rotor_rise" in places and "rotor_fall" in places:
            rise = places["rotor_rise"]
            fall = places["rotor_fall"]
            ratio = self.free[rise].value(x[rise]) / self.free[fall].value(x[fall])
            yield _JointPrior({rise: 1.0, fall: -1.0}, float(np.log(ratio)), _LAG_RATIO_DEVIATION)
        for segment, wind in zip(self.segments, self._winds, strict=True):
            deviation = _WIND_CHANGE * math.sqrt(segment.seconds / max(len(wind) - 1, 1))
            for before, after in zip(wind[:-1].flat, wind[1:].flat, strict=True):
                yield _JointPrior({before: -1.0, after: 1.0}, x[after] - x[before], deviation)

    def cost(self, x: Array) -> float:
        """Negative logarithm of the likelihood, each axis at its most likely variance, and of the priors."""
        innovations = []
        lifts = []
        for i in range(len(self.segments)):
            misfit, _ = self.misfit(x, i)
            innovations.append(self._innovations(misfit, x, i))
            lifts.append(self._lift(misfit[:, -1], i))
        lift = np.concatenate(lifts)
        costs_of_flights = []
        for e in self._by_flight(innovations):
            costs_of_flights.append(len(e) * 0.5 * float(np.log((e**2).mean(axis=0)).sum()))
        cost_of_priors, _ = self.prior(x)
        cost = cost_of_priors + sum(costs_of_flights) + 0.5 * float(lift @ lift)
        if np.isfinite(cost):
            return cost
        return np.inf

    def misfits(self, x: Array, index: int) -> tuple[Array, Array]:
        """Misfit (N, 6) of a segment's increments and its slopes (N, 6, P) by every free parameter."""
        misfit, rotors = self.misfit(x, index)
        slopes = np.zeros((*misfit.shape, self._free_count))
        for place, parameter in enumerate(self.free):
            if parameter.segment is not None or parameter.flight not in (None, self.segments[index].flight):
                continue
            step = _SCALED_STEP
            if parameter.scale is None:
                step = _LOG_STEP
            moved = x.copy()
            moved[place] += step
            if parameter.name in _ROTOR_PARAMETERS:
                moved_misfit, _ = self.misfit(moved, index)
            else:
                moved_misfit, _ = self.misfit(moved, index, rotors)
            slopes[:, :, place] = (moved_misfit - misfit) / step
        self._fill_wind_slopes(slopes, misfit, rotors, x, index)
        return misfit, slopes

    def _fill_wind_slopes(self, slopes: Array, misfit: Array, rotors: RotorMotion, x: Array, index: int) -> None:
        """Write the slopes by the wind: as it is linear between its knots, so is what a change of all of them does."""
        begun = self.segments[index].starts[self._skip[index] :]
        when = begun / max(len(self.segments[index].motion.rates) - 1, 1)
        for wind in self._winds[index].T:
            moved = x.copy()
            moved[wind] += _SCALED_STEP
            moved_misfit, _ = self.misfit(moved, index, rotors)
            slope = (moved_misfit - misfit) / _SCALED_STEP
            knots = np.linspace(0.0, 1.0, len(wind))
            for hat, place in zip(np.eye(len(wind)), wind, strict=True):
                slopes[:, :, place] = slope * np.interp(when, knots, hat)[:, None]

    def rows(self, index: int) -> list[Indices]:
        """The samples of each block of a segment."""
        size = len(self.segments[index].increments) - self._skip[index]
        seconds = size * self.segments[index].step
        block = max(SHORTEST_BLOCK, self.seconds / _MAX_BLOCKS)
        count = max(math.ceil(MIN_BLOCKS / len(self.segments)), round(seconds / block))
        return np.array_split(np.arange(size), count)

    def _lift(self, misfit: Array, index: int) -> Array:
        """Mean misfit (N, ...) of vz in each block, over what is allowed of it: thrust has to carry the weight."""
        blocks = self.rows(index)
        means = np.stack([misfit[rows].mean(axis=0) for rows in blocks])
        deviation = LIFT_DEVIATION * math.sqrt(len(blocks) * len(self.segments))
        return means / (deviation * self.vehicle.gravity * self.segments[index].step)

    def _linearised(self, index: int) -> _Linearised:
        """The innovations of a segment and the lift of its blocks at x, with their slopes."""
        x = self.x
        misfit, misfit_slopes = self.misfits(x, index)
        innovations = self._innovations(misfit, x, index)
        slopes = np.zeros((*innovations.shape, len(x)))
        for axis in range(len(INCREMENTS)):
            slopes[:, axis, : self._free_count] = self._filtered(misfit_slopes[:, axis], x, index, axis)
            for place in (*self._noise_places(index, axis), self._first_error_place(index, axis)):
                moved = x.copy()
                moved[place] += _NOISE_STEP
                change = self._innovations_of_axis(misfit, moved, index, axis) - innovations[:, axis]
                slopes[:, axis, place] = change / _NOISE_STEP
        lift_slopes = np.zeros((len(self.rows(index)), len(x)))
        lift_slopes[:, : self._free_count] = self._lift(misfit_slopes[:, -1], index)
        return _Linearised(innovations, slopes, self._lift(misfit[:, -1], index), lift_slopes)

    def blocks(self, *, instrumented: bool = False) -> list[NormalEquations]:
        """Normal equations of the log's parts, each of `SHORTEST_BLOCK` or longer but for `MIN_BLOCKS`, without priors.

        With the instruments that there are, if `instrumented`.
        """
        blocks = []
        for i, segment in enumerate(self.segments):
            innovations, slopes, lift, lift_slopes = self._linearised(i)
            instruments = None
            if instrumented and segment.instrument_speeds is not None and self.settled:
                instruments = self._instruments(i, slopes, segment.instrument_speeds)
            sigma = self.sigma[segment.flight]
            for rows, mean, slope in zip(self.rows(i), lift, lift_slopes, strict=True):
                J = np.vstack([(slopes[rows] / sigma[:, None]).reshape(-1, len(self.x)), slope])
                Z = J
                if instruments is not None:
                    Z = np.vstack([(instruments[rows] / sigma[:, None]).reshape(-1, len(self.x)), slope])
                e = np.append((innovations[rows] / sigma).ravel(), mean)
                blocks.append(NormalEquations(Z.T @ J, Z.T @ e, Z.T @ Z))
        return blocks

    def _instrumented_places(self) -> list[int]:
        """Where in x the moments of inertia are that the thrust turns: for yaw, the commands predict too little."""
        return [place for place, name in enumerate(self.names) if name in ("inertia_x", "inertia_y")]

    def _instruments(self, index: int, slopes: Array, speeds: Array) -> Array:
        """Slopes (N, 6, X) with those by the moments of inertia at the speeds (N, 4) that the commands predict."""
        delay = self.parameters(self.x, index).delay
        rotors = measured_rotors(speeds, self.segments[index].record.period, delay=delay)
        misfit, _ = self.misfit(self.x, index, rotors)
        instruments = slopes.copy()
        for place in self._instrumented_places():
            moved = self.x.copy()
            moved[place] += _LOG_STEP
            moved_misfit, _ = self.misfit(moved, index, rotors)
            misfit_slopes = (moved_misfit - misfit) / _LOG_STEP
            for axis in range(len(INCREMENTS)):
                instruments[:, axis, place] = self._filtered(misfit_slopes[:, axis], self.x, index, axis)
        return instruments

    def flight_of_blocks(self) -> list[int]:
        """The flight of each of `blocks`."""
        flights = []
        for i, segment in enumerate(self.segments):
            flights += [segment.flight] * len(self.rows(i))
        return flights

    def run(self) -> None:
        """Find the parameters: the most likely ones; then, where there are instruments, those orthogonal to them."""
        self._maximise_likelihood()
        self.settled = True
        has_instruments = all(segment.instrument_speeds is not None for segment in self.segments)
        if has_instruments and self._instrumented_places():
            likely = self.x
            self.settled = self._solve_with_instruments()
            if not self.settled:
                self.x = likely

    def _solve_with_instruments(self) -> bool:
        """Make the innovations orthogonal to the instruments, by Newton's steps; return whether that settles."""
        for _ in range(_MAX_NEWTON_STEPS):
            H, g = self._with_priors(self.blocks(instrumented=True))
            try:
                step = np.clip(-np.linalg.solve(H, g), -_LONGEST_NEWTON_STEP, _LONGEST_NEWTON_STEP)
            except np.linalg.LinAlgError:
                return False
            self.x = self.x + step
            if np.abs(step[self._instrumented_places()]).max() < _SETTLED:
                return True
        return False

    def _with_priors(self, blocks: Sequence[NormalEquations]) -> tuple[Array, Array]:
        """H and g of all blocks and the priors together."""
        _, prior = self.prior(self.x)
        whole = joined(blocks)
        return whole.H + prior.H, whole.g + prior.g

    def _maximise_likelihood(self) -> None:
        """Gauss-Newton steps, damped by Levenberg and Marquardt."""
        damping = 1e-2
        for _ in range(_MAX_STEPS):
            self._update_sigma()
            H, g = self._with_priors(self.blocks())
            before = self.cost(self.x)
            for _ in range(_MAX_TRIES):
                step = -np.linalg.solve(H + damping * np.diag(np.diag(H)), g)
                moved = self.x + np.clip(step, -_LONGEST_STEP, _LONGEST_STEP)
                after = self.cost(moved)
                if after < before:
                    break
                damping = max(5.0 * damping, 1e-5)
            else:
                return
            damping = max(0.2 * damping, 1e-7)
            self.x = moved
            if before - after < _LEAST_GAIN:
                return

    def _update_sigma(self) -> None:
        """Set sigma to the most likely one at x; the errors of first samples, which count in it, stay what they are."""
        before = self.sigma
        by_flight = self._by_flight(self.innovations(self.x))
        self.sigma = np.stack([np.sqrt((e**2).mean(axis=0)) for e in by_flight])
        flights = [segment.flight for segment in self.segments]
        first_errors = self.x[self._errors_begin :].reshape(-1, len(INCREMENTS))
        first_errors *= (before / self.sigma)[flights]

    def adopt(self, other: Search) -> None:
        """Begin where another search of the same segments ended."""
        coordinates: dict[Any, list[float]] = {}
        for parameter, coordinate in zip(other.free, other.x, strict=False):
            owner = (parameter.name, parameter.flight, parameter.segment)
            coordinates.setdefault(owner, []).append(coordinate)
        for place, parameter in enumerate(self.free):
            owner = (parameter.name, parameter.flight, parameter.segment)
            self.x[place] = coordinates[owner].pop(0)
        self.x[self._free_count :] = other.x[other._free_count :]
        self.sigma = other.sigma


def joined(blocks: Sequence[NormalEquations]) -> NormalEquations:
    """All blocks as one."""
    H = np.sum([block.H for block in blocks], axis=0)
    g = np.sum([block.g for block in blocks], axis=0)
    S = np.sum([block.S for block in blocks], axis=0)
    return NormalEquations(H, g, S)


def _weight(deviation: float | None) -> float:
    """The information of a prior with a standard deviation, or of none."""
    if deviation is None:
        return 0.0
    return deviation**-2.0


def _polynomial(reflections: Array) -> Array:
    """A stable polynomial 1 + a_1 / z + ... from reflection coefficients in (-1, 1), by Levinson's recursion."""
    polynomial = np.ones(1)
    for k in reflections:
        padded = np.append(polynomial, 0.0)
        polynomial = padded + k * padded[::-1]
    return polynomial
