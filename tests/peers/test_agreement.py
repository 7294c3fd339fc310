"""Every QP solver of the registry on the flight's QPs, its solutions judged by residuals computed here."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from peers import agreement
from peers.checks import Check
from peers.constrained_qp import ConstrainedQP
from peers.recorded import Query

from quadsim.mpc.problem.ocp import Problem


@pytest.mark.parametrize("name", agreement.PACKAGES)
def test_solved_answers_are_optimal(
    name: str, problem: Problem, queries: tuple[Query, ...], against_qpmpc: ConstrainedQP, hold: Callable[[Check], None]
) -> None:
    verdict = agreement.measure(name, problem, queries, against_qpmpc.speeds)
    assert verdict.failures < verdict.queried, "it solved nothing"
    for check in verdict.checks:
        hold(check)


def test_a_wrong_reference_is_seen(problem: Problem, queries: tuple[Query, ...], against_qpmpc: ConstrainedQP) -> None:
    """The comparison is by period: with the next period's inputs it fails."""
    few = slice(100, 130)
    shifted = np.roll(against_qpmpc.speeds, -1, axis=0)[few]
    verdict = agreement.measure("piqp-multistage", problem, queries[few], shifted)
    assert not verdict.checks[0].holds
    assert verdict.checks[1].holds
