"""The paper's constrained QP, rebuilt and solved through qpmpc's own API, against ours.

For x_{j+1} = A x_j + B v_j, j = 0 .. N-1, qpmpc minimises

    |x_N - goal|^2 + sum |x_j - target_j|^2 + sum |v_j|^2   subject to   C x_j + D v_j <= e,

with one scalar weight per sum, all one here.  Ours becomes that by a change of coordinates:

- x = [S xi; eps (u(k-1) - u_bar)] and v = R (u - u_bar), S and R the square roots of the diagonal weights on xi and u.
  The state holds u(k-1) because the slew bounds need it.
- What ours does not weigh is scaled by eps = 2^-30.  A power of two rounds nothing, and the weight it leaves, eps^2,
  about 1e-18, is below the rounding of the others: zero, in double precision.
- Ours weighs and bounds the outputs of xi(k+1) .. xi(k+N), qpmpc x_0 .. x_{N-1}.  So the bounds are put on
  A x_j + B v_j; target_j is y_d(k+j) for j = 1 .. N-1, goal is y_d(k+N), and target_0 moves no input.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from peers.checks import Check
from peers.recorded import Query
from qpmpc import MPCProblem, Plan, solve_mpc

from quadsim.errors import ParameterError
from quadsim.mpc.problem.ocp import Problem
from quadsim.mpc.solvers import QPSolver
from quadsim.state import Array

SOLVER: Final = "quadprog"
"""qpsolvers' name of the solver behind qpmpc: an active-set method, exact to rounding."""
UNWEIGHED: Final = 2.0**-30
"""eps of the module's text."""
OURS: Final = "piqp-multistage"
ACTIVE: Final = 1e-9
"""Multiplier from which a constraint counts as active."""


class QpmpcController:
    """A problem of ours in qpmpc, solved anew for every query."""

    def __init__(self, problem: Problem) -> None:
        model = problem.model
        bounds = problem.bounds
        objective = problem.objective
        if bounds is None:
            raise ParameterError("controller", "bounds", None, "given: without any, there is no QP")
        n = model.n
        nu = model.nu
        weights = _diagonal("C_r' Q_y C_r", objective.C_r.T @ objective.Q_y @ objective.C_r)
        scales = np.where(weights > 0.0, np.sqrt(weights), UNWEIGHED)
        to_state = np.hstack([np.diag(1.0 / scales), np.zeros((n, nu))])  # xi = to_state x
        to_before = np.hstack([np.zeros((nu, n)), np.eye(nu) / UNWEIGHED])  # u(k-1) - u_bar = to_before x
        to_input = np.diag(1.0 / np.sqrt(_diagonal("Q_u", objective.Q_u)))  # u - u_bar = to_input v
        A = np.vstack([np.diag(scales) @ model.A @ to_state, np.zeros((nu, n + nu))])
        B = np.vstack([np.diag(scales) @ model.B, UNWEIGHED * np.eye(nu)]) @ to_input
        outputs = bounds.C_c @ to_state
        no_state = np.zeros((nu, n + nu))
        self._mpc = MPCProblem(
            transition_state_matrix=A,
            transition_input_matrix=B,
            ineq_state_matrix=np.vstack([outputs @ A, -outputs @ A, no_state, no_state, -to_before, to_before]),
            ineq_input_matrix=np.vstack([outputs @ B, -outputs @ B, to_input, -to_input, to_input, -to_input]),
            ineq_vector=np.concatenate(
                [
                    bounds.y_max,
                    -bounds.y_min,
                    bounds.u_max - model.u_bar,
                    model.u_bar - bounds.u_min,
                    bounds.delta_max,
                    -bounds.delta_min,
                ]
            ),
            nb_timesteps=problem.horizon,
            terminal_cost_weight=1.0,
            stage_state_cost_weight=1.0,
            stage_input_cost_weight=1.0,
        )
        self._scales = scales
        self._to_input = to_input
        self._u_bar = model.u_bar
        self._C_r = objective.C_r

    def solve(self, query: Query) -> Plan:
        """Qpmpc's plan, in its own coordinates."""
        before = UNWEIGHED * (query.u_before - self._u_bar)
        targets = np.hstack([query.desired @ self._C_r * self._scales, np.zeros((len(query.desired), before.size))])
        self._mpc.update_initial_state(np.concatenate([self._scales * query.state, before]))
        self._mpc.update_target_states(np.vstack([np.zeros_like(targets[:1]), targets[:-1]]))
        self._mpc.update_goal_state(targets[-1])
        return solve_mpc(self._mpc, solver=SOLVER)

    def speeds(self, plan: Plan) -> Array:
        """(4,) the first input of a plan [rad/s]; NaN where qpmpc found none."""
        if plan.first_input is None:
            return np.full_like(self._u_bar, np.nan)
        return self._to_input @ plan.first_input + self._u_bar


@dataclass(frozen=True, kw_only=True)
class ConstrainedQP:
    """What was found."""

    speeds: Array  # (K, 4) the first inputs of qpmpc's plans [rad/s]; NaN where it found none
    differences: Array  # (K,) of our QP's first inputs from them, the largest over the rotors [rad/s]
    flown: Array  # (K,) the same of what the controller flew, found with or without a QP [rad/s]
    constrained: np.ndarray[tuple[int], np.dtype[np.bool_]]  # (K,) whether a constraint is active at qpmpc's optimum

    @property
    def checks(self) -> tuple[Check, ...]:
        """The largest differences of all, NaN if there was no solution."""
        named = {"first input of the QP": self.differences, "command flown": self.flown}
        return tuple(
            Check(
                what=f"constrained: {name}, {differences.size} periods",
                peer="qpmpc",
                measured=float(differences.max()),
                allowed=1e-3,
                unit="rad/s",
            )
            for name, differences in named.items()
        )


def measure(problem: Problem, queries: Sequence[Query]) -> ConstrainedQP:
    """Solve every query with both."""
    peer = QpmpcController(problem)
    ours = QPSolver(OURS, problem)
    plans = [peer.solve(query) for query in queries]
    speeds = np.array([peer.speeds(plan) for plan in plans])
    answers = np.array([ours.solve(query.posed).plan[0] for query in queries])
    return ConstrainedQP(
        speeds=speeds,
        differences=np.abs(speeds - answers).max(axis=1),
        flown=np.abs(speeds - np.array([query.speeds for query in queries])).max(axis=1),
        constrained=np.array([plan.qpsol.z is not None and plan.qpsol.z.max() > ACTIVE for plan in plans]),
    )


def _diagonal(name: str, matrix: Array) -> Array:
    """The diagonal of a diagonal matrix.

    Raises:
        ParameterError: it is not one; the weights would need another change of coordinates.
    """
    if np.any(matrix != np.diag(np.diag(matrix))):
        raise ParameterError("controller", name, matrix.tolist(), "diagonal, to be rebuilt in qpmpc")
    return np.diag(matrix)
