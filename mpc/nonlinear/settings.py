"""What a nonlinear MPC is made from."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Annotated

import numpy as np
from annotated_types import Len, doc

from mpc.disturbance import RampSettings
from mpc.nonlinear.rigidbody import Inputs
from mpc.observer import ObserverSettings
from quadsim.errors import ParameterError
from quadsim.fields import NonNegative, Weight
from quadsim.state import Array

AxisWeights = Weight | Annotated[Sequence[Weight], Len(3, 3)]
"""One weight for three axes, or one each."""


class AttitudeError(StrEnum):
    """What the weight of the attitude is of, with the reference q_r."""

    ERROR_STATE = "error-state"
    """2 vec(q_r* q), three components: the rotation vector to first order, and the same of q and -q."""
    DIFFERENCE = "difference"
    """q - q_r, four components, whose signs have to agree: to first order half the rotation vector."""


@dataclass(frozen=True, kw_only=True)
class Weights:
    """What squared distances from the reference cost."""

    position: Annotated[AxisWeights, doc("[1/m^2] one weight, or x, y, z")] = 10.0
    attitude: Annotated[AxisWeights, doc("[1/rad^2] one weight, or about body x, y, z")] = 0.1
    velocity: Annotated[AxisWeights, doc("[1/(m/s)^2] one weight, or x, y, z")] = 0.05
    body_rates: Annotated[AxisWeights, doc("[1/(rad/s)^2] one weight, or about body x, y, z")] = 0.05
    input: Annotated[Weight, doc("[-] of an input's distance from the reference's, as shares")] = 0.1
    move: Annotated[NonNegative, doc("[-] of an input's change from one node to the next, as shares")] = 0.0

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            array = np.asarray(value, float)
            axes = ((),) if name in ("input", "move") else ((), (3,))
            inside = np.isfinite(array) & (array >= 0.0) & ((array > 0.0) | (name == "move"))
            if array.shape not in axes or not inside.all():
                rule = "positive: one number, or three" if len(axes) == 2 else "one positive number"
                raise ParameterError("controller.weights", name, value, rule)
            if array.ndim:
                object.__setattr__(self, name, tuple(array.tolist()))


_USUAL = Weights()


@dataclass(frozen=True, kw_only=True)
class NonlinearSettings:
    """Horizon, cost and model; the units are those of the states, inputs are shares of the largest."""

    horizon: int = 10  # N, nodes
    stride: int = 1  # control periods from one node to the next
    iterations: int = 1  # most steps of sequential quadratic programming in a period; 1 is the real-time iteration
    tolerance: float = 1e-6  # largest step of a state or an input that ends them
    shift: bool | None = None  # whether the plan moves on by a node before it is linearised along; None: if stride is 1
    substeps: int = 1  # Runge-Kutta steps from one node to the next
    inputs: Inputs = Inputs.THRUST  # what the inputs are shares of the largest of
    rotor_lag: float | None = None  # time constant of the rotors' thrusts or speeds [s]; None for none
    drag: tuple[float, float, float] = (0.0, 0.0, 0.0)  # linear, that the model knows, body axes [N s/m]
    quadratic_drag: tuple[float, float, float] = (0.0, 0.0, 0.0)  # in each component of the velocity [N s^2/m^2]
    attitude_error: AttitudeError = AttitudeError.ERROR_STATE  # what the weight of the attitude is of
    weights: Weights = _USUAL  # what distances from the reference cost
    terminal: float | str = (
        0.0  # the last state's weight over the others', 0 for none; "lqr" for the Riccati equation's
    )
    tilt: float | None = None  # largest angle between thrust axis and vertical [rad], below pi/2; None for no bound
    largest_rates: tuple[float, float, float] = (math.inf, math.inf, math.inf)  # body rates [rad/s]
    soft: tuple[float, float] | None = None  # (l1, l2) of exceeding these by 1 rad or 1 rad/s; None for hard bounds
    observer: ObserverSettings | None = None  # of the disturbance observer; None for no offset-free tracking
    ramp: RampSettings | None = None  # of the one that follows changing forces, and fits drag to them; None for none
    solver: str | None = None  # see `mpc.solvers.find_solver`; None for the fastest one for the size

    def __post_init__(self) -> None:
        for name in ("horizon", "stride", "iterations", "substeps"):
            if not isinstance(getattr(self, name), int) or getattr(self, name) < 1:
                raise ParameterError("controller", name, getattr(self, name), "a whole number >= 1")
        if not isinstance(self.terminal, str) and not 0.0 <= self.terminal < math.inf:
            raise ParameterError("controller", "terminal", self.terminal, 'at least 0 and finite, or "lqr"')
        if self.tilt is not None and not 0.0 < self.tilt < 0.5 * math.pi:
            raise ParameterError("controller", "tilt", self.tilt, "positive and below pi/2, or None")
        if self.attitude_error is AttitudeError.DIFFERENCE and np.ndim(self.weights.attitude):
            rule = 'one number where attitude_error = "difference"'
            raise ParameterError("controller.weights", "attitude", self.weights.attitude, rule)

    def outputs(self) -> tuple[Array, Array]:
        """C_r (n_r, 13) and the diagonal of Q_y (n_r,), for states whose quaternion is q_r* q."""
        weights, difference = self.weights, self.attitude_error is AttitudeError.DIFFERENCE
        rows = np.eye(13) if difference else np.delete(np.eye(13), 3, axis=0)
        attitude = np.full(4, weights.attitude) if difference else 4.0 * _three(weights.attitude)
        parts = (_three(weights.position), attitude, _three(weights.velocity), _three(weights.body_rates))
        return rows, np.concatenate(parts)


def _three(weight: AxisWeights) -> Array:
    return np.broadcast_to(np.asarray(weight, float), 3)
