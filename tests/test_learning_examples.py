"""The examples on learning: a gradient that is one, a student that is audited, a filter that is needed."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
import scipy

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "examples"))

import imitation
import safety_filter

import quadsim


def test_the_gradient_is_that_of_the_mean_squared_error() -> None:
    network, rng = imitation.Network(5, 4, 3, 2), np.random.default_rng(0)
    x, y = rng.normal(size=(7, 5)), rng.normal(size=(7, 2))
    numeric = scipy.optimize.approx_fprime(network.weights, lambda weights: network.error(weights, x, y)[0])
    assert network.error(network.weights, x, y)[1] == pytest.approx(numeric, abs=1e-6)


def test_the_network_learns_beyond_its_linear_map() -> None:
    rng = np.random.default_rng(0)
    x = rng.normal(size=(400, 3))
    y = np.column_stack([x @ [1.0, -1.0, 0.5], np.clip(2.0 * x[:, 0], -1.0, 1.0)])
    network = imitation.Network(3, 16, 16, 2)
    error = network.fit(x, y, steps=200)
    assert error == pytest.approx(np.sqrt(np.mean((network(x) - y) ** 2)))
    assert error < 0.3 * np.sqrt(np.mean((imitation.with_ones(x) @ network.linear - y) ** 2))


def test_a_student_is_audited_like_its_teacher(capsys: pytest.CaptureFixture[str]) -> None:
    student = imitation.learn(courses=1, rounds=0, steps=2)
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
    own = imitation.Lesson(scenario)
    flight = quadsim.fly(scenario, controller=own, progress=False)
    assert np.array_equal(flight.command, quadsim.fly(scenario, progress=False).command)
    assert np.array_equal(own.speeds, flight.command)
    student = imitation.Student(imitation.Network(imitation.INPUTS, 4, 4), quadsim.load_vehicle("lopes2011"))
    other = imitation.Lesson(scenario, student)
    quadsim.fly(scenario, controller=other, progress=False)
    assert len(other.seen) == len(other.speeds) > 1
    assert np.array_equal(other.speeds[0], own.speeds[0])
    assert not np.array_equal(other.speeds[1], own.speeds[1])
