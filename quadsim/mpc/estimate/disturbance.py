"""Estimates of unmodelled force and torque, and of the force's rate of change.

The mean acceleration over a period that the model misses,

    d = (v(k) - v(k-1)) / tau_s + g e_z - mean(f / m R e_z + R d_drag),

The mean angular acceleration is defined in the same way.  Two states follow each of them, the disturbance and its rate
of change, with both poles of the error at exp(-bandwidth tau_s): the critically damped g-h filter (Morrison,
"Introduction to Sequential Smoothing and Prediction", 1969).  It tracks a disturbance that changes at a constant rate
without lag; drag on a curved path nearly does so.  The estimate of a constant disturbance in
`quadsim.mpc.estimate.observer` lags by its time constant.

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

import ctypes
import math
from dataclasses import dataclass
from typing import Annotated, Final

import numpy as np
from annotated_types import doc
from numpy.typing import ArrayLike

from quadsim.controller import StepInputs
from quadsim.core.mirror import Struct, core_library, set_members, struct
from quadsim.fields import NonNegative, Positive, Seconds
from quadsim.state import Array
from quadsim.vehicle import N_ROTORS, Vehicle

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
SAME_TIME: Final = 1e-6
"""Difference of two times [s] that counts as rounding."""


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
        Seconds, doc("[s] window for fitting linear drag to the force, for a nonlinear MPC's predictions")
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


RampNumbers: Final = struct("quadsim_ramp_numbers")
RampState: Final = struct("quadsim_ramp")


class RampObserver:
    """The six filters, an evolving state: three for the force (world axes) and three for the torque (body axes).

    Commands are rotor speeds, or with `thrust_lag` [s] collective thrusts [N] that act with this lag; no torque is
    estimated then. The model knows `drag` (3,) [1/s] and `quadratic_drag` (3,) [1/m], of the square of each component,
    in body axes, and with `moment` the vehicle's `air_moment`. A command takes over `late` [s] after an update.

    The core computes it, `quadsim_ramp.c`; a controller in C calls it there, with the addresses of both attributes.

    Attributes:
        numbers: what does not change.
        state: the estimates.
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
        late: float = 0.0,
    ) -> None:
        self._library = core_library()
        self._period = period
        self.numbers = RampNumbers()
        _fill(self.numbers, settings, vehicle, period, thrust_lag, late)
        self.numbers.moment = moment
        set_members(self.numbers, drag=np.array(drag, float), square_drag=np.array(quadratic_drag, float))
        self.bind(RampState())
        # What C reads in an update, and what it writes.
        self._measured = np.zeros(3), np.zeros((3, 3)), np.zeros(3), np.zeros(N_ROTORS)
        self._foreseen = np.zeros((3, 3))
        arrays = (*self._measured, *self._foreseen)
        self._addresses = [array.ctypes.data for array in arrays]
        self.reset(vehicle.mass * vehicle.gravity if self.numbers.targets else vehicle.hover_speeds)

    def bind(self, state: Struct) -> None:
        """Keep the estimates in this memory from now on, as they are there."""
        self.state = state
        self._value, self._change, self._acting = map(np.ctypeslib.as_array, (state.value, state.change, state.acting))

    def reset(self, acting: Array | float) -> None:
        """Clear the estimates; the rotors turn at `acting` (4,) [rad/s], or give this thrust [N] with `thrust_lag`."""
        command = self._measured[-1]
        command[:] = acting
        self._library.quadsim_ramp_reset(self.state, self.numbers, command.ctypes.data)
        self._time = 0.0

    def adopt(self, other: RampObserver) -> None:
        """Take over the state of another observer, as far as it estimates the same."""
        same_commands = self.numbers.targets == other.numbers.targets
        shared = np.array([True, True, self.numbers.scaled == other.numbers.scaled, *[same_commands] * 3])
        largest = np.array(self.numbers.largest)
        acting = self._acting.copy()
        command = np.array(self.state.command)
        ctypes.memmove(ctypes.byref(self.state), ctypes.byref(other.state), ctypes.sizeof(RampState))
        self._value[:] = np.where(shared, np.clip(self._value, -largest, largest), 0.0)
        self._change[:] = np.where(shared, self._change, 0.0)
        if not same_commands:
            self._acting[:] = acting
            set_members(self.state, command=command)
        self._time = other._time

    def update(self, time: float, velocity: Array, attitude: Array, rates: Array, command: Array | float) -> None:
        """Update the estimates at the end of a period; after a gap, only record the start of the next one.

        Measured values: velocity (3,), world; attitude (3, 3), body to world; body rates (3,). The command was held
        over the period that ends: rotor speeds (4,) [rad/s], or the thrust [N] with `thrust_lag`.
        """
        for array, value in zip(self._measured, (velocity, attitude, rates, command), strict=True):
            array[:] = value
        self._library.quadsim_ramp_update(self.state, self.numbers, self.follows(time), *self._addresses[:4])

    def follows(self, time: float) -> bool:
        """Return whether an update at a time [s] follows the one before by a period, and remember the time."""
        before = self._time
        self._time = time
        return abs(time - before - self._period) <= SAME_TIME

    def foreseen(self, ahead: float) -> tuple[Array, Array, Array]:
        """Predict the disturbance `ahead` [s] after the last measurement: three arrays (3,).

        Acceleration [m/s^2] and its rate of change [m/s^3], world axes; angular acceleration [rad/s^2], body axes.
        """
        self._library.quadsim_ramp_foreseen(self.state, self.numbers, ahead, *self._addresses[4:])
        force, change, torque = self._foreseen.copy()
        return force, change, torque

    @property
    def thrust_scale(self) -> float:
        """The thrust that rotors give over the modelled one, kappa, in the period that follows the last measurement."""
        return float(self._library.quadsim_ramp_scale(self.state, self.numbers))

    def log(self, now: StepInputs) -> None:
        """Log the thrust scale, where it is estimated, as `thrust_scale`."""
        if self.numbers.scaled:
            now.log("thrust_scale", self.thrust_scale)

    @property
    def drag(self) -> Array:
        """(3,) linear drag [1/s], body axes, beyond the model's: the part of the force that follows the velocity.

        A least-squares fit of d_b + diag(drag) v_b that weights older samples less; zero while the vehicle is slow.
        """
        drag = np.empty(3)
        self._library.quadsim_ramp_drag(self.state, self.numbers, drag.ctypes.data)
        return drag


