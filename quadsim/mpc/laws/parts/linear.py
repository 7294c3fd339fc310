"""The linear MPC: in every period it solves the optimisation of Eq. (27), from a query made of the measurements.

A step is: measurement -> `Preparation.prepare` -> `Query` -> solver -> `Answer` -> check -> `Command`.  The problem
(model, cost, constraints) is built once; the query has what differs from period to period: the state, the desired
outputs, the last command and the equilibrium.  The paper's constrained MPC and the robust MPC differ only in their
preparation.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple, Protocol

import numpy as np

from quadsim.controller import GROUNDED, ROTORS, Command, StepInputs, stopped
from quadsim.errors import PlanExhaustedError
from quadsim.mpc.estimate.observer import disturbance_of
from quadsim.mpc.guard.answer import ActuatorBounds, AnswerCheck, command_of, refused, rejection, resized, shifted
from quadsim.mpc.laws.parts.core_law import CoreLaw, CoreNumbers, core_law
from quadsim.mpc.problem.equilibrium import Trim
from quadsim.mpc.problem.ocp import InfeasiblePeriod, Problem, Query
from quadsim.mpc.problem.paper import rollout
from quadsim.mpc.problem.qp import KKT_EVERY
from quadsim.mpc.solvers import INVALID_DATA, Answer, Solver
from quadsim.mpc.space import SOLVER as SPACE_SOLVER
from quadsim.mpc.space import ObstacleQP, Space
from quadsim.state import INDEX, Array, ReferenceTurns

if TYPE_CHECKING:
    from quadsim.core.mirror import Struct
    from quadsim.mpc.tables.bounded import Bounded


class Remembered(NamedTuple):
    """What a preparation remembers of its vehicle, for another one to take over in flight."""

    delay: float  # from t_k to the instant of x(k), at which the command of period k takes over [s]
    rotors: Array  # (4,) rotor speeds at the instant of this period at which the next command takes over [rad/s]
    turning: Array  # (4,) rotor speeds at the instant of x(k), after all commands under way [rad/s]
    sent: tuple[Array, ...]  # the last commands sent (4,), oldest first [rad/s]
    ahead: Array | None  # (12,) predicted state at the instant of `rotors`; None if it is not known
    called_at: float  # time of the last call [s]
    measured: float  # time of the last measured state [s]
    estimate: Array | None  # (6,) of the observer, as `quadsim.mpc.estimate.observer` says; None without one
    targets: bool  # whether commands are an inner loop's targets, not rotor speeds


class Preparation(Protocol):
    """Makes the query of each period from its measurements, and from what it remembers of earlier periods."""

    @property
    def problem(self) -> Problem:
        """The optimal control problem that queries refer to."""
        ...

    @property
    def delay(self) -> float:
        """Time from t_k to the instant of x(k) [s]."""
        ...

    @property
    def numbers(self) -> CoreNumbers | None:
        """The numbers of the same controller in C; None if there is none."""
        ...

    @property
    def yaw(self) -> float:
        """Angle by which the axes of the last query are turned about world z [rad]."""
        ...

    @property
    def trim(self) -> Trim | None:
        """The equilibrium under the estimated disturbance; None where none is estimated."""
        ...

    @property
    def disturbance(self) -> Array | None:
        """(6,) estimated accelerations [m/s^2] and angular accelerations [rad/s^2]; None where none are estimated."""
        ...

    def reset(self, speeds: Array) -> None:
        """Restart after the command u(-1) (4,) [rad/s]."""
        ...

    @property
    def memory(self) -> Remembered | None:
        """What another preparation may take over; None if there is nothing."""
        ...

    def adopt(self, memory: Remembered | None, disturbance: Array | None) -> None:
        """Take over what the previous controller has learnt.

        Args:
            memory: of its preparation; None if it has none.
            disturbance: as of `disturbance`; None if it estimates none.
        """
        ...

    def stand(self, now: StepInputs, acting: Array) -> None:
        """Pass a period on the ground, with the command `acting` (4,) in force [rad/s]."""
        ...

    def prepare(self, now: StepInputs, state: Array, reference: Array, acting: Array) -> Query | None:
        """Return the query of a period in the air; None if its numbers are out of range.  It is called once per period.

        Args:
            now: time, and inputs besides the state.
            state: (12,) measured.
            reference: (N, 4) x, y, z [m], yaw [rad] at t_{k+1} .. t_{k+N}.
            acting: (4,) the command in force, u(k-1) [rad/s].
        """
        ...

    def predict(self, states: Array, plans: Array) -> Array:
        """See `quadsim.controller.Controller.predict`."""
        ...


class NominalPreparation:
    """Makes the paper's query, about hover: the measured state, the desired outputs and the last command.

    The reference's yaw is moved by whole turns to the turn of the measured yaw (`quadsim.state.ReferenceTurns`).

    Examples:
        >>> import numpy as np
        >>> import quadsim
        >>> from quadsim import mpc
        >>> problem = quadsim.problem("paper-constrained")
        >>> preparation = mpc.NominalPreparation(problem)
        >>> state = np.zeros(12)
        >>> query = preparation.prepare(quadsim.StepInputs(), state, np.zeros((50, 4)), problem.model.u_bar)
        >>> query.state.shape, query.desired.shape
        ((12,), (50, 4))
    """

    delay = 0.0
    yaw = 0.0
    trim = None
    disturbance = None
    memory = None
    numbers = None

    def __init__(self, problem: Problem) -> None:
        self.problem = problem
        self._turns = ReferenceTurns()

    def reset(self, speeds: Array) -> None:
        """Forget the turn of the reference's yaw, the only state."""
        self._turns.reset()

    def adopt(self, memory: Remembered | None, disturbance: Array | None) -> None:
        """Take over nothing: there is no estimate."""

    def stand(self, now: StepInputs, acting: Array) -> None:
        """Change nothing."""

    def prepare(self, now: StepInputs, state: Array, reference: Array, acting: Array) -> Query:
        """See `Preparation.prepare`; it always returns a query, since solvers refuse numbers that are not finite."""
        yaw = float(state[INDEX["yaw"]])
        desired = self.problem.desired(self._turns.follow(reference, yaw))
        return Query(state=state, desired=desired, u_before=acting)

    def predict(self, states: Array, plans: Array) -> Array:
        """See `quadsim.controller.Controller.predict`."""
        return rollout(self.problem.model, states, plans)


