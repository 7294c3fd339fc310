"""Obstacles, corridors and fences as half-spaces along the predicted positions.

An obstacle is a union of convex solids. At each predicted instant, a plane keeps the vehicle clear of each solid. It
passes through the point of the solid closest to p_i, the position that the last plan had for that instant, with d_i the
distance and n_i the outward normal:

    n_i . p >= n_i . p_i - d_i + r + m_i,

with r the radius of the vehicle's bounding ball and m_i the margin. If p_i is inside, d_i is negative and the plane is
that of the shortest way out. The whole solid lies behind the plane, so a position that satisfies the half-space is
clear at that instant, for any p_i: the restriction is safe and conservative. Moving obstacles are evaluated at the
predicted instant. Corridors and fences are half-spaces themselves, and exact.

The planes change with the plan, so the QP is solved again along the new plan, a few times per period at most
(sequential convex programming; Schulman et al., 2014, "Motion planning with sequential convex optimization and convex
collision checking").
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Final, TypeAlias

import numpy as np
from annotated_types import Ge, Le, doc

from quadsim.controller import ACCEPTED
from quadsim.fields import NonNegative
from quadsim.mpc.forms.staged import Staged
from quadsim.mpc.problem.constraints import Constraint, Origin, Penalty, Soft
from quadsim.mpc.problem.ocp import Problem, Query, predicted
from quadsim.mpc.solvers import Answer, Solver
from quadsim.mpc.solvers.piqp import Piqp
from quadsim.space import AnyObstacle, Corridor, Fence, Obstacle, Solids
from quadsim.state import POSITION, Array
from quadsim.vehicle import Vehicle

Shape: TypeAlias = AnyObstacle | Corridor | Fence

SWITCHED_OFF: Final = 1e3
"""Bound [m] of a half-space that is switched off."""
SOLVER: Final = "piqp-multistage"  # solves QPs with half-spaces; the problem's own solver solves the others
SOFT_SPACE: Final = "controller.avoidance.soft"
"""Table of a scenario file that makes half-spaces soft (`quadsim.mpc.problem.constraints.Origin.soft`)."""
HALF_SPACE_ROUNDING: Final = 1e-6
"""Violation of a half-space [m] attributed to rounding."""
SETTLED: Final = 1e-2
"""Change of all predicted positions [m] below which planes are not recomputed in the same period."""


@dataclass(frozen=True, kw_only=True)
class Avoidance:
    """Half-spaces that keep the vehicle clear of obstacles and inside corridors and the fence."""

    margin: Annotated[NonNegative, doc("[m] added clearance: planes change from instant to instant")] = 0.05
    rows: Annotated[
        int,
        Ge(1),
        Le(50),
        doc("[-] of a linear MPC: half-spaces per predicted instant in the QP, the tightest first; more if needed"),
    ] = 6
    iterations: Annotated[
        int,
        Ge(1),
        Le(50),
        doc("[-] most QPs per period, each built along the plan of the one before"),
    ] = 3
    soft: Annotated[Soft | None, doc("[1/m, 1/m^2] cost of violating a constraint; absent: hard")] = None

    def space(
        self,
        shapes: Sequence[Shape],
        vehicle: Vehicle,
        *,
        period: float,
        horizon: int,
        margins: Array | None = None,
        positions: Sequence[int] = POSITION,
        largest: bool = False,
    ) -> Space | None:
        """Return the half-spaces of obstacles and regions (`Space`); None without any."""
        if not shapes:
            return None
        penalty = None
        if self.soft is not None:
            penalty = (self.soft.linear, self.soft.quadratic)
        return Space(
            shapes,
            radius=vehicle.enclosing_radius,
            period=period,
            horizon=horizon,
            settings=self,
            margins=margins,
            penalty=penalty,
            positions=positions,
            largest=largest,
        )


class Space:
    """Obstacles and regions as half-spaces.

    Args:
        shapes: the obstacles and regions.
        radius: radius of the vehicle's bounding ball [m].
        period: time between predicted instants [s].
        horizon: N.
        settings: how half-spaces are enforced.
        margins: (N, 3) further margins along x, y, z at each predicted instant [m], for a disturbance; None for none.
        penalty: l1 [1/m] and l2 [1/m^2] of violating a half-space; None for hard ones.
        positions: indices of the states x, y, z.
        largest: whether the penalty applies to the largest violation at each instant, instead of to all of them.
    """

    def __init__(
        self,
        shapes: Sequence[Shape],
        *,
        radius: float,
        period: float,
        horizon: int,
        settings: Avoidance,
        margins: Array | None = None,
        penalty: tuple[float, float] | None = None,
        positions: Sequence[int] = POSITION,
        largest: bool = False,
    ) -> None:
        self._largest = largest
        self.settings = settings
        self.penalty = penalty
        self.period = period
        self.positions = list(positions)
        self._shapes = tuple(shapes)
        self._distance = radius + settings.margin
        if margins is None:
            self._margins = np.zeros((horizon, 3))
        else:
            self._margins = margins
        obstacles = []
        names: list[str] = []  # of each half-space's shape
        of_solids: list[bool] = []
        self._regions: list[tuple[Corridor | Fence, slice]] = []
        for shape in self._shapes:
            if isinstance(shape, Obstacle):
                count = len(shape.solids)
                obstacles.append(shape)
            else:
                count = len(shape.half_spaces[1])
                self._regions.append((shape, slice(len(names), len(names) + count)))
            names += [shape.name] * count
            of_solids += [isinstance(shape, Obstacle)] * count
        self._solids = Solids(obstacles)
        self._names = np.array(names, str)
        self._of_solids = np.array(of_solids, bool)

    @property
    def count(self) -> int:
        """Number of half-spaces at an instant."""
        return len(self._names)

    def half_spaces(self, t: Array, positions: Array) -> tuple[Array, Array]:
        """Normals (S, N, 3) and bounds (S, N) [m] of normal . p >= bound, at times (N,) along positions (N, 3)."""
        normals = np.empty((len(self._names), len(t), 3))
        bounds = np.empty((len(self._names), len(t)))
        distance, normal = self._solids.clearances(t, positions)
        normals[self._of_solids] = normal
        bounds[self._of_solids] = (normal * positions).sum(axis=2) - distance
        for region, at in self._regions:
            rows, upper = region.half_spaces
            normals[at] = -rows[:, None, :]
            # Also inside at the neighbouring instants, so that the motion between two instants stays inside.
            in_force = (t > region.start - self.period) & (t < region.stop + self.period)
            bounds[at] = np.where(in_force, -upper[:, None], (normals[at] * positions).sum(axis=2) - SWITCHED_OFF)
        return normals, bounds + self._distance + (np.abs(normals) * self._margins).sum(axis=2)

    def constraint(self, normals: Array, bounds: Array, states: int, *, name: str = "space") -> Constraint:
        """Return half-spaces (m, N, 3), (m, N) as rows on `states` states."""
        C = np.zeros((bounds.shape[1], len(bounds), states))
        C[:, :, self.positions] = normals.transpose(1, 0, 2)
        lower = bounds.T
        penalty = None
        if self.penalty is not None:
            l1, l2 = self.penalty
            penalty = Penalty(l1=np.full(len(bounds), l1), l2=np.full(len(bounds), l2), largest=self._largest)
        return Constraint(
            name=name,
            lower=lower,
            upper=np.full_like(lower, np.inf),
            C=C,
            penalty=penalty,
            origins=(Origin(name, "m", soft=SOFT_SPACE),) * len(bounds),
        )

    def constraints(self, normals: Array, bounds: Array, states: int) -> tuple[Constraint, ...]:
        """Return all half-spaces as one constraint per obstacle or region, by its name."""
        constraints = []
        for shape in self._shapes:
            if isinstance(shape, Obstacle):
                kind = "obstacle"
            elif isinstance(shape, Corridor):
                kind = "corridor"
            else:
                kind = ""
            at = self._names == shape.name
            name = f"{kind} {shape.name}".strip()
            constraints.append(self.constraint(normals[at], bounds[at], states, name=name))
        return tuple(constraints)


class ObstacleQP:
    """The optimum of a problem with half-spaces, which are added only when they matter.

    An optimum under fewer constraints that satisfies all of them is the optimum. So the solver's answer is final
    wherever the way is clear. Elsewhere the QP is solved with the tightest half-spaces of each instant, then with twice
    as many for as long as the plan violates one that was left out.

    The problem and its solver contain no half-spaces.
    """

    def __init__(self, problem: Problem, solver: Solver, space: Space) -> None:
        self.problem = problem
        self._solver = solver
        self._space = space
        self.reset()

    def reset(self) -> None:
        """Forget the last plan."""
        self._forms: dict[int, tuple[Staged, Piqp]] = {}
        self._last: Array | None = None

    def solve(self, time: float, query: Query, yaw: float = 0.0) -> tuple[Answer, Problem]:
        """Return the optimum of a query, and the problem solved; planes are made along the last optimum, moved on.

        Args:
            time: instant of its x(k) [s].
            query: the state, reference and last input.
            yaw: angle by which the states' axes x and y are turned from the world's [rad].
        """
        turn = np.array([[math.cos(yaw), math.sin(yaw), 0.0], [-math.sin(yaw), math.cos(yaw), 0.0], [0.0, 0.0, 1.0]])
        t = time + self._space.period * np.arange(1, self.problem.horizon + 1, dtype=np.float64)
        last = self._last
        self._last = None
        problem = self.problem
        answer = self._solver.solve(query)
        if answer.status not in ACCEPTED:
            return answer, problem
        planned = self._positions(query, answer, turn)
        if last is None:
            along = planned
        else:
            along = np.concatenate([last[1:], 2.0 * last[-1:] - last[-2:-1]])
        for _ in range(self._space.settings.iterations):
            normals, bounds = self._space.half_spaces(t, along)
            inside = distances(normals, bounds, planned)
            if (inside >= -HALF_SPACE_ROUNDING).all():
                break
            answer, problem, planned = self._solve_with_half_spaces(query, normals, bounds, inside, turn)
            if answer.status not in ACCEPTED:
                named = self._space.constraints(normals @ turn.T, bounds, problem.model.n)
                constraints = (*self.problem.constraints, *named)
                return answer, replace(problem, constraints=constraints)
            if np.abs(planned - along).max() < SETTLED:
                break
            along = planned
        self._last = planned
        return answer, problem

    def _positions(self, query: Query, answer: Answer, turn: Array) -> Array:
        """(N, 3) the answer's positions in the world."""
        return np.asarray(predicted(self.problem, query, answer.plan)[:, self._space.positions] @ turn)

    def _with_half_spaces(self, normals: Array, bounds: Array) -> Problem:
        """The problem with chosen half-spaces (m, N, 3), (m, N) in the states' axes."""
        added = self._space.constraint(normals, bounds, self.problem.model.n)
        return replace(self.problem, constraints=(*self.problem.constraints, added))

    def _solve_with_half_spaces(
        self, query: Query, normals: Array, bounds: Array, inside: Array, turn: Array
    ) -> tuple[Answer, Problem, Array]:
        """The optimum with half-spaces of the world, and its positions; `inside` (S, N) gives the tightest."""
        count = self._space.settings.rows
        while True:
            at = np.argsort(inside, axis=0, kind="stable")[:count], np.arange(bounds.shape[1])
            problem = self._with_half_spaces(normals[at] @ turn.T, bounds[at])
            form, backend = self._form(len(at[0]))
            qp = form.assemble(query, problem)
            answer = Answer.of(form, qp, backend.solve(qp), SOLVER)
            if answer.status not in ACCEPTED:
                return answer, problem, np.empty(0)
            planned = self._positions(query, answer, turn)
            inside = distances(normals, bounds, planned)
            violated = inside < -HALF_SPACE_ROUNDING
            violated[at] = False
            if not violated.any():
                return answer, problem, planned
            inside[at] = -SWITCHED_OFF  # what was there stays
            count *= 2

    def _form(self, count: int) -> tuple[Staged, Piqp]:
        """The QP with so many half-spaces at each instant, and what solves it."""
        if count not in self._forms:
            normals = np.full((count, self.problem.horizon, 3), 3.0**-0.5)  # in general position
            form = Staged(self._with_half_spaces(normals, np.zeros(normals.shape[:2])))
            backend = Piqp(changing=True)
            backend.setup(form.qp)
            self._forms[count] = form, backend
        return self._forms[count]


def distances(normals: Array, bounds: Array, positions: Array) -> Array:
    """(S, N) how far positions (N, 3) are inside half-spaces [m]."""
    return np.asarray((normals * positions).sum(axis=2) - bounds)
