"""The examples on learning: a student that is audited, a filter that is needed."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "examples"))

import imitation
import safety_filter

import quadsim


def test_a_student_is_audited_like_its_teacher(capsys: pytest.CaptureFixture[str]) -> None:
    student = imitation.learn(courses=1, rounds=0)
    assert "600 samples, RMS error 0." in capsys.readouterr().out
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
    scenario, hover = imitation.course(0).replace({"duration": 1.0}), quadsim.load_vehicle("lopes2011").hover_speed
    own = imitation.Lesson(scenario, hover)
    flight = quadsim.fly(scenario, controller=own, progress=False)
    assert np.array_equal(flight.command, quadsim.fly(scenario, progress=False).command)
    assert np.array_equal(own.speeds, flight.command)
    other = imitation.Lesson(scenario, hover, imitation.Student(np.ones((imitation.INPUTS, 4)), hover))
    quadsim.fly(scenario, controller=other, progress=False)
    assert len(other.seen) == len(other.speeds) > 1
    assert np.array_equal(other.speeds[0], own.speeds[0])
    assert not np.array_equal(other.speeds[1], own.speeds[1])
