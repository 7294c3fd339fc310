"""Laws of the compiled plant in NumPy, written from their equations, against which it is tested."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from quadsim.sim.autopilot import AutopilotSettings
from quadsim.sim.effects import Push
from quadsim.sim.effects.battery import Battery
from quadsim.sim.effects.rotors import RotorDynamics
from quadsim.state import Array
from quadsim.vehicle import Vehicle

LOWEST_RATIO = 0.5  # height in radii below which the ground effect grows no further


def respond(rotors: RotorDynamics, speeds: Array, target: Array, elapsed: Array) -> tuple[Array, Array]:
    """Speeds (M, 4) and accelerations (M, 4) of rotors at times (M,) after a command: a line, then an exponential."""
    gap = target - speeds
    sign = np.sign(gap)
    distance = np.abs(gap)
    lag = np.where(gap >= 0.0, rotors.rise or 0.0, rotors.fall or 0.0)
    steepest = rotors.acceleration or math.inf
    eased = distance if math.isinf(steepest) else np.minimum(distance, steepest * lag)
    ramp_end = (distance - eased) / steepest  # the slope is limited until then; 0 without a limit
    t = elapsed[:, None]
    ramping = t < ramp_end
    rate = np.divide(1.0, lag, out=np.zeros_like(lag), where=lag > 0.0)
    decay = np.where(lag > 0.0, np.exp(-rate * np.maximum(t - ramp_end, 0.0)), 0.0)
    limit = steepest if math.isfinite(steepest) else 0.0
    after = np.where(ramping, speeds + sign * limit * t, target - sign * eased * decay)
    return after, np.where(ramping, sign * limit, sign * eased * rate * decay)


def open_circuit(battery: Battery, charge: float) -> float:
    """E(s) [V]."""
    charges, voltages = np.array(battery.curve).T
    return battery.cells * float(np.interp(charge, charges, voltages))


def discharge(battery: Battery, charge: float, demands: Sequence[float], timestep: float) -> tuple[Array, float]:
    """Voltage and charge (M, 2) over steps with demands sum_i e_i (w_i / w_hover)^3 / 4, and the charge after them."""
    assert battery.hover_current is not None
    assert battery.reference_voltage is not None
    rows = []
    for demand in demands:
        conductance = battery.hover_current * demand / battery.reference_voltage**2
        rest = max(open_circuit(battery, charge) - battery.resistance * battery.idle_current, 0.0)
        voltage = 2.0 * rest / (1.0 + math.sqrt(1.0 + 4.0 * battery.resistance * conductance * rest))
        rows.append([voltage, charge])
        current = conductance * voltage**2 + battery.idle_current
        charge = max(charge - timestep * current / (3600.0 * battery.capacity), 0.0)
    return np.array(rows), charge


def thrust_ratio(height: float, radius: float) -> float:
    """Cheeseman and Bennett: T / T_inf = 1 / (1 - (R / (4 z))^2), for z > R / 2."""
    return float(1.0 / (1.0 - (0.25 * radius / max(height, LOWEST_RATIO * radius)) ** 2))


def rotor_drag(vehicle: Vehicle, coefficient: float, speeds: Array, turn: Rotation, air: Array, rates: Array) -> Array:
    """F_i = -k w_i v_i in each rotor's plane, v_i the air's speed at its hub: force, world, and torque, body (6,)."""
    force = np.zeros(3)
    torque = np.zeros(3)
    for place, speed in zip(vehicle.hubs, speeds, strict=True):
        at_hub = turn.inv().apply(air) + np.cross(rates, place)
        pull = -coefficient * speed * at_hub * [1.0, 1.0, 0.0]
        force += pull
        torque += np.cross(place, pull)
    return np.concatenate([turn.apply(force), torque])


def rotor_moment(
    vehicle: Vehicle, moment: tuple[float, float], speeds: Array, turn: Rotation, air: Array, rates: Array
) -> Array:
    """(m_x w_i v_y, -m_y w_i v_x, 0), v each rotor's velocity through the air, body (3,)."""
    torque = np.zeros(3)
    for place, speed in zip(vehicle.hubs, speeds, strict=True):
        across = turn.inv().apply(air) + np.cross(rates, place)
        torque += speed * np.array([moment[0] * across[1], -moment[1] * across[0], 0.0])
    return torque


def inflow_moment(moment: tuple[float, float], turn: Rotation, air: Array) -> Array:
    """v_z (-k_x v_y, k_y v_x, 0), v the body's velocity through the air, body (3,)."""
    x, y, z = turn.inv().apply(air)
    return np.asarray(z * np.array([-moment[0] * y, moment[1] * x, 0.0]))


def inflow(vehicle: Vehicle, coefficient: float, speeds: Array, turn: Rotation, air: Array, rates: Array) -> Array:
    """-c w_i v_z,i of each rotor's thrust, v_z,i its hub's velocity through the air along body z, with what that turns.

    Force, world, and torque, body (6,): of arm times thrust, and of the reaction that follows the thrust.
    """
    force = np.zeros(3)
    torque = np.zeros(3)
    for place, speed, spin in zip(vehicle.hubs, speeds, vehicle.rotor_spins, strict=True):
        at_hub = turn.inv().apply(air) + np.cross(rates, place)
        lost = np.array([0.0, 0.0, coefficient * speed * at_hub[2]])
        force -= lost
        torque -= np.cross(place, lost) + spin * vehicle.drag_to_thrust * lost
    return np.concatenate([turn.apply(force), torque])


