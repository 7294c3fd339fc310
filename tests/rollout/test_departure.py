"""A flight that ends far off its course and still leaves it is lost, and says so wherever its verdict is shown."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support import NO_PRODUCTS

import quadsim
from quadsim.commands.cli import main
from quadsim.console.results import EXIT_DONE, EXIT_FAILED, EXIT_WRONG_INPUT
from quadsim.console.summary_tables import outcome_line
from quadsim.errors import FileError
from quadsim.flight import rundir
from quadsim.flight.departure import departure_numbers, departure_of
from quadsim.flight.log import ControlLog
from quadsim.report.comparison_rows import outcome
from quadsim.report.film.frames import filmed
from quadsim.rollout.flown import Flight
from quadsim.rollout.reaudit import reaudit
from quadsim.rollout.rollout import Rollout
from quadsim.rollout.stored import read_flight
from quadsim.scenarios.loading import load_scenario
from quadsim.scenarios.schema.scenario import Scenario
from quadsim.state import Array

TOLERANT = [{"name": name, "signal": name, "lower": -5.0, "upper": 5.0, "tolerance": 0.2} for name in ("roll", "pitch")]
TURNED: dict[str, Any] = {
    "duration": 8.0,
    "controller.horizon": 15,
    "initial.euler": [0.0, 0.0, 90.0],
    "reference": {"type": "yaw_turns", "turns": [{"start": 0.0, "yaw": 90.0, "rate": 30.0}]},
    "events": [{"type": "push", "at": 1.0, "duration": 0.2, "force": [4.0, 0.0, 0.0]}],
    "constraints": TOLERANT,
}
"""The paper's law at a heading of 90 deg, and a short push: its model is linearised at heading 0."""


def turned(**changes: Any) -> Scenario:
    return quadsim.load("paper-constrained").replace(TURNED | changes)


def line(flight: Flight) -> str:
    return outcome_line(flight).plain


@pytest.fixture(scope="module")
def leaving() -> Flight:
    return quadsim.fly(turned(), progress=False)


@pytest.fixture
def run(leaving: Flight, tmp_path: Path) -> Path:
    return leaving.save(tmp_path / "run", **NO_PRODUCTS)


def rewrite(run: Path, **entries: Any) -> None:
    path = run / rundir.SUMMARY_FILE
    path.write_text(json.dumps({**json.loads(path.read_text()), **entries}))


# --- one flight, wherever its verdict is shown ------------------------------------------------------------------------


def test_a_flight_that_leaves_its_course_for_good_is_lost_though_every_constraint_holds(leaving: Flight) -> None:
    assert all(finding.satisfied for finding in leaving.audit)
    assert leaving.log.status == "completed"
    assert leaving.time.size == 160
    assert leaving.outcome == "lost"
    assert not leaving.satisfied
    away = np.linalg.norm([leaving.state[axis] - leaving.reference[axis] for axis in "xyz"], axis=0)
    assert away[-1] == away.max() > 6.0
    assert leaving.departure is not None
    assert leaving.departure.distance == pytest.approx(away[-1])
    assert 0.2 < leaving.departure.growth < 0.6
    assert line(leaving).startswith(f"lost: at its end {away[-1]:.3g} m off its course and leaving it (growth 0.")
    assert "beyond lost.departure = 4 m" in line(leaving)
    assert "beyond lost.departure = 4 m" in repr(leaving)
    assert "beyond lost.departure = 4 m" in outcome(leaving).text
    _, cases = leaving.verdicts()
    assert cases[0][:2] == ("flight", False)
    assert "lost.departure" in cases[0][2]
    assert "lost.departure" in filmed(leaving).failures[0]


def test_its_summary_has_the_numbers_and_a_new_audit_gives_the_same_verdict(leaving: Flight, run: Path) -> None:
    assert leaving.departure is not None
    summary = rundir.read_summary(run)
    assert (summary["status"], summary["verdict"], summary["lost"]) == ("completed", "lost", "departure")
    assert summary["reason"] is None
    assert summary["tracking"]["departure"] == {
        "distance": leaving.departure.distance,
        "growth": leaving.departure.growth,
    }
    again = reaudit(run)
    assert again.outcome == "lost"
    assert again.departure == leaving.departure
    assert again.exit_status == EXIT_FAILED
    assert line(again) == line(leaving)


@pytest.mark.parametrize("limit", [False, 30.0])
def test_the_limit_decides_and_the_departure_is_named_whatever_it_is(leaving: Flight, limit: float | bool) -> None:
    scenario = leaving.scenario.replace({"lost.departure": limit})
    milder = replace(leaving, scenario=scenario)
    assert milder.outcome == "satisfied"
    assert milder.exit_status == EXIT_DONE
    assert "every required constraint holds" in line(milder)
    assert "m off its course and leaving it" in line(milder)
    assert "off its course" in outcome(milder).text
    assert milder.reason is None


def test_a_number_that_was_changed_contradicts_the_tables(run: Path) -> None:
    tracking = rundir.read_summary(run)["tracking"]
    tracking["departure"]["distance"] = 2.0
    rewrite(run, tracking=tracking, verdict="satisfied", satisfied=True, as_expected=True, lost=None)
    with pytest.raises(FileError, match=r"departure\.distance is recorded as 2\.0"):
        reaudit(run)


