"""The one contract for answers: solved, finite and within what actuators can take; else why not."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from mpc.constraints import Bounds
from mpc.ocp import Problem
from mpc.solvers import Answer
from quadsim.controller import ACCEPTED, Command
from quadsim.errors import ParameterError
from quadsim.state import Array, all_true
from quadsim.vehicle import N_ROTORS, Vehicle

BOUND_TOLERANCE: Final = 1e-6
"""How far outside its bounds [rad/s] an answer may be and still count as in bounds; it is then moved onto them."""


@dataclass(frozen=True, kw_only=True)
class ActuatorBounds:
    """Hard bounds on rotor speeds, Eq. (20), and on their steps from one period to the next, Eq. (15).

    Raises:
        ParameterError: bounds that are not four numbers each, are not in order, or that forbid holding a speed.
    """

    u_min: Array  # (4,) speeds [rad/s], finite and not negative: rotors turn one way
    u_max: Array  # likewise
    delta_min: Array  # (4,) steps u(k) - u(k-1) [rad/s]; infinite where there is no bound
    delta_max: Array  # likewise

    def __post_init__(self) -> None:
        for name in ("u_min", "u_max", "delta_min", "delta_max"):
            bound = np.asarray(getattr(self, name), float)
            if bound.shape != (N_ROTORS,) or np.isnan(bound).any():
                raise ParameterError("controller", name, getattr(self, name), f"{N_ROTORS} numbers")
            object.__setattr__(self, name, bound)
        if not (np.isfinite(self.u_min).all() and np.isfinite(self.u_max).all() and np.all(self.u_min < self.u_max)):
            raise ParameterError("controller", "u_min", self.u_min, f"finite and below a finite u_max = {self.u_max}")
        if self.u_min.min() < 0.0:
            raise ParameterError("controller", "u_min", self.u_min, "at least 0 rad/s: rotors turn one way")
        if not np.all((self.delta_min <= 0.0) & (self.delta_max >= 0.0)):
            rule = f"<= 0 and delta_max = {self.delta_max} >= 0, so that a speed can be held"
            raise ParameterError("controller", "delta_min", self.delta_min, rule)

    @classmethod
    def alike(cls, speed: tuple[float, float], slew: tuple[float, float] = (-math.inf, math.inf)) -> ActuatorBounds:
        """The same (lower, upper) bounds of speed and of its step for every rotor [rad/s]."""
        (u_min, u_max), (down, up) = (np.full((2, N_ROTORS), np.reshape(pair, (2, 1))) for pair in (speed, slew))
        return cls(u_min=u_min, u_max=u_max, delta_min=down, delta_max=up)

    @classmethod
    def of(cls, bounds: Bounds) -> ActuatorBounds:
        """Those of an optimisation."""
        return cls(u_min=bounds.u_min, u_max=bounds.u_max, delta_min=bounds.delta_min, delta_max=bounds.delta_max)

    @classmethod
    def of_problem(cls, problem: Problem) -> ActuatorBounds:
        """What an optimisation's hard rows on single inputs, or on single steps, leave in every period."""
        rows, nu = problem.rows, problem.model.nu
        hard = np.isinf(rows.l1) & ~rows.on_states
        found = []
        for rate, other in ((rows.D, rows.E), (rows.E, rows.D)):
            alone = hard & (np.count_nonzero(rate, axis=1) == 1) & ~other.any(axis=1)
            lower, upper = np.full(nu, -math.inf), np.full(nu, math.inf)
            for i in np.flatnonzero(alone & (rate.max(axis=1, initial=0.0) == 1.0)):
                j = int(np.argmax(rate[i]))
                lower[j], upper[j] = max(lower[j], rows.lower[0, i]), min(upper[j], rows.upper[0, i])
            found += [lower, upper]
        return cls(u_min=found[0], u_max=found[1], delta_min=found[2], delta_max=found[3])

    @classmethod
    def of_vehicle(cls, vehicle: Vehicle) -> ActuatorBounds:
        """The speeds that its rotors hold, and no bounds on steps."""
        return cls.alike((vehicle.speed_min, vehicle.speed_max))

    def reach(self, before: Array) -> tuple[Array, Array]:
        """The lowest and highest speeds (4,) [rad/s] after a command `before` (4,).

        A command outside the speed bounds, as of rotors that stand still, leaves no speed within both; then those on
        the speeds hold, and those on the steps do not.
        """
        lower = np.minimum(np.maximum(before + self.delta_min, self.u_min), self.u_max)
        upper = np.minimum(np.maximum(before + self.delta_max, self.u_min), self.u_max)
        return lower, upper

    def clip(self, speeds: Array, before: Array) -> Array:
        """The speeds (4,) in reach of `before` that are nearest to `speeds` [rad/s]."""
        lower, upper = self.reach(before)
        return np.minimum(np.maximum(speeds, lower), upper)

    def clip_plan(self, plan: Array, before: Array) -> Array:
        """A plan (N, 4) with each row in reach of the one before it, the first of `before`.

        Steps that are so but for rounding stay as they are.
        """
        steps = plan - np.concatenate((before[None], plan[:-1]))
        beyond = np.maximum(self.delta_min - steps, steps - self.delta_max)
        if beyond.flat[beyond.argmax()] <= BOUND_TOLERANCE:
            return np.minimum(np.maximum(plan, self.u_min), self.u_max)
        clipped = np.empty_like(plan)
        for i, speeds in enumerate(plan):
            clipped[i] = before = self.clip(speeds, before)
        return clipped


