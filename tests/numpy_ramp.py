"""The observer of changing forces in NumPy, written from its equations, against which the core is tested."""

from __future__ import annotations

import math

import numpy as np

from quadsim.mpc.estimate.disturbance import (
    FITTED_FROM,
    FORCE_SHARE,
    LARGEST_CHANGE,
    OBSERVABLE_THRUST,
    TORQUE_SHARE,
    RampSettings,
)
from quadsim.state import Array
from quadsim.vehicle import Vehicle


class NumpyRamp:
    """Filters of force and torque with default bandwidths; see `quadsim.mpc.estimate.disturbance`."""

    def __init__(
        self,
        settings: RampSettings,
        vehicle: Vehicle,
        period: float,
        *,
        drag: Array,
        quadratic_drag: Array,
        moment: bool,
        thrust_lag: float | None,
        acting: Array,
    ) -> None:
        self.vehicle = vehicle
        self.period = period
        self.drags = (drag, quadratic_drag)
        self.moment = moment
        self.targets = thrust_lag is not None
        self.lag = (settings.rotor_lag if thrust_lag is None else thrust_lag) or 0
        self.scaled = settings.thrust_scale
        self.acting = acting
        self.last = None
        self.pole = np.exp(-np.repeat([FORCE_SHARE, TORQUE_SHARE], 3))
        self.largest = np.repeat([settings.largest_force, settings.largest_torque], 3)
        self.largest[2] = LARGEST_CHANGE * vehicle.gravity if self.scaled else self.largest[2]
        self.decay = math.exp(-period / settings.drag_memory)
        self.value = np.zeros(6)
        self.change = np.zeros(6)
        self.products = np.zeros(3)
        self.squares = np.zeros(3)

    @property
    def scale(self) -> float:
        ahead = self.value[2] + self.period * self.change[2]
        return 1.0 + float(np.clip(ahead / self.vehicle.gravity, -LARGEST_CHANGE, LARGEST_CHANGE)) * bool(self.scaled)

    def foreseen(self, ahead: float) -> tuple[Array, Array, Array]:
        value = self.value + (0.5 * self.period + ahead) * self.change
        change = self.change[:3].copy()
        if self.scaled:
            value[2] = change[2] = 0.0
        return value[:3], change, value[3:]

    @property
    def fitted(self) -> Array:
        return np.maximum(-self.products / (self.squares + FITTED_FROM**2 / (1.0 - self.decay)), 0.0)

    def wrench(self, command: Array) -> Array:
        """Mean over the period, by quadrature of the exponential; the actuators follow."""
        nodes, weights = np.polynomial.legendre.leggauss(20)
        share = np.exp(-self.period * (0.5 + 0.5 * nodes) / self.lag) if self.lag else np.zeros(20)
        path = command + share[:, None] * (self.acting - command)
        before, self.acting = (
            self.acting,
            command + math.exp(-self.period / self.lag if self.lag else -math.inf) * (self.acting - command),
        )
        if self.targets:
            return np.array([0.5 * weights @ path[:, 0], 0.0, 0.0, 0.0])
        wrench = self.vehicle.allocation @ (0.5 * weights @ path**2)
        wrench[1:] *= self.scale
        wrench[3] += self.rotor_momentum(before) - self.rotor_momentum(self.acting)
        return np.asarray(wrench)

    def rotor_momentum(self, speeds: Array) -> float:
        """About body z, over the period: torque where it is lost [N m]."""
        inertia = (self.vehicle.rotor_inertia or 0.0) if self.lag else 0.0
        return -inertia * float(np.array(self.vehicle.rotor_spins) @ speeds) / self.period

    def update(self, follows: bool, v: Array, R: Array, Omega: Array, command: Array) -> None:
        g = self.vehicle.gravity
        dt = self.period
        J = self.vehicle.inertia_matrix
        thrust, *torque = self.wrench(command)
        v_b, (linear, square) = R.T @ v, self.drags
        drag = -R @ ((linear + square * np.abs(v_b)) * v_b)
        axis = R[:, 2]
        turning = R @ np.cross(Omega, [0, 0, 1.0])
        momentum = J @ Omega + [0.0, 0.0, 0.0 if self.targets else dt * self.rotor_momentum(self.acting)]
        resisting = np.cross(Omega, momentum)
        if self.moment:
            resisting -= self.vehicle.air_moment(float(self.acting.sum()), v_b, Omega)
            hover = self.vehicle.hover_speeds
            still = np.zeros(3)
            damping = [self.vehicle.lost_to_inflow(hover, still, unit)[1:] for unit in np.eye(3)]
            resisting += np.diagonal(damping) * Omega
            drag -= axis * (self.vehicle.inflow or 0.0) * float(self.acting.sum()) * v_b[2] / self.vehicle.mass
        last = self.last
        self.last = (v, Omega, axis, turning, drag, resisting)
        if last is None or not follows:
            return
        lift = thrust / self.vehicle.mass * (0.5 * (last[2] + axis) + dt / 12.0 * (last[3] - turning))
        missed = (v - last[0]) / dt + [0.0, 0.0, g] - lift - 0.5 * (last[4] + drag)
        turned = (Omega - last[1]) / dt - np.linalg.solve(J, torque - 0.5 * (last[5] + resisting))
        holds = bool(self.scaled) and lift[2] < OBSERVABLE_THRUST * g
        if self.scaled:
            self.change[2] *= not holds
            s = self.value[2] / g if holds else missed[2] / lift[2]
            missed = np.array([*(missed - s * lift)[:2], g * s])
        predicted = self.value + dt * self.change
        surprise = np.concatenate([missed, 0.0 * turned if self.targets else turned]) - predicted
        free = predicted + (1.0 - self.pole**2) * surprise
        self.value = np.clip(free, -self.largest, self.largest)
        self.change = (self.change + (1.0 - self.pole) ** 2 / dt * surprise) * (free == self.value)
        if not holds:
            d_b = R.T @ self.foreseen(0.0)[0] * [1.0, 1.0, not self.scaled]
            self.products = self.decay * self.products + d_b * v_b
            self.squares = self.decay * self.squares + v_b**2
