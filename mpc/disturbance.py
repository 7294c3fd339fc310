"""Estimates of unmodelled force and torque, and of the force's rate of change.

The mean acceleration over a period that the model misses,

    d = (v(k) - v(k-1)) / tau_s + g e_z - mean(f / m R e_z + R d_drag),

The mean angular acceleration is defined in the same way.  Two states follow each of them, the disturbance and its rate
of change, with both poles of the error at exp(-bandwidth tau_s): the critically damped g-h filter (Morrison,
"Introduction to Sequential Smoothing and Prediction", 1969).  It tracks a disturbance that changes at a constant rate
without lag; drag on a curved path nearly does so.  The estimate of a constant disturbance in `mpc.observer` lags by its
time constant.

A vehicle with rotor lag has rotor inertia: the torque that accelerates the rotors acts on the body, and their momentum
turns with it.  On a Hummingbird at a period of 25 ms, a change of commands turns the body more through this torque than
through rotor drag.  A controller that compensated it as a disturbance would oscillate.

With f / m computed from the rotor commands, this is the acceleration feedback of incremental nonlinear dynamic
inversion (Tal and Karaman, "Accurate tracking of aggressive quadrotor trajectories using incremental nonlinear dynamic
inversion and differential flatness", 2021), f / m R e_z - g e_z + d = v', with a prediction in place of the lag of a
low-pass filter.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Final

import numpy as np
from annotated_types import doc
from numpy.typing import ArrayLike

from quadsim.fields import NonNegative, Positive
from quadsim.state import Array
from quadsim.vehicle import Vehicle

FORCE_SHARE: Final = 0.5
"""Default bandwidth of the force estimate times the control period."""
TORQUE_SHARE: Final = 0.25
"""Default bandwidth of the torque estimate times the control period."""
FITTED_FROM: Final = 1.0
"""Speed along an axis [m/s] at which the fitted drag explains half of the force."""
_SAME_TIME: Final = 1e-6  # [s]


@dataclass(frozen=True, kw_only=True)
class RampSettings:
    """Settings of the disturbance estimate: unmodelled force, its rate of change, and torque."""

    force: Annotated[
        Positive | None, doc(f"[rad/s] bandwidth of the force estimate; absent: {FORCE_SHARE:g} / control period")
    ] = None
    torque: Annotated[
        Positive | None, doc(f"[rad/s] bandwidth of the torque estimate; absent: {TORQUE_SHARE:g} / control period")
    ] = None
    drag_memory: Annotated[
        Positive, doc("[s] window for fitting linear drag to the force, for a nonlinear MPC's predictions")
    ] = 1.0
    rotor_lag: Annotated[
        NonNegative | None,
        doc("[s] rotor time constant; absent: that of the controller's prediction, or 0"),
    ] = None
    largest_force: Annotated[Positive, doc("[m/s^2] larger estimates are clipped")] = 20.0
    largest_torque: Annotated[Positive, doc("[rad/s^2] larger estimates are clipped")] = 100.0


class RampObserver:
    """The six filters, an evolving state: three for the force (world axes) and three for the torque (body axes).

    The model knows `drag` (3,) [1/s] and `quadratic_drag` (3,) [1/m], of the square of each component, in body axes.
    """

    def __init__(
        self,
        settings: RampSettings,
        vehicle: Vehicle,
        period: float,
        *,
        drag: ArrayLike = (0.0, 0.0, 0.0),
        quadratic_drag: ArrayLike = (0.0, 0.0, 0.0),
    ) -> None:
        force = FORCE_SHARE / period if settings.force is None else settings.force
        torque = TORQUE_SHARE / period if settings.torque is None else settings.torque
        pole = np.exp(-period * np.repeat([force, torque], 3))
        self._gain, self._gain_of_change = 1.0 - pole**2, (1.0 - pole) ** 2 / period
        self._largest = np.repeat([settings.largest_force, settings.largest_torque], 3)
        self._vehicle, self._period, self._lag = vehicle, period, settings.rotor_lag or 0.0
        inertia = (vehicle.rotor_inertia or 0.0) if self._lag else 0.0
        self._momentum = -inertia * np.array(vehicle.rotor_spins, float)
        self._drag, self._quadratic = np.array(drag, float), np.array(quadratic_drag, float)
        self._decay = math.exp(-period / settings.drag_memory)
        self._ballast = FITTED_FROM**2 / (1.0 - self._decay)
        self._up = np.array([0.0, 0.0, vehicle.gravity])
        self.reset(np.full(4, vehicle.hover_speed))

    def reset(self, rotors: Array) -> None:
        """Clear the estimates; the rotors turn at `rotors` (4,) [rad/s]."""
        self._value, self._change = np.zeros(6), np.zeros(6)
        self._products, self._squares = np.zeros(3), np.zeros(3)
        self._rotors = np.array(rotors, float)
        self._last: tuple[Array, Array, Array, Array] | None = None
        self._time = 0.0

    def adopt(self, other: RampObserver) -> None:
        """Take over the state of another observer."""
        self._value = np.clip(other._value, -self._largest, self._largest)
        self._change, self._rotors = other._change, other._rotors
        self._products, self._squares = other._products, other._squares
        self._last, self._time = other._last, other._time

    def update(self, time: float, velocity: Array, attitude: Array, rates: Array, speeds: Array) -> None:
        """Update the estimates at the end of a period; after a gap, only record the start of the next one.

        Measured values: velocity (3,), world; attitude (3, 3), body to world; body rates (3,). The speeds (4,) [rad/s]
        were commanded over the period that ends.
        """
        period, J = self._period, np.array(self._vehicle.inertia)
        spun, squares = self._rotors, self._mean_squares(speeds)
        axis, turning = attitude[:, 2], attitude @ np.array([rates[1], -rates[0], 0.0])
        v_b = attitude.T @ velocity
        drag = -attitude @ ((self._drag + self._quadratic * np.abs(v_b)) * v_b)
        momentum = J * rates
        momentum[2] += self._momentum @ self._rotors
        now = velocity, rates, np.concatenate([axis, turning]), np.concatenate([drag, np.cross(rates, momentum)])
        last, self._last = self._last, now
        before, self._time = self._time, time
        if last is None or abs(time - before - period) > _SAME_TIME:
            return
        # Mean over the period from its two ends; for the thrust axis also from its derivative (Euler-Maclaurin).
        b = 0.5 * (last[2][:3] + axis) + period / 12.0 * (last[2][3:] - turning)
        drag, gyroscopic = np.split(0.5 * (last[3] + now[3]), 2)
        thrust, torque = np.split(self._vehicle.allocation @ squares, [1])
        torque[2] -= self._momentum @ (self._rotors - spun) / period
        missed = np.concatenate(
            [
                (velocity - last[0]) / period + self._up - thrust / self._vehicle.mass * b - drag,
                (rates - last[1]) / period - (torque - gyroscopic) / J,
            ]
        )
        predicted = self._value + period * self._change
        surprise = missed - predicted
        value = predicted + self._gain * surprise
        self._value = np.clip(value, -self._largest, self._largest)
        self._change = np.where(value == self._value, self._change + self._gain_of_change * surprise, 0.0)
        d_b = attitude.T @ self.foreseen(0.0)[0]
        self._products, self._squares = self._decay * self._products + d_b * v_b, self._decay * self._squares + v_b**2

    def foreseen(self, ahead: float) -> tuple[Array, Array, Array]:
        """Predict the disturbance `ahead` [s] after the last measurement: three arrays (3,).

        Acceleration [m/s^2] and its rate of change [m/s^3], world axes; angular acceleration [rad/s^2], body axes.
        """
        value = self._value + (0.5 * self._period + ahead) * self._change  # the estimate is for mid-period
        return value[:3], self._change[:3], value[3:]

    @property
    def drag(self) -> Array:
        """(3,) linear drag [1/s], body axes, beyond the model's: the part of the force that follows the velocity.

        A least-squares fit of d_b + diag(drag) v_b that weights older samples less; zero while the vehicle is slow.
        """
        return np.maximum(-self._products / (self._squares + self._ballast), 0.0)

    def _mean_squares(self, speeds: Array) -> Array:
        """(4,) mean squares of the rotor speeds over the period, which tend to `speeds` exponentially [rad^2/s^2]."""
        if self._lag == 0.0:
            return np.square(speeds)
        away, share = self._rotors - speeds, self._lag / self._period
        left = math.exp(-1.0 / share)
        self._rotors = speeds + left * away
        return np.asarray(
            speeds**2 + 2.0 * share * (1.0 - left) * speeds * away + 0.5 * share * (1.0 - left**2) * away**2
        )
