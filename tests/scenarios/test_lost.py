"""`[lost]`: an obviously failed flight ends as lost, whatever its scenario requires."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from quadsim.controller import Phase
from quadsim.flight import rundir
from quadsim.state import tilt
from scenarios import cli
from scenarios.campaign.pilot import CampaignPilot
from scenarios.campaign.plan import load_plan
from scenarios.flight import summarise
from scenarios.loading import load_scenario
from scenarios.run import fly_scenario

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
    run = rundir.load_run(out)
    assert run.log.plant.t[-1] == pytest.approx(summary["duration"])
    assert cli.main(["check", str(out)]) == 1


@pytest.mark.parametrize(
    ("settings", "lost"),
    [
        ([], "tilt"),
        (["lost.tilt=false"], "depth"),
        (["lost.tilt=false", "lost.depth=false"], "distance"),
        (["lost.tilt=false", "lost.depth=false", "lost.distance=false"], "speed"),
        ([f"lost.{name}=false" for name in ("tilt", "depth", "speed", "distance")], None),
    ],
)
def test_each_criterion_is_on_unless_it_is_switched_off(unstable: str, settings: list[str], lost: str | None) -> None:
    flight = fly_scenario(load_scenario(unstable, settings))
    assert (flight.log.lost, summarise(flight)["lost"]) == (lost, lost)
    assert flight.outcome == ("satisfied" if lost is None else "lost")
    if lost is None:
        assert flight.log.plant.state[-1, 4] < -500.0


def test_what_capsizes_on_the_ground_has_crashed_and_is_not_lost(unstable: str) -> None:
    """It ends upside down, and its reference may go on without it."""
    settings = ["duration=9", "effects.ground.contact=true", "initial.position=[0.0, 0.0, 0.1]", "lost.tilt=61"]
    away = "reference.x=[{start=0.0, stop=3.0, value=0.0}, {start=3.0, stop=9.0, value=300.0}]"
    flight = fly_scenario(load_scenario(unstable, [*settings, away]))
    assert np.degrees(tilt(flight.log.plant.state)).max() > 61.0
    assert np.abs(flight.log.control.truth[:, 0] - flight.log.control.reference[:, 0]).max() > 200.0
    assert (flight.log.reason, flight.outcome, flight.log.control.phase[-1]) == (None, "violated", Phase.CRASHED)


def test_a_descent_below_the_start_is_no_fall() -> None:
    descent = "reference={type='waypoints', points=[{position=[0.0, 0.0, 0.0]}, {position=[0.0, 0.0, -30.0]}]}"
    flight = fly_scenario(load_scenario("hover", ["lost.depth=5", "duration=30", "constraints=[]", descent]))
    assert flight.log.plant.state[-1, 4] < -25.0
    assert flight.outcome == "satisfied"


def test_a_campaign_draws_criteria_and_has_their_verdicts(unstable: str, tmp_path: Path) -> None:
    file = tmp_path / "campaign.toml"
    depths = 'name = "depth"\nfields = ["lost.depth"]\ndistribution = "uniform"\nlow = 5.0\nhigh = 40.0\n'
    settings = "[set.lost]\ntilt = false\n"
    file.write_text(f'name = "c"\nscenario = "{unstable}"\nflights = 3\n{settings}[[vary]]\n{depths}')
    plan = load_plan(str(file))
    rows = [CampaignPilot(plan).fly(flight) for flight in range(3)]
    assert [row["verdict"] for row in rows] == ["lost"] * 3
    assert all(f"beyond lost.depth = {row['draw.depth']:g} m" in str(row["reason"]) for row in rows)
    order = np.argsort([float(str(row["draw.depth"])) for row in rows])
    assert list(order) == list(np.argsort([float(str(row["duration"])) for row in rows]))
