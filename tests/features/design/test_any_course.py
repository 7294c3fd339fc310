"""Any course on any vehicle, and its fastest speed: `quadsim scenario --for VEHICLE --course ANY --fastest`."""

from __future__ import annotations

import math
import tomllib
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import quadsim
from quadsim.assets import vehicle_path
from quadsim.errors import InputError, UnknownNameError
from quadsim.features.design.any_course import course_for, course_names
from quadsim.features.design.courses_by_rule import ALLOWED_SHARE, SHARE, eight_length
from quadsim.features.design.fastest import at_fastest, fly_fastest, paced
from quadsim.features.design.first_scenario import FirstScenario, first_scenario
from quadsim.features.design.rules import design_for
from quadsim.flight.audit import COMMAND_SIGNALS
from quadsim.scenarios.assembly import Assembly
from quadsim.scenarios.catalogue import scenario_names
from quadsim.scenarios.loading import load_scenario
from quadsim.scenarios.preflight import checked
from quadsim.vehicle import Vehicle, load_vehicle

UPSIDE_DOWN = ("inverted-start", "power-loop")
HUMMINGBIRD = load_vehicle(vehicle_path("hummingbird"))
CRAZYFLIE = load_vehicle(vehicle_path("crazyflie2"))


def made(course: str, vehicle: str = "crazyflie2", law: str = "robust", **options: Any) -> FirstScenario:
    loaded = load_vehicle(vehicle_path(vehicle))
    return first_scenario(loaded, vehicle, course=course_for(course, loaded, vehicle, law=law, **options), law=law)


@pytest.mark.parametrize("course", [name for name in course_names() if name not in UPSIDE_DOWN])
def test_every_course_of_the_library_is_made_for_a_vehicle(course: str) -> None:
    """Its parts fit together, its demands are within the vehicle's limits, and its heights above the ground."""
    first = made(course)
    assembly = checked(Assembly(first.scenario))
    scenario = assembly.scenario
    poses = assembly.reference(scenario.periods + 1)
    tuning = design_for(CRAZYFLIE)
    velocity = np.diff(poses[:, :3], axis=0) / scenario.control_period
    assert np.linalg.norm(velocity, axis=1).max() < 1.05 * tuning.fastest
    if not any(
        np.ptp(assembly.course.sample(np.array([jump - 1e-3, jump + 1e-3])), axis=0).any()
        for jump in assembly.course.jumps
    ):
        level = np.linalg.norm(np.diff(velocity[:, :2], axis=0), axis=1).max() / scenario.control_period
        assert level <= 1.2 * SHARE * CRAZYFLIE.gravity * tuning.acceleration
    if scenario.effects.ground is None:
        assert poses[:, 2].min() > CRAZYFLIE.enclosing_radius


@pytest.mark.parametrize(
    ("course", "vehicle"),
    [
        ("minimum-snap", "crazyflie2"),
        ("waypoints", "lopes2011"),
        ("csv-trefoil", "torrente2021"),
        ("helix", "hummingbird"),
    ],
)
def test_it_is_flown_within_every_bound(course: str, vehicle: str) -> None:
    assert quadsim.fly(made(course, vehicle).scenario, progress=False).outcome == "satisfied"


def test_lengths_are_scaled_by_the_extents_and_gaps_with_them() -> None:
    base = load_scenario("slalom")
    scenario = made("slalom").scenario
    ratio = CRAZYFLIE.enclosing_radius / HUMMINGBIRD.enclosing_radius
    for before, after in zip(base.obstacles, scenario.obstacles, strict=True):
        assert after.radius == pytest.approx(ratio * before.radius, rel=1e-3)
        assert after.position[0] == pytest.approx(ratio * before.position[0], rel=1e-3)
    assert scenario.controller.avoidance.margin == pytest.approx(ratio * 0.05, rel=1e-3)


def test_among_obstacles_it_asks_for_no_more_acceleration_than_was_stated() -> None:
    base = load_scenario("pillar")
    scenario = made("pillar").scenario
    ratio = CRAZYFLIE.enclosing_radius / HUMMINGBIRD.enclosing_radius
    slower = scenario.reference.start / base.reference.start
    assert slower >= math.sqrt(ratio) - 1e-3


