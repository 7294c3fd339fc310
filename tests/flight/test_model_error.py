"""Predictions for a period later against what was flown, on made-up flights with known changes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support import small_log

from quadsim.controller import MISSED
from quadsim.flight.log import ControlLog
from quadsim.flight.model_error import model_errors, model_report
from quadsim.state import INDEX, Array

PERIODS = 200
PERIOD = 0.05


def flight(state: str, accelerations: Array) -> tuple[ControlLog, Array]:
    """A level flight in which one rate changes by accelerations (K,), and what predicts it exactly."""
    log = small_log(PERIODS).control
    truth = np.zeros_like(log.truth)
    changes = PERIOD * accelerations
    truth[1:, INDEX[state]] = np.cumsum(changes)[:-1]
    foreseen = truth.copy()
    foreseen[:, INDEX[state]] += changes
    flown = replace(
        log,
        t=PERIOD * np.arange(PERIODS),
        truth=truth,
        state=truth,
        phase=("flying",) * PERIODS,
        status=("solved",) * PERIODS,
        delay=np.zeros(PERIODS),
    )
    return flown, foreseen


def turned(log: ControlLog, foreseen: Array, state: str, factor: float) -> Array:
    """What a model predicts whose change of a state is wrong by a factor."""
    i = INDEX[state]
    wrong = foreseen.copy()
    wrong[:, i] = log.state[:, i] + factor * (foreseen[:, i] - log.state[:, i])
    return wrong


@pytest.fixture
def accelerations() -> Array:
    slow = np.repeat(np.random.default_rng(1).normal(size=PERIODS // 4), 4)
    return 2.0 * slow


STATES = ("vx", "vy", "vz", "roll_rate", "pitch_rate", "yaw_rate")


@pytest.mark.parametrize("state", STATES)
def test_a_reversed_sign_is_named_with_the_first_period_and_both_changes(state: str, accelerations: Array) -> None:
    log, foreseen = flight(state, accelerations)
    assert model_errors(log, foreseen) == [], "the exact model"
    (error,) = model_errors(log, turned(log, foreseen, state, -1.0))
    first = int(np.argmax(np.abs(accelerations) >= 0.2))
    assert (error.state, error.time) == (state, PERIOD * first)
    assert error.flown == pytest.approx(PERIOD * accelerations[first])
    assert error.predicted == pytest.approx(-PERIOD * accelerations[first])
    assert error.correlation == pytest.approx(-1.0)
    assert error.ratio == pytest.approx(1.0)
    assert f"the wrong way {'along' if state.startswith('v') else 'about'} " in error.sentence
    assert error.sentence.endswith("deg/s" if state.endswith("rate") else " m/s")


@pytest.mark.parametrize(("factor", "wrong"), [(3.0, True), (9.55, True), (1.5, False), (0.5, False), (-0.2, False)])
def test_a_wrong_size_counts_where_no_change_would_be_the_better_prediction(
    factor: float, wrong: bool, accelerations: Array
) -> None:
    log, foreseen = flight("roll_rate", accelerations)
    errors = model_errors(log, turned(log, foreseen, "roll_rate", factor))
    assert bool(errors) == wrong
    if wrong:
        assert f"turns {factor:.2g} times as much as the vehicle about x" in errors[0].sentence


def test_a_right_model_under_wind_noise_or_pushes_is_not_blamed(accelerations: Array) -> None:
    log, foreseen = flight("vx", accelerations)
    rng = np.random.default_rng(2)
    wind = np.convolve(rng.normal(size=PERIODS + 39), np.ones(40) / 12.0, "valid")
    pushes = np.where(rng.uniform(size=PERIODS) < 0.05, 20.0, 0.0)
    for unknown in (np.full(PERIODS, 3.0), wind, pushes):
        truth = log.truth.copy()
        truth[1:, INDEX["vx"]] += PERIOD * np.cumsum(unknown)[:-1]
        predicted = foreseen + truth - log.truth
        assert model_errors(replace(log, truth=truth, state=truth), predicted) == []
    noise = 0.3 * rng.normal(size=log.truth.shape)
    assert model_errors(replace(log, state=log.truth + noise), foreseen + noise) == []


def test_a_state_that_is_wrong_first_comes_first(accelerations: Array) -> None:
    log, foreseen = flight("vx", accelerations)
    late, predicted_late = flight("yaw_rate", np.where(np.arange(PERIODS) < 50, 0.0, accelerations))
    i = INDEX["yaw_rate"]
    truth = log.truth.copy()
    truth[:, i] = late.truth[:, i]
    both = replace(log, truth=truth, state=truth)
    wrong = turned(log, foreseen, "vx", -1.0)
    wrong[:, i] = turned(late, predicted_late, "yaw_rate", -1.0)[:, i]
    assert [error.state for error in model_errors(both, wrong)] == ["vx", "yaw_rate"]
    report = model_report(both, wrong, "your model")
    assert report is not None
    assert report["sentence"].startswith("your model moves the wrong way along x: in the period from ")
    assert [entry["state"] for entry in report["states"]] == ["vx", "yaw_rate"]
    assert model_report(log, foreseen, "your model") is None


def test_what_does_not_show_the_model_is_not_compared(accelerations: Array) -> None:
    log, foreseen = flight("vy", accelerations)
    wrong = turned(log, foreseen, "vy", -1.0)
    assert model_errors(log, wrong)
    steep = log.truth.copy()
    steep[:, INDEX["roll"]] = 0.9
    for other in (
        replace(log, phase=("landed",) * PERIODS),
        replace(log, status=(MISSED,) * PERIODS),
        replace(log, delay=np.full(PERIODS, 0.6 * PERIOD)),
        replace(log, truth=steep),
    ):
        assert model_errors(other, wrong) == []
    assert model_errors(log, np.full_like(wrong, np.nan)) == []
    assert model_errors(log, None) == []
    small, predicted = flight("vy", 0.05 * accelerations / np.abs(accelerations).max())
    assert model_errors(small, turned(small, predicted, "vy", -1.0)) == []


def test_a_flight_of_a_few_periods_shows_nothing(accelerations: Array) -> None:
    log, foreseen = flight("vy", accelerations)
    few = {name: getattr(log, name)[:4] for name in ("t", "truth", "state", "phase", "status", "delay")}
    assert model_errors(replace(log, **few), turned(log, foreseen, "vy", -1.0)[:4]) == []
