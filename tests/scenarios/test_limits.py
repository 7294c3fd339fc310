"""What is audited: the bounds of the controller, named or not, and what stands for them."""

import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest

import quadsim
from quadsim.commands.cli import main
from quadsim.console.results import EXIT_DONE, EXIT_FAILED
from quadsim.features.live.session import Session
from quadsim.flight.audit import UNAUDITED_ADVICE, Limit
from quadsim.rollout.reaudit import reaudit
from quadsim.scenarios.assembly import Assembly
from quadsim.scenarios.feasibility_check import hover_notes
from quadsim.scenarios.limits import flyable
from quadsim.scenarios.loading import load_scenario
from quadsim.scenarios.schema.scenario import Scenario


def audited(scenario: Scenario) -> dict[str, Limit]:
    return {limit.name: limit for limit in Assembly(scenario).limits}


def hover(**changes: Any) -> Scenario:
    return quadsim.load("hover").replace(
        {"duration": 0.5, **{key.replace("__", "."): at for key, at in changes.items()}}
    )


def test_a_bound_that_no_entry_names_is_audited_within_one_percent() -> None:
    scenario = hover(controller__output_bounds__vz=[-0.5, 1.5])
    limit = audited(scenario)["vz"]
    assert (limit.signal, limit.lower, limit.upper, limit.required) == ("vz", -0.5, 1.5, True)
    assert limit.tolerances == pytest.approx((0.01, 0.002))  # of half the band, 1 m/s
    (note,) = Assembly(scenario).audit_notes
    assert note.startswith("vz: ")


def test_a_bound_on_velocity_that_is_violated_makes_the_flight_violated() -> None:
    """Soft, so that it gives: 10 m up in a step, faster than 0.3 m/s."""
    changes = {
        "duration": 4.0,
        "controller.output_bounds.vz": [-0.3, 0.3],
        "controller.soft": {"linear": 0.0, "quadratic": 1e-3},
        "controller.tightening": None,
    }
    flight = quadsim.fly(quadsim.load("robust").replace(changes))
    (finding,) = (entry for entry in flight.audit if entry.limit.name == "vz")
    assert finding.verdict == flight.outcome == "violated"


def test_an_entry_without_bounds_takes_the_controllers_with_its_own_tolerance_and_window() -> None:
    entry = {"name": "late", "signal": "roll", "tolerance": 0.3, "start": 0.2, "required": False}
    limits = audited(hover(constraints=[entry]))
    late = limits["late"]
    assert (late.lower, late.upper, late.tolerance, late.start, late.required) == (-5.0, 5.0, 0.3, 0.2, False)
    assert "roll" not in limits, "the entry stands for the bound"
    assert {"pitch", "speed", "slew"} <= limits.keys()


def test_an_entry_for_a_part_of_the_flight_leaves_the_bound_audited() -> None:
    entry = {"name": "roll", "signal": "roll", "lower": -1.0, "upper": 1.0, "start": 0.2}
    limits = audited(hover(constraints=[entry]))
    assert (limits["roll"].upper, limits["controller.roll"].upper) == (1.0, 5.0)


