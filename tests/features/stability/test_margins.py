"""Margins: the search, laws with a known margin, loops without margins, and what the command says and writes."""

from __future__ import annotations

import functools
import json
import math
from pathlib import Path

import numpy as np
import pytest
import scaled_laws
from support import draw_nothing, fly_here

import quadsim
from quadsim.commands.cli import main
from quadsim.errors import InputError, OutputError, ParameterError, UnknownNameError
from quadsim.features.stability.margins import (
    BRACKET_WIDTH,
    LoopPoint,
    MarginSide,
    MeasuredLoop,
    find_side,
    measure_point,
)
from quadsim.features.stability.quantities import VARIED, point
from quadsim.rollout.growth import SIZE
from quadsim.scenarios.assembly import Assembly
from quadsim.scenarios.loading import load_scenario
from quadsim.scenarios.schema.scenario import Scenario


@pytest.fixture(autouse=True)
def _here(monkeypatch: pytest.MonkeyPatch) -> None:
    fly_here(monkeypatch)
    draw_nothing(monkeypatch)


@pytest.fixture
def hummingbird() -> Scenario:
    return load_scenario("hummingbird-figure-eight")


# --- the search ----------------------------------------------------------------------------------------------------


def side_of(stable: object, *, end: float = 100.0, geometric: bool = False, step: float = 0.0) -> MarginSide:
    """Search for the end of what a function says is stable, outwards from 0, or from 1 where equal factors count."""
    start = 1.0 if geometric else 0.0
    quantity = VARIED["mass" if geometric else "delay"]

    def at(value: float) -> LoopPoint:
        return LoopPoint(values={"delay": value}, state="stable" if stable(value) else "unstable")  # type: ignore[operator]

    return find_side(at, lambda share: quantity.between(start, end, share, step), geometric=geometric)


@pytest.mark.parametrize("margin", [3.0, 17.3, 50.0, 99.0])
def test_the_bracket_holds_the_margin_to_its_width(margin: float) -> None:
    side = side_of(lambda value: value < margin)
    assert side.unstable is not None
    assert side.stable < margin <= side.unstable
    assert side.unstable - side.stable <= BRACKET_WIDTH * side.unstable


@pytest.mark.parametrize("margin", [1.05, 1.9, 7.0])
def test_the_bracket_of_a_factor_is_a_share_of_its_value(margin: float) -> None:
    side = side_of(lambda value: value < margin, end=8.0, geometric=True)
    assert side.unstable is not None
    assert side.stable < margin <= side.unstable
    assert side.unstable / side.stable <= math.exp(BRACKET_WIDTH)


def test_what_is_stable_again_beyond_an_unstable_value_is_not_taken_for_stable() -> None:
    side = side_of(lambda value: value < 20.0 or value > 60.0)
    assert side.stable < 20.0 <= (side.unstable or math.inf)


def test_a_loop_that_is_stable_to_the_end_has_no_unstable_value() -> None:
    side = side_of(lambda value: True)
    assert (side.stable, side.unstable, side.state) == (100.0, None, "stable")


def test_values_of_whole_steps_end_the_search_one_step_apart() -> None:
    side = side_of(lambda value: value < 7.0, step=1.0)
    assert (side.stable, side.unstable) == (6.0, 7.0)
    assert all(looked.values["delay"] == round(looked.values["delay"]) for looked in side.points)


# --- quantities ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", [*VARIED])
def test_each_quantity_changes_what_it_says(name: str) -> None:
    nominal = Assembly(load_scenario("hummingbird-real-rotors"))
    quantity = VARIED[name]
    value = quantity.nominal(nominal)
    heading, changes = point(nominal, {name: value})
    assert (heading, changes) == (0.0, {})
    other = quantity.between(value, quantity.ends(value)[1], 0.1, quantity.step(nominal))
    heading, changes = point(nominal, {name: other})
    period = changes.get("control_period", nominal.scenario.control_period)
    changed = Assembly(nominal.scenario.replace(changes | {"duration": 40.0 * period}))
    assert (heading != 0.0) == (name == "heading")
    measured = {
        "delay": lambda: 1e3 * changed.scenario.computation.delay if changed.scenario.computation else 0.0,
        "lag": lambda: 1e3 * (changed.effects.rotors.rise or 0.0) if changed.effects.rotors else 0.0,
        "mass": lambda: changed.actual.mass / nominal.actual.mass,
        "thrust": lambda: changed.actual.mean_coefficient / nominal.actual.mean_coefficient,
        "inertia": lambda: changed.actual.inertia[0] / nominal.actual.inertia[0],
        "period": lambda: 1e3 * changed.scenario.control_period,
        "drag": lambda: changed.effects.air.linear_drag[0] / changed.actual.mass if changed.effects.air else 0.0,
        "tilt": lambda: (
            math.degrees(math.atan2(-changed.effects.disturbance.force[0], weight(changed)))
            if changed.effects.disturbance
            else 0.0
        ),
        "heading": lambda: heading,
    }
    assert measured[name]() == pytest.approx(other, rel=1e-9)
    if name != "mass":
        assert changed.vehicle == nominal.vehicle, "the law's model stays"


