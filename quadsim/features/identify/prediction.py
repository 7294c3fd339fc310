"""Open-loop prediction on flight that was not fitted: what the identified numbers are worth.

From every window's start, the measured state is simulated with the rotor speeds that the log gives, and compared with
what was measured up to 0.5 s later.  Beside the identified vehicle stand the start file as it is, and "thrust only":
the identified thrust with the body rates of the window's start, the baseline of published comparisons.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from scipy.ndimage import uniform_filter1d
from scipy.spatial.transform import Rotation

from quadsim.errors import InputError
from quadsim.features.identify.checks import SHORTEST_SPAN
from quadsim.features.identify.estimate import Identification
from quadsim.features.identify.model import MeanMotion, Parameters, predicted_increments, turning
from quadsim.features.identify.record import Record
from quadsim.features.identify.rotors import Turning
from quadsim.state import Array, Indices
from quadsim.vehicle import Vehicle

PREDICTION_WINDOW: Final = 0.5  # longest horizon [s]; windows start every half of it
HORIZONS: Final = (0.05, 0.1, 0.15, 0.2, 0.25, 0.3, 0.35, 0.4, 0.45, 0.5)  # at which errors are taken [s]
RESIDUAL_AFTER: Final = 0.25  # [s] from a window's start
JUDGED: Final = (0.1, 0.25, 0.5)  # horizons of the verdict [s]
TIE: Final = 0.05  # by which the errors of a quantity may exceed a rival's, in their geometric mean over the horizons
IDENTIFIED, START, THRUST_ONLY = "identified", "start", "thrust only"
QUANTITIES: Final = {"position": "m", "velocity": "m/s", "attitude": "rad", "body rates": "rad/s"}
ROTOR_FIELDS: Final = ("commands", "throttle", "speeds", "voltage")  # what a record may say of them
_HELD_OUT: Final = 0.2  # share of the airborne samples of a log
_DRIFT: Final = 5.0  # [s] over which a velocity by the accelerometer is left out
_RESIDUAL: Final = HORIZONS.index(RESIDUAL_AFTER)
_SHOWN: Final = 10  # windows in a trace
_VELOCITY_AND_RATES: Final = [3, 4, 5, 10, 11, 12]  # of a state


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
        """Errors of the identified vehicle over a rival's at `JUDGED`, by quantity that the logs have."""
        at = [HORIZONS.index(horizon) for horizon in JUDGED]
        ratios = self.errors[IDENTIFIED][at] / np.maximum(self.errors[rival][at], 1e-12)
        return {
            name: tuple(of.tolist()) for name, of in zip(QUANTITIES, ratios.T, strict=True) if np.isfinite(of).all()
        }

    @property
    def lost(self) -> tuple[str, ...]:
        """Where a rival predicts better by more than `TIE`, in words; empty where the identified vehicle wins."""
        return tuple(
            f"{quantity} than {rival}, {' '.join(f'{ratio:.2f}' for ratio in of)} times its error"
            for rival in (START, THRUST_ONLY)
            for quantity, of in self.ratios(rival).items()
            if math.prod(of) > (1.0 + TIE) ** len(of)
        )

    @property
    def verdict(self) -> str:
        """Whether the identified vehicle predicts better than its rivals, and by how much."""
        horizons = f"at {', '.join(f'{horizon:g}' for horizon in JUDGED)} s"
        if self.lost:
            return f"predicts flight that was not fitted worse, {horizons}: {'; '.join(self.lost)}"
        each = []
        for rival in (START, THRUST_ONLY):
            of = np.array([*self.ratios(rival).values()])
            mean = np.exp(np.log(np.maximum(of, 1e-12)).mean(axis=0)).tolist()
            each.append(f"{', '.join(f'{ratio:.2f}' for ratio in mean)} of the errors of {rival}")
        return f"predicts flight that was not fitted better: {horizons}, {' and '.join(each)}"


