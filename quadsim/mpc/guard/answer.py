"""The one test of every solver answer: solved, finite and within the actuators' limits; otherwise the reason.

A plan is predicted anew from the measured state, and must violate no normalised row by more than `INFEASIBLE`; KKT
residuals are computed now and then.  `quadsim.mpc.guard.contract` then decides what is flown.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from quadsim.controller import ACCEPTED, FALLBACK, Command
from quadsim.errors import ParameterError
from quadsim.mpc.forms.condensing import states_rows
from quadsim.mpc.problem.constraints import Rows
from quadsim.mpc.problem.ocp import Problem, Query, predicted
from quadsim.mpc.problem.paper import prediction
from quadsim.mpc.problem.qp import kkt_residuals
from quadsim.state import Array, Indices, all_true
from quadsim.vehicle import N_ROTORS, Vehicle

if TYPE_CHECKING:
    from quadsim.mpc.solvers import Answer

BOUND_TOLERANCE: Final = 1e-6
"""Tolerance of the bounds [rad/s]: an answer outside by no more is moved onto its bounds and accepted."""
INFEASIBLE: Final = 1e-3
"""Largest violation of a normalised row (`quadsim.mpc.problem.constraints.Rows`) that an accepted plan may have."""
INFEASIBLE_ANSWER: Final = "infeasible_answer"
"""Status of an answer whose plan violates a row by more than `INFEASIBLE`."""
LARGEST_MAP: Final = 2**20
"""Largest map from inputs to rows [entries] that predicts states; for a larger one they are predicted step by step."""


@dataclass(frozen=True, kw_only=True)
class ActuatorBounds:
    """Hard bounds on rotor speeds, Eq. (20), and on their steps from one period to the next, Eq. (15).

    With `targets`, on the targets of an inner loop, collective thrust [N] and body rates [rad/s], instead of speeds.
    """

    u_min: Array  # (4,) speeds [rad/s], finite and not negative: rotors turn one way
    u_max: Array  # same
    delta_min: Array  # (4,) steps u(k) - u(k-1) [rad/s]; infinite for no bound
    delta_max: Array  # same
    targets: bool = False  # whether commands are targets

    def __post_init__(self) -> None:
        for name in ("u_min", "u_max", "delta_min", "delta_max"):
            bound = np.asarray(getattr(self, name), float)
            if bound.shape != (N_ROTORS,) or np.isnan(bound).any():
                raise ParameterError("controller", name, getattr(self, name), f"{N_ROTORS} numbers")
            object.__setattr__(self, name, bound)
        if not (np.isfinite(self.u_min).all() and np.isfinite(self.u_max).all() and np.all(self.u_min < self.u_max)):
            raise ParameterError("controller", "u_min", self.u_min, f"finite and below a finite u_max = {self.u_max}")
        if self.u_min.min() < 0.0 and not self.targets:
            raise ParameterError("controller", "u_min", self.u_min, "at least 0 rad/s: rotors turn one way")
        if not np.all((self.delta_min <= 0.0) & (self.delta_max >= 0.0)):
            rule = f"<= 0 and delta_max = {self.delta_max} >= 0, so that a speed can be held"
            raise ParameterError("controller", "delta_min", self.delta_min, rule)

    @classmethod
    def alike(cls, speed: tuple[float, float], slew: tuple[float, float] = (-math.inf, math.inf)) -> ActuatorBounds:
        """Return the same (lower, upper) bounds on speed and slew for every rotor [rad/s]."""
        slowest, fastest = speed
        down, up = slew
        return cls(
            u_min=np.full(N_ROTORS, slowest),
            u_max=np.full(N_ROTORS, fastest),
            delta_min=np.full(N_ROTORS, down),
            delta_max=np.full(N_ROTORS, up),
        )

    @classmethod
    def of_problem(cls, problem: Problem) -> ActuatorBounds:
        """Return the hard rows on single inputs and single steps, as bounds that hold in every period."""
        rows = problem.rows
        nu = problem.model.nu
        sides = []
        for at in (rows.input, rows.step):
            lower = np.full(nu, -math.inf)
            upper = np.full(nu, math.inf)
            for i in np.flatnonzero(at >= 0):
                j = at[i]
                lower[j] = max(lower[j], rows.lower[0, i])
                upper[j] = min(upper[j], rows.upper[0, i])
            sides += [lower, upper]
        least, most, down, up = sides
        targets = problem.model.targets
        return cls(u_min=least, u_max=most, delta_min=down, delta_max=up, targets=targets)

    @classmethod
    def of_vehicle(cls, vehicle: Vehicle) -> ActuatorBounds:
        """Return the vehicle's range of rotor speeds, with unbounded steps."""
        return cls.alike((vehicle.speed_min, vehicle.speed_max))

    def reach(self, before: Array) -> tuple[Array, Array]:
        """Return the lowest and highest speeds (4,) [rad/s] after a command `before` (4,).

        No speed satisfies both bounds if `before` is outside the speed bounds, for example when rotors start from rest.
        The speed bounds then take precedence.
        """
        lower = np.minimum(np.maximum(before + self.delta_min, self.u_min), self.u_max)
        upper = np.minimum(np.maximum(before + self.delta_max, self.u_min), self.u_max)
        return lower, upper

    def lowest(self, before: Array) -> Array:
        """Return the command (4,) of stopping rotors: the lowest speeds in reach of `before` (4,), or no rates."""
        lower, _ = self.reach(before)
        if self.targets:
            return np.append(lower[0], np.zeros(N_ROTORS - 1))
        return lower

    def clip(self, speeds: Array, before: Array) -> Array:
        """Return the speeds (4,) [rad/s] in reach of `before` that are closest to `speeds`."""
        lower, upper = self.reach(before)
        return np.minimum(np.maximum(speeds, lower), upper)

    def clip_plan(self, plan: Array, before: Array) -> Array:
        """The plan (N, 4) with each row moved into reach of the row before, unless it is within rounding of it."""
        steps = plan - np.concatenate((before[None], plan[:-1]))
        beyond = np.maximum(self.delta_min - steps, steps - self.delta_max)
        if beyond.flat[beyond.argmax()] <= BOUND_TOLERANCE:
            return np.minimum(np.maximum(plan, self.u_min), self.u_max)
        clipped = np.empty_like(plan)
        for i, speeds in enumerate(plan):
            clipped[i] = before = self.clip(speeds, before)
        return clipped


