"""The constrained QP against qpmpc's."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from peers.checks import Check
from peers.constrained_qp import OURS, ConstrainedQP, QpmpcController
from peers.recorded import Query

from quadsim.controller import UNCONSTRAINED
from quadsim.mpc.problem.ocp import Problem
from quadsim.mpc.solvers import QPSolver


def test_first_inputs_are_the_same(against_qpmpc: ConstrainedQP, hold: Callable[[Check], None]) -> None:
    assert against_qpmpc.differences.size == 1200
    assert against_qpmpc.constrained.sum() > 300, "hardly a constraint is active: little is compared"
    for check in against_qpmpc.checks:
        hold(check)


def test_no_qp_was_solved_where_no_constraint_is_active(
    against_qpmpc: ConstrainedQP, queries: tuple[Query, ...]
) -> None:
    taken = [query.status == UNCONSTRAINED for query in queries]
    np.testing.assert_array_equal(~against_qpmpc.constrained, taken)


def test_a_reference_one_sample_late_is_seen(problem: Problem, queries: tuple[Query, ...]) -> None:
    """The index of the targets, which a constant reference would not show."""
    peer = QpmpcController(problem)
    ours = QPSolver(OURS, problem)
    late = [replace(query, desired=np.roll(query.desired, 1, axis=0)) for query in queries[::100]]
    differences = [
        np.abs(peer.speeds(peer.solve(wrong)) - ours.solve(query.posed).plan[0]).max()
        for wrong, query in zip(late, queries[::100], strict=True)
    ]
    assert max(differences) > 0.1
