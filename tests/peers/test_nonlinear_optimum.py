"""Nonlinear MPC against the same problems in CasADi, solved by IPOPT."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from peers.casadi_ocp import Case, Peer
from peers.checks import Check
from peers.do_mpc_ocp import DoMPC
from peers.nonlinear_optimum import ALLOWED, LAGGED, PAPER, PERIOD, STATES, Course, measure, optima


@pytest.mark.parametrize("case", [PAPER, LAGGED], ids=lambda case: case.name)
def test_optima_and_real_time_iterations_are_the_same(case: Case, hold: Callable[[Check], None]) -> None:
    agreement = measure(case)
    assert agreement.optima.size == agreement.steps.size == STATES[case]
    assert agreement.bounded > STATES[case], "hardly a bound is active: little is compared"
    for check in agreement.checks:
        hold(check)


def test_optima_are_those_of_do_mpc(hold: Callable[[Check], None]) -> None:
    pairs = list(optima(PAPER, DoMPC(PAPER)))
    assert len(pairs) == STATES[PAPER]
    assert all(result.solved for result, _ in pairs)
    apart = max(np.abs(result.inputs - ours).max() for result, ours in pairs)
    hold(Check(what="converged inputs, relative to the largest", peer="do-mpc", measured=apart, allowed=ALLOWED))


def test_do_mpc_is_given_the_same_problem() -> None:
    """With rotor lag, the error-state attitude, shares of speeds and a weight on moves."""
    case = replace(LAGGED, tilt=0.0, steps=(), penalty=(0.0, 0.0))
    course = Course(LAGGED)
    rng = np.random.default_rng(3)
    whole = Peer(case)
    by_do_mpc = DoMPC(case)
    for k in (300, 400):
        question = course.question(k, rng, None, None)
        of = question.state, question.states, question.inputs, question.before
        result = whole.optimum(*of)
        other = by_do_mpc.optimum(*of)
        assert result.solved
        assert other.solved
        assert np.abs(result.inputs - other.inputs).max() < ALLOWED
        assert np.abs(result.states - other.states).max() < ALLOWED


def test_a_changed_weight_is_detected() -> None:
    """A hundredth more on the velocity: two thousand times what is allowed."""
    course = Course(PAPER)
    other = Peer(replace(PAPER, velocity=1.01 * PAPER.velocity))
    question = course.question(300, np.random.default_rng(1), None, None)
    law = course.law(iterations=100, tolerance=1e-8)
    law.reset(course.speeds(question.before))
    ours = course.plan(law, question, PERIOD[PAPER])
    result = other.optimum(question.state, question.states, question.inputs, question.before)
    assert result.solved
    assert np.abs(result.inputs - ours).max() > 1e-4
