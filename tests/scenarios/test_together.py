"""Flights stepped together move as one by one, to the bit; what that could save is measured."""

from __future__ import annotations

import math

import pytest

from quadsim.errors import ParameterError
from scenarios.bench.together import CASES, Saving, Together, bench_together, difference, saving_rows
from scenarios.build import build_plant, build_vehicle
from scenarios.loading import load_scenario

GYROSCOPIC = ("paper-unconstrained", (*CASES["paper-unconstrained in wind"][1], "effects.rotors.inertia=1e-4"))
HEAVY = ("paper-unconstrained", ("effects.load.mass_factor=1.3", "effects.air.rotor_drag=3e-4"))


@pytest.mark.parametrize(("file", "settings"), [*CASES.values(), GYROSCOPIC, HEAVY])
@pytest.mark.parametrize("size", [1, 3])
def test_flights_stepped_together_move_as_one_by_one(file: str, settings: tuple[str, ...], size: int) -> None:
    assert difference(load_scenario(file, settings), size, holds=5) == 0.0


def test_seeds_blow_vehicles_apart() -> None:
    """So that the comparison is one between flights that differ."""
    file, settings = CASES["paper-unconstrained in wind"]
    scenario = load_scenario(file, settings)
    batch = Together(scenario, 2)
    with build_plant(scenario, build_vehicle(scenario)) as plant:
        batch.reset(plant.physics, plant.hover_speeds)
        first, second = batch.advance(plant.hover_speeds, 50)
    assert abs(first[-1] - second[-1]).max() > 1e-6


def test_other_effects_are_refused() -> None:
    scenario = load_scenario("paper-unconstrained", ["effects.disturbance.force=[0.1, 0.0, 0.0]"])
    with pytest.raises(ParameterError, match="none but rotor lag, rotor drag and wind"):
        Together(scenario, 2)


def test_savings_are_measured_and_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(CASES, "short", ("paper-unconstrained", ("duration=1.0", "effects.air.rotor_drag=1e-4")))
    (saving,) = bench_together(["short"], sizes=(1, 2), rounds=1, holds=2)
    assert saving.steps == 1000
    assert saving.apart == 0.0
    assert saving.log_bytes == 8 * (14 + 6)
    assert all(0.1 < us < 1e4 for us in (saving.alone_us, *saving.together_us.values()))
    head, row = saving_rows([saving])
    assert len(head) == len(row)
    assert row[0] == "short"


def test_the_ratio_counts_the_stepping_alone() -> None:
    saving = Saving(name="x", flight_s=1.0, steps=60_000, alone_us=12.0, together_us={8: 7.0}, apart=0.0, log_bytes=200)
    assert math.isclose(saving.ratio(8), 0.7)
    assert math.isclose(saving.log_mb(8), 96.0)
