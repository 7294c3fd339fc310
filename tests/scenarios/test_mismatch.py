"""A plant whose rotors lag, under a controller that predicts none: one line says so."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

import quadsim
from quadsim.commands.cli import main
from quadsim.scenarios.assembly import Assembly
from quadsim.scenarios.loading import load_scenario
from quadsim.scenarios.mismatch import model_notes

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
