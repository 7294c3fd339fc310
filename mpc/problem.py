"""What an MPC is asked to do: model, horizon, weights, outputs and bounds, checked once."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from mpc.model import LinearModel
from quadsim.errors import ParameterError
from quadsim.state import N_STATES, REFERENCE_STATES, STATE_NAMES, STATE_UNITS, Array


@dataclass(frozen=True, kw_only=True)
class Objective:
    """The cost of Eq. (5).

    Attributes:
        C_r: (n_r, n) regulated outputs y_r = C_r xi.  Eq. (4), where the paper prints n_r x n_r.
        Q_y: (n_r, n_r) weight of the output error, symmetric positive definite.
        Q_u: (nu, nu) weight of u - u_bar, symmetric positive definite.
    """

    C_r: Array
    Q_y: Array
    Q_u: Array

    def __post_init__(self) -> None:
        for name in ("Q_y", "Q_u"):
            _check_positive_definite(name, getattr(self, name))
        if self.C_r.ndim != 2 or self.Q_y.shape[0] != self.C_r.shape[0]:
            raise ParameterError("controller", "C_r", self.C_r.shape, f"of shape ({self.Q_y.shape[0]}, n)")

    def desired(self, reference: Array) -> Array:
        """Desired outputs y_r^d (..., n_r) of a reference (..., 4) for x, y, z, yaw; other states are wanted at 0."""
        return reference @ self.C_r[:, REFERENCE_STATES].T


@dataclass(frozen=True, kw_only=True)
class Bounds:
    """The constraints of Eqs. (12)-(20); an infinite entry is no bound.

    Attributes:
        C_c: (n_c, n) constrained outputs y_c = C_c xi.  Eq. (12).
        y_min, y_max: (n_c,) output bounds.  Eq. (13).
        delta_min, delta_max: (nu,) bounds on u(k) - u(k-1) [rad/s].  Eq. (15).
        u_min, u_max: (nu,) input bounds [rad/s].  Eq. (20).
    """

    C_c: Array
    y_min: Array
    y_max: Array
    delta_min: Array
    delta_max: Array
    u_min: Array
    u_max: Array

    def __post_init__(self) -> None:
        for low, high in (("y_min", "y_max"), ("delta_min", "delta_max"), ("u_min", "u_max")):
            lower, upper = getattr(self, low), getattr(self, high)
            if lower.shape != upper.shape or np.any(np.isnan(lower)) or np.any(np.isnan(upper)):
                raise ParameterError("controller", low, lower, f"numbers of the same shape as {high} = {upper}")
            if np.any(lower >= upper):
                raise ParameterError("controller", low, lower, f"below {high} = {upper}")

    def output(self, i: int) -> tuple[str, float, str]:
        """A constrained output as scenario files name it: its state, what one of its unit is there, and that unit."""
        (states,) = np.nonzero(self.C_c[i])
        if states.size != 1 or self.C_c[i, states[0]] != 1.0 or states[0] >= N_STATES:
            return f"row {i} of C_c", 1.0, ""
        name, unit = STATE_NAMES[states[0]], STATE_UNITS[states[0]]
        return (name, math.degrees(1.0), unit.replace("rad", "deg")) if unit.startswith("rad") else (name, 1.0, unit)

    @property
    def slewing(self) -> np.ndarray[tuple[int], np.dtype[np.int64]]:
        """The inputs whose steps have a bound."""
        return np.flatnonzero(np.isfinite(self.delta_min) | np.isfinite(self.delta_max))


@dataclass(frozen=True, kw_only=True)
class Problem:
    """Everything that defines a controller but the way its optimum is found.

    Attributes:
        model: the prediction model.
        horizon: N, steps.
        objective: what is minimised.
        bounds: what must hold; None for the unconstrained MPC.
    """

    model: LinearModel
    horizon: int
    objective: Objective
    bounds: Bounds | None = None

    def __post_init__(self) -> None:
        if not isinstance(self.horizon, int) or self.horizon < 1:
            raise ParameterError("controller", "horizon", self.horizon, "a whole number >= 1")
        n, nu = self.model.n, self.model.nu
        _check_shape("C_r", self.objective.C_r, (self.objective.C_r.shape[0], n))
        _check_shape("Q_u", self.objective.Q_u, (nu, nu))
        if self.bounds is not None:
            n_c = self.bounds.y_min.size
            _check_shape("C_c", self.bounds.C_c, (n_c, n))
            _check_shape("delta_min", self.bounds.delta_min, (nu,))
            _check_shape("u_min", self.bounds.u_min, (nu,))


def _check_shape(name: str, value: Array, shape: tuple[int, ...]) -> None:
    if value.shape != shape:
        raise ParameterError("controller", name, value.shape, f"of shape {shape}")


def _check_positive_definite(name: str, matrix: Array) -> None:
    symmetric = matrix.ndim == 2 and matrix.shape[0] == matrix.shape[1] and np.array_equal(matrix, matrix.T)
    if not symmetric or not np.all(np.isfinite(matrix)) or np.linalg.eigvalsh(matrix)[0] <= 0.0:
        raise ParameterError("controller", name, matrix.tolist(), "symmetric and positive definite")
