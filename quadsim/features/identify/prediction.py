"""Open-loop prediction on flight that was not fitted: the validation of the identified numbers.

From every window's start, the measured state is simulated with the rotor speeds that the log gives, and compared with
what was measured up to 0.5 s later: x_{k+1} = x_k + T f(x_k + T/2 f(x_k)).  The identified vehicle is compared with
the start file, with two models of thrust and drag alone, and with the error that the identified disturbance causes to
any model, the floor.
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
from quadsim.features.identify.model import (
    INCREMENTS,
    MeanMotion,
    Parameters,
    predicted_increments,
    prepare_segment,
    rotor_motion,
)
from quadsim.features.identify.noise import AxisNoise
from quadsim.features.identify.record import ROTOR_INPUTS, Record, new_rows, part_of
from quadsim.features.identify.rotors import RotorMotion
from quadsim.state import Array, Indices
from quadsim.vehicle import Vehicle

PREDICTION_WINDOW: Final = 0.5  # longest horizon [s]; windows start every half of it
HORIZONS: Final = (0.05, 0.1, 0.15, 0.2, 0.25, 0.3, 0.35, 0.4, 0.45, 0.5)  # at which errors are taken [s]
RESIDUAL_AFTER: Final = 0.25  # [s] from a window's start
JUDGED: Final = (0.1, 0.25, 0.5)  # horizons of the verdict [s]
RATES_JUDGED: Final = 2  # of them for body rates: later, what is not known of the torque is most of the error
TIE: Final = 0.05  # by which errors of a quantity may exceed a baseline's, in the geometric mean over the horizons
NEAR_FLOOR: Final = 0.25  # by which they may exceed the floor to be said to reach it

IDENTIFIED = "identified"
"""Starts with the torque and force that a filter estimates from the periods before, which decay as the identified noise
does (`AxisNoise`)."""
NO_DISTURBANCE = "undisturbed"
"""The same without them."""
START = "start"
"""The start file with the same filter."""
RATES_HELD = "rates held"
"""The identified thrust and drag alone: body rates are held, as the baseline of published comparisons holds them."""
RATES_DECAY = "rates decay"
"""The same, but rates decay as they did in what was fitted."""
NOISE_FLOOR = "floor"
"""The error that the identified noise causes even where the vehicle is known exactly: that of the simulation against
itself with noise that comes after the start.  In a closed loop, it may exceed the errors of rates that are held: the
rotors' later speeds counteract a torque that the model does not have, and the vehicle turns less than they predict."""
BASELINES: Final = (START, RATES_HELD, RATES_DECAY)
QUANTITIES: Final = {"position": "m", "velocity": "m/s", "attitude": "rad", "body rates": "rad/s"}