def weight(assembly: Assembly) -> float:
    return assembly.actual.mass * assembly.actual.gravity


def test_the_nominal_heading_is_the_one_that_the_course_has_most() -> None:
    """The paper's course starts at 30 deg and is to turn to 0."""
    assembly = Assembly(load_scenario("paper-constrained"))
    assert math.degrees(assembly.initial_pose[3]) == pytest.approx(30.0)
    assert VARIED["heading"].nominal(assembly) == 0.0


# --- loops ---------------------------------------------------------------------------------------------------------


def test_a_law_of_ones_own_has_the_margin_of_its_gain(hummingbird: Scenario) -> None:
    """Rotors of `thrust` times the force at a speed multiply the gain by the root of that, in hover."""
    law = functools.partial(scaled_laws.ScaledGain, factor=3.0)
    found = quadsim.stability(hummingbird, controller=law, over=["thrust"], progress=False).loops[0]
    built = scaled_laws.ScaledGain(Assembly(hummingbird).vehicle, hummingbird.control_period, 1, factor=3.0)
    A = built.model.A
    B = built.model.B
    K = built.gain

    def radius(thrust: float) -> float:
        return float(np.abs(np.linalg.eigvals(A - math.sqrt(thrust) * B @ K)).max())

    upper = found.margins["thrust"].upper
    assert found.name == "ScaledGain"
    assert upper is not None
    assert upper.unstable is not None
    assert radius(0.98 * upper.stable) < 1.0 < radius(1.02 * upper.unstable)
    assert found.closest is not None
    assert found.closest.quantity == "thrust"


def test_a_loop_that_diverges_at_its_nominal_point_has_no_margins() -> None:
    """At a heading of 60 deg; the rate is that of the eigenvalues of A(60 deg) - B K."""
    turned = {"reference": {"type": "yaw_turns", "turns": [{"start": 0.0, "yaw": 60.0, "rate": 30.0}]}}
    scenario = load_scenario("paper-constrained").replace(
        turned | {"initial.euler": [0.0, 0.0, 60.0], "duration": 10.0, "constraints": []}
    )
    found = quadsim.stability(scenario, over=["delay"], size=0.1, progress=False)
    assert [loop.size for loop in found.loops] == [SIZE, 0.1]
    assert [loop.growth.verdict for loop in found.loops] == ["unstable", "unstable"]
    assert found.loops[0].growth.rate == pytest.approx(1.287, rel=0.05)
    assert [loop.margins for loop in found.loops] == [{}, {}]
    assert found.loops[0].closest is None
    assert "grows 3.6" in found.text()
    assert "no margins" in found.text()
    assert "constrained, 0.1 m/s" in found.text()


def test_a_loop_that_leaves_its_heading_alone_is_neither_stable_nor_unstable(hummingbird: Scenario) -> None:
    found = quadsim.stability(hummingbird, controller=scaled_laws.FreeHeading, over=["delay"], progress=False)
    assert found.loops[0].growth.verdict == "neutral"
    assert found.loops[0].margins == {}
    assert "neither" in found.text()


def test_a_law_that_raises_is_said_and_has_no_margins(hummingbird: Scenario) -> None:
    found = quadsim.stability(hummingbird, controller=scaled_laws.RaisesLater, over=["delay"], progress=False)
    growth = found.loops[0].growth
    assert growth.verdict == "unstable"
    assert growth.ended.endswith("RuntimeError: no answer for this")
    assert found.loops[0].margins == {}
    assert growth.ended in found.text()


def test_a_law_that_cannot_be_built_is_refused(hummingbird: Scenario) -> None:
    with pytest.raises(InputError, match="not today"):
        quadsim.stability(hummingbird, controller=scaled_laws.RaisesAtOnce, over=["delay"], progress=False)