class AnswerCheck:
    """Checks each answer against the original problem, independent of the solver and of the form of the QP.

    It predicts the plan's states anew from the model and the measured state, more slowly for another problem.
    It computes KKT residuals in every `kkt_every`-th period and for every rejected answer.
    """

    def __init__(self, problem: Problem, kkt_every: int) -> None:
        self._problem = problem
        self._every = kkt_every
        self._periods = 0
        self._map: tuple[Indices | slice, Array, Array, Array] | None = None
        rows = problem.rows
        N = problem.horizon
        nu = problem.model.nu
        at = np.flatnonzero(rows.on_states)
        if rows.C.ndim == 2 and at.size * N**2 * nu <= LARGEST_MAP:
            maps = states_rows(rows.C[at], rows.of_states[at], prediction(problem.model, N), N)
            self._map = _span(at), rows.C[at], np.concatenate(maps.of_inputs), np.concatenate(maps.of_state)

    def reset(self) -> None:
        """Make the next period the first."""
        self._periods = 0

    @np.errstate(over="ignore", invalid="ignore", divide="ignore")  # a failed solver may return any number
    def __call__(
        self, problem: Problem, query: Query, answer: Answer, refused: str | None
    ) -> tuple[Answer, str | None]:
        """Return the answer with its violation of rows and, when due, KKT residuals; and the reason to reject it.

        A reason in `refused` takes precedence.
        """
        due = self._periods % self._every == 0
        self._periods = self._periods + 1
        if answer.certificate is None:
            return answer, refused
        violation = self._infeasibility(problem, query, answer)
        if refused is None and not violation <= INFEASIBLE:
            refused = INFEASIBLE_ANSWER
        if due or refused is not None:
            kkt = kkt_residuals(*answer.certificate())
            stats = answer.stats._replace(
                infeasibility=violation,
                kkt_stationarity=kkt.stationarity,
                kkt_complementarity=kkt.complementarity,
                kkt_dual=kkt.dual,
            )
        else:
            stats = answer.stats._replace(infeasibility=violation)
        return answer._replace(stats=stats), refused

    @property
    def maps(self) -> bool:
        """Whether it has a map from inputs to the problem's rows, as `violations` needs."""
        return self._map is not None

    def violations(
        self, states: Array, equilibrium: tuple[Array, Array], before: Array, plans: Array, slacks: Array
    ) -> Array:
        """Return (...,) the largest violation of a row by each plan, less the slack of soft rows; 0 if there is none.

        The same bits for one plan and for each of many.

        Args:
            states: (..., n) x(k).
            equilibrium: x_s (..., n) and u_s (..., 4).
            before: (..., 4) u(k-1).
            plans: (..., N, 4).
            slacks: (..., N, m_s) of the soft rows.
        """
        assert self._map is not None
        at, C, of_inputs, of_state = self._map
        x_s, u_s = equilibrium
        rows = self._problem.rows
        steps = plans - np.concatenate((before[..., None, :], plans[..., :-1, :]), axis=-2)
        values = plans @ rows.D.T + steps @ rows.E.T
        inputs = (plans - u_s[..., None, :]).reshape(*plans.shape[:-2], -1, 1)
        of_plan = of_inputs @ inputs + of_state @ (states - x_s)[..., None]
        of_plan = of_plan.reshape(*plans.shape[:-1], -1)
        values[..., at] += of_plan + (C @ x_s[..., None])[..., None, :, 0]
        return _largest_violation(rows, values, slacks)

    def _infeasibility(self, problem: Problem, query: Query, answer: Answer) -> float:
        """See `violations`, of an answer; slower of another problem than this object's."""
        rows = problem.rows
        plan = answer.plan
        if self._map is not None and problem is self._problem and query.steps is None:
            equilibrium = query.equilibrium or problem.equilibrium
            return float(self.violations(query.state, equilibrium, query.u_before, plan, answer.slacks))
        steps = plan - np.concatenate((query.u_before[None], plan[:-1]))
        values = plan @ rows.D.T + steps @ rows.E.T
        if rows.on_states.any():
            states = predicted(problem, query, plan)
            of_plan = (rows.C @ states[:, :, None])[:, :, 0]
            if rows.starts:
                before = np.concatenate((query.state[None], states[:-1]))
                of_plan = np.where(rows.of_states, of_plan, (rows.C @ before[:, :, None])[:, :, 0])
            values += of_plan
        return float(_largest_violation(rows, values, answer.slacks))


