"""What a file holds is held against its form once, and named where it has another."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from quadsim.errors import FileError
from quadsim.flight.form import MAYBE_NUMBER, NUMBER, Each, Optional, misfits, read_json

FORM: dict[str, Any] = {
    "name": str,
    "size": NUMBER,
    "count": int,
    "peak": MAYBE_NUMBER,
    "rows": [{"t": NUMBER}],
    "errors": Each(NUMBER),
    "note": Optional(str),
}
RIGHT: dict[str, Any] = {"name": "a", "size": 1, "count": 2, "peak": None, "rows": [{"t": 0.5}], "errors": {"x": 0.1}}

WRONG: dict[str, tuple[dict[str, Any], list[str]]] = {
    "nothing": ({}, []),
    "more": ({"extra": object}, []),
    "optional": ({"note": "b"}, []),
    "another type": ({"name": 3, "note": None}, ["name", "note"]),
    "a truth value is no number": ({"size": True, "count": False, "peak": True}, ["size", "count", "peak"]),
    "a text is no number": ({"size": "1"}, ["size"]),
    "not finite": ({"size": float("nan"), "peak": float("inf")}, ["size", "peak"]),
    "too large": ({"size": 1e301, "count": 10**4000}, ["size", "count"]),
    "a fraction is not whole": ({"count": 2.0}, ["count"]),
    "deep": ({"rows": [{"t": 1}, {}, 3, {"t": None}]}, ["rows.1.t", "rows.2", "rows.3.t"]),
    "any names": ({"errors": {"x": 1, "y": "1", "": []}}, ["errors.y", "errors."]),
    "a list for a table": ({"errors": [1.0], "rows": {}}, ["rows", "errors"]),
}


@pytest.mark.parametrize(("change", "named"), WRONG.values(), ids=WRONG)
def test_what_has_another_form_is_named(change: dict[str, Any], named: list[str]) -> None:
    assert list(misfits(RIGHT | change, FORM)) == named


def test_what_is_missing_is_named() -> None:
    assert list(misfits({"name": "a"}, FORM)) == ["size", "count", "peak", "rows", "errors"]
    assert list(misfits([], FORM)) == ["it"]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "Expecting value"),
        ('{"a": NaN}', "NaN is no number of JSON"),
        ('{"a": -Infinity}', "-Infinity is no number of JSON"),
        ('{"a": 1e400}', "Out of range float values"),
        ('{"a": ' + 5000 * "1" + "}", "Exceeds the limit"),
        ('{"a": "\\ud800"}', "surrogates not allowed"),
        ('{"a": 1, "a": 2}', "'a' is there twice"),
        (100_000 * "[", "it is nested too deep"),
        ("[1]", "it is no table"),
        ('{"\\u001b[2J": 1}', "it lacks or misstates name, size, count, peak, rows, errors"),
    ],
)
def test_what_is_no_strict_json_is_refused_in_a_line(text: str, message: str, tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    path.write_text(text)
    with pytest.raises(FileError, match=message) as caught:
        read_json(path, FORM, "a test's file")
    assert str(caught.value).startswith(f"{path}: is not a test's file")
    assert "\n" not in str(caught.value)


def test_names_in_a_message_are_text_and_not_too_many(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    path.write_text(json.dumps({**RIGHT, "errors": {"\x1b[2J": "", **{str(i): "" for i in range(20)}}}))
    with pytest.raises(FileError, match=r"misstates errors\.\\x1b\[2J, errors\.0, .* and 11 more$"):
        read_json(path, FORM, "a test's file")
