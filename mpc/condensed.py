"""The paper's condensed QP in the inputs alone.  Eqs. (27)-(29)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mpc.constraints import inequalities
from mpc.cost import cost
from mpc.prediction import prediction
from mpc.problem import Bounds, Problem
from mpc.qp import QP, Solution, Vectors
from quadsim.state import Array


@dataclass(frozen=True, kw_only=True)
class Condensed:
    """min 1/2 u' H u + F(k)' u over u = [u(k); ...; u(k+N-1)], with the paper's row pairs as two-sided rows.

    Rows of steps that have no bound are left out.

    Attributes:
        qp: H, the upper halves of A_ineq, and the box; vectors for xi(k), y_d and u(k-1) all zero.
        nu: number of inputs.
        c_p: (N nu, n + N n_r) slope of c in [xi(k); y_d], which is [F1 F2].
        h_p: (rows, n + nu) slope of h_l and h_u in [xi(k); u(k-1)], which is [G1 G2].
    """

    qp: QP
    nu: int
    c_p: Array
    h_p: Array

    def vectors(self, state: Array, desired: Array, u_before: Array) -> Vectors:
        """See `mpc.qp.Formulation.vectors`."""
        c = self.qp.c + self.c_p @ np.concatenate([state, desired.ravel()])
        shift = self.h_p @ np.concatenate([state, u_before])
        return Vectors(c=c, b=self.qp.b, h_l=self.qp.h_l + shift, h_u=self.qp.h_u + shift)

    def inputs(self, x: Array) -> Array:
        """See `mpc.qp.Formulation.inputs`."""
        return x.reshape(-1, self.nu)

    def condensed(self, solution: Solution) -> Solution:
        """See `mpc.qp.Formulation.condensed`."""
        return solution


def condensed(problem: Problem) -> Condensed:
    """Condense a constrained problem.

    Raises:
        ValueError: the problem has no bounds; it needs no QP.
    """
    bounds = require_bounds(problem)
    model = problem.model
    maps = prediction(model, problem.horizon)
    terms = cost(maps, problem.objective)
    rows = inequalities(maps, bounds)
    slews = np.arange(problem.horizon)[:, None] * model.nu + bounds.slewing
    kept = np.concatenate([np.arange(rows.n_outputs), rows.n_outputs + slews.ravel()])
    upper, lower = rows.upper_rows[kept], rows.lower_rows[kept]
    constant = rows.G3 + rows.G4 @ model.u_bar
    size = terms.H.shape[0]
    return Condensed(
        qp=QP(
            P=np.asfortranarray(terms.H),
            c=(terms.F3 + terms.F4) @ model.u_bar,
            A=np.zeros((0, size)),
            b=np.zeros(0),
            G=np.asfortranarray(rows.A_ineq[upper]),
            h_l=-constant[lower],
            h_u=constant[upper],
            x_l=rows.u_min,
            x_u=rows.u_max,
        ),
        nu=model.nu,
        c_p=np.hstack([terms.F1, terms.F2]),
        h_p=np.hstack([rows.G1[upper], rows.G2[upper]]),
    )


def require_bounds(problem: Problem) -> Bounds:
    """The problem's bounds.

    Raises:
        ValueError: there are none.
    """
    if problem.bounds is None:
        raise ValueError("a constrained MPC needs a problem with bounds")
    return problem.bounds
