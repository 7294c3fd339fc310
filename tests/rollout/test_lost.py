"""`[lost]`: an obviously failed flight ends as lost, whatever its scenario requires."""

from __future__ import annotations

from pathlib import Path

import pytest

from quadsim.commands import cli
from quadsim.flight import rundir
from quadsim.rollout.flown import summarise
from quadsim.rollout.rollout import Rollout
from quadsim.rollout.stored import read_flight
from quadsim.scenarios.loading import load_scenario

UNSTABLE = '''
import numpy as np


class Unstable:
    """Rolls in the wrong direction, ever faster."""

    def __init__(self, vehicle, period, horizon):
        self.hover = vehicle.hover_speed

    def step(self, now, state, reference):
        push = 0.02 - 2.0 * state[6]
        return self.hover + np.array([0.0, push, 0.0, -push])
'''
SCENARIO = """
name = "unstable"
description = "A controller that rolls the vehicle over, and no constraint against it"
duration = 20.0
control_period = 0.05
[vehicle]
file = "lopes2011"
[reference]
type = "steps"
[controller]
type = "unstable:Unstable"
horizon = 1
"""


@pytest.fixture(scope="module")
def unstable(tmp_path_factory: pytest.TempPathFactory) -> str:
    folder = tmp_path_factory.mktemp("unstable")
    (folder / "unstable.py").write_text(UNSTABLE)
    (folder / "unstable.toml").write_text(SCENARIO)
    return str(folder / "unstable.toml")


def test_an_unstable_controller_ends_as_lost_with_exit_status_1(
    unstable: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "run"
    status = cli.main(["run", unstable, "--no-video", "--no-recording", "--no-figures", "--out", str(out)])
    assert status == 1
    assert "lost.tilt = 120 deg" in "".join(capsys.readouterr())
    summary = rundir.read_summary(out)
    assert (summary["status"], summary["lost"], summary["satisfied"]) == ("aborted", "tilt", False)
    assert 0.0 < summary["duration"] < 20.0
    run = read_flight(out)
    assert run.log.plant.t[-1] == pytest.approx(summary["duration"])
    assert cli.main(["check", str(out)]) == 1


@pytest.mark.parametrize(
    ("settings", "lost"),
    [
        ([], "tilt"),
        (["lost.tilt=false"], "depth"),
        (["lost.tilt=false", "lost.depth=false"], "distance"),
        (["lost.tilt=false", "lost.depth=false", "lost.distance=false"], "speed"),
        ([f"lost.{name}=false" for name in ("tilt", "depth", "speed", "distance")], "departure"),
        ([f"lost.{name}=false" for name in ("tilt", "depth", "speed", "distance", "departure")], None),
    ],
)
def test_each_criterion_is_on_unless_it_is_switched_off(unstable: str, settings: list[str], lost: str | None) -> None:
    flight = Rollout(load_scenario(unstable, settings)).fly()
    assert summarise(flight)["lost"] == lost
    assert flight.log.lost == (None if lost == "departure" else lost)
    assert flight.outcome == ("unaudited" if lost is None else "lost")
    if flight.log.lost is None:
        assert flight.log.plant.state[-1, 4] < -500.0
