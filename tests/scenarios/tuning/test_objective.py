"""Expressions of a flight's columns: arithmetic and nothing else."""

from __future__ import annotations

import math
from contextlib import suppress

import pytest
from hypothesis import given
from hypothesis import strategies as st

from quadsim.errors import InputError
from scenarios.tuning.objective import value_of

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
