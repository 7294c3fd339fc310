"""Open-loop prediction on flight that was not fitted: what the identified numbers are worth.

From every window's start, the measured state is simulated with the rotor speeds that the log gives, and compared with
what was measured up to 0.5 s later.  The identified vehicle starts with the unknown torque and force that a filter
knows at that instant, of the periods before it alone, and which fade as the identified noise does (`AxisNoise`).

Beside it stand the same without them; the start file with the same filter; and two that have thrust and drag alone: the
body rates are held, as the baseline of published comparisons holds them, or decay as they did in what was fitted.

The floor is what the identified noise leaves open to any prediction that knows the vehicle: the error of the simulation
against itself with noise that comes after the start.  In a closed loop, it may exceed the errors of rates that are
held: the rotors' coming speeds answer a torque that the model does not know, and the vehicle turns less than they say.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final, NamedTuple

import numpy as np
from scipy.ndimage import uniform_filter1d
from scipy.spatial.transform import Rotation

from quadsim.errors import InputError
from quadsim.features.identify.checks import SHORTEST_SPAN
from quadsim.features.identify.estimate import Identification
from quadsim.features.identify.model import INCREMENTS, MeanMotion, Parameters, predicted_increments, stretch, turning
from quadsim.features.identify.noise import AxisNoise
from quadsim.features.identify.record import Record, part_of
from quadsim.features.identify.rotors import Turning
from quadsim.state import Array, Indices
from quadsim.vehicle import Vehicle

PREDICTION_WINDOW: Final = 0.5  # longest horizon [s]; windows start every half of it
HORIZONS: Final = (0.05, 0.1, 0.15, 0.2, 0.25, 0.3, 0.35, 0.4, 0.45, 0.5)  # at which errors are taken [s]
RESIDUAL_AFTER: Final = 0.25  # [s] from a window's start
JUDGED: Final = (0.1, 0.25, 0.5)  # horizons of the verdict [s]
RATES_JUDGED: Final = 2  # of them for body rates: later, what is not known of the torque is most of the error
TIE: Final = 0.05  # by which the errors of a quantity may exceed a rival's, in their geometric mean over the horizons
NEAR_FLOOR: Final = 0.25  # by which they may exceed the floor to be said to reach it
IDENTIFIED = "identified"
NO_DISTURBANCE = "undisturbed"
START = "start"
RATES_HELD = "rates held"
RATES_DECAY = "rates decay"
NOISE_FLOOR = "floor"
RIVALS: Final = (START, RATES_HELD, RATES_DECAY)
QUANTITIES: Final = {"position": "m", "velocity": "m/s", "attitude": "rad", "body rates": "rad/s"}
ROTOR_FIELDS: Final = ("commands", "throttle", "speeds", "voltage")  # what a record may say of them
_HELD_OUT: Final = 0.2  # share of the airborne samples of a log
_DRIFT: Final = 5.0  # [s] over which a velocity by the accelerometer is left out
_RESIDUAL: Final = HORIZONS.index(RESIDUAL_AFTER)
_SHOWN: Final = 10  # windows in a trace
_VELOCITY_AND_RATES: Final = [3, 4, 5, 10, 11, 12]  # of a state
_FLOOR_DRAWS: Final = 4  # of noise, for each window


@dataclass(frozen=True, kw_only=True)
class Trace:
    """Windows that follow one another in one log, measured and predicted."""

    log: str
    t: Array  # (n, K) [s]
    measured: Array  # (n, K, 6) velocity, world [m/s], and body rates [rad/s]
    predicted: Mapping[str, Array]  # the same by model


@dataclass(frozen=True, kw_only=True)
class PredictionErrors:
    """Errors of all windows."""

    windows: int
    errors: Mapping[str, Array]
    """By model: (len(HORIZONS), 4) mean norm of the error, in the order of `QUANTITIES`; NaN without what they need."""
    trace: Trace
    ends: Array  # (W,) time at which each window's residual is taken, log after log [s]
    residuals: Mapping[str, Array]
    """By model: (W, 6) measured less predicted velocity, world [m/s], and body rates [rad/s] after `RESIDUAL_AFTER`."""

    def ratios(self, rival: str) -> dict[str, tuple[float, ...]]:
        """Errors of the identified vehicle over a rival's at those of `JUDGED` that count, by quantity in the logs."""
        at = [HORIZONS.index(horizon) for horizon in JUDGED]
        ratios = self.errors[IDENTIFIED][at] / np.maximum(self.errors[rival][at], 1e-12)
        found = {}
        for name, of in zip(QUANTITIES, ratios.T.tolist(), strict=True):
            if np.isfinite(of).all():
                found[name] = tuple(of[:RATES_JUDGED] if name == "body rates" else of)
        return found

    def _exceeding(self, rival: str, share: float) -> dict[str, tuple[float, ...]]:
        """The ratios of those quantities whose geometric mean over the horizons exceeds 1 by a share."""
        return {name: of for name, of in self.ratios(rival).items() if math.prod(of) > (1.0 + share) ** len(of)}

    @property
    def lost(self) -> tuple[str, ...]:
        """Where a rival predicts better by more than `TIE`, in words; empty where the identified vehicle wins."""
        return tuple(
            f"{quantity} than {rival}, {' '.join(f'{ratio:.2f}' for ratio in of)} times its error"
            for rival in RIVALS
            for quantity, of in self._exceeding(rival, TIE).items()
        )

    @property
    def at_floor(self) -> tuple[str, ...]:
        """Quantities in which it loses to thrust and drag alone, and yet is within `NEAR_FLOOR` of the floor."""
        lost = self._exceeding(RATES_HELD, TIE) | self._exceeding(RATES_DECAY, TIE)
        above = self._exceeding(NOISE_FLOOR, NEAR_FLOOR)
        return tuple(name for name in QUANTITIES if name in lost and name not in above)

    @property
    def verdict(self) -> str:
        """Whether the identified vehicle predicts better than its rivals, and by how much."""
        horizons = f"at {', '.join(f'{horizon:g}' for horizon in JUDGED)} s"
        if self.lost:
            return f"predicts flight that was not fitted worse, {horizons}: {'; '.join(self.lost)}"
        texts = []
        for rival in RIVALS:
            by_quantity = self.ratios(rival).values()
            by_horizon = []
            for i in range(len(JUDGED)):
                by_horizon.append([of[i] for of in by_quantity if i < len(of)])
            means = [math.exp(np.log(np.maximum(of, 1e-12)).mean()) for of in by_horizon]
            texts.append(f"{', '.join(f'{mean:.2f}' for mean in means)} of the errors of {rival}")
        return f"predicts flight that was not fitted better: {horizons}, {', '.join(texts[:-1])} and {texts[-1]}"


