"""The constrained MPC: the optimum of Eq. (27) in every period.  Eqs. (27)-(29)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Final, Literal

import numpy as np
from annotated_types import doc

from mpc.answer import ActuatorBounds, AnswerCheck, command_of, rejection, shifted
from mpc.bounded import Bounded, FallbackSettings
from mpc.handover import resized, within
from mpc.obstacles import ObstacleQP, Shape, Space
from mpc.ocp import InfeasiblePeriod, Problem, Query
from mpc.paper import rollout
from mpc.qp import KKT_EVERY
from mpc.solvers import INVALID_DATA, Answer, Solver
from quadsim.controller import GROUNDED, Command, Controller, StepInputs, stopped
from quadsim.errors import PlanExhaustedError
from quadsim.state import INDEX, Array, ReferenceTurns
from quadsim.vehicle import Vehicle


class ConstrainedMPC:
    """The MPC of Eq. (27): it solves for the optimal plan in each period and sends the plan's first input.

    If the unconstrained optimum satisfies every constraint, it is the solution and no QP is solved; the status is then
    `unconstrained`.  The controller uses an answer only if it is solved and finite, its first input is within the hard
    bounds, and its plan satisfies the problem's rows (`mpc.answer.AnswerCheck`).  Otherwise it holds the previous plan,
    shifted by one step (fallback level 1), for as long as that plan lasts, and then ends the flight.

    Arguments: `solver` is the problem's (`mpc.solvers.make_solver`), `space` the obstacles to avoid, `kkt_every` the
    interval of KKT checks.  States, units and frames: `docs/conventions.md`.

    Attributes:
        problem: the optimal control problem.
        infeasible_period: the first period since `reset` whose QP had no answer; None if there was none.
        answer: the answer of the last period; None before the first.
    """

    name: Final = "constrained"
    answer: Answer | None = None

    def __init__(
        self,
        problem: Problem,
        solver: Solver,
        *,
        space: Space | None = None,
        kkt_every: int = KKT_EVERY,
    ) -> None:
        self.problem, self.horizon, self.solver = problem, problem.horizon, solver.name
        self._solver = solver
        self._obstacles = None if space is None else ObstacleQP(problem, self._solver, space)
        self._bounds, self._check = ActuatorBounds.of_problem(problem), AnswerCheck(problem, kkt_every)
        self._turns = ReferenceTurns()
        self.reset(problem.model.u_bar)

    def reset(self, speeds: Array) -> None:
        """Restart after the command u(-1) (4,) [rad/s]."""
        self._before = np.array(speeds, float)
        self._plan: Array | None = None
        self._held = 0
        self._turns.reset()
        self.infeasible_period: InfeasiblePeriod | None = None
        self._solver.reset()
        self._check.reset()
        if self._obstacles is not None:
            self._obstacles.reset()

    def adopt(self, previous: object) -> None:
        """Take over the plan of the previous law, to hold if a QP has no answer."""
        law = within(previous, ConstrainedMPC)
        if law is not None and law._plan is not None:
            self._plan, self._held = resized(law._plan, self.horizon), law._held

    def step(self, now: StepInputs, state: Array, reference: Array) -> Command:
        """See `quadsim.controller.Controller.step`.

        While landed, the rotors slow down to their lowest speed as fast as their bounds allow.

        Raises:
            PlanExhaustedError: the solver failed and the previous plan has no step left.
        """
        if now.acting is not None:
            self._before = now.acting
        if now.phase in GROUNDED:
            self._before, self._plan, self._held = self._bounds.reach(self._before)[0], None, 0
            return stopped(self._before.copy(), self.horizon, now.phase)
        reference = self._turns.follow(reference, float(state[INDEX["yaw"]]))
        query = Query(state, self.problem.objective.desired(reference), self._before)
        problem = self.problem
        if self._obstacles is None:
            answer = self._solver.solve(query)
        else:
            answer, problem = self._obstacles.solve(now.time, query)
        refused = rejection(answer.status, answer.plan[0], answer.plan, self._bounds, self._before)
        answer, refused = self._check(problem, query, answer, refused)
        self.answer = answer
        if refused not in (None, INVALID_DATA) and self.infeasible_period is None:
            self.infeasible_period = InfeasiblePeriod(problem=problem, query=query, status=refused, time=now.time)
        if refused is None:
            self._plan, self._held = answer.plan, 0
        elif self._plan is None or self._held + 1 >= self.horizon:
            held = f"after holding the last plan for {self._held} periods" if self._held else "with no plan to hold"
            raise PlanExhaustedError(f"the solver answered {refused!r} {held}", time=now.time)
        else:
            self._held += 1
        self._before = self._bounds.clip(self._plan[self._held], self._before)
        if refused is None:
            return command_of(self._before, self._plan, answer.status, answer)
        return command_of(self._before, shifted(self._plan, self._held), refused, answer, fallback=1)

    def predict(self, states: Array, plans: Array) -> Array:
        """See `quadsim.controller.Controller.predict`."""
        return rollout(self.problem.model, states, plans)


@dataclass(frozen=True, kw_only=True)
class Constrained(Bounded):
    """The paper's constrained MPC, the optimum of a QP in every period (Sec. 5)."""

    type: Annotated[Literal["constrained"], doc("the control law, by its name in `quadsim list`")] = "constrained"
    fallback: Annotated[
        FallbackSettings | None,
        doc("absent: the last plan is held, shifted, and then the flight ends"),
    ] = None

    def build(self, vehicle: Vehicle, period: float, shapes: Sequence[Shape] = ()) -> Controller:
        """See `mpc.bounded.ControllerTable.build`."""
        law = self.in_c(vehicle, period, shapes)
        if law is None:
            problem, space = self.problem(vehicle, period), self.space(shapes, vehicle, period, None)
            law = ConstrainedMPC(problem, self.make_solver(problem, space), space=space, kkt_every=self.kkt_every)
        return law if self.fallback is None else self.guarded(law, self.fallback, vehicle, period)
