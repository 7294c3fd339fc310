"""A scenario holds what was stated: duration, bounds and numbers of the vehicle follow what is flown."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support import NO_PRODUCTS, fly_here

import quadsim
from quadsim.commands.app import run
from quadsim.errors import InputError
from quadsim.features.campaign.plan import make_plan, plan_for_scenario
from quadsim.scenarios.assembly import Assembly
from quadsim.scenarios.catalogue import scenario_names
from quadsim.scenarios.feasibility_check import floor_notes
from quadsim.scenarios.loading import assemble, load_scenario, parse_scenario
from quadsim.scenarios.schema.bases import read_whole
from quadsim.scenarios.schema.problems import ScenarioError
from quadsim.scenarios.schema.scenario import Scenario

TURNS = "reference.turns"
OTHER_VEHICLE = "hummingbird"
ROTORS = [[0.2, 0.0, 0.0], [0.0, -0.2, 0.0], [-0.2, 0.0, 0.0], [0.0, 0.2, 0.0]]
"""Places of rotors [m], instead of arms."""


@pytest.fixture(scope="module")
def eight() -> Scenario:
    """A figure eight of one turn, whose file states no duration."""
    scenario: Scenario = quadsim.scenario(vehicle="hummingbird", course="figure-eight").scenario
    assert scenario.ends_with_course
    return scenario


def longer(eight: Scenario, turns: float) -> float:
    """Return the duration [s] of a number of turns: whole control periods."""
    assert eight.reference.type == "figure_eight"
    until = eight.reference.until + (turns - eight.reference.turns) * eight.reference.period
    return round(np.ceil(until / eight.control_period - 1e-6) * eight.control_period, 9)


# --- every way of deriving a scenario ------------------------------------------------------------------------------


def test_every_way_to_other_fields_gives_the_same_scenario(eight: Scenario, tmp_path: Path) -> None:
    base = tmp_path / "eight.toml"
    base.write_text(eight.to_toml(), encoding="utf-8")
    derived = tmp_path / "derived.toml"
    derived.write_text('base = "eight.toml"\nname = "derived"\n[reference]\nturns = 3.0\n', encoding="utf-8")
    printed = tmp_path / "printed.toml"
    printed.write_text(Assembly(eight).to_toml().replace("turns = 1.0", "turns = 3.0"), encoding="utf-8")
    campaign = tmp_path / "campaign.toml"
    entry = f'[[vary]]\nname = "turns"\nfields = ["{TURNS}"]\ndistribution = "grid"\nvalues = [3.0]\n'
    campaign.write_text(f'name = "c"\nflights = 1\nscenario = "{base}"\n{entry}', encoding="utf-8")
    changed = tmp_path / "changed.toml"
    changed.write_text(
        f'name = "c"\nflights = 1\nscenario = "{base}"\n[set.reference]\nturns = 3.0\n', encoding="utf-8"
    )
    flown = quadsim.fly(eight.replace({TURNS: 2.0}), progress=False).scenario
    vary = [{"name": "turns", "fields": [TURNS], "distribution": "grid", "values": [3.0]}]
    ways = {
        "replace": eight.replace({TURNS: 3.0}),
        "of a flight": flown.replace({TURNS: 3.0}),
        "--set": load_scenario(str(base), [f"{TURNS}=3.0"]),
        "base": load_scenario(str(derived)),
        "printed": load_scenario(str(printed)),
        "campaign": make_plan(eight, {"flights": 1, "vary": vary}).of(0),
        "campaign of a flight": make_plan(flown, {"flights": 1, "vary": vary}).of(0),
        "vary": plan_for_scenario(eight, str(campaign)).of(0),
        "set": plan_for_scenario(eight, str(changed)).of(0),
    }
    durations = {way: scenario.duration for way, scenario in ways.items()}
    assert durations == dict.fromkeys(ways, longer(eight, 3.0))
    assert longer(eight, 3.0) > 14.0
    assert all(scenario.ends_with_course for scenario in ways.values())


def test_a_sweep_flies_each_course_to_its_end(eight: Scenario, monkeypatch: pytest.MonkeyPatch) -> None:
    fly_here(monkeypatch)
    table = quadsim.sweep(eight, {TURNS: [1.0, 2.0]}, workers=1, progress=False)
    assert table["duration"].tolist() == [longer(eight, 1.0), longer(eight, 2.0)]
    alone = quadsim.fly(eight.replace({TURNS: 2.0}), progress=False)
    assert table["rmse.x"][1] == alone.metrics["rmse.x"]
    assert table.cut == 0


def test_a_stated_duration_stays(eight: Scenario) -> None:
    short = eight.replace({"duration": 5.0})
    assert not short.ends_with_course
    assert short.replace({TURNS: 3.0}).duration == 5.0
    assert short.replace({"duration": None, TURNS: 3.0}).duration == longer(eight, 3.0)


def test_a_default_is_not_stated_and_a_number_of_it_can_be_set() -> None:
    hover = load_scenario("hover")
    assert "lost" not in hover.tables
    assert hover.replace({"initial.velocity.1": 0.5}).initial.velocity == (0.0, 0.5, 0.0)
    assert load_scenario("hover", ["initial.velocity.1=0.5"]).initial.velocity == (0.0, 0.5, 0.0)
    share = {"name": "d", "fields": ["lost.distance"], "relative": True, "distribution": "grid", "values": [0.5]}
    assert make_plan(hover, {"flights": 1, "vary": [share]}).of(0).lost.distance == 50.0


# --- numbers of the vehicle ----------------------------------------------------------------------------------------


def test_another_vehicle_file_brings_its_own_numbers_and_what_was_stated_stays(monkeypatch: pytest.MonkeyPatch) -> None:
    fly_here(monkeypatch)
    scenario = load_scenario("hover").replace({"vehicle.gravity": 9.5, "duration": 0.1, "constraints": []})
    recorded = Assembly(scenario).recorded.scenario
    assert recorded.vehicle.mass == 4.0
    vary = [{"name": "v", "fields": ["vehicle.file"], "distribution": "grid", "values": [OTHER_VEHICLE]}]
    heavier = {"name": "m", "fields": ["vehicle.mass"], "relative": True, "distribution": "grid", "values": [1.2]}
    other = Assembly(scenario.replace({"vehicle.file": OTHER_VEHICLE})).vehicle
    assert other.mass < 1.0
    ways = (
        recorded.replace({"vehicle.file": OTHER_VEHICLE}),
        quadsim.fly(scenario, progress=False).scenario.replace({"vehicle.file": OTHER_VEHICLE}),
        make_plan(scenario, {"flights": 1, "vary": vary}).of(0),
    )
    for way in ways:
        assert Assembly(way).vehicle == other
        assert Assembly(way).vehicle.gravity == 9.5
    drawn = make_plan(scenario, {"flights": 1, "vary": [heavier, *vary]}).of(0)
    assert Assembly(drawn).vehicle.mass == 1.2 * other.mass


def test_a_size_that_the_vehicle_gives_follows_the_vehicle() -> None:
    lagging = {"vehicle.rotor_rise": 0.02, "vehicle.rotor_fall": 0.03, "effects.rotors": {}, "duration": 0.1}
    flown = quadsim.fly(load_scenario("hover").replace({**lagging, "constraints": []}), progress=False).scenario
    rotors = Assembly(flown.replace({"vehicle.rotor_rise": 0.05})).effects.rotors
    assert rotors is not None
    assert (rotors.rise, rotors.fall) == (0.05, 0.03)


def test_a_run_folder_states_what_was_stated_and_flies_the_same_again(tmp_path: Path, eight: Scenario) -> None:
    first = run(eight, out=tmp_path / "first", progress=False, **NO_PRODUCTS)
    text = (tmp_path / "first" / "scenario.toml").read_text(encoding="utf-8")
    assert f"# duration = {eight.duration}  # derived; [s]" in text
    tables = tomllib.loads(text)
    assert "duration" not in tables
    assert tables["vehicle"]["mass"] == first.vehicle.mass
    assert tables["recorded"] == {"file": "hummingbird", "stated": []}
    assert "  # of hummingbird" in text
    again = run(tmp_path / "first" / "scenario.toml", out=tmp_path / "again", progress=False, **NO_PRODUCTS)
    for name in ("flight.parquet", "plant.parquet", "scenario.toml"):
        assert (tmp_path / "again" / name).read_bytes() == (tmp_path / "first" / name).read_bytes()
    assert again.scenario == first.scenario
    more = load_scenario(str(tmp_path / "first" / "scenario.toml"), [f"{TURNS}=3.0"])
    assert more.duration == longer(eight, 3.0)


def test_a_flight_cut_by_hand_states_its_duration(eight: Scenario) -> None:
    with quadsim.start(eight) as started:
        for _ in range(20):
            started.step()
        flight = started.flight()
    assert not flight.scenario.ends_with_course
    again = parse_scenario(tomllib.loads(flight.to_toml()))
    assert again.duration == 20 * eight.control_period
    assert (quadsim.fly(again, progress=False).command == flight.command).all()


def test_a_recorded_vehicle_is_not_taken_for_another(tmp_path: Path) -> None:
    recorded = Assembly(load_scenario("hover")).recorded
    text = recorded.to_toml().replace('file = "lopes2011"', f'file = "{OTHER_VEHICLE}"', 1)
    with pytest.raises(ScenarioError, match=r"recorded\.file"):
        parse_scenario(tomllib.loads(text))
    (tmp_path / "run.toml").write_text(recorded.to_toml(), encoding="utf-8")
    (tmp_path / "mine.toml").write_text(
        f'base = "run.toml"\nname = "mine"\n[vehicle]\nfile = "{OTHER_VEHICLE}"\nmass = 0.7\n', encoding="utf-8"
    )
    mine = load_scenario(str(tmp_path / "mine.toml"))
    assert mine.recorded is None
    assert mine.vehicle.overrides() == {"mass": 0.7}


def test_a_number_stated_over_a_recorded_one_stays_with_another_vehicle() -> None:
    recorded = Assembly(load_scenario("hover")).recorded.scenario
    heavier = recorded.replace({"vehicle.mass": 4.2})
    assert heavier.recorded is not None
    assert heavier.recorded.stated == ("vehicle.mass",)
    assert heavier.replace({"vehicle.file": OTHER_VEHICLE}).vehicle.overrides() == {"mass": 4.2}
    placed = recorded.replace({"vehicle.rotor_positions": ROTORS})
    assert Assembly(placed).vehicle.arm_length is None


def test_another_table_of_poses_is_not_held_to_the_hash_of_the_first(tmp_path: Path) -> None:
    for name, height in (("a", 1.0), ("b", 2.0)):
        rows = "\n".join(f"{t},0,0,{height},0" for t in (0.0, 1.0, 2.0))
        (tmp_path / f"{name}.csv").write_text(f"t,x,y,z,yaw\n{rows}\n", encoding="utf-8")
    table = 'base = "hover"\nname = "poses"\nduration = 2.0\n[reference]\ntype = "csv"\nfile = "a.csv"\n'
    (tmp_path / "poses.toml").write_text(table, encoding="utf-8")
    first = load_scenario(str(tmp_path / "poses.toml"))
    other = first.replace({"reference.file": str(tmp_path / "b.csv")})
    assert Assembly(other).course.sample(np.array([1.0]))[0, 2] == 2.0


# --- bounds of a user's controller ---------------------------------------------------------------------------------

LAW = """
import numpy as np