def hold_out(record: Record, spans: Sequence[slice]) -> tuple[list[slice], list[slice]]:
    """Cut a record's airborne spans into what is fitted and what is held out: the last fifth of their samples.

    Where what is left of a span is too short to be fitted, all of it is held out.
    """
    left = round((1.0 - _HELD_OUT) * sum(span.stop - span.start for span in spans))
    fitted = []
    held = []
    for span in spans:
        cut = min(span.start + left, span.stop)
        left -= cut - span.start
        if (cut - span.start) * record.period < SHORTEST_SPAN * (1.0 - 1e-6):
            cut = span.start
        fitted += [slice(span.start, cut)] if cut > span.start else []
        held += [slice(cut, span.stop)] if cut < span.stop else []
    return fitted, held


def predict(
    records: Sequence[Record],
    spans: Sequence[Sequence[slice]],
    identification: Identification,
    start: Vehicle,
    *,
    fitted: bool = False,
) -> PredictionErrors:
    """Predict every window of the held-out spans of some records, with their own numbers where they were `fitted`.

    Raises:
        InputError: no span is as long as a window.
    """
    errors: dict[str, list[Array]] = {}
    residuals: dict[str, list[Array]] = {}
    traces = []
    ends = []
    begun = 0.0
    rng = np.random.default_rng(0)
    for flight, record, span in (
        (i, record, span) for i, (record, own) in enumerate(zip(records, spans, strict=True)) for span in own
    ):
        length = max(1, round(PREDICTION_WINDOW / record.period))
        rows = np.arange(span.start, span.stop - length, max(1, length // 2))[:, None] + np.arange(length + 1)
        if not rows.size:
            continue
        measured = _measured(record)[rows]
        at = np.rint(np.array(HORIZONS) / record.period).astype(int)
        drawn = np.s_[: 2 * _SHOWN : 2, :, _VELOCITY_AND_RATES]
        drawn_states = {}
        if fitted:
            known = identification.of_flight(flight)
        else:
            known = identification
        predicted = _predictions(known, start, record, rows, measured, rng)
        for name, prediction in predicted.items():
            of_windows = _errors(prediction.states[:, at], prediction.truth[:, at])
            of_windows[..., 1] *= np.nan if record.inertial else 1.0
            errors.setdefault(name, []).append(of_windows)
            if name == NOISE_FLOOR:
                continue
            residuals.setdefault(name, []).append((measured - prediction.states)[:, at[_RESIDUAL], _VELOCITY_AND_RATES])
            drawn_states[name] = prediction.states[drawn]
        taken = record.t[rows[:, at[_RESIDUAL]]]
        ends.append(begun + taken - taken[0])
        begun = float(ends[-1][-1]) + PREDICTION_WINDOW
        traces.append(
            Trace(log=record.name, t=record.t[rows[: 2 * _SHOWN : 2]], measured=measured[drawn], predicted=drawn_states)
        )
    if not traces:
        raise InputError(
            f"what is held out for the prediction is shorter than one window of {PREDICTION_WINDOW:g} s: fly longer, "
            "or give another log with --test"
        )
    whole = {name: np.concatenate(parts) for name, parts in errors.items()}
    return PredictionErrors(
        windows=len(whole[IDENTIFIED]),
        errors={name: of.mean(axis=0) for name, of in whole.items()},
        trace=max(traces, key=lambda trace: len(trace.t)),
        ends=np.concatenate(ends),
        residuals={name: np.concatenate(parts) for name, parts in residuals.items()},
    )


class _Predicted(NamedTuple):
    """States of windows."""

    states: Array  # (W, K, 13)
    truth: Array  # (W, K, 13) what they are compared with


def _predictions(
    known: Identification, start: Vehicle, record: Record, rows: Indices, measured: Array, rng: np.random.Generator
) -> dict[str, _Predicted]:
    """The windows (W, K) of a record, by each model."""
    held = _held(record)
    identified = parameters_of(known)
    windows = _Windows(rows=rows, measured=measured, period=record.period, vehicle=start)
    rotors = turning(held, start, identified)
    disturbance = _forecast(known.noise, identified, start, held, rotors, rows)
    states = {
        IDENTIFIED: windows.simulated(identified, rotors, disturbance),
        NO_DISTURBANCE: windows.simulated(identified, rotors),
    }
    of_start = Parameters.of(start, voltage=known.voltage or 0.0)
    rotors_of_start = turning(held, start, of_start)
    disturbance_of_start = _forecast(known.noise, of_start, start, held, rotors_of_start, rows)
    states[START] = windows.simulated(of_start, rotors_of_start, disturbance_of_start)
    states[RATES_HELD] = windows.simulated(identified, rotors, lasting=math.inf)
    states[RATES_DECAY] = windows.simulated(identified, rotors, lasting=known.rates_last)
    predicted = {name: _Predicted(of, measured) for name, of in states.items()}
    again = windows.repeated(_FLOOR_DRAWS)
    surprises = _surprises(known, record.period, (len(again.rows), rows.shape[1] - 1), rng)
    nominal = np.tile(states[IDENTIFIED], (_FLOOR_DRAWS, 1, 1))
    disturbed = again.simulated(identified, rotors, np.tile(disturbance, (_FLOOR_DRAWS, 1, 1)) + surprises)
    return predicted | {NOISE_FLOOR: _Predicted(nominal, disturbed)}


def parameters_of(known: Identification) -> Parameters:
    """The parameters of an identified vehicle, the wind at its mean."""
    return Parameters.of(
        known.vehicle,
        delay=known.delay,
        offset=np.array(known.offset),
        wind=np.array([known.wind, known.wind]),
        yaw_trim=known.yaw_trim,
        throttle_curve=known.throttle_curve,
        voltage_exponent=known.voltage_exponent,
        voltage=known.voltage or 0.0,
    )


def _forecast(
    noises: Sequence[AxisNoise], p: Parameters, vehicle: Vehicle, held: Record, rotors: Turning, rows: Indices
) -> Array:
    """(W, K - 1, 6) increments that the unknown torque and force are expected to give, by what precedes each window."""
    if not noises:
        return np.zeros((len(rows), rows.shape[1] - 1, len(INCREMENTS)))
    samples = slice(int(rows[0, 0]), int(rows[-1, -1]) + 1)
    misfit = _misfit(p, vehicle, held, rotors, samples)
    starts = rows[:, 0] - samples.start
    forecasts = []
    for i, noise in enumerate(noises):
        forecasts.append(noise.forecast(misfit[:, i], held.period, starts, rows.shape[1] - 1))
    return np.stack(forecasts, axis=-1)


def _misfit(p: Parameters, vehicle: Vehicle, held: Record, rotors: Turning, samples: slice) -> Array:
    """(N - 1, 6) measured less predicted increments of N samples; those over held rows are spread evenly."""
    past = stretch(part_of(replace(held, speeds=None), samples), 0)
    if held.fresh is None:
        new = np.arange(samples.stop - samples.start)
    else:
        new = np.flatnonzero(held.fresh[samples])
    first = int(new[0])
    last = int(new[-1])
    before = rotors.during(np.arange(samples.start + first, samples.start + last))
    left_over = np.nan_to_num(past.misfit(predicted_increments(past.motion, before, vehicle, p)))
    lasting = np.diff(new)
    misfit = np.zeros((samples.stop - samples.start - 1, len(INCREMENTS)))
    misfit[first:last] = np.repeat(left_over / lasting[:, None], lasting, axis=0)
    return misfit


def _surprises(known: Identification, period: float, shape: tuple[int, int], rng: np.random.Generator) -> Array:
    """(*shape, 6) increments on top of those that are expected, drawn from the identified noise."""
    if not known.noise:
        return np.zeros((*shape, len(INCREMENTS)))
    drawn = [noise.surprises(rng.standard_normal(shape), period) for noise in known.noise]
    return np.stack(drawn, axis=-1)


def _measured(record: Record) -> Array:
    """(N, 13) position, velocity, attitude and body rates; positions are NaN where there are none."""
    if record.position is None:
        position = np.full_like(record.velocity, np.nan)
    else:
        position = record.position
    velocity = record.velocity
    if record.inertial:  # what it drifts by is left out
        velocity = velocity - uniform_filter1d(np.nan_to_num(velocity), round(_DRIFT / record.period), axis=0)
    return np.concatenate([position, velocity, record.attitude, record.rates], axis=1)


def _errors(predicted: Array, measured: Array) -> Array:
    """(W, H, 4) norms of the errors of states (W, H, 13)."""
    error = predicted - measured
    before, after = (Rotation.from_quat(x[..., 6:10].reshape(-1, 4), scalar_first=True) for x in (measured, predicted))
    angle = (before.inv() * after).magnitude().reshape(error.shape[:-1])
    norms = [np.linalg.norm(error[..., part], axis=-1) for part in (slice(3), slice(3, 6), slice(10, 13))]
    return np.stack([*norms[:2], angle, norms[2]], axis=-1)


@dataclass(frozen=True, kw_only=True)
class _Windows:
    """Windows of a record, to be simulated from their first measured states on."""

    rows: Indices  # (W, K) samples
    measured: Array  # (W, K, 13)
    period: float  # [s]
    vehicle: Vehicle

    def repeated(self, times: int) -> _Windows:
        """The same windows several times."""
        return replace(self, rows=np.tile(self.rows, (times, 1)), measured=np.tile(self.measured, (times, 1, 1)))

    def simulated(
        self, p: Parameters, rotors: Turning, disturbance: Array | None = None, *, lasting: float | None = None
    ) -> Array:
        """(W, K, 13) states, by the midpoint rule.

        Args:
            p: the parameters.
            rotors: over the record.
            disturbance: (W, K - 1, 6) increments of body rates and velocity that the parameters do not give; or none.
            lasting: the time constant [s] with which body rates decay, where no torque acts on them.
        """
        period = self.period
        position, velocity, rates = (self.measured[:, 0, part] for part in (slice(3), slice(3, 6), slice(10, 13)))
        attitude = Rotation.from_quat(self.measured[:, 0, 6:10], scalar_first=True)
        states = [self.measured[:, 0]]

        def changes(periods: Indices, turn: Rotation, rates: Array, velocity: Array, extra: Array | float) -> Array:
            motion = MeanMotion(period=period, rates=rates, turn=turn.as_matrix(), velocity=velocity)
            change = predicted_increments(motion, rotors.during(periods), self.vehicle, p) + extra
            if lasting is not None:
                change[:, :3] = -period / lasting * rates
            return change

        for step, periods in enumerate(self.rows.T[:-1]):
            extra = 0.0 if disturbance is None else disturbance[:, step]
            begun = 0.5 * changes(periods, attitude, rates, velocity, extra)
            ahead = attitude * Rotation.from_rotvec(0.5 * period * rates)
            change = changes(periods, ahead, rates + begun[:, :3], velocity + begun[:, 3:], extra)
            position = position + period * (velocity + 0.5 * change[:, 3:])
            attitude = attitude * Rotation.from_rotvec(period * (rates + 0.5 * change[:, :3]))
            velocity = velocity + change[:, 3:]
            rates = rates + change[:, :3]
            states.append(np.concatenate([position, velocity, attitude.as_quat(scalar_first=True), rates], axis=1))
        return np.stack(states, axis=1)


def _held(record: Record) -> Record:
    """The record with what it says of the rotors held through its gaps."""
    found: dict[str, Any] = {name: rows for name in ROTOR_FIELDS if (rows := getattr(record, name)) is not None}
    there = np.isfinite(np.column_stack([*found.values()])).all(axis=1)
    latest = np.maximum.accumulate(np.where(there, np.arange(len(record.t)), int(there.argmax())))
    return replace(record, **{name: rows[latest] for name, rows in found.items()})
