"""The heading frame: axes turned by the yaw, in which the hover model at zero yaw holds for any yaw.

The model is linearised at the equilibrium (x_s, u_s) of `quadsim.mpc.problem.equilibrium`: in axes turned by the yaw

    x(k+1) = x_s + A (x(k) - x_s) + B (u(k) - u_s).
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Final

import numpy as np

from quadsim.mpc.problem.equilibrium import Trim
from quadsim.mpc.problem.model import ACCELERATED, LinearModel
from quadsim.mpc.problem.paper import rollout
from quadsim.state import INDEX, N_STATES, Array

_YAW: Final = INDEX["yaw"]


def turn_horizontally(states: Array, angles: Array | float) -> Array:
    """States (..., n), positions and velocities turned about world z by angles [rad] that broadcast to (...,)."""
    turned = np.array(states, float)
    cosine: Array | float
    sine: Array | float
    if isinstance(angles, float):
        cosine = math.cos(angles)
        sine = math.sin(angles)
    else:
        cosine = np.cos(angles)[..., None]
        sine = np.sin(angles)[..., None]
    # x and vx, then y and vy
    along = states[..., 0:2]
    across = states[..., 2:4]
    turned[..., 0:2] = cosine * along - sine * across
    turned[..., 2:4] = sine * along + cosine * across
    return turned


def turn(yaw: float) -> Array:
    """(12, 12) matrix T that turns positions and velocities by a yaw [rad], from heading frame to world frame."""
    return turn_horizontally(np.eye(N_STATES), np.array(yaw)).T


def slope(model: LinearModel) -> Array:
    """(4, 4) accelerations along z and about x, y, z per rotor speed [(m/s^2)/(rad/s)], [1/s]."""
    # Rates and vz only integrate accelerations, so their rows of B are the period times the slope.
    return np.asarray(model.B[ACCELERATED] / model.period)


def anchored(model: LinearModel, trim: Trim) -> LinearModel:
    """Linearise the hover model at the trim, where thrust has another slope and causes a torque."""
    if model.targets:  # linear in its inputs, and an inner loop balances the torque
        return replace(model, u_bar=trim.speeds)
    B = model.B * (trim.speeds / model.u_bar)
    if trim.twist.any():
        there = slope(model)
        brought = np.outer(np.append(0.0, trim.twist), there[0] * (trim.speeds / model.u_bar))
        B += model.B @ np.linalg.solve(there, brought)
    return replace(model, B=B, u_bar=trim.speeds)


def predict_in_heading_frame(model: LinearModel, states: Array, plans: Array, trim: Trim | None = None) -> Array:
    """Predict states (K, N, 12) from states (K, 12) and plans (K, N, 4), by the linear model turned by each yaw.

    With a trim, the model is `anchored` there; otherwise it is the model of level hover.
    """
    yaws = states[:, _YAW]
    seen = turn_horizontally(states, -yaws)
    trim = trim or Trim(speeds=model.u_bar, lift=np.array([0.0, 0.0, 1.0]))
    rest = np.array([trim.state(yaw) for yaw in yaws.tolist()])
    predicted = rollout(replace(model, u_bar=trim.speeds), seen - rest, plans) + rest[:, None]
    return turn_horizontally(predicted, yaws[:, None])


def advance(model: LinearModel, state: Array, speeds: Array, trim: Trim) -> Array:
    """The state (12,) a period later under speeds (4,) [rad/s], by the anchored model in the heading frame."""
    return predict_in_heading_frame(anchored(model, trim), state[None], speeds[None, None], trim)[0, 0]
