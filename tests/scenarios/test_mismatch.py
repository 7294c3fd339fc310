"""A plant whose rotors lag, under a controller that predicts none: one line says so."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

import quadsim
from quadsim.commands.cli import main
from quadsim.rollout.infeasibility import changed_scenario
from quadsim.scenarios.assembly import Assembly
from quadsim.scenarios.loading import load_scenario
from quadsim.scenarios.mismatch import model_notes, unmodelled, unpredicted

LAG = {"effects.rotors": {"rise": 0.02, "fall": 0.02}}
REMEDY = 'controller.rotor_lag = "vehicle"'


@pytest.mark.parametrize(
    ("name", "changes", "note"),
    [
        ("hover", {}, None),
        ("hover", {"effects.rotors": {}}, None),  # worn or not, they follow at once
        (
            "paper-constrained-lag20",
            {},
            'the rotors lag by 20 ms, and constrained predicts none; to predict it: controller.type = "robust" or '
            f'"nonlinear", vehicle.rotor_rise = 0.02, {REMEDY}',
        ),
        (
            "hummingbird-real-rotors",
            {},
            'the rotors lag by 12.5 ms, and constrained predicts none; to predict it: controller.type = "robust" or '
            f'"nonlinear", {REMEDY}',
        ),
        (
            "robust",
            LAG,
            f"the rotors lag by 20 ms, and robust predicts none; to predict it: vehicle.rotor_rise = 0.02, {REMEDY}",
        ),
        ("robust", {**LAG, "controller.rotor_lag": 0.02}, None),
        ("robust-lag50", {}, None),
        ("playground", {}, None),
        (
            "playground",
            {"controller.rotor_lag": 0.0},
            f"the rotors lag by 12.5 ms, and robust predicts none; to predict it: {REMEDY}",
        ),
        ("hover", {"controller": "pid", **LAG}, None),  # it predicts nothing
        (
            "robust",
            {"actual": {"rotor_rise": 0.03, "rotor_fall": 0.03}},
            f"the rotors lag by 30 ms, and robust predicts none; to predict it: vehicle.rotor_rise = 0.03, {REMEDY}",
        ),
    ],
)
def test_a_lag_that_is_not_predicted_is_noted(name: str, changes: dict[str, Any], note: str | None) -> None:
    assert model_notes(Assembly(load_scenario(name, changes))) == ([] if note is None else [note])


def test_the_remedy_is_a_change_that_can_be_made() -> None:
    """As named for the paper's controller, with softened bounds, so that the note is gone."""
    settings = ["controller.type=robust", "vehicle.rotor_rise=0.02", "controller.rotor_lag=vehicle"]
    scenario = load_scenario("robust", [*settings, "effects.rotors={rise=0.02, fall=0.02}"])
    assert model_notes(Assembly(scenario)) == []


