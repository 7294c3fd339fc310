"""Every scenario that ships: finite, reproducible to the bit, with the verdict that its file states."""

from __future__ import annotations

import math
import tomllib
from collections.abc import Callable, Mapping
from dataclasses import fields, replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from _pytest.mark.structures import ParameterSet
from golden_numbers import library_entry, read

from quadsim.controller import FALLBACK, LAW, MISSED, STOPPED
from quadsim.features.campaign.rows import flown_row
from quadsim.flight.audit import COMMAND_TOLERANCE, audit, worst_finding, worst_share
from quadsim.flight.log import ControlLog, FlightLog, PlantLog
from quadsim.mpc.guard.answer import INFEASIBLE
from quadsim.report.comparison_rows import comparison_rows
from quadsim.rollout.flown import Flight, summarise
from quadsim.rollout.rollout import Rollout
from quadsim.scenarios.catalogue import scenario_names, scenario_source
from quadsim.scenarios.loading import load_scenario, parse_scenario
from quadsim.scenarios.schema.base import fields_of
from quadsim.scenarios.schema.scenario import Lost, Scenario

SHARED = (
    *("paper-constrained", "paper-constrained-lag20", "paper-unconstrained", "paper-unconstrained-clipped"),
    *("gps-outage", "hard-landing", "lost-rotor", "nan-position", "power-loop"),
    *("torrente-loop4-all", "torrente-loop4-drag", "torrente-loop4-ideal"),
)
"""With other modules."""
ROOT = Path(__file__).resolve().parents[2]
SAME = ("verdict", "flown", "nearest", "unit")
TOLERANCES = {"rmse": 1e-3, "tilt": 0.1, "qps": 1.0, "margin": 0.01}
"""Of golden numbers: the same, and within [m, deg, %, the constraint's unit]."""
RELATIVE = 1e-3
"""Or within this share."""
COMPARED = 1.0
"""Of a flight and of the same one again, at least [s]."""
SHORT = 12.0
"""Longest flight of another paper that is flown here [s]."""


@cache
def loaded() -> dict[str, Scenario]:
    """Every scenario, read once."""
    return {name: load_scenario(name) for name in scenario_names()}


def flown_here() -> list[str]:
    """All but the long flights of other papers, which `quadsim reproduce` flies."""
    return [name for name, each in loaded().items() if each.group != "papers" or each.duration <= SHORT]


def flights() -> list[ParameterSet]:
    """`make test` flies the two that other modules need as well."""
    slow = pytest.mark.slow("library")
    representative = pytest.mark.representative("library")
    quick = ("paper-constrained", "paper-unconstrained")
    return [pytest.param(name, marks=[slow, representative] if name in quick else slow) for name in flown_here()]


@pytest.fixture(scope="module", params=flights())
def flight(request: pytest.FixtureRequest, fly_once: Callable[..., Flight]) -> Flight:
    """Each scenario, flown once for all tests that use it."""
    return fly_once(request.param) if request.param in SHARED else Rollout(loaded()[request.param]).fly()


def flown_again(scenario: Scenario, periods: int) -> FlightLog:
    """The flight once more, interrupted after so many periods."""

    def interrupt(stage: str, done: int, total: int) -> None:
        if done == periods < total:
            raise KeyboardInterrupt

    return Rollout(scenario).fly(interrupt).log


def periods_compared(scenario: Scenario) -> int:
    """Of the first seconds, or as long as it takes for every event to have come and gone."""
    ends = [event.at + (getattr(event, "duration", None) or 0.0) for event in scenario.events]
    return math.ceil(max([COMPARED, *(end + 0.5 for end in ends)]) / scenario.control_period)


def numbers(log: FlightLog, periods: int, steps: int) -> tuple[list[bytes], list[bytes]]:
    """The first periods of the control log and of the plant, each column as bytes."""

    def columns(rows: ControlLog | PlantLog, count: int) -> list[bytes]:
        values = [getattr(rows, field.name) for field in fields(rows)]
        arrays = [value for value in values if value is not None and not isinstance(value, Mapping)]
        logged = [signal for value in values if isinstance(value, Mapping) for _, signal in value.values()]
        return [np.asarray(array[:count]).tobytes() for array in (*arrays, *logged)]

    return columns(log.control, periods), columns(log.plant, periods * steps)


