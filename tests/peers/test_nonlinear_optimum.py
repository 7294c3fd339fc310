"""Nonlinear MPC against the same problems in CasADi, solved by IPOPT."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from peers.casadi_ocp import Case, Peer
from peers.checks import Check
from peers.nonlinear_optimum import LAGGED, PAPER, PERIOD, STATES, Course, measure


@pytest.mark.parametrize("case", [PAPER, LAGGED], ids=lambda case: case.name)
def test_optima_and_real_time_iterations_are_the_same(
    case: Case, hold: Callable[[Check], None], told: Callable[[tuple[str, ...]], None]
) -> None:
    agreement = measure(case)
    assert agreement.optima.size == agreement.steps.size == STATES[case]
    assert agreement.bounded > STATES[case], "hardly a bound is active: little is compared"
    for check in agreement.checks:
        hold(check)
        told(check.row)


def test_a_weight_that_is_another_is_seen() -> None:
    """A hundredth more on the velocity: two thousand times what is allowed."""
    course, other = Course(PAPER), Peer(replace(PAPER, velocity=1.01 * PAPER.velocity))
    question = course.question(300, np.random.default_rng(1), None, None)
    law = course.law(iterations=100, tolerance=1e-8)
    law.reset(course.speeds(question.before))
    ours = course.plan(law, question, PERIOD[PAPER])
    found = other.optimum(question.state, question.states, question.inputs, question.before)
    assert found.solved
    assert np.abs(found.inputs - ours).max() > 1e-4
