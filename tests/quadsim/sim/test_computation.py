"""Simulated computation times: what delays a command, and by how much."""

from __future__ import annotations

import numpy as np
import pytest

from quadsim.controller import Command
from quadsim.sim.computation import Computation, Stall

COMMAND = Command(speeds=np.zeros(4), plan=np.zeros((1, 4)), iterations=12)


def delay(computation: Computation, time: float = 0.0) -> float:
    return computation.taken(time, COMMAND, np.random.default_rng(0))


def test_fixed_part_and_iterations_add_up() -> None:
    assert delay(Computation()) == 0.0
    assert delay(Computation(delay=0.01, per_iteration=0.002)) == pytest.approx(0.034)


def test_jitter_is_exponential() -> None:
    rng = np.random.default_rng(0)
    computation = Computation(delay=0.005, jitter=0.01)
    waits = np.array([computation.taken(0.0, COMMAND, rng) for _ in range(20_000)]) - 0.005
    assert waits.min() >= 0.0
    assert waits.mean() == pytest.approx(0.01, rel=0.03)
    assert np.mean(waits > 0.03) == pytest.approx(np.exp(-3.0), rel=0.1)


@pytest.mark.parametrize(
    ("time", "expected"),
    [
        (0.95, 0.01),  # done before the stall
        (0.995, 0.105),  # caught by it
        (1.05, 0.05),  # begun in it
        (1.095, 0.01),  # it ends before the computation would
        (1.1, 0.01),  # over
    ],
)
def test_a_stall_holds_back_what_it_meets(time: float, expected: float) -> None:
    assert delay(Computation(delay=0.01, stalls=(Stall(at=1.0, duration=0.1),)), time) == pytest.approx(expected)


def test_stalls_follow_one_another_whatever_their_order() -> None:
    stalls = (Stall(at=0.02, duration=0.03), Stall(at=0.0, duration=0.02))
    assert delay(Computation(stalls=stalls)) == delay(Computation(stalls=stalls[::-1])) == pytest.approx(0.05)
