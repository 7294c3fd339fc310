"""Level hover by LQR: the last resort of every controller, and the correction that returns a vehicle to its plan.

The gain is that of the infinite horizon on the hover model, in the heading frame, where the model at zero yaw holds for
any yaw.  The weights follow Bryson's rule (Bryson and Ho, "Applied Optimal Control", 1975, Sec.  5.2), one over the
square of the largest acceptable value, for states and for the *accelerations* that inputs cause, not for rotor speeds:
the closed loop is then the same for every vehicle.

    acceleration = -K (xi - xi_target)    u = u_s + S^-1 acceleration

u_s holds the vehicle at rest under the known disturbance; see `quadsim.mpc.problem.equilibrium.Trim`. S maps rotor
speeds to accelerations along z and about x, y, z.  K acts on horizontal errors through the tilt that it demands in
addition to the tilt at rest, tilt* = -(k_p e_p + k_v e_v) / k_tilt.  That sum is bounded here: the law is exactly the
LQR within the bound, and demands no more tilt beyond.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from quadsim.mpc.guard.answer import ActuatorBounds
from quadsim.mpc.problem.equilibrium import Trim
from quadsim.mpc.problem.heading import anchored, slope, turn_horizontally
from quadsim.mpc.problem.model import LinearModel
from quadsim.mpc.problem.regulator import lqr
from quadsim.state import INDEX, POSITION, VELOCITY, Array, by_group, read_only
from quadsim.vehicle import N_ROTORS

ACCEPTABLE_ACCELERATION: Final = (2.0, 8.0, 8.0, 2.0)  # along z [m/s^2], about x, y and z [rad/s^2]
LARGEST_CLIMB: Final = 2.0
"""Largest acceleration along z [m/s^2] that height errors demand beyond the trim: rotors keep the range that levels the
vehicle."""
LARGEST_TURN: Final = 2.0  # the same for yaw [rad/s^2]

_POSITION: Final = list(POSITION)
_VELOCITY: Final = list(VELOCITY)
_SIDEWAYS: Final = [INDEX[name] for name in ("x", "vx", "y", "vy")]
_TILTS: Final = [INDEX["roll"], INDEX["pitch"]]
_ROLL_PITCH: Final = [1, 2]  # rows of an acceleration (4,)
ACCEPTABLE: Final = by_group(0.5, 1.0, 0.2, 1.0)  # [m], [m/s], [rad], also for yaw, [rad/s]


class HoverLaw:
    """The LQR of hover, set up once.

    Attributes:
        tilt: the largest demanded tilt, of roll and pitch together [rad].
        gain: (4, 12) K, for errors in the heading frame.
        slope: (4, 4) S.
        inverse: (4, 4) of S.
        lean: (2, 4) tilt that an error of x, vx, y, vy demands: roll, pitch.
    """

    def __init__(self, model: LinearModel, *, tilt: float) -> None:
        self.model, self.tilt = model, tilt
        self.slope = read_only(slope(model))
        self.inverse = read_only(np.asarray(np.linalg.inv(self.slope), float))
        pushed = model.B @ self.inverse  # xi(k+1) = A xi(k) + pushed acceleration
        Q, R = np.diag(ACCEPTABLE**-2.0), np.diag(np.array(ACCEPTABLE_ACCELERATION) ** -2.0)
        self.gain = read_only(lqr(model.A, pushed, Q, R))
        rows = self.gain[_ROLL_PITCH]
        self.lean = read_only(np.asarray(np.linalg.solve(rows[:, _TILTS], rows[:, _SIDEWAYS]), float))

    def correction(self, error: Array, yaw: float) -> Array:
        """Return the correction of the rotor speeds (4,) [rad/s] towards a moving state.

        The error (12,) is the measured minus the desired state, the yaw the measured one [rad].
        """
        return self.inverse @ self._acceleration(turn_horizontally(error, np.array(-yaw)), np.zeros(2))

    def plan(
        self, state: Array, target: Array, before: Array, bounds: ActuatorBounds, horizon: int, trim: Trim
    ) -> Array:
        """Plan the speeds (N, 4) [rad/s] of the next periods by the model, turned by the measured yaw.

        The target (12,) is the desired state now, level; it moves at its velocity.
        """
        model, yaw = anchored(self.model, trim), float(state[INDEX["yaw"]])
        A, B = model.A, model.B
        rest = trim.state(yaw)
        drift = rest - A @ rest - B @ trim.speeds
        state, target = turn_horizontally(np.array([state, target]), np.array(-yaw))
        plan = np.empty((horizon, N_ROTORS))
        for i in range(horizon):
            speeds = trim.speeds + self.inverse @ self._acceleration(state - target, rest[_TILTS])
            plan[i] = before = bounds.clip(speeds, before)
            state = A @ state + B @ before + drift
            target[_POSITION] += self.model.period * target[_VELOCITY]
        return plan

    def _acceleration(self, error: Array, rest: Array) -> Array:
        """-K error (4,) in the heading frame, within its limits; roll and pitch (2,) at rest are not errors."""
        lean = rest - self.lean @ error[_SIDEWAYS]
        lean *= min(1.0, self.tilt / max(math.hypot(*lean), self.tilt))
        error = error.copy()
        error[_SIDEWAYS] = 0.0
        error[_TILTS] -= lean
        acceleration: Array = -self.gain @ error
        acceleration[0] = min(max(acceleration[0], -LARGEST_CLIMB), LARGEST_CLIMB)
        acceleration[3] = min(max(acceleration[3], -LARGEST_TURN), LARGEST_TURN)
        return acceleration