class LinearMPC:
    """The MPC of Eq. (27): it solves for the optimal plan in each period and sends the plan's first input.

    If the unconstrained optimum satisfies every constraint, it is the solution and no QP is solved; the status is then
    `unconstrained`.  The controller uses an answer only if it is solved and finite, its first input is within the hard
    bounds, and its plan satisfies the problem's rows (`AnswerCheck`).  Otherwise a controller that holds plans flies
    the last accepted one, one step further in each period (fallback level 1), and ends the flight when the plan has no
    step left.  Any other controller repeats the command in force, with the reason as its status, for a fallback to act
    on.

    States, units and frames: `docs/conventions.md`.

    Attributes:
        preparation: what makes the queries.
        problem: the optimal control problem.
        commands: what it commands: rotor speeds, or an autopilot's targets.
        infeasible_period: the first period since `reset` whose QP had no answer; None if there was none.
        answer: the solver's last answer; None before the first.

    Examples:
        >>> import numpy as np
        >>> import quadsim
        >>> from quadsim import mpc
        >>> problem = quadsim.problem("paper-constrained")
        >>> solver = mpc.QPSolver("piqp", problem, free_first=True)
        >>> controller = mpc.LinearMPC(mpc.NominalPreparation(problem), solver, name="mine")
        >>> command = controller.step(quadsim.StepInputs(), np.zeros(12), np.zeros((50, 4)))
        >>> command.status, bool(np.allclose(command.speeds, problem.model.u_bar))
        ('unconstrained', True)
    """

    answer: Answer | None = None

    def __init__(
        self,
        preparation: Preparation,
        solver: Solver,
        *,
        name: str,
        holds: bool = False,
        space: Space | None = None,
        kkt_every: int = KKT_EVERY,
        commands: str = ROTORS,
    ) -> None:
        """Set up at rest.

        Args:
            preparation: makes the query of each period.
            solver: the problem's (`quadsim.mpc.solvers.by_name.make_solver`).
            name: of the controller, in summaries.
            holds: whether the last plan is held where a QP has no answer.
            space: the obstacles to avoid; None for none.
            kkt_every: interval of KKT checks [periods].
            commands: what it commands.
        """
        self.preparation = preparation
        self.problem = preparation.problem
        self.name = name
        self.solver = solver.name
        self.horizon = self.problem.horizon
        self.commands = commands
        self._solver = solver
        self._holds = holds
        if space is None:
            self._obstacles = None
        else:
            self._obstacles = ObstacleQP(self.problem, solver, space)
        self._bounds = ActuatorBounds.of_problem(self.problem)
        self._check = AnswerCheck(self.problem, kkt_every)
        self.reset(self.problem.model.u_bar)

    def reset(self, speeds: Array) -> None:
        """Restart after the command u(-1) (4,) [rad/s], with rotors at that speed."""
        self._acting = np.array(speeds, float)  # (4,) the command in force, u(k-1) [rad/s]
        self._plan: Array | None = None  # the last accepted plan; always None for a controller that does not hold plans
        self._held = 0  # periods for which it has been held so far
        self.infeasible_period: InfeasiblePeriod | None = None
        self.preparation.reset(self._acting)
        self._solver.reset()
        self._check.reset()
        if self._obstacles is not None:
            self._obstacles.reset()

    def adopt(self, previous: object) -> None:
        """Take over what the previous controller has learnt, and the plan that it would hold if a QP had no answer."""
        memory = None
        if isinstance(previous, LinearMPC):
            memory = previous.preparation.memory
            if previous._plan is not None and self._holds:
                self._plan = resized(previous._plan, self.horizon)
                self._held = previous._held
        self.preparation.adopt(memory, disturbance_of(previous))

    @property
    def iterates(self) -> frozenset[str]:
        """See `quadsim.controller.Iterating`."""
        if self._obstacles is None:
            return self._solver.iterates
        return self._solver.iterates | {SPACE_SOLVER}

    @property
    def trim(self) -> Trim | None:
        """See `Preparation.trim`."""
        return self.preparation.trim

    @property
    def disturbance(self) -> Array | None:
        """See `Preparation.disturbance`."""
        return self.preparation.disturbance

    @np.errstate(over="ignore", invalid="ignore", divide="ignore")  # values out of range are rejected, not warned of
    def step(self, now: StepInputs, state: Array, reference: Array) -> Command:
        """See `quadsim.controller.Controller.step`.

        While landed, the rotors slow down to their lowest speed as fast as their bounds allow.  Numbers that the
        preparation rejects give the status `invalid_data`.

        Raises:
            PlanExhaustedError: the solver failed, and the plan that is held has no step left.
        """
        if now.acting is not None:
            self._acting = np.array(now.acting, float)
        if now.phase in GROUNDED:
            return self._slow_down(now)
        query = self.preparation.prepare(now, state, reference, self._acting)
        if query is None:
            return refused(self._acting, self.horizon, INVALID_DATA)
        answer, problem = self._solve(now.time + self.preparation.delay, query)
        reason = rejection(answer.status, answer.plan[0], answer.plan, self._bounds, self._acting)
        # The check completes the answer's statistics, and may find a reason where there is none so far.
        answer, reason = self._check(problem, query, answer, reason)
        self.answer = answer
        if reason is None:
            return self._accept(answer)
        if reason != INVALID_DATA and self.infeasible_period is None:
            self.infeasible_period = InfeasiblePeriod(
                problem=problem, query=query, status=reason, time=now.time, delay=self.preparation.delay
            )
        if self._holds:
            return self._hold_plan(answer, reason, now.time)
        return refused(self._acting, self.horizon, reason, answer)

    def _slow_down(self, now: StepInputs) -> Command:
        """Return the command of a period on the ground, where no plan is flown."""
        self.preparation.stand(now, self._acting)
        self._acting = self._bounds.lowest(self._acting)
        self._plan = None
        self._held = 0
        return stopped(self._acting.copy(), self.horizon, now.phase)

    def _solve(self, time: float, query: Query) -> tuple[Answer, Problem]:
        """Return the optimum of a query whose x(k) is at a time [s], and the problem with the rows of obstacles."""
        if self._obstacles is None:
            return self._solver.solve(query), self.problem
        return self._obstacles.solve(time, query, self.preparation.yaw)

    def _accept(self, answer: Answer) -> Command:
        """Return the first input of an accepted plan as the command; where rounding put it out of bounds, on them."""
        if self._holds:
            self._plan = answer.plan
            self._held = 0
        self._acting = self._bounds.clip(answer.plan[0], self._acting)
        return command_of(self._acting, answer.plan, answer.status, answer)

    def _hold_plan(self, answer: Answer, reason: str, time: float) -> Command:
        """Return the next input of the last accepted plan, in place of an answer that is rejected for a reason."""
        if self._plan is None or self._held + 1 >= self.horizon:
            if self._held:
                raise PlanExhaustedError(
                    f"the solver answered {reason!r} after holding the last plan for {self._held} periods", time=time
                )
            raise PlanExhaustedError(f"the solver answered {reason!r} with no plan to hold", time=time)
        self._held += 1
        self._acting = self._bounds.clip(self._plan[self._held], self._acting)
        return command_of(self._acting, shifted(self._plan, self._held), reason, answer, fallback=1)

    def predict(self, states: Array, plans: Array) -> Array:
        """See `quadsim.controller.Controller.predict`."""
        return self.preparation.predict(states, plans)

    def in_core(self, fallback: Struct) -> CoreLaw | None:
        """Return this controller with its fallback contract as one controller of the core; None if a part is Python's.

        Args:
            fallback: the contract's numbers, a `quadsim_fallback`.
        """
        if self._holds or self._obstacles is not None:
            return None
        return core_law(self.problem, self.preparation.numbers, self._solver, self._check, fallback)


def linear_law(table: Bounded, preparation: Preparation, solver: Solver, space: Space | None = None) -> LinearMPC:
    """Return the `LinearMPC` of a table of settings and of the parts that are built from it."""
    return LinearMPC(
        preparation,
        solver,
        name=table.type,
        holds=table.holds_plans,
        space=space,
        kkt_every=table.kkt_every,
        commands=table.commands,
    )