def error(flight: Flight, channel: str) -> float:
    """Real minus reference at the last sample."""
    return float(summarise(flight)["tracking"]["final_error"][channel])


def estimation_rmse(log: FlightLog, columns: list[int]) -> float:
    return float(np.sqrt(np.mean((log.control.state - log.control.truth)[20:, columns] ** 2)))


# What no golden number shows of some files.


def jitter_misses_one_in_twenty(flight: Flight) -> None:
    share = flight.log.control.status.count(MISSED) / flight.log.control.t.size
    assert share == pytest.approx(math.exp(-3.0), abs=3.0 * math.sqrt(0.05 / 400))


def lands_gently(flight: Flight) -> None:
    ground = summarise(flight)["ground"]
    assert ground["phase"] == "landed"
    assert 0.0 < ground["touchdown"]["speed"] < 0.5
    assert ground["touchdown"]["tilt"] < 2.0


def lands_hard(flight: Flight) -> None:
    ground = summarise(flight)["ground"]
    assert ground["touchdown"]["speed"] == pytest.approx(1.9, abs=0.05)
    assert ground["phase"] == "landed"


def capture_is_within_four_millimetres(flight: Flight) -> None:
    assert 0.002 < estimation_rmse(flight.log, [0, 2, 4]) < 0.005


def satellites_are_filtered(flight: Flight) -> None:
    assert 0.05 < estimation_rmse(flight.log, [0, 2, 4]) < 0.3  # of 0.5 m


def frozen_position_is_believed(flight: Flight) -> None:
    errors = flight.log.control.state - flight.log.control.truth
    assert np.abs(errors[:, 0]).max() > 1.0
    assert abs(error(flight, "x")) < 0.1


def nothing_is_solved_without_a_position(flight: Flight) -> None:
    control = flight.log.control
    blind = np.isnan(control.state).any(axis=1)
    assert np.count_nonzero(blind) == 10
    assert np.array_equal(blind, control.fallback == 1)


def outage_is_bridged(flight: Flight) -> None:
    t = flight.log.control.t
    errors = np.abs(flight.log.control.state - flight.log.control.truth)[:, [0, 2, 4]].max(axis=1)
    assert errors[(t > 5.0) & (t < 6.0)].max() > errors[(t > 3.0) & (t < 4.0)].max()
    assert errors[t > 8.0].max() < 0.6


SHOWN: dict[str, Callable[[Flight], None]] = {
    "late-commands": jitter_misses_one_in_twenty,
    "take-off-and-landing": lands_gently,
    "hard-landing": lands_hard,
    "landing-by-estimate": lands_gently,
    "motion-capture": capture_is_within_four_millimetres,
    "outliers": capture_is_within_four_millimetres,
    "gyro-bias": capture_is_within_four_millimetres,
    "satellite-navigation": satellites_are_filtered,
    "frozen-position": frozen_position_is_believed,
    "nan-position": nothing_is_solved_without_a_position,
    "gps-outage": outage_is_bridged,
}


def test_it_has_the_verdict_that_its_file_states(flight: Flight) -> None:
    """And whatever else `SHOWN` has of it; its resolved file is the same scenario."""
    broken = {f.limit.name: f.worst_margin for f in flight.findings if f.limit.required and not f.satisfied}
    assert flight.findings, "a scenario must be audited against something"
    assert flight.outcome == flight.scenario.expect, f"{flight.log.reason or ''} {broken}"
    if flight.scenario.name in SHOWN:
        SHOWN[flight.scenario.name](flight)
    assert parse_scenario(tomllib.loads(flight.scenario.to_toml())) == flight.scenario


def test_a_campaign_names_the_same_worst_constraint_and_margin_as_the_flight(flight: Flight) -> None:
    worst = worst_finding(flight.findings)
    row = flown_row(flight.log, flight.findings, verdict=flight.outcome, wall_s=0.0, machine="")
    expected = (None, None) if worst is None else (worst.limit.name, worst_share(flight.findings))
    assert (row.get("worst_constraint"), row.get("worst_margin")) == expected
    shown = next(row.cells[0].text for row in comparison_rows([flight]) if row.label == "worst constraint")
    assert shown.startswith("-" if worst is None else f"{worst.limit.name} ")
    assert ("worst margin: " in repr(flight)) == (worst is not None)


