"""Prediction errors of a Kalman filter per axis, and the parameters that make them smallest.

What a flight measures of axis a from sample to sample, less what the parameters predict, is a coloured noise d: white
and slow torques or forces, and differences of the sensor's noise.  Its innovations e = A(z) / C(z) d, both of second
order and stable, are those of the stationary Kalman filter of that noise.  A and C are found together with the
parameters, at the least N log(sum e^2) summed over axes: the likelihood.  A loop that feeds torque back through the
commands does not bias this estimate, as each e_k is predicted from commands and samples before it alone (Ljung,
"System Identification", 2nd ed., Secs. 7.2, 8.4 and 13.4).

Noise of measured rotor speeds does: torques look larger than they are, and so do moments of inertia.  Where the
commands are logged too, they are instruments (Sec. 7.6): by the moments of inertia about x and y, the innovations are
made orthogonal not to their own slopes J but to Z, the slopes at the speeds that the commands foretell, which share no
noise with the measured ones: sum Z' e = 0 in place of sum J' e = 0.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Final, NamedTuple

import numpy as np
from scipy.signal import lfilter

from quadsim.features.identify.estimate import VECTORS, field_of
from quadsim.features.identify.model import INCREMENTS, Parameters, Stretch, mean_voltage, predicted_increments, turning
from quadsim.features.identify.rotors import Turning, measured
from quadsim.fields import floor_of
from quadsim.state import Array, Indices
from quadsim.vehicle import LARGEST, VEHICLE_UNITS, Vehicle

TURN_ON: Final = 0.5  # time [s] after a stretch begins until the rotors have forgotten the speeds assumed there
KNOT: Final = 0.5  # time between two instants of the wind [s], where `_MOST_KNOTS` allow
LONGEST_FORCE: Final = 2.0
"""Time [s] that an unknown force lasts: one that may last for ever would carry the weight in the thrust's place."""
BALANCE: Final = 0.002
"""Standard deviation of the mean lift over a log that is not the rotors' or drag, over the weight [-]."""
_MOST_KNOTS: Final = 120  # of all stretches
SHORTEST_FOLD: Final = 3.0  # shortest part of a log that is left out in turn [s]
FEWEST: Final = 6  # parts, shorter ones of a log of less than 18 s: of 2, Student's t makes intervals useless
_MOST_BLOCKS: Final = 20
_ORDER: Final = 2  # of A and C
_NOISE_AT_FIRST: Final = (1.0, 0.0, -1.5, 0.5)  # reflection coefficients of A and C, before tanh
PLATE: Final = (0.87, 0.12)
"""Inertia_z over inertia_x + inertia_y, and its standard deviation in logarithms; of a plate it is 1."""
LEVEL_PLATE: Final = (1.0, 1.0, 2.0)  # drag areas along x, y, z to each other, where the start has none
_LAG_RATIO: Final = 0.5  # standard deviation of log(rise / fall)
_WIND: Final = (2.0, 2.0, 0.7)  # standard deviation of the mean wind of a stretch, world axes [m/s]
_WIND_STEP: Final = 0.2  # of its change in one second, over that of the mean
# of the search: how many, shortened how often, until the likelihood gains less
_STEPS = 60
_TRIES = 8
_SMALL = 5e-3
_LOG_STEP: Final = 1e-4  # of a logarithm, for slopes
_NEWTON_STEPS = 30
_LONGEST_STEP = 0.5
_SETTLED = 2e-3
"""Of the search with instruments: how many, how long at most, and how short a step of the inertia ends it."""
ROTOR_PARAMETERS: Final = ("rotor_rise", "rotor_fall", "delay", "throttle_curve", "voltage_exponent")
"""Parameters that the rotors' speeds depend on."""


class Sought(NamedTuple):
    """A number that is searched for: start exp(x) where it is positive by nature, else start + scale x."""

    name: str
    start: float
    scale: float | None  # None for the logarithm
    deviation: float | None  # of the prior, in units of x; None without
    flight: int | None = None  # whose own it is; None for one of the vehicle
    part: int | None = None  # of the stretch whose own it is

    def value(self, x: float) -> float:
        """The number itself; one that is positive by nature stays within what a vehicle's numbers may be."""
        if self.scale is not None:
            return float(self.start + self.scale * x)
        least = floor_of(VEHICLE_UNITS[field_of(self.name)])
        within = np.clip(x, math.log(least / self.start), math.log(LARGEST / self.start))
        return float(self.start * np.exp(within))

    def place(self, value: float) -> float:
        """Where in x a value is: the inverse of `value`."""
        if self.scale is None:
            return math.log(value / self.start)
        return (value - self.start) / self.scale