def test_errors_are_allowed_what_the_vehicles_own_figure_eight_is() -> None:
    least = ALLOWED_SHARE * eight_length(CRAZYFLIE, design_for(CRAZYFLIE))
    bounds = {limit.name: (limit.lower, limit.upper) for limit in made("minimum-snap").scenario.constraints}
    for name in ("hold_x", "hold_y", "hold_z"):
        assert bounds[name] == (pytest.approx(-least, rel=0.01), pytest.approx(least, rel=0.01))


def test_bounds_stated_for_the_same_vehicle_stay(tmp_path: Path) -> None:
    file = tmp_path / "mine.toml"
    first = made("figure-eight", "hummingbird")
    file.write_text(first.text.replace("upper = 0.254", "upper = 0.1"), encoding="utf-8")
    again = made(str(file), "hummingbird").scenario
    assert load_scenario(file).constraints[1].upper == 0.1, "the text was changed"
    assert {limit.name: limit.upper for limit in again.constraints}["hold_x"] == 0.1
    assert again.reference.length == load_scenario(file).reference.length


def test_a_size_is_the_longest_side() -> None:
    for course in ("minimum-snap", "slalom", "waypoints"):
        first = made(course, size=3.0)
        poses = Assembly(first.scenario).course.sample(np.linspace(0.0, first.scenario.duration, 4000))
        assert np.ptp(poses[:, :3], axis=0).max() == pytest.approx(3.0, rel=2e-3)
    assert made("figure-eight", size=3.0).scenario.reference.length == 3.0
    assert made("step", size=0.5).scenario.reference.x[0].value == 0.5


def test_a_table_keeps_its_lengths_and_starts_at_its_first_row(tmp_path: Path) -> None:
    t = np.linspace(0.0, 8.0, 161)
    s = 10.0 * (t / 8.0) ** 3 - 15.0 * (t / 8.0) ** 4 + 6.0 * (t / 8.0) ** 5
    rows = np.column_stack([t, 3.0 + 4.0 * s, 0.0 * t, 2.0 + 0.0 * t])
    path = tmp_path / "line.csv"
    path.write_text(
        "t,x,y,z\n" + "\n".join(",".join(f"{value:.17e}" for value in row) for row in rows), encoding="utf-8"
    )
    scenario = made(str(path)).scenario
    assert scenario.initial.position == (3.0, 0.0, 2.0)
    assert scenario.reference.length_factor == 1.0
    assert quadsim.fly(scenario, progress=False).outcome == "satisfied"


