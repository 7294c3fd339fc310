"""The fit of flight logs: parameters, their intervals, and the gates that refuse what a log cannot tell."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, Final, NamedTuple

import numpy as np
from scipy.stats import t as student

from quadsim.errors import InputError
from quadsim.vehicle import VEHICLE_UNITS, Vehicle
from scenarios.identify.estimate import Identification, ParameterEstimate
from scenarios.identify.model import INCREMENTS, Stretch, stretch
from scenarios.identify.record import Record
from scenarios.identify.rotors import smoothed
from scenarios.identify.search import LEVEL_PLATE, PLATE, Search

INTERVAL_SHARE: Final = 0.95
WIDEST: Final = 0.25
"""Half-width of an interval, in logarithms, above which a log is said not to excite a parameter."""
WIDEST_DELAY: Final = 0.01  # the same of a delay [s]
MOST_COLOUR: Final = 0.2  # largest autocorrelation of the innovations [-]
CHANCE: Final = 3.7
"""The same times sqrt(N) that noise of N samples stays below in 99 %, at 8 lags of 6 axes: more than 0.2 if N < 342."""
MOST_PRIOR: Final = 0.25  # share of the information on a parameter that rules and start may give
OUTPUT_ERROR_WINDOW: Final = 0.5  # of the output-error method [s]
_NORMAL: Final = 1.96  # standard deviations on either side, of a normal distribution
_LONGEST_LAG: Final = 0.2  # of the autocorrelation [s]
_STEPS: Final = 6  # of the output-error method
_YAW: Final = "yaw steps of 40 deg, one per second, for 10 s"
_GUSTS: Final = 0.015  # of drag, by wind that changes faster than its knots
_TURNS: Final = "a figure eight with yaw steps, 20 s"


class _Kind(NamedTuple):
    """How a parameter is judged and learnt."""

    axes: tuple[str, ...]  # whose innovations must be white
    advice: str  # what to fly to learn it
    unit: str = ""  # where the vehicle file has none
    floor: float = 0.0015  # standard deviation, in units of the search, of what the prediction leaves out


_KINDS: Final = {
    "thrust_coefficient": _Kind(("vz",), "20 s in the air, climbing and sinking"),
    "inertia_x": _Kind(("roll",), "steps to the side or a figure eight, 20 s", "kg m^2"),
    "inertia_y": _Kind(("pitch",), "steps forward or a figure eight, 20 s", "kg m^2"),
    "inertia_z": _Kind(("roll", "pitch", "yaw"), _TURNS, "kg m^2"),
    "drag_to_thrust": _Kind(("yaw",), _YAW),
    "rotor_rise": _Kind(("roll", "pitch", "yaw"), _YAW),
    "rotor_fall": _Kind(("roll", "pitch", "yaw"), _YAW),
    "rotor_inertia": _Kind(("yaw",), _YAW),
    "rotor_drag": _Kind(("vx", "vy"), "a figure eight at 2 m/s or more, 20 s", floor=_GUSTS),
    "body_drag": _Kind(("vx", "vy"), "straight legs at the highest speed, there and back", floor=_GUSTS),
    "delay": _Kind(("roll", "pitch", "yaw"), _TURNS, "s", floor=0.04),
    "lateness": _Kind(("roll", "pitch", "yaw"), _TURNS, "s"),
    "offset_x": _Kind(("pitch",), "hover, 10 s", "m", floor=0.1),
    "offset_y": _Kind(("roll",), "hover, 10 s", "m", floor=0.1),
    "throttle_curve": _Kind(("vz",), "climbs and descents at full and little throttle", "-"),
    "voltage_exponent": _Kind(("vz",), "one flight from a full battery to an empty one", "-"),
}


def identify_records(records: Sequence[Record], spans: Sequence[Sequence[slice]], vehicle: Vehicle) -> Identification:
    """Identify a vehicle from the parts of records that fly; its mass, arms and layout are taken as they are.

    Raises:
        InputError: nothing flies, or the records differ in what they say of rotors and battery.
        ParameterError: what was identified makes no vehicle, such as one that cannot hover.
    """
    flown = [part_of(record, span) for record, own in zip(records, spans, strict=True) for span in own]
    if not flown:
        raise InputError("no part of the logs flies")
    if len({(record.speeds is None, record.commands is None, record.voltage is None) for record in records}) > 1:
        names = ", ".join(record.name for record in records)
        raise InputError(f"logs fitted together must have the same columns of rotors and battery; got {names}")
    search = _searched([stretch(record) for record in flown], vehicle)
    richer = _searched(search.parts, vehicle, order=3, start=search)
    noisier = search
    if flown[0].commands is None and flown[0].speeds is not None:
        noisier = _searched([stretch(_noisier(record)) for record in flown], vehicle, start=search)
    return _Fit(search, richer, noisier).result()


def _searched(parts: Sequence[Stretch], vehicle: Vehicle, *, order: int = 2, start: Search | None = None) -> Search:
    search = Search(parts, vehicle, order=order)
    if start is not None:
        search.adopt(start)
    search.run()
    return search


def _noisier(record: Record) -> Record:
    """The record with the noise of its rotor speeds once more: what that changes, the noise has changed before.

    Noise of an input shrinks what it explains (Cook and Stefanski, "Simulation-extrapolation estimation", 1994).
    """
    assert record.speeds is not None
    rng = np.random.default_rng(0)
    noise = np.std(record.speeds - smoothed(record.speeds), axis=0)
    return replace(record, speeds=record.speeds + noise * rng.standard_normal(record.speeds.shape))


def part_of(record: Record, span: slice) -> Record:
    """A span of a record as one of its own."""
    cut: dict[str, Any] = {name: rows[span] for name, rows in vars(record).items() if isinstance(rows, np.ndarray)}
    return replace(record, **cut)


_WEAK: Final = "not excited"
_HOPELESS: Final = 1.1  # half-width above which its size is not told
_NEARLY: Final = 2.0  # how much too wide an interval may be for more of the same flight to help
_RELATIVE: Final = {*_KINDS} - {"delay", "lateness", "offset_x", "offset_y", "throttle_curve", "voltage_exponent"}
"""Parameters whose interval is judged by its share of the value."""


class _Fit:
    """What a search found, judged."""

    def __init__(self, search: Search, richer: Search, noisier: Search) -> None:
        self.search, self.vehicle = search, search.vehicle
        blocks, prior = search.blocks(), search.prior(search.x)[1]
        H = sum((block.H for block in blocks), prior.H)
        self.cov = np.linalg.inv(H)
        self.left_out = np.array([np.linalg.solve(H - block.H, block.g) for block in blocks])
        self.quantile = _quantile(len(blocks))
        self.rests = np.diag(self.cov) * np.diag(prior.H)
        count = len(search.sought)
        self.moved = richer.x[:count] - search.x[:count]
        self.drift = np.abs(noisier.x[:count] - search.x[:count])  # by the noise of measured speeds
        record = search.parts[0].record
        self._alone = record.commands is None and record.throttle is None  # measured speeds, without commands
        self.colour = _colour(search)
        self.most_colour = max(MOST_COLOUR, CHANCE / min(map(len, search.innovations(search.x))) ** 0.5)

    def _deviations(self, shares: dict[int, float]) -> tuple[float, float]:
        """Standard deviations of a sum of shares of x: what the innovations explain, and by leaving out blocks."""
        row = np.zeros(len(self.search.x))
        row[list(shares)] = list(shares.values())
        each = self.left_out @ row
        return float(np.sqrt(row @ self.cov @ row)), float(np.sqrt((len(each) - 1) * each.var()))

    def _half_width(self, shares: dict[int, float]) -> float:
        """Half of the interval: of noise, of the blocks' scatter, and of what the prediction leaves out, together."""
        drift = sum(abs(share) * self.drift[i] for i, share in shares.items())
        floor = max(_KINDS[self.search.sought[i].name].floor for i in shares)
        explained, scatter = self._deviations(shares)
        half = math.hypot(_NORMAL * explained, self.quantile * scatter, self.quantile * floor)
        return half + 2.0 * float(drift)

    def result(self) -> Identification:
        """Every estimate, and the vehicle with those that are not refused."""
        search, x = self.search, self.search.x
        sought = {number.name: i for i, number in enumerate(search.sought) if number.name in _KINDS}
        late = self._delay()
        estimates = {name: self._estimate(i) for name, i in sought.items() if name != "delay"} | {late.name: late}
        if "rotor_rise" not in estimates:
            estimates |= self._lags_as_stated()
        inertia = [estimates[f"inertia_{axis}"] for axis in "xyz"]
        used = [e.start if e.refused and e.start else e.value for e in inertia]
        if not inertia[2].refused and not _is_body(used):
            why = f"no body has it beside {used[0]:.4g} and {used[1]:.4g} about x and y"
            estimates["inertia_z"] = replace(inertia[2], refused=why, advice=_TURNS)
        vehicle = self._assembled({name: e.value for name, e in estimates.items() if not e.refused})
        if estimates["inertia_z"].refused:
            estimates["drag_to_thrust"], vehicle = self._yaw_gain(estimates, vehicle)
        first = search.parameters(x, 0)
        return Identification(
            estimates=tuple(estimates[name] for name in _KINDS if name in estimates),
            vehicle=vehicle,
            delay=late.value,
            offset=(first.offset[0], first.offset[1]),
            wind=(float(first.wind[:, 0].mean()), float(first.wind[:, 1].mean())),
            throttle_curve=first.throttle_curve,
            voltage_exponent=first.voltage_exponent,
            voltage=search.voltage or None,
            yaw_trim=first.yaw_trim,
            whiteness=self.colour,
            cross_check=_output_error(search),
        )

    def _estimate(self, i: int) -> ParameterEstimate:
        number, x = self.search.sought[i], self.search.x[i]
        half = self._half_width({i: 1.0})
        found = self._judged(
            number.name, number.value(x), number.value(x - half), number.value(x + half), self._weak(i, half)
        )
        if not WIDEST < half < _NEARLY * WIDEST or not found.refused.startswith(_WEAK):
            return found
        flown = sum(part.record.period * len(part.increments) for part in self.search.parts)
        return replace(found, advice=f"{found.advice}, or the same again, {flown * (half / WIDEST) ** 2:.0f} s in all")

    def _weak(self, i: int, half: float) -> str:
        """Why a number that is searched for tells nothing, or nothing."""
        number, kind = self.search.sought[i], _KINDS[self.search.sought[i].name]
        loud = max(kind.axes, key=self.colour.__getitem__)
        if self.colour[loud] > self.most_colour:
            found = f"innovations of {loud} correlate by {self.colour[loud]:.2f}"
            return f"not white: {found}, allowed {self.most_colour:.2g}"
        relative = half if number.scale is None else half * number.scale / abs(number.value(self.search.x[i]))
        if relative > WIDEST and number.name in _RELATIVE:
            return _not_excited(relative)
        if number.name == "body_drag" and self.vehicle.body_drag is None:
            return "its ratio along x, y and z is not known: give body_drag in the start file"
        if self.rests[i] > MOST_PRIOR:
            return f"rests on a rule of thumb for {self.rests[i]:.0%}, allowed {MOST_PRIOR:.0%}"
        if abs(self.moved[i]) > half:
            other = number.value(self.search.x[i] + self.moved[i])
            return f"depends on the noise model: {other:.3g} with one of third order"
        return ""

    def _judged(self, name: str, value: float, low: float, high: float, refused: str) -> ParameterEstimate:
        field, _, axis = name.partition("_") if name.startswith("inertia") else (name, "", "")
        start = getattr(self.vehicle, field, None)
        if axis and start is not None:
            start = start["xyz".index(axis)]
        elif isinstance(start, tuple):
            start = start[0]
        return ParameterEstimate(
            name=name,
            unit=_KINDS[name].unit or VEHICLE_UNITS[field],
            value=value,
            low=min(low, high),
            high=max(low, high),
            start=start,
            refused=refused,
            advice=_KINDS[name].advice if refused else "",
            in_file=field in VEHICLE_UNITS,
        )

    def _delay(self) -> ParameterEstimate:
        """One delay of all stretches: the mean, and an interval that holds each."""
        search = self.search
        every = [i for i, number in enumerate(search.sought) if number.name == "delay"]
        delays = np.array([search.sought[i].value(search.x[i]) for i in every])
        halves = np.array([self._half_width({i: 1.0}) * (search.sought[i].scale or 1.0) for i in every])
        value = float(np.average(delays, weights=halves**-2.0))
        half = max(float(halves.min()), float(np.abs(delays - value).max()))
        refused = f"not excited: +-{1e3 * half:.0f} ms" if half > WIDEST_DELAY else ""
        name = "lateness" if self._alone else "delay"
        return self._judged(name, value, value - half, value + half, refused)

    def _lags_as_stated(self) -> dict[str, ParameterEstimate]:
        """Rotor lag where speeds were measured and no commands."""
        why, lag = "the log has the rotors' speeds but not their commands", self.vehicle.rotor_rise or 0.0
        return {name: self._judged(name, lag, lag, lag, why) for name in ("rotor_rise", "rotor_fall")}

    def _yaw_gain(
        self, estimates: Mapping[str, ParameterEstimate], vehicle: Vehicle
    ) -> tuple[ParameterEstimate, Vehicle]:
        """The yaw reaction that gives the identified yaw acceleration with the inertia that the file keeps."""
        told, share = estimates["drag_to_thrust"], {"drag_to_thrust": 1.0, "thrust_coefficient": 1.0, "inertia_z": -1.0}
        sought = enumerate(self.search.sought)
        half = self._half_width({i: share[number.name] for i, number in sought if number.name in share})
        if half > WIDEST or self.colour["yaw"] > self.most_colour:
            return told, vehicle
        gain = told.value * estimates["thrust_coefficient"].value / estimates["inertia_z"].value
        tied = float(f"{gain * vehicle.inertia[2] / vehicle.mean_coefficient:.5g}")
        why = f"only the yaw acceleration that it gives is identified, +-{np.expm1(half):.1%}; "
        why += f"{tied:.4g} gives it with inertia_z as kept"
        return replace(told, refused=why, advice=_TURNS), replace(vehicle, drag_to_thrust=tied)

    def _assembled(self, values: Mapping[str, float]) -> Vehicle:
        """The start's vehicle with other values."""
        changes: dict[str, Any] = {
            name: value for name, value in values.items() if name in VEHICLE_UNITS and name != "body_drag"
        }
        inertia = [values.get(f"inertia_{axis}", kept) for axis, kept in zip("xyz", self.vehicle.inertia, strict=True)]
        if "inertia_z" not in values and not _is_body(inertia):
            inertia[2] = PLATE[0] * (inertia[0] + inertia[1])
        if "body_drag" in values:
            ratio = np.array(self.vehicle.body_drag or LEVEL_PLATE)
            changes["body_drag"] = tuple((values["body_drag"] * ratio / ratio[0]).tolist())
        return replace(self.vehicle, inertia=tuple(inertia), **changes)