_HELD_OUT: Final = 0.2  # share of the airborne samples of a log
_LONGEST_DRIFT: Final = 5.0  # [s] over which the mean of a velocity by the accelerometer is left out
_RESIDUAL_HORIZON: Final = HORIZONS.index(RESIDUAL_AFTER)
_TRACED_WINDOWS: Final = slice(0, 20, 2)  # of a log's: they follow one another, as windows start every half of one
_POSITION: Final = slice(0, 3)  # of a state
_VELOCITY: Final = slice(3, 6)
_ATTITUDE: Final = slice(6, 10)
_RATES: Final = slice(10, 13)
_VELOCITY_AND_RATES: Final = [3, 4, 5, 10, 11, 12]
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

    def ratios(self, baseline: str) -> dict[str, tuple[float, ...]]:
        """By logged quantity: errors of the identified vehicle over a baseline's, at those of `JUDGED` that count."""
        at = [HORIZONS.index(horizon) for horizon in JUDGED]
        ratios = self.errors[IDENTIFIED][at] / np.maximum(self.errors[baseline][at], 1e-12)
        by_quantity = {}
        for quantity, of_quantity in zip(QUANTITIES, ratios.T.tolist(), strict=True):
            counted = len(JUDGED)
            if quantity == "body rates":
                counted = RATES_JUDGED
            if np.isfinite(of_quantity).all():
                by_quantity[quantity] = tuple(of_quantity[:counted])
        return by_quantity

    def _exceeding(self, baseline: str, share: float) -> dict[str, tuple[float, ...]]:
        """The ratios of those quantities whose geometric mean over the horizons exceeds 1 by a share."""
        exceeding = {}
        for quantity, ratios in self.ratios(baseline).items():
            if math.prod(ratios) > (1.0 + share) ** len(ratios):
                exceeding[quantity] = ratios
        return exceeding

    @property
    def lost(self) -> tuple[str, ...]:
        """Where a baseline predicts better by more than `TIE`, in words; empty where the identified vehicle wins."""
        lost = []
        for baseline in BASELINES:
            for quantity, ratios in self._exceeding(baseline, TIE).items():
                listed = " ".join(f"{ratio:.2f}" for ratio in ratios)
                lost.append(f"{quantity} than {baseline}, {listed} times its error")
        return tuple(lost)

    @property
    def at_floor(self) -> tuple[str, ...]:
        """Quantities in which it loses to thrust and drag alone, and yet is within `NEAR_FLOOR` of the floor."""
        lost = self._exceeding(RATES_HELD, TIE) | self._exceeding(RATES_DECAY, TIE)
        above = self._exceeding(NOISE_FLOOR, NEAR_FLOOR)
        return tuple(quantity for quantity in QUANTITIES if quantity in lost and quantity not in above)

    @property
    def verdict(self) -> str:
        """Whether the identified vehicle predicts better than its baselines, and by how much."""
        horizons = f"at {', '.join(f'{horizon:g}' for horizon in JUDGED)} s"
        if self.lost:
            return f"predicts flight that was not fitted worse, {horizons}: {'; '.join(self.lost)}"
        *others, last = (f"{self._mean_ratios(baseline)} of the errors of {baseline}" for baseline in BASELINES)
        return f"predicts flight that was not fitted better: {horizons}, {', '.join(others)} and {last}"

    def _mean_ratios(self, baseline: str) -> str:
        """The geometric mean over the quantities of the ratios to a baseline, at each horizon of the verdict."""
        by_quantity = self.ratios(baseline).values()
        means = []
        for i in range(len(JUDGED)):
            at_horizon = [ratios[i] for ratios in by_quantity if i < len(ratios)]
            mean = math.exp(np.log(np.maximum(at_horizon, 1e-12)).mean())
            means.append(f"{mean:.2f}")
        return ", ".join(means)


def hold_out(record: Record, spans: Sequence[slice]) -> tuple[list[slice], list[slice]]:
    """Cut a record's airborne spans into what is fitted and what is held out: the last fifth of their samples.

    Where what is left of a span is too short to be fitted, all of it is held out.
    """
    airborne = sum(span.stop - span.start for span in spans)
    left = round((1.0 - _HELD_OUT) * airborne)
    fitted = []
    held_out = []
    for span in spans:
        cut = min(span.start + left, span.stop)
        left -= cut - span.start
        if (cut - span.start) * record.period < SHORTEST_SPAN * (1.0 - 1e-6):
            cut = span.start
        if cut > span.start:
            fitted.append(slice(span.start, cut))
        if cut < span.stop:
            held_out.append(slice(cut, span.stop))
    return fitted, held_out


class _SpanPrediction(NamedTuple):
    """The windows of one span of a log."""

    errors: Mapping[str, Array]  # by model, (W, len(HORIZONS), 4)
    residuals: Mapping[str, Array]  # by model but the floor, (W, 6)
    t: Array  # (W,) at which residuals are taken, in the log [s]
    trace: Trace


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
    spans_predicted: list[_SpanPrediction] = []
    rng = np.random.default_rng(0)
    for flight, (record, spans_of_record) in enumerate(zip(records, spans, strict=True)):
        known = identification
        if fitted:
            known = identification.of_flight(flight)
        for span in spans_of_record:
            rows = _window_rows(span, record.period)
            if rows.size:
                spans_predicted.append(_predict_span(known, start, record, rows, rng))
    if not spans_predicted:
        raise InputError(
            f"what is held out for the prediction is shorter than one window of {PREDICTION_WINDOW:g} s: fly longer, "
            "or give another log with --test"
        )
    return _errors_of_all(spans_predicted)


def _errors_of_all(spans: Sequence[_SpanPrediction]) -> PredictionErrors:
    """The errors of the windows of all spans; the trace is that of the span with most windows."""
    errors = {}
    for model in spans[0].errors:
        errors[model] = np.concatenate([span.errors[model] for span in spans])
    residuals = {}
    for model in spans[0].residuals:
        residuals[model] = np.concatenate([span.residuals[model] for span in spans])
    longest = max(spans, key=lambda span: len(span.trace.t))
    return PredictionErrors(
        windows=len(errors[IDENTIFIED]),
        errors={model: of_windows.mean(axis=0) for model, of_windows in errors.items()},
        trace=longest.trace,
        ends=_one_after_the_other([span.t for span in spans]),
        residuals=residuals,
    )


