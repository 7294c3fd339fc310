"""The optimum among obstacles, with no more half-spaces in the QP than it takes."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Final, NamedTuple

import numpy as np

from mpc.ocp import Problem, Query, predicted
from mpc.solvers import Answer
from mpc.solvers.piqp_backends import PiqpChanging
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


class Cleared(NamedTuple):
    """An optimum among obstacles, the problem it is of, and the states (N, n) that it predicts."""

    answer: Answer
    problem: Problem
    states: Array


class Clearing:
    """A solver's optimum where it keeps all half-spaces, and else the optimum with them.

    The optimum of fewer constraints that satisfies all is the optimum: shortcuts of the solver hold wherever the way is
    clear.  Where it is not, the whole QP is solved with the tightest half-spaces of each instant, and with twice as
    many as long as the plan violates one that was left out.

    Args:
        problem: without half-spaces.
        solve: solves it.
        space: what makes the half-spaces.
        changing: whether queries have steps of their own.
    """

    def __init__(
        self, problem: Problem, solve: Callable[[Query], Answer], space: Space, *, changing: bool = False
    ) -> None:
        self.problem, self._solve, self._space = problem, solve, space
        self._changing = changing
        self.reset()

    def reset(self) -> None:
        """Forget the last plan."""
        self._forms: dict[int, tuple[Staged, PiqpChanging]] = {}
        self._last: Array | None = None

    def solve(self, time: float, query: Query, yaw: float = 0.0, along: Array | None = None) -> Cleared:
        """The optimum for a query.

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
        problem = self.problem
        # Where the last plan touched half-spaces, this one is all but sure to: it is sought among them at once.
        among = self._changing and along is not None and self._touched(t, along)
        if along is None or not among:
            answer = self._solve(query)
            if answer.solution.status not in ACCEPTED:
                return Cleared(answer, problem, np.empty(0))
            states = predicted(problem, query, answer.plan)
            planned = states[:, self._space.positions] @ turn
            if along is None:
                along = planned if last is None else np.concatenate([last[1:], 2.0 * last[-1:] - last[-2:-1]])
        else:
            planned = along
        for i in range(self._space.settings.iterations):
            normals, bounds = self._space.half_spaces(t, along)
            room = _room(normals, bounds, planned)
            if (room >= -ROUNDING).all() and not (among and i == 0):
                break
            answer, problem, states = self._whole(query, normals, bounds, room, turn)
            if answer.solution.status not in ACCEPTED:
                named = self._space.constraints(normals @ turn.T, bounds, problem.model.n)
                constraints = (*self.problem.constraints, *named)
                return Cleared(answer, replace(problem, constraints=constraints), states)
            planned = states[:, self._space.positions] @ turn
            if np.abs(planned - along).max() < SETTLED:
                break
            along = planned
        self._last = planned
        return Cleared(answer, problem, states)

    def _touched(self, t: Array, along: Array) -> bool:
        return bool((_room(*self._space.half_spaces(t, along), along) < NEAR).any())

    def _posed(self, normals: Array, bounds: Array) -> Problem:
        """The problem with chosen half-spaces (m, N, 3), (m, N) in the states' axes."""
        added = self._space.constraint(normals, bounds, self.problem.model.n)
        return replace(self.problem, constraints=(*self.problem.constraints, added))

    def _whole(self, query: Query, normals: Array, bounds: Array, room: Array, turn: Array) -> Cleared:
        """The optimum with half-spaces of the world; `room` (S, N) gives the tightest."""
        count = self._space.settings.rows
        while True:
            at = np.argsort(room, axis=0, kind="stable")[:count], np.arange(bounds.shape[1])
            problem = self._posed(normals[at] @ turn.T, bounds[at])
            answer = self._solved(query, problem, len(at[0]))
            if answer.solution.status not in ACCEPTED:
                return Cleared(answer, problem, np.empty(0))
            states = predicted(self.problem, query, answer.plan)
            room = _room(normals, bounds, states[:, self._space.positions] @ turn)
            violated = room < -ROUNDING
            violated[at] = False
            if not violated.any():
                return Cleared(answer, problem, states)
            room[at] = -LOOSE  # what was there stays
            count *= 2

    def _solved(self, query: Query, problem: Problem, count: int) -> Answer:
        """The QP's answer with so many half-spaces at each instant."""
        if count not in self._forms:
            normals = np.full((count, problem.horizon, 3), 3.0**-0.5)  # in general position
            form, backend = (
                Staged(self._posed(normals, np.zeros(normals.shape[:2])), changing=self._changing),
                PiqpChanging(),
            )
            backend.setup(form.qp)
            self._forms[count] = form, backend
        (form, backend), rest = self._forms[count], query.rest or self.problem.rest
        if query.steps is None:
            matrices = form.renewed(problem)
            vectors = form.vectors(*query[:3], rest, matrices)
        else:
            A, B, c = query.steps
            matrices = form.renewed(problem, form.prepare(A, B))
            vectors = form.changed_vectors(matrices, c, *query[:3], rest)
        qp = form.changed(matrices, vectors)
        solution = backend.solve_changed(qp)
        return Answer(form.inputs(solution.x), form.slacks(solution.x), solution, SOLVER, qp=qp)


def _room(normals: Array, bounds: Array, positions: Array) -> Array:
    """(S, N) how far positions (N, 3) are inside half-spaces [m]."""
    return np.asarray((normals * positions).sum(axis=2) - bounds)