def _is_body(inertia: Sequence[float]) -> bool:
    """Whether none of three moments of inertia exceeds the sum of the others."""
    return 2.0 * max(inertia) < sum(inertia)


def _quantile(blocks: int) -> float:
    """Student's, two-sided."""
    return float(student.ppf(0.5 + 0.5 * INTERVAL_SHARE, max(blocks - 1, 1)))


def _not_excited(half: float) -> str:
    width = f"+-{np.expm1(half):.0%}" if half < _HOPELESS else f"more than +-{np.expm1(_HOPELESS):.0%}"
    return f"{_WEAK}: the interval is {width}, allowed {np.expm1(WIDEST):.0%}"


def _colour(search: Search) -> dict[str, float]:
    """Largest |autocorrelation| of each axis's innovations at lags up to `_LONGEST_LAG`."""
    colour = np.zeros(len(INCREMENTS))
    for part, innovations in zip(search.parts, search.innovations(search.x), strict=True):
        e = innovations - innovations.mean(axis=0)
        for lag in range(1, 1 + max(1, round(_LONGEST_LAG / part.record.period))):
            colour = np.maximum(colour, np.abs((e[lag:] * e[:-lag]).mean(axis=0)) / (e**2).mean(axis=0))
    return dict(zip(INCREMENTS, colour.tolist(), strict=True))


