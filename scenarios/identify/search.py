"""Prediction errors of a Kalman filter per axis, and the parameters that make them smallest.

What a flight measures of axis a from sample to sample, less what the parameters predict, is a coloured noise d: white
and slow torques or forces, and differences of the sensor's noise.  Its innovations e = A(z) / C(z) d, both of second
order and stable, are those of the stationary Kalman filter of that noise.  A and C are found together with the
parameters, at the least N log(sum e^2) summed over axes: the likelihood.  A loop that feeds torque back through the
commands does not bias this estimate, as each e_k is predicted from commands and samples before it alone (Ljung,
"System Identification", 2nd ed., Secs. 7.2, 8.4 and 13.4).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from typing import Any, Final, NamedTuple

import numpy as np
from scipy.signal import lfilter

from quadsim.state import Array, Indices
from quadsim.vehicle import Vehicle
from scenarios.identify.model import INCREMENTS, Parameters, Stretch, predicted_increments, turning
from scenarios.identify.rotors import Turning

TURN_ON: Final = 0.5  # time [s] after a stretch begins until the rotors have forgotten the speeds assumed there
KNOT: Final = 1.5  # time between two instants of the wind [s]
LONGEST_FORCE: Final = 2.0
"""Time [s] that an unknown force lasts: one that may last for ever would carry the weight in the thrust's place."""
BALANCE: Final = 0.002
"""Standard deviation of the mean lift over a log that is not the rotors' or drag, over the weight [-]."""
_MOST_KNOTS: Final = 40
SHORTEST_FOLD: Final = 3.0  # shortest part of a log that is left out in turn [s]
FEWEST: Final = 6  # parts, shorter ones of a log of less than 18 s: of 2, Student's t makes intervals useless
_MOST_BLOCKS: Final = 20
_NOISE_AT_FIRST: Final = ((1.0, 0.0), (-1.5, 0.5))  # reflection coefficients of A and C, before tanh
PLATE: Final = (0.87, 0.12)
"""Inertia_z over inertia_x + inertia_y, and its standard deviation in logarithms; of a plate it is 1."""
LEVEL_PLATE: Final = (1.0, 1.0, 2.0)  # drag areas along x, y, z to each other, where the start has none
_LAG_RATIO: Final = 0.5  # standard deviation of log(rise / fall)
_WIND_STEP: Final = 1.0  # standard deviation of the wind's change from knot to knot [m/s]
_STEPS, _TRIES, _SMALL = 60, 8, 5e-3  # of the search: how many, shortened how often, until the likelihood gains less
ROTOR_PARAMETERS: Final = ("rotor_rise", "rotor_fall", "delay", "throttle_curve", "voltage_exponent")
"""Parameters that the rotors' speeds depend on."""


class Sought(NamedTuple):
    """A number that is searched for: start exp(x) where it is positive by nature, else start + scale x."""

    name: str
    start: float
    scale: float | None  # None for the logarithm
    deviation: float | None  # of the prior, in units of x; None without
    part: int | None = None  # of the stretch whose own it is; None for one of the vehicle

    def value(self, x: float) -> float:
        """The number itself."""
        return float(self.start * np.exp(x)) if self.scale is None else float(self.start + self.scale * x)


def _sought(vehicle: Vehicle, parts: Sequence[Stretch]) -> list[Sought]:
    """What is searched for, from the vehicle of the start file on."""
    weight, arm = vehicle.mass * vehicle.gravity, vehicle.longest_arm
    record = parts[0].record
    area = vehicle.body_drag[0] if vehicle.body_drag else 0.25 * arm**2
    lag = vehicle.rotor_rise or vehicle.rotor_fall or 0.03
    numbers = [
        Sought("thrust_coefficient", vehicle.mean_coefficient, None, None),
        *(Sought(f"inertia_{axis}", value, None, None) for axis, value in zip("xyz", vehicle.inertia, strict=True)),
        Sought("drag_to_thrust", vehicle.drag_to_thrust, None, None),
        Sought("rotor_inertia", vehicle.rotor_inertia or 6e-4 * vehicle.inertia[2], None, 1.0),
        Sought("rotor_drag", vehicle.rotor_drag or 0.005 * weight / vehicle.hover_speed, None, 1.5),
        Sought("body_drag", area, area, 1.0),
        Sought("offset_x", 0.0, 0.01 * arm, 10.0),
        Sought("offset_y", 0.0, 0.01 * arm, 10.0),
        Sought("drag_height", 0.0, 0.1 * arm, 20.0),
        Sought("inflow", 0.0, 0.02 * weight / (4.0 * vehicle.hover_speed), 5.0),
        Sought("munk", 0.0, 0.001 * vehicle.mass, 2.0),
        Sought("yaw_trim", 0.0, 0.01 * weight * vehicle.drag_to_thrust, 10.0),
    ]
    if record.speeds is None or record.commands is not None:
        numbers += [Sought(name, getattr(vehicle, name) or lag, None, 1.5) for name in ("rotor_rise", "rotor_fall")]
        if record.throttle is not None and record.commands is None:
            numbers.append(Sought("throttle_curve", 1.0, 0.3, 1.0))
        if record.voltage is not None:
            numbers.append(Sought("voltage_exponent", 1.0, 0.5, 2.0))
    for i, part in enumerate(parts):
        numbers.append(Sought("delay", 0.0, 0.005, 4.0, i))
        numbers += [Sought("wind", 0.0, 1.0, 2.0, i)] * (2 * _knots(part))
    return numbers