def test_where_the_vehicle_cannot_hover_is_the_end_and_is_said() -> None:
    found = quadsim.stability("paper-unconstrained", over=["mass"], progress=False)
    upper = found.loops[0].margins["mass"].upper
    vehicle = quadsim.load_vehicle(load_scenario("paper-unconstrained").vehicle.file)
    heaviest = (vehicle.speed_max / vehicle.hover_speed) ** 2
    assert upper is not None
    assert upper.unstable is not None
    assert upper.stable < heaviest < upper.unstable
    assert upper.state == "no flight"
    assert "hover" in upper.why
    assert "hover" in found.text()
    assert found.loops[0].closest is None, "what cannot be flown is no limit of stability"


def test_a_larger_push_does_not_reach_as_far() -> None:
    """A tilt of 4 deg leaves the paper's controller 1 deg."""
    scenario = load_scenario("paper-constrained")
    small = MeasuredLoop(name="", scenario=scenario, size=SIZE)
    large = MeasuredLoop(name="", scenario=scenario, size=2.0)
    assert measure_point(small, {"tilt": 4.0}).state == "stable"
    assert measure_point(large, {"tilt": 4.0}).state == "unstable"


@pytest.mark.slow("stability")
@pytest.mark.representative("stability")
def test_two_controllers_stand_side_by_side(hummingbird: Scenario, tmp_path: Path) -> None:
    found = quadsim.stability(
        hummingbird, controller=["constrained", "lqr"], over=["delay"], out=tmp_path / "both", progress=False
    )
    assert [loop.name for loop in found.loops] == ["constrained", "lqr"]
    head = found.grid.head
    assert head == ("quantity", "nominal", "constrained: from", "to", "lqr: from", "to")
    files = {path.name for path in (tmp_path / "both").iterdir()}
    assert files == {"summary.json", "stability.md", "stability.png"}
    data = json.loads((tmp_path / "both" / "summary.json").read_text(encoding="utf-8"))
    assert data.pop("files").keys() == files - {"summary.json"}
    assert data == json.loads(json.dumps(found.to_json()))
    with pytest.raises(OutputError):
        quadsim.stability(hummingbird, over=["delay"], out=tmp_path / "both", progress=False)


@pytest.mark.slow("stability")
def test_a_map_is_stable_at_the_nominal_point_and_not_beyond_both_margins(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """A second, larger push has a map of its own."""
    for module in ("margins", "report"):
        monkeypatch.setattr(f"quadsim.features.stability.{module}.MAP_POINTS", 3)
    options = {"over": ["delay"], "map": ["delay", "lag"], "size": 0.1, "out": tmp_path / "maps"}
    found = quadsim.stability("paper-unconstrained", **options, progress=False)  # type: ignore[arg-type]
    assert [each.size for each in found.maps] == [0.001, 0.1]
    assert len([*(tmp_path / "maps").glob("map-*.png")]) == 2
    assert found.maps[0].quantities == ("delay", "lag")
    states = [looked.state for looked in found.maps[0].points]
    assert len(states) == 9
    assert states[0] == "stable"
    assert states[-1] == "unstable"
    assert "delay [ms] across, lag [ms] up" in " ".join(found.text().split())


def test_the_heading_of_the_nominal_hover_can_be_chosen() -> None:
    """A course at 60 deg, under a law that is stable to 46 deg."""
    turned = {"reference": {"type": "yaw_turns", "turns": [{"start": 0.0, "yaw": 60.0, "rate": 30.0}]}}
    scenario = load_scenario("paper-unconstrained").replace(turned | {"duration": 10.0})
    chosen = quadsim.stability(scenario, over=["drag"], heading=10.0, progress=False).loops[0]
    assert chosen.growth.verdict == "stable"
    with pytest.raises(ParameterError, match="--heading"):
        quadsim.stability(scenario, heading=270.0)


# --- wrong input ---------------------------------------------------------------------------------------------------


def test_wrong_names_are_refused() -> None:
    with pytest.raises(UnknownNameError, match="no quantity named 'weight'"):
        quadsim.stability("hover", over=["weight"])
    with pytest.raises(ParameterError, match="two different quantities"):
        quadsim.stability("hover", map=["delay"])
    with pytest.raises(ParameterError, match="--size"):
        quadsim.stability("hover", size=0.0)
    with pytest.raises(InputError, match="no scenario named 'nope'"):
        quadsim.stability("hover", controller="nope")


def test_the_command_prints_json_alone(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["stability", "hover", "--over", "heading", "--set", "controller=lqr", "--json"]) == 0
    data = json.loads(capsys.readouterr().out)
    assert data["loops"][0]["margins"]["heading"]["unit"] == "deg"
