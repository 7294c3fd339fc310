"""Open-loop prediction on flight that was not fitted: what the identified numbers are worth.

From every window's start, the measured state is simulated with the rotor speeds that the log gives, and compared with
what was measured up to 0.5 s later.  Beside the identified vehicle stand the start file as it is, and "thrust only":
the identified thrust with the body rates of the window's start, the baseline of published comparisons.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from scipy.spatial.transform import Rotation

from quadsim.errors import InputError
from quadsim.state import Array, Indices
from quadsim.vehicle import Vehicle
from scenarios.identify.checks import SHORTEST_SPAN
from scenarios.identify.estimate import Identification
from scenarios.identify.model import MeanMotion, Parameters, predicted_increments, turning
from scenarios.identify.record import Record
from scenarios.identify.rotors import Turning

PREDICTION_WINDOW: Final = 0.5  # longest horizon [s]; windows start every half of it
HORIZONS: Final = (0.05, 0.1, 0.15, 0.2, 0.25, 0.3, 0.35, 0.4, 0.45, 0.5)  # at which errors are taken [s]
IDENTIFIED, START, THRUST_ONLY = "identified", "start", "thrust only"
QUANTITIES: Final = {"position": "m", "velocity": "m/s", "attitude": "rad", "body rates": "rad/s"}
ROTOR_FIELDS: Final = ("commands", "throttle", "speeds", "voltage")  # what a record may say of them
_HELD_OUT: Final = 0.2  # share of the airborne samples of a log
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
    """By model: (len(HORIZONS), 4) mean norm of the error, in the order of `QUANTITIES`; NaN without positions."""
    trace: Trace


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
    records: Sequence[Record], spans: Sequence[Sequence[slice]], identification: Identification, start: Vehicle
) -> PredictionErrors:
    """Predict every window of the held-out spans of some records.

    Raises:
        InputError: no span is as long as a window.
    """
    known = _without_refused(identification)
    voltage = known.voltage or 0.0
    identified = Parameters.of(
        known.vehicle,
        delay=known.delay,
        offset=np.array([*known.offset, 0.0]),
        wind=np.array([known.wind, known.wind]),
        yaw_trim=known.yaw_trim,
        throttle_curve=known.throttle_curve,
        voltage_exponent=known.voltage_exponent,
        voltage=voltage,
    )
    models = {
        IDENTIFIED: identified,
        START: Parameters.of(start, voltage=voltage),
        THRUST_ONLY: replace(identified, rotor_drag=0.0, body_drag=np.zeros(3)),
    }
    errors: dict[str, list[Array]] = {name: [] for name in models}
    traces = []
    for record, span in ((record, span) for record, own in zip(records, spans, strict=True) for span in own):
        length = max(1, round(PREDICTION_WINDOW / record.period))
        rows = np.arange(span.start, span.stop - length, max(1, length // 2))[:, None] + np.arange(length + 1)
        if not rows.size:
            continue
        measured = _measured(record)[rows]
        at = np.rint(np.array(HORIZONS) / record.period).astype(int)
        drawn = np.s_[: 2 * _SHOWN : 2, :, _VELOCITY_AND_RATES]
        drawn_states = {}
        for name, model in models.items():
            rotors = turning(_held(record), start, model)
            states = _simulate(model, start, rotors, rows, measured, record.period, turns=name != THRUST_ONLY)
            errors[name].append(_errors(states[:, at], measured[:, at]))
            drawn_states[name] = states[drawn]
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
    )


def _without_refused(known: Identification) -> Identification:
    """Return the identification without a delay or offset that a gate refuses, and without wind if it refuses drag."""
    refused = {estimate.name for estimate in known.estimates if estimate.refused}
    offset = (
        0.0 if "offset_x" in refused else known.offset[0],
        0.0 if "offset_y" in refused else known.offset[1],
    )
    wind = (0.0, 0.0) if {"rotor_drag", "body_drag"} <= refused else known.wind
    return replace(known, delay=0.0 if refused & {"delay", "lateness"} else known.delay, offset=offset, wind=wind)


def _measured(record: Record) -> Array:
    """(N, 13) position, velocity, attitude and body rates; positions are NaN where there are none."""
    position = np.full_like(record.velocity, np.nan) if record.position is None else record.position
    return np.concatenate([position, record.velocity, record.attitude, record.rates], axis=1)


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
