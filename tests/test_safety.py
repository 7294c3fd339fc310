"""The attacks of docs/safety.md in a short form; `make safety` goes through all of them."""

from __future__ import annotations

import safety_outputs


def test_foreign_files_never_change_wherever_a_command_writes() -> None:
    counted = safety_outputs.measure(60, number=1)
    assert counted["cases"] >= 50
    assert counted["done"] >= 10


def test_processes_that_are_killed_leave_nothing_that_stays() -> None:
    assert safety_outputs.measure_kills(4)["kills"] == 4
