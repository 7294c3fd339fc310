"""The reference of a horizon's nodes: states, and the inputs that hold them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mpc.nonlinear.rigidbody import N_BODY, P, Q, V, W
from quadsim.motion import Motion
from quadsim.state import Array, Indices


class Nodes(NamedTuple):
    """The reference of N + 1 nodes, starting now."""

    states: Array  # (N + 1, 13)
    thrusts: Array  # (N, 4) of the rotors [N]


def nodes_of_motion(motion: Motion, horizon: int, stride: int) -> Nodes:
    """Take the samples k, k + stride, ...; past the end repeat the last one, and for thrusts the last but one."""
    last = (len(motion) - 1) // stride
    at: slice | Indices = slice(0, stride * horizon + 1, stride)
    with_inputs: slice | Indices = slice(0, stride * horizon, stride)
    if last < horizon:
        at = stride * np.minimum(np.arange(horizon + 1), last)
        with_inputs = stride * np.minimum(np.arange(horizon), max(last - 1, 0))
    states = np.empty((horizon + 1, N_BODY))
    states[:, P], states[:, Q], states[:, V] = motion.position[at], motion.attitude[at], motion.velocity[at]
    states[:, W] = motion.body_rates[at]
    return Nodes(states, motion.thrusts[with_inputs])


def nodes_of_preview(reference: Array, horizon: int, stride: int, period: float, hover: Array) -> Nodes:
    """Take x, y, z, yaw (N stride, 4) from t_{k+1} on: velocity by differences, level, rotor thrusts `hover` [N].

    The first node, which has no cost, is extrapolated from the first two samples.
    """
    steps = np.diff(reference, axis=0) if len(reference) > 1 else np.zeros((1, 4))
    ahead = np.concatenate([[2.0 * reference[0] - reference[min(1, len(reference) - 1)]], reference])
    rates = np.concatenate([steps[:1], steps[:1], 0.5 * (steps[:-1] + steps[1:]), steps[-1:]])[: len(ahead)] / period
    chosen, rates = ahead[::stride], rates[::stride]
    states = np.zeros((horizon + 1, N_BODY))
    states[:, P], states[:, V] = chosen[:, :3], rates[:, :3]
    half = 0.5 * chosen[:, 3]
    states[:, 3], states[:, 6], states[:, 12] = np.cos(half), np.sin(half), rates[:, 3]
    return Nodes(states, np.full((horizon, 4), hover))
