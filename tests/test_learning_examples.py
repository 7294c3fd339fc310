"""The examples on learning: a gradient that is one, a student that is audited, a filter that is needed."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "examples"))

import imitation
import safety_filter

import quadsim
import quadsim.gym


def test_the_gradient_is_that_of_the_mean_squared_error() -> None:
    network, rng = imitation.Network((5, 4, 3, 2)), np.random.default_rng(0)
    x, y = rng.normal(size=(7, 5)), rng.normal(size=(7, 2))

    def error() -> float:
        return float(np.mean((network._layers(x)[-1] - y) ** 2))

    parameters = [*network.weights[:-1], *network.offsets]
    for parameter, slope in zip(parameters, network._gradient(x, y), strict=True):
        for index in np.ndindex(parameter.shape):
            there, step = parameter[index], 1e-6
            parameter[index] = there + step
            above = error()
            parameter[index] = there - step
            below = error()
            parameter[index] = there
            assert slope[index] == pytest.approx((above - below) / (2.0 * step), abs=1e-8)


def test_features_are_the_same_from_an_observation_and_from_a_controllers_arguments() -> None:
    rng = np.random.default_rng(0)
    state, preview, command = rng.normal(size=12), rng.normal(size=(50, 4)), rng.normal(size=4)
    observed = np.concatenate([(preview - state[[0, 2, 4, 10]]).ravel(), state, command])
    found = imitation.of_observation(observed, 200.0)
    assert found == pytest.approx(imitation.features(state, preview, command, 200.0), abs=1e-12)


def test_a_student_is_audited_like_its_teacher(capsys: pytest.CaptureFixture[str]) -> None:
    student = imitation.learn(courses=1, rounds=0, epochs=2)
    assert "round 0: 600 samples" in capsys.readouterr().out
    flights = imitation.compared(student, flights=1, duration=3.0)
    assert [flights[name][0].controller for name in ("teacher", "student")] == ["constrained", "student"]
    limits = [{finding.limit.name for finding in each[0].audit} for each in flights.values()]
    assert limits == [{"roll", "pitch", "speed", "slew"}] * 3
    assert flights["teacher"][0].satisfied
    assert imitation.beyond(flights["student"][0]) > imitation.TOLERANCE  # hardly taught at all
    assert imitation.beyond(flights["student behind the filter"][0]) < imitation.TOLERANCE


def test_the_filter_is_needed(capsys: pytest.CaptureFixture[str]) -> None:
    safety_filter.main(["gust"])
    behind, alone = capsys.readouterr().out.splitlines()
    assert behind.startswith("gust: 180 steps, tilt up to 4.")
    assert "flown; stepped in" in behind
    assert alone.endswith("lost; no filter")


def test_the_teacher_labels_its_own_flight_and_the_students() -> None:
    scenario = imitation.course(0).replace({"duration": 1.0})
    hover = quadsim.load_vehicle("lopes2011").hover_speed
    _, speeds = imitation.answers(scenario, hover)
    assert np.array_equal(speeds, quadsim.fly(scenario, progress=False).command)
    student = imitation.Student(imitation.Network((imitation.INPUTS, 4, 4)), quadsim.load_vehicle("lopes2011"))
    seen, labels = imitation.answers(scenario, hover, student)
    assert len(seen) == len(labels) > 1
    assert np.array_equal(labels[0], speeds[0])
    assert not np.array_equal(labels[1], speeds[1])
