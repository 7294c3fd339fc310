"""Laws of a user's own: the optimal gain times a factor, one that leaves the heading alone, and two that raise."""

from __future__ import annotations

import numpy as np

from quadsim.controller import StepInputs
from quadsim.mpc.laws.lqr import lqr_gain
from quadsim.mpc.problem.model import LinearModel, hover_model
from quadsim.mpc.problem.ocp import Objective
from quadsim.state import INDEX, STATE_NAMES, Array
from quadsim.vehicle import Vehicle

OUTPUTS = [INDEX[name] for name in ("x", "y", "z", "yaw")]


def optimal_gain(model: LinearModel) -> Array:
    """K (4, 12)."""
    weights = np.diag([10.0, 10.0, 100.0, 100.0])
    return lqr_gain(model, Objective(C_r=np.eye(12)[OUTPUTS], Q_y=weights, Q_u=9e-4 * np.eye(4)))


class ScaledGain:
    """u = u_bar - factor K (xi - xi_r)."""

    name = "scaled"

    def __init__(self, vehicle: Vehicle, period: float, horizon: int, factor: float = 1.0) -> None:
        self.model = hover_model(vehicle, period)
        self.gain = factor * optimal_gain(self.model)

    def step(self, now: StepInputs, state: Array, reference: Array) -> Array:
        desired = np.zeros(len(STATE_NAMES))
        desired[OUTPUTS] = reference[0]
        return np.maximum(self.model.u_bar - self.gain @ (np.asarray(state) - desired), 0.0)


class FreeHeading(ScaledGain):
    """It stops a rotation about z, and goes back to no heading."""

    name = "free heading"

    def step(self, now: StepInputs, state: Array, reference: Array) -> Array:
        seen = np.array(state)
        seen[INDEX["yaw"]] = reference[0, 3]
        return super().step(now, seen, reference)


class RaisesLater(ScaledGain):
    """It raises after a second."""

    name = "raises"

    def step(self, now: StepInputs, state: Array, reference: Array) -> Array:
        if now.time >= 1.0:
            raise RuntimeError("no answer for this")
        return super().step(now, state, reference)


class RaisesAtOnce:
    """It cannot be built."""

    name = "never"

    def __init__(self, vehicle: Vehicle, period: float, horizon: int) -> None:
        raise RuntimeError("not today")
