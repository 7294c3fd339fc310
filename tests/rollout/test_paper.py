"""The paper's results, turned into numbers and held."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from quadsim.controller import ACCEPTED
from quadsim.flight.audit import Finding
from quadsim.rollout.flown import Flight, summarise

SAMPLED = 0.01
PLANT = 0.05
"""How far beyond 5 deg roll and pitch may go [deg]: at the control samples, and at the physics rate."""


def findings(flight: Flight) -> dict[str, Finding]:
    return {finding.limit.name: finding for finding in flight.findings}


def assert_constrained_flight_holds(flight: Flight, *, plant_tolerance: float) -> None:
    control = flight.log.control
    result = findings(flight)
    assert flight.log.status == "completed"
    assert len(control.status) == 1200
    assert set(control.status) <= ACCEPTED
    assert control.fallback.max() == 0
    for angle in ("roll", "pitch"):
        assert result[angle].worst_margin_sampled >= -SAMPLED
        assert result[angle].worst_margin >= -plant_tolerance
    assert control.speeds.min() >= -1e-6
    assert control.speeds.max() <= 250.0 + 1e-6
    assert control.slews.min() >= -10.0 - 1e-6
    assert control.slews.max() <= 5.0 + 1e-6
    climbing = control.t < 10.0
    assert control.speeds[climbing].max() == pytest.approx(250.0, abs=1e-6)  # upper bound active in the take-off
    error = control.state[-1, [0, 2, 4, 10]] - control.reference[-1]
    assert np.abs(error).max() < 0.01


@pytest.mark.representative("paper")
def test_constrained_flight_keeps_every_bound_and_arrives(constrained_flight: Flight) -> None:
    assert_constrained_flight_holds(constrained_flight, plant_tolerance=PLANT)
    assert constrained_flight.satisfied
    assert constrained_flight.log.plant.t.size == 60_001  # audited at the physics rate


@pytest.mark.slow("paper")
@pytest.mark.parametrize("arm_length", [0.2, 0.5])
@pytest.mark.parametrize("drag_to_thrust", [0.012, 0.048])
def test_it_holds_over_the_parameters_the_paper_leaves_out(
    fly_once: Callable[..., Flight], arm_length: float, drag_to_thrust: float
) -> None:
    changes = (f"vehicle.arm_length={arm_length}", f"vehicle.drag_to_thrust={drag_to_thrust}")
    flight = fly_once("paper-constrained", *changes)
    assert (flight.vehicle.arm_length, flight.vehicle.drag_to_thrust) == (arm_length, drag_to_thrust)
    assert_constrained_flight_holds(flight, plant_tolerance=0.1)


@pytest.mark.representative("paper")
def test_unconstrained_flight_tracks_and_leaves_every_bound(unconstrained_flight: Flight) -> None:
    control = unconstrained_flight.log.control
    result = findings(unconstrained_flight)
    error = control.state[:, [0, 2, 4, 10]] - control.reference
    assert np.abs(error[-1]).max() < 0.01
    assert np.sqrt(np.mean(error[:, :3] ** 2, axis=0)).max() < 0.5
    for name in ("roll", "pitch", "speed", "slew"):
        assert not result[name].satisfied
        assert not result[name].limit.required
        assert result[name].time_violated > 0.0
    assert unconstrained_flight.satisfied  # it promised none of them
    entries = {entry["name"]: entry for entry in summarise(unconstrained_flight)["constraints"]}
    assert entries["roll"]["worst_margin"] == pytest.approx(-4.48, abs=0.01)
    assert entries["speed"]["worst_margin"] == pytest.approx(-121.7, abs=0.1)


@pytest.mark.slow("paper")
def test_clipped_flight_shows_what_a_real_rotor_would_do(fly_once: Callable[..., Flight]) -> None:
    flight = fly_once("paper-unconstrained-clipped")
    assert flight.log.control.speeds.max() > 300.0
    assert flight.log.plant.speeds.max() == 250.0
    assert flight.satisfied


def test_constraints_make_the_profile_smoother(constrained_flight: Flight, unconstrained_flight: Flight) -> None:
    """Sec. 7 states it; total variation of the commands measures it."""

    def total_variation(flight: Flight) -> float:
        return float(np.abs(flight.log.control.slews).sum())

    def largest_step(flight: Flight) -> float:
        return float(np.abs(flight.log.control.slews).max())

    assert largest_step(constrained_flight) < 0.1 * largest_step(unconstrained_flight)
    assert total_variation(constrained_flight) < total_variation(unconstrained_flight)  # by 2 % only


@pytest.mark.slow("paper")
def test_both_solvers_fly_the_same_commands(constrained_flight: Flight, fly_once: Callable[..., Flight]) -> None:
    dense = fly_once("paper-constrained", "controller.solver=piqp-dense")
    difference = np.abs(dense.log.control.speeds - constrained_flight.log.control.speeds).max()
    assert difference < 1e-2
    assert dense.satisfied
