"""Open-loop prediction on flight that was not fitted: what the identified numbers are worth.

From every window's start, the measured state is simulated with the rotor speeds that the log gives, and compared with
what was measured up to 0.5 s later.  Beside the identified vehicle stand the start file as it is, and "thrust only":
the identified thrust with the body rates of the window's start, the baseline of published comparisons.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from quadsim.errors import InputError
from quadsim.rotation import conjugate, multiply
from quadsim.sim.effects.wind import SEA_LEVEL_DENSITY
from quadsim.state import Array, Indices
from quadsim.vehicle import Vehicle
from scenarios.identify.checks import SHORTEST
from scenarios.identify.estimate import Identification
from scenarios.identify.record import Record
from scenarios.identify.rotors import lagging

WINDOW: Final = 0.5  # longest horizon [s]; windows start every half of it
HORIZONS: Final = (0.05, 0.1, 0.15, 0.2, 0.25, 0.3, 0.35, 0.4, 0.45, 0.5)  # at which errors are taken [s]
IDENTIFIED, START, THRUST_ONLY = "identified", "start", "thrust only"
QUANTITIES: Final = {"position": "m", "velocity": "m/s", "attitude": "rad", "body rates": "rad/s"}
_HELD_OUT: Final = 0.2  # share of the airborne samples of a log
_AT_ONCE: Final = 1e-6  # lag of rotors that have none [s]
_STEP: Final = 2.5e-3  # longest step of the integration [s]
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
class Prediction:
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
        if (cut - span.start) * record.period < SHORTEST * (1.0 - 1e-6):
            cut = span.start
        fitted += [slice(span.start, cut)] if cut > span.start else []
        held += [slice(cut, span.stop)] if cut < span.stop else []
    return fitted, held


def predict(
    records: Sequence[Record], spans: Sequence[Sequence[slice]], identification: Identification, start: Vehicle
) -> Prediction:
    """Predict every window of the held-out spans of some records.

    Raises:
        InputError: no span is as long as a window.
    """
    known = _without_refused(identification)
    bare = replace(known.vehicle, rotor_drag=None, body_drag=None, rotor_inertia=None)
    models = {
        IDENTIFIED: known,
        START: replace(known, vehicle=start, delay=0.0, offset=(0.0, 0.0), wind=(0.0, 0.0), yaw_trim=0.0),
        THRUST_ONLY: replace(known, vehicle=bare),
    }
    errors: dict[str, list[Array]] = {name: [] for name in models}
    traces = []
    for record, part in ((record, part) for record, parts in zip(records, spans, strict=True) for part in parts):
        half = max(1, round(0.5 * WINDOW / record.period))
        rows = np.arange(part.start, part.stop - 2 * half, half)[:, None] + np.arange(2 * half + 1)
        if not rows.size:
            continue
        measured = _measured(record)[rows]
        at = np.rint(np.array(HORIZONS) / record.period).astype(int)
        drawn = np.s_[: 2 * _SHOWN : 2, :, _VELOCITY_AND_RATES]
        predicted = {}
        for name, model in models.items():
            states = _simulate(model, record, rows, measured[:, 0], turns=name != THRUST_ONLY)
            errors[name].append(_errors(states[:, at], measured[:, at]))
            predicted[name] = states[drawn]
        traces.append(
            Trace(log=record.name, t=record.t[rows[: 2 * _SHOWN : 2]], measured=measured[drawn], predicted=predicted)
        )
    if not traces:
        raise InputError(
            f"what is held out for the prediction is shorter than one window of {WINDOW:g} s: fly longer, or give "
            "another log with --test"
        )
    whole = {name: np.concatenate(parts) for name, parts in errors.items()}
    return Prediction(
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
    return replace(known, delay=0.0 if "delay" in refused else known.delay, offset=offset, wind=wind)


def _measured(record: Record) -> Array:
    """(N, 13) position, velocity, attitude and body rates; positions are NaN where there are none."""
    position = np.full_like(record.velocity, np.nan) if record.position is None else record.position
    return np.concatenate([position, record.velocity, record.attitude, record.rates], axis=1)


def _errors(predicted: Array, measured: Array) -> Array:
    """(W, H, 4) norms of the errors of states (W, H, 13)."""
    error = predicted - measured
    turn = multiply(conjugate(measured[..., 6:10]), predicted[..., 6:10])
    angle = 2.0 * np.arctan2(np.linalg.norm(turn[..., 1:], axis=-1), np.abs(turn[..., 0]))
    norms = [np.linalg.norm(error[..., part], axis=-1) for part in (slice(3), slice(3, 6), slice(10, 13))]
    return np.stack([*norms[:2], angle, norms[2]], axis=-1)


def _simulate(model: Identification, record: Record, rows: Indices, initial: Array, *, turns: bool) -> Array:
    """(W, K, 13) states from (W, 13) at the samples (W, K) of windows, by the classical Runge-Kutta method.

    Without `turns`, the body rates stay as they are.
    """
    steps = math.ceil(record.period / _STEP - 1e-9)
    h = record.period / steps
    rotors = _rotor_speeds(model, record, 2 * steps)  # also at the middle of each step
    x, states = initial.copy(), [initial]
    spin = _spin(model.vehicle)
    x[:, 12] += rotors[2 * steps * rows[:, 0]] @ spin  # the third rate becomes r + h_z / Jz: no dw/dt is needed
    for sample in rows.T[:-1]:
        for i in range(0, 2 * steps, 2):
            begin, middle, end = (rotors[2 * steps * sample + i + part] for part in range(3))
            k1 = _derivative(model, x, begin, turns=turns)
            k2 = _derivative(model, x + 0.5 * h * k1, middle, turns=turns)
            k3 = _derivative(model, x + 0.5 * h * k2, middle, turns=turns)
            k4 = _derivative(model, x + h * k3, end, turns=turns)
            x = x + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
        x[:, 6:10] /= np.linalg.norm(x[:, 6:10], axis=1, keepdims=True)
        state = x.copy()
        state[:, 12] -= rotors[2 * steps * (sample + 1)] @ spin
        states.append(state)
    return np.stack(states, axis=1)


def _spin(vehicle: Vehicle) -> Array:
    """(4,) share of each rotor speed in h_z / Jz."""
    return -(vehicle.rotor_inertia or 0.0) / vehicle.inertia[2] * np.array(vehicle.rotor_spins, float)


def _rotor_speeds(model: Identification, record: Record, fineness: int) -> Array:
    """(fineness N, 4) rotor speeds, so many per sample [rad/s]."""
    vehicle, period = model.vehicle, record.period / fineness
    if record.speeds is not None:
        t = record.t[0] + period * np.arange(fineness * len(record.t)) - model.delay
        return np.stack([np.interp(t, record.t, measured) for measured in _filled(record.speeds).T], axis=1)
    if record.commands is not None:
        commands = np.clip(record.commands, vehicle.speed_min, vehicle.speed_max)
    else:
        assert record.throttle is not None
        u, a = np.clip(record.throttle, 0.0, 1.0), model.throttle_curve
        commands = vehicle.speed_max * np.sqrt((1.0 - a) * u + a * u**2)
    if record.voltage is not None and model.voltage is not None:
        commands = commands * (record.voltage / model.voltage)[:, None] ** (0.5 * model.voltage_exponent)
    held = np.repeat(_filled(commands), fineness, axis=0)
    rise, fall = vehicle.rotor_rise or _AT_ONCE, vehicle.rotor_fall or _AT_ONCE
    return lagging(held, period, rise=rise, fall=fall, delay=model.delay).speeds


def _filled(rows: Array) -> Array:
    """Rows (N, 4) with the last finite one held in gaps."""
    there = np.isfinite(rows).all(axis=1)
    return rows[np.maximum.accumulate(np.where(there, np.arange(len(rows)), there.argmax()))]


def _derivative(model: Identification, x: Array, w: Array, *, turns: bool) -> Array:
    """Time derivative of states (W, 13) under rotor speeds (W, 4): rigid body, thrust, drag, and rotors' momentum.

    Equations: `quadsim.sim.effects.forces` and, of the body's drag, `quadsim.sim.airframe`.
    """
    vehicle, q = model.vehicle, x[:, 6:10]
    J = np.array(vehicle.inertia)
    momentum = J[2] * (w @ _spin(vehicle))
    rates = x[:, 10:].copy()
    rates[:, 2] -= momentum / J[2]
    places = vehicle.rotor_positions - [*model.offset, 0.0]
    air = _turned(conjugate(q), x[:, 3:6] - [*model.wind, 0.0])
    forces = -(vehicle.rotor_drag or 0.0) * w[..., None] * (air[:, None] + np.cross(rates[:, None], places))
    forces[..., 2] = vehicle.thrust_coefficient * w**2
    force = forces.sum(axis=1) + _body_drag(vehicle, air)
    dx = np.empty_like(x)
    dx[:, :3] = x[:, 3:6]
    dx[:, 3:6] = _turned(q, force) / vehicle.mass - [0.0, 0.0, vehicle.gravity]
    dx[:, 6:10] = 0.5 * multiply(q, np.insert(rates, 0, 0.0, axis=1))
    dx[:, 10:] = 0.0
    if turns:
        torque = np.cross(places, forces).sum(axis=1)
        torque[:, 2] += vehicle.drag_coefficient * w**2 @ np.array(vehicle.rotor_spins) + model.yaw_trim
        whole = J * rates
        whole[:, 2] += momentum
        dx[:, 10:] = (torque - np.cross(rates, whole)) / J
    return dx


def _body_drag(vehicle: Vehicle, air: Array) -> Array:
    """(W, 3) drag [N] of the ellipsoid with the body's drag areas at velocities (W, 3) through the air, body frame."""
    areas = np.square(vehicle.body_drag or (0.0, 0.0, 0.0))
    shares = np.square(air) * areas
    area = np.sqrt(shares @ areas / np.maximum(shares.sum(axis=1), 1e-300))
    drag: Array = -0.5 * SEA_LEVEL_DENSITY * (area * np.linalg.norm(air, axis=1))[:, None] * air
    return drag


def _turned(q: Array, vectors: Array) -> Array:
    """Vectors (W, 3) turned by quaternions (W, 4)."""
    twice = 2.0 * np.cross(q[:, 1:], vectors)
    turned: Array = vectors + q[:, :1] * twice + np.cross(q[:, 1:], twice)
    return turned
