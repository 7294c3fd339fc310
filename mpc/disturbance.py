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

With `thrust_scale`, rotors give kappa times the modelled thrust T b, per mass, with b = R e_z, and what else is missed
is a horizontal force,

    d = s T b + (a_x, a_y, 0),    s = kappa - 1 = d_z / (T b_z),    a_xy = (d - s T b)_xy.

T is the thrust commanded, at kappa = 1, and each period splits its own d, so that the filters of a_x, a_y and g s, in
place of those of d, do not act on each other.  A vertical force and a scale cannot be told apart in hover: estimates of
both drift, one growing against the other.  Where T b_z is less than `OBSERVABLE_THRUST` g, d hardly depends on the
scale, which holds, as does the fit of drag.  The torque of the commands counts kappa times, with the scale that was
foreseen for the period, by which a controller divides the wrench that it demands.  (a_x, a_y, 0) differs from d by
s T b, which has no component along the body's x and y axes; so drag is fitted along these two.  Drag along z counts as
a change of the thrust.

An autopilot takes collective thrust, which acts with the lag tau_T.  Its mean over a period is then

    T_c + (T - T_c) tau_T / tau_s (1 - exp(-tau_s / tau_T)),

with T, at its start, the thrust that acted and T_c the one commanded.  The autopilot's own integrals balance torques.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Final

import numpy as np
from annotated_types import doc
from numpy.typing import ArrayLike

from quadsim.controller import StepInputs
from quadsim.fields import NonNegative, Positive
from quadsim.rotation import cross
from quadsim.state import Array
from quadsim.vehicle import Vehicle

FORCE_SHARE: Final = 0.5
"""Default bandwidth of the force estimate times the control period."""
TORQUE_SHARE: Final = 0.25
"""Default bandwidth of the torque estimate times the control period."""
FITTED_FROM: Final = 1.0
"""Speed along an axis [m/s] at which the fitted drag explains half of the force."""
OBSERVABLE_THRUST: Final = 0.3
"""Vertical thrust as a share of the weight below which the thrust scale holds."""
LARGEST_CHANGE: Final = 0.7
"""Largest difference of the thrust scale from 1; larger estimates are clipped."""
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
    thrust_scale: Annotated[
        bool | None,
        doc(
            "true: a vertical misfit scales the thrust, as a battery's charge does, and only a horizontal one is a "
            "force; false: a force along three axes; absent: true where an autopilot takes the commands"
        ),
    ] = None
    largest_force: Annotated[Positive, doc("[m/s^2] larger estimates are clipped")] = 20.0
    largest_torque: Annotated[Positive, doc("[rad/s^2] larger estimates are clipped")] = 100.0