def test_the_last_digits_change_neither_the_worst_constraint_nor_a_worst_time(flight: Flight) -> None:
    """Shares of findings differ by 3e-6 from one linear algebra kernel to another, states by 1e-11 to 1e-8."""
    rng = np.random.default_rng(0)
    worst = worst_finding(flight.findings)
    for _ in range(20):
        shaken = []
        for finding in flight.findings:
            commanded = finding.limit.source.tolerance is COMMAND_TOLERANCE  # what is limited to its bound has no noise
            noise = 0.0 if commanded else 3e-6 * finding.limit.half_band * rng.uniform(-1.0, 1.0)
            margins = finding.worst_margin + noise, finding.worst_margin_sampled + noise
            shaken.append(replace(finding, worst_margin=margins[0], worst_margin_sampled=margins[1]))
        other = worst_finding(shaken)
        assert (other and other.limit.name) == (worst and worst.limit.name)
    log = flight.log
    control = log.control
    plant = log.plant
    truth = control.truth + 1e-10 * rng.uniform(-1.0, 1.0, control.truth.shape)
    state = plant.state + 1e-10 * rng.uniform(-1.0, 1.0, plant.state.shape)
    again = replace(log, control=replace(control, truth=truth), plant=replace(plant, state=state))
    limits = tuple(finding.limit for finding in flight.findings)
    for finding, other in zip(flight.findings, audit(again, limits), strict=True):
        np.testing.assert_equal(other.worst_time, finding.worst_time, err_msg=finding.limit.name)


def test_every_number_in_its_log_is_finite(flight: Flight) -> None:
    control = flight.log.control
    plant = flight.log.plant
    measured = control.state.copy()
    if flight.scenario.name == "nan-position":  # what the sensor measured then; nothing else
        measured[np.ix_((control.t > 2.99) & (control.t < 3.51), [0, 2, 4])] = 0.0
        assert np.isnan(control.state).any()
    assert np.isfinite(measured).all()
    for name in ("t", "truth", "reference", "speeds", "slack", "delay"):
        assert np.isfinite(getattr(control, name)).all(), name
    by_qp = np.array([by not in {LAW, FALLBACK, STOPPED} for by in control.answered_by])
    if flight.scenario.controller.type != "unconstrained":  # whose rows nobody poses
        assert (control.infeasibility[by_qp] <= INFEASIBLE).all()
    for field in fields(PlantLog):
        values = getattr(plant, field.name)
        assert values is None or np.isfinite(values).all(), field.name


def test_it_is_reproducible_to_the_bit(flight: Flight) -> None:
    periods = periods_compared(flight.scenario)
    steps = flight.scenario.steps_per_period
    assert numbers(flown_again(flight.scenario, periods), periods, steps) == numbers(flight.log, periods, steps)


def test_its_numbers_are_the_golden_ones(flight: Flight) -> None:
    golden = read("library")[flight.scenario.name]
    result = library_entry(flight)
    assert result.keys() == golden.keys()
    assert [result[key] for key in SAME if key in result] == [golden[key] for key in SAME if key in golden]
    for key, tolerance in TOLERANCES.items():
        if key in golden:
            assert result[key] == pytest.approx(golden[key], abs=tolerance, rel=RELATIVE), key


@pytest.mark.parametrize("name", scenario_names())
def test_a_file_is_named_for_its_scenario_and_described_in_a_line(name: str) -> None:
    file, changes = scenario_source(name)
    data = {**tomllib.loads(file.read_text(encoding="utf-8")), **changes}
    assert data["name"] == name
    assert len(data["description"].splitlines()) == 1
    assert "group" in data


def test_every_scenario_has_golden_numbers() -> None:
    assert sorted(read("library")) == scenario_names()


def test_the_page_states_every_loss_criterion_and_its_default() -> None:
    text = (ROOT / "docs" / "conventions.md").read_text(encoding="utf-8")
    for name, info in fields_of(Lost).items():
        assert f"- `lost.{name} = {info.default:g}`: {info.description}\n" in text