def _sought(vehicle: Vehicle, parts: Sequence[Stretch], *, wind: bool) -> Iterator[Sought]:
    """What is searched for, from the vehicle of the start file on."""
    weight = vehicle.mass * vehicle.gravity
    arm = vehicle.longest_arm
    hover = vehicle.hover_speed
    record = parts[0].record
    lag = vehicle.rotor_rise or vehicle.rotor_fall or 0.03
    yield Sought("thrust_coefficient", vehicle.mean_coefficient, None, None)
    for axis, moment in zip("xyz", vehicle.inertia, strict=True):
        yield Sought(f"inertia_{axis}", moment, None, None)
    yield Sought("drag_to_thrust", vehicle.drag_to_thrust, None, None)
    yield Sought("rotor_inertia", vehicle.rotor_inertia or 6e-4 * vehicle.inertia[2], None, 1.0)
    if vehicle.body_drag:
        area = vehicle.body_drag[0]
    else:
        area = 0.25 * arm**2
    yield Sought("rotor_drag", vehicle.rotor_drag or 0.005 * weight / hover, None, 1.5)
    yield Sought("body_drag", area, area, 1.0)
    for i, axis in enumerate("xy"):
        if vehicle.rotor_moment:
            moment = vehicle.rotor_moment[i]
        else:
            moment = 0.0
        yield Sought(f"rotor_moment_{axis}", moment, 0.01 * weight * arm / (4.0 * hover), 10.0)
    for i, axis in enumerate("xy"):
        if vehicle.inflow_moment:
            moment = vehicle.inflow_moment[i]
        else:
            moment = 0.0
        yield Sought(f"inflow_moment_{axis}", moment, 0.01 * weight * arm, 10.0)
    for i, axis in enumerate("xyz"):
        if vehicle.rate_damping:
            damping = vehicle.rate_damping[i]
        else:
            damping = 0.0
        yield Sought(f"rate_damping_{axis}", damping, vehicle.inertia[i], 10.0)
    yield Sought("inflow", vehicle.inflow or 0.0, 0.02 * weight / (4.0 * hover), 5.0)
    yield Sought("yaw_trim", 0.0, 0.01 * weight * vehicle.drag_to_thrust, 10.0)
    if record.speeds is None:
        yield from (Sought(name, getattr(vehicle, name) or lag, None, 1.5) for name in ("rotor_rise", "rotor_fall"))
        if record.throttle is not None:
            yield Sought("throttle_curve", vehicle.throttle_share, 0.3, 1.0)
        if record.voltage is not None and record.throttle is None:
            yield Sought("voltage_exponent", 1.0, 0.5, 2.0)
    for flight in range(1 + parts[-1].flight):
        yield Sought("delay", 0.0, 0.005, 4.0, flight)
        yield from (Sought(f"offset_{axis}", 0.0, 0.01 * arm, 10.0, flight) for axis in "xy")
    for i, part in enumerate(parts if wind else ()):
        knots = int(np.clip(np.ceil(part.seconds / KNOT), 2, max(2, _MOST_KNOTS // len(parts))))
        yield from (Sought("wind", 0.0, of, knots**0.5, part.flight, i) for _ in range(knots) for of in _WIND)


class NormalEquations(NamedTuple):
    """Normal equations of some samples by their innovations e, slopes J, and instruments Z, else J: H dx = -g."""

    H: Array  # Z' J
    g: Array  # Z' e
    S: Array  # Z' Z, the covariance of g


class Search:
    """The parameters of all stretches at once, and what their innovations say of them.

    Args:
        parts: the stretches, flight by flight.
        vehicle: the start.
        wind: whether the air may move.
        fixed: numbers that are not searched for, by name, in SI units.
    """

    def __init__(
        self, parts: Sequence[Stretch], vehicle: Vehicle, *, wind: bool, fixed: Mapping[str, float] | None = None
    ) -> None:
        self.parts = parts
        self.vehicle = vehicle
        self.fixed = fixed or {}
        self.sought = [number for number in _sought(vehicle, parts, wind=wind) if number.name not in self.fixed]
        self.voltage = mean_voltage(parts)
        self.flights = 1 + parts[-1].flight
        self._physical = len(self.sought)
        noise = [*_NOISE_AT_FIRST] * len(INCREMENTS) * self.flights
        self._starts = self._physical + len(noise)  # where what is wrong with the first samples is
        self.x = np.concatenate([np.zeros(self._physical), noise, np.zeros(len(INCREMENTS) * len(parts))])
        self._fading = math.exp(-parts[0].step / LONGEST_FORCE)
        self._skip = [int(np.searchsorted(part.starts, int(TURN_ON / part.record.period))) for part in parts]
        self.settled = True  # whether instruments, if there are any, gave moments of inertia
        self.sigma = np.ones((self.flights, len(INCREMENTS)))  # of the innovations of each flight [rad/s, m/s]
        deviations = [number.deviation for number in self.sought]
        self._weights = np.array([0.0 if sd is None else sd**-2.0 for sd in deviations] + [1 / 9.0] * len(noise))
        self._weights = np.append(self._weights, np.full(len(self.x) - self._starts, 1 / 16.0))
        winds = []
        for k in range(len(parts)):
            winds.append([i for i, n in enumerate(self.sought) if n.part == k])
        self._winds = [
            np.array(wind, int).reshape(-1, 3) for wind in winds
        ]  # (K, 3) where each stretch's wind is in `x`

    def in_steady_wind(self, x: Array) -> Array:
        """The same numbers with the wind of each stretch at its mean."""
        steady = x.copy()
        for wind in self._winds:
            if len(wind):
                steady[wind] = x[wind].mean(axis=0)
        return steady

    def parameters(self, x: Array, part: int) -> Parameters:
        """The prediction's parameters for a stretch."""
        own: dict[str, Any] = {
            n.name: n.value(v)
            for n, v in zip(self.sought, x, strict=False)
            if n.flight in (None, self.parts[part].flight) and n.part is None
        } | dict(self.fixed)
        if len(self._winds[part]):
            own["wind"] = x[self._winds[part]] * _WIND
        area = own.pop("body_drag")
        given = self.vehicle.body_drag or LEVEL_PLATE
        for name, axes in {**VECTORS, "offset": "xy"}.items():
            own[name] = np.array([own.pop(f"{name}_{axis}") for axis in axes])
        own.setdefault("throttle_curve", self.vehicle.throttle_share)
        return Parameters(body_drag=area / given[0] * np.array(given), voltage=self.voltage, **own)

    def _turns(self, x: Array, part: int, *, foretold: bool = False) -> Turning:
        """A stretch's rotors, as they were measured or as the commands foretell them."""
        of = self.parts[part]
        parameters = self.parameters(x, part)
        if foretold and of.foretold is not None:
            return measured(of.foretold, of.record.period, delay=parameters.delay)
        return turning(of.record, self.vehicle, parameters)

    def misfit(self, x: Array, part: int, rotors: Turning | None = None) -> tuple[Array, Turning]:
        """(N, 6) measured less predicted increments of a stretch, and its rotors."""
        parameters = self.parameters(x, part)
        rotors = rotors or self._turns(x, part)
        of = self.parts[part]
        misfit = of.misfit(predicted_increments(of.motion, rotors, self.vehicle, parameters))
        return misfit[self._skip[part] :], rotors

    def _polynomials(self, noise: Array, axis: int) -> tuple[Array, Array]:
        """A and C from their reflection coefficients; of a force, A forgets within `LONGEST_FORCE`."""
        fading = self._fading ** np.arange(_ORDER + 1) if axis >= 3 else 1.0
        return fading * _polynomial(np.tanh(noise[:_ORDER])), _polynomial(np.tanh(noise[_ORDER:]))

    def _noise(self, part: int, axis: int) -> tuple[range, int]:
        """Where in `x` the noise model of an axis of a stretch is, and what is wrong with its first sample."""
        first = self._physical + 2 * _ORDER * (len(INCREMENTS) * self.parts[part].flight + axis)
        return range(first, first + 2 * _ORDER), self._starts + len(INCREMENTS) * part + axis

    def _innovations_of(self, misfit: Array, x: Array, part: int, axis: int) -> Array:
        """(N,) innovations of one axis: e = A(z) / C(z) d, the first d less what is wrong with its sample."""
        noise, start = self._noise(part, axis)
        driven = misfit[:, axis].copy()
        driven[0] += x[start] * self.sigma[self.parts[part].flight, axis]
        return np.asarray(lfilter(*self._polynomials(x[noise.start : noise.stop], axis), driven))

    def _innovations(self, misfit: Array, x: Array, part: int) -> Array:
        return np.stack([self._innovations_of(misfit, x, part, axis) for axis in range(len(INCREMENTS))], axis=1)

    def _by_flight(self, rows: Sequence[Array]) -> list[Array]:
        """What the stretches of each flight have, together."""
        flights = [part.flight for part in self.parts]
        return [
            np.concatenate([one for one, of in zip(rows, flights, strict=True) if of == flight])
            for flight in range(self.flights)
        ]

    def innovations(self, x: Array) -> list[Array]:
        """(N, 6) of each stretch."""
        return [self._innovations(self.misfit(x, i)[0], x, i) for i in range(len(self.parts))]

    def prior(self, x: Array) -> tuple[float, NormalEquations]:
        """Half the squares of what the priors add, and their normal equations."""
        H = np.diag(self._weights)
        g = self._weights * x
        cost = 0.5 * float(self._weights @ x**2)
        for row, residual, deviation in self._rules(x):
            slope = np.zeros(len(x))
            for i, share in row:
                slope[i] += share / deviation
            H += np.outer(slope, slope)
            g += slope * residual / deviation
            cost += 0.5 * (residual / deviation) ** 2
        return cost, NormalEquations(H, g, H)

    def _rules(self, x: Array) -> Iterator[tuple[list[tuple[int, float]], float, float]]:
        """Priors on several numbers at once: slopes by index, residual, standard deviation."""
        place = {number.name: i for i, number in enumerate(self.sought)}
        inertia = self.parameters(x, 0).inertia
        flat = inertia[0] + inertia[1]
        shares = {"inertia_z": 1.0, "inertia_x": -inertia[0] / flat, "inertia_y": -inertia[1] / flat}
        if "inertia_z" in place:
            yield (
                [(place[name], share) for name, share in shares.items() if name in place],
                float(np.log(inertia[2] / flat / PLATE[0])),
                PLATE[1],
            )
        if {"rotor_rise", "rotor_fall"} <= {*place}:
            rise = place["rotor_rise"]
            fall = place["rotor_fall"]
            ratio = self.sought[rise].value(x[rise]) / self.sought[fall].value(x[fall])
            yield [(rise, 1.0), (fall, -1.0)], float(np.log(ratio)), _LAG_RATIO
        for part, wind in zip(self.parts, self._winds, strict=True):
            step = _WIND_STEP * math.sqrt(part.seconds / max(len(wind) - 1, 1))
            for before, after in zip(wind[:-1].flat, wind[1:].flat, strict=True):
                yield [(before, -1.0), (after, 1.0)], x[after] - x[before], step

    def cost(self, x: Array) -> float:
        """Negative logarithm of the likelihood, each axis at its most likely variance, and of the priors."""
        misfits = [self.misfit(x, i)[0] for i in range(len(self.parts))]
        every = self._by_flight([self._innovations(misfit, x, i) for i, misfit in enumerate(misfits)])
        lift = np.concatenate([self._lift(misfit[:, -1], i) for i, misfit in enumerate(misfits)])
        cost = self.prior(x)[0] + sum(len(e) * 0.5 * float(np.log((e**2).mean(axis=0)).sum()) for e in every)
        cost += 0.5 * float(lift @ lift)
        if np.isfinite(cost):
            return cost
        return np.inf

    def misfits(self, x: Array, part: int) -> tuple[Array, Array]:
        """Misfit (N, 6) of a stretch's increments and its slopes (N, 6, P) by every number that is sought."""
        misfit, rotors = self.misfit(x, part)
        slopes = np.zeros((*misfit.shape, self._physical))
        for i, number in enumerate(self.sought):
            if number.flight not in (None, self.parts[part].flight) or number.part is not None:
                continue
            step = _LOG_STEP if number.scale is None else 1e-2
            moved = x.copy()
            moved[i] += step
            slopes[:, :, i] = (
                self.misfit(moved, part, None if number.name in ROTOR_PARAMETERS else rotors)[0] - misfit
            ) / step
        begun = self.parts[part].starts[self._skip[part] :]
        when = begun / max(len(self.parts[part].motion.rates) - 1, 1)
        for wind in self._winds[part].T:  # as it is linear between its knots, so is what a change of all of them does
            moved = x.copy()
            moved[wind] += 1e-2
            slope = (self.misfit(moved, part, rotors)[0] - misfit) / 1e-2
            for share, i in zip(np.eye(len(wind)), wind, strict=True):
                slopes[:, :, i] = slope * np.interp(when, np.linspace(0.0, 1.0, len(wind)), share)[:, None]
        return misfit, slopes

    def rows(self, part: int) -> list[Indices]:
        """The samples of each block of a stretch."""
        long = sum(part.seconds for part in self.parts)
        size = len(self.parts[part].increments) - self._skip[part]
        seconds = size * self.parts[part].step
        count = max(math.ceil(FEWEST / len(self.parts)), round(seconds / max(SHORTEST_FOLD, long / _MOST_BLOCKS)))
        return np.array_split(np.arange(size), count)

    def _lift(self, misfit: Array, part: int) -> Array:
        """Mean misfit (N, ...) of vz in each block, over what is allowed of it: thrust has to carry the weight."""
        rows = self.rows(part)
        most = BALANCE * math.sqrt(len(rows) * len(self.parts))
        return np.stack([misfit[of].mean(axis=0) for of in rows]) / (
            most * self.vehicle.gravity * self.parts[part].step
        )

    def _slopes(self, part: int) -> tuple[Array, Array, Array, Array]:
        """Innovations (N, 6) of a stretch and their slopes (N, 6, X); its blocks' lift (B,) and its slopes (B, X)."""
        x = self.x
        misfit, raw = self.misfits(x, part)
        innovations = self._innovations(misfit, x, part)
        slopes = np.zeros((*innovations.shape, len(x)))
        for axis in range(len(INCREMENTS)):
            noise, start = self._noise(part, axis)
            top, bottom = self._polynomials(x[noise.start : noise.stop], axis)
            slopes[:, axis, : self._physical] = lfilter(top, bottom, raw[:, axis], axis=0)
            for i in (*noise, start):
                moved = x.copy()
                moved[i] += 1e-4
                slopes[:, axis, i] = (self._innovations_of(misfit, moved, part, axis) - innovations[:, axis]) / 1e-4
        lift = np.zeros((len(self.rows(part)), len(x)))
        lift[:, : self._physical] = self._lift(raw[:, -1], part)
        return innovations, slopes, self._lift(misfit[:, -1], part), lift

    def blocks(self, *, instrumented: bool = False) -> list[NormalEquations]:
        """Normal equations of the log's parts, each of `SHORTEST_FOLD` or longer but for `FEWEST`, without priors.

        With the instruments that there are, if `instrumented`.
        """
        blocks = []
        for i in range(len(self.parts)):
            innovations, slopes, lift, lift_slopes = self._slopes(i)
            if instrumented:
                instruments = self._instruments(i, slopes)
            else:
                instruments = slopes
            sigma = self.sigma[self.parts[i].flight]
            for rows, mean, slope in zip(self.rows(i), lift, lift_slopes, strict=True):
                J = np.vstack([(slopes[rows] / sigma[:, None]).reshape(-1, len(self.x)), slope])
                Z = J
                if instruments is not slopes:
                    Z = np.vstack([(instruments[rows] / sigma[:, None]).reshape(-1, len(self.x)), slope])
                e = np.append((innovations[rows] / sigma).ravel(), mean)
                blocks.append(NormalEquations(Z.T @ J, Z.T @ e, Z.T @ Z))
        return blocks

    def _instrumented(self) -> list[int]:
        """Where in x the moments of inertia are that the thrust turns: for yaw, commands foretell too little."""
        return [i for i, number in enumerate(self.sought) if number.name in ("inertia_x", "inertia_y")]

    def _instruments(self, part: int, slopes: Array) -> Array:
        """Slopes (N, 6, X) with those by the moments of inertia at the speeds that the commands foretell."""
        if self.parts[part].foretold is None or not self.settled:
            return slopes
        instruments = slopes.copy()
        rotors = self._turns(self.x, part, foretold=True)
        misfit, _ = self.misfit(self.x, part, rotors)
        for i in self._instrumented():
            moved = self.x.copy()
            moved[i] += _LOG_STEP
            raw = (self.misfit(moved, part, rotors)[0] - misfit) / _LOG_STEP
            for axis in range(len(INCREMENTS)):
                noise, _ = self._noise(part, axis)
                instruments[:, axis, i] = lfilter(
                    *self._polynomials(self.x[noise.start : noise.stop], axis), raw[:, axis]
                )
        return instruments

    def flight_of_blocks(self) -> list[int]:
        """The flight of each of `blocks`."""
        return [part.flight for i, part in enumerate(self.parts) for _ in self.rows(i)]

    def run(self) -> None:
        """Find the parameters: the most likely ones; then, where there are instruments, those orthogonal to them."""
        self._most_likely()
        self.settled = True
        if all(part.foretold is not None for part in self.parts) and self._instrumented():
            likely = self.x
            self.settled = self._orthogonal()
            if not self.settled:
                self.x = likely

    def _orthogonal(self) -> bool:
        """Make the innovations orthogonal to the instruments, by Newton's steps; return whether that settles."""
        for _ in range(_NEWTON_STEPS):
            blocks = self.blocks(instrumented=True)
            _, prior = self.prior(self.x)
            H = sum(block.H for block in blocks) + prior.H
            g = sum(block.g for block in blocks) + prior.g
            try:
                step = np.clip(-np.linalg.solve(H, g), -_LONGEST_STEP, _LONGEST_STEP)
            except np.linalg.LinAlgError:
                return False
            self.x = self.x + step
            if np.abs(step[self._instrumented()]).max() < _SETTLED:
                return True
        return False

    def _most_likely(self) -> None:
        """Gauss-Newton steps, damped by Levenberg and Marquardt."""
        damping = 1e-2
        cost = self.cost(self.x)
        for _ in range(_STEPS):
            scale = self.sigma
            every = self._by_flight(self.innovations(self.x))
            self.sigma = np.stack([np.sqrt((e**2).mean(axis=0)) for e in every])
            starts = self.x[self._starts :].reshape(-1, len(INCREMENTS))
            starts *= (scale / self.sigma)[[part.flight for part in self.parts]]  # they count in sigma
            blocks = self.blocks()
            _, prior = self.prior(self.x)
            H = sum(b.H for b in blocks) + prior.H
            g = sum(b.g for b in blocks) + prior.g
            cost = self.cost(self.x)
            for _ in range(_TRIES):
                step = -np.linalg.solve(H + damping * np.diag(np.diag(H)), g)
                moved = self.x + np.clip(step, -0.6, 0.6)
                after = self.cost(moved)
                if after < cost:
                    break
                damping = max(5.0 * damping, 1e-5)
            else:
                return
            damping = max(0.2 * damping, 1e-7)
            self.x = moved
            if cost - after < _SMALL:
                return

    def adopt(self, other: Search) -> None:
        """Begin where another search of the same stretches ended."""
        found: dict[Any, list[float]] = {(number.name, number.flight, number.part): [] for number in other.sought}
        for number, value in zip(other.sought, other.x, strict=False):
            found[number.name, number.flight, number.part].append(value)
        self.x[: self._physical] = [found[n.name, n.flight, n.part].pop(0) for n in self.sought]
        self.x[self._physical :] = other.x[other._physical :]
        self.sigma = other.sigma


def _polynomial(reflections: Array) -> Array:
    """A stable polynomial 1 + a_1 / z + ... from reflection coefficients in (-1, 1), by Levinson's recursion."""
    polynomial = np.ones(1)
    for k in reflections:
        padded = np.append(polynomial, 0.0)
        polynomial = padded + k * padded[::-1]
    return polynomial