class Hovering:
    def __init__(self, vehicle, period, horizon, tilt=5.0):
        self.bounds = {"roll": (-tilt, tilt)}
        self.speeds = vehicle.hover_speeds

    def step(self, now, state, reference):
        return self.speeds
"""


def test_bounds_of_a_users_controller_are_those_of_each_flight(tmp_path: Path) -> None:
    (tmp_path / "hovering_law.py").write_text(LAW, encoding="utf-8")
    controller = {"type": "hovering_law:Hovering", "folder": str(tmp_path)}
    scenario = load_scenario("hover").replace({"controller": controller, "duration": 0.1, "constraints": []})
    vary = [{"name": "t", "fields": ["controller.settings.tilt"], "distribution": "grid", "values": [3.0, 8.0]}]
    plan = make_plan(scenario, {"flights": 2, "vary": vary})
    margins = [plan.fly(flight)["margin.roll"] for flight in range(2)]
    assert margins == [3.0, 8.0]
    assert [limit.upper for limit in plan.limits] == [5.0]


# --- what a flight says --------------------------------------------------------------------------------------------


def test_a_flight_shorter_than_its_course_says_so(eight: Scenario, monkeypatch: pytest.MonkeyPatch) -> None:
    short = eight.replace({"duration": 0.5})
    flight = quadsim.fly(short, progress=False)
    end = Assembly(short).course_cut
    assert end == pytest.approx(Assembly(eight).course.end, abs=1e-9)
    assert f"0.50 s of a course that ends at {end:g} s" in repr(flight)
    assert flight.summary["course"]["cut_before"] == end
    assert f"0.50 s flown, of a course that ends at {end:g} s" in " ".join(flight.text().split())
    whole = quadsim.fly(eight, progress=False)
    assert "of a course" not in repr(whole)
    assert "cut_before" not in whole.summary["course"]
    fly_here(monkeypatch)
    swept = quadsim.sweep(short, {TURNS: [1.0, 2.0]}, workers=1, progress=False)
    assert swept.cut == 2


NORTH_EAST_DOWN = {"reference.height": -3.0, "effects.ground": {}}
"""A course for vehicles whose z points down, over a floor."""


def test_a_course_below_the_floor_is_named_before_it_crashes(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    scenario = load_scenario("hummingbird-figure-eight").replace(NORTH_EAST_DOWN | {"duration": 2.0})
    note = "The course is below the floor, by up to 3 m, from 1 s on: z points up here; where z points down, as in PX4"
    with caplog.at_level("INFO", logger="quadsim"):
        flight = run(scenario, out=tmp_path / "run", progress=False, **NO_PRODUCTS)
    assert any(record.message.startswith(note) for record in caplog.records)
    assert any(text.startswith(note) for text in flight.summary["course"]["notes"])


def test_a_flight_below_zero_without_a_floor_is_named_too() -> None:
    low = load_scenario("hummingbird-figure-eight").replace({"initial.position": [0.0, 0.0, -5.0]})
    (note,) = floor_notes(Assembly(low))
    assert "-5 m" in note


@pytest.mark.parametrize("name", scenario_names())
def test_no_flight_of_the_library_is_below_the_floor(name: str) -> None:
    assert floor_notes(assemble(name)) == ()


# --- a name is a name ----------------------------------------------------------------------------------------------


def test_a_folder_does_not_hide_a_scenario(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "hover").mkdir()
    short: dict[str, Any] = {"changes": {"duration": 0.1}, "progress": False}
    flight = run("hover", out="run", **short, **NO_PRODUCTS)
    assert flight.scenario.name == "hover"
    assert quadsim.check("hover", **short).satisfied
    with pytest.raises(InputError, match="directory"):
        load_scenario("run")
    (tmp_path / "hover").rmdir()
    (tmp_path / "run").rename(tmp_path / "hover")
    checked = quadsim.check("hover", progress=False)
    assert checked.directory == Path("hover"), "read, not flown"
    assert read_whole(tmp_path / "hover" / "scenario.toml")["duration"] == 0.1