class RampObserver:
    """The six filters, an evolving state: three for the force (world axes) and three for the torque (body axes).

    Commands are rotor speeds, or with `thrust_lag` [s] collective thrusts [N] that act with this lag; no torque is
    estimated then. The model knows `drag` (3,) [1/s] and `quadratic_drag` (3,) [1/m], of the square of each component,
    in body axes, and with `moment` the vehicle's `air_moment`.
    """

    def __init__(
        self,
        settings: RampSettings,
        vehicle: Vehicle,
        period: float,
        *,
        drag: ArrayLike = (0.0, 0.0, 0.0),
        quadratic_drag: ArrayLike = (0.0, 0.0, 0.0),
        moment: bool = False,
        thrust_lag: float | None = None,
    ) -> None:
        force = FORCE_SHARE / period if settings.force is None else settings.force
        torque = TORQUE_SHARE / period if settings.torque is None else settings.torque
        pole = np.exp(-period * np.repeat([force, torque], 3))
        self._gain, self._gain_of_change = 1.0 - pole**2, (1.0 - pole) ** 2 / period
        self._largest = np.repeat([settings.largest_force, settings.largest_torque], 3)
        self._thrust_lag, scaled = thrust_lag, settings.thrust_scale
        self._scaled = thrust_lag is not None if scaled is None else scaled
        if self._scaled:
            self._largest[2] = LARGEST_CHANGE * vehicle.gravity
        if thrust_lag is not None:
            self._gain[3:] = self._gain_of_change[3:] = 0.0
        self._vehicle, self._period, self._lag = vehicle, period, settings.rotor_lag or 0.0
        inertia = (vehicle.rotor_inertia or 0.0) if self._lag else 0.0
        self._momentum = -inertia * np.array(vehicle.rotor_spins, float)
        self._drag, self._quadratic, self._moment = np.array(drag, float), np.array(quadratic_drag, float), moment
        self._decay = math.exp(-period / settings.drag_memory)
        self._ballast = FITTED_FROM**2 / (1.0 - self._decay)
        self._up = np.array([0.0, 0.0, vehicle.gravity])
        self._rotors, self._thrust = vehicle.hover_speeds, vehicle.mass * vehicle.gravity
        self.reset(self._rotors if thrust_lag is None else self._thrust)

    def reset(self, acting: Array | float) -> None:
        """Clear the estimates; the rotors turn at `acting` (4,) [rad/s], or give this thrust [N] with `thrust_lag`."""
        self._value, self._change = np.zeros(6), np.zeros(6)
        self._products, self._squares = np.zeros(3), np.zeros(3)
        if self._thrust_lag is None:
            self._rotors = np.array(acting, float)
        else:
            self._thrust = float(acting)
        self._last: tuple[Array, Array, Array, Array] | None = None
        self._time = 0.0

    def adopt(self, other: RampObserver) -> None:
        """Take over the state of another observer, as far as it estimates the same."""
        same_commands = (self._thrust_lag is None) == (other._thrust_lag is None)
        shared = np.array([True, True, self._scaled == other._scaled, *[same_commands] * 3])
        self._value = np.where(shared, np.clip(other._value, -self._largest, self._largest), 0.0)
        self._change = np.where(shared, other._change, 0.0)
        if same_commands:
            self._rotors, self._thrust = other._rotors, other._thrust
        self._products, self._squares = other._products, other._squares
        self._last, self._time = other._last, other._time

    def update(self, time: float, velocity: Array, attitude: Array, rates: Array, command: Array | float) -> None:
        """Update the estimates at the end of a period; after a gap, only record the start of the next one.

        Measured values: velocity (3,), world; attitude (3, 3), body to world; body rates (3,). The command was held
        over the period that ends: rotor speeds (4,) [rad/s], or the thrust [N] with `thrust_lag`.
        """
        period, vehicle = self._period, self._vehicle
        thrust, torque = self._mean_wrench(command)
        axis, turning = attitude[:, 2], attitude @ np.array([rates[1], -rates[0], 0.0])
        v_b = attitude.T @ velocity
        drag = -attitude @ ((self._drag + self._quadratic * np.abs(v_b)) * v_b)
        momentum = vehicle.momentum(rates)
        momentum[2] += self._momentum @ self._rotors
        resisting = cross(rates, momentum)
        if self._moment:
            resisting -= vehicle.air_moment(float(self._rotors.sum()), v_b, rates)
        now = velocity, rates, np.concatenate([axis, turning]), np.concatenate([drag, resisting])
        last, self._last = self._last, now
        before, self._time = self._time, time
        if last is None or abs(time - before - period) > _SAME_TIME:
            return
        # Mean over the period from its two ends; for the thrust axis also from its derivative (Euler-Maclaurin).
        b = 0.5 * (last[2][:3] + axis) + period / 12.0 * (last[2][3:] - turning)
        mean = 0.5 * (last[3] + now[3])
        drag, resisting = mean[:3], mean[3:]
        lift = thrust / vehicle.mass * b
        missed = np.concatenate(
            [
                (velocity - last[0]) / period + self._up - lift - drag,
                (rates - last[1]) / period - vehicle.angular_acceleration(torque - resisting),
            ]
        )
        holds = False
        if self._scaled:
            g = self._vehicle.gravity
            if holds := bool(lift[2] < OBSERVABLE_THRUST * g):
                self._change[2] = 0.0
            s = self._value[2] / g if holds else missed[2] / lift[2]
            missed[:2], missed[2] = missed[:2] - s * lift[:2], g * s
        predicted = self._value + period * self._change
        surprise = missed - predicted
        value = predicted + self._gain * surprise
        self._value = np.minimum(np.maximum(value, -self._largest), self._largest)
        self._change = np.where(value == self._value, self._change + self._gain_of_change * surprise, 0.0)
        if holds:
            return
        d_b = attitude.T @ self.foreseen(0.0)[0]
        if self._scaled:
            d_b[2] = 0.0
        self._products, self._squares = self._decay * self._products + d_b * v_b, self._decay * self._squares + v_b**2

    def foreseen(self, ahead: float) -> tuple[Array, Array, Array]:
        """Predict the disturbance `ahead` [s] after the last measurement: three arrays (3,).

        Acceleration [m/s^2] and its rate of change [m/s^3], world axes; angular acceleration [rad/s^2], body axes.
        """
        value = self._value + (0.5 * self._period + ahead) * self._change  # the estimate is for mid-period
        change = self._change[:3].copy()
        if self._scaled:
            value[2] = change[2] = 0.0
        return value[:3], change, value[3:]

    @property
    def thrust_scale(self) -> float:
        """The thrust that rotors give over the modelled one, kappa, in the period that follows the last measurement."""
        if not self._scaled:
            return 1.0
        change = (self._value[2] + self._period * self._change[2]) / self._vehicle.gravity
        return 1.0 + min(max(float(change), -LARGEST_CHANGE), LARGEST_CHANGE)

    def log(self, now: StepInputs) -> None:
        """Log the thrust scale, where it is estimated, as `thrust_scale`."""
        if self._scaled:
            now.log("thrust_scale", self.thrust_scale)

    @property
    def drag(self) -> Array:
        """(3,) linear drag [1/s], body axes, beyond the model's: the part of the force that follows the velocity.

        A least-squares fit of d_b + diag(drag) v_b that weights older samples less; zero while the vehicle is slow.
        """
        return np.maximum(-self._products / (self._squares + self._ballast), 0.0)

    def _mean_wrench(self, command: Array | float) -> tuple[float, Array]:
        """The mean thrust [N], before its scale, and torque (3,) [N m] of a period with this command."""
        if self._thrust_lag is None:
            spun, squares = self._rotors, self._mean_squares(np.asarray(command))
            wrench = self._vehicle.allocation @ squares
            torque = self.thrust_scale * wrench[1:]
            torque[2] -= self._momentum @ (self._rotors - spun) / self._period
            return float(wrench[0]), torque
        thrust, share = float(command), self._thrust_lag / self._period
        left, away = math.exp(-1.0 / share) if share else 0.0, self._thrust - thrust
        self._thrust = thrust + left * away
        return thrust + share * (1.0 - left) * away, np.zeros(3)

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