def _fill(
    numbers: Struct, settings: RampSettings, vehicle: Vehicle, period: float, thrust_lag: float | None, late: float
) -> None:
    """Fill in all numbers but what the model knows of the air."""
    bandwidths = settings.force or FORCE_SHARE / period, settings.torque or TORQUE_SHARE / period
    pole = np.exp(-period * np.repeat(bandwidths, 3))
    gain = 1.0 - pole**2
    gain_of_change = (1.0 - pole) ** 2 / period
    largest = np.repeat([settings.largest_force, settings.largest_torque], 3)
    numbers.targets = thrust_lag is not None
    if settings.thrust_scale is None:
        numbers.scaled = numbers.targets
    else:
        numbers.scaled = settings.thrust_scale
    if numbers.scaled:
        largest[2] = LARGEST_CHANGE * vehicle.gravity
    if numbers.targets:
        gain[3:] = gain_of_change[3:] = 0.0
    numbers.period = period
    numbers.mass = vehicle.mass
    numbers.gravity = vehicle.gravity
    numbers.least_lift = OBSERVABLE_THRUST * vehicle.gravity
    if thrust_lag is None:
        lag = settings.rotor_lag or 0.0
    else:
        lag = thrust_lag
    numbers.lag = lag / period
    numbers.share = late / period
    if lag:
        numbers.left = math.exp(-(period - late) / lag)
        numbers.left_before = math.exp(-late / lag)
    if lag:
        rotor_inertia = vehicle.rotor_inertia or 0.0
    else:
        rotor_inertia = 0.0
    set_members(
        numbers,
        gain=gain,
        gain_of_change=gain_of_change,
        largest=largest,
        inertia=vehicle.inertia_matrix,
        inverse=vehicle.angular_acceleration(np.eye(3)),
        allocation=vehicle.allocation,
        momentum=-rotor_inertia * np.array(vehicle.rotor_spins, float),
        across=vehicle.rotor_moment or (0.0, 0.0),
        inflow=vehicle.inflow_moment or (0.0, 0.0),
        damping=vehicle.turn_damping,
        loss=(vehicle.inflow or 0.0) / vehicle.mass,
    )
    numbers.decay = math.exp(-period / settings.drag_memory)
    numbers.ballast = FITTED_FROM**2 / (1.0 - numbers.decay)
