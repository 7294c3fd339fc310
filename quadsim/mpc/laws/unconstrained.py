"""The unconstrained MPC: a constant gain.  Eqs. (21)-(26).

Without constraints the optimum is linear in the state and the desired outputs, u(k) = K_N xi(k) + G_N y_d + L_N u_bar:
the gains are computed once, and a period is a product of matrices and vectors.  The constrained MPCs try the same
optimum first (`quadsim.mpc.forms.condensing.FreeOptimum`): where it satisfies every constraint, they solve no QP.
"""

from __future__ import annotations

import time as clock
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Final, Literal

import numpy as np
import scipy.linalg
from annotated_types import doc

from quadsim.controller import GAIN, GROUNDED, UNCONSTRAINED, Command, Statistics, StepInputs, stopped
from quadsim.errors import ParameterError
from quadsim.mpc.forms.condensing import condensed_cost
from quadsim.mpc.laws import register
from quadsim.mpc.problem.ocp import Problem
from quadsim.mpc.problem.paper import prediction, rollout
from quadsim.mpc.space import Shape
from quadsim.mpc.tables.bounded import Weighted
from quadsim.state import INDEX, Array, ReferenceTurns
from quadsim.vehicle import Vehicle


@dataclass(frozen=True, kw_only=True)
class SequenceGains:
    """The whole optimal sequence u_opt = K xi(k) + G y_d + L u_bar of Eq. (22), all N steps.

    The first nu rows are K_N, G_N and L_N of Eqs. (23)-(26).
    """

    K: Array  # (N nu, n)
    G: Array  # (N nu, N n_r)
    L: Array  # (N nu, nu), but for rounding the identity at every step: at rest on the reference, u = u_bar is optimal


def sequence_gains(problem: Problem) -> SequenceGains:
    """Solve Eq. (21) for the optimal sequence, without the problem's constraints.

    Raises:
        ParameterError: the objective has a weight Q_d on changes of the input, for which there is no gain of u(k-1).
    """
    Q_d = problem.objective.Q_d
    if Q_d is not None and Q_d.any():
        raise ParameterError(
            "controller", "Q_d", Q_d.tolist(), "None or zero: this law has no gain of the input before"
        )
    terms = condensed_cost(problem, prediction(problem.model, problem.horizon))
    factor = scipy.linalg.cho_factor(terms.H)
    # The cost is quadratic in u - u_bar, so its gradient is H u - H [I; ...; I] u_bar + F_x xi(k) + F_y y_d.  In the
    # paper's terms, with the sign of F3 corrected, H [I; ...; I] = -(F3 + F4) (`quadsim.mpc.problem.paper.Cost`).
    every_step = np.tile(np.eye(problem.model.nu), (problem.horizon, 1))
    cost_of_u_bar = terms.H @ every_step
    return SequenceGains(
        K=-scipy.linalg.cho_solve(factor, terms.F_x),
        G=-scipy.linalg.cho_solve(factor, terms.F_y),
        L=scipy.linalg.cho_solve(factor, cost_of_u_bar),
    )


class UnconstrainedMPC:
    """The linear feedback law of Eq. (23), which also reports the rest of its optimal sequence.

    Examples:
        >>> import numpy as np
        >>> import quadsim
        >>> from quadsim import mpc
        >>> problem = quadsim.problem("paper-unconstrained")
        >>> controller = mpc.UnconstrainedMPC(problem)
        >>> reference = np.tile([0.0, 0.0, 1.0, 0.0], (problem.horizon, 1))  # 1 m up
        >>> command = controller.step(quadsim.StepInputs(), np.zeros(12), reference)
        >>> command.speeds.shape, bool((command.speeds > problem.model.u_bar).all())
        ((4,), True)
    """

    name: Final = "unconstrained"
    solver: Final = ""

    def __init__(self, problem: Problem) -> None:
        self.problem = problem
        self.horizon = problem.horizon
        self.gains = sequence_gains(problem)
        self._offset = self.gains.L @ problem.model.u_bar
        self._turns = ReferenceTurns()

    def reset(self, speeds: Array) -> None:
        """Forget the turn of the reference's yaw, the only state."""
        self._turns.reset()

    def step(self, now: StepInputs, state: Array, reference: Array) -> Command:
        """Evaluate Eq. (22), rotors off while landed; see `quadsim.controller.Controller.step`."""
        if now.phase in GROUNDED:
            return stopped(np.zeros(self.problem.model.nu), self.horizon, now.phase)
        started = clock.perf_counter()
        yaw = float(state[INDEX["yaw"]])
        desired = self.problem.desired(self._turns.follow(reference, yaw))
        sequence = self.gains.K @ state + self.gains.G @ desired.ravel() + self._offset
        plan = sequence.reshape(self.horizon, -1)
        spent_s = clock.perf_counter() - started
        stats = Statistics(solve_s=spent_s)
        return Command(speeds=plan[0].copy(), plan=plan, status=UNCONSTRAINED, answered_by=GAIN, stats=stats)

    def predict(self, states: Array, plans: Array) -> Array:
        """See `quadsim.controller.Controller.predict`."""
        return rollout(self.problem.model, states, plans)


@register(
    title="unconstrained MPC",
    description="the paper's Sec. 4: a constant gain from the unconstrained optimum",
    place=1,
)
@dataclass(frozen=True, kw_only=True)
class Unconstrained(Weighted):
    """The paper's unconstrained MPC, a constant gain (Sec. 4)."""

    type: Annotated[Literal["unconstrained"], doc("the controller, by its name in `quadsim list`")] = "unconstrained"

    def law(self, vehicle: Vehicle, period: float, shapes: Sequence[Shape] = ()) -> UnconstrainedMPC:
        """See `quadsim.mpc.tables.controller.ControllerTable.law`."""
        return UnconstrainedMPC(self.problem(vehicle, period))
