"""Increments of velocity and body rates from sample to sample, as measured and as a vehicle's parameters predict.

A segment of a log is prepared once: what was measured over each period, and the mean motion in it.  The equations of
`predicted_increments` give the same from the rotors' speeds; the search makes their difference, the misfit, small.
"""

from __future__ import annotations

import operator
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Final, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from quadsim.features.identify.record import Record, new_rows, part_of
from quadsim.features.identify.rotors import RotorMotion, lagged_rotors, measured_rotors, smoothed_speeds
from quadsim.features.identify.series import interpolated
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
        numbers: dict[str, Any] = {
            "thrust_coefficient": vehicle.mean_coefficient,
            "inertia": np.array(vehicle.inertia),
            "drag_to_thrust": vehicle.drag_to_thrust,
            "rotor_rise": vehicle.rotor_rise or 0.0,
            "rotor_fall": vehicle.rotor_fall or 0.0,
            "rotor_inertia": vehicle.rotor_inertia or 0.0,
            "rotor_drag": vehicle.rotor_drag or 0.0,
            "body_drag": np.array(vehicle.body_drag or (0.0, 0.0, 0.0)),
            "rotor_moment": np.array(vehicle.rotor_moment or (0.0, 0.0)),
            "inflow_moment": np.array(vehicle.inflow_moment or (0.0, 0.0)),
            "rate_damping": np.array(vehicle.rate_damping or (0.0, 0.0, 0.0)),
            "inflow": vehicle.inflow or 0.0,
            "throttle_curve": vehicle.throttle_share,
        }
        return cls(**(numbers | others))


@dataclass(frozen=True, kw_only=True)
class MeanMotion:
    """The motion of a vehicle over M periods, as its mean in each, or of M vehicles over one."""

    period: float  # [s]
    rates: Array  # (M, 3) body rates [rad/s]
    turn: Array  # (M, 3, 3) body to world
    velocity: Array  # (M, 3) world [m/s]


@dataclass(frozen=True, kw_only=True)
class Segment:
    """Part of a record that flies, with what no parameter changes: the measured increments and the mean motion."""

    record: Record
    flight: int  # which of those fitted together
    increments: Array  # (K, 6) of body rates [rad/s] and world velocity [m/s], from each new row to the next
    starts: Indices  # (K,) the period in which each begins; of a log without held rows, K = N - 1 and all of them
    motion: MeanMotion
    instrument_speeds: Array | None = None  # (N, 4) rotor speeds by the commands, where both are logged [rad/s]

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


def voltages(segments: Sequence[Segment]) -> Array:
    """The battery's voltage in all samples of some segments [V]; none where it is not logged."""
    logged = [segment.record.voltage for segment in segments if segment.record.voltage is not None]
    return np.concatenate([np.zeros(0), *logged])


def mean_voltage(segments: Sequence[Segment]) -> float:
    """Return the mean voltage of the battery in some segments, 0 where none is logged [V]."""
    samples = voltages(segments)
    if not samples.size:
        return 0.0
    return float(np.mean(samples))


def prepare_segment(record: Record, flight: int) -> Segment:
    """Prepare a record, all of which flies, from its first new row to its last."""
    new = new_rows(record)
    record = part_of(record, slice(new[0], new[-1] + 1))
    rows = new - new[0]
    if record.speeds is not None:
        record = replace(record, speeds=smoothed_speeds(record.speeds))
    turn = Rotation.from_quat(_filtered_attitude(record), scalar_first=True).as_matrix()
    motion = MeanMotion(period=record.period, rates=_mid(record.rates), turn=_mid(turn), velocity=_mid(record.velocity))
    rates_and_velocity = np.concatenate([record.rates, record.velocity], axis=1)
    increments = np.diff(rates_and_velocity[rows], axis=0)
    return Segment(record=record, flight=flight, increments=increments, starts=rows[:-1], motion=motion)


def _mid(rows: Array) -> Array:
    """Means (N - 1, ...) of neighbouring samples (N, ...)."""
    return 0.5 * (rows[1:] + rows[:-1])


def _filtered_attitude(record: Record) -> Array:
    """(N, 4) attitude by a complementary filter: it follows the gyro, and the logged attitude slowly."""
    share = record.period / (record.period + _SMOOTHING)
    angles = 0.5 * record.period * (record.rates[1:] + record.rates[:-1])
    filtered = [tuple(record.attitude[0].tolist())]
    for angle, logged in zip(angles.tolist(), record.attitude[1:].tolist(), strict=True):
        ahead = multiply(filtered[-1], exponential(tuple(angle)))
        sign = 1.0
        if sum(map(operator.mul, ahead, logged)) < 0.0:  # q and -q are the same attitude
            sign = -1.0
        mixed = [a + share * (sign * b - a) for a, b in zip(ahead, logged, strict=True)]
        filtered.append(normalise(tuple(mixed)))
    return np.array(filtered)


