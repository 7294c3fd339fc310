"""A reference that is passed in as a function of the time."""

from __future__ import annotations

import math
import pickle
import shutil
from pathlib import Path

import numpy as np
import pytest

import quadsim
from quadsim.errors import FileError, InputError
from quadsim.scenarios.schema.scenario import Scenario
from quadsim.state import REFERENCE_NAMES


def helix(t: float) -> tuple[float, float, float, float]:
    return math.sin(t) / 3.0, 1.0 - math.cos(t), 0.1 * t, 0.25


@pytest.fixture(scope="module")
def hover() -> Scenario:
    return quadsim.load("paper-constrained").replace({"duration": 0.5, "controller.horizon": 10})


def test_it_is_followed_at_the_control_instants_and_seen_ahead(hover: Scenario) -> None:
    with quadsim.start(hover, reference=helix) as started:
        preview = started.observation.preview
        flight = started.fly()
    instants = hover.control_period * np.arange(10.0)
    followed = np.stack([flight.reference[name] for name in REFERENCE_NAMES], axis=1)
    np.testing.assert_array_equal(followed, [helix(t) for t in instants])
    np.testing.assert_array_equal(preview, [helix(t) for t in hover.control_period * np.arange(1.0, 11.0)])
    assert flight.summary["course"]["tilt"] < 40.0  # samples do not count as rounded, or as kinks that nothing can fly


def test_a_run_keeps_its_samples_and_flies_again_to_the_same_bits(
    hover: Scenario, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = quadsim.run(hover, reference=helix, out=tmp_path / "run", video=False, recording=False, figures=False)
    monkeypatch.chdir(tmp_path)
    assert quadsim.check("run").satisfied == run.satisfied
    shutil.move("run", "elsewhere")
    for again in (
        hover.fly(reference=helix),
        quadsim.fly("elsewhere/scenario.toml"),
        quadsim.fly(quadsim.read("elsewhere").scenario),
        quadsim.fly(run.scenario),
        quadsim.fly(run.scenario.replace({"seed": 1})),
        quadsim.fly(pickle.loads(pickle.dumps(run.scenario))),
    ):
        np.testing.assert_array_equal(again.command, run.command)
        np.testing.assert_array_equal(again.log.control.reference, run.log.control.reference)
    Path("elsewhere/reference.csv").write_text("t,x,y,z,yaw\n0,0,0,0,0\n9,0,0,0,0\n", encoding="utf-8")
    with pytest.raises(FileError, match="SHA-256"):
        quadsim.fly("elsewhere/scenario.toml")
    with pytest.raises(FileError, match=r"reference\.csv"):
        quadsim.check("elsewhere")


def test_it_takes_the_place_of_a_course_that_ends_the_flight_and_of_its_filter() -> None:
    scenario = quadsim.load("torrente-lemniscate8-ideal", {"initial.on_reference": False})
    assert scenario.ends_with_course
    with quadsim.start(scenario, reference=lambda t: [1.0, 0.0, 0.0, 0.0]) as started:
        np.testing.assert_array_equal(started.observation.preview[:, 0], 1.0)
        assert started.scenario.replace({"seed": 2}).duration == scenario.duration


@pytest.mark.parametrize(
    ("reference", "problem"),
    [
        (3.0, r"reference must be a function f\(t\) that returns x, y, z \[m\], yaw \[rad\]; got 3\.0"),
        (
            lambda t: [0.0] * 3,
            r"f\(0\) must be four numbers within \+-1e\+06: x, y, z \[m\], yaw \[rad\]; got \[0\.0, ",
        ),
        (lambda t: [0.0, math.nan if t > 0.31 else 0.0, 0.0, 0.0], r"f\(0\.35\) must be four numbers .* nan, "),
        (lambda t: [1.0 / (t - 0.1), 0.0, 0.0, 0.0], r"f\(0\.1\) cannot be used: ZeroDivisionError: .*py, line \d+"),
        (lambda t: ["x", 0.0, 0.0, 0.0], r"f\(0\) cannot be used: ValueError: could not convert"),
        (lambda: [0.0] * 4, r"f\(0\) cannot be used: TypeError: "),
    ],
)
def test_one_that_gives_no_pose_is_refused_before_the_flight(hover: Scenario, reference: object, problem: str) -> None:
    with pytest.raises(InputError, match=problem):
        quadsim.start(hover, reference=reference)  # type: ignore[arg-type]