def _knots(part: Stretch) -> int:
    return int(np.clip(np.ceil(len(part.increments) * part.record.period / KNOT), 2, _MOST_KNOTS))


class NormalEquations(NamedTuple):
    """Normal equations of the innovations of some samples: H dx = -g."""

    H: Array
    g: Array


class Search:
    """The parameters of all stretches at once, and what their innovations say of them."""

    def __init__(self, parts: Sequence[Stretch], vehicle: Vehicle, *, order: int = 2) -> None:
        self.parts, self.vehicle, self.order = parts, vehicle, order
        self.sought = _sought(vehicle, parts)
        voltages = [part.record.voltage for part in parts if part.record.voltage is not None]
        self.voltage = float(np.mean(np.concatenate(voltages))) if voltages else 0.0
        self._physical = len(self.sought)
        noise = [*itertools.chain(*([*half, *[0.0] * (order - 2)] for half in _NOISE_AT_FIRST))] * len(INCREMENTS)
        self._starts = self._physical + len(noise)  # where what is wrong with the first samples is
        self.x = np.concatenate([np.zeros(self._physical), noise, np.zeros(len(INCREMENTS) * len(parts))])
        self._fading = math.exp(-parts[0].record.period / LONGEST_FORCE)
        self._skip = [int(TURN_ON / part.record.period) for part in parts]
        self.sigma = np.ones(len(INCREMENTS))  # of the innovations [rad/s, m/s]
        deviations = [number.deviation for number in self.sought]
        self._weights = np.array([0.0 if sd is None else sd**-2.0 for sd in deviations] + [1 / 9.0] * len(noise))
        self._weights = np.append(self._weights, np.full(len(self.x) - self._starts, 1 / 16.0))
        winds = [[i for i, n in enumerate(self.sought) if n.name == "wind" and n.part == k] for k in range(len(parts))]
        self._winds = [np.reshape(wind, (-1, 2)) for wind in winds]  # (K, 2) where each stretch's wind is in `x`

    def parameters(self, x: Array, part: int) -> Parameters:
        """The prediction's parameters for a stretch."""
        own: dict[str, Any] = {
            n.name: n.value(v) for n, v in zip(self.sought, x, strict=False) if n.part in (None, part)
        }
        own["wind"] = x[self._winds[part]]
        area, given = own.pop("body_drag"), self.vehicle.body_drag or LEVEL_PLATE
        return Parameters(
            inertia=np.array([own.pop(f"inertia_{axis}") for axis in "xyz"]),
            body_drag=area / given[0] * np.array(given),
            offset=np.array([own.pop("offset_x"), own.pop("offset_y"), own.pop("drag_height")]),
            voltage=self.voltage,
            **own,
        )

    def _misfit(self, x: Array, part: int, rotors: Turning | None = None) -> tuple[Array, Turning]:
        """(N, 6) measured less predicted increments of a stretch, and its rotors."""
        parameters = self.parameters(x, part)
        rotors = rotors or turning(self.parts[part].record, self.vehicle, parameters)
        misfit = self.parts[part].increments - predicted_increments(
            self.parts[part].motion, rotors, self.vehicle, parameters
        )
        return misfit[self._skip[part] :], rotors

    def _polynomials(self, noise: Array, axis: int) -> tuple[Array, Array]:
        """A and C from their reflection coefficients; of a force, A forgets within `LONGEST_FORCE`."""
        fading = self._fading ** np.arange(self.order + 1) if axis >= 3 else 1.0
        return fading * _polynomial(np.tanh(noise[: self.order])), _polynomial(np.tanh(noise[self.order :]))

    def _filtered(self, misfit: Array, axis: int, noise: Array, start: float) -> Array:
        """(N,) innovations of one axis: e = A(z) / C(z) d, the first d less what is wrong with the first sample."""
        driven = misfit[:, axis].copy()
        driven[0] += start * self.sigma[axis]
        filtered: Array = lfilter(*self._polynomials(noise, axis), driven)
        return filtered

    def _innovations(self, misfit: Array, x: Array, part: int) -> Array:
        noise = x[self._physical : self._starts].reshape(len(INCREMENTS), 2 * self.order)
        start = x[self._starts + len(INCREMENTS) * part :]
        return np.stack([self._filtered(misfit, i, noise[i], start[i]) for i in range(len(INCREMENTS))], axis=1)

    def innovations(self, x: Array) -> list[Array]:
        """(N, 6) of each stretch."""
        return [self._innovations(self._misfit(x, i)[0], x, i) for i in range(len(self.parts))]

    def prior(self, x: Array) -> tuple[float, NormalEquations]:
        """Half the squares of what the priors add, and their normal equations."""
        H, g = np.diag(self._weights), self._weights * x
        cost = 0.5 * float(self._weights @ x**2)
        for row, residual, deviation in self._rules(x):
            slope = np.zeros(len(x))
            for i, share in row:
                slope[i] += share / deviation
            H += np.outer(slope, slope)
            g += slope * residual / deviation
            cost += 0.5 * (residual / deviation) ** 2
        return cost, NormalEquations(H, g)

    def _rules(self, x: Array) -> Iterator[tuple[list[tuple[int, float]], float, float]]:
        """Priors on several numbers at once: slopes by index, residual, standard deviation."""
        place = {number.name: i for i, number in enumerate(self.sought)}
        jx, jy, jz = (place[f"inertia_{axis}"] for axis in "xyz")
        inertia = [self.sought[i].value(x[i]) for i in (jx, jy, jz)]
        flat = inertia[0] + inertia[1]
        yield (
            [(jz, 1.0), (jx, -inertia[0] / flat), (jy, -inertia[1] / flat)],
            np.log(inertia[2] / flat / PLATE[0]),
            PLATE[1],
        )
        if "rotor_rise" in place:
            rise, fall = place["rotor_rise"], place["rotor_fall"]
            ratio = self.sought[rise].value(x[rise]) / self.sought[fall].value(x[fall])
            yield [(rise, 1.0), (fall, -1.0)], float(np.log(ratio)), _LAG_RATIO
        for before, after in (
            (b, a) for wind in self._winds for b, a in zip(wind[:-1].flat, wind[1:].flat, strict=True)
        ):
            yield [(before, -1.0), (after, 1.0)], x[after] - x[before], _WIND_STEP

    def cost(self, x: Array) -> float:
        """Negative logarithm of the likelihood, each axis at its most likely variance, and of the priors."""
        misfits = [self._misfit(x, i)[0] for i in range(len(self.parts))]
        every = np.concatenate([self._innovations(misfit, x, i) for i, misfit in enumerate(misfits)])
        lift = np.concatenate([self._lift(misfit[:, -1], i) for i, misfit in enumerate(misfits)])
        cost = self.prior(x)[0] + len(every) * float(np.log(np.sqrt((every**2).mean(axis=0))).sum())
        cost += 0.5 * float(lift @ lift)
        return cost if np.isfinite(cost) else np.inf

    def misfits(self, x: Array, part: int) -> tuple[Array, Array]:
        """Misfit (N, 6) of a stretch's increments and its slopes (N, 6, P) by every number that is sought."""
        misfit, rotors = self._misfit(x, part)
        slopes = np.zeros((*misfit.shape, self._physical))
        for i, number in enumerate(self.sought):
            if number.part not in (None, part) or number.name == "wind":
                continue
            step = 1e-4 if number.scale is None else 1e-2
            moved = x.copy()
            moved[i] += step
            slopes[:, :, i] = (
                self._misfit(moved, part, None if number.name in ROTOR_PARAMETERS else rotors)[0] - misfit
            ) / step
        when = np.linspace(0.0, 1.0, len(misfit) + self._skip[part])[self._skip[part] :]
        for wind in self._winds[part].T:  # as it is linear between its knots, so is what a change of all of them does
            moved = x.copy()
            moved[wind] += 1e-2
            slope = (self._misfit(moved, part, rotors)[0] - misfit) / 1e-2
            for share, i in zip(np.eye(len(wind)), wind, strict=True):
                slopes[:, :, i] = slope * np.interp(when, np.linspace(0.0, 1.0, len(wind)), share)[:, None]
        return misfit, slopes

    def _rows(self, part: int) -> list[Indices]:
        """The samples of each block of a stretch."""
        long = sum(len(one.increments) * one.record.period for one in self.parts)
        size = len(self.parts[part].increments) - self._skip[part]
        seconds = size * self.parts[part].record.period
        count = max(math.ceil(FEWEST / len(self.parts)), round(seconds / max(SHORTEST_FOLD, long / _MOST_BLOCKS)))
        return np.array_split(np.arange(size), count)

    def _lift(self, misfit: Array, part: int) -> Array:
        """Mean misfit (N, ...) of vz in each block, over what is allowed of it: thrust has to carry the weight."""
        rows = self._rows(part)
        most = BALANCE * math.sqrt(len(rows) * len(self.parts))
        return np.stack([misfit[of].mean(axis=0) for of in rows]) / (
            most * self.vehicle.gravity * self.parts[part].record.period
        )

    def _slopes(self, part: int) -> tuple[Array, Array, Array, Array]:
        """Innovations (N, 6) of a stretch and their slopes (N, 6, X); its blocks' lift (B,) and its slopes (B, X)."""
        x, physical, starts = self.x, self._physical, self._starts
        misfit, raw = self.misfits(x, part)
        innovations, size = self._innovations(misfit, x, part), 2 * self.order
        slopes = np.zeros((*innovations.shape, len(x)))
        for axis in range(len(INCREMENTS)):
            own, first = physical + size * axis, starts + len(INCREMENTS) * part + axis
            top, bottom = self._polynomials(x[own : own + size], axis)
            slopes[:, axis, :physical] = lfilter(top, bottom, raw[:, axis], axis=0)
            for i in (*range(own, own + size), first):
                moved = x.copy()
                moved[i] += 1e-4
                after = self._filtered(misfit, axis, moved[own : own + size], moved[first])
                slopes[:, axis, i] = (after - innovations[:, axis]) / 1e-4
        lift = np.zeros((len(self._rows(part)), len(x)))
        lift[:, :physical] = self._lift(raw[:, -1], part)
        return innovations, slopes, self._lift(misfit[:, -1], part), lift

    def blocks(self) -> list[NormalEquations]:
        """Normal equations of the log's parts, each of `SHORTEST_FOLD` or longer but for `FEWEST`, without priors."""
        blocks = []
        for i in range(len(self.parts)):
            innovations, slopes, lift, lift_slopes = self._slopes(i)
            for rows, mean, slope in zip(self._rows(i), lift, lift_slopes, strict=True):
                J = np.vstack([(slopes[rows] / self.sigma[:, None]).reshape(-1, len(self.x)), slope])
                blocks.append(NormalEquations(J.T @ J, J.T @ np.append((innovations[rows] / self.sigma).ravel(), mean)))
        return blocks

    def run(self) -> None:
        """Find the parameters: Gauss-Newton steps, damped by Levenberg and Marquardt."""
        damping, cost = 1e-2, self.cost(self.x)
        for _ in range(_STEPS):
            every = np.concatenate(self.innovations(self.x))
            scale, self.sigma = self.sigma, np.sqrt((every**2).mean(axis=0))
            starts = self.x[self._starts :].reshape(-1, len(INCREMENTS))
            starts *= scale / self.sigma  # they count in sigma
            blocks, (_, prior) = self.blocks(), self.prior(self.x)
            H, g = sum(b.H for b in blocks) + prior.H, sum(b.g for b in blocks) + prior.g
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
        """Begin where a search with a lower order ended."""
        self.x[: self._physical] = other.x[: other._physical]
        self.x[self._starts :] = other.x[other._starts :]
        mine = self.x[self._physical : self._starts].reshape(len(INCREMENTS), 2, self.order)
        mine[:, :, : other.order] = other.x[other._physical : other._starts].reshape(len(INCREMENTS), 2, other.order)
        mine[:, :, other.order :] = 0.0
        self.sigma = other.sigma


def _polynomial(reflections: Array) -> Array:
    """A stable polynomial 1 + a_1 / z + ... from reflection coefficients in (-1, 1), by Levinson's recursion."""
    polynomial = np.ones(1)
    for k in reflections:
        padded = np.append(polynomial, 0.0)
        polynomial = padded + k * padded[::-1]
    return polynomial
