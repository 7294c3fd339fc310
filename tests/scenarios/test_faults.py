"""Faults at the solver, the sensors and the computer in the paper's climb: the contract is kept.

A handful here; `make robustness` flies fifty over the whole course, for both controllers.
"""

from __future__ import annotations

from dataclasses import replace

import fault_injection
import pytest
from fault_injection import CONTROLLERS, STATUSES, Fault, Injection, draw, faults, inject

from mpc.solvers._piqp import STATUS
from quadsim.sensing import SensorName

HANDFUL = (
    "solver: primal_infeasible",
    "solver: 10 failures on end",
    "computer: stalls for 100 ms",
    "velocity z: NaN for 1 s",
    "all sensors: frozen for 0.5 s",
)
LONGEST = 18.0
"""Of these flights [s]."""


def test_every_fault_that_is_asked_for_is_there() -> None:
    names = {fault.name for fault in faults()}
    assert {f"solver: {status}" for status in STATUSES} < names
    assert {*STATUS.values()} - {*STATUSES} == {"solved"}
    assert {f"{sensor} {axis}: NaN for 1 s" for sensor in SensorName for axis in "xyz"} < names
    assert {f"{sensor}: frozen for 0.5 s" for sensor in SensorName} < names
    assert set(HANDFUL) < names


def test_draws_are_seeded_and_take_every_kind() -> None:
    drawn = draw(50, seed=1)
    assert drawn == draw(50, seed=1)
    assert drawn != draw(50, seed=2)
    assert len(drawn) == 100
    assert {injection.fault.name for injection in drawn[:50]} == {fault.name for fault in faults()}
    assert [replace(each, controller="paper") for each in drawn[:50]] == drawn[50:]  # both meet the same
    starts = [injection.start for injection in drawn]
    assert min(starts) >= 1.0
    assert max(starts) <= 47.0
    assert all(round(20 * start) == pytest.approx(20 * start) for start in starts)


@pytest.mark.parametrize("controller", CONTROLLERS)
def test_a_handful_is_harmless(controller: str) -> None:
    kinds = {fault.name: fault for fault in faults()}
    starts = {each.fault.name: each.start for each in draw(len(kinds), earliest=1.0, latest=5.0)}
    for name in HANDFUL:
        found = inject(Injection(controller=controller, fault=kinds[name], start=starts[name]), longest=LONGEST)
        assert found.harmless, found
        assert found.fallback == (1 if name.startswith("solver") or "stalls" in name else 0)
        assert found.furthest > 0.0  # it did happen


def test_what_is_not_recovered_from_is_told() -> None:
    """A minute without one optimum: hover, descent, and nothing that flies the course again."""
    hopeless = Fault(name="solver: gone", statuses=("numerics",) * 1200)
    found = inject(Injection(controller="paper", fault=hopeless, start=2.0), longest=LONGEST)
    assert (found.reason, found.finite, found.within, found.fallback) == (None, True, True, 3)
    assert found.back > fault_injection.SOON
    assert not found.harmless
