"""Obstacles, corridors and the fence in scenarios: what is read, audited, touched, drawn and refused."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support import NO_PRODUCTS

from quadsim.console.summary_tables import outcome_line
from quadsim.controller import Phase
from quadsim.errors import FileError
from quadsim.flight.audit import Finding, SpaceLimit
from quadsim.report.figure import Scene, has_space, obstacles_in, outlines, region_edges
from quadsim.report.flight_figures import page_figures, write_figures
from quadsim.report.recording import write_recording
from quadsim.rollout.flown import Flight
from quadsim.rollout.reaudit import reaudit
from quadsim.rollout.rollout import Rollout
from quadsim.rollout.stored import read_flight
from quadsim.scenarios.loading import load_scenario
from quadsim.scenarios.schema.scenario import Scenario
from quadsim.scenarios.schema.writing import plain
from quadsim.space import Cylinder

PILLAR = {"type": "cylinder", "name": "pillar", "position": [1.0, 0.0, 1.0], "radius": 0.1, "height": 3.0}
BALL = {
    "type": "sphere", "name": "ball", "position": [0.5, 3.0, 1.0], "radius": 0.1, "start": 0.5,
    "velocity": [0.0, -2.0, 1.0], "acceleration": [0.0, 0.0, -1.0],
}  # fmt: skip
WALL = {
    "type": "wall", "name": "wall", "position": [2.5, 0.0, 1.0], "size": [0.1, 4.0, 2.0], "window": [1.4, 1.4],
    "yaw": 10.0,
}  # fmt: skip
LOG = {"type": "capsule", "name": "log", "position": [0.0, 2.0, 0.0], "axis": [1.0, 1.0, 0.0], "radius": 0.1}
CRATE = {
    "type": "box", "name": "crate", "position": [0.0, -2.0, 0.0], "size": [0.5, 0.5, 0.5],
    "path": [{"time": 1.0, "position": [1.0, -2.0, 0.0]}],
}  # fmt: skip
TUBE = {"name": "tube", "position": [0.0, 0.0, 1.0], "size": [3.0, 2.0, 2.0], "stop": 1.0}
FENCE = {"rows": [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]], "upper": [1.9, 2.0]}


def cleared(flight: Flight) -> list[Finding]:
    """What the audit found of obstacles and regions, beside the controller's bounds."""
    return [finding for finding in flight.findings if isinstance(finding.limit, SpaceLimit)]


def scenario(changes: Mapping[str, Any] = {}) -> Scenario:
    """Four seconds straight along x, from hover, among given obstacles."""
    base = load_scenario("hummingbird-figure-eight").replace(
        {"duration": 4.0, "constraints": [], "reference": {"type": "waypoints", "start": 0.5, "response_time": 0.5}}
        | {"reference": {"type": "waypoints", "start": 0.5, "points": [{"position": [2.0, 0.0, 1.0]}]}}
    )
    return base.replace(changes)


@pytest.fixture(scope="module")
def crashed() -> Flight:
    return Rollout(
        scenario({"obstacles": [PILLAR, BALL, WALL, LOG, CRATE], "corridors": [TUBE], "keep_in": FENCE})
    ).fly()


def test_tables_become_limits(crashed: Flight) -> None:
    limits = [finding.limit for finding in cleared(crashed)]
    assert [limit.name for limit in limits] == ["pillar", "ball", "wall", "log", "crate", "tube", "keep_in"]
    assert [(limit.start, limit.stop) for limit in limits[-2:]] == [(0.0, 1.0), (0.0, np.inf)]
    radius = crashed.vehicle.arm_length + (crashed.vehicle.rotor_radius or 0.0)
    assert all(isinstance(limit, SpaceLimit) and limit.radius == radius and limit.unit == "m" for limit in limits)
    again = Scenario.parse(plain(scenario({"obstacles": [PILLAR, CRATE], "keep_in": FENCE})))
    assert again.obstacles[0] == Cylinder(name="pillar", position=(1.0, 0.0, 1.0), radius=0.1, height=3.0)