@pytest.mark.parametrize(
    ("course", "options", "message"),
    [
        ("power-loop", {}, "--course must be one that stays upright"),
        ("inverted-start", {}, "--course must be one that stays upright"),
        ("slalom", {"law": "pid"}, "--course must be flown by --controller robust or nonlinear or rates"),
        ("hover", {"size": 2.0}, "--size must be absent with --course hover"),
        ("lost-rotor", {"size": 2.0}, "--size must be absent with --course lost-rotor, which does not move"),
        ("step", {"size": 0.0}, "--size must be between"),
        ("gone.csv", {}, "gone.csv: cannot be read"),
        ("gone.toml", {}, "gone.toml"),
    ],
)
def test_what_cannot_be_made_is_refused(course: str, options: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        made(course, **options)


def test_a_course_that_is_none_names_those_there_are() -> None:
    with pytest.raises(UnknownNameError, match="no course named 'slalon'") as caught:
        made("slalon")
    assert "did you mean 'slalom'" in str(caught.value)


def test_the_fastest_pace_was_flown_and_the_next_does_not_hold() -> None:
    first = made("figure-eight", "hummingbird")
    calls: list[tuple[str, int, int]] = []
    found = fly_fastest(first.scenario, 0.2, lambda *call: calls.append(call))
    assert found.fastest.holds
    assert not found.stopped.holds
    assert 1.0 < found.stopped.pace / found.fastest.pace <= 1.0101
    assert found.fastest.worst is not None
    assert found.fastest.worst.share >= 0.2
    assert len(calls) == len(found.flights)
    again = quadsim.fly(found.scenario, progress=False)
    assert again.outcome == "satisfied"
    shares = [finding.share for finding in again.findings if finding.limit.signal not in COMMAND_SIGNALS]
    assert min(shares) == pytest.approx(found.fastest.worst.share, abs=1e-9)
    faster = quadsim.fly(paced(first.scenario, found.stopped.pace), progress=False)
    shares = [finding.share for finding in faster.findings if finding.limit.signal not in COMMAND_SIGNALS]
    assert faster.outcome != "satisfied" or min(shares) < 0.2


def test_its_file_says_what_stops_it_and_flies_that_pace() -> None:
    first = made("figure-eight", "hummingbird")
    found = fly_fastest(first.scenario, 0.5)
    text = at_fastest(first, found).text
    head = text.partition("\n#\n")[0]
    assert head.splitlines()[1].endswith("--course figure-eight --fastest --margin 0.5")
    assert found.stopped.worst is not None
    assert found.stopped.worst.limit.name in head
    tables = tomllib.loads(text)
    assert tables["description"] == "hummingbird: a figure eight, as fast as its bounds permit"
    assert tables["reference"]["period"] == found.scenario.reference.period
    assert tables["reference"]["length"] == first.scenario.reference.length
    changed = [line for line in text.splitlines() if line.endswith("# at the fastest pace")]
    assert [line.split(" = ")[0] for line in changed] == ["start", "period", "ramp"]


def test_windows_and_moving_obstacles_keep_pace() -> None:
    scenario = made("thrown-ball", "hummingbird").scenario
    twice = paced(scenario, 2.0)
    assert twice.obstacles[0].velocity[0] == pytest.approx(2.0 * scenario.obstacles[0].velocity[0])
    assert twice.obstacles[0].start == pytest.approx(0.5 * scenario.obstacles[0].start)
    landing = made("take-off-and-landing").scenario
    half = paced(landing, 0.5)
    windows = {limit.name: limit.start for limit in landing.constraints}
    for limit in half.constraints:
        assert limit.start == pytest.approx(2.0 * windows[limit.name])
        assert limit.lower == {entry.name: entry.lower for entry in landing.constraints}[limit.name]


@pytest.mark.parametrize(
    ("course", "margin", "message"),
    [
        ("hover", 0.1, "--fastest needs a course that moves"),
        ("figure-eight", 1.5, "--margin must be between 0 and 0.9"),
    ],
)
def test_what_has_no_fastest_pace_is_refused(course: str, margin: float, message: str) -> None:
    with pytest.raises(InputError, match=message):
        fly_fastest(made(course).scenario, margin)


def test_options_that_need_each_other() -> None:
    with pytest.raises(InputError, match="--margin must be given with --fastest alone"):
        quadsim.scenario(vehicle="hummingbird", margin=0.2)
    with pytest.raises(InputError, match="--fastest must be given with --for alone"):
        quadsim.scenario("hover", fastest=True)
    with pytest.raises(InputError, match="--size must be given with --for alone"):
        quadsim.scenario("hover", size=2.0)


def test_a_vehicle_that_barely_turns_is_given_time() -> None:
    """Less torque about z, slower turns."""
    weak: Vehicle = replace(HUMMINGBIRD, drag_to_thrust=0.2 * HUMMINGBIRD.drag_to_thrust)
    strong_course = course_for("yaw-turns", HUMMINGBIRD, "hummingbird", law="robust")
    weak_course = course_for("yaw-turns", weak, "hummingbird", law="robust")
    assert weak_course.duration is not None
    assert strong_course.duration is not None
    assert weak_course.duration > 1.3 * strong_course.duration


def test_the_library_is_listed() -> None:
    assert set(scenario_names()) <= set(course_names())
    assert course_names()[:3] == ["hover", "step", "figure-eight"]
