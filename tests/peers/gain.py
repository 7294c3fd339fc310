"""The unconstrained gain, against do-mpc's finite-horizon LQR and, as N grows, scipy's discrete Riccati equation.

The paper's cost weighs the outputs of xi(k+1) .. xi(k+N) and the inputs u(k) .. u(k+N-1).  An LQR's weighs the states
x_0 .. x_{N-1} with Q, x_N with P, and the same inputs with R.  The term of x_0 does not depend on the inputs; so
Q = P = C_r' Q_y C_r and R = Q_u give the same minimiser, and the LQR's gain of its first step, after N steps of the
Riccati recursion, is K_N exactly.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
import scipy.linalg
from peers.checks import Check

from quadsim.mpc.laws.unconstrained import sequence_gains
from quadsim.mpc.problem.ocp import Problem
from quadsim.state import Array

SCENARIO: Final = "paper-unconstrained"
HORIZONS: Final = (10, 20, 50, 100)
ALLOWED: Final = {10: 1e-12, 20: 1e-12, 50: 1e-10, 100: 1e-8}
"""Relative differences that pass; they grow as the condensed cost's rounding does."""


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """K_N for one horizon."""

    horizon: int  # N
    difference: float  # of K_N from do-mpc's gain for N, relative to it in the Frobenius norm
    one_step_more: float  # the same from do-mpc's gain for N + 1, which a wrong index would compare with
    infinite: float  # the same from the gain of scipy's discrete algebraic Riccati equation

    @property
    def checks(self) -> tuple[Check, ...]:
        """Against the finite horizon, and for the longest N against the infinite one."""
        what = f"gain, N = {self.horizon}, relative"
        finite = Check(what=what, peer="do-mpc", measured=self.difference, allowed=ALLOWED[self.horizon])
        if self.horizon < max(HORIZONS):
            return (finite,)
        what = f"gain, N = {self.horizon}, from the infinite horizon's, relative"
        return finite, Check(what=what, peer="scipy", measured=self.infinite, allowed=1e-3)


def measure(problem: Problem) -> tuple[Comparison, ...]:
    """Compare for each of `HORIZONS`."""
    return tuple(_compare(replace(problem, horizon=horizon)) for horizon in HORIZONS)


def riccati_gain(problem: Problem) -> Array:
    """(nu, n) the first gain of do-mpc's LQR over the problem's horizon."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # do-mpc warns of extras that are not installed, when imported
        from do_mpc.controller import LQR
        from do_mpc.model import LinearModel
    model = LinearModel("discrete")
    model.set_variable("_x", "xi", shape=(problem.model.n, 1))
    model.set_variable("_u", "u", shape=(problem.model.nu, 1))
    model.setup(problem.model.A, problem.model.B)
    weight = _state_weight(problem)
    lqr = LQR(model)
    lqr.settings.t_step = problem.model.period
    lqr.settings.n_horizon = problem.horizon
    lqr.set_objective(Q=weight, R=problem.objective.Q_u, P=weight)
    lqr.setup()
    return np.array(lqr.K)


def infinite_gain(problem: Problem) -> Array:
    """(nu, n) the gain that scipy's solution of the discrete algebraic Riccati equation gives."""
    A = problem.model.A
    B = problem.model.B
    R = problem.objective.Q_u
    P = scipy.linalg.solve_discrete_are(A, B, _state_weight(problem), R)
    return -np.linalg.solve(R + B.T @ P @ B, B.T @ P @ A)


def _state_weight(problem: Problem) -> Array:
    """(n, n) the weight of the outputs, on the state."""
    objective = problem.objective
    return objective.C_r.T @ objective.Q_y @ objective.C_r


def _compare(problem: Problem) -> Comparison:
    K_N = sequence_gains(problem).K[: problem.model.nu]

    def relative(other: Array) -> float:
        return float(np.linalg.norm(K_N - other) / np.linalg.norm(other))

    return Comparison(
        horizon=problem.horizon,
        difference=relative(riccati_gain(problem)),
        one_step_more=relative(riccati_gain(replace(problem, horizon=problem.horizon + 1))),
        infinite=relative(infinite_gain(problem)),
    )