def axis_drag(linear: Sequence[float], quadratic: Sequence[float], turn: Rotation, air: Array) -> Array:
    """F_i = -(l_i + k_i |v_i|) v_i along the body's axes, world (3,)."""
    along = turn.inv().apply(air)
    return np.asarray(turn.apply(-(np.array(linear) + np.array(quadratic) * np.abs(along)) * along))


def pushed(push: Push, turn: Rotation) -> Array:
    """Force, world, and torque r x R' F, body (6,)."""
    return np.concatenate([push.force, np.cross(push.point, turn.inv().apply(push.force))])


def ground_effect(
    vehicle: Vehicle, radius: float, thrusts: Array, turn: Rotation, height: float, floor: float, disc: float
) -> Array:
    """What the rotors' thrusts gain near the ground: force, world, and torque, body (6,)."""
    force = 0.0
    torque = np.zeros(3)
    for place, thrust in zip(vehicle.hubs, thrusts, strict=True):
        above = height - floor + turn.apply(place + np.array([0.0, 0.0, disc]))[2]
        gain = thrust * (thrust_ratio(above, radius) - 1.0)
        force += gain
        torque += np.cross([place[0], place[1], 0.0], [0.0, 0.0, gain])
    return np.concatenate([turn.apply([0.0, 0.0, force]), torque])


def mix(vehicle: Vehicle, settings: AutopilotSettings, thrust: float, torque: Array) -> tuple[Array, Array]:
    """The rotors' thrusts (4,) for a collective thrust and a torque (3,), and the axes that are cut."""
    assert settings.idle is not None
    lift = 4.0 * vehicle.thrust_shares  # thrusts are in units of this, so that a collective thrust is the same for all
    low, high = (
        vehicle.coefficients * speed**2 / lift for speed in (settings.idle * vehicle.speed_max, vehicle.speed_max)
    )
    to_thrusts = np.linalg.inv(vehicle.allocation / vehicle.coefficients) / lift[:, None]
    level = to_thrusts[:, 1:3] @ torque[:2]
    yaw = to_thrusts[:, 3] * torque[2]
    base = min(max(0.25 * thrust, low.max()), high.min())
    airmode = settings.airmode
    signs = np.concatenate([np.eye(4), -np.eye(4)])
    differences = np.eye(4)[:, None] - np.eye(4)
    rows = differences.reshape(16, 4) if airmode else signs
    if airmode:
        limits = (high[:, None] - low).ravel()
    else:
        limits = np.tile(np.minimum(base - low, high - base), 2)
    parts = rows @ level
    share = 1.0
    for limit, part in zip(limits, parts, strict=True):
        if part > 0.0:
            share = min(share, limit / part)
    level = share * level
    # With airmode only the differences of the parts are limited: the collective thrust yields.
    least = 1e-9 * float(np.abs(yaw).max())  # rotors that turn alike differ by rounding
    turn = 1.0
    for limit, part, change in zip(limits, rows @ level, rows @ yaw, strict=True):
        if change > least:
            turn = min(turn, (limit - part) / change)
    turn = max(turn, 0.0)
    parts = level + turn * yaw
    if airmode:
        base = min(max(base, float((low - parts).max())), float((high - parts).min()))
    return lift * np.clip(base + parts, low, high), np.array([share < 1.0, share < 1.0, turn < 1.0])


class NumpyAutopilot:
    """The equations of `quadsim.sim.autopilot`."""

    def __init__(self, vehicle: Vehicle, settings: AutopilotSettings) -> None:
        self.vehicle = vehicle
        self.settings = settings.resolved(vehicle)
        assert self.settings.rate is not None
        assert self.settings.delay is not None
        self.step = 1.0 / self.settings.rate
        hover = vehicle.hover_speeds
        self.integral = np.zeros(3)
        self.filtered = np.zeros(3)
        self.slope = np.zeros(3)
        self.queue = deque([hover] * round(self.settings.delay * self.settings.rate))

    def _share(self, cutoff: float | None) -> float:
        return 1.0 - math.exp(-math.tau * cutoff * self.step) if cutoff else 1.0

    def speeds(self, target: Array, rates: Array, attitude: Array) -> Array:
        s = self.settings
        J = self.vehicle.inertia_matrix
        assert s.largest_rate is not None
        demanded = target[1:4]
        if target.size > 4:
            turn = Rotation.from_quat(attitude, scalar_first=True).inv() * Rotation.from_quat(
                target[4:], scalar_first=True
            )
            w, *vector = turn.as_quat(scalar_first=True)
            largest = np.radians(s.largest_rate)
            demanded = np.clip(
                demanded + np.array(s.attitude) * 2.0 * math.copysign(1.0, w) * np.array(vector), -largest, largest
            )
        before = self.filtered
        self.filtered = before + self._share(s.gyro_cutoff) * (rates - before)
        self.slope = self.slope + self._share(s.d_cutoff) * ((self.filtered - before) / self.step - self.slope)
        error = demanded - self.filtered
        torque = J @ (np.array(s.p) * error + self.integral - np.array(s.d) * self.slope)
        thrusts, cut = mix(self.vehicle, s, float(target[0]), torque + np.cross(self.filtered, J @ self.filtered))
        integral = np.clip(self.integral + self.step * np.array(s.i) * error, -np.array(s.i_max), np.array(s.i_max))
        self.integral = np.where(cut, self.integral, integral)
        self.queue.append(np.sqrt(thrusts / self.vehicle.coefficients))
        return self.queue.popleft()