def rejection(status: str, speeds: Array, plan: Array, bounds: ActuatorBounds, before: Array) -> str | None:
    """Why an answer must not reach the plant, or None.

    `speeds` (4,) is the command, `plan` (N, 4) the inputs planned, `before` (4,) the command in force [rad/s].
    """
    if status not in ACCEPTED:
        return status
    beyond = np.abs(speeds - bounds.clip(speeds, before))
    if beyond[beyond.argmax()] <= BOUND_TOLERANCE and all_true(np.isfinite(plan)):
        return None
    return "out_of_bounds" if np.isfinite(speeds).all() and np.isfinite(plan).all() else "not_finite"


def free_command(answer: Answer) -> Command:
    """The command of an optimum without constraints, which is within every bound or it would not be one."""
    solution = answer.solution
    return Command(speeds=answer.plan[0].copy(), plan=answer.plan, status=solution.status, solve_s=solution.solve_s)


def command_of(speeds: Array, plan: Array, status: str, answer: Answer, *, fallback: int = 0) -> Command:
    """Speeds (4,) and a plan (N, 4) as a command under a status, with the solver's report on its answer."""
    solution, accepted = answer.solution, status in ACCEPTED
    return Command(
        speeds=speeds.copy(),
        plan=plan,
        status=status,
        iterations=solution.iterations,
        active=solution.active if accepted else 0,
        fallback=fallback,
        slack=max(float(answer.slacks.max()), 0.0) if accepted and answer.slacks.size else 0.0,
        primal_residual=solution.primal_residual,
        dual_residual=solution.dual_residual,
        solve_s=solution.solve_s,
    )


def refused(acting: Array, horizon: int, status: str, answer: Answer | None = None) -> Command:
    """The command in force (4,) held over the horizon, with the reason for refusing another."""
    plan = np.tile(acting, (horizon, 1))
    if answer is None:
        return Command(speeds=plan[0].copy(), plan=plan, status=status)
    return command_of(plan[0], plan, status, answer)


def shifted(plan: Array, steps: int) -> Array:
    """The rest of a plan (N, nu) after some steps, its last input held."""
    return np.concatenate([plan[steps:], np.repeat(plan[-1:], steps, axis=0)])