@pytest.mark.slow("library")
def test_other_numbers_than_the_controllers_are_reported(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    settings = ["constraints.roll.lower=-8.0", "constraints.roll.upper=8.0", "duration=0.5"]
    line = "roll: audited against ±8 deg, the controller bounds ±5 deg"
    assert Assembly(load_scenario("hover", settings)).audit_notes == [line]
    options = [part for setting in settings for part in ("--set", setting)]
    assert main(["run", "hover", *options, "--out", str(tmp_path / "run"), "--no-video", "--no-recording"]) == EXIT_DONE
    assert line in capsys.readouterr().out
    quadsim.compare(tmp_path / "run", out=tmp_path / "page")
    assert line in (tmp_path / "page/index.html").read_text()
    assert reaudit(tmp_path / "run").satisfied


@pytest.mark.parametrize("how", ["replace", "set", "base"])
def test_a_law_without_bounds_is_held_to_those_of_the_law_that_it_replaces(how: str, tmp_path: Path) -> None:
    (tmp_path / "mine.toml").write_text('base = "hover"\nname = "mine"\ncontroller = "pid"\n')
    scenario = {
        "replace": lambda: hover(controller={"type": "pid"}),
        "set": lambda: load_scenario("hover", ["controller=pid"]),
        "base": lambda: load_scenario(str(tmp_path / "mine.toml")),
    }[how]()
    before = audited(hover())
    assert audited(scenario) == before
    assert (before["roll"].upper, Assembly(scenario).audit_notes) == (5.0, [])


def test_an_entry_without_bounds_is_not_audited_where_no_law_has_had_any() -> None:
    entry = {"name": "climb", "signal": "vz"}
    scenario = hover(controller={"type": "pid"}).replace({"constraints": [entry]})
    assert audited(scenario) == {}
    advice, note = Assembly(scenario).audit_notes
    assert advice == UNAUDITED_ADVICE
    assert note.startswith("climb: ")


def test_bounds_that_an_event_changes_are_reported_with_their_time() -> None:
    event = {"type": "controller", "at": 0.2, "fields": {"output_bounds.roll": [-3.0, 3.0]}}
    scenario = hover(events=[event])
    assert audited(scenario)["roll"].upper == 5.0
    (note,) = Assembly(scenario).audit_notes
    assert [each in note for each in ("±5 deg", "±3 deg", "0.2 s")] == [True, True, True]


def test_all_bounds_of_nonlinear_mpc_are_audited() -> None:
    law = {
        "type": "nonlinear",
        "tilt": 30.0,
        "body_rate": [100.0, 200.0, 50.0],
        "output_bounds": {"vz": [-1.0, 1.0]},
        "inputs": "speed",
        "input_bounds": {"slew": [-20.0, 20.0]},
    }
    limits = audited(hover(controller=law, constraints=[]))
    assert {name: (limit.lower, limit.upper) for name, limit in limits.items()} == {
        "vz": (-1.0, 1.0),
        "tilt": (-math.inf, 30.0),
        "body_rate_x": (-100.0, 100.0),
        "body_rate_y": (-200.0, 200.0),
        "body_rate_z": (-50.0, 50.0),
        "speed": (0.0, 250.0),  # what the vehicle's rotors hold
        "slew": (-20.0, 20.0),
    }
    assert quadsim.fly(hover(controller=law, constraints=[])).outcome == "satisfied"


ARRIVAL = {"constraints": [{"name": "arrival", "signal": "z_error", "lower": -0.1, "upper": 0.1, "start": 1.0}]}


def incomplete() -> Scenario:
    return hover(**ARRIVAL)


def entry_of(summary: Mapping[str, Any], name: str) -> Mapping[str, Any]:
    (result,) = (entry for entry in summary["constraints"] if entry["name"] == name)
    return result


def test_a_required_constraint_that_the_flight_does_not_reach_makes_it_incomplete() -> None:
    flight = quadsim.fly(incomplete())
    assert (flight.outcome, flight.satisfied) == ("incomplete", False)
    assert flight.summary["verdict"] == entry_of(flight.summary, "arrival")["verdict"] == "incomplete"
    assert not flight.summary["as_expected"]
    assert quadsim.fly(incomplete().replace({"constraints.arrival.required": False})).outcome == "satisfied"
    assert quadsim.fly(incomplete().replace({"duration": 1.5})).outcome == "satisfied"
    low = {"name": "low", "signal": "z", "upper": 0.5}
    assert quadsim.fly(hover(constraints=[*ARRIVAL["constraints"], low])).outcome == "violated"


def test_the_command_line_tells_incomplete_from_violated(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "scenario.toml"
    verdicts = tmp_path / "verdicts.xml"
    path.write_text(incomplete().to_toml())
    quiet = ["--out", str(tmp_path / "run"), "--no-video", "--no-recording", "--no-figures"]
    assert main(["run", str(path), *quiet]) == EXIT_DONE
    assert "arrival" in capsys.readouterr().out.splitlines()[0]
    for target in (path, tmp_path / "run"):
        assert main(["check", str(target), "--junit", str(verdicts)]) == EXIT_FAILED
        assert "violated" not in capsys.readouterr().out
        (case,) = ElementTree.parse(verdicts).getroot().findall("testcase[skipped]")
        assert case.get("name") == "arrival"


def test_a_second_law_of_a_session_is_held_to_the_bounds_of_the_first() -> None:
    scenario = quadsim.load("hover")
    session = Session(scenario, against=scenario.replace({"controller": {"type": "pid"}}).controller)
    first, second = (flight.limits for flight in session.flights)
    assert first == second
    session.close()


def test_steps_of_the_command_have_no_value_between_the_samples() -> None:
    flight = quadsim.fly(hover())
    assert entry_of(flight.summary, "slew")["peak_plant"] is None
    assert entry_of(flight.summary, "slew")["worst_margin"] is not None


def test_a_bound_on_speed_is_what_the_rotors_can_do_of_it() -> None:
    vehicle = replace(quadsim.load_vehicle("lopes2011"), speed_min=50.0, speed_max=250.0)
    roll = {"roll": (-5.0, 5.0)}
    assert flyable({"speed": (0.0, 300.0), **roll}, vehicle) == {"speed": (50.0, 250.0), **roll}
    assert flyable({"speed": (60.0, 200.0)}, vehicle) == {"speed": (60.0, 200.0)}
    assert flyable({"speed": (300.0, 400.0)}, vehicle) == {"speed": (50.0, 250.0)}


def test_what_the_rotors_can_do_is_the_bound_of_audit_notes_and_feasibility() -> None:
    assembly = Assembly(hover(constraints=[], actual={"speed_max": 200.0}, effects={"load": {"mass_factor": 1.1}}))
    assert assembly.bounds["speed"] == (0.0, 200.0)
    assert [(limit.lower, limit.upper) for limit in assembly.limits if limit.signal == "speed"] == [(0.0, 200.0)]
    (note,) = hover_notes(assembly)
    assert note.startswith("hover needs 202.2 rad/s, the bound is 200")


def test_a_difference_is_noted_from_when_it_is_there() -> None:
    """A change of the controller that leaves its bound brings no second note."""
    entry = {"name": "roll", "signal": "roll", "lower": -4.0, "upper": 4.0}
    events = [
        {"type": "controller", "at": 0.1, "fields": {"horizon": 21}},
        {"type": "controller", "at": 0.2, "fields": {"output_bounds": {"roll": [-3.0, 3.0]}}},
    ]
    notes = Assembly(hover(constraints=[entry], events=events)).audit_notes
    first, later = [note for note in notes if note.startswith("roll")]
    assert "±5 deg" in first
    assert "±3 deg from 0.2 s" in later
