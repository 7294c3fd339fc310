"""Faults at the solver, the sensors and the computer on the paper's course, disturbed or not: the contract holds.

Eight, over the whole flight, each after what came of the one before.
"""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise

import fault_injection
import numpy as np
import pytest
from fault_injection import (
    DISTURBANCES,
    EARLIEST,
    LAST,
    SOON,
    STATUSES,
    Consequence,
    Injection,
    draw,
    draw_flight,
    failing,
    faults,
    fly_with,
    judge,
    recorded,
)

from mpc.solvers.piqp_backends import STATUS
from quadsim.errors import CommandError
from quadsim.sim.plant import Plant
from quadsim.sim.sensing.sensor import SensorName
from quadsim.vehicle import Vehicle

FLIGHTS = (("robust", "worn rotor"), ("paper", "nominal"))
EACH = 4
"""Faults per flight."""


def test_every_requested_fault_is_there() -> None:
    names = {fault.name for fault in faults()}
    assert {f"solver: {status}" for status in STATUSES} < names
    assert {*STATUS.values()} - {*STATUSES} == {"solved"}
    assert {f"{sensor} {axis}: NaN for 1 s" for sensor in SensorName for axis in "xyz"} < names
    assert {f"{sensor}: frozen for 0.5 s" for sensor in SensorName} < names
    assert {"solver: 10 failures on end", "computer: stalls for 100 ms"} < names
    assert {"all sensors: NaN for 1 s", "all sensors: frozen for 0.5 s"} < names


def test_draws_are_seeded_and_take_every_kind_under_disturbances() -> None:
    drawn = draw(50, seed=1)
    assert drawn == draw(50, seed=1)
    assert drawn != draw(50, seed=2)
    assert len(drawn) == 100
    disturbed = [each for each in drawn[:50] if each.condition != "nominal"]
    assert {each.fault.name for each in disturbed} == {fault.name for fault in faults()}
    for condition in DISTURBANCES:
        starts = [each.start for each in disturbed if each.condition == condition]
        assert len(starts) > 8
        assert min(starts) >= EARLIEST.get(condition, 1.0)
        assert max(starts) > 35.0
    assert [replace(each, controller="paper", condition="nominal") for each in drawn[:50]] == drawn[50:]
    starts = [each.start for each in drawn]
    assert 1.0 <= min(starts) < 6.0
    assert 43.0 < max(starts) <= 47.0
    assert all(round(20 * start) == pytest.approx(20 * start) for start in starts)


def test_faults_of_one_flight_are_over_before_the_next() -> None:
    instants = []
    for seed in range(30):
        for controller, condition in FLIGHTS:
            drawn = draw_flight(controller, condition, EACH, seed=seed)
            assert len({each.fault.name for each in drawn}) == EACH
            assert drawn[0].start >= EARLIEST.get(condition, 1.0)
            assert all(later.start >= each.stop + SOON - 0.05 for each, later in pairwise(drawn))
            assert drawn[-1].stop + SOON <= LAST
            instants += [each.start for each in drawn]
    assert min(instants) < 3.0
    assert max(instants) > 46.0


@pytest.mark.parametrize(("seed", "controller", "condition"), [(k, *flight) for k, flight in enumerate(FLIGHTS)])
def test_faults_all_over_the_flight_are_harmless(seed: int, controller: str, condition: str) -> None:
    for found in fly_with(draw_flight(controller, condition, EACH, seed=seed), shortcut=True):
        assert found.harmless, found
        name = found.injection.fault.name
        assert found.fallback == (1 if name.startswith("solver") or "stalls" in name else 0)
        assert found.furthest > 0.0  # it did happen


def test_what_is_not_recovered_from_is_reported() -> None:
    """Twelve seconds without one optimum: hover, descent, and a course that is not caught up with soon."""
    hopeless = failing("gone", ["numerics"] * 240)
    (found,) = fly_with([Injection(controller="paper", fault=hopeless, start=2.0)], shortcut=True)
    assert (found.reason, found.finite, found.within, found.fallback) == (None, True, True, 3)
    assert found.back > SOON
    assert not found.harmless


def test_harmless_is_all_of_it() -> None:
    injection = Injection(controller="paper", fault=faults()[0], start=3.0)
    good = Consequence(
        injection=injection, reason=None, finite=True, within=True, fallback=1, furthest=0.2, back=fault_injection.SOON
    )
    assert good.harmless
    for spoilt in ({"reason": "lost"}, {"finite": False}, {"within": False}, {"back": SOON + 0.05}):
        assert not replace(good, **spoilt).harmless  # type: ignore[arg-type]


def test_what_the_plant_is_given_is_judged_as_it_is(vehicle: Vehicle) -> None:
    """Also what it refuses: the record is made before."""
    hover = np.full(4, vehicle.hover_speed)
    with Plant(vehicle) as plant, recorded(plant) as given:
        plant.advance(hover, 3)
        with pytest.raises(CommandError):
            plant.advance(np.full(4, math.nan), 3)
    assert len(given) == 2
    assert judge(np.array(given[:1])) == (True, True)
    assert judge(np.array(given)) == (False, False)
    assert judge(np.array([hover, hover + 5.0, hover - 5.0])) == (True, True)
    assert judge(np.array([hover + 5.1])) == (True, False)
    assert judge(np.array([hover - 10.1])) == (True, False)
    up = hover[None] + 5.0 * np.arange(13)[:, None]
    assert up[-2].max() < 250.0 < up[-1].max()
    assert judge(up[:-1]) == (True, True)
    assert judge(up) == (True, False)