def rotor_motion(record: Record, vehicle: Vehicle, p: Parameters) -> RotorMotion:
    """The rotors' speeds, from whatever the record has of them."""
    if record.speeds is not None:
        return measured_rotors(record.speeds, record.period, delay=p.delay)
    commands = demanded_speeds(record, vehicle, p)
    return lagged_rotors(commands, record.period, rise=p.rotor_rise, fall=p.rotor_fall, delay=p.delay)


def demanded_speeds(record: Record, vehicle: Vehicle, p: Parameters) -> Array:
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


class _RotorForces(NamedTuple):
    """Forces of each rotor over M periods, body axes [N]."""

    x: Array  # (M, 4)
    y: Array  # (M, 4)
    thrust: Array  # (M, 4)


def predicted_increments(motion: MeanMotion, rotors: RotorMotion, vehicle: Vehicle, p: Parameters) -> Array:
    """(M, 6) increments of body rates and velocity in each period, as the parameters predict them.

    J dw/dt = sum r_i x f_i + tau_air - w x (J w + h e_z) - dh/dt e_z with h = -sum spin_i J_r w_i, f_i = (b w_i^2 -
    inflow w_i v_axial,i) e_z - rotor_drag w_i v_perp,i, tau_air that of `Vehicle.air_moment` at each hub;
    m dv/dt = R (sum f_i + body drag) - m g e_z.
    """
    dt = motion.period
    air = _air_velocity(motion, p)
    forces = _rotor_forces(motion, rotors, vehicle, p, air)
    torque = _torque(motion, rotors, vehicle, p, air, forces)
    angular = dt * (torque - p.rate_damping * motion.rates)
    spins = np.array(vehicle.rotor_spins, float)
    momentum_change = -(rotors.change @ spins) * p.rotor_inertia
    angular[:, 2] -= momentum_change
    every = np.ones(len(spins))
    force = np.stack([forces.x @ every, forces.y @ every, forces.thrust @ every], axis=1)
    body = force - 0.5 * SEA_LEVEL_DENSITY * p.body_drag * np.linalg.norm(air, axis=1, keepdims=True) * air
    linear = np.einsum("kij,kj->ki", motion.turn, body) / vehicle.mass - [0.0, 0.0, vehicle.gravity]
    return np.concatenate([angular / p.inertia, dt * linear], axis=1)


def _air_velocity(motion: MeanMotion, p: Parameters) -> Array:
    """(M, 3) velocity through the air, body axes [m/s]."""
    instants = np.arange(len(p.wind))
    when = np.linspace(0.0, len(p.wind) - 1.0, len(motion.rates))
    wind = interpolated(when, instants, p.wind)
    return np.asarray(np.einsum("kji,kj->ki", motion.turn, motion.velocity - wind))


def _rotor_forces(motion: MeanMotion, rotors: RotorMotion, vehicle: Vehicle, p: Parameters, air: Array) -> _RotorForces:
    """Thrust less what inflow takes, and drag, by the velocity of each hub through the air."""
    x, y, _ = vehicle.hubs.T
    roll, pitch, yaw = motion.rates.T
    axial = air[:, 2:] + roll[:, None] * y - pitch[:, None] * x
    drag = p.rotor_drag * rotors.mean
    return _RotorForces(
        x=-(drag * (air[:, :1] - yaw[:, None] * y)),
        y=-(drag * (air[:, 1:2] + yaw[:, None] * x)),
        thrust=p.thrust_coefficient * rotors.square - p.inflow * rotors.mean * axial,
    )


def _torque(
    motion: MeanMotion, rotors: RotorMotion, vehicle: Vehicle, p: Parameters, air: Array, forces: _RotorForces
) -> Array:
    """(M, 3) torque about the body axes [N m], the gyroscopic one included, without damping and the rotors' spin-up."""
    x, y, _ = vehicle.hubs.T
    roll, pitch, yaw = motion.rates.T
    jx, jy, jz = p.inertia
    spins = np.array(vehicle.rotor_spins, float)
    every = np.ones(len(spins))
    thrust = forces.thrust
    total_thrust = thrust @ every
    total_speed = rotors.mean @ every
    momentum = -(rotors.mean @ spins) * p.rotor_inertia
    about_x = (
        thrust @ y
        - p.offset[1] * total_thrust
        + p.rotor_moment[0] * (total_speed * air[:, 1] + yaw * (rotors.mean @ x))
        - p.inflow_moment[0] * air[:, 1] * air[:, 2]
        - momentum * pitch
        - (jz - jy) * pitch * yaw
    )
    about_y = (
        p.offset[0] * total_thrust
        - thrust @ x
        - p.rotor_moment[1] * (total_speed * air[:, 0] - yaw * (rotors.mean @ y))
        + p.inflow_moment[1] * air[:, 0] * air[:, 2]
        + momentum * roll
        - (jx - jz) * roll * yaw
    )
    about_z = p.drag_to_thrust * (thrust @ spins) + forces.y @ x - forces.x @ y + p.yaw_trim - (jy - jx) * roll * pitch
    return np.stack([about_x, about_y, about_z], axis=1)