def test_the_extent_is_the_vehicle_s_or_the_scenario_s() -> None:
    for extent, radius in ((0.4, 0.4), (0.05, 0.27)):  # the rotors reach 0.27 m
        (finding,) = cleared(Rollout(scenario({"obstacles": [PILLAR], "vehicle.extent": extent})).fly())
        assert isinstance(finding.limit, SpaceLimit)
        assert finding.limit.radius == pytest.approx(radius)


def test_a_touch_is_a_crash_at_the_distance_that_the_audit_measures(crashed: Flight) -> None:
    assert crashed.outcome == "violated"
    assert outcome_line(crashed).plain.startswith("crashed, touched pillar, a required constraint is violated")
    assert not cleared(crashed)[0].satisfied
    log = crashed.log
    limit = cleared(crashed)[0].limit
    clearance = limit.source.finest(log)[1]
    touch = log.plant.t[np.flatnonzero(clearance <= 0.0)[0]]
    first = log.control.t[log.control.phase.index(Phase.CRASHED)]
    period = crashed.scenario.control_period
    assert touch <= first <= touch + period + 1e-9
    assert clearance.min() > -0.02  # it bounces off


def test_obstacles_out_of_reach_change_nothing() -> None:
    """Steps are then taken one by one where they move; the numbers are those of a flight without."""
    far = {**PILLAR, "position": [50.0, 0.0, 1.0]}
    plain = Rollout(scenario()).fly()
    among = Rollout(scenario({"obstacles": [far]})).fly()
    np.testing.assert_allclose(among.log.plant.state, plain.log.plant.state, rtol=0.0, atol=1e-9)
    assert among.outcome == "satisfied"


@pytest.mark.usefixtures("undrawn")
def test_a_run_with_shapes_is_read_audited_again_and_drawn(crashed: Flight, tmp_path: Path) -> None:
    directory = tmp_path / "run"
    directory.mkdir()
    crashed.save(directory, **NO_PRODUCTS)
    run = read_flight(directory)
    assert run.limits == tuple(finding.limit for finding in crashed.findings)
    assert not reaudit(directory).satisfied
    assert {path.stem for path in write_figures(run, tmp_path / "figures")} >= {"space"}
    (scene,) = [figure for figure in page_figures([run]) if isinstance(figure, Scene)]
    assert len(scene.solids) == 8, "four of the wall"
    write_recording(run, tmp_path / "flight.rrd")
    assert has_space(run.limits)
    assert [len(edges) for _, edges in region_edges(run.limits, run.log)] == [12, 12]
    (outline,) = outlines(obstacles_in(run.limits)[0], 0.0)
    np.testing.assert_allclose(np.linalg.norm(outline - [1.0, 0.0], axis=1), 0.1)


def test_a_shape_that_was_changed_is_noticed(crashed: Flight, tmp_path: Path) -> None:
    crashed.save(tmp_path, **NO_PRODUCTS)
    text = (tmp_path / "summary.json").read_text()
    (tmp_path / "summary.json").write_text(text.replace('"radius": 0.1,', '"radius": 0.2,', 1))
    with pytest.raises(FileError, match="shape"):
        reaudit(tmp_path)


AVOIDANCE = {"controller.output_bounds": {"roll": [-30.0, 30.0], "pitch": [-30.0, 30.0]}, "controller.avoidance": {}}


def test_the_robust_controller_keeps_clear_in_any_heading() -> None:
    robust = {
        "type": "robust", "horizon": 30, "soft": {}, "offset_free": {}, "heading": True,
        "output_weights": {"x": 10.0, "y": 10.0, "z": 100.0, "yaw": 100.0}, "input_weights": {"speed": 9e-4},
        "output_bounds": AVOIDANCE["controller.output_bounds"],
        "input_bounds": {"speed": [0.0, 838.0], "slew": [-80.0, 80.0]}, "avoidance": {"soft": {}},
        "tightening": {"acceleration": 0.2, "angular_acceleration": 0.2},
    }  # fmt: skip
    among = {"obstacles": [{**PILLAR, "position": [1.0, 0.2, 1.0]}], "initial.euler": [0.0, 0.0, 40.0]}
    flight = Rollout(scenario({**among, "controller": robust})).fly()
    assert flight.outcome == "satisfied"
    assert 0.04 < cleared(flight)[0].worst_margin < 0.3
    assert abs(flight.state["y"]).max() > 0.1