def test_it_is_printed_and_in_the_summary_where_that_controller_flew(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    products = ("--no-video", "--no-recording", "--no-figures")
    main(["run", "paper-constrained-lag20", "--set", "duration=0.2", *products, "--out", str(tmp_path / "run")])
    assert "the rotors lag by 20 ms, and constrained predicts none" in " ".join(capsys.readouterr().out.split())
    scenario = load_scenario("paper-constrained-lag20").replace({"duration": 0.2})
    assert len(quadsim.fly(scenario, progress=False).summary["model_notes"]) == 1
    own = quadsim.fly(scenario, controller=lambda now, state, reference: [205.0] * 4, progress=False)
    assert "model_notes" not in own.summary


WINDY = {"effects.air": {"wind": [6.0, 0.0, 0.0]}}
PUSHED = {"effects.disturbance": {"force": [0.5, 0.0, 0.0]}}
NONLINEAR: dict[str, Any] = {"controller": "nonlinear"}


@pytest.mark.parametrize(
    ("name", "changes", "expected"),
    [
        ("hover", {}, {}),
        ("hover", WINDY, {"wind": {"controller.type": "robust", "controller.offset_free": {}}}),
        ("robust", PUSHED, {}),  # it estimates one
        ("robust", {**PUSHED, "controller.offset_free": None}, {"a disturbance": {"controller.offset_free": {}}}),
        ("hover", {"controller": "pid", **WINDY}, {}),  # it has no field for it
        ("hover", NONLINEAR | WINDY | PUSHED, {"wind and a disturbance": {"controller.disturbance": {}}}),
        (
            "hover",
            NONLINEAR | {"effects.air": {"linear_drag": [0.3, 0.2, 0.1]}},
            {"drag": {"controller.drag": [0.3, 0.2, 0.1]}},
        ),
        (
            "hover",
            {
                "controller": {"type": "nonlinear", "drag": [0.3, 0.2, 0.1]},
                "effects.air": {"linear_drag": [0.3, 0.2, 0.1]},
            },
            {},
        ),
    ],
)
def test_effects_that_a_law_has_a_field_for_are_named(
    name: str, changes: dict[str, Any], expected: dict[str, dict[str, Any]]
) -> None:
    """Each field is one that the scenario takes, and with it the law lacks that effect no more."""
    scenario = load_scenario(name).replace(changes)
    found = unpredicted(Assembly(scenario))
    assert {entry.text: entry.settings for entry in found} == expected
    for entry in found:
        changed = changed_scenario(scenario, dict(entry.settings))
        assert changed is not None
        assert entry.text not in [left.text for left in unpredicted(Assembly(changed))]
        still = scenario.replace(entry.absent)
        assert unpredicted(Assembly(still)) == ()


@pytest.mark.parametrize("number", [{"rate_damping": [0.01, 0.01, 0.01]}, {"inflow": 1e-3}])
@pytest.mark.parametrize(
    ("name", "controller", "settings"),
    [
        ("hover", {"controller": "nonlinear"}, {}),
        ("robust", {}, {}),
        ("hover", {"controller": "lqr"}, {}),
        ("hover", {"controller": "pid"}, {}),
        ("hover", {"controller": "geometric"}, {"controller.feedforward": True}),
        ("paper-constrained", {}, {"controller.type": "robust"}),
    ],
)
def test_moments_of_the_air_are_named_where_the_vehicle_has_their_numbers(
    name: str, controller: dict[str, Any], settings: dict[str, Any], number: dict[str, Any]
) -> None:
    """A law with the field set lacks them no more; nor does one of rates, whose inner loop balances them."""
    moments = {f"vehicle.{field}": value for field, value in number.items()}
    scenario = load_scenario(name).replace(controller | {"effects.air": {}} | moments)
    (found,) = [entry for entry in unpredicted(Assembly(scenario)) if entry.text == "moments of the air"]
    assert found.settings == {"controller.moment": True} | settings
    known = changed_scenario(scenario, dict(found.settings))
    assert known is not None
    assert "moments of the air" not in [entry.text for entry in unpredicted(Assembly(known))]


def test_a_law_of_rates_leaves_moments_of_the_air_to_its_inner_loop() -> None:
    moments = {"effects.air": {}, "vehicle.rate_damping": [0.01, 0.01, 0.01]}
    rates = {"controller": {"type": "nonlinear", "commands": "rates"}, "autopilot": {}}
    assert unpredicted(Assembly(load_scenario("hover").replace(rates | moments))) == ()


@pytest.mark.parametrize(
    ("name", "changes"),
    [
        ("hover", {"computation": {"delay": 0.03}}),
        ("paper-constrained-lag20", {}),
        ("crazyflie-real-rotors", {}),
        ("hover", NONLINEAR | {"actual": {"rotor_rise": 0.03, "rotor_fall": 0.03}}),
        ("paper-unconstrained", {"computation": {"delay": 0.03}, "effects.rotors": LAG["effects.rotors"]}),
        ("hover", {"controller": "pid", "computation": {"delay": 0.03}}),
        ("hover", {"actual.mass": 4.2}),
    ],
)
def test_what_is_lacking_is_gone_without_it_and_with_its_fields(name: str, changes: dict[str, Any]) -> None:
    scenario = load_scenario(name).replace(changes)
    lacking = unmodelled(Assembly(scenario))
    assert lacking != ()
    for entry in lacking:
        texts = [other.text for other in unmodelled(Assembly(scenario.replace(entry.absent)))]
        assert texts == [other.text for other in lacking if other is not entry]
        changed = changed_scenario(scenario, dict(entry.settings))
        assert changed is not None
        assert entry.text not in [left.text for left in unmodelled(Assembly(changed))]
