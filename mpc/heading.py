"""Axes turned by the heading: at hover the vehicle moves alike for any yaw, and the model at zero yaw holds there."""

from __future__ import annotations

import numpy as np

from mpc.model import LinearModel
from mpc.prediction import rollout
from quadsim.state import INDEX, Array


def turn_horizontally(states: Array, angles: Array) -> Array:
    """States (..., n) whose horizontal positions and velocities are turned by `angles` (...,) [rad] about world z."""
    turned = np.array(states, float)
    cosine, sine = np.cos(angles), np.sin(angles)
    for x, y in (("x", "y"), ("vx", "vy")):
        i, j = INDEX[x], INDEX[y]
        turned[..., i] = cosine * states[..., i] - sine * states[..., j]
        turned[..., j] = sine * states[..., i] + cosine * states[..., j]
    return turned


def predict_in_heading_frame(model: LinearModel, states: Array, plans: Array) -> Array:
    """Predicted states (K, N, 12) of the linear model turned by each measured yaw.

    Args:
        model: at zero yaw.
        states: (K, 12).
        plans: (K, N, 4) [rad/s].
    """
    yaws = states[:, INDEX["yaw"]]
    predicted = rollout(model, turn_horizontally(states, -yaws), plans)
    return turn_horizontally(predicted, np.broadcast_to(yaws[:, None], predicted.shape[:2]))
