"""Where a vehicle rests against a constant disturbance: the target of offset-free tracking.

At rest thrust holds what gravity and the disturbance's acceleration a leave over, and torques hold its angular
acceleration alpha:

    U / m R(eta) e_z = g e_z - a,    I^-1 tau = -alpha,    omega = 0.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from mpc.nonlinear import NonlinearModel
from quadsim.state import INDEX, N_STATES, Array

LEAST_LIFT: Final = 0.1
"""Share of the weight that thrust holds at least: no rest is upside down."""


def equilibrium(model: NonlinearModel, yaw: float = 0.0) -> tuple[Array, Array]:
    """Rest at the origin under the model's disturbance, seen from axes turned by the yaw, where yaw itself is 0.

    Args:
        model: with its disturbance in the world frame.
        yaw: of the axes [rad].

    Returns:
        State (n,) and inputs (4,) [rad/s]; a rotor that would have to pull stands still.
    """
    a_x, a_y, a_z = model.acceleration
    cosine, sine = math.cos(yaw), math.sin(yaw)
    forward, left = -cosine * a_x - sine * a_y, sine * a_x - cosine * a_y
    up = max(model.gravity - a_z, LEAST_LIFT * model.gravity)
    thrust = math.sqrt(forward**2 + left**2 + up**2)
    drive = np.concatenate([[thrust], -model.angular_acceleration])
    speeds = np.sqrt(np.maximum(np.linalg.solve(model.effectiveness, drive), 0.0))
    state = np.zeros(model.n)
    state[INDEX["roll"]] = -math.asin(left / thrust)
    state[INDEX["pitch"]] = math.atan2(forward, up)
    state[N_STATES:] = speeds[: model.n - N_STATES]
    return state, speeds