def test_a_run_of_a_version_without_the_numbers_keeps_its_verdict(run: Path) -> None:
    tracking = rundir.read_summary(run)["tracking"]
    del tracking["departure"]
    rewrite(run, tracking=tracking, verdict="satisfied", satisfied=True, as_expected=True, lost=None)
    old = read_flight(run)
    assert old.departure is None
    assert old.outcome == "satisfied"
    assert line(old) == "completed, every required constraint holds"
    assert reaudit(run).outcome == "satisfied"


def test_run_and_check_exit_with_1_and_the_limit_is_a_field_of_the_scenario(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "turned.toml"
    file.write_text(turned(duration=5.0).to_toml())
    tables = ("--no-video", "--no-recording", "--no-figures", "--out", str(tmp_path / "run"), "--overwrite")
    assert main(["run", str(file), *tables, "--set", "lost.departure=2.0"]) == EXIT_FAILED
    assert "beyond lost.departure = 2 m" in " ".join(capsys.readouterr().out.split())
    assert main(["check", str(tmp_path / "run")]) == EXIT_FAILED
    assert "as recorded" in capsys.readouterr().out
    assert main(["check", str(file), "--set", "lost.departure=2.0"]) == EXIT_FAILED
    capsys.readouterr()
    assert main(["run", str(file), *tables]) == EXIT_DONE, "up to 4 m"
    assert "m off its course and leaving it" in " ".join(capsys.readouterr().out.split())
    assert main(["run", str(file), *tables, "--set", "lost.departure=-1"]) == EXIT_WRONG_INPUT
    assert "lost.departure" in capsys.readouterr().err


# --- other flights ----------------------------------------------------------------------------------------------------


def swinging(now: quadsim.StepInputs, state: quadsim.State, reference: Array) -> Array:
    """PD in all axes, but for a velocity that is fed back with the wrong sign along x: it swings ever wider."""
    vehicle = quadsim.load_vehicle("lopes2011")
    pitch = np.clip(0.25 * (reference[0, 0] - state.x) + 0.02 * state.vx, -0.5, 0.5)
    roll = np.clip(0.3 * (state.y - reference[0, 1]) + 0.3 * state.vy, -0.3, 0.3)
    climb = 4.0 * (reference[0, 2] - state.z) - 3.0 * state.vz
    rolling = 4.0 * (roll - state.roll) - 2.0 * state.roll_rate
    pitching = 4.0 * (pitch - state.pitch) - 2.0 * state.pitch_rate
    thrust = vehicle.mass * (vehicle.gravity + climb) / 4.0
    arm = 2.0 * vehicle.arm_length
    front_and_back = vehicle.inertia[1] * pitching / arm
    left_and_right = vehicle.inertia[0] * rolling / arm
    forces = thrust + np.array([-front_and_back, -left_and_right, front_and_back, left_and_right])
    return np.sqrt(np.clip(forces, 0.0, None) / vehicle.mean_coefficient)


def line_ahead(t: float) -> list[float]:
    return [0.4 * t, 0.0, 1.0, 0.0]


def test_a_swing_that_grows_is_lost_also_where_it_passes_its_reference() -> None:
    scenario = quadsim.load("hover").replace({"duration": 9.05, "constraints": []})
    flight = quadsim.fly(scenario, controller=swinging, reference=line_ahead, progress=False)
    away = np.linalg.norm([flight.state[axis] - flight.reference[axis] for axis in "xyz"], axis=0)
    assert away[-1] < 2.0, "it is near its reference just now"
    assert away.max() > 10.0
    assert flight.outcome == "lost"


def test_a_live_flight_has_its_verdict_so_far() -> None:
    scenario = quadsim.load("hover").replace({"duration": 20.0, "constraints": []})
    outcomes = []
    with quadsim.start(scenario, controller=swinging, live=True) as started:
        started.apply({"type": "setpoint", "x": 2.0, "y": 0.0, "z": 0.0})
        for steps in (40, 141):
            for _ in range(steps):
                started.step()
            outcomes.append(started.flight().outcome)
    assert outcomes == ["unaudited", "lost"]


def shortened(log: ControlLog, periods: int) -> ControlLog:
    """The start of a flight, as if it had ended there."""
    parts = {name: getattr(log, name)[:periods] for name in ("t", "truth", "reference", "phase")}
    return replace(log, **parts)


@pytest.mark.parametrize(("name", "duration"), [("paper-constrained", 16.0), ("robust-worn-rotor", 24.0)])
def test_a_satisfied_flight_is_not_lost_wherever_it_is_cut_off(name: str, duration: float) -> None:
    scenario = load_scenario(name).replace({"duration": duration})
    flight = Rollout(scenario).fly()
    log = flight.log.control
    away = np.linalg.norm(log.tracking_error[:, :3], axis=1)
    assert away.max() > 2.5, "it lags behind its steps by metres"
    limit = scenario.lost.departure
    for periods in range(20, log.t.size + 1, 7):
        departure = departure_of(departure_numbers(shortened(log, periods)), limit)
        assert departure is not None
        assert not departure.lost
    assert flight.departure is not None
    assert not flight.departure.leaving
