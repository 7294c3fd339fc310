"""The unconstrained gain against do-mpc's LQR and scipy's."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from peers import gain
from peers.checks import Check
from peers.gain import Comparison
from support import paper_problem


@pytest.fixture(scope="module")
def measured() -> tuple[Comparison, ...]:
    return gain.measure(paper_problem(gain.SCENARIO))


def test_gain_is_that_of_both_lqrs(measured: tuple[Comparison, ...], hold: Callable[[Check], None]) -> None:
    for comparison in measured:
        for check in comparison.checks:
            hold(check)


def test_gain_tends_to_that_of_the_infinite_horizon(measured: tuple[Comparison, ...]) -> None:
    differences = [comparison.infinite for comparison in measured]
    assert differences == sorted(differences, reverse=True)


def test_one_step_more_would_be_seen(measured: tuple[Comparison, ...]) -> None:
    for comparison in measured:
        assert comparison.one_step_more > 100.0 * comparison.checks[0].allowed
