"""The paper's constrained flight on RotorPy's plant."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from peers import closed_loop
from peers.checks import Check
from peers.closed_loop import ClosedLoop


@pytest.fixture(scope="module")
def measured() -> ClosedLoop:
    return closed_loop.measure()


def test_the_whole_flight_is_the_same(measured: ClosedLoop, hold: Callable[[Check], None]) -> None:
    assert (measured.mujoco.reason, measured.rotorpy.reason) == (None, None)
    assert measured.rotorpy.control.t.size == measured.scenario.periods
    for check in measured.checks:
        hold(check)
