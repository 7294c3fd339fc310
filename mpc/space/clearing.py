"""The optimum among obstacles, with no more half-spaces in the QP than it takes."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Final

import numpy as np

from mpc.ocp import Problem, Query, predicted
from mpc.solvers import Answer, Solver
from mpc.solvers.piqp_backends import PiqpMultistage
from mpc.space.halfspaces import LOOSE, Space
from mpc.staged import Staged
from quadsim.controller import ACCEPTED
from quadsim.state import Array

SOLVER: Final = "piqp-multistage"  # solves QPs with half-spaces, whatever solves those without
ROUNDING: Final = 1e-6
"""Violation of a half-space [m] that is taken for rounding."""
NEAR: Final = 1e-2
"""Distance from a half-space [m] within which a plan is taken to touch it."""
SETTLED: Final = 1e-2
"""Change of all predicted positions [m] below which planes are not recomputed in the same period."""


class Clearing:
    """A solver's optimum where it keeps all half-spaces, and else the optimum with them.

    The optimum of fewer constraints that satisfies all is the optimum: so is the solver's wherever the way is clear.
    Where it is not, the whole QP is solved with the tightest half-spaces of each instant, and with twice as many as
    long as the plan violates one that was left out.

    The problem and its solver know no half-spaces; queries of a `changing` one have steps of their own.
    """

    def __init__(self, problem: Problem, solver: Solver, space: Space, *, changing: bool = False) -> None:
        self.problem, self._solver, self._space = problem, solver, space
        self._changing = changing
        self.reset()

    def reset(self) -> None:
        """Forget the last plan."""
        self._forms: dict[int, tuple[Staged, PiqpMultistage]] = {}
        self._last: Array | None = None

    def solve(self, time: float, query: Query, yaw: float = 0.0, along: Array | None = None) -> tuple[Answer, Problem]:
        """The optimum for a query, with its `Answer.states`, and the problem that it is of.

        Args:
            time: of its x(k) [s].
            query: the state, reference and last input.
            yaw: by which the states' axes x and y are turned from the world's [rad].
            along: (N, 3) positions of the plan that planes are made along [m]; where absent, those of the last optimum,
                moved on by an instant.
        """
        turn = np.array([[math.cos(yaw), math.sin(yaw), 0.0], [-math.sin(yaw), math.cos(yaw), 0.0], [0.0, 0.0, 1.0]])
        t = time + self._space.period * np.arange(1, self.problem.horizon + 1, dtype=np.float64)
        last, self._last = self._last, None
        problem, among = self.problem, False
        if self._changing and along is not None:
            # Where the last plan touched half-spaces, this one is all but sure to: it is sought among them at once.
            among = bool((_room(*self._space.half_spaces(t, along), along) < NEAR).any())
        if along is None or not among:
            answer = self._solver.solve(query)
            if answer.status not in ACCEPTED:
                return answer, problem
            answer, planned = self._predicted(query, answer, turn)
            if along is None:
                along = planned if last is None else np.concatenate([last[1:], 2.0 * last[-1:] - last[-2:-1]])
        else:
            planned = along
        for i in range(self._space.settings.iterations):
            normals, bounds = self._space.half_spaces(t, along)
            room = _room(normals, bounds, planned)
            if (room >= -ROUNDING).all() and not (among and i == 0):
                break
            answer, problem, planned = self._whole(query, normals, bounds, room, turn)
            if answer.status not in ACCEPTED:
                named = self._space.constraints(normals @ turn.T, bounds, problem.model.n)
                constraints = (*self.problem.constraints, *named)
                return answer, replace(problem, constraints=constraints)
            if np.abs(planned - along).max() < SETTLED:
                break
            along = planned
        self._last = planned
        return answer, problem

    def _predicted(self, query: Query, answer: Answer, turn: Array) -> tuple[Answer, Array]:
        """The answer with its states, and their positions in the world (N, 3)."""
        states = predicted(self.problem, query, answer.plan)
        return answer._replace(states=states), states[:, self._space.positions] @ turn

    def _posed(self, normals: Array, bounds: Array) -> Problem:
        """The problem with chosen half-spaces (m, N, 3), (m, N) in the states' axes."""
        added = self._space.constraint(normals, bounds, self.problem.model.n)
        return replace(self.problem, constraints=(*self.problem.constraints, added))

    def _whole(
        self, query: Query, normals: Array, bounds: Array, room: Array, turn: Array
    ) -> tuple[Answer, Problem, Array]:
        """The optimum with half-spaces of the world, and its positions; `room` (S, N) gives the tightest."""
        count = self._space.settings.rows
        while True:
            at = np.argsort(room, axis=0, kind="stable")[:count], np.arange(bounds.shape[1])
            problem = self._posed(normals[at] @ turn.T, bounds[at])
            form, backend = self._form(len(at[0]))
            qp = form.pose(query, problem).qp
            answer = Answer.of(form, qp, backend.solve(qp), SOLVER)
            if answer.status not in ACCEPTED:
                return answer, problem, np.empty(0)
            answer, planned = self._predicted(query, answer, turn)
            room = _room(normals, bounds, planned)
            violated = room < -ROUNDING
            violated[at] = False
            if not violated.any():
                return answer, problem, planned
            room[at] = -LOOSE  # what was there stays
            count *= 2

    def _form(self, count: int) -> tuple[Staged, PiqpMultistage]:
        """The QP with so many half-spaces at each instant, and what solves it."""
        if count not in self._forms:
            normals = np.full((count, self.problem.horizon, 3), 3.0**-0.5)  # in general position
            form = Staged(self._posed(normals, np.zeros(normals.shape[:2])), changing=self._changing)
            backend = PiqpMultistage(changing=True)
            backend.setup(form.qp)
            self._forms[count] = form, backend
        return self._forms[count]


def _room(normals: Array, bounds: Array, positions: Array) -> Array:
    """(S, N) how far positions (N, 3) are inside half-spaces [m]."""
    return np.asarray((normals * positions).sum(axis=2) - bounds)
