"""Increments of velocity and body rates from sample to sample, as measured and as a vehicle's parameters predict."""

from __future__ import annotations

import operator
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Final

import numpy as np
from scipy.spatial.transform import Rotation

from quadsim.features.identify.record import Record, part_of
from quadsim.features.identify.rotors import Turning, lagging, measured, smoothed
from quadsim.rotation import exponential, multiply, normalise
from quadsim.sim.effects.wind import SEA_LEVEL_DENSITY
from quadsim.state import Array, Indices
from quadsim.vehicle import Vehicle

INCREMENTS: Final = ("roll", "pitch", "yaw", "vx", "vy", "vz")
_SMOOTHING: Final = 0.1
"""Time constant [s] below which the attitude follows the gyro: it averages the noise of the attitude itself."""


@dataclass(frozen=True, kw_only=True)
class Parameters:
    """Everything that the prediction depends on, in SI units; see `Vehicle`."""

    thrust_coefficient: float
    inertia: Array  # (3,)
    drag_to_thrust: float
    rotor_rise: float = 0.0  # not used where speeds were measured [s]
    rotor_fall: float = 0.0
    delay: float = 0.0  # of the commands [s]
    rotor_inertia: float
    rotor_drag: float
    body_drag: Array  # (3,)
    rotor_moment: Array  # (2,)
    inflow_moment: Array  # (2,)
    rate_damping: Array  # (3,)
    offset: Array = field(default_factory=lambda: np.zeros(2))  # (2,) centre of mass in the rotors' frame [m]
    wind: Array = field(default_factory=lambda: np.zeros((2, 3)))
    """(W, 3) world, linear between W instants from first sample to last [m/s]."""
    inflow: float = 0.0  # thrust lost per rotor speed and air speed along the axis [N s^2/(m rad)]
    yaw_trim: float = 0.0  # constant yaw torque that is not the rotors' [N m]
    throttle_curve: float = 1.0  # a of w^2 / w_max^2 = (1 - a) v + a v^2, v `Vehicle.effective_throttle` [-]
    voltage_exponent: float = 0.0  # n of thrust over voltage, (V / V0)^n
    voltage: float = 0.0  # V0, at which the thrust coefficient holds [V]

    @classmethod
    def of(cls, vehicle: Vehicle, **others: Any) -> Parameters:
        """Those of a vehicle, with `others` for what its file has no field for."""
        own: dict[str, Any] = {name: getattr(vehicle, name) or 0.0 for name in ("rotor_rise", "rotor_fall")}
        own |= {name: getattr(vehicle, name) or 0.0 for name in ("rotor_inertia", "rotor_drag", "inflow")}
        own |= {"thrust_coefficient": vehicle.mean_coefficient, "drag_to_thrust": vehicle.drag_to_thrust}
        own |= {"throttle_curve": vehicle.throttle_share}
        vectors = {"rotor_moment": 2, "inflow_moment": 2, "rate_damping": 3, "body_drag": 3}
        own |= {name: np.array(getattr(vehicle, name) or (0.0,) * n) for name, n in vectors.items()}
        return cls(**({"inertia": np.array(vehicle.inertia)} | own | others))


@dataclass(frozen=True, kw_only=True)
class MeanMotion:
    """The motion of a vehicle over M periods, as its mean in each, or of M vehicles over one."""

    period: float  # [s]
    rates: Array  # (M, 3) body rates [rad/s]
    turn: Array  # (M, 3, 3) body to world
    velocity: Array  # (M, 3) world [m/s]


@dataclass(frozen=True, kw_only=True)
class Stretch:
    """Part of a record that flies, with what no parameter changes."""

    record: Record
    flight: int  # which of those fitted together
    increments: Array  # (K, 6) of body rates [rad/s] and world velocity [m/s], from each new row to the next
    starts: Indices  # (K,) the period in which each begins; of a log without held rows, K = N - 1 and all of them
    motion: MeanMotion
    foretold: Array | None = None  # (N, 4) rotor speeds by the commands, where both are logged [rad/s]

    @property
    def seconds(self) -> float:
        """How long it flies [s]."""
        return self.record.period * len(self.motion.rates)

    @property
    def step(self) -> float:
        """Mean time from a new row to the next [s]."""
        return self.seconds / len(self.increments)

    def misfit(self, predicted: Array) -> Array:
        """(K, 6) increments less those that are predicted for each period (N - 1, 6)."""
        if len(self.starts) < len(predicted):
            predicted = np.add.reduceat(predicted, self.starts, axis=0)
        return self.increments - predicted


def mean_voltage(parts: Sequence[Stretch]) -> float:
    """Return the mean voltage of the battery in some stretches, 0 where none is logged [V]."""
    voltages = [part.record.voltage for part in parts if part.record.voltage is not None]
    if voltages:
        return float(np.mean(np.concatenate(voltages)))
    return 0.0


def stretch(record: Record, flight: int) -> Stretch:
    """Prepare a record, all of which flies, from its first new row to its last."""
    if record.fresh is None:
        rows = np.arange(len(record.t))
    else:
        rows = np.flatnonzero(record.fresh)
    record = part_of(record, slice(rows[0], rows[-1] + 1))
    rows = rows - rows[0]
    if record.speeds is not None:
        record = replace(record, speeds=smoothed(record.speeds))
    turn = Rotation.from_quat(_smoothed(record), scalar_first=True).as_matrix()
    means = (0.5 * (rows[1:] + rows[:-1]) for rows in (record.rates, turn, record.velocity))
    rates, turns, velocity = means
    return Stretch(
        record=record,
        flight=flight,
        increments=np.diff(np.concatenate([record.rates, record.velocity], axis=1)[rows], axis=0),
        starts=rows[:-1],
        motion=MeanMotion(period=record.period, rates=rates, turn=turns, velocity=velocity),
    )


