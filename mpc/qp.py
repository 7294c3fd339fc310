"""A quadratic program as a value, a solution as a value, and what makes one the other's: the KKT residuals."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol, TypeAlias

import numpy as np
from scipy.sparse import csc_matrix

from mpc.problem import Problem
from quadsim.state import Array

Matrix: TypeAlias = Array | csc_matrix


@dataclass(frozen=True, kw_only=True)
class Vectors:
    """The part of a QP that changes from one control period to the next."""

    c: Array
    b: Array
    h_l: Array
    h_u: Array


@dataclass(frozen=True, kw_only=True)
class QP:
    """min 1/2 x' P x + c' x  subject to  A x = b,  h_l <= G x <= h_u,  x_l <= x <= x_u.

    Matrices are dense or sparse (csc); bounds may be infinite.  Eq. (27), with rows bounded from both sides.

    Attributes:
        seldom: how many rows, the last of G, hardly ever bind.  A hint: a back end may leave them out at first, since
            an optimum that satisfies them all the same is the optimum.
    """

    P: Matrix
    c: Array
    A: Matrix
    b: Array
    G: Matrix
    h_l: Array
    h_u: Array
    x_l: Array
    x_u: Array
    seldom: int = 0

    def with_vectors(self, vectors: Vectors) -> QP:
        """The same matrices and box with other vectors."""
        return replace(self, c=vectors.c, b=vectors.b, h_l=vectors.h_l, h_u=vectors.h_u)


@dataclass(frozen=True, kw_only=True)
class Solution:
    """What a back end answers, or a shortcut; arrays are no back end's own, and not to be written to.

    Attributes:
        x: primal point.
        y: multipliers of A x = b.
        z: multipliers of h_l <= G x <= h_u, positive at the upper side, negative at the lower.
        z_box: multipliers of x_l <= x <= x_u, signed likewise.
        status: `solved`, or the back end's name for what went wrong; of a shortcut, see `mpc.shortcut`.
        iterations: of the back end.
        active: inequality rows and box entries active at the point.
        primal_residual: as the back end reports it, before any polish; NaN where it reports none.
        dual_residual: likewise.
        solve_s: wall time inside the back end, updates included, and what shortcuts took before it [s].
    """

    x: Array
    y: Array
    z: Array
    z_box: Array
    status: str
    iterations: int
    active: int
    primal_residual: float
    dual_residual: float
    solve_s: float


class Formulation(Protocol):
    """One way to write an MPC's optimisation as a QP whose matrices never change."""

    @property
    def qp(self) -> QP:
        """The matrices, with vectors for a zero state."""
        ...

    def vectors(self, state: Array, desired: Array, u_before: Array) -> Vectors:
        """The QP's vectors for xi(k) (n,), y_d (N, n_r) and u(k-1) (nu,)."""
        ...

    def inputs(self, x: Array) -> Array:
        """(N, nu) the planned inputs [rad/s] in a primal point."""
        ...

    def condensed(self, solution: Solution) -> Solution:
        """The same solution as one of the QP of `mpc.condensed`."""
        ...


class Backend(Protocol):
    """A QP solver set up once and called with new vectors each period."""

    def setup(self, qp: QP) -> None:
        """Take over the matrices and the box."""
        ...

    def solve(self, vectors: Vectors) -> Solution:
        """Solve with new vectors; whatever happens is in the solution's status."""
        ...


class FormulationBuilder(Protocol):
    """Builds a formulation for a constrained problem."""

    def __call__(self, problem: Problem) -> Formulation:
        """Build it."""
        ...


@dataclass(frozen=True, kw_only=True)
class KKTResiduals:
    """How far a point is from optimal, each as the largest absolute entry; all zero at the optimum.

    Attributes:
        stationarity: P x + c + A' y + G' z + z_box.
        primal: violation of A x = b, h_l <= G x <= h_u, x_l <= x <= x_u.
        complementarity: multiplier times distance to the bound it belongs to.
        dual: size of multipliers with no bound to belong to (an infinite one).
    """

    stationarity: float
    primal: float
    complementarity: float
    dual: float

    @property
    def worst(self) -> float:
        """The largest of the four."""
        return float(np.max([self.stationarity, self.primal, self.complementarity, self.dual]))


def kkt_residuals(qp: QP, solution: Solution) -> KKTResiduals:
    """The KKT residuals of a solution, computed from the QP alone and believing no solver."""
    x, y, z, z_box = solution.x, solution.y, solution.z, solution.z_box
    gradient = qp.P @ x + qp.c + qp.A.T @ y + qp.G.T @ z + z_box
    values = np.concatenate([qp.G @ x, x])
    multipliers = np.concatenate([z, z_box])
    lower, upper = np.concatenate([qp.h_l, qp.x_l]), np.concatenate([qp.h_u, qp.x_u])
    bound = np.where(multipliers >= 0.0, upper, lower)
    bounded = np.isfinite(bound)
    distance = np.where(bounded, np.abs(np.where(bounded, bound, 0.0) - values), 0.0)
    violation = np.concatenate([lower - values, values - upper, np.abs(qp.A @ x - qp.b)])
    return KKTResiduals(
        stationarity=_largest(gradient),
        primal=float(np.max(violation, initial=0.0)),  # NaN stays NaN
        complementarity=_largest(multipliers * distance),
        dual=_largest(np.where(bounded, 0.0, multipliers)),
    )


def _largest(values: Array) -> float:
    return float(np.max(np.abs(values), initial=0.0))