def hold_out(record: Record, spans: Sequence[slice]) -> tuple[list[slice], list[slice]]:
    """Cut a record's airborne spans into what is fitted and what is held out: the last fifth of their samples.

    Where what is left of a span is too short to be fitted, all of it is held out.
    """
    left = round((1.0 - _HELD_OUT) * sum(span.stop - span.start for span in spans))
    fitted, held = [], []
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
    errors: dict[str, list[Array]] = {name: [] for name in (IDENTIFIED, START, THRUST_ONLY)}
    residuals: dict[str, list[Array]] = {name: [] for name in errors}
    traces, ends, begun = [], [], 0.0
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
        for name, model in _models(identification.of_flight(flight) if fitted else identification, start).items():
            rotors = turning(_held(record), start, model)
            states = _simulate(model, start, rotors, rows, measured, record.period, turns=name != THRUST_ONLY)
            errors[name].append(_errors(states[:, at], measured[:, at]))
            errors[name][-1][..., 1] *= np.nan if record.inertial else 1.0
            residuals[name].append((measured - states)[:, at[_RESIDUAL], _VELOCITY_AND_RATES])
            drawn_states[name] = states[drawn]
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


def _models(known: Identification, start: Vehicle) -> dict[str, Parameters]:
    voltage = known.voltage or 0.0
    identified = Parameters.of(
        known.vehicle,
        delay=known.delay,
        offset=np.array(known.offset),
        wind=np.array([known.wind, known.wind]),
        yaw_trim=known.yaw_trim,
        throttle_curve=known.throttle_curve,
        voltage_exponent=known.voltage_exponent,
        voltage=voltage,
    )
    return {
        IDENTIFIED: identified,
        START: Parameters.of(start, voltage=voltage),
        THRUST_ONLY: replace(identified, rotor_drag=0.0, body_drag=np.zeros(3)),
    }


def _measured(record: Record) -> Array:
    """(N, 13) position, velocity, attitude and body rates; positions are NaN where there are none."""
    position = np.full_like(record.velocity, np.nan) if record.position is None else record.position
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


def _simulate(
    p: Parameters, vehicle: Vehicle, rotors: Turning, rows: Indices, measured: Array, period: float, *, turns: bool
) -> Array:
    """(W, K, 13) states at the samples (W, K) of windows, from the first measured ones on, by the midpoint rule.

    Without `turns`, the body rates stay as they are.
    """
    position, velocity, rates = (measured[:, 0, part] for part in (slice(3), slice(3, 6), slice(10, 13)))
    attitude = Rotation.from_quat(measured[:, 0, 6:10], scalar_first=True)
    states, share = [measured[:, 0]], np.array([float(turns)] * 3 + [1.0] * 3)
    for k in rows.T[:-1]:
        of = rotors.during(k)
        motion = MeanMotion(period=period, rates=rates, turn=attitude.as_matrix(), velocity=velocity)
        begun = 0.5 * share * predicted_increments(motion, of, vehicle, p)
        ahead = attitude * Rotation.from_rotvec(0.5 * period * rates)
        middle = MeanMotion(
            period=period, rates=rates + begun[:, :3], turn=ahead.as_matrix(), velocity=velocity + begun[:, 3:]
        )
        change = share * predicted_increments(middle, of, vehicle, p)
        position = position + period * (velocity + 0.5 * change[:, 3:])
        attitude = attitude * Rotation.from_rotvec(period * (rates + 0.5 * change[:, :3]))
        velocity, rates = velocity + change[:, 3:], rates + change[:, :3]
        states.append(np.concatenate([position, velocity, attitude.as_quat(scalar_first=True), rates], axis=1))
    return np.stack(states, axis=1)


def _held(record: Record) -> Record:
    """The record with what it says of the rotors held through its gaps."""
    found: dict[str, Any] = {name: rows for name in ROTOR_FIELDS if (rows := getattr(record, name)) is not None}
    there = np.isfinite(np.column_stack([*found.values()])).all(axis=1)
    latest = np.maximum.accumulate(np.where(there, np.arange(len(record.t)), int(there.argmax())))
    return replace(record, **{name: rows[latest] for name, rows in found.items()})