def _smoothed(record: Record) -> Array:
    """(N, 4) attitude as a complementary filter of attitude and gyro gives it."""
    share = record.period / (record.period + _SMOOTHING)
    halves = 0.5 * record.period * (record.rates[1:] + record.rates[:-1])
    smoothed = [tuple(record.attitude[0].tolist())]
    for angle, seen in zip(halves.tolist(), record.attitude[1:].tolist(), strict=True):
        ahead = multiply(smoothed[-1], exponential(tuple(angle)))
        if sum(map(operator.mul, ahead, seen)) >= 0.0:
            sign = 1.0
        else:
            sign = -1.0
        smoothed.append(normalise(tuple(a + share * (sign * b - a) for a, b in zip(ahead, seen, strict=True))))
    return np.array(smoothed)


def turning(record: Record, vehicle: Vehicle, p: Parameters) -> Turning:
    """The rotors' speeds, from whatever the record has of them."""
    if record.speeds is not None:
        return measured(record.speeds, record.period, delay=p.delay)
    commands = commanded(record, vehicle, p)
    return lagging(commands, record.period, rise=p.rotor_rise, fall=p.rotor_fall, delay=p.delay)


def commanded(record: Record, vehicle: Vehicle, p: Parameters) -> Array:
    """(N, 4) rotor speeds that the commands or the throttle demand [rad/s]."""
    if record.commands is not None:
        commands = record.commands
    else:
        assert record.throttle is not None
        share = vehicle.effective_throttle(np.clip(record.throttle, 0.0, 1.0))
        slope = np.maximum(1.0 - p.throttle_curve * (1.0 - share), 1e-3)
        commands = vehicle.speed_max * np.sqrt(slope * share)
    if record.voltage is not None and p.voltage_exponent:
        commands = commands * (record.voltage / p.voltage)[:, None] ** (0.5 * p.voltage_exponent)
    return np.asarray(commands)


def predicted_increments(motion: MeanMotion, rotors: Turning, vehicle: Vehicle, p: Parameters) -> Array:
    """(M, 6) increments of body rates and velocity in each period, as the parameters predict them.

    J dw/dt = sum r_i x f_i + tau_air - w x (J w + h e_z) - dh/dt e_z with h = -sum spin_i J_r w_i, f_i = (b w_i^2 -
    inflow w_i v_axial,i) e_z - rotor_drag w_i v_perp,i, tau_air that of `Vehicle.air_moment` at each hub;
    m dv/dt = R (sum f_i + body drag) - m g e_z.
    """
    x, y, _ = vehicle.hubs.T
    spin = np.array(vehicle.rotor_spins, float)
    dt, jx, jy, jz = motion.period, *p.inertia
    when = np.linspace(0.0, len(p.wind) - 1.0, len(motion.rates))
    wind = np.stack([np.interp(when, np.arange(len(p.wind)), w) for w in p.wind.T], axis=1)
    air = np.einsum("kji,kj->ki", motion.turn, motion.velocity - wind)  # body axes
    roll, pitch, yaw = motion.rates.T
    axial = air[:, 2:] + roll[:, None] * y - pitch[:, None] * x
    thrust = p.thrust_coefficient * rotors.square - p.inflow * rotors.mean * axial
    dragging = p.rotor_drag * rotors.mean
    every = np.ones(len(spin))
    turning_speed = rotors.mean @ every
    side = -(dragging * (air[:, :1] - yaw[:, None] * y)), -(dragging * (air[:, 1:2] + yaw[:, None] * x))
    total = thrust @ every
    force = np.stack([side[0] @ every, side[1] @ every, total], axis=1)
    momentum = -(rotors.mean @ spin) * p.rotor_inertia
    spun_up = -(rotors.change @ spin) * p.rotor_inertia
    torque = np.stack(
        [
            thrust @ y
            - p.offset[1] * total
            + p.rotor_moment[0] * (turning_speed * air[:, 1] + yaw * (rotors.mean @ x))
            - p.inflow_moment[0] * air[:, 1] * air[:, 2]
            - momentum * pitch
            - (jz - jy) * pitch * yaw,
            p.offset[0] * total
            - thrust @ x
            - p.rotor_moment[1] * (turning_speed * air[:, 0] - yaw * (rotors.mean @ y))
            + p.inflow_moment[1] * air[:, 0] * air[:, 2]
            + momentum * roll
            - (jx - jz) * roll * yaw,
            p.drag_to_thrust * (thrust @ spin) + side[1] @ x - side[0] @ y + p.yaw_trim - (jy - jx) * roll * pitch,
        ],
        axis=1,
    )
    angular = dt * (torque - p.rate_damping * motion.rates)
    angular[:, 2] -= spun_up
    body = force - 0.5 * SEA_LEVEL_DENSITY * p.body_drag * np.linalg.norm(air, axis=1, keepdims=True) * air
    linear = np.einsum("kij,kj->ki", motion.turn, body) / vehicle.mass - [0.0, 0.0, vehicle.gravity]
    return np.concatenate([angular / p.inertia, dt * linear], axis=1)