@pytest.mark.slow("obstacles")
@pytest.mark.parametrize(
    "more",
    [
        pytest.param({}, marks=pytest.mark.representative("obstacles")),
        {"node": 0.1, "iterations": 2},
        {"rotor_lag": 0.02, "offset_free": {}},
    ],
)
def test_the_nonlinear_controller_keeps_clear(more: Mapping[str, Any]) -> None:
    nonlinear = {"type": "nonlinear", "horizon": 30, "terminal": "lqr", "avoidance": {"soft": {}}, **more}
    pillar = {"obstacles": [{**PILLAR, "position": [1.0, 0.2, 1.0]}]}
    flight = Rollout(scenario({**pillar, "controller": nonlinear})).fly()
    assert flight.outcome == "satisfied"
    assert 0.03 < cleared(flight)[0].worst_margin < 0.3
    assert abs(flight.state["y"]).max() > 0.1


OFFSET = {"name": "offset", "rows": [[0.0, -1.0, 0.0]], "upper": [-0.4]}  # y >= 0.4, the vehicle's ball inside


@cache
def blind(speed: float) -> Flight:
    """A flight along the path that knows nothing of its corridor; over soon after the path."""
    return Rollout(scenario(offset_at(speed))).fly()


def offset_at(speed: float) -> dict[str, Any]:
    duration = 0.1 * round(10.0 * (2.0 / speed + 2.0))
    return {"corridors": [{**OFFSET, "path": [0.9, 1.3]}], "reference.speed": speed, "duration": duration}


@pytest.mark.slow("obstacles")
@pytest.mark.parametrize(
    ("law", "speed"),
    [
        pytest.param("constrained", 0.5, marks=pytest.mark.representative("obstacles")),
        ("constrained", 0.8),
        ("robust", 0.5),
        ("nonlinear", 0.8),
    ],
)
def test_a_corridor_along_the_path_holds_where_the_reference_is(law: str, speed: float) -> None:
    laws: dict[str, dict[str, Any]] = {
        "constrained": AVOIDANCE,
        "robust": {"controller.type": "robust", "controller.solver": None, **AVOIDANCE},
        "nonlinear": {"controller": {"type": "nonlinear", "horizon": 30, "terminal": "lqr", "avoidance": {}}},
    }
    unaware = blind(speed)
    (result,) = [each for each in unaware.findings if each.limit.name == "offset"]
    reference = unaware.log.control.reference[:, :3]
    gone = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(reference, axis=0), axis=1))])
    inside = result.limit.holds_at(unaware.log.control.t)
    np.testing.assert_array_equal(inside, (gone >= 0.9) & (gone <= 1.3))
    assert inside.any()
    assert not result.satisfied
    flight = Rollout(scenario({**offset_at(speed), **laws[law]})).fly()
    (result,) = [each for each in flight.findings if each.limit.name == "offset"]
    assert result.satisfied
    assert abs(flight.state["y"][[0, -1]]).max() < 0.1  # offset there alone


def test_who_does_not_avoid_touches_and_who_does_keeps_clear() -> None:
    pillar = {"obstacles": [{**PILLAR, "position": [1.0, 0.2, 1.0]}]}
    assert Rollout(scenario(pillar)).fly().log.control.crashed
    flight = Rollout(scenario({**pillar, **AVOIDANCE})).fly()
    assert flight.outcome == "satisfied"
    assert cleared(flight)[0].worst_margin > 0.04  # of a margin of 0.05, between the samples


@pytest.mark.slow("obstacles")
def test_no_answer_among_obstacles_is_explained_by_their_names() -> None:
    thrown = {
        **BALL,
        "radius": 2.0,
        "position": [0.0, 4.5, 1.0],
        "velocity": [0.0, -9.0, 0.0],
        "acceleration": [0.0] * 3,
    }
    flight = Rollout(scenario({"obstacles": [thrown], **AVOIDANCE, "controller.fallback": {}})).fly()
    assert flight.diagnosis is not None
    assert "cannot hold together" in flight.diagnosis["sentence"]
    assert "obstacle ball" in flight.diagnosis["sentence"]
    assert any("controller.avoidance.soft" in each["settings"] for each in flight.diagnosis["suggestions"])
