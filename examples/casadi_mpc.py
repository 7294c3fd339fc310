"""Nonlinear MPC written with CasADi, as a controller of quadsim: `quadsim run examples/casadi_mpc.toml`.

It needs `pip install casadi`.  IPOPT starts from the last plan, shifted; a plan that it does not find is flown on.
"""

from __future__ import annotations

from typing import Any

import casadi as cs
import numpy as np
from numpy.typing import NDArray

from quadsim.controller import StepInputs
from quadsim.vehicle import Vehicle

Array = NDArray[np.float64]
QUIET: dict[str, Any] = {"print_time": False, "error_on_fail": True, "ipopt": {"print_level": 0, "sb": "yes"}}


def after(vehicle: Vehicle, h: float, x: Any, w: Any) -> Any:
    """Return (12,) the state after a period h [s] of constant acceleration; w: rotor speeds over the hover speed.

    Accelerations are those of the rigid body at the attitude of half the period, gyroscopic torque left out; Euler
    rates stand for body rates, which they are to some 4 % within 15 deg.
    """
    wrench = cs.DM(vehicle.allocation * vehicle.hover_speed**2) @ w**2
    pose = x[0::2]  # x, y, z, roll, pitch, yaw
    velocity = x[1::2]
    roll, pitch, yaw = cs.vertsplit(pose[3:] + h / 2 * velocity[3:])
    forward = cs.sin(pitch) * cs.cos(roll)
    left = -cs.sin(roll)
    up = cs.vertcat(
        cs.cos(yaw) * forward - cs.sin(yaw) * left,
        cs.sin(yaw) * forward + cs.cos(yaw) * left,
        cs.cos(pitch) * cs.cos(roll),
    )
    linear = up * wrench[0] / vehicle.mass - cs.DM([0.0, 0.0, vehicle.gravity])
    angular = cs.DM(np.linalg.inv(vehicle.inertia_matrix)) @ wrench[1:]
    a = cs.vertcat(linear, angular)
    next_pose = pose + h * velocity + h**2 / 2 * a
    next_velocity = velocity + h * a
    return cs.vec(cs.horzcat(next_pose, next_velocity).T)


class CasadiMPC:
    """Follows the course within bounds on tilt [deg], rotor speeds and their steps [rad/s]."""

    solver = "ipopt"

    def __init__(self, vehicle: Vehicle, period: float, horizon: int, tilt: float = 15.0, slew: float = 80.0) -> None:
        self.hover = vehicle.hover_speed
        self.bounds = {  # which the audit checks
            "roll": (-tilt, tilt),
            "pitch": (-tilt, tilt),
            "speed": (vehicle.speed_min, vehicle.speed_max),
            "slew": (-slew, slew),
        }
        x = cs.SX.sym("x", 12)
        w = cs.SX.sym("w", 4)
        model = cs.Function("after", [x, w], [after(vehicle, period, x, w)])
        opti = cs.Opti()
        X = opti.variable(12, horizon + 1)
        W = opti.variable(4, horizon)
        now = opti.parameter(12)
        before = opti.parameter(4)
        course = opti.parameter(4, horizon)
        errors = X[[0, 2, 4, 10], 1:] - course
        steps = cs.diff(cs.horzcat(before, W), 1, 1)
        opti.minimize(10.0 * cs.sumsqr(errors) + 0.1 * cs.sumsqr(X[1::2, 1:]) + 10.0 * cs.sumsqr(steps))
        opti.subject_to(X[:, 0] == now)
        opti.subject_to(X[:, 1:] == model.map(horizon)(X[:, :-1], W))
        for bounded, name, unit in (
            (X[[6, 8], 1:], "roll", np.degrees(1.0)),
            (W, "speed", self.hover),
            (steps, "slew", self.hover),
        ):
            lower, upper = self.bounds[name]
            opti.subject_to(opti.bounded(lower / unit, cs.vec(bounded), upper / unit))
        opti.solver("ipopt", QUIET)
        self.plan_from = opti.to_function("plan", [now, before, course, X, W], [X, W])

    def reset(self, speeds: Array) -> None:
        """Start from the command before the first."""
        self.before = speeds / self.hover
        self.plan: tuple[Array, Array] | None = None

    def step(self, now: StepInputs, state: Array, reference: Array) -> Array:
        """Four rotor speeds [rad/s] for a state (12,) and the next N samples of the course (N, 4)."""
        if self.plan is None:
            X = np.tile(state, (len(reference) + 1, 1)).T
            W = np.tile(self.before, (len(reference), 1)).T
        else:
            X, W = self.plan
        try:
            states, speeds = self.plan_from(state, self.before, reference.T, X, W)
            X = np.array(states)
            W = np.array(speeds)
        except RuntimeError:
            now.log("no_plan", 1.0)
        self.before = W[:, 0]
        self.plan = (np.hstack([X[:, 1:], X[:, -1:]]), np.hstack([W[:, 1:], W[:, -1:]]))  # shifted by a period
        return self.hover * self.before