def _largest_violation(rows: Rows, values: Array, slacks: Array) -> Array:
    """Return (...,) the largest violation of rows by their values (..., N, m), less the slack of soft rows."""
    beyond = np.maximum(values - rows.upper, rows.lower - values)
    if np.count_nonzero(slacks):
        beyond[..., rows.soft] -= (slacks * rows.slack_scale)[..., rows.slack[rows.soft]]
    largest: Array = beyond.max(axis=(-2, -1))
    return np.where(largest < 0.0, 0.0, largest)


def _span(at: Indices) -> Indices | slice:
    """Return indices in order as a slice, which NumPy takes in half the time, where none is left out."""
    if at.size and at[-1] - at[0] == at.size - 1:
        return slice(int(at[0]), int(at[-1]) + 1)
    return at


def rejection(status: str, speeds: Array, plan: Array, bounds: ActuatorBounds, before: Array) -> str | None:
    """Return why an answer must not reach the plant, or None; `AnswerCheck` makes the remaining checks.

    `speeds` (4,) is the command, `plan` (N, 4) the planned inputs, `before` (4,) the command in force [rad/s].
    """
    if status not in ACCEPTED:
        return status
    beyond = np.abs(speeds - bounds.clip(speeds, before))
    if beyond[beyond.argmax()] <= BOUND_TOLERANCE and all_true(np.isfinite(plan)):
        return None
    if np.isfinite(speeds).all() and np.isfinite(plan).all():
        return "out_of_bounds"
    return "not_finite"


def command_of(speeds: Array, plan: Array, status: str, answer: Answer, *, fallback: int = 0) -> Command:
    """Return speeds (4,) and a plan (N, 4) as a command, with its status and the statistics of the answer."""
    stats = answer.stats
    answered_by = answer.answered_by
    if status not in ACCEPTED:
        stats = stats._replace(active=0, sqp_defect=math.nan, sqp_step=math.nan)
        answered_by = FALLBACK
    elif answer.slacks.size:
        stats = stats._replace(slack=max(float(answer.slacks.max()), 0.0))
    return Command(
        speeds=speeds.copy(),
        plan=plan,
        status=status,
        answered_by=answered_by,
        fallback=fallback,
        stats=stats,
        iterations_by=answer.answered_by,
    )


def refused(acting: Array, horizon: int, status: str, answer: Answer | None = None) -> Command:
    """Return the command in force (4,), held over the horizon, with the reason for rejecting another."""
    plan = np.tile(acting, (horizon, 1))
    if answer is None:
        return Command(speeds=plan[0].copy(), plan=plan, status=status, answered_by=FALLBACK)
    return command_of(plan[0], plan, status, answer)


def resized(rows: Array, count: int) -> Array:
    """Return a plan (N, ...) cut to `count` steps, or extended by its last row."""
    return rows[np.minimum(np.arange(count), len(rows) - 1)]


def shifted(plan: Array, steps: int) -> Array:
    """Return a plan (N, nu) without its first `steps` rows, its last row repeated."""
    return np.concatenate([plan[steps:], np.repeat(plan[-1:], steps, axis=0)])
