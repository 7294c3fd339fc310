"""docs/remake.py: JSON in, Markdown out; a page keeps what it cannot fill."""

from __future__ import annotations

from pathlib import Path

import pytest
import remake


def test_records_become_rows_under_their_keys() -> None:
    data = {"machine": "fast", "rows": [{"solver": "piqp", "p50_ms": 0.12345}, {"solver": "osqp", "p50_ms": None}]}
    assert remake.records(data) == "| solver | p50 ms |\n| --- | --- |\n| piqp | 0.123 |\n| osqp | - |\n"


def test_speeds_have_a_column_for_each_controller() -> None:
    flights = [
        {"course": "loop", "speed": speed, "controller": name, "error": error, "half": half}
        for speed, name, error, half in (
            *((4.0, "LQR", 1.0, None), (4.0, "PID", 0.02, 0.001)),
            *((10.0, "LQR", None, None), (10.0, "PID", 0.42, None)),
        )
    ]
    assert remake.speed(flights).splitlines() == [
        "| course | m/s | LQR | PID |",
        "| --- | --- | --- | --- |",
        "| loop | 4 | 1.000 | 0.020 ± 0.001 |",
        "| loop | 10 | lost | 0.420 |",
    ]


def test_first_flights_are_counted_by_course_and_law() -> None:
    flights = [
        {"law": "lqr", "course": "hover", "outcome": "satisfied", "largest": 0.001},
        {"law": "lqr", "course": "step", "outcome": "violated", "largest": 0.5},
        {"law": "lqr", "course": "step", "outcome": "satisfied", "largest": 0.1},
    ]
    assert remake.first_flights(flights).splitlines()[-1] == "| lqr | 1 of 1, 0.1 % | 1 of 2, 50.0 % |"


def test_a_page_is_filled_and_otherwise_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(remake, "ROOT", tmp_path)
    page = "before\n<!-- peers: filled by docs/remake.py from made.json -->\nold\n<!-- peers end -->\nafter\n"
    assert remake.filled(page) == (page, ["made.json"])
    (tmp_path / "made.json").write_text('[["position", "rotorpy", "1e-11 m", "1e-9 m"]]')
    text, missing = remake.filled(page)
    assert missing == []
    assert "| position | rotorpy | 1e-11 m | 1e-9 m |" in text
    assert text.startswith("before\n")
    assert text.endswith("after\n")
    assert remake.filled(text) == (text, [])


def test_a_name_that_nothing_makes_is_refused(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sys.argv", ["remake.py", "fast"])
    with pytest.raises(SystemExit, match="2"):
        remake.main()
    assert "NAME must be one of solvers, flight" in capsys.readouterr().err
