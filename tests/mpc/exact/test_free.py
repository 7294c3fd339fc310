"""The free optimum and the axes where changes of inputs cost something, the last state too, and rest is elsewhere."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace

import numpy as np
import ocp_peer
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support import random_axes

from mpc.core.axes import axes
from mpc.exact.free import FreeOptimum
from mpc.exact.shortcut import Shortcut
from mpc.ocp import Problem, Query, Rest, lqr_terminal_weight
from mpc.solvers import Method, QPSolver
from quadsim.controller import ACCEPTED, SOLVED

TERMS = ("Q_d", "P", "rest")


def drawn(rng: np.random.Generator, terms: Collection[str], *, size: float, room: float) -> tuple[Problem, Query]:
    """Three systems in one, with a query; moves are weighed in proportion to inputs, so that the axes stay apart."""
    problem = random_axes(rng, horizon=5, room=room)
    objective, model = problem.objective, problem.model
    if "Q_d" in terms:
        objective = replace(objective, Q_d=3.0 * objective.Q_u)
    if "P" in terms:
        objective = replace(objective, P=lqr_terminal_weight(model, objective))
    rest = problem.rest
    if "rest" in terms:
        rest = Rest(0.1 * rng.normal(size=7), model.u_bar + 0.1 * room * rng.normal(size=4))
    before = model.u_bar + 0.01 * rng.normal(size=4)
    query = Query(size * rng.normal(size=7), size * rng.normal(size=(5, 7)), before, rest)
    return replace(problem, objective=objective), query


@given(
    seed=st.integers(0, 2**32 - 1),
    terms=st.sets(st.sampled_from(TERMS)),
    size=st.sampled_from([0.05, 0.5, 2.0]),
    room=st.sampled_from([1.0, 10.0, 1000.0]),
)
def test_every_way_ends_at_the_peers_optimum(seed: int, terms: set[str], size: float, room: float) -> None:
    problem, query = drawn(np.random.default_rng(seed), terms, size=size, room=room)
    answer = Shortcut(problem, QPSolver("piqp-dense", problem)).solve(Query(*query))
    peer = ocp_peer.optimum(problem, ocp_peer.period(problem, *query[:4]))
    assert (answer.status in ACCEPTED) == (peer.solution.status == SOLVED)
    if peer.solution.status == SOLVED:
        scale = max(1.0, float(np.abs(peer.plan).max()))
        np.testing.assert_allclose(answer.plan, peer.plan, rtol=0.0, atol=1e-7 * scale)


@pytest.mark.parametrize("terms", [(), ("Q_d",), ("P",), ("rest",), TERMS])
def test_every_way_is_taken(terms: tuple[str, ...]) -> None:
    """What the test above rests on; and that these terms leave the axes apart."""
    methods = []
    for seed in range(30):
        rng = np.random.default_rng(seed)
        size, room = float(rng.choice([0.05, 2.0])), float(rng.choice([1.0, 1000.0]))
        problem, query = drawn(rng, terms, size=size, room=room)
        assert len(axes(problem)) == 3
        methods.append(Shortcut(problem, QPSolver("piqp-multistage", problem)).solve(Query(*query)).method)
    assert min(methods.count(method) for method in Method) >= 2


def test_moves_that_tie_the_axes_leave_one_piece() -> None:
    """By a weight on the change of one rotor alone, which is part of all of them; the optimum is the peer's still."""
    problem, query = drawn(np.random.default_rng(1), (), size=0.05, room=1000.0)
    tied = replace(problem, objective=replace(problem.objective, Q_d=np.diag([1.0, 0.0, 0.0, 0.0])))
    (whole,) = axes(tied)
    np.testing.assert_array_equal(whole.T, np.eye(4))
    answer = Shortcut(tied, QPSolver("piqp-dense", tied)).solve(Query(*query))
    peer = ocp_peer.optimum(tied, ocp_peer.period(tied, *query[:4]))
    np.testing.assert_allclose(answer.plan, peer.plan, atol=1e-8)


def test_values_of_rows_are_those_of_the_plan() -> None:
    """C x along the free optimum, rolled out; it receives only deviations from rest."""
    problem, (state, desired, before, rest, _) = drawn(np.random.default_rng(2), TERMS, size=0.5, room=1.0)
    parts = axes(problem)
    free = FreeOptimum(problem, parts)
    answer = free.at(state - rest.x, desired - problem.objective.C_r @ rest.x, before - rest.u)
    w, y = answer[free.inputs], answer[free.outputs]
    plan = rest.u + w.T @ np.hstack([axis.T for axis in parts]).T
    states = ocp_peer.trajectory(ocp_peer.period(problem, state, desired, before, rest), plan)[1:]
    channels = np.concatenate([axis.outputs for axis in parts])
    np.testing.assert_allclose(y.T, (states - rest.x) @ problem.rows.C[channels].T, atol=1e-10)
