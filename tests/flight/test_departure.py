"""Departure from the course, on made-up flights with known distances."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import ArrayLike
from support import small_log

from quadsim.controller import Phase
from quadsim.flight.departure import LEAVING_FROM, LEAVING_GROWTH, Departure, departure_numbers, departure_of
from quadsim.flight.log import ControlLog


def flight(position: ArrayLike, reference: ArrayLike, *, period: float = 0.05, grounded: int = 0) -> ControlLog:
    """A flight along positions (K, 3) [m] beside a reference (K, 3); its first `grounded` periods are on the ground."""
    positions = np.asarray(position, float)
    log = small_log(len(positions)).control
    truth = np.zeros_like(log.truth)
    truth[:, [0, 2, 4]] = positions
    references = np.zeros_like(log.reference)
    references[:, :3] = reference
    phase = tuple("landed" if k < grounded else "flying" for k in range(len(positions)))
    return replace(log, t=period * np.arange(len(positions)), truth=truth, reference=references, phase=phase)


def along_x(x: ArrayLike) -> np.ndarray:
    values = np.asarray(x, float)
    return np.stack([values, np.zeros_like(values), np.zeros_like(values)], axis=1)


def departed(log: ControlLog, limit: float | None = 4.0) -> Departure:
    found = departure_of(departure_numbers(log), limit)
    assert found is not None
    return found


TIME = 0.05 * np.arange(400)
HOVER = np.zeros((TIME.size, 3))


def test_an_exponential_departure_has_its_own_growth_and_its_last_distance() -> None:
    away = 0.5 * np.exp(0.2 * TIME)
    away[0] = 0.0  # it starts on its course
    found = departed(flight(along_x(away), HOVER))
    assert found.distance == pytest.approx(away[-1])
    assert found.growth == pytest.approx(0.2, abs=2e-3)
    assert found.leaving
    assert found.lost
    assert "beyond lost.departure = 4 m" in found.sentence


def test_an_oscillation_that_grows_is_a_departure_also_while_it_swings_back() -> None:
    swing = 0.5 * np.exp(0.2 * TIME) * np.sin(6.0 * TIME)
    inward = [k for k in range(250, 400) if abs(swing[k]) < 0.2 * abs(swing[:k]).max()]
    assert inward
    for k in inward:
        found = departed(flight(along_x(swing[: k + 1]), HOVER[: k + 1]))
        assert found.growth == pytest.approx(0.2, abs=0.15)
        assert found.leaving


def test_a_vehicle_that_lags_behind_its_course_does_not_leave_it() -> None:
    stepped = np.where(TIME >= 18.0, 20.0, 0.0)
    on_its_way = np.clip(2.0 * (TIME - 18.0), 0.0, None)
    assert departed(flight(along_x(on_its_way), along_x(stepped))).distance < 1e-12
    angle = 0.8 * TIME
    circle = 6.0 * np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], axis=1)
    late = np.vstack([circle[:1].repeat(30, axis=0), circle[:-30]])
    assert np.linalg.norm(late - circle, axis=1).max() > 5.0
    assert departed(flight(late, circle)).distance < 1e-12


def test_the_way_from_the_start_to_the_course_belongs_to_it() -> None:
    away = np.linspace(30.0, 12.0, TIME.size)
    assert departed(flight(along_x(away), HOVER)).distance < 1e-12
    beside = along_x(away) + [0.0, 2.0, 0.0] * np.linspace(0.0, 1.0, TIME.size)[:, None]
    assert departed(flight(beside, HOVER)).distance == pytest.approx(2.0, rel=0.05)


@pytest.mark.parametrize(("duration", "distance"), [(50.0, 0.0), (100.0, 7.0)])
def test_only_the_last_minute_of_a_long_course_counts(duration: float, distance: float) -> None:
    time = np.arange(0.0, duration, 0.05)
    reference = along_x(np.where(time < 5.0, 8.0, 0.0))
    leaves = along_x(7.0 * np.clip((time - time[-1] + 4.0) / 4.0, 0.0, 1.0))
    assert departed(flight(leaves, reference)).distance == pytest.approx(distance, abs=1e-9)


def test_an_offset_that_stays_does_not_grow_whatever_its_rounding() -> None:
    offset = 6.0 + 1e-9 * np.sin(40.0 * TIME)
    offset[0] = 0.0
    found = departed(flight(along_x(offset), HOVER))
    assert found.distance == pytest.approx(6.0)
    assert abs(found.growth) < LEAVING_GROWTH / 100.0
    assert not found.leaving
    assert not found.lost


def test_a_small_distance_is_no_departure_however_fast_it_grows() -> None:
    found = departed(flight(along_x(1e-6 * np.expm1(0.6 * TIME)), HOVER))
    assert found.growth > LEAVING_GROWTH
    assert found.distance < LEAVING_FROM
    assert not found.leaving


def test_time_on_the_ground_does_not_count() -> None:
    away = along_x(np.where(TIME < 18.0, 9.0, 9.0 + 2.0 * (TIME - 18.0)))
    away[0] = 0.0
    whole = departed(flight(away, HOVER))
    assert whole.growth == pytest.approx(np.log(12.9 / 9.0) / 2.5, rel=0.05)
    later = departed(flight(away, HOVER, grounded=360))
    assert later.growth == pytest.approx(np.log(12.9 / 10.9) / 1.0, rel=0.1)
    assert departure_numbers(flight(away, HOVER, grounded=385)) is None, "too short a time in the air"
    landed = flight(away, HOVER)
    assert departure_numbers(replace(landed, phase=(*landed.phase[:-1], str(Phase.LANDED)))) is None
    assert departure_numbers(replace(landed, phase=(*landed.phase[:-1], str(Phase.CRASHED)))) is None


def test_a_flight_that_is_too_short_or_not_finite_has_no_numbers() -> None:
    assert departure_numbers(flight(along_x([]), np.zeros((0, 3)))) is None
    assert departure_numbers(flight(along_x([5.0]), np.zeros((1, 3)))) is None
    assert departure_numbers(flight(along_x(TIME[:19]), HOVER[:19])) is None
    assert departure_numbers(flight(along_x(TIME[:20]), HOVER[:20])) is not None
    broken = along_x(TIME)
    broken[-1] = np.nan
    assert departure_numbers(flight(broken, HOVER)) is None
    assert departure_of(None, 4.0) is None


@pytest.mark.parametrize("period", [0.002, 0.07, 0.5, 4.0])
def test_every_control_period_has_the_same_numbers(period: float) -> None:
    time = period * np.arange(round(12.0 / period) + 1)
    away = 0.5 * np.exp(0.25 * time)
    away[0] = 0.0
    found = departed(flight(along_x(away), np.zeros((time.size, 3)), period=period))
    assert found.growth == pytest.approx(0.25, rel=0.2)
    assert found.distance == pytest.approx(away[-1])


def test_the_limit_alone_decides_what_is_lost() -> None:
    numbers = {"distance": 6.0, "growth": 0.1}
    assert Departure(**numbers, limit=4.0).lost
    assert not Departure(**numbers, limit=8.0).lost
    assert not Departure(**numbers).lost
    assert Departure(**numbers).leaving
    assert "lost" not in Departure(**numbers).sentence
    near = Departure(distance=0.5, growth=0.1, limit=0.2)
    assert near.lost, "a limit may be below the distance from which on a departure is named"
    assert near.leaving