def _output_error(search: Search) -> dict[str, float]:
    """Estimates of the output-error method over those of the search, by parameter.

    It takes all noise for the sensors': windows of `OUTPUT_ERROR_WINDOW`, each with a first sample and a constant
    torque of its own.  A torque that the loop answers makes it wrong, by 10 to 20 % in the inertias.
    """
    count = len(search.sought)
    x = search.x.copy()
    for _ in range(_STEPS):
        _, prior = search.prior(x)
        H, g = prior.H[:count, :count].copy(), prior.g[:count].copy()
        for i, part in enumerate(search.parts):
            misfit, slopes = search.misfits(x, i)
            n = max(4, round(OUTPUT_ERROR_WINDOW / part.record.period))
            rows = len(misfit) // n * n
            every = np.concatenate([misfit[:rows, :, None], slopes[:rows]], axis=2).reshape(
                -1, n, len(INCREMENTS), count + 1
            )
            summed = np.cumsum(every, axis=1)
            summed -= summed.mean(axis=1, keepdims=True)
            slope = np.arange(n) - 0.5 * (n - 1)
            slope /= np.linalg.norm(slope)
            summed[:, :, :3] -= np.einsum("i,k,wkap->wiap", slope, slope, summed[:, :, :3])
            summed /= np.sqrt((summed[..., :1] ** 2).mean(axis=(0, 1), keepdims=True))
            residual, J = summed[..., 0].ravel(), summed[..., 1:].reshape(-1, count)
            H += J.T @ J
            g += J.T @ residual
        x[:count] += np.clip(-np.linalg.solve(H, g), -0.3, 0.3)
    found = zip(search.sought, x, search.x, strict=False)
    return {number.name: float(np.exp(new - old)) for number, new, old in found if number.scale is None}
