"""Tuning files: every wrong field refused by its name, and objectives that are arithmetic and nothing else."""

from __future__ import annotations

import copy
import math
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from tuning_formula import TUNING, write_tuning

from quadsim.errors import InputError
from scenarios.catalogue import tuning_names
from scenarios.tuning.tuning_plan import load_tuning, value_of


def entry(**changes: Any) -> list[dict[str, Any]]:
    """`[[search]]` with its first entry changed."""
    return [{**TUNING["search"][0], **changes}, TUNING["search"][1]]


def campaign(**changes: Any) -> dict[str, Any]:
    return {**copy.deepcopy(TUNING["campaign"]), **changes}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"trials": 7}, "trials must be a multiple of batch, 6; got 7"),
        ({"flights": [4, 4]}, r"flights must rise; got \[4, 4\]"),
        ({"fresh": {"seed": 0}}, "fresh.seed must not be seed, 0, whose draws choose the answer"),
        ({"require": "P(violation) > 0.2 @ 50%"}, "require: .* must keep a probability small, with < or <="),
        ({"require": "never"}, r"require: requirement 'never' must read P\(EVENT\)"),
        ({"require": "P(rmse.q > 1) < 0.1 @ 90%"}, "require: no column named 'rmse.q'"),
        ({"guard": "rmse.q > 1"}, "guard: no column named 'rmse.q'"),
        (
            {"search": entry(distribution="normal")},
            "search.speed.distribution must be one of 'uniform', 'log_uniform', 'integer'",
        ),
        ({"search": entry(fields=["controller.input_weights.sped"])}, "search.speed at 0.0001: .*sped is not a field"),
        ({"search": entry(fields=["seed"])}, "search.speed.fields must not have seed"),
        ({"search": entry(fields=["effects.load.mass_factor"])}, "must not have effects.load.mass_factor, which mass"),
        ({"search": entry(name="z")}, r"search must have distinct names; got \['z', 'z'\]"),
        ({"objectives": [{"name": "e", "expression": "verdict"}]}, "objectives.e.expression: no column of numbers"),
        ({"objectives": [{"name": "e", "expression": "rmse.x +"}]}, "e.expression: .* must be arithmetic on"),
        ({"objectives": 3 * TUNING["objectives"]}, "objectives must be a list of 1 to 2 entries; got "),
        ({"campaign": campaign(seed=3)}, "campaign.seed must be absent: a tuning has its own"),
        ({"campaign": campaign(base="papers")}, "no campaign named 'papers'"),
        ({"campaign": campaign(scenario="hove")}, "no scenario named 'hove'; did you mean 'hover'"),
        ({"campaign": campaign(failure=["fell"])}, "campaign: failure has an entry 'fell' that is no event"),
        (
            {"search": entry(fields=["controller.input_bounds.speed.1"])},
            "search.speed.fields must be of fields that leave",
        ),
        ({"trails": 3}, "trails is not a field of the tuning file; did you mean 'trials'"),
    ],
)
def test_a_wrong_field_is_refused_by_its_name(tmp_path: Path, changes: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        load_tuning(str(write_tuning(tmp_path, **changes)))


@pytest.mark.parametrize("name", tuning_names())
def test_those_that_ship_can_be_flown(name: str) -> None:
    plan = load_tuning(name)
    assert plan.spec.name == name
    assert set(plan.start_values) == {each.name for each in plan.spec.search}


def test_a_file_may_hold_only_what_differs(tmp_path: Path) -> None:
    write_tuning(tmp_path, campaign=campaign(base="held.toml"))
    (tmp_path / "held.toml").write_text('base = "paper-nominal"\nname = "held"\nfailure = ["lost"]\n', encoding="utf-8")
    (tmp_path / "shorter.toml").write_text('base = "little.toml"\ntrials = 12\n', encoding="utf-8")
    result = load_tuning(str(tmp_path / "shorter.toml"))
    assert (result.spec.trials, result.spec.batch, result.spec.name) == (12, 6, "little")
    assert result.start.spec.failure == ["lost"]
    assert [each.name for each in result.start.spec.vary][-1] == "pitch"


def test_a_file_written_out_is_the_same_tuning(tmp_path: Path) -> None:
    plan = load_tuning(str(write_tuning(tmp_path)))
    (tmp_path / "again.toml").write_text(plan.to_toml(), encoding="utf-8")
    (tmp_path / "scenario.toml").write_text(plan.start.scenario.to_toml(), encoding="utf-8")
    again = load_tuning(str(tmp_path / "again.toml"))
    assert again.start.scenario == plan.start.scenario
    assert again.to_toml() == plan.to_toml()


ROW = {"rmse.x": 3.0, "rmse.y": 4.0, "peak_tilt": -2.0, "fallback_periods": 2, "lost": None, "violated": True}


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("sqrt(rmse.x**2 + rmse.y**2)", 5.0),
        ("-rmse.x * 2 - (1 - rmse.y) / 2", -4.5),
        ("max(rmse.x, rmse.y, peak_tilt) + min(1, 2) + abs(peak_tilt)", 7.0),
        ("fallback_periods + violated", 3.0),
    ],
)
def test_values(text: str, value: float) -> None:
    assert value_of(text, ROW) == pytest.approx(value)


@pytest.mark.parametrize("text", ["lost", "1 / (rmse.x - 3)", "9.9**9**9", "peak_tilt**0.5"])
def test_what_has_no_finite_value_is_nan(text: str) -> None:
    assert math.isnan(value_of(text, ROW))


@pytest.mark.parametrize(
    "text",
    ["__import__('os')", "rmse.x if 1 else 2", "[1]", "'text'", "1 < 2", "sqrt()", "max(1, key=2)", "sqrt.x(1)", ""],
)
def test_what_is_no_arithmetic_is_refused(text: str) -> None:
    with pytest.raises(InputError, match=r"must be|no column of numbers"):
        value_of(text, ROW)


@given(st.text(max_size=40))
def test_any_text_is_an_expression_or_refused(text: str) -> None:
    with suppress(InputError):
        assert isinstance(value_of(text, ROW), float)