def _window_rows(span: slice, period: float) -> Indices:
    """(W, K) samples of the windows of a span."""
    length = max(1, round(PREDICTION_WINDOW / period))
    starts = np.arange(span.start, span.stop - length, max(1, length // 2))
    return np.asarray(starts[:, None] + np.arange(length + 1))


def _one_after_the_other(spans: Sequence[Array]) -> Array:
    """Times of all spans, the first of each a window's length after the last of the one before [s]."""
    begin = 0.0
    moved = []
    for t in spans:
        moved.append(begin + t - t[0])
        begin = float(moved[-1][-1]) + PREDICTION_WINDOW
    return np.concatenate(moved)


def _predict_span(
    known: Identification, start: Vehicle, record: Record, rows: Indices, rng: np.random.Generator
) -> _SpanPrediction:
    """The windows (W, K) of a span of a record."""
    measured = _measured(record)[rows]
    at = np.rint(np.array(HORIZONS) / record.period).astype(int)
    residual_at = at[_RESIDUAL_HORIZON]
    traced = (_TRACED_WINDOWS, slice(None), _VELOCITY_AND_RATES)
    errors = {}
    residuals = {}
    traces = {}
    for model, prediction in _predictions(known, start, record, rows, measured, rng).items():
        errors[model] = _errors(prediction.states[:, at], prediction.truth[:, at])
        if record.inertial:
            errors[model][..., 1] = np.nan  # a velocity by the accelerometer drifts
        if model != NOISE_FLOOR:
            residuals[model] = (measured - prediction.states)[:, residual_at, _VELOCITY_AND_RATES]
            traces[model] = prediction.states[traced]
    t = record.t[rows[_TRACED_WINDOWS]]
    trace = Trace(log=record.name, t=t, measured=measured[traced], predicted=traces)
    return _SpanPrediction(errors, residuals, record.t[rows[:, residual_at]], trace)


class _Predicted(NamedTuple):
    """States of windows."""

    states: Array  # (W, K, 13)
    truth: Array  # (W, K, 13) what they are compared with


def _predictions(
    known: Identification, start: Vehicle, record: Record, rows: Indices, measured: Array, rng: np.random.Generator
) -> dict[str, _Predicted]:
    """The windows (W, K) of a record, by each model."""
    steps = rows.shape[1] - 1
    held = _with_inputs_held(record)
    windows = _Windows(rows=rows, measured=measured, period=record.period, vehicle=start)
    identified = parameters_of(known)
    rotors = rotor_motion(held, start, identified)
    disturbance = _forecast(known.noise, identified, start, held, rotors, rows)
    of_start = Parameters.of(start, voltage=known.voltage or 0.0)
    rotors_of_start = rotor_motion(held, start, of_start)
    disturbance_of_start = _forecast(known.noise, of_start, start, held, rotors_of_start, rows)
    states = {
        IDENTIFIED: windows.simulated(identified, rotors, disturbance),
        NO_DISTURBANCE: windows.simulated(identified, rotors),
        START: windows.simulated(of_start, rotors_of_start, disturbance_of_start),
        RATES_HELD: windows.simulated(identified, rotors, decay_time=math.inf),
        RATES_DECAY: windows.simulated(identified, rotors, decay_time=known.rates_last),
    }
    predicted = {model: _Predicted(of_model, measured) for model, of_model in states.items()}
    # The floor: the same windows with random errors of the forecast, in place of what was measured.
    again = windows.repeated(_FLOOR_DRAWS)
    random_errors = _forecast_errors(known, record.period, (len(again.rows), steps), rng)
    expected = np.tile(disturbance, (_FLOOR_DRAWS, 1, 1))
    disturbed = again.simulated(identified, rotors, expected + random_errors)
    undisturbed = np.tile(states[IDENTIFIED], (_FLOOR_DRAWS, 1, 1))
    predicted[NOISE_FLOOR] = _Predicted(undisturbed, disturbed)
    return predicted


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
    noises: Sequence[AxisNoise], p: Parameters, vehicle: Vehicle, held: Record, rotors: RotorMotion, rows: Indices
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


def _misfit(p: Parameters, vehicle: Vehicle, held: Record, rotors: RotorMotion, samples: slice) -> Array:
    """(N - 1, 6) measured less predicted increments of N samples; those over held rows are spread evenly."""
    past = part_of(replace(held, speeds=None), samples)
    new = new_rows(past)
    first = int(new[0])
    last = int(new[-1])
    before = rotors.during(np.arange(samples.start + first, samples.start + last))
    measured = prepare_segment(past, 0)
    per_row = np.nan_to_num(measured.misfit(predicted_increments(measured.motion, before, vehicle, p)))
    periods = np.diff(new)
    misfit = np.zeros((samples.stop - samples.start - 1, len(INCREMENTS)))
    misfit[first:last] = np.repeat(per_row / periods[:, None], periods, axis=0)
    return misfit


def _forecast_errors(known: Identification, period: float, shape: tuple[int, int], rng: np.random.Generator) -> Array:
    """(*shape, 6) random errors of the forecast increments, drawn from the identified noise."""
    if not known.noise:
        return np.zeros((*shape, len(INCREMENTS)))
    drawn = []
    for noise in known.noise:
        white = rng.standard_normal(shape)
        drawn.append(noise.forecast_errors(white, period))
    return np.stack(drawn, axis=-1)


def _measured(record: Record) -> Array:
    """(N, 13) position, velocity, attitude and body rates; positions are NaN where there are none."""
    if record.position is None:
        position = np.full_like(record.velocity, np.nan)
    else:
        position = record.position
    velocity = record.velocity
    if record.inertial:
        drift = uniform_filter1d(np.nan_to_num(velocity), round(_LONGEST_DRIFT / record.period), axis=0)
        velocity = velocity - drift
    return np.concatenate([position, velocity, record.attitude, record.rates], axis=1)


def _errors(predicted: Array, measured: Array) -> Array:
    """(W, H, 4) norms of the errors of states (W, H, 13)."""
    error = predicted - measured
    position = np.linalg.norm(error[..., _POSITION], axis=-1)
    velocity = np.linalg.norm(error[..., _VELOCITY], axis=-1)
    rates = np.linalg.norm(error[..., _RATES], axis=-1)
    turn = _attitudes(measured).inv() * _attitudes(predicted)
    angle = turn.magnitude().reshape(error.shape[:-1])
    return np.stack([position, velocity, angle, rates], axis=-1)


def _attitudes(states: Array) -> Rotation:
    return Rotation.from_quat(states[..., _ATTITUDE].reshape(-1, 4), scalar_first=True)


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
        self, p: Parameters, rotors: RotorMotion, disturbance: Array | None = None, *, decay_time: float | None = None
    ) -> Array:
        """(W, K, 13) states, by the midpoint rule.

        Args:
            p: the parameters.
            rotors: over the record.
            disturbance: (W, K - 1, 6) increments of body rates and velocity that the parameters do not give; or none.
            decay_time: the time constant [s] with which body rates decay, where no torque acts on them.
        """
        period = self.period
        first = self.measured[:, 0]
        position = first[:, _POSITION]
        velocity = first[:, _VELOCITY]
        rates = first[:, _RATES]
        attitude = _attitudes(first)
        states = [first]

        def increments(step: int, turn: Rotation, rates: Array, velocity: Array) -> Array:
            motion = MeanMotion(period=period, rates=rates, turn=turn.as_matrix(), velocity=velocity)
            change = predicted_increments(motion, rotors.during(self.rows[:, step]), self.vehicle, p)
            if disturbance is not None:
                change += disturbance[:, step]
            if decay_time is not None:
                change[:, :3] = -period / decay_time * rates
            return change

        for step in range(self.rows.shape[1] - 1):
            half = 0.5 * increments(step, attitude, rates, velocity)
            middle = attitude * Rotation.from_rotvec(0.5 * period * rates)
            change = increments(step, middle, rates + half[:, :3], velocity + half[:, 3:])
            position = position + period * (velocity + 0.5 * change[:, 3:])
            attitude = attitude * Rotation.from_rotvec(period * (rates + 0.5 * change[:, :3]))
            velocity = velocity + change[:, 3:]
            rates = rates + change[:, :3]
            states.append(np.concatenate([position, velocity, attitude.as_quat(scalar_first=True), rates], axis=1))
        return np.stack(states, axis=1)


def _with_inputs_held(record: Record) -> Record:
    """The record with what it says of the rotors held through its gaps."""
    inputs: dict[str, Any] = {}
    for name in (*ROTOR_INPUTS, "voltage"):
        rows = getattr(record, name)
        if rows is not None:
            inputs[name] = rows
    there = np.isfinite(np.column_stack([*inputs.values()])).all(axis=1)
    rows = np.where(there, np.arange(len(record.t)), int(there.argmax()))
    latest = np.maximum.accumulate(rows)
    for name in inputs:
        inputs[name] = inputs[name][latest]
    return replace(record, **inputs)
